"""Write an episode as MCAP with Foxglove's schemas: `/tf`, `/scene`, `/plan`.

`/tf` has a `FrameTransforms` for each event that moved objects or joints, `/scene` a `SceneUpdate` with the shapes of
each object, in the frames of its links, and the deletion when it is removed, and `/plan` a `Log` for the start and the
end of each node. The time of a message is the wall time of its event, or, by event, `fps` events in a second; its
sequence is that of the event.
"""

from __future__ import annotations

from collections.abc import Callable, Iterator
from functools import partial
from itertools import groupby
from pathlib import Path
from typing import Any, NamedTuple

from pycrorm_async.errors import MissingExtra
from pycrorm_async.export.lerobot.states import Clock
from pycrorm_async.export.recorded_episode import EventTime, RecordedEpisode
from pycrorm_async.export.scene_frames import REPORTED_CHANGES, FrameChange, SceneObject, Shape, frame_changes

_SECOND_NS = 10**9
_TOPICS = {"/tf": "FrameTransforms", "/scene": "SceneUpdate", "/plan": "Log"}


class _Message(NamedTuple):
    """A message of a topic. `content` makes the message from its time stamp, which depends on the clock."""

    when: EventTime
    topic: str
    content: Callable[[Any], Any]


def write_mcap(
    episode: RecordedEpisode,
    objects: dict[int, SceneObject],
    path: Path,
    report_events: Callable[[int], object],
    *,
    clock: Clock,
    fps: int,
) -> int:
    """Write the file and return the number of messages.

    Args:
        report_events: gets the event up to which the messages are written.
        clock: the axis of the messages: `time`, the wall time of each event, or `event`, `fps` events in a second.

    Raises `MissingExtra`.
    """
    try:
        from foxglove import messages
        from mcap.writer import Writer
    except ImportError:
        raise MissingExtra("MCAP files need mcap and foxglove-sdk: pip install 'pycrorm-async[mcap]'") from None

    count = 0
    with path.open("wb") as file:
        writer = Writer(file)
        writer.start(profile="", library="pycrorm-async")
        writer.add_metadata("episode", _metadata(episode))
        channels = {topic: _channel(writer, topic, getattr(messages, name)) for topic, name in _TOPICS.items()}
        for each in sorted(_messages(episode, objects, messages), key=lambda message: message.when.sequence):
            since_ns = each.when.sequence * _SECOND_NS // fps
            time_ns = each.when.wall_ns if clock == "time" else episode.started_wall_ns + since_ns
            stamped = each.content(messages.Timestamp(sec=time_ns // _SECOND_NS, nsec=time_ns % _SECOND_NS))
            writer.add_message(channels[each.topic], time_ns, stamped.encode(), time_ns, each.when.sequence)
            count += 1
            if count % REPORTED_CHANGES == 0:
                report_events(each.when.sequence)
        writer.finish()
    return count


def _metadata(episode: RecordedEpisode) -> dict[str, str]:
    return {
        "number": str(episode.number),
        "id": episode.id,
        "description": episode.description,
        "status": episode.status,
    }


def _channel(writer: Any, topic: str, kind: Any) -> int:
    schema = kind.get_schema()
    registered = writer.register_schema(schema.name, schema.encoding, schema.data)
    channel: int = writer.register_channel(topic, "protobuf", registered)
    return channel


def _messages(episode: RecordedEpisode, objects: dict[int, SceneObject], kinds: Any) -> Iterator[_Message]:
    for when, changes in groupby(frame_changes(episode, objects), key=lambda each: each.when):
        yield _Message(when, "/tf", partial(_transforms, kinds, list(changes)))
    yield from _scene(episode, objects, kinds)
    yield from _plan(episode, kinds)


def _transforms(kinds: Any, changes: list[FrameChange], stamp: Any) -> Any:
    return kinds.FrameTransforms(
        transforms=[
            kinds.FrameTransform(
                timestamp=stamp,
                parent_frame_id=each.parent,
                child_frame_id=each.child,
                translation=_vector(kinds, each.translation),
                rotation=_rotation(kinds, each.rotation),
            )
            for each in changes
        ]
    )


def _scene(episode: RecordedEpisode, objects: dict[int, SceneObject], kinds: Any) -> Iterator[_Message]:
    seen: set[int] = set()
    for change in episode.changes:
        shapes = {frame: each for frame, each in objects[change.object].shapes.items() if each}
        if change.removed:
            yield _Message(change.when, "/scene", partial(_deletion, kinds, list(shapes)))
        elif change.object not in seen:
            seen.add(change.object)
            yield _Message(change.when, "/scene", partial(_entities, kinds, shapes))


def _deletion(kinds: Any, names: list[str], stamp: Any) -> Any:
    return kinds.SceneUpdate(deletions=[kinds.SceneEntityDeletion(timestamp=stamp, id=name) for name in names])


def _entities(kinds: Any, shapes: dict[str, list[Shape]], stamp: Any) -> Any:
    return kinds.SceneUpdate(entities=[_entity(kinds, stamp, frame, each) for frame, each in shapes.items()])


def _entity(kinds: Any, stamp: Any, frame: str, shapes: list[Shape]) -> Any:
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
    return kinds.SceneEntity(
        timestamp=stamp,
        frame_id=frame,
        id=frame,
        frame_locked=True,
        cubes=cubes,
        cylinders=cylinders,
        spheres=spheres,
    )


def _plan(episode: RecordedEpisode, kinds: Any) -> Iterator[_Message]:
    for node in episode.nodes:
        line, level = partial(_line, kinds, node.label), kinds.LogLevel.Info
        yield _Message(node.start, "/plan", partial(line, level, f"{node.dtype} started {node.parameters}".rstrip()))
        if node.end is not None:
            level = kinds.LogLevel.Error if node.status in ("FAILED", "ERROR") else level
            reason = f" {node.reason}: {node.message}" if node.reason else ""
            yield _Message(node.end, "/plan", partial(line, level, f"{node.dtype} {node.status}{reason}"))


def _line(kinds: Any, name: str, level: Any, text: str, stamp: Any) -> Any:
    return kinds.Log(timestamp=stamp, level=level, message=text, name=name)


def _vector(kinds: Any, values: tuple[float, ...]) -> Any:
    x, y, z = values
    return kinds.Vector3(x=x, y=y, z=z)


def _rotation(kinds: Any, values: tuple[float, ...]) -> Any:
    x, y, z, w = values
    return kinds.Quaternion(x=x, y=y, z=z, w=w)
