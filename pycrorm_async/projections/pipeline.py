"""Fold batch after batch into one target: while one batch is written, prepare the next.

    pipeline = FoldPipeline(LiveTarget(log))
    while await pipeline.fold_next(workers) is not None: ...

Theory of operation. A `BatchWorker` folds into the target's tables, in this process or in one of its own. It prepares a
batch (reads the events and folds them into rows) and later writes it in one transaction. The pipeline chooses the
events of each batch. It prepares at most one batch ahead, and writes a prepared batch only if the batch before it was
written whole; otherwise it discards the prepared one and reads the checkpoints again. A worker process may die or be
replaced at any moment: its batch then counts as not written. If its transaction committed although its answer was lost,
the checkpoints show it, because the next batch is read from them, and a batch that does not continue the checkpoints is
rolled back. So no event is folded twice or left out.

Another worker prepares ahead, if there is one. A `local` worker can also prepare ahead itself, which is faster where a
server writes in its own process, and slower with SQLite, which writes in this one.
"""

from __future__ import annotations

import asyncio
import logging
import re
from collections.abc import Callable, Iterator, Mapping, Sequence
from dataclasses import dataclass
from typing import Final, NamedTuple, Protocol

from sqlalchemy import TableClause, column, or_, select, table, text, update
from sqlalchemy.ext.asyncio import AsyncConnection, AsyncEngine

from pycrorm_async.errors import DatabaseForeign, DatabaseUnavailable, InternalError, LogDamaged
from pycrorm_async.events.codec import fingerprint
from pycrorm_async.projections.columns import Layout, Storage, physical_name, unite
from pycrorm_async.projections.fold import TableRows, fold
from pycrorm_async.projections.generations import (
    Generation,
    GrowthTarget,
    Hold,
    current_generation,
    grow,
    grow_tables,
    read_generation,
    show,
    write_generation,
)
from pycrorm_async.projections.row_batch import CannotFold, Designators, Rows
from pycrorm_async.store.dialect import Progress, RowRefused
from pycrorm_async.store.dialects import dialect_of
from pycrorm_async.store.log import EventLog, advance_folded, park
from pycrorm_async.store.stored import EpisodeRow, Span, StoredEvent, beyond, consecutive, pages_of, share_out, size_of

LOOKAHEAD_EVENTS_MIN: Final = 2_000
"""The smallest batch that is prepared ahead; a smaller one waits for the events that arrive during the write."""


class BatchWorker(Protocol):
    """Folds one batch at a time into the tables. Both methods raise `DatabaseUnavailable`."""

    async def prepare(self, spans: Sequence[Span]) -> BatchPreview:
        """Read and fold these events, and discard the batch prepared before. Writes nothing."""
        ...

    async def write(self) -> int:
        """Write the batch; return the number of its events that are in the tables now."""
        ...


class FoldPipeline:
    """Assigns the events that a target lacks to workers, batch by batch.

    Args:
        target: of all workers.
        batch_events: the most events in one transaction.
        local: a worker of this process that prepares the next batch while it writes.
    """

    def __init__(self, target: FoldTarget, *, batch_events: int = 10_000, local: BatchWorker | None = None) -> None:
        self._target = target
        self._batch_events = batch_events
        self._local = local
        self._ready: tuple[BatchWorker, BatchPreview] | None = None
        self._last_number = 0

    async def fold_next(self, workers: Sequence[BatchWorker]) -> int | None:
        """Fold one batch with one or more workers; return the number of events, None if no episode is behind.

        The number is smaller than the batch if an episode was parked, and 0 if another process folded it first. Raises
        the errors of the workers; rows that were written stay.
        """
        prepared, self._ready = self._ready, None
        if prepared is None or prepared[0] not in workers:
            spans = await self._spans(None)
            if not spans:
                return None
            prepared = workers[0], await workers[0].prepare(spans)
        worker, preview = prepared
        following = next((each for each in workers if each is not worker), self._local)
        if following is None or not preview.is_whole:
            return await worker.write()
        # `write` comes first, because a local worker takes its batch before it prepares another.
        count, ready = await asyncio.gather(
            worker.write(), self._prepare_ahead(following, preview), return_exceptions=True
        )
        for fault in (count, ready):
            if isinstance(fault, BaseException):
                raise fault
        assert isinstance(count, int)
        if count == preview.events and isinstance(ready, BatchPreview):
            self._ready = following, ready
        return count

    def begin_again(self) -> None:
        """Begin the next batch with the first episode that is behind."""
        self._last_number = 0

    async def size(self) -> int:
        """Return the number of events that the next batch would have."""
        return size_of(await self._target.unfolded(self._batch_events, after=0, reached={}))

    async def _prepare_ahead(self, worker: BatchWorker, before: BatchPreview) -> BatchPreview | None:
        spans = await self._spans(before)
        return await worker.prepare(spans) if size_of(spans) >= min(LOOKAHEAD_EVENTS_MIN, self._batch_events) else None

    async def _spans(self, before: BatchPreview | None) -> list[Span]:
        # Start behind the last batch's episode, so that an episode that always grows does not starve the others.
        reached = before.reached if before is not None else {}
        spans = await self._target.unfolded(self._batch_events, after=self._last_number, reached=reached)
        if spans:
            self._last_number = spans[-1].number
        return spans


# === batch fold ===============================================================================================
#
# Fold batches of events into a generation, writing rows and checkpoints in one transaction.
#
# Theory of operation. A batch has two phases. `prepare` reads the declarations and then the events, a page at a time,
# and folds them into rows in memory; it holds no lock and writes nothing. `write` opens a transaction, locks the
# generation's row, compares number and revision of the generation and the checkpoint of each episode with those that
# `prepare` assumed, and only then writes rows and checkpoints. If anything differs, because another process folded the
# same events or changed the tables, it rolls back and returns 0, and the caller reads the events again. So any number
# of processes may fold one memory: every event is folded exactly once, and rows and checkpoints never disagree.
#
# A declaration that the generation has no tables for makes the write transaction exclusive and grows the tables first
# (`generations`). If the database creates only some of them, the growth is committed, the batch is not, and it is
# folded again for the tables that exist now. An event that cannot be folded parks its episode at this event: the events
# before it are written, later ones are not folded, and all other episodes continue. If the database refuses a row, the
# batch is written again episode by episode, and then in halves, until the refused event is alone; it parks its episode.
#
# `FoldTarget` is the generation and its checkpoints, of which there are two kinds (section "targets"). `FoldDefinition`
# turns events into rows: those of the built-in tables, here, or those of a custom projection.

_REASON_LENGTH_MAX = 2_000
"""Bounds the characters of the reason for parking an episode: `status` shows it, and a value may have megabytes."""
_PAGE_EVENTS = 10_000
"""Bounds the events that are read at once, and so their memory; all of a batch, unless it makes few rows."""
_SLICE_EVENTS = 100
"""The events folded between two yields to the event loop, some 0.4 ms."""


class FoldTarget(GrowthTarget, Protocol):
    """A generation to fold into, and its checkpoints. All methods but `unfolded` run in the caller's transaction.

    Attributes:
        parks_gaps: whether an event that is missing in the log parks its episode; otherwise `LogDamaged` is raised.
    """

    parks_gaps: bool

    async def unfolded(self, limit: int, *, after: int, reached: Mapping[int, int]) -> list[Span]:
        """Return spans of events that this generation lacks, at most `limit` in total; without parked episodes.

        Begins with the episodes whose number is above `after`, or with the first if there are none. `reached` is the
        last sequence, by number, of a batch that is being written.
        """
        ...

    async def generation(self, connection: AsyncConnection, hold: Hold) -> Generation:
        """Read the generation and lock it until the transaction ends."""
        ...

    async def advance(self, connection: AsyncConnection, steps: Sequence[Progress]) -> bool:
        """Advance the checkpoints; return False if one has moved, and then the caller must not commit."""
        ...

    async def park(self, connection: AsyncConnection, number: int, reason: str) -> None: ...


class Batch(Protocol):
    """The rows of a batch of events."""

    async def restore(self, log: EventLog, spans: Sequence[Span]) -> None:
        """Prepare for folding these spans, by reading the facts that the fold needs of the events before them."""
        ...

    def fold(self, events: Sequence[StoredEvent]) -> tuple[int, str] | None:
        """Add the rows of consecutive events of an episode, at least one.

        Returns the first event that cannot be folded, with the reason; of it and those behind it, no row is added.
        """
        ...

    async def ready(self, engine: AsyncEngine, generation: int) -> None:
        """Prepare the statements for this generation, after the last event and before the transaction."""
        ...

    async def write(self, connection: AsyncConnection, generation: int) -> None:
        """Write the rows. Raises `RowRefused`."""
        ...


class FoldDefinition(Protocol):
    """A way of turning events into rows."""

    def learn(self, layout: Layout, payloads: Sequence[bytes]) -> tuple[Layout, Callable[[], Batch]]:
        """Return the layout with these declarations, and a factory of empty batches for it."""
        ...


@dataclass(frozen=True)
class _Types:
    """The declarations that were read, and the layout and batch factory for them at one revision."""

    payloads: list[bytes]
    revision: int
    layout: Layout
    batch: Callable[[], Batch]


@dataclass(frozen=True)
class _PreparedBatch:
    """A batch between `prepare` and `write`.

    Attributes:
        rows: for the generation `number`.
        steps: (episode, folded before, folded now) for each episode.
        parked: the reasons of the episodes to park.
    """

    spans: Sequence[Span]
    types: _Types
    rows: Batch
    number: int
    steps: list[Progress]
    parked: dict[int, str]

    @property
    def count(self) -> int:
        """The number of its folded events."""
        return sum(now - before for _, before, now in self.steps)


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


class _Tables:
    """The fold into the built-in tables. Implements `FoldDefinition`."""

    def learn(self, layout: Layout, payloads: Sequence[bytes]) -> tuple[Layout, Callable[[], Batch]]:
        united = unite(layout, payloads)
        designators = Designators.of_union(united)
        return united.layout, lambda: TableRows(designators)


TABLES = _Tables()


class BatchFold:
    """Folds events of one log into one target. Implements `BatchWorker`.

    Attributes:
        generation: its state when this process last read it.
    """

    def __init__(
        self, log: EventLog, target: FoldTarget, generation: Generation, definition: FoldDefinition = TABLES
    ) -> None:
        self._log = log
        self._target = target
        self._definition = definition
        self.generation = generation
        self._types: _Types | None = None
        self._prepared: _PreparedBatch | None = None

    async def prepare(self, spans: Sequence[Span]) -> BatchPreview:
        """Read and fold these events, yielding to the event loop at intervals. Writes nothing."""
        self._prepared = None
        self._prepared = batch = await self._folded(spans)
        return BatchPreview(batch.count, {number: now for number, _, now in batch.steps}, not batch.parked)

    async def write(self) -> int:
        """Write the prepared batch; return the number of events folded.

        It is smaller if an episode was parked, and 0 if another process folded them first or changed the tables.
        """
        batch, self._prepared = self._prepared, None
        return 0 if batch is None else await self._write(batch)

    async def write_in(self, connection: AsyncConnection, spans: Sequence[Span]) -> bool:
        """Fold in the caller's transaction, which must be rolled back if this returns False or raises `RowRefused`."""
        batch = await self._folded(spans)
        generation = await self._generation(connection, batch)
        if generation is not None and generation.layout != batch.types.layout:
            return False
        return await self._write_rows(connection, batch, generation) is not None

    async def _folded(self, spans: Sequence[Span]) -> _PreparedBatch:
        """Read and fold these events, a page at a time, so that the events of a large batch never are in memory."""
        types = await self._types_now()
        rows, number = types.batch(), self.generation.number
        await rows.restore(self._log, spans)
        reached = {each.number: each.after for each in spans}
        parked: dict[int, str] = {}
        for page in pages_of(spans, _PAGE_EVENTS):
            wanted = [each for each in page if each.number not in parked]
            events = await self._log.spans(wanted)
            if not self._target.parks_gaps and len(events) < size_of(wanted):
                raise await _damage(self._log, wanted, events)
            steps, reasons = await _fold_all(wanted, events, rows)
            reached |= {number: now for number, _, now in steps}
            parked |= reasons
        await rows.ready(self._log.engine, number)
        steps = [(each.number, each.after, reached[each.number]) for each in spans]
        return _PreparedBatch(spans, types, rows, number, steps, parked)

    async def _write(self, batch: _PreparedBatch) -> int:
        try:
            async with self._log.writing() as connection:
                generation = await self._generation(connection, batch)
                grown = generation is not None and generation.layout != batch.types.layout
                written = generation if grown else await self._write_rows(connection, batch, generation)
                if written is None:
                    await connection.rollback()
                    return 0
            self.generation = written
            if grown:  # some tables of this batch do not exist: the caller folds it again for those that do
                return 0
        except RowRefused as refusal:
            return await self._isolate(batch.spans, refusal)
        return batch.count

    async def _generation(self, connection: AsyncConnection, batch: _PreparedBatch) -> Generation | None:
        """Lock the generation and create missing tables; return None if its number or revision has changed.

        The layout of the result differs from that of the batch if some tables could not be created.
        """
        types = batch.types
        growing = types.layout != self.generation.layout
        if growing:
            await dialect_of(connection).lock_log_changes(connection)
        generation = await self._target.generation(connection, "change" if growing else "share")
        if (generation.number, generation.revision) != (batch.number, types.revision):
            self.generation = generation
            return None
        return await grow(connection, self._target, generation, types.payloads) if growing else generation

    async def _write_rows(
        self, connection: AsyncConnection, batch: _PreparedBatch, generation: Generation | None
    ) -> Generation | None:
        """Write rows and checkpoints; return None, to roll back, without a generation or if a checkpoint has moved."""
        if generation is None or not await self._target.advance(connection, batch.steps):
            return None
        await batch.rows.write(connection, generation.number)
        for number, reason in batch.parked.items():
            await self._target.park(connection, number, _writable(reason))
        return generation

    async def _types_now(self) -> _Types:
        """Read the declarations. They include those of all stored events: each is stored before its first use."""
        payloads = await self._log.declarations()
        types = self._types
        if types is None or types.revision != self.generation.revision or types.payloads != payloads:
            layout, batch = self._definition.learn(self.generation.layout, payloads)
            types = _Types(payloads, self.generation.revision, layout, batch)
            self._types = types
        return types

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
            reason = f"event {span.last}: the database refuses it: {refusal}"
            await self._target.park(connection, span.number, _writable(reason))
        return 0


def _writable(reason: str) -> str:
    """Shorten and escape a reason for storage: it may quote recorded text that a database refuses."""
    shortened = reason[:_REASON_LENGTH_MAX] + ("…" if len(reason) > _REASON_LENGTH_MAX else "")
    return shortened.encode(errors="backslashreplace").decode().replace("\0", "\\x00")


async def _damage(log: EventLog, spans: Sequence[Span], events: Sequence[StoredEvent]) -> LogDamaged:
    """Return the error for the first event of these spans that is missing."""
    present = {(each.number, each.sequence) for each in events}
    number, sequence = next(
        (span.number, sequence)
        for span in spans
        for sequence in range(span.after + 1, span.last + 1)
        if (span.number, sequence) not in present
    )
    [episode] = await log.episodes(number, number)
    return LogDamaged(episode.id, sequence, f"is missing in {log.address}")


async def _fold_all(
    spans: Sequence[Span], events: Sequence[StoredEvent], rows: Batch
) -> tuple[list[Progress], dict[int, str]]:
    """Fold the events of these spans into `rows`, in order; return the new checkpoints and the episodes to park."""
    steps: list[Progress] = []
    parked: dict[int, str] = {}
    folded = _SLICE_EVENTS  # since this yielded to the event loop
    for span, part in _by_span(spans, events):
        for first in range(0, len(part), _SLICE_EVENTS):
            if folded >= _SLICE_EVENTS:
                await asyncio.sleep(0)
                folded = 0
            some = part[first : first + _SLICE_EVENTS]
            folded += len(some)
            if (refused := rows.fold(some)) is not None:
                sequence, reason = refused
                last = sequence - 1
                parked[span.number] = f"event {sequence}: {reason}"
                break
        else:
            last = span.after + len(part)
            if last < span.last:
                parked[span.number] = f"event {last + 1} is missing in the log"
        steps.append((span.number, span.after, last))
    return steps, parked


def _by_span(spans: Sequence[Span], events: Sequence[StoredEvent]) -> Iterator[tuple[Span, Sequence[StoredEvent]]]:
    """Pair each span with its events up to the first that is missing; each episode has one span."""
    first = 0
    for span in spans:
        part = events[first : first + span.last - span.after]
        if part and part[-1].number != span.number:  # some are missing, so it has events of the next span
            part = [each for each in part if each.number == span.number]
        first += len(part)
        yield span, consecutive(part, span.after)


# === checkpoints ==============================================================================================
#
# Read and write the checkpoint table of a generation: one row for each episode.
#
# Generations that a rebuild fills and those of custom projections have such a table, named after the generation
# (section "targets").

TABLE = "pycrorm_progress"
COLUMNS: dict[str, Storage] = {"id": "key", "folded": "integer", "parked": "text"}
"""The episode's number, the last sequence that is in the tables, and the reason if it is parked."""
SEEN = "SELECT number, folded FROM episode"
"""SQL that selects, for each episode, the last sequence in the visible tables."""


def place_of(generation: int, projection: str | None = None) -> str:
    """Return the name of the checkpoint table of a generation, of the built-in tables or of a custom projection."""
    return physical_name(TABLE if projection is None else f"{TABLE}_{projection}", generation)


async def episodes_behind(
    connection: AsyncConnection,
    place: str,
    *,
    after: int,
    limit: int,
    share: tuple[int, int] = (0, 1),
    after_tables: bool = False,
) -> list[EpisodeRow]:
    """Return the episodes above number `after` whose log is ahead of their checkpoint, limited to one share.

    With `after_tables`, only episodes whose first event is folded into the visible tables or parked, because that fold
    decides whether an episode is a simulation.
    """
    begun = "AND (episode.folded > 0 OR episode.parked IS NOT NULL)" if after_tables else ""
    rows = await connection.execute(
        text(f"""
SELECT number, {dialect_of(connection).episode_id}, head, coalesce(progress.folded, 0), started_wall_ns
FROM episode LEFT JOIN {place} AS progress ON progress.id = number
WHERE number > :after AND head > coalesce(progress.folded, 0) AND progress.parked IS NULL
AND number % :many = :part {begun} ORDER BY number LIMIT :limit"""),  # noqa: S608
        {"after": after, "part": share[0], "many": share[1], "limit": limit},
    )
    return [EpisodeRow(*row) for row in rows]


async def late(connection: AsyncConnection, place: str, *, seen: str, limit: int) -> list[EpisodeRow]:
    """Return the episodes of which the visible tables have more events than this generation.

    Their `head` is the last sequence in the visible tables. `seen` is the SQL for the checkpoints of those tables:
    `SEEN`, or `folded` of another generation.
    """
    rows = await connection.execute(
        text(f"""
SELECT episode.number, {dialect_of(connection).episode_id}, seen.folded, coalesce(progress.folded, 0), started_wall_ns
FROM episode JOIN ({seen}) AS seen ON seen.number = episode.number
LEFT JOIN {place} AS progress ON progress.id = episode.number
WHERE seen.folded > coalesce(progress.folded, 0) AND progress.parked IS NULL
ORDER BY episode.number LIMIT :limit"""),  # noqa: S608
        {"limit": limit},
    )
    return [EpisodeRow(*row) for row in rows]


def folded(place: str) -> str:
    """Return SQL that selects, for each episode, the last sequence in this generation."""
    return f"SELECT id AS number, folded FROM {place}"  # noqa: S608


async def left(connection: AsyncConnection, place: str) -> int:
    """Return the number of events in the log that this generation lacks, without those of parked episodes."""
    result = await connection.execute(
        text(
            f"SELECT coalesce(sum(head - coalesce(progress.folded, 0)), 0) FROM episode LEFT JOIN {place} AS progress"  # noqa: S608
            " ON progress.id = number WHERE progress.parked IS NULL"
        )
    )
    return int(result.scalar_one())


async def parked(connection: AsyncConnection, place: str) -> dict[int, str]:
    """Return the parked episodes of this generation by number, with the reasons."""
    rows = await connection.execute(
        text(f"SELECT id, parked FROM {place} WHERE parked IS NOT NULL ORDER BY id")  # noqa: S608
    )
    return {each.id: each.parked for each in rows}


async def advance(connection: AsyncConnection, place: str, steps: Sequence[Progress]) -> bool:
    """Write (number, folded before, folded now) of each episode; return False if a checkpoint has moved."""
    dialect = dialect_of(connection)
    progress = _table(place)
    query = select(progress.c.id, progress.c.folded).where(progress.c.id.in_([number for number, _, _ in steps]))
    rows = await connection.execute(query.order_by(progress.c.id).with_for_update())
    present: dict[int, int] = {row.id: row.folded for row in rows}
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
    return True


async def park_in_generation(connection: AsyncConnection, place: str, number: int, reason: str) -> None:
    """Park an episode in this generation."""
    await connection.execute(
        text(
            f"INSERT INTO {place} (id, folded, parked) VALUES (:number, 0, :reason)"  # noqa: S608
            " ON CONFLICT (id) DO UPDATE SET parked = excluded.parked"
        ),
        {"number": number, "reason": reason},
    )


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


# === parked release ===========================================================================================
#
# Release parked episodes whose next event can be folded now: by a newer version, or because a name became free.
#
# A process tries this once, when it opens the tables. It folds the one event at which each episode is parked and
# discards the rows; the next batch folds it again and continues there.

_RELEASED_EPISODES_MAX = 1_000
"""Bounds the parked episodes that one process tries, at 0.1 ms each, so that opening a memory never takes minutes."""
_AT_AN_EVENT = re.compile(r"event (\d+): (?!the database refuses it)")
"""Matches a reason from the fold. A row that the database refused is excluded, because only writing it again shows
whether the database accepts it now."""


async def release_parked(connection: AsyncConnection, target: GrowthTarget, generation: Generation) -> Generation:
    """Release episodes and create tables that the database refused before; return the generation with those.

    Runs in the caller's transaction, which must exclude all other writers of the memory.
    """
    dialect = dialect_of(connection)
    parked = [each for each in await dialect.stopped(connection) if each.parked is not None]
    places = [(each, _AT_AN_EVENT.match(each.parked or "")) for each in parked[:_RELEASED_EPISODES_MAX]]
    payloads = await dialect.declarations(connection) if parked or generation.layout.unmade else []
    generation = await _retry_unmade(connection, target, generation, payloads)
    if not parked:
        return generation
    designators = Designators.of_union(unite(generation.layout, payloads))
    for episode, place in places:
        if place is None or int(place[1]) != episode.folded + 1:
            continue
        for event in await dialect.events(connection, episode.number, after=episode.folded, limit=1):
            try:
                fold(event, designators, Rows())
            except CannotFold:
                continue
            await park(connection, episode.number, None)
    return generation


async def _retry_unmade(
    connection: AsyncConnection, target: GrowthTarget, generation: Generation, payloads: Sequence[bytes]
) -> Generation:
    """Try again to create the tables that the database refused; return the generation with those it creates now."""
    unmade = generation.layout.unmade
    if not unmade:
        return generation
    attempt = await connection.begin_nested()
    cleared = generation.without_unmade()
    grown = await grow(connection, target, cleared, [each for each in payloads if fingerprint(each) in unmade])
    if grown.layout == generation.layout:
        await attempt.rollback()  # keeps the revision, so that no other process has to read the layout again
        return generation
    await attempt.commit()
    return grown


# === targets ==================================================================================================
#
# Define the targets of a fold: `LiveTarget` is the visible generation, `SideTarget` any other, with its checkpoints.
#
# Theory of operation. There are two stores of checkpoints. Those of the visible built-in tables are `episode.folded`,
# whose index makes a poll for new events take 0.03 ms, however many episodes there are. Every other generation, one
# that a rebuild fills or that of a custom projection, has a table with one row for each episode (section
# "checkpoints"), which is dropped together with it. A rebuild copies its checkpoints into `episode.folded` when it
# switches. No index leads from it to the episodes that are behind, so a custom projection checks the newest episodes
# often and all of them seldom (`custom`).
#
# `SideTarget` reads the generation under its key in every transaction. For a rebuild another number is an error. For a
# projection it means that another process has rebuilt it: a batch folded for the old tables is folded again for the new
# ones, unless their version differs, which is an error. Several workers may fill one generation, each its `Share` of
# the episodes, so that no two of them advance one checkpoint.

_log = logging.getLogger("pycrorm_async.projections")

_BEHIND_EPISODES_MAX = 400
"""Bounds the episodes in one batch, because reading each of them costs as much as folding some of its events."""


_NEWEST_EPISODES = 1_000
"""The episodes that a check of the newest reads, in 0.3 ms: more than record at a time."""


class Share(NamedTuple):
    """The episodes that one of several workers folds: those whose number modulo `many` is `part`."""

    part: int = 0
    many: int = 1


WHOLE = Share()


class LiveTarget:
    """The visible generation, with `episode.folded` as its checkpoints. Implements `FoldTarget`."""

    parks_gaps = True

    def __init__(self, log: EventLog) -> None:
        self._log = log

    async def generation(self, connection: AsyncConnection, hold: Hold) -> Generation:
        generation = await current_generation(connection, hold=hold)
        if generation is None:
            raise DatabaseUnavailable("the tables are missing: restore them from a backup, or run `pycrorm rebuild`")
        return generation

    async def grow(self, connection: AsyncConnection, generation: Generation, layout: Layout) -> Generation:
        return await show(connection, await grow_tables(connection, generation, layout))

    async def unfolded(self, limit: int, *, after: int, reached: Mapping[int, int]) -> list[Span]:
        return await self._log.unfolded(limit, after=after, reached=reached)

    async def advance(self, connection: AsyncConnection, steps: Sequence[Progress]) -> bool:
        return await advance_folded(connection, steps)

    async def park(self, connection: AsyncConnection, number: int, reason: str) -> None:
        await park(connection, number, reason)


class SideTarget:
    """A generation with its own checkpoint table. Implements `FoldTarget`.

    Args:
        log: with the events.
        key: of its row in `pycrorm_generation`.
        projection: the custom projection's name; None for the built-in tables.
        version: of the fold in this process.
        number: of the generation; None accepts any that has the key.
        share: the episodes that this process folds.

    Attributes:
        newest_only: whether `unfolded` leaves out all but the newest episodes.
    """

    parks_gaps = False
    newest_only = False

    def __init__(
        self,
        log: EventLog,
        key: str,
        projection: str | None,
        version: int,
        *,
        number: int | None = None,
        share: Share = WHOLE,
    ) -> None:
        self._log = log
        self._key = key
        self._projection = projection
        self._version = version
        self._number = number
        self._share = share
        self._place = ""

    async def generation(self, connection: AsyncConnection, hold: Hold) -> Generation:
        generation = await read_generation(connection, self._key, hold=hold)
        if generation is None or self._number not in (None, generation.number):
            raise InternalError(
                f"another process replaced the tables of {self._projection or 'the memory'} during the fold"
            )
        if generation.version != self._version:
            raise DatabaseForeign(
                f"its tables have version {generation.version} now, but this process folds version {self._version}"
            )
        self._place = place_of(generation.number, self._projection)
        return generation

    async def grow(self, connection: AsyncConnection, generation: Generation, layout: Layout) -> Generation:
        grown = await grow_tables(connection, generation, layout)
        await write_generation(connection, self._key, grown)
        return grown

    async def unfolded(self, limit: int, *, after: int, reached: Mapping[int, int]) -> list[Span]:
        async with self._log.reading() as connection:
            await self.generation(connection, "share")  # locked, so that no rebuild drops its tables
            first = 0
            if self.newest_only:
                newest = await connection.execute(text("SELECT coalesce(max(number), 0) FROM episode"))
                first = max(newest.scalar_one() - _NEWEST_EPISODES, 0)
            after = max(after, first)
            while True:
                episodes = await episodes_behind(
                    connection,
                    self._place,
                    after=after,
                    limit=_BEHIND_EPISODES_MAX,
                    share=self._share,
                    after_tables=self._projection is not None,
                )
                behind = beyond(episodes, reached)
                if behind or after == first:
                    return share_out(behind, limit)
                after = first

    async def advance(self, connection: AsyncConnection, steps: Sequence[Progress]) -> bool:
        return await advance(connection, self._place, steps)

    async def park(self, connection: AsyncConnection, number: int, reason: str) -> None:
        await park_in_generation(connection, self._place, number, reason)
        if self._projection is not None:
            _log.warning("episode %s is parked in the projection %s: %s", number, self._projection, reason)
