"""Check the log for damage, and compare the tables with it.

Panel: Operate, 4.
"""

from __future__ import annotations

import asyncio
import sys
from collections.abc import Sequence
from pathlib import Path
from typing import Annotated, Any

import msgspec
import typer

from pycrorm_async.bulk_records import collect_seldom
from pycrorm_async.cli.output import JsonOption, ProjectionOption, counted, note, print_json, stdout
from pycrorm_async.cli.reading import ReadingPlace
from pycrorm_async.errors import CallerError
from pycrorm_async.progress_bar import progress_bar
from pycrorm_async.projections.custom import Projection, installed_projections, load_projections
from pycrorm_async.projections.findings import VerifyResult
from pycrorm_async.projections.verify import OutsideDigest
from pycrorm_async.projections.verify import verify as verify_log
from pycrorm_async.store.log import episode_named

_FINDINGS_MAX = 20
"""Bounds the printed findings of each kind; the rest is only counted."""


def verify(
    *,
    episode: Annotated[
        str | None, typer.Option("--episode", help="Verify only this episode: its number, its id, or `last`.")
    ] = None,
    place: ReadingPlace,
    digests: Annotated[
        Path | None,
        typer.Option(
            "--digests",
            help="Compare also with these digests: a file from `pycrorm episodes --all --simulated --json`; or -.",
            allow_dash=True,
            dir_okay=False,
        ),
    ] = None,
    projection: ProjectionOption = None,
    as_json: JsonOption = False,
) -> int:
    """Check the log for damage, fold it again, and compare the result with the tables row by row.

    Changes nothing; recording and folding may continue. Exit code 0 if there is no problem; 1 if tables differ from
    the log or are of an older version (`pycrorm rebuild` replaces them), if an episode is parked or refused, or if a
    designator type has no tables or a view is left out; 4 if the log is damaged, or differs from its digests or from
    those of --digests.
    """
    outside = () if digests is None else _read_digests(digests)
    given_projections = load_projections(projection or ())
    projections = [*given_projections, *installed_projections(given_projections)]
    collect_seldom()
    result, ids = asyncio.run(_verify(place, episode, projections, outside))
    place.place.note_pending_events()
    for name, reason in result.not_compared.items():
        note(f"the projection {name} was not verified: {reason}")
    if as_json:
        print_json(_document(result, ids))
    else:
        _print(result)
    if result.damage:
        return 4
    return 1 if result.drift or result.stopped or result.unmade or result.failed_views or result.outdated else 0


class _EpisodeDigest(msgspec.Struct):
    """The fields of `pycrorm episodes --json` that name an episode and its last digest."""

    id: str
    digest_sequence: int | None = None
    digest: str | None = None


def _read_digests(path: Path) -> list[OutsideDigest]:
    """Read a document of `pycrorm episodes --json`; episodes without a digest are left out. Raises `CallerError`."""
    try:
        document = sys.stdin.buffer.read() if str(path) == "-" else path.read_bytes()
        episodes = msgspec.json.decode(document, type=list[_EpisodeDigest])
    except OSError as error:
        raise CallerError(f"{path} cannot be read: {error.strerror}") from error
    except (msgspec.DecodeError, UnicodeDecodeError) as error:
        raise CallerError(
            f"{path} holds no digests: {error}; write them with `pycrorm episodes --all --json`"
        ) from error
    return [
        OutsideDigest(each.id, each.digest_sequence, each.digest)
        for each in episodes
        if each.digest is not None and each.digest_sequence is not None
    ]


async def _verify(
    place: ReadingPlace, episode: str | None, projections: Sequence[Projection], digests: Sequence[OutsideDigest]
) -> tuple[VerifyResult, dict[int, str]]:
    async with await place.open_log() as log:
        only = None if episode is None else await episode_named(log, episode)
        with progress_bar("verifying") as report_progress:
            result = await verify_log(
                log, episode=only, projections=projections, digests=digests, report_progress=report_progress
            )
        return result, {each.number: each.id for each in ([only] if only else await log.episodes())}


def _print(result: VerifyResult) -> None:
    findings = (
        [f"damage: {each}" for each in result.damages],
        [f"drift: episode {each.number}, event {each.sequence}: {each}" for each in result.differences],
        [f"{each.how}: episode {each.number}: {each.reason}" for each in result.stopped],
        [f"no tables: {dtype[:80]!r}: {reason}" for dtype, reason in result.unmade.items()],
        [f"no view: {name}: {reason}" for name, reason in result.failed_views.items()],
    )
    for each in findings:
        for line in each[:_FINDINGS_MAX]:
            stdout.print(line, markup=False)
    if result.outdated is not None:
        stdout.print(f"outdated: {result.outdated}", markup=False)
    count = result.damage + result.drift + sum(map(len, findings[2:]))
    shown = sum(min(len(each), _FINDINGS_MAX) for each in findings)
    if count > shown:
        stdout.print(f"and {count - shown} more")
    if result.behind:
        stdout.print(f"{result.behind} events are not in the tables yet")
    if result.without_digest:
        stdout.print(
            f"{result.without_digest} episodes are without a digest: an earlier version stored them, or a login that"
            " may not insert digests, or the digests were deleted; in a copy made with `pycrorm copy` they have one",
            soft_wrap=True,
        )
    folded = f"{counted(result.events, 'event')} of {counted(result.episodes, 'episode')}"
    removed = f" ({result.archived:,} archived and {result.erased:,} erased episodes are not in the log)"
    is_whole = not result.archived and not result.erased
    checked = f"{folded} and {counted(result.rows, 'row')}{'' if is_whole else removed}: "
    stdout.print(f"{checked}{_verdict(result)}", soft_wrap=True)


def _verdict(result: VerifyResult) -> str:
    if result.rows_without_event:
        rows = counted(result.rows_without_event, "row")
        return (
            f"events were deleted from the log, and the tables have {rows} of them, which `pycrorm rebuild` would"
            " delete; restore a backup, or compare digests kept elsewhere (`--digests`)"
        )
    if result.damage:
        return "the log is damaged; copy its intact events to another memory with `pycrorm copy`"
    if result.drift and result.undecided:
        return (
            f"the tables of {counted(result.undecided, 'episode')} without a digest differ from the log, so that either"
            " these tables or these events were changed; compare them with a backup before `pycrorm rebuild`, which"
            " makes the tables from the events"
        )
    if result.drift:
        return "the log is intact, but the tables differ from it; run `pycrorm rebuild`"
    if result.outdated is not None:
        return "the tables are outdated; run `pycrorm rebuild`"
    if result.stopped or result.unmade or result.failed_views:
        views = f" {len(result.failed_views)} views are left out," if result.failed_views else ""
        stopped = f"{len(result.stopped)} episodes are stopped, {len(result.unmade)} types have no tables"
        return f"{stopped},{views} no other problem"
    return "no problem"


def _document(result: VerifyResult, ids: dict[int, str]) -> dict[str, Any]:
    def id_of(number: int | None) -> str | None:
        return None if number is None else ids.get(number)

    return {
        **{name: value for name, value in vars(result).items() if not name.startswith("_")},
        "blobs": len(result.blobs),
        "undecided": result.undecided,
        "deleted": sorted(result.deleted),
        "damages": [{"episode": id_of(each.number), **each._asdict()} for each in result.damages],
        "stopped": [{"episode": id_of(each.number), **each._asdict()} for each in result.stopped],
        "differences": [{"episode": id_of(each.number), **each._asdict()} for each in result.differences],
    }
