from __future__ import annotations

from collections.abc import AsyncIterator

import pytest

from pycrorm_async.store.address import DatabaseAddress
from pycrorm_async.store.log import EventLog


@pytest.fixture
async def log(database_url: str) -> AsyncIterator[EventLog]:
    """Open a log on each kind of database."""
    opened = await EventLog.open(DatabaseAddress.parse(database_url), create=True)
    yield opened
    await opened.close()
