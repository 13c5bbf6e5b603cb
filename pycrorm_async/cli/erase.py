"""Erase episodes everywhere, or those older than a rule keeps.

Panel: Operate, 7.
"""

from __future__ import annotations

import asyncio
from collections.abc import Sequence
from contextlib import suppress
from typing import Annotated

import typer

from pycrorm_async.cli import output
from pycrorm_async.cli.reading import Place
from pycrorm_async.clock import utc_of
from pycrorm_async.errors import CallerError
from pycrorm_async.operations import removal
from pycrorm_async.operations.retention import BY_RULE
from pycrorm_async.store.log import EventLog
from pycrorm_async.store.stored import EpisodeRow, RemovedEpisode

_NAMED = 10
"""The episodes that the question names."""


def erase(
    *,
    episodes: Annotated[
        list[str] | None,
        typer.Argument(metavar="[EPISODE]...", help="Numbers, ids or first digits of the ids; without, the journal."),
    ] = None,
    keep: Annotated[
        str | None,
        typer.Option(metavar="AGE", help="Instead of EPISODE: all that are older: 90d, 52w, or ended before a date."),
    ] = None,
    tag: output.TagOption = None,
    reason: Annotated[str | None, typer.Option(metavar="TEXT", help="The reason, which stays in the journal.")] = None,
    dry_run: Annotated[bool, typer.Option("--dry-run", help="List what would be erased, and change nothing.")] = False,
    lake: output.LakeOption = None,
    yes: Annotated[bool, typer.Option("--yes", help="Do not ask.")] = False,
    place: Place,
    form: output.Form,
) -> int:
    """Erase episodes from the log, the tables, recall, blobs, kept segments of the spool and the file's free pages.

    Their numbers, ids, digests, times and the reason stay, in the journal. What arrives of them later, from a spool, a
    copy or an import, is discarded. An episode that is or was archived is erased from its lake too. Not rewritten are
    backups, replicas, and on PostgreSQL the write-ahead log and the free space in pages. Run it again after an
    interruption, or when it has named what is left (exit code 1). On PostgreSQL it needs the login that owns the log.

    For --keep, an age counts from the end of an episode, and at the earliest from when episodes started that were
    stored before it, because a robot's clock may be years behind.
    """
    if not episodes and keep is None:
        return asyncio.run(_print_journal(place, form))
    if episodes and keep is not None:
        raise CallerError("name episodes or give --keep, not both")
    if tag and keep is None:
        raise CallerError("--tag belongs to --keep: it chooses among the episodes that ended before then")
    if reason is not None and reason.startswith(BY_RULE):
        raise CallerError(f"a reason that begins with {BY_RULE!r} is that of a rule: put another word before it")
    why = reason or (f"--keep {keep}" + "".join(f" --tag {each}" for each in tag or ()) if keep else "")
    if not why:
        raise CallerError("say why with --reason: it stays in the journal when the episode is gone")

    async def run() -> int:
        async with await EventLog.open(place.shared_address, create=False) as log:
            before = None if keep is None else output.parse_since(keep)
            rows = await removal.erasable(log, episodes or (), ended_before=before, tags=tag or ())
        if dry_run or not rows:
            _print(form, f"To erase from {place.address}", rows)
            return 0
        if not yes:
            listed = ", ".join(str(each.number) for each in rows[:_NAMED]) + ", …" * (len(rows) > _NAMED)
            ask(f"Erase {output.counted(len(rows), 'episode')} of {place.address} for ever: {listed}?")
        async with await EventLog.open(place.shared_address, create=True, belongs_to=log.log_id) as log:
            spool = place.spool or place.address.default_spool
            done = await removal.erase(log, rows, reason=why, spool=spool, lake=lake)
        _print(form, f"Erased from {place.address}", [each.removed for each in done])
        return name_what_is_left(done)

    return asyncio.run(run())


def name_what_is_left(done: Sequence[removal.ErasedEpisode]) -> int:
    """Print a line for each part of an erased episode that is left; return the exit code."""
    for each in done:
        for what in each.left:
            output.problem(f"episode {each.removed.number} is erased from the log, and parts of it are left in {what}")
    return 1 if any(each.left for each in done) else 0


def ask(question: str) -> None:
    """Ask before episodes are erased. Raises `CallerError` unless the answer is yes."""
    with suppress(typer.Abort):  # also where no terminal answers
        if typer.confirm(question, err=True):
            return
    raise CallerError("nothing was erased; --yes answers the question")


async def _print_journal(place: Place, form: output.Form) -> int:
    async with await EventLog.open(place.shared_address, create=False) as log:
        removed = await log.all_removed()
    _print(form, f"Removed from {place.address}", removed)
    if form.is_table and not removed:
        output.note("nothing was erased or archived; name the episodes to erase, or give --keep")
    return 0


def _print(form: output.Form, title: str, rows: Sequence[EpisodeRow | RemovedEpisode]) -> None:
    columns = ("episode", "id", "events", "ended", "removed", "reason", "archived in")
    cells: list[tuple[object, ...]] = []
    for each in rows:
        removal: tuple[str | None, ...] = ("", "", "")
        if isinstance(each, RemovedEpisode):
            removal = moment_of(each.removed_wall_ns), each.reason, each.archived_in
        cells.append((each.number, each.id, each.head, moment_of(each.ended_wall_ns), *removal))
    output.print_rows(form, [each._asdict() for each in rows], title, columns, cells)


def moment_of(wall_ns: int | None) -> str:
    """Return this time as a cell of a table."""
    return "" if wall_ns is None else output.moment(utc_of(wall_ns // 1000))
