"""Attributes of queried objects are loaded with them or on access, or reading raises an error with the remedy."""

from __future__ import annotations

import asyncio
import gc
import weakref
from pathlib import Path
from typing import Any

import pytest
from sqlalchemy import event, inspect, select
from sqlalchemy.ext.hybrid import HybridExtensionType
from sqlalchemy.orm import selectinload, undefer

from pycrorm_async import Memory, orm
from pycrorm_async.errors import CallerError, DatabaseUnavailable
from pycrorm_async.events.types import NodeStarted, RobotValue
from pycrorm_async.plan import TransportAction, simulated_robot
from pycrorm_async.query.reading import LoadOnAccess, Reading
from pycrorm_async.store.log import EventLog
from pycrorm_async.world import Arms, BulletWorld, ObjectType, Pose
from pycrorm_async.world import Object as WorldObject
from tests.projections.event_script import NAVIGATE, Script, declarations, name_of, pose
from tests.projections.sql_queries import stored_and_folded

# === loading on access ========================================================================================
#
# Attributes that a query does not load are loaded when they are read, for many objects at once.

_COUNT = 5


@pytest.fixture
async def reading(log: EventLog) -> Reading:
    """A memory with a few navigations."""
    script = Script()
    for number in range(_COUNT):
        robot = RobotValue(pose(number), "ROBOT", 0.25)
        script.put(NodeStarted("action", None, name_of(NAVIGATE), {"target_location": pose(0, number)}, robot))
    await stored_and_folded(log, [*declarations(NAVIGATE), *script.records])
    return Reading(log)


@pytest.fixture
def statements(monkeypatch: pytest.MonkeyPatch) -> list[str]:
    """The statements that loads on access send."""
    sent: list[str] = []
    original = LoadOnAccess.__init__

    def listening(self: LoadOnAccess, engine: Any, *arguments: Any) -> None:
        original(self, engine, *arguments)
        event.listen(engine.sync_engine, "before_cursor_execute", lambda *each: sent.append(each[2]))

    monkeypatch.setattr(LoadOnAccess, "__init__", listening)
    return sent


async def actions_of(reading: Reading) -> list[Any]:
    async with reading.session() as session:
        return list((await session.scalars(select(orm.Action).order_by(orm.Action.id))).all())


def selects(statements: list[str], table: str) -> int:
    return sum(f"FROM {table}" in each for each in statements)


@pytest.mark.soak_on("postgresql")
async def test_an_attribute_is_loaded_for_all_objects_of_a_query_at_once(
    statements: list[str], reading: Reading
) -> None:
    rows = await actions_of(reading)
    assert [type(each) for each in rows] == [orm.NavigateAction] * _COUNT
    assert not statements
    assert [each.target_location_id is not None for each in rows] == [True] * _COUNT
    assert len([each for each in statements if "navigate_action" in each]) == 1
    assert [each.target_location.position.y for each in rows] == list(range(_COUNT))
    assert [each.robot_state.pose.position.x for each in rows] == list(range(_COUNT))
    assert [selects(statements, table) for table in ("robot_state", "position")] == [3, 4]  # for any number of rows


@pytest.mark.soak_on("postgresql")
async def test_a_batch_is_bounded(statements: list[str], reading: Reading, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(orm.base, "BATCH", 2)
    rows = await actions_of(reading)
    assert [each.pose_id is not None for each in rows] == [True] * _COUNT
    assert len([each for each in statements if "navigate_action" in each]) == 3


async def test_attributes_are_loaded_after_the_memory_is_closed_and_in_other_threads(reading: Reading) -> None:
    rows = await actions_of(reading)
    await reading.close()
    assert rows[1].robot_state.pose.position.x == 1
    assert await asyncio.to_thread(lambda: rows[2].pose.position.y) == 2
    assert rows[3].items == []


@pytest.mark.soak_on("postgresql")
async def test_an_object_that_was_loaded_on_access_loads_what_is_read_of_it(reading: Reading) -> None:
    robot_pose = (await actions_of(reading))[1].robot_state.pose
    gc.collect()  # the actions that the query returned, and all that only they kept
    assert robot_pose.position.x == 1


@pytest.mark.soak_on("postgresql")
async def test_a_closed_session_is_freed_with_its_last_object(reading: Reading) -> None:
    async with reading.session() as session:
        session.expunge_all()
        row = (await session.scalars(select(orm.Action).order_by(orm.Action.id).limit(1))).one()
        kept = weakref.ref(session.sync_session)
    del session
    gc.collect()
    assert kept() is not None
    assert row.robot_state is not None
    del row
    gc.collect()
    assert kept() is None


@pytest.mark.soak_on("postgresql")
async def test_an_attribute_is_read_between_the_rows_of_an_open_session(reading: Reading) -> None:
    async with reading.session() as session:
        places = [
            (
                each.robot_state and each.robot_state.pose.x,
                (await session.get_one(orm.TaskTreeNode, each.id)).action is each,
            )
            async for each in await session.stream_scalars(select(orm.Action).order_by(orm.Action.id))
        ]
    assert places == [(number, True) for number in range(_COUNT)]


async def test_a_database_that_is_away_is_named_when_an_attribute_is_read(
    reading: Reading, database_url: str, request: pytest.FixtureRequest
) -> None:
    rows = await actions_of(reading)
    address = reading._address
    await reading.close()
    if address.is_sqlite:
        address.path.unlink()
    else:
        request.getfixturevalue("server").drop(database_url)
    with pytest.raises(DatabaseUnavailable):
        _ = rows[0].robot_state
    assert (
        repr(rows[0]) == f"NavigateAction(id={rows[0].id}, process_metadata_id=1, dtype='NavigateAction',"
        f" kind='action', robot_state_id={rows[0].id})"
    )


# === loaded attributes ========================================================================================
#
# Every attribute of an object from a query is loaded, or reading it raises an error that names the remedy.

CLASSES = [getattr(orm, name) for name in orm.__all__ if name != "Base"]
ON_REQUEST = {"children", "ancestors", "node", "parameters", "refusals", "description", "robots", "outcome"}
ON_REQUEST_OF_PICK_UPS = {"object_z", "object_qx", "object_qy", "object_qz", "object_qw", "height_over_torso"}
ON_REQUEST_OF_PICK_UPS |= {f"robot_in_{name}" for name in ON_REQUEST_OF_PICK_UPS if name != "height_over_torso"}
ON_REQUEST_OF_PICK_UPS |= {"policy", "robot", "scene"}


def attributes(row: orm.Base) -> set[str]:
    """Return the names of all columns, relationships, synonyms, hybrids and properties of a row's class."""
    mapper = inspect(row).mapper
    mapped = {name for name, each in mapper.all_orm_descriptors.items() if hasattr(type(row), name)}
    hybrids = {
        name
        for name, each in mapper.all_orm_descriptors.items()
        if each.extension_type is HybridExtensionType.HYBRID_PROPERTY
    }
    properties = {
        name for class_ in type(row).__mro__ for name, each in vars(class_).items() if isinstance(each, property)
    }
    return {name for name in mapped | hybrids | properties if not name.startswith("_")} - {"awaitable_attrs"}


def unloaded(row: orm.Base, seen: set[int], depth: int) -> set[tuple[str, str]]:
    """Read every attribute of a row and of the rows it leads to; return those that raise `CallerError`."""
    names: set[tuple[str, str]] = set()
    if id(row) in seen or depth < 0:
        return names
    seen.add(id(row))
    for name in sorted(attributes(row)):  # reading `parent` loads what `ancestors` needs
        try:
            value = getattr(row, name)
        except CallerError as error:
            names.add((type(row).__name__, name if f"`await row.awaitable_attrs.{name}`" in str(error) else str(error)))
            continue
        for each in value if isinstance(value, list) else [value]:
            if isinstance(each, orm.Base):
                names |= unloaded(each, seen, depth - 1)
    return names


async def transport(memory: Memory) -> None:
    async with memory.episode():
        with BulletWorld(), simulated_robot:
            WorldObject("kitchen", ObjectType.ENVIRONMENT)
            WorldObject("pr2", ObjectType.ROBOT)
            milk = WorldObject("milk", ObjectType.MILK, pose=Pose([1.3, 1.0, 0.9]))
            await TransportAction([milk], [Arms.LEFT], [Pose([1.3, 0.4, 0.95])]).resolve().perform()
    await memory.flush()


@pytest.mark.slow
@pytest.mark.soak_on("postgresql")
async def test_every_attribute_is_loaded_or_its_error_names_how_to_load_it(
    database_url: str, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.chdir(tmp_path)
    on_request: set[str] = set()
    with_rows: set[str] = set()
    async with Memory.open(database_url) as memory:
        await transport(memory)
        for class_ in CLASSES:
            async with memory.session() as session:
                rows = (await session.scalars(select(class_).limit(8))).unique().all()
                with_rows |= {class_.__name__} if rows else set()
                in_session = {name for row in rows for _, name in unloaded(row, set(), depth=3)}
            async with memory.session() as session:
                rows = (await session.scalars(select(class_).limit(8))).unique().all()
            after = {name for row in rows for _, name in unloaded(row, set(), depth=3)}
            assert in_session == after, class_
            on_request |= in_session
            expected = ON_REQUEST | (ON_REQUEST_OF_PICK_UPS if class_ is orm.PickUpWithContextView else set())
            assert in_session <= expected, class_
    assert on_request == ON_REQUEST | ON_REQUEST_OF_PICK_UPS
    assert {"TransportAction", "Object", "LocationResolution", "Attachment", "TaskTreeNode", "MoveMotion"} <= with_rows


@pytest.mark.slow
@pytest.mark.soak_on("postgresql")
async def test_attributes_on_request_are_loaded_as_the_error_advises(
    database_url: str, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.chdir(tmp_path)
    async with Memory.open(database_url) as memory:
        await transport(memory)
        cases: list[tuple[Any, str, Any]] = [
            (orm.TaskTreeNode, "parent", selectinload(orm.TaskTreeNode.parent)),
            (orm.Action, "robot_state", selectinload(orm.Action.robot_state)),
            (orm.TaskTreeNode, "children", selectinload(orm.TaskTreeNode.children)),
            (orm.Object, "node", selectinload(orm.Object.node)),
            (orm.Action, "node", selectinload(orm.Action.node)),
            (orm.Action, "parameters", undefer(orm.Action.parameters)),
            (orm.ProcessMetaData, "robots", selectinload(orm.ProcessMetaData.robots)),
            (orm.LocationResolution, "refusals", selectinload(orm.LocationResolution.refusals)),
            (orm.TaskTreeNode, "outcome", undefer(orm.TaskTreeNode.outcome)),
            (orm.PickUpWithContextView, "robot_in_object_z", undefer(orm.PickUpWithContextView.robot_in_object_z)),
        ]
        for class_, name, option in cases:
            async with memory.session() as session:
                rows = (await session.scalars(select(class_).order_by(class_.id.desc()).options(option))).all()
            loaded = [getattr(row, name) for row in rows]
            async with memory.session() as session:
                plain = (await session.scalars(select(class_).order_by(class_.id.desc()))).all()
                awaited = [await getattr(row.awaitable_attrs, name) for row in plain]
            assert list(map(str, awaited)) == list(map(str, loaded))
            assert loaded
            assert any(loaded) or name in ("refusals", "outcome")
