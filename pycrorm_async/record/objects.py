"""`ObjectRows` writes the events of an episode's objects and keeps each object's current row.

Theory of operation. The sequence of an object's `ObjectAdded` identifies the object; the sequence of its latest
`ObjectAdded` or `ObjectMoved` is its current row. `K` is whatever the executive identifies an object by.

A change of the world must not fail because of a memory, so `_put` catches and counts every exception; the object then
keeps its former row. An object whose `ObjectAdded` failed has no row, and its later changes are not recorded, because
an event that names an object without a row would be damage.
"""

from collections.abc import Callable, Hashable, Iterator, Mapping
from dataclasses import dataclass, field
from sys import intern
from typing import Any, Generic, TypeVar

from msgspec.structs import replace

from pycrorm_async.events import types as event_types
from pycrorm_async.events.codec import NotEncodable, encoded
from pycrorm_async.record.episode_writer import ActingRobot, EpisodeWriter
from pycrorm_async.record.frames import FramePlaces
from pycrorm_async.record.values import PoseLike, recorded_as

K = TypeVar("K", bound=Hashable)


class ObjectRows(Generic[K]):
    """The rows of one episode's objects.

    Attributes:
        last: sequence of the last event it recorded; 0 before the first.
    """

    def __init__(self, episode: EpisodeWriter) -> None:
        self.last = 0
        self._episode = episode
        self._emitter = episode.emitter
        self._references: dict[K, event_types.ObjectReference] = {}
        self._placed: dict[int, tuple[int, event_types.PoseValue]] = {}
        """The current row of each object and the pose in it, by identity."""

    def reference(self, key: K) -> event_types.ObjectReference | None:
        """Return the current row of an object; None if there is none of this key."""
        return self._references.get(key)

    def _put_removed(self, key: K, node: int | None) -> int:
        reference = self._references.pop(key, None)
        if reference is None:
            return 0
        self._placed.pop(reference.object, None)
        return self._put(lambda: event_types.ObjectRemoved(reference, node))

    def _put_joints(self, key: K, positions: Mapping[str, float], node: int | None) -> int:
        reference = self._references.get(key)
        return (
            self._put(lambda: event_types.JointsMoved(reference, dict(positions), node)) if reference is not None else 0
        )

    def _put_attachment(
        self,
        kind: type[event_types.ObjectAttached | event_types.ObjectDetached],
        parent: K,
        child: K,
        link: str | None,
        node: int | None,
    ) -> int:
        first, second = self._references.get(parent), self._references.get(child)
        return self._put(lambda: kind(first, second, link, node)) if first is not None and second is not None else 0

    def _put(
        self, build: Callable[[], event_types.Happening], *, row_of: K | None = None, identity: int | None = None
    ) -> int:
        """Build and record an event; return its sequence. Exceptions are counted, so that the change succeeds; 0 then.

        The event becomes the current row of the object `row_of`, and its identity too if `identity` is None.
        """
        if self._emitter.is_closed:
            return 0
        try:
            event = build()
            self.last = sequence = self._episode.events.put(event)
        except Exception as error:  # noqa: BLE001  a change of the world must not fail because of a memory
            self._emitter.note_fault("a change of the world", error)
            return 0
        if row_of is not None and isinstance(event, event_types.ObjectAdded | event_types.ObjectMoved):
            own = sequence if identity is None else identity
            self._references[row_of] = event_types.ObjectReference(own, sequence)
            self._placed[own] = sequence, event.pose
        return sequence

    def acting(self, state: event_types.RobotValue) -> ActingRobot:
        """Return the state of a robot as a node that starts now is written with it."""
        pose, reference, written = state.pose, state.object, state
        if pose is not None:
            row, placed = self._placed.get(reference.object, (0, pose)) if reference is not None else (0, pose)
            is_current = reference is not None and reference.row == row
            is_in_row = is_current and placed.time_ns == pose.time_ns and _are_at_one_place(placed, pose)
            written_pose = None if is_in_row else event_types.BriefPose.of(pose)
            written = replace(state, pose=written_pose, object_type=intern(state.object_type))
        try:
            return ActingRobot(state, encoded(written))
        except NotEncodable:  # the episode leaves out what cannot be recorded
            return ActingRobot(state, written)


# === recorded objects =========================================================================================
#
# `RecordedObjects` writes the objects of an episode whose executive reports them by keys of its own, and keeps the last
# reported state of each.


@dataclass(slots=True)
class RecordedObject:
    """An object as it was last reported: pose and joints as they are now, the rest as it was added.

    `torso_joint` is the joint whose position is the torso height, of a robot.
    """

    name: str
    object_type: str
    pose: event_types.PoseValue
    joints: dict[str, float] = field(default_factory=dict)
    urdf: str | None = None
    color: tuple[float, float, float, float] | None = None
    model: str | None = None
    serial: str | None = None
    mass_kg: float | None = None
    base_link: str | None = None
    torso_joint: str | None = None


class RecordedObjects(ObjectRows[Hashable]):
    """The objects of one episode; `frames` are the places of their frames, and of others that the executive states."""

    def __init__(self, episode: EpisodeWriter) -> None:
        super().__init__(episode)
        self._objects: dict[Hashable, RecordedObject] = {}
        self._attached: dict[tuple[Hashable, Hashable], str | None] = {}
        self._identities: set[int] = set()
        self.frames = FramePlaces()

    def holds(self, reference: event_types.ObjectReference | None) -> bool:
        """Return whether this episode has such a row; True for None."""
        if reference is None:
            return True
        return reference.object in self._identities and reference.object <= reference.row <= self.last

    def names(self) -> Iterator[str]:
        """Yield the names of the objects."""
        return (each.name for each in self._objects.values())

    def robot(self, key: Hashable) -> event_types.RobotValue | None:
        """Return the state of the object as that of the acting robot; None if there is none of this key."""
        state = self._objects.get(key)
        if state is None:
            return None
        torso = state.joints.get(state.torso_joint) if state.torso_joint is not None else None
        return event_types.RobotValue(state.pose, state.object_type, torso, self._references.get(key), state.name)

    def is_at(self, key: Hashable, pose: Any) -> bool:
        """Return whether the last pose of an object is this one; False if no object has this key."""
        state = self._objects.get(key)
        return (
            state is not None
            and (isinstance(pose, event_types.PoseValue) or recorded_as(type(pose)) == "pose")
            and _are_at_one_place(state.pose, pose)
        )

    def add(self, key: Hashable, added: RecordedObject, node: int | None) -> int:
        """Write that an object entered the world; for a known key, write its new pose and joints."""
        if key in self._references:
            return max(self.move(key, added.pose, node), self.turn(key, added.joints, node))
        added.pose = self.frames.in_map(added.pose)
        sequence = self._put(
            lambda: event_types.ObjectAdded(
                added.name,
                added.object_type,
                event_types.BriefPose.of(added.pose),
                dict(added.joints),
                node,
                self._emitter.descriptions.declare_text(added.urdf) if added.urdf is not None else None,
                added.color,
                added.model,
                added.serial,
                added.mass_kg,
                added.base_link,
            ),
            row_of=key,
        )
        if sequence:
            self._objects[key] = added
            self.frames.place(added.name, added.pose)
            self._identities.add(sequence)
        return sequence

    def move(self, key: Hashable, pose: event_types.PoseValue, node: int | None) -> int:
        """Write a new pose of an object, if it has changed."""
        state, reference = self._objects[key], self._references[key]
        last, pose = state.pose, self.frames.in_map(pose)
        if _are_at_one_place(pose, last):
            return 0
        sequence = self._put(
            lambda: event_types.ObjectMoved(
                reference.object, state.name, state.object_type, event_types.BriefPose.of(pose), node
            ),
            row_of=key,
            identity=reference.object,
        )
        state.pose = pose if sequence else last
        self.frames.place(state.name, state.pose)
        return sequence

    def turn(self, key: Hashable, positions: Mapping[str, float], node: int | None) -> int:
        """Write those joint positions of an object that have changed."""
        joints = self._objects[key].joints
        changed = {name: each for name, each in positions.items() if joints.get(name) != each}
        sequence = self._put_joints(key, changed, node) if changed else 0
        if sequence:
            joints.update(changed)
        return sequence

    def attach(self, parent: Hashable, child: Hashable, link: str | None, node: int | None) -> int:
        """Write that `child` moves with `parent`."""
        self._attached[parent, child] = link
        return self._put_attachment(event_types.ObjectAttached, parent, child, link, node)

    def detach(self, parent: Hashable, child: Hashable, node: int | None) -> int:
        """Write that `child` no longer moves with `parent`."""
        link = self._attached.pop((parent, child), None)
        return self._put_attachment(event_types.ObjectDetached, parent, child, link, node)

    def remove(self, key: Hashable, node: int | None) -> int:
        """Write that an object left the world."""
        self._objects.pop(key, None)
        self._attached = {pair: link for pair, link in self._attached.items() if key not in pair}
        return self._put_removed(key, node)


def _are_at_one_place(pose: PoseLike | event_types.PoseValue, other: PoseLike | event_types.PoseValue) -> bool:
    return pose.position == other.position and pose.orientation == other.orientation and pose.frame == other.frame
