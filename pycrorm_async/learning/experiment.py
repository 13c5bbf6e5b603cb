"""The learning experiment of the thesis (5.2): try at random, remember, learn from what went well, try again.

Everything that is learned from or told comes out of the memory, by questions; what the workers counted is held
against it. An interrupted experiment goes on with the rollouts that are not remembered yet.
"""

from __future__ import annotations

import time
from collections.abc import AsyncIterator, Callable, Sequence
from contextlib import asynccontextmanager
from dataclasses import dataclass, field
from typing import TYPE_CHECKING

from pycrorm_async.errors import CallerError, InternalError
from pycrorm_async.learning.policies.default_policy import default_policy
from pycrorm_async.learning.policies.policy import PickUpChoice, Policy
from pycrorm_async.learning.policies.policy_file import name_of
from pycrorm_async.learning.policies.tree import check_leaf, learn
from pycrorm_async.learning.rollouts import recorded_rollouts
from pycrorm_async.learning.rollouts.recorded_rollouts import tally_of
from pycrorm_async.learning.rollouts.rollout_pool import AT_ONCE, Job, Place, Workers
from pycrorm_async.learning.rollouts.rollouts import Tally
from pycrorm_async.learning.rollouts.scene import Scene
from pycrorm_async.operations.recovery import recover
from pycrorm_async.query.reading import Reading
from pycrorm_async.world.enums import Arms, Grasp

if TYPE_CHECKING:
    import pandas as pd

__all__ = ["Experiment", "Phase", "Learned", "Watch", "run", "known", "coverage_of", "HELD_OUT_SEED"]

HELD_OUT_SEED = 1_000_003
"""Added to the experiment's seed for the default rollouts that nothing is learned from."""

Watch = Callable[[str, int, int, Tally], None]
"""Is told what is done, how much of it, of how much, and how it went so far."""


@dataclass(frozen=True)
class Experiment:
    """What is to be tried.

    Attributes:
        rollouts: in each round: the first under the default policy, the next ones under what was learned so far.
        rounds: after each a policy is learned from the successes of all.
        evaluate: rollouts under the last policy, to see what it is worth.
        held_out: default rollouts that are not learned from, to see how much of what works it still does.
        min_samples_leaf: of the tree.
        scene: where.
        workers: processes.
        episode_each: each rollout is an episode of its own; otherwise some hundred are one.
        resume: goes on with what is remembered of the same experiment; otherwise there must be nothing of it.
    """

    rollouts: int = 50_000
    rounds: int = 1
    evaluate: int = 10_000
    held_out: int = 5_000
    seed: int = 69
    min_samples_leaf: int = 25
    scene: Scene = field(default_factory=Scene)
    workers: int = 1
    episode_each: bool = False
    resume: bool = False

    def __post_init__(self) -> None:
        for name in ("rollouts", "rounds", "evaluate", "held_out", "workers"):
            if getattr(self, name) < 1:
                raise CallerError(f"an experiment has at least one of {name.replace('_', '-')}")
        check_leaf(self.min_samples_leaf)
        if not 0 <= self.seed < 2**62:
            raise CallerError("a seed is a whole number from 0 on, below 2**62")


@dataclass(frozen=True)
class Phase:
    """Rollouts under one policy, as the memory has them.

    Attributes:
        name: in words.
        policy: its name.
        tally: how they ended.
        stages: at which goal of the hand how many failed.
        arms, grasps: how the pick-ups with each ended.
        done_now: how many were done in this run, while the others were remembered.
        seconds: what that took, until all were in the tables.
    """

    name: str
    policy: str
    seed: int
    tally: Tally
    stages: dict[str, int]
    arms: dict[str, Tally]
    grasps: dict[str, Tally]
    done_now: int
    seconds: float

    @property
    def rate(self) -> float | None:
        """Rollouts per second of this run; None if none was done."""
        return self.done_now / self.seconds if self.done_now else None


@dataclass(frozen=True)
class Learned:
    """What came out.

    Attributes:
        phases: default rollouts, further rounds, evaluation, held out.
        policy: the last one; `leaves` of its tree.
        successes: the choices it was learned from.
        coverage: the share of the held-out successes that it could have made; None if there is none.
    """

    phases: tuple[Phase, ...]
    policy: Policy
    successes: tuple[PickUpChoice, ...]
    coverage: float | None

    @property
    def default(self) -> Phase:
        return self.phases[0]

    @property
    def evaluation(self) -> Phase:
        return self.phases[-2]

    @property
    def held_out(self) -> Phase:
        return self.phases[-1]


class _Rolling:
    """Workers, and a memory to look into."""

    def __init__(self, experiment: Experiment, workers: Workers, reading: Reading, watch: Watch) -> None:
        self._experiment = experiment
        self._workers = workers
        self._reading = reading
        self._watch = watch
        self.phases: list[Phase] = []

    async def phase(self, name: str, policy: Policy, seed: int, count: int) -> pd.DataFrame:
        """The rollouts 0 to `count` under this policy; those that are not remembered are done first."""
        experiment = self._experiment
        before = await known(self._reading, experiment.scene, name_of(policy), seed, count)
        if len(before) and not experiment.resume:
            raise CallerError(
                f"{len(before):,} rollouts of this experiment are remembered already (seed {experiment.seed},"
                f" {experiment.scene}): go on with --resume, or take another --seed or --url"
            )
        began, already, counted = time.monotonic(), recorded_rollouts.tally_of(before), Tally()
        frame = before
        if len(before) < count:
            job = Job(experiment.scene, policy, seed, episode_each=experiment.episode_each)
            runs = recorded_rollouts.missing(before["index"], count, at_once=AT_ONCE)
            counted = await self._workers.roll_out(
                job, runs, lambda tally: self._watch(name, len(before) + tally.rollouts, count, already + tally)
            )
        seconds = time.monotonic() - began
        if counted.rollouts:
            frame = await known(self._reading, experiment.scene, name_of(policy), seed, count)
        tally = tally_of(frame)
        if tally != already + counted or tally.rollouts != count:
            raise InternalError(f"{name}: {already + counted} was counted, {tally} is remembered")
        self.phases.append(
            Phase(
                name,
                name_of(policy),
                seed,
                tally,
                recorded_rollouts.stages_of(frame),
                {
                    each.name: recorded_rollouts.tally_of(frame[frame.arm == each.name])
                    for each in (Arms.LEFT, Arms.RIGHT)
                },
                {each.name: recorded_rollouts.tally_of(frame[frame.grasp == each.name]) for each in Grasp},
                counted.rollouts,
                seconds,
            )
        )
        return frame


async def run(experiment: Experiment, place: Place, watch: Watch = lambda *_: None) -> Learned:
    """Does the experiment, or what is left of it.

    Raises:
        CallerError: it is remembered already, and not to be resumed.
        NotEnoughExperience: too few rollouts went well to learn from them; all are remembered.
        WorkerLost: a worker died; what was done is remembered.
        InternalError: the memory does not hold what was counted.
    """
    async with _rolling(experiment, place, watch) as rolling:
        policy, frames = default_policy(), []
        for number in range(experiment.rounds):
            name = "default policy" if number == 0 else f"learned policy, round {number + 1}"
            frame = await rolling.phase(name, policy, experiment.seed + number, experiment.rollouts)
            frames.append(recorded_rollouts.successes(frame))
            policy = _learned(frames, experiment)
        await rolling.phase("learned policy", policy, experiment.seed + experiment.rounds, experiment.evaluate)
        held_out_seed = experiment.seed + HELD_OUT_SEED
        held_out = await rolling.phase("default policy, held out", default_policy(), held_out_seed, experiment.held_out)
        return Learned(
            tuple(rolling.phases),
            policy,
            tuple(choice for frame in frames for choice in choices_of(frame)),
            coverage_of(held_out, policy),
        )


@asynccontextmanager
async def _rolling(experiment: Experiment, place: Place, watch: Watch) -> AsyncIterator[_Rolling]:
    await recover(place.url, spool=place.spool)  # what killed workers had not handed over; it makes the tables too
    async with Workers(experiment.workers, place) as workers, Reading.open(place.url) as reading:
        yield _Rolling(experiment, workers, reading, watch)


def _learned(frames: Sequence[pd.DataFrame], experiment: Experiment) -> Policy:
    import pandas as pd

    return learn(pd.concat(frames), min_samples_leaf=experiment.min_samples_leaf)


async def known(reading: Reading, scene: Scene, policy: str, seed: int, count: int) -> pd.DataFrame:
    """Those of the rollouts 0 to `count` that are remembered, each once."""
    question = recorded_rollouts.rollouts_question(scene=str(scene), seed=seed, policy=policy)
    frame = recorded_rollouts.once(await reading.dataframe(question))
    return frame[frame["index"] < count]


def coverage_of(held_out: pd.DataFrame, policy: Policy) -> float | None:
    """The share of these rollouts' successes that the policy could have made; None if there is none."""
    choices = choices_of(recorded_rollouts.successes(held_out))
    return policy.coverage(choices) if choices else None


def choices_of(frame: pd.DataFrame) -> list[PickUpChoice]:
    """The rows as choices."""
    columns = (frame.arm, frame.grasp, frame.object_x, frame.object_y)
    return [
        PickUpChoice(Arms[arm], Grasp[grasp], float(x), float(y)) for arm, grasp, x, y in zip(*columns, strict=True)
    ]
