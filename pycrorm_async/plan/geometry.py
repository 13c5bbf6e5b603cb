"""Compute poses for grasping, opening and holding, and check whether a gripper can take an object."""

import math
from collections.abc import Iterable
from typing import NamedTuple

from pycrorm_async.plan import failures
from pycrorm_async.plan.objects import CurrentRobot, ObjectLike, ObjectPart, in_world
from pycrorm_async.world import pose as poses
from pycrorm_async.world.bounding_boxes import BoundingBox, box_around
from pycrorm_async.world.bullet import Object
from pycrorm_async.world.queries import collisions_at
from pycrorm_async.world.urdf import GRASP_ORIENTATIONS, ArmDescription, RobotDescription

# === articulation =============================================================================================
#
# Compute the joint of a handle, its open and closed positions, its grasp, and the paths of handle and hand.
#
# The opening motions and the search for base poses use the same functions, so that an offered base pose suits the
# motion. Pure geometry in the map, metres and rad; nothing is moved.

OPENING_MARGIN = 0.05
"""Distance that opening leaves between the joint and its upper limit, m or rad."""
STEP_M_MAX = 0.05
"""Bounds the distance in m between two poses of the hand along the path of a drawer."""
STEP_RAD_MAX = 0.1
"""Greatest distance between two checked points on a handle's path."""
_ROUNDING = 1e-9
"""Tolerates the rounding of joint positions."""


class Handle(NamedTuple):
    """A link to hold, and the joint that moves it."""

    whole: Object
    link: str
    joint: str

    @property
    def position(self) -> float:
        """The joint's current position, m or rad."""
        return self.whole.joint_position(self.joint)


def handle_of(part: ObjectLike, joint: str | None = None) -> Handle:
    """Return the handle with the nearest movable joint above it, or with the named joint.

    Raises:
        EnvironmentManipulationImpossible: `part` is not an `ObjectPart`, no joint moves it, or the named one does not.
        PerceptionObjectNotInWorld: the object it is part of is not in the world.
        UnknownLink: that object has no such link.
    """
    if not isinstance(part, ObjectPart):
        raise failures.EnvironmentManipulationImpossible(
            f"{part.name} is not part of an object: pass the handle as ObjectPart(handle, object)", part.name
        )
    whole = in_world(part.part_of)
    joints = whole.joints_above(part.name)
    if not joints or joint not in (None, *joints):
        mover = "no joint" if joint is None else f"no joint {joint}"
        raise failures.EnvironmentManipulationImpossible(
            f"{mover} of {whole.name} moves {part.name}", part.name, whole.name
        )
    return Handle(whole, part.name, joint or joints[0])


def opened_position(handle: Handle) -> float:
    """Return the joint's open position: `OPENING_MARGIN` below its upper limit, but not below the current position.

    Raises:
        EnvironmentManipulationImpossible: the joint has no limits.
    """
    _, upper = _limits(handle)
    return max(handle.position, upper - OPENING_MARGIN)


def closed_position(handle: Handle) -> float:
    """Return the joint's lower limit. Raises `EnvironmentManipulationImpossible` if the joint has no limits."""
    lower, _ = _limits(handle)
    return lower


def moved_position(handle: Handle, distance: float) -> float:
    """Return the joint's position after a motion by `distance`, m or rad.

    Raises:
        EnvironmentManipulationImpossible: that position is outside the joint's limits.
    """
    lower, upper = handle.whole.joint_limits(handle.joint)
    goal = handle.position + distance
    if not lower - _ROUNDING <= goal <= upper + _ROUNDING:
        limits = f"its limits are {lower:g} to {upper:g}"
        message = f"{handle.joint} at {handle.position:g} cannot move by {distance:g}: {limits}"
        raise failures.EnvironmentManipulationImpossible(message, handle.link, handle.joint, distance)
    return min(max(goal, lower), upper)


def handle_poses(handle: Handle, goal: float, start: float | None = None) -> list[poses.Pose]:
    """Return poses of the handle's frame while its joint moves to `goal`: the start, points between, the goal.

    Args:
        start: the joint's first position; None means the current one.
    """
    begin = handle.position if start is None else start
    step = STEP_M_MAX if handle.whole.joint_type(handle.joint) is poses.JointType.PRISMATIC else STEP_RAD_MAX
    count = max(1, math.ceil(abs(goal - begin) / step - _ROUNDING))
    return [
        handle.whole.link_pose_at(handle.link, {handle.joint: begin + (goal - begin) * number / count})
        for number in range(count + 1)
    ]


def hold_pose(handle: Handle) -> poses.Pose:
    """Return the pose of the tool frame relative to the handle's frame in a grasp.

    A drawer's handle is grasped from the front, with the handle's orientation. A door's handle is grasped from the side
    of the hinge: the hand is rotated by 90 degrees about the hinge's axis and points away from the hinge. The moving
    door rotates the hand, and a hand that starts straight could not follow it from any base pose.
    """
    if handle.whole.joint_type(handle.joint) is poses.JointType.PRISMATIC:
        return poses.Pose()
    # Half a turn of the joint would bring the handle to the opposite side of the hinge: this locates the hinge.
    current = handle.whole.link_pose(handle.link)
    opposite = handle.whole.link_pose_at(handle.link, {handle.joint: handle.position + math.pi}).relative_to(current)
    x, y, z, _ = opposite.orientation
    from_hinge = [-across / 2 for across in opposite.position]
    for side in (1.0, -1.0):
        turn = poses.Pose(orientation=(side * x, side * y, side * z, 1.0))
        if poses.dot(poses.rotated(turn.orientation, (1.0, 0.0, 0.0)), from_hinge) > 0.0:
            break
    return turn


def hand_poses(handle: Handle, goal: float, start: float | None = None) -> list[poses.Pose]:
    """Return the poses of the tool frame of a hand that holds the handle while its joint moves (`handle_poses`)."""
    grip = hold_pose(handle)
    return [each @ grip for each in handle_poses(handle, goal, start)]


def grasp_pose(target: ObjectLike) -> poses.Pose:
    """Return the tool frame's pose for grasping: an object's own frame, or a handle's `hold_pose`.

    Raises:
        PerceptionObjectNotInWorld: the object, or the object that has the part, is not in the world.
        UnknownLink: the object has no such part.
    """
    if not isinstance(target, ObjectPart):
        return in_world(target).pose
    whole = in_world(target.part_of)
    if not whole.joints_above(target.name):
        return whole.link_pose(target.name)
    return whole.link_pose(target.name) @ hold_pose(handle_of(target))


def _limits(handle: Handle) -> tuple[float, float]:
    lower, upper = handle.whole.joint_limits(handle.joint)
    if not math.isfinite(upper - lower):
        message = f"{handle.joint} has no limits, so it has no open and no closed position"
        raise failures.EnvironmentManipulationImpossible(message, handle.link, handle.joint)
    return lower, upper


# === grasp poses ==============================================================================================
#
# Compute poses of the gripper for picking up, placing and holding. Pure geometry in the map, metres.
#
# The actions and the search for base poses use the same functions, so that an offered base pose suits the action.

APPROACH_M = 0.1
"""The distance in m from the goal at which the tool frame begins its straight approach."""
LIFT_M = 0.03
"""The height in m by which the object is lifted after the grasp."""
RETRACT_M = 0.07
"""The distance in m by which the gripper moves back after it released an object."""
HOLD_DISTANCE_M_MAX = 0.03
"""Greatest distance between the tool frame and an object's bounding box at which the gripper can hold the object."""


class PickUpPoses(NamedTuple):
    """The three goals of the tool frame in a pick-up, in order."""

    before: poses.Pose
    at: poses.Pose
    above: poses.Pose


def pick_up_poses(
    description: RobotDescription, object_pose: poses.Pose, grasp: poses.Grasp, tool: poses.Pose
) -> PickUpPoses:
    """Return the goals for an object at this pose and a tool frame that is at `tool` now.

    A PR2's approach follows the gripper's *current* direction, as in the thesis, that of other robots the direction
    which the gripper has at the object (`RobotDescription.approaches_along_fingers`).
    """
    orientation = poses.product(object_pose.orientation, GRASP_ORIENTATIONS[grasp])
    along = orientation if description.approaches_along_fingers else tool.orientation
    back = poses.rotated(along, (-APPROACH_M, 0.0, 0.0))
    x, y, z = object_pose.position
    frame = object_pose.frame
    return PickUpPoses(
        poses.Pose((x + back.x, y + back.y, z + back.z), orientation, frame),
        poses.Pose((x, y, z), orientation, frame),
        poses.Pose((x, y, z + LIFT_M), orientation, frame),
    )


def grasping_pose(object_pose: poses.Pose, grasp: poses.Grasp) -> poses.Pose:
    """Return the tool frame's pose in a grasp of an object at this pose."""
    return object_pose @ poses.Pose(orientation=GRASP_ORIENTATIONS[grasp])


def place_pose(target: poses.Pose, held: poses.Pose, tool: poses.Pose) -> poses.Pose:
    """Return the pose of the tool frame that brings the held object to `target`."""
    return target @ tool.relative_to(held)


def approach(tool: poses.Pose) -> poses.Pose:
    """Return the pose from which the tool frame moves straight ahead, along its fingers, to `tool`."""
    return tool @ poses.Pose((-APPROACH_M, 0.0, 0.0))


def retract(tool: poses.Pose) -> poses.Pose:
    """Return the pose of the tool frame after moving back along its fingers."""
    return tool @ poses.Pose((-RETRACT_M, 0.0, 0.0))


def distance_to_box(tool: poses.Pose, box: BoundingBox) -> float:
    """Return the distance of the tool frame from the box, m; 0 inside."""
    return math.hypot(
        *(max(low - at, at - high, 0.0) for at, low, high in zip(tool.position, box.min, box.max, strict=True))
    )


# === gripper checks ===========================================================================================
#
# Check whether a gripper can take an object, and attach the object to it.


def check_takable(robot: CurrentRobot, arm: poses.Arms, target: Object) -> None:
    """Check that the gripper can take the object, and that the arm lifts it with all that is attached to it.

    Raises:
        IllPosedGoalFailure: the object is furniture or a robot, or `arm` is not a single arm.
        EndEffectorFailure: the gripper holds another object.
        PerceptionObjectNotInWorld: the object is in another world than the robot.
        CapabilityAbsenceFailure: the robot has no such arm, or the arm no gripper, or the object is heavier than its
            payload. A mass that is not known counts as 0.
    """
    check_same_world(robot, target)
    if target.object_type in (poses.ObjectType.ROBOT, poses.ObjectType.ENVIRONMENT):
        raise failures.IllPosedGoalFailure(f"{target.name} cannot be held by a gripper", target.name)
    check_free(robot, arm, target)
    if (overload := _overload(robot.one_arm(arm), arm, target)) is not None:
        raise overload


def lifting_arms(robot: CurrentRobot, among: Iterable[poses.Arms], target: ObjectLike) -> tuple[poses.Arms, ...]:
    """Return the arms of `among` that lift the object; all of them if none does, so that the action names the reason.

    Returns all of them also for a part of an object, and for an object that is not in the world. An arm that the robot
    lacks is returned too, because the action then fails with that reason.
    """
    arms, described = tuple(among), robot.description.arms
    if isinstance(target, ObjectPart):
        return arms
    try:
        load = in_world(target)
    except failures.PerceptionObjectNotInWorld:
        return arms
    too_weak = {arm for arm in arms if arm in described and _overload(described[arm], arm, load) is not None}
    if too_weak.issuperset(arm for arm in arms if arm in described):
        return arms
    return tuple(arm for arm in arms if arm not in too_weak)


def _overload(described: ArmDescription, arm: poses.Arms, target: Object) -> failures.CapabilityAbsenceFailure | None:
    """Return the failure of lifting the object and all that is attached to it; None within the arm's payload."""
    mass_kg = sum(each.mass_kg or 0.0 for each in (target, *target.world.attachments.below(target)))
    if described.payload_kg is None or mass_kg <= described.payload_kg:
        return None
    message = f"{target.name} weighs {mass_kg:g} kg, the {arm.name} arm lifts {described.payload_kg:g} kg"
    return failures.CapabilityAbsenceFailure(message, target.name, mass_kg, described.payload_kg)


def check_same_world(robot: CurrentRobot, obj: Object) -> None:
    """Raise `PerceptionObjectNotInWorld` if the object is in another world than the robot."""
    if obj.world is not robot.body.world:
        raise failures.PerceptionObjectNotInWorld(f"{obj.name} is in another world than {robot.body.name}", obj.name)


def check_free(robot: CurrentRobot, arm: poses.Arms, *but: Object) -> None:
    """Raise `EndEffectorFailure` if the gripper holds an object other than `but`.

    Raises `CapabilityAbsenceFailure` if there is no such gripper.
    """
    robot.gripper_joints(arm, poses.GripperState.CLOSE)
    tool_frame = robot.one_arm(arm).tool_frame
    for obj, link in robot.body.attachments.items():
        if link == tool_frame and obj not in but:
            raise failures.EndEffectorFailure(f"the {arm.name} gripper holds {obj.name}: place or release it", obj.name)


def check_fits(robot: CurrentRobot, arm: poses.Arms, target: Object, tool: poses.Pose) -> None:
    """Check that a gripper with its tool frame at this pose can take the object, and can leave it again.

    The fingers enclose the whole object: its width, m, is taken in the direction in which they close. Because a grasp
    is at the object's middle, the palm may be in the object then. But the open gripper leaves it by moving back by
    `RETRACT_M`: a short gripper that took a tall object from above would still be in it.

    Raises:
        CapabilityAbsenceFailure: the object is wider than the gripper's opening, or the gripper could not leave it.
    """
    body, described = robot.body, robot.one_arm(arm)
    across = poses.Pose((0.0, 0.0, 0.0), tool.orientation).inverse()
    frames = [(across @ target.link_pose(link), target.body.solids[link]) for link in target.links]
    box = box_around([((frame.position, frame.orientation), solids) for frame, solids in frames])
    width, opening = box.size.y if box is not None else 0.0, described.opening_m
    if opening is not None and width > opening:
        message = f"{target.name} is {width:.3f} m wide between the fingers, the {arm.name} gripper opens {opening:g} m"
        raise failures.CapabilityAbsenceFailure(message, target.name, width, opening)
    links = [each for each in body.links if body.body.solids[each] and described.joints[-1] in body.joints_above(each)]
    base = retract(tool) @ body.pose.relative_to(robot.tool_pose(arm))
    for link, obj in collisions_at(body, robot.gripper_joints(arm, poses.GripperState.OPEN), links=links, base=base):
        if obj is target:
            raise failures.CapabilityAbsenceFailure(f"{link} cannot move back out of {target.name}", target.name, link)


def take(robot: CurrentRobot, arm: poses.Arms, target: Object) -> None:
    """Attach the object to the gripper and detach it from its former parent."""
    tool_frame = robot.one_arm(arm).tool_frame
    if robot.body.attachments.get(target) == tool_frame:
        return
    if target.attached_to is not None:
        target.attached_to.detach(target)
    robot.body.attach(target, tool_frame)
