"""An `Episode` records one open episode of our own plan layer: its nodes, its world and its percepts.

Theory of operation. Starts of nodes, observations and changes of the world reach an episode in the thread of the plan,
through `Recorder` and `WorldRecorder`. Ends of nodes do so too, except when a plan is dropped unfinished: then the
garbage collector closes its coroutines and thereby ends its nodes, in any thread and between any two of that thread's
bytecodes. The sampler's thread reads `id` and `world`.
"""

from __future__ import annotations

import math
from collections.abc import Mapping, Sequence
from typing import Final, Literal, NamedTuple

from pycrorm_async.events.codec import NotEncodable
from pycrorm_async.events.ids import EpisodeId
from pycrorm_async.events.types import (
    CandidateValue,
    CellsValue,
    LocationResolved,
    NodeEnded,
    NodeReference,
    NodeStatus,
    ObjectAdded,
    ObjectAttached,
    ObjectDetached,
    ObjectDetected,
    ObjectMoved,
    ObjectReference,
    PoseValue,
    RefusalValue,
    RobotValue,
    SeenValue,
)
from pycrorm_async.plan.execution import CalledPerforms, Candidate, Cells, Refusal, Seen
from pycrorm_async.plan.language import Designator
from pycrorm_async.plan.objects import ObjectDesignator
from pycrorm_async.plan.task import TaskTreeNode, current_node
from pycrorm_async.record.episode_writer import UNAWAITED_MAX, Emitter, EpisodeOpening, EpisodeWriter, current_task
from pycrorm_async.record.objects import ObjectRows
from pycrorm_async.record.parameters import DeclaredType, episode_text_of, fit_resolution, read_parameters
from pycrorm_async.record.values import References, clean, encode_or_missing, failure_value, pose_value
from pycrorm_async.world.bullet import BulletWorld, Object, current_world
from pycrorm_async.world.pose import ObjectType, Pose
from pycrorm_async.world.world_copy import acting_robot, counterpart, related


class NodeRecord(NamedTuple):
    """The hooks' record of a running node, kept as `TaskTreeNode.record`.

    Attributes:
        episode: the episode that recorded the node.
        sequence: sequence of the node's NodeStarted; its id.
        implicit: whether the episode was opened for this node alone and ends with it.
        outer_episode: the current episode of the context before the node started.
    """

    episode: Episode
    sequence: int
    implicit: bool
    outer_episode: Episode | None


class Episode(EpisodeWriter[TaskTreeNode]):
    """An open or closed episode of our own plan layer.

    Attributes:
        task: the asyncio task that opened the episode; None outside any task.
        world: the recorder of its world; None without a world.
        faults: faults of the plan, each type once: performs that were never awaited.
        calls: performs called in the episode's context.
    """

    def __init__(
        self,
        emitter: Emitter,
        episode: EpisodeId,
        opening: EpisodeOpening,
    ) -> None:
        super().__init__(emitter, episode, opening)
        self.task = current_task()
        self.world: WorldRecorder | None = None
        self.faults: tuple[str, ...] = ()
        self.calls: Final = CalledPerforms(self._note_unawaited)
        self._entered_world: str | None = None

    # --- world ------------------------------------------------------------------------------------------------

    def enter_world(self, world: BulletWorld) -> None:
        """Record this world from now on. A second world at the same time is not recorded, but counted as missing."""
        if self.world is None:
            self.world = WorldRecorder(self.emitter, self.id, world)
        elif self.world.world is not world:
            self.emitter.missing.note("Episode", "second world", f"{self} records only the world entered first")

    @property
    def acts_in_recorded_world(self) -> bool:
        """True if the current world of this context is the recorded world, not a second one."""
        if self.world is None:
            return False
        current = current_world.get()
        return current is None or current is self.world.world

    def leave_world(self, world: BulletWorld, *, emptied: bool) -> None:
        """Stop recording this world; with `emptied`, record first that all its objects were removed."""
        if self.world is not None and self.world.world is world:
            self._described_world()
            if emptied:
                self.world.empty()
            self.world.stop()
            self.world = None

    def reference(self, world_object: Object) -> ObjectReference | None:
        """Return the object's current row in this episode; None without a row."""
        return self.world.reference(world_object) if self.world is not None else None

    def node_reference(self, node: TaskTreeNode | None) -> NodeReference:
        """Return a reference to this node, or to its nearest recorded ancestor; None gives the root."""
        return NodeReference(str(self), self.node_or_root(node))

    # --- nodes ------------------------------------------------------------------------------------------------

    def start_node(self, node: TaskTreeNode, declared: DeclaredType) -> int:
        """Write the start of a node and return its sequence.

        Raises `Unrecordable` for a parameter, with `on_unrecordable="refuse"` only.
        """
        assert node.designator is not None
        missing: dict[str, str] = {}
        parent = self._sequence_of(node.parent) or self._root
        parameters = read_parameters(node.designator, declared, self, missing)
        return self._put_start(
            node, declared, node.kind, parent, parameters, self._robot_state(),
            missing=missing, may_refuse=True,
        )  # fmt: skip

    def end_node(self, node: TaskTreeNode) -> None:
        """Write the end of a node."""
        record: NodeRecord = node.record
        try:
            self._ending.add(node)  # before the removal, so that no thread that misses the node ends the episode
            if self._open_nodes.get(record.sequence) is node:
                failure = failure_value(node.failure, self) if node.failure is not None else None
                result = encode_or_missing(node.result, self) if node.result is not None else None
                status: NodeStatus = node.status._value_  # `value` takes 0.1 µs longer
                assert node.designator is not None
                self._close_node(NodeEnded(record.sequence, status, failure, result), node.designator.__dtype__)
        finally:
            self._ending.discard(node)

    def record_location(
        self, *, location: str, offered: tuple[Candidate, ...], taken: int | None, considered: int,
        refused: tuple[Refusal, ...], offered_beyond: int, cells: Cells | None, node: TaskTreeNode | None,
    ) -> int:  # fmt: skip
        """Write the places that a location designator offered, took and refused; return the sequence."""
        number = self._sequence_of(node)
        resolved = location_resolved(
            location, offered, taken=taken, considered=considered, refused=refused, offered_beyond=offered_beyond,
            cells=cells, node=number,
        )  # fmt: skip
        try:
            return self.emitter.put(self.id, resolved)
        except NotEncodable as error:
            fitted = fit_resolution(resolved, self.emitter.settings.record_bytes_max)
            shortened = "offered" if len(fitted.offered) < len(resolved.offered) else "refused"
            self.emitter.missing.note(resolved.location, shortened, error.reason)
            return self.emitter.put(self.id, fitted)

    def record_detection(
        self, *, source: Literal["camera", "world_state"], object_type: ObjectType | None, seen: tuple[Seen, ...],
        node: TaskTreeNode | None,
    ) -> int:  # fmt: skip
        """Write the request to perception and its result; return the sequence."""
        return self._put_detection(object_detected(source, object_type, seen, self, node=self._sequence_of(node)))

    # --- the end ----------------------------------------------------------------------------------------------

    def end_episode(self, failure: BaseException | None) -> None:
        """Write the end of the episode, after reporting performs that were never awaited."""
        if not self.closed:
            self.calls.close()
        super().end_episode(failure)

    def _leave_world(self) -> None:
        if self.world is not None:
            self.leave_world(self.world.world, emptied=False)

    def _described_world(self) -> str | None:
        """Return the description of the world that was entered inside the episode; None if none was."""
        if self.world is not None and self._opening.world is None:
            self._entered_world = episode_text_of(self.world.world.description)
        return self._entered_world

    def _note_unawaited(self, designator: type[Designator]) -> None:
        self.emitter.note_unawaited(designator.__dtype__)
        fault = f"{designator.__dtype__}.perform() was called and never awaited"
        if fault not in self.faults:
            self.faults = (*self.faults[1 - UNAWAITED_MAX :], fault)

    # --- inside -----------------------------------------------------------------------------------------------

    def node_or_root(self, node: TaskTreeNode | None) -> int:
        """Return the sequence of this node or of its nearest recorded ancestor; None gives the root."""
        return self._sequence_of(node) or self._root

    def _sequence_of(self, node: TaskTreeNode | None) -> int | None:
        """Return the sequence of the node, or of its nearest ancestor that this episode recorded; else None."""
        while node is not None:
            record: NodeRecord | None = node.record
            if record is not None and record.episode is self:
                return record.sequence
            node = node.parent
        return None

    def _robot_state(self) -> RobotValue | None:
        if self.world is None:
            return None
        current = current_world.get()
        if current is not self.world.world and current is not None:
            self.emitter.missing.note("Episode", "robot of a second world", "the episode records only the first world")
            return None
        try:
            return self.world.robot()
        except Exception as error:  # noqa: BLE001  the node is recorded without the robot's state
            self.emitter.note_fault("robot state", error)
            return None


# === episode events ===========================================================================================
#
# Build the events of resolved locations and of perception from values of the plan.


def location_resolved(
    location: str, offered: Sequence[Candidate], *, taken: int | None, considered: int, refused: Sequence[Refusal],
    offered_beyond: int, cells: Cells | None, node: int | None,
) -> LocationResolved:  # fmt: skip
    """Build the event of a resolved location designator; `node` is the sequence of the node that resolved it."""
    return LocationResolved(
        location=clean(location),
        offered=tuple(
            CandidateValue(
                pose_value(each.pose),
                tuple(arm.name for arm in each.arms),
                each.grasp.name if each.grasp is not None else None,
                each.torso_height,
            )
            for each in offered
        ),
        taken=taken,
        considered=considered,
        node=node,
        refused=tuple(RefusalValue(pose_value(each.pose), clean(each.reason)) for each in refused),
        offered_beyond=offered_beyond,
        cells=CellsValue(cells.occupied, cells.hidden, cells.free) if cells is not None else None,
    )


def object_detected(
    source: Literal["camera", "world_state"],
    object_type: ObjectType | None,
    seen: Sequence[Seen],
    references: References,
    *,
    node: int | None,
) -> ObjectDetected:
    """Build the event of a result of perception; `node` is the sequence of the node that requested it."""
    values = tuple(_seen_value(each, references) for each in seen)
    return ObjectDetected(source, object_type.name if object_type is not None else None, values, node)


def _seen_value(seen: Seen, references: References) -> SeenValue:
    thing = seen.thing
    world_object = thing.world_object if isinstance(thing, ObjectDesignator) else thing
    return SeenValue(  # perception often computes numbers of numpy
        clean(thing.name),
        thing.object_type.name,
        pose_value(seen.pose if seen.pose is not None else thing.pose),
        references.reference(world_object) if world_object is not None else None,
        float(seen.visible) if seen.visible is not None else None,
        float(seen.confidence) if seen.confidence is not None else None,
        clean(seen.source) if seen.source is not None else None,
    )


# === world recorder ===========================================================================================
#
# The `WorldRecorder` turns changes of one world into events of one episode and keeps each object's current row.
#
# Theory of operation. The world calls its observer synchronously from its setters, in the thread of the plan. Each call
# builds one event and puts it into the queue at once, so the values are those of that moment and the events have the
# order of the changes. The rows of the objects, and what happens if an event cannot be written, are those of
# `ObjectRows`.
#
# The recorder starts with `ObjectAdded` and `ObjectAttached` for the present state of the world.


class WorldRecorder(ObjectRows[Object]):
    """Observes one world for one episode; the constructor records the present state of the world.

    Attributes:
        world: the observed world.
        sampled: for each robot, the last sampled value of each channel in this episode.
    """

    def __init__(self, emitter: Emitter, episode: EpisodeId, world: BulletWorld) -> None:
        super().__init__(emitter, episode)
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
        if node is not None and node.record.episode.id == self._episode:
            sequence: int = node.record.sequence
            return sequence
        return None


def _model(added: Object) -> tuple[str | None, str | None]:
    """Return model and serial of a robot; None for other objects, and for each that its description lacks."""
    described = added.robot_description
    if described is None:
        return None, None
    return clean(described.name), clean(described.serial) if described.serial is not None else None
