"""The default policy picks any arm and any grasp at random, from a random position within 2 m of the object.

Arm and grasp are equally likely. relative_x and relative_y are normal with a variance of 0.5 m², in (-2 m, 2 m)²
without the open square (-0.2 m, 0.2 m)² around the object; that region holds 0.94107 of the normal distribution.
"""

from __future__ import annotations

import math

from pycrorm_async.learning.policies.evidence import Evidence, Rectangle, Region
from pycrorm_async.learning.policies.marginals import Normal
from pycrorm_async.learning.policies.policy import ARMS, GRASPS, Leaf, Policy

VARIANCE_M2 = 0.5
"""The variance in m² of the base's place along each axis around the object, as in the thesis."""
FARTHEST_M = 2.0
"""Half the side in m of the square around the object in which the base is placed, as in the thesis."""
NEAREST_M = 0.2
"""Half the side in m of the square around the object that is left out, as in the thesis."""

AROUND_OBJECT = Region(
    (
        Rectangle(-FARTHEST_M, -NEAREST_M, -FARTHEST_M, FARTHEST_M),
        Rectangle(NEAREST_M, FARTHEST_M, -FARTHEST_M, FARTHEST_M),
        Rectangle(-NEAREST_M, NEAREST_M, -FARTHEST_M, -NEAREST_M),
        Rectangle(-NEAREST_M, NEAREST_M, NEAREST_M, FARTHEST_M),
    )
)


def default_policy() -> Policy:
    """Return the policy to start learning from; it does not depend on height.

    >>> default_policy().probability(Evidence(arms=frozenset({Arms.LEFT})))
    0.5
    """
    place = Normal(0.0, math.sqrt(VARIANCE_M2))
    anywhere = Leaf(1.0, (1 / len(ARMS),) * len(ARMS), (1 / len(GRASPS),) * len(GRASPS), place, place)
    return Policy((anywhere,), Evidence(region=AROUND_OBJECT))
