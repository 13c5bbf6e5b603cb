"""PyCRAM's test of moving and picking up (July 2024), by name, as far as it is about the action and not the policy."""

from __future__ import annotations

import random

from pycrorm_async.plan import MoveAndPickUpPerformable, PlanFailure
from pycrorm_async.world import Arms, Grasp, Pose
from tests.plan.conftest import Scene


async def test_move_and_pick_up(scene: Scene) -> None:
    """Of 20 places around the milk, drawn as the default policy draws them, one at least will do."""
    rng = random.Random(69)
    held = []
    for _ in range(20):
        while True:
            x, y = rng.gauss(0, 0.5**0.5), rng.gauss(0, 0.5**0.5)
            if max(abs(x), abs(y)) < 2 and max(abs(x), abs(y)) > 0.2:
                break
        arm, grasp = rng.choice([Arms.LEFT, Arms.RIGHT]), rng.choice(list(Grasp))
        try:
            await MoveAndPickUpPerformable(Pose([1.3 + x, 1 + y, 0]), scene.milk, arm, grasp).perform()
        except PlanFailure:
            assert scene.milk.attached_to in (None, scene.robot)
        else:
            held.append(scene.milk.attached_to)
        scene.world.reset()
    assert 1 <= len(held) < 20
    assert set(held) == {scene.robot}
