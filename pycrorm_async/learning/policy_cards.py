"""Describe the policies that a memory holds: where each comes from, how often it was used, and how that ended.

>>> for summary in await read_policies(memory.reading):
...     print(summary.name, summary.kind, summary.learned_from, summary.used, summary.rate)
>>> card = await read_card(memory.reading, "3f9c")          # the first digits of a name are enough
>>> card.heights, card.evaluation

A policy is known by its name, the hash of its content. All figures are read from what is recorded: the node
`LearnPolicyAction` with the training episodes, the content, the pick-ups that name the policy, and the evaluation that
`learn --from-memory` or an experiment has recorded with it. The pick-ups that a policy chose are no part of what it
was learned from, so their share of successes evaluates it.
"""

from __future__ import annotations

from collections import Counter, defaultdict
from collections.abc import Iterable, Mapping, Sequence
from dataclasses import dataclass
from datetime import datetime
from typing import Final, NamedTuple

from sqlalchemy import and_, func, select
from sqlalchemy.orm import aliased

from pycrorm_async.errors import CallerError
from pycrorm_async.learning.policy import Policy, default_policy
from pycrorm_async.learning.policy_file import AnyPolicy, name_of
from pycrorm_async.learning.recorded_policy import Evaluation, read_evaluation, read_policy, recorded_names
from pycrorm_async.learning.success_model import SuccessModel
from pycrorm_async.orm import BatchRolloutAction, LearnPolicyAction, MoveAndPickUpAction, Object, TaskTreeNode
from pycrorm_async.orm import Pose as PoseRow
from pycrorm_async.query.reading import Reading
from pycrorm_async.query.success import interval_95
from pycrorm_async.query.text import nearest
from pycrorm_async.task_status import TaskStatus

BAND_M: Final = 0.1
"""The width in m of the bands of height for which a card has the share of successes."""
_ROUNDING: Final = 1e-6
"""Added to a height in bands, so that 0.3 m, which no float is exactly, belongs to the band that begins there."""


@dataclass(frozen=True)
class SuccessRate:
    """The share of some tries that succeeded, with its 95 % interval; `rate` is None without a try."""

    successes: int
    tries: int
    rate: float | None
    interval: tuple[float, float]

    @classmethod
    def of(cls, successes: int, tries: int) -> SuccessRate:
        return cls(successes, tries, successes / tries if tries else None, interval_95(successes, tries))

    def __str__(self) -> str:
        """Return it as `55.0 % (34 % to 74 %) of 20`; empty without a try."""
        low, high = self.interval
        return "" if self.rate is None else f"{self.rate:.1%} ({low:.0%} to {high:.0%}) of {self.tries:,}"


@dataclass(frozen=True)
class Training:
    """One record of how a policy was learned.

    Attributes:
        learned_at: the moment.
        successes: number of samples that succeeded.
        rollouts, scene, seeds: of the rollouts that gave the samples; None and empty if they come from other episodes.
        rounds: the number of rounds of rollouts; 0 without.
        episodes: number of the episodes with samples; `episode_ids` are those of the first 10,000.
    """

    learned_at: datetime
    successes: int
    min_samples_leaf: int
    rollouts: int | None
    scene: str | None
    seeds: tuple[int, ...]
    rounds: int
    episodes: int
    episode_ids: tuple[str, ...]


@dataclass(frozen=True)
class PolicySummary:
    """One policy of a memory.

    Attributes:
        kind: `tree`, `polar tree`, `success model`, or `default policy`; `not held` if only its name is recorded.
        robots, objects: names of the robots that it is for or that used it, and types of the objects that these picked
            up by it.
        learned_from: number of pick-ups that it was learned from; None if that is not recorded.
        used: number of actions that name it.
        succeeded: how those ended that succeeded or failed.
        learned_at: None if that is not recorded.
    """

    name: str
    kind: str
    robots: tuple[str, ...]
    objects: tuple[str, ...]
    learned_from: int | None
    used: int
    succeeded: SuccessRate
    learned_at: datetime | None


@dataclass(frozen=True)
class PolicyCard:
    """All that a memory knows about one policy.

    Attributes:
        features: those that it depends on, with name and version.
        size: number of its leaves or trees.
        trainings: the records of how it was learned; the same samples may be learned from again.
        heights: how its uses ended, by the lower limit (m) of the height of the object over the floor.
        scenes: in which it was used in batches of rollouts, with how those ended.
        evaluation: on pick-ups that it was not learned from; None if none is recorded.
    """

    summary: PolicySummary
    features: str
    size: int | None
    trainings: tuple[Training, ...]
    heights: Mapping[float, SuccessRate]
    scenes: Mapping[str, SuccessRate]
    evaluation: Evaluation | None


async def read_policies(reading: Reading) -> list[PolicySummary]:
    """Return the policies that a memory names or holds, the latest learned first, then by name."""
    names = await recorded_names(reading)
    uses, trainings = await _uses(reading), await _trainings(reading)
    held = {name: await _held(reading, name) for name in names | uses.keys() | trainings.keys()}
    summaries = [_summary(name, *each, uses.get(name, ()), trainings.get(name, ())) for name, each in held.items()]
    return sorted(summaries, key=lambda each: (-(each.learned_at.timestamp() if each.learned_at else 0), each.name))


async def read_card(reading: Reading, name: str) -> PolicyCard:
    """Return the card of the policy whose name begins with `name`. Raises `CallerError` if it is not exactly one."""
    full = await policy_named(reading, name)
    uses, trainings = (await _uses(reading, full)).get(full, ()), (await _trainings(reading, full)).get(full, ())
    kind, policy = await _held(reading, full)
    heights, scenes = defaultdict[float, Counter[bool]](Counter), defaultdict[str, Counter[bool]](Counter)
    for each in uses:
        if each.succeeded is not None:
            if each.height is not None:
                heights[each.height][each.succeeded] += each.times
            if each.scene is not None:
                scenes[each.scene][each.succeeded] += each.times
    return PolicyCard(
        _summary(full, kind, policy, uses, trainings),
        _features(policy),
        None if policy is None else len(policy.trees if isinstance(policy, SuccessModel) else policy.leaves),
        tuple(trainings),
        {height: _share(counts) for height, counts in sorted(heights.items())},
        {scene: _share(counts) for scene, counts in sorted(scenes.items())},
        await read_evaluation(reading, full),
    )


async def policy_named(reading: Reading, name: str) -> str:
    """Return the whole name of a policy. Raises `CallerError` if none or several begin with it."""
    names = await recorded_names(reading)
    names |= (await _uses(reading)).keys() | (await _trainings(reading)).keys()
    matches = sorted(each for each in names if each.startswith(name)) if name else []
    if len(matches) == 1 or name in matches:
        return name if name in matches else matches[0]
    if matches:
        raise CallerError(f"{len(matches)} policies begin with {name!r}: {', '.join(matches[:10])}; give more digits")
    advice = nearest(name, sorted(names)) or "; `pycrorm policies` lists those it names" if names else "; it names none"
    raise CallerError(f"the memory names no policy {name!r}{advice}")


class _Use(NamedTuple):
    """The number of pick-ups that one policy chose with the same outcome and circumstances."""

    times: int
    succeeded: bool | None
    robot: str | None
    object_type: str | None
    height: float | None
    scene: str | None


async def _uses(reading: Reading, name: str | None = None) -> dict[str, list[_Use]]:
    """Return the uses by policy; with `name`, of this one only."""
    move, batch = aliased(MoveAndPickUpAction, flat=True), aliased(BatchRolloutAction, flat=True)
    node, taken, place = TaskTreeNode, Object, PoseRow
    policy = func.coalesce(move.policy, batch.policy)  # a batch of version 0.1.0 alone names it
    band = func.floor(place.z / BAND_M + _ROUNDING)
    columns = policy, node.status, node.robot, taken.obj_type, band, batch.scene
    statement = (
        select(*columns, func.count())
        .select_from(move)
        .join(node, and_(node.id == move.id, node.process_metadata_id == move.process_metadata_id))
        .outerjoin(batch, and_(batch.id == node.parent_id, batch.process_metadata_id == node.process_metadata_id))
        .outerjoin(taken, and_(taken.id == move.object_id, taken.process_metadata_id == move.process_metadata_id))
        .outerjoin(place, and_(place.id == taken.pose_id, place.process_metadata_id == taken.process_metadata_id))
        .where(policy.is_not(None) if name is None else policy == name)
        .group_by(*columns)
    )
    uses: dict[str, list[_Use]] = {}
    for used, status, robot, kind, number, scene, count in await reading.rows(statement):
        succeeded = {TaskStatus.SUCCEEDED: True, TaskStatus.FAILED: False}.get(status)
        height = None if number is None else round(number * BAND_M, 6)
        uses.setdefault(used, []).append(_Use(count, succeeded, robot, kind.name if kind else None, height, scene))
    return uses


async def _trainings(reading: Reading, name: str | None = None) -> dict[str, list[Training]]:
    """Return the records of how policies were learned, by policy, the latest first; with `name`, of this one only."""
    query = select(LearnPolicyAction).order_by(LearnPolicyAction.id.desc())
    if name is not None:
        query = query.where(LearnPolicyAction.policy == name)
    async with reading.session() as session:
        nodes = (await session.scalars(query)).all()
        records: dict[str, list[Training]] = {}
        for each in nodes:
            seeds = tuple(each.seeds)
            record = Training(
                each.start_time, each.successes, each.min_samples_leaf, each.rollouts, each.scene, seeds,
                len(seeds) if each.rollouts else 0, each.episode_count,
                tuple(each.training_episodes) if name is not None else (),
            )  # fmt: skip
            records.setdefault(each.policy, []).append(record)
    return records


async def _held(reading: Reading, name: str) -> tuple[str, AnyPolicy | None]:
    """Return the kind of a policy and its content; None if the memory does not hold it, or not for this program."""
    try:
        policy = await read_policy(reading, name)
    except CallerError:
        return "not held", None
    if isinstance(policy, SuccessModel):
        return "success model", policy
    if not isinstance(policy, Policy):
        return "polar tree", policy
    return "default policy" if name == name_of(default_policy()) else "tree", policy


def _features(policy: AnyPolicy | None) -> str:
    if policy is None:
        return ""
    if not isinstance(policy, Policy):
        return f"{policy.features}, version {policy.features_version}"
    has_height = any(leaf.height is not None for leaf in policy.leaves)
    height = "" if policy.constant_height is None else f"; learned at {policy.constant_height:.3f} m over the torso"
    return f"arm, grasp, place{', height over the torso' if has_height else ''}{height}"


def _summary(
    name: str, kind: str, policy: AnyPolicy | None, uses: Iterable[_Use], trainings: Sequence[Training]
) -> PolicySummary:
    counts, used = Counter[bool](), 0
    robots, objects = set[str](), set[str]()
    for each in uses:
        used += each.times
        robots |= {each.robot} if each.robot else set()
        objects |= {each.object_type} if each.object_type else set()
        if each.succeeded is not None:
            counts[each.succeeded] += each.times
    latest = trainings[0] if trainings else None
    learned_from = None if latest is None else latest.rollouts or latest.successes
    if isinstance(policy, SuccessModel):
        learned_from = policy.rollouts
    robots |= {policy.robot} if policy is not None and policy.robot else set()
    return PolicySummary(
        name, kind, tuple(sorted(robots)), tuple(sorted(objects)), learned_from, used, _share(counts),
        latest.learned_at if latest else None,
    )  # fmt: skip


def _share(counts: Mapping[bool, int]) -> SuccessRate:
    return SuccessRate.of(counts[True], counts[True] + counts[False])
