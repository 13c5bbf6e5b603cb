"""Views for learning, views that users register, and materialised ones, which show the same rows."""

from __future__ import annotations

import math

import msgspec
import numpy as np
import pytest
from numpy.typing import NDArray
from sqlalchemy import BigInteger, Text, column, func, select, table
from sqlalchemy.dialects import sqlite
from sqlalchemy.ext.asyncio import AsyncSession

from pycrorm_async.errors import CallerError
from pycrorm_async.events.types import (
    DesignatorTypeDeclared,
    EpisodeEnded,
    EpisodeStarted,
    FailureValue,
    NodeEnded,
    NodeStarted,
    ObjectAdded,
    ObjectMoved,
    ObjectReference,
    PoseValue,
    RobotValue,
)
from pycrorm_async.operations.rebuild import rebuild_memory
from pycrorm_async.orm import ParkArmsAction, PickUpAction, PickUpWithContextView, TaskTreeNode
from pycrorm_async.projections import generations
from pycrorm_async.projections.columns import LayoutConflict
from pycrorm_async.projections.generations import current_generation, failed_views
from pycrorm_async.projections.mapped_tables import UserView, view_texts
from pycrorm_async.projections.projector import Projector
from pycrorm_async.projections.verify import verify
from pycrorm_async.store.log import EventLog
from pycrorm_async.task_status import TaskStatus
from tests.projections.event_script import (
    PICK_UP,
    SAYING,
    T0_NS,
    Script,
    declarations,
    declared,
    field,
    mixed,
    name_of,
    pose,
    row,
)
from tests.projections.sql_queries import ask, names, stored_and_folded

pytestmark = pytest.mark.slow


# === public and user views ====================================================================================
#
# Views for learning, and views that users register.


def two_pick_ups() -> Script:
    """Return two episodes: the milk is at (1, 2), is picked up from (0.25, 2.5), and is then moved to (5, 5)."""
    script = Script()
    milk = script.put(ObjectAdded("milk", "MILK", pose(1, 2, 0.9)))
    robot = RobotValue(pose(0.25, 2.5, 0, turned=0.6), "ROBOT", 0.3)
    parameters = {"object_designator": ObjectReference(milk, milk), "arm": "LEFT", "grasp": "TOP"}
    node = script.put(NodeStarted("action", None, name_of(PICK_UP), parameters, robot))
    script.put(NodeEnded(node, "FAILED", FailureValue("a.IKError", "far")))
    moved = script.put(ObjectMoved(milk, "milk", "MILK", pose(5, 5, 0.9)))
    robot = RobotValue(pose(4, 4), "ROBOT", None)
    parameters = {"object_designator": ObjectReference(milk, moved), "arm": "RIGHT", "grasp": "FRONT"}
    node = script.put(NodeStarted("action", None, name_of(PICK_UP), parameters, robot))
    script.put(NodeEnded(node, "SUCCEEDED"))
    return script


async def test_the_pick_up_view_has_the_columns_of_the_thesis_and_the_pose_at_execution(log: EventLog) -> None:
    await stored_and_folded(log, [*declarations(PICK_UP), *two_pick_ups().records])
    async with log.engine.connect() as connection:
        answer = await connection.exec_driver_sql('SELECT * FROM "PickUpWithContextView" ORDER BY id')
        assert list(answer.keys()) == [
            "id", "arm", "grasp", "torso_height", "relative_x", "relative_y", "quaternion_x", "quaternion_y",
            "quaternion_z", "quaternion_w", "obj_type", "status", "process_metadata_id", "node_id",
            "object_x", "object_y", "object_z", "object_qx", "object_qy", "object_qz", "object_qw",
            "height_over_torso", "robot", "description", "scene", "policy", "sequence",
            *(f"robot_in_object_{each}" for each in ("x", "y", "z", "qx", "qy", "qz", "qw")),
        ]  # fmt: skip
        rows = [tuple(each) for each in answer]
    assert [each[:14] for each in rows] == [
        (row(2), "LEFT", "TOP", 0.3, -0.75, 0.5, 0.0, 0.0, 0.6, 0.8, "MILK", "FAILED", 1, row(2)),
        (row(5), "RIGHT", "FRONT", None, -1.0, -1.0, 0.0, 0.0, 0.0, 1.0, "MILK", "SUCCEEDED", 1, row(5)),
    ]
    assert [each[21] for each in rows] == [pytest.approx(0.9 - 0.3), None]  # above the lifted torso


CAREFUL = declared(
    "CarefulPickUpAction", "careful_pick_up_action", *PICK_UP.fields, field("speed", "real", 5), bases=("PickUpAction",)
)
WARY = declared(
    "WaryPickUpAction", "wary_pick_up_action", *PICK_UP.fields, bases=("CarefulPickUpAction", "PickUpAction")
)
GRAB = msgspec.structs.replace(declared("GrabAction", "grab_action", *PICK_UP.fields), aliases=("PickUpAction",))
LIFT = msgspec.structs.replace(declared("LiftAction", "lift_action", *CAREFUL.fields), aliases=("CarefulPickUpAction",))


@pytest.mark.parametrize(
    "types",
    [
        (WARY, CAREFUL, PICK_UP),
        (CAREFUL, PICK_UP, WARY, GRAB),
        (PICK_UP, CAREFUL, msgspec.structs.replace(LIFT, bases=("PickUpAction",)), WARY),
    ],
)
@pytest.mark.soak_on("postgresql")
async def test_the_pick_up_view_includes_descendants_and_former_names_in_any_order(
    log: EventLog, types: tuple[DesignatorTypeDeclared, ...]
) -> None:
    script = Script()
    milk = script.put(ObjectAdded("milk", "MILK", pose(1, 2, 0.9)))
    rows = []
    projector = Projector(log)
    await projector.open()
    for each in types:
        parameters = {"object_designator": ObjectReference(milk, milk), "arm": "LEFT", "grasp": "TOP"}
        robot = RobotValue(pose(0.25, 2.5), "ROBOT", 0.3)
        rows.append(row(script.put(NodeStarted("action", None, name_of(each), parameters, robot))))
        await log.append([*declarations(each), *script.records])
        await projector.catch_up()
    assert await ask(log, 'SELECT id FROM "PickUpWithContextView" ORDER BY id') == [(each,) for each in rows]


def turn(axis: tuple[float, float, float], angle: float) -> NDArray[np.float64]:
    """The rotation matrix, by Rodrigues' formula."""
    x, y, z = np.array(axis) / np.linalg.norm(axis)
    cross = np.array([[0, -z, y], [z, 0, -x], [-y, x, 0]])
    matrix: NDArray[np.float64] = np.eye(3) + math.sin(angle) * cross + (1 - math.cos(angle)) * cross @ cross
    return matrix


def turned(axis: tuple[float, float, float], angle: float) -> tuple[float, float, float, float]:
    """Return the same rotation as a quaternion."""
    x, y, z = np.array(axis) / np.linalg.norm(axis) * math.sin(angle / 2)
    return float(x), float(y), float(z), math.cos(angle / 2)


@pytest.mark.parametrize(("axis", "angle"), [((0, 0, 1), -2.5), ((1, -2, 0.5), 2.0)])
async def test_the_pick_up_view_has_the_robots_position_in_the_frame_of_the_object(
    log: EventLog, axis: tuple[float, float, float], angle: float
) -> None:
    script = Script()
    object_position = np.array([1.3, 1.0, 0.9])
    milk = script.put(ObjectAdded("milk", "MILK", PoseValue((1.3, 1.0, 0.9), turned(axis, angle), "map", T0_NS)))
    stand, heading = np.array([0.6, 0.4, 0.0]), 0.7
    robot = RobotValue(PoseValue((0.6, 0.4, 0.0), turned((0, 0, 1), heading), "map", T0_NS), "ROBOT", 0.3)
    parameters = {"object_designator": ObjectReference(milk, milk), "arm": "LEFT", "grasp": "TOP"}
    script.put(NodeStarted("action", None, name_of(PICK_UP), parameters, robot))
    await stored_and_folded(log, [*declarations(PICK_UP), *script.records])
    view = PickUpWithContextView
    async with AsyncSession(log.engine) as session:
        names = "x y z qx qy qz qw".split()
        (seen,) = await session.execute(select(*(getattr(view, f"robot_in_object_{each}") for each in names)))
        former = select(*(getattr(view, f"object_{each}") for each in names))
        assert (await session.execute(former)).one() == seen
    object_rotation = turn(axis, angle)
    np.testing.assert_allclose(seen[:3], object_rotation.T @ (stand - object_position), atol=1e-12)
    # The robot's heading as a direction, which the quaternion rotates into the object's frame.
    x, y, z, w = seen[3:]
    ahead = np.array([1 - 2 * (y * y + z * z), 2 * (x * y + z * w), 2 * (x * z - y * w)])
    upwards = np.array([2 * (x * z + y * w), 2 * (y * z - x * w), 1 - 2 * (x * x + y * y)])
    np.testing.assert_allclose(ahead, object_rotation.T @ [math.cos(heading), math.sin(heading), 0], atol=1e-12)
    np.testing.assert_allclose(upwards, object_rotation.T @ [0, 0, 1], atol=1e-12)


async def test_a_user_view_is_made_beside_the_tables_and_changed_with_its_query(log: EventLog) -> None:
    node = TaskTreeNode
    reasons = UserView(
        "reasons",
        select(node.reason, func.count().label("times")).where(node.status == TaskStatus.FAILED).group_by(node.reason),
    )
    await stored_and_folded(log, [*declarations(PICK_UP), *two_pick_ups().records])
    await Projector(log, views=[reasons]).open()
    assert await ask(log, "SELECT * FROM reasons") == [("IKError", 1)]
    async with AsyncSession(log.engine) as session:
        counts = await session.execute(select(reasons.table.c.times).where(reasons.table.c.reason == "IKError"))
        assert counts.scalars().all() == [1]
    await Projector(log, views=[UserView("reasons", select(node.reason).where(node.reason.is_not(None)))]).open()
    await Projector(log).open()  # as another process, which does not register it
    assert await ask(log, "SELECT * FROM reasons") == [("IKError",)]


async def test_every_name_in_a_fresh_memory_is_reserved_for_designators_and_for_views(log: EventLog) -> None:
    await Projector(log).open()
    names_used = set(await names(log, "table", "view"))
    assert len(names_used) > 60
    assert {"event", "pycrorm_generation", "designator", "pose", "zz_pose__1001", "PickUpWithContextView"} <= names_used
    async with log.engine.connect() as connection:
        generation = await current_generation(connection)
    assert generation is not None
    layout = generation.layout
    # The table of an author's class is for the designator that will use its name.
    waiting = layout.leaves.keys() - {table for each in layout.types.values() for table in each.tables}
    others = {"Action", "pycrorm_x", "pg_x", "pose__1", "x__12", "pickupWithContextView"}
    for name in names_used - waiting | others:
        with pytest.raises(LayoutConflict):
            layout.with_declaration(declared("NobodysAction", name))
        with pytest.raises(CallerError, match=f"the view name '{name}' is taken"):
            view_texts([UserView(name, select(ParkArmsAction.arm))], layout, sqlite.dialect())


def of_a_table_of_the_user(*, materialised: bool) -> UserView:
    plans = table("plans", column("process_metadata_id", BigInteger()), column("title", Text()))
    return UserView("planned", select(plans.c.process_metadata_id, plans.c.title), materialised=materialised)


async def make_plans(log: EventLog) -> None:
    async with log.engine.begin() as connection:
        await connection.exec_driver_sql("CREATE TABLE plans (process_metadata_id BIGINT, title TEXT)")
        await connection.exec_driver_sql("INSERT INTO plans VALUES (1, 'tea')")


async def drop_plans(log: EventLog) -> None:
    async with log.engine.begin() as connection:
        await connection.exec_driver_sql(f"DROP TABLE plans{' CASCADE' * (connection.dialect.name == 'postgresql')}")


@pytest.mark.soak_on("postgresql")
@pytest.mark.parametrize("materialised", [False, True])
async def test_a_view_whose_table_was_dropped_is_left_out_and_all_events_are_visible(
    log: EventLog, materialised: bool, caplog: pytest.LogCaptureFixture
) -> None:
    await make_plans(log)
    view = of_a_table_of_the_user(materialised=materialised)
    await Projector(log, views=[view, UserView("arms", select(PickUpAction.arm))]).open()
    await drop_plans(log)
    projector = Projector(log)
    await projector.open()
    saying = Script(1)
    saying.put(EpisodeStarted("a talk", "me", "host", "1.0", "3.11"))
    saying.put(NodeStarted("action", None, name_of(SAYING), {"text": "hello"}))
    await log.append([*declarations(SAYING), *saying.records])
    await projector.catch_up()
    assert await ask(log, "SELECT text FROM saying_action") == [("hello",)]
    assert await ask(log, "SELECT * FROM arms") == []
    if materialised or log.engine.dialect.name == "postgresql":  # SQLite creates views of missing tables
        assert list(await failed_views(log)) == ["planned"]
        assert "plans" in (await failed_views(log))["planned"]
        assert "planned" in caplog.text
        assert (await verify(log)).failed_views == await failed_views(log)
        await Projector(log, views=[view]).open()
    if not materialised and log.engine.dialect.name == "postgresql":
        with pytest.raises(CallerError, match="the database refuses the view again"):
            await Projector(log, views=[UserView("again", view.meaning)]).open()
    await make_plans(log)
    again = Projector(log)
    await again.open()
    await again.catch_up()
    assert await failed_views(log) == {}
    assert await ask(log, "SELECT title FROM planned") == [("tea",)]


# === materialised views =======================================================================================
#
# Materialised user views show at every flush the same rows as the plain view of the same query.

MEANING = select(TaskTreeNode.id, TaskTreeNode.dtype, TaskTreeNode.status, TaskTreeNode.process_metadata_id).where(
    TaskTreeNode.dtype == "SayingAction", TaskTreeNode.reason.is_(None), TaskTreeNode.dtype != "a:b % c"
)
KEPT = UserView("said", MEANING, materialised=True)
PLAIN = UserView("said_plainly", MEANING)


def talk(episode: int, count: int) -> Script:
    script = Script(episode)
    root = script.put(NodeStarted("root"))
    for number in range(count):
        node = script.put(NodeStarted("action", root, name_of(SAYING), {"text": str(number)}))
        script.put(NodeEnded(node, "SUCCEEDED"))
    script.put(NodeEnded(root, "SUCCEEDED"))
    script.put(EpisodeEnded("SUCCEEDED"))
    return script


async def visible_rows(log: EventLog, view: str) -> list[tuple[object, ...]]:
    return await ask(log, f"SELECT * FROM {view} ORDER BY id")


async def kept_tables_of(log: EventLog) -> list[str]:
    return [name for name in await names(log, "table") if name.startswith("zz_pycrorm_view_")]


@pytest.mark.parametrize("step", [1, 1000])
async def test_a_materialised_view_shows_at_every_flush_the_rows_of_the_plain_view(log: EventLog, step: int) -> None:
    projector = Projector(log, views=[KEPT, PLAIN])
    await projector.open()
    await log.append(declarations(SAYING))
    records = mixed(talk(1, 3), talk(2, 5), talk(3, 0))
    for start in range(0, len(records), step):
        await log.append(records[start : start + step])
        await projector.catch_up()
        assert await visible_rows(log, "said") == await visible_rows(log, "said_plainly")
    assert len(await visible_rows(log, "said")) == 8
    assert {status for _, _, status, _ in await visible_rows(log, "said")} == {"SUCCEEDED"}


@pytest.mark.soak_on("postgresql")
async def test_one_that_is_registered_later_shows_earlier_rows_and_may_become_a_plain_view(
    log: EventLog, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setattr(generations, "_EPISODES", 2)
    other = Projector(log)  # which does not register it
    await other.open()
    await log.append([*declarations(SAYING), *mixed(*(talk(each, 2) for each in range(1, 6)))])
    await other.catch_up()
    for number, view in enumerate((KEPT, UserView("said", MEANING), KEPT), 6):
        await Projector(log, views=[view]).open()
        await log.append(talk(number, 2).records)
        await other.catch_up()
        assert len(await visible_rows(log, "said")) == 2 * number


@pytest.mark.soak_on("postgresql")
@pytest.mark.soak_on("sqlite")
async def test_a_changed_query_under_the_same_name_is_shown_and_the_next_rebuild_drops_the_old_rows(
    log: EventLog,
) -> None:
    projector = Projector(log, views=[KEPT])
    await projector.open()
    await log.append([*declarations(SAYING), *talk(1, 4).records])
    await projector.catch_up()
    roots = UserView("said", select(TaskTreeNode.process_metadata_id, TaskTreeNode.kind), materialised=True)
    changed = Projector(log, views=[roots])
    await changed.open()
    await changed.catch_up()
    assert await ask(log, "SELECT kind, count(*) FROM said GROUP BY kind ORDER BY kind") == [("action", 4), ("root", 1)]
    assert len(await kept_tables_of(log)) == 4
    await rebuild_memory(log.address.to_type)
    assert await ask(log, "SELECT kind, count(*) FROM said GROUP BY kind ORDER BY kind") == [("action", 4), ("root", 1)]
    assert len(await kept_tables_of(log)) == 2


async def test_one_whose_rows_name_no_episode_is_refused(log: EventLog) -> None:
    nameless = UserView("said", select(TaskTreeNode.id), materialised=True)
    with pytest.raises(CallerError, match=r"said cannot be materialised: .* \(select process_metadata_id\)"):
        await Projector(log, views=[nameless]).open()
