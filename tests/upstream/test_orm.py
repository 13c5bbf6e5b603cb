"""PyCRAM's tests of its ORM and merger (July 2024), by name; the assertions are those that theirs should make."""

# ruff: noqa: N802  the names are theirs

from __future__ import annotations

import math
import sqlite3
from contextlib import closing
from pathlib import Path

import pytest
from sqlalchemy import func, select

from pycrorm_async import Memory, orm, plan
from pycrorm_async.operations.copy import copy_episodes
from pycrorm_async.task_status import TaskStatus
from pycrorm_async.world import Arms, Grasp, ObjectType, Pose
from pycrorm_async.world.pose import yaw_quaternion
from tests.databases import Server, ask
from tests.plan.conftest import kitchen
from tests.promises.lab import at, url_of
from tests.table_comparison import Tables, differences, tables_of, united
from tests.upstream.conftest import Recorded, common_plan

pytestmark = pytest.mark.slow


# === orm ======================================================================================================
#
# PyCRAM's tests of its ORM (July 2024), by name; the assertions are those that theirs were meant to make.
#
# Names and the common plan are facts of that system, the bodies are new. Where this package differs by design, its own
# number is asserted, and computed in a comment.


async def test_schema_creation(tmp_path: Path) -> None:
    """All tables exist before the first perform, under their lower-case names."""
    async with Memory.open(url_of(tmp_path)):
        pass
    with closing(sqlite3.connect(tmp_path / "memory.db")) as file, file:
        present = {name for (name,) in file.execute("SELECT name FROM sqlite_schema WHERE type IN ('table', 'view')")}
    tables = """
        position quaternion task_tree_node action park_arms_action navigate_action move_torso_action set_gripper_action
        release_action grip_action pick_up_action place_action transport_action look_at_action detect_action open_action
        close_action
    """
    assert set(tables.split()) <= present


async def test_node(planned: Recorded) -> None:
    # the root, 4 actions; 1 motion of the drive, 1 of the torso, 5 of the pick-up, 3 of the placing
    assert len(await planned.all(select(orm.TaskTreeNode))) == 1 + 4 + 10
    # 4 objects when they were added; targets: of 2 actions, of 3 + 2 motions of the hand, while the drive has that of
    # its action; moved: the robot once, the milk when it was lifted and when it was brought down. A designator has the
    # pose of the robot's row that was in force.
    poses = 4 + 2 + 5 + 1 + 2
    assert len(await planned.all(select(orm.Pose))) == poses
    assert len(await planned.all(select(orm.Position))) == poses
    assert len(await planned.all(select(orm.Quaternion))) == poses
    assert await planned.all(select(orm.ParkArmsAction)) == []
    assert len(await planned.all(select(orm.NavigateAction))) == 1
    assert len(await planned.all(select(orm.Action))) == 4
    assert {type(each) for each in await planned.all(select(orm.Action))} == {
        orm.NavigateAction,
        orm.MoveTorsoAction,
        orm.PickUpAction,
        orm.PlaceAction,
    }


async def test_task_tree_node_parents(planned: Recorded) -> None:
    nodes = {each.id: each for each in await planned.all(select(orm.TaskTreeNode))}
    roots = [each for each in nodes.values() if each.parent is None]
    assert [each.parent_id for each in roots] == [None]
    for each in nodes.values():
        if each.parent is not None:
            assert each.parent is nodes[each.parent_id]
    # every action is below the root, every motion below its action
    assert {each.parent.kind for each in nodes.values() if each.kind == "action"} == {"root"}
    below = [(each.dtype, each.parent.dtype) for each in nodes.values() if each.kind == "motion"]
    assert [parent for _, parent in below] == [
        "NavigateAction",
        "MoveTorsoAction",
        *["PickUpAction"] * 5,
        *["PlaceAction"] * 3,
    ]


async def test_meta_data(planned: Recorded) -> None:
    metadata = await planned.one(select(orm.ProcessMetaData))
    assert metadata.status == "SUCCEEDED"
    for mapped in (orm.Action, orm.Motion, orm.Object, orm.Pose, orm.RobotState, orm.TaskTreeNode):
        rows = await planned.all(select(mapped))
        assert rows
        assert {each.process_metadata_id for each in rows} == {metadata.id}
    assert await planned.all(select(orm.ParkArmsAction)) == []


async def test_pose(planned: Recorded) -> None:
    for pose in await planned.all(select(orm.Pose)):
        assert (pose.position.x, pose.position.y, pose.position.z) == (pose.x, pose.y, pose.z)
        turn = pose.orientation
        assert (turn.x, turn.y, turn.z, turn.w) == (pose.qx, pose.qy, pose.qz, pose.qw)
        assert math.hypot(turn.x, turn.y, turn.z, turn.w) == pytest.approx(1)


async def test_pose_mixin(planned: Recorded) -> None:
    states = await planned.all(select(orm.RobotState))
    assert len(states) == 14
    for state in states:
        assert state.pose_id == state.pose.id
    assert [(at(each.pose), each.torso_height) for each in states] == [
        *[((0, 0, 0), 0.0)] * 2,  # the drive begins at the robot's first pose
        *[((0.6, 0.4, 0), 0.0)] * 2,  # and so does the torso
        *[((0.6, 0.4, 0), 0.3)] * 10,
    ]


async def test_transportAction(tmp_path: Path) -> None:
    async with Memory.open(url_of(tmp_path)) as memory, memory.episode():
        with kitchen() as scene:
            await plan.MoveTorsoActionPerformable(0.3).perform()
            island = Pose([-1.35, 0.78, 0.95], yaw_quaternion(math.pi))
            await plan.TransportActionPerformable(scene.milk, Arms.LEFT, island).perform()
            resting = scene.milk.pose
    recorded = Recorded(tmp_path)
    transport = await recorded.one(select(orm.TransportAction))
    milk = await recorded.all(select(orm.Object).where(orm.Object.name == "milk").order_by(orm.Object.id))
    assert transport.object.id == milk[0].id
    assert at(transport.object.pose) == at(milk[0].pose) == (1.3, 1, 0.9)
    assert at(transport.pose) == (-1.35, 0.78, 0.95)
    assert at(milk[-1].pose) == resting.position


async def test_lookAt_and_detectAction(tmp_path: Path) -> None:
    async with Memory.open(url_of(tmp_path)) as memory, memory.episode():
        with kitchen() as scene:
            await plan.ParkArmsActionPerformable(Arms.BOTH).perform()
            await plan.NavigateActionPerformable(Pose([0, 1, 0])).perform()
            await plan.LookAtActionPerformable(scene.milk.pose).perform()
            detected = await plan.DetectActionPerformable(scene.milk).perform()
            assert detected.world_object is scene.milk
    recorded = Recorded(tmp_path)
    assert at((await recorded.one(select(orm.LookAtAction))).pose) == (1.3, 1, 0.9)
    detect = await recorded.one(select(orm.DetectAction))
    assert (detect.object.name, detect.object.obj_type) == ("milk", ObjectType.MILK)


async def test_open_and_closeAction(tmp_path: Path) -> None:
    async with Memory.open(url_of(tmp_path)) as memory, memory.episode():
        with kitchen() as scene:
            handle = plan.ObjectPart("sink_area_drawer_handle", scene.kitchen)
            await plan.NavigateActionPerformable(Pose([0.1, 1.1, 0])).perform()
            await plan.MoveTorsoActionPerformable(0.1).perform()
            await plan.OpenActionPerformable(handle, Arms.LEFT).perform()
            await plan.CloseAction(handle, [Arms.LEFT]).resolve().perform()
    recorded = Recorded(tmp_path)
    opened, closed = await recorded.one(select(orm.OpenAction)), await recorded.one(select(orm.CloseAction))
    for action in (opened, closed):
        assert isinstance(action.object, orm.ObjectPart)
        assert action.object.name == "sink_area_drawer_handle"
        assert action.object.part_of is not None
        assert action.object.part_of.name == "kitchen"
        assert action.arm is Arms.LEFT
    # The drawer slides along -x: its handle was 0.3 m further out at the start of closing.
    assert opened.object.pose.x - closed.object.pose.x == pytest.approx(0.3)


async def test_view_creation(planned: Recorded) -> None:
    with closing(sqlite3.connect(planned.folder / "memory.db")) as file, file:
        kinds = file.execute("SELECT type FROM sqlite_schema WHERE name = 'PickUpWithContextView'").fetchall()
        columns = [name for _, name, *_ in file.execute("PRAGMA table_info('PickUpWithContextView')")]
    assert kinds == [("view",)]
    expected = "id arm grasp torso_height relative_x relative_y quaternion_x quaternion_y quaternion_z quaternion_w"
    assert columns[:12] == [*expected.split(), "obj_type", "status"]


async def test_pickUpWithContextView(planned: Recorded) -> None:
    row = await planned.one(select(orm.PickUpWithContextView))
    assert (row.arm, row.grasp, row.torso_height) == (Arms.LEFT, Grasp.FRONT, 0.3)
    assert (row.relative_x, row.relative_y) == (pytest.approx(-0.7, abs=1e-6), pytest.approx(-0.6, abs=1e-6))
    assert (row.quaternion_x, row.quaternion_y, row.quaternion_z, row.quaternion_w) == (0, 0, 0, 1)
    assert (row.obj_type, row.status) == (ObjectType.MILK, TaskStatus.SUCCEEDED)


async def test_pickUpWithContextView_conditions(planned: Recorded) -> None:
    assert await planned.all(select(orm.PickUpWithContextView).where(orm.PickUpWithContextView.arm == Arms.RIGHT)) == []
    left = select(func.count()).where(orm.PickUpWithContextView.arm == Arms.LEFT)
    assert await planned.all(left) == [1]


# === database merger ==========================================================================================
#
# PyCRAM's tests of its merging of databases (July 2024), by name; the assertions are those that theirs were meant to
# make.
#
# There, three runs of a pick-and-place plan were stored in SQLite and moved to PostgreSQL: the primary keys of the
# existing run were shifted until none collided, then every row was inserted. Here no existing row is changed, and
# copying twice has the same result as once.

RUNS = 3


@pytest.fixture
async def source(tmp_path: Path) -> str:
    """Three runs of the common plan, each with its own metadata."""
    async with Memory.open(url_of(tmp_path)) as memory:
        for run in range(RUNS):
            with kitchen():
                async with memory.episode(description=f"run {run}"):
                    await common_plan()
    return url_of(tmp_path)


@pytest.fixture
async def destination(server: Server, tmp_path: Path) -> str:
    """A memory with a run of its own, whose rows have the ids of the first run in the source."""
    url = server.new_database()
    opened = Memory.open(url, spool=tmp_path / "spool")
    async with opened as memory, memory.episode(description="was here before"):
        with kitchen():
            await common_plan()
    return url


def assert_holds(destination: str, source: Tables, before: Tables) -> None:
    """Assert that every table has all rows of the source, and all that it had before."""
    tables_before = tables_of(destination)
    for table, rows in source.items():
        assert rows.items() <= tables_before[table].items(), table
    assert differences(tables_before, united(source, before)) == []


async def test_merge_databases(source: str, destination: str) -> None:
    same_ids = "SELECT id FROM pose WHERE process_metadata_id = 1 ORDER BY id"
    assert ask(source, same_ids) == ask(destination, same_ids)
    rows, before = tables_of(source), tables_of(destination)
    for _ in range(2):
        await copy_episodes(source, destination)
        assert_holds(destination, rows, before)
    described = ask(destination, "SELECT description FROM process_metadata ORDER BY description")
    assert described == [("run 0",), ("run 1",), ("run 2",), ("was here before",)]
    assert tables_of(source) == rows
