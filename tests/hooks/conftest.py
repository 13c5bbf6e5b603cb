"""Provide a recorder that samples the state of a PR2 in a world."""

from __future__ import annotations

from collections.abc import Iterator

import pytest

from pycrorm_async.plan import simulated_robot
from pycrorm_async.world import BulletWorld, Object, ObjectType
from tests.hooks.fakes import RecorderCase, recorder_case
from tests.hooks.sampled_motions import SAMPLED


@pytest.fixture
def case() -> Iterator[RecorderCase]:
    with recorder_case(SAMPLED) as sampled_case, BulletWorld(), simulated_robot:
        Object("pr2", ObjectType.ROBOT)
        yield sampled_case
