"""Open a connection whose temporary views hide the public views of the same names."""

from __future__ import annotations

from collections.abc import AsyncIterator, Mapping
from contextlib import asynccontextmanager

from sqlalchemy.ext.asyncio import AsyncConnection, AsyncEngine

from pycrorm_async.projections.schema.generations import Generation, projections_in, read_generations, view_texts_of
from pycrorm_async.store.dialects import dialect_of


@asynccontextmanager
async def with_views(engine: AsyncEngine, views: Mapping[str, str]) -> AsyncIterator[AsyncConnection]:
    """Open a connection on which these views replace the public views of the same names, outside a transaction.

    A view may select from those before it. The connection is closed at the end and never returns to the pool.
    """
    async with engine.connect() as connection:
        await dialect_of(connection).shadow_views(connection, views)
        await connection.commit()
        try:
            yield connection
        finally:
            await connection.invalidate()  # in the pool it would keep its temporary views


async def all_views(connection: AsyncConnection, generation: Generation) -> dict[str, str]:
    """Return name and SQL of every view including simulations; a view may select from those before it."""
    projections = projections_in(await read_generations(connection))
    return view_texts_of(connection, generation, projections, simulated=True)
