"""An `Episode` records one open episode of our own plan layer: its nodes, its world and its percepts.

Theory of operation. Starts of nodes, observations and changes of the world reach an episode in the thread of the plan,
through `Recorder` and `WorldRecorder`. Ends of nodes do so too, except when a plan is dropped unfinished: then the
garbage collector closes its coroutines and thereby ends its nodes, in any thread and between any two of that thread's
bytecodes. The sampler's thread reads `id`, `world` and `continue_at`. How an episode is continued in a follow-up is
described in `recording.writing.episode_writer`; meanwhile the sampler takes only the first and the last sample of each
motion.

`NodeRecord.episode_id` is the id under which the node's sequence counts; a node whose `episode_id` is not the episode's
current id is never referred to in the follow-up.
"""

from __future__ import annotations

from collections.abc import Callable
from typing import Final, Literal, NamedTuple

from pycrorm_async.events.codec import NotEncodable
from pycrorm_async.events.ids import EpisodeId
from pycrorm_async.events.types import NodeEnded
from pycrorm_async.events.values import NodeReference, NodeStatus, ObjectReference, RobotValue
from pycrorm_async.hooks.episode_events import location_resolved, object_detected
from pycrorm_async.hooks.world_recorder import WorldRecorder
from pycrorm_async.plan.designator import Designator
from pycrorm_async.plan.execution.observer import Candidate, Cells, Refusal, Seen
from pycrorm_async.plan.execution.unawaited_performs import CalledPerforms
from pycrorm_async.plan.task_tree import TaskTreeNode
from pycrorm_async.recording.declarations.declared_type import DeclaredType
from pycrorm_async.recording.values.event_fitting import (
    episode_text_of,
    fit_resolution,
)
from pycrorm_async.recording.values.failure_values import failure_value
from pycrorm_async.recording.values.parameters import read_parameters
from pycrorm_async.recording.values.value_snapshot import encode_or_missing
from pycrorm_async.recording.writing.emitter import UNAWAITED_MAX, Emitter
from pycrorm_async.recording.writing.episode_opening import EpisodeOpening, current_task
from pycrorm_async.recording.writing.episode_writer import EpisodeWriter
from pycrorm_async.world.bullet import BulletWorld
from pycrorm_async.world.enums import ObjectType
from pycrorm_async.world.objects import Object
from pycrorm_async.world.observers import current_world


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


class Episode(EpisodeWriter[TaskTreeNode]):
    """An open or closed episode of our own plan layer.

    Attributes:
        task: the asyncio task that opened the episode; None outside any task.
        world: the recorder of its world; None without a world.
        faults: faults of the plan, each type once: performs that were never awaited.
        calls: performs called in the episode's context.
    """

    def __init__(
        self,
        emitter: Emitter,
        episode: EpisodeId,
        opening: EpisodeOpening,
        declared: Callable[[TaskTreeNode], DeclaredType],
    ) -> None:
        super().__init__(emitter, episode, opening)
        self.task = current_task()
        self.world: WorldRecorder | None = None
        self.faults: tuple[str, ...] = ()
        self.calls: Final = CalledPerforms(self._note_unawaited)
        self._declared = declared
        self._entered_world: str | None = None

    # --- world ------------------------------------------------------------------------------------------------

    def enter_world(self, world: BulletWorld, continue_: Callable[[], None]) -> None:
        """Record this world from now on. A second world at the same time is not recorded, but counted as missing.

        The world's recorder calls `continue_` when a change of the world has reached `continue_at`.
        """
        if self.world is None:
            self.world = WorldRecorder(self.emitter, self.id, world, continue_)
            self.world.continue_at = self.continue_at
        elif self.world.world is not world:
            self.emitter.missing.note("Episode", "second world", f"{self} records only the world entered first")

    @property
    def acts_in_recorded_world(self) -> bool:
        """True if the current world of this context is the recorded world, not a second one."""
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
        parent = self._sequence_of(node.parent) or self._root
        parameters = read_parameters(node.designator, declared, self, missing)
        return self._put_start(
            node, declared, node.kind, parent, parameters, self._robot_state(),
            missing=missing, continues=continues, may_refuse=continues is None,
        )  # fmt: skip

    def end_node(self, node: TaskTreeNode) -> None:
        """Write the end of a node."""
        record: NodeRecord = node.record
        try:
            self._ending.add(node)  # before the removal, so that no thread that misses the node ends the episode
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
        refused: tuple[Refusal, ...], offered_beyond: int, cells: Cells | None, node: TaskTreeNode | None,
    ) -> int:  # fmt: skip
        """Write the places that a location designator offered, took and refused; return the sequence."""
        number = self._sequence_of(node)
        resolved = location_resolved(
            location, offered, taken=taken, considered=considered, refused=refused, offered_beyond=offered_beyond,
            cells=cells, node=number,
        )  # fmt: skip
        try:
            return self.emitter.put(self.id, resolved)
        except NotEncodable as error:
            fitted = fit_resolution(resolved, self.emitter.settings.record_bytes_max)
            shortened = "offered" if len(fitted.offered) < len(resolved.offered) else "refused"
            self.emitter.missing.note(resolved.location, shortened, error.reason)
            return self.emitter.put(self.id, fitted)

    def record_detection(
        self, *, source: Literal["camera", "world_state"], object_type: ObjectType | None, seen: tuple[Seen, ...],
        node: TaskTreeNode | None,
    ) -> int:  # fmt: skip
        """Write the request to perception and its result; return the sequence."""
        return self._put_detection(object_detected(source, object_type, seen, self, node=self._sequence_of(node)))

    # --- the end and the follow-up ----------------------------------------------------------------------------

    def end_episode(self, failure: BaseException | None) -> None:
        """Write the end of the episode, after reporting performs that were never awaited."""
        if not self.closed:
            self.calls.close()
        super().end_episode(failure)

    def continue_as(self, follow_up: EpisodeId) -> dict[int, int]:
        """End the episode and continue it under the id `follow_up`; map the old sequences of open nodes to the new."""
        renumbered = super().continue_as(follow_up)
        if self.world is not None:
            self.world.continue_at = self.continue_at
        return renumbered

    def _has_ended(self, node: TaskTreeNode) -> bool:
        return node.ended_ns is not None

    def _restart_node(self, node: TaskTreeNode, sequence: int) -> int:
        new = self.start_node(node, self._declared(node), continues=sequence)
        node.record = node.record._replace(sequence=new, episode_id=self.id)
        return new

    def _restart_world(self) -> int:
        former = self.world
        if former is None:
            return 0
        former.stop()
        self.world = WorldRecorder(self.emitter, self.id, former.world, former.continue_)
        return self.world.last

    def _leave_world(self) -> None:
        if self.world is not None:
            self.leave_world(self.world.world, emptied=False)

    def _described_world(self) -> str | None:
        """Return the description of the world that was entered inside the episode; None if none was."""
        if self.world is not None and self._opening.world is None:
            self._entered_world = episode_text_of(self.world.world.description)
        return self._entered_world

    def _note_unawaited(self, designator: type[Designator]) -> None:
        self.emitter.note_unawaited(designator.dtype)
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

    def _robot_state(self) -> RobotValue | None:
        if self.world is None:
            return None
        current = current_world.get()
        if current is not self.world.world and current is not None:
            self.emitter.missing.note("Episode", "robot of a second world", "the episode records only the first world")
            return None
        try:
            return self.world.robot()
        except Exception as error:  # noqa: BLE001  the node is recorded without the robot's state
            self.emitter.note_fault("robot state", error)
            return None
