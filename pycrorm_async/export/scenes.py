"""Read episodes as motion over time: states and scene frames of robots; write them as MCAP."""

from __future__ import annotations

import asyncio
import heapq
import json
import logging
from collections.abc import Callable, Iterable, Iterator, Mapping, Sequence
from functools import partial
from itertools import groupby
from pathlib import Path
from types import MappingProxyType
from typing import Any, Literal, NamedTuple, TypeAlias, TypeVar

import numpy as np
from numpy.typing import NDArray

from pycrorm_async.errors import CallerError, MissingExtra
from pycrorm_async.events import types as event_types
from pycrorm_async.events.codec import description_of
from pycrorm_async.export.formats import Format, Job, Written
from pycrorm_async.export.selection import CoveredEpisode
from pycrorm_async.query import observed_images
from pycrorm_async.query.observed_images import Content, Kind
from pycrorm_async.query.reading import Reading
from pycrorm_async.query.replay import EpisodeReplay, ReplayedNode, ReplayTime
from pycrorm_async.query.scene import Triangles, assumed_model, joint_pose, link_poses, object_model, point_model
from pycrorm_async.query.text import parameters_text
from pycrorm_async.report.document import Meshes
from pycrorm_async.store.address import DatabaseAddress
from pycrorm_async.store.stored import EpisodeRow, StoredEvent
from pycrorm_async.world.pose import Pose
from pycrorm_async.world.urdf_model import origin
from pycrorm_async.writer.drain import run_to_completion

#
# Read an episode's events into the history of its world and of its plan, which all formats of robots share.

BASE = ("base.x", "base.y", "base.z", "base.qx", "base.qy", "base.qz", "base.qw")


class Change(NamedTuple):
    """A change of an object of the world: its new pose (position, orientation), new joint positions, or its removal."""

    when: ReplayTime
    object: int
    pose: tuple[float, ...] | None
    joints: Mapping[str, float]
    removed: bool

    @property
    def adds(self) -> bool:
        """Whether it is the first change of the object, whose identity is the event that added it."""
        return self.when.sequence == self.object


class Picture(NamedTuple):
    """An observed image, depth map or point cloud. `data` is an encoded image, or pixels, a depth map or points."""

    when: ReplayTime
    name: str
    kind: Kind
    data: bytes | NDArray[Any]


class PlanLine(NamedTuple):
    """The start or the end of a node as text. `label` is its type with the names of its objects."""

    when: ReplayTime
    label: str
    text: str
    is_failure: bool = False


class ExportedEpisode(EpisodeReplay):
    """An episode up to its head when it was chosen, with what changed at each event.

    Attributes:
        events: all of them, in order.
        changes: of the world, in order; an object's first one adds it.
        contents: the images, depth maps and point clouds that were observed, with their names.
        numbers: the numbers that were observed, by name.
        pictures: what `contents` hold, as far as they can be read and a file has room.
    """

    def __init__(self, row: EpisodeRow, address: DatabaseAddress) -> None:
        super().__init__(row, address, strict=False, samples=True)
        self.events: list[ReplayTime] = []
        self.changes: list[Change] = []
        self.contents: list[tuple[ReplayTime, str, Content]] = []
        self.numbers: dict[str, list[tuple[ReplayTime, float]]] = {}
        self.pictures: list[Picture] = []
        self._poses: dict[int, tuple[float, ...]] = {}
        self._robots: dict[int, str] = {}

    def read(self, event: StoredEvent) -> event_types.Happening | None:
        """Apply the next event, as `EpisodeReplay.read`, and keep its change of the world."""
        happening = super().read(event)
        self.events.append(self.at)
        match happening:
            case event_types.NodeStarted():
                self._robots[event.sequence] = self.world.robot_name(happening.robot)
            case event_types.ObjectAdded():
                self._change(event.sequence, _numbers(happening.pose), happening.joints)
            case event_types.ObjectMoved():
                self._change(happening.object, _numbers(happening.pose))
            case event_types.JointsMoved():
                self._change(happening.object.object, joints=happening.joints)
            case event_types.StateSampled():
                self._sampled(happening.object.object, happening.channels)
            case event_types.ObjectRemoved():
                self._change(happening.object.object, removed=True)
            case event_types.Observed():
                self.contents += [(self.at, *each) for each in contents_of(happening)]
                for name, number in observed_images.numbers_in(happening.name, happening.values):
                    self.numbers.setdefault(name, []).append((self.at, number))
        return happening

    def _change(
        self,
        identity: int,
        pose: tuple[float, ...] | None = None,
        joints: Mapping[str, float] = MappingProxyType({}),
        *,
        removed: bool = False,
    ) -> None:
        if identity not in self.world.added:
            return
        if pose is not None:
            self._poses[identity] = pose
        self.changes.append(Change(self.at, identity, pose, joints, removed))

    def _sampled(self, identity: int, channels: Mapping[str, float]) -> None:
        """Apply a sample of the robot's state, which holds the channels that have changed."""
        before = self._poses.get(identity)
        pose = None
        if before is not None and not channels.keys().isdisjoint(BASE):
            pose = tuple(channels.get(name, value) for name, value in zip(BASE, before, strict=True))
        self._change(identity, pose, {name: value for name, value in channels.items() if name not in BASE})

    def type_of(self, node: ReplayedNode) -> str:
        """Return the dtype of a node, or its kind without one."""
        return self.dtype(node) or node.kind

    def label(self, node: ReplayedNode) -> str:
        """Return the type of a node with the names of its objects."""
        named = self.parameters(node)
        names = [each["name"] for key, each in named.items() if each is not node.parameters[key]]
        return " ".join([self.type_of(node), *names])

    def plan_lines(self) -> list[PlanLine]:
        """Return a line for each start and end of a node, in the order of the events."""
        lines: list[PlanLine] = []
        for node in self.nodes.values():
            dtype, label = self.type_of(node), self.label(node)
            lines.append(
                PlanLine(node.start, label, f"{dtype} started {parameters_text(self.parameters(node))}".rstrip())
            )
            if node.end is not None:
                text = f"{dtype} {node.status}" + (f" {node.reason}: {node.message}" if node.reason else "")
                lines.append(PlanLine(node.end, label, text, node.status in ("FAILED", "ERROR")))
        return sorted(lines, key=lambda each: each.when.sequence)

    def action_lanes(self) -> dict[str, list[tuple[ReplayTime, str]]]:
        """Return, by robot, its innermost running action whenever it changes; empty while none runs."""
        actions = {start: each for start, each in self.nodes.items() if each.kind == "action"}
        turns = [(each.start, start, True) for start, each in actions.items()]
        turns += [(each.end, start, False) for start, each in actions.items() if each.end is not None]
        lanes: dict[str, list[tuple[ReplayTime, str]]] = {}
        running: dict[str, set[int]] = {}
        for when, start, begins in sorted(turns):
            robot = self._robots[start]
            now = running.setdefault(robot, set())
            (now.add if begins else now.discard)(start)
            label, lane = self.label(actions[max(now)]) if now else "", lanes.setdefault(robot, [])
            if not lane or lane[-1][1] != label:
                lane.append((when, label))
        return lanes


def _numbers(pose: event_types.PoseValue) -> tuple[float, ...]:
    return (*pose.position, *pose.orientation)


def contents_of(observed: event_types.Observed) -> Iterator[tuple[str, Content]]:
    """Yield the images, depth maps and point clouds of an observation, with their names."""
    for each in observed_images.contents_in(observed.values):
        if each.kind is not None:
            yield f"{observed.name}.{each.path}".rstrip("."), each


E = TypeVar("E", bound=ExportedEpisode)


async def read_episode(
    kind: type[E], reading: Reading, covered: CoveredEpisode, report_events: Callable[[int], object]
) -> E:
    """Read an episode up to the event `covered.events`. `report_events` gets the number of events read so far.

    Raises `CallerError` for one without an event; `LogDamaged` or `DatabaseForeign` for an event that cannot be read.
    """
    log = await reading.log()
    [row] = await log.episodes(covered.number, covered.number)
    if covered.events == 0:
        raise CallerError(f"the log has no event of episode {covered.number}")
    episode = kind(row, log.address)
    episode.dtypes = await log.dtypes()
    async for page in log.pages(row._replace(head=covered.events)):
        for event in page:
            episode.read(event)
        report_events(page[-1].sequence)
    return episode


# === states ===================================================================================================
#
# Make the frames of an episode: the robot's base and joints, by event or at a fixed rate, and the running action.
#
# By event there is a frame for each event that changed the robot's state, because a plan whose motions are jumps takes
# a third of a second for 70 nodes. By time there is a frame at a fixed rate, with the latest state, samples included.

Clock: TypeAlias = Literal["event", "time"]
"""The axis of the frames."""

IDLE = "idle"
"""The subtask while no action runs."""
_FRAMES_MAX = 10_000_000
"""Bounds the frames of an episode by time, because a wrong rate could fill the disk."""
_SECOND_NS = 10**9


class Frames(NamedTuple):
    """The frames of an episode.

    Attributes:
        robot: the model of the robot, or its name.
        channels: names of the numbers of a state: 7 of the base (m, quaternion), then the joints (rad, m) by name.
        states: one row for each frame.
        at: the last event of each frame; by time at the time of the frame.
        subtasks: the innermost running action of each frame, with the names of its objects.
    """

    robot: str
    channels: tuple[str, ...]
    states: NDArray[np.float32]
    at: list[ReplayTime]
    subtasks: list[str]


def frames_of(episode: ExportedEpisode, clock: Clock, fps: int) -> Frames:
    """Return the frames of the robot that was added first, while it was in the world.

    Raises `CallerError` for an episode without a robot, or with fewer than two frames.
    """
    robots = [identity for identity, each in episode.world.added.items() if each.object_type == "ROBOT"]
    if not robots:
        raise CallerError(f"episode {episode.number} has no robot, whose states LeRobot's frames are: leave it out")
    robot = episode.world.added[robots[0]]
    channels = (*BASE, *sorted(robot.joints))
    changed = list(_states(episode, robots[0], channels))
    while_there = _events_with(episode, robots[0])
    chosen = changed if clock == "event" else list(_resampled(episode.number, while_there, changed, fps))
    if len(chosen) < 2:
        stay_ns = while_there[-1].since_ns - while_there[0].since_ns
        time_remedy = f"give a higher --fps, because the robot was there for {stay_ns / 1e9:.3f} s, or --clock event"
        remedy = time_remedy if clock == "time" else "leave it out"
        count = f"{len(chosen)} frame{'' if len(chosen) == 1 else 's'}"
        raise CallerError(f"episode {episode.number} has {count} by {clock}, and LeRobot needs two: {remedy}")
    at = [when for when, _ in chosen]
    states = np.array([state for _, state in chosen], dtype=np.float32)
    return Frames(robot.model or robot.name, channels, states, at, list(_subtasks(episode, at)))


def _states(
    episode: ExportedEpisode, identity: int, channels: Sequence[str]
) -> Iterator[tuple[ReplayTime, tuple[float, ...]]]:
    """Yield each event that changed the robot's state, and the state after it."""
    index = {name: position for position, name in enumerate(channels)}
    state = [0.0] * len(channels)
    before: tuple[float, ...] | None = None
    for change in episode.changes:
        if change.object != identity:
            continue
        if change.removed:
            return
        if change.pose is not None:
            state[: len(BASE)] = change.pose
        for name, position in change.joints.items():
            if name in index:
                state[index[name]] = position
        now = tuple(state)
        if now != before:
            before = now
            yield change.when, now


def _events_with(episode: ExportedEpisode, identity: int) -> list[ReplayTime]:
    """Return the events from the one that added the robot to the last one before its removal."""
    removals = (each.when.sequence for each in episode.changes if each.removed and each.object == identity)
    removal = next(removals, None)
    return [each for each in episode.events if identity <= each.sequence and (not removal or each.sequence < removal)]


def _resampled(
    episode: int, events: Sequence[ReplayTime], changed: Sequence[tuple[ReplayTime, tuple[float, ...]]], fps: int
) -> Iterator[tuple[ReplayTime, tuple[float, ...]]]:
    """Yield the last event and the state in force at each multiple of 1 / fps, from the first event to the last."""
    begin_ns, end_ns = events[0].since_ns, events[-1].since_ns
    count = (end_ns - begin_ns) * fps // _SECOND_NS + 1
    if count > _FRAMES_MAX:
        raise CallerError(f"episode {episode} would have {count:,} frames at {fps} per second: give a lower --fps")
    event = state = 0
    for frame in range(count):
        since_ns = begin_ns + frame * _SECOND_NS // fps
        while event + 1 < len(events) and events[event + 1].since_ns <= since_ns:
            event += 1
        while state + 1 < len(changed) and changed[state + 1][0].sequence <= events[event].sequence:
            state += 1
        yield events[event]._replace(since_ns=since_ns), changed[state][1]


def _subtasks(episode: ExportedEpisode, at: Sequence[ReplayTime]) -> Iterator[str]:
    """Yield the label of the action that was running last at each of these events."""
    actions = [(each.start.sequence, each) for each in episode.nodes.values() if each.kind == "action"]
    running: list[tuple[int, str, ReplayTime | None]] = []  # the one that started last comes first
    started = 0
    for when in at:
        while started < len(actions) and actions[started][0] <= when.sequence:
            sequence, action = actions[started]
            heapq.heappush(running, (-sequence, episode.label(action), action.end))
            started += 1
        while running and (end := running[0][2]) is not None and end.sequence <= when.sequence:
            heapq.heappop(running)
        yield running[0][1] if running else IDLE


# === pictures =================================================================================================

VIEWS_MAX = 4
"""Bounds the cameras that have a view when a file is opened."""
_PICTURES_BYTES_MAX = 512_000_000
"""Bounds the bytes of the pictures of a file, which are in memory while it is written."""
_log = logging.getLogger(__name__)


async def read_pictures(reading: Reading, episode: ExportedEpisode) -> None:
    """Read the contents of an episode into its pictures; of more than a file has room for, every n-th."""
    log = await reading.log()
    step = -(-sum(content.size for _, _, content in episode.contents) // _PICTURES_BYTES_MAX) or 1
    for when, name, content in episode.contents[::step]:
        with log.translated():
            data = await log.blobs.read_blob(content.hash)
        try:
            if data is None:
                raise ValueError("its content is not in the log")  # noqa: TRY301  all reasons are logged alike
            picture = await asyncio.to_thread(_picture, when, name, content, data)
        except ValueError as reason:
            _log.warning("event %d: %s is left out: %s", when.sequence, name, reason)
        else:
            episode.pictures.append(picture)
    if step > 1:
        _log.warning("of %d observed pictures, the file has one in %d", len(episode.contents), step)


def _picture(when: ReplayTime, name: str, content: Content, data: bytes) -> Picture:
    if content.kind == "points":
        return Picture(when, name, "points", observed_images.points_of(content, data))
    if content.kind == "depth":
        depth = observed_images.array_of(data)
        observed_images.range_of(depth)  # refuses one without a finite number
        return Picture(when, name, "depth", depth.view(np.uint8) if depth.dtype.kind == "b" else depth)
    if content.media_type.startswith("image/"):
        observed_images.image_type(data)
        return Picture(when, name, "image", data)
    return Picture(when, name, "image", observed_images.pixels_of(content, data))


# === mcap file ================================================================================================
#
# Write an episode as MCAP with Foxglove's schemas: `/tf`, `/scene`, `/plan`.
#
# `/camera/NAME` has a `CompressedImage` of each observed image, depth maps in colours, `/cloud/NAME` the points of each
# cloud, and `/joint_states/ROBOT` the joints of a robot whenever they change.
#
# `/tf` has a `FrameTransforms` for each event that moved objects or joints, `/scene` a `SceneUpdate` with the shapes of
# each object, in the frames of its links, and the deletion when it is removed, and `/plan` a `Log` for the start and
# the end of each node. The time of a message is the wall time of the episode's start and the monotonic time since then,
# or, by event, `fps` events in a second; its sequence is that of the event.

_TOPICS = {"/tf": "FrameTransforms", "/scene": "SceneUpdate", "/plan": "Log"}
_Message: TypeAlias = tuple[ReplayTime, str, Any]
"""The event of a message, its topic and its content. Those of one topic come in the order of the events."""
_Stamp: TypeAlias = Callable[[ReplayTime], Any]
"""Makes the time stamp of a message of an event."""


def write_mcap(
    episode: ExportedEpisode,
    objects: dict[int, SceneObject],
    path: Path,
    report_events: Callable[[int], object],
    options: Mapping[str, Any],
) -> Written:
    """Write the file and return the number of messages, and a layout. `report_events` gets the event of the latest one.

    Raises `MissingExtra`.
    """
    try:
        from foxglove import messages
        from mcap.writer import Writer
    except ImportError:
        raise MissingExtra("MCAP files need mcap and foxglove-sdk: pip install 'pycrorm-async[mcap]'") from None

    def time_ns(when: ReplayTime) -> int:
        by_event_ns = when.sequence * _SECOND_NS // options["fps"]
        return episode.begin_wall_ns + (when.since_ns if options["clock"] == "time" else by_event_ns)

    def stamp(when: ReplayTime) -> Any:
        seconds, rest_ns = divmod(time_ns(when), _SECOND_NS)
        return messages.Timestamp(sec=seconds, nsec=rest_ns)

    count = 0
    with path.open("wb") as file:
        writer = Writer(file)
        writer.start(profile="", library="pycrorm-async")
        writer.add_metadata("episode", _metadata(episode))
        channels = {topic: _channel(writer, topic, getattr(messages, name)) for topic, name in _TOPICS.items()}
        of_topics = (
            _transforms(episode, objects, messages, stamp),
            _scene(episode, objects, messages, stamp),
            _plan(episode, messages, stamp),
            _joint_states(episode, objects, messages, stamp),
            _pictures(episode, messages, stamp),
        )
        for when, topic, content in heapq.merge(*of_topics, key=lambda message: message[0].sequence):
            if topic not in channels:
                channels[topic] = _channel(writer, topic, type(content))
            writer.add_message(channels[topic], time_ns(when), content.encode(), time_ns(when), when.sequence)
            count += 1
            if count % REPORTED_CHANGES == 0:
                report_events(when.sequence)
        writer.finish()
    return Written(count, beside=_layout(episode, channels))


def _layout(episode: ExportedEpisode, topics: Iterable[str]) -> str:
    """Return a layout as Foxglove exports one: the scene, and the first cameras, the joints that move and the plan."""
    shown = {each: {"visible": True} for each in topics if each.startswith(("/scene", "/cloud/"))}
    cameras = [each for each in topics if each.startswith("/camera/")][:VIEWS_MAX]
    moved = dict.fromkeys(name for each in episode.changes if not each.adds for name in each.joints)
    robots = [each for each in topics if each.startswith("/joint_states/")]
    values = [f"{each}.joints[:]{{name=={json.dumps(name)}}}.position" for each in robots for name in moved]
    curves = [{"value": each, "enabled": True, "timestampMethod": "receiveTime"} for each in values]
    modes = [{"imageMode": {"imageTopic": each}} for each in cameras]
    panels: dict[str, Any] = {f"Image!{index}": each for index, each in enumerate(modes)}
    panels |= {"Plot!joints": {"paths": curves}} if curves else {}
    panels["RosOut!plan"] = {"topicToRender": "/plan", "minLogLevel": 1}
    *others, last = panels
    beside: Any = last
    for count, each in enumerate(reversed(others), 2):
        beside = {"direction": "column", "first": each, "second": beside, "splitPercentage": 100 / count}
    scene = {"3D!scene": {"followTf": MAP, "fixedFrame": MAP, "topics": shown}}
    arranged = {"direction": "row", "first": "3D!scene", "second": beside, "splitPercentage": 65}
    return json.dumps({"configById": scene | panels, "globalVariables": {}, "userNodes": {}, "layout": arranged})


def _metadata(episode: ExportedEpisode) -> dict[str, str]:
    return {
        "number": str(episode.number),
        "id": episode.id,
        "description": episode.started.description,
        "status": episode.status,
    }


def _channel(writer: Any, topic: str, kind: Any) -> int:
    schema = kind.get_schema()
    registered = writer.register_schema(schema.name, schema.encoding, schema.data)
    channel: int = writer.register_channel(topic, "protobuf", registered)
    return channel


def _transforms(
    episode: ExportedEpisode, objects: Mapping[int, SceneObject], kinds: Any, stamp: _Stamp
) -> Iterator[_Message]:
    for when, changes in groupby(frame_changes(episode, objects), key=lambda each: each.when):
        transforms = [
            kinds.FrameTransform(
                timestamp=stamp(when),
                parent_frame_id=each.parent,
                child_frame_id=each.child,
                translation=_vector(kinds, each.translation),
                rotation=_rotation(kinds, each.rotation),
            )
            for each in changes
        ]
        yield when, "/tf", kinds.FrameTransforms(transforms=transforms)


def _scene(
    episode: ExportedEpisode, objects: Mapping[int, SceneObject], kinds: Any, stamp: _Stamp
) -> Iterator[_Message]:
    for change in episode.changes:
        shapes = {frame: each for frame, each in objects[change.object].shapes.items() if each}
        if change.removed:
            deletions = [kinds.SceneEntityDeletion(timestamp=stamp(change.when), id=name) for name in shapes]
            yield change.when, "/scene", kinds.SceneUpdate(deletions=deletions)
        elif change.adds:
            entities = [_entity(kinds, stamp(change.when), frame, each) for frame, each in shapes.items()]
            yield change.when, "/scene", kinds.SceneUpdate(entities=entities)


def _entity(kinds: Any, stamp: Any, frame: str, shapes: list[SceneShape]) -> Any:
    cubes, cylinders, spheres = [], [], []
    for each in shapes:
        pose = kinds.Pose(position=_vector(kinds, each.translation), orientation=_rotation(kinds, each.rotation))
        color = kinds.Color(**dict(zip("rgba", each.color, strict=True)))
        match each.kind, each.sizes:
            case "box", edges:
                cubes.append(kinds.CubePrimitive(pose=pose, size=_vector(kinds, edges), color=color))
            case "sphere", (radius,):
                size = _vector(kinds, (2 * radius,) * 3)
                spheres.append(kinds.SpherePrimitive(pose=pose, size=size, color=color))
            case _, (radius, length):  # a capsule is shown as the cylinder between its ends
                size = _vector(kinds, (2 * radius, 2 * radius, length))
                cylinders.append(
                    kinds.CylinderPrimitive(pose=pose, size=size, bottom_scale=1, top_scale=1, color=color)
                )
    named = {"timestamp": stamp, "frame_id": frame, "id": frame, "frame_locked": True}
    return kinds.SceneEntity(**named, cubes=cubes, cylinders=cylinders, spheres=spheres)


def _plan(episode: ExportedEpisode, kinds: Any, stamp: _Stamp) -> Iterator[_Message]:
    for line in episode.plan_lines():
        level = kinds.LogLevel.Error if line.is_failure else kinds.LogLevel.Info
        log = kinds.Log(timestamp=stamp(line.when), level=level, message=line.text, name=line.label)
        yield line.when, "/plan", log


def _joint_states(
    episode: ExportedEpisode, objects: Mapping[int, SceneObject], kinds: Any, stamp: _Stamp
) -> Iterator[_Message]:
    positions: dict[int, dict[str, float]] = {}
    for change in episode.changes:
        if not change.joints or episode.world.added[change.object].object_type != "ROBOT":
            continue
        joints = positions.setdefault(change.object, {})
        joints.update(change.joints)
        states = [kinds.JointState(name=name, position=position) for name, position in joints.items()]
        topic = f"/joint_states/{objects[change.object].name}"
        yield change.when, topic, kinds.JointStates(timestamp=stamp(change.when), joints=states)


def _pictures(episode: ExportedEpisode, kinds: Any, stamp: _Stamp) -> Iterator[_Message]:
    real = kinds.PackedElementFieldNumericType.Float32
    for when, name, kind, data in episode.pictures:
        if kind == "points":
            fields = [kinds.PackedElementField(name=each, offset=4 * at, type=real) for at, each in enumerate("xyz")]
            points = np.asarray(data, "<f4").tobytes()
            described = {"frame_id": MAP, "point_stride": 12, "fields": fields, "data": points}
            yield when, f"/cloud/{named(name)}", kinds.PointCloud(timestamp=stamp(when), **described)
            continue
        if isinstance(data, bytes):
            encoded, form = data, observed_images.image_type(data).removeprefix("image/")
        else:
            pixels = observed_images.colored(data) if kind == "depth" else data
            encoded, form = observed_images.png_of(pixels, 1), "png"
        image = kinds.CompressedImage(timestamp=stamp(when), frame_id=name, data=encoded, format=form)
        yield when, f"/camera/{named(name)}", image


def _vector(kinds: Any, values: Sequence[float]) -> Any:
    return kinds.Vector3(**dict(zip("xyz", values, strict=True)))


def _rotation(kinds: Any, values: Sequence[float]) -> Any:
    return kinds.Quaternion(**dict(zip("xyzw", values, strict=True)))


# === scene frames =============================================================================================
#
# Turn the changes of an episode's world into frames: one for each object and link, each in that of its parent.
#
# `map` is the frame of the world, `milk` that of the object, `pr2/torso_lift_link` that of a link. A second object of
# the same name is `milk#51`, with the event that added it. A joint that moves changes the frame of its child link
# alone.

MAP = "map"
REPORTED_CHANGES = 100
"""A writer reports its progress after so many changes or messages: to draw a bar takes longer than to write one."""
_GREY = (0.6, 0.6, 0.6, 1.0)
"""The colour of a shape without one."""


class FrameChange(NamedTuple):
    """A frame has a new pose in its parent: translation (m) and quaternion xyzw."""

    when: ReplayTime
    parent: str
    child: str
    translation: tuple[float, float, float]
    rotation: tuple[float, float, float, float]


class SceneShape(NamedTuple):
    """A shape in the frame of a link: kind (box, cylinder, capsule, sphere, mesh), sizes (m), pose and colour.

    The sizes of a box are its three edges, of a cylinder and a capsule radius and length, of a sphere the radius, of a
    mesh the factors by which its triangles, in `SceneObject.meshes` by this reference, are scaled.
    """

    kind: str
    sizes: tuple[float, ...]
    translation: tuple[float, float, float]
    rotation: tuple[float, float, float, float]
    color: tuple[float, float, float, float]
    mesh: str = ""


class SceneObject:
    """An object of the world with its model.

    Args:
        model: root link, shapes by link, and joints, as `query.scene.object_model` returns them.
        base_link: the link whose pose is recorded; None means the root link.
        color: of all its shapes; None means each shape's own.
        meshes: the triangles of the shapes that are meshes.

    Attributes:
        name: of its frame.
        parents: the frame that each of its links' frames is in, by link; that of the root link is in the object's own.
        shapes: by frame.
    """

    def __init__(
        self,
        name: str,
        model: Mapping[str, Any],
        base_link: str | None,
        color: Any,
        meshes: Mapping[str, Triangles] = MappingProxyType({}),
    ) -> None:
        self.name = name
        self.meshes = meshes
        self._model = model
        self._base_link = base_link
        self._joints: dict[str, float] = {}
        self._pose = Pose([0, 0, 0])
        self.shapes = {
            self.frame(link): [_shape(each, color) for each in shapes] for link, shapes in model["shapes"].items()
        }

    def frame(self, link: str) -> str:
        """Return the name of the frame of a link; the root link has that of the object."""
        return self.name if link == self._model["root"] else f"{self.name}/{link}"

    def changes(self, change: Change) -> Iterator[FrameChange]:
        """Yield the frames that a change of this object gives new poses, and for its first one those of all links.

        Where the recorded pose is that of another link than the root, a joint between the two also moves the root.
        """
        self._joints.update(change.joints)
        if change.pose is not None:
            self._pose = Pose(change.pose[:3], change.pose[3:])
        if change.pose is not None or (self._base_link is not None and change.joints):
            root = link_poses(self._model, self._pose, self._joints, self._base_link)[self._model["root"]]
            yield FrameChange(change.when, MAP, self.name, *_parts(root))
        for joint in self._model["joints"]:
            name, _, parent, child, *_, mimic = joint
            moves = name in change.joints or (mimic is not None and mimic[0] in change.joints)
            if change.adds or moves:
                frame = joint_pose(joint, self._joints)
                yield FrameChange(change.when, self.frame(parent), self.frame(child), *_parts(frame))


async def scene_objects(reading: Reading, episode: ExportedEpisode, triangles_max: int = 0) -> dict[int, SceneObject]:
    """Return the objects of an episode by identity, with their recorded, assumed or missing shapes.

    Recorded meshes have boxes in their place when there would be more than `triangles_max` triangles. Unless that is 0,
    a line in the log says which and why.
    """
    log = await reading.log()
    fingerprints = {each.description for each in episode.world.added.values() if each.description is not None}
    reader = Meshes(log, triangles_max)
    models: dict[str, Mapping[str, Any]] = {}
    meshes: dict[str, Mapping[str, Triangles]] = {}
    for name, payload in (await log.descriptions(fingerprints)).items():
        try:
            description = description_of(payload)
            if not triangles_max:
                models[name] = object_model(description)
                continue
            models[name], meshes[name] = await reader.model(description)
            if models[name].get("boxes"):
                _log.warning("boxes stand for %s", models[name]["boxes"])
        except ValueError as error:
            models[name] = point_model(f"its description cannot be read: {error}")
    objects: dict[int, SceneObject] = {}
    names: set[str] = set()
    for identity, added in episode.world.added.items():
        if added.description is None:
            model: Mapping[str, Any] = assumed_model(added.name, added.object_type, set(added.joints))
        else:
            model = models.get(added.description) or point_model("its description is not in the log")
        name = added.name.replace("/", "_")
        name = f"{name}#{identity}" if name in names else name
        names.add(name)
        triangles = meshes.get(added.description or "", {})
        objects[identity] = SceneObject(name, model, added.base_link, added.color, triangles)
    return objects


def frame_changes(episode: ExportedEpisode, objects: Mapping[int, SceneObject]) -> Iterator[FrameChange]:
    """Yield every change of a frame, in the order of the events."""
    for change in episode.changes:
        if not change.removed:
            yield from objects[change.object].changes(change)


def _shape(shape: Sequence[Any], color: Sequence[float] | None) -> SceneShape:
    kind, sizes, xyz, rpy, own = shape
    translation, rotation = _parts(origin(xyz, rpy))
    red, green, blue, opacity = color or own or _GREY
    mesh, sizes = (sizes[0], sizes[1:]) if kind == "mesh" else ("", sizes)
    return SceneShape(kind, tuple(sizes), translation, rotation, (red, green, blue, opacity), mesh)


def _parts(pose: Pose) -> tuple[tuple[float, float, float], tuple[float, float, float, float]]:
    """Return translation and quaternion xyzw of a pose, with w >= 0."""
    x, y, z, w = pose.orientation
    return pose.position, (x, y, z, w) if w >= 0 else (-x, -y, -z, -w)


def part(frame: str) -> str:
    """Return the last part of an entity path, without the characters that have a meaning in rerun."""
    return "".join(each if each.isalnum() or each in "_-." else "_" for each in frame.rpartition("/")[2])


def named(observation: str) -> str:
    """Return the name of an observation as one part of a topic or an entity path."""
    return part(observation.replace("/", "_"))


# === formats ==================================================================================================

_WriteScene: TypeAlias = Callable[
    [ExportedEpisode, dict[int, SceneObject], Path, Callable[[int], object], Mapping[str, Any]], Written
]


async def write_scene(write: _WriteScene, job: Job, path: Path, *, triangles_max: int = 0) -> Written:
    """Write one episode to a file, with at most so many triangles of meshes. Raises `MissingExtra`."""
    [covered] = job.selection.episodes
    episode = await read_episode(ExportedEpisode, job.reading, covered, job.reporter("reading"))
    objects = await scene_objects(job.reading, episode, triangles_max)
    await read_pictures(job.reading, episode)
    report = job.reporter("writing")
    # A cancelled task waits for the end of the thread: a file that is deleted while it writes would crash the process.
    written = await run_to_completion(asyncio.to_thread(write, episode, objects, path, report, job.options))
    report(covered.events)
    return written


MCAP = Format(
    partial(write_scene, write_mcap),
    noun="message",
    holds="episode",
    options={"clock": "time", "fps": 10},
    packages=("mcap", "foxglove-sdk"),
    beside="layout.json",
)
