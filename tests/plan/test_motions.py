"""The effect of each motion on a robot, and the robot that performs motions: chosen by `with`, for one context."""

from __future__ import annotations

import asyncio
import math

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
    ResolutionError,
    TaskStatus,
    WorldStateDetectingMotion,
    collected_tree,
    simulated_robot,
    simulated_robot_within,
)
from pycrorm_async.plan.failures import (
    CapabilityAbsenceFailure,
    ConfigurationNotReached,
    GripperGoalNotReached,
    ManipulationGoalInCollision,
    ReachabilityFailure,
    TorsoGoalUnreachable,
)
from pycrorm_async.world import Arms, BulletWorld, GripperState, Limits, Object, ObjectType, Pose, WorldMode
from pycrorm_async.world.pose import NoWorld, UnknownJoint, rotated, yaw_quaternion
from tests.plan.conftest import Scene
from tests.world.fakes import ChangeLog

# === motions ==================================================================================================
#
# The effect of each motion on the simulated robot, and its failures: complete or without effect.

LEFT_TOOL = "l_gripper_tool_frame"


class Watching(ChangeLog):
    """A log of changes in short."""

    @property
    def seen(self) -> list[str]:
        return [f"joints {len(note[2])}" if note[0] == "joints" else f"{note[0]} {note[1]}" for note in self.notes]


@pytest.fixture
def watching(scene: Scene) -> Watching:
    observer = Watching()
    scene.world.observe(observer)
    return observer


async def test_the_base_is_at_its_target(scene: Scene, watching: Watching) -> None:
    goal = Pose([0.6, 0.4, 0], yaw_quaternion(1.0))
    await MoveMotion(goal).perform()
    assert scene.robot.pose == goal
    assert watching.seen == ["moved pr2"]


async def test_the_tool_frame_is_at_its_target(scene: Scene, watching: Watching) -> None:
    goal = Pose([0.7, 0.3, 0.9], yaw_quaternion(0.3))
    await MoveTCPMotion(goal, Arms.LEFT).perform()
    reached = scene.robot.link_pose(LEFT_TOOL)
    assert reached.position == pytest.approx(goal.position, abs=1e-6)
    assert reached.orientation == pytest.approx(goal.orientation, abs=1e-6)
    assert watching.seen == ["joints 7"]


@pytest.mark.parametrize("grippers", [(Arms.LEFT, "l"), (Arms.RIGHT, "r"), (Arms.BOTH, "lr")])
async def test_a_gripper_opens_and_closes(scene: Scene, watching: Watching, grippers: tuple[Arms, str]) -> None:
    gripper, sides = grippers
    fingers = [f"{side}_gripper_{finger}_finger_joint" for side in sides for finger in "lr"]
    await MoveGripperMotion(GripperState.OPEN, gripper).perform()
    assert [scene.robot.joint_position(finger) for finger in fingers] == [0.548] * len(fingers)
    assert sum(map(bool, scene.robot.joint_positions().values())) == len(fingers)
    await MoveGripperMotion(GripperState.CLOSE, gripper).perform()
    assert not any(scene.robot.joint_positions().values())
    assert watching.seen == [f"joints {len(fingers)}"] * 2


async def test_both_arms_move_in_one_motion(scene: Scene, watching: Watching) -> None:
    await MoveArmJointsMotion({"l_shoulder_lift_joint": 0.1}, {"r_shoulder_lift_joint": 0.2}).perform()
    assert scene.robot.joint_position("l_shoulder_lift_joint") == 0.1
    assert scene.robot.joint_position("r_shoulder_lift_joint") == 0.2
    assert watching.seen == ["joints 2"]


async def test_joints_beyond_their_limits_are_plan_failures_and_move_nothing(scene: Scene, watching: Watching) -> None:
    with pytest.raises(TorsoGoalUnreachable, match="torso_lift_joint") as torso:
        await MoveJointsMotion(["torso_lift_joint"], [2.0]).perform()
    assert torso.value.data == (2.0,)
    with pytest.raises(ConfigurationNotReached, match="head_pan_joint") as head:
        await MoveJointsMotion(["torso_lift_joint", "head_pan_joint"], [0.1, 7.0]).perform()
    assert head.value.data == ({"torso_lift_joint": 0.1, "head_pan_joint": 7.0},)
    with pytest.raises(ConfigurationNotReached):
        await MoveArmJointsMotion({"l_elbow_flex_joint": 1.0}, None).perform()
    assert watching.seen == []


async def test_an_arm_is_moved_by_its_own_joints(scene: Scene, watching: Watching) -> None:
    for motion, arm in (
        (MoveArmJointsMotion(right_arm_poses={"l_elbow_flex_joint": -1.0}), "RIGHT"),
        (MoveArmJointsMotion({"torso_lift_joint": 0.1}), "LEFT"),
    ):
        with pytest.raises(UnknownJoint, match=f"'pr2, {arm} arm' has no movable joint"):
            await motion.perform()
    assert watching.seen == []


def test_each_joint_needs_one_position() -> None:
    with pytest.raises(ResolutionError, match="expected 2 values, one for each name, got 1"):
        MoveJointsMotion(["a", "b"], [1.0])
    with pytest.raises(ResolutionError, match="names: b, c more than once"):
        MoveJointsMotion(["c", "b", "a", "b", "c"], [1.0, 1.0, 1.0, 2.0, 2.0])


@pytest.mark.parametrize(
    ("base_yaw", "torso", "point"),
    [
        (0.0, 0.0, (1.3, 1.0, 0.9)),
        (0.0, 0.3, (1.3, -1.0, 0.9)),
        (2.0, 0.1, (-1.0, 2.0, 1.4)),
        (-0.5, 0.0, (0.6, -0.5, 0.9)),
    ],
)
async def test_the_camera_looks_at_the_point(
    scene: Scene, base_yaw: float, torso: float, point: tuple[float, float, float]
) -> None:
    await MoveMotion(Pose([0.1, 0.2, 0], yaw_quaternion(base_yaw))).perform()
    await MoveJointsMotion(["torso_lift_joint", "head_pan_joint", "head_tilt_joint"], [torso, 0.5, 0.2]).perform()
    await LookingMotion(Pose(point)).perform()
    tilt = scene.robot.link_pose("head_tilt_link")
    ahead = rotated(tilt.orientation, (1, 0, 0))
    way = [there - here for there, here in zip(point, tilt.position, strict=True)]
    length = math.hypot(*way)
    assert list(ahead) == pytest.approx([each / length for each in way], abs=1e-6)


async def test_the_neck_turns_as_far_as_it_can_to_a_point_behind(scene: Scene, watching: Watching) -> None:
    await LookingMotion(Pose([-1, -0.01, 5])).perform()
    pan, tilt = scene.robot.joint_limits("head_pan_joint"), scene.robot.joint_limits("head_tilt_joint")
    assert scene.robot.joint_position("head_pan_joint") == pan[0]
    assert scene.robot.joint_position("head_tilt_joint") == tilt[0]
    assert watching.seen == ["joints 2"]


@pytest.mark.parametrize(
    ("target", "message"),
    [(Pose([1, 0, 0], frame="base_link"), "in frame 'base_link'"), (Pose([math.nan, 0, 0]), "not finite")],
)
async def test_the_head_does_not_turn_to_a_point_outside_the_map(
    scene: Scene, watching: Watching, target: Pose, message: str
) -> None:
    with pytest.raises(CallerError, match=message):
        await LookingMotion(target).perform()
    assert watching.seen == []


# === process modules ==========================================================================================
#
# The robot that performs motions: chosen by `with`, for one context.

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
