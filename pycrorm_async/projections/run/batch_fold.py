"""Fold batches of events into a generation, writing rows and checkpoints in one transaction.

Theory of operation. A batch has two phases. `prepare` reads the declarations and then the events, a page at a time, and
folds them into rows in memory; it holds no lock and writes nothing. `write` opens a transaction, locks the generation's
row, compares number and revision of the generation and the checkpoint of each episode with those that `prepare`
assumed, and only then writes rows and checkpoints. If anything differs, because another process folded the same events
or changed the tables, it rolls back and returns 0, and the caller reads the events again. So any number of processes
may fold one memory: every event is folded exactly once, and rows and checkpoints never disagree.

A declaration that the generation has no tables for makes the write transaction exclusive and grows the tables first
(`growth`). If the database creates only some of them, the growth is committed, the batch is not, and it is folded
again for the tables that exist now. An event that cannot be folded parks its episode at this event: the events before
it are written, later ones are not folded, and all other episodes continue. If the database refuses a row, the batch is
written again episode by episode, and then in halves, until the refused event is alone; it parks its episode.

`FoldTarget` is the generation and its checkpoints, of which there are two kinds (`targets`). `FoldDefinition` turns
events into rows: those of the built-in tables, here, or those of a custom projection.
"""

from __future__ import annotations

import asyncio
from collections.abc import Callable, Iterator, Mapping, Sequence
from dataclasses import dataclass
from typing import NamedTuple, Protocol

from sqlalchemy.ext.asyncio import AsyncConnection, AsyncEngine

from pycrorm_async.errors import LogDamaged
from pycrorm_async.projections.fold.parameters import Designators
from pycrorm_async.projections.fold.row_writer import TableRows
from pycrorm_async.projections.schema.generations import Generation, Hold
from pycrorm_async.projections.schema.growth import GrowthTarget, grow
from pycrorm_async.projections.schema.layout import Layout
from pycrorm_async.projections.schema.union import unite
from pycrorm_async.store.dialect import Progress, RowRefused
from pycrorm_async.store.dialects import dialect_of
from pycrorm_async.store.log import EventLog
from pycrorm_async.store.stored import Span, StoredEvent, consecutive, pages_of, size_of

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
    ids = {each.number: each.id for each in await log.episodes()}
    return LogDamaged(ids[number], sequence, f"is missing in {log.address}")


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
