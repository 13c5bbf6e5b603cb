"""The robot that performs motions: chosen by `with`, for one context."""

from __future__ import annotations

import asyncio

import pytest

from pycrorm_async.errors import CallerError
from pycrorm_async.plan import (
    AccessingMotion,
    ChosenRobot,
    ClosingMotion,
    CostmapLocation,
    DetectingMotion,
    IKError,
    LookingMotion,
    MoveArmJointsMotion,
    MoveGripperMotion,
    MoveJointsMotion,
    MoveMotion,
    MoveTCPMotion,
    NavigateActionPerformable,
    NoRobotChosen,
    NoRobotHere,
    ObjectPart,
    OpeningMotion,
    PlanFailure,
    TaskStatus,
    WorldStateDetectingMotion,
    collected_tree,
    simulated_robot,
    simulated_robot_within,
)
from pycrorm_async.plan.failures import (
    CapabilityAbsenceFailure,
    GripperGoalNotReached,
    ManipulationGoalInCollision,
    ReachabilityFailure,
)
from pycrorm_async.world import Arms, BulletWorld, GripperState, Limits, Object, ObjectType, Pose, WorldMode
from pycrorm_async.world.pose import NoWorld
from tests.plan.conftest import Scene

THERE = Pose([0.6, 0.4, 0])


class Noting:
    """Process modules that note their requests."""

    def __init__(self) -> None:
        self.asked: list[str] = []

    async def navigate(self, motion: MoveMotion) -> None:
        self.asked.append("navigate")

    async def move_tcp(self, motion: MoveTCPMotion) -> None:
        self.asked.append("move_tcp")

    async def looking(self, motion: LookingMotion) -> None:
        self.asked.append("looking")

    async def move_gripper(self, motion: MoveGripperMotion) -> None:
        self.asked.append("move_gripper")
        raise GripperGoalNotReached

    async def move_arm_joints(self, motion: MoveArmJointsMotion) -> None:
        self.asked.append("move_arm_joints")

    async def move_joints(self, motion: MoveJointsMotion) -> None:
        self.asked.append("move_joints")


async def test_a_motion_without_a_chosen_robot_names_the_remedy() -> None:
    with collected_tree() as tree, pytest.raises(NoRobotChosen, match="with simulated_robot:") as caught:
        await NavigateActionPerformable(THERE).perform()
    assert isinstance(caught.value, CallerError)
    assert not isinstance(caught.value, PlanFailure)
    assert "MoveMotion" in str(caught.value)
    assert [node.status for node in tree] == [TaskStatus.ERROR, TaskStatus.ERROR]


async def test_without_a_world_or_a_robot_an_error_is_raised() -> None:
    with simulated_robot:
        with pytest.raises(NoWorld, match=r"the plan.*with BulletWorld"):
            await MoveMotion(THERE).perform()
        with BulletWorld(mode=WorldMode.DIRECT):
            with pytest.raises(NoRobotHere, match="no robot"):
                await MoveMotion(THERE).perform()
            Object("walle", ObjectType.ROBOT, '<robot name="walle"><link name="walle"/></robot>')
            with pytest.raises(NoRobotHere, match="no robot description is registered for the robot 'walle'"):
                await MoveMotion(THERE).perform()


async def test_within_hard_limits_an_arm_reaches_what_soft_limits_forbid(scene: Scene) -> None:
    """0.7195 m from the shoulder's lift axis to the wrist: elbow at -0.15 rad 0.7190 m, stretched 0.7210 m."""
    stretched = MoveTCPMotion(Pose([0.9495, 0.188, 0.790675]), Arms.LEFT)
    with simulated_robot_within(Limits.HARD):
        with simulated_robot_within(Limits.SOFT), pytest.raises(IKError, match="too far"):
            await stretched.perform()
        assert not any(scene.robot.joint_positions().values())
        await stretched.perform()
    assert scene.robot.link_pose("l_gripper_tool_frame").distance(stretched.target) < 1e-6
    assert -0.15 < scene.robot.joint_position("l_elbow_flex_joint") <= 0
    with pytest.raises(IKError, match="too far"):
        await stretched.perform()


@pytest.mark.slow
async def test_locations_are_resolved_within_the_limits_of_the_chosen_robot(scene: Scene) -> None:
    """From above at 0.6 m with the torso down: not within soft limits."""
    from_above = Pose([0, 3, 0.6], [0, 1, 0, 1])
    location = CostmapLocation(from_above, reachable_for=scene.robot)
    with pytest.raises(ReachabilityFailure):
        location.resolve()
    with simulated_robot_within(Limits.HARD):
        stands = list(location)
        assert len(stands) > 50
        for stand in stands:
            await MoveMotion(stand.pose).perform()
            for arm in stand.reachable_arms:
                await MoveTCPMotion(from_above, arm).perform()


async def test_choices_nest_and_end_with_their_block_even_by_an_exception(scene: Scene) -> None:
    outer, inner = Noting(), Noting()
    with ChosenRobot("outer", outer):
        with pytest.raises(PlanFailure), ChosenRobot("inner", inner):
            await MoveGripperMotion(GripperState.OPEN, Arms.LEFT).perform()
        with ChosenRobot("inner", inner), simulated_robot:
            await MoveMotion(THERE).perform()
        await NavigateActionPerformable(THERE).perform()
    assert (outer.asked, inner.asked) == (["navigate"], ["move_gripper"])
    assert scene.robot.pose == THERE


async def test_a_robot_written_before_a_motion_existed_refuses_it_with_that_reason(scene: Scene) -> None:
    part, noting = ObjectPart("fridge_door_handle", scene.kitchen), Noting()
    motions = {
        "open": OpeningMotion(part, Arms.LEFT),
        "close": ClosingMotion(part, Arms.LEFT),
        "accessing": AccessingMotion(scene.kitchen, Arms.LEFT, "gripper", "joint", "handle", 0.1),
        "detecting": DetectingMotion(ObjectType.MILK),
        "world_state_detecting": WorldStateDetectingMotion(ObjectType.MILK),
    }
    before = scene.world.save_state()
    with ChosenRobot("old", noting):
        for module, motion in motions.items():
            name = type(motion).__name__
            with collected_tree() as tree, pytest.raises(CapabilityAbsenceFailure) as caught:
                await motion.perform()
            assert caught.value.message == f"the old robot cannot do {name}: Noting has no method {module!r}"
            assert caught.value.data == ("old", name)
            assert [node.status for node in tree] == [TaskStatus.FAILED]
    assert (scene.world.save_state(), noting.asked) == (before, [])


async def test_a_choice_belongs_to_its_context() -> None:
    async def alone(name: str, modules: Noting) -> None:
        with ChosenRobot(name, modules):
            await both_inside.wait()
            await MoveMotion(THERE).perform()
            await both_inside.wait()

    both_inside = asyncio.Barrier(2)
    a, b = Noting(), Noting()
    await asyncio.gather(alone("a", a), alone("b", b))
    assert (a.asked, b.asked) == (["navigate"], ["navigate"])
    with pytest.raises(NoRobotChosen):
        await MoveMotion(THERE).perform()


async def test_a_hand_that_checks_collisions_fails_where_its_arm_would_collide_and_stays_in_place(
    scene: Scene,
) -> None:
    goal = Pose([1.25, 0.4, 0.86])  # over the worktop by less than half a forearm
    await NavigateActionPerformable(Pose([0.62, 0.2, 0])).perform()
    before = scene.robot.joint_positions()
    with simulated_robot_within(Limits.SOFT, collisions=True) as robot:
        assert repr(robot) == "<simulated (soft limits, minding collisions) robot>"
        with pytest.raises(ManipulationGoalInCollision, match="LEFT arm would be in kitchen") as failed:
            await MoveTCPMotion(goal, Arms.LEFT).perform()
    part, obstacle = failed.value.data
    assert obstacle == "kitchen"
    assert part in scene.robot.links
    assert scene.robot.joint_positions() == before
    await MoveTCPMotion(goal, Arms.LEFT).perform()  # the others do not check
    assert scene.robot.joint_positions() != before
