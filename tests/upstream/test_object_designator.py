"""PyCRAM's tests of object designators (July 2024), by name."""

from __future__ import annotations

import pytest

from pycrorm_async.plan import ObjectDesignatorDescription
from pycrorm_async.world import ObjectType, Pose
from tests.plan.conftest import Scene

pytestmark = pytest.mark.slow


def test_object_grounding(scene: Scene) -> None:
    designator = ObjectDesignatorDescription(["milk"], [ObjectType.MILK]).resolve()
    assert (designator.name, designator.object_type) == ("milk", ObjectType.MILK)
    assert designator.world_object is scene.milk


def test_frozen_copy(scene: Scene) -> None:
    designator = ObjectDesignatorDescription(["milk"], [ObjectType.MILK]).resolve()
    frozen = designator.frozen_copy()
    assert frozen.pose == designator.pose == Pose([1.3, 1, 0.9])
    scene.milk.set_pose(Pose([2, 2, 2]))
    assert (frozen.pose, designator.pose) == (Pose([1.3, 1, 0.9]), Pose([2, 2, 2]))
