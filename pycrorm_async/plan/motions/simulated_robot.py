"""Execute motions as exact jumps of the robot in the world: no duration, no noise, collision checks on request.

A motion either has its whole effect, and the world notifies its observers once per moved object, or it fails and has
none.
"""

from __future__ import annotations

from collections.abc import Mapping, Sequence

from pycrorm_async.plan.current_robot import CurrentRobot, check_in_map, require_robot
from pycrorm_async.plan.execution.observer import Seen
from pycrorm_async.plan.failures import (
    ConfigurationNotReached,
    EnvironmentManipulationImpossible,
    IKError,
    IllPosedGoalFailure,
    ManipulationGoalInCollision,
    NavigationGoalInCollision,
    TorsoGoalUnreachable,
)
from pycrorm_async.plan.geometry.articulation import (
    Handle,
    closed_position,
    handle_of,
    handle_poses,
    moved_position,
    opened_position,
)
from pycrorm_async.plan.geometry.grasp_poses import HOLD_DISTANCE_M_MAX, distance_to_box
from pycrorm_async.plan.geometry.gripper_checks import check_same_world
from pycrorm_async.plan.motions.looking import head_joints
from pycrorm_async.plan.motions.motions import (
    AccessingMotion,
    ClosingMotion,
    DetectingMotion,
    LookingMotion,
    MoveArmJointsMotion,
    MoveGripperMotion,
    MoveJointsMotion,
    MoveMotion,
    MoveTCPMotion,
    OpeningMotion,
    WorldStateDetectingMotion,
)
from pycrorm_async.plan.motions.perception import objects_in_world, seen_by_camera
from pycrorm_async.plan.object_designators import ObjectPart
from pycrorm_async.world.enums import Arms
from pycrorm_async.world.errors import JointLimitExceeded, UnknownJoint
from pycrorm_async.world.pose import Pose
from pycrorm_async.world.queries.collision_queries import collisions_at
from pycrorm_async.world.robots.kinematics import Unreachable, solve
from pycrorm_async.world.robots.robot_description import Drive, Limits


class SimulatedModules:
    """The process modules of `with simulated_robot:`; inverse kinematics keeps the arms within `limits`.

    With `collisions` a goal is refused at which the arm or the held object, or the base, collides with another object;
    the gripper itself may collide if the motion allows it. Driving moves the whole robot, but arms and held objects are
    checked only by their own motions.
    """

    def __init__(self, limits: Limits, *, collisions: bool = False) -> None:
        self._limits = limits
        self._collisions = collisions

    async def navigate(self, motion: MoveMotion) -> None:
        robot = require_robot()
        if robot.description.drive is Drive.FIXED:
            raise robot.absence("drive: its base is fixed")
        if self._collisions:
            _check_base_clear(robot, motion.target)
        robot.body.set_pose(motion.target)

    async def move_tcp(self, motion: MoveTCPMotion) -> None:
        robot = require_robot()
        joints = self._solve(robot, motion.arm, motion.target)
        if self._collisions:
            self._check_clear(robot, motion, joints)
        robot.body.set_joint_positions(joints)

    async def looking(self, motion: LookingMotion) -> None:
        robot = require_robot()
        check_in_map(motion.target)
        robot.body.set_joint_positions(head_joints(robot, motion.target))

    async def move_gripper(self, motion: MoveGripperMotion) -> None:
        robot = require_robot()
        joints: dict[str, float] = {}
        for arm in robot.each_arm(motion.gripper):
            joints |= robot.gripper_joints(arm, motion.motion)
        robot.body.set_joint_positions(joints)

    async def move_arm_joints(self, motion: MoveArmJointsMotion) -> None:
        robot = require_robot()
        targets: dict[str, float] = {}
        for arm, positions in ((Arms.LEFT, motion.left_arm_poses), (Arms.RIGHT, motion.right_arm_poses)):
            for joint in positions or {}:
                if joint not in (joints := robot.one_arm(arm).joints):
                    raise UnknownJoint(f"{robot.body.name}, {arm.name} arm", joint, joints)
            targets |= positions or {}
        _set_joints(robot, targets)

    async def move_joints(self, motion: MoveJointsMotion) -> None:
        _set_joints(require_robot(), dict(zip(motion.names, motion.positions, strict=True)))

    async def detecting(self, motion: DetectingMotion) -> Sequence[Seen]:
        return seen_by_camera(require_robot(), motion.object_type)

    async def world_state_detecting(self, motion: WorldStateDetectingMotion) -> Sequence[Seen]:
        return objects_in_world(motion.object_type)

    async def open(self, motion: OpeningMotion) -> None:
        handle = handle_of(motion.object_part)
        self._move_handle(require_robot(), motion.arm, handle, opened_position(handle))

    async def close(self, motion: ClosingMotion) -> None:
        handle = handle_of(motion.object_part)
        self._move_handle(require_robot(), motion.arm, handle, closed_position(handle))

    async def accessing(self, motion: AccessingMotion) -> None:
        robot = require_robot()
        tool_frame = robot.one_arm(motion.arm).tool_frame
        if motion.gripper != tool_frame:
            message = f"the gripper of the {motion.arm.name} arm is {tool_frame}, not {motion.gripper}"
            raise IllPosedGoalFailure(message, motion.gripper)
        handle = handle_of(ObjectPart(motion.drawer_handle, motion.part_of), motion.drawer_joint)
        self._move_handle(robot, motion.arm, handle, moved_position(handle, motion.distance))

    def _move_handle(self, robot: CurrentRobot, arm: Arms, handle: Handle, goal: float) -> None:
        """Move the handle's joint to `goal` together with the hand, which keeps its pose relative to the handle."""
        check_same_world(robot, handle.whole)
        tool_frame = robot.one_arm(arm).tool_frame
        tool = robot.tool_pose(arm)
        distance = distance_to_box(tool, handle.whole.bounding_box(handle.link))
        if distance > HOLD_DISTANCE_M_MAX:
            message = f"{tool_frame} is not on {handle.link} but {distance:.3f} m away: grasp it first"
            raise EnvironmentManipulationImpossible(message, handle.link, distance)
        grip = tool.relative_to(handle.whole.link_pose(handle.link))
        path = [self._solve(robot, arm, each @ grip) for each in handle_poses(handle, goal)]
        robot.body.set_joint_positions(path[-1])
        handle.whole.set_joint_position(handle.joint, goal)

    def _solve(self, robot: CurrentRobot, arm: Arms, target: Pose) -> dict[str, float]:
        """Return the arm's joint angles for a tool frame at the target. Raises `IKError`."""
        tool_frame = robot.one_arm(arm).tool_frame
        try:
            return solve(robot.body, arm, target, limits=self._limits)
        except Unreachable as unreachable:
            raise IKError(target, arm, tool_frame, unreachable.reason) from unreachable

    def _check_clear(self, robot: CurrentRobot, motion: MoveTCPMotion, joints: dict[str, float]) -> None:
        """Raise `ManipulationGoalInCollision` if the arm or the held object collides at these joint angles."""
        arm = robot.one_arm(motion.arm)
        last = arm.joints[-1] if motion.allow_gripper_collision else None
        body = robot.body
        above = {link: body.joints_above(link) for link in body.links if body.body.solids[link]}
        links = [
            link for link, joints_above in above.items() if arm.joints[0] in joints_above and last not in joints_above
        ]
        held = [obj for obj, link in body.attachments.items() if link == arm.tool_frame]
        collisions = collisions_at(body, joints, links=links, carried=held)
        if collisions:
            part, obj = collisions[0]
            message = f"at its goal the {motion.arm.name} arm would be in {obj.name} with {part}"
            raise ManipulationGoalInCollision(message, part, obj.name)


def _check_base_clear(robot: CurrentRobot, goal: Pose) -> None:
    """Raise `NavigationGoalInCollision` if the base, the torso or the head collides at this pose of the base."""
    check_in_map(goal)
    links = robot.base_links()
    carried = [obj for obj, link in robot.body.attachments.items() if (link or robot.body.body.base) in links]
    collisions = collisions_at(robot.body, {}, links=links, carried=carried, base=goal)
    if collisions:
        part, obj = collisions[0]
        message = f"at its goal the base would be in {obj.name} with {part}"
        raise NavigationGoalInCollision(message, part, obj.name)


def _set_joints(robot: CurrentRobot, positions: Mapping[str, float]) -> None:
    body, description = robot
    try:
        body.set_joint_positions(positions)
    except JointLimitExceeded as exceeded:
        if description.torso_joint is not None and [*positions] == [description.torso_joint]:
            raise TorsoGoalUnreachable(str(exceeded), positions[description.torso_joint]) from exceeded
        raise ConfigurationNotReached(str(exceeded), dict(positions)) from exceeded
