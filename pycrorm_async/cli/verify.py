"""`pycrorm verify`: are log and tables what they should be."""

from __future__ import annotations

import asyncio
from collections.abc import Sequence
from typing import Annotated, Any

import typer

from pycrorm_async.bulk_records import collect_seldom
from pycrorm_async.cli.options import DEFAULT_URL, JsonOption, ProjectionOption, SpoolOption, UrlOption
from pycrorm_async.cli.output import note, print_json, stdout
from pycrorm_async.cli.pending_events import note_pending_events
from pycrorm_async.operations.destination import shared_address
from pycrorm_async.progress_bar import watched
from pycrorm_async.projections.custom.discovery import installed_besides, named
from pycrorm_async.projections.custom.projection import Projection
from pycrorm_async.projections.verify.verify import Verified
from pycrorm_async.projections.verify.verify import verify as verify_log
from pycrorm_async.store.episode_lookup import episode_named
from pycrorm_async.store.log import EventLog

__all__ = ["verify"]

_SHOWN = 20


def verify(
    episode: Annotated[
        str | None, typer.Option("--episode", help="Only this one: its number, its id, or `last`.")
    ] = None,
    url: UrlOption = DEFAULT_URL,
    spool: SpoolOption = None,
    projection: ProjectionOption = None,
    as_json: JsonOption = False,
) -> int:
    """Fold the log again and compare with the tables, row by row; look whether the log is whole.

    Reads only, while recording and folding go on. Exit code 0 if all is as it should be, 1 if tables differ from the
    log or are those of an older version (`pycrorm rebuild` makes them anew), if an episode is parked or refused, or if
    a designator type has no tables; 4 if the log itself is damaged.
    """
    projections = named(projection or ())
    known = [*projections, *installed_besides(projections)]
    collect_seldom()
    found, ids = asyncio.run(_verify(url, episode, known))
    note_pending_events(url, spool)
    for name, reason in found.not_compared.items():
        note(f"the projection {name} was not looked at: {reason}")
    if as_json:
        print_json(_document(found, ids))
    else:
        _print(found)
    if found.damage:
        return 4
    return 1 if found.drift or found.stopped or found.unmade or found.outdated else 0


async def _verify(url: str, episode: str | None, known: Sequence[Projection]) -> tuple[Verified, dict[int, str]]:
    log = await EventLog.open(shared_address(url), create=False)
    try:
        only = None if episode is None else await episode_named(log, episode)
        with watched("verifying") as tell:
            found = await verify_log(log, episode=only, projections=known, report_progress=tell)
        return found, {each.number: each.id for each in await log.episodes()}
    finally:
        await log.close()


def _print(found: Verified) -> None:
    for damage in found.damages[:_SHOWN]:
        stdout.print(f"damage: {damage}", markup=False)
    for each in found.differences[:_SHOWN]:
        stdout.print(f"drift: episode {each.number}, event {each.sequence}: {each}", markup=False)
    for stopped in found.stopped[:_SHOWN]:
        stdout.print(f"{stopped.how}: episode {stopped.number}: {stopped.reason}", markup=False)
    for dtype, reason in [*found.unmade.items()][:_SHOWN]:
        stdout.print(f"no tables: {dtype[:80]!r}: {reason}", markup=False)
    if found.outdated is not None:
        stdout.print(f"outdated: {found.outdated}", markup=False)
    findings = (found.damages, found.differences, found.stopped, found.unmade)
    count = found.damage + found.drift + len(found.stopped) + len(found.unmade)
    shown = sum(min(len(each), _SHOWN) for each in findings)
    if count > shown:
        stdout.print(f"and {count - shown} more")
    if found.behind:
        stdout.print(f"{found.behind} events are not in the tables yet")
    said = f"{found.events} events of {found.episodes} episodes and {found.rows} rows: "
    if found.damage:
        stdout.print(f"{said}the log is damaged; what is whole can be copied to another with `pycrorm copy`")
    elif found.drift:
        stdout.print(f"{said}the log is whole, the tables differ from it: `pycrorm rebuild` makes them anew")
    elif found.outdated is not None:
        stdout.print(f"{said}the tables are outdated: `pycrorm rebuild` makes them anew")
    elif found.stopped or found.unmade:
        stdout.print(
            f"{said}{len(found.stopped)} episodes are stopped, {len(found.unmade)} types have no tables,"
            " and the rest is as it should be",
            soft_wrap=True,
        )
    else:
        stdout.print(f"{said}all as it should be")


def _document(found: Verified, ids: dict[int, str]) -> dict[str, Any]:
    def named(number: int | None) -> str | None:
        return None if number is None else ids.get(number)

    return {
        **{name: value for name, value in found._asdict().items() if name not in ("damages", "differences", "stopped")},
        "damages": [{"episode": named(each.number), **each._asdict()} for each in found.damages],
        "stopped": [{"episode": named(each.number), **each._asdict()} for each in found.stopped],
        "differences": [{"episode": named(each.number), **each._asdict()} for each in found.differences],
    }
