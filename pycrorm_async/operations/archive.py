"""`pycrorm archive`: move episodes that have ended from a memory into a lake, which `pycrorm restore` reads.

Theory of operation. Of each episode the events that the lake lacks are added in one transaction of the lake, with the
types, descriptions and blobs that they name. Then its events are read back, and their digest is compared with that of
the memory. Only then is the episode removed from the memory (`operations.removal`). A process that is killed between
the two leaves the episode in both, and the next archive finds it in the lake and removes it. One that is killed before
the commit leaves files that the catalog does not know; an hour later the next archive or erasure deletes them.

While some episodes are added to the lake and read back, those before them are removed from the memory. The lake works
in a thread, so that the statements of the removal need not wait for it.
"""

import asyncio
from collections.abc import Collection, Mapping, Sequence
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

_EVENTS_AT_ONCE: Final = 200_000
"""Bounds the events of one file of the lake, unless an episode has more, and with them the memory that is used."""

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
                total, done = sum(each.head for each in rows), 0
                removing = asyncio.create_task(_remove(log, lake, (), {}, reason, summary))
                try:
                    for some in parts(rows, _EVENTS_AT_ONCE):
                        digests = await _add_and_compare(log, lake, some, summary)
                        done += sum(each.head for each in some)
                        report_progress(done, total)
                        await removing
                        removing = asyncio.create_task(_remove(log, lake, some, digests, reason, summary))
                finally:
                    await removing
                lake.clear_orphans()
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


async def _add_and_compare(
    log: EventLog, lake: Lake, rows: Sequence[EpisodeRow], summary: ArchiveSummary
) -> dict[str, str]:
    """Add the events that the lake lacks and read all back; return the digests by id of the episodes that may go."""
    added = await _add_missing(log, lake, rows, summary)
    read = await asyncio.to_thread(lake.digests, [each.id for each in added])
    for each in added:
        if read.get(each.id) != each.digest:
            summary.stayed[each.id] = "the lake holds other events of it than this memory"
    return {name: digest for name, digest in read.items() if name not in summary.stayed}


async def _remove(
    log: EventLog,
    lake: Lake,
    rows: Sequence[EpisodeRow],
    digests: Mapping[str, str],
    reason: str,
    summary: ArchiveSummary,
) -> None:
    """Remove those of these episodes that have one of these digests in the lake."""
    numbered = {row.number: digests[row.id] for row in rows if row.id in digests}
    for some in parts([each for each in rows if each.number in numbered], EVENTS_AT_ONCE):
        summary.removed.extend(await remove(log, some, reason=reason, archived_in=lake.address, digests=numbered))


async def _add_missing(
    log: EventLog, lake: Lake, rows: Sequence[EpisodeRow], summary: ArchiveSummary
) -> list[LakeEpisode]:
    """Add the events that the lake lacks; return the episodes that it should have now, to be read back."""
    there, erased = lake.episode_rows([each.id for each in rows]), lake.erased([each.id for each in rows])
    kept = await log.last_digests(rows[0].number, rows[-1].number)
    new: list[tuple[LakeEpisode, Sequence[StoredEvent]]] = []
    read_events = await _events(log, rows)
    elsewhere = {each.id: each.archived_in for each in await log.restored(each.id for each in rows)}
    for row in rows:
        if elsewhere.get(row.id, lake.address) != lake.address:
            summary.stayed[row.id] = f"it was restored from {elsewhere[row.id]}, which has it still: archive it there"
            continue
        if row.id in erased:
            why = erased[row.id]
            summary.stayed[row.id] = f"it was erased from the lake on {why}: `pycrorm erase` removes it here too"
            continue
        try:
            events = read_events.get(row.number, [])
            if len(events) < row.head:  # raises for the one that is damaged or missing
                events = [event async for page in log.pages(row) for event in page]
            digest = digest_after(RunningDigest.at_start(row.identity), events)
        except DamageError as damage:
            summary.stayed[row.id] = str(damage)
            continue
        own = kept.get(row.number)
        if own is not None and own.sequence == row.head and own.digest != digest:
            summary.stayed[row.id] = "its events do not match its digest: run `pycrorm verify`"
            continue
        after = there[row.id].head if row.id in there else 0
        assert row.ended_wall_ns is not None, "it has ended"
        episode = LakeEpisode(row.id, row.head, row.started_wall_ns, row.ended_wall_ns, digest)
        if after > row.head:
            summary.stayed[row.id] = f"the lake holds {after} events of it, and this memory only {row.head}"
        else:
            new.append((episode, events[after:]))
    lacking = [each for each in new if each[0].id not in there or there[each[0].id] != each[0]]
    if lacking:
        await _add(log, lake, lacking)
    return [each for each, _ in new]


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
    lacking = lake.absent("declaration", "fingerprint", declared_by(events))
    declarations = await log.descriptions(lacking)
    if types := lake.absent("declaration", "substr(fingerprint, 1, 16)", lacking - declarations.keys()):
        declared = {fingerprint(each): each for each in await log.declarations()}
        declarations |= {name: each for name, each in declared.items() if short_name(name) in types}
    references: dict[str, BlobReference] = {}
    referring = [(each.type, each.payload) for each in events if b'"$blob"' in each.payload]
    for kind, payload in [*referring, *(("DescriptionDeclared", each) for each in declarations.values())]:
        references |= {each.hash: each for each in references_in(kind, payload)}
    blobs: dict[str, tuple[str, bytes]] = {}
    for name in lake.absent("blob", "hash", references):
        content = await log.blobs.read_blob(name)
        if content is not None:
            blobs[name] = references[name].media_type, content

    async def add() -> None:
        await asyncio.to_thread(lake.add, episodes, declarations, blobs, log.log_id)

    await retry(add, backoff=_COMMITTING)
