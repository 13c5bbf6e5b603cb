"""Questions with a name: which episodes there are, and what one of them did, as plain values ready to be printed."""

from __future__ import annotations

from collections.abc import Iterator, Mapping
from dataclasses import dataclass, replace
from datetime import datetime, timedelta
from typing import Any

from sqlalchemy import Select, func, select
from sqlalchemy.ext.asyncio import AsyncConnection
from sqlalchemy.orm import aliased

from pycrorm_async.events.ids import SLOT_NODE, row_id
from pycrorm_async.orm import Designator, Object, ProcessMetaData, TaskTreeNode
from pycrorm_async.store.episode_lookup import number_named
from pycrorm_async.task_status import TaskStatus

__all__ = ["EpisodeSummary", "NodeSummary", "Thinker", "episodes", "episode_named", "task_tree"]


@dataclass(frozen=True)
class Thinker:
    """The node in which a plan was thought through.

    Attributes:
        id: the UUID of its episode.
        episode, node: the number of that episode and the id of the node; None where this database does not have it.
        dtype: what was performed; None also at the root.
    """

    id: str
    episode: int | None
    node: int | None
    dtype: str | None


@dataclass(frozen=True)
class EpisodeSummary:
    """One episode.

    Attributes:
        number, id: its number in this database, its UUID.
        duration_ns: from its first to its last event; None while it runs.
        nodes: of its task tree, the root included; `failed` of them failed, raised an error or were lost.
        simulated: it was thought through in a copy of the world, and nothing of it happened.
        thought_by: who thought it, as far as that is known.
        continues: UUID of the episode of which this one is the rest.
        continued_in: UUID of the episode that is the rest of this one.
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
    thought_by: Thinker | None = None
    continues: str | None = None
    continued_in: str | None = None


@dataclass(frozen=True)
class NodeSummary:
    """One node of a task tree.

    Attributes:
        depth: 0 at the root.
        dtype: what was performed; None at the root.
        duration_ns: None while it runs, and if it was LOST.
        parameters: as they were recorded, empty at the root; a reference to an object of the world has its name too.
        reason, failure_message: the class and the text of the failure it ended with.
        thoughts: numbers of the episodes that were thought through in it.
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
    thoughts: tuple[int, ...] = ()


async def episodes(connection: AsyncConnection, number: int | None = None) -> list[EpisodeSummary]:
    """Every episode that the connection sees, the oldest first; or only the one of that number."""
    question = _overview()
    if number is not None:
        question = question.where(ProcessMetaData.id == number)
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
            thought_by=Thinker(row.thought_by, row.thinker_number, row.thinker_id, row.thinker_dtype)
            if row.thought_by is not None
            else None,
            continues=row.continues,
            continued_in=row.continued_in,
        )
        for row in await connection.execute(question)
    ]


def _overview() -> Select[*tuple[Any, ...]]:
    node, episode = TaskTreeNode, ProcessMetaData
    thinker, thinking = aliased(ProcessMetaData), aliased(TaskTreeNode)
    ended_badly = node.status.in_([TaskStatus.FAILED, TaskStatus.ERROR, TaskStatus.LOST])
    of_it = node.process_metadata_id == episode.id
    nodes = select(func.count()).where(of_it).scalar_subquery()
    failed = select(func.count()).where(of_it, ended_badly).scalar_subquery()
    thinking_id = thinker.id * row_id(1, 0, SLOT_NODE) + episode.thought_by_node * row_id(0, 1, SLOT_NODE)
    return (
        select(
            episode.__table__,
            nodes.label("nodes"),
            failed.label("failed"),
            thinker.id.label("thinker_number"),
            thinking.id.label("thinker_id"),
            thinking.dtype.label("thinker_dtype"),
        )
        .outerjoin(thinker, thinker.uuid == episode.thought_by)
        .outerjoin(thinking, thinking.id == thinking_id)
        .order_by(episode.id)
    )


async def episode_named(connection: AsyncConnection, name: str) -> EpisodeSummary:
    """The episode of that number, or id, or first digits of its id; `last` is the newest that really happened.

    Raises `UnknownEpisode`, also when several ids begin like that.
    """
    question = select(ProcessMetaData.id, ProcessMetaData.uuid, ProcessMetaData.simulated).order_by(ProcessMetaData.id)
    known = (await connection.execute(question)).all()
    real = [each.id for each in known if not each.simulated]
    ids = {each.id: each.uuid for each in known}
    number = real[-1] if name == "last" and real else number_named(name, ids, listed=len(real))
    return (await episodes(connection, number))[0]


async def task_tree(connection: AsyncConnection, number: int) -> list[NodeSummary]:
    """The nodes of an episode, each before its children, children in the order they started; empty without any."""
    table, designator, thing = TaskTreeNode.__table__, Designator.__table__, Object.__table__
    question = (
        select(table, designator.c.parameters)
        .outerjoin(designator, designator.c.id == table.c.id)
        .where(table.c.process_metadata_id == number)
        .order_by(table.c.id)
    )
    named = select(thing.c.id, thing.c.name).where(thing.c.process_metadata_id == number)
    names = {row.id: row.name for row in await connection.execute(named)}
    thoughts = await _thoughts_by_node(connection, number)
    children: dict[int | None, list[NodeSummary]] = {}
    for row in await connection.execute(question):
        children.setdefault(row.parent_id, []).append(
            NodeSummary(
                id=row.id,
                parent_id=row.parent_id,
                depth=0,
                dtype=row.dtype,
                kind=row.kind,
                parameters={name: _with_name(value, number, names) for name, value in (row.parameters or {}).items()},
                status=row.status.name if isinstance(row.status, TaskStatus) else row.status,
                started_at=row.start_time,
                duration_ns=None if row.end_ns is None else row.end_ns - row.start_ns,
                reason=row.reason,
                failure_message=row.failure_message,
                simulated=row.simulated,
                thoughts=tuple(thoughts.get(row.id, ())),
            )
        )
    return list(_depth_first(children))


async def _thoughts_by_node(connection: AsyncConnection, number: int) -> dict[int, list[int]]:
    """By the id of the node of this episode that thought them, the numbers of what was thought through."""
    thinker, thought = aliased(ProcessMetaData), ProcessMetaData
    question = (
        select(thought.id, thought.thought_by_node)
        .join(thinker, thinker.uuid == thought.thought_by)
        .where(thinker.id == number, thought.thought_by_node.is_not(None))
        .order_by(thought.id)
    )
    found: dict[int, list[int]] = {}
    for row in await connection.execute(question):
        found.setdefault(row_id(number, row.thought_by_node, SLOT_NODE), []).append(row.id)
    return found


def _depth_first(children: dict[int | None, list[NodeSummary]]) -> Iterator[NodeSummary]:
    waiting = [(node, 0) for node in reversed(children.get(None, []))]
    while waiting:
        node, depth = waiting.pop()
        yield replace(node, depth=depth)
        waiting.extend((child, depth + 1) for child in reversed(children.get(node.id, [])))


def _with_name(value: Any, number: int, names: Mapping[int, str]) -> Any:
    """A reference to an object with the object's name; anything else as it is."""
    if isinstance(value, dict) and value.keys() == {"object", "row"}:
        return {**value, "name": names.get(row_id(number, value["row"], SLOT_NODE))}
    return value


def _nanoseconds(start: datetime, end: datetime | None) -> int | None:
    return None if end is None else (end - start) // timedelta(microseconds=1) * 1000
