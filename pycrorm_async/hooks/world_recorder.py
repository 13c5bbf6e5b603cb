"""Turns the changes of one world into events of one episode, and knows which row of each object is in force.

An object's identity is the sequence of its `ObjectAdded`; its row in force that of its latest `ObjectAdded` or
`ObjectMoved`. Nothing here raises: the world's setters never fail because of a memory.
"""

from __future__ import annotations

import sys
from collections.abc import Callable, Mapping

from pycrorm_async.events.codec import NotEncodable
from pycrorm_async.events.ids import EpisodeId
from pycrorm_async.events.types import (
    Happening,
    JointsMoved,
    ObjectAdded,
    ObjectAttached,
    ObjectDetached,
    ObjectMoved,
    ObjectReference,
    ObjectRemoved,
    PoseValue,
    RobotValue,
)
from pycrorm_async.hooks.emitter import Emitter
from pycrorm_async.hooks.values.event_fitting import clean_texts
from pycrorm_async.hooks.values.texts import clean
from pycrorm_async.hooks.values.value_snapshot import pose_value
from pycrorm_async.plan.task_tree import current_node
from pycrorm_async.world.bullet import BulletWorld
from pycrorm_async.world.objects import Object
from pycrorm_async.world.pose import Pose
from pycrorm_async.world.world_copy import counterpart, related

__all__ = ["WorldRecorder"]


class WorldRecorder:
    """The observer of one world for one episode; begins with `ObjectAdded` for all that is there.

    Attributes:
        sampled: by robot, what the episode's samples of its state said last, channel by channel.
        last: the sequence of what it recorded last.
        continue_at: a change that gets this sequence, or a later one, calls `continue_`.
    """

    def __init__(
        self, emitter: Emitter, episode: EpisodeId, world: BulletWorld, continue_: Callable[[], None] = lambda: None
    ) -> None:
        self.world = world
        self.last = 0
        self.continue_at = sys.maxsize  # not before all that is there was recorded
        self.continue_ = continue_
        self.sampled: dict[Object, dict[str, float]] = {}
        self._emitter = emitter
        self._episode = episode
        self._references: dict[Object, ObjectReference] = {}
        self._robot_pose: tuple[Pose, PoseValue] | None = None
        for each in world.objects:
            self.object_added(each)
        for each in world.objects:
            for child, link in each.attachments.items():
                self.object_attached(each, child, link)
        world.observe(self)

    def empty(self) -> None:
        """The world is gone, and so is all that was in it."""
        self.continue_at = sys.maxsize  # a follow-up would begin with what is being removed
        for each in tuple(self._references):
            self.object_removed(each)

    def stop(self) -> None:
        """Look no longer; references stay readable."""
        self.world.unobserve(self)

    def reference(self, world_object: Object) -> ObjectReference | None:
        """The row in force of this object, or of what stands for it in this world; None if there is nothing."""
        found = self._references.get(world_object)
        if found is None and world_object.world is not self.world and related(world_object.world, self.world):
            here = counterpart(world_object, self.world)
            found = self._references.get(here) if here is not None else None
        return found

    def robot(self) -> RobotValue | None:
        """Base pose and torso height of the robot now; None without a robot."""
        robot = self.world.robot
        if robot is None:
            return None
        pose = robot.pose
        if self._robot_pose is None or self._robot_pose[0] is not pose:
            self._robot_pose = (pose, pose_value(pose))
        description = robot.robot_description
        torso = description.torso_joint if description is not None else None
        return RobotValue(
            self._robot_pose[1],
            robot.object_type.name,
            robot.joint_position(torso) if torso is not None else None,
            self._references.get(robot),
        )

    # --- the world's observer ---------------------------------------------------------------------------------

    def object_added(self, added: Object) -> None:
        self._put(
            lambda: ObjectAdded(
                clean(added.name),
                added.object_type.name,
                pose_value(added.pose),
                dict(added.joint_positions()),
                self._node(),
            ),
            row_of=added,
        )

    def object_removed(self, removed: Object) -> None:
        reference = self._references.pop(removed, None)
        if reference is not None:
            self._put(lambda: ObjectRemoved(reference, self._node()))

    def object_moved(self, moved: Object) -> None:
        reference = self._references.get(moved)
        if reference is None:
            return
        self._put(
            lambda: ObjectMoved(
                reference.object, clean(moved.name), moved.object_type.name, pose_value(moved.pose), self._node()
            ),
            row_of=moved,
            identity=reference.object,
        )

    def joints_moved(self, moved: Object, positions: Mapping[str, float]) -> None:
        reference = self._references.get(moved)
        if reference is not None:
            self._put(lambda: JointsMoved(reference, dict(positions), self._node()))

    def object_attached(self, parent: Object, child: Object, link: str | None) -> None:
        pair = self._pair(parent, child)
        if pair is not None:
            self._put(lambda: ObjectAttached(*pair, link, self._node()))

    def object_detached(self, parent: Object, child: Object, link: str | None) -> None:
        pair = self._pair(parent, child)
        if pair is not None:
            self._put(lambda: ObjectDetached(*pair, link, self._node()))

    def _pair(self, parent: Object, child: Object) -> tuple[ObjectReference, ObjectReference] | None:
        first, second = self._references.get(parent), self._references.get(child)
        return (first, second) if first is not None and second is not None else None

    def _node(self) -> int | None:
        """The node that caused the change: the innermost recorded one of this context, if it is of this episode."""
        node = current_node.get()
        while node is not None and node.record is None:
            node = node.parent
        if node is not None and node.record.part == self._episode:
            sequence: int = node.record.sequence
            return sequence
        return None

    def _put(self, made: Callable[[], Happening], *, row_of: Object | None = None, identity: int | None = None) -> None:
        """Make the event and record it; a fault is counted, and the world's setter goes on.

        The event is the row in force of the object `row_of`, whose identity is this one, or the event itself.
        """
        if self._emitter.over:
            return
        try:
            event = made()
            try:
                sequence = self._emitter.put(self._episode, event)
            except NotEncodable as unencodable:
                self._emitter.missing.note(type(event).__name__, "value", str(unencodable))
                sequence = self._emitter.put(self._episode, clean_texts(event))
            self.last = sequence
        except Exception as error:  # noqa: BLE001  a world's setter never fails because of a memory
            self._emitter.note_fault("a change of the world", error)
            return
        if row_of is not None:
            self._references[row_of] = ObjectReference(sequence if identity is None else identity, sequence)
        if sequence >= self.continue_at:
            self.continue_()
