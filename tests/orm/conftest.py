"""Fixtures with the episode of `recorded_breakfast`, recorded once for all tests of a module."""

from __future__ import annotations

from collections.abc import AsyncIterator

import pytest

from pycrorm_async.store.address import DatabaseAddress
from pycrorm_async.store.log import EventLog
from tests.databases import run_in_own_loop
from tests.orm.recorded_breakfast import fill


@pytest.fixture(scope="module")
def filled_url(module_database_url: str) -> str:
    run_in_own_loop(fill(module_database_url))
    return module_database_url


@pytest.fixture
async def breakfast(filled_url: str) -> AsyncIterator[EventLog]:
    """The log of that episode, open for reading."""
    log = await EventLog.open(DatabaseAddress.parse(filled_url), create=False)
    yield log
    await log.close()
