"""What a hand can act on and what a gripper can take, and the taking over of a thing from what it hung on."""

from __future__ import annotations

from pycrorm_async.plan.current_robot import CurrentRobot
from pycrorm_async.plan.failures import EndEffectorFailure, IllPosedGoalFailure, PerceptionObjectNotInWorld
from pycrorm_async.world.enums import Arms, ObjectType
from pycrorm_async.world.objects import Object

__all__ = ["check_same_world", "check_free", "check_takable", "take"]


def check_takable(robot: CurrentRobot, arm: Arms, wanted: Object) -> None:
    """Whether that gripper can take it, or holds it already.

    Raises:
        IllPosedGoalFailure: furniture or a robot is to be held, or not one arm is named.
        EndEffectorFailure: the gripper holds something else.
        PerceptionObjectNotInWorld: it is in another world than the robot.
        CapabilityAbsenceFailure: the robot has no such arm.
    """
    check_same_world(robot, wanted)
    if wanted.object_type in (ObjectType.ROBOT, ObjectType.ENVIRONMENT):
        raise IllPosedGoalFailure(f"{wanted.name} is nothing that a gripper can hold", wanted.name)
    check_free(robot, arm, wanted)


def check_same_world(robot: CurrentRobot, thing: Object) -> None:
    """Raise `PerceptionObjectNotInWorld` if it is in another world than the robot, which moves nothing there."""
    if thing.world is not robot.body.world:
        raise PerceptionObjectNotInWorld(f"{thing.name} is in another world than {robot.body.name}", thing.name)


def check_free(robot: CurrentRobot, arm: Arms, *but: Object) -> None:
    """Raise `EndEffectorFailure` if the gripper holds something else than this."""
    tool_frame = robot.one_arm(arm).tool_frame
    for thing, link in robot.body.attachments.items():
        if link == tool_frame and thing not in but:
            raise EndEffectorFailure(f"the {arm.name} gripper holds {thing.name}: place or release it", thing.name)


def take(robot: CurrentRobot, arm: Arms, wanted: Object) -> None:
    """From now on it moves with the gripper, and no longer with what it hung on."""
    tool_frame = robot.one_arm(arm).tool_frame
    if robot.body.attachments.get(wanted) == tool_frame:
        return
    if wanted.attached_to is not None:
        wanted.attached_to.detach(wanted)
    robot.body.attach(wanted, tool_frame)
