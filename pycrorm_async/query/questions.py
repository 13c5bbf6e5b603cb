"""Questions with a name: which episodes there are, and what one of them did, as plain values ready to be printed."""

from __future__ import annotations

from collections.abc import Iterator, Mapping
from dataclasses import dataclass, replace
from datetime import datetime, timedelta
from typing import Any

from sqlalchemy import func, select
from sqlalchemy.ext.asyncio import AsyncEngine

from pycrorm_async.errors import UnknownEpisode
from pycrorm_async.events.ids import SLOT_NODE, row_id
from pycrorm_async.orm import Designator, Object, ProcessMetaData, TaskTreeNode
from pycrorm_async.plan.task_tree import TaskStatus

__all__ = ["EpisodeSummary", "NodeSummary", "episodes", "episode_named", "task_tree"]


@dataclass(frozen=True)
class EpisodeSummary:
    """One episode.

    Attributes:
        number, id: its number in this database, its UUID.
        duration_ns: from its first to its last event; None while it runs.
        nodes: of its task tree, the root included; `failed` of them ended otherwise than well.
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


@dataclass(frozen=True)
class NodeSummary:
    """One node of a task tree.

    Attributes:
        depth: 0 at the root.
        dtype: what was performed; None at the root.
        duration_ns: None while it runs, and if it was LOST.
        parameters: as they were recorded, empty at the root; a reference to an object of the world has its name too.
        reason, failure_message: the class and the text of the failure it ended with.
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


async def episodes(engine: AsyncEngine) -> list[EpisodeSummary]:
    """Every episode, the oldest first."""
    node = TaskTreeNode
    ended_well = node.status.in_([TaskStatus.SUCCEEDED, TaskStatus.RUNNING])
    counted = (
        select(
            node.process_metadata_id.label("number"),
            func.count().label("nodes"),
            func.count().filter(~ended_well).label("failed"),
        )
        .group_by(node.process_metadata_id)
        .subquery()
    )
    question = (
        select(
            ProcessMetaData.__table__,
            func.coalesce(counted.c.nodes, 0).label("nodes"),
            func.coalesce(counted.c.failed, 0).label("failed"),
        )
        .outerjoin(counted, counted.c.number == ProcessMetaData.id)
        .order_by(ProcessMetaData.id)
    )
    async with engine.connect() as connection:
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
            )
            for row in await connection.execute(question)
        ]


async def episode_named(engine: AsyncEngine, name: str) -> EpisodeSummary:
    """The episode of that number, or id, or first digits of its id; `last` is the newest one.

    Raises `UnknownEpisode`, also when several ids begin like that.
    """
    known = await episodes(engine)
    if name == "last" and known:
        return known[-1]
    if name.isdecimal():
        # A short one is a number; a long one may be the beginning of an id that happens to have no letter.
        by_number = [each for each in known if each.number == int(name)]
        if by_number:
            return by_number[0]
    found = [each for each in known if len(name) >= 4 and each.id.startswith(name.lower())]
    if len(found) == 1:
        return found[0]
    if found:
        raise UnknownEpisode(f"{len(found)} episodes have an id that begins with {name!r}: give more of it")
    raise UnknownEpisode(f"there is no episode {name!r} (`pycrorm episodes` lists the {len(known)} there are)")


async def task_tree(engine: AsyncEngine, number: int) -> list[NodeSummary]:
    """The nodes of an episode, each before its children, children in the order they started; empty without any."""
    table, designator, thing = TaskTreeNode.__table__, Designator.__table__, Object.__table__
    question = (
        select(table, designator.c.parameters)
        .outerjoin(designator, designator.c.id == table.c.id)
        .where(table.c.process_metadata_id == number)
        .order_by(table.c.id)
    )
    named = select(thing.c.id, thing.c.name).where(thing.c.process_metadata_id == number)
    children: dict[int | None, list[NodeSummary]] = {}
    async with engine.connect() as connection:
        names = {row.id: row.name for row in await connection.execute(named)}
        for row in await connection.execute(question):
            children.setdefault(row.parent_id, []).append(
                NodeSummary(
                    id=row.id,
                    parent_id=row.parent_id,
                    depth=0,
                    dtype=row.dtype,
                    kind=row.kind,
                    parameters={
                        name: _with_name(value, number, names) for name, value in (row.parameters or {}).items()
                    },
                    status=row.status.name if isinstance(row.status, TaskStatus) else row.status,
                    started_at=row.start_time,
                    duration_ns=None if row.end_ns is None else row.end_ns - row.start_ns,
                    reason=row.reason,
                    failure_message=row.failure_message,
                    simulated=row.simulated,
                )
            )
    return list(_depth_first(children))


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
