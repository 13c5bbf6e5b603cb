"""The fold behind as-of: one event after the other into the state of a task tree and a world.

Pure, and as large as what it tells. StateSampled changes nothing: every pose and joint that a sample repeats had an
event of its own when it was set, which is exact, while a sample may be older than the event before it.
"""

from __future__ import annotations

from collections.abc import Iterator, Mapping
from dataclasses import dataclass, field
from datetime import UTC, datetime, timedelta
from typing import Any

from pycrorm_async.errors import LogDamaged
from pycrorm_async.events.ids import SLOT_NODE, row_id
from pycrorm_async.events.types import (
    EpisodeEnded,
    EpisodeStarted,
    FailureValue,
    Happening,
    JointsMoved,
    NodeEnded,
    NodeStarted,
    ObjectAdded,
    ObjectAttached,
    ObjectDetached,
    ObjectMoved,
    ObjectRemoved,
    PoseValue,
)
from pycrorm_async.projections.fold.fold import CannotFold, happening_of
from pycrorm_async.query.snapshot import Moment, NodeThen, ObjectThen, RobotThen, WorldThen
from pycrorm_async.store.stored import StoredEvent
from pycrorm_async.world.pose import MalformedPose, Pose
from pycrorm_async.world.robots.robot_description import robot_description

__all__ = ["MomentFold"]

_CHANGE_NOTHING = frozenset({"LocationResolved", "ObjectDetected", "StateSampled"})
_EPOCH = datetime(1970, 1, 1, tzinfo=UTC)


@dataclass(slots=True)
class _Node:
    """What is told of a node: of large parameters there is one copy, of the robot and of results none."""

    kind: str
    parent: int | None
    designator: str | None
    parameters: dict[str, Any]
    simulated: bool
    wall_ns: int
    monotonic_ns: int
    status: str = "RUNNING"
    ended_ns: int | None = None
    failure: FailureValue | None = None


@dataclass(slots=True)
class _Thing:
    """An object in the world: `row` is the sequence of the event that put it where it is."""

    name: str
    object_type: str
    pose: PoseValue
    row: int
    joints: dict[str, float] = field(default_factory=dict)
    attached_to: tuple[int, str | None] | None = None


class MomentFold:
    """An episode after the events it has read.

    Attributes:
        first: its first event; None before that is read.
    """

    def __init__(self, number: int, identity: str) -> None:
        self.number = number
        self.id = identity
        self.first: StoredEvent | None = None
        self._started: EpisodeStarted | None = None
        self._last: StoredEvent | None = None
        self._status = "RUNNING"
        self._nodes: dict[int, _Node] = {}
        self._things: dict[int, _Thing] = {}
        self._names: dict[int, str] = {}
        """Of every object that ever was there."""

    def read(self, event: StoredEvent) -> None:
        """The next event. Raises `CannotFold`."""
        if self.first is None and event.type != "EpisodeStarted":
            raise CannotFold(f"the episode has not started, and begins with {event.type}")
        if event.type not in _CHANGE_NOTHING:
            self._happened(event, happening_of(event))
        self.first = event if self.first is None else self.first
        self._last = event

    def _happened(self, event: StoredEvent, happening: Happening) -> None:
        match happening:
            case NodeStarted():
                if happening.parent is not None and happening.parent not in self._nodes:
                    raise CannotFold(f"its parent {happening.parent} never started")
                self._nodes[event.sequence] = _Node(
                    happening.kind,
                    happening.parent,
                    happening.designator,
                    happening.parameters,
                    happening.simulated,
                    event.wall_ns,
                    event.monotonic_ns,
                )
            case NodeEnded():
                if (node := self._nodes.get(happening.node)) is None:
                    raise CannotFold(f"node {happening.node} ends and never started")
                node.status, node.failure = happening.status, happening.failure
                node.ended_ns = None if happening.status == "LOST" else event.monotonic_ns
            case EpisodeStarted():
                if self._started is not None:
                    raise CannotFold("the episode starts a second time")
                self._started = happening
            case EpisodeEnded():
                self._ended(happening.status)
            case _:
                self._changed(event.sequence, happening)

    def _ended(self, status: str) -> None:
        self._status = status
        if status == "LOST":  # nobody saw how the nodes that were running went on
            for node in self._nodes.values():
                if node.status == "RUNNING":
                    node.status = "LOST"

    def _changed(self, sequence: int, happening: Happening) -> None:
        """Something in the world. What is told of an object that has left it changes nothing."""
        match happening:
            case ObjectAdded(name=name, object_type=kind, pose=pose, joints=joints):
                self._things[sequence] = _Thing(name, kind, pose, sequence, dict(joints))
                self._names[sequence] = name
            case ObjectMoved():
                if (thing := self._thing(happening.object)) is not None:
                    thing.pose, thing.row = happening.pose, sequence
            case JointsMoved():
                if (thing := self._thing(happening.object.object)) is not None:
                    thing.joints.update(happening.joints)
            case ObjectAttached() | ObjectDetached():
                self._thing(happening.parent.object)
                if (thing := self._thing(happening.child.object)) is not None:
                    attached = isinstance(happening, ObjectAttached)
                    thing.attached_to = (happening.parent.object, happening.link) if attached else None
            case ObjectRemoved():
                self._thing(happening.object.object)
                self._things.pop(happening.object.object, None)

    def _thing(self, identity: int) -> _Thing | None:
        """The object, None if it has left the world. Raises `CannotFold`."""
        if identity not in self._names:
            raise CannotFold(f"object {identity} was never added")
        return self._things.get(identity)

    # --- what it comes to -------------------------------------------------------------------------------------

    def moment(self, dtypes: Mapping[str, str]) -> Moment:
        """As values, with the dtype of each declaration by its fingerprint. Raises `LogDamaged`."""
        started, first, last = self._started, self.first, self._last
        assert started is not None
        assert first is not None
        assert last is not None
        return Moment(
            number=self.number,
            id=self.id,
            description=started.description,
            created_by=started.created_by,
            started_at=_moment(first.wall_ns),
            simulated=started.simulated,
            sequence=last.sequence,
            time_s=(last.monotonic_ns - first.monotonic_ns) / 1e9,
            at=_moment(last.wall_ns),
            status=self._status,
            tree=tuple(self._tree(dtypes, first.monotonic_ns)),
            world=self._world(),
        )

    def _tree(self, dtypes: Mapping[str, str], start_ns: int) -> Iterator[NodeThen]:
        children: dict[int | None, list[int]] = {}
        for sequence, node in self._nodes.items():
            children.setdefault(node.parent, []).append(sequence)
        waiting = [(sequence, 0) for sequence in reversed(children.get(None, []))]
        while waiting:
            sequence, depth = waiting.pop()
            yield self._node(sequence, depth, dtypes, start_ns)
            waiting.extend((child, depth + 1) for child in reversed(children.get(sequence, [])))

    def _node(self, sequence: int, depth: int, dtypes: Mapping[str, str], start_ns: int) -> NodeThen:
        node = self._nodes[sequence]
        if node.designator is not None and node.designator not in dtypes:
            raise LogDamaged(self.id, sequence, f"the designator type {node.designator} was never declared")
        return NodeThen(
            id=row_id(self.number, sequence, SLOT_NODE),
            parent_id=row_id(self.number, node.parent, SLOT_NODE) if node.parent is not None else None,
            depth=depth,
            dtype=dtypes[node.designator] if node.designator is not None else None,
            kind=node.kind,
            parameters={name: self._with_name(value) for name, value in node.parameters.items()},
            status=node.status,
            started_at=_moment(node.wall_ns),
            duration_ns=node.ended_ns - node.monotonic_ns if node.ended_ns is not None else None,
            reason=node.failure.type.rpartition(".")[2] if node.failure is not None else None,
            failure_message=node.failure.message if node.failure is not None else None,
            simulated=node.simulated,
            sequence=sequence,
            start_s=(node.monotonic_ns - start_ns) / 1e9,
            end_s=(node.ended_ns - start_ns) / 1e9 if node.ended_ns is not None else None,
        )

    def _with_name(self, value: Any) -> Any:
        """A reference to an object with the object's name; anything else as it is."""
        if isinstance(value, dict) and value.keys() == {"object", "row"}:
            return {**value, "name": self._names.get(value["object"])}
        return value

    def _world(self) -> WorldThen:
        objects = tuple(self._object(identity, thing) for identity, thing in self._things.items())
        robot = next((each for each in objects if each.object_type == "ROBOT"), None)
        return WorldThen(objects, _robot(robot) if robot is not None else None)

    def _object(self, identity: int, thing: _Thing) -> ObjectThen:
        at = thing.pose
        try:
            pose = Pose(at.position, at.orientation, at.frame, at.time_ns)
        except MalformedPose as error:
            raise LogDamaged(self.id, thing.row, str(error)) from None
        held = thing.attached_to
        return ObjectThen(
            id=row_id(self.number, thing.row, SLOT_NODE),
            identity_id=row_id(self.number, identity, SLOT_NODE),
            name=thing.name,
            object_type=thing.object_type,
            pose=pose,
            joints=thing.joints,
            attached_to=(self._names[held[0]], held[1]) if held is not None and held[0] in self._things else None,
        )


def _robot(robot: ObjectThen) -> RobotThen:
    description = robot_description(robot.name)
    return RobotThen(
        robot.name, robot.pose, robot.joints.get(description.torso_joint) if description is not None else None
    )


def _moment(wall_ns: int) -> datetime:
    return _EPOCH + timedelta(microseconds=wall_ns // 1000)
