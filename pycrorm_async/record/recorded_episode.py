"""A `RecordedEpisode` is an episode of an executive that is not ours: any thread writes nodes, objects and values."""

from __future__ import annotations

import functools
import math
import threading
from collections import OrderedDict, deque
from collections.abc import Callable, Hashable, Mapping, Sequence
from enum import Enum
from os import PathLike
from types import TracebackType
from typing import Any, Concatenate, Literal, ParamSpec, Self, TypeAlias, TypeVar, cast, get_args

import msgspec
from msgspec.structs import replace

from pycrorm_async.errors import CallerError
from pycrorm_async.events import types as event_types
from pycrorm_async.events.fields import checked_tags
from pycrorm_async.events.reasons import UNNAMED, template_of
from pycrorm_async.events.types import ObjectDetected
from pycrorm_async.record.declarations import DeclaredType
from pycrorm_async.record.episode_writer import Emitter, EpisodeWriter, OpenEpisodes, is_of_memory, put_observation
from pycrorm_async.record.geometry import mass_of, urdf_of
from pycrorm_async.record.objects import RecordedObject, RecordedObjects
from pycrorm_async.record.opening import EpisodeOpening, Failures, end_statuses
from pycrorm_async.record.values import (
    MissingValues,
    PoseLike,
    RefusedValue,
    clean,
    clean_repr,
    encode_or_missing,
    failure_value,
    message_of,
    missing_value,
    pose_value,
    read_parameters,
    reading_fault,
    recorded_as,
)

# === ordered calls ============================================================================================
#
# `OrderedCalls` runs the calls of one memory one after the other, whichever threads make them.
#
# Theory of operation. A thread runs its call under the lock, so its call has run when it returns. The garbage
# collector, or a method of a key, may make a call in the middle of another one, in the thread that holds the lock: the
# lock is reentrant, `_is_running` shows this, and the call is left in `_left` for the outer one. A thread of the memory
# must not wait for the lock, because its holder may wait for the room in the spool that this thread makes: it takes the
# lock only if it is free, and otherwise leaves the call to the holder.
#
# A signal handler may raise KeyboardInterrupt in the main thread when any call returns. `with` on the lock itself
# cannot be interrupted between taking the lock and entering the block, nor before the lock is released; `acquire` and
# `release` in a `try` can. Only threads of the memory, which run no signal handlers, use these. A handler may also run
# where a loop begins its next round, and there Python 3.12 and 3.13 leave the block without releasing the lock, because
# they take the jump back for one that cannot raise. So no loop, and no comprehension, is directly in such a block.

P = ParamSpec("P")
R = TypeVar("R")


class OrderedCalls:
    """The calls of one memory."""

    def __init__(self) -> None:
        self._left: deque[Callable[[], object]] = deque()
        self._lock = threading.RLock()
        self._is_running = False

    def run(self, call: Callable[[], object]) -> None:
        """Run a call, which must not raise, after all earlier ones."""
        if is_of_memory():
            self._left.append(call)
            while self._left and self._lock.acquire(blocking=False):
                try:
                    if self._is_running:  # as below
                        return
                    self._run(_nothing)
                finally:
                    self._lock.release()
            return
        with self._lock:
            if self._is_running:  # in a call that this thread runs, which is followed by this one
                self._left.append(call)
                return
            self._run(call)
        while self._left:  # a thread of the memory came before the lock was released
            with self._lock:
                self._run(_nothing)

    def _run(self, call: Callable[[], object]) -> None:
        self._is_running = True  # followed by `try` without a call, so that Ctrl-C cannot separate the two
        try:
            self._run_left()
            call()
            self._run_left()
        finally:
            self._is_running = False

    def _run_left(self) -> None:
        while self._left:
            self._left.popleft()()


def _nothing() -> None:
    """Write nothing."""


def reported(
    event_type: str,
) -> Callable[
    [Callable[Concatenate[RecordedEpisode, P], Callable[[], object]]], Callable[Concatenate[RecordedEpisode, P], None]
]:
    """Make a method that copies its arguments, and returns the call that writes them, one that writes and never raises.

    Its exceptions are counted. If the memory is closed or belongs to a parent process, only the call is counted; the
    memory has ended what was open then, so an end is not missed.
    """

    def wrap(
        method: Callable[Concatenate[RecordedEpisode, P], Callable[[], object]],
    ) -> Callable[Concatenate[RecordedEpisode, P], None]:
        @functools.wraps(method)
        def run(self: RecordedEpisode, /, *args: P.args, **kwargs: P.kwargs) -> None:
            if self.is_recording(method.__name__, event_type):
                try:
                    self.write(event_type, method(self, *args, **kwargs))
                except Exception as error:  # noqa: BLE001  a fault of the memory must not reach a plan
                    self.emitter.note_fault(event_type, error)

        return run

    return wrap


def noted(emitter: Any, event_type: str, read: Callable[P, R], /, *args: P.args, **kwargs: P.kwargs) -> R | None:
    """Call `read` with these arguments and return its result; if it raises, count the exception and return None."""
    try:
        return read(*args, **kwargs)
    except Exception as error:  # noqa: BLE001  the code of an executive's values may raise anything
        emitter.note_fault(event_type, error)
        return None


# === recorded episode ========================================================================================
#
# Theory of operation. Each method first copies its arguments, which may run any code of the caller, and then has
# `OrderedCalls` write them; so no other call comes between the events of one, and a node's parent has started before
# it, whichever threads start them. No method raises into the caller: faults, and calls after the end of the episode,
# are counted in `Memory.status`. `_nodes` holds the open nodes by key, `_ended` the last ones that ended, because a
# child may start after the end of its parent.

FOREVER_S = 1e8
"""The seconds that a start waits for room: three years, because a wait takes a number."""
FailureCause: TypeAlias = BaseException | event_types.FailureValue | tuple[str, str] | str
"""A failure as an executive gives it: an exception, a pair of reason and message, or a text."""
Convert: TypeAlias = Callable[[Any], Any]
END_STATUSES = tuple(each for each in get_args(event_types.NodeStatus) if each != "RUNNING")
_ENDED_MAX = 1_000
"""Bounds the keys of ended nodes that a child can still name as its parent."""


class _Node:
    """A node that an executive started.

    `parent` is the parent, or, when this node has ended, the nearest node above it that was open then.
    """

    __slots__ = ("declared", "episode", "key", "parameters", "parent", "sequence")

    def __init__(self, key: Hashable, declared: DeclaredType, parameters: dict[str, Any]) -> None:
        self.key = key
        self.declared = declared
        self.parameters = parameters
        self.parent: _Node | None = None
        self.sequence = 0
        self.episode: RecordedEpisode | None = None


class RecordedEpisode(EpisodeWriter):
    """An episode of any executive, from any thread; `Recording.episode` makes it.

    >>> with recording.episode(description="Tutorial") as episode:
    ...     episode.start("a", navigate, {"target_location": Pose([1, 0, 0])})
    ...     episode.end("a")

    Keys are any hashable values, `id(node)` for example; a key can be used again after its node has ended. No method
    raises: values that cannot be recorded are counted in `Memory.status` and logged. `node` is always the key of the
    acting node; None means the root of the episode.
    """

    def __init__(
        self,
        emitter: Emitter,
        episodes: OpenEpisodes,
        calls: OrderedCalls,
        opening: EpisodeOpening,
        convert: Convert | None,
        failures: Failures = (),
    ) -> None:
        super().__init__(emitter, episodes.new_id(), opening)
        self._episodes = episodes
        self._failures = failures
        self._calls = calls
        self._end_status: event_types.EpisodeStatus | None = None
        self._nodes: dict[Hashable, _Node] = {}
        self._ended: OrderedDict[Hashable, _Node] = OrderedDict()
        self._objects = RecordedObjects(self)
        self._values = RecordedValues(convert, self._objects)
        self._arguments = ArgumentReader(emitter.missing)

    def __enter__(self) -> Self:
        return self

    def __exit__(
        self, kind: type[BaseException] | None, error: BaseException | None, traceback: TracebackType | None
    ) -> None:
        self.close(error)

    def close(self, failure: BaseException | None = None, status: event_types.EpisodeStatus | None = None) -> None:
        """End the episode. Without a failure it SUCCEEDED, and nodes that are still open are counted.

        They end LOST, or CANCELLED in an episode that was INTERRUPTED.
        `status` is FAILED, ERROR or INTERRUPTED, by default as for `end`.
        """
        if isinstance(status, str) and status in get_args(event_types.EpisodeStatus):
            self._end_status = status
        self._episodes.close(self, failure)

    def is_recording(self, method: str, event_type: str) -> bool:
        """Return whether the memory is open; otherwise count a call of this method, unless it ends something."""
        if not self.emitter.is_closed:
            return True
        if event_type not in ("NodeEnded", "EpisodeEnded", "EpisodeStarted"):
            self.emitter.note_unrecorded(f"a call of `{method}`")
        return False

    def write(self, event_type: str, write: Callable[[], object]) -> None:
        """Call `write` after all earlier calls, unless the episode has ended; count its exceptions."""

        def run() -> None:
            if self.closed:
                self._note(event_type, f"episode {self} has ended")
                return
            try:  # not `noted`, because this is called for each event
                write()
            except Exception as error:  # noqa: BLE001  a fault of the memory must not reach a plan
                self.emitter.note_fault(event_type, error)

        self._calls.run(run)

    # --- nodes ------------------------------------------------------------------------------------------------

    def start(
        self,
        key: Hashable,
        type: DeclaredType,  # noqa: A002  the field's word
        parameters: Mapping[str, Any] = {},
        *,
        parent: Hashable | None = None,
        robot: event_types.RobotValue | Hashable | None = None,
    ) -> Hashable:
        """Record that a node started; return it.

        Waits while the spool is full. With `on_full="fail"`, the node is counted as a fault then, and not recorded.

        The returned value can be passed as `parent` and `node` in place of the key, also long after the node has ended
        and its key names another one.

        Args:
            key: names the node from now on. If an open node has it, that one ends LOST, and is counted.
            type: from `Recording.type`.
            parameters: by field name, copied now.
            parent: key of the node it runs inside. One that never started is counted, and the root takes its place.
            robot: the state of the robot that acts, or the key of its object.
        """
        if not self.is_recording("start", "NodeStarted"):
            return None
        return noted(self.emitter, "NodeStarted", self._start, key, type, parameters, parent, robot)

    def _start(
        self, key: Hashable, declared: DeclaredType, given: Mapping[str, Any], parent: Hashable | None, robot: object
    ) -> _Node:
        hash(key)
        if self.emitter.must_wait() and not is_of_memory():
            self.emitter.sink.block_until_room(FOREVER_S, reserved=False)
        missing: dict[str, str] = {}
        parameters = noted(self.emitter, "NodeStarted", self._values.parameters, declared, given, self, missing) or {}
        node = _Node(key, declared, parameters)
        self.write("NodeStarted", lambda: self._start_node(node, parent, robot, missing))
        return node

    def _start_node(self, node: _Node, parent: Hashable | None, robot: object, missing: dict[str, str]) -> None:
        key = node.key
        if key in self._nodes:
            self._note("NodeStarted", f"the key {clean_repr(key)} starts a second node before the first has ended")
            self._end_node(self._nodes[key], "LOST")
        node.parent = self._find(parent, "NodeStarted")
        declared, acting = node.declared, noted(self.emitter, "NodeStarted", self._robot, robot)
        above = self.node_or_root(node.parent)
        node.sequence = self.put_start(declared, declared.declaration.kind, above, node.parameters, acting, missing)
        node.episode = self
        self._nodes[key] = node
        self._ended.pop(key, None)

    def _robot(self, robot: Any) -> event_types.RobotValue | None:
        if robot is None:
            return None
        if isinstance(robot, event_types.RobotValue):
            state = struct_of(robot, event_types.RobotValue)
            return state if self._objects.holds(state.object) else replace(state, object=None)
        if (acting := self._objects.robot(robot)) is None:
            raise CallerError(f"no object has the key {clean_repr(robot)}, so the robot's state is not recorded")
        return acting

    @reported("NodeEnded")
    def end(
        self,
        key: Hashable,
        status: event_types.NodeStatus | None = None,
        failure: FailureCause | None = None,
        result: Any = None,
        *,
        below: event_types.NodeStatus | None = None,
    ) -> Callable[[], object]:
        """Record that a node ended. A key that no open node has is counted, and so is an unknown status, as ERROR.

        >>> episode.end("drive", failure=("WheelSlipped", "the left wheel turned 3 rad without moving"))

        Args:
            status: by default SUCCEEDED without a failure, FAILED for a plan failure, a text or a pair of texts,
                CANCELLED for a cancellation, Ctrl-C or an exit, and ERROR for any other exception.
            failure: why it failed: an exception, whose class is the reason by which failures are counted; a pair of
                reason and message; or a text, whose reason is the text without its numbers, ids, names of objects and
                values of the node's own parameters.
            result: what it returned.
            below: first end the nodes that are open below this one, the innermost first, with this status.
        """
        key = key.key if isinstance(key, _Node) and self._nodes.get(key.key) is key else key
        hash(key)
        if status is None:
            raised = failure if isinstance(failure, BaseException) else None
            status = end_statuses(raised, self._failures)[1] if raised is failure else "FAILED"
        own, lower = self._checked_status(status), self._checked_status(below) if below is not None else None
        value = noted(self.emitter, "NodeEnded", self._values.failure, failure, self) if failure is not None else None
        encoded = encode_or_missing(self._values.converted(result), self) if result is not None else None
        return lambda: self._end_open(key, own, value, encoded, lower)

    def _checked_status(self, status: event_types.NodeStatus) -> event_types.NodeStatus:
        if status in END_STATUSES:
            return status
        self._note("NodeEnded", f"{clean_repr(status)} is not a status ({', '.join(END_STATUSES)})")
        return "ERROR"

    def _end_open(
        self,
        key: Hashable,
        status: event_types.NodeStatus,
        failure: event_types.FailureValue | None,
        result: Any,
        below: event_types.NodeStatus | None,
    ) -> None:
        node = self._nodes.get(key)
        if node is None:
            raise CallerError(f"no open node has the key {clean_repr(key)}")
        if below is not None:
            for each in [each for each in reversed(self._nodes.values()) if _is_below(each, node)]:
                self._end_node(each, below)
        if failure is not None and failure.type == UNNAMED:
            parameters = (each for each in node.parameters.values() if isinstance(each, str))
            template = template_of(failure.message, (*parameters, *self._objects.names()))
            failure = replace(failure, type=template or UNNAMED)
        self._end_node(node, status, failure, result)

    def _end_node(
        self,
        node: _Node,
        status: event_types.NodeStatus,
        failure: event_types.FailureValue | None = None,
        result: Any = None,
    ) -> None:
        self.put_end(node.sequence, status, failure, result)
        self._nodes.pop(node.key, None)
        node.parameters = {}
        while node.parent is not None and self._nodes.get(node.parent.key) is not node.parent:
            node.parent = node.parent.parent
        self._ended[node.key] = node
        while len(self._ended) > _ENDED_MAX:
            self._ended.popitem(last=False)

    def is_open(self, key: Hashable) -> bool:
        """Return whether a node with this key has started and not ended."""
        return bool(noted(self.emitter, "NodeStarted", lambda: key in self._nodes))

    def node_reference(self, key: Hashable | None = None) -> event_types.NodeReference:
        """Return a reference to a node for `Recording.episode(thought_by=…)`; without a known key, to the root."""
        return event_types.NodeReference(str(self), self.node_or_root(self._find(key, "EpisodeStarted")))

    def node_or_root(self, node: Any) -> int:
        """Return the sequence of this node or of its nearest ancestor in this episode; without a node, of the root."""
        while isinstance(node, _Node):
            if node.episode is self:
                return node.sequence
            node = node.parent
        return self._root

    # --- objects ----------------------------------------------------------------------------------------------

    @reported("ObjectAdded")
    def object_added(
        self,
        key: Hashable,
        name: str,
        object_type: str | Enum,
        pose: PoseLike | event_types.PoseValue,
        joints: Mapping[str, float] = {},
        *,
        urdf: str | PathLike[str] | None = None,
        color: tuple[float, float, float, float] | None = None,
        model: str | None = None,
        serial: str | None = None,
        mass_kg: float | None = None,
        base_link: str | None = None,
        torso_joint: str | None = None,
        node: Hashable | None = None,
    ) -> Callable[[], object]:
        """Record that an object entered the world; for a known key, record its new pose and joints.

        Args:
            key: names the object from now on.
            object_type: `ROBOT`, `MILK`, …; a type of `world.ObjectType` where one fits.
            joints: positions by name, rad or m.
            urdf: its description, which is recorded once: the text, or the path of a .urdf file. The names of its mesh
                files start at the folder of that file, or for a text at the current folder; the boxes around the
                meshes, for relations such as `on`, are computed from these files.
            color, model, serial, mass_kg, base_link: see `events.types.ObjectAdded`.
            torso_joint: of a robot with a torso that is lifted, the joint that does it.
        """
        added = self._arguments.object_of(
            name, object_type, pose, joints, urdf=urdf, color=color, model=model, serial=serial, mass_kg=mass_kg,
            base_link=base_link, torso_joint=torso_joint,
        )  # fmt: skip
        return lambda: self._objects.add(key, added, self._cause(node))

    @reported("ObjectMoved")
    def object_moved(
        self, key: Hashable, pose: PoseLike | event_types.PoseValue, *, node: Hashable | None = None
    ) -> Callable[[], object]:
        """Record the new pose of an object, unless it is the same."""
        if not self.closed and self._objects.is_at(key, pose):
            return lambda: None  # before the pose is copied, which takes longer
        copied = pose_of(pose)
        return lambda: self._objects.move(self._known(key), copied, self._cause(node))

    @reported("JointsMoved")
    def joints_moved(
        self, key: Hashable, joints: Mapping[str, float], *, node: Hashable | None = None
    ) -> Callable[[], object]:
        """Record new joint positions (rad or m); only those that changed."""
        copied = self._arguments.joints_of(joints)
        return lambda: self._objects.turn(self._known(key), copied, self._cause(node))

    @reported("ObjectAttached")
    def object_attached(
        self, parent: Hashable, child: Hashable, link: str | None = None, *, node: Hashable | None = None
    ) -> Callable[[], object]:
        """Record that `child` moves with `link` of `parent` from now on."""
        name = self._arguments.text_of("link", link)

        def write() -> int:
            return self._objects.attach(self._known(parent), self._known(child), name, self._cause(node))

        return write

    @reported("ObjectDetached")
    def object_detached(
        self, parent: Hashable, child: Hashable, *, node: Hashable | None = None
    ) -> Callable[[], object]:
        """Record that `child` no longer moves with `parent`."""

        def write() -> int:
            return self._objects.detach(self._known(parent), self._known(child), self._cause(node))

        return write

    @reported("ObjectRemoved")
    def object_removed(self, key: Hashable, *, node: Hashable | None = None) -> Callable[[], object]:
        """Record that an object left the world."""
        return lambda: self._objects.remove(self._known(key), self._cause(node))

    def reference(self, key: Hashable) -> event_types.ObjectReference | None:
        """Return the current row of an object, for values that name it; None if there is none of this key.

        Call it again for each value: the row changes when the object moves.
        """
        return noted(self.emitter, "ObjectAdded", self._objects.reference, key)

    # --- observations -----------------------------------------------------------------------------------------

    @reported("Observed")
    def observe(self, name: str, values: object, *, node: Hashable | None = None) -> Callable[[], object]:
        """Record an observation, as `Memory.observe` does."""
        copied = self._values.converted(values)

        def write() -> int:
            observer = self.node_or_root(self._find(node, "Observed"))
            return put_observation(self, name, copied, observer, may_refuse=False)

        return write

    @reported("ObjectDetected")
    def detected(
        self,
        seen: Sequence[event_types.SeenValue],
        *,
        source: Literal["camera", "world_state"] = "camera",
        object_type: str | None = None,
        node: Hashable | None = None,
    ) -> Callable[[], object]:
        """Record a result of perception; `object_type` is the type searched for."""
        copied = (noted(self.emitter, "ObjectDetected", struct_of, each, event_types.SeenValue) for each in seen)
        percepts = [each for each in copied if each is not None]
        event = struct_of(ObjectDetected(source, object_type), ObjectDetected)

        def write() -> int:
            acting = self._find(node, "ObjectDetected")
            number = self.node_or_root(acting) if acting is not None else None
            held = (each if self._objects.holds(each.object) else replace(each, object=None) for each in percepts)
            return self.put(replace(event, seen=tuple(held), node=number))

        return write

    @reported("EpisodeTagged")
    def tag(self, *tags: str, remove: Sequence[str] = ()) -> Callable[[], object]:
        """Add and remove tags."""
        added, removed = checked_tags(tags), checked_tags(remove)

        return lambda: EpisodeWriter.change_tags(self, added, removed)

    def wait_for_room(self, timeout_s: float | None = None) -> bool:
        """Block while the spool is full, for a limited time; return whether it has room now.

        `start` waits by itself, without a limit; so this is for an executive that has something else to do then.
        """
        sink, limit_s = self.emitter.sink, FOREVER_S if timeout_s is None else timeout_s
        has_room = not sink.full or noted(
            self.emitter, "EpisodeStarted", sink.block_until_room, limit_s, reserved=False
        )
        return bool(has_room) and not self.emitter.is_closed

    # --- the writer's part ------------------------------------------------------------------------------------

    def open(self) -> None:
        """Write the start of the episode; if that fails, count the fault, and record nothing."""
        self._calls.run(self._open_now)

    def _open_now(self) -> None:
        try:
            self._episodes.add(self)
            super().open()
        except Exception as error:  # noqa: BLE001  a fault of the memory must not reach a plan
            self.emitter.note_fault("EpisodeStarted", error)
            self._episodes.by_id.pop(self.id, None)
            self.closed = True

    def end_episode(self, failure: BaseException | None, world: str | None = None) -> None:
        """Write the end of the episode."""
        self._calls.run(lambda: noted(self.emitter, "EpisodeEnded", self._end_now, failure, world))

    def _end_now(self, failure: BaseException | None, world: str | None) -> None:
        if (left := len(self._nodes)) and failure is None and not self.closed:
            self._note("EpisodeEnded", f"nodes open at the end of episode {self}, which end LOST: {left}")
        super().end_episode(failure, world)
        self._nodes.clear()
        self._ended.clear()

    def change_tags(self, added: Sequence[str], removed: Sequence[str]) -> None:
        """Write a change of the episode's tags, for `Memory.tag`. Raises what `EpisodeWriter.change_tags` raises."""
        raised: list[BaseException] = []

        def change() -> None:
            try:
                EpisodeWriter.change_tags(self, added, removed)
            except Exception as error:  # noqa: BLE001  raised to the caller below
                raised.append(error)

        self._calls.run(change)
        for each in raised:
            raise each

    def _end_statuses(self, failure: BaseException | None) -> tuple[event_types.EpisodeStatus, event_types.NodeStatus]:
        status = self._end_status
        if status is None:
            return end_statuses(failure, self._failures)
        return status, ("CANCELLED" if status == "INTERRUPTED" else status)

    def _find(self, key: Hashable | None, event_type: str) -> _Node | None:
        """Return the node of a key, or of a value that `start` returned; count a key that no node has."""
        if key is None or isinstance(key, _Node):
            return key
        node = noted(self.emitter, event_type, lambda: self._nodes.get(key) or self._ended.get(key))
        if node is None:
            self._note(event_type, f"no node has the key {clean_repr(key)}; the root of the episode takes its place")
        return node

    def _known(self, key: Hashable) -> Hashable:
        if self._objects.reference(key) is None:
            raise CallerError(f"no object has the key {clean_repr(key)}: add it with `object_added` first")
        return key

    def _cause(self, key: Hashable | None) -> int | None:
        """Return the sequence of the node that changes the world; None for one of another episode."""
        node = self._find(key, "a change of the world")
        return node.sequence if node is not None and node.episode is self else None

    def _note(self, event_type: str, reason: str) -> None:
        self.emitter.note_fault(event_type, CallerError(reason))


def _is_below(node: _Node, ancestor: _Node) -> bool:
    above = node.parent
    while above is not None and above is not ancestor:
        above = above.parent
    return above is not None


# === checked arguments ========================================================================================
#
# Copy the arguments of an executive, because a value of a wrong type in the log would stop the fold of its episode.
#
# A wrong value raises `CallerError` if it is required (a pose); an optional one (a colour, one joint) is counted as
# missing.

_INTEGERS = range(-(2**63), 2**63)
_UNIT_TOLERANCE = 1e-6
"""A quaternion whose length differs from 1 by less keeps its bits: it is that of an executive in single precision."""

S = TypeVar("S", bound=msgspec.Struct)


def struct_of(value: object, kind: type[S]) -> S:
    """Return a value of this class whose parts, or numbers of numpy, have the declared types. Raises `CallerError`."""
    if not isinstance(value, kind):
        raise CallerError(f"expected a {kind.__name__}, got {clean_repr(value)}")
    try:
        parts = msgspec.to_builtins(value, enc_hook=lambda number: number.tolist())
        return _with_unit_turn(msgspec.convert(parts, kind))
    except Exception as error:
        raise CallerError(f"not a whole {kind.__name__}: {message_of(error)}") from error


def _with_unit_turn(value: S) -> S:
    """Return a pose, or a value with a pose, with a quaternion of length 1, from which a rotation is computed."""
    if isinstance(value, event_types.PoseValue):
        length = math.hypot(*value.orientation)
        if 0 < length < math.inf and abs(length - 1) > _UNIT_TOLERANCE:
            return replace(value, orientation=tuple(each / length for each in value.orientation))
    elif isinstance(pose := getattr(value, "pose", None), event_types.PoseValue):
        return replace(value, pose=_with_unit_turn(pose))
    return value


def pose_of(pose: PoseLike | event_types.PoseValue) -> event_types.PoseValue:
    """Copy a pose. Raises `CallerError`, also for a number that is not finite."""
    value = (
        struct_of(pose, event_types.PoseValue)
        if recorded_as(type(pose)) is None
        else pose_value(cast("PoseLike", pose))
    )
    if not math.isfinite(sum(value.position) + sum(value.orientation)):
        raise CallerError(f"the pose holds a number that is not finite: {clean_repr(pose)}")
    if value.time_ns not in _INTEGERS:
        raise CallerError(f"the time of the pose does not fit into 64 bits: {clean_repr(pose)}")
    return value


def _are_plain(joints: dict[Any, Any]) -> bool:
    """Return whether all names are ASCII texts and all positions finite floats, so that none of them must change."""
    if set(map(type, joints)) != {str} or set(map(type, joints.values())) != {float}:
        return False
    names = "".join(joints)
    return names.isascii() and "\0" not in names and all(map(math.isfinite, joints.values()))


class ArgumentReader:
    """Copies the arguments that describe an object; counts the ones that it has to leave out in `missing`."""

    def __init__(self, missing: MissingValues) -> None:
        self._missing = missing

    def object_of(
        self,
        name: str,
        object_type: str | Enum,
        pose: PoseLike | event_types.PoseValue,
        joints: Mapping[str, float],
        **others: Any,
    ) -> RecordedObject:
        """Copy the description of an object; `others` are the further attributes of `RecordedObject`."""
        urdf, kind = urdf_of(name, others["urdf"], self._missing), self.text_of("object_type", object_type) or "UNKNOWN"
        mass_kg = self._number_of("mass_kg", others["mass_kg"])
        if mass_kg is None:
            mass_kg = mass_of(urdf, kind)
        texts = {each: self.text_of(each, others[each]) for each in ("model", "serial", "base_link", "torso_joint")}
        return RecordedObject(
            self.text_of("name", name) or "an object",
            kind,
            pose_of(pose),
            self.joints_of(joints),
            urdf=urdf,
            color=self._color_of(others["color"]),
            mass_kg=mass_kg,
            **texts,
        )

    def text_of(self, argument: str, text: object) -> str | None:
        """Copy a text; of an enum its member's name, of another value its shortened repr."""
        if text is None:
            return None
        if isinstance(text, Enum):
            return clean(str(text.name))
        if isinstance(text, str):
            return clean(str.__str__(text))
        self._missing.note("ObjectAdded", argument, f"it must be a text, not {clean_repr(text)}")
        return clean_repr(text)

    def joints_of(self, joints: Mapping[str, float]) -> dict[str, float]:
        """Copy joint positions; those that are not finite numbers are counted as missing."""
        if not isinstance(joints, Mapping):
            self._missing.note("JointsMoved", "joints", f"they must be positions by name, not {clean_repr(joints)}")
            return {}
        copied = dict(joints)
        if _are_plain(copied):  # as nearly all are; the checks below take twenty times as long
            return copied
        positions: dict[str, float] = {}
        for name, position in copied.items():
            text = self.text_of("joint", name)
            number = self._number_of("joints", position)
            if text is not None and number is not None:
                positions[text] = number
        return positions

    def _number_of(self, argument: str, number: Any) -> float | None:
        if number is None:
            return None
        try:
            if isinstance(number, str | bytes | bool) or not math.isfinite(number):
                raise ValueError("it must be a finite number")  # noqa: TRY301  counted below
            return float(number)
        except Exception as error:  # noqa: BLE001  a __float__ of the user's may raise anything
            self._missing.note("ObjectAdded", argument, f"{clean_repr(number)}: {message_of(error)}")
            return None

    def _color_of(self, color: Any) -> tuple[float, float, float, float] | None:
        if color is None:
            return None
        parts = [self._number_of("color", each) for each in color] if isinstance(color, list | tuple) else []
        red, green, blue, opacity, *_ = (*parts, None, None, None, None)
        if len(parts) != 4 or red is None or green is None or blue is None or opacity is None:
            self._missing.note("ObjectAdded", "color", f"it must be red, green, blue and opacity: {clean_repr(color)}")
            return None
        return red, green, blue, opacity


# === recorded values ==========================================================================================
#
# Copy the values of an executive, through its own conversion, into values of events.


class RecordedValues:
    """Converts values for one episode. `convert` is the executive's; it is called with each value and each item."""

    def __init__(self, convert: Convert | None, objects: RecordedObjects) -> None:
        self._convert = convert
        self._objects = objects

    def parameters(
        self, declared: DeclaredType, given: Mapping[Any, Any], episode: RecordedEpisode, missing: dict[str, str]
    ) -> dict[str, Any]:
        """Return the parameters by field name; add to `missing` the reason for each that becomes a `MissingValue`."""
        source: dict[Any, Any] = {}
        left = dict(given)
        for field in declared.fields:
            key = field.path[0]
            value = left.pop(key, None)
            if value is not None:
                source[key] = self.converted(value, as_object=field.is_object)
        parameters = read_parameters(source, declared.fields, episode, missing)
        for name, value in left.items():
            if value is not None:
                text = clean(name) if isinstance(name, str) else clean_repr(name)
                missing[text] = reason = f"{declared.dtype} was declared without this field"
                parameters[text] = missing_value(reason, value)
        return parameters

    def converted(self, value: Any, *, as_object: bool = False) -> Any:
        """Return the value as the executive converts it; a `RefusedValue` with the reason if it cannot convert it.

        With `as_object` the key of an object becomes a reference to its row.
        """
        value = self._item(value, as_object)
        kind = type(value)
        if kind is list or kind is tuple:
            return [self._item(each, as_object) for each in value]
        if kind is dict:
            return {key: self._item(each, as_object) for key, each in value.items()}
        return value

    def _item(self, value: Any, as_object: bool) -> Any:  # noqa: FBT001  a keyword would cost each item of a list
        """Convert a value, but not the items inside it."""
        if as_object and (reference := self._known_object(value)) is not None:
            return reference
        if self._convert is not None:
            try:
                value = self._convert(value)
            except Exception as error:  # noqa: BLE001  an executive's conversion may raise anything
                return RefusedValue(message_of(error) if isinstance(error, ValueError) else reading_fault(error), value)
            if as_object and (reference := self._known_object(value)) is not None:
                return reference
        return self._checked(value) if isinstance(value, msgspec.Struct) else value

    def failure(self, failure: object, episode: RecordedEpisode) -> event_types.FailureValue:
        """Copy a `FailureCause`; a text is of the type `UNNAMED`. Raises `CallerError` for anything else."""
        match failure:
            case BaseException():
                return failure_value(failure, episode, self.converted)
            case (str(), str()) | str():
                reason, message = (UNNAMED, failure) if isinstance(failure, str) else failure
                return event_types.FailureValue(clean(reason), clean(message))
        return struct_of(failure, event_types.FailureValue)

    def _checked(self, value: msgspec.Struct) -> Any:
        """Return a value of an event if it is whole, and its rows are those of this episode."""
        try:
            if isinstance(value, event_types.PoseValue):
                return pose_of(value)
            whole = struct_of(value, type(value))
        except CallerError as error:
            return RefusedValue(message_of(error), value)
        reference = whole.part_of if isinstance(whole, event_types.ObjectValue) else whole
        if isinstance(reference, event_types.ObjectReference) and not self._objects.holds(reference):
            return RefusedValue("it refers to a row that this episode does not have", value)
        if isinstance(whole, event_types.ObjectValue) and whole.pose is not None:
            return self._checked(whole.pose) if isinstance(self._checked(whole.pose), RefusedValue) else whole
        return whole

    def _known_object(self, value: Any) -> event_types.ObjectReference | None:
        try:
            return self._objects.reference(value)
        except Exception:  # noqa: BLE001  it is not hashable, so it is no key
            return None
