"""Models loaded directly into Bullet, without the package's world: the oracle for frames and forward kinematics."""

from __future__ import annotations

import math
import random
from collections.abc import Mapping
from pathlib import Path

import numpy as np

from pycrorm_async.world import Object
from pycrorm_async.world.pose import Arms, Pose, Quaternion, Vector, product
from pycrorm_async.world.urdf import PR2, Limits
from tests import bullet
from tests.world.fakes import Matrix

# === loaded model =============================================================================================
#
# A model loaded directly into Bullet, without the package's world: the oracle for frames and forward kinematics.

LINK_WORLD_POSITION, LINK_WORLD_ORIENTATION = 4, 5


class LoadedModel:
    """One URDF in a Bullet of its own, without a window."""

    def __init__(self, urdf: Path) -> None:
        self._client = bullet.connect(bullet.DIRECT)
        self._body = bullet.loadURDF(str(urdf), useFixedBase=True, physicsClientId=self._client)
        facts = [
            bullet.getJointInfo(self._body, index, physicsClientId=self._client)
            for index in range(bullet.getNumJoints(self._body, physicsClientId=self._client))
        ]
        self.root: str = bullet.getBodyInfo(self._body, physicsClientId=self._client)[0].decode()
        self.links: dict[str, int] = {fact[12].decode(): fact[0] for fact in facts}
        self._joints: dict[str, int] = {fact[1].decode(): fact[0] for fact in facts}
        self.limits: dict[str, tuple[float, float]] = {
            fact[1].decode(): (fact[8], fact[9]) for fact in facts if fact[2] != bullet.JOINT_FIXED
        }

    def close(self) -> None:
        bullet.disconnect(physicsClientId=self._client)

    def put(self, *, base: Pose, joints: Mapping[str, float]) -> None:
        bullet.resetBasePositionAndOrientation(
            self._body, base.position, base.orientation, physicsClientId=self._client
        )
        for name, value in joints.items():
            bullet.resetJointState(self._body, self._joints[name], value, physicsClientId=self._client)

    def link_pose(self, link: str) -> Pose:
        state = bullet.getLinkState(
            self._body, self.links[link], computeForwardKinematics=True, physicsClientId=self._client
        )
        return Pose(state[LINK_WORLD_POSITION], state[LINK_WORLD_ORIENTATION])

    def bounding_box(self, link: str) -> tuple[Vector, Vector]:
        lower, upper = bullet.getAABB(self._body, self.links[link], physicsClientId=self._client)
        return Vector(*lower), Vector(*upper)


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


# === bullet frames ============================================================================================
#
# Return a link's frame by Bullet's own forward kinematics, in single precision, without the package's code.


def bullet_frame(target: Object, link: str) -> Matrix:
    """Return the link's frame in the map as a 4 by 4 matrix."""
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
