"""Robots whose base link is not the root of their model: above a footprint, and on rails that joints move."""

from __future__ import annotations

from dataclasses import replace
from xml.etree.ElementTree import fromstring, indent, tostring

from pycrorm_async.world import COURIER, Object, Pose, RobotDescription
from pycrorm_async.world.models import courier_urdf, link, moving
from pycrorm_async.world.urdf import Bounds

HEIGHT_M = 0.2
RAILS = {"rail_x": 0.4, "rail_y": -0.3, "rail_turn": 0.9}
"""The joints between the root of `rail_robot` and its base, nearest to the root first, and a position of each."""


def raised_robot() -> RobotDescription:
    """Return a courier whose base link is fixed 0.2 m above its root, the link `base_footprint`."""
    robot = fromstring(courier_urdf())
    [origin] = robot.iterfind("joint[@name='base_footprint_joint']/origin")
    origin.set("xyz", f"0 0 {HEIGHT_M}")
    return replace(COURIER, name="raised", base_link="base_link", urdf=tostring(robot, encoding="unicode"))


def rail_robot() -> RobotDescription:
    """Return a courier on two rails and a turntable above its root, the link `hall`."""
    robot = fromstring(courier_urdf())
    link(robot, "hall", (6, 0.1, 0.02), (0, 3, 0.01))
    link(robot, "carriage")
    link(robot, "slide")
    moving(robot, "rail_x", "hall", "carriage", (0, 0, 0.1), (1, 0, 0), Bounds(-2, 2), prismatic=True)
    moving(robot, "rail_y", "carriage", "slide", (0, 0, 0), (0, 1, 0), Bounds(-2, 2), prismatic=True)
    moving(robot, "rail_turn", "slide", "base_footprint", (0, 0, 0.07), (0, 0, 1), Bounds(-3, 3))
    indent(robot)
    return replace(COURIER, name="railed", base_link="base_link", urdf=tostring(robot, encoding="unicode"))


def link_poses(robot: Object) -> dict[str, Pose]:
    """Return the pose of every link."""
    return {each: robot.link_pose(each) for each in robot.links}
