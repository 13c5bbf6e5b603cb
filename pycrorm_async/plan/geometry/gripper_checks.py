"""Check whether a gripper can take an object, and attach the object to it."""

from __future__ import annotations

from collections.abc import Iterable

from pycrorm_async.plan.current_robot import CurrentRobot
from pycrorm_async.plan.failures import (
    CapabilityAbsenceFailure,
    EndEffectorFailure,
    IllPosedGoalFailure,
    PerceptionObjectNotInWorld,
)
from pycrorm_async.plan.object_designators import ObjectLike, ObjectPart, in_world
from pycrorm_async.world.enums import Arms, GripperState, ObjectType
from pycrorm_async.world.objects import Object
from pycrorm_async.world.pose import Pose, Quaternion
from pycrorm_async.world.queries.bounding_boxes import box_around
from pycrorm_async.world.robots.robot_description import ArmDescription


def check_takable(robot: CurrentRobot, arm: Arms, target: Object) -> None:
    """Check that the gripper can take the object, and that the arm lifts it with all that is attached to it.

    Raises:
        IllPosedGoalFailure: the object is furniture or a robot, or `arm` is not a single arm.
        EndEffectorFailure: the gripper holds another object.
        PerceptionObjectNotInWorld: the object is in another world than the robot.
        CapabilityAbsenceFailure: the robot has no such arm, or the arm no gripper, or the object is heavier than its
            payload. A mass that is not known counts as 0.
    """
    check_same_world(robot, target)
    if target.object_type in (ObjectType.ROBOT, ObjectType.ENVIRONMENT):
        raise IllPosedGoalFailure(f"{target.name} cannot be held by a gripper", target.name)
    check_free(robot, arm, target)
    if (overload := _overload(robot.one_arm(arm), arm, target)) is not None:
        raise overload


def lifting_arms(robot: CurrentRobot, among: Iterable[Arms], target: ObjectLike) -> tuple[Arms, ...]:
    """Return the arms of `among` that lift the object; all of them if none does, so that the action names the reason.

    Returns all of them also for a part of an object, and for an object that is not in the world. An arm that the robot
    lacks is returned too, because the action then fails with that reason.
    """
    arms, described = tuple(among), robot.description.arms
    if isinstance(target, ObjectPart):
        return arms
    try:
        load = in_world(target)
    except PerceptionObjectNotInWorld:
        return arms
    too_weak = {arm for arm in arms if arm in described and _overload(described[arm], arm, load) is not None}
    if too_weak.issuperset(arm for arm in arms if arm in described):
        return arms
    return tuple(arm for arm in arms if arm not in too_weak)


def _overload(described: ArmDescription, arm: Arms, target: Object) -> CapabilityAbsenceFailure | None:
    """Return the failure of lifting the object and all that is attached to it; None within the arm's payload."""
    mass_kg = sum(each.mass_kg or 0.0 for each in (target, *target.world.attachments.below(target)))
    if described.payload_kg is None or mass_kg <= described.payload_kg:
        return None
    message = f"{target.name} weighs {mass_kg:g} kg, the {arm.name} arm lifts {described.payload_kg:g} kg"
    return CapabilityAbsenceFailure(message, target.name, mass_kg, described.payload_kg)


def check_same_world(robot: CurrentRobot, obj: Object) -> None:
    """Raise `PerceptionObjectNotInWorld` if the object is in another world than the robot."""
    if obj.world is not robot.body.world:
        raise PerceptionObjectNotInWorld(f"{obj.name} is in another world than {robot.body.name}", obj.name)


def check_free(robot: CurrentRobot, arm: Arms, *but: Object) -> None:
    """Raise `EndEffectorFailure` if the gripper holds an object other than `but`.

    Raises `CapabilityAbsenceFailure` if there is no such gripper.
    """
    robot.gripper_joints(arm, GripperState.CLOSE)
    tool_frame = robot.one_arm(arm).tool_frame
    for obj, link in robot.body.attachments.items():
        if link == tool_frame and obj not in but:
            raise EndEffectorFailure(f"the {arm.name} gripper holds {obj.name}: place or release it", obj.name)


def check_fits(robot: CurrentRobot, arm: Arms, target: Object, tool: Quaternion) -> None:
    """Raise `CapabilityAbsenceFailure` if the object is wider than the opening of a gripper with this orientation.

    The width, m, is that of the whole object along the direction in which the fingers close.
    """
    across = Pose((0.0, 0.0, 0.0), tool).inverse()
    frames = [(across @ target.link_pose(link), target.body.solids[link]) for link in target.links]
    box = box_around([((frame.position, frame.orientation), solids) for frame, solids in frames])
    width, opening = box.size.y if box is not None else 0.0, robot.one_arm(arm).opening_m
    if opening is not None and width > opening:
        message = f"{target.name} is {width:.3f} m wide between the fingers, the {arm.name} gripper opens {opening:g} m"
        raise CapabilityAbsenceFailure(message, target.name, width, opening)


def take(robot: CurrentRobot, arm: Arms, target: Object) -> None:
    """Attach the object to the gripper and detach it from its former parent."""
    tool_frame = robot.one_arm(arm).tool_frame
    if robot.body.attachments.get(target) == tool_frame:
        return
    if target.attached_to is not None:
        target.attached_to.detach(target)
    robot.body.attach(target, tool_frame)
