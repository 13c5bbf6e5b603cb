"""A connection that also sees what was only thought through, while everybody else sees what really happened.

The database looks for a name among a connection's own, temporary views first. So this connection gets views of the
same names, users' views too, that leave out nothing; and it is closed when it is given back, with all of them.
"""

from __future__ import annotations

from collections.abc import AsyncIterator
from contextlib import asynccontextmanager

from sqlalchemy import Connection, Dialect
from sqlalchemy.ext.asyncio import AsyncConnection, AsyncEngine

from pycrorm_async.projections.generations import Generation
from pycrorm_async.projections.public import public_views
from pycrorm_async.projections.views import view_text
from pycrorm_async.store.dialects import dialect_of

__all__ = ["with_thoughts", "all_views"]


def all_views(generation: Generation, dialect: Dialect) -> dict[str, str]:
    """Name and SQL of every view there is, as it is without anything left out; a view stands on those before it."""
    meanings = public_views(generation.layout, generation.number, simulated=True)
    return {name: view_text(each, dialect) for name, each in meanings.items()} | generation.layout.user_views


@asynccontextmanager
async def with_thoughts(engine: AsyncEngine, views: dict[str, str]) -> AsyncIterator[AsyncConnection]:
    """A connection that sees these views in place of everybody's of the same names. No transaction is begun in it."""
    async with engine.connect() as connection:
        await dialect_of(connection).shadow_views(connection, views)
        await connection.run_sync(Connection.detach)  # it never goes back to the pool
        await connection.commit()
        yield connection
