"""Return a link's frame by Bullet's own forward kinematics, in single precision, without the package's code."""

from __future__ import annotations

import numpy as np

from pycrorm_async.world import Object
from tests import bullet
from tests.world.fakes import Matrix


def bullet_frame(target: Object, link: str) -> Matrix:
    """Return the link's frame in the map as a 4 by 4 matrix."""
    number, client = target.body.number, target.world.client
    names = [
        bullet.getJointInfo(number, joint, physicsClientId=client)[12].decode()
        for joint in range(bullet.getNumJoints(number, physicsClientId=client))
    ]
    state = bullet.getLinkState(number, names.index(link), computeForwardKinematics=True, physicsClientId=client)
    result = np.eye(4)
    result[:3, :3] = np.reshape(bullet.getMatrixFromQuaternion(state[5]), (3, 3))
    result[:3, 3] = state[4]
    return result
