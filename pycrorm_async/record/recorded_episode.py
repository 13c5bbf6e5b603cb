"""A `RecordedEpisode` is an episode of an executive that is not ours: any thread writes nodes, objects and values."""

from __future__ import annotations

import functools
import threading
from collections import OrderedDict, deque
from collections.abc import Callable, Hashable, Mapping, Sequence
from enum import Enum
from os import PathLike
from types import TracebackType
from typing import TYPE_CHECKING, Any, Concatenate, Literal, ParamSpec, Self, TypeAlias, TypeVar, get_args

from msgspec.structs import replace

from pycrorm_async.errors import CallerError
from pycrorm_async.events import types as event_types
from pycrorm_async.events.fields import checked_tags
from pycrorm_async.events.ids import EpisodeId, is_named
from pycrorm_async.events.reasons import UNNAMED, template_of
from pycrorm_async.events.types import ObjectDetected
from pycrorm_async.record.arguments import ArgumentReader, Convert, RecordedValues, pose_of, struct_of
from pycrorm_async.record.declarations import DeclaredType
from pycrorm_async.record.episode_writer import (
    Emitter,
    EpisodeWriter,
    OpenEpisodes,
    is_of_memory,
    name_of,
    put_observation,
)
from pycrorm_async.record.event_times import At, EventTimes
from pycrorm_async.record.objects import RecordedObjects
from pycrorm_async.record.opening import EpisodeOpening, Failures, end_statuses
from pycrorm_async.record.recorded_before import RecordedBefore, StoredEpisode, StoredEpisodes
from pycrorm_async.record.values import PoseLike, clean_repr, encode_or_missing, message_of

if TYPE_CHECKING:
    from pycrorm_async.record.samples import SampleBlocks

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
    acting node; None means the root of the episode. `at` is always the time at which it happened (`event_times.At`);
    without it, it happens now, or, in an episode that began at a given time, with what happened before it.

    Attributes:
        is_recorded: whether the log has this episode with its end already; nothing is recorded then.
        refusal: why nothing, or nothing more, is recorded: the log cannot be read, or has other events of this name,
            or the episode is open; None without a reason.
    """

    def __init__(
        self,
        emitter: Emitter,
        episodes: OpenEpisodes,
        calls: OrderedCalls,
        opening: EpisodeOpening,
        convert: Convert | None,
        failures: Failures = (),
        *,
        id: EpisodeId | None = None,  # noqa: A002  the field's word
        at: At | None = None,
    ) -> None:
        super().__init__(emitter, episodes.new_id() if id is None else id, opening)
        self._times = EventTimes(episodes.clock, at)
        self.time = self._times.began
        self.is_recorded = False
        self._episodes = episodes
        self._failures = failures
        self._calls = calls
        self._end_status: event_types.EpisodeStatus | None = None
        self._end_at: At | None = None
        self._nodes: dict[Hashable, _Node] = {}
        self._ended: OrderedDict[Hashable, _Node] = OrderedDict()
        self._objects = RecordedObjects(self)
        self._values = RecordedValues(convert, self._objects)
        self._arguments = ArgumentReader(emitter)
        self._samples: SampleBlocks | None = None

    def __enter__(self) -> Self:
        return self

    def __exit__(
        self, kind: type[BaseException] | None, error: BaseException | None, traceback: TracebackType | None
    ) -> None:
        self.close(error)

    def close(
        self,
        failure: BaseException | None = None,
        status: event_types.EpisodeStatus | None = None,
        *,
        at: At | None = None,
    ) -> None:
        """End the episode. Without a failure it SUCCEEDED, and nodes that are still open are counted.

        They end LOST, CANCELLED in an episode that was INTERRUPTED, or UNKNOWN, without a time, in one whose status is
        UNKNOWN. An episode with a name of its own that is interrupted gets no end, so that it can be continued.

        `status` is FAILED, ERROR, INTERRUPTED or UNKNOWN, by default as for `end`.
        """
        self._end_at = at
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

    def write(self, event_type: str, write: Callable[[], object], at: At | None = None) -> None:
        """Call `write` after all earlier calls, unless the episode has ended; count its exceptions."""

        def run() -> None:
            if self.closed:
                if not self.is_recorded and self.refusal is None:
                    self._note(event_type, f"episode {self} has ended")
                return
            try:  # not `noted`, because this is called for each event
                self._set_time(event_type, at)
                write()
            except Exception as error:  # noqa: BLE001  a fault of the memory must not reach a plan
                self.emitter.note_fault(event_type, error)

        self._calls.run(run)

    def _set_time(self, event_type: str, at: At | None) -> None:
        """Set the time of the next event; a wrong one is counted, and the event happens as without it."""
        try:
            self.time, warning = self._times.next(at)
        except CallerError as error:
            self.emitter.note_fault(event_type, error)
            self.time, warning = self._times.next(None)
        if warning is not None:
            self._note(event_type, warning)

    # --- nodes ------------------------------------------------------------------------------------------------

    def start(
        self,
        key: Hashable,
        type: DeclaredType,  # noqa: A002  the field's word
        parameters: Mapping[str, Any] = {},
        *,
        parent: Hashable | None = None,
        robot: event_types.RobotValue | Hashable | None = None,
        at: At | None = None,
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
        return noted(self.emitter, "NodeStarted", self._start, key, type, parameters, parent, robot, at)

    def _start(
        self,
        key: Hashable,
        declared: DeclaredType,
        given: Mapping[str, Any],
        parent: Hashable | None,
        robot: object,
        at: At | None,
    ) -> _Node:
        hash(key)
        if self.emitter.must_wait() and not is_of_memory():
            self.emitter.sink.block_until_room(FOREVER_S, reserved=False)
        missing: dict[str, str] = {}
        parameters = noted(self.emitter, "NodeStarted", self._values.parameters, declared, given, self, missing) or {}
        node = _Node(key, declared, parameters)
        self.write("NodeStarted", lambda: self._start_node(node, parent, robot, missing), at)
        return node

    def _start_node(self, node: _Node, parent: Hashable | None, robot: object, missing: dict[str, str]) -> None:
        key = node.key
        if key in self._nodes:
            self._note("NodeStarted", f"the key {clean_repr(key)} starts a second node before the first has ended")
            self._end_node(self._nodes[key], "LOST")
        node.parent = self._find(parent, "NodeStarted")
        declared, state = node.declared, noted(self.emitter, "NodeStarted", self._robot, robot)
        acting = self._objects.acting(state) if state is not None else None
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
            if state.pose is not None:
                state = replace(state, pose=self._objects.frames.in_map(state.pose))
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
        at: At | None = None,
        untimed: bool = False,
    ) -> Callable[[], object]:
        """Record that a node ended. A key that no open node has is counted, and so is an unknown status, as ERROR.

        >>> episode.end("drive", failure=("WheelSlipped", "the left wheel turned 3 rad without moving"))

        Args:
            status: by default SUCCEEDED without a failure, FAILED for a plan failure, a text or a pair of texts,
                CANCELLED for a cancellation, Ctrl-C or an exit, and ERROR for any other exception. UNKNOWN is for an
                end of which the executive does not report how it ended.
            failure: why it failed: an exception, whose class is the reason by which failures are counted; a pair of
                reason and message; or a text, whose reason is the text without its numbers, ids, names of objects and
                values of the node's own parameters.
            result: what it returned.
            below: first end the nodes that are open below this one, the innermost first, with this status.
            untimed: the time of the end is not known, so that tables show none.
        """
        key = key.key if isinstance(key, _Node) and self._nodes.get(key.key) is key else key
        hash(key)
        if status is None:
            raised = failure if isinstance(failure, BaseException) else None
            status = end_statuses(raised, self._failures)[1] if raised is failure else "FAILED"
        own, lower = self._checked_status(status), self._checked_status(below) if below is not None else None
        value = noted(self.emitter, "NodeEnded", self._values.failure, failure, self) if failure is not None else None
        encoded = encode_or_missing(self._values.converted(result), self) if result is not None else None
        return self._timed("NodeEnded", at, lambda: self._end_open(key, own, value, encoded, lower, untimed=untimed))

    def _timed(self, event_type: str, at: At | None, write: Callable[[], object]) -> Callable[[], object]:
        """Return a call that writes events of a given time."""
        if at is None:
            return write

        def timed() -> object:
            self._set_time(event_type, at)
            return write()

        return timed

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
        *,
        untimed: bool,
    ) -> None:
        node = self._nodes.get(key)
        if node is None:
            raise CallerError(f"no open node has the key {clean_repr(key)}")
        if below is not None:
            for each in [each for each in reversed(self._nodes.values()) if _is_below(each, node)]:
                self._end_node(each, below, untimed=untimed)
        if failure is not None and failure.type == UNNAMED:
            parameters = (each for each in node.parameters.values() if isinstance(each, str))
            template = template_of(failure.message, (*parameters, *self._objects.names()))
            failure = replace(failure, type=template or UNNAMED)
        self._end_node(node, status, failure, result, untimed=untimed)

    def _end_node(
        self,
        node: _Node,
        status: event_types.NodeStatus,
        failure: event_types.FailureValue | None = None,
        result: Any = None,
        *,
        untimed: bool = False,
    ) -> None:
        self.put_end(node.sequence, status, failure, result, untimed=untimed)
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
        at: At | None = None,
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
        return self._timed("ObjectAdded", at, lambda: self._objects.add(key, added, self._cause(node)))

    @reported("ObjectMoved")
    def object_moved(
        self,
        key: Hashable,
        pose: PoseLike | event_types.PoseValue,
        *,
        node: Hashable | None = None,
        at: At | None = None,
    ) -> Callable[[], object]:
        """Record the new pose of an object, unless it is the same."""
        if not self.closed and self._objects.is_at(key, pose):
            return lambda: None  # before the pose is copied, which takes longer
        copied = pose_of(pose)
        return self._timed("ObjectMoved", at, lambda: self._objects.move(self._known(key), copied, self._cause(node)))

    @reported("a frame")
    def frame_moved(self, frame: str, pose: PoseLike | event_types.PoseValue) -> Callable[[], object]:
        """State where a frame is, in the frame of this pose. Records nothing itself.

        Poses of objects, percepts and robots in this frame are recorded in the map from now on, if that frame's place
        is known too. Those of objects are known by their names.
        """
        name, copied = str(frame), pose_of(pose)
        return lambda: self._objects.frames.place(name, copied)

    @reported("JointsMoved")
    def joints_moved(
        self, key: Hashable, joints: Mapping[str, float], *, node: Hashable | None = None, at: At | None = None
    ) -> Callable[[], object]:
        """Record new joint positions (rad or m); only those that changed."""
        copied = self._arguments.joints_of(joints)
        return self._timed("JointsMoved", at, lambda: self._objects.turn(self._known(key), copied, self._cause(node)))

    @reported("ObjectAttached")
    def object_attached(
        self,
        parent: Hashable,
        child: Hashable,
        link: str | None = None,
        *,
        node: Hashable | None = None,
        at: At | None = None,
    ) -> Callable[[], object]:
        """Record that `child` moves with `link` of `parent` from now on."""
        name = self._arguments.text_of("link", link)

        def write() -> int:
            return self._objects.attach(self._known(parent), self._known(child), name, self._cause(node))

        return self._timed("ObjectAttached", at, write)

    @reported("ObjectDetached")
    def object_detached(
        self, parent: Hashable, child: Hashable, *, node: Hashable | None = None, at: At | None = None
    ) -> Callable[[], object]:
        """Record that `child` no longer moves with `parent`."""

        def write() -> int:
            return self._objects.detach(self._known(parent), self._known(child), self._cause(node))

        return self._timed("ObjectDetached", at, write)

    @reported("ObjectRemoved")
    def object_removed(
        self, key: Hashable, *, node: Hashable | None = None, at: At | None = None
    ) -> Callable[[], object]:
        """Record that an object left the world."""
        return self._timed("ObjectRemoved", at, lambda: self._objects.remove(self._known(key), self._cause(node)))

    def reference(self, key: Hashable) -> event_types.ObjectReference | None:
        """Return the current row of an object, for values that name it; None if there is none of this key.

        Call it again for each value: the row changes when the object moves.
        """
        return noted(self.emitter, "ObjectAdded", self._objects.reference, key)

    # --- observations -----------------------------------------------------------------------------------------

    @reported("Observed")
    def observe(
        self, name: str, values: object, *, node: Hashable | None = None, at: At | None = None
    ) -> Callable[[], object]:
        """Record an observation, as `Memory.observe` does."""
        copied = self._values.converted(values)

        def write() -> int:
            observer = self.node_or_root(self._find(node, "Observed"))
            return put_observation(self, name, copied, observer, may_refuse=False)

        return self._timed("Observed", at, write)

    @reported("Observed")
    def sampled(
        self,
        key: Hashable,
        channels: Sequence[str],
        values: Any,
        at: int | Sequence[int] | None = None,
        *,
        node: Hashable | None = None,
    ) -> Callable[[], object]:
        """Record samples of a stream, such as joint states or the pose of a frame, in blocks (`record.samples`).

        >>> episode.sampled("joint_states", ["shoulder", "elbow"], [0.1, -0.4], at=stamp_ns)
        >>> episode.sampled("joint_states", ["shoulder", "elbow"], array_of_n_times_2, at=n_stamps)

        `Memory.samples` returns them as a frame. Up to five seconds of a stream are in memory only, until their block
        is written.

        Args:
            key: the name of the stream.
            channels: the names of the numbers.
            values: the numbers of one sample, or an array of a row for each sample; NaN where there is none.
            at: the wall time of the sample, or of each, UTC in ns.
        """
        name = name_of(key)
        stamps = self._now_ns() if at is None else at
        from pycrorm_async.record import samples  # here, because it loads numpy and few executives have streams

        names, numbers, times = samples.sampled_values(channels, values, stamps)

        def write() -> None:
            last = int(times[-1]) if len(times) else 0
            if self.time is not None and last > self.time[0]:  # streams overlap, so that others may be ahead
                self._set_time("Observed", last)
            if self._samples is None:
                self._samples = samples.SampleBlocks()
            for sampling, block in self._samples.add(name, names, numbers, times, node):
                self._put_block(name, sampling, block)

        return write

    def _put_block(self, name: str, node: Hashable | None, block: dict[str, Any]) -> None:
        put_observation(self, name, block, self.node_or_root(self._find(node, "Observed")), may_refuse=False)

    def _now_ns(self) -> int:
        return self._episodes.clock.wall_ns() if self.time is None else self.time[0]

    @reported("ObjectDetected")
    def detected(
        self,
        seen: Sequence[event_types.SeenValue],
        *,
        source: Literal["camera", "world_state"] = "camera",
        object_type: str | None = None,
        node: Hashable | None = None,
        at: At | None = None,
    ) -> Callable[[], object]:
        """Record a result of perception; `object_type` is the type searched for."""
        copied = (noted(self.emitter, "ObjectDetected", struct_of, each, event_types.SeenValue) for each in seen)
        percepts = [replace(each, pose=event_types.BriefPose.of(each.pose)) for each in copied if each is not None]
        event = struct_of(ObjectDetected(source, object_type), ObjectDetected)

        def write() -> int:
            acting = self._find(node, "ObjectDetected")
            number = self.node_or_root(acting) if acting is not None else None
            placed = (replace(each, pose=self._objects.frames.in_map(each.pose)) for each in percepts)
            held = (each if self._objects.holds(each.object) else replace(each, object=None) for each in placed)
            return self.put(replace(event, seen=tuple(held), node=number))

        return self._timed("ObjectDetected", at, write)

    @reported("EpisodeTagged")
    def tag(self, *tags: str, remove: Sequence[str] = (), at: At | None = None) -> Callable[[], object]:
        """Add and remove tags."""
        added, removed = checked_tags(tags), checked_tags(remove)

        return self._timed("EpisodeTagged", at, lambda: EpisodeWriter.change_tags(self, added, removed))

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

    def open(self, stored: StoredEpisodes | None = None) -> None:
        """Write the start of the episode; if that fails, count the fault, and record nothing.

        With `stored`, continue the episode behind the events that the log has of it; see `is_recorded`.
        """
        before = None
        if stored is not None and self.id not in self._episodes.by_id:
            try:
                before = stored.find(self.id)
            except Exception as error:  # noqa: BLE001  a fault of the memory must not reach a plan
                self.emitter.note_fault("EpisodeStarted", error)
                self.closed, self.refusal = True, message_of(error)
                return
        if before is not None and before.has_ended:
            self.closed = self.is_recorded = True
        else:
            self._calls.run(lambda: self._open_now(before))

    def _open_now(self, before: StoredEpisode | None) -> None:
        is_added = False
        try:
            self._episodes.add(self)
            is_added = True
            if before is not None:
                self._recorded = RecordedBefore(self.id, before)
            super().open()
        except Exception as error:  # noqa: BLE001  a fault of the memory must not reach a plan
            self.emitter.note_fault("EpisodeStarted", error)
            if is_added:
                self._episodes.by_id.pop(self.id, None)
            self.closed = True
            if is_named(self.id):  # of any other episode the calls that are lost are counted
                self.refusal = message_of(error)

    def end_episode(self, failure: BaseException | None, world: str | None = None) -> None:
        """Write the end of the episode; leave a named one that is interrupted without an end."""
        self._calls.run(lambda: noted(self.emitter, "EpisodeEnded", self._end_now, failure, world))

    def _end_now(self, failure: BaseException | None, world: str | None) -> None:
        is_interrupted = self._end_status is None and self._end_statuses(failure)[0] == "INTERRUPTED"
        if is_named(self.id) and not self.closed and is_interrupted:
            self.closed = self._is_ended = True
            return
        if not self.closed:
            self._set_time("EpisodeEnded", self._end_at)
            for name, node, block in self._samples.take_all() if self._samples is not None else ():
                self._put_block(name, node, block)
        if (left := len(self._nodes)) and failure is None and not self.closed and self._end_status != "UNKNOWN":
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
