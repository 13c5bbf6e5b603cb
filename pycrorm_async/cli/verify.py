"""`pycrorm verify`: are log and tables what they should be."""

from __future__ import annotations

import asyncio
from collections.abc import Sequence
from typing import Annotated, Any

import typer

from pycrorm_async.bulk import collect_seldom
from pycrorm_async.cli.options import DEFAULT_URL, JsonOption, ProjectionOption, UrlOption
from pycrorm_async.cli.output import note, print_json, stdout
from pycrorm_async.projections.own import Projection
from pycrorm_async.projections.own_found import installed_besides, named
from pycrorm_async.projections.verify import Verified
from pycrorm_async.projections.verify import verify as verify_log
from pycrorm_async.store.address import DatabaseAddress
from pycrorm_async.store.log import EventLog
from pycrorm_async.store.naming import episode_named
from pycrorm_async.watching import watched

__all__ = ["verify"]

_SHOWN = 20


def verify(
    episode: Annotated[
        str | None, typer.Option("--episode", help="Only this one: its number, its id, or `last`.")
    ] = None,
    url: UrlOption = DEFAULT_URL,
    projection: ProjectionOption = None,
    as_json: JsonOption = False,
) -> int:
    """Fold the log again and compare with the tables, row by row; look whether the log is whole.

    Reads only, while recording and folding go on. Exit code 0 if all is as it should be, 1 if tables differ from the
    log (`pycrorm rebuild` makes them anew), 4 if the log itself is damaged.
    """
    projections = named(projection or ())
    known = [*projections, *installed_besides(projections)]
    collect_seldom()
    found, ids = asyncio.run(_verify(url, episode, known))
    for name, reason in found.not_compared.items():
        note(f"the projection {name} was not looked at: {reason}")
    if as_json:
        print_json(_document(found, ids))
    else:
        _print(found)
    if found.damage:
        return 4
    return 1 if found.drift else 0


async def _verify(url: str, episode: str | None, known: Sequence[Projection]) -> tuple[Verified, dict[int, str]]:
    log = await EventLog.open(DatabaseAddress.parse(url), create=False)
    try:
        only = None if episode is None else await episode_named(log, episode)
        with watched("verifying") as tell:
            found = await verify_log(log, episode=only, projections=known, tell=tell)
        return found, {each.number: each.id for each in await log.episodes()}
    finally:
        await log.close()


def _print(found: Verified) -> None:
    for damage in found.damages[:_SHOWN]:
        stdout.print(f"damage: {damage}", markup=False)
    for each in found.differences[:_SHOWN]:
        stdout.print(f"drift: episode {each.number}, event {each.sequence}: {each}", markup=False)
    shown = min(len(found.damages), _SHOWN) + min(len(found.differences), _SHOWN)
    if found.damage + found.drift > shown:
        stdout.print(f"and {found.damage + found.drift - shown} more")
    if found.behind:
        stdout.print(f"{found.behind} events are not in the tables yet")
    said = f"{found.events} events of {found.episodes} episodes and {found.rows} rows: "
    if found.damage:
        stdout.print(f"{said}the log is damaged; what is whole can be copied to another with `pycrorm copy`")
    elif found.drift:
        stdout.print(f"{said}the log is whole, the tables differ from it: `pycrorm rebuild` makes them anew")
    else:
        stdout.print(f"{said}all as it should be")


def _document(found: Verified, ids: dict[int, str]) -> dict[str, Any]:
    def named(number: int | None) -> str | None:
        return None if number is None else ids.get(number)

    return {
        **{name: value for name, value in found._asdict().items() if name not in ("damages", "differences")},
        "damages": [{"episode": named(each.number), **each._asdict()} for each in found.damages],
        "differences": [{"episode": named(each.number), **each._asdict()} for each in found.differences],
    }
