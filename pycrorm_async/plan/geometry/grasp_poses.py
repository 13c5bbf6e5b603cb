"""Compute poses of the gripper for picking up, placing and holding. Pure geometry in the map, metres.

The actions and the search for base poses use the same functions, so that an offered base pose suits the action.
"""

from __future__ import annotations

import math
from typing import NamedTuple

from pycrorm_async.world.enums import Grasp
from pycrorm_async.world.pose import Pose, Quaternion, product, rotated
from pycrorm_async.world.queries.bounding_boxes import BoundingBox
from pycrorm_async.world.robots.robot_description import GRASP_ORIENTATIONS

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

    before: Pose
    at: Pose
    above: Pose


def pick_up_poses(object_pose: Pose, grasp: Grasp, tool: Pose) -> PickUpPoses:
    """Return the goals for an object at this pose and a tool frame that is at `tool` now.

    The approach follows the gripper's *current* direction, not the direction it will have at the object.
    """
    orientation = grasp_orientation(object_pose, grasp)
    back = rotated(tool.orientation, (-APPROACH_M, 0.0, 0.0))
    x, y, z = object_pose.position
    frame = object_pose.frame
    return PickUpPoses(
        Pose((x + back.x, y + back.y, z + back.z), orientation, frame),
        Pose((x, y, z), orientation, frame),
        Pose((x, y, z + LIFT_M), orientation, frame),
    )


def grasp_orientation(object_pose: Pose, grasp: Grasp) -> Quaternion:
    """Return the tool frame's orientation in a grasp of an object at this pose."""
    return product(object_pose.orientation, GRASP_ORIENTATIONS[grasp])


def place_pose(target: Pose, held: Pose, tool: Pose) -> Pose:
    """Return the pose of the tool frame that brings the held object to `target`."""
    return target @ tool.relative_to(held)


def approach(tool: Pose) -> Pose:
    """Return the pose from which the tool frame moves straight ahead, along its fingers, to `tool`."""
    return tool @ Pose((-APPROACH_M, 0.0, 0.0))


def retract(tool: Pose) -> Pose:
    """Return the pose of the tool frame after moving back along its fingers."""
    return tool @ Pose((-RETRACT_M, 0.0, 0.0))


def distance_to_box(tool: Pose, box: BoundingBox) -> float:
    """Return the distance of the tool frame from the box, m; 0 inside."""
    return math.hypot(
        *(max(low - at, at - high, 0.0) for at, low, high in zip(tool.position, box.min, box.max, strict=True))
    )
