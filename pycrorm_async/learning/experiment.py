"""Run the learning experiment of the thesis (5.2): perform random pick-ups, learn from the successes, try again.

A policy of another kind is learned in the same way (`Learned`): its first round tries ways of the default policy with
any height of the torso. A success model learns from the failures too, and can try where it is unsure.

Every result is queried from the memory and compared with the workers' own counts. An interrupted experiment can be
resumed: only the rollouts that are not recorded yet are performed.
"""

from __future__ import annotations

import asyncio
import math
import time
from collections import Counter
from collections.abc import AsyncIterator, Callable, Iterable
from contextlib import asynccontextmanager, suppress
from contextvars import Context
from dataclasses import dataclass, field, replace
from enum import StrEnum
from itertools import compress
from typing import TYPE_CHECKING

import numpy as np
from numpy.typing import NDArray
from sqlalchemy import select

from pycrorm_async.errors import CallerError, InternalError, NotEnoughExperience
from pycrorm_async.learning import rollouts as recorded_rollouts
from pycrorm_async.learning.cluster import RolloutPool, check_cluster, rollout_pool
from pycrorm_async.learning.features import PickUpContext, features_of_frame
from pycrorm_async.learning.move_and_pick_up import MoveAndPickUp
from pycrorm_async.learning.polar_policy import PolarPolicy
from pycrorm_async.learning.policy import Floats, PickUpChoice, Policy, default_policy
from pycrorm_async.learning.policy_file import AnyPolicy, name_of
from pycrorm_async.learning.pool import ROLLOUTS_PER_RUN, SETTINGS, MemoryLocation, RolloutTask
from pycrorm_async.learning.recorded_policy import (
    Evaluation,
    HeldOut,
    read_evaluation,
    record_evaluation,
    record_policy,
)
from pycrorm_async.learning.rollouts import Tally, tally_of
from pycrorm_async.learning.scenes import Disturbance, Scene, Stage
from pycrorm_async.learning.success_model import CONFIDENT, Draws, SuccessModel
from pycrorm_async.learning.tree import check_leaf, learn, learn_polar
from pycrorm_async.memory import Memory
from pycrorm_async.operations.recovery import recover
from pycrorm_async.orm import LearnPolicyAction
from pycrorm_async.plan.actions import MoveAndPickUpPerformable
from pycrorm_async.plan.failures import PlanFailure
from pycrorm_async.query.reading import Reading
from pycrorm_async.task_status import TaskStatus
from pycrorm_async.world.pose import Arms, Grasp, ObjectType

if TYPE_CHECKING:
    import pandas as pd


_DRAWN = 20_000
"""The ways from which the figure of a policy that sets the torso is drawn."""
HELD_OUT_SEED = 1_000_003
"""Added to the experiment's seed for the held-out default rollouts, so that their seed is not used for learning."""

CEILING_WAYS, CEILING_SCENES = 500, 100
"""The most ways that are tried in a scene, and the most scenes. With tables, 100 scenes take about 20 s."""
_CEILING = 4
"""Separates the random numbers of these ways from those of scenes, errors and policies."""

ReportProgress = Callable[[str, int, int, Tally], None]
"""Callback for progress: the phase's name, rollouts done, rollouts in total, results so far."""


class Learned(StrEnum):
    """The kinds of policies that an experiment learns.

    Attributes:
        PLACES: a tree of places, the thesis' policy (`learn`).
        POLAR: a tree of polar features, which sets the torso (`learn_polar`).
        SUCCESS: a success model (`SuccessModel`).
    """

    PLACES = "places"
    POLAR = "polar"
    SUCCESS = "success"


@dataclass(frozen=True)
class Experiment:
    """The parameters of an experiment.

    Attributes:
        model: what is learned.
        explore: how a success model picks the ways that are tried in all rounds but the first.
        rollouts: rollouts per round: the first round uses the default policy, each later one the policy learned so
            far.
        rounds: number of rounds; after each, a policy is learned from the successes of all rounds.
        evaluate: rollouts under the last policy, to measure its success rate.
        held_out: default rollouts that are not learned from, to measure the coverage of the last policy.
        min_samples_leaf: minimum number of samples in a leaf of the tree.
        scene: the scene of every rollout.
        workers: number of worker processes.
        cluster: address of the scheduler of a Dask cluster whose workers perform the rollouts instead.
        episode_each: record each rollout as an episode of its own; otherwise a few hundred share one.
        resume: continue from the recorded rollouts of the same experiment; otherwise none may be recorded.
    """

    rollouts: int = 50_000
    rounds: int = 1
    evaluate: int = 10_000
    held_out: int = 5_000
    seed: int = 69
    model: Learned = Learned.PLACES
    explore: Draws = Draws.UNCERTAIN
    min_samples_leaf: int = 25
    scene: Scene = field(default_factory=Scene)
    workers: int = 1
    cluster: str | None = None
    episode_each: bool = False
    resume: bool = False

    def __post_init__(self) -> None:
        for name in ("rollouts", "rounds", "evaluate", "held_out", "workers"):
            if getattr(self, name) < 1:
                raise CallerError(f"an experiment needs {name.replace('_', '-')} >= 1, got {getattr(self, name)}")
        check_leaf(self.min_samples_leaf)
        if self.rollouts < self.min_samples_leaf:
            raise CallerError(
                f"{self.rollouts} rollouts cannot have the {self.min_samples_leaf} successes that a leaf takes: choose"
                " a larger --rollouts (rollouts=) or a smaller --min-samples-leaf (min_samples_leaf=)"
            )
        if not 0 <= self.seed < 2**62:
            raise CallerError(f"seed must be >= 0 and < 2**62, got {self.seed}")


@dataclass(frozen=True)
class Phase:
    """The recorded rollouts under one policy.

    Attributes:
        name: the phase in words.
        policy: the policy's name, see `name_of`.
        tally: how the rollouts ended.
        stages: number of failures by stage of the pick-up, see `STAGES`.
        arms, grasps: how the pick-ups with each arm and each grasp ended.
        done_now: rollouts performed by this run; the others were recorded before.
        seconds: duration of those, until all their rows were visible, s.
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
        """Rollouts per second of this run; None if this run performed none."""
        return self.done_now / self.seconds if self.done_now else None


@dataclass(frozen=True)
class ExperimentResult:
    """The result of an experiment.

    Attributes:
        phases: in this order: default rollouts, further rounds, evaluation, held-out rollouts.
        policy: the policy of the last round.
        successes: the choices that succeeded among those from which it was learned.
        coverage: the share of the held-out successes that the policy could have chosen; None if none succeeded. Of a
            success model, that of which it is confident.
        ceiling: the share of held-out scenes in which some way succeeds, see `ceiling_of`; None if it was not measured.
    """

    phases: tuple[Phase, ...]
    policy: AnyPolicy
    successes: tuple[PickUpChoice, ...]
    coverage: float | None
    ceiling: float | None = None

    @property
    def default(self) -> Phase:
        return self.phases[0]

    @property
    def evaluation(self) -> Phase:
        return self.phases[-2]

    @property
    def held_out(self) -> Phase:
        return self.phases[-1]


class _PhaseRunner:
    """Run the phases of one experiment with workers, and query each phase's results from the memory."""

    def __init__(
        self,
        experiment: Experiment,
        place: MemoryLocation,
        workers: RolloutPool,
        reading: Reading,
        report_progress: ReportProgress,
    ) -> None:
        self._experiment = experiment
        self._workers = workers
        self._reading = reading
        self._report_progress = report_progress
        self._place = place
        self.phases: list[Phase] = []

    async def phase(self, name: str, policy: AnyPolicy, seed: int, count: int) -> pd.DataFrame:
        """Return the rollouts with index 0 to `count` - 1 under this policy; perform those not recorded yet first."""
        experiment = self._experiment
        recorded = await self._read(policy, seed, count)
        if len(recorded) and not experiment.resume:
            raise CallerError(
                f"{len(recorded):,} rollouts of this experiment are recorded already (seed {experiment.seed},"
                f" {experiment.scene}): continue with --resume, or choose another --seed or --url"
            )
        began, recorded_tally, counted = time.monotonic(), recorded_rollouts.tally_of(recorded), Tally()
        frame = recorded
        if len(recorded) < count:
            job = RolloutTask(experiment.scene, policy, seed, episode_each=experiment.episode_each)
            runs = recorded_rollouts.missing_runs(recorded["index"], count, length_max=ROLLOUTS_PER_RUN)
            counted = await self._workers.roll_out(
                job,
                runs,
                lambda tally: self._report_progress(
                    name, len(recorded) + tally.rollouts, count, recorded_tally + tally
                ),
            )
        seconds = time.monotonic() - began
        if counted.rollouts:
            frame = await self._read(policy, seed, count)
        tally = tally_of(frame)
        if tally != recorded_tally + counted or tally.rollouts != count:
            raise InternalError(f"{name}: the workers counted {recorded_tally + counted}, the memory holds {tally}")
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

    async def _read(self, policy: AnyPolicy, seed: int, count: int) -> pd.DataFrame:
        scene, predicted = self._experiment.scene, not isinstance(policy, Policy)
        return await read_rollouts(self._reading, scene, name_of(policy), seed, count, predicted=predicted)

    async def record(self, policy: AnyPolicy, *, rounds: int, successes: int) -> None:
        """Record the policy learned after that many rounds, with its training episodes, unless it is recorded."""
        experiment, name = self._experiment, name_of(policy)
        seeds = [experiment.seed + number for number in range(rounds)]
        scene, policies = str(experiment.scene), [each.policy for each in self.phases[:rounds]]
        async with self._reading.session() as session:
            if await session.scalar(select(LearnPolicyAction.id).where(LearnPolicyAction.policy == name).limit(1)):
                return
            training = recorded_rollouts.episodes_question(scene=scene, seeds=seeds, policies=policies)
            episodes = list(await session.scalars(training))
        async with self._recording(f"learned policy {name}") as memory:
            await record_policy(
                memory,
                policy,
                episodes=episodes,
                successes=successes,
                min_samples_leaf=experiment.min_samples_leaf,
                rollouts=rounds * experiment.rollouts,
                scene=scene,
                seeds=seeds,
            )

    async def record_evaluation(self, policy: AnyPolicy, evaluation: Evaluation) -> None:
        """Record the evaluation of a policy, unless one is recorded."""
        name = name_of(policy)
        if await read_evaluation(self._reading, name) is None:
            async with self._recording(f"evaluation of policy {name}") as memory:
                record_evaluation(memory, name, evaluation)

    @asynccontextmanager
    async def _recording(self, description: str) -> AsyncIterator[Memory]:
        """Record an episode; it is visible afterwards."""
        # The daemon that drains the workers' recorders drains this one too.
        async with Memory.open(self._place.url, spool=self._place.spool, writer="daemon", settings=SETTINGS) as memory:
            async with memory.episode(description=description, plan="learn", seed=self._experiment.seed):
                yield memory
            await memory.flush()


async def run(
    experiment: Experiment, place: MemoryLocation, report_progress: ReportProgress = lambda *_: None
) -> ExperimentResult:
    """Run the experiment; with `resume`, only its missing rollouts.

    Raises:
        CallerError: rollouts of this experiment are recorded already and `resume` is False; or the cluster does not
            answer.
        NotEnoughExperience: too few rollouts succeeded to learn from; all are recorded.
        WorkerLost: a worker process died; its finished rollouts are recorded.
        InternalError: the memory and the workers' counts differ.
    """
    import pandas as pd

    if experiment.cluster is not None:
        await check_cluster(experiment.cluster)  # before a database is created for nothing
    # Killed workers may have left records in the spool; `recover` stores them and creates the tables.
    await recover(place.url, spool=place.spool)
    async with (
        rollout_pool(experiment.workers, experiment.cluster, place) as workers,
        Reading.open(place.url) as reading,
    ):
        runner = _PhaseRunner(experiment, place, workers, reading, report_progress)
        first = default_policy() if experiment.model is Learned.PLACES else SuccessModel.untrained()
        policy: AnyPolicy = first
        frames: list[pd.DataFrame] = []
        for number in range(experiment.rounds):
            name = "default policy" if number == 0 else f"learned policy, round {number + 1}"
            explorer = policy
            if isinstance(policy, SuccessModel) and policy is not first:
                is_random = experiment.explore is Draws.RANDOM
                explorer = first if is_random else policy.drawing(experiment.explore)
            frames.append(await runner.phase(name, explorer, experiment.seed + number, experiment.rollouts))
            tries = pd.concat(frames)
            policy = learned_from(tries, experiment.model, experiment.min_samples_leaf)
            await runner.record(policy, rounds=number + 1, successes=len(recorded_rollouts.successes(tries)))
        await runner.phase("learned policy", policy, experiment.seed + experiment.rounds, experiment.evaluate)
        held_out_seed = experiment.seed + HELD_OUT_SEED
        held_out = await runner.phase("default policy, held out", first, held_out_seed, experiment.held_out)
        coverage = coverage_of(held_out, policy)
        limit = ceiling_of(experiment.scene, first, held_out_seed, experiment.held_out, report_progress)
        ceiling = await asyncio.create_task(limit, context=Context())  # in which no memory of the caller records
        await runner.record_evaluation(policy, _evaluation(held_out, policy, coverage, ceiling))
        successes = tuple(choices_of(recorded_rollouts.successes(tries)))
        return ExperimentResult(tuple(runner.phases), policy, successes, coverage, ceiling)


def learned_from(tries: pd.DataFrame, model: Learned, min_samples_leaf: int) -> AnyPolicy:
    """Return the policy of this kind that these pick-ups teach. Raises what `SuccessModel.fit` or `learn` raises."""
    match model:
        case Learned.SUCCESS:
            return SuccessModel.fit(tries, min_samples_leaf=min_samples_leaf)
        case Learned.POLAR:
            return learn_polar(recorded_rollouts.successes(tries), min_samples_leaf=min_samples_leaf)
        case Learned.PLACES:
            return learn(recorded_rollouts.successes(tries), min_samples_leaf=min_samples_leaf)


def drawn_of(policy: PolarPolicy | SuccessModel, context: PickUpContext, *, seed: int) -> list[PickUpChoice]:
    """Return many ways of the policy in this context: of a success model those of which it is confident, in the air."""
    rng = np.random.default_rng(seed)
    if isinstance(policy, PolarPolicy):
        return policy.sample(rng, _DRAWN, context)
    low, high = context.torso_limits or (context.torso, context.torso)
    torsos = rng.uniform(low, high, _DRAWN).tolist()
    ways = [
        each._replace(torso=torso) for each, torso in zip(default_policy().sample(rng, _DRAWN), torsos, strict=True)
    ]
    return list(compress(ways, policy.probability(ways, context) >= CONFIDENT))


async def read_rollouts(
    reading: Reading, scene: Scene, policy: str, seed: int, count: int, *, predicted: bool = False
) -> pd.DataFrame:
    """Return the recorded rollouts with an index below `count`, each index once.

    With `predicted` they are those of a policy that sets the torso, with the columns that a success model learns from.
    """
    question = recorded_rollouts.rollouts_question(scene=str(scene), seed=seed, policy=policy, predicted=predicted)
    # Rollouts with the same seed and index are identical, so any of them will do.
    frame = (await reading.dataframe(question)).drop_duplicates("index")
    frame = frame[frame["index"] < count]
    return recorded_rollouts.with_parameters(frame) if predicted else frame


def coverage_of(held_out: pd.DataFrame, policy: AnyPolicy) -> float | None:
    """Return the share of these rollouts' successes that the policy could have chosen; None if none succeeded."""
    done = recorded_rollouts.successes(held_out)
    if not len(done):
        return None
    return policy.coverage(choices_of(done)) if isinstance(policy, Policy) else policy.coverage(done)


def rated(policy: AnyPolicy, tries: pd.DataFrame) -> tuple[NDArray[np.bool_], Floats | None]:
    """Return whether the policy would have chosen each of these pick-ups, and its probability of success.

    A success model chooses those of which it is confident; a tree has no probability.
    """
    if isinstance(policy, SuccessModel):
        probabilities = policy.probability_in(tries)
        return probabilities >= CONFIDENT, probabilities
    if isinstance(policy, Policy):
        return policy.likelihood(choices_of(tries)) > 0, None
    return policy.density_of(features_of_frame(tries)) > 0, None


def _evaluation(held_out: pd.DataFrame, policy: AnyPolicy, coverage: float | None, ceiling: float) -> Evaluation:
    tried = held_out.dropna(subset=["object_x", "height"])  # without those of which no place is recorded
    if tried.empty:
        return Evaluation(coverage=coverage, ceiling=ceiling)
    succeeded = (tried["status"] == TaskStatus.SUCCEEDED.value).to_numpy()
    return Evaluation(
        held_out=(HeldOut.of("seed", 1, succeeded, *rated(policy, tried)),), coverage=coverage, ceiling=ceiling
    )


async def ceiling_of(
    scene: Scene, policy: AnyPolicy, seed: int, count: int, report_progress: ReportProgress = lambda *_: None
) -> float:
    """Return the share of these scenes in which one of `CEILING_WAYS` ways of this policy succeeds.

    No choice among its ways succeeds more often, and errors of the robot, of which it makes none here, only make that
    rarer. The first `CEILING_SCENES` of a scene that varies are tried, and one of any other; nothing is recorded.
    """
    solved, number = Tally(), min(count, CEILING_SCENES) if scene.varies else 1
    with replace(scene, disturbance=Disturbance()).entered() as stage:
        for index in range(number):
            target = stage.prepare(seed, index)
            action = MoveAndPickUp(target, policy=policy, rng=np.random.default_rng((seed, index, _CEILING)))
            try:
                ways = map(action.way, action.rated(CEILING_WAYS)[0])
                done = await _any_succeeds(ways, stage, seed, index)
            except PlanFailure:  # no place is free
                done = False
            solved += Tally(1) if done else Tally(failures=Counter(unsolved=1))
            report_progress("ceiling, each scene once", index + 1, number, solved)
            stage.reset()
    return solved.success_rate


async def _any_succeeds(ways: Iterable[MoveAndPickUpPerformable], stage: Stage, seed: int, index: int) -> bool:
    for way in ways:
        with suppress(PlanFailure):
            await way.perform()
            return True
        stage.reset()
        stage.prepare(seed, index)
    return False


def choices_of(frame: pd.DataFrame) -> list[PickUpChoice]:
    """Convert the rows to choices."""
    columns = (frame.arm, frame.grasp, frame.object_x, frame.object_y)
    return [
        PickUpChoice(Arms[arm], Grasp[grasp], float(x), float(y)) for arm, grasp, x, y in zip(*columns, strict=True)
    ]


# === evaluation ===============================================================================================
#
# Evaluate a learned policy outside the scene in which it was learned. None of these rollouts is recorded.
#
# The evaluation measures how success grows with experience; how the policy performs with the object at another place,
# turned, higher or lower, or with another object; how it performs when an arm in collision is a failure; and how much
# recording slows the rollouts down.

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

    Raises `WorkerLost`, `InternalError` if the same rollouts ended differently without recording, and `CallerError`
    for a policy other than a tree of places.
    """
    if not isinstance(learned.policy, Policy):
        raise CallerError("only a tree of places is studied: leave out --study, or choose --model places")
    policy = learned.policy
    async with Reading.open(place.url) as reading:
        default, evaluation, held_out = [
            await read_rollouts(reading, experiment.scene, phase.policy, phase.seed, phase.tally.rollouts)
            for phase in (learned.default, learned.evaluation, learned.held_out)
        ]
    async with rollout_pool(experiment.workers, experiment.cluster, None) as workers:

        async def tally(
            name: str, scene: Scene, policy: Policy, seed: int = experiment.seed + _STUDY_SEED, count: int = rollouts
        ) -> Tally:
            """Perform rollouts that nothing records."""
            job = RolloutTask(scene, policy, seed, recorded=False)
            length_max = min(ROLLOUTS_PER_RUN, -(-count // experiment.workers))
            runs = recorded_rollouts.missing_runs((), count, length_max=length_max)
            return await workers.roll_out(job, runs, lambda done: report_progress(name, done.rollouts, count, done))

        curve: list[CurvePoint] = []
        for size in (each for each in CURVE if each <= len(default)):
            successes = recorded_rollouts.successes(default, among=size)
            with suppress(NotEnoughExperience):
                point = learn(successes, min_samples_leaf=experiment.min_samples_leaf)
                done = await tally(f"learned from {size:,} rollouts", experiment.scene, point)
                curve.append(CurvePoint(size, len(successes), done, coverage_of(held_out, point)))
        scenes = [
            SceneComparison(
                scene,
                await tally(f"default policy: {scene}", scene, default_policy()),
                await tally(f"learned policy: {scene}", scene, policy),
            )
            for scene in scene_variants(experiment.scene)
        ]
        costs: list[Cost] = []
        for phase, used, frame in (
            (learned.default, default_policy(), default),
            (learned.evaluation, policy, evaluation),
        ):
            if phase.rate is not None:  # this run performed the phase
                count, began = min(len(frame), 4 * rollouts), time.monotonic()
                done = await tally(f"{phase.name}, not recorded", experiment.scene, used, phase.seed, count)
                seconds = time.monotonic() - began
                if done != tally_of(frame[frame["index"] < count]):
                    raise InternalError(f"{phase.name}: the same rollouts ended differently without recording")
                costs.append(Cost(phase.name, count, phase.rate, count / seconds))
    return Study(tuple(curve), tuple(scenes), tuple(costs))


# === kitchen trial ============================================================================================
#
# Try one pick-up in the kitchen with a policy learned without a kitchen, as at the end of the thesis' notebook.

KITCHEN = Scene(kitchen=True, collisions=True, torso_height=0.3)
"""The thesis' milk on the worktop, with the torso raised so that the arm can stay clear of the worktop."""
KITCHEN_TRIAL = "picking up in the kitchen with a learned policy"
"""The description of the episode of such a trial, in which `pycrorm learn --from-memory` does not learn."""


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
    policy: AnyPolicy, place: MemoryLocation, *, seed: int, scene: Scene = KITCHEN
) -> KitchenResult:
    """Try samples of the policy in order of likelihood until one succeeds, at places that `free_and_visible` allows.

    Records one episode, which is visible when this returns.
    """
    tries, done, failure = 0, None, None
    async with Memory.open(place.url, spool=place.spool) as memory:
        async with memory.episode(description=KITCHEN_TRIAL, plan="learn", seed=seed) as episode:
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
