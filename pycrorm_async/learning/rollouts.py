"""Perform rollouts: many tries of one action, each sampled from a policy, each from the same start (thesis 5.2).

Seed and index alone determine a rollout, independent of the process and the order in which rollouts are performed.

>>> with Scene().entered() as stage:
...     tally = await batch_rollout(MoveAndPickUp(stage.target), 500, seed=69, reset=stage.reset)
>>> tally.success_rate
0.158
"""

from __future__ import annotations

import math
from collections import Counter
from collections.abc import Awaitable, Callable, Iterable, Iterator, Sequence
from contextlib import AbstractAsyncContextManager, contextmanager, nullcontext
from dataclasses import dataclass, field
from functools import partial
from operator import attrgetter
from typing import TYPE_CHECKING, Any, cast

import msgspec
import numpy as np
from sqlalchemy import Select, and_, func, inspect, or_, select
from sqlalchemy.orm import aliased

from pycrorm_async.errors import CallerError
from pycrorm_async.learning.features import CIRCUMSTANCES
from pycrorm_async.learning.move_and_pick_up import MoveAndPickUp
from pycrorm_async.orm import (
    BatchRolloutAction,
    MoveAndPickUpAction,
    PickUpWithContextView,
    ProcessMetaData,
    TaskTreeNode,
)
from pycrorm_async.plan import objects
from pycrorm_async.plan.failures import PlanFailure
from pycrorm_async.plan.language import ActionAbstract
from pycrorm_async.progress_bar import progress_bar
from pycrorm_async.projections.derived_views import parameters_of
from pycrorm_async.query.success import interval_95
from pycrorm_async.task_status import TaskStatus

if TYPE_CHECKING:
    import pandas as pd
    from sqlalchemy.sql.selectable import NamedFromClause

    from pycrorm_async.memory import Memory

# === recorded rollouts ========================================================================================
#
# Query the recorded rollouts: index, status, failure, choice, and number of goals set for the hand.

_ROLLOUTS = ("MoveAndPickUpAction", "PredictedPickUpAction")
"""The types of the nodes of rollouts."""
STAGES = ("before the pre-pose", "pre-pose", "grasp", "lift")
"""Stages at which a pick-up can fail, indexed by the number of goals its hand was given."""


def rollouts_question(*, scene: str, seed: int, policy: str | None = None, predicted: bool = False) -> Select[Any]:
    """Select the rollouts that succeeded or failed, ordered by index; interrupted ones are left out.

    A data frame of it has the columns policy, index, status, failure, arm, grasp, object_x, object_y, height (as
    in `MoveAndPickUp.query_for_database`) and goals: the number of goals the hand was given. If the robot did not reach
    its place, object_x, object_y and height are missing. The last one is robot. With `predicted` it also has the
    recorded parameters of each rollout as JSON, for `with_parameters`.
    """
    batch, node, view, move = BatchRolloutAction, TaskTreeNode, PickUpWithContextView, MoveAndPickUpAction
    episode = attrgetter("process_metadata_id")
    tried, picked, moved = aliased(TaskTreeNode, name="tried"), aliased(TaskTreeNode), aliased(TaskTreeNode)
    number = func.row_number().over(partition_by=(episode(tried), node.id), order_by=tried.id)
    recorded = parameters_of(cast("NamedFromClause", inspect(tried).selectable))
    # Two steps: the subquery selects and numbers the rollouts within their batch, the outer query joins the details.
    ended = (
        select(
            tried.id,
            tried.process_metadata_id,
            tried.status,
            tried.reason,
            batch.policy,
            (batch.first + number - 1).label("index"),
            tried.robot,
            *([recorded.label("parameters")] if predicted else ()),
        )
        .join(node, and_(node.id == batch.id, episode(node) == episode(batch)))
        .join(tried, and_(tried.parent_id == node.id, episode(tried) == episode(node)))
        .where(tried.dtype.in_(_ROLLOUTS), batch.scene == scene, batch.seed == seed)
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
            move.arm,
            move.grasp,
            view.robot_in_object_x.label("object_x"),
            view.robot_in_object_y.label("object_y"),
            func.coalesce(view.height_over_torso, -view.robot_in_object_z).label("height"),
            func.coalesce(goals, 0).label("goals"),
            rollout.c.robot,
            *([rollout.c.parameters] if predicted else ()),
        )
        .select_from(rollout)
        .join(move, and_(move.id == rollout.c.id, episode(move) == rollout.c.process_metadata_id))
        .outerjoin(
            picked,
            and_(
                picked.parent_id == rollout.c.id,
                episode(picked) == rollout.c.process_metadata_id,
                picked.dtype == "PickUpAction",
            ),
        )
        .outerjoin(view, and_(view.id == picked.id, episode(view) == episode(picked)))
        .order_by(rollout.c.index, rollout.c.id)
    )


def with_parameters(frame: pd.DataFrame) -> pd.DataFrame:
    """Return the frame with the ways as they were chosen, and their circumstances, for `SuccessModel.fit`.

    The place where the robot stood is replaced by that where it was sent, of which a model must predict the success.
    What a choice did not record stays as it is, or NaN.
    """
    chosen = [msgspec.json.decode(each) for each in frame.pop("parameters")]
    columns = {"object_x": "relative_x", "object_y": "relative_y", "height": "height", "torso_height": "torso"}
    for name, own in {**columns, **{name: name for name in CIRCUMSTANCES}}.items():
        values = np.array([each.get(own) for each in chosen], dtype=np.float64)
        former = frame[name].astype(np.float64) if name in frame.columns else math.nan
        frame = frame.assign(**{name: np.where(np.isnan(values), former, values)})
    return frame


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
    prepare: Callable[[int, int], objects.ObjectLike] | None = None,
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
        prepare: draws what varies in the rollout of a seed and an index (`Stage.prepare`), and returns its object; None
            keeps the action's object where it is.
        each_in: the memory in which each rollout becomes an episode of its own.
        stop: called before each rollout; True ends the batch.
        report_progress: called with the results so far after each rollout; None shows a bar if stderr is a terminal.

    Raises `CallerError` for a count, index or seed below 0. A `PlanFailure` is counted as a failed rollout; any other
    exception ends the batch and is raised.
    """
    if min(count, first, seed) < 0:
        raise CallerError(f"count, first and seed of rollouts must be >= 0, got {count}, {first} and {seed}")
    tally = Tally()
    reset = reset or objects.require_world().reset
    policy = action.policy_here() if prepare is None else None
    arms, grasps = (
        sorted(each.name for each in members or ()) for members in (action.allowed.arms, action.allowed.grasps)
    )

    async def roll_out(indexes: range, report: Callable[[Tally], None]) -> None:
        action.keep_policy()
        for index in indexes:
            if index > indexes.start and stop():
                break
            tried = action if prepare is None else action.of(prepare(seed, index))
            try:
                await tried.drawn(randomness(seed, index), policy).perform()
            except PlanFailure as failure:
                tally.failures[type(failure).__name__] += 1
            else:
                tally.successes += 1
            reset()
            report(tally)

    with _bar(count) if report_progress is None else nullcontext(report_progress) as report:
        length = count if each_in is None else 1
        for begin in range(first, first + count, max(length, 1)):
            if stop():
                break
            name, work = action.policy_name, partial(roll_out, range(begin, begin + length), report)
            batch = BatchRolloutActionPerformable(name, scene, seed, begin, length, arms, grasps, work)
            episode: AbstractAsyncContextManager[Any] = nullcontext()
            if each_in is not None:
                episode = each_in.episode(description=f"rollout {begin} under policy {name}", seed=seed)
            async with episode:
                await batch.perform()
    return tally


@contextmanager
def _bar(count: int) -> Iterator[Callable[[Tally], None]]:
    with progress_bar("rollouts", unit="rollouts") as report_progress:
        yield lambda tally: report_progress(tally.rollouts, count, f"{tally.success_rate:.1%} succeed")


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
    _work: Callable[[], Awaitable[None]] | None = field(default=None, repr=False, compare=False)

    async def perform(self) -> None:
        assert self._work is not None, "only batch_rollout creates and performs a batch"
        await self._work()
