"""PyCRAM's tests of moving and picking up (July 2024), by name, with their assertions."""

from __future__ import annotations

from itertools import combinations

import numpy as np
import pytest

from pycrorm_async.learning import Evidence, MoveAndPickUp, PickUpChoice, Rectangle, Region, default_policy
from pycrorm_async.plan import PlanFailure, Retry
from tests.plan.conftest import Scene

pytestmark = pytest.mark.slow


def test_create_model() -> None:
    """No base pose is inside the object; there are four variables."""
    centre = Region((Rectangle(-0.2, 0.2, -0.2, 0.2),))
    assert default_policy().probability(Evidence(region=centre)) == 0
    assert PickUpChoice._fields == ("arm", "grasp", "relative_x", "relative_y")


def test_grounding(scene: Scene) -> None:
    """The places that are free and see the object are disjoint pieces, and there is a policy for it in the scene."""
    grounded = MoveAndPickUp(scene.milk).grounded()
    region = grounded.evidence.region
    assert region is not None
    assert region.rectangles
    for one, other in combinations(region.rectangles, 2):
        apart_x = one.x_max <= other.x_min or other.x_max <= one.x_min
        assert apart_x or one.y_max <= other.y_min or other.y_max <= one.y_min
    assert grounded.sample(np.random.default_rng(69), 5)


@pytest.mark.parametrize("seed", [69, 420])
async def test_move_and_pick_up(scene: Scene, seed: int) -> None:
    """At least one of twenty samples for the scene succeeds."""
    rng = np.random.default_rng(seed)
    tries = iter(MoveAndPickUp(scene.milk, samples=20, rng=rng))
    for each in tries:
        try:
            await each.perform()
        except PlanFailure:
            scene.world.reset()
        else:
            break
    assert scene.milk.attached_to is scene.robot
    scene.world.reset()
    await Retry(MoveAndPickUp(scene.milk, rng=np.random.default_rng(seed)), max_tries=20).perform()
    assert scene.milk.attached_to is scene.robot
