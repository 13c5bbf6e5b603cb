"""An `Episode` records one open episode: it numbers the nodes, observes the world and writes how the episode ended.

Theory of operation. Starts of nodes, observations and changes of the world reach an episode in the thread of the plan,
through `Recorder` and `WorldRecorder`. Ends of nodes do so too, except when a plan is dropped unfinished: then the
garbage collector closes its coroutines and thereby ends its nodes, in any thread and in the middle of whatever that
thread is doing. The sampler's thread reads `id`, `world` and `continue_at`.

`_open_nodes` holds every node that started and whose end is not written. The call that removes a node writes its end,
so no node has two; if writing raises, it restores the node, which then ends LOST with the episode. `_ending` holds a
node while a thread writes its end. `end` and `continue_as` wait, for a limited time, until it is empty, because the end
of a node must precede the end of the episode. `end_node` never waits, because the garbage collector may call it.

A sequence has 26 bits, so an episode can run out of sequences. When one reaches `continue_at`, `continue_as` ends it,
and the same `Episode` object continues under a new id, so that contexts and nodes that refer to it stay valid. Every
open node ends INTERRUPTED with the reason EpisodeContinued, innermost first, then the root and the episode itself. The
follow-up begins with EpisodeStarted, which names the former episode, then a root, the world as it is then, and a start
of each interrupted node, outermost first. Such a start names the sequence that it continues and holds the node's
parameters and the robot's state as they are then. So each perform has exactly one row whose status is its outcome, and
the duration of a node is the sum of its parts.

Only a start, an observation or a change of the world triggers a follow-up, after it has been recorded itself. An end
never does, because the garbage collector may cause it. Until the next start, events use the reserve of sequences behind
`continue_at`, and the sampler takes only the first and the last sample of each motion. If an end cannot be written, the
next event tries again; `_interrupted` then holds the nodes that have an end and, if they still run then, are started
again in the follow-up. `NodeRecord.episode_id` is the id under which the node's sequence counts; a node whose
`episode_id` is not the episode's current id is never referred to in the follow-up.
"""

from __future__ import annotations

import time
from collections.abc import Callable, Mapping, Sequence
from typing import Final, Literal, NamedTuple

from pycrorm_async.errors import Unrecordable
from pycrorm_async.events.codec import NotEncodable
from pycrorm_async.events.ids import EpisodeId, episode_text
from pycrorm_async.events.tags import changed_tags
from pycrorm_async.events.types import EpisodeEnded, EpisodeTagged, NodeEnded, NodeStarted
from pycrorm_async.events.values import FailureValue, NodeReference, NodeStatus, ObjectReference, RobotValue
from pycrorm_async.hooks.episode_events import location_resolved, object_detected
from pycrorm_async.hooks.world_recorder import WorldRecorder
from pycrorm_async.plan.designator import Designator
from pycrorm_async.plan.execution.observer import Candidate, Refusal, Seen
from pycrorm_async.plan.execution.unawaited_performs import CalledPerforms
from pycrorm_async.plan.task_tree import TaskTreeNode
from pycrorm_async.recording.declarations.declared_type import DeclaredType
from pycrorm_async.recording.values.event_fitting import (
    episode_text_of,
    fit_detection,
    fit_episode_end,
    fit_episode_start,
    fit_node_end,
    fit_resolution,
)
from pycrorm_async.recording.values.parameters import ROBOT, fit_node_start, read_parameters
from pycrorm_async.recording.values.value_snapshot import encode_or_missing, failure_value, missing_in
from pycrorm_async.recording.writing.emitter import UNAWAITED_MAX, Emitter
from pycrorm_async.recording.writing.episode_opening import EpisodeOpening, current_task, end_statuses, episode_started
from pycrorm_async.world.bullet import BulletWorld
from pycrorm_async.world.enums import ObjectType
from pycrorm_async.world.objects import Object
from pycrorm_async.world.observers import current_world

__all__ = ["Episode", "NodeRecord", "CONTINUED"]

CONTINUED: Final = "EpisodeContinued"
"""The failure type of nodes and episodes that ended because a follow-up episode continues them."""

_RESERVE_EVENTS_MAX = 2**20
"""Bounds the sequences reserved behind `continue_at`: more open nodes than fit into a process' memory."""
_LAST_ENDS_S = 1.0
"""Bounds how long the end of an episode waits for ends of nodes in other threads; each takes microseconds."""


class NodeRecord(NamedTuple):
    """The hooks' record of a running node, kept as `TaskTreeNode.record`.

    Attributes:
        episode: the episode that recorded the node.
        sequence: sequence of the node's NodeStarted; its id.
        implicit: whether the episode was opened for this node alone and ends with it.
        outer_episode: the current episode of the context before the node started.
        episode_id: the episode's id when the node started; `sequence` counts under this id.
    """

    episode: Episode
    sequence: int
    implicit: bool
    outer_episode: Episode | None
    episode_id: EpisodeId


class Episode:
    """An open or closed episode.

    Attributes:
        id: 16 bytes of a UUIDv7; `str(episode)` is its text. A continued episode has the id of its latest follow-up.
        continue_at: the first sequence that triggers a follow-up episode.
        task: the asyncio task that opened the episode; None outside any task.
        closed: whether the last event has been written, or its writing has begun.
        simulated: whether the episode is a simulation.
        world: the recorder of its world; None without a world.
        faults: faults of the plan, each type once: performs that were never awaited.
        calls: performs called in the episode's context.
    """

    def __init__(self, emitter: Emitter, episode: EpisodeId, opening: EpisodeOpening) -> None:
        self.id = episode
        self.task = current_task()
        self.closed = False
        self.simulated: Final = opening.simulated
        self.world: WorldRecorder | None = None
        self.faults: tuple[str, ...] = ()
        self.calls: Final = CalledPerforms(self._note_unawaited)
        self._emitter = emitter
        self._opening = opening
        self._entered_world: str | None = None
        self._open_nodes: dict[int, TaskTreeNode] = {}
        self._interrupted: dict[int, TaskTreeNode] = {}
        self._ending: set[TaskTreeNode] = set()
        events_max = emitter.settings.episode_events_max
        self._continue_at: Final = events_max - min(events_max // 8, _RESERVE_EVENTS_MAX)
        self.continue_at = self._continue_at
        self._root = self._start(None, None)
        self._root_ended = False

    def _start(self, continues: EpisodeId | None, root: int | None) -> int:
        """Write the start of the episode and of its root node; return the root's sequence."""
        started = episode_started(self._opening, continues)
        started, shortened = fit_episode_start(started, self._emitter.settings.record_bytes_max)
        for name in shortened:
            self._emitter.missing.note("Episode", name, "its text is too long for an episode and was cut")
        self._emitter.put(self.id, started)
        return self._emitter.put(self.id, NodeStarted("root", simulated=self._opening.simulated, continues=root))

    def __str__(self) -> str:
        return episode_text(self.id)

    def __repr__(self) -> str:
        return f"<Episode {self}{' closed' if self.closed else ''}>"

    # --- world ------------------------------------------------------------------------------------------------

    def enter_world(self, world: BulletWorld, continue_: Callable[[], None]) -> None:
        """Record this world from now on. A second world at the same time is not recorded, but counted as missing.

        The world's recorder calls `continue_` when a change of the world has reached `continue_at`.
        """
        if self.world is None:
            self.world = WorldRecorder(self._emitter, self.id, world, continue_)
            self.world.continue_at = self.continue_at
        elif self.world.world is not world:
            self._emitter.missing.note("Episode", "second world", f"{self} records only the world entered first")

    @property
    def acts_in_recorded_world(self) -> bool:
        """Whether the current world of this context is the recorded world, and not a second one."""
        if self.world is None:
            return False
        current = current_world.get()
        return current is None or current is self.world.world

    def leave_world(self, world: BulletWorld, *, emptied: bool) -> None:
        """Stop recording this world; with `emptied`, record first that all its objects were removed."""
        if self.world is not None and self.world.world is world:
            self._described_world()
            if emptied:
                self.world.empty()
            self.world.stop()
            self.world = None

    def reference(self, world_object: Object) -> ObjectReference | None:
        """Return the object's current row in this episode; None without a row."""
        return self.world.reference(world_object) if self.world is not None else None

    def node_reference(self, node: TaskTreeNode | None) -> NodeReference:
        """Return a reference to this node, or to its nearest recorded ancestor; None gives the root."""
        return NodeReference(str(self), self.node_or_root(node))

    # --- nodes ------------------------------------------------------------------------------------------------

    def start_node(self, node: TaskTreeNode, declared: DeclaredType, continues: int | None = None) -> int:
        """Write the start of a node and return its sequence.

        Raises `Unrecordable` for a parameter, with `on_unrecordable="refuse"` only.
        """
        assert node.designator is not None
        missing: dict[str, str] = {}
        event = NodeStarted(
            kind=node.kind,
            parent=self._sequence_of(node.parent) or self._root,
            designator=declared.fingerprint or None,
            parameters=read_parameters(node.designator, declared, self, missing),
            robot=self._robot_state(),
            simulated=self.simulated,
            continues=continues,
        )
        if missing:
            self._note_parameters(declared, missing, may_refuse=continues is None)
        try:
            sequence = self._emitter.put(self.id, event)
        except NotEncodable:
            missing = {}
            event = fit_node_start(event, self._emitter.settings.record_bytes_max, missing)
            self._note_parameters(declared, missing, may_refuse=continues is None)
            sequence = self._emitter.put(self.id, event)
        self._open_nodes[sequence] = node
        return sequence

    def end_node(self, node: TaskTreeNode) -> None:
        """Write how a node ended."""
        record: NodeRecord = node.record
        self._ending.add(node)  # before the removal, so that no thread that misses the node ends the episode
        try:
            if self._open_nodes.get(record.sequence) is node:
                failure = failure_value(node.failure, self) if node.failure is not None else None
                result = encode_or_missing(node.result, self) if node.result is not None else None
                status: NodeStatus = node.status._value_  # `value` takes 0.1 µs longer
                assert node.designator is not None
                self._close_node(NodeEnded(record.sequence, status, failure, result), node.designator.dtype)
        finally:
            self._ending.discard(node)

    def record_location(
        self, *, location: str, offered: tuple[Candidate, ...], taken: int | None, considered: int,
        refused: tuple[Refusal, ...], offered_beyond: int, node: TaskTreeNode | None,
    ) -> int:  # fmt: skip
        """Write which places a location designator offered, took and refused; return the sequence."""
        number = self._sequence_of(node)
        resolved = location_resolved(
            location, offered, taken=taken, considered=considered, refused=refused, offered_beyond=offered_beyond,
            node=number,
        )  # fmt: skip
        try:
            return self._emitter.put(self.id, resolved)
        except NotEncodable as error:
            fitted = fit_resolution(resolved, self._emitter.settings.record_bytes_max)
            shortened = "offered" if len(fitted.offered) < len(resolved.offered) else "refused"
            self._emitter.missing.note(resolved.location, shortened, error.reason)
            return self._emitter.put(self.id, fitted)

    def record_detection(
        self, *, source: Literal["camera", "world_state"], object_type: ObjectType | None, seen: tuple[Seen, ...],
        node: TaskTreeNode | None,
    ) -> int:  # fmt: skip
        """Write the request to perception and its result; return the sequence."""
        detected = object_detected(source, object_type, seen, self, node=self._sequence_of(node))
        try:
            return self._emitter.put(self.id, detected)
        except NotEncodable as error:
            self._emitter.missing.note("ObjectDetected", "seen", error.reason)
            return self._emitter.put(self.id, fit_detection(detected, self._emitter.settings.record_bytes_max))

    def tag(self, added: Sequence[str], removed: Sequence[str]) -> None:
        """Write a change of the episode's tags. Raises `CallerError` for a removed tag that it does not have."""
        tags = changed_tags(self._opening.labels.tags, added, removed)
        self._emitter.put(self.id, EpisodeTagged(tuple(added), tuple(removed)))
        self._opening = self._opening.with_tags(tags)

    def end(self, failure: BaseException | None) -> None:
        """Write the end of the episode. Nodes that are still open end LOST, because no later end can be recorded."""
        if self.closed:
            return
        self.calls.close()
        self.closed = True
        if self.world is not None:
            self.leave_world(self.world.world, emptied=False)
        for sequence in sorted(self._open_nodes, reverse=True):
            self._close_node(NodeEnded(sequence, "LOST"), "Episode")
        self._wait_for_ends()
        status, root_status = end_statuses(failure)
        value = failure_value(failure, self) if failure is not None else None
        if not self._root_ended:
            self._put_end(NodeEnded(self._root, root_status, value), "Episode")
        ended = EpisodeEnded(status, value, world=self._described_world())
        try:
            self._emitter.put(self.id, ended)
        except NotEncodable:
            self._emitter.put(self.id, fit_episode_end(ended, self._emitter.settings.record_bytes_max))

    def continue_as(self, follow_up: EpisodeId, declared: Callable[[TaskTreeNode], DeclaredType]) -> dict[int, int]:
        """End the episode and continue it under the id `follow_up`; map the old sequences of open nodes to the new."""
        former, root, world = self.id, self._root, self.world
        self._interrupted.update(self._open_nodes)
        open_nodes = sorted(self._interrupted.items())
        reason = FailureValue(CONTINUED, f"the episode continues in episode {episode_text(follow_up)}")
        for sequence, node in reversed(open_nodes):
            interrupted = NodeEnded(sequence, "INTERRUPTED", reason)
            self._close_node(interrupted if node.ended_ns is None else NodeEnded(sequence, "LOST"), "Episode")
        self._wait_for_ends()
        if not self._root_ended:  # it ended in an attempt before this one
            self._put_end(NodeEnded(root, "INTERRUPTED", reason), "Episode")
            self._root_ended = True
        self._emitter.put(former, EpisodeEnded("INTERRUPTED", reason, episode_text(follow_up), self._described_world()))
        self.id = follow_up
        last = self._root = self._start(former, root)
        self._root_ended = False
        self._interrupted.clear()
        if world is not None:
            world.stop()
            self.world = WorldRecorder(self._emitter, follow_up, world.world, world.continue_)
            last = max(last, self.world.last)
        renumbered: dict[int, int] = {}
        for sequence, node in open_nodes:
            if node.ended_ns is not None:
                continue
            try:
                last = renumbered[sequence] = self.start_node(node, declared(node), continues=sequence)
            except Exception as error:  # noqa: BLE001  the other nodes continue nevertheless
                self._emitter.note_fault("NodeStarted", error)
                continue
            node.record = node.record._replace(sequence=last, episode_id=follow_up)
        # The world and the tree may reach the limit at once; doubling it prevents an endless chain of follow-ups.
        self.continue_at = max(self._continue_at, 2 * last)
        if self.world is not None:
            self.world.continue_at = self.continue_at
        return renumbered

    def _described_world(self) -> str | None:
        """Return the description of the world that was entered inside the episode; None if none was."""
        if self.world is not None and self._opening.world is None:
            self._entered_world = episode_text_of(self.world.world.description)
        return self._entered_world

    def _note_unawaited(self, designator: type[Designator]) -> None:
        self._emitter.note_unawaited(designator.dtype)
        fault = f"{designator.dtype}.perform() was called and never awaited"
        if fault not in self.faults:
            self.faults = (*self.faults[1 - UNAWAITED_MAX :], fault)

    # --- inside -----------------------------------------------------------------------------------------------

    def node_or_root(self, node: TaskTreeNode | None) -> int:
        """Return the sequence of this node or of its nearest recorded ancestor; None gives the root."""
        return self._sequence_of(node) or self._root

    def _sequence_of(self, node: TaskTreeNode | None) -> int | None:
        """Return the sequence of the node, or of its nearest ancestor recorded under the current id; else None."""
        while node is not None:
            record: NodeRecord | None = node.record
            if record is not None and record.episode is self and record.episode_id == self.id:
                return record.sequence
            node = node.parent
        return None

    def _note_parameters(self, declared: DeclaredType, missing: Mapping[str, str], *, may_refuse: bool) -> None:
        """Count the missing values of a start. Raises `Unrecordable` if `may_refuse` and the settings ask for it."""
        parameters = [name for name in missing if name != ROBOT]
        if may_refuse and parameters and self._emitter.settings.on_unrecordable == "refuse":
            raise Unrecordable(declared.dtype, " and ".join(parameters), missing[parameters[0]])
        for name, reason in missing.items():
            self._emitter.missing.note(declared.dtype, name, reason)

    def _robot_state(self) -> RobotValue | None:
        if self.world is None:
            return None
        current = current_world.get()
        if current is not self.world.world and current is not None:
            self._emitter.missing.note("Episode", "robot of a second world", "the episode records only the first world")
            return None
        try:
            return self.world.robot()
        except Exception as error:  # noqa: BLE001  the node is recorded without the robot's state
            self._emitter.note_fault("robot state", error)
            return None

    def _close_node(self, event: NodeEnded, owner: str) -> None:
        """Remove the node and write its end; no effect if it was removed, as the garbage collector may do meanwhile."""
        node = self._open_nodes.pop(event.node, None)
        if node is None:
            return
        try:
            self._put_end(event, owner)
        except BaseException:
            self._open_nodes[event.node] = node  # so that it ends LOST with the episode
            raise

    def _wait_for_ends(self) -> None:
        """Wait until other threads have written the ends of nodes that they are ending, for a limited time."""
        deadline = time.monotonic() + _LAST_ENDS_S
        while self._ending and time.monotonic() < deadline:
            time.sleep(0.001)

    def _put_end(self, event: NodeEnded, owner: str) -> None:
        if event.failure is not None or event.result is not None:
            for field, value in (("failure", event.failure and event.failure.arguments), ("result", event.result)):
                for each in missing_in(value):
                    self._emitter.missing.note(owner, field, each.missing)
        try:
            self._emitter.put(self.id, event)
        except NotEncodable as error:
            self._emitter.missing.note(owner, "failure" if event.failure is not None else "result", error.reason)
            self._emitter.put(self.id, fit_node_end(event, self._emitter.settings.record_bytes_max))
