from __future__ import annotations

from collections.abc import Iterator

import pytest

from pycrorm_async.world import BulletWorld
from tests.world.fakes import Witness


@pytest.fixture
def world() -> Iterator[BulletWorld]:
    with BulletWorld() as entered:
        yield entered


@pytest.fixture
def witness(world: BulletWorld) -> Witness:
    """Told of all that happens in `world`."""
    observer = Witness()
    world.observe(observer)
    return observer
