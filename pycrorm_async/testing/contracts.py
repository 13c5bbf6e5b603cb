"""Check the contracts of custom projections, designators and executives, on a real memory in a folder of the test.

rows = await check_projection(GraspRate(), plan, tmp_path)
assert [row["arm"] for row in rows["grasp_try"]] == ["LEFT"]
"""

import asyncio
import dataclasses
import inspect
from collections.abc import Awaitable, Callable, Mapping
from datetime import datetime
from enum import Enum
from pathlib import Path
from typing import Any, TypeAlias

from sqlalchemy import Select, column, select, table

from pycrorm_async.errors import CallerError
from pycrorm_async.memory import Memory
from pycrorm_async.operations.rebuild import rebuild_projection
from pycrorm_async.orm import TaskTreeNode
from pycrorm_async.plan import ActionAbstract
from pycrorm_async.projections.custom import Projection, columns_of
from pycrorm_async.projections.custom_tables import states
from pycrorm_async.projections.verify import verify
from pycrorm_async.query.again import names_in_rows
from pycrorm_async.query.reading import Reading
from pycrorm_async.record.recording import Recording
from pycrorm_async.settings import Settings
from pycrorm_async.store.address import shared_address
from pycrorm_async.store.log import EventLog
from pycrorm_async.task_status import TaskStatus

__all__ = ["check_designator", "check_executive", "check_projection"]

Rows: TypeAlias = Mapping[str, list[dict[str, Any]]]


async def check_projection(projection: Projection, plan: Callable[[], Awaitable[object]], folder: Path) -> Rows:
    """Record the plan, and check that the projection can fold it, live and again from the log, with the same rows.

    Returns the rows of each table of the projection, ordered by id. What the plan raises is not caught.

    Raises:
        AssertionError: the projection stopped at an event, or a second fold of the log differs, at the place in the
            message.
        CallerError: the projection has no valid name, version or tables.
    """
    columns_of(projection)
    url = f"sqlite:///{folder}/projection.db"
    async with Memory.open(url, projections=[projection]) as memory:
        async with memory.episode(description=f"the contract of {projection.name}"):
            await plan()
        await memory.flush()
    live = await _rows_of(projection, url)
    async with await EventLog.open(shared_address(url), create=False) as log:
        [state] = [each for each in await states(log, [projection]) if each.name == projection.name]
        second = await verify(log, projections=[projection])
    assert not state.parked, f"{projection.name} stopped: {', '.join(state.parked.values())}"
    assert not second.drift, f"a second fold of {projection.name} differs, so it is not pure: {second.differences[0]}"
    await rebuild_projection(url, projection)
    rebuilt = await _rows_of(projection, url)
    assert rebuilt == live, f"{projection.name} rebuilt has other rows: {rebuilt} instead of {live}"
    return live


async def check_designator(designator: ActionAbstract, folder: Path) -> Any:
    """Perform an action with a memory that refuses unrecordable values, and check that its fields can be queried.

    Returns the row, an instance of the mapped class. Scalars, enums and datetimes are compared with the designator's
    fields; other fields have columns of their own that depend on their type. What `perform` raises is not caught.

    Raises:
        AssertionError: the action has no row, or a field has another value in it.
        DeclarationRefused, Unrecordable: the class or a field cannot be recorded; the message names it and the reason.
    """
    if not dataclasses.is_dataclass(designator):
        raise CallerError(f"{type(designator).__name__} is not a dataclass, so its fields cannot be compared")
    settings = Settings(on_unrecordable="refuse")
    async with Memory.open(f"sqlite:///{folder}/designator.db", settings=settings) as memory:
        await designator.perform()
        await memory.flush()
        async with memory.session() as session:
            mapped = memory.mapped(type(designator))
            row = (await session.scalars(select(mapped).order_by(mapped.id))).first()
    assert row is not None, f"{type(designator).__name__} has no row: does its perform() run?"
    names = names_in_rows(type(designator))
    for field in dataclasses.fields(designator):
        value = getattr(designator, field.name)
        if value is None or isinstance(value, str | int | float | datetime):
            stored = getattr(row, names.get(field.name, field.name))
            expected = value.name if isinstance(value, Enum) and not isinstance(stored, Enum) else value
            assert stored == expected, f"{field.name} is {stored!r} in the table instead of {expected!r}"
    return row


async def check_executive(drive: Callable[[Recording], object], folder: Path) -> list[TaskTreeNode]:
    """Let an executive record into a new memory, and check that nothing is missing, open or out of order.

    `drive` gets the `Memory.recording`, opens episodes with it and closes them. A coroutine function is awaited; an
    ordinary function runs in another thread, because a start may block. What it raises is not caught.

    >>> nodes = await check_executive(lambda recording: my_integration(recording, my_tree), tmp_path)
    >>> assert [(node.dtype, node.status.name) for node in nodes] == [("PickUpAction", "SUCCEEDED")]

    Returns the nodes but the roots of the episodes, in the order of their starts. The memory stays in
    `sqlite:///{folder}/executive.db`, for further queries.

    Raises:
        AssertionError: a call was counted as a fault, a value is missing, a node or an episode did not end, no node
            was recorded, the order of the events is not legal, or a second fold of the log makes other rows.
    """
    url = f"sqlite:///{folder}/executive.db"
    async with Memory.open(url) as memory:
        running = await asyncio.to_thread(drive, memory.recording)
        if inspect.isawaitable(running):
            await running
        faults, missing = memory.status.faults, memory.status.missing
        await memory.flush()
        async with memory.session() as session:
            nodes = list(await session.scalars(select(TaskTreeNode).order_by(TaskTreeNode.id)))
    assert not faults.total, f"{faults.total} faults were counted, the last one: {faults.last}"
    assert not missing.total, f"{missing.total} values are missing, the last one: {missing.last}"
    for each in nodes:
        what = "an episode" if each.dtype is None else f"node {each.id}, a {each.dtype},"
        assert each.status not in (TaskStatus.RUNNING, TaskStatus.LOST), f"{what} did not end: it is {each.status.name}"
    async with await EventLog.open(shared_address(url), create=False) as log:
        second = await verify(log)
    findings = [*second.damages, *second.stopped, *second.differences]
    assert not findings, f"the log or the tables are wrong: {findings[0]}"
    nodes = [each for each in nodes if each.dtype is not None]
    assert nodes, "no node was recorded"
    return nodes


async def _rows_of(projection: Projection, url: str) -> Rows:
    async with Reading.open(url) as reading, reading.session() as session:
        rows: dict[str, list[dict[str, Any]]] = {}
        for name, columns in columns_of(projection).items():
            query: Select[*tuple[Any, ...]] = select(*map(column, columns)).select_from(table(name))
            query = query.order_by(column("id"))
            rows[name] = [dict(row) for row in (await session.execute(query)).mappings()]
        return rows
