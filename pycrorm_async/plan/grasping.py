"""Where the gripper has to be to pick an object up and to put it down. Pure geometry in the map, metres.

The same functions serve the actions and the search for a place to stand, so that what is offered is what
will be done.
"""

from __future__ import annotations

from typing import NamedTuple

from pycrorm_async.world.enums import Grasp
from pycrorm_async.world.pose import Pose, product, rotated
from pycrorm_async.world.robot import GRASP_ORIENTATIONS

__all__ = ["APPROACH_M", "LIFT_M", "RETRACT_M", "PickUpPoses", "pick_up_poses", "place_pose", "retracted"]

APPROACH_M = 0.1
LIFT_M = 0.03
RETRACT_M = 0.07


class PickUpPoses(NamedTuple):
    """The three goals of the tool frame, in order."""

    before: Pose
    at: Pose
    above: Pose


def pick_up_poses(object_pose: Pose, grasp: Grasp, tool: Pose) -> PickUpPoses:
    """The goals for an object at this pose, when the tool frame is at `tool` now.

    The approach is along the direction in which the gripper points *now*, not the one it will have at the
    object.
    """
    turned = product(object_pose.orientation, GRASP_ORIENTATIONS[grasp])
    back = rotated(tool.orientation, (-APPROACH_M, 0.0, 0.0))
    x, y, z = object_pose.position
    frame = object_pose.frame
    return PickUpPoses(
        Pose((x + back.x, y + back.y, z + back.z), turned, frame),
        Pose((x, y, z), turned, frame),
        Pose((x, y, z + LIFT_M), turned, frame),
    )


def place_pose(target: Pose, held: Pose, tool: Pose) -> Pose:
    """Where the tool frame brings the held object to `target`."""
    return target @ tool.relative_to(held)


def retracted(tool: Pose) -> Pose:
    """The tool frame after moving back along its fingers."""
    return tool @ Pose((-RETRACT_M, 0.0, 0.0))
