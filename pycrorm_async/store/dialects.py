"""The kinds of database there are."""

from __future__ import annotations

from sqlalchemy.ext.asyncio import AsyncConnection, AsyncEngine

from pycrorm_async.store.dialect import Dialect
from pycrorm_async.store.postgresql.dialect import PostgreSQL
from pycrorm_async.store.sqlite.dialect import SQLite

__all__ = ["dialect_of"]

_DIALECTS: dict[str, Dialect] = {"sqlite": SQLite(), "postgresql": PostgreSQL()}


def dialect_of(place: AsyncConnection | AsyncEngine) -> Dialect:
    """That of a connection or an engine."""
    return _DIALECTS[place.dialect.name]
