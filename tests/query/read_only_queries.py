"""Run queries in SQL as a login that can only read."""

from __future__ import annotations

from collections.abc import AsyncIterator
from contextlib import asynccontextmanager
from functools import partial
from typing import Any
from urllib.parse import urlsplit

from pycrorm_async.query import sql as read_only_sql
from pycrorm_async.query.sql import DEFAULT_LIMITS, SqlLimits
from pycrorm_async.store.address import DatabaseAddress
from pycrorm_async.store.log import EventLog
from tests.databases import change_each
from tests.projections.event_script import NAVIGATE, PICK_UP, SAYING, declarations
from tests.query.test_reading import episode

RECORDS = [*declarations(NAVIGATE, PICK_UP, SAYING), *episode(1).records, *episode(2).records]
ENDLESS = "WITH RECURSIVE n(x) AS (SELECT 1 UNION ALL SELECT x + 1 FROM n) SELECT "


class SqlReader:
    """Runs queries on an open log."""

    def __init__(self, log: EventLog) -> None:
        self.is_sqlite = log.address.is_sqlite
        self.stream = partial(read_only_sql.stream, log)
        self._query = partial(read_only_sql.query, log)

    async def query(self, text: str, limits: SqlLimits = DEFAULT_LIMITS) -> tuple[tuple[str, ...], list[Any], bool]:
        result = await self._query(text, limits)
        return result.columns, result.rows, result.more


@asynccontextmanager
async def opened_reader(url: str) -> AsyncIterator[SqlReader]:
    log = await EventLog.open(DatabaseAddress.parse(url), create=False)
    yield SqlReader(log)
    await log.close()


def is_sqlite(url: str) -> bool:
    return url.startswith("sqlite")


def login(url: str, attributes: str, *after: str) -> str:
    """Return the URL of a new login with these attributes."""
    name = f"login-{next(_NUMBERS)}-of-{urlsplit(url).path.removeprefix('/')}"
    change_each(url, [f'CREATE ROLE "{name}" LOGIN {attributes}', *(each.format(name=f'"{name}"') for each in after)])
    return url.replace("postgres@", f"{name}@")


_NUMBERS = iter(range(1, 1_000))
