"""Provide one small live queue to a test, released afterwards."""

from collections.abc import Iterator
from pathlib import Path

import pytest

from pycrorm_async.queue import RecorderQueue
from tests.queue.factories import make


@pytest.fixture
def spool(tmp_path: Path) -> Path:
    return tmp_path / "memory.db.spool"


@pytest.fixture
def queue(spool: Path) -> Iterator[RecorderQueue]:
    queue = make(spool)
    yield queue
    queue.release()
