from __future__ import annotations

from collections.abc import Iterator

import pytest

from pycrorm_async.world import BulletWorld
from tests.world.fakes import ChangeLog


@pytest.fixture
def world() -> Iterator[BulletWorld]:
    with BulletWorld() as entered:
        yield entered


@pytest.fixture
def change_log(world: BulletWorld) -> ChangeLog:
    """Return an observer that notes every change of `world`."""
    observer = ChangeLog()
    world.observe(observer)
    return observer
