"""What a learned policy is worth besides its success where it was learned. Nothing of this is remembered.

How much experience it takes, how it does with the object elsewhere, turned, higher or lower, or with another one, what
it is worth if the arm must not be in anything, and what remembering costs.
"""

from __future__ import annotations

import math
import time
from collections.abc import AsyncIterator
from dataclasses import dataclass, replace
from typing import TYPE_CHECKING

from pycrorm_async.errors import InternalError, NotEnoughExperience
from pycrorm_async.learning.experiment import Experiment, Learned, Phase, Watch, coverage_of, known
from pycrorm_async.learning.policies.default_policy import default_policy
from pycrorm_async.learning.policies.policy import Policy
from pycrorm_async.learning.policies.tree import learn
from pycrorm_async.learning.rollouts import recorded_rollouts
from pycrorm_async.learning.rollouts.rollout_pool import AT_ONCE, Job, Place, Workers
from pycrorm_async.learning.rollouts.rollouts import Tally
from pycrorm_async.learning.rollouts.scene import Scene
from pycrorm_async.query.reading import Reading
from pycrorm_async.world.enums import ObjectType

if TYPE_CHECKING:
    import pandas as pd

__all__ = ["Study", "CurvePoint", "Elsewhere", "Cost", "study", "CURVE", "elsewhere"]

CURVE = (500, 1_000, 2_000, 5_000, 10_000, 20_000, 50_000)
"""So many remembered default rollouts a policy is learned from, as far as there are so many."""
_STUDY_SEED = 2_000_003


@dataclass(frozen=True)
class CurvePoint:
    """What is learned from the first default rollouts."""

    rollouts: int
    successes: int
    tally: Tally
    coverage: float | None


@dataclass(frozen=True)
class Elsewhere:
    """Both policies in another scene."""

    scene: Scene
    default: Tally
    learned: Tally


@dataclass(frozen=True)
class Cost:
    """The same rollouts with and without being remembered: per second, in as many processes."""

    name: str
    rollouts: int
    with_memory: float
    without: float

    @property
    def share(self) -> float:
        """Of the time, what remembering takes."""
        return 1 - self.with_memory / self.without


@dataclass(frozen=True)
class Study:
    curve: tuple[CurvePoint, ...]
    elsewhere: tuple[Elsewhere, ...]
    costs: tuple[Cost, ...]


def elsewhere(scene: Scene) -> tuple[Scene, ...]:
    """The scenes a policy is tried in that was learned in this one; the first is this one itself."""
    x, y, z = scene.position
    raised = replace(scene, torso_height=0.3)
    return (
        scene,
        replace(scene, position=(x - 2.0, y + 1.5, z)),
        replace(scene, yaw=math.pi / 2),
        replace(scene, yaw=-2.0),
        *(replace(scene, position=(x, y, height)) for height in (0.6, 0.75, 1.04, 1.2)),
        replace(raised, position=(x, y, 1.04)),
        replace(raised, position=(x, y, 1.2)),
        replace(scene, name="bowl", object_type=ObjectType.BOWL),
        replace(scene, collisions=not scene.collisions),
    )


async def study(experiment: Experiment, learned: Learned, place: Place, *, rollouts: int, watch: Watch) -> Study:
    """Tries each so often. Raises `WorkerLost`, and `InternalError` if remembering changed what happened."""
    async with Reading.open(place.url) as reading:
        default, evaluation, held_out = [
            await known(reading, experiment.scene, phase.policy, phase.seed, phase.tally.rollouts)
            for phase in (learned.default, learned.evaluation, learned.held_out)
        ]
    async with Workers(experiment.workers, None) as workers:
        trying = _Trying(experiment, workers, rollouts, watch)
        return Study(
            tuple([each async for each in trying.curve(default, held_out)]),
            tuple([await trying.elsewhere(scene, learned.policy) for scene in elsewhere(experiment.scene)]),
            tuple(
                cost
                for cost in (
                    await trying.cost(learned.default, default_policy(), default),
                    await trying.cost(learned.evaluation, learned.policy, evaluation),
                )
                if cost is not None
            ),
        )


class _Trying:
    """Workers that remember nothing."""

    def __init__(self, experiment: Experiment, workers: Workers, rollouts: int, watch: Watch) -> None:
        self._experiment = experiment
        self._workers = workers
        self._rollouts = rollouts
        self._watch = watch
        self._seed = experiment.seed + _STUDY_SEED

    async def curve(self, default: pd.DataFrame, held_out: pd.DataFrame) -> AsyncIterator[CurvePoint]:
        for size in CURVE:
            if size > len(default):
                return
            successes = recorded_rollouts.successes(default, among=size)
            try:
                policy = learn(successes, min_samples_leaf=self._experiment.min_samples_leaf)
            except NotEnoughExperience:
                continue
            tally = await self._tried(f"learned from {size:,} rollouts", self._experiment.scene, policy)
            yield CurvePoint(size, len(successes), tally, coverage_of(held_out, policy))

    async def elsewhere(self, scene: Scene, policy: Policy) -> Elsewhere:
        default = await self._tried(f"default policy: {scene}", scene, default_policy())
        return Elsewhere(scene, default, await self._tried(f"learned policy: {scene}", scene, policy))

    async def cost(self, phase: Phase, policy: Policy, frame: pd.DataFrame) -> Cost | None:
        """None if the phase was not done in this run. Raises `InternalError` if the same rollouts ended otherwise."""
        if phase.rate is None:
            return None
        count = min(len(frame), 4 * self._rollouts)
        began = time.monotonic()
        tally = await self._tried(f"{phase.name}, not remembered", self._experiment.scene, policy, phase.seed, count)
        seconds = time.monotonic() - began
        if tally != recorded_rollouts.tally_of(frame[frame["index"] < count]):
            raise InternalError(f"{phase.name}: rollouts ended otherwise when they were not remembered")
        return Cost(phase.name, count, phase.rate, count / seconds)

    async def _tried(
        self, name: str, scene: Scene, policy: Policy, seed: int | None = None, count: int | None = None
    ) -> Tally:
        count = self._rollouts if count is None else count
        job = Job(scene, policy, self._seed if seed is None else seed, remembered=False)
        runs = recorded_rollouts.missing((), count, at_once=min(AT_ONCE, -(-count // self._experiment.workers)))
        return await self._workers.roll_out(job, runs, lambda tally: self._watch(name, tally.rollouts, count, tally))
