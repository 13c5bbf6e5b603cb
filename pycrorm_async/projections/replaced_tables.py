"""Drop the tables of generations that a rebuild has replaced, in slices, while queries may still read them."""

from __future__ import annotations

import asyncio

from sqlalchemy.ext.asyncio import AsyncConnection

from pycrorm_async.errors import DatabaseForeign
from pycrorm_async.projections.run import checkpoints
from pycrorm_async.projections.schema.core_columns import CORE, OF_NO_EPISODE
from pycrorm_async.projections.schema.generations import (
    PROJECTION,
    PROJECTION_VERSION,
    SHOWN,
    Generation,
    delete_generation,
    read_generations,
)
from pycrorm_async.projections.schema.materialised_views import materialised_tables
from pycrorm_async.projections.table_names import physical_name
from pycrorm_async.store.dialects import dialect_of
from pycrorm_async.store.log import EventLog

REPLACED = "/gone/"
"""Separates owner and number in the key of a replaced generation."""
_SLICE_ROWS = 10_000
"""Bounds the rows of a replaced table that one transaction deletes."""
_PAUSE_S = 0.02
"""The pause between two slices. SQLite connections poll for the write lock and would never find it free otherwise."""
_DROP_PAUSES_S = (0.0, 0.1, 0.2, 0.4, 0.8, 1.6, 3.2)
"""The pauses before the attempts to drop a table, in which queries that began before the switch end."""


async def clear(log: EventLog) -> list[str]:
    """Empty and drop replaced tables in slices; return the names of tables that are still in use and were left."""
    left: list[str] = []
    with log.translated():
        async with log.reading() as connection:
            generations = await readable_generations(log, connection)
        await _sweep(log)
        for key, generation in generations.items():
            if key == SHOWN:
                await _drop(log, checkpoints.place_of(generation.number))
            owner, separator, _ = key.partition(REPLACED)
            if not separator:
                continue
            is_built_in = owner == SHOWN
            tables = [
                *(CORE | OF_NO_EPISODE if is_built_in else ()),
                *generation.layout.leaves,
                *materialised_tables(generation.layout),
                checkpoints.TABLE if is_built_in else f"{checkpoints.TABLE}_{owner.removeprefix(PROJECTION)}",
            ]
            named = [physical_name(each, generation.number) for each in tables]
            in_use = await _drop_all(log, named)
            left += in_use
            if not in_use:
                async with log.engine.begin() as connection:
                    await delete_generation(connection, key)
    return left


async def readable_generations(log: EventLog, connection: AsyncConnection) -> dict[str, Generation]:
    """Read all generations. Raises `DatabaseForeign` if a newer version made one, whose tables this one cannot list."""
    generations = await read_generations(connection)
    newest = max((each.version for key, each in generations.items() if not key.startswith(PROJECTION)), default=0)
    if newest > PROJECTION_VERSION:
        versions = f"there are tables made by version {newest} of the fold, this is version {PROJECTION_VERSION}"
        raise DatabaseForeign(f"{log.address}: {versions}: use a newer pycrorm")
    return generations


async def _sweep(log: EventLog) -> None:
    async with log.engine.begin() as connection:
        await dialect_of(connection).sweep(connection)


async def _drop_all(log: EventLog, tables: list[str]) -> list[str]:
    """Drop these tables; return those that stay in use after the last attempt."""
    for pause_s in _DROP_PAUSES_S:
        await asyncio.sleep(pause_s)
        await _sweep(log)  # drops replaced views first, because a table cannot be dropped before its views
        while tables and await _drop(log, tables[0]):
            tables = tables[1:]
        if not tables:
            return []
    return [each for each in tables if not await _drop(log, each)]


async def _drop(log: EventLog, table: str) -> bool:
    """Empty and drop this table if it exists; False if a query still reads it.

    A table of one slice costs one transaction: there are dozens, and most are empty.
    """
    dialect = dialect_of(log.engine)
    dropping = False
    try:
        while not dropping:
            async with log.engine.begin() as connection:
                if not await dialect.has_table(connection, table):
                    return True
                dropping = not await dialect.empty(connection, table, rows_max=_SLICE_ROWS)
                if dropping:
                    await dialect.drop(connection, table)
            if not dropping:
                await asyncio.sleep(_PAUSE_S)
    except dialect.faults:
        if not dropping:
            raise
        return False
    return True
