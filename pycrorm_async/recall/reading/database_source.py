"""Read the stored blocks of a memory; one statement finds out whether any has changed."""

from __future__ import annotations

from collections.abc import Collection, Mapping
from contextlib import suppress
from typing import Any, Final

from sqlalchemy import Select

from pycrorm_async.errors import DatabaseUnavailable, PycrormError, TablesOutdated
from pycrorm_async.projections.schema.generations import PROJECTION, read_generation
from pycrorm_async.query.reading import Reading
from pycrorm_async.recall.cases.case_projection import CaseProjection
from pycrorm_async.recall.cases.stored_blocks import read_blocks, read_headings, select_numbers
from pycrorm_async.recall.reading.case_reader import StoredBlocks
from pycrorm_async.store.log import EventLog

_KEY: Final = f"{PROJECTION}{CaseProjection.name}"


class DatabaseSource:
    """The blocks in the tables of a memory. Implements `BlockSource`."""

    def __init__(self, reading: Reading) -> None:
        self._reading = reading
        self._numbers: tuple[int, Select[Any]] | None = None

    async def read(self, generation: int, block_numbers: Collection[int]) -> StoredBlocks:
        """Return the blocks in one snapshot.

        Raises `DatabaseUnavailable` for a memory without a table of cases, `TablesOutdated` for one of another version,
        `DamageError` for a block whose bytes were changed.
        """
        log = await self._reading.log()
        if await self._is_unchanged(log, generation, block_numbers):
            return StoredBlocks(generation, frozenset(block_numbers), {})
        async with log.snapshot() as connection:
            tables = await read_generation(connection, _KEY)
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
            wanted = numbers.difference(block_numbers if tables.number == generation else ())
            added = await read_blocks(connection, tables.number, sorted(wanted)) if wanted else {}
        return StoredBlocks(tables.number, numbers, added)

    async def _is_unchanged(self, log: EventLog, generation: int, block_numbers: Collection[int]) -> bool:
        """Return whether this generation has exactly these blocks; False also if it was dropped."""
        if not block_numbers:
            return False
        if self._numbers is None or self._numbers[0] != generation:
            self._numbers = generation, select_numbers(_KEY, generation)
        with suppress(PycrormError):  # where a rebuild has dropped the table; another fault is met again
            async with log.reading() as connection:
                rows = (await connection.execute(self._numbers[1])).all()
            generations = {(number, version) for number, version, _ in rows}
            return generations == {(generation, CaseProjection.version)} and {block for _, _, block in rows} == {
                *block_numbers
            }
        return False

    async def present_names(self) -> Mapping[str, str]:
        """Return the present name of each declared type, by all its names."""
        return await self._reading.present_names()
