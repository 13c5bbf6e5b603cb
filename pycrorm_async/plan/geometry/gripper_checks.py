"""Check whether a gripper can take an object, and attach the object to it."""

from __future__ import annotations

from pycrorm_async.plan.current_robot import CurrentRobot
from pycrorm_async.plan.failures import EndEffectorFailure, IllPosedGoalFailure, PerceptionObjectNotInWorld
from pycrorm_async.world.enums import Arms, ObjectType
from pycrorm_async.world.objects import Object

__all__ = ["check_same_world", "check_free", "check_takable", "take"]


def check_takable(robot: CurrentRobot, arm: Arms, target: Object) -> None:
    """Check that the gripper can take the object or holds it already.

    Raises:
        IllPosedGoalFailure: the object is furniture or a robot, or `arm` is not a single arm.
        EndEffectorFailure: the gripper holds another object.
        PerceptionObjectNotInWorld: the object is in another world than the robot.
        CapabilityAbsenceFailure: the robot has no such arm.
    """
    check_same_world(robot, target)
    if target.object_type in (ObjectType.ROBOT, ObjectType.ENVIRONMENT):
        raise IllPosedGoalFailure(f"{target.name} cannot be held by a gripper", target.name)
    check_free(robot, arm, target)


def check_same_world(robot: CurrentRobot, obj: Object) -> None:
    """Raise `PerceptionObjectNotInWorld` if the object is in another world than the robot."""
    if obj.world is not robot.body.world:
        raise PerceptionObjectNotInWorld(f"{obj.name} is in another world than {robot.body.name}", obj.name)


def check_free(robot: CurrentRobot, arm: Arms, *but: Object) -> None:
    """Raise `EndEffectorFailure` if the gripper holds an object other than `but`."""
    tool_frame = robot.one_arm(arm).tool_frame
    for obj, link in robot.body.attachments.items():
        if link == tool_frame and obj not in but:
            raise EndEffectorFailure(f"the {arm.name} gripper holds {obj.name}: place or release it", obj.name)


def take(robot: CurrentRobot, arm: Arms, target: Object) -> None:
    """Attach the object to the gripper and detach it from its former parent."""
    tool_frame = robot.one_arm(arm).tool_frame
    if robot.body.attachments.get(target) == tool_frame:
        return
    if target.attached_to is not None:
        target.attached_to.detach(target)
    robot.body.attach(target, tool_frame)
