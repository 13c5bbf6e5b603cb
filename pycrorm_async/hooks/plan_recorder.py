"""The memory as plans and worlds meet it: finds the episode an observation belongs to and hands it on.

A plan that runs without a memory runs with one. What reaches it, before `perform` runs, is the caller's choice alone:
`SpoolFull` with `on_full="fail"`, `Unrecordable` and `DeclarationRefused` with `on_unrecordable="refuse"`. What cannot
be recorded otherwise is recorded as missing, and every fault of ours is counted and stays here.
"""

from __future__ import annotations

import logging
import os
from collections import deque
from collections.abc import Awaitable, Callable
from contextlib import nullcontext
from contextvars import ContextVar
from typing import Literal

from pycrorm_async.clock import Clock
from pycrorm_async.errors import CallerError, DeclarationRefused, EpisodeRefused, SpoolFull, Unrecordable
from pycrorm_async.events.envelope import Heading
from pycrorm_async.events.ids import EpisodeId, episode_id, episode_text
from pycrorm_async.events.types import NodeReference
from pycrorm_async.hooks.declaration import Declarations, DeclaredType
from pycrorm_async.hooks.emitter import Emitter
from pycrorm_async.hooks.episode import Episode, EpisodeOpening, NodeRecord, current_task
from pycrorm_async.hooks.sampler import Sampler
from pycrorm_async.hooks.values.event_fitting import EPISODE_TEXT_MAX
from pycrorm_async.plan.execution.observer import Candidate, Seen, Thought, thinking
from pycrorm_async.plan.execution.unawaited_performs import CalledPerforms
from pycrorm_async.plan.task_tree import TaskTreeNode
from pycrorm_async.world.bullet import BulletWorld
from pycrorm_async.world.enums import ObjectType
from pycrorm_async.world.observers import current_world

__all__ = ["Recorder", "current_episode"]

_log = logging.getLogger("pycrorm_async")
RECENT_MAX = 100

current_episode: ContextVar[Episode | None] = ContextVar("current_episode", default=None)


class Recorder:
    """Implements the plan layer's `PlanObserver` and the world's `WorldWatcher` for one memory."""

    def __init__(
        self,
        emitter: Emitter,
        *,
        clock: Clock,
        software: str,
        randomness: Callable[[int], bytes] = os.urandom,
    ) -> None:
        self._emitter = emitter
        self._clock = clock
        self._software = software
        self._randomness = randomness
        self._strict = emitter.settings.on_unrecordable == "refuse"
        self._declarations = Declarations(strict=self._strict)
        self._sampler = _sampler_of(emitter)
        self.calls = CalledPerforms(lambda designator: emitter.note_unawaited(getattr(designator, "dtype", "it")))
        """Performs that were called outside any episode."""
        self._open: dict[EpisodeId, Episode] = {}
        self._recent: deque[EpisodeId] = deque(maxlen=RECENT_MAX)
        self.opened_count = 0
        self.continued_count = 0
        self._continuing: set[EpisodeId] = set()

    @property
    def over(self) -> bool:
        """Whether its memory is closed."""
        return self._emitter.over

    # --- episodes ---------------------------------------------------------------------------------------------

    def open_episode(self, *, description: str, plan: str | None = None, seed: int | None = None) -> Episode:
        """Begin an episode in this context; `close_episode` ends it. Refused if this task has one open already."""
        open_here = self._open_here()
        if open_here is not None and open_here.task is current_task():
            raise EpisodeRefused(
                f"episode {open_here} is open in this task already: end it first, or open the second in its own task"
            )
        _check_arguments(description=description, plan=plan, seed=seed, strict=self._strict)
        return self._begin(description, plan=plan, seed=seed)

    def _begin(self, description: str, *, plan: str | None = None, seed: int | None = None) -> Episode:
        """An episode of what happens in this context, or is thought in it."""
        thought, world = thinking.get(), current_world.get()
        name = episode_id(self._clock.wall_ns(), self._randomness(10))
        opening = EpisodeOpening(
            description,
            self._software,
            plan,
            seed,
            world.description if world else None,
            simulated=thought is not None,
            thought_by=_thinker(thought),
        )
        episode = Episode(self._emitter, name, opening)
        self._open[name] = episode
        self._note_opened(episode)
        if world is not None:
            self._enter(episode, world)
        return episode

    def _enter(self, episode: Episode, world: BulletWorld) -> None:
        episode.enter_world(world, lambda: self._continue(episode))

    def _continue(self, episode: Episode) -> None:
        """Go on with an episode that comes near its last sequence in a follow-up. A fault of ours is counted."""
        if episode.id in self._continuing or self._emitter.over:
            return
        former, name = episode.id, episode_id(self._clock.wall_ns(), self._randomness(10))
        self._continuing.add(former)
        self._open[name] = episode
        try:
            with self._sampler.renumbering(episode) if self._sampler is not None else nullcontext() as renumber:
                renumbered = episode.continue_as(name, self._declared)
                if renumber is not None:
                    renumber(renumbered)
        except Exception as error:  # noqa: BLE001  a fault of ours never reaches a plan
            self._emitter.note_fault("EpisodeStarted", error)
        finally:
            self._open.pop(former if episode.id == name else name, None)
            self._continuing.discard(former)
        if episode.id == name:
            self.continued_count += 1
            self._note_opened(episode)
            _log.info("episode %s came near its last sequence and goes on in episode %s", episode_text(former), episode)

    def _declared(self, node: TaskTreeNode) -> DeclaredType:
        assert node.designator is not None
        return self._declarations.of(type(node.designator), self._declare)

    def _note_opened(self, episode: Episode) -> None:
        if not episode.simulated:
            self._recent.append(episode.id)
            self.opened_count += 1

    def close_episode(self, episode: Episode, failure: BaseException | None) -> None:
        """Its last event. A fault of ours is counted, not raised."""
        if self._emitter.over:
            return
        self._open.pop(episode.id, None)
        try:
            if self._sampler is not None:
                self._sampler.drop(episode)
            episode.end(failure)
        except Exception as error:  # noqa: BLE001  the plan's own outcome matters more
            self._emitter.note_fault("EpisodeEnded", error)

    @property
    def samples_left_out(self) -> int:
        """How many samples of the robot's state the spool had no room for."""
        return self._sampler.left_out if self._sampler is not None else 0

    def close(self) -> None:
        """The memory is over, and so is the sampling."""
        self.calls.close()
        if self._sampler is not None:
            self._sampler.close()

    @property
    def open_episodes(self) -> tuple[Episode, ...]:
        """Those that have begun and not ended, oldest first."""
        return tuple(self._open.values())

    @property
    def recent_episodes(self) -> tuple[str, ...]:
        """The ids of the last hundred that were opened, also of those that have ended."""
        return tuple(map(episode_text, self._recent))

    def _open_here(self) -> Episode | None:
        """The open episode of this memory in this context; never that of a thought where things happen."""
        episode = current_episode.get()
        if episode is None or episode.closed or episode.id not in self._open:
            return None
        return episode if episode.simulated is (thinking.get() is not None) else None

    # --- the plan layer's port ----------------------------------------------------------------------------------

    def admit(self) -> Awaitable[None] | None:
        if self._emitter.over or not self._emitter.sink.full:
            return None
        if self._emitter.settings.on_full == "fail":
            raise SpoolFull("the spool is full (spool_bytes_max) and on_full is 'fail': start a writer or make room")
        return self._emitter.sink.room()

    def node_started(self, node: TaskTreeNode) -> None:
        if self._emitter.over:
            return
        assert node.designator is not None
        before = current_episode.get()
        implicit: Episode | None = None
        try:
            declared = self._declarations.of(type(node.designator), self._declare)
            episode = self._open_here()
            if episode is None:
                name = declared.dtype
                episode = implicit = self.open_episode(description=name, plan=name)
            sequence = episode.start_node(node, declared)
        except (Unrecordable, DeclarationRefused) as refused:
            if implicit is not None:
                self.close_episode(implicit, refused)
            raise
        except Exception as error:  # noqa: BLE001  a fault of ours never reaches a plan
            self._emitter.note_fault("NodeStarted", error)
            if implicit is not None:
                self.close_episode(implicit, error)
        else:
            node.record = NodeRecord(episode, sequence, implicit is not None, before, episode.id)
            if implicit is not None:
                current_episode.set(implicit)
            if declared.fault is not None:
                self._emitter.missing.note(declared.dtype, "type", declared.fault)
            if self._sampler is not None and node.kind == "motion" and episode.in_its_world:
                self._sample(self._sampler.begin, node.record)
            if sequence >= episode.continue_at:
                self._continue(episode)

    def node_ended(self, node: TaskTreeNode) -> None:
        record: NodeRecord | None = node.record
        if record is None or self._emitter.over:
            return
        if self._sampler is not None and node.kind == "motion":
            self._sample(self._sampler.end, record)
        try:
            record.episode.end_node(node)
        except Exception as error:  # noqa: BLE001  a fault of ours never reaches a plan
            self._emitter.note_fault("NodeEnded", error)
        if record.implicit:
            self.close_episode(record.episode, node.failure)
            if current_episode.get() is record.episode:  # a dropped plan is closed in whatever context drops it
                current_episode.set(record.before)

    def location_resolved(
        self, *, location: str, offered: tuple[Candidate, ...], taken: int | None, considered: int,
        node: TaskTreeNode | None,
    ) -> None:  # fmt: skip
        episode = self._open_here()
        if episode is None or self._emitter.over:
            return
        try:
            sequence = episode.locate(location=location, offered=offered, taken=taken, considered=considered, node=node)
        except Exception as error:  # noqa: BLE001  a fault of ours never reaches a plan
            self._emitter.note_fault("LocationResolved", error)
        else:
            if sequence >= episode.continue_at:
                self._continue(episode)

    def object_detected(
        self, *, source: Literal["camera", "world_state"], object_type: ObjectType | None, seen: tuple[Seen, ...],
        node: TaskTreeNode | None,
    ) -> None:  # fmt: skip
        episode = self._open_here()
        if episode is None or self._emitter.over:
            return
        try:
            sequence = episode.detect(source=source, object_type=object_type, seen=seen, node=node)
        except Exception as error:  # noqa: BLE001  a fault of ours never reaches a plan
            self._emitter.note_fault("ObjectDetected", error)
        else:
            if sequence >= episode.continue_at:
                self._continue(episode)

    def thought_began(self, thought: Thought) -> None:
        if self._emitter.over:
            return
        before = current_episode.get()
        thought.record = record = _ThoughtRecord(before.naming(thought.by) if before is not None else None, before)
        try:
            record.episode = self._begin(_description_of(thought))
        except Exception as error:  # noqa: BLE001  a fault of ours never reaches a plan
            self._emitter.note_fault("EpisodeStarted", error)
        # None, if it could not begin: what is only thought never gets into the episode around it.
        current_episode.set(record.episode)

    def thought_ended(self, thought: Thought, failure: BaseException | None) -> None:
        record: _ThoughtRecord | None = thought.record
        if record is None:
            return
        if record.episode is not None:
            self.close_episode(record.episode, failure)
        if current_episode.get() is record.episode:  # a dropped plan is closed in whatever context drops it
            current_episode.set(record.before)

    def _sample(self, do: Callable[[Episode, int], None], record: NodeRecord) -> None:
        try:
            do(record.episode, record.sequence)
        except Exception as error:  # noqa: BLE001  a fault of ours never reaches a plan
            self._emitter.note_fault("StateSampled", error)

    def _declare(self, declared: DeclaredType) -> None:
        kind = type(declared.declaration)
        self._emitter.put_payload(Heading(None, kind.__name__, kind.version), declared.payload)

    # --- the world's port ---------------------------------------------------------------------------------------

    def world_entered(self, world: BulletWorld) -> None:
        episode = self._open_here()
        if episode is None or self._emitter.over:
            return
        try:
            self._enter(episode, world)
        except Exception as error:  # noqa: BLE001  a fault of ours never keeps a world from being entered
            self._emitter.note_fault("entering a world", error)

    def world_left(self, world: BulletWorld) -> None:
        episode = self._open_here()
        if episode is not None:
            episode.leave_world(world, emptied=True)


def _sampler_of(emitter: Emitter) -> Sampler | None:
    settings = emitter.settings
    if settings.sample_interval_ms is None:
        return None
    return Sampler(emitter, interval_ms=settings.sample_interval_ms, change_min=settings.sample_change_min)


class _ThoughtRecord:
    """What the memory keeps at a thought.

    Attributes:
        thinker: the node in which it is thought; None where nothing was recorded around it.
        before: the current episode of the context when it began.
        episode: its own; None if it could not begin.
    """

    def __init__(self, thinker: NodeReference | None, before: Episode | None) -> None:
        self.thinker = thinker
        self.before = before
        self.episode: Episode | None = None


def _thinker(thought: Thought | None) -> NodeReference | None:
    record = thought.record if thought is not None else None
    return record.thinker if isinstance(record, _ThoughtRecord) else None


def _description_of(thought: Thought) -> str:
    if thought.description is not None:
        return thought.description[:EPISODE_TEXT_MAX]
    if thought.by is not None and thought.by.designator is not None:
        return f"thinking in {thought.by.designator.dtype}"
    return "thinking"


def _check_arguments(*, description: object, plan: object, seed: object, strict: bool) -> None:
    """What an episode is opened with must fit its columns. Raises `CallerError` naming the argument.

    A text that is too long is cut, and in strict mode refused.
    """
    for name, text in (("plan", plan), ("description", description)):
        if text is not None and not (isinstance(text, str) and (len(text) <= EPISODE_TEXT_MAX or not strict)):
            raise CallerError(f"the {name} of an episode must be a str of at most {EPISODE_TEXT_MAX:,} characters")
    if seed is not None and not (isinstance(seed, int) and -(2**63) <= seed < 2**63):
        raise CallerError(f"the seed of an episode must be an int of at most 64 bits, not {seed!r:.100}")
