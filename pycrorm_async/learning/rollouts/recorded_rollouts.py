"""The rollouts a memory holds, each with its index, how it ended, and at which of the three goals of the hand."""

from __future__ import annotations

from collections import Counter
from collections.abc import Iterable, Iterator
from typing import TYPE_CHECKING, Any

from sqlalchemy import Select, func, select
from sqlalchemy.orm import aliased

from pycrorm_async.learning.rollouts.rollouts import Tally
from pycrorm_async.orm import BatchRolloutAction, PickUpWithContextView, TaskTreeNode
from pycrorm_async.task_status import TaskStatus

if TYPE_CHECKING:
    import pandas as pd

__all__ = ["rollouts_question", "once", "successes", "tally_of", "stages_of", "missing", "STAGES"]

STAGES = ("before the pre-pose", "pre-pose", "grasp", "lift")
"""Where a pick-up can fail: by how many goals its hand was given."""


def rollouts_question(*, scene: str, seed: int, policy: str | None = None) -> Select[Any]:
    """All that were brought to an end, in the order of their index: what was interrupted never counts.

    A frame of it has the columns policy, index, status, failure, arm, grasp, object_x, object_y, height (as
    in `MoveAndPickUp.query_for_database`) and goals: how many goals the hand was given.
    """
    batch, node, view = BatchRolloutAction, TaskTreeNode, PickUpWithContextView
    tried, picked, moved = aliased(TaskTreeNode), aliased(TaskTreeNode), aliased(TaskTreeNode)
    # In two steps: first which rollouts, numbered within their batch, then what is to be known of each.
    ended = (
        select(
            tried.id,
            tried.status,
            tried.reason,
            batch.policy,
            (batch.first + func.row_number().over(partition_by=node.id, order_by=tried.id) - 1).label("index"),
        )
        .join(node, node.id == batch.id)
        .join(tried, tried.parent_id == node.id)
        .where(tried.dtype == "MoveAndPickUpAction", batch.scene == scene, batch.seed == seed)
        .where(tried.status.in_([TaskStatus.SUCCEEDED, TaskStatus.FAILED]))
    )
    if policy is not None:
        ended = ended.where(batch.policy == policy)
    rollout = ended.subquery("rollout")
    goals = (
        select(func.count(moved.id)).where(moved.parent_id == view.id, moved.dtype == "MoveTCPMotion").scalar_subquery()
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
        .join(picked, picked.parent_id == rollout.c.id)
        .join(view, view.id == picked.id)
        .order_by(rollout.c.index, rollout.c.id)
    )


def once(frame: pd.DataFrame) -> pd.DataFrame:
    """Each index once. Should two runs have done the same rollout, they did the same in it."""
    return frame.drop_duplicates("index")


def successes(frame: pd.DataFrame, *, among: int | None = None) -> pd.DataFrame:
    """What can be learned from, of the rollouts with an index below `among`, or of all."""
    kept = frame[frame.status == TaskStatus.SUCCEEDED.value]
    return kept if among is None else kept[kept["index"] < among]


def tally_of(frame: pd.DataFrame) -> Tally:
    """How the rollouts ended."""
    failed = frame[frame.status != TaskStatus.SUCCEEDED.value]
    return Tally(len(frame) - len(failed), Counter(each.rpartition(".")[2] for each in failed.failure))


def stages_of(frame: pd.DataFrame) -> dict[str, int]:
    """How many failed at which goal of the hand; those at which none did are left out."""
    failed = frame[frame.status != TaskStatus.SUCCEEDED.value]
    counts = Counter(STAGES[min(int(goals), len(STAGES) - 1)] for goals in failed.goals)
    return {stage: counts[stage] for stage in STAGES if counts[stage]}


def missing(done: Iterable[int], count: int, *, at_once: int) -> Iterator[tuple[int, int]]:
    """Runs of indexes below `count` that are not done yet, at most so long: first index and length."""
    known = set(done)
    first, length = 0, 0
    for index in range(count + 1):
        if length and (index == count or index in known or length == at_once):
            yield first, length
            length = 0
        if index < count and index not in known:
            first, length = (index, 1) if not length else (first, length + 1)
