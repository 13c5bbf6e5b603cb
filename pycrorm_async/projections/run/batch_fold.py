"""Folds batches of events into a generation: rows and progress in one transaction, or neither.

Reading and folding hold no lock. The write transaction then checks that both the tables and the progress are as they
were taken to be; if somebody else was quicker it is rolled back, and the events are read again. So any number may fold
one memory, and none of them ever shows an event twice or half. Which generation it is and where its progress is noted
is the `FoldTarget`'s: of what people see (`projector`), or of what is made beside it (`rebuild`). What events mean
is the `FoldDefinition`'s: our tables here, or a projection of one's own (`own_tables`).
"""

from __future__ import annotations

import asyncio
from collections.abc import Callable, Iterator, Sequence
from dataclasses import dataclass
from itertools import groupby
from operator import attrgetter
from typing import Protocol

from sqlalchemy.ext.asyncio import AsyncConnection, AsyncEngine

from pycrorm_async.projections.fold.fold import CannotFold, fold
from pycrorm_async.projections.fold.parameters import Designators
from pycrorm_async.projections.fold.row_batch import Rows
from pycrorm_async.projections.fold.row_writer import insertion_of, write_rows
from pycrorm_async.projections.schema.generations import Generation, Hold
from pycrorm_async.projections.schema.growth import Growing, grow
from pycrorm_async.projections.schema.layout import Layout, unite
from pycrorm_async.store.dialect import Insertion, Progress, RowRefused
from pycrorm_async.store.dialects import dialect_of
from pycrorm_async.store.log import EventLog
from pycrorm_async.store.stored import Span, StoredEvent

__all__ = ["Folding", "FoldTarget", "FoldDefinition", "Batch", "Prepared", "TABLES"]

_REASON_LENGTH_MAX = 2_000
"""Characters of the reason that an episode is parked for: `status` shows it, and a value may be megabytes long."""
_SLICE_EVENTS = 100
"""So many are folded before others of the loop get their turn; some 0.4 ms."""


class FoldTarget(Growing, Protocol):
    """A generation that is folded into. Everything happens in the caller's transaction."""

    async def generation(self, connection: AsyncConnection, hold: Hold) -> Generation:
        """As it is now, and stays until the transaction ends."""
        ...

    async def advance(self, connection: AsyncConnection, steps: Sequence[Progress]) -> bool:
        """False if one of the episodes is not where it was believed to be: then nothing may be committed."""
        ...

    async def park(self, connection: AsyncConnection, number: int, reason: str) -> None: ...


class Batch(Protocol):
    """What a batch of events makes."""

    def fold(self, event: StoredEvent) -> None:
        """Raises `CannotFold`, and then has added nothing."""
        ...

    async def ready(self, engine: AsyncEngine, generation: int) -> None:
        """All is folded: makes ready what can be before a transaction, to be written into this generation."""
        ...

    async def write(self, connection: AsyncConnection, generation: int) -> None:
        """Raises `RowRefused`."""
        ...


class FoldDefinition(Protocol):
    """What events mean."""

    def learn(self, layout: Layout, payloads: Sequence[bytes]) -> tuple[Layout, Callable[[], Batch]]:
        """What these declarations make of the layout, and a maker of empty batches that knows them."""
        ...


@dataclass(frozen=True)
class _Folded:
    """A batch after the fold: its rows, ready for the generation of this number, (episode, folded before, folded now)
    of each episode, and why some stop."""

    rows: Batch
    number: int
    steps: list[Progress]
    parked: dict[int, str]


@dataclass(frozen=True)
class _Types:
    """What the declarations that were read make of the generation's layout."""

    payloads: list[bytes]
    revision: int
    layout: Layout
    batch: Callable[[], Batch]


@dataclass(frozen=True)
class Prepared:
    """A batch that is to be written."""

    spans: Sequence[Span]
    events: Sequence[StoredEvent]
    types: _Types
    done: _Folded

    @property
    def count(self) -> int:
        """How many events are folded in it."""
        return sum(now - before for _, before, now in self.done.steps)

    @property
    def is_whole(self) -> bool:
        """Whether nothing of it stays behind: no episode is parked."""
        return not self.done.parked

    @property
    def reached(self) -> dict[int, int]:
        """By number, how far the episodes are when it is written."""
        return {number: now for number, _, now in self.done.steps}


class _TableRows:
    """Those of our own tables. Implements `Batch`."""

    def __init__(self, designators: Designators) -> None:
        self._designators = designators
        self._rows = Rows()
        self._insertion: Insertion = None

    def fold(self, event: StoredEvent) -> None:
        fold(event, self._designators, self._rows)

    async def ready(self, engine: AsyncEngine, generation: int) -> None:
        self._insertion = await insertion_of(engine, self._rows, generation)

    async def write(self, connection: AsyncConnection, generation: int) -> None:
        await write_rows(connection, self._rows, self._insertion, generation)


class _Tables:
    """Our own tables. Implements `FoldDefinition`."""

    def learn(self, layout: Layout, payloads: Sequence[bytes]) -> tuple[Layout, Callable[[], Batch]]:
        layout, accepted, refused = unite(layout, payloads)
        designators = Designators(accepted, refused)
        return layout, lambda: _TableRows(designators)


TABLES = _Tables()


class Folding:
    """Folds events of one log into one goal. `generation` is how it was when last looked at."""

    def __init__(
        self, log: EventLog, goal: FoldTarget, generation: Generation, meaning: FoldDefinition = TABLES
    ) -> None:
        self._log = log
        self._goal = goal
        self._meaning = meaning
        self.generation = generation
        self._types: _Types | None = None

    async def batch(self, spans: Sequence[Span], events: Sequence[StoredEvent]) -> int:
        """How many of them are folded now: fewer if an episode was parked, none if somebody else was quicker.

        An event that is missing or cannot be folded parks its episode with the reason; what came before it is written,
        and the others go on.
        """
        return await self.write(await self.prepare(spans, events))

    async def prepare(self, spans: Sequence[Span], events: Sequence[StoredEvent]) -> Prepared:
        """The first half of it: writes nothing, and gives way to others of the loop from time to time."""
        types = await self._types_now()
        return Prepared(spans, events, types, await self._folded(spans, events, types))

    async def write(self, batch: Prepared) -> int:
        """The second half."""
        try:
            async with self._log.writing() as connection:
                found = await self._generation(connection, batch.done, batch.types)
                grown = found is not None and found.layout != batch.types.layout
                written = found if grown else await self._write(connection, batch.done, found)
                if written is None:
                    await connection.rollback()
                    return 0
            self.generation = written
            if grown:  # some tables are not there yet, or never will be: read and folded again with those that are
                return 0
        except RowRefused as refusal:
            return await self._apart(batch.spans, batch.events, refusal)
        return batch.count

    async def batch_in(self, connection: AsyncConnection, spans: Sequence[Span], events: Sequence[StoredEvent]) -> bool:
        """The same in the caller's transaction, which must not be committed if it says False or raises `RowRefused`."""
        types = await self._types_now()
        done = await self._folded(spans, events, types)
        generation = await self._generation(connection, done, types)
        if generation is not None and generation.layout != types.layout:
            return False
        return await self._write(connection, done, generation) is not None

    async def _folded(self, spans: Sequence[Span], events: Sequence[StoredEvent], types: _Types) -> _Folded:
        rows, number = types.batch(), self.generation.number
        steps, parked = await _fold_all(spans, events, rows)
        await rows.ready(self._log.engine, number)
        return _Folded(rows, number, steps, parked)

    async def _generation(self, connection: AsyncConnection, done: _Folded, types: _Types) -> Generation | None:
        """The generation to write to, grown by what was declared; None if it is not what the fold took it to be.

        Its layout is another than that of `types` if not all could be made.
        """
        growing = types.layout != self.generation.layout
        if growing:
            await dialect_of(connection).alone(connection)
        generation = await self._goal.generation(connection, "change" if growing else "share")
        if (generation.number, generation.revision) != (done.number, types.revision):
            self.generation = generation
            return None
        return await grow(connection, self._goal, generation, types.payloads) if growing else generation

    async def _write(
        self, connection: AsyncConnection, done: _Folded, generation: Generation | None
    ) -> Generation | None:
        """The generation written to; None if there is none, or the progress is not what the fold took it to be."""
        if generation is None or not await self._goal.advance(connection, done.steps):
            return None
        await done.rows.write(connection, generation.number)
        for number, reason in done.parked.items():
            await self._goal.park(connection, number, _writable(reason))
        return generation

    async def _types_now(self) -> _Types:
        """Read after the events: a declaration is stored before the first event that needs it."""
        payloads = await self._log.declarations()
        types = self._types
        if types is None or types.revision != self.generation.revision or types.payloads != payloads:
            layout, batch = self._meaning.learn(self.generation.layout, payloads)
            types = _Types(payloads, self.generation.revision, layout, batch)
            self._types = types
        return types

    async def _apart(self, spans: Sequence[Span], events: Sequence[StoredEvent], refusal: RowRefused) -> int:
        """The database refused a row of this batch: find the episode it belongs to, and park that one."""
        if len(spans) > 1:
            return sum([await self.batch([span], some) for span, some in _by_span(spans, events)])
        span = spans[0]
        if len(events) > 1:
            # Halves, so that all that comes before the event is shown.
            middle = len(events) // 2
            cut = events[middle - 1].sequence
            count = await self.batch([span._replace(last=cut)], events[:middle])
            return count + (await self.batch([span._replace(after=cut)], events[middle:]) if count == middle else 0)
        async with self._log.writing() as connection:
            reason = f"event {events[0].sequence}: the database refuses it: {refusal}"
            await self._goal.park(connection, events[0].number, _writable(reason))
        return 0


def _writable(reason: str) -> str:
    """The reason as every database takes it: it may name what a declaration or an event holds."""
    shown = reason[:_REASON_LENGTH_MAX] + ("…" if len(reason) > _REASON_LENGTH_MAX else "")
    return shown.encode(errors="backslashreplace").decode().replace("\0", "\\x00")


async def _fold_all(
    spans: Sequence[Span], events: Sequence[StoredEvent], rows: Batch
) -> tuple[list[Progress], dict[int, str]]:
    """The events of these spans, in their order, added to `rows`; how far that is, and why some episodes stop."""
    steps: list[Progress] = []
    parked: dict[int, str] = {}
    seen = 0
    for span, some in _by_span(spans, events):
        last = span.after
        for event in some:
            if event.sequence != last + 1:
                break
            seen += 1
            if seen % _SLICE_EVENTS == 0:
                await asyncio.sleep(0)
            try:
                rows.fold(event)
            except CannotFold as reason:
                parked[span.number] = f"event {event.sequence}: {reason}"
                break
            last = event.sequence
        if last < span.last and span.number not in parked:
            parked[span.number] = f"event {last + 1} is missing in the log"
        steps.append((span.number, span.after, last))
    return steps, parked


def _by_span(spans: Sequence[Span], events: Sequence[StoredEvent]) -> Iterator[tuple[Span, list[StoredEvent]]]:
    """Each span with its events, of which there may be none; one span an episode."""
    read = {number: list(some) for number, some in groupby(events, key=attrgetter("number"))}
    return ((span, read.get(span.number, [])) for span in spans)
