"""The thesis' scene, in a real Bullet world without a window."""

from __future__ import annotations

from collections.abc import Iterator
from contextlib import contextmanager
from typing import NamedTuple

import pytest

from pycrorm_async.plan import simulated_robot
from pycrorm_async.world import BulletWorld, Object, ObjectType, Pose, WorldMode


class Scene(NamedTuple):
    world: BulletWorld
    robot: Object
    kitchen: Object
    milk: Object
    cereal: Object


@contextmanager
def kitchen() -> Iterator[Scene]:
    """Robot at the origin, kitchen, milk and cereal on its counter; the simulated robot performs motions."""
    with BulletWorld(mode=WorldMode.DIRECT) as world, simulated_robot:
        yield Scene(
            world,
            Object("pr2", ObjectType.ROBOT),
            Object("kitchen", ObjectType.ENVIRONMENT),
            Object("milk", ObjectType.MILK, pose=Pose([1.3, 1, 0.9])),
            Object("cereal", ObjectType.BREAKFAST_CEREAL, pose=Pose([1.3, 0.7, 0.95])),
        )


@pytest.fixture
def scene() -> Iterator[Scene]:
    """The kitchen, for the whole of a test."""
    with kitchen() as kitchen_scene:
        yield kitchen_scene
