"""Evaluate a learned policy outside the scene in which it was learned. None of these rollouts is recorded.

The evaluation measures how success grows with experience; how the policy performs with the object at another place,
turned, higher or lower, or with another object; how it performs when an arm in collision is a failure; and how much
recording slows the rollouts down.
"""

from __future__ import annotations

import math
import time
from collections.abc import AsyncIterator
from dataclasses import dataclass, replace
from typing import TYPE_CHECKING

from pycrorm_async.errors import InternalError, NotEnoughExperience
from pycrorm_async.learning.experiment import (
    Experiment,
    ExperimentResult,
    Phase,
    ReportProgress,
    coverage_of,
    read_rollouts,
)
from pycrorm_async.learning.policies.default_policy import default_policy
from pycrorm_async.learning.policies.policy import Policy
from pycrorm_async.learning.policies.tree import learn
from pycrorm_async.learning.rollouts import recorded_rollouts
from pycrorm_async.learning.rollouts.rollout_pool import ROLLOUTS_PER_RUN, Job, MemoryLocation, Workers
from pycrorm_async.learning.rollouts.rollouts import Tally
from pycrorm_async.learning.rollouts.scene import Scene
from pycrorm_async.query.reading import Reading
from pycrorm_async.world.enums import ObjectType

if TYPE_CHECKING:
    import pandas as pd

CURVE = (500, 1_000, 2_000, 5_000, 10_000, 20_000, 50_000)
"""Numbers of default rollouts to learn from, one point of the learning curve each; those above the recorded number
are skipped. 50,000 is the number of the thesis."""
_STUDY_SEED = 2_000_003
"""Added to the experiment's seed, so that the evaluation does not repeat the rollouts it learned from."""


@dataclass(frozen=True)
class CurvePoint:
    """A policy learned from the first `rollouts` default rollouts.

    Attributes:
        successes: those among them that succeeded; the policy is learned from these.
        tally: how the policy performed.
        coverage: see `coverage_of`.
    """

    rollouts: int
    successes: int
    tally: Tally
    coverage: float | None


@dataclass(frozen=True)
class SceneComparison:
    """The results of the default and the learned policy in one scene."""

    scene: Scene
    default: Tally
    learned: Tally


@dataclass(frozen=True)
class Cost:
    """Rollouts per second with and without recording: the same rollouts, in the same number of processes."""

    name: str
    rollouts: int
    with_memory: float
    without: float

    @property
    def share(self) -> float:
        """The share of the time that recording takes, 0 to 1."""
        return 1 - self.with_memory / self.without


@dataclass(frozen=True)
class Study:
    """The results of `study`: the learning curve, the scenes (the first is that of the experiment), the costs."""

    curve: tuple[CurvePoint, ...]
    scenes: tuple[SceneComparison, ...]
    costs: tuple[Cost, ...]


def scene_variants(scene: Scene) -> tuple[Scene, ...]:
    """Return the scenes in which to evaluate a policy that was learned in `scene`, which comes first."""
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


async def study(
    experiment: Experiment,
    learned: ExperimentResult,
    place: MemoryLocation,
    *,
    rollouts: int,
    report_progress: ReportProgress,
) -> Study:
    """Evaluate the learned policy, `rollouts` rollouts per point and scene.

    Raises `WorkerLost`, and `InternalError` if the same rollouts ended differently without recording.
    """
    async with Reading.open(place.url) as reading:
        default, evaluation, held_out = [
            await read_rollouts(reading, experiment.scene, phase.policy, phase.seed, phase.tally.rollouts)
            for phase in (learned.default, learned.evaluation, learned.held_out)
        ]
    async with Workers(experiment.workers, None) as workers:
        evaluator = _Evaluator(experiment, workers, rollouts, report_progress)
        return Study(
            tuple([each async for each in evaluator.curve(default, held_out)]),
            tuple([await evaluator.compare(scene, learned.policy) for scene in scene_variants(experiment.scene)]),
            tuple(
                cost
                for cost in (
                    await evaluator.cost(learned.default, default_policy(), default),
                    await evaluator.cost(learned.evaluation, learned.policy, evaluation),
                )
                if cost is not None
            ),
        )


class _Evaluator:
    """Run the evaluation's rollouts in workers that record nothing."""

    def __init__(
        self, experiment: Experiment, workers: Workers, rollouts: int, report_progress: ReportProgress
    ) -> None:
        self._experiment = experiment
        self._workers = workers
        self._rollouts = rollouts
        self._report_progress = report_progress
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
            tally = await self._tally(f"learned from {size:,} rollouts", self._experiment.scene, policy)
            yield CurvePoint(size, len(successes), tally, coverage_of(held_out, policy))

    async def compare(self, scene: Scene, policy: Policy) -> SceneComparison:
        default = await self._tally(f"default policy: {scene}", scene, default_policy())
        return SceneComparison(scene, default, await self._tally(f"learned policy: {scene}", scene, policy))

    async def cost(self, phase: Phase, policy: Policy, frame: pd.DataFrame) -> Cost | None:
        """Repeat rollouts of the phase without recording them; None if this run did not perform the phase.

        Raises `InternalError` if the same rollouts ended differently.
        """
        if phase.rate is None:
            return None
        count = min(len(frame), 4 * self._rollouts)
        began = time.monotonic()
        tally = await self._tally(f"{phase.name}, not recorded", self._experiment.scene, policy, phase.seed, count)
        seconds = time.monotonic() - began
        if tally != recorded_rollouts.tally_of(frame[frame["index"] < count]):
            raise InternalError(f"{phase.name}: the same rollouts ended differently without recording")
        return Cost(phase.name, count, phase.rate, count / seconds)

    async def _tally(
        self, name: str, scene: Scene, policy: Policy, seed: int | None = None, count: int | None = None
    ) -> Tally:
        count = self._rollouts if count is None else count
        job = Job(scene, policy, self._seed if seed is None else seed, recorded=False)
        runs = recorded_rollouts.missing_runs(
            (), count, length_max=min(ROLLOUTS_PER_RUN, -(-count // self._experiment.workers))
        )
        return await self._workers.roll_out(
            job, runs, lambda tally: self._report_progress(name, tally.rollouts, count, tally)
        )
