"""Fixtures with a recorder's folder in one spool: of a live queue, drained here or elsewhere, or of a dead recorder."""

from collections.abc import Iterator
from pathlib import Path

import pytest

from pycrorm_async.clock import SYSTEM_CLOCK
from pycrorm_async.queue import RecorderQueue
from tests.queue.factories import SLOW, FolderWriter, make


@pytest.fixture
def spool(tmp_path: Path) -> Path:
    return tmp_path / "memory.db.spool"


@pytest.fixture
def queue(spool: Path) -> Iterator[RecorderQueue]:
    queue = make(spool)
    yield queue
    queue.release()


@pytest.fixture
def unsynced(spool: Path) -> Iterator[RecorderQueue]:
    """Return a queue that syncs only when it is asked to."""
    queue = make(spool, settings=SLOW)
    yield queue
    queue.release()


@pytest.fixture
def offered(spool: Path) -> Iterator[RecorderQueue]:
    queue = make(spool, clock=SYSTEM_CLOCK, offered=True)
    yield queue
    queue.release()


@pytest.fixture
def author(spool: Path) -> FolderWriter:
    return FolderWriter(spool)
