"""Where the gripper has to be to pick an object up, put it down or hold on to it. Pure geometry in the map, metres.

The same functions serve the actions and the search for a place to stand, so that what is offered is what
will be done.
"""

from __future__ import annotations

import math
from typing import NamedTuple

from pycrorm_async.world.enums import Grasp
from pycrorm_async.world.pose import Pose, product, rotated
from pycrorm_async.world.queries.bounding_boxes import BoundingBox
from pycrorm_async.world.robots.robot_description import GRASP_ORIENTATIONS

__all__ = [
    "APPROACH_M",
    "HOLD_DISTANCE_M_MAX",
    "LIFT_M",
    "RETRACT_M",
    "PickUpPoses",
    "approach",
    "distance_to_box",
    "pick_up_poses",
    "place_pose",
    "retract",
]

APPROACH_M = 0.1
LIFT_M = 0.03
RETRACT_M = 0.07
HOLD_DISTANCE_M_MAX = 0.03
"""A gripper can hold what its tool frame is no farther from than this."""


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


def approach(tool: Pose) -> Pose:
    """The tool frame before it goes straight ahead, along its fingers, to `tool`."""
    return tool @ Pose((-APPROACH_M, 0.0, 0.0))


def retract(tool: Pose) -> Pose:
    """The tool frame after moving back along its fingers."""
    return tool @ Pose((-RETRACT_M, 0.0, 0.0))


def distance_to_box(tool: Pose, box: BoundingBox) -> float:
    """How far the tool frame is from the box around something, m; 0 inside."""
    return math.hypot(
        *(max(low - at, at - high, 0.0) for at, low, high in zip(tool.position, box.min, box.max, strict=True))
    )
