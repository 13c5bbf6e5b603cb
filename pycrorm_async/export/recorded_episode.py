"""Read an episode's events into objects, their changes, and nodes of the plan, which all formats of robots share."""

from __future__ import annotations

from collections.abc import Callable, Mapping
from dataclasses import dataclass, field
from typing import NamedTuple

from pycrorm_async.errors import CallerError
from pycrorm_async.events.types import (
    EpisodeEnded,
    EpisodeStarted,
    JointsMoved,
    NodeEnded,
    NodeStarted,
    ObjectAdded,
    ObjectMoved,
    ObjectRemoved,
    StateSampled,
)
from pycrorm_async.export.selection import CoveredEpisode
from pycrorm_async.projections.fold.column_values import CannotFold
from pycrorm_async.projections.fold.fold import happening_of
from pycrorm_async.query.as_of import unreadable
from pycrorm_async.query.parameter_text import parameters_text, with_object_names
from pycrorm_async.query.reading import Reading
from pycrorm_async.store.stored import StoredEvent

_BASE = ("base.x", "base.y", "base.z", "base.qx", "base.qy", "base.qz", "base.qw")


class EventTime(NamedTuple):
    """An event: its sequence, the ns since the episode's first event, and the wall time in ns."""

    sequence: int
    since_ns: int
    wall_ns: int


class Change(NamedTuple):
    """A change of an object of the world: its new pose (position, orientation), new joint positions, or its removal."""

    when: EventTime
    object: int
    pose: tuple[float, ...] | None
    joints: Mapping[str, float]
    removed: bool = False
    sampled: bool = False


@dataclass(slots=True)
class ExportedNode:
    """A node of the plan. `label` is its type with the names of its objects; `parameters` all of them as text."""

    sequence: int
    parent: int | None
    kind: str
    dtype: str
    label: str
    parameters: str
    start: EventTime
    end: EventTime | None = None
    status: str = "RUNNING"
    reason: str | None = None
    message: str | None = None


@dataclass
class RecordedEpisode:
    """The events of an episode up to its head when it was chosen.

    Attributes:
        events: all of them, in order.
        objects: each object's `ObjectAdded`, by identity, the sequence of that event.
        changes: of the world, in order; an object's first one adds it.
        nodes: in the order in which they started.
    """

    number: int
    id: str
    description: str = ""
    status: str = "RUNNING"
    started_wall_ns: int = 0
    events: list[EventTime] = field(default_factory=list)
    objects: dict[int, ObjectAdded] = field(default_factory=dict)
    changes: list[Change] = field(default_factory=list)
    nodes: list[ExportedNode] = field(default_factory=list)


async def read_episode(
    reading: Reading, covered: CoveredEpisode, report_events: Callable[[int], object]
) -> RecordedEpisode:
    """Read an episode up to the event `covered.events`. `report_events` gets the number of events read so far.

    Raises `CallerError` for one without an event; `LogDamaged` or `DatabaseForeign` for an event that cannot be read.
    """
    log = await reading.log()
    row = next(each for each in await log.episodes() if each.number == covered.number)
    if covered.events == 0:
        raise CallerError(f"the log has no event of episode {covered.number}")
    fold = _EpisodeFold(RecordedEpisode(row.number, row.id), await log.dtypes())
    async for page in log.pages(row._replace(head=covered.events)):
        for event in page:
            try:
                fold.read(event)
            except CannotFold as reason:
                raise unreadable(row.id, event, str(reason), log) from None
        report_events(page[-1].sequence)
    return fold.episode


class _EpisodeFold:
    def __init__(self, episode: RecordedEpisode, dtypes: Mapping[str, str]) -> None:
        self.episode = episode
        self._dtypes = dtypes
        self._begin_ns = 0
        self._nodes: dict[int, ExportedNode] = {}
        self._poses: dict[int, tuple[float, ...]] = {}

    def read(self, event: StoredEvent) -> None:
        happening = happening_of(event)
        if event.sequence == 1:
            self._begin_ns, self.episode.started_wall_ns = event.monotonic_ns, event.wall_ns
        when = EventTime(event.sequence, event.monotonic_ns - self._begin_ns, event.wall_ns)
        self.episode.events.append(when)
        match happening:
            case EpisodeStarted():
                self.episode.description = happening.description
            case EpisodeEnded():
                self.episode.status = happening.status
            case ObjectAdded():
                self.episode.objects[event.sequence] = happening
                pose = (*happening.pose.position, *happening.pose.orientation)
                self._change(when, event.sequence, pose, happening.joints)
            case ObjectMoved():
                self._change(when, happening.object, (*happening.pose.position, *happening.pose.orientation), {})
            case JointsMoved():
                self._change(when, happening.object.object, None, happening.joints)
            case StateSampled():
                self._sampled(when, happening)
            case ObjectRemoved():
                self._change(when, happening.object.object, None, {}, removed=True)
            case NodeStarted():
                self._started(when, happening)
            case NodeEnded():
                self._ended(when, happening)

    def _change(
        self,
        when: EventTime,
        identity: int,
        pose: tuple[float, ...] | None,
        joints: Mapping[str, float],
        *,
        removed: bool = False,
        sampled: bool = False,
    ) -> None:
        if identity not in self.episode.objects:
            return
        if pose is not None:
            self._poses[identity] = pose
        self.episode.changes.append(Change(when, identity, pose, joints, removed, sampled))

    def _sampled(self, when: EventTime, sample: StateSampled) -> None:
        """Apply a sample of the robot's state, which holds the channels that have changed."""
        identity, channels = sample.object.object, sample.channels
        before = self._poses.get(identity)
        pose = None
        if before is not None and not channels.keys().isdisjoint(_BASE):
            pose = tuple(channels.get(name, value) for name, value in zip(_BASE, before, strict=True))
        joints = {name: value for name, value in channels.items() if name not in _BASE}
        self._change(when, identity, pose, joints, sampled=True)

    def _started(self, when: EventTime, started: NodeStarted) -> None:
        dtype = self._dtypes.get(started.designator or "", "") or started.kind
        named = with_object_names(started.parameters, self._name_of)
        names = [each["name"] for key, each in named.items() if each is not started.parameters[key]]
        node = ExportedNode(
            when.sequence,
            started.parent,
            started.kind,
            dtype,
            " ".join([dtype, *names]),
            parameters_text(named),
            when,
        )
        self._nodes[when.sequence] = node
        self.episode.nodes.append(node)

    def _name_of(self, reference: Mapping[str, int]) -> str | None:
        added = self.episode.objects.get(reference["object"])
        return added.name if added is not None else None

    def _ended(self, when: EventTime, ended: NodeEnded) -> None:
        if (node := self._nodes.get(ended.node)) is None:
            raise CannotFold(f"node {ended.node} ends and never started")
        node.status = ended.status
        node.end = when if ended.status != "LOST" else None
        if ended.failure is not None:
            node.reason, node.message = ended.failure.type.rpartition(".")[2], ended.failure.message
