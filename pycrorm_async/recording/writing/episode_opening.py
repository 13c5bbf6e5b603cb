"""Build the first event of an episode, and the statuses that an episode and its root end with."""

from __future__ import annotations

import asyncio
import getpass
import platform
from typing import Any, NamedTuple, TypeAlias

from pycrorm_async.events.ids import EpisodeId, episode_text
from pycrorm_async.events.types import EpisodeStarted
from pycrorm_async.events.values import EpisodeStatus, NodeReference, NodeStatus
from pycrorm_async.plan.exceptions import is_plan_failure
from pycrorm_async.recording.values.episode_arguments import NO_LABELS, Labels
from pycrorm_async.recording.values.texts import clean
from pycrorm_async.recording.writing.provenance import Provenance

Failures: TypeAlias = tuple[type[BaseException], ...]
"""The classes of an executive's own plan failures."""


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


def end_statuses(failure: BaseException | None, failures: Failures = ()) -> tuple[EpisodeStatus, NodeStatus]:
    """Return the statuses of an episode, and of a node, that this exception left."""
    if failure is None:
        return "SUCCEEDED", "SUCCEEDED"
    if is_plan_failure(failure) or isinstance(failure, failures):
        return "FAILED", "FAILED"
    if isinstance(failure, asyncio.CancelledError | KeyboardInterrupt | SystemExit):
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
