"""Perform rollouts of move-and-pick-up in one or several processes, and read them back from a memory.

**Rollouts.** Perform rollouts: many tries of one action, each sampled from a policy, each from the same start (thesis
5.2).

Seed and index alone determine a rollout, independent of the process and the order in which rollouts are performed.

>>> with Scene().entered() as stage:
...     tally = await batch_rollout(MoveAndPickUp(stage.target), 500, seed=69, reset=stage.reset)
>>> tally.success_rate
0.158
"""

from __future__ import annotations

import math
from collections import Counter
from collections.abc import AsyncIterator, Callable, Iterable, Iterator, Sequence
from contextlib import AbstractAsyncContextManager, contextmanager, nullcontext
from dataclasses import dataclass, field
from operator import attrgetter
from typing import TYPE_CHECKING, Any

import numpy as np
from numpy.typing import NDArray
from sqlalchemy import Select, and_, func, or_, select
from sqlalchemy.orm import aliased

from pycrorm_async.errors import CallerError, ImpossibleCondition
from pycrorm_async.learning.policy import (
    ARMS,
    GRASPS,
    Evidence,
    PickUpChoice,
    Policy,
    Rectangle,
    Region,
    default_policy,
    name_of,
)
from pycrorm_async.learning.recorded_policy import keep_policy
from pycrorm_async.orm import BatchRolloutAction, PickUpWithContextView, ProcessMetaData, TaskTreeNode
from pycrorm_async.plan import objects
from pycrorm_async.plan.actions import MoveAndPickUpPerformable
from pycrorm_async.plan.failures import ObjectUnreachable, PlanFailure
from pycrorm_async.plan.geometry import lifting_arms
from pycrorm_async.plan.language import ActionAbstract, ActionDescription
from pycrorm_async.plan.locations import BaseClearance, base_clearance, base_height_m, face
from pycrorm_async.plan.motions import simulated_robot_within
from pycrorm_async.plan.task import Experience, PastSuccess, experience
from pycrorm_async.progress_bar import progress_bar
from pycrorm_async.query.success import interval_95
from pycrorm_async.task_status import TaskStatus
from pycrorm_async.world.bullet import BulletWorld, Object
from pycrorm_async.world.pose import Arms, Grasp, ObjectType, Pose, rotated, yaw_quaternion
from pycrorm_async.world.queries import Costmap, OccupancyCostmap, VisibilityCostmap
from pycrorm_async.world.urdf import Limits

if TYPE_CHECKING:
    import pandas as pd

    from pycrorm_async.memory import Memory


# === feasible places ==========================================================================================
#
# Compute the places around an object that are free for the robot's base and from which its camera sees the object.
#
# The places are rectangles in the object's own frame.

CLEARANCE_M = 0.3
"""Minimum distance between the middle of the robot's base and any obstacle, the thesis' value."""
REACH_M = 2.0
"""Half the side of the square of places around the object: the same as the range of the default policy."""
_RESOLUTION_M = 0.05
_CELLS = round(2 * REACH_M / _RESOLUTION_M)
_VISIBLE_SHARE_MIN = 0.5
"""The least share of the object that must be visible from a place."""


def free_and_visible(robot: objects.CurrentRobot, target: Object) -> Region:
    """Return the places where the robot's base is clear of obstacles and its camera sees the object. Moves nothing.

    Where collisions count, the base is clear of the places outside with any heading; `MoveAndPickUp` checks the heading
    of each of its samples.
    """
    world, ignored = target.world, robot.with_load()
    ground = Pose((target.pose.position.x, target.pose.position.y, 0.0))
    low, high = robot.camera_heights_m()
    # The maps are not turned with the object, so the square in its frame needs up to √2 times the side: 1.5 is enough.
    size = {"size_cells": 2 * round(0.75 * _CELLS), "resolution_m": _RESOLUTION_M}
    clearance = base_clearance([robot])
    free = (
        OccupancyCostmap(world, ground, distance_to_obstacle_m=CLEARANCE_M, ignore=ignored, **size)  # type: ignore[arg-type]
        if clearance is None
        else clearance.costmap(ground, **size)  # type: ignore[arg-type]
    )
    visible = VisibilityCostmap(
        world,
        target,
        min_height_m=low,
        max_height_m=high,
        origin=ground,
        ignore=ignored,
        **size,  # type: ignore[arg-type]
    )
    middles = (np.arange(_CELLS) + 0.5) * _RESOLUTION_M - REACH_M
    places = _values(free, target.pose.yaw, middles) > 0
    places &= _values(visible, target.pose.yaw, middles) >= _VISIBLE_SHARE_MIN
    return Region(tuple(rectangles(places)))


def _values(costmap: Costmap, yaw: float, middles: NDArray[np.floating]) -> NDArray[np.float64]:
    """Sample the map at the cells of a grid that is turned by `yaw` about the map's origin."""
    x, y = np.meshgrid(middles, middles, indexing="ij")
    turned = (np.cos(yaw) * x - np.sin(yaw) * y, np.sin(yaw) * x + np.cos(yaw) * y)
    row, column = (np.floor(each / costmap.resolution_m + costmap.size_cells / 2).astype(int) for each in turned)
    return np.asarray(costmap.map[row, column])


def rectangles(cells: NDArray[np.bool_]) -> Iterator[Rectangle]:
    """Cover the true cells with disjoint rectangles; equal runs along y in consecutive rows become one rectangle."""
    open_runs: dict[tuple[int, int], int] = {}
    for row in range(len(cells) + 1):
        runs = set(_runs(cells[row])) if row < len(cells) else set()
        for run in [each for each in open_runs if each not in runs]:
            edges = (open_runs.pop(run), row, *run)
            yield Rectangle(*(each * _RESOLUTION_M - REACH_M for each in edges))
        for run in runs:
            open_runs.setdefault(run, row)


def _runs(cells: NDArray[np.bool_]) -> Iterator[tuple[int, int]]:
    """Yield the start and the end (exclusive) of each run of true cells."""
    edges = np.flatnonzero(np.diff(np.concatenate([[False], cells, [False]])))
    yield from zip(edges[::2].tolist(), edges[1::2].tolist(), strict=True)


# === move and pick up =========================================================================================
#
# Describe move-and-pick-up actions whose arm, grasp and base position are sampled from a policy (thesis 5.2).

HEIGHT_TOLERANCE_M = 0.05
"""Experience with objects up to this much higher or lower, measured from the torso, applies to the present object."""
_DRAWS_MAX = 10
"""Bounds the draws as a multiple of the samples, because in a scene without free places all samples collide."""
_UPRIGHT_MIN = 0.1
"""Minimum vertical component of the object's own z axis (a cosine); below it the object lies on its side and its x-y
plane no longer maps to the floor."""


class MoveAndPickUp(ActionDescription[MoveAndPickUpPerformable]):
    """A description whose alternatives for moving to an object and picking it up are samples of a policy.

    Iterating draws samples that fit the scene and yields the likeliest first:

    >>> await Retry(MoveAndPickUp(milk, policy=learned), max_tries=20).perform()

    Args:
        target: the object, or a description of it.
        arms, grasps: the allowed ones; None allows all.
        policy: the distribution of base positions, arms and grasps; None means the thesis' default policy.
        samples: number of alternatives.
        rng: random generator; None means a new one with an unpredictable seed.

    Each alternative names the policy as passed, before arms and grasps limit it (`policy_name`). The first alternative
    in an episode records the policy's content, once for each opened memory (`read_policy`).

    Raises `ImpossibleCondition` if the policy gives these arms or grasps no probability, `CallerError` if
    samples < 1.
    """

    def __init__(
        self,
        target: objects.ObjectLike | objects.ObjectDesignatorDescription,
        arms: Iterable[Arms] | None = None,
        grasps: Iterable[Grasp] | None = None,
        policy: Policy | None = None,
        *,
        samples: int = 20,
        rng: np.random.Generator | None = None,
    ) -> None:
        super().__init__(MoveAndPickUpPerformable)
        if samples < 1:
            raise CallerError(f"samples must be >= 1, got {samples}")
        self.target = (
            target.resolve()
            if isinstance(target, objects.ObjectDesignatorDescription)
            else objects.designator_of(target)
        )
        self.allowed = evidence = Evidence(
            arms=frozenset(arms) if arms is not None else None,
            grasps=frozenset(grasps) if grasps is not None else None,
        )
        self._passed_policy = policy = default_policy() if policy is None else policy
        self.policy_name = name_of(policy)
        self.policy: Policy = policy if evidence == Evidence() else policy.condition(evidence)
        self.samples = samples
        self._rng = np.random.default_rng() if rng is None else rng

    def __repr__(self) -> str:
        return f"MoveAndPickUp({self.target.name!r}, policy={self.policy_name})"

    @staticmethod
    def query_for_database() -> Select[Arms, Grasp, float, float, float | None]:
        """Select the successful pick-ups of all episodes, the input of `learn`.

        A data frame of it has the columns arm, grasp, object_x, object_y (the robot's position in the object's own
        frame, m) and height (of the object over the lifted torso, m). Add a `where` to cut it, by columns of
        `PickUpWithContextView` such as `robot`, `description` and `scene` (of the episode) or `obj_type`.
        """
        view = PickUpWithContextView
        return select(
            view.arm,
            view.grasp,
            view.robot_in_object_x.label("object_x"),
            view.robot_in_object_y.label("object_y"),
            view.height_over_torso.label("height"),
        ).where(view.status == TaskStatus.SUCCEEDED)

    # --- policies for the current scene -----------------------------------------------------------------------

    @property
    def height(self) -> float:
        """Height of the object over the lifted torso at this moment, m. Raises `NoWorld`, `NoRobotHere`."""
        robot = objects.require_robot()
        torso = robot.body.joint_position(robot.torso_joint())
        return self.target.pose.position.z - robot.body.pose.position.z - torso

    def policy_here(self) -> Policy:
        """Condition the policy on the object's height, and its mass if an allowed arm does not lift it.

        Raises `ObjectUnreachable` if that has probability 0.
        """
        return self._condition(Evidence(self._strong_enough(), height=_around(self.height)), "at this height")

    def grounded(self) -> Policy:
        """Condition the policy on height and mass of the object, and on the free places that see it.

        Raises `ObjectUnreachable` if that has probability 0.
        """
        region = free_and_visible(objects.require_robot(), objects.in_world(self.target))
        return self._condition(
            Evidence(self._strong_enough(), region=region, height=_around(self.height)), "in this scene"
        )

    def _strong_enough(self) -> frozenset[Arms] | None:
        """Return the allowed arms that lift the object; None if that does not rule one out."""
        allowed = ARMS if self.allowed.arms is None else tuple(self.allowed.arms)
        lifting = lifting_arms(objects.require_robot(), allowed, self.target)
        return frozenset(lifting) if len(lifting) < len(allowed) else None

    def _condition(self, evidence: Evidence, where: str) -> Policy:
        try:
            return self.policy.condition(evidence)
        except ImpossibleCondition as impossible:
            message = f"the policy has no way to pick up {self.target.name} {where}: {impossible}"
            raise ObjectUnreachable(message, self.target.name) from impossible

    # --- alternatives -----------------------------------------------------------------------------------------

    def __iter__(self) -> Iterator[MoveAndPickUpPerformable]:
        """Yield samples that fit the scene, the likeliest first. Raises `ObjectUnreachable` if none fits."""
        yield from map(self.chosen, self.choices())

    def choices(self) -> Iterator[PickUpChoice]:
        """Yield the choices of `__iter__`."""
        self.keep_policy()
        yield from self._likeliest_first(self.grounded())

    def from_mode(self) -> Iterator[MoveAndPickUpPerformable]:
        """Yield samples from around the mode of the grounded policy only, as the thesis' `iter_with_mode` does.

        Raises `ObjectUnreachable`.
        """
        self.keep_policy()
        yield from map(self.chosen, self._likeliest_first(self.grounded().mode()))

    def plain(self) -> Iterator[MoveAndPickUpPerformable]:
        """Yield samples in the order they are drawn, without regard to obstacles and visibility."""
        self.keep_policy()
        for choice in self.policy_here().sample(self._rng, self.samples):
            yield self.chosen(choice)

    def keep_policy(self) -> None:
        """Record the policy's content in the open episode, once for each opened memory."""
        keep_policy(self.policy_name, self._passed_policy)

    def _likeliest_first(self, policy: Policy) -> Iterator[PickUpChoice]:
        choices = self._clear_choices(policy)
        for number in np.argsort(-policy.likelihood(choices), kind="stable"):
            yield choices[number]

    def _clear_choices(self, policy: Policy) -> Sequence[PickUpChoice]:
        """Draw samples; where collisions count, only those where the base is clear before and after it turns.

        Raises `ObjectUnreachable` if collisions count and none of `_DRAWS_MAX` times as many samples is clear.
        """
        clearance = base_clearance()
        if clearance is None:
            return policy.sample(self._rng, self.samples)
        clear: list[PickUpChoice] = []
        for _ in range(_DRAWS_MAX):
            clear += [each for each in policy.sample(self._rng, self.samples) if self.is_clear(each, clearance)]
            if len(clear) >= self.samples:
                break
        if not clear:
            message = f"the base would be in collision at every place to pick up {self.target.name}"
            raise ObjectUnreachable(message, self.target.name)
        return clear[: self.samples]

    def is_clear(self, choice: PickUpChoice, clearance: BaseClearance) -> bool:
        """Return whether the base is clear of obstacles at its place, before and after it turns to the object."""
        place = self.chosen(choice).standing_position
        facing = face(place, self.target.pose, height_m=place.position.z)
        return clearance.refusal(place) is None and clearance.refusal(facing) is None

    def chosen(self, choice: PickUpChoice) -> MoveAndPickUpPerformable:
        """Return the action for this choice and the object's current pose.

        The base's position is above the point of the floor that has these x and y in the object's own frame. Raises
        `ObjectUnreachable` for an object that lies on its side, whose x-y plane does not map to the floor.
        """
        pose = self.target.pose
        up = rotated(pose.orientation, (0.0, 0.0, 1.0))
        if abs(up.z) < _UPRIGHT_MIN:
            message = f"{self.target.name} lies on its side: its frame gives no position on the floor"
            raise ObjectUnreachable(message, self.target.name)
        x, y, z = (pose @ Pose((choice.relative_x, choice.relative_y, 0.0))).position
        standing_position = Pose((x - z * up.x / up.z, y - z * up.y / up.z, base_height_m()))
        return MoveAndPickUpPerformable(
            standing_position, self.target, choice.arm, choice.grasp, policy=self.policy_name
        )


def _around(height: float) -> tuple[float, float]:
    return height - HEIGHT_TOLERANCE_M, height + HEIGHT_TOLERANCE_M


# === recalled pick up =========================================================================================
#
# Describe a pick-up whose alternatives are the ways that succeeded before, at about this height.

_EVIDENCE_MIN = 0.5
"""The least evidence for an alternative: that of one success at a height 12 cm away."""


@dataclass
class RecalledPickUpPerformable(MoveAndPickUpPerformable):
    """Drive to a place, face the object from there, and pick it up; the node records why this way was chosen.

    Attributes:
        chosen_by: `recall`, `default policy`, or the name of a learned policy.
        expected_success: the share of successes that recall expects, 0 to 1; None if a policy chose it.
    """

    chosen_by: str = "recall"
    expected_success: float | None = None


class RecalledPickUp(ActionDescription[RecalledPickUpPerformable]):
    """A description whose alternatives for moving to an object and picking it up are those of earlier tries.

    Each alternative is the way with the highest expected success at the object's height over the lifted torso. The
    tries of this process count as soon as they have ended, so that a failure also makes similar ways less likely.
    Leaves out ways that are expected to succeed less often than an average try, and ways without a similar try; after
    the last one the samples of the policy follow, as in `MoveAndPickUp`, and then those of the default policy.

    >>> await Retry(RecalledPickUp(milk, policy=learned), max_tries=20).perform()

    Args:
        target: the object, or a description of it.
        arms, grasps: the allowed ones; None allows all.
        policy: the policy that follows; None means the thesis' default policy alone.
        experience: the source of earlier tries; None means the open memory, or none if no memory is open.
        samples: number of each policy's samples.
        rng: random generator of the policies; None means a new one with an unpredictable seed.

    Raises what `MoveAndPickUp` raises. The robot drives only to free places from which the object is visible.
    """

    def __init__(
        self,
        target: objects.ObjectLike | objects.ObjectDesignatorDescription,
        arms: Iterable[Arms] | None = None,
        grasps: Iterable[Grasp] | None = None,
        policy: Policy | None = None,
        *,
        experience: Experience | None = None,
        samples: int = 20,
        rng: np.random.Generator | None = None,
    ) -> None:
        super().__init__(RecalledPickUpPerformable)
        self._arms = ARMS if arms is None else tuple(arms)
        self._grasps = GRASPS if grasps is None else tuple(grasps)
        rng = np.random.default_rng() if rng is None else rng
        self._default = MoveAndPickUp(target, self._arms, self._grasps, samples=samples, rng=rng)
        self._otherwise = [(self._default, "default policy")]
        if policy is not None:
            learned = MoveAndPickUp(self._default.target, self._arms, self._grasps, policy, samples=samples, rng=rng)
            self._otherwise.insert(0, (learned, name_of(policy)))
        self._experience = experience
        self.target = self._default.target

    def __repr__(self) -> str:
        return f"RecalledPickUp({self.target.name!r}, otherwise={self._otherwise[0][1]})"

    async def resolve(self) -> RecalledPickUpPerformable:  # type: ignore[override]  # a memory is asked
        """Return the first alternative. Raises `ObjectUnreachable` if there is none."""
        async for each in self:
            return each
        raise ObjectUnreachable(f"there is no way to pick up {self.target.name} here", self.target.name)

    def __iter__(self) -> Iterator[RecalledPickUpPerformable]:
        """Raise `CallerError`, because the memory is queried between two alternatives."""
        raise CallerError("a recalled pick-up asks the memory: iterate with `async for`, or `await …resolve()`")

    async def __aiter__(self) -> AsyncIterator[RecalledPickUpPerformable]:
        """Yield the way with the highest expected success that was not yielded yet, then the policy's samples."""
        source = self._experience if self._experience is not None else experience.get()
        if source is not None:
            region, clearance = (
                free_and_visible(objects.require_robot(), objects.in_world(self.target)),
                base_clearance(),
            )
            tried: set[PickUpChoice] = set()
            while (best := await self._best(source, region, clearance, tried)) is not None:
                choice, way = best
                tried.add(choice)
                yield self._performable_of(choice, "recall", expected=way.score)
        for description, chosen_by in self._otherwise:
            try:
                choices = [*description.choices()]
            except ObjectUnreachable:
                if description is self._default:
                    raise
                continue  # a learned policy may know no way at this height
            for each in choices:
                yield self._performable_of(each, chosen_by, policy=description.policy_name)

    async def _best(
        self, source: Experience, region: Region, clearance: BaseClearance | None, tried: set[PickUpChoice]
    ) -> tuple[PickUpChoice, PastSuccess] | None:
        """Return the best way that is left and possible here."""
        robot = objects.require_robot()
        torso = robot.body.joint_position(robot.torso_joint()) if robot.description.torso_joint is not None else None
        over_base = self.target.pose.position.z - robot.body.pose.position.z
        arms = lifting_arms(robot, self._arms, self.target)
        arm = arms[0] if len(arms) == 1 else None
        ways = await source.successes(self.target.object_type, arm=arm, height=over_base, torso=torso)
        places = np.array([each.stand.position[:2] for each in ways]).reshape(-1, 2)
        for way, is_free in zip(ways, region.contains(*places.T), strict=True):
            choice = PickUpChoice(way.arm, way.grasp, *way.stand.position[:2])
            if (
                is_free
                and choice not in tried
                and way.arm in arms
                and way.grasp in self._grasps
                and way.score >= way.prior
                and way.evidence >= _EVIDENCE_MIN
                and (clearance is None or self._default.is_clear(choice, clearance))
            ):
                return choice, way
        return None

    def _performable_of(
        self, choice: PickUpChoice, chosen_by: str, *, expected: float | None = None, policy: str | None = None
    ) -> RecalledPickUpPerformable:
        move = self._default.chosen(choice)
        return RecalledPickUpPerformable(
            move.standing_position, move.object_designator, move.arm, move.grasp, chosen_by, expected, policy=policy
        )


# === recorded rollouts ========================================================================================
#
# Query the recorded rollouts: index, status, failure, choice, and number of goals set for the hand.

STAGES = ("before the pre-pose", "pre-pose", "grasp", "lift")
"""Stages at which a pick-up can fail, indexed by the number of goals its hand was given."""


def rollouts_question(*, scene: str, seed: int, policy: str | None = None) -> Select[Any]:
    """Select the rollouts that succeeded or failed, ordered by index; interrupted ones are left out.

    A data frame of it has the columns policy, index, status, failure, arm, grasp, object_x, object_y, height (as
    in `MoveAndPickUp.query_for_database`) and goals: the number of goals the hand was given.
    """
    batch, node, view = BatchRolloutAction, TaskTreeNode, PickUpWithContextView
    episode = attrgetter("process_metadata_id")
    tried, picked, moved = aliased(TaskTreeNode), aliased(TaskTreeNode), aliased(TaskTreeNode)
    number = func.row_number().over(partition_by=(episode(tried), node.id), order_by=tried.id)
    # Two steps: the subquery selects and numbers the rollouts within their batch, the outer query joins the details.
    ended = (
        select(
            tried.id,
            tried.process_metadata_id,
            tried.status,
            tried.reason,
            batch.policy,
            (batch.first + number - 1).label("index"),
        )
        .join(node, and_(node.id == batch.id, episode(node) == episode(batch)))
        .join(tried, and_(tried.parent_id == node.id, episode(tried) == episode(node)))
        .where(tried.dtype == "MoveAndPickUpAction", batch.scene == scene, batch.seed == seed)
        .where(tried.status.in_([TaskStatus.SUCCEEDED, TaskStatus.FAILED]))
    )
    if policy is not None:
        ended = ended.where(batch.policy == policy)
    rollout = ended.subquery("rollout")
    goals = (
        select(func.count(moved.id))
        .where(moved.parent_id == view.id, episode(moved) == episode(view), moved.dtype == "MoveTCPMotion")
        .scalar_subquery()
    )
    return (
        select(
            rollout.c.policy,
            rollout.c.index,
            rollout.c.status,
            rollout.c.reason.label("failure"),
            view.arm,
            view.grasp,
            view.robot_in_object_x.label("object_x"),
            view.robot_in_object_y.label("object_y"),
            view.height_over_torso.label("height"),
            goals.label("goals"),
        )
        .select_from(rollout)
        .join(picked, and_(picked.parent_id == rollout.c.id, episode(picked) == rollout.c.process_metadata_id))
        .join(view, and_(view.id == picked.id, episode(view) == episode(picked)))
        .order_by(rollout.c.index, rollout.c.id)
    )


def episodes_question(*, scene: str, seeds: Sequence[int], policies: Sequence[str]) -> Select[str]:
    """Select the ids of the episodes that hold the rollouts in this scene under these policies, each with its seed."""
    batch, episode = BatchRolloutAction, ProcessMetaData
    rounds = [and_(batch.seed == seed, batch.policy == policy) for seed, policy in zip(seeds, policies, strict=True)]
    return (
        select(episode.uuid)
        .join(batch, batch.process_metadata_id == episode.id)
        .where(batch.scene == scene, or_(*rounds))
        .group_by(episode.id, episode.uuid)
        .order_by(episode.id)
    )


def successes(frame: pd.DataFrame, *, among: int | None = None) -> pd.DataFrame:
    """Select the rollouts that succeeded, if `among` is set only those with an index below it."""
    succeeded = frame[frame.status == TaskStatus.SUCCEEDED.value]
    return succeeded if among is None else succeeded[succeeded["index"] < among]


def tally_of(frame: pd.DataFrame) -> Tally:
    """Count successes and, per failure class, failures."""
    failed = frame[frame.status != TaskStatus.SUCCEEDED.value]
    return Tally(len(frame) - len(failed), Counter(failed.failure))


def stages_of(frame: pd.DataFrame) -> dict[str, int]:
    """Count the failures per stage; stages without a failure are left out."""
    failed = frame[frame.status != TaskStatus.SUCCEEDED.value]
    counts = Counter(STAGES[min(int(goals), len(STAGES) - 1)] for goals in failed.goals)
    return {stage: counts[stage] for stage in STAGES if counts[stage]}


def missing_runs(done: Iterable[int], count: int, *, length_max: int) -> Iterator[tuple[int, int]]:
    """Yield the first index and the length of each run of indexes below `count` that are not in `done`."""
    indexes_done = set(done)
    first, length = 0, 0
    for index in range(count + 1):
        if length and (index == count or index in indexes_done or length == length_max):
            yield first, length
            length = 0
        if index < count and index not in indexes_done:
            first, length = (index, 1) if not length else (first, length + 1)


# === rollouts =================================================================================================


@dataclass
class Tally:
    """The number of rollouts by result.

    Attributes:
        successes: number of rollouts that succeeded.
        failures: number of failed rollouts by the class name of the plan failure.
    """

    successes: int = 0
    failures: Counter[str] = field(default_factory=Counter)

    @property
    def rollouts(self) -> int:
        return self.successes + self.failures.total()

    @property
    def success_rate(self) -> float:
        """Share of successes, 0 to 1; NaN before the first rollout."""
        return self.successes / self.rollouts if self.rollouts else math.nan

    @property
    def interval(self) -> tuple[float, float]:
        """Limits of the 95 % confidence interval of the success rate, by Wilson's formula."""
        return interval_95(self.successes, self.rollouts)

    def __add__(self, other: Tally) -> Tally:
        return Tally(self.successes + other.successes, self.failures + other.failures)


def randomness(seed: int, index: int) -> np.random.Generator:
    """Return the random generator of one rollout."""
    return np.random.default_rng((seed, index))


async def batch_rollout(
    action: MoveAndPickUp,
    count: int,
    *,
    seed: int,
    first: int = 0,
    scene: str = "",
    reset: Callable[[], None] | None = None,
    each_in: Memory | None = None,
    stop: Callable[[], bool] = lambda: False,
    report_progress: Callable[[Tally], None] | None = None,
) -> Tally:
    """Perform `count` rollouts of the action, each with its own sample of the policy and from the same start.

    With a memory open, all rollouts belong to one episode: the open one, or a new one.

    Args:
        count, first: the indexes of the rollouts: `first`, `first + 1`, … `first + count - 1`.
        scene: the scene in words; recorded, so that queries can separate rollouts in different scenes.
        reset: restores the world after each rollout; None moves everything to its original pose with joints at 0.
        each_in: the memory in which each rollout becomes an episode of its own.
        stop: called before each rollout; True ends the batch.
        report_progress: called with the results so far after each rollout; None shows a bar if stderr is a terminal.

    Raises `CallerError` for a count, index or seed below 0. A `PlanFailure` is counted as a failed rollout; any other
    exception ends the batch and is raised.
    """
    if min(count, first, seed) < 0:
        raise CallerError(f"count, first and seed of rollouts must be >= 0, got {count}, {first} and {seed}")
    tally = Tally()
    with _bar(count) if report_progress is None else nullcontext(report_progress) as report:
        run = _Run(action, action.policy_here(), reset or objects.require_world().reset, stop, tally, report)
        slices = ((index, 1) for index in range(first, first + count)) if each_in is not None else ((first, count),)
        for begin, length in slices:
            if stop():
                break
            arms, grasps = (
                sorted(each.name for each in members or ()) for members in (action.allowed.arms, action.allowed.grasps)
            )
            batch = BatchRolloutActionPerformable(action.policy_name, scene, seed, begin, length, arms, grasps, run)
            async with _episode_of(each_in, batch):
                await batch.perform()
    return tally


@contextmanager
def _bar(count: int) -> Iterator[Callable[[Tally], None]]:
    with progress_bar("rollouts", unit="rollouts") as report_progress:
        yield lambda tally: report_progress(tally.rollouts, count, f"{tally.success_rate:.1%} succeed")


def _episode_of(memory: Memory | None, batch: BatchRolloutActionPerformable) -> AbstractAsyncContextManager[Any]:
    if memory is None:
        return nullcontext()
    return memory.episode(description=f"rollout {batch.first} under policy {batch.policy}", seed=batch.seed)


@dataclass
class _Run:
    """The parts of a batch that are not recorded."""

    action: MoveAndPickUp
    policy: Policy
    reset: Callable[[], None]
    stop: Callable[[], bool]
    tally: Tally
    report: Callable[[Tally], None]


@dataclass
class BatchRolloutActionPerformable(ActionAbstract):
    """The task-tree node above a batch of rollouts; the rollout with index `first + n` is its n-th child that ended.

    `batch_rollout` creates it.
    """

    policy: str
    scene: str
    seed: int
    first: int
    count: int
    arms: list[str] = field(default_factory=list)
    grasps: list[str] = field(default_factory=list)
    _run: _Run | None = field(default=None, repr=False, compare=False)

    async def perform(self) -> None:
        run = self._run
        assert run is not None, "only batch_rollout creates and performs a batch"
        run.action.keep_policy()
        for index in self._indexes(run):
            choice = run.policy.sample(randomness(self.seed, index))[0]
            try:
                await run.action.chosen(choice).perform()
            except PlanFailure as failure:
                run.tally.failures[type(failure).__name__] += 1
            else:
                run.tally.successes += 1
            run.reset()
            run.report(run.tally)

    def _indexes(self, run: _Run) -> Iterator[int]:
        for index in range(self.first, self.first + self.count):
            if index > self.first and run.stop():
                return
            yield index


# === scene ====================================================================================================
#
# Build the scene of a rollout: a world with a robot, one object to pick up, and optionally a kitchen.


@dataclass(frozen=True)
class Scene:
    """The parameters of a world for rollouts; the default is the thesis' scene (5.2): milk in the air, nothing else.

    Attributes:
        name, object_type: name and type of the object.
        position: position of the object in the map frame, m.
        yaw: rotation of the object about the vertical, rad.
        torso_height: torso height at the start of every rollout, m. The thesis' rollouts have 0.
        limits: joint limits of the arms. Within soft limits and with the torso at 0 no grasp from above is reachable.
        collisions: whether a base or an arm in collision is a failure; if False, collisions are not checked.
        kitchen: whether the world contains the kitchen.
    """

    name: str = "milk"
    object_type: ObjectType = ObjectType.MILK
    position: tuple[float, float, float] = (1.3, 1.0, 0.9)
    yaw: float = 0.0
    torso_height: float = 0.0
    limits: Limits = Limits.SOFT
    collisions: bool = False
    kitchen: bool = False

    def __str__(self) -> str:
        """Describe the scene in words. Queries select rollouts by these words; no two scenes have the same."""
        kind = self.object_type.name.lower()
        label = kind if self.name == kind else f"{self.name} ({kind})"
        parts = [f"{label} at {', '.join(map(_digits, self.position))} m"]
        if self.yaw:
            parts.append(f"turned by {_digits(math.degrees(self.yaw))}°")
        parts.append(f"torso at {_digits(self.torso_height)} m")
        parts.append(f"{self.limits.name.lower()} limits")
        if self.collisions:
            parts.append("collisions count")
        if self.kitchen:
            parts.append("in the kitchen")
        return ", ".join(parts)

    @contextmanager
    def entered(self) -> Iterator[Stage]:
        """Build the world, enter it, and choose its robot; the world closes with the context."""
        with BulletWorld() as world, simulated_robot_within(self.limits, collisions=self.collisions):
            robot = Object("pr2", ObjectType.ROBOT)
            if self.kitchen:
                Object("kitchen", ObjectType.ENVIRONMENT)
            pose = Pose(self.position, yaw_quaternion(self.yaw))
            stage = Stage(self, world, robot, Object(self.name, self.object_type, pose=pose))
            stage.reset()
            yield stage


@dataclass(frozen=True)
class Stage:
    """A scene's world, its robot and its object, with a method to restore them."""

    scene: Scene
    world: BulletWorld
    robot: Object
    target: Object

    def reset(self) -> None:
        """Restore the start of a rollout. Moves only what has changed: a fifth of the time of Bullet's own reset."""
        self.world.reset()
        description = self.robot.robot_description
        torso = description.torso_joint if description is not None else None
        if self.scene.torso_height and torso is not None:
            self.robot.set_joint_position(torso, self.scene.torso_height)


def _digits(number: float) -> str:
    return f"{number:.9g}"
