"""Try one pick-up in the kitchen with a policy learned without a kitchen, as at the end of the thesis' notebook."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from pycrorm_async.learning.policies.policy import Policy
from pycrorm_async.learning.rollouts.move_and_pick_up import MoveAndPickUp
from pycrorm_async.learning.rollouts.rollout_pool import MemoryLocation
from pycrorm_async.learning.rollouts.scene import Scene
from pycrorm_async.memory import Memory
from pycrorm_async.plan.actions.basic import MoveAndPickUpPerformable
from pycrorm_async.plan.failures import PlanFailure

KITCHEN = Scene(kitchen=True, collisions=True, torso_height=0.3)
"""The thesis' milk on the worktop, with the torso raised so that the arm can stay clear of the worktop."""


@dataclass(frozen=True)
class KitchenResult:
    """The result of `pick_up_in_kitchen`.

    Attributes:
        tries: number of samples tried; only the last one can have succeeded.
        done: the action that succeeded; None if none did.
        failure: message of the last failure; None after a success.
        episode: the episode's id.
    """

    tries: int
    done: MoveAndPickUpPerformable | None
    failure: str | None
    episode: str


async def pick_up_in_kitchen(
    policy: Policy, place: MemoryLocation, *, seed: int, scene: Scene = KITCHEN
) -> KitchenResult:
    """Try samples of the policy in order of likelihood until one succeeds, at places that `free_and_visible` allows.

    Records one episode, which is visible when this returns.
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
                except PlanFailure as reason:  # raised by the iteration: the policy has no sample that fits the scene
                    failure = str(reason)
        await memory.flush()
    return KitchenResult(tries, done, failure, str(episode))
