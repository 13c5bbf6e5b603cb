"""A `RecordedEpisode` is an episode of an executive that is not ours: any thread writes nodes, objects and values."""

# ruff: noqa: ARG002  `reported` reads the argument `at` of each method

from __future__ import annotations

import functools
from collections.abc import Callable, Hashable, Mapping, Sequence
from enum import Enum
from os import PathLike
from types import TracebackType
from typing import Any, Concatenate, Literal, Self, TypeAlias, get_args

from msgspec.structs import replace

from pycrorm_async.errors import CallerError
from pycrorm_async.events import types as event_types
from pycrorm_async.events.fields import checked_tags
from pycrorm_async.events.ids import EpisodeId, is_named
from pycrorm_async.record.arguments import ArgumentReader, Convert, RecordedValues, pose_of, struct_of
from pycrorm_async.record.camera import CameraStream, put_image
from pycrorm_async.record.declarations import DeclaredType
from pycrorm_async.record.episode_writer import Emitter, EpisodeWriter, OpenEpisodes, is_of_memory, name_of
from pycrorm_async.record.event_times import At
from pycrorm_async.record.keyed_episode import KeyedEpisode, Node, OrderedCalls, P, noted
from pycrorm_async.record.opening import EpisodeOpening, Failures, end_statuses
from pycrorm_async.record.recorded_before import StoredEpisodes
from pycrorm_async.record.values import PoseLike, clean_repr, encode_or_missing


def reported(
    event_type: str, *, timed: bool = True
) -> Callable[
    [Callable[Concatenate[RecordedEpisode, P], Callable[[], object]]], Callable[Concatenate[RecordedEpisode, P], None]
]:
    """Make a method that copies its arguments, and returns the call that writes them, one that writes and never raises.

    With `timed`, the events happen at its argument `at`.

    Its exceptions are counted. If the memory is closed or belongs to a parent process, only the call is counted; the
    memory has ended what was open then, so an end is not missed.
    """

    def wrap(
        method: Callable[Concatenate[RecordedEpisode, P], Callable[[], object]],
    ) -> Callable[Concatenate[RecordedEpisode, P], None]:
        @functools.wraps(method)
        def run(self: RecordedEpisode, /, *args: P.args, **kwargs: P.kwargs) -> None:
            if self.is_recording(method.__name__, event_type):
                at: Any = kwargs.get("at") if timed else None
                try:
                    self._writer.write(event_type, method(self, *args, **kwargs), at)
                except Exception as error:  # noqa: BLE001  a fault of the memory must not reach a plan
                    self.emitter.note_fault(event_type, error)

        return run

    return wrap


# === recorded episode ========================================================================================
#
# Theory of operation. Each method first copies its arguments, which may run any code of the caller, and then has the
# `KeyedEpisode` write them in its `OrderedCalls`; so no other call comes between the events of one, and a node's parent
# has started before it, whichever threads start them. No method raises into the caller: faults, and calls after the end
# of the episode, are counted in `Memory.status`.

FOREVER_S = 1e8
"""The seconds that a start waits for room: three years, because a wait takes a number."""
FailureCause: TypeAlias = BaseException | event_types.FailureValue | tuple[str, str] | str
"""A failure as an executive gives it: an exception, a `FailureValue`, a pair of reason and message, or a text."""
END_STATUSES = tuple(each for each in get_args(event_types.NodeStatus) if each != "RUNNING")


class RecordedEpisode:
    """An episode of any executive, from any thread; `Recording.episode` makes it.

    >>> with recording.episode(description="Tutorial") as episode:
    ...     episode.start("a", navigate, {"target_location": Pose([1, 0, 0])})
    ...     episode.end("a")

    Keys are any hashable values, `id(node)` for example; a key can be used again after its node has ended. No method
    raises: values that cannot be recorded are counted in `Memory.status` and logged. `node` is always the key of the
    acting node; None means the root of the episode. `at` is always the time at which it happened (`event_times.At`);
    without it, it happens now, or, in an episode that began at a given time, with what happened before it.

    Attributes:
        emitter: has the queue, and counts faults.
        id: 16 bytes of a UUID; `str(episode)` is its text.
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
        self._writer = KeyedEpisode(emitter, episodes, calls, opening, failures, id, at)
        self.emitter = emitter
        self.id = self._writer.id
        self._episodes = episodes
        self._failures = failures
        self._values = RecordedValues(convert, self._writer.objects)
        self._arguments = ArgumentReader(emitter)

    @property
    def closed(self) -> bool:
        """Whether the last event has been written, or its writing has begun."""
        return self._writer.closed

    @property
    def simulated(self) -> bool:
        """Whether the episode is a simulation."""
        return self._writer.simulated

    @property
    def is_recorded(self) -> bool:
        """Whether the log has this episode with its end already; nothing is recorded then."""
        return self._writer.is_recorded

    @property
    def refusal(self) -> str | None:
        """The reason why nothing, or nothing more, is recorded; None while the episode is recorded.

        The log cannot be read, or has other events of this name, or the episode is open.
        """
        return self._writer.refusal

    def __str__(self) -> str:
        return str(self._writer)

    def __repr__(self) -> str:
        return f"<{type(self).__name__} {self}{' closed' if self.closed else ''}>"

    def _repr_html_(self) -> str:
        return self._writer._repr_html_()

    def open(self, stored: StoredEpisodes | None = None) -> None:
        """Write the start of the episode; see `KeyedEpisode.open`."""
        self._writer.open(stored)

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
        is_status = isinstance(status, str) and status in get_args(event_types.EpisodeStatus)
        self._writer.end = (status if is_status else self._writer.end[0]), at
        self._episodes.close(self._writer, failure)

    def is_recording(self, method: str, event_type: str) -> bool:
        """Return whether the memory is open; otherwise count a call of this method, unless it ends something."""
        if not self.emitter.is_closed:
            return True
        if event_type not in ("NodeEnded", "EpisodeEnded", "EpisodeStarted"):
            self.emitter.note_unrecorded(f"a call of `{method}`")
        return False

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
    ) -> Node:
        hash(key)
        if self.emitter.must_wait() and not is_of_memory():
            self.emitter.sink.block_until_room(FOREVER_S, reserved=False)
        missing: dict[str, str] = {}
        parameters = (
            noted(self.emitter, "NodeStarted", self._values.parameters, declared, given, self._writer, missing) or {}
        )
        node = Node(key, declared, parameters)
        self._writer.write("NodeStarted", lambda: self._writer.start_node(node, parent, robot, missing), at)
        return node

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
        writer = self._writer
        key = key.key if isinstance(key, Node) and writer.open_node(key.key) is key else key
        hash(key)
        if status is None:
            raised = failure if isinstance(failure, BaseException) else None
            status = end_statuses(raised, self._failures)[1] if raised is failure else "FAILED"
        own, lower = self._checked_status(status), self._checked_status(below) if below is not None else None
        value = noted(self.emitter, "NodeEnded", self._values.failure, failure, writer) if failure is not None else None
        encoded = encode_or_missing(self._values.converted(result), writer) if result is not None else None
        return lambda: writer.end_node(key, own, value, encoded, lower, untimed=untimed)

    def _checked_status(self, status: event_types.NodeStatus) -> event_types.NodeStatus:
        if status in END_STATUSES:
            return status
        self._writer.note("NodeEnded", f"{clean_repr(status)} is not a status ({', '.join(END_STATUSES)})")
        return "ERROR"

    def is_open(self, key: Hashable) -> bool:
        """Return whether a node with this key has started and not ended."""
        return bool(noted(self.emitter, "NodeStarted", lambda: self._writer.open_node(key) is not None))

    def node_reference(self, key: Hashable | None = None) -> event_types.NodeReference:
        """Return a reference to a node for `Recording.episode(thought_by=…)`; without a known key, to the root."""
        return event_types.NodeReference(str(self), self._writer.node_or_root(self._writer.find(key, "EpisodeStarted")))

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
        return lambda: self._writer.objects.add(key, added, self._writer.cause(node))

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
        writer = self._writer
        if not writer.closed and writer.objects.is_at(key, pose):
            return lambda: None  # before the pose is copied, which takes longer
        copied = pose_of(pose)
        return lambda: writer.objects.move(writer.known(key), copied, writer.cause(node))

    @reported("a frame")
    def frame_moved(self, frame: str, pose: PoseLike | event_types.PoseValue) -> Callable[[], object]:
        """State where a frame is, in the frame of this pose. Records nothing itself.

        Poses of objects, percepts and robots in this frame are recorded in the map from now on, if that frame's place
        is known too. Those of objects are known by their names.
        """
        name, copied = str(frame), pose_of(pose)
        return lambda: self._writer.objects.frames.place(name, copied)

    @reported("JointsMoved")
    def joints_moved(
        self, key: Hashable, joints: Mapping[str, float], *, node: Hashable | None = None, at: At | None = None
    ) -> Callable[[], object]:
        """Record new joint positions (rad or m); only those that changed."""
        copied, writer = self._arguments.joints_of(joints, "JointsMoved"), self._writer
        return lambda: writer.objects.turn(writer.known(key), copied, writer.cause(node))

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
        name, writer = self._arguments.text_of("link", link), self._writer
        return lambda: writer.objects.attach(writer.known(parent), writer.known(child), name, writer.cause(node))

    @reported("ObjectDetached")
    def object_detached(
        self, parent: Hashable, child: Hashable, *, node: Hashable | None = None, at: At | None = None
    ) -> Callable[[], object]:
        """Record that `child` no longer moves with `parent`."""
        writer = self._writer
        return lambda: writer.objects.detach(writer.known(parent), writer.known(child), writer.cause(node))

    @reported("ObjectRemoved")
    def object_removed(
        self, key: Hashable, *, node: Hashable | None = None, at: At | None = None
    ) -> Callable[[], object]:
        """Record that an object left the world."""
        writer = self._writer
        return lambda: writer.objects.remove(writer.known(key), writer.cause(node))

    def reference(self, key: Hashable) -> event_types.ObjectReference | None:
        """Return the current row of an object, for values that name it; None if there is none of this key.

        Call it again for each value: the row changes when the object moves.
        """
        return self._writer.reference(key)

    # --- observations -----------------------------------------------------------------------------------------

    @reported("Observed")
    def observe(
        self, name: str, values: object, *, node: Hashable | None = None, at: At | None = None
    ) -> Callable[[], object]:
        """Record an observation; `Memory.observe` describes name and values."""
        copied = self._values.converted(values)
        return lambda: self._writer.observe(name, copied, node)

    def observe_camera(
        self, name: str, frames: Any = None, *, hz: float = 2.0, bytes_per_s: float = 4e6, node: Hashable | None = None
    ) -> CameraStream:
        """Record the images of a camera until the episode ends; see `Memory.observe_camera`.

        Raises `CallerError` for an argument that does not fit, and in an episode with a name or times of its own, whose
        images `observe` records.
        """
        if self._writer.events.time is not None or is_named(self.id):
            raise CallerError("this episode has a name or times of its own: record each image with `observe`")
        writer, acting = self._writer, self._writer.find(node, "Observed")

        def record(image: object) -> bool:  # not in `write`, so that no call of the executive waits for an image
            return put_image(writer, name, image, writer.node_or_root(acting))

        stream = CameraStream(name, record, self.emitter, self._episodes.clock, hz, bytes_per_s)
        return stream if frames is None else stream.read(frames)

    @reported("Observed", timed=False)
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
        from pycrorm_async.record import samples  # here, because it loads numpy and few executives have streams

        stamps = self._writer.now_ns() if at is None else at
        names, numbers, times = samples.sampled_values(channels, values, stamps)
        return lambda: self._writer.sample(name, names, numbers, times, node)

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
        event = struct_of(event_types.ObjectDetected(source, object_type), event_types.ObjectDetected)
        return lambda: self._writer.detect(event, percepts, node)

    @reported("EpisodeTagged")
    def tag(self, *tags: str, remove: Sequence[str] = (), at: At | None = None) -> Callable[[], object]:
        """Add and remove tags."""
        added, removed = checked_tags(tags), checked_tags(remove)
        return lambda: EpisodeWriter.change_tags(self._writer, added, removed)

    def wait_for_room(self, timeout_s: float | None = None) -> bool:
        """Block while the spool is full, for a limited time; return whether it has room now.

        `start` waits by itself, without a limit; so this is for an executive that has something else to do then.
        """
        sink, limit_s = self.emitter.sink, FOREVER_S if timeout_s is None else timeout_s
        has_room = not sink.full or noted(
            self.emitter, "EpisodeStarted", sink.block_until_room, limit_s, reserved=False
        )
        return bool(has_room) and not self.emitter.is_closed
