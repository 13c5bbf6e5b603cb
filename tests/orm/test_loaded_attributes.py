"""Every attribute of an object from a query is loaded, or reading it raises an error that names the remedy."""

from __future__ import annotations

from pathlib import Path
from typing import Any

import pytest
from sqlalchemy import inspect, select
from sqlalchemy.ext.hybrid import HybridExtensionType
from sqlalchemy.orm import selectinload, undefer

from pycrorm_async import Memory
from pycrorm_async.errors import CallerError
from pycrorm_async.orm import (
    Action,
    Base,
    LocationResolution,
    Object,
    PickUpWithContextView,
    ProcessMetaData,
    TaskTreeNode,
)
from pycrorm_async.plan import TransportAction, simulated_robot
from pycrorm_async.world import Arms, BulletWorld, ObjectType, Pose
from pycrorm_async.world import Object as WorldObject

pytestmark = pytest.mark.slow

CLASSES = [
    each.class_
    for each in sorted(Base.registry.mappers, key=str)
    if each.class_.__module__.startswith("pycrorm_async.orm")
]
ON_REQUEST = {"children", "ancestors", "node", "parameters", "refusals", "description", "robots"}
ON_REQUEST_OF_PICK_UPS = {"object_z", "object_qx", "object_qy", "object_qz", "object_qw", "height_over_torso"}
ON_REQUEST_OF_PICK_UPS |= {"policy", "robot", "scene"}


def attributes(row: Base) -> set[str]:
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


def unloaded(row: Base, seen: set[int], depth: int) -> set[tuple[str, str]]:
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
            if isinstance(each, Base):
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
            expected = ON_REQUEST | (ON_REQUEST_OF_PICK_UPS if class_ is PickUpWithContextView else set())
            assert in_session <= expected, class_
    assert on_request == ON_REQUEST | ON_REQUEST_OF_PICK_UPS
    assert {"TransportAction", "Object", "LocationResolution", "Attachment", "TaskTreeNode", "MoveMotion"} <= with_rows


@pytest.mark.soak_on("postgresql")
async def test_attributes_on_request_are_loaded_as_the_error_advises(
    database_url: str, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.chdir(tmp_path)
    async with Memory.open(database_url) as memory:
        await transport(memory)
        cases: list[tuple[Any, str, Any]] = [
            (TaskTreeNode, "parent", selectinload(TaskTreeNode.parent)),
            (Action, "robot_state", selectinload(Action.robot_state)),
            (TaskTreeNode, "children", selectinload(TaskTreeNode.children)),
            (Object, "node", selectinload(Object.node)),
            (Action, "node", selectinload(Action.node)),
            (Action, "parameters", undefer(Action.parameters)),
            (ProcessMetaData, "robots", selectinload(ProcessMetaData.robots)),
            (LocationResolution, "refusals", selectinload(LocationResolution.refusals)),
            (PickUpWithContextView, "object_z", undefer(PickUpWithContextView.object_z)),
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
            assert any(loaded) or name == "refusals"
