"""Record learned policies in the memory, and read them back by name.

Rollouts and sampled pick-ups name their policy by the hash of its content (`name_of`), so a run stays explainable when
its policy file has been overwritten: they record the content as a blob of the memory. `record_policy` records it under
a node that also names the training episodes and settings.

>>> await record_policy(memory, policy, episodes=memory.recent_episodes, successes=158, min_samples_leaf=25)
>>> same = await read_policy(memory.reading, name_of(policy))

How a policy does on pick-ups that it was not learned from is an `Evaluation`, recorded in the same way, as a blob of
JSON under the name of the policy; the latest one counts.
"""

from __future__ import annotations

from collections.abc import Iterable, Iterator
from dataclasses import dataclass, field
from itertools import pairwise
from typing import Final

import msgspec
import numpy as np
from numpy.typing import NDArray
from sqlalchemy import Select, and_, or_, select

from pycrorm_async.errors import CallerError, ImpossibleCondition
from pycrorm_async.events.types import Blob
from pycrorm_async.learning.policy_file import AnyPolicy, decode_policy, encode_policy, name_of
from pycrorm_async.memory import Memory
from pycrorm_async.orm import LearnPolicyAction, Observation, ObservationValue
from pycrorm_async.plan.language import ActionAbstract
from pycrorm_async.query.reading import Reading
from pycrorm_async.record.plan_recorder import observing

EPISODES_MAX = 10_000
"""Bounds the training episodes that are recorded by id, so that they fit into one event; `episode_count` counts all."""
_MEDIA_TYPE = "application/json"
_OBSERVATION = "policy"
_EVALUATION = "policy_evaluation"
_BINS: Final = (0.0, 0.2, 0.4, 0.6, 0.8, 1.0)


class CalibrationBin(msgspec.Struct, frozen=True):
    """Held-out pick-ups whose predicted probability was between `low` and `high`, `predicted` on average."""

    low: float
    high: float
    predicted: float
    tries: int
    successes: int


class HeldOut(msgspec.Struct, frozen=True):
    """The evaluation on pick-ups that were held out, each group of them in turn.

    Attributes:
        by: what the groups differ in: `seed`, `height`, `object`, `scene` or `random`.
        groups: their number.
        tries, successes: number of the held-out pick-ups.
        confident, confident_successes: those of them that the policy would have chosen, and that succeeded.
        brier: the mean square of the difference of predicted probability and outcome; None for a tree, which has none.
        calibration: predicted beside observed successes; empty for a tree.
    """

    by: str
    groups: int
    tries: int
    successes: int
    confident: int
    confident_successes: int
    brier: float | None = None
    calibration: tuple[CalibrationBin, ...] = ()

    @classmethod
    def of(
        cls,
        by: str,
        groups: int,
        succeeded: NDArray[np.bool_],
        confident: NDArray[np.bool_],
        probabilities: NDArray[np.float64] | None,
    ) -> HeldOut:
        """Return the evaluation of these pick-ups; `probabilities` are None for a tree. All have shape (pick-ups,)."""
        figures = len(succeeded), int(succeeded.sum()), int(confident.sum()), int((confident & succeeded).sum())
        if probabilities is None:
            return cls(by, groups, *figures)
        brier = float(np.square(probabilities - succeeded).mean())
        return cls(by, groups, *figures, brier, tuple(_calibration(probabilities, succeeded)))

    @property
    def coverage(self) -> float | None:
        """The share of the held-out successes that the policy would have chosen; None without any."""
        return self.confident_successes / self.successes if self.successes else None


def _calibration(probabilities: NDArray[np.float64], succeeded: NDArray[np.bool_]) -> Iterator[CalibrationBin]:
    numbers = np.clip(np.searchsorted(_BINS, probabilities, side="right") - 1, 0, len(_BINS) - 2)
    for number, (low, high) in enumerate(pairwise(_BINS)):
        part = numbers == number
        if part.any():
            mean = float(probabilities[part].mean())
            yield CalibrationBin(low, high, mean, int(part.sum()), int(succeeded[part].sum()))


class Evaluation(msgspec.Struct, frozen=True):
    """The evaluation of a policy, and what it was learned from besides the parameters of its `LearnPolicyAction`.

    Attributes:
        experience: the kind of experience in words; None for rollouts of an experiment, whose scene is recorded.
        failures: number of the samples that failed; None for a policy learned from successes alone.
        held_out: by each way to hold out pick-ups that the data allows.
        coverage: the share of the successes of other default rollouts that the policy could have made; None if unknown.
        ceiling: the share of held-out scenes in which some way succeeds if the robot makes no errors, 0 to 1: no choice
            of ways can succeed more often. None if it was not measured.
        unknown: what the memory does not know of the samples, such as the place to which the robot was sent.
    """

    experience: str | None = None
    failures: int | None = None
    held_out: tuple[HeldOut, ...] = ()
    coverage: float | None = None
    ceiling: float | None = None
    unknown: tuple[str, ...] = ()


@dataclass
class LearnPolicyActionPerformable(ActionAbstract):
    """The node of a learned policy, with the origin of its training samples; `record_policy` performs it."""

    policy: str
    successes: int
    min_samples_leaf: int
    rollouts: int | None
    scene: str | None
    seeds: list[int]
    episode_count: int
    episodes: list[str]
    _memory: Memory | None = field(default=None, repr=False, compare=False)
    _content: bytes = field(default=b"", repr=False, compare=False)
    _evaluation: Evaluation | None = field(default=None, repr=False, compare=False)

    async def perform(self) -> None:
        assert self._memory is not None, "only record_policy creates and performs it"
        self._memory.observe(_OBSERVATION, Blob(self._content, _MEDIA_TYPE))
        if self._evaluation is not None:
            record_evaluation(self._memory, self.policy, self._evaluation)


async def record_policy(
    memory: Memory,
    policy: AnyPolicy,
    *,
    episodes: Iterable[str],
    successes: int,
    min_samples_leaf: int,
    rollouts: int | None = None,
    scene: str | None = None,
    seeds: Iterable[int] = (),
    evaluation: Evaluation | None = None,
) -> str:
    """Record a learned policy, in the open episode or in one of its own, and return its name.

    Args:
        episodes: ids of the episodes that hold the training samples.
        successes: number of training samples.
        min_samples_leaf: the setting of `learn`.
        rollouts, scene, seeds: of the rollouts that gave the samples, if they were made by `batch_rollout`.
        evaluation: recorded with it.
    """
    ids, name = list(episodes), name_of(policy)
    await LearnPolicyActionPerformable(
        name, successes, min_samples_leaf, rollouts, scene, list(seeds), len(ids), ids[:EPISODES_MAX],
        memory, encode_policy(policy), evaluation,
    ).perform()  # fmt: skip
    return name


def keep_policy(name: str, policy: AnyPolicy) -> None:
    """Record the content of a policy that is used, in the open episode; once for each opened memory."""
    here = observing()
    if here is not None:
        here.keep(_OBSERVATION, name, lambda: Blob(encode_policy(policy), _MEDIA_TYPE))


def record_evaluation(memory: Memory, name: str, evaluation: Evaluation) -> None:
    """Record the evaluation of a policy, in the open episode."""
    memory.observe(_EVALUATION, {name: Blob(msgspec.json.encode(evaluation), _MEDIA_TYPE)})


async def read_evaluation(reading: Reading, name: str) -> Evaluation | None:
    """Return the latest recorded evaluation of the policy with this name; None if there is none."""
    content = await _blob(reading, _contents(_EVALUATION).where(ObservationValue.key == name))
    return None if content is None else msgspec.json.decode(content, type=Evaluation)


def policy_contents(name: str) -> Select[str | None]:
    """Select the hash of the blob that holds the content of the policy with this name, the latest first."""
    node = LearnPolicyAction
    of_node = node.id == Observation.node_id, node.process_metadata_id == Observation.process_metadata_id
    named = or_(ObservationValue.key == name, node.policy == name)
    return _contents(_OBSERVATION).outerjoin(node, and_(*of_node)).where(named)


def _contents(observed: str) -> Select[str | None]:
    value = ObservationValue
    of_value = Observation.id == value.id, Observation.process_metadata_id == value.process_metadata_id
    statement = select(value.blob).join(Observation, and_(*of_value))
    return statement.where(Observation.name == observed, value.blob.is_not(None)).order_by(Observation.id.desc())


async def _blob(reading: Reading, statement: Select[str | None]) -> bytes | None:
    async with reading.session() as session:
        hash_ = await session.scalar(statement.limit(1))
    blob = await reading.blob(hash_) if hash_ is not None else None
    return None if blob is None else blob.content


async def recorded_names(reading: Reading) -> set[str]:
    """Return the names of the policies whose content was recorded when they were used."""
    names = _contents(_OBSERVATION).with_only_columns(ObservationValue.key).order_by(None).distinct()
    async with reading.session() as session:
        keys = set((await session.scalars(names)).all())
    return keys - {"value"}  # the key of the content below a `LearnPolicyAction`, which names the policy itself


async def read_policy(reading: Reading, name: str) -> AnyPolicy:
    """Return the recorded policy with this name.

    Raises `CallerError` if the memory does not hold it, or one that this version of the program does not read.
    """
    content = await _blob(reading, policy_contents(name))
    if content is None:
        raise CallerError(f"the memory holds no policy {name!r}: `MoveAndPickUpAction.policy` names those it holds")
    try:
        return decode_policy(content)
    except (msgspec.MsgspecError, ValueError, KeyError, ImpossibleCondition) as error:
        raise CallerError(f"the policy {name} cannot be read: {error}") from None
