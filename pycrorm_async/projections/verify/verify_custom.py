"""Fold the log again for a custom projection and compare its tables, in parts of whole episodes."""

from __future__ import annotations

from collections.abc import AsyncIterator, Sequence
from typing import NamedTuple

from sqlalchemy import text
from sqlalchemy.ext.asyncio import AsyncConnection

from pycrorm_async.errors import DatabaseForeign
from pycrorm_async.events.ids import EPISODE_NUMBER_MAX
from pycrorm_async.projections.custom.projection import Projection
from pycrorm_async.projections.custom.projection_rows import CustomRows
from pycrorm_async.projections.custom.projection_tables import CustomFoldDefinition, fault_in_version, layout_of
from pycrorm_async.projections.fold.fold import CannotFold
from pycrorm_async.projections.run import checkpoints
from pycrorm_async.projections.run.batch_fold import Batch
from pycrorm_async.projections.schema.generations import Generation, projections_in, read_generations
from pycrorm_async.projections.schema.tables import OWN
from pycrorm_async.projections.verify.row_comparison import Comparison, Difference, Range
from pycrorm_async.store.dialects import dialect_of
from pycrorm_async.store.log import EventLog
from pycrorm_async.store.stored import Span

__all__ = ["PartComparison", "compare_projection", "uncompared_projections"]

_PART_EVENTS = 4_000
_EPISODES_MAX = 400
_ATTEMPTS = 10


class PartComparison(NamedTuple):
    """The result for some episodes: the number of rows compared, and the differences."""

    rows: int
    differences: list[Difference]


async def uncompared_projections(log: EventLog, projections: Sequence[Projection]) -> dict[str, str]:
    """Return the projections of this memory that cannot be compared, by name, with the reasons."""
    by_name = {each.name: each for each in projections}
    async with log.snapshot() as connection:
        generations = projections_in(await read_generations(connection))
        dialect = connection.dialect
    reasons: dict[str, str] = {}
    for name, each in generations.items():
        fault = "its code is not installed here"
        if name in by_name:
            fault = fault_in_version(by_name[name], each, layout_of(by_name[name], dialect)) or ""
        if fault:
            reasons[name] = fault
    return reasons


async def compare_projection(
    log: EventLog, projection: Projection, *, first: int = 0, end: int | None = None
) -> AsyncIterator[PartComparison]:
    """Yield the comparison of the episodes with numbers from `first` up to but not including `end`, part by part.

    Yields one empty part if the projection has no tables yet. Raises `DatabaseForeign` if a table is missing.
    """
    at: int | None = first
    while at is not None:
        at, part = await _part(log, projection, at, end)
        yield part


async def _part(
    log: EventLog, projection: Projection, first: int, end: int | None
) -> tuple[int | None, PartComparison]:
    for _ in range(_ATTEMPTS):
        async with log.snapshot() as connection:
            generation = projections_in(await read_generations(connection)).get(projection.name)
            if generation is None or generation.version != projection.version:
                return None, PartComparison(0, [])
            comparison = Comparison(generation, dialect_of(connection).stored_column, {})
            place = checkpoints.place_of(generation.number, projection.name)
            if await dialect_of(connection).keep(connection, [*comparison.tables, place]):
                return await _look(connection, projection, comparison, first, end)
        # A rebuild replaced and dropped the tables between two statements: read the generation again.
    raise DatabaseForeign(
        f"{log.address}: a table of the projection {projection.name} is missing:"
        f" run `pycrorm rebuild {projection.name}`"
    )


async def _look(
    connection: AsyncConnection, projection: Projection, comparison: Comparison, first: int, end: int | None
) -> tuple[int | None, PartComparison]:
    folded = await _folded(connection, projection, comparison.generation, first, end)
    payloads = await dialect_of(connection).declarations(connection)
    _, batch = CustomFoldDefinition(projection).learn(comparison.generation.layout, payloads)
    rows = batch()
    assert isinstance(rows, CustomRows)
    findings: list[Difference] = []
    count = 0
    following = end
    for number, last in folded:
        if count >= _PART_EVENTS:
            following = number
            break
        fault = await _fold_again(connection, rows, number, last)
        count += last
        if fault is not None:
            sequence, reason = fault
            stored = "folded in the tables"
            findings.append(Difference(number, sequence, projection.name, "fold", stored, f"parked: {reason}"))
    else:
        if len(folded) == _EPISODES_MAX:
            following = folded[-1][0] + 1
    lost = {each.number for each in findings}
    within = Range(first << 31 or None, None if following is None else following << 31, None, None)
    differences = await comparison.differences(connection, rows, within, carried=(), settled=())
    findings += [each._replace(table=each.table.removeprefix(OWN)) for each in differences if each.number not in lost]
    return None if following == end else following, PartComparison(comparison.count, findings)


async def _folded(
    connection: AsyncConnection, projection: Projection, generation: Generation, first: int, end: int | None
) -> list[tuple[int, int]]:
    """Return number and checkpoint of each episode."""
    place = checkpoints.place_of(generation.number, projection.name)
    rows = await connection.execute(
        text(
            f"SELECT id, folded FROM {place} WHERE id >= :first AND id < :end ORDER BY id LIMIT {_EPISODES_MAX}"  # noqa: S608
        ),
        {"first": first, "end": EPISODE_NUMBER_MAX + 1 if end is None else end},
    )
    return [(each.id, each.folded) for each in rows]


async def _fold_again(connection: AsyncConnection, rows: Batch, number: int, last: int) -> tuple[int, str] | None:
    """Fold an episode up to event `last`; return the first event that cannot be folded, with the reason."""
    for after in range(0, last, _PART_EVENTS):
        page = Span(number, after, min(after + _PART_EVENTS, last))
        sequence = after
        for event in await dialect_of(connection).spans(connection, [page]):
            sequence += 1
            if event.sequence != sequence:
                break
            try:
                rows.fold(event)
            except CannotFold as reason:
                return sequence, str(reason)
        else:
            if sequence == page.last:
                continue
            sequence += 1
        return sequence, "it is missing in the log"
    return None
