from __future__ import annotations

from collections.abc import AsyncIterator
from pathlib import Path

import pytest

from pycrorm_async.store.address import DatabaseAddress
from pycrorm_async.store.log import EventLog


@pytest.fixture
async def log(tmp_path: Path) -> AsyncIterator[EventLog]:
    opened = await EventLog.open(DatabaseAddress.parse(f"sqlite:///{tmp_path / 'memory.db'}"), create=True)
    yield opened
    await opened.close()
