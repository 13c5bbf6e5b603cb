"""A connection that sees other views than everybody: its own, temporary ones, which a database looks for first."""

from __future__ import annotations

from collections.abc import AsyncIterator, Mapping
from contextlib import asynccontextmanager

from sqlalchemy.ext.asyncio import AsyncConnection, AsyncEngine

from pycrorm_async.projections.schema.generations import Generation, all_noted, projections_in, view_texts_of
from pycrorm_async.store.dialects import dialect_of

__all__ = ["with_views", "all_views"]


@asynccontextmanager
async def with_views(engine: AsyncEngine, views: Mapping[str, str]) -> AsyncIterator[AsyncConnection]:
    """A connection that sees these views in place of everybody's of the same names. No transaction is begun in it.

    A view may stand on those before it. The connection is closed with all of them when it is given back.
    """
    async with engine.connect() as connection:
        await dialect_of(connection).shadow_views(connection, views)
        await connection.commit()
        try:
            yield connection
        finally:
            await connection.invalidate()  # it never goes back to the pool


async def all_views(connection: AsyncConnection, generation: Generation) -> dict[str, str]:
    """Name and SQL of every view there is, as it is without anything left out; a view stands on those before it."""
    projections = projections_in(await all_noted(connection))
    return view_texts_of(connection, generation, projections, simulated=True)
