"""`pycrorm copy`: appends the episodes of one memory to another, of whatever kind, and makes their tables there.

The keys are the events' own, so it can be done in any order, interrupted, and done again: what is there already is
compared, and what follows it is appended. An episode that is being recorded is copied as far as it is; doing it again
takes the rest. Nothing is written to the source. Numbers and row ids belong to a database and are given anew.
"""

from __future__ import annotations

from collections.abc import AsyncIterator, Callable, Iterable, Sequence
from contextlib import asynccontextmanager
from dataclasses import dataclass
from functools import partial
from itertools import chain

import msgspec

from pycrorm_async.errors import CallerError, DamageError, LogDamaged
from pycrorm_async.events.codec import decode, fingerprint
from pycrorm_async.events.envelope import Record
from pycrorm_async.events.ids import EpisodeId, episode_text, parse_episode_id
from pycrorm_async.events.types import EVENT_TYPES
from pycrorm_async.operations.destination import LogAndTables, shared_address
from pycrorm_async.projections.projector import Projector
from pycrorm_async.settings import Settings
from pycrorm_async.store.address import DatabaseAddress
from pycrorm_async.store.episode_lookup import episode_named
from pycrorm_async.store.log import EventLog
from pycrorm_async.store.stored import EpisodeRow, StoredEvent
from pycrorm_async.writer.retry import BRIEF, retry

__all__ = ["copy_episodes", "CopySummary", "EpisodeCopy"]


@dataclass(frozen=True)
class EpisodeCopy:
    """One episode.

    Attributes:
        id, number: its UUID, its number in the source.
        were_there: how many of the source's events the target had before.
        copied: how many more it has now.
        head: the last event the target has now.
        damage: why not all of it could be copied: the source contradicts itself, or the target holds something else.
        stopped: why the target took or shows no more of it.
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
    """What was copied from where to where; the URLs are without passwords."""

    source: str
    target: str
    episodes: tuple[EpisodeCopy, ...]


def _unwatched(_done: int, _of: int) -> None: ...


async def copy_episodes(
    source: str,
    target: str,
    *,
    episodes: Sequence[str] = (),
    settings: Settings | None = None,
    watch: Callable[[int, int], None] = _unwatched,
) -> CopySummary:
    """Copy these episodes, by number in the source, id, first digits of it or `last`; without any, all of them.

    A target that does not exist is made. `watch` is told how many events are done, and of how many. Damage of one
    episode does not keep the others from being copied. Raises `UnknownEpisode`, `CallerError` if both are the same
    memory, and as `Memory.open` does; what was copied up to there stays.
    """
    source_address, target_address = shared_address(source), shared_address(target)
    log = await EventLog.open(source_address, create=False)
    try:
        chosen = {row.number: row for row in [await episode_named(log, each) for each in episodes]}
        rows = list(chosen.values()) if episodes else await log.episodes()
        async with _made(target_address, log) as (there, destination):
            copier = _Copier(log, there, destination, settings or Settings(), watch)
            done = await copier.copy(rows)
    finally:
        await log.close()
    return CopySummary(source_address.to_type, target_address.to_type, done)


@asynccontextmanager
async def _made(address: DatabaseAddress, source: EventLog) -> AsyncIterator[tuple[EventLog, LogAndTables]]:
    """The target's log and tables, made if need be."""
    log = await EventLog.open(address, create=True)
    try:
        if log.log_id == source.log_id:
            raise CallerError(
                f"{source.address} and {address} are the same memory, or the files of one are a copy of the other's:"
                " copy into a new one"
            )
        projector = Projector(log)
        await retry(projector.open, backoff=BRIEF)  # another copy may be making the tables
        yield log, LogAndTables(log, projector)
    finally:
        await log.close()


class _Copier:
    """Copies one episode after the other; appends and folds whenever there is enough for a batch."""

    def __init__(
        self,
        source: EventLog,
        target: EventLog,
        destination: LogAndTables,
        settings: Settings,
        watch: Callable[[int, int], None],
    ) -> None:
        self._source = source
        self._target = target
        self._destination = destination
        self._settings = settings
        self._watch = watch
        self._done = self._of = 0
        self._batch: dict[EpisodeId, list[StoredEvent]] = {}
        self._batch_events = self._batch_bytes = 0
        self._damage: dict[str, str] = {}
        self._refused: dict[str, str] = {}
        self._declared: dict[str, bytes] = {}
        self._sent: set[str] = set()

    async def copy(self, rows: Sequence[EpisodeRow]) -> tuple[EpisodeCopy, ...]:
        self._of = sum(row.head for row in rows)
        before = {row.id: row.head for row in await self._target.episodes()}
        for row in rows:
            try:
                await self._copy(row, before.get(row.id, 0))
            except DamageError as damage:
                self._damage[row.id] = str(damage)
        await self._append()
        await self._fold({row.id for row in rows})
        after = {row.id: row.head for row in await self._target.episodes()}
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

    async def _copy(self, row: EpisodeRow, head: int) -> None:
        shared = min(row.head, head)
        if shared:
            await self._compare(row._replace(head=shared))
        async for page in self._source.pages(row, after=shared):
            events = self._batch.setdefault(parse_episode_id(row.id), [])
            for event in page:
                _refuse_unreadable(row.id, event)
                events.append(event)
                self._batch_bytes += len(event.payload)
            self._batch_events += len(page)
            self._progress(len(page))
            settings = self._settings
            if self._batch_events >= settings.batch_events_max or self._batch_bytes >= settings.batch_bytes_max:
                await self._append()
            if row.id in self._damage or row.id in self._refused:
                return

    async def _compare(self, shared: EpisodeRow) -> None:
        """Raises `LogDamaged` at the first event that is not the same in both, up to this head."""
        there = await self._target.episode(parse_episode_id(shared.id))
        assert there is not None, "its head is above zero"
        theirs = self._target.pages(there._replace(head=shared.head))
        async for page in self._source.pages(shared):
            there_too = await anext(theirs)
            for event, other in zip(page, there_too, strict=False):
                if event[1:] != other[1:]:
                    reason = f"{self._target.address} holds another event under this number than {self._source.address}"
                    raise LogDamaged(shared.id, event.sequence, reason)
            if len(there_too) < len(page):
                await anext(theirs)  # says which one is missing
            self._progress(len(page))

    def _progress(self, count: int) -> None:
        self._done += count
        self._watch(self._done, self._of)

    async def _append(self) -> None:
        batch, self._batch, self._batch_events, self._batch_bytes = self._batch, {}, 0, 0
        declarations = await self._declarations(batch.values())
        records = {episode: [Record(0, episode, *each[1:]) for each in events] for episode, events in batch.items()}
        try:
            await self._append_at_once([*declarations, *chain.from_iterable(records.values())])
        except DamageError:
            # Somebody else is appending one of them, with other events: nothing was stored.
            for episode, events in records.items():
                try:
                    await self._append_at_once([*declarations, *events])
                except DamageError as damage:
                    self._damage[episode_text(episode)] = str(damage)
        await self._fold({episode_text(episode) for episode in batch})

    async def _fold(self, episodes: set[str]) -> None:
        """Until the tables show these; where others append all the time there is always something else to fold."""
        while episodes & (await self._destination.behind()).keys():
            await retry(self._destination.fold_next_batch, backoff=BRIEF)

    async def _append_at_once(self, records: Sequence[Record]) -> None:
        refusals = await retry(partial(self._destination.append, records), backoff=BRIEF)
        self._refused |= {episode_text(episode): reason for episode, reason in refusals.items()}

    async def _declarations(self, events: Iterable[Sequence[StoredEvent]]) -> list[Record]:
        """Those that these events name and the target may not have, in the order the source got them."""
        named = {_designator(each) for each in chain.from_iterable(events) if each.type == "NodeStarted"} - self._sent
        named.discard(None)
        if not named <= self._declared.keys():
            # Read after the events that name them: they were stored before.
            self._declared = {fingerprint(payload): payload for payload in await self._source.declarations()}
        sent = {name: payload for name, payload in self._declared.items() if name in named}
        self._sent |= sent.keys()
        return [Record(0, None, 0, "DesignatorTypeDeclared", 1, 0, 0, payload) for payload in sent.values()]


def _refuse_unreadable(episode: str, event: StoredEvent) -> None:
    """Raises `LogDamaged` for what cannot be what was recorded; an event of another version need only be JSON."""
    shape = EVENT_TYPES.get(event.type)
    try:
        if shape is not None and shape.version == event.version:
            decode(event.type, event.payload)
        else:
            msgspec.json.decode(event.payload)
    except (msgspec.DecodeError, UnicodeDecodeError) as error:
        raise LogDamaged(episode, event.sequence, f"its payload cannot be read: {error}") from None


class _Naming(msgspec.Struct):
    designator: str | None = None


def _designator(event: StoredEvent) -> str | None:
    """The fingerprint it names. One that another version writes elsewhere is not found, and its node will not fold."""
    try:
        return msgspec.json.decode(event.payload, type=_Naming).designator
    except msgspec.ValidationError:
        return None
