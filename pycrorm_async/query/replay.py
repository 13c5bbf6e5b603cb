"""Replay the events of an episode into its state: task tree, world, percepts, observations, tags and times.

As-of, the terminal view, the report, the live page and the exports all read an `EpisodeReplay`, event by event, and ask
it. What only one of them needs, such as the tracks of the page, it keeps on top. `projections.fold` is another fold: it
makes rows, and its state is a batch of them.

A replay is pure, and its memory grows with the state that it has.
"""

from collections import deque
from collections.abc import Mapping
from dataclasses import dataclass, field
from typing import Any, NamedTuple

from pycrorm_async.errors import DatabaseForeign, LogDamaged, PycrormError
from pycrorm_async.events import types as event_types
from pycrorm_async.events.fields import retagged
from pycrorm_async.events.reasons import reason_of
from pycrorm_async.events.types import EpisodeStarted
from pycrorm_async.projections.fold import happening_of
from pycrorm_async.projections.row_batch import CannotFold
from pycrorm_async.query.text import with_object_names
from pycrorm_async.store.address import DatabaseAddress
from pycrorm_async.store.stored import EpisodeRow, StoredEvent

LATEST_MAX = 100
"""Bounds the percepts and the searches for places of a replay, each: an episode may have many thousands."""


class ReplayTime(NamedTuple):
    """An event: its sequence, and the ns since the episode's first event."""

    sequence: int
    since_ns: int


@dataclass(slots=True)
class ReplayedNode:
    """A node, without the robot's state and the result, to save memory. `end` is None while it runs, and if LOST."""

    kind: str
    parent: int | None
    designator: str | None
    parameters: dict[str, Any]
    simulated: bool
    wall_ns: int
    start: ReplayTime
    end: ReplayTime | None = None
    status: str = "RUNNING"
    failure: event_types.FailureValue | None = None
    considered: int = 0
    offered: int = 0
    detected: int = 0

    @property
    def reason(self) -> str | None:
        """The reason of its failure."""
        return reason_of(self.failure) if self.failure is not None else None

    @property
    def message(self) -> str | None:
        """The message of its failure."""
        return self.failure.message if self.failure is not None else None


@dataclass(slots=True)
class WorldObject:
    """An object in the world. `row` is the sequence of the event that set its pose."""

    added: event_types.ObjectAdded
    pose: event_types.PoseValue
    row: int
    joints: dict[str, float] = field(default_factory=dict)
    attached_to: tuple[int, str | None] | None = None


class ReplayedWorld:
    """The objects in the world of an episode after the events read so far.

    Args:
        strict: whether an event of an object that was never added raises `CannotFold`, or has no effect.

    Attributes:
        objects: those that are present, by identity.
        added: how each object was added, removed ones included, by identity.
    """

    def __init__(self, *, strict: bool = True) -> None:
        self.objects: dict[int, WorldObject] = {}
        self.added: dict[int, event_types.ObjectAdded] = {}
        self._strict = strict

    def read(self, sequence: int, happening: event_types.Happening) -> None:
        """Apply an event of the world. Events of a removed object have no effect."""
        match happening:
            case event_types.ObjectAdded():
                self.added[sequence] = happening
                self.objects[sequence] = WorldObject(happening, happening.pose, sequence, dict(happening.joints))
            case event_types.ObjectMoved():
                if (moved := self._present(happening.object)) is not None:
                    moved.pose, moved.row = happening.pose, sequence
            case event_types.JointsMoved():
                if (moved := self._present(happening.object.object)) is not None:
                    moved.joints.update(happening.joints)
            case event_types.ObjectAttached() | event_types.ObjectDetached():
                self._present(happening.parent.object)
                if (child := self._present(happening.child.object)) is not None:
                    attached = isinstance(happening, event_types.ObjectAttached)
                    child.attached_to = (happening.parent.object, happening.link) if attached else None
            case event_types.ObjectRemoved():
                self._present(happening.object.object)
                self.objects.pop(happening.object.object, None)

    def _present(self, identity: int) -> WorldObject | None:
        """Return the object, None if it was removed. Raises `CannotFold` for one that was never added."""
        if self._strict and identity not in self.added:
            raise CannotFold(f"object {identity} was never added")
        return self.objects.get(identity)

    def pose_of(self, robot: event_types.RobotValue) -> event_types.PoseValue | None:
        """Return the pose of the robot that starts a node now; None if the world does not have its object."""
        if robot.pose is not None or robot.object is None:
            return robot.pose
        present = self.objects.get(robot.object.object)
        return present.pose if present is not None else None

    def robot_name(self, robot: event_types.RobotValue | None) -> str:
        """Return the name of a robot that acts; that of its object in events of older versions, else its type."""
        if robot is None:
            return ""
        name = robot.name or (self.name_of(robot.object.object) if robot.object is not None else None)
        return name or robot.object_type

    def name_of(self, identity: int) -> str | None:
        """Return the name of an object, also of a removed one; None if it was never added."""
        added = self.added.get(identity)
        return added.name if added is not None else None


class EpisodeReplay:
    """The state of an episode after the events read so far.

    Args:
        address: of the log, for errors.
        strict: whether an event that names an unknown object or parent is refused, or applied as far as it can be.
        samples: whether `StateSampled` is decoded and returned. It changes no state, because every pose and joint in it
            had an exact event of its own, while the sample may be older than the event before it.

    Attributes:
        number, id: of the episode.
        dtypes: the dtype of each designator type, by its short name; the reader of the log keeps it up to date.
        begin_ns, begin_wall_ns: monotonic and wall time of the first event.
        at, wall_ns: the last event that was read, and its wall time; event 0 before.
        started: the first event; empty before it is read.
        ended: the end of the episode; None before it is read.
        tags: of the episode.
        nodes: those that have started, by sequence, in that order.
        world: the objects.
        observed: the latest observation of each name.
        detections, searches: the latest answers of perception with a percept, and of location designators.
    """

    def __init__(
        self, row: EpisodeRow, address: DatabaseAddress, *, strict: bool = True, samples: bool = False
    ) -> None:
        self.number, self.id = row.number, row.id
        self.dtypes: Mapping[str, str] = {}
        self.begin_ns = self.begin_wall_ns = self.wall_ns = 0
        self.at = ReplayTime(0, 0)
        self.started = EpisodeStarted("", "", "", "", "")
        self.ended: event_types.EpisodeEnded | None = None
        self.tags: tuple[str, ...] = ()
        self.nodes: dict[int, ReplayedNode] = {}
        self._failures: dict[int, event_types.FailureValue] = {}
        """The failures that ends have themselves, by node."""
        self.world = ReplayedWorld(strict=strict)
        self.observed: dict[str, tuple[StoredEvent, event_types.Observed]] = {}
        self.detections: deque[tuple[StoredEvent, event_types.ObjectDetected]] = deque(maxlen=LATEST_MAX)
        self.searches: deque[tuple[StoredEvent, event_types.LocationResolved]] = deque(maxlen=LATEST_MAX)
        self._address = address
        self._strict = strict
        self._samples = samples

    @property
    def status(self) -> str:
        """The status of the episode."""
        return self.ended.status if self.ended is not None else "RUNNING"

    def dtype(self, node: ReplayedNode) -> str:
        """Return the dtype of a node; empty for the root, and if its type is not known."""
        return self.dtypes.get(node.designator or "", "")

    def parameters(self, node: ReplayedNode) -> dict[str, Any]:
        """Return the parameters of a node, with the names of the objects that they refer to."""
        return with_object_names(node.parameters, lambda each: self.world.name_of(each["object"]))

    def read(self, event: StoredEvent) -> event_types.Happening | None:
        """Apply the next event and return it; None for a sample that is not decoded.

        Raises `LogDamaged`, or `DatabaseForeign` for an event of a newer version.
        """
        if self.at.sequence == 0:
            self.begin_ns, self.begin_wall_ns = event.monotonic_ns, event.wall_ns
        at = ReplayTime(event.sequence, event.monotonic_ns - self.begin_ns)
        try:
            happening = self._decoded(event)
            if happening is not None:
                self._apply(event, at, happening)
        except CannotFold as reason:
            raise _unreadable(self.id, event, str(reason), self._address) from None
        self.at, self.wall_ns = at, event.wall_ns
        return happening

    def _decoded(self, event: StoredEvent) -> event_types.Happening | None:
        if self.at.sequence == 0 and event.type != "EpisodeStarted":
            raise CannotFold(f"the episode begins with {event.type} instead of EpisodeStarted")
        return happening_of(event) if self._samples or event.type != "StateSampled" else None

    def _apply(self, event: StoredEvent, at: ReplayTime, happening: event_types.Happening) -> None:
        match happening:
            case event_types.NodeStarted():
                self._start(event, at, happening)
            case event_types.NodeEnded():
                self._end(at, happening)
            case EpisodeStarted():
                if self.at.sequence > 0:
                    raise CannotFold("the episode starts a second time")
                self.started = happening
                self.tags = retagged((), happening.tags, ())
            case event_types.EpisodeTagged():
                self.tags = retagged(self.tags, happening.added, happening.removed)
            case event_types.EpisodeEnded():
                self._end_episode(happening)
            case event_types.Observed():
                self.observed[happening.name] = event, happening
            case event_types.ObjectDetected() | event_types.LocationResolved():
                self._answer(event, happening)
            case _:
                self.world.read(event.sequence, happening)

    def _start(self, event: StoredEvent, at: ReplayTime, started: event_types.NodeStarted) -> None:
        parent = started.parent
        if self._strict and parent is not None and parent not in self.nodes:
            raise CannotFold(f"its parent {parent} never started")
        parameters = started.parameters
        if b'"pose_of"' in event.payload:
            parameters = event_types.with_poses(parameters, self._parameters_of)
        self.nodes[event.sequence] = ReplayedNode(
            started.kind, parent, started.designator, parameters, started.simulated, event.wall_ns, at
        )

    def _parameters_of(self, sequence: int) -> Mapping[str, Any] | None:
        node = self.nodes.get(sequence)
        return node.parameters if node is not None else None

    def _end(self, at: ReplayTime, ended: event_types.NodeEnded) -> None:
        if (node := self.nodes.get(ended.node)) is None:
            raise CannotFold(f"node {ended.node} ends and never started")
        failure = ended.failure
        if failure is not None and failure.of is not None:
            failure = self._failures.get(failure.of.node, failure)
        elif failure is not None:
            self._failures[ended.node] = failure
        node.status, node.failure = ended.status, failure
        if ended.has_time:
            node.end = at

    def _answer(self, event: StoredEvent, answer: event_types.ObjectDetected | event_types.LocationResolved) -> None:
        """Keep the answer of perception or of a location designator, and count it at the node that asked."""
        node = self.nodes.get(answer.node or 0)
        if isinstance(answer, event_types.LocationResolved):
            self.searches.append((event, answer))
            if node is not None:
                node.considered += answer.considered
                node.offered += len(answer.offered) + answer.offered_beyond
        elif answer.seen:
            self.detections.append((event, answer))
            if node is not None:
                node.detected += len(answer.seen)

    def _end_episode(self, ended: event_types.EpisodeEnded) -> None:
        self.ended = ended
        if ended.status in event_types.LOSES_OPEN_NODES:
            for node in self.nodes.values():
                if node.status == "RUNNING":
                    node.status = "LOST"


def _unreadable(episode: str, event: StoredEvent, reason: str, address: DatabaseAddress) -> PycrormError:
    """Return the error for an event that cannot be applied: of a newer version, or damaged."""
    shape = event_types.EVENT_TYPES.get(event.type)
    if shape is not None and event.version <= shape.version:
        return LogDamaged(episode, event.sequence, reason)
    return DatabaseForeign(
        f"{address}: episode {episode}, event {event.sequence}: {reason}: use a newer pycrorm, or ask for a moment"
        f" before event {event.sequence}"
    )
