"""Parts of the robot that a designator uses exclusively while it runs, so that parallel branches take turns.

A part is also needed if it only must not move: an arm that reaches for a place in the map needs the base and the torso.
Looking does not need the base, so a robot may turn its head while it drives. `language.resource_arbiter` decides which
designator waits.

>>> PickUpActionPerformable(milk, Arms.LEFT, Grasp.FRONT).resources() == reaching(Arms.LEFT)
True
"""

from __future__ import annotations

from collections.abc import Iterable
from enum import Enum
from typing import TYPE_CHECKING

from pycrorm_async.world.enums import Arms

if TYPE_CHECKING:
    from pycrorm_async.world.robots.robot_description import RobotDescription


class Resource(Enum):
    """A part of the robot that one designator at a time can use."""

    LEFT_ARM = "LEFT_ARM"
    RIGHT_ARM = "RIGHT_ARM"
    BASE = "BASE"
    OTHER_ARM = "OTHER_ARM"
    """Any arm but the left and the right one: the further arms of a robot take turns."""
    TORSO = "TORSO"
    HEAD = "HEAD"


NOTHING: frozenset[Resource] = frozenset()
_ARMS = {
    Arms.LEFT: frozenset({Resource.LEFT_ARM}),
    Arms.RIGHT: frozenset({Resource.RIGHT_ARM}),
    Arms.BOTH: frozenset({Resource.LEFT_ARM, Resource.RIGHT_ARM}),
}
_OTHER_ARM = frozenset({Resource.OTHER_ARM})
_STANDING = frozenset({Resource.BASE, Resource.TORSO})


def arms(arm: Arms) -> frozenset[Resource]:
    """Return the arm, or both, with its gripper."""
    return _ARMS.get(arm, _OTHER_ARM)


def reaching(arm: Arms) -> frozenset[Resource]:
    """Return the parts for reaching a place in the map: the arm, and base and torso, which must not move."""
    return arms(arm) | _STANDING


def moving(joints: Iterable[str], robot: RobotDescription) -> frozenset[Resource]:
    """Return the parts that these joints belong to; a joint of no part is ignored."""
    parts = dict.fromkeys(robot.head_joints, Resource.HEAD)
    if robot.torso_joint is not None:
        parts[robot.torso_joint] = Resource.TORSO
    for arm, description in robot.arms.items():
        (part,) = arms(arm)
        parts |= dict.fromkeys(description.joints, part)
        for positions in description.gripper_joints.values():
            parts |= dict.fromkeys(positions, part)
    return frozenset(parts[joint] for joint in joints if joint in parts)
