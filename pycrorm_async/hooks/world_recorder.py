"""The `WorldRecorder` turns changes of one world into events of one episode and keeps each object's current row.

Theory of operation. The world calls its observer synchronously from its setters, in the thread of the plan. Each call
builds one event and puts it into the queue at once, so the values are those of that moment and the events have the
order of the changes. The rows of the objects, and what happens if an event cannot be written, are those of
`ObjectRows`.

The recorder starts with `ObjectAdded` and `ObjectAttached` for the present state of the world. A change whose sequence
reaches `continue_at` calls `continue_` after it has been recorded; that replaces this recorder by one for the follow-up
episode. While the present state is recorded, and while `empty` removes the objects, no sequence reaches `continue_at`,
because the follow-up would start with the state of an incomplete world.
"""

from __future__ import annotations

import math
import sys
from collections.abc import Callable, Mapping

from pycrorm_async.events.ids import EpisodeId
from pycrorm_async.events.types import (
    ObjectAdded,
    ObjectAttached,
    ObjectDetached,
    ObjectMoved,
)
from pycrorm_async.events.values import ObjectReference, PoseValue, RobotValue
from pycrorm_async.plan.task_tree import current_node
from pycrorm_async.recording.values.texts import clean
from pycrorm_async.recording.values.value_snapshot import pose_value
from pycrorm_async.recording.writing.emitter import Emitter
from pycrorm_async.recording.writing.object_rows import ObjectRows
from pycrorm_async.world.bullet import BulletWorld
from pycrorm_async.world.objects import Object
from pycrorm_async.world.pose import Pose
from pycrorm_async.world.robots.acting_robot import acting_robot
from pycrorm_async.world.world_copy import counterpart, related


class WorldRecorder(ObjectRows[Object]):
    """Observes one world for one episode; the constructor records the present state of the world.

    Attributes:
        world: the observed world.
        sampled: for each robot, the last sampled value of each channel in this episode.
    """

    def __init__(
        self, emitter: Emitter, episode: EpisodeId, world: BulletWorld, continue_: Callable[[], None] = lambda: None
    ) -> None:
        super().__init__(emitter, episode, continue_)
        self.world = world
        self.sampled: dict[Object, dict[str, float]] = {}
        self._robots: dict[Object, tuple[Pose, PoseValue, str]] = {}
        for each in world.objects:
            self.object_added(each)
        for each in world.objects:
            for child, link in each.attachments.items():
                self.object_attached(each, child, link)
        world.observe(self)

    def empty(self) -> None:
        """Record that all objects were removed, because the world was closed."""
        self.continue_at = sys.maxsize  # a follow-up would start with objects that are being removed
        for each in tuple(self._references):
            self.object_removed(each)

    def stop(self) -> None:
        """Stop observing the world; `reference` still works."""
        self.world.unobserve(self)

    def reference(self, world_object: Object) -> ObjectReference | None:
        """Return the current row of this object, or of its counterpart if it is in a copy of this world; else None."""
        row = self._references.get(world_object)
        if row is None and world_object.world is not self.world and related(world_object.world, self.world):
            local_object = counterpart(world_object, self.world)
            row = self._references.get(local_object) if local_object is not None else None
        return row

    def robot(self) -> RobotValue | None:
        """Return base pose and torso height of the robot that acts in this context; None without a robot."""
        robot = acting_robot(self.world)
        if robot is None:
            return None
        pose = robot.pose
        recorded = self._robots.get(robot)
        if recorded is None or recorded[0] is not pose:
            self._robots[robot] = recorded = (pose, pose_value(pose), clean(robot.name))
        description = robot.robot_description
        torso = description.torso_joint if description is not None else None
        return RobotValue(
            recorded[1],
            robot.object_type._name_,  # `name` takes 0.1 µs longer
            robot.joint_position(torso) if torso is not None else None,
            self._references.get(robot),
            recorded[2],
        )

    # --- the world's observer ---------------------------------------------------------------------------------

    def object_added(self, added: Object) -> None:
        self._put(
            lambda: ObjectAdded(
                clean(added.name),
                added.object_type.name,
                pose_value(added.pose),
                dict(added.joint_positions()),
                self._causing_node(),
                self._emitter.descriptions.declare(added),
                self._color(added),
                *_model(added),
                added.mass_kg,
                clean(added.base_link) or None,
            ),
            row_of=added,
        )

    def _color(self, added: Object) -> tuple[float, float, float, float] | None:
        if added.color is None:
            return None
        red, green, blue, opacity = map(float, added.color)
        if not all(map(math.isfinite, (red, green, blue, opacity))):
            self._emitter.missing.note("ObjectAdded", "color", f"{added.color} is not finite")
            return None
        return red, green, blue, opacity

    def object_removed(self, removed: Object) -> None:
        self._robots.pop(removed, None)
        self._put_removed(removed, self._causing_node)

    def object_moved(self, moved: Object) -> None:
        reference = self._references.get(moved)
        if reference is None:
            return
        self._put(
            lambda: ObjectMoved(
                reference.object,
                clean(moved.name),
                moved.object_type.name,
                pose_value(moved.pose),
                self._causing_node(),
            ),
            row_of=moved,
            identity=reference.object,
        )

    def joints_moved(self, moved: Object, positions: Mapping[str, float]) -> None:
        self._put_joints(moved, positions, self._causing_node)

    def object_attached(self, parent: Object, child: Object, link: str | None) -> None:
        self._put_attachment(ObjectAttached, parent, child, link, self._causing_node)

    def object_detached(self, parent: Object, child: Object, link: str | None) -> None:
        self._put_attachment(ObjectDetached, parent, child, link, self._causing_node)

    def _causing_node(self) -> int | None:
        """Return the node that caused a change: the context's innermost recorded node, if this episode recorded it."""
        node = current_node.get()
        while node is not None and node.record is None:
            node = node.parent
        if node is not None and node.record.episode_id == self._episode:
            sequence: int = node.record.sequence
            return sequence
        return None


def _model(added: Object) -> tuple[str | None, str | None]:
    """Return model and serial of a robot; None for other objects, and for each that its description lacks."""
    described = added.robot_description
    if described is None:
        return None, None
    return clean(described.name), clean(described.serial) if described.serial is not None else None
