"""Query the recorded rollouts: index, status, failure, choice, and number of goals set for the hand."""

from __future__ import annotations

from collections import Counter
from collections.abc import Iterable, Iterator, Sequence
from operator import attrgetter
from typing import TYPE_CHECKING, Any

from sqlalchemy import Select, and_, func, or_, select
from sqlalchemy.orm import aliased

from pycrorm_async.learning.rollouts.rollouts import Tally
from pycrorm_async.orm import BatchRolloutAction, PickUpWithContextView, ProcessMetaData, TaskTreeNode
from pycrorm_async.task_status import TaskStatus

if TYPE_CHECKING:
    import pandas as pd

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
            view.object_x,
            view.object_y,
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


def drop_repeats(frame: pd.DataFrame) -> pd.DataFrame:
    """Keep one row per index. Rollouts with the same seed and index are identical, so any of them will do."""
    return frame.drop_duplicates("index")


def successes(frame: pd.DataFrame, *, among: int | None = None) -> pd.DataFrame:
    """Select the rollouts that succeeded, if `among` is set only those with an index below it."""
    succeeded = frame[frame.status == TaskStatus.SUCCEEDED.value]
    return succeeded if among is None else succeeded[succeeded["index"] < among]


def tally_of(frame: pd.DataFrame) -> Tally:
    """Count successes and, per failure class, failures."""
    failed = frame[frame.status != TaskStatus.SUCCEEDED.value]
    return Tally(len(frame) - len(failed), Counter(each.rpartition(".")[2] for each in failed.failure))


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
