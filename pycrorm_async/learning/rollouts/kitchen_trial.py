"""One pick-up in the kitchen with a policy that was learned without one, as at the end of the thesis' notebook."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from pycrorm_async.learning.policies.policy import Policy
from pycrorm_async.learning.rollouts.move_and_pick_up import MoveAndPickUp
from pycrorm_async.learning.rollouts.rollout_pool import Place
from pycrorm_async.learning.rollouts.scene import Scene
from pycrorm_async.memory import Memory
from pycrorm_async.plan.actions.basic import MoveAndPickUpPerformable
from pycrorm_async.plan.failures import PlanFailure

__all__ = ["InKitchen", "pick_up_in_kitchen", "KITCHEN"]

KITCHEN = Scene(kitchen=True, collisions=True, torso_height=0.3)
"""The milk of the thesis on the worktop, and the torso up: the arm has to stay out of the worktop."""


@dataclass(frozen=True)
class InKitchen:
    """How it went.

    Attributes:
        tries: how many samples were tried; the last one succeeded, if any did.
        done: what succeeded; None if nothing did, then `failure` says why in the end.
        episode: the episode's id.
    """

    tries: int
    done: MoveAndPickUpPerformable | None
    failure: str | None
    episode: str


async def pick_up_in_kitchen(policy: Policy, place: Place, *, seed: int, scene: Scene = KITCHEN) -> InKitchen:
    """Samples of the policy, grounded in where the robot can stand and see the object, the likeliest first.

    Remembered as one episode, in the tables when this returns.
    """
    tries, done, failure = 0, None, None
    async with Memory.open(place.url, spool=place.spool) as memory:
        description = "picking up in the kitchen with a learned policy"
        async with memory.episode(description=description, plan="learn", seed=seed) as episode:
            with scene.entered() as stage:
                action = MoveAndPickUp(stage.target, policy=policy, rng=np.random.default_rng(seed))
                try:
                    for each in action:
                        tries += 1
                        try:
                            await each.perform()
                        except PlanFailure as reason:
                            failure = str(reason)
                        else:
                            done, failure = each, None
                            break
                except PlanFailure as nowhere:
                    failure = str(nowhere)
        await memory.flush()
    return InKitchen(tries, done, failure, str(episode))
