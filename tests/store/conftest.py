"""Fixtures for logs: `log` runs a test on both kinds of database, `file_log` on SQLite alone."""

from __future__ import annotations

from collections.abc import AsyncIterator
from pathlib import Path

import pytest

from pycrorm_async.store.address import DatabaseAddress
from pycrorm_async.store.log import EventLog


def pytest_itemcollected(item: pytest.Item) -> None:
    """Let each test of this folder make its log."""
    item.add_marker(pytest.mark.empty_database)


@pytest.fixture
def address(database_url: str) -> DatabaseAddress:
    return DatabaseAddress.parse(database_url)


@pytest.fixture
async def log(address: DatabaseAddress) -> AsyncIterator[EventLog]:
    opened = await EventLog.open(address, create=True)
    yield opened
    await opened.close()


@pytest.fixture
def file_address(tmp_path: Path) -> DatabaseAddress:
    return DatabaseAddress.parse(f"sqlite:///{tmp_path / 'memory.db'}")


@pytest.fixture
async def file_log(file_address: DatabaseAddress) -> AsyncIterator[EventLog]:
    opened = await EventLog.open(file_address, create=True)
    yield opened
    await opened.close()
