"""Fixtures with memories that several tests of queries only read."""

from __future__ import annotations

from collections.abc import AsyncIterator

import pytest

from pycrorm_async.query.reading import Reading
from pycrorm_async.store.postgresql import GRANTS
from tests.databases import change_each, run_in_own_loop
from tests.projections.event_script import append_and_fold
from tests.query.random_memory import EPISODES, TYPES
from tests.query.read_only_queries import RECORDS, SqlReader, is_sqlite, login, opened_reader


@pytest.fixture(scope="module")
def owner_url(module_database_url: str) -> str:
    """The URL of the owner of a memory with two episodes, on PostgreSQL a superuser who has made the roles."""
    run_in_own_loop(append_and_fold(module_database_url, RECORDS))
    if not is_sqlite(module_database_url):
        change_each(module_database_url, GRANTS)
    return module_database_url


@pytest.fixture(scope="module")
def reader_url(owner_url: str) -> str:
    """The URL of a login that can only read."""
    return owner_url if is_sqlite(owner_url) else login(owner_url, "IN ROLE pycrorm_reader")


@pytest.fixture
async def sql(reader_url: str) -> AsyncIterator[SqlReader]:
    async with opened_reader(reader_url) as opened:
        yield opened


@pytest.fixture(scope="module")
def filled_url(module_database_url: str) -> str:
    records = [*TYPES, *(record for each in EPISODES for record in each.records)]
    run_in_own_loop(append_and_fold(module_database_url, records))
    return module_database_url


@pytest.fixture
async def reading(filled_url: str) -> AsyncIterator[Reading]:
    async with Reading.open(filled_url) as opened:
        yield opened
