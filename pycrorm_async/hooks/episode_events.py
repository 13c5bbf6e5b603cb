"""This module builds the first and last events of an episode and its observations from values of the plan."""

from __future__ import annotations

import asyncio
import getpass
import platform
from collections.abc import Sequence
from typing import Any, Literal, NamedTuple

from pycrorm_async.events.ids import EpisodeId, episode_text
from pycrorm_async.events.types import EpisodeStarted, LocationResolved, ObjectDetected
from pycrorm_async.events.values import (
    CandidateValue,
    EpisodeStatus,
    NodeReference,
    NodeStatus,
    RefusalValue,
    SeenValue,
)
from pycrorm_async.hooks.provenance import Provenance
from pycrorm_async.hooks.values.episode_arguments import NO_LABELS, Labels
from pycrorm_async.hooks.values.texts import clean
from pycrorm_async.hooks.values.value_snapshot import References, pose_value
from pycrorm_async.plan.exceptions import is_plan_failure
from pycrorm_async.plan.execution.observer import Candidate, Refusal, Seen
from pycrorm_async.plan.object_designators import ObjectDesignator
from pycrorm_async.world.enums import ObjectType

__all__ = ["EpisodeOpening", "episode_started", "location_resolved", "object_detected", "end_statuses", "current_task"]


class EpisodeOpening(NamedTuple):
    """The arguments an episode is opened with; its follow-ups repeat them."""

    description: str
    software: str
    plan: str | None = None
    seed: int | None = None
    world: str | None = None
    simulated: bool = False
    thought_by: NodeReference | None = None
    provenance: Provenance | None = None
    labels: Labels = NO_LABELS

    def with_tags(self, tags: tuple[str, ...]) -> EpisodeOpening:
        """Return the arguments with these tags instead."""
        return self._replace(labels=self.labels._replace(tags=tags))


def episode_started(opening: EpisodeOpening, continues: EpisodeId | None) -> EpisodeStarted:
    """Build the first event of an episode, or of a follow-up that continues another episode."""
    return EpisodeStarted(
        description=clean(opening.description),
        created_by=clean(_user()),
        host=clean(platform.node()),
        software=opening.software,
        python=platform.python_version(),
        plan=clean(opening.plan) if opening.plan is not None else None,
        seed=opening.seed,
        world=clean(opening.world) if opening.world is not None else None,
        simulated=opening.simulated,
        thought_by=opening.thought_by,
        continues=episode_text(continues) if continues is not None else None,
        tags=opening.labels.tags,
        metadata=dict(opening.labels.metadata),
        **(opening.provenance.fields() if opening.provenance is not None else {}),
    )


def location_resolved(
    location: str, offered: Sequence[Candidate], *, taken: int | None, considered: int, refused: Sequence[Refusal],
    offered_beyond: int, node: int | None,
) -> LocationResolved:  # fmt: skip
    """Build the event of a resolved location designator; `node` is the sequence of the node that resolved it."""
    return LocationResolved(
        location=clean(location),
        offered=tuple(
            CandidateValue(
                pose_value(each.pose),
                tuple(arm.name for arm in each.arms),
                each.grasp.name if each.grasp is not None else None,
                each.torso_height,
            )
            for each in offered
        ),
        taken=taken,
        considered=considered,
        node=node,
        refused=tuple(RefusalValue(pose_value(each.pose), clean(each.reason)) for each in refused),
        offered_beyond=offered_beyond,
    )


def object_detected(
    source: Literal["camera", "world_state"],
    object_type: ObjectType | None,
    seen: Sequence[Seen],
    references: References,
    *,
    node: int | None,
) -> ObjectDetected:
    """Build the event of a result of perception; `node` is the sequence of the node that asked for it."""
    values = tuple(_seen_value(each, references) for each in seen)
    return ObjectDetected(source, object_type.name if object_type is not None else None, values, node)


def _seen_value(seen: Seen, references: References) -> SeenValue:
    thing = seen.thing
    world_object = thing.world_object if isinstance(thing, ObjectDesignator) else thing
    return SeenValue(
        clean(thing.name),
        thing.object_type.name,
        pose_value(seen.pose if seen.pose is not None else thing.pose),
        references.reference(world_object) if world_object is not None else None,
        seen.visible,
        float(seen.confidence) if seen.confidence is not None else None,  # perception often computes a numpy.float32
        clean(seen.source) if seen.source is not None else None,
    )


def end_statuses(failure: BaseException | None) -> tuple[EpisodeStatus, NodeStatus]:
    """Return the statuses of an episode and of its root node after `failure` left the episode."""
    if failure is None:
        return "SUCCEEDED", "SUCCEEDED"
    if is_plan_failure(failure):
        return "FAILED", "FAILED"
    if isinstance(failure, asyncio.CancelledError | KeyboardInterrupt):
        return "INTERRUPTED", "CANCELLED"
    return "ERROR", "ERROR"


def current_task() -> asyncio.Task[Any] | None:
    """Return the running asyncio task; None outside an event loop."""
    try:
        return asyncio.current_task()
    except RuntimeError:
        return None


def _user() -> str:
    try:
        return getpass.getuser()
    except (OSError, KeyError):  # no entry for this uid, as in many containers
        return "unknown"
