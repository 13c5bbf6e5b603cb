"""The effect of each motion on the simulated robot, and its failures: complete or without effect."""

from __future__ import annotations

import math
from collections.abc import Mapping

import pytest

from pycrorm_async.errors import CallerError
from pycrorm_async.plan import (
    IKError,
    LookingMotion,
    MoveArmJointsMotion,
    MoveGripperMotion,
    MoveJointsMotion,
    MoveMotion,
    MoveTCPMotion,
    ResolutionError,
)
from pycrorm_async.plan.failures import ConfigurationNotReached, TorsoGoalUnreachable
from pycrorm_async.world import Arms, GripperState, Object, Pose
from pycrorm_async.world.pose import UnknownJoint, rotated, yaw_quaternion
from tests.plan.conftest import Scene

LEFT_TOOL = "l_gripper_tool_frame"


class Watching:
    """A world observer that notes the moved objects."""

    def __init__(self) -> None:
        self.seen: list[str] = []

    def object_added(self, added: Object) -> None:
        self.seen.append(f"added {added.name}")

    def object_removed(self, removed: Object) -> None:
        self.seen.append(f"removed {removed.name}")

    def object_moved(self, moved: Object) -> None:
        self.seen.append(f"moved {moved.name}")

    def joints_moved(self, moved: Object, positions: Mapping[str, float]) -> None:
        self.seen.append(f"joints {len(positions)}")

    def object_attached(self, parent: Object, child: Object, link: str | None) -> None:
        self.seen.append(f"attached {child.name} to {link}")

    def object_detached(self, parent: Object, child: Object, link: str | None) -> None:
        self.seen.append(f"detached {child.name} from {link}")


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


async def test_a_goal_out_of_reach_is_an_ik_error_and_moves_nothing(scene: Scene, watching: Watching) -> None:
    goal = Pose([3, 0, 1])
    with pytest.raises(IKError) as caught:
        await MoveTCPMotion(goal, Arms.RIGHT).perform()
    assert (caught.value.pose, caught.value.arm, caught.value.tip_frame) == (
        goal,
        Arms.RIGHT,
        "r_gripper_tool_frame",
    )
    assert watching.seen == []


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


async def test_joints_move_in_one_motion(scene: Scene, watching: Watching) -> None:
    await MoveJointsMotion(["torso_lift_joint", "head_pan_joint"], [0.2, 1]).perform()
    assert scene.robot.joint_position("torso_lift_joint") == 0.2
    assert scene.robot.joint_position("head_pan_joint") == 1.0
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


async def test_looking_twice_changes_nothing(scene: Scene) -> None:
    await LookingMotion(Pose([1.3, 1.0, 0.9])).perform()
    once = scene.robot.joint_positions()
    await LookingMotion(Pose([1.3, 1.0, 0.9])).perform()
    assert scene.robot.joint_positions() == pytest.approx(once, abs=1e-9)


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


def test_a_motion_requires_its_properties() -> None:
    with pytest.raises(ResolutionError, match=r"target: expected Pose, got list \[1, 2, 3\]"):
        MoveMotion([1, 2, 3])  # type: ignore[arg-type]  # the fault this test is about
    with pytest.raises(ResolutionError, match="arm: expected Arms, got str 'left'"):
        MoveTCPMotion(Pose(), "left")  # type: ignore[arg-type]  # the fault this test is about
    with pytest.raises(ResolutionError, match="missing: motion"):
        MoveGripperMotion(None, Arms.LEFT)  # type: ignore[arg-type]  # the fault this test is about
    with pytest.raises(ResolutionError, match="left_arm_poses"):
        MoveArmJointsMotion({"l_elbow_flex_joint": "bent"})  # type: ignore[dict-item]  # the fault this test is about
