"""Fakes and models for the tests of the world: an observer that notes changes, a crane, and independent matrices."""

from __future__ import annotations

import math
import random
from collections.abc import Mapping, Sequence
from dataclasses import replace
from typing import Any
from xml.etree.ElementTree import fromstring, tostring

import numpy as np
from numpy.typing import NDArray

from pycrorm_async.world import COURIER, Object, Pose, RobotDescription
from pycrorm_async.world.models import built_in_model
from pycrorm_async.world.pose import Arms, Quaternion, product
from pycrorm_async.world.urdf import PR2, Limits
from tests import bullet

Matrix = NDArray[np.float64]


class ChangeLog:
    """An observer: `notes` lists every change with the pose at that moment."""

    def __init__(self) -> None:
        self.notes: list[tuple[Any, ...]] = []

    def object_added(self, added: Object) -> None:
        self.notes.append(("added", added.name, added.pose))

    def object_removed(self, removed: Object) -> None:
        self.notes.append(("removed", removed.name, removed.pose))

    def object_moved(self, moved: Object) -> None:
        self.notes.append(("moved", moved.name, moved.pose))

    def joints_moved(self, moved: Object, positions: Mapping[str, float]) -> None:
        self.notes.append(("joints", moved.name, dict(positions)))

    def object_attached(self, parent: Object, child: Object, link: str | None) -> None:
        self.notes.append(("attached", parent.name, child.name, link))

    def object_detached(self, parent: Object, child: Object, link: str | None) -> None:
        self.notes.append(("detached", parent.name, child.name, link))

    def names(self) -> list[tuple[Any, ...]]:
        """Return the kind of each change and its object, without the poses."""
        return [entry[:2] for entry in self.notes]


_INERTIAL = (
    '<inertial><origin xyz="0.11 -0.07 0.23" rpy="0.4 -0.3 0.9"/><mass value="2"/>'
    '<inertia ixx="1" iyy="1" izz="1" ixy="0" ixz="0" iyz="0"/></inertial>'
)
CRANE = f"""<?xml version="1.0"?>
<robot name="crane">
  <link name="foot">{_INERTIAL}<collision><origin xyz="0 0 0.1"/><geometry><box size="0.4 0.6 0.2"/></geometry></collision></link>
  <link name="mast">{_INERTIAL}<collision><origin xyz="0.1 0 0.2" rpy="0.5 0 0"/><geometry><box size="0.1 0.2 0.4"/></geometry></collision></link>
  <link name="boom">{_INERTIAL}</link>
  <link name="hook">{_INERTIAL}<collision><origin xyz="0 0 -0.1"/><geometry><sphere radius="0.05"/></geometry></collision></link>
  <link name="flag"><collision><geometry><cylinder radius="0.03" length="0.2"/></geometry></collision></link>
  <joint name="turning" type="continuous"><parent link="foot"/><child link="mast"/><origin xyz="0.1 0 0.5"/><axis xyz="0 0 1"/></joint>
  <joint name="lifting" type="revolute"><parent link="mast"/><child link="boom"/><origin xyz="0 0.2 0.3" rpy="0 0 0.7"/><axis xyz="0 1 0"/><limit lower="-0.5" upper="1.2" effort="1" velocity="1"/></joint>
  <joint name="reaching" type="prismatic"><parent link="boom"/><child link="hook"/><origin xyz="0.4 0 0" rpy="0.2 0 0"/><axis xyz="1 0 0"/><limit lower="0" upper="0.6" effort="1" velocity="1"/></joint>
  <joint name="pole" type="fixed"><parent link="mast"/><child link="flag"/><origin xyz="0 0 1"/></joint>
</robot>
"""  # noqa: E501 a table of links and joints


def matrix(pose: Pose) -> Matrix:
    """Return the 4 by 4 matrix of a pose, by way of its axis and angle."""
    x, y, z, w = pose.orientation
    length = math.sqrt(x * x + y * y + z * z)
    axis = (x / length, y / length, z / length) if length else (0.0, 0.0, 1.0)
    return shifted(*pose.position) @ turned(axis, 2 * math.atan2(length, w))


def shifted(x: float, y: float, z: float) -> Matrix:
    result = np.eye(4)
    result[:3, 3] = x, y, z
    return result


def turned(axis: Sequence[float], angle: float) -> Matrix:
    """Return the rotation by Rodrigues' formula."""
    x, y, z = axis
    cross = np.array([[0, -z, y], [z, 0, -x], [-y, x, 0]])
    result = np.eye(4)
    result[:3, :3] = np.eye(3) + math.sin(angle) * cross + (1 - math.cos(angle)) * cross @ cross
    return result


X, Y, Z = (1.0, 0.0, 0.0), (0.0, 1.0, 0.0), (0.0, 0.0, 1.0)


def crane_links(base: Pose, *, turning: float, lifting: float, reaching: float) -> dict[str, Matrix]:
    """Return the frames of the crane's links, from the numbers in its description."""
    foot = matrix(base)
    mast = foot @ shifted(0.1, 0, 0.5) @ turned(Z, turning)
    boom = mast @ shifted(0, 0.2, 0.3) @ turned(Z, 0.7) @ turned(Y, lifting)
    hook = boom @ shifted(0.4, 0, 0) @ turned(X, 0.2) @ shifted(reaching, 0, 0)
    return {"foot": foot, "mast": mast, "boom": boom, "hook": hook, "flag": mast @ shifted(0, 0, 1)}


# === base links ===============================================================================================
#
# Robots whose base link is not the root of their model: above a footprint, and on rails that joints move.

HEIGHT_M = 0.2
RAILS = {"rail_x": 0.4, "rail_y": -0.3, "rail_turn": 0.9}
"""The joints between the root of `rail_robot` and its base, nearest to the root first, and a position of each."""


def raised_robot() -> RobotDescription:
    """Return a courier whose base link is fixed 0.2 m above its root, the link `base_footprint`."""
    robot = fromstring(built_in_model("courier"))
    [origin] = robot.iterfind("joint[@name='base_footprint_joint']/origin")
    origin.set("xyz", f"0 0 {HEIGHT_M}")
    return replace(COURIER, name="raised", base_link="base_link", urdf=tostring(robot, encoding="unicode"))


_RAILS = """
<link name="hall"><collision><origin xyz="0 3 0.01"/><geometry><box size="6 0.1 0.02"/></geometry></collision></link>
<link name="carriage"/>
<link name="slide"/>
<joint name="rail_x" type="prismatic"><parent link="hall"/><child link="carriage"/><origin xyz="0 0 0.1"/>
  <axis xyz="1 0 0"/><limit lower="-2" upper="2"/></joint>
<joint name="rail_y" type="prismatic"><parent link="carriage"/><child link="slide"/>
  <axis xyz="0 1 0"/><limit lower="-2" upper="2"/></joint>
<joint name="rail_turn" type="revolute"><parent link="slide"/><child link="base_footprint"/><origin xyz="0 0 0.07"/>
  <axis xyz="0 0 1"/><limit lower="-3" upper="3"/></joint>
"""


def rail_robot() -> RobotDescription:
    """Return a courier on two rails and a turntable above its root, the link `hall`."""
    robot = built_in_model("courier").removesuffix("</robot>")
    return replace(COURIER, name="railed", base_link="base_link", urdf=f"{robot}{_RAILS}</robot>")


def link_poses(robot: Object) -> dict[str, Pose]:
    """Return the pose of every link."""
    return {each: robot.link_pose(each) for each in robot.links}


# === arms =====================================================================================================


def random_arm(rng: random.Random, arm: Arms, limits: Limits) -> dict[str, float]:
    """Return joint angles drawn uniformly within the limits."""
    bounds = PR2.arms[arm].limits(limits)
    return {
        name: rng.uniform(max(bounds[name].lower, -3.14), min(bounds[name].upper, 3.14))
        if "forearm_roll" in name or "wrist_roll" in name
        else rng.uniform(*bounds[name])
        for name in PR2.arms[arm].joints
    }


def random_base_pose(rng: random.Random) -> tuple[Pose, float]:
    """Return a base pose, not only upright, and a torso height."""
    turn = [rng.gauss(0, 1) for _ in range(4)]
    return Pose([rng.uniform(-3, 3) for _ in range(3)], turn), rng.uniform(0.0, 0.33)


def angle_between(a: Quaternion, b: Quaternion) -> float:
    """Return the angle in rad; it is exact also for small angles."""
    x, y, z, _ = product((-a.x, -a.y, -a.z, a.w), b)
    return 2 * math.hypot(x, y, z)


def bullet_frame(target: Object, link: str) -> Matrix:
    """Return the link's frame in the map by Bullet's own forward kinematics, in single precision."""
    number, client = target.body.number, bullet.client_of(target.world)
    names = [
        bullet.getJointInfo(number, joint, physicsClientId=client)[12].decode()
        for joint in range(bullet.getNumJoints(number, physicsClientId=client))
    ]
    state = bullet.getLinkState(number, names.index(link), computeForwardKinematics=True, physicsClientId=client)
    result = np.eye(4)
    result[:3, :3] = np.reshape(bullet.getMatrixFromQuaternion(state[5]), (3, 3))
    result[:3, 3] = state[4]
    return result
