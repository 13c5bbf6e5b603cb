"""Fixtures for pytest: a memory of its own for each test, and a clock that the test advances.

pytest_plugins = ["pycrorm_async.testing.fixtures"]


async def test_a_greeting_is_recorded(memory):
    async with memory.episode(description="test"):
        await GreetActionPerformable("Ada").perform()
    await memory.flush()
"""

from collections.abc import AsyncIterator
from pathlib import Path

import pytest
import pytest_asyncio

from pycrorm_async.memory import Memory
from pycrorm_async.settings import Settings
from pycrorm_async.testing.fake_clock import FakeClock

__all__ = ["clock", "memory"]


@pytest.fixture
def clock() -> FakeClock:
    """A clock for `Memory.open(url, clock=clock.clock)`."""
    return FakeClock()


@pytest_asyncio.fixture
async def memory(tmp_path: Path) -> AsyncIterator[Memory]:
    """An open memory in a new SQLite file. A value that cannot be recorded fails the test (`on_unrecordable`)."""
    settings = Settings(on_unrecordable="refuse")
    async with Memory.open(f"sqlite:///{tmp_path}/memory.db", settings=settings) as opened:
        yield opened
