"""Record learned policies in the memory, and read them back by name.

Rollouts and sampled pick-ups name their policy by the hash of its content (`name_of`), so a run stays explainable when
its policy file has been overwritten: they record the content as a blob of the memory. `record_policy` records it under
a node that also names the training episodes and settings.

>>> await record_policy(memory, policy, episodes=memory.recent_episodes, successes=158, min_samples_leaf=25)
>>> same = await read_policy(memory.reading, name_of(policy))
"""

from __future__ import annotations

from collections.abc import Iterable
from dataclasses import dataclass, field

from sqlalchemy import Select, and_, or_, select

from pycrorm_async.errors import CallerError
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

    async def perform(self) -> None:
        assert self._memory is not None, "only record_policy creates and performs it"
        self._memory.observe(_OBSERVATION, Blob(self._content, _MEDIA_TYPE))


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
) -> str:
    """Record a learned policy, in the open episode or in one of its own, and return its name.

    Args:
        episodes: ids of the episodes that hold the training samples.
        successes: number of training samples.
        min_samples_leaf: the setting of `learn`.
        rollouts, scene, seeds: of the rollouts that gave the samples, if they were made by `batch_rollout`.
    """
    ids, name = list(episodes), name_of(policy)
    await LearnPolicyActionPerformable(
        name, successes, min_samples_leaf, rollouts, scene, list(seeds), len(ids), ids[:EPISODES_MAX],
        memory, encode_policy(policy),
    ).perform()  # fmt: skip
    return name


def keep_policy(name: str, policy: AnyPolicy) -> None:
    """Record the content of a policy that is used, in the open episode; once for each opened memory."""
    here = observing()
    if here is not None:
        here.keep(_OBSERVATION, name, lambda: Blob(encode_policy(policy), _MEDIA_TYPE))


def policy_contents(name: str) -> Select[str | None]:
    """Select the hash of the blob that holds the content of the policy with this name, the latest first."""
    node, observation, value = LearnPolicyAction, Observation, ObservationValue
    of_node = node.id == observation.node_id, node.process_metadata_id == observation.process_metadata_id
    return (
        select(value.blob)
        .join(
            observation, and_(observation.id == value.id, observation.process_metadata_id == value.process_metadata_id)
        )
        .outerjoin(node, and_(*of_node))
        .where(observation.name == _OBSERVATION, value.blob.is_not(None))
        .where(or_(value.key == name, node.policy == name))
        .order_by(observation.id.desc())
    )


async def read_policy(reading: Reading, name: str) -> AnyPolicy:
    """Return the recorded policy with this name. Raises `CallerError` if the memory does not hold it."""
    async with reading.session() as session:
        hash_ = await session.scalar(policy_contents(name).limit(1))
    blob = await reading.blob(hash_) if hash_ is not None else None
    if blob is None:
        raise CallerError(f"the memory holds no policy {name!r}: `MoveAndPickUpAction.policy` names those it holds")
    return decode_policy(blob.content)
