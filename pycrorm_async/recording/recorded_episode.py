"""A `RecordedEpisode` is one episode of an executive that is not ours: any thread writes its nodes, objects and values.

Theory of operation. The caller names nodes and objects by keys of its own. One lock per episode makes each call whole,
so the parent of a node is known when the node starts, whichever thread started it. The garbage collector may end a node
in a thread that holds the lock, so the lock is reentrant. Nothing raises into the caller: each method counts what goes
wrong, and what comes after the end of the episode, in `Memory.status`. `_nodes` holds the open nodes by key, `_ended`
the last ones that ended, because a child may start after the end of its parent.
"""

from __future__ import annotations

import threading
import time
from collections import OrderedDict
from collections.abc import Callable, Hashable, Mapping, Sequence
from types import TracebackType
from typing import Any, Literal, Self

from msgspec.structs import replace

from pycrorm_async.errors import CallerError
from pycrorm_async.events.ids import EpisodeId
from pycrorm_async.events.types import NodeEnded, NodeStarted, ObjectDetected
from pycrorm_async.events.values import (
    EpisodeStatus,
    FailureValue,
    NodeReference,
    NodeStatus,
    ObjectReference,
    PoseValue,
    RobotValue,
    SeenValue,
)
from pycrorm_async.recording.checked_arguments import (
    END_STATUSES,
    failure_of,
    joints_of,
    link_of,
    object_of,
    pose_of,
    struct_of,
)
from pycrorm_async.recording.counted_calls import counted
from pycrorm_async.recording.declarations.declared_type import DeclaredType
from pycrorm_async.recording.recorded_objects import RecordedObjects
from pycrorm_async.recording.recorded_values import Convert, RecordedValues
from pycrorm_async.recording.values.failure_values import failure_value
from pycrorm_async.recording.values.texts import clean_repr
from pycrorm_async.recording.writing.emitter import Emitter
from pycrorm_async.recording.writing.episode_opening import EpisodeOpening
from pycrorm_async.recording.writing.episode_writer import EpisodeWriter
from pycrorm_async.recording.writing.observing import put_observation
from pycrorm_async.recording.writing.open_episodes import OpenEpisodes
from pycrorm_async.world.pose import Pose

__all__ = ["RecordedEpisode"]

_ENDED_MAX = 1_000
"""Bounds the keys of ended nodes that a child can still name as its parent."""
_ROOM_POLL_S = 0.005


class _Node:
    """A node that an executive started: what its start held, and its sequence under the id of that episode."""

    __slots__ = ("declared", "episode_id", "key", "parameters", "parent", "robot", "sequence")

    def __init__(self, key: Hashable, declared: DeclaredType, parent: _Node | None, robot: RobotValue | None) -> None:
        self.key = key
        self.declared = declared
        self.parent = parent
        self.robot = robot
        self.parameters: dict[str, Any] = {}
        self.sequence = 0
        self.episode_id: EpisodeId | None = None


class RecordedEpisode(EpisodeWriter[_Node]):
    """An episode of any executive, from any thread; `Recording.episode` makes it.

    >>> with recording.episode(description="Tutorial") as episode:
    ...     episode.start("a", navigate, {"target_location": Pose([1, 0, 0])})
    ...     episode.end("a")

    Keys are any hashable values, `id(node)` for example; a key can be used again after its node has ended. Nothing
    raises: what cannot be recorded is counted in `Memory.status` and logged. `node` is always the key of the node that
    did it; None stands for the root of the episode.
    """

    def __init__(
        self,
        emitter: Emitter,
        episodes: OpenEpisodes,
        opening: EpisodeOpening,
        convert: Convert | None,
    ) -> None:
        super().__init__(emitter, episodes.new_id(), opening)
        self._episodes = episodes
        self.lock = threading.RLock()
        self._end_status: EpisodeStatus | None = None
        self._nodes: dict[Hashable, _Node] = {}
        self._ended: OrderedDict[Hashable, _Node] = OrderedDict()
        self._objects = RecordedObjects(emitter, self.id, self._continue)
        self._objects.continue_at = self.continue_at
        self._values = RecordedValues(convert, lambda: self._objects, self)

    def __enter__(self) -> Self:
        return self

    def __exit__(
        self, kind: type[BaseException] | None, error: BaseException | None, traceback: TracebackType | None
    ) -> None:
        self.close(error)

    def close(self, failure: BaseException | None = None, status: EpisodeStatus | None = None) -> None:
        """End the episode. Without a failure it SUCCEEDED; nodes that are still open end LOST, and are counted.

        `status` is for a failure whose class only the executive knows: FAILED, ERROR or INTERRUPTED.
        """
        if self.emitter.is_closed:
            return
        with self.lock:
            if self._nodes and failure is None and not self.closed:
                self._note("EpisodeEnded", f"{len(self._nodes)} nodes were open at the end of episode {self}")
            self._end_status = status
            self._episodes.close(self, failure)

    # --- nodes ------------------------------------------------------------------------------------------------

    @counted("NodeStarted")
    def start(
        self,
        key: Hashable,
        type: DeclaredType,  # noqa: A002  the field's word
        parameters: Mapping[str, Any] = {},
        *,
        parent: Hashable | None = None,
        robot: RobotValue | Hashable | None = None,
    ) -> Hashable:
        """Record that a node started; return it.

        As `parent` and `node` the returned value stands for the key, also long after the node has ended and its key
        names another one.

        Args:
            key: names the node from now on. If an open node has it, that one ends LOST, and is counted.
            type: from `Recording.type`.
            parameters: by field name, copied now.
            parent: key of the node it runs inside. One that never started is counted, and the root takes its place.
            robot: the state of the robot that acts, or the key of its object.
        """
        if key in self._nodes:
            self._note("NodeStarted", f"the key {clean_repr(key)} starts a second node before the first has ended")
            self._end(self._nodes[key], NodeEnded(self._nodes[key].sequence, "LOST"))
        state = struct_of(robot, RobotValue) if isinstance(robot, RobotValue) else self._objects.robot(robot)
        node = _Node(key, type, self._find(parent), state)
        missing: dict[str, str] = {}
        node.parameters = self._values.parameters(type, parameters, missing)
        self._write_start(node, missing, continues=None)
        self._nodes[key] = node
        self._ended.pop(key, None)
        if node.sequence >= self.continue_at:
            self._continue()
        return node

    def _write_start(self, node: _Node, missing: Mapping[str, str], continues: int | None) -> None:
        event = NodeStarted(
            kind=node.declared.declaration.kind,
            parent=self.node_or_root(node.parent),
            designator=node.declared.fingerprint or None,
            parameters=node.parameters,
            robot=node.robot,
            simulated=self.simulated,
            continues=continues,
        )
        node.sequence = self._put_start(node, event, node.declared.dtype, missing, may_refuse=False)
        node.episode_id = self.id

    @counted("NodeEnded")
    def end(
        self,
        key: Hashable,
        status: NodeStatus = "SUCCEEDED",
        failure: BaseException | FailureValue | str | None = None,
        result: Any = None,
    ) -> None:
        """Record that a node ended. A key that no open node has is counted, and so is an unknown status, as ERROR."""
        node = self._nodes.get(key)
        if node is None:
            raise CallerError(f"no open node has the key {clean_repr(key)}")
        if status not in END_STATUSES:
            self._note("NodeEnded", f"{clean_repr(status)} is not a status ({', '.join(sorted(END_STATUSES))})")
            status = "ERROR"
        value = failure_value(failure, self) if isinstance(failure, BaseException) else self._failure(failure)
        encoded = self._values.any(result) if result is not None else None
        self._end(node, NodeEnded(node.sequence, status, value, encoded))

    def _end(self, node: _Node, event: NodeEnded) -> None:
        self._close_node(event, node.declared.dtype)
        self._nodes.pop(node.key, None)
        node.parameters = {}
        node.parent = None
        self._ended[node.key] = node
        while len(self._ended) > _ENDED_MAX:
            self._ended.popitem(last=False)

    def is_open(self, key: Hashable) -> bool:
        """Whether a node with this key has started and not ended."""
        return key in self._nodes

    def node_reference(self, key: Hashable | None = None) -> NodeReference:
        """Return a reference to a node for `Recording.episode(thought_by=…)`; without a known key, to the root."""
        with self.lock:
            return NodeReference(str(self), self.node_or_root(self._find(key)))

    # --- objects ----------------------------------------------------------------------------------------------

    @counted("ObjectAdded")
    def object_added(
        self,
        key: Hashable,
        name: str,
        object_type: str,
        pose: Pose | PoseValue,
        joints: Mapping[str, float] = {},
        *,
        urdf: str | None = None,
        color: tuple[float, float, float, float] | None = None,
        model: str | None = None,
        serial: str | None = None,
        mass_kg: float | None = None,
        base_link: str | None = None,
        torso_joint: str | None = None,
        node: Hashable | None = None,
    ) -> None:
        """Record that an object entered the world; of a known key, that pose and joints are these now.

        Args:
            key: names the object from now on.
            object_type: `ROBOT`, `MILK`, …; a type of `world.ObjectType` where one fits.
            joints: positions by name, rad or m.
            urdf: the text of its description, which is recorded once.
            color, model, serial, mass_kg, base_link: see `events.types.ObjectAdded`.
            torso_joint: of a robot with a torso that is lifted, the joint that does it.
        """
        added = object_of(
            name, object_type, pose, joints, urdf=urdf, color=color, model=model, serial=serial, mass_kg=mass_kg,
            base_link=base_link, torso_joint=torso_joint,
        )  # fmt: skip
        self._objects.add(key, added, self._cause(node))

    @counted("ObjectMoved")
    def object_moved(self, key: Hashable, pose: Pose | PoseValue, *, node: Hashable | None = None) -> None:
        """Record the new pose of an object; nothing, if it is the same."""
        self._objects.move(self._known(key), pose_of(pose), self._cause(node))

    @counted("JointsMoved")
    def joints_moved(self, key: Hashable, joints: Mapping[str, float], *, node: Hashable | None = None) -> None:
        """Record new joint positions (rad or m); only those that changed."""
        self._objects.turn(self._known(key), joints_of(joints), self._cause(node))

    @counted("ObjectAttached")
    def object_attached(
        self, parent: Hashable, child: Hashable, link: str | None = None, *, node: Hashable | None = None
    ) -> None:
        """Record that `child` moves with `link` of `parent` from now on."""
        self._objects.attach(self._known(parent), self._known(child), link_of(link), self._cause(node))

    @counted("ObjectDetached")
    def object_detached(self, parent: Hashable, child: Hashable, *, node: Hashable | None = None) -> None:
        """Record that `child` no longer moves with `parent`."""
        self._objects.detach(self._known(parent), self._known(child), self._cause(node))

    @counted("ObjectRemoved")
    def object_removed(self, key: Hashable, *, node: Hashable | None = None) -> None:
        """Record that an object left the world."""
        self._objects.remove(self._known(key), self._cause(node))

    def reference(self, key: Hashable) -> ObjectReference | None:
        """Return the current row of an object, for values that name it; None if there is none of this key."""
        return self._objects.reference(key)

    # --- observations -----------------------------------------------------------------------------------------

    @counted("Observed")
    def observe(self, name: str, values: object, *, node: Hashable | None = None) -> None:
        """Record an observation, as `Memory.observe` does."""
        observer = self.node_or_root(self._find(node))
        sequence = put_observation(self.emitter, self, name, self._values.converted(values), observer)
        if sequence >= self.continue_at:
            self._continue()

    @counted("ObjectDetected")
    def detected(
        self,
        seen: Sequence[SeenValue],
        *,
        source: Literal["camera", "world_state"] = "camera",
        object_type: str | None = None,
        node: Hashable | None = None,
    ) -> None:
        """Record a result of perception; `object_type` is the type searched for."""
        found = self._find(node)
        number = self.node_or_root(found) if found is not None else None
        percepts = tuple(struct_of(each, SeenValue) for each in seen)
        event = struct_of(ObjectDetected(source, object_type, percepts, number), ObjectDetected)
        if self._put_detection(event) >= self.continue_at:
            self._continue()

    def wait_for_room(self, timeout_s: float | None = None) -> bool:
        """Block while the spool is full, before a node starts; return whether it has room now.

        A start that finds no room uses the reserve of the spool, and blocks when that is used up as well.
        """
        deadline = None if timeout_s is None else time.monotonic() + timeout_s
        while not self.emitter.is_closed and self.emitter.sink.full:
            if deadline is not None and time.monotonic() >= deadline:
                return False
            time.sleep(_ROOM_POLL_S)
        return not self.emitter.is_closed

    def node_or_root(self, node: Any) -> int:
        """Return the sequence of this node; of None, and of a node of an episode that this one continues, the root."""
        return node.sequence if isinstance(node, _Node) and node.episode_id == self.id else self._root

    def end_episode(self, failure: BaseException | None) -> None:
        """Write the end of the episode."""
        with self.lock:
            super().end_episode(failure)
            self._nodes.clear()
            self._ended.clear()

    def _end_statuses(self, failure: BaseException | None) -> tuple[EpisodeStatus, NodeStatus]:
        status = self._end_status
        if status is None:
            return super()._end_statuses(failure)
        return status, ("CANCELLED" if status == "INTERRUPTED" else status)

    def tag(self, added: Sequence[str], removed: Sequence[str]) -> None:
        """Write a change of the episode's tags. Raises `CallerError` for a removed tag that it does not have."""
        with self.lock:
            super().tag(added, removed)

    def _continue(self) -> None:
        self._episodes.continue_episode(self)

    def continue_as(self, follow_up: EpisodeId) -> dict[int, int]:
        """End the episode and continue it under the id `follow_up`; map the old sequences of open nodes to the new."""
        renumbered = super().continue_as(follow_up)
        self._objects.continue_at = self.continue_at
        return renumbered

    def _has_ended(self, node: _Node) -> bool:
        return self._nodes.get(node.key) is not node

    def _restart_node(self, node: _Node, sequence: int) -> int:
        node.parameters = self._objects.renewed(node.parameters)
        if node.robot is not None:
            node.robot = replace(node.robot, object=self._objects.renewed(node.robot.object))
        self._write_start(node, {}, continues=sequence)
        return node.sequence

    def _restart_world(self) -> int:
        self._objects = RecordedObjects(self.emitter, self.id, self._continue, self._objects)
        return self._objects.last

    def _leave_world(self) -> None:
        """Objects are reported by the executive, so nothing observes them."""

    def _described_world(self) -> str | None:
        return None

    def _failure(self, failure: object) -> FailureValue | None:
        try:
            return failure_of(failure) if failure is not None else None
        except CallerError as error:  # the node has ended nevertheless
            self.emitter.note_fault("NodeEnded", error)
            return None

    def _find(self, key: Hashable | None) -> _Node | None:
        if key is None or isinstance(key, _Node):
            return key
        node = self._nodes.get(key) or self._ended.get(key)
        if node is None:
            self._note("NodeStarted", f"no node has the key {clean_repr(key)}; the root of the episode takes its place")
        return node

    def _known(self, key: Hashable) -> Hashable:
        if self._objects.reference(key) is None:
            raise CallerError(f"no object has the key {clean_repr(key)}: add it with `object_added` first")
        return key

    def _cause(self, key: Hashable | None) -> Callable[[], int | None]:
        """Return a function for the sequence of the node that changes the world, under the episode's present id."""
        node = self._find(key)
        return lambda: node.sequence if node is not None and node.episode_id == self.id else None

    def _note(self, what: str, reason: str) -> None:
        self.emitter.note_fault(what, CallerError(reason))
