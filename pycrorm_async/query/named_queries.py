"""Query the episodes of a memory and the task tree of one of them, as plain values ready to be printed."""

from __future__ import annotations

from collections import Counter
from collections.abc import Iterator, Mapping, Sequence
from dataclasses import dataclass, field, fields
from datetime import UTC, datetime
from enum import Enum
from typing import Any, TypeAlias

from sqlalchemy import ColumnElement, Row, Select, and_, exists, func, or_, select
from sqlalchemy.ext.asyncio import AsyncConnection, AsyncSession

from pycrorm_async import orm
from pycrorm_async.errors import CallerError
from pycrorm_async.events.ids import SLOT_NODE, row_id, row_key
from pycrorm_async.events.types import LocationResolved, ObjectDetected
from pycrorm_async.orm.base import same_row
from pycrorm_async.query import frames
from pycrorm_async.query.frames import of_episode
from pycrorm_async.query.running_episodes import RobotSummary, robots_of
from pycrorm_async.query.text import NotebookValue, with_object_names
from pycrorm_async.store.log import number_named
from pycrorm_async.store.stored import StoredEvent
from pycrorm_async.task_status import TaskStatus


@dataclass(frozen=True)
class SimulatingNode:
    """The node that performed a simulation.

    Attributes:
        id: the UUID of its episode.
        episode, node: the number of that episode and the id of the node; None where this database does not have it.
        dtype: the node's designator type; None also at the root.
    """

    id: str
    episode: int | None
    node: int | None
    dtype: str | None


@dataclass(frozen=True)
class EpisodeSummary(NotebookValue):
    """One episode.

    Attributes:
        number, id: its number in this database, its UUID.
        duration_ns: from its first to its last event by the monotonic clock; None while it runs.
        end_sequence: the sequence of its last event; None while it runs.
        nodes, failed: number of nodes in its task tree, the root included, and of those that FAILED, ended in ERROR or
            are LOST.
        failed_actions: number of actions that FAILED or ended in ERROR.
        simulated: whether it is a simulation, performed in a copy of the world.
        thought_by: the node that performed this simulation, if recorded.
        continues: UUID of the episode that this one continues.
        continued_in: UUID of the episode that continues this one.
        plan, plan_sha256, git_commit, git_dirty: the plan's name, the hash of its file, the commit of its repository,
            and whether the work tree differed from it.
        world: the world in one line; see `ProcessMetaData.world`.
        libraries, settings: version by package; the settings that differ from their defaults.
        clock_synchronized, clock_error_us: whether a time service kept the clock, and its estimated error.
        robots: the robots that took part, in the order in which they were added.
        digest_sequence, digest: the last digest that the log keeps of this episode, and the event up to which it covers
            the episode; None if there is none.
        tags: in alphabetical order.
        metadata: given by the program that opened it.
    """

    number: int
    id: str
    started_at: datetime
    ended_at: datetime | None
    duration_ns: int | None
    status: str
    description: str
    created_by: str
    nodes: int
    failed: int
    simulated: bool = False
    thought_by: SimulatingNode | None = None
    continues: str | None = None
    continued_in: str | None = None
    end_sequence: int | None = None
    plan: str | None = None
    plan_sha256: str | None = None
    git_commit: str | None = None
    git_dirty: bool | None = None
    world: str | None = None
    libraries: dict[str, str] | None = None
    settings: dict[str, Any] | None = None
    clock_synchronized: bool | None = None
    clock_error_us: int | None = None
    robots: tuple[RobotSummary, ...] = ()
    digest_sequence: int | None = None
    digest: str | None = None
    tags: tuple[str, ...] = ()
    metadata: dict[str, Any] | None = None
    failed_actions: int = field(default=0, compare=False)

    @property
    def status_text(self) -> str:
        """The status, and of an episode that SUCCEEDED how many of its actions failed."""
        if self.status != TaskStatus.SUCCEEDED.name or not self.failed_actions:
            return self.status
        return f"{self.status}, {self.failed_actions:,} action{'s' * (self.failed_actions > 1)} failed"


@dataclass(frozen=True)
class NodeSummary:
    """One node of a task tree.

    Attributes:
        depth: 0 at the root.
        dtype: its designator type; None at the root, and of a type that could not be declared.
        duration_ns: None while it runs, and if it is LOST.
        sequence, end_sequence: the events of its start and its end; `end_sequence` is None while it runs, and if it is
            LOST.
        parameters: as recorded, empty at the root; a reference to an object of the world also has the object's name.
        reason, failure_message: the reason and the text of the failure it ended with.
        outcome: how the plan went on after it failed (`RootFailure.outcome`); None for a node that did not.
        thoughts: numbers of the simulations that it performed.
        observations: number of observations that a program made at it.
        considered, offered: number of places that location designators checked for it, and of those they offered.
        detected: number of percepts that it had.
        start_ns: of the robot's monotonic clock, which only the times of one episode are compared by.
        robot: the name of the robot that acted; None if there is none.
    """

    id: int
    parent_id: int | None
    depth: int
    dtype: str | None
    kind: str
    parameters: dict[str, Any]
    status: str
    started_at: datetime
    duration_ns: int | None
    reason: str | None
    failure_message: str | None
    simulated: bool
    sequence: int
    end_sequence: int | None
    thoughts: tuple[int, ...] = ()
    observations: int = 0
    considered: int = 0
    offered: int = 0
    detected: int = 0
    start_ns: int = field(default=0, compare=False)
    outcome: str | None = field(default=None, compare=False)
    robot: str | None = field(default=None, compare=False)


_OF_EPISODE = {each.name for each in fields(EpisodeSummary)} & {*orm.ProcessMetaData.__table__.c.keys()}
_OF_NODE = {each.name for each in fields(NodeSummary)} & {*orm.TaskTreeNode.__table__.c.keys()}
_OF_EPISODE -= {"id", "thought_by"}
_OF_NODE -= {"status"}
"""The fields that are columns of the same name."""
_AT_ONCE = 500
"""Bounds the episodes that one query names, because a database takes 32,766 parameters."""


async def episodes(connection: AsyncConnection, chosen: int | EpisodeChoice | None = None) -> list[EpisodeSummary]:
    """Return every episode that the connection sees, the oldest first; or one by its number, or a choice."""
    if isinstance(chosen, int):
        return await _summaries(connection, [chosen])
    newest = (EpisodeChoice() if chosen is None else chosen).newest()
    numbers = sorted((await connection.execute(newest)).scalars())
    parts = [numbers[first : first + _AT_ONCE] for first in range(0, len(numbers), _AT_ONCE)]
    return [each for part in parts for each in await _summaries(connection, part)]


async def _summaries(connection: AsyncConnection, numbers: Sequence[int]) -> list[EpisodeSummary]:
    """Return the episodes with these numbers, by number."""
    episode = orm.ProcessMetaData.__table__
    query = select(episode).where(episode.c.id.in_(numbers)).order_by(episode.c.id)
    rows = (await connection.execute(query)).all()
    simulating = await _simulating_nodes(connection, rows)
    robots = await robots_of(connection, numbers)
    tags: dict[int, list[str]] = {}
    tag_row, node = orm.EpisodeTag.__table__.c, orm.TaskTreeNode.__table__.c
    tagged = select(tag_row.process_metadata_id, tag_row.tag).order_by(tag_row.tag)
    for number, tag in await connection.execute(tagged.where(tag_row.process_metadata_id.in_(numbers))):
        tags.setdefault(number, []).append(tag)
    ended_badly = frames.times_with(node.status.in_([TaskStatus.FAILED, TaskStatus.ERROR, TaskStatus.LOST]))
    raised = frames.times_with(node.status.in_([TaskStatus.FAILED, TaskStatus.ERROR]) & (node.kind == "action"))
    counted = select(node.process_metadata_id, func.count(), ended_badly, raised).group_by(node.process_metadata_id)
    counts = {row[0]: row[1:] for row in await connection.execute(counted.where(node.process_metadata_id.in_(numbers)))}
    return [
        EpisodeSummary(
            number=row.id,
            id=row.uuid,
            started_at=row.created_at,
            duration_ns=None if row.end_ns is None else row.end_ns - row.start_ns,
            nodes=nodes,
            failed=int(failed),
            failed_actions=int(failed_actions),
            thought_by=simulating.get(row.id),
            robots=tuple(robots.get(row.id, ())),
            tags=tuple(tags.get(row.id, ())),
            **{name: getattr(row, name) for name in _OF_EPISODE},
        )
        for row in rows
        for nodes, failed, failed_actions in [counts.get(row.id, (0, 0, 0))]
    ]


async def _simulating_nodes(connection: AsyncConnection, episodes: Sequence[Row[Any]]) -> dict[int, SimulatingNode]:
    """Return the nodes that performed these simulations, by the number of the simulation."""
    simulated = [each for each in episodes if each.thought_by is not None]
    if not simulated:
        return {}
    episode, node = orm.ProcessMetaData.__table__.c, orm.TaskTreeNode.__table__.c
    named = select(episode.uuid, episode.id).where(episode.uuid.in_({each.thought_by for each in simulated}))
    numbers: dict[str, int] = {row[0]: row[1] for row in await connection.execute(named)}
    ids = {
        each.id: row_id(numbers[each.thought_by], each.thought_by_node, SLOT_NODE)
        for each in simulated
        if each.thought_by in numbers and each.thought_by_node is not None
    }
    by_key = select(node.id, node.dtype).where(
        node.id.in_(ids.values()), node.process_metadata_id.in_(numbers.values())
    )
    dtypes: dict[int, str | None] = {row[0]: row[1] for row in await connection.execute(by_key)}
    return {
        each.id: SimulatingNode(
            each.thought_by,
            numbers.get(each.thought_by),
            id_ if (id_ := ids.get(each.id)) in dtypes else None,
            dtypes.get(ids.get(each.id, 0)),
        )
        for each in simulated
    }


async def episode_named(connection: AsyncConnection, name: str) -> EpisodeSummary:
    """Return the episode with this number, id, or first digits of its id; `last` is the newest except simulations.

    Raises `UnknownEpisode`, also when several ids have these first digits.
    """
    episode = orm.ProcessMetaData.__table__.c
    last = select(func.max(episode.id)).where(~episode.simulated)
    number = (await connection.execute(last)).scalar() if name == "last" else None
    if number is None:
        listed = select(func.count()).where(~episode.simulated)
        number = await number_named(connection, name, episode.id, episode.uuid, listed)
    return (await episodes(connection, number))[0]


def nodes_of(number: int) -> Select[*tuple[Any, ...]]:
    """Return the select of an episode's nodes with their parameters."""
    table, designator = orm.TaskTreeNode.__table__, orm.Designator.__table__
    return (
        select(table, designator.c.parameters)
        .outerjoin(designator, same_row(designator, table))
        .where(table.c.process_metadata_id == number)
        .order_by(table.c.id)
    )


async def task_tree(connection: AsyncConnection, number: int) -> list[NodeSummary]:
    """Return the nodes of an episode, each before its children, children in the order in which they started."""
    objects = orm.Object.__table__
    named = select(objects.c.id, objects.c.name).where(objects.c.process_metadata_id == number)
    names = {row.id: row.name for row in await connection.execute(named)}
    simulations = await _simulations_by_node(connection, number)
    observed, seen, search = (each.__table__.c for each in (orm.Observation, orm.Detection, orm.LocationResolution))

    async def by_node(row: Any, *sums: Any) -> dict[int, Any]:
        counted = select(row.node_id, *sums).where(row.process_metadata_id == number).group_by(row.node_id)
        return {node: sums for node, *sums in await connection.execute(counted)}

    observations, detected = await by_node(observed, func.count()), await by_node(seen, func.count())
    places = await by_node(search, func.sum(search.considered), func.sum(search.offered))
    rows = {row.id: row for row in await connection.execute(nodes_of(number))}
    tree = []
    for key, depth in depth_first({key: row.parent_id for key, row in rows.items()}):
        row = rows[key]
        parameters = with_object_names(
            row.parameters or {}, lambda each: names.get(row_id(number, each["row"], SLOT_NODE))
        )
        considered, offered = map(int, places.get(key, (0, 0)))
        tree.append(
            NodeSummary(
                depth=depth,
                parameters=parameters,
                status=_name(row.status),
                started_at=row.start_time,
                duration_ns=None if row.end_ns is None else row.end_ns - row.start_ns,
                thoughts=tuple(simulations.get(key, ())),
                sequence=row_key(key).sequence,
                observations=observations.get(key, (0,))[0],
                considered=considered,
                offered=offered,
                detected=detected.get(key, (0,))[0],
                **{name: getattr(row, name) for name in _OF_NODE},
            )
        )
    return tree


def depth_first(parents: Mapping[int, int | None]) -> Iterator[tuple[int, int]]:
    """Yield each node with its depth, parents first, children in the order of `parents`, which has each node's parent.

    >>> [*depth_first({1: None, 2: 1, 3: 1, 4: 2})]
    [(1, 0), (2, 1), (4, 2), (3, 1)]
    """
    children: dict[int | None, list[int]] = {}
    for node, parent in parents.items():
        children.setdefault(parent, []).append(node)
    stack = [(node, 0) for node in reversed(children.get(None, []))]
    while stack:
        node, depth = stack.pop()
        yield node, depth
        stack.extend((child, depth + 1) for child in reversed(children.get(node, [])))


async def observed_contents(connection: AsyncConnection, number: int) -> list[tuple[str, int, int | None]]:
    """Return name, event and node of each observation of an episode that has a content."""
    observation, value = orm.Observation, orm.ObservationValue
    contents = select(value.id).where(value.process_metadata_id == number, value.blob.is_not(None))
    observed = select(observation.name, observation.id, observation.node_id).where(observation.id.in_(contents))
    rows = await connection.execute(observed)
    return [(row.name, row_key(row.id).sequence, row.node_id) for row in rows]


async def _simulations_by_node(connection: AsyncConnection, number: int) -> dict[int, list[int]]:
    """Return the numbers of the simulations of this episode, by the id of the node that performed them."""
    episodes = orm.ProcessMetaData.__table__
    simulating, simulation = episodes.alias().c, episodes.c
    own = select(simulating.uuid).where(simulating.id == number).scalar_subquery()
    query = (
        select(simulation.id, simulation.thought_by_node)
        .where(simulation.thought_by == own, simulation.thought_by_node.is_not(None))
        .order_by(simulation.id)
    )
    numbers: dict[int, list[int]] = {}
    for row in await connection.execute(query):
        numbers.setdefault(row_id(number, row.thought_by_node, SLOT_NODE), []).append(row.id)
    return numbers


# === episode list =============================================================================================
#
# Choose episodes by status, start, tags, robot, text: for `memory.ask.episodes`, `pycrorm episodes` and reports.


@dataclass(frozen=True)
class EpisodeChoice:
    """Conditions on episodes; None means no condition.

    Attributes:
        status: the name of a `TaskStatus`.
        since: the earliest start, with a time zone.
        tags: an episode has all of them.
        robot: name or model of a robot that took part.
        text: a part of the description, the plan's name or a tag.
        limit: the largest number of episodes; the newest that fulfil all conditions are taken.
        without_tags: an episode has none of them.
        ids: the UUIDs to choose from.
    """

    status: str | None = None
    since: datetime | None = None
    tags: tuple[str, ...] = ()
    robot: str | None = None
    text: str | None = None
    limit: int | None = None
    without_tags: tuple[str, ...] = ()
    ids: tuple[str, ...] | None = None

    def __post_init__(self) -> None:
        frames.check_texts({"status": self.status, "robot": self.robot, "text": self.text})
        for each in (*self.tags, *self.without_tags):
            frames.check_texts({"tag": each})
        if self.since is not None and not isinstance(self.since, datetime):
            raise CallerError(f"since must be a datetime with a time zone, got {self.since!r}")
        if self.since is not None and self.since.tzinfo is None:
            raise CallerError(f"since has no time zone: {self.since.isoformat()}")
        # Both are built again for each query; here they raise where the choice is made.
        self.conditions()
        frames.limited(select(), self.limit)

    def __str__(self) -> str:
        """Return the conditions as `status FAILED; tags night, kitchen; the newest 10`; empty if there is none."""
        conditions = {
            "status": self.status,
            "since": None if self.since is None else f"{self.since.astimezone(UTC):%Y-%m-%d %H:%M:%S} UTC",
            "tags" if len(self.tags) > 1 else "tag": ", ".join(self.tags) or None,
            "without": ", ".join(self.without_tags) or None,
            "robot": self.robot,
            "text": self.text,
            "the newest": self.limit,
        }
        return "; ".join(f"{name} {value}" for name, value in conditions.items() if value is not None)

    def conditions(self) -> list[ColumnElement[bool]]:
        """Return the conditions on `ProcessMetaData`, without the limit. Raises `CallerError` for a wrong status.

        They name columns of its table, as all that lists episodes: attributes of classes would map all classes first.
        """
        episode, tag_row = orm.ProcessMetaData.__table__.c, orm.EpisodeTag.__table__.c
        conditions: list[ColumnElement[bool]] = []
        if self.status is not None:
            conditions.append(episode.status == frames.member_of(TaskStatus, self.status, "status"))
        if self.since is not None:
            conditions.append(episode.created_at >= self.since)
        tagged = {
            each: exists().where(tag_row.process_metadata_id == episode.id, tag_row.tag == each)
            for each in (*self.tags, *self.without_tags)
        }
        conditions += [tagged[each] for each in self.tags]
        conditions += [~tagged[each] for each in self.without_tags]
        if self.ids is not None:
            conditions.append(episode.uuid.in_(self.ids))
        if self.robot is not None:
            robot = orm.EpisodeRobot.__table__.c
            named = or_(robot.name == self.robot, robot.model == self.robot)
            conditions.append(exists().where(robot.process_metadata_id == episode.id, named))
        if self.text is not None:
            by_tag = exists().where(
                tag_row.process_metadata_id == episode.id, frames.containing(self.text, tag_row.tag)
            )
            conditions.append(or_(frames.containing(self.text, episode.description, episode.plan), by_tag))
        return conditions

    def counted(self) -> Select[*tuple[int]]:
        """Return the select of the number of episodes that fulfil the conditions, whatever the limit."""
        return select(func.count(orm.ProcessMetaData.__table__.c.id)).where(*self.conditions())

    def newest(self) -> Select[*tuple[int]]:
        """Return the select of the numbers of the chosen episodes."""
        number = orm.ProcessMetaData.__table__.c.id
        return frames.limited(select(number).where(*self.conditions()).order_by(number.desc()), self.limit)


def episode_list(episode: Any, choice: EpisodeChoice) -> Select[*tuple[Any, ...]]:
    """Select the chosen episodes with their outcomes, the newest first."""
    listed = orm.ProcessMetaData
    statement = select(
        listed.id.label("episode"),
        listed.uuid.label("id"),
        listed.created_at.label("started_at"),
        listed.ended_at,
        listed.duration_s,
        listed.status,
        listed.description,
        listed.plan,
        listed.created_by,
        listed.world,
        listed.failure_type,
        listed.failure_message,
        listed.continues,
    )
    conditions = frames.needed(of_episode(listed.id, episode), *choice.conditions())
    return frames.limited(statement.where(*conditions).order_by(listed.id.desc()), choice.limit)


# === percepts and places ======================================================================================
#
# List the percepts of an episode and its searches for places, from its events or from the tables.

Position: TypeAlias = "tuple[float, ...]"


@dataclass(frozen=True)
class Percept:
    """A percept.

    Attributes:
        sequence: of the event of its detection.
        node: id of the node that asked perception.
        looked_for: the type that was searched for; None for any type.
        object_id: of the matching object's row in `orm.Object`; None if the percept matches no object.
        position, orientation: in m, and as a unit quaternion (x, y, z, w).
    """

    sequence: int
    node: int | None
    name: str
    object_type: str
    source: str
    looked_for: str | None
    object_id: int | None
    position: Position
    orientation: Position
    confidence: float | None
    visible: float | None


@dataclass(frozen=True)
class PlaceSearch:
    """The answer of a location designator to one request for a place.

    Attributes:
        sequence: of its event.
        node: id of the node that made the request.
        location: class of the location designator.
        considered, offered: the number of places it checked, and of those it offered.
        taken: position of the place that the plan used, in m; None if it used none.
        refused: the number of recorded refusals, by reason, the most frequent first.
    """

    sequence: int
    node: int | None
    location: str
    considered: int
    offered: int
    taken: Position | None
    refused: Mapping[str, int] = field(default_factory=dict)


def counts_text(node: NodeSummary) -> str:
    """Return how many places were considered and offered at a node and how many percepts it had; empty without any."""
    places = f"considered {node.considered}, offered {node.offered}" if node.considered or node.offered else ""
    return "; ".join(filter(None, (places, f"detected {node.detected}" if node.detected else "")))


# --- from events --------------------------------------------------------------------------------------------------


def percepts_in(number: int, event: StoredEvent, detected: ObjectDetected) -> list[Percept]:
    """Return the percepts of a detection in the episode with this number."""
    return [
        Percept(
            event.sequence,
            _row(number, detected.node),
            each.name,
            each.object_type,
            each.source or detected.source,
            detected.object_type,
            _row(number, each.object.row if each.object is not None else None),
            tuple(each.pose.position),
            tuple(each.pose.orientation),
            each.confidence,
            each.visible,
        )
        for each in detected.seen
    ]


def search_in(number: int, event: StoredEvent, resolved: LocationResolved) -> PlaceSearch:
    """Return the search for a place of an event in the episode with this number."""
    taken = resolved.taken
    at = resolved.offered[taken].pose.position if taken is not None and 0 <= taken < len(resolved.offered) else None
    return PlaceSearch(
        event.sequence,
        _row(number, resolved.node),
        resolved.location,
        resolved.considered,
        len(resolved.offered) + resolved.offered_beyond,
        tuple(at) if at is not None else None,
        _by_frequency(Counter(each.reason for each in resolved.refused)),
    )


def _row(number: int, sequence: int | None) -> int | None:
    return None if sequence is None else row_id(number, sequence, SLOT_NODE)


def _by_frequency(counts: Mapping[str, int]) -> dict[str, int]:
    return dict(sorted(counts.items(), key=lambda each: (-each[1], each[0])))


# --- from the tables ----------------------------------------------------------------------------------------------


async def percepts_of(session: AsyncSession, number: int) -> Sequence[Percept]:
    """Read the percepts of an episode, in the order of the events."""
    seen = orm.Detection.__table__
    of_episode = select(seen).where(seen.c.process_metadata_id == number)
    rows = await session.execute(of_episode.order_by(seen.c.id, seen.c.position))
    return [
        Percept(
            row_key(row.id).sequence,
            row.node_id,
            row.name,
            _name(row.obj_type),
            row.source,
            _name(row.looked_for),
            row.object_id,
            (row.x, row.y, row.z),
            (row.qx, row.qy, row.qz, row.qw),
            row.confidence,
            row.visible,
        )
        for row in rows
    ]


def _name(value: Any) -> Any:
    """Return the name of an enum's member; other values unchanged, such as a type of a newer version."""
    return value.name if isinstance(value, Enum) else value


async def searches_of(session: AsyncSession, number: int) -> Sequence[PlaceSearch]:
    """Read the searches for places of an episode, in the order of the events."""
    resolution, place, refusal = orm.LocationResolution, orm.Pose, orm.LocationRefusal
    counted = select(refusal.resolution_id, refusal.reason, func.count()).where(refusal.process_metadata_id == number)
    reasons: dict[int, dict[str, int]] = {}
    for key, reason, count in await session.execute(counted.group_by(refusal.resolution_id, refusal.reason)):
        reasons.setdefault(key, {})[reason] = count
    columns = (
        resolution.id,
        resolution.node_id,
        resolution.location,
        resolution.considered,
        resolution.offered,
        place.x,
        place.y,
        place.z,
    )
    rows = await session.execute(
        select(*columns)
        .outerjoin(
            place, and_(place.id == resolution.pose_id, place.process_metadata_id == resolution.process_metadata_id)
        )
        .where(resolution.process_metadata_id == number)
        .order_by(resolution.id)
    )
    return [
        PlaceSearch(
            row_key(row.id).sequence,
            row.node_id,
            row.location,
            row.considered,
            row.offered,
            None if row.x is None else (row.x, row.y, row.z),
            _by_frequency(reasons.get(row.id, {})),
        )
        for row in rows
    ]
