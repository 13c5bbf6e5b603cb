"""Fold the log again for a custom projection and compare its tables, in parts of whole episodes."""

from __future__ import annotations

from collections.abc import Sequence

from sqlalchemy import text
from sqlalchemy.ext.asyncio import AsyncConnection

from pycrorm_async.events.ids import row_id_min
from pycrorm_async.projections.custom.packed_projection import PackedProjection
from pycrorm_async.projections.custom.projection import Projection
from pycrorm_async.projections.custom.projection_rows import CustomRows
from pycrorm_async.projections.custom.projection_tables import CustomFoldDefinition, fault_in_version, layout_of
from pycrorm_async.projections.run import checkpoints
from pycrorm_async.projections.run.batch_fold import Batch
from pycrorm_async.projections.schema.core_columns import OWN
from pycrorm_async.projections.schema.generations import Generation, projections_in, read_generations
from pycrorm_async.projections.verify.findings import VerifyResult
from pycrorm_async.projections.verify.parts import EpisodeRange, PartCheck, Place
from pycrorm_async.projections.verify.row_comparison import Comparison, Difference, Range
from pycrorm_async.store.dialects import dialect_of
from pycrorm_async.store.log import EventLog
from pycrorm_async.store.stored import Span, consecutive


def check_of(projection: Projection, result: VerifyResult) -> PartCheck:
    """Return the check of the tables of this projection."""
    return projection.check(result) if isinstance(projection, PackedProjection) else ProjectionCheck(projection, result)


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


class ProjectionCheck:
    """The check of the tables of one projection. Implements `PartCheck`; a part consists of whole episodes."""

    def __init__(self, projection: Projection, result: VerifyResult) -> None:
        self._projection = projection
        self.result = result
        name = projection.name
        self.missing_table = f"a table of the projection {name} is missing: run `pycrorm rebuild {name}`"

    async def comparison(self, connection: AsyncConnection) -> Comparison | None:
        generation = projections_in(await read_generations(connection)).get(self._projection.name)
        if generation is None or generation.version != self._projection.version:
            return None
        comparison = Comparison(generation, dialect_of(connection).stored_column, {})
        comparison.tables.append(self._place(generation))
        return comparison

    async def check(
        self, connection: AsyncConnection, comparison: Comparison, at: Place, within: EpisodeRange, limit: int
    ) -> Place | None:
        place = self._place(comparison.generation)
        folded = await _folded(connection, place, within._replace(first=at.number), limit)
        payloads = await dialect_of(connection).declarations(connection)
        _, batch = CustomFoldDefinition(self._projection).learn(comparison.generation.layout, payloads)
        rows = batch()
        findings: list[Difference] = []
        count = 0
        following = within.end
        for number, last in folded:
            if count >= limit:
                following = number
                break
            fault = await _fold_again(connection, rows, Span(number, 0, last), limit)
            count += last
            if fault is not None:
                sequence, reason = fault
                stored = "folded in the tables"
                findings.append(
                    Difference(number, sequence, self._projection.name, "fold", stored, f"parked: {reason}")
                )
        else:
            if len(folded) == limit:
                following = folded[-1][0] + 1
        lost = {each.number for each in findings}
        differences = await self.differences(connection, comparison, rows, EpisodeRange(at.number, following))
        for each in (*findings, *(each for each in differences if each.number not in lost)):
            self.result.add_difference(each._replace(table=each.table.removeprefix(OWN)))
        return None if following is None or following == within.end else Place(following)

    async def differences(
        self, connection: AsyncConnection, comparison: Comparison, rows: Batch, episodes: EpisodeRange
    ) -> Sequence[Difference]:
        """Compare the tables with the rows that the events of these episodes make; count the stored rows."""
        assert isinstance(rows, CustomRows)
        last = None if episodes.end is None else row_id_min(episodes.end)
        within = Range(row_id_min(episodes.first) or None, last, None, None)
        differences = await comparison.differences(connection, rows, within, carried=(), settled=())
        self.result.rows += comparison.count
        return differences

    def _place(self, generation: Generation) -> str:
        return checkpoints.place_of(generation.number, self._projection.name)


async def _folded(connection: AsyncConnection, place: str, within: EpisodeRange, limit: int) -> list[tuple[int, int]]:
    """Return number and checkpoint of each episode."""
    rows = await connection.execute(
        text(f"SELECT id, folded FROM {place} WHERE id >= :first AND id < :end ORDER BY id LIMIT :limit"),  # noqa: S608
        {**within.limits, "limit": limit},
    )
    return [(each.id, each.folded) for each in rows]


async def _fold_again(connection: AsyncConnection, rows: Batch, span: Span, limit: int) -> tuple[int, str] | None:
    """Fold an episode again; return the first event that cannot be folded, with the reason."""
    for after in range(0, span.last, limit):
        page = Span(span.number, after, min(after + limit, span.last))
        whole = consecutive(await dialect_of(connection).spans(connection, [page]), after)
        if whole and (refused := rows.fold(whole)) is not None:
            return refused
        if after + len(whole) < page.last:
            return after + len(whole) + 1, "it is missing in the log"
    return None
