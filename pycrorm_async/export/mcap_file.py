"""Write an episode as MCAP with Foxglove's schemas: `/tf`, `/scene`, `/plan`.

`/tf` has a `FrameTransforms` for each event that moved objects or joints, `/scene` a `SceneUpdate` with the shapes of
each object, in the frames of its links, and the deletion when it is removed, and `/plan` a `Log` for the start and the
end of each node. The time of a message is the wall time of its event, or, by event, `fps` events in a second; its
sequence is that of the event.
"""

from __future__ import annotations

from collections.abc import Iterator
from itertools import groupby
from pathlib import Path
from typing import Any, NamedTuple

from pycrorm_async.errors import MissingExtra
from pycrorm_async.export.lerobot.states import Clock
from pycrorm_async.export.recorded_episode import RecordedEpisode, When
from pycrorm_async.export.scene_frames import SceneObject, Shape, frame_changes

__all__ = ["write_mcap"]

_SECOND_NS = 10**9
_TOPICS = {"/tf": "FrameTransforms", "/scene": "SceneUpdate", "/plan": "Log"}


class _Message(NamedTuple):
    when: When
    topic: str
    content: Any


def write_mcap(episode: RecordedEpisode, objects: dict[int, SceneObject], path: Path, *, clock: Clock, fps: int) -> int:
    """Write the file and return the number of messages. Raises `MissingExtra`."""
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
        moved = list(changes)

        def transforms(stamp: Any, moved: list[Any] = moved) -> Any:
            return kinds.FrameTransforms(
                transforms=[
                    kinds.FrameTransform(
                        timestamp=stamp,
                        parent_frame_id=each.parent,
                        child_frame_id=each.child,
                        translation=_vector(kinds, each.translation),
                        rotation=_rotation(kinds, each.rotation),
                    )
                    for each in moved
                ]
            )

        yield _Message(when, "/tf", transforms)
    yield from _scene(episode, objects, kinds)
    yield from _plan(episode, kinds)


def _scene(episode: RecordedEpisode, objects: dict[int, SceneObject], kinds: Any) -> Iterator[_Message]:
    seen: set[int] = set()
    for change in episode.changes:
        scene_object = objects[change.object]
        if change.removed:

            def deletion(stamp: Any, scene_object: SceneObject = scene_object) -> Any:
                names = [each for each, shapes in scene_object.shapes.items() if shapes]
                return kinds.SceneUpdate(
                    deletions=[kinds.SceneEntityDeletion(timestamp=stamp, id=name) for name in names]
                )

            yield _Message(change.when, "/scene", deletion)
        elif change.object not in seen:
            seen.add(change.object)

            def entities(stamp: Any, scene_object: SceneObject = scene_object) -> Any:
                return kinds.SceneUpdate(
                    entities=[
                        _entity(kinds, stamp, frame, shapes) for frame, shapes in scene_object.shapes.items() if shapes
                    ]
                )

            yield _Message(change.when, "/scene", entities)


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
        started = f"{node.dtype} started {node.parameters}".rstrip()

        def log(stamp: Any, level: Any = kinds.LogLevel.Info, text: str = started, name: str = node.label) -> Any:
            return kinds.Log(timestamp=stamp, level=level, message=text, name=name)

        yield _Message(node.start, "/plan", log)
        if node.end is None:
            continue
        failed = node.status in ("FAILED", "ERROR")
        level = kinds.LogLevel.Error if failed else kinds.LogLevel.Info
        text = f"{node.dtype} {node.status}" + (f" {node.reason}: {node.message}" if node.reason else "")

        def ended(stamp: Any, level: Any = level, text: str = text, name: str = node.label) -> Any:
            return kinds.Log(timestamp=stamp, level=level, message=text, name=name)

        yield _Message(node.end, "/plan", ended)


def _vector(kinds: Any, values: tuple[float, ...]) -> Any:
    x, y, z = values
    return kinds.Vector3(x=x, y=y, z=z)


def _rotation(kinds: Any, values: tuple[float, ...]) -> Any:
    x, y, z, w = values
    return kinds.Quaternion(x=x, y=y, z=z, w=w)
