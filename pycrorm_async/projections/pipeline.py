"""Run a fold: bring one set of tables up to date with the log, batch after batch.

    runner = FoldRunner(LiveTarget(log))
    while await runner.fold_next() is not None: ...

**Theory of operation: batches.** A batch has two phases. `prepare` reads the declarations and then the events, a page
at a time, and folds them into rows in memory; it holds no lock and writes nothing. `write` opens a transaction, locks
the generation's row, compares number and revision of the generation and the checkpoint of each episode with those that
`prepare` assumed, and only then writes rows and checkpoints. If anything differs, because another process folded the
same events or changed the tables, it rolls back and returns 0, and the caller reads the events again. So any number
of processes may fold one memory: every event is folded exactly once, and rows and checkpoints never disagree.

A declaration that the generation has no tables for makes the write transaction exclusive and grows the tables first
(`generations`). If the database creates only some of them, the growth is committed, the batch is not, and it is
folded again for the tables that exist now. An event that cannot be folded parks its episode at this event: the events
before it are written, later ones are not folded, and all other episodes continue. If the database refuses a row, the
batch is written again episode by episode, and then in halves, until the refused event is alone; it parks its episode.
A parked episode stays so until the tables are rebuilt.

**Companions.** A runner may have companions: the runners of custom projections, whose targets have checkpoints of their
own. A batch of the runner then folds each event for all of them, so that it is read and decoded once, and writes their
rows and checkpoints in its transaction, each companion's behind a savepoint. A companion takes part with those episodes
that its own last batch left where this one begins. If it cannot be written, because its checkpoint has moved, its
tables were replaced or locked, or the database refuses a row, the savepoint is rolled back and the batch is written
without it. The companion is then behind, and folds these events with a batch of its own, as it folds all that it lacks
for another reason. So a fault in a companion never concerns the tables, and the order in which two processes lock the
rows of generations does not matter, because a companion's are taken only if no other transaction has them.

**Workers.** A `BatchWorker` folds one batch at a time into the target's tables: the runner itself, or a process of its
own. The runner chooses the events of each batch. It prepares at most one batch ahead, and writes a prepared batch only
if the batch before it was written whole; otherwise it discards the prepared one and reads the checkpoints again. A
worker process may die or be replaced at any moment: its batch then counts as not written. If its transaction committed
although its answer was lost, the checkpoints show it, because the next batch is read from them, and a batch that does
not continue the checkpoints is rolled back. So no event is folded twice or left out. Another worker prepares ahead, if
there is one. The runner itself also prepares ahead while it writes to a server, which works in a process of its own.

**Targets.** The tables that a fold fills, and where their checkpoints are (section "targets"). The fold itself is a
`Learn`: it makes the rows of the built-in tables (`learn_tables`) or of a custom projection.
"""

from __future__ import annotations

import asyncio
import logging
from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass, field
from itertools import groupby
from operator import attrgetter
from typing import Final, NamedTuple, Protocol, TypeAlias

from sqlalchemy import TableClause, column, or_, select, table, text, update
from sqlalchemy.ext.asyncio import AsyncConnection

from pycrorm_async.errors import DatabaseForeign, DatabaseUnavailable, InternalError, LogDamaged, PycrormError
from pycrorm_async.events.ids import NUMBER_SHIFT, SEQUENCE_MAX, row_id_min
from pycrorm_async.events.types import Happening
from pycrorm_async.projections import generations
from pycrorm_async.projections.columns import Layout, Storage, physical_name, unite
from pycrorm_async.projections.fold import Batch, TableRows, decode_events
from pycrorm_async.projections.row_batch import Designators
from pycrorm_async.store.dialect import Progress, RowRefused
from pycrorm_async.store.dialects import dialect_of
from pycrorm_async.store.log import EventLog, advance_folded, park
from pycrorm_async.store.schema import SELECT_BEHIND
from pycrorm_async.store.stored import EpisodeRow, Span, StoredEvent, beyond, consecutive, pages_of, share_out, size_of

LOOKAHEAD_EVENTS_MIN: Final = 2_000
"""The smallest batch that is prepared ahead; a smaller one waits for the events that arrive during the write."""
_REASON_LENGTH_MAX = 2_000
"""Bounds the characters of the reason for parking an episode: `status` shows it, and a value may have megabytes."""
_PAGE_EVENTS = 10_000
"""Bounds the events that are read at once, and so their memory; all of a batch, unless it makes few rows."""
_SLICE_EVENTS = 100
"""The events folded between two yields to the event loop, some 0.4 ms."""


class BatchPreview(NamedTuple):
    """The effect of a prepared batch once it is written.

    Attributes:
        events: the number folded in the batch.
        reached: by episode number, the last sequence folded.
        is_whole: False if the batch parks an episode.
    """

    events: int
    reached: Mapping[int, int]
    is_whole: bool


class BatchWorker(Protocol):
    """Folds one batch at a time into the tables. Both methods raise `DatabaseUnavailable`."""

    async def prepare(self, spans: Sequence[Span]) -> BatchPreview:
        """Read and fold these events, and discard the batch prepared before. Writes nothing."""
        ...

    async def write(self) -> int:
        """Write the batch; return the number of its events that are in the tables now."""
        ...


Learn: TypeAlias = Callable[[Layout, Sequence[bytes]], tuple[Layout, Callable[[], Batch]]]
"""Takes a layout and declarations; returns the layout that has them, and a factory of empty batches for it."""


FoldTarget: TypeAlias = "LiveTarget | SideTarget"
"""The generation into which a runner folds, with its checkpoints."""


def learn_tables(layout: Layout, payloads: Sequence[bytes]) -> tuple[Layout, Callable[[], Batch]]:
    """Learn to fold into the built-in tables."""
    united = unite(layout, payloads)
    designators = Designators.of_union(united)
    return united.layout, lambda: TableRows(designators)


class _Types(NamedTuple):
    """The declarations that were read, and the layout and batch factory for them at one revision."""

    payloads: list[bytes]
    revision: int
    layout: Layout
    batch: Callable[[], Batch]


@dataclass(slots=True)
class _PreparedBatch:
    """A batch between `prepare` and `write`.

    Attributes:
        runner: the owner.
        rows: for the generation `number`.
        reached: by episode number, the last sequence folded.
        parked: the reasons of the episodes to park.
        beside: the batches of companions.
    """

    runner: FoldRunner
    spans: Sequence[Span]
    types: _Types
    rows: Batch
    number: int
    reached: dict[int, int]
    parked: dict[int, str] = field(default_factory=dict)
    beside: list[_PreparedBatch] = field(default_factory=list)

    @property
    def steps(self) -> list[Progress]:
        """(episode, folded before, folded now) for each episode."""
        return [(each.number, each.after, self.reached[each.number]) for each in self.spans]

    @property
    def events(self) -> int:
        """The number of its folded events."""
        return sum(now - before for _, before, now in self.steps)

    @property
    def reads(self) -> frozenset[str] | None:
        """The types of the events that it folds, or a companion; None: all types."""
        reads = [each.rows.reads for each in (self, *self.beside)]
        return None if None in reads else frozenset().union(*(each for each in reads if each is not None))

    def add(self, number: int, events: Sequence[StoredEvent], happenings: Sequence[Happening | None]) -> None:
        """Fold the next events of an episode, unless it is not in the batch, or is parked."""
        if number not in self.reached or number in self.parked:
            return
        if (refused := self.rows.fold(events, happenings)) is None:
            self.reached[number] = events[-1].sequence
        else:
            self.park(number, *refused)

    def park(self, number: int, sequence: int, reason: str) -> None:
        """Park an episode at an event."""
        self.reached[number] = sequence - 1
        self.parked[number] = _writable(f"event {sequence}: {reason}")


class FoldRunner:
    """Folds the events that a target lacks, batch by batch. Implements `BatchWorker`.

    Args:
        target: of this runner and of all workers.
        learn: makes the rows.
        batch_events: the most events in one transaction.
    """

    def __init__(self, target: FoldTarget, learn: Learn = learn_tables, *, batch_events: int = 10_000) -> None:
        self._target = target
        self._log = target.log
        self._learn = learn
        self._batch_events = batch_events
        self.generation: generations.Generation | None = None
        """The state of the target's generation when this process last read it."""
        self.last_number = 0
        """The last episode of the last batch; the next one begins with the episode behind it."""
        self.companions: Callable[[int], Sequence[FoldRunner]] = lambda _events: ()
        """Returns the companions of a batch with this number of events."""
        self._types: _Types | None = None
        self._prepared: _PreparedBatch | None = None
        self._ahead: tuple[BatchWorker, BatchPreview] | None = None

    async def fold_next(self, workers: Sequence[BatchWorker] = ()) -> int | None:
        """Fold one batch, here or by workers; return the number of events, None if no episode is behind.

        The number is smaller than the batch if an episode was parked, and 0 if another process folded it first. Raises
        the errors of the workers; rows that were written stay.
        """
        with self._log.translated():
            workers = workers or [self]
            prepared, self._ahead = self._ahead, None
            if prepared is None or prepared[0] not in workers:
                spans = await self._spans(None)
                if not spans:
                    return None
                prepared = workers[0], await workers[0].prepare(spans)
            worker, preview = prepared
            alone = self if worker is self and not self._log.address.is_sqlite else None
            following = next((each for each in workers if each is not worker), alone)
            if following is None or not preview.is_whole:
                return await worker.write()
            # `write` comes first, because the runner takes its batch before it prepares another.
            count, ahead = await asyncio.gather(
                worker.write(), self._prepare_ahead(following, preview), return_exceptions=True
            )
            for fault in (count, ahead):
                if isinstance(fault, BaseException):
                    raise fault
            assert isinstance(count, int)
            if count == preview.events and isinstance(ahead, BatchPreview):
                self._ahead = following, ahead
            return count

    async def size(self) -> int:
        """Return the number of events that the next batch would have."""
        with self._log.translated():
            async with self._log.reading() as connection:
                behind = await self._target.behind(connection, 0, self._batch_events)
            return size_of(share_out(behind, self._batch_events))

    async def prepare(self, spans: Sequence[Span]) -> BatchPreview:
        """Read and fold these events, yielding to the event loop at intervals. Writes nothing."""
        self._prepared = None
        with self._log.translated():
            self._prepared = batch = await self._folded(spans)
        return BatchPreview(batch.events, batch.reached, not batch.parked)

    async def write(self) -> int:
        """Write the prepared batch; return the number of events folded.

        It is smaller if an episode was parked, and 0 if another process folded them first or changed the tables.
        """
        batch, self._prepared = self._prepared, None
        with self._log.translated():
            return 0 if batch is None else await self._write(batch)

    async def write_in(self, connection: AsyncConnection, spans: Sequence[Span]) -> bool:
        """Fold in the caller's transaction, which must be rolled back if this returns False or raises `RowRefused`."""
        batch = await self._folded(spans)
        generation = await self._lock_generation(connection, batch)
        if generation is None or generation.layout != batch.types.layout:
            return False
        return await self._write_rows(connection, batch, generation)

    async def _prepare_ahead(self, worker: BatchWorker, before: BatchPreview) -> BatchPreview | None:
        spans = await self._spans(before)
        return await worker.prepare(spans) if size_of(spans) >= min(LOOKAHEAD_EVENTS_MIN, self._batch_events) else None

    async def _spans(self, before: BatchPreview | None) -> list[Span]:
        # Start behind the last batch's episode, so that an episode that always grows does not starve the others.
        async with self._log.reading() as connection:
            for after in (self.last_number, 0) if self.last_number else (0,):
                episodes = await self._target.behind(connection, after, self._batch_events)
                if episodes := beyond(episodes, before.reached if before is not None else {}):
                    spans = share_out(episodes, self._batch_events)
                    self.last_number = spans[-1].number
                    return spans
        return []

    async def _folded(self, spans: Sequence[Span]) -> _PreparedBatch:
        """Read and fold these events, a page at a time, so that the events of a large batch never are in memory."""
        payloads = await self._log.declarations()
        batch = await self._begun(spans, payloads)
        await batch.rows.restore(self._log, spans)
        for companion in self.companions(size_of(spans)):
            try:
                beside = await companion._begun(spans, payloads, if_continued=True)  # noqa: SLF001 - of this class
                await beside.rows.restore(self._log, beside.spans)
            except PycrormError:  # met again, and reported, when the companion folds by itself
                continue
            if beside.spans:
                batch.beside.append(beside)
        for page in pages_of(spans, _PAGE_EVENTS):
            await self._fold_page([each for each in page if each.number not in batch.parked], batch)
        for each in (batch, *batch.beside):
            await each.rows.ready(self._log.engine, each.number)
        return batch

    async def _begun(
        self, spans: Sequence[Span], payloads: list[bytes], *, if_continued: bool = False
    ) -> _PreparedBatch:
        """Return an empty batch for these spans; with `if_continued`, for those that continue the last batch."""
        generation, types = await self._types_now(payloads)
        rows = types.batch()
        spans = rows.continued(spans) if if_continued else spans
        return _PreparedBatch(self, spans, types, rows, generation.number, {each.number: each.after for each in spans})

    async def _fold_page(self, spans: Sequence[Span], batch: _PreparedBatch) -> None:
        """Fold the events of these spans, in order."""
        events = await self._log.spans(spans)
        by_number = {number: [*each] for number, each in groupby(events, key=attrgetter("number"))}
        batches, reads = (batch, *batch.beside), batch.reads
        for each in batches:
            await each.rows.look_up(self._log, events)
        folded = _SLICE_EVENTS  # since this yielded to the event loop
        for number, after, last in spans:
            part = consecutive(by_number.get(number, ()), after)
            for first in range(0, len(part), _SLICE_EVENTS):
                if folded >= _SLICE_EVENTS:
                    await asyncio.sleep(0)
                    folded = 0
                happenings, fault = decode_events(part[first : first + _SLICE_EVENTS], reads)
                some = part[first : first + len(happenings)]
                folded += len(some)
                for each in batches if some else ():
                    each.add(number, some, happenings)
                if fault is not None and number not in batch.parked:
                    batch.park(number, after + first + len(some) + 1, str(fault))
                if number in batch.parked:
                    break
            else:
                if after + len(part) < last:
                    batch.parked[number] = await self._target.missing(number, after + len(part) + 1)

    async def _write(self, batch: _PreparedBatch) -> int:
        try:
            async with self._log.writing() as connection:
                generation = await self._lock_generation(connection, batch)
                # If some tables of the batch do not exist, the caller folds it again for those that do.
                grown = generation is not None and generation.layout != batch.types.layout
                if generation is None or (not grown and not await self._write_rows(connection, batch, generation)):
                    await connection.rollback()
                    return 0
                for each in batch.beside if not grown else ():
                    await each.runner._write_beside(connection, each)  # noqa: SLF001 - of this class
        except RowRefused as refusal:
            return await self._isolate(batch.spans, refusal)
        self.generation = generation
        if generation.revision != batch.types.revision:
            await sweep(self._log)
        return 0 if grown else batch.events

    async def _write_beside(self, connection: AsyncConnection, batch: _PreparedBatch) -> None:
        """Write the batch of a companion, or none of it if that is not possible."""
        try:
            with self._log.translated():
                async with connection.begin_nested() as savepoint:
                    generation = await self._lock_generation(connection, batch, "if free")
                    if generation is None or not await self._write_rows(connection, batch, generation):
                        await savepoint.rollback()
        except (RowRefused, PycrormError):
            if connection.invalidated:
                raise  # the caller's transaction is lost too
            # Otherwise met again, and reported, when the companion folds by itself.

    async def _lock_generation(
        self, connection: AsyncConnection, batch: _PreparedBatch, hold: generations.Hold = "share"
    ) -> generations.Generation | None:
        """Lock the generation and create missing tables; return None if its number or revision has changed.

        The layout of the result differs from that of the batch if some tables could not be created.
        """
        types = batch.types
        growing = self.generation is None or types.layout != self.generation.layout
        if growing:
            await dialect_of(connection).lock_log_changes(connection)
        generation = await self._target.generation(connection, "change" if growing else hold)
        if (generation.number, generation.revision) != (batch.number, types.revision):
            self.generation = generation
            return None
        if growing:
            return await generations.grow(connection, self._target.grow, generation, types.payloads)
        return generation

    async def _write_rows(
        self, connection: AsyncConnection, batch: _PreparedBatch, generation: generations.Generation
    ) -> bool:
        """Write rows and checkpoints; return False, to roll back, if a checkpoint has moved."""
        if not await self._target.advance(connection, batch.steps, batch.parked):
            return False
        await batch.rows.write(connection, generation.number)
        return True

    async def _types_now(self, payloads: list[bytes]) -> tuple[generations.Generation, _Types]:
        """Learn these declarations. They include those of all stored events: each is stored before its first use."""
        if self.generation is None:
            async with self._log.reading() as connection:
                self.generation = await self._target.generation(connection, None)
        generation, types = self.generation, self._types
        if types is None or types.revision != generation.revision or types.payloads != payloads:
            self._types = types = _Types(payloads, generation.revision, *self._learn(generation.layout, payloads))
        return generation, types

    async def _isolate(self, spans: Sequence[Span], refusal: RowRefused) -> int:
        """Fold the batch in smaller parts until the refused row's event is alone, and park its episode there."""
        if len(spans) > 1:
            return sum([await self._write(await self._folded([each])) for each in spans])
        span = spans[0]
        if size_of(spans) > 1:
            # The second half is folded only if the first is whole, so that no event is folded behind the refused one.
            middle = (span.after + span.last) // 2
            count = await self._write(await self._folded([span._replace(last=middle)]))
            if count < middle - span.after:
                return count
            return count + await self._write(await self._folded([span._replace(after=middle)]))
        async with self._log.writing() as connection:
            reason = _writable(f"event {span.last}: the database refuses it: {refusal}")
            await self._target.advance(connection, [], {span.number: reason})
        return 0


def _writable(reason: str) -> str:
    """Shorten and escape a reason for storage: it may quote recorded text that a database refuses."""
    shortened = reason[:_REASON_LENGTH_MAX] + ("…" if len(reason) > _REASON_LENGTH_MAX else "")
    return shortened.encode(errors="backslashreplace").decode().replace("\0", "\\x00")


async def sweep(log: EventLog) -> None:
    """Drop replaced views that no query reads."""
    async with log.engine.begin() as connection:
        await dialect_of(connection).sweep(connection)


# === checkpoints ==============================================================================================
#
# Read and write the checkpoint table of a generation: one row for each episode.
#
# Generations that a rebuild fills and those of custom projections have such a table, named after the generation
# (section "targets").

TABLE = "pycrorm_progress"
COLUMNS: dict[str, Storage] = {"id": "key", "folded": "integer", "parked": "text"}
"""The episode's number, the last sequence that is in the tables, and the reason if it is parked. A row without an
episode, whose id is not above 0, is a mark (section "targets")."""
SEEN = "SELECT number, folded FROM episode"
"""SQL that selects, for each episode, the last sequence in the visible tables."""


def place_of(generation: int, projection: str | None = None) -> str:
    """Return the name of the checkpoint table of a generation, of the built-in tables or of a custom projection."""
    return physical_name(TABLE if projection is None else f"{TABLE}_{projection}", generation)


async def episodes_behind(
    connection: AsyncConnection,
    place: str,
    *,
    limit: int,
    after: int = 0,
    share: tuple[int, int] = (0, 1),
    after_tables: bool = False,
    newer: int = 0,
    seen: str | None = None,
) -> list[EpisodeRow]:
    """Return the episodes above number `after` whose log is ahead of their checkpoint, limited to one share.

    With `after_tables`, only episodes whose first event is folded into the visible tables or parked, because that fold
    decides whether an episode is a simulation. With `newer`, only those with an event of a higher rowid. With `seen`,
    the SQL for the checkpoints of the visible tables (`SEEN`, or `folded` of another generation), those of which the
    visible tables have more events; these are their `head`.
    """
    head, joined = (
        ("head", "") if seen is None else ("seen.folded", f"JOIN ({seen}) AS seen ON seen.number = episode.number")
    )
    begun = "AND (episode.folded > 0 OR episode.parked IS NOT NULL)" if after_tables else ""
    grown = "AND episode.number IN (SELECT episode FROM event WHERE rowid > :newer)" if newer else ""
    rows = await connection.execute(
        text(f"""
SELECT episode.number, {dialect_of(connection).episode_id}, {head}, coalesce(progress.folded, 0), started_wall_ns
FROM episode {joined} LEFT JOIN {place} AS progress ON progress.id = episode.number
WHERE episode.number > :after AND {head} > coalesce(progress.folded, 0) AND progress.parked IS NULL
AND episode.number % :many = :part {begun} {grown} ORDER BY episode.number LIMIT :limit"""),  # noqa: S608
        {"after": after, "part": share[0], "many": share[1], "limit": limit, "newer": newer},
    )
    return [EpisodeRow(*row) for row in rows]


def folded(place: str) -> str:
    """Return SQL that selects, for each episode, the last sequence in this generation."""
    return f"SELECT id AS number, folded FROM {place}"  # noqa: S608


async def left(connection: AsyncConnection, place: str, share: tuple[int, int] = (0, 1)) -> int:
    """Return the number of events of a share that this generation lacks, without those of parked episodes."""
    result = await connection.execute(
        text(
            f"SELECT coalesce(sum(head - coalesce(progress.folded, 0)), 0) FROM episode LEFT JOIN {place} AS progress"  # noqa: S608
            " ON progress.id = number WHERE progress.parked IS NULL AND number % :many = :part"
        ),
        {"part": share[0], "many": share[1]},
    )
    return int(result.scalar_one())


async def parked(connection: AsyncConnection, place: str) -> dict[int, str]:
    """Return the parked episodes of this generation by number, with the reasons."""
    rows = await connection.execute(
        text(f"SELECT id, parked FROM {place} WHERE parked IS NOT NULL ORDER BY id")  # noqa: S608
    )
    return {each.id: each.parked for each in rows}


async def advance(
    connection: AsyncConnection, place: str, steps: Sequence[Progress], parked: Mapping[int, str]
) -> bool:
    """Write (number, folded before, folded now) of each episode, and park some.

    Returns False if a checkpoint has moved, or an episode is parked already.
    """
    dialect = dialect_of(connection)
    progress = _table(place)
    query = select(*progress.c).where(progress.c.id.in_([number for number, _, _ in steps]))
    rows = await connection.execute(query.order_by(progress.c.id).with_for_update())
    present: dict[int, int] = {row.id: row.folded if row.parked is None else -1 for row in rows}
    if any(present.get(number, 0) != before for number, before, _ in steps):
        return False
    new = [(number, now, None) for number, _, now in steps if number not in present]
    grown = [(number, now) for number, _, now in steps if number in present]
    try:
        if new:
            await dialect.insert(connection, await dialect.insertion({(place, tuple(COLUMNS)): new}))
    except RowRefused:
        return False
    if grown:
        await dialect.update_rows(connection, place, {"id": "bigint", "folded": "bigint"}, grown)
    park = f"INSERT INTO {place} (id, folded, parked) VALUES (:number, 0, :reason)"  # noqa: S608
    for number, reason in parked.items():
        await connection.execute(
            text(f"{park} ON CONFLICT (id) DO UPDATE SET parked = excluded.parked"),
            {"number": number, "reason": reason},
        )
    return True


async def carry_over(connection: AsyncConnection, place: str) -> None:
    """Copy the checkpoints of this generation into `episode`, when it becomes the visible one."""
    episode = table("episode", column("number"), column("folded"), column("parked"))
    progress = _table(place)
    different = or_(episode.c.folded != progress.c.folded, episode.c.parked.is_distinct_from(progress.c.parked))
    taken = (
        select(episode.c.number, progress.c.folded, progress.c.parked)
        .join_from(episode, progress, progress.c.id == episode.c.number)
        .where(different)
        .order_by(episode.c.number)  # all transactions lock episodes in this order, which prevents deadlocks
        .with_for_update(of=episode)
        .cte("taken")
    )
    change = update(episode).where(episode.c.number == taken.c.number)
    await connection.execute(change.values(folded=taken.c.folded, parked=taken.c.parked))


def _table(place: str) -> TableClause:
    return table(place, *map(column, COLUMNS))


# === targets ==================================================================================================
#
# Define the targets of a fold: `LiveTarget` is the visible generation, `SideTarget` any other, with its checkpoints.
#
# Theory of operation. There are two stores of checkpoints, and `behind` and `advance` differ by them. Those of the
# visible built-in tables are `episode.folded`, whose index makes a poll for new events take 0.03 ms, however many
# episodes there are. Every other generation, one that a rebuild fills or that of a custom projection, has a table with
# one row for each episode (section "checkpoints"), which is dropped together with it. A rebuild copies its checkpoints
# into `episode.folded` when it switches. No index leads from it to the episodes that are behind, so a custom projection
# checks all episodes at intervals (`custom_tables`).
#
# On SQLite the checkpoints of a custom projection have one more row, its mark: the newest event such that it and all
# that were stored before are folded or belong to parked episodes. Events are stored in the order of their rowids, so
# only episodes with an event behind the mark have to be checked. The mark stays true: checkpoints never go back, a
# parked episode stays so, and a rebuild begins a table without a mark. Only a removal takes checkpoints away, of an
# episode that may be restored, and it raises the revision of each generation. So the mark belongs to one revision. It
# names the event and not its rowid, because SQLite may give a rowid to a second event, and changes rowids in a VACUUM.
# `mark` moves it only where many events are behind it, because that takes a transaction.
#
# `SideTarget` reads the generation under its key in every transaction. For a rebuild another number is an error. For a
# projection it means that another process has rebuilt it: a batch folded for the old tables is folded again for the new
# ones, unless their version differs, which is an error. Several workers may fill one generation, each its `Share` of
# the episodes, so that no two of them advance one checkpoint.

_log = logging.getLogger("pycrorm_async.projections")

_BEHIND_EPISODES_MAX = 400
"""Bounds the episodes in one batch, because reading each of them costs as much as folding some of its events."""
_UNMARKED_EVENTS_MIN: Final = 10_000
"""The events behind a mark from which on it is moved: to check their episodes takes 1 ms."""
_CHECKED_EVENTS_MAX: Final = 3
"""Bounds the events behind a mark whose episodes are checked, per episode of the memory: with more of them, checking
all episodes is faster."""


class Share(NamedTuple):
    """The episodes that one of several processes folds: those whose number modulo `many` is `part`."""

    part: int = 0
    many: int = 1


WHOLE = Share()


class LiveTarget:
    """The visible generation, with `episode.folded` as its checkpoints.

    Methods with a connection run in the caller's transaction; those of `SideTarget` mean the same.

    Attributes:
        share: the episodes that this process folds.
    """

    def __init__(self, log: EventLog) -> None:
        self.log = log
        self.share = WHOLE
        self._known: generations.Generation | None = None

    async def behind(self, connection: AsyncConnection, after: int, limit: int) -> list[EpisodeRow]:
        """Return the episodes above number `after` whose events this generation lacks, without parked ones."""
        values = {"after": after, "limit": limit, **self.share._asdict()}
        return await dialect_of(connection).rows(connection, EpisodeRow, SELECT_BEHIND, **values)

    async def advance(self, connection: AsyncConnection, steps: Sequence[Progress], parked: Mapping[int, str]) -> bool:
        """Advance checkpoints and park episodes; return False if a checkpoint has moved: then roll back."""
        if steps and not await advance_folded(connection, steps):
            return False
        for number, reason in parked.items():
            await park(connection, number, reason)
        return True

    async def generation(self, connection: AsyncConnection, hold: generations.Hold | None) -> generations.Generation:
        """Read the generation and lock it until the transaction ends."""
        known = None if hold == "change" else self._known
        generation = await generations.current_generation(connection, hold=hold, known=known)
        if generation is None:
            raise DatabaseUnavailable("the tables are missing: restore them from a backup, or run `pycrorm rebuild`")
        self._known = generation
        return generation

    async def grow(
        self, connection: AsyncConnection, generation: generations.Generation, layout: Layout
    ) -> generations.Generation:
        """Create the tables and columns that only this layout has, and store the layout."""
        return await generations.show(connection, await generations.grow_tables(connection, generation, layout))

    async def missing(self, number: int, sequence: int) -> str:  # noqa: ARG002 - of each target
        """Return the reason to park the episode whose event is missing in the log; `SideTarget` raises `LogDamaged`."""
        return f"event {sequence} is missing in the log"


@dataclass(slots=True)
class SideTarget:
    """A generation with its own checkpoint table.

    Attributes:
        log: with the events.
        key: of its row in `pycrorm_generation`.
        projection: the custom projection's name; None for the built-in tables.
        version: of the fold in this process.
        number: of the generation; None accepts any that has the key.
        share: the episodes that this process folds.
    """

    log: EventLog
    key: str
    projection: str | None
    version: int
    number: int | None = None
    share: Share = WHOLE
    _place: str = field(default="", init=False)
    _known: generations.Generation | None = field(default=None, init=False)
    _unmarked: int = field(default=0, init=False)
    """The events behind the mark, at the last check."""

    async def behind(self, connection: AsyncConnection, after: int, limit: int) -> list[EpisodeRow]:
        generation = await self.generation(connection, "share")  # locked, so that no rebuild drops its tables
        return await episodes_behind(
            connection,
            self._place,
            after=after,
            limit=min(limit, _BEHIND_EPISODES_MAX),
            share=self.share,
            after_tables=self.projection is not None,
            newer=(await self._marked(connection, generation))[1],
        )

    async def _marked(self, connection: AsyncConnection, generation: generations.Generation) -> tuple[int, int]:
        """Return the rowid of the mark, 0 without one, and the rowid above which episodes have to be checked."""
        if self.projection is None or not self.log.address.is_sqlite:
            return 0, 0
        key = f"event.episode = folded >> {NUMBER_SHIFT} AND event.sequence = folded >> 5 & {SEQUENCE_MAX}"
        query = text(f"""
SELECT coalesce(max(rowid), 0), (SELECT max(number) FROM episode),
coalesce((SELECT event.rowid FROM {self._place} AS mark JOIN event ON {key} WHERE mark.id = :mark), 0) FROM event
""")  # noqa: S608
        newest, episodes, marked = (await connection.execute(query, {"mark": -generation.revision})).one()
        self._unmarked = newest - marked
        return marked, marked if self._unmarked <= _CHECKED_EVENTS_MAX * (episodes or 0) else 0

    async def mark(self) -> None:
        """Move the mark of this custom projection as far as possible, if many events are behind it."""
        if self._unmarked < _UNMARKED_EVENTS_MIN:
            return
        async with self.log.snapshot() as connection:
            generation = await self.generation(connection, None)
            marked, newer = await self._marked(connection, generation)
            behind = await episodes_behind(connection, self._place, limit=_BEHIND_EPISODES_MAX, newer=newer)
            lacking = ", ".join(f"({each.number}, {each.folded + 1})" for each in behind) or "(0, 0)"
            query = f"SELECT count(*), min(rowid) FROM event WHERE (episode, sequence) IN (VALUES {lacking})"  # noqa: S608
            count, first = (await connection.execute(text(query))).one()
            query = "SELECT rowid, episode, sequence FROM event WHERE rowid < :first ORDER BY rowid DESC LIMIT 1"
            last = (await connection.execute(text(query), {"first": first or 2**63 - 1})).first()
        # If the projection is far behind, it is marked later. An event that it lacks may be missing in the log.
        if last is None or len(behind) == _BEHIND_EPISODES_MAX or count < len(behind):
            return
        rowid, number, sequence = last
        if rowid < marked + _UNMARKED_EVENTS_MIN:
            return
        async with self.log.writing() as connection:
            if (await self.generation(connection, "share")).number == generation.number:
                await connection.execute(text(f"DELETE FROM {self._place} WHERE id <= 0"))  # noqa: S608
                insert = text(f"INSERT INTO {self._place} (id, folded) VALUES (:mark, :key)")  # noqa: S608
                await connection.execute(insert, {"mark": -generation.revision, "key": row_id_min(number, sequence)})

    async def advance(self, connection: AsyncConnection, steps: Sequence[Progress], parked: Mapping[int, str]) -> bool:
        if not await advance(connection, self._place, steps, parked):
            return False
        for number, reason in parked.items() if self.projection is not None else ():
            _log.warning("episode %s is parked in the projection %s: %s", number, self.projection, reason)
        return True

    async def generation(self, connection: AsyncConnection, hold: generations.Hold | None) -> generations.Generation:
        known = None if hold == "change" else self._known
        generation = await generations.read_generation(connection, self.key, hold=hold, known=known)
        if generation is None or self.number not in (None, generation.number):
            raise InternalError(
                f"another process replaced the tables of {self.projection or 'the memory'} during the fold"
            )
        if generation.version != self.version:
            raise DatabaseForeign(
                f"its tables have version {generation.version} now, but this process folds version {self.version}"
            )
        self._place = place_of(generation.number, self.projection)
        self._known = generation
        return generation

    async def grow(
        self, connection: AsyncConnection, generation: generations.Generation, layout: Layout
    ) -> generations.Generation:
        grown = await generations.grow_tables(connection, generation, layout)
        await generations.write_generation(connection, self.key, grown)
        return grown

    async def missing(self, number: int, sequence: int) -> str:
        [episode] = await self.log.episodes(number, number)
        raise LogDamaged(episode.id, sequence, f"is missing in {self.log.address}")
