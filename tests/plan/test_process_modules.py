"""Who carries motions out: chosen by `with`, for one context."""

from __future__ import annotations

import asyncio

import pytest

from pycrorm_async.errors import CallerError
from pycrorm_async.plan import (
    ChosenRobot,
    LookingMotion,
    MoveArmJointsMotion,
    MoveGripperMotion,
    MoveJointsMotion,
    MoveMotion,
    MoveTCPMotion,
    NavigateActionPerformable,
    NoRobotChosen,
    NoRobotHere,
    PlanFailure,
    TaskStatus,
    collected_tree,
    simulated_robot,
)
from pycrorm_async.plan.failures import GripperGoalNotReached
from pycrorm_async.world import Arms, BulletWorld, GripperState, Object, ObjectType, Pose, WorldMode
from pycrorm_async.world.errors import NoWorld
from tests.plan.conftest import Scene

THERE = Pose([0.6, 0.4, 0])


class Noting:
    """Process modules that write down what they are asked."""

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


async def test_a_motion_outside_of_any_choice_says_what_to_write() -> None:
    with collected_tree() as tree, pytest.raises(NoRobotChosen, match="with simulated_robot:") as caught:
        await NavigateActionPerformable(THERE).perform()
    assert isinstance(caught.value, CallerError)
    assert not isinstance(caught.value, PlanFailure)
    assert "MoveMotion" in str(caught.value)
    assert [node.status for node in tree] == [TaskStatus.ERROR, TaskStatus.ERROR]


async def test_without_a_world_or_a_robot_the_caller_is_told() -> None:
    with simulated_robot:
        with pytest.raises(NoWorld, match=r"the plan.*with BulletWorld"):
            await MoveMotion(THERE).perform()
        with BulletWorld(mode=WorldMode.DIRECT):
            with pytest.raises(NoRobotHere, match="no robot"):
                await MoveMotion(THERE).perform()
            Object("walle", ObjectType.ROBOT, '<robot name="walle"><link name="walle"/></robot>')
            with pytest.raises(NoRobotHere, match="'walle' is not of a kind"):
                await MoveMotion(THERE).perform()


async def test_a_choice_nests_and_ends_with_its_block_also_by_an_exception(scene: Scene) -> None:
    outer, inner = Noting(), Noting()
    with ChosenRobot("outer", outer):
        with pytest.raises(PlanFailure), ChosenRobot("inner", inner):
            await MoveGripperMotion(GripperState.OPEN, Arms.LEFT).perform()
        with ChosenRobot("inner", inner), simulated_robot:
            await MoveMotion(THERE).perform()
        await NavigateActionPerformable(THERE).perform()
    assert (outer.asked, inner.asked) == (["navigate"], ["move_gripper"])
    assert scene.robot.pose == THERE


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
