"""Fixtures with a spool, a daemon that drains it in the test's own loop, and a current folder for one test."""

from collections.abc import AsyncIterator
from contextlib import asynccontextmanager
from pathlib import Path

import pytest

from pycrorm_async import Settings
from tests.writer.running_writers import QUICKLY_SYNCED, Daemon, Start


@pytest.fixture
def spool(tmp_path: Path) -> Path:
    return tmp_path / "spool"


@pytest.fixture
def daemon(database_url: str, spool: Path) -> Start:
    @asynccontextmanager
    async def running(settings: Settings = QUICKLY_SYNCED) -> AsyncIterator[Daemon]:
        started = Daemon(database_url, spool, settings)
        yield started
        started.leave.set()
        await started.task

    return running
