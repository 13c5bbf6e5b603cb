"""`pycrorm archive`: move episodes that have ended from a memory into a lake, which `pycrorm restore` reads.

Theory of operation. Of each episode the events that the lake lacks are added in one transaction of the lake, with the
types, descriptions and blobs that they name. Then its events are read back, and their digest is compared with that of
the memory. Only then is the episode removed from the memory (`operations.removal`). A process that is killed between
the two leaves the episode in both, and the next archive finds it in the lake and removes it. One that is killed before
the commit leaves files that the catalog does not know; an hour later the next archive or erasure deletes them.

Episodes go in groups, each with one file of events. While one group is added to the lake and read back, the next one is
read from the memory, and the one before it is removed. The lake works in a thread, so that the others need not wait.
"""

import asyncio
from collections.abc import Collection, Sequence
from datetime import datetime
from itertools import islice
from typing import Final, NamedTuple

from pycrorm_async.errors import DamageError
from pycrorm_async.events.codec import fingerprint, short_name
from pycrorm_async.events.types import BlobReference, references_in
from pycrorm_async.operations.copy import declared_by
from pycrorm_async.operations.removal import EVENTS_AT_ONCE, parts, remove
from pycrorm_async.progress_bar import ProgressCallback
from pycrorm_async.projections.rebuild import claimed
from pycrorm_async.store.address import shared_address
from pycrorm_async.store.dialects import dialect_of
from pycrorm_async.store.lake import Lake, LakeEpisode, check_present, digest_after, shown
from pycrorm_async.store.log import EventLog
from pycrorm_async.store.stored import EpisodeRow, RemovedEpisode, RunningDigest, Span, StoredEvent
from pycrorm_async.writer.drain import Backoff, retry

_EVENTS_AT_ONCE: Final = 120_000
"""Bounds the events of one file of the lake, unless an episode has more, and with them the memory that is used: a file
of Parquet is read in groups of 122,880 rows."""

_COMMITTING: Final = Backoff(first_s=0.1, longest_s=5.0, attempts_max=12)
"""The backoff of commits to a lake to which other processes commit: a catalog in a file refuses one of two at once."""


class ArchiveSummary(NamedTuple):
    """The result of an archive: the episodes that left the memory, and the reasons why others stayed, by id."""

    removed: list[RemovedEpisode]
    stayed: dict[str, str]


async def archive_episodes(
    url: str,
    address: str,
    *,
    before: datetime,
    only: Collection[int] | None = None,
    reason: str,
    summary: ArchiveSummary | None = None,
    report_progress: ProgressCallback = lambda _done, _total, _what=None: None,
) -> ArchiveSummary:
    """Move the episodes that ended before this time into the lake at this address, which is made if it is missing.

    With `only`, those among them with one of these numbers. Adds to `summary`, which has what went before an error.

    Leaves out episodes that are stopped or not visible yet. Raises `CallerError` while another archive or rebuild of
    the memory runs, `MissingExtra`, and errors of both databases, also for a lake that has episodes of this memory and
    is missing; what was moved until then stays moved.
    """
    log = await EventLog.open_to_change(shared_address(url))
    summary = ArchiveSummary([], {}) if summary is None else summary
    try:
        async with claimed(log):
            if any(each.archived_in == shown(address) for each in await log.all_removed()):
                check_present(address)
            lake = Lake(address, write=True)
            try:
                end_ns = before.timestamp() * 1e9
                rows = [each for each in await log.episodes() if _may_go(each, end_ns)]
                rows = rows if only is None else [each for each in rows if each.number in only]
                archiving = _Archiving(log, lake, reason, summary, report_progress, sum(each.head for each in rows))
                async with asyncio.TaskGroup() as tasks:
                    for some in parts(rows, _EVENTS_AT_ONCE):
                        tasks.create_task(archiving.archive(some), name="pycrorm archive")
                lake.clear_orphans()
            except ExceptionGroup as errors:  # the others of the group were cancelled
                raise errors.exceptions[0] from None
            finally:
                await lake.close()
            if summary.removed and log.address.is_sqlite:
                await dialect_of(log.engine).purge(log.engine, ())
    finally:
        await log.close()
    return summary


def _may_go(row: EpisodeRow, end_ns: float) -> bool:
    ended = row.ended_wall_ns is not None and row.ended_wall_ns < end_ns
    return ended and row.refused is None and row.parked is None and row.folded == row.head


class _ReadEpisode(NamedTuple):
    """An episode of the memory, as the lake should have it, and its events."""

    row: EpisodeRow
    archived: LakeEpisode
    events: Sequence[StoredEvent]


class _Archiving:
    """Archives groups of episodes: reads one, adds the one before it, and removes the one before that."""

    def __init__(
        self,
        log: EventLog,
        lake: Lake,
        reason: str,
        summary: ArchiveSummary,
        report_progress: ProgressCallback,
        events: int,
    ) -> None:
        self._log = log
        self._lake = lake
        self._reason = reason
        self._summary = summary
        self._report_progress = report_progress
        self._done, self._events = 0, events
        self._reading, self._adding, self._removing = asyncio.Lock(), asyncio.Lock(), asyncio.Lock()
        self._in_memory = asyncio.Semaphore(2)

    async def archive(self, rows: Sequence[EpisodeRow]) -> None:
        """Move these episodes into the lake; calls wait for each other in their order."""
        moved = await self._copied(rows)
        async with self._removing:
            digests = {row.number: digest for row, digest in moved}
            for some in parts([row for row, _ in moved], EVENTS_AT_ONCE):
                removed = await remove(
                    self._log, some, reason=self._reason, archived_in=self._lake.address, digests=digests
                )
                self._summary.removed.extend(removed)
        self._done += sum(each.head for each in rows)
        self._report_progress(self._done, self._events)

    async def _copied(self, rows: Sequence[EpisodeRow]) -> list[tuple[EpisodeRow, str]]:
        """Copy these episodes into the lake; return those that may be removed, with the digests of their events."""
        async with self._in_memory:
            async with self._reading:
                read = await self._read(rows)
            async with self._adding:
                return await self._add(read)

    async def _read(self, rows: Sequence[EpisodeRow]) -> list[_ReadEpisode]:
        """Read the events of these episodes, without those that are damaged or do not match their digest."""
        log, stayed = self._log, self._summary.stayed
        kept = await log.last_digests(rows[0].number, rows[-1].number)
        events_by_number = await _events(log, rows)
        read: list[_ReadEpisode] = []
        for row in rows:
            try:
                events: Sequence[StoredEvent] = events_by_number.get(row.number, [])
                if len(events) < row.head:  # raises for the one that is damaged or missing
                    events = [event async for page in log.pages(row) for event in page]
                digest = digest_after(RunningDigest.at_start(row.identity), events)
            except DamageError as damage:
                stayed[row.id] = str(damage)
                continue
            own = kept.get(row.number)
            if own is not None and own.sequence == row.head and own.digest != digest:
                stayed[row.id] = "its events do not match its digest: run `pycrorm verify`"
                continue
            assert row.ended_wall_ns is not None, "it has ended"
            archived = LakeEpisode(row.id, row.head, row.started_wall_ns, row.ended_wall_ns, digest)
            read.append(_ReadEpisode(row, archived, events))
        return read

    async def _add(self, episodes: Sequence[_ReadEpisode]) -> list[tuple[EpisodeRow, str]]:
        """Add the events that the lake lacks, and read all back; return the episodes with equal digests."""
        lake, stayed, ids = self._lake, self._summary.stayed, [each.row.id for each in episodes]
        there = await asyncio.to_thread(lake.episode_rows, ids)
        erased = await asyncio.to_thread(lake.erased, ids)
        elsewhere = {each.id: each.archived_in for each in await self._log.restored(ids)}
        new: list[_ReadEpisode] = []
        for each in episodes:
            name = each.row.id
            after = there[name].head if name in there else 0
            if elsewhere.get(name, lake.address) != lake.address:
                stayed[name] = f"it was restored from {elsewhere[name]}, which has it still: archive it there"
            elif name in erased:
                why = erased[name]
                stayed[name] = f"it was erased from the lake on {why}: `pycrorm erase` removes it here too"
            elif after > each.row.head:
                stayed[name] = f"the lake holds {after} events of it, and this memory only {each.row.head}"
            else:
                new.append(each._replace(events=each.events[after:]))
        lacking = [(each.archived, each.events) for each in new if there.get(each.row.id) != each.archived]
        if lacking:
            await _add(self._log, lake, lacking)
        read = await asyncio.to_thread(lake.digests, [each.row.id for each in new])
        for each in new:
            if read.get(each.row.id) != each.archived.digest:
                stayed[each.row.id] = "the lake holds other events of it than this memory"
        return [(each.row, read[each.row.id]) for each in new if each.row.id not in stayed]


async def _events(log: EventLog, rows: Sequence[EpisodeRow]) -> dict[int, list[StoredEvent]]:
    """Read the events of episodes, by number; none if one of them is damaged or lacks an event."""
    try:
        events = await log.spans([Span(row.number, 0, row.head) for row in rows])
    except DamageError:
        return {}
    if len(events) < sum(row.head for row in rows):
        return {}
    in_order = iter(events)
    return {row.number: [*islice(in_order, row.head)] for row in rows}


async def _add(log: EventLog, lake: Lake, episodes: Sequence[tuple[LakeEpisode, Sequence[StoredEvent]]]) -> None:
    events = [event for _, some in episodes for event in some]
    lacking = await asyncio.to_thread(lake.absent, "declaration", "fingerprint", declared_by(events))
    declarations = await log.descriptions(lacking)
    if types := lake.absent("declaration", "substr(fingerprint, 1, 16)", lacking - declarations.keys()):
        declared = {fingerprint(each): each for each in await log.declarations()}
        declarations |= {name: each for name, each in declared.items() if short_name(name) in types}
    references: dict[str, BlobReference] = {}
    referring = [(each.type, each.payload) for each in events if b'"$blob"' in each.payload]
    for kind, payload in [*referring, *(("DescriptionDeclared", each) for each in declarations.values())]:
        references |= {each.hash: each for each in references_in(kind, payload)}
    blobs: dict[str, tuple[str, bytes]] = {}
    for name in await asyncio.to_thread(lake.absent, "blob", "hash", references):
        content = await log.blobs.read_blob(name)
        if content is not None:
            blobs[name] = references[name].media_type, content

    async def add() -> None:
        await asyncio.to_thread(lake.add, episodes, declarations, blobs, log.log_id)

    await retry(add, backoff=_COMMITTING)
