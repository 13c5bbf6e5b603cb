"""One open episode: numbers its nodes, watches its world, and writes down how it ended.

Theory of operation of follow-up episodes. A sequence has 26 bits. An episode that comes near its last one
(`continue_at`) is ended, and the same `Episode` object goes on under a new id, so that contexts and nodes that hold it
need not know. Everything open is cut at that moment: each open node ends INTERRUPTED with the reason EpisodeContinued,
innermost first, then the root and the episode itself; the follow-up begins with EpisodeStarted, which names the former
episode, a root, the world as it is then, and each of those nodes started again, outermost first. A node started again
names the sequence it continues, and takes its parameters and the robot's state as they are then. So each perform has
exactly one row whose status says how it ended, and the time of a node is the sum of its parts.

A start, an observation or a change of the world that reaches `continue_at` does this in the plan's thread, when it is
recorded itself. An end never does, because the collector ends the nodes of a dropped plan in the middle of whatever a
thread is doing. What comes before the next start finds room in the reserve below the last sequence; of the samples of
the robot's state only the first and the last of a motion are taken then.
"""

from __future__ import annotations

import asyncio
import getpass
import platform
from collections.abc import Callable, Mapping
from typing import Any, Final, Literal, NamedTuple

from pycrorm_async.errors import Unrecordable
from pycrorm_async.events.codec import NotEncodable
from pycrorm_async.events.ids import EpisodeId, episode_text
from pycrorm_async.events.types import (
    CandidateValue,
    EpisodeEnded,
    EpisodeStarted,
    EpisodeStatus,
    FailureValue,
    LocationResolved,
    NodeEnded,
    NodeReference,
    NodeStarted,
    NodeStatus,
    ObjectDetected,
    ObjectReference,
    RobotValue,
    SeenValue,
)
from pycrorm_async.hooks.declaration import DeclaredType
from pycrorm_async.hooks.emitter import UNAWAITED_MAX, Emitter
from pycrorm_async.hooks.values.event_fitting import (
    fit_detection,
    fit_episode_end,
    fit_episode_start,
    fit_node_end,
    fit_resolution,
)
from pycrorm_async.hooks.values.parameters import ROBOT, fit_node_start, read_parameters
from pycrorm_async.hooks.values.texts import clean
from pycrorm_async.hooks.values.value_snapshot import encode_or_missing, failure_value, missing_in, pose_value
from pycrorm_async.hooks.world_recorder import WorldRecorder
from pycrorm_async.plan.designator import Designator
from pycrorm_async.plan.execution.observer import Candidate, Seen
from pycrorm_async.plan.execution.unawaited_performs import CalledPerforms
from pycrorm_async.plan.failures import is_plan_failure
from pycrorm_async.plan.task_tree import TaskTreeNode
from pycrorm_async.world.bullet import BulletWorld
from pycrorm_async.world.enums import ObjectType
from pycrorm_async.world.objects import Object
from pycrorm_async.world.observers import current_world

__all__ = ["Episode", "NodeRecord", "EpisodeOpening", "CONTINUED", "current_task"]

CONTINUED: Final = "EpisodeContinued"
"""The reason of nodes and episodes that ended because the episode goes on in a follow-up episode."""

_RESERVE_EVENTS_MAX = 2**20
"""Sequences kept back for the ends of open nodes: more nodes than a process has memory for."""


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
    part: EpisodeId
    """The id of the episode when the node started: its sequence counts in that one."""


class Episode:
    """An episode that is open, or was.

    Attributes:
        id: 16 bytes of a UUIDv7; `str(episode)` is its text. That of the latest follow-up, if it was continued.
        continue_at: the sequence from which on it is to be continued in a follow-up.
        task: the asyncio task that opened it; None outside any.
        simulated: it is thought through in a copy of the world, and nothing of it happens.
        world: who watches its world; None without one.
        faults: mistakes of the plan that were noticed in it, each once: performs that were never awaited.
        calls: performs that were called in its context.
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
        self._open_nodes: dict[int, TaskTreeNode] = {}
        events_max = emitter.settings.episode_events_max
        self._continue_at: Final = events_max - min(events_max // 8, _RESERVE_EVENTS_MAX)
        self.continue_at = self._continue_at
        self._root = self._start(None, None)

    def _start(self, continues: EpisodeId | None, root: int | None) -> int:
        """Write down that the episode starts; the sequence of its root."""
        opening = self._opening
        started = EpisodeStarted(
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
        )
        started, shortened = fit_episode_start(started, self._emitter.settings.record_bytes_max)
        for name in shortened:
            self._emitter.missing.note("Episode", name, "its text is longer than an episode's may be, and was cut")
        self._emitter.put(self.id, started)
        return self._emitter.put(self.id, NodeStarted("root", simulated=opening.simulated, continues=root))

    def __str__(self) -> str:
        return episode_text(self.id)

    def __repr__(self) -> str:
        return f"<Episode {self}{' closed' if self.closed else ''}>"

    # --- world ------------------------------------------------------------------------------------------------

    def enter_world(self, world: BulletWorld, continue_: Callable[[], None]) -> None:
        """This world belongs to the episode from now on. A second one at the same time is not recorded, and counted.

        `continue_` is called when a change of the world has reached `continue_at`.
        """
        if self.world is None:
            self.world = WorldRecorder(self._emitter, self.id, world, continue_)
            self.world.continue_at = self.continue_at
        elif self.world.world is not world:
            self._emitter.missing.note("Episode", "second world", f"{self} records the world that was entered first")

    @property
    def in_its_world(self) -> bool:
        """Whether the plan acts in the recorded world now, and not in a second one."""
        if self.world is None:
            return False
        current = current_world.get()
        return current is None or current is self.world.world

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

    def start_node(self, node: TaskTreeNode, declared: DeclaredType, continues: int | None = None) -> int:
        """Write down that the node starts; its sequence. Raises `Unrecordable` for a parameter, if so chosen."""
        assert node.designator is not None
        missing: dict[str, str] = {}
        event = NodeStarted(
            kind=node.kind,
            parent=self._parent_of(node.parent),
            designator=declared.fingerprint or None,
            parameters=read_parameters(node.designator, declared, self, missing),
            robot=self._robot(),
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
        """Write down how the node ended."""
        record: NodeRecord = node.record
        if self._open_nodes.get(record.sequence) is not node:
            return
        failure = failure_value(node.failure, self) if node.failure is not None else None
        result = encode_or_missing(node.result, self) if node.result is not None else None
        status: NodeStatus = node.status.value
        assert node.designator is not None
        self._put_end(NodeEnded(record.sequence, status, failure, result), node.designator.dtype)
        # Only now: an end that was not written is LOST when the episode ends.
        self._open_nodes.pop(record.sequence, None)

    def locate(
        self, *, location: str, offered: tuple[Candidate, ...], taken: int | None, considered: int,
        node: TaskTreeNode | None,
    ) -> int:  # fmt: skip
        """Write down what a location designator offered and which was taken; the sequence of that."""
        resolved = LocationResolved(
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
        )
        try:
            return self._emitter.put(self.id, resolved)
        except NotEncodable as error:
            self._emitter.missing.note(resolved.location, "offered", error.reason)
            return self._emitter.put(self.id, fit_resolution(resolved, self._emitter.settings.record_bytes_max))

    def detect(
        self, *, source: Literal["camera", "world_state"], object_type: ObjectType | None, seen: tuple[Seen, ...],
        node: TaskTreeNode | None,
    ) -> int:  # fmt: skip
        """Write down what perception was asked and what it found; the sequence of that."""
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
        detected = ObjectDetected(source, looked_for, found, self._sequence_of(node))
        try:
            return self._emitter.put(self.id, detected)
        except NotEncodable as error:
            self._emitter.missing.note("ObjectDetected", "seen", error.reason)
            return self._emitter.put(self.id, fit_detection(detected, self._emitter.settings.record_bytes_max))

    def end(self, failure: BaseException | None) -> None:
        """The last event. Nodes that outlive the episode are out of its sight: LOST."""
        if self.closed:
            return
        self.calls.close()
        self.closed = True
        if self.world is not None:
            self.leave_world(self.world.world, emptied=False)
        for sequence in sorted(self._open_nodes, reverse=True):
            self._put_end(NodeEnded(sequence, "LOST"), "Episode")
        self._open_nodes.clear()
        status, root_status = _outcome(failure)
        value = failure_value(failure, self) if failure is not None else None
        self._put_end(NodeEnded(self._root, root_status, value), "Episode")
        ended = EpisodeEnded(status, value)
        try:
            self._emitter.put(self.id, ended)
        except NotEncodable:
            self._emitter.put(self.id, fit_episode_end(ended, self._emitter.settings.record_bytes_max))

    def continue_as(self, follow_up: EpisodeId, declared: Callable[[TaskTreeNode], DeclaredType]) -> dict[int, int]:
        """End the episode and go on under this id; the new sequences of the nodes that are open, by their old ones."""
        former, open_nodes, root, world = self.id, sorted(self._open_nodes.items()), self._root, self.world
        if world is not None:
            world.stop()
        why = FailureValue(CONTINUED, f"the episode goes on in episode {episode_text(follow_up)}")
        for sequence, node in reversed(open_nodes):
            if self._open_nodes.pop(sequence, None) is node:  # the collector may have ended it just now, in this thread
                cut = NodeEnded(sequence, "INTERRUPTED", why)
                self._put_end(cut if node.ended_ns is None else NodeEnded(sequence, "LOST"), "Episode")
        self._put_end(NodeEnded(root, "INTERRUPTED", why), "Episode")
        self._emitter.put(former, EpisodeEnded("INTERRUPTED", why, episode_text(follow_up)))
        self.id = follow_up
        last = self._root = self._start(former, root)
        if world is not None:
            self.world = WorldRecorder(self._emitter, follow_up, world.world, world.continue_)
            last = max(last, self.world.last)
        renumbered: dict[int, int] = {}
        for sequence, node in open_nodes:
            if node.ended_ns is not None:
                continue
            try:
                last = renumbered[sequence] = self.start_node(node, declared(node), continues=sequence)
            except Exception as error:  # noqa: BLE001  the other nodes go on all the same
                self._emitter.note_fault("NodeStarted", error)
                continue
            node.record = node.record._replace(sequence=last, part=follow_up)
        # A world or a tree so large that the follow-up begins near its end must not be continued for ever.
        self.continue_at = max(self._continue_at, 2 * last)
        if self.world is not None:
            self.world.continue_at = self.continue_at
        return renumbered

    def _note_unawaited(self, designator: type[Designator]) -> None:
        self._emitter.note_unawaited(designator.dtype)
        fault = f"{designator.dtype}.perform() was called and never awaited"
        if fault not in self.faults:
            self.faults = (*self.faults[1 - UNAWAITED_MAX :], fault)

    # --- inside -----------------------------------------------------------------------------------------------

    def _parent_of(self, above: TaskTreeNode | None) -> int:
        return self._sequence_of(above) or self._root

    def _sequence_of(self, node: TaskTreeNode | None) -> int | None:
        """The nearest recorded node of this episode, from this one upwards."""
        while node is not None:
            record: NodeRecord | None = node.record
            if record is not None and record.episode is self and record.part == self.id:
                return record.sequence
            node = node.parent
        return None

    def _note_parameters(self, declared: DeclaredType, missing: Mapping[str, str], *, may_refuse: bool) -> None:
        """Count what is missing of a start. Raises `Unrecordable` for a parameter, if so chosen."""
        parameters = [name for name in missing if name != ROBOT]
        if may_refuse and parameters and self._emitter.settings.on_unrecordable == "refuse":
            raise Unrecordable(declared.dtype, " and ".join(parameters), missing[parameters[0]])
        for name, reason in missing.items():
            self._emitter.missing.note(declared.dtype, name, reason)

    def _robot(self) -> RobotValue | None:
        if self.world is None:
            return None
        if not self.in_its_world:
            self._emitter.missing.note("Episode", "robot of a second world", "the episode records the first world")
            return None
        try:
            return self.world.robot()
        except Exception as error:  # noqa: BLE001  the action itself is recorded all the same
            self._emitter.note_fault("robot state", error)
            return None

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


def _outcome(failure: BaseException | None) -> tuple[EpisodeStatus, NodeStatus]:
    """How an exception that leaves the episode is written: its status, and that of the root node."""
    if failure is None:
        return "SUCCEEDED", "SUCCEEDED"
    if is_plan_failure(failure):
        return "FAILED", "FAILED"
    if isinstance(failure, asyncio.CancelledError | KeyboardInterrupt):
        return "INTERRUPTED", "CANCELLED"
    return "ERROR", "ERROR"


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
