"""One open episode: numbers its nodes, watches its world, and writes down how it ended."""

from __future__ import annotations

import asyncio
import getpass
import platform
from typing import Any, Final, Literal, NamedTuple

from msgspec.structs import replace

from pycrorm_async.errors import EpisodeRefused, Unrecordable
from pycrorm_async.events.codec import NotEncodable
from pycrorm_async.events.happenings import (
    CandidateValue,
    EpisodeEnded,
    EpisodeStarted,
    EpisodeStatus,
    FailureValue,
    LocationResolved,
    MissingValue,
    NodeEnded,
    NodeReference,
    NodeStarted,
    NodeStatus,
    ObjectDetected,
    ObjectReference,
    RobotValue,
    SeenValue,
)
from pycrorm_async.events.ids import EpisodeId, episode_text
from pycrorm_async.hooks.declaration import DeclaredType
from pycrorm_async.hooks.emitter import Emitter
from pycrorm_async.hooks.values import (
    Unwritable,
    clean,
    clean_repr,
    failure_value,
    pose_value,
    written,
    written_or_missing,
)
from pycrorm_async.hooks.world import WorldRecorder
from pycrorm_async.plan.failures import is_plan_failure
from pycrorm_async.plan.ports import Candidate, Seen
from pycrorm_async.plan.task_tree import TaskTreeNode
from pycrorm_async.world.bullet import BulletWorld
from pycrorm_async.world.enums import ObjectType
from pycrorm_async.world.objects import Object

__all__ = ["Episode", "NodeRecord", "EpisodeOpening", "current_task"]


class EpisodeOpening(NamedTuple):
    """What an episode begins with."""

    description: str
    software: str
    plan: str | None = None
    seed: int | None = None
    world: str | None = None
    simulated: bool = False
    thought_by: NodeReference | None = None


class NodeRecord(NamedTuple):
    """What the memory keeps at a running node."""

    episode: Episode
    sequence: int
    implicit: bool
    """Whether the episode was opened for this node and ends with it."""
    before: Episode | None
    """The current episode of the context when the node started."""


class Episode:
    """An episode that is open, or was.

    Attributes:
        id: 16 bytes of a UUIDv7; `str(episode)` is its text.
        task: the asyncio task that opened it; None outside any.
        simulated: it is thought through in a copy of the world, and nothing of it happens.
        world: who watches its world; None without one.
    """

    def __init__(self, emitter: Emitter, episode: EpisodeId, opening: EpisodeOpening) -> None:
        self.id: Final = episode
        self.task = current_task()
        self.closed = False
        self.simulated: Final = opening.simulated
        self.world: WorldRecorder | None = None
        self._emitter = emitter
        self._open_nodes: set[int] = set()
        emitter.put(
            episode,
            EpisodeStarted(
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
            ),
        )
        self._root = emitter.put(episode, NodeStarted("root", simulated=opening.simulated))

    def __str__(self) -> str:
        return episode_text(self.id)

    def __repr__(self) -> str:
        return f"<Episode {self}{' closed' if self.closed else ''}>"

    # --- world ------------------------------------------------------------------------------------------------

    def enter_world(self, world: BulletWorld) -> None:
        """This world belongs to the episode from now on. A second one at the same time is refused."""
        if self.world is not None:
            raise EpisodeRefused(
                "this episode has a world already: leave it first, or open an episode of its own for the second world"
                " in a task of its own"
            )
        self.world = WorldRecorder(self._emitter, self.id, world)

    def leave_world(self, world: BulletWorld, *, emptied: bool) -> None:
        """Look at it no longer; `emptied` if it is gone with all its objects, and not only the episode over."""
        if self.world is not None and self.world.world is world:
            if emptied:
                self.world.empty()
            self.world.stop()
            self.world = None

    def reference(self, world_object: Object) -> ObjectReference | None:
        """The row in force of this object in this episode."""
        return self.world.reference(world_object) if self.world is not None else None

    def naming(self, node: TaskTreeNode | None) -> NodeReference:
        """How other episodes name this node of it, or the nearest recorded one above; the root for None."""
        return NodeReference(str(self), self._parent_of(node))

    # --- nodes ------------------------------------------------------------------------------------------------

    def start_node(self, node: TaskTreeNode, declared: DeclaredType) -> int:
        """Write down that the node starts; its sequence. Raises `Unrecordable` for a parameter, if so chosen."""
        event = NodeStarted(
            kind=node.kind,
            parent=self._parent_of(node.parent),
            designator=declared.fingerprint,
            parameters=self._parameters(node, declared),
            robot=self._robot(),
            simulated=self.simulated,
        )
        try:
            sequence = self._emitter.put(self.id, event)
        except NotEncodable as error:
            sequence = self._start_incomplete(event, declared, error)
        self._open_nodes.add(sequence)
        return sequence

    def end_node(self, node: TaskTreeNode) -> None:
        """Write down how the node ended."""
        record: NodeRecord = node.record
        if record.sequence not in self._open_nodes:
            return
        failure = failure_value(node.failure, self) if node.failure is not None else None
        result = written_or_missing(node.result, self) if node.result is not None else None
        status: NodeStatus = node.status.value
        self._put_end(NodeEnded(record.sequence, status, failure, result))
        # Only now: an end that was not written is LOST when the episode ends.
        self._open_nodes.discard(record.sequence)

    def locate(
        self, *, location: str, offered: tuple[Candidate, ...], taken: int | None, considered: int,
        node: TaskTreeNode | None,
    ) -> None:  # fmt: skip
        """Write down what a location designator offered and which was taken."""
        self._emitter.put(
            self.id,
            LocationResolved(
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
                node=self._sequence_of(node),
            ),
        )

    def detect(
        self, *, source: Literal["camera", "world_state"], object_type: ObjectType | None, seen: tuple[Seen, ...],
        node: TaskTreeNode | None,
    ) -> None:  # fmt: skip
        """Write down what perception was asked and what it found."""
        found = tuple(
            SeenValue(
                clean(each.thing.name),
                each.thing.object_type.name,
                pose_value(each.thing.pose),
                self.reference(each.thing),
                each.visible,
            )
            for each in seen
        )
        looked_for = object_type.name if object_type is not None else None
        self._emitter.put(self.id, ObjectDetected(source, looked_for, found, self._sequence_of(node)))

    def end(self, failure: BaseException | None) -> None:
        """The last event. Nodes that outlive the episode are out of its sight: LOST."""
        if self.closed:
            return
        self.closed = True
        if self.world is not None:
            self.leave_world(self.world.world, emptied=False)
        for sequence in sorted(self._open_nodes, reverse=True):
            self._put_end(NodeEnded(sequence, "LOST"))
        self._open_nodes.clear()
        status, root_status = _outcome(failure)
        value = failure_value(failure, self) if failure is not None else None
        self._put_end(NodeEnded(self._root, root_status, value))
        try:
            self._emitter.put(self.id, EpisodeEnded(status, value))
        except NotEncodable:
            self._emitter.put(self.id, EpisodeEnded(status, _short(value)))

    # --- inside -----------------------------------------------------------------------------------------------

    def _parent_of(self, above: TaskTreeNode | None) -> int:
        return self._sequence_of(above) or self._root

    def _sequence_of(self, node: TaskTreeNode | None) -> int | None:
        """The nearest recorded node of this episode, from this one upwards."""
        while node is not None:
            record: NodeRecord | None = node.record
            if record is not None and record.episode is self:
                return record.sequence
            node = node.parent
        return None

    def _parameters(self, node: TaskTreeNode, declared: DeclaredType) -> dict[str, Any]:
        parameters: dict[str, Any] = {}
        for field, path, enum in declared.fields:
            value: Any = node.designator
            try:
                for name in path:
                    value = getattr(value, name, None)
                if value is not None:
                    parameters[field.name] = written(field, enum, value, self)
            except Unwritable as reason:
                parameters[field.name] = self._missing(declared, field.name, str(reason), value)
            except Exception as error:  # noqa: BLE001  a property or a __float__ of the user's may raise anything
                raised = f"reading it raised {type(error).__name__}: {clean(str(error))}"
                parameters[field.name] = self._missing(declared, field.name, raised, value)
        return parameters

    def _missing(self, declared: DeclaredType, name: str, reason: str, value: object) -> MissingValue:
        if self._emitter.settings.on_unrecordable == "refuse":
            raise Unrecordable(declared.declaration.dtype, name, reason)
        return MissingValue(reason, clean_repr(value))

    def _start_incomplete(self, event: NodeStarted, declared: DeclaredType, error: NotEncodable) -> int:
        """A start that is too large, or whose world value cannot be written: without that part, if so chosen."""
        part, _, rest = error.path.partition(".")
        if part == "robot":
            self._emitter.note_fault("robot state", error)
            event = replace(event, robot=None)
            return self._emitter.put(self.id, event)
        names = [rest.partition(".")[0]] if rest else list(event.parameters)
        if self._emitter.settings.on_unrecordable == "refuse":
            raise Unrecordable(declared.declaration.dtype, " and ".join(names) or "it", error.reason) from None
        kept = event.parameters | {name: MissingValue(error.reason) for name in names}
        return self._emitter.put(self.id, replace(event, parameters=kept))

    def _robot(self) -> RobotValue | None:
        if self.world is None:
            return None
        try:
            return self.world.robot()
        except Exception as error:  # noqa: BLE001  the action itself is recorded all the same
            self._emitter.note_fault("robot state", error)
            return None

    def _put_end(self, event: NodeEnded) -> None:
        try:
            self._emitter.put(self.id, event)
        except NotEncodable as error:
            shorter = NodeEnded(event.node, event.status, _short(event.failure), MissingValue(error.reason))
            self._emitter.put(self.id, shorter)


def _outcome(failure: BaseException | None) -> tuple[EpisodeStatus, NodeStatus]:
    """How an exception that leaves the episode is written: its status, and that of the root node."""
    if failure is None:
        return "SUCCEEDED", "SUCCEEDED"
    if is_plan_failure(failure):
        return "FAILED", "FAILED"
    if isinstance(failure, asyncio.CancelledError | KeyboardInterrupt):
        return "INTERRUPTED", "CANCELLED"
    return "ERROR", "ERROR"


def _short(failure: FailureValue | None) -> FailureValue | None:
    return FailureValue(failure.type, failure.message) if failure is not None else None


def _user() -> str:
    try:
        return getpass.getuser()
    except (OSError, KeyError):  # no entry for this uid, as in many containers
        return "unknown"


def current_task() -> asyncio.Task[Any] | None:
    """The running task; None outside any loop."""
    try:
        return asyncio.current_task()
    except RuntimeError:
        return None
