"""A `RecordedEpisode` is an episode of an executive that is not ours: any thread writes nodes, objects and values."""

from __future__ import annotations

from collections.abc import Hashable, Mapping, Sequence
from enum import Enum
from types import TracebackType
from typing import Literal, Self

from msgspec.structs import replace

from pycrorm_async.events.tags import checked_tags
from pycrorm_async.events.types import ObjectDetected
from pycrorm_async.events.values import (
    ObjectReference,
    PoseValue,
    SeenValue,
)
from pycrorm_async.recording.checked_arguments import pose_of, struct_of
from pycrorm_async.recording.ordered_calls import counted, noted
from pycrorm_async.recording.recorded_nodes import FOREVER_S, RecordedNodes
from pycrorm_async.recording.writing.observing import put_observation
from pycrorm_async.world.pose import Pose


class RecordedEpisode(RecordedNodes):
    """An episode of any executive, from any thread; `Recording.episode` makes it.

    >>> with recording.episode(description="Tutorial") as episode:
    ...     episode.start("a", navigate, {"target_location": Pose([1, 0, 0])})
    ...     episode.end("a")

    Keys are any hashable values, `id(node)` for example; a key can be used again after its node has ended. No method
    raises: values that cannot be recorded are counted in `Memory.status` and logged. `node` is always the key of the
    acting node; None means the root of the episode.
    """

    def __enter__(self) -> Self:
        return self

    def __exit__(
        self, kind: type[BaseException] | None, error: BaseException | None, traceback: TracebackType | None
    ) -> None:
        self.close(error)

    # --- objects ----------------------------------------------------------------------------------------------

    @counted("ObjectAdded")
    def object_added(
        self,
        key: Hashable,
        name: str,
        object_type: str | Enum,
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
        """Record that an object entered the world; for a known key, record its new pose and joints.

        Args:
            key: names the object from now on.
            object_type: `ROBOT`, `MILK`, …; a type of `world.ObjectType` where one fits.
            joints: positions by name, rad or m.
            urdf: the text of its description, which is recorded once.
            color, model, serial, mass_kg, base_link: see `events.types.ObjectAdded`.
            torso_joint: of a robot with a torso that is lifted, the joint that does it.
        """
        added = self._arguments.object_of(
            name, object_type, pose, joints, urdf=urdf, color=color, model=model, serial=serial, mass_kg=mass_kg,
            base_link=base_link, torso_joint=torso_joint,
        )  # fmt: skip
        self._write("ObjectAdded", lambda: self._objects.add(key, added, self._cause(node)))

    @counted("ObjectMoved")
    def object_moved(self, key: Hashable, pose: Pose | PoseValue, *, node: Hashable | None = None) -> None:
        """Record the new pose of an object, unless it is the same."""
        if not self.closed and self._objects.is_at(key, pose):
            return  # before the pose is copied, which takes longer
        copied = pose_of(pose)
        self._write("ObjectMoved", lambda: self._objects.move(self._known(key), copied, self._cause(node)))

    @counted("JointsMoved")
    def joints_moved(self, key: Hashable, joints: Mapping[str, float], *, node: Hashable | None = None) -> None:
        """Record new joint positions (rad or m); only those that changed."""
        copied = self._arguments.joints_of(joints)
        self._write("JointsMoved", lambda: self._objects.turn(self._known(key), copied, self._cause(node)))

    @counted("ObjectAttached")
    def object_attached(
        self, parent: Hashable, child: Hashable, link: str | None = None, *, node: Hashable | None = None
    ) -> None:
        """Record that `child` moves with `link` of `parent` from now on."""
        name = self._arguments.text_of("link", link)

        def write() -> int:
            return self._objects.attach(self._known(parent), self._known(child), name, self._cause(node))

        self._write("ObjectAttached", write)

    @counted("ObjectDetached")
    def object_detached(self, parent: Hashable, child: Hashable, *, node: Hashable | None = None) -> None:
        """Record that `child` no longer moves with `parent`."""

        def write() -> int:
            return self._objects.detach(self._known(parent), self._known(child), self._cause(node))

        self._write("ObjectDetached", write)

    @counted("ObjectRemoved")
    def object_removed(self, key: Hashable, *, node: Hashable | None = None) -> None:
        """Record that an object left the world."""
        self._write("ObjectRemoved", lambda: self._objects.remove(self._known(key), self._cause(node)))

    def reference(self, key: Hashable) -> ObjectReference | None:
        """Return the current row of an object, for values that name it; None if there is none of this key.

        Call it again for each value: the row changes when the object moves and when the episode is continued.
        """
        return noted(self.emitter, "ObjectAdded", self._objects.reference, key)

    # --- observations -----------------------------------------------------------------------------------------

    @counted("Observed")
    def observe(self, name: str, values: object, *, node: Hashable | None = None) -> None:
        """Record an observation, as `Memory.observe` does."""
        copied = self._values.converted(values)

        def write() -> int:
            observer = self.node_or_root(self._find(node, "Observed"))
            return put_observation(self.emitter, self, name, copied, observer, may_refuse=False)

        self._write("Observed", write)

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
        copied = (noted(self.emitter, "ObjectDetected", struct_of, each, SeenValue) for each in seen)
        percepts = [each for each in copied if each is not None]
        event = struct_of(ObjectDetected(source, object_type), ObjectDetected)

        def write() -> int:
            acting = self._find(node, "ObjectDetected")
            number = self.node_or_root(acting) if acting is not None else None
            held = (each if self._objects.holds(each.object) else replace(each, object=None) for each in percepts)
            return self._put_detection(replace(event, seen=tuple(held), node=number))

        self._write("ObjectDetected", write)

    @counted("EpisodeTagged")
    def tag(self, *tags: str, remove: Sequence[str] = ()) -> None:
        """Add and remove tags."""
        added, removed = checked_tags(tags), checked_tags(remove)

        def write() -> int:
            super(RecordedNodes, self).change_tags(added, removed)
            return 0

        self._write("EpisodeTagged", write)

    @counted("EpisodeStarted")
    def wait_for_room(self, timeout_s: float | None = None) -> bool:
        """Block while the spool is full, for a limited time; return whether it has room now.

        `start` waits by itself, without a limit; so this is for an executive that has something else to do then.
        """
        sink = self.emitter.sink
        has_room = not sink.full or sink.block_until_room(FOREVER_S if timeout_s is None else timeout_s, reserved=False)
        return has_room and not self.emitter.is_closed
