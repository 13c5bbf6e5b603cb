"""`pycrorm copy`: append the episodes of one memory to another memory of any kind, and fold them there.

The command forks two fold workers, which fold what is appended while this process reads and appends the next episodes.
A caller without them folds in its own process.

An event's key is part of the event, so a copy may be interrupted and repeated, in any order: events that the target has
are compared, and those after them are appended, with the blobs that they refer to. An episode that is being recorded is
copied up to its present head; repeating the copy appends the rest. Nothing is written to the source. Episode numbers
and row ids belong to a database, so the target assigns its own.
"""

from __future__ import annotations

import asyncio
import logging
from collections.abc import AsyncIterator, Awaitable, Callable, Iterable, Sequence
from contextlib import asynccontextmanager, suppress
from dataclasses import dataclass
from functools import partial
from itertools import chain, repeat
from tempfile import TemporaryDirectory
from typing import TYPE_CHECKING, TypeAlias

import msgspec

from pycrorm_async import errors
from pycrorm_async.bulk_records import make
from pycrorm_async.clock import SYSTEM_CLOCK, Clock
from pycrorm_async.events.codec import Record, declaration_type, decode, encode, fingerprint, short_name
from pycrorm_async.events.fields import changed_tags
from pycrorm_async.events.ids import EpisodeId, episode_text, is_episode_id
from pycrorm_async.events.types import EVENT_TYPES, EpisodeTagged
from pycrorm_async.operations.destination import LogAndTables
from pycrorm_async.operations.workers import Assignment, ChildProcess, FoldWorkers, WorkerFolds
from pycrorm_async.projections.custom import own_projections
from pycrorm_async.projections.projector import Projector
from pycrorm_async.settings import Settings
from pycrorm_async.store.address import DatabaseAddress, shared_address
from pycrorm_async.store.lake import PREFIX, Lake
from pycrorm_async.store.log import EventLog, episode_named, tags_of
from pycrorm_async.store.placement import PLAIN, Placement
from pycrorm_async.store.stored import EpisodeRow, StoredEvent
from pycrorm_async.writer.drain import BATCH_BYTES_MAX, BRIEF, retry

if TYPE_CHECKING:
    from pycrorm_async.progress_bar import ProgressCallback
    from pycrorm_async.query.reading import Reading


_log = logging.getLogger("pycrorm_async")

Source: TypeAlias = EventLog | Lake
"""What a copy reads: a memory, or a lake, of which archived episodes are restored."""


@dataclass(frozen=True)
class EpisodeCopy:
    """The copy of one episode.

    Attributes:
        id, number: its UUID, its number in the source.
        were_there: the number of the source's events that the target had before the copy.
        copied: the number of events appended.
        head: the last event that the target has now.
        damage: the reason of an incomplete copy: damage in the source, or other events in the target.
        stopped: the reason why the target refuses or does not fold further events.
    """

    id: str
    number: int
    were_there: int
    copied: int
    head: int
    damage: str | None = None
    stopped: str | None = None


@dataclass(frozen=True)
class CopySummary:
    """The result of a copy; the URLs have no passwords."""

    source: str
    target: str
    episodes: tuple[EpisodeCopy, ...]


async def copy_episodes(
    source: str,
    target: str,
    *,
    episodes: Sequence[str] = (),
    settings: Settings | None = None,
    report_progress: ProgressCallback = lambda _done, _total, _what=None: None,
    forked: Sequence[ChildProcess] = (),
) -> CopySummary:
    """Copy episodes, given by number in the source, id, first digits of the id or `last`; by default all of them.

    Creates a missing target. Calls `report_progress` with the number of events done and their total. The processes that
    the caller has `forked` fold; without any, this one does. Damage to one episode does not prevent copying the others.
    Raises `UnknownEpisode`, `CallerError` if both are the same memory, and the errors of `Memory.open`; events copied
    until then stay.
    """
    target_address = shared_address(target)
    log: Source
    if source.startswith(PREFIX):
        log = Lake(source)
    else:
        log = await EventLog.open(shared_address(source), create=False)
    try:
        named = [
            await (_archived(log, each, target_address) if isinstance(log, Lake) else episode_named(log, each))
            for each in episodes
        ]
        chosen = {row.id: row for row in named}
        rows = list(chosen.values()) if episodes else await log.episodes()
        settings = settings or Settings()
        async with _open_target(target_address, log) as (target_log, destination):
            assignment = Assignment(target_address, target_log.log_id)
            async with FoldWorkers(
                len(forked), assignment, settings=settings, report=_log.warning, note=lambda _: None, forked=forked
            ) as workers:
                folds = WorkerFolds(destination, workers) if forked else destination
                copier = _Copier(log, target_log, destination, folds.fold_next_batch, settings, report_progress)
                done = await copier.copy(rows)
    finally:
        await log.close()
    return CopySummary(str(log.address), target_address.to_type, done)


async def _archived(lake: Lake, name: str, target: DatabaseAddress) -> EpisodeRow:
    """Find an episode of a lake. Raises `UnknownEpisode`, of one that the target has erased with time and reason."""
    try:
        return lake.named(name)
    except errors.UnknownEpisode:
        with suppress(errors.DatabaseError):  # there may be no target yet
            async with await EventLog.open(target, create=False) as log:
                for each in await log.all_removed():
                    if each.archived_in is None and each.id.startswith(name.lower()):
                        raise errors.UnknownEpisode(str(each)) from None
        raise


@asynccontextmanager
async def read_archived(lake: str, episodes: Sequence[str] = ()) -> AsyncIterator[Reading]:
    """Read archived episodes as those of a memory, without bringing one back: frames, questions, recall, pages.

    >>> async with read_archived("ducklake:/nfs/lake", ["01975a3c"]) as reading:
    ...     frame = await reading.dataframe(PickUpWithContextView)

    Folds them, given by id or first digits of it, by default all, into a temporary memory that the end of the context
    deletes; it takes what `pycrorm restore` takes in time, and on the disk of temporary files. The numbers of the
    episodes and their row ids are those of that memory. Raises `UnknownEpisode`, `MissingExtra`, `DatabaseUnavailable`,
    and `DamageError` for an episode that cannot be read or folded whole.
    """
    from pycrorm_async.query.reading import Reading  # here, because it loads the mapped classes

    with TemporaryDirectory(prefix="pycrorm-lake-") as folder:
        url = f"sqlite:///{folder}/memory.db"
        summary = await copy_episodes(lake, url, episodes=episodes)
        for each in summary.episodes:
            if fault := each.damage or each.stopped:
                raise errors.DamageError(f"{summary.source}: episode {each.id}: {fault}")
        async with Reading.open(url) as reading:
            yield reading


@asynccontextmanager
async def _open_target(address: DatabaseAddress, source: Source) -> AsyncIterator[tuple[EventLog, LogAndTables]]:
    """Open the target's log and tables, creating them if they are missing, with the source's placement if possible."""
    placement = PLAIN if address.is_sqlite else Placement((await source.placement()).partitions)
    async with await EventLog.open(address, create=True, placement=placement) as log:
        if log.log_id == source.log_id:
            raise errors.CallerError(
                f"{source.address} and {address} are the same memory, or file copies of one memory: copy to a new URL"
            )
        log.blobs.source = source.blobs
        log.blobs.restores = isinstance(source, Lake)
        projector = Projector(log, installed=own_projections())
        await retry(projector.open, backoff=BRIEF)  # another copy may be creating the tables
        destination = LogAndTables(log, projector)
        try:
            yield log, destination
        finally:
            await destination.group.leave()


class _Copier:
    """Copies one episode after the other: appends whenever a batch is full, and folds meanwhile."""

    def __init__(
        self,
        source: Source,
        target: EventLog,
        destination: LogAndTables,
        fold_next_batch: Callable[[], Awaitable[bool]],
        settings: Settings,
        report_progress: ProgressCallback,
    ) -> None:
        self._source = source
        self._target = target
        self._destination = destination
        self._fold_next_batch = fold_next_batch
        self._appended = asyncio.Event()
        self._is_last = False
        self._settings = settings
        self._report_progress = report_progress
        self._done = self._of = 0
        self._batch: dict[EpisodeId, list[StoredEvent]] = {}
        self._batch_events = self._batch_bytes = 0
        self._damage: dict[str, str] = {}
        self._refused: dict[str, str] = {}
        self._declared: dict[str, bytes] = {}
        self._sent: set[str] = set()

    async def copy(self, rows: Sequence[EpisodeRow]) -> tuple[EpisodeCopy, ...]:
        self._of = sum(row.head for row in rows)
        before = await self._heads(rows)
        removed = await self._target.removed([row.identity for row in rows if is_episode_id(row.id)])
        restores = self._target.blobs.restores
        self._refused |= {each.id: str(each) for each in removed.values() if each.archived_in is None or not restores}
        folding = asyncio.create_task(self._fold({row.id for row in rows}), name="pycrorm copy fold")
        try:
            for row in rows:
                if row.id in self._refused:
                    continue
                try:
                    await self._copy(row, before.get(row.id, 0))
                except errors.DamageError as damage:
                    self._damage[row.id] = str(damage)
                if folding.done():  # it failed
                    break
            else:
                self._is_last = True
                await self._append()
            await folding
        finally:
            folding.cancel()
            await asyncio.gather(folding, return_exceptions=True)
        await retry(self._destination.fold, backoff=BRIEF)  # the cases, too
        after = await self._heads(rows)
        if isinstance(self._source, Lake):
            rows = await self._numbered(self._source, rows)
        stopped = {**await self._destination.stopped(), **self._refused}
        return tuple(
            EpisodeCopy(
                id=row.id,
                number=row.number,
                were_there=(were_there := min(before.get(row.id, 0), row.head)),
                copied=min(after.get(row.id, 0), row.head) - were_there,
                head=after.get(row.id, 0),
                damage=self._damage.get(row.id),
                stopped=stopped.get(row.id),
            )
            for row in rows
        )

    async def _heads(self, rows: Sequence[EpisodeRow]) -> dict[str, int]:
        """Return the last event that the target has of each of these episodes, by id."""
        heads = await self._target.heads([row.identity for row in rows if is_episode_id(row.id)])
        return {row.id: row.head for row in heads.values()}

    async def _copy(self, row: EpisodeRow, head: int) -> None:
        shared = min(row.head, head)
        if shared:
            await self._compare(row._replace(head=shared))
        if shared == row.head:
            return
        is_intact = isinstance(self._source, Lake) and await self._source.is_intact(row)
        async for page in self._source.pages(row, after=shared):
            events = self._batch.setdefault(row.identity, [])
            for event in page if not is_intact else ():
                _refuse_unreadable(row.id, event)
                events.append(event)
            if is_intact:
                events += page
            self._batch_events += len(page)
            self._batch_bytes += sum(len(each.payload) for each in page)
            self._progress(len(page))
            settings = self._settings
            if self._batch_events >= settings.batch_events_max or self._batch_bytes >= BATCH_BYTES_MAX:
                await self._append()
            if row.id in self._damage or row.id in self._refused:
                return

    async def _compare(self, shared: EpisodeRow) -> None:
        """Compare the shared events of both logs. Raises `LogDamaged` at the first difference."""
        target_row = await self._target.episode(shared.identity)
        assert target_row is not None, "its head is above zero"
        target_pages = self._target.pages(target_row._replace(head=shared.head))  # of another length than the source's
        others = (other async for page in target_pages for other in page)
        async for page in self._source.pages(shared):
            for event in page:
                if event[1:] != (await anext(others))[1:]:
                    reason = f"{self._target.address} has another event with this sequence than {self._source.address}"
                    raise errors.LogDamaged(shared.id, event.sequence, reason)
            self._progress(len(page))

    async def _numbered(self, lake: Lake, rows: Sequence[EpisodeRow]) -> list[EpisodeRow]:
        """Compare the digests of restored episodes with those of the lake; return their rows with their numbers."""
        restored = await self._target.heads([row.identity for row in rows])
        archived = lake.episode_rows([row.id for row in rows])
        numbers = {row.id: row.number for row in restored.values()}
        digests = await self._target.last_digests(min(numbers.values(), default=1), max(numbers.values(), default=1))
        for row in restored.values():
            digest, there = digests.get(row.number), archived.get(row.id)
            if there is None:
                why = f"was erased from {lake.address} meanwhile: `pycrorm erase` removes it here too"
                self._damage[row.id] = f"episode {row.id} {why}"
            elif digest is not None and digest.sequence == there.head and digest.digest != there.digest:
                self._damage[row.id] = f"episode {row.id}: its digest differs from that in {lake.address}"
        return [row._replace(number=numbers.get(row.id, 0)) for row in rows]

    def _progress(self, count: int) -> None:
        self._done += count
        self._report_progress(self._done, self._of)

    async def _append(self) -> None:
        batch, self._batch, self._batch_events, self._batch_bytes = self._batch, {}, 0, 0
        declarations = await self._declarations(batch.values())
        records = {episode: _records(episode, events) for episode, events in batch.items() if events}
        try:
            await self._append_at_once([*declarations, *chain.from_iterable(records.values())])
        except errors.DamageError:
            # The target refused the whole batch, because another process appended other events to one of the episodes.
            for episode, events in records.items():
                try:
                    await self._append_at_once([*declarations, *events])
                except errors.DamageError as damage:
                    self._damage[episode_text(episode)] = str(damage)
        self._appended.set()

    async def _fold(self, episodes: set[str]) -> None:
        """Fold beside `_append`, until it has come to its end and these episodes are visible.

        Others may stay behind while other processes append to them.
        """
        is_last = False
        while not is_last:
            await self._appended.wait()
            self._appended.clear()
            is_last = self._is_last
            while episodes & (await self._destination.behind()).keys():
                await retry(self._fold_next_batch, backoff=BRIEF)

    async def _append_at_once(self, records: Sequence[Record]) -> None:
        refusals = await retry(partial(self._destination.append, records), backoff=BRIEF)
        self._refused |= {episode_text(episode): reason for episode, reason in refusals.items()}

    async def _declarations(self, events: Iterable[Sequence[StoredEvent]]) -> list[Record]:
        """Return the declarations that these events name and that were not sent yet, in the source's order."""
        missing = declared_by(chain.from_iterable(events)) - self._sent
        # Read after the events, because each declaration is stored before its first use.
        described = [each for each in missing if declaration_type(each) == "DescriptionDeclared"]
        descriptions = await self._source.descriptions(described)
        if not missing - descriptions.keys() <= self._declared.keys():
            declared = await self._source.declarations()
            self._declared = {short_name(fingerprint(payload)): payload for payload in declared}
        sent = {name: payload for name, payload in self._declared.items() if name in missing} | descriptions
        self._sent |= sent.keys()
        return [Record(0, None, 0, declaration_type(name), 1, 0, 0, payload) for name, payload in sent.items()]


def _records(episode: EpisodeId, events: Sequence[StoredEvent]) -> list[Record]:
    _, *columns = zip(*events, strict=True)
    return [*map(make, repeat(Record), zip(repeat(0), repeat(episode), *columns, strict=False))]


def _refuse_unreadable(episode: str, event: StoredEvent) -> None:
    """Raise `LogDamaged` for a payload that does not decode; that of another version need only be JSON."""
    shape = EVENT_TYPES.get(event.type)
    try:
        if shape is not None and shape.version == event.version:
            decode(event.type, event.payload)
        else:
            msgspec.json.decode(event.payload)
    except (msgspec.DecodeError, UnicodeDecodeError, RecursionError) as error:
        raise errors.LogDamaged(episode, event.sequence, f"its payload cannot be read: {error}") from None


class _CopiedType(msgspec.Struct):
    designator: str | None = None
    description: str | None = None


_decode_declared = msgspec.json.Decoder(_CopiedType).decode


def declared_by(events: Iterable[StoredEvent]) -> set[str]:
    """Return the short names of the types and the fingerprints of the descriptions that these events name.

    Leaves out one that another version stores elsewhere; the fold parks its node.
    """
    named: set[str | None] = set()
    for event in events:
        with suppress(msgspec.ValidationError):
            if event.type == "NodeStarted":
                named.add(short_name(_decode_declared(event.payload).designator or ""))
            elif event.type == "ObjectAdded":
                named.add(_decode_declared(event.payload).description)
    return {each for each in named if each}


# === tag ======================================================================================================
#
# `pycrorm tag`: append a change of tags to an episode that has ended, and fold it.
#
# The change is an event behind the episode's last one. It is appended on the condition that this is still the last one:
# if another process appended a change first, the log refuses the event, and the change is decided again from the new
# tags.

_ATTEMPTS = 20
"""Bounds the attempts while other processes tag the same episode; each of them fails only if another succeeded."""


@dataclass(frozen=True)
class TaggedEpisode:
    """An episode and its tags after a change. `visible`: the tables show them; else the next fold does."""

    number: int
    id: str
    tags: tuple[str, ...]
    visible: bool


async def tag_episode(
    address: DatabaseAddress,
    name: str,
    added: tuple[str, ...],
    removed: tuple[str, ...],
    *,
    clock: Clock = SYSTEM_CLOCK,
) -> TaggedEpisode:
    """Add and remove tags of an episode, given by number, id, first digits of it, or `last`.

    Raises `CallerError` for an episode that has not ended or does not have a removed tag, and `UnknownEpisode`.
    """
    log = await EventLog.open_to_change(address)
    try:
        row = await episode_named(log, name)
        for _ in range(_ATTEMPTS):
            before = await tags_of(log, row)
            tags = changed_tags(before, added, removed)
            if sorted(tags) == sorted(before):
                return TaggedEpisode(row.number, row.id, tuple(sorted(tags)), visible=True)
            if await _append(log, row, EpisodeTagged(added, removed), clock):
                visible = await _fold(log, row)
                return TaggedEpisode(row.number, row.id, tuple(sorted(tags)), visible)
            row = await episode_named(log, row.id)
        raise errors.DatabaseUnavailable(f"{address}: other processes tag episode {row.number} all the time; try again")
    finally:
        await log.close()


async def _append(log: EventLog, row: EpisodeRow, event: EpisodeTagged, clock: Clock) -> bool:
    """Append behind the episode's last event; False if another process did so first."""
    if row.ended_wall_ns is None:
        raise errors.CallerError(
            f"episode {row.number} has not ended: tag it in the process that records it (`memory.tag`);"
            " if that died, run `pycrorm writer --once` first"
        )
    if row.refused is not None:
        raise errors.CallerError(
            f"episode {row.number} cannot be tagged, because events of it are missing: {row.refused}"
        )
    (last,) = await log.events(row.number, after=row.head - 1, limit=1)
    # No time passes on the recorder's monotonic clock any more, and this process may have another one.
    wall_ns, monotonic_ns = clock.wall_ns(), last.monotonic_ns
    episode, kind = row.identity, type(event)
    record = Record(0, episode, row.head + 1, kind.__name__, kind.version, wall_ns, monotonic_ns, encode(event))
    try:
        refusals = await log.append([record])
    except errors.LogDamaged:
        now = await log.episode(episode)
        if now is None or now.head == row.head:
            raise
        return False
    if refusals:
        raise errors.DatabaseUnavailable(f"{log.address}: episode {row.number}: {refusals[episode]}")
    return True


async def _fold(log: EventLog, row: EpisodeRow) -> bool:
    """Fold the episode to its end; False if this process cannot, or the episode is parked."""
    destination = LogAndTables(log, projector := Projector(log))
    try:
        await retry(projector.open, backoff=BRIEF)
        while row.id in await destination.behind():
            await retry(destination.fold_next_batch, backoff=BRIEF)
        return row.id not in await destination.stopped()
    except errors.DatabaseError:
        return False
    finally:
        await destination.group.leave()
