"""Find the dialect of a connection or an engine."""

from functools import cache

from sqlalchemy.ext.asyncio import AsyncConnection, AsyncEngine

from pycrorm_async.errors import InternalError
from pycrorm_async.store.dialect import Dialect


def dialect_of(place: AsyncConnection | AsyncEngine) -> Dialect:
    """Return the dialect of a connection or an engine."""
    return _dialect(place.dialect.name)


@cache
def _dialect(name: str) -> Dialect:
    # Imported on demand: the server's driver takes a tenth of a second to import.
    match name:
        case "sqlite":
            from pycrorm_async.store.sqlite import SQLite

            return SQLite()
        case "postgresql":
            from pycrorm_async.store.postgresql import PostgreSQL

            return PostgreSQL()
    raise InternalError(f"there is no dialect for {name}")
