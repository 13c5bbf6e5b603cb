"""`Moment` is the snapshot of an episode after one of its events: its task tree and its world, as plain values.

The classes named `…Then` are the parts of a `Moment`. Ids lead back to the tables: each change of an object is a row of
`orm.Object` with an `id` of its own, and all rows of one object share its `identity_id`, the id of the first.

>>> moment = await memory.as_of("last", time=12.5)
>>> [node.dtype for node in moment.running]
[None, 'PickUpAction', 'MoveTCPMotion']
>>> moment.world.object("milk").pose
Pose(position=[1.3, 1.0, 0.9], orientation=[0.0, 0.0, 0.0, 1.0], frame='map')
>>> world.restore_state(moment.world.state)  # needs a world with the same objects
"""

from __future__ import annotations

from collections.abc import AsyncIterator, Callable, Collection, Iterable, Mapping, Sequence
from dataclasses import dataclass, field, replace
from datetime import datetime
from numbers import Integral, Real
from types import MappingProxyType
from typing import TYPE_CHECKING, Any, NamedTuple, TypeAlias

from pycrorm_async import world
from pycrorm_async.clock import microseconds_of, utc_of
from pycrorm_async.errors import CallerError, LogDamaged, UnknownEpisode
from pycrorm_async.events.codec import description_of
from pycrorm_async.events.ids import SLOT_NODE, row_id
from pycrorm_async.events.types import DescriptionDeclared, EpisodeEnded
from pycrorm_async.projections.fold import happening_of
from pycrorm_async.query import named_queries
from pycrorm_async.query.named_queries import EpisodeSummary, NodeSummary, Percept, PlaceSearch
from pycrorm_async.query.question import AskedEpisode
from pycrorm_async.query.replay import LATEST_MAX, EpisodeReplay, ReplayedNode, WorldObject
from pycrorm_async.query.text import NotebookValue
from pycrorm_async.store.log import EventLog, episode_named
from pycrorm_async.store.stored import EpisodeRow, StoredEvent
from pycrorm_async.visible_text import visible
from pycrorm_async.world.pose import MalformedPose, Pose

if TYPE_CHECKING:
    from pycrorm_async.query.observed_images import ObservedPicture


@dataclass(frozen=True, kw_only=True)
class NodeThen(NodeSummary):
    """A node at that moment: RUNNING and without an end if it ended later.

    The inherited `thoughts`, the simulations that the node performed, is always empty: a snapshot reads one episode.

    Attributes:
        start_s, end_s: since the episode's start; `end_s` is None while it runs, and if it is LOST.
    """

    start_s: float
    end_s: float | None


@dataclass(frozen=True)
class ObjectThen:
    """An object at that moment.

    Attributes:
        id: of its row in `orm.Object` at that moment.
        identity_id: of its first row, from when it was added. An object that is removed and added again under its old
            name has a new identity.
        object_type: name of the member of `ObjectType`.
        pose: of its base link's frame, in "map".
        joints: rad or m, by name.
        attached_to: name and link of the object that it moves with; the link is None for the base link.
        description_fingerprint: of its description in `WorldThen.descriptions`; None in episodes of older versions.
        color: red, green, blue, opacity, 0 to 1; None if only the description has it.
        model, serial: of a robot with a `RobotDescription`; None in episodes of older versions.
        mass_kg: None if it is not known.
        base_link: None for the root link.
    """

    id: int
    identity_id: int
    name: str
    object_type: str
    pose: Pose
    joints: Mapping[str, float]
    attached_to: tuple[str, str | None] | None
    description_fingerprint: str | None = None
    color: tuple[float, float, float, float] | None = None
    model: str | None = None
    serial: str | None = None
    mass_kg: float | None = None
    base_link: str | None = None


@dataclass(frozen=True)
class RobotThen:
    """The robot at that moment: base pose, torso joint position in m (None for a robot without a description)."""

    name: str
    pose: Pose
    torso_height: float | None


class AttachmentThen(NamedTuple):
    """`child` moves with `link` of `parent` (None: the base link); objects by name."""

    parent: str
    child: str
    link: str | None


@dataclass(frozen=True)
class WorldThen(NotebookValue):
    """The world at that moment.

    Attributes:
        objects: in the order they were added.
        robot: the first of type ROBOT.
        descriptions: the descriptions of the objects, by fingerprint.
        meshes: contents of their recorded mesh files, by SHA-256; empty unless the snapshot was requested with them.
        robots: all of type ROBOT, in the order they were added.
        engine: name and version of the world's engine; None if it is not known, as in an episode that did not end.
    """

    objects: tuple[ObjectThen, ...]
    robot: RobotThen | None
    descriptions: Mapping[str, DescriptionDeclared] = field(default_factory=dict)
    meshes: Mapping[str, bytes] = field(default_factory=dict, repr=False)
    robots: tuple[RobotThen, ...] = ()
    engine: str | None = None

    def object(self, name: str) -> ObjectThen:
        """Return the object with this name. Raises `CallerError` if the world had none."""
        for each in self.objects:
            if each.name == name:
                return each
        present = ", ".join(each.name for each in self.objects) or "none"
        raise CallerError(f"the world had no object {name!r} at this moment; its objects: {present}")

    @property
    def attachments(self) -> tuple[AttachmentThen, ...]:
        """All attachments of the world."""
        pairs = [(each.name, each.attached_to) for each in self.objects]
        return tuple(AttachmentThen(to[0], name, to[1]) for name, to in pairs if to is not None)

    @property
    def state(self) -> world.WorldState:
        """The world's state for `BulletWorld.restore_state`."""
        return world.WorldState(
            {each.name: world.ObjectState(each.pose, each.joints, each.attached_to) for each in self.objects}
        )


@dataclass(frozen=True)
class ObservationThen:
    """The latest observation of one name.

    Attributes:
        values: as recorded; a blob is a dict with its hash in `$blob`.
        sequence: of its event.
        time_s: since the episode's start.
        node: id of the node that observed it.
        missing: by path, why a value could not be recorded.
    """

    values: Any
    sequence: int
    time_s: float
    node: int | None
    missing: Mapping[str, str] = field(default_factory=dict)


@dataclass(frozen=True, repr=False)
class Moment(NotebookValue):
    """The state of an episode after one of its events, until the next one.

    Attributes:
        number: of the episode in this database.
        id: the episode's UUID.
        simulated: True for a simulation, performed in a copy of the world.
        sequence: of that event, the last one included.
        time_s: of that event, in s since the episode's start by the monotonic clock.
        at: of that event, by the wall clock.
        status: of the episode at that moment.
        tree: the nodes that had started, each before its children, children in the order they started.
        observations: by name, the latest observation of a program.
        percepts, places: the latest 100 percepts and searches for a place up to that moment, in the order of events.
        tags: of the episode at that moment.
        pictures: of the observations, which a notebook draws; empty unless they were asked for.
    """

    number: int
    id: str
    description: str
    created_by: str
    started_at: datetime
    simulated: bool
    sequence: int
    time_s: float
    at: datetime
    status: str
    tree: tuple[NodeThen, ...]
    world: WorldThen
    observations: Mapping[str, ObservationThen] = field(default_factory=dict)
    tags: tuple[str, ...] = ()
    percepts: tuple[Percept, ...] = ()
    places: tuple[PlaceSearch, ...] = ()
    pictures: tuple[ObservedPicture, ...] = field(default=(), repr=False)

    @property
    def running(self) -> tuple[NodeThen, ...]:
        """The running nodes: the path from the root to the current action, or several paths for concurrent ones."""
        return tuple(each for each in self.tree if each.status == "RUNNING")

    def __str__(self) -> str:
        lines = [f"episode {self.number} at {self.time_s:.3f} s, event {self.sequence}: {self.status}"]
        lines += [f"{'  ' * (each.depth + 1)}{each.dtype or each.kind} {each.status}" for each in self.tree]
        lines += [f"{each.name} {each.pose!r}" for each in self.world.objects]
        return "\n".join(visible(each, kept="") for each in lines)

    __repr__ = __str__


# === as of ====================================================================================================
#
# Compute the task tree and the world of an episode at any moment by replaying its events up to then.
#
# It reads the log and not the tables, which contain only the final state of each node. So it also works for events that
# are not folded yet, and for parked episodes. It reads no further than one page beyond the moment.

_NUMBERS_END = 1e15
_END_WITHIN = 100
"""Bounds the last events that are searched for the end of an episode, behind which only tags may follow."""

_Within: TypeAlias = Callable[[int, StoredEvent], bool]
"""Takes the monotonic time of the first event and another event; returns whether this is not later than the moment."""


async def as_of(
    log: EventLog,
    episode: AskedEpisode,
    *,
    time: float | datetime | None = None,
    sequence: int | None = None,
    meshes: bool = False,
) -> Moment:
    """Return the episode's state at a moment; see `Reading.as_of`."""
    limit, within = _limit(time, sequence)
    row = await episode_named(log, str(episode.number if isinstance(episode, EpisodeSummary) else episode))
    if row.head == 0:
        raise UnknownEpisode(f"the log has no event of episode {row.number}")
    replay = EpisodeReplay(row, log.address)
    async for page in log.pages(row):
        if not _read(replay, page, within):
            break
    if replay.at.sequence == 0:
        raise CallerError(f"{limit} is before episode {row.number} began")
    replay.dtypes = await log.dtypes()
    moment = await _moment_of(replay, log, meshes=meshes)
    line = replay.started.world or await _entered_world(log, row)
    from pycrorm_async.world.engines import engine_in  # here, because it loads numpy

    return replace(moment, world=replace(moment.world, engine=engine_in(line or "")))


async def _entered_world(log: EventLog, row: EpisodeRow) -> str | None:
    """Return the line that the end of an episode has of its world; None before the end, and without a world."""
    for event in await log.events(row.number, after=max(0, row.head - _END_WITHIN)):
        if event.type == "EpisodeEnded" and isinstance(ended := happening_of(event), EpisodeEnded):
            return ended.world
    return None


async def moments(log: EventLog, number: int, sequences: Collection[int]) -> AsyncIterator[Moment]:
    """Yield the state of an episode after each of these events, in one pass over its events."""
    [row] = await log.episodes(number, number)
    replay = EpisodeReplay(row, log.address)
    replay.dtypes = await log.dtypes()
    async for page in log.pages(row._replace(head=max(sequences))):
        for event in page:
            replay.read(event)
            if event.sequence in sequences:
                yield await _moment_of(replay, log)


async def _moment_of(replay: EpisodeReplay, log: EventLog, *, meshes: bool = False) -> Moment:
    described = {each.added.description for each in replay.world.objects.values()}
    payloads = await log.descriptions({each for each in described if each is not None})
    descriptions = {name: _description(payload) for name, payload in payloads.items()}
    return moment_of(replay, descriptions, await _meshes(log, descriptions.values()) if meshes else {})


async def _meshes(log: EventLog, descriptions: Iterable[DescriptionDeclared]) -> dict[str, bytes]:
    """Read the mesh files that are recorded; one that is missing or damaged in the log is left out."""
    recorded = {mesh.content.hash for each in descriptions for mesh in each.meshes if mesh.content is not None}
    with log.translated():
        contents = {name: await log.blobs.read_blob(name) for name in recorded}
    return {name: content for name, content in contents.items() if content is not None}


def _description(payload: bytes) -> DescriptionDeclared:
    """Decode a description; one that this version cannot read is missing, with the reason."""
    try:
        return description_of(payload)
    except ValueError as error:
        return DescriptionDeclared(missing=f"it cannot be read: {error}")


def _read(replay: EpisodeReplay, page: Sequence[StoredEvent], within: _Within) -> bool:
    """Read the events of a page up to the moment; return whether the next page may have more."""
    for event in page:
        if not within(replay.begin_ns if replay.at.sequence else event.monotonic_ns, event):
            return False
        replay.read(event)
    return True


def _limit(time: float | datetime | None, sequence: int | None) -> tuple[str, _Within]:
    """Return the moment as text and as a condition. Raises `CallerError`."""
    if (time is None) == (sequence is None):
        raise CallerError("a moment needs either a time or the sequence of an event: pass exactly one of them")
    if sequence is not None:
        last = _number(sequence, Integral)
        if last is None:
            raise CallerError(f"sequence must be an integer, got {sequence!r}")
        return f"event {last:.0f}", lambda _, event: event.sequence <= last
    if isinstance(time, datetime):
        if time.utcoffset() is None:
            raise CallerError(f"{time!r} has no time zone: add one, for example .replace(tzinfo=UTC)")
        wall_us = microseconds_of(time)
        return time.isoformat(" "), lambda _, event: event.wall_ns // 1000 <= wall_us
    seconds = _number(time, Real)
    if seconds is None:
        raise CallerError(f"time must be seconds since the episode's start or a datetime, got {time!r}")
    since_ns = round(seconds * 1e9)
    return f"{seconds:g} s", lambda begin_ns, event: event.monotonic_ns - begin_ns <= since_ns


def parse_moment(text: str, option: str = "at") -> tuple[float | None, int | None]:
    """Parse the text of a moment as seconds or as the sequence of an event. Raises `CallerError`.

    >>> parse_moment("12.5"), parse_moment("e300"), parse_moment("#300")
    ((12.5, None), (None, 300), (None, 300))
    """
    try:
        return (None, int(text[1:])) if text[:1] in ("e", "#") else (float(text), None)
    except ValueError:
        raise CallerError(
            f"{option} takes seconds since the episode's start, or an event such as e300, got {text!r}"
        ) from None


def _number(value: Any, kind: type) -> float | None:
    """Return a Python or NumPy number as a float; None if it is not finite or of another kind."""
    is_number = isinstance(value, kind) and not isinstance(value, bool)
    return float(value) if is_number and abs(value) < _NUMBERS_END else None


# === moment ===================================================================================================
#
# Make the values of a moment from the replay of an episode.


def moment_of(
    replay: EpisodeReplay,
    descriptions: Mapping[str, DescriptionDeclared] = MappingProxyType({}),
    meshes: Mapping[str, bytes] = MappingProxyType({}),
) -> Moment:
    """Return the state of a replay that has read an event. Raises `LogDamaged`.

    Args:
        descriptions: those of the objects, by fingerprint.
        meshes: contents of their mesh files, by SHA-256.
    """
    started, number = replay.started, replay.number
    percepts = [each for answer in replay.detections for each in named_queries.percepts_in(number, *answer)]
    return Moment(
        number=number,
        id=replay.id,
        description=started.description,
        created_by=started.created_by,
        started_at=utc_of(replay.begin_wall_ns // 1000),
        simulated=started.simulated,
        sequence=replay.at.sequence,
        time_s=replay.at.since_ns / 1e9,
        at=utc_of(replay.wall_ns // 1000),
        status=replay.status,
        tree=tuple(
            _node(replay, replay.nodes[sequence], depth)
            for sequence, depth in named_queries.depth_first({key: each.parent for key, each in replay.nodes.items()})
        ),
        world=_world(replay, descriptions, meshes),
        observations={
            name: ObservationThen(
                values=observed.values,
                sequence=event.sequence,
                time_s=(event.monotonic_ns - replay.begin_ns) / 1e9,
                node=row_id(number, observed.node, SLOT_NODE) if observed.node is not None else None,
                missing=observed.missing,
            )
            for name, (event, observed) in replay.observed.items()
        },
        tags=replay.tags,
        percepts=tuple(percepts[-LATEST_MAX:]),
        places=tuple(named_queries.search_in(number, *answer) for answer in replay.searches),
    )


def _node(replay: EpisodeReplay, node: ReplayedNode, depth: int) -> NodeThen:
    start, end = node.start, node.end
    if node.designator is not None and node.designator not in replay.dtypes:
        raise LogDamaged(replay.id, start.sequence, f"the designator type {node.designator} was never declared")
    return NodeThen(
        id=row_id(replay.number, start.sequence, SLOT_NODE),
        parent_id=row_id(replay.number, node.parent, SLOT_NODE) if node.parent is not None else None,
        depth=depth,
        dtype=replay.dtype(node) if node.designator is not None else None,
        kind=node.kind,
        parameters=replay.parameters(node),
        status=node.status,
        started_at=utc_of(node.wall_ns // 1000),
        duration_ns=end.since_ns - start.since_ns if end is not None else None,
        reason=node.reason,
        failure_message=node.message,
        simulated=node.simulated,
        sequence=start.sequence,
        end_sequence=end.sequence if end is not None else None,
        start_ns=replay.begin_ns + start.since_ns,
        start_s=start.since_ns / 1e9,
        end_s=end.since_ns / 1e9 if end is not None else None,
        considered=node.considered,
        offered=node.offered,
        detected=node.detected,
    )


def _world(
    replay: EpisodeReplay, descriptions: Mapping[str, DescriptionDeclared], meshes: Mapping[str, bytes]
) -> WorldThen:
    objects = tuple(_object(replay, identity, each) for identity, each in replay.world.objects.items())
    robots = tuple(_robot(each) for each in objects if each.object_type == "ROBOT")
    return WorldThen(objects, robots[0] if robots else None, descriptions, meshes, robots)


def _object(replay: EpisodeReplay, identity: int, value: WorldObject) -> ObjectThen:
    added, at, parent = value.added, value.pose, value.attached_to
    try:
        pose = Pose(at.position, at.orientation, at.frame, at.time_ns)
    except MalformedPose as error:
        raise LogDamaged(replay.id, value.row, str(error)) from None
    holder = replay.world.objects.get(parent[0]) if parent is not None else None
    return ObjectThen(
        id=row_id(replay.number, value.row, SLOT_NODE),
        identity_id=row_id(replay.number, identity, SLOT_NODE),
        name=added.name,
        object_type=added.object_type,
        pose=pose,
        joints=dict(value.joints),  # the replay may go on
        attached_to=(holder.added.name, parent[1]) if holder is not None and parent is not None else None,
        description_fingerprint=added.description,
        color=added.color,
        model=added.model,
        serial=added.serial,
        mass_kg=added.mass_kg,
        base_link=added.base_link,
    )


def _robot(robot: ObjectThen) -> RobotThen:
    from pycrorm_async.world.urdf import robot_description  # which reading verbs need not load

    description = robot_description(robot.model or robot.name)
    torso = description.torso_joint if description is not None else None
    return RobotThen(robot.name, robot.pose, robot.joints.get(torso) if torso is not None else None)
