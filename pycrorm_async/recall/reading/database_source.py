"""Read the stored blocks of a memory."""

from __future__ import annotations

from collections.abc import Collection

from pycrorm_async.errors import DatabaseUnavailable, TablesOutdated
from pycrorm_async.projections.schema.generations import PROJECTION, read_generation
from pycrorm_async.query.reading import Reading
from pycrorm_async.recall.cases.case_projection import CaseProjection
from pycrorm_async.recall.cases.stored_blocks import read_blocks, read_headings
from pycrorm_async.recall.reading.case_reader import StoredBlocks

__all__ = ["DatabaseSource"]


class DatabaseSource:
    """The blocks in the tables of a memory. Implements `BlockSource`."""

    def __init__(self, reading: Reading) -> None:
        self._reading = reading

    async def read(self, generation: int, known: Collection[int]) -> StoredBlocks:
        """Return the blocks in one snapshot.

        Raises `DatabaseUnavailable` for a memory without a table of cases, `TablesOutdated` for one of another version,
        `DamageError` for a block whose bytes were changed.
        """
        log = await self._reading.log()
        async with log.snapshot() as connection:
            tables = await read_generation(connection, f"{PROJECTION}{CaseProjection.name}")
            if tables is None:
                raise DatabaseUnavailable(
                    f"{log.address} has no cases to recall yet (with Settings(recall=False) none are made): run"
                    " `pycrorm writer --once`"
                )
            if tables.version != CaseProjection.version:
                raise TablesOutdated(
                    f"{log.address}: its cases have version {tables.version} instead of {CaseProjection.version}: run"
                    f" `pycrorm rebuild {CaseProjection.name}`"
                )
            numbers = frozenset(each.number for each in await read_headings(connection, tables.number))
            wanted = numbers.difference(known if tables.number == generation else ())
            added = await read_blocks(connection, tables.number, sorted(wanted)) if wanted else {}
        return StoredBlocks(tables.number, numbers, added)
