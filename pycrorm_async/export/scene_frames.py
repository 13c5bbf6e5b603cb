"""Turn the changes of an episode's world into frames: one for each object and link, each in that of its parent.

`map` is the frame of the world, `milk` that of the object, `pr2/torso_lift_link` that of a link. A second object of the
same name is `milk#51`, with the event that added it. A joint that moves changes the frame of its child link alone.
"""

from __future__ import annotations

import math
from collections.abc import Iterator, Mapping, Sequence
from typing import Any, NamedTuple

import numpy as np

from pycrorm_async.events.codec import description_of
from pycrorm_async.export.recorded_episode import Change, EventTime, RecordedEpisode
from pycrorm_async.query.reading import Reading
from pycrorm_async.query.scene.link_frames import Frame, joint_frame, link_frames, placed
from pycrorm_async.query.scene.object_model import assumed_model, object_model, point_model
from pycrorm_async.world.pose import Pose

MAP = "map"
REPORTED_CHANGES = 100
"""A writer reports its progress after so many changes or messages: to draw a bar takes longer than to write one."""
_GREY = (0.6, 0.6, 0.6, 1.0)
"""The colour of a shape without one."""


class FrameChange(NamedTuple):
    """A frame has a new pose in its parent: translation (m) and quaternion xyzw."""

    when: EventTime
    parent: str
    child: str
    translation: tuple[float, float, float]
    rotation: tuple[float, float, float, float]


class Shape(NamedTuple):
    """A shape in the frame of a link: kind (box, cylinder, capsule, sphere), sizes (m), pose and colour.

    The sizes of a box are its three edges, of a cylinder and a capsule radius and length, of a sphere the radius.
    """

    kind: str
    sizes: tuple[float, ...]
    translation: tuple[float, float, float]
    rotation: tuple[float, float, float, float]
    color: tuple[float, float, float, float]


class SceneObject:
    """An object of the world with its model.

    Args:
        model: root link, shapes by link, and joints, as `query.scene.object_model.object_model` returns them.
        base_link: the link whose pose is recorded; None means the root link.
        color: of all its shapes; None means each shape's own.

    Attributes:
        name: of its frame.
        parents: the frame that each of its links' frames is in, by link; that of the root link is in the object's own.
        shapes: by frame.
    """

    def __init__(self, name: str, model: Mapping[str, Any], base_link: str | None, color: Any) -> None:
        self.name = name
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

    def changes(self, change: Change, *, is_first: bool) -> Iterator[FrameChange]:
        """Yield the frames that a change of this object gives new poses, and for its first one those of all links.

        Where the recorded pose is that of another link than the root, a joint between the two also moves the root.
        """
        self._joints.update(change.joints)
        if change.pose is not None:
            self._pose = Pose(change.pose[:3], change.pose[3:])
        if change.pose is not None or (self._base_link is not None and change.joints):
            root = link_frames(self._model, self._pose, self._joints, self._base_link)[self._model["root"]]
            yield FrameChange(change.when, MAP, self.name, *_parts(root))
        for joint in self._model["joints"]:
            name, _, parent, child, *_, mimic = joint
            moves = name in change.joints or (mimic is not None and mimic[0] in change.joints)
            if is_first or moves:
                frame = joint_frame(joint, self._joints)
                yield FrameChange(change.when, self.frame(parent), self.frame(child), *_parts(frame))


async def scene_objects(reading: Reading, episode: RecordedEpisode) -> dict[int, SceneObject]:
    """Return the objects of an episode by identity, with their recorded, assumed or missing shapes."""
    log = await reading.log()
    fingerprints = {each.description for each in episode.objects.values() if each.description is not None}
    models: dict[str, Mapping[str, Any]] = {}
    for name, payload in (await log.descriptions(fingerprints)).items():
        try:
            models[name] = object_model(description_of(payload))
        except ValueError as error:
            models[name] = point_model(f"its description cannot be read: {error}")
    objects: dict[int, SceneObject] = {}
    names: set[str] = set()
    for identity, added in episode.objects.items():
        if added.description is None:
            model: Mapping[str, Any] = assumed_model(added.name, added.object_type, set(added.joints))
        else:
            model = models.get(added.description) or point_model("its description is not in the log")
        name = added.name.replace("/", "_")
        name = f"{name}#{identity}" if name in names else name
        names.add(name)
        objects[identity] = SceneObject(name, model, added.base_link, added.color)
    return objects


def frame_changes(episode: RecordedEpisode, objects: Mapping[int, SceneObject]) -> Iterator[FrameChange]:
    """Yield every change of a frame, in the order of the events."""
    seen: set[int] = set()
    for change in episode.changes:
        if not change.removed:
            yield from objects[change.object].changes(change, is_first=change.object not in seen)
            seen.add(change.object)


def _shape(shape: Sequence[Any], color: Sequence[float] | None) -> Shape:
    kind, sizes, xyz, rpy, own = shape
    translation, rotation = _parts(placed(xyz, rpy))
    red, green, blue, opacity = color or own or _GREY
    return Shape(kind, tuple(sizes), translation, rotation, (red, green, blue, opacity))


def _parts(frame: Frame) -> tuple[tuple[float, float, float], tuple[float, float, float, float]]:
    """Return translation and quaternion xyzw of a frame."""
    x, y, z = (float(each) for each in frame[:3, 3])
    return (x, y, z), _quaternion(frame)


def _quaternion(frame: Frame) -> tuple[float, float, float, float]:
    turn = frame[:3, :3]
    # The largest of the four is computed first, because dividing by a small one would lose digits.
    squares = [1 + np.trace(turn), *(1 + 2 * turn[each, each] - np.trace(turn) for each in range(3))]
    largest = int(np.argmax(squares))
    twice = math.sqrt(squares[largest])
    if largest == 0:
        parts = [turn[2, 1] - turn[1, 2], turn[0, 2] - turn[2, 0], turn[1, 0] - turn[0, 1]]
        x, y, z = (float(each) / twice / 2 for each in parts)
        return x, y, z, twice / 2
    first = largest - 1
    second, third = (first + 1) % 3, (first + 2) % 3
    vector = [0.0, 0.0, 0.0]
    vector[first] = twice / 2
    vector[second] = float(turn[second, first] + turn[first, second]) / twice / 2
    vector[third] = float(turn[third, first] + turn[first, third]) / twice / 2
    return vector[0], vector[1], vector[2], float(turn[third, second] - turn[second, third]) / twice / 2
