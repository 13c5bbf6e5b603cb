"""The parts of the robot that each built-in designator requires."""

from __future__ import annotations

from dataclasses import dataclass, field

import pytest

from pycrorm_async.plan import (
    ActionAbstract,
    Designator,
    DetectActionPerformable,
    FaceAtPerformable,
    GripActionPerformable,
    LookingMotion,
    MoveAndPickUpPerformable,
    MoveArmJointsMotion,
    MoveGripperMotion,
    MoveJointsMotion,
    MoveMotion,
    MoveTCPMotion,
    MoveTorsoActionPerformable,
    NavigateActionPerformable,
    ObjectPart,
    OpenActionPerformable,
    ParkArmsActionPerformable,
    PickUpActionPerformable,
    PlaceActionPerformable,
    SetGripperActionPerformable,
    TransportActionPerformable,
)
from pycrorm_async.plan.failures import Resource, ResourcesNotAMethod
from pycrorm_async.world import Arms, Grasp, GripperState, Pose
from tests.plan.conftest import Scene

THERE = Pose([1, 0, 0])
LEFT, RIGHT, BASE, TORSO, HEAD = (
    Resource.LEFT_ARM,
    Resource.RIGHT_ARM,
    Resource.BASE,
    Resource.TORSO,
    Resource.HEAD,
)


def needs(designator: Designator) -> set[Resource]:
    return set(designator.resources())


def test_a_motion_of_one_part_requires_that_part() -> None:
    assert needs(MoveMotion(THERE)) == needs(NavigateActionPerformable(THERE)) == {BASE}
    assert needs(LookingMotion(THERE)) == {HEAD}
    assert needs(MoveGripperMotion(GripperState.OPEN, Arms.RIGHT)) == {RIGHT}
    assert needs(SetGripperActionPerformable(Arms.LEFT, GripperState.OPEN)) == {LEFT}
    assert needs(ParkArmsActionPerformable(Arms.BOTH)) == {LEFT, RIGHT}
    assert needs(MoveTorsoActionPerformable(0.2)) == {TORSO}
    assert needs(MoveArmJointsMotion({"l_elbow_flex_joint": -1.0})) == {LEFT}
    assert needs(MoveArmJointsMotion(None, {"r_elbow_flex_joint": -1.0})) == {RIGHT}
    assert needs(FaceAtPerformable(THERE)) == {BASE, HEAD}


def test_a_reach_for_a_pose_in_the_map_requires_the_robot_to_stand_still(scene: Scene) -> None:
    handle = ObjectPart("sink_area_drawer_handle", scene.kitchen)
    assert needs(MoveTCPMotion(THERE, Arms.LEFT)) == {LEFT, BASE, TORSO}
    assert needs(PickUpActionPerformable(scene.milk, Arms.RIGHT, Grasp.FRONT)) == {RIGHT, BASE, TORSO}
    assert needs(PlaceActionPerformable(scene.milk, Arms.RIGHT, THERE)) == {RIGHT, BASE, TORSO}
    assert needs(GripActionPerformable(Arms.LEFT, scene.milk, 1.0)) == {LEFT, BASE, TORSO}
    assert needs(OpenActionPerformable(handle, Arms.LEFT)) == {LEFT, BASE, TORSO}
    assert needs(MoveAndPickUpPerformable(THERE, scene.milk, Arms.LEFT, Grasp.TOP)) == {LEFT, BASE, TORSO, HEAD}
    assert needs(TransportActionPerformable(scene.milk, Arms.LEFT, THERE)) == {LEFT, RIGHT, BASE, TORSO}
    assert needs(DetectActionPerformable(scene.milk)) == {HEAD}


def test_joints_by_name_require_the_parts_they_belong_to(scene: Scene) -> None:
    names = ["torso_lift_joint", "head_pan_joint", "r_elbow_flex_joint", "l_gripper_l_finger_joint", "no_such_joint"]
    assert needs(MoveJointsMotion(names, [0.0] * 5)) == {TORSO, HEAD, RIGHT, LEFT}
    assert needs(MoveJointsMotion(["no_such_joint"], [0.0])) == set()


def test_unknown_joints_require_nothing() -> None:
    assert needs(MoveJointsMotion(["torso_lift_joint"], [0.0])) == set()


def test_a_users_action_requires_nothing_by_default() -> None:
    class Thinking(ActionAbstract):
        async def perform(self) -> None: ...

    assert needs(Thinking()) == set()


def test_a_field_with_the_name_of_the_method_is_refused_when_the_class_is_made() -> None:
    with pytest.raises(ResourcesNotAMethod, match=r"Cooking\.resources must be a method that returns a frozenset"):

        @dataclass
        class Cooking(ActionAbstract):
            resources: list[str] = field(default_factory=list)  # type: ignore[assignment]  # what is refused

            async def perform(self) -> None: ...
