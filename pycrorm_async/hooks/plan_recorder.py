"""The `Recorder` receives the reports of the plan and the world, and passes each to its episode.

Theory of operation. The plan layer and the world call the recorder synchronously, in the thread and context of the
plan. `current_episode` holds the episode of a context. It is used only if it is open in this memory and if it is a
simulation exactly when the context is in one, so that no simulated event gets into a real episode. A node that starts
without an episode opens an implicit one, which ends with the node; that node's context then sees the implicit episode
until the node ends.

A plan that runs without a memory also runs with one, because the recorder catches and counts every exception of its
own. Only the caller's settings let an exception reach a plan, and only before `perform` runs: `SpoolFull` with
`on_full="fail"`; `Unrecordable` and `DeclarationRefused` with `on_unrecordable="refuse"`. Without these settings, a
value that cannot be recorded is recorded as missing.

`node_ended` may also run in a thread and context of the garbage collector, when it closes a plan that was dropped
unfinished. So it resets `current_episode` only if the context still holds the node's episode, and it never starts a
follow-up (see `episode`).
"""

from __future__ import annotations

import logging
from collections.abc import Awaitable, Callable
from contextlib import nullcontext
from contextvars import ContextVar
from typing import Any, Literal

from pycrorm_async.errors import DeclarationRefused, EpisodeRefused, Unrecordable
from pycrorm_async.events.values import NodeReference
from pycrorm_async.hooks.declaration import Declarations
from pycrorm_async.hooks.episode import Episode, NodeRecord
from pycrorm_async.hooks.sampler import Sampler
from pycrorm_async.plan.execution.observer import Candidate, Cells, Refusal, Seen, Simulation, current_simulation
from pycrorm_async.plan.execution.unawaited_performs import CalledPerforms
from pycrorm_async.plan.task_tree import TaskTreeNode
from pycrorm_async.recording.declarations.declared_type import DeclaredType
from pycrorm_async.recording.declarations.known_types import KnownTypes
from pycrorm_async.recording.values.episode_arguments import NO_LABELS, Labels, check_arguments
from pycrorm_async.recording.values.event_fitting import EPISODE_TEXT_MAX
from pycrorm_async.recording.writing.emitter import Emitter
from pycrorm_async.recording.writing.episode_opening import EpisodeOpening, current_task
from pycrorm_async.recording.writing.episode_writer import EpisodeWriter
from pycrorm_async.recording.writing.open_episodes import OpenEpisodes
from pycrorm_async.recording.writing.provenance import Provenance
from pycrorm_async.world.bullet import BulletWorld
from pycrorm_async.world.enums import ObjectType
from pycrorm_async.world.observers import current_world

_log = logging.getLogger("pycrorm_async")
current_episode: ContextVar[Episode | None] = ContextVar("current_episode", default=None)
"""The innermost episode opened in this context; it may be closed already."""


class Recorder:
    """Implements the plan layer's `PlanObserver` and the world's `WorldWatcher` for one memory."""

    def __init__(
        self,
        emitter: Emitter,
        *,
        episodes: OpenEpisodes,
        software: str,
        provenance: Provenance | None = None,
    ) -> None:
        self._emitter = emitter
        self.episodes = episodes
        self._software = software
        self._provenance = provenance
        self._strict = emitter.settings.on_unrecordable == "refuse"
        self._declarations = Declarations(strict=self._strict)
        self._sampler = _sampler_of(emitter)
        self.calls = CalledPerforms(lambda designator: emitter.note_unawaited(getattr(designator, "dtype", "it")))
        """Performs called outside any episode."""

    @property
    def known_types(self) -> KnownTypes:
        """The types declared in this memory, by any executive."""
        return self._declarations.known

    @property
    def is_closed(self) -> bool:
        """True if the memory is closed, or belongs to the process that forked this one."""
        return self._emitter.is_closed

    # --- episodes ---------------------------------------------------------------------------------------------

    def open_episode(
        self, *, description: str, plan: str | None = None, seed: int | None = None, labels: Labels = NO_LABELS
    ) -> Episode:
        """Open an episode in this context; `close_episode` ends it.

        Raises `EpisodeRefused` if this task has an open episode, `CallerError` for an argument that does not fit.
        """
        open_episode = self.episode_here()
        if open_episode is not None and open_episode.task is current_task():
            raise EpisodeRefused(
                f"episode {open_episode} is open in this task already: end it first, or open the other in its own task"
            )
        check_arguments(description=description, plan=plan, seed=seed, strict=self._strict)
        return self._start(description, plan=plan, seed=seed, labels=labels)

    def _start(
        self, description: str, *, plan: str | None = None, seed: int | None = None, labels: Labels = NO_LABELS
    ) -> Episode:
        """Start an episode; a simulation if this context is in one."""
        simulation, world = current_simulation.get(), current_world.get()
        opening = EpisodeOpening(
            description,
            self._software,
            plan,
            seed,
            world.description if world else None,
            simulated=simulation is not None,
            thought_by=_simulating_node(simulation),
            provenance=self._provenance,
            labels=labels,
        )
        episode = Episode(self._emitter, self.episodes.new_id(), opening, self._declared)
        self.episodes.add(episode)  # first, so that the memory ends an episode whose start Ctrl-C interrupted
        try:
            episode.open()
        except Exception:
            self.episodes.by_id.pop(episode.id, None)
            raise
        if world is not None:
            self._enter(episode, world)
        return episode

    def _enter(self, episode: Episode, world: BulletWorld) -> None:
        episode.enter_world(world, lambda: self.continue_episode(episode))

    def continue_episode(self, episode: Episode) -> None:
        """Continue an episode that reached `continue_at` in a follow-up episode. Exceptions are counted, not raised."""
        around = self._sampler.renumbering(episode) if self._sampler is not None else nullcontext()
        self.episodes.continue_episode(episode, around)

    def _declared(self, node: TaskTreeNode) -> DeclaredType:
        assert node.designator is not None
        return self._declarations.of(type(node.designator), self._emitter.put_declaration)

    def close_episode(self, episode: EpisodeWriter[Any], failure: BaseException | None) -> None:
        """Write the end of an episode that `failure` left, or None. Exceptions are counted, not raised."""
        if self._sampler is not None and not self._emitter.is_closed:
            self._sample(self._sampler.stop_episode, episode)
        self.episodes.close(episode, failure)

    @property
    def samples_left_out(self) -> int:
        """The number of samples omitted because the spool or the episode had no room."""
        return self._sampler.omitted if self._sampler is not None else 0

    def close(self) -> None:
        """Stop the sampler and report performs that were never awaited."""
        self.calls.close()
        if self._sampler is not None:
            self._sampler.close()

    def episode_here(self) -> Episode | None:
        """Return the open episode of this memory in this context; None if only one of the two is a simulation."""
        episode = current_episode.get()
        if episode is None or episode.closed or episode.id not in self.episodes.by_id:
            return None
        return episode if episode.simulated is (current_simulation.get() is not None) else None

    def episode_of(self, node: TaskTreeNode) -> Episode | None:
        """Return the open episode of this memory in which the node is recorded; None without one."""
        record: NodeRecord | None = node.record
        return record.episode if record is not None and record.episode.id in self.episodes.by_id else None

    # --- the port of the plan layer ----------------------------------------------------------------------------------

    def admit(self) -> Awaitable[None] | None:
        if self._emitter.is_closed or not self._emitter.must_wait():
            return None
        return self._emitter.sink.room()

    def node_started(self, node: TaskTreeNode) -> None:
        if self._emitter.is_closed:
            return
        assert node.designator is not None
        outer_episode = current_episode.get()
        implicit: Episode | None = None
        try:
            declared = self._declarations.of(type(node.designator), self._emitter.put_declaration)
            episode = self.episode_here()
            if episode is None:
                dtype = declared.dtype
                episode = implicit = self.open_episode(description=dtype, plan=dtype)
            sequence = episode.start_node(node, declared)
        except BaseException as error:
            if implicit is not None:
                self.close_episode(implicit, error)
            if isinstance(error, Unrecordable | DeclarationRefused) or not isinstance(error, Exception):
                raise
            self._emitter.note_fault("NodeStarted", error)  # a fault of the memory must not reach a plan
        else:
            node.record = NodeRecord(episode, sequence, implicit is not None, outer_episode, episode.id)
            if implicit is not None:
                current_episode.set(implicit)
            if declared.fault is not None:
                self._emitter.missing.note(declared.dtype, "type", declared.fault)
            if self._sampler is not None and node.kind == "motion" and episode.acts_in_recorded_world:
                self._sample(self._sampler.begin, episode, sequence)
            if sequence >= episode.continue_at:
                self.continue_episode(episode)

    def node_ended(self, node: TaskTreeNode) -> None:
        record: NodeRecord | None = node.record
        if record is None or self._emitter.is_closed:
            return
        if self._sampler is not None and node.kind == "motion":
            self._sample(self._sampler.end, record.episode, record.sequence)
        try:
            record.episode.end_node(node)
        except Exception as error:  # noqa: BLE001  a fault of the memory must not reach a plan
            self._emitter.note_fault("NodeEnded", error)
        if record.implicit:
            self.close_episode(record.episode, node.failure)
            if current_episode.get() is record.episode:  # the garbage collector may close the plan in another context
                current_episode.set(record.outer_episode)

    def location_resolved(
        self, *, location: str, offered: tuple[Candidate, ...], taken: int | None, considered: int,
        refused: tuple[Refusal, ...], offered_beyond: int, cells: Cells | None, node: TaskTreeNode | None,
    ) -> None:  # fmt: skip
        episode = self.episode_here()
        if episode is None or self._emitter.is_closed:
            return
        try:
            sequence = episode.record_location(
                location=location, offered=offered, taken=taken, considered=considered, refused=refused,
                offered_beyond=offered_beyond, cells=cells, node=node,
            )  # fmt: skip
        except Exception as error:  # noqa: BLE001  a fault of the memory must not reach a plan
            self._emitter.note_fault("LocationResolved", error)
        else:
            if sequence >= episode.continue_at:
                self.continue_episode(episode)

    def object_detected(
        self, *, source: Literal["camera", "world_state"], object_type: ObjectType | None, seen: tuple[Seen, ...],
        node: TaskTreeNode | None,
    ) -> None:  # fmt: skip
        episode = self.episode_here()
        if episode is None or self._emitter.is_closed:
            return
        try:
            sequence = episode.record_detection(source=source, object_type=object_type, seen=seen, node=node)
        except Exception as error:  # noqa: BLE001  a fault of the memory must not reach a plan
            self._emitter.note_fault("ObjectDetected", error)
        else:
            if sequence >= episode.continue_at:
                self.continue_episode(episode)

    def simulation_started(self, simulation: Simulation) -> None:
        if self._emitter.is_closed:
            return
        outer = current_episode.get()
        simulation.record = record = _SimulationRecord(
            outer.node_reference(simulation.by) if outer is not None else None, outer
        )
        try:
            record.episode = self._start(_description_of(simulation))
        except Exception as error:  # noqa: BLE001  a fault of the memory must not reach a plan
            self._emitter.note_fault("EpisodeStarted", error)
        # None if the episode could not start, so that no simulated event gets into the outer episode.
        current_episode.set(record.episode)

    def simulation_ended(self, simulation: Simulation, failure: BaseException | None) -> None:
        record: _SimulationRecord | None = simulation.record
        if record is None:
            return
        if record.episode is not None:
            self.close_episode(record.episode, failure)
        if current_episode.get() is record.episode:  # the garbage collector may close the plan in another context
            current_episode.set(record.outer_episode)

    def _sample(self, step: Callable[..., None], *arguments: object) -> None:
        try:
            step(*arguments)
        except Exception as error:  # noqa: BLE001  a fault of the memory must not reach a plan
            self._emitter.note_fault("StateSampled", error)

    # --- the port of the world ---------------------------------------------------------------------------------------

    def world_entered(self, world: BulletWorld) -> None:
        episode = self.episode_here()
        if episode is None or self._emitter.is_closed:
            return
        try:
            self._enter(episode, world)
        except Exception as error:  # noqa: BLE001  a fault of the memory must not prevent entering a world
            self._emitter.note_fault("entering a world", error)

    def world_left(self, world: BulletWorld) -> None:
        episode = self.episode_here()
        if episode is not None:
            episode.leave_world(world, emptied=True)


def _sampler_of(emitter: Emitter) -> Sampler | None:
    settings = emitter.settings
    if settings.sample_interval_ms is None:
        return None
    return Sampler(emitter, interval_ms=settings.sample_interval_ms, change_min=settings.sample_change_min)


class _SimulationRecord:
    """The hooks' record of a running simulation.

    Attributes:
        node: the node that runs the simulation; None outside any recorded episode.
        outer_episode: the current episode of the context before the simulation began.
        episode: the simulation's own episode; None if it could not start.
    """

    def __init__(self, node: NodeReference | None, outer_episode: Episode | None) -> None:
        self.node = node
        self.outer_episode = outer_episode
        self.episode: Episode | None = None


def _simulating_node(simulation: Simulation | None) -> NodeReference | None:
    record = simulation.record if simulation is not None else None
    return record.node if isinstance(record, _SimulationRecord) else None


def _description_of(simulation: Simulation) -> str:
    if simulation.description is not None:
        return simulation.description[:EPISODE_TEXT_MAX]
    if simulation.by is not None and simulation.by.designator is not None:
        return f"simulation in {simulation.by.designator.dtype}"
    return "simulation"
