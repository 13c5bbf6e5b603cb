"""Fold an episode's events into the state of its task tree and world at a moment.

The fold is pure, and its memory grows with the state it describes. It ignores StateSampled: every pose and joint in a
sample had an exact event of its own, while the sample may be older than the event before it.
"""

from __future__ import annotations

from collections import deque
from collections.abc import Iterator, Mapping
from dataclasses import dataclass
from datetime import UTC, datetime, timedelta
from typing import Any

from pycrorm_async.errors import LogDamaged
from pycrorm_async.events.ids import SLOT_NODE, row_id
from pycrorm_async.events.tags import retagged
from pycrorm_async.events.types import (
    DescriptionDeclared,
    EpisodeEnded,
    EpisodeStarted,
    EpisodeTagged,
    Happening,
    LocationResolved,
    NodeEnded,
    NodeStarted,
    ObjectDetected,
    Observed,
)
from pycrorm_async.events.values import FailureValue
from pycrorm_async.projections.fold.column_values import CannotFold
from pycrorm_async.projections.fold.fold import happening_of
from pycrorm_async.projections.fold.world_fold import WorldFold, WorldObject
from pycrorm_async.query.parameter_text import with_object_names
from pycrorm_async.query.percepts_and_places import Percept, PlaceSearch, percepts_in, search_in
from pycrorm_async.query.snapshot import Moment, NodeThen, ObjectThen, ObservationThen, RobotThen, WorldThen
from pycrorm_async.store.stored import StoredEvent
from pycrorm_async.world.pose import MalformedPose, Pose
from pycrorm_async.world.robots.robot_description import robot_description

_LATEST_MAX = 100
"""Bounds the percepts and the searches for places of a snapshot, each: an episode may have many thousands."""
_EPOCH = datetime(1970, 1, 1, tzinfo=UTC)


@dataclass(slots=True)
class _Node:
    """The state of a node, without the robot's state and the result, to save memory."""

    kind: str
    parent: int | None
    designator: str | None
    parameters: dict[str, Any]
    simulated: bool
    wall_ns: int
    monotonic_ns: int
    status: str = "RUNNING"
    ended_ns: int | None = None
    end_sequence: int | None = None
    failure: FailureValue | None = None
    considered: int = 0
    offered: int = 0
    detected: int = 0


class MomentFold:
    """The state of an episode after the events read so far.

    Attributes:
        first: the first event; None before it is read.
    """

    def __init__(self, number: int, identity: str) -> None:
        self.number = number
        self.id = identity
        self.first: StoredEvent | None = None
        self._started: EpisodeStarted | None = None
        self._last: StoredEvent | None = None
        self._status = "RUNNING"
        self._nodes: dict[int, _Node] = {}
        self._fold = WorldFold()
        self._tags: tuple[str, ...] = ()
        self._observed: dict[str, tuple[StoredEvent, Observed]] = {}
        self._percepts: deque[Percept] = deque(maxlen=_LATEST_MAX)
        self._places: deque[PlaceSearch] = deque(maxlen=_LATEST_MAX)

    def read(self, event: StoredEvent) -> None:
        """Apply the next event. Raises `CannotFold`."""
        if self.first is None and event.type != "EpisodeStarted":
            raise CannotFold(f"the episode begins with {event.type} instead of EpisodeStarted")
        if event.type != "StateSampled":
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
                if happening.status != "LOST":
                    node.ended_ns, node.end_sequence = event.monotonic_ns, event.sequence
            case EpisodeStarted():
                if self._started is not None:
                    raise CannotFold("the episode starts a second time")
                self._started = happening
                self._tags = retagged((), happening.tags, ())
            case EpisodeTagged():
                self._tags = retagged(self._tags, happening.added, happening.removed)
            case EpisodeEnded():
                self._ended(happening.status)
            case Observed():
                self._observed[happening.name] = event, happening
            case ObjectDetected() | LocationResolved():
                self._answered(event, happening)
            case _:
                self._fold.read(event.sequence, happening)

    def _answered(self, event: StoredEvent, answer: ObjectDetected | LocationResolved) -> None:
        """Keep the answer of perception or of a location designator, and count it at the node that asked."""
        node = self._nodes.get(answer.node or 0)
        if isinstance(answer, ObjectDetected):
            percepts = percepts_in(self.number, event, answer)
            self._percepts.extend(percepts)
            if node is not None:
                node.detected += len(percepts)
            return
        search = search_in(self.number, event, answer)
        self._places.append(search)
        if node is not None:
            node.considered += search.considered
            node.offered += search.offered

    def _ended(self, status: str) -> None:
        self._status = status
        if status == "LOST":  # the process died, so the outcome of its running nodes is unknown
            for node in self._nodes.values():
                if node.status == "RUNNING":
                    node.status = "LOST"

    # --- the result -------------------------------------------------------------------------------------------

    @property
    def descriptions(self) -> set[str]:
        """The fingerprints of the objects' descriptions."""
        return {each.description for each in self._fold.objects.values() if each.description is not None}

    def moment(
        self,
        dtypes: Mapping[str, str],
        descriptions: Mapping[str, DescriptionDeclared],
        meshes: Mapping[str, bytes],
    ) -> Moment:
        """Return the state as values. Raises `LogDamaged`.

        Args:
            dtypes: the dtype of each declaration, by fingerprint.
            descriptions: those of the objects, by fingerprint.
            meshes: contents of their mesh files, by SHA-256.
        """
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
            world=self._world(descriptions, meshes),
            observations={name: self._observation(*each) for name, each in self._observed.items()},
            tags=self._tags,
            percepts=tuple(self._percepts),
            places=tuple(self._places),
        )

    def _observation(self, event: StoredEvent, observed: Observed) -> ObservationThen:
        assert self.first is not None
        return ObservationThen(
            values=observed.values,
            sequence=event.sequence,
            time_s=(event.monotonic_ns - self.first.monotonic_ns) / 1e9,
            node=row_id(self.number, observed.node, SLOT_NODE) if observed.node is not None else None,
            missing=observed.missing,
        )

    def _tree(self, dtypes: Mapping[str, str], start_ns: int) -> Iterator[NodeThen]:
        children: dict[int | None, list[int]] = {}
        for sequence, node in self._nodes.items():
            children.setdefault(node.parent, []).append(sequence)
        stack = [(sequence, 0) for sequence in reversed(children.get(None, []))]
        while stack:
            sequence, depth = stack.pop()
            yield self._node(sequence, depth, dtypes, start_ns)
            stack.extend((child, depth + 1) for child in reversed(children.get(sequence, [])))

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
            parameters=with_object_names(node.parameters, lambda each: self._fold.names.get(each["object"])),
            status=node.status,
            started_at=_moment(node.wall_ns),
            duration_ns=node.ended_ns - node.monotonic_ns if node.ended_ns is not None else None,
            reason=node.failure.type.rpartition(".")[2] if node.failure is not None else None,
            failure_message=node.failure.message if node.failure is not None else None,
            simulated=node.simulated,
            sequence=sequence,
            end_sequence=node.end_sequence,
            start_s=(node.monotonic_ns - start_ns) / 1e9,
            end_s=(node.ended_ns - start_ns) / 1e9 if node.ended_ns is not None else None,
            considered=node.considered,
            offered=node.offered,
            detected=node.detected,
        )

    def _world(self, descriptions: Mapping[str, DescriptionDeclared], meshes: Mapping[str, bytes]) -> WorldThen:
        objects = tuple(self._object(identity, each) for identity, each in self._fold.objects.items())
        robots = tuple(_robot(each) for each in objects if each.object_type == "ROBOT")
        return WorldThen(objects, robots[0] if robots else None, descriptions, meshes, robots)

    def _object(self, identity: int, value: WorldObject) -> ObjectThen:
        at = value.pose
        try:
            pose = Pose(at.position, at.orientation, at.frame, at.time_ns)
        except MalformedPose as error:
            raise LogDamaged(self.id, value.row, str(error)) from None
        parent = value.attached_to
        return ObjectThen(
            id=row_id(self.number, value.row, SLOT_NODE),
            identity_id=row_id(self.number, identity, SLOT_NODE),
            name=value.name,
            object_type=value.object_type,
            pose=pose,
            joints=value.joints,
            attached_to=(self._fold.names[parent[0]], parent[1])
            if parent is not None and parent[0] in self._fold.objects
            else None,
            description_fingerprint=value.description,
            color=value.color,
            model=value.model,
            serial=value.serial,
            mass_kg=value.mass_kg,
            base_link=value.base_link,
        )


def _robot(robot: ObjectThen) -> RobotThen:
    description = robot_description(robot.model or robot.name)
    torso = description.torso_joint if description is not None else None
    return RobotThen(robot.name, robot.pose, robot.joints.get(torso) if torso is not None else None)


def _moment(wall_ns: int) -> datetime:
    return _EPOCH + timedelta(microseconds=wall_ns // 1000)
