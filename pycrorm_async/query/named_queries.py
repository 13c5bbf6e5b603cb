"""Query the episodes of a memory and the task tree of one of them, as plain values ready to be printed."""

from __future__ import annotations

from collections.abc import Iterator
from dataclasses import dataclass, replace
from datetime import datetime, timedelta
from typing import Any

from sqlalchemy import Select, and_, func, select
from sqlalchemy.ext.asyncio import AsyncConnection
from sqlalchemy.orm import aliased

from pycrorm_async.events.ids import SLOT_NODE, row_id, row_key
from pycrorm_async.orm import (
    Designator,
    Detection,
    EpisodeTag,
    LocationResolution,
    Object,
    Observation,
    ProcessMetaData,
    TaskTreeNode,
)
from pycrorm_async.orm.base import same_row
from pycrorm_async.query.asking.episode_list import EpisodeChoice
from pycrorm_async.query.parameter_text import with_object_names
from pycrorm_async.query.running_episodes import RobotSummary, robots_of
from pycrorm_async.query.value_html import NotebookValue
from pycrorm_async.store.episode_lookup import number_named
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
        duration_ns: from its first to its last event; None while it runs.
        end_sequence: the sequence of its last event; None while it runs.
        nodes, failed: number of nodes in its task tree, the root included, and of those that FAILED, ended in ERROR or
            are LOST.
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
            the episode; None without one.
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
        reason, failure_message: the class and the text of the failure it ended with.
        thoughts: numbers of the simulations that it performed.
        observations: number of observations that a program made at it.
        considered, offered: number of places that location designators checked for it, and of those they offered.
        detected: number of percepts that it had.
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


async def episodes(connection: AsyncConnection, chosen: int | EpisodeChoice | None = None) -> list[EpisodeSummary]:
    """Return every episode that the connection sees, the oldest first; or one by its number, or a choice."""
    query = _overview()
    numbers = chosen.newest() if isinstance(chosen, EpisodeChoice) else None if chosen is None else [chosen]
    if numbers is not None:
        query = query.where(ProcessMetaData.id.in_(numbers))
    robots = await robots_of(connection, numbers)
    tags: dict[int, list[str]] = {}
    tagged = select(EpisodeTag.process_metadata_id, EpisodeTag.tag).order_by(EpisodeTag.tag)
    if numbers is not None:
        tagged = tagged.where(EpisodeTag.process_metadata_id.in_(numbers))
    for episode, tag in await connection.execute(tagged):
        tags.setdefault(episode, []).append(tag)
    return [
        EpisodeSummary(
            number=row.id,
            id=row.uuid,
            started_at=row.created_at,
            ended_at=row.ended_at,
            duration_ns=_nanoseconds(row.created_at, row.ended_at),
            status=row.status,
            description=row.description,
            created_by=row.created_by,
            nodes=row.nodes,
            failed=row.failed,
            simulated=row.simulated,
            thought_by=SimulatingNode(row.thought_by, row.simulating_number, row.simulating_id, row.simulating_dtype)
            if row.thought_by is not None
            else None,
            continues=row.continues,
            continued_in=row.continued_in,
            end_sequence=row.end_sequence,
            plan=row.plan,
            plan_sha256=row.plan_sha256,
            git_commit=row.git_commit,
            git_dirty=row.git_dirty,
            world=row.world,
            libraries=row.libraries,
            settings=row.settings,
            clock_synchronized=row.clock_synchronized,
            clock_error_us=row.clock_error_us,
            robots=tuple(robots.get(row.id, ())),
            tags=tuple(tags.get(row.id, ())),
            metadata=row.metadata,
        )
        for row in await connection.execute(query)
    ]


def _overview() -> Select[*tuple[Any, ...]]:
    node, episode = TaskTreeNode, ProcessMetaData
    simulating_episode, simulating_node = aliased(ProcessMetaData), aliased(TaskTreeNode)
    ended_badly = node.status.in_([TaskStatus.FAILED, TaskStatus.ERROR, TaskStatus.LOST])
    of_it = node.process_metadata_id == episode.id
    nodes = select(func.count()).where(of_it).scalar_subquery()
    failed = select(func.count()).where(of_it, ended_badly).scalar_subquery()
    first_row = simulating_episode.id * row_id(1, 0, SLOT_NODE)
    simulating_node_id = first_row + episode.thought_by_node * row_id(0, 1, SLOT_NODE)
    return (
        select(
            episode.__table__,
            nodes.label("nodes"),
            failed.label("failed"),
            simulating_episode.id.label("simulating_number"),
            simulating_node.id.label("simulating_id"),
            simulating_node.dtype.label("simulating_dtype"),
        )
        .outerjoin(simulating_episode, simulating_episode.uuid == episode.thought_by)
        .outerjoin(
            simulating_node,
            and_(
                simulating_node.id == simulating_node_id, simulating_node.process_metadata_id == simulating_episode.id
            ),
        )
        .order_by(episode.id)
    )


async def episode_named(connection: AsyncConnection, name: str) -> EpisodeSummary:
    """Return the episode with this number, id, or first digits of its id; `last` is the newest except simulations.

    Raises `UnknownEpisode`, also when several ids have these first digits.
    """
    query = select(ProcessMetaData.id, ProcessMetaData.uuid, ProcessMetaData.simulated).order_by(ProcessMetaData.id)
    rows = (await connection.execute(query)).all()
    real = [each.id for each in rows if not each.simulated]
    ids = {each.id: each.uuid for each in rows}
    number = real[-1] if name == "last" and real else number_named(name, ids, listed=len(real))
    return (await episodes(connection, number))[0]


def nodes_of(number: int) -> Select[*tuple[Any, ...]]:
    """Return the select of an episode's nodes with their parameters."""
    table, designator = TaskTreeNode.__table__, Designator.__table__
    return (
        select(table, designator.c.parameters)
        .outerjoin(designator, same_row(designator, table))
        .where(table.c.process_metadata_id == number)
        .order_by(table.c.id)
    )


async def task_tree(connection: AsyncConnection, number: int) -> list[NodeSummary]:
    """Return the nodes of an episode, each before its children, children in the order in which they started."""
    objects = Object.__table__
    named = select(objects.c.id, objects.c.name).where(objects.c.process_metadata_id == number)
    names = {row.id: row.name for row in await connection.execute(named)}
    simulations = await _simulations_by_node(connection, number)
    counted = select(Observation.node_id, func.count()).where(Observation.process_metadata_id == number)
    observations = dict(iter(await connection.execute(counted.group_by(Observation.node_id))))
    seen = select(Detection.node_id, func.count()).where(Detection.process_metadata_id == number)
    detected = dict(iter(await connection.execute(seen.group_by(Detection.node_id))))
    sums = func.sum(LocationResolution.considered), func.sum(LocationResolution.offered)
    searched = select(LocationResolution.node_id, *sums).where(LocationResolution.process_metadata_id == number)
    places = {row[0]: row[1:] for row in await connection.execute(searched.group_by(LocationResolution.node_id))}
    children: dict[int | None, list[NodeSummary]] = {}
    for row in await connection.execute(nodes_of(number)):
        parameters = with_object_names(
            row.parameters or {}, lambda each: names.get(row_id(number, each["row"], SLOT_NODE))
        )
        considered, offered = map(int, places.get(row.id, (0, 0)))
        children.setdefault(row.parent_id, []).append(
            NodeSummary(
                id=row.id,
                parent_id=row.parent_id,
                depth=0,
                dtype=row.dtype,
                kind=row.kind,
                parameters=parameters,
                status=row.status.name if isinstance(row.status, TaskStatus) else row.status,
                started_at=row.start_time,
                duration_ns=None if row.end_ns is None else row.end_ns - row.start_ns,
                reason=row.reason,
                failure_message=row.failure_message,
                simulated=row.simulated,
                thoughts=tuple(simulations.get(row.id, ())),
                sequence=row_key(row.id).sequence,
                end_sequence=row.end_sequence,
                observations=observations.get(row.id, 0),
                considered=considered,
                offered=offered,
                detected=detected.get(row.id, 0),
            )
        )
    return list(_depth_first(children))


async def _simulations_by_node(connection: AsyncConnection, number: int) -> dict[int, list[int]]:
    """Return the numbers of the simulations of this episode, by the id of the node that performed them."""
    simulating_episode, simulation = aliased(ProcessMetaData), ProcessMetaData
    query = (
        select(simulation.id, simulation.thought_by_node)
        .join(simulating_episode, simulating_episode.uuid == simulation.thought_by)
        .where(simulating_episode.id == number, simulation.thought_by_node.is_not(None))
        .order_by(simulation.id)
    )
    numbers: dict[int, list[int]] = {}
    for row in await connection.execute(query):
        numbers.setdefault(row_id(number, row.thought_by_node, SLOT_NODE), []).append(row.id)
    return numbers


def _depth_first(children: dict[int | None, list[NodeSummary]]) -> Iterator[NodeSummary]:
    stack = [(node, 0) for node in reversed(children.get(None, []))]
    while stack:
        node, depth = stack.pop()
        yield replace(node, depth=depth)
        stack.extend((child, depth + 1) for child in reversed(children.get(node.id, [])))


def _nanoseconds(start: datetime, end: datetime | None) -> int | None:
    return None if end is None else (end - start) // timedelta(microseconds=1) * 1000
