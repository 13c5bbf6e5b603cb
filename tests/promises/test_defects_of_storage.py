"""Measured defects in storage of the system of the thesis, each with the property that this package keeps instead.

Numbers as in tests/README.md. Every test covers the whole way: a plan, a memory in a SQLite file, and queries by the
mapped classes, the file itself or another process.
"""

from __future__ import annotations

import asyncio
import json
import math
import re
import shutil
import signal
import sqlite3
import subprocess
import sys
from contextlib import closing
from dataclasses import dataclass
from itertools import combinations
from pathlib import Path
from statistics import median
from typing import Any

import pytest
from sqlalchemy import func, select
from sqlalchemy.dialects import sqlite

from pycrorm_async import Memory, Reading, recover
from pycrorm_async.orm import Action, Base, Object, ProcessMetaData, TaskTreeNode
from pycrorm_async.plan import (
    ActionAbstract,
    NavigateActionPerformable,
    ObjectDesignator,
    ParkArmsActionPerformable,
    PlanFailure,
)
from pycrorm_async.task_status import TaskStatus
from pycrorm_async.world import Arms, ObjectType, Pose
from pycrorm_async.world import Object as WorldObject
from tests.commands import environment, run_script
from tests.databases import ask
from tests.memory.note_actions import NoteActionPerformable
from tests.memory_in_use import ALLOCATING
from tests.promises.lab import (
    MILK_AT,
    WITHIN_REACH,
    FailingActionPerformable,
    at,
    every,
    lab,
    nodes_of,
    recorded,
    results_of,
    statuses,
    turned,
    url_of,
)

pytestmark = pytest.mark.slow


async def test_events_that_are_drained_twice_are_stored_once(tmp_path: Path) -> None:
    spool, copied = tmp_path / "memory.db.spool", tmp_path / "copied"
    async with recorded(tmp_path) as memory:
        with lab():
            await ParkArmsActionPerformable(Arms.BOTH).perform()
        await memory.flush()
        await memory.flush()
    async with Memory.open(url_of(tmp_path)) as memory:
        await NoteActionPerformable("again").perform()
        await memory.synced()
        shutil.copytree(spool, copied)
    before = contents(tmp_path)
    assert [name for name, _ in statuses(await nodes_of(tmp_path))] == [
        None,
        "ParkArmsAction",
        "MoveArmJointsMotion",
        None,
        "NoteAction",
    ]
    # The spool before it was drained: the state after a crash between storing and acknowledging.
    shutil.rmtree(spool)
    shutil.copytree(copied, spool)
    report = await recover(url_of(tmp_path))
    assert (report.failed, report.lost) == ({}, ())
    assert contents(tmp_path) == before
    assert not [each for each in spool.iterdir() if each.is_dir() and each.name != "stored"]


def contents(folder: Path) -> dict[str, list[Any]]:
    """Return every row of every table of the file."""
    with closing(sqlite3.connect(folder / "memory.db")) as file, file:
        tables = [name for (name,) in file.execute("SELECT name FROM sqlite_schema WHERE type = 'table'")]
        rows = {name: sorted(file.execute(f'SELECT * FROM "{name}"'), key=repr) for name in tables}
    file.close()
    return {name: found for name, found in rows.items() if not name.startswith("pycrorm_")}


async def test_an_episode_without_a_description_is_stored(tmp_path: Path) -> None:
    async with Memory.open(url_of(tmp_path)) as memory:
        async with memory.episode():
            await NoteActionPerformable("in an episode").perform()
        async with memory.episode(plan="breakfast"):
            await NoteActionPerformable("in a plan").perform()
        await NoteActionPerformable("in no episode").perform()
    found = await results_of(tmp_path, select(ProcessMetaData).order_by(ProcessMetaData.id))
    assert [(each.description, each.plan, each.status) for each in found] == [
        ("an episode", None, "SUCCEEDED"),
        ("breakfast", "breakfast", "SUCCEEDED"),
        ("NoteAction", "NoteAction", "SUCCEEDED"),
    ]
    assert len(await nodes_of(tmp_path)) == 6


async def test_any_number_of_sessions_and_memories_read_one_episode(tmp_path: Path) -> None:
    async with recorded(tmp_path) as memory:
        await NoteActionPerformable("one").perform()
        await memory.flush()
        async with Reading.open(url_of(tmp_path)) as reading, memory.session() as first, memory.session() as second:
            async with reading.session() as third:
                for session in (first, second, third, first):
                    (metadata,) = (await session.scalars(select(ProcessMetaData))).all()
                    assert (metadata.description, metadata.status) == ("a test", "RUNNING")
                    (action,) = (await session.scalars(select(Action))).all()
                    assert action.process_metadata.id == metadata.id
            await NoteActionPerformable("two").perform()
    async with Memory.open(url_of(tmp_path)) as again, again.session() as session:
        assert len((await session.scalars(select(Action))).all()) == 2
        assert [each.status for each in (await session.scalars(select(ProcessMetaData))).all()] == ["SUCCEEDED"]


KILLED = """
import asyncio, os, signal, sys
from pycrorm_async import Memory
from pycrorm_async.plan import MoveTorsoActionPerformable, NavigateActionPerformable, simulated_robot
from pycrorm_async.world import BulletWorld, Object, ObjectType, Pose

async def main():
    async with Memory.open(sys.argv[1]) as memory, memory.episode(description="killed"):
        with BulletWorld(), simulated_robot:
            Object("pr2", ObjectType.ROBOT)
            for index in range(50):
                await NavigateActionPerformable(Pose([index / 100, 0, 0])).perform()
            os.kill(os.getpid(), signal.SIGKILL)
            await MoveTorsoActionPerformable(0.1).perform()

asyncio.run(main())
"""


async def test_everything_done_before_a_kill_is_stored(tmp_path: Path) -> None:
    done = await asyncio.to_thread(run_script, KILLED, url_of(tmp_path))
    assert done.returncode == -signal.SIGKILL, done.stderr
    report = await recover(url_of(tmp_path))
    assert (len(report.lost), report.failed) == (1, {})
    root, *nodes = await nodes_of(tmp_path)
    assert (root.status, root.end_time) == (TaskStatus.LOST, None)
    assert statuses(nodes) == [("NavigateAction", "SUCCEEDED"), ("MoveMotion", "SUCCEEDED")] * 50
    drives = await results_of(tmp_path, select(Action).order_by(Action.id))
    assert [each.target_location.x for each in drives] == [index / 100 for index in range(50)]
    last = (await results_of(tmp_path, select(Object).order_by(Object.id.desc()).limit(1)))[0]
    assert (last.name, at(last.pose)) == ("pr2", (0.49, 0, 0))


async def test_one_value_that_cannot_be_stored_loses_no_other(tmp_path: Path) -> None:
    async with recorded(tmp_path):
        with lab():
            await NavigateActionPerformable(Pose([0.1, 0, 0])).perform()
            await NoteActionPerformable("half a pair: \ud800").perform()
            await NavigateActionPerformable(Pose([0.2, 0, 0])).perform()
    drive = [("NavigateAction", "SUCCEEDED"), ("MoveMotion", "SUCCEEDED")]
    assert statuses(await nodes_of(tmp_path))[1:] == [*drive, ("NoteAction", "SUCCEEDED"), *drive]


GROWING = """
import asyncio, json, sys
from dataclasses import dataclass
from pycrorm_async import Memory
from pycrorm_async.plan import ActionAbstract
from tests.memory_in_use import bytes_in_use

WINDOW_NODES = int(sys.argv[2])

@dataclass
class CountActionPerformable(ActionAbstract):
    index: int

    async def perform(self):
        return None

async def main(url):
    sizes = []
    async with Memory.open(url) as memory, memory.episode():
        for first in range(0, 8 * WINDOW_NODES, WINDOW_NODES):
            for index in range(first, first + WINDOW_NODES):
                await CountActionPerformable(index).perform()
            for _ in range(2):  # writer and fold keep their last batch, which should be a small one
                await memory.flush()
                await CountActionPerformable(0).perform()
            await memory.flush()
            sizes.append(bytes_in_use())
    print(json.dumps(sizes))

asyncio.run(main(sys.argv[1]))
"""


@pytest.mark.parametrize("window_nodes", [1_000, pytest.param(10_000, marks=pytest.mark.soak)])
async def test_a_long_plan_costs_less_than_a_hundred_bytes_of_memory_a_node(tmp_path: Path, window_nodes: int) -> None:
    done = await in_a_process(GROWING, url_of(tmp_path), str(window_nodes), **ALLOCATING)
    assert done.returncode == 0, done.stderr
    _, _, *sizes = json.loads(done.stdout)  # buffers grow to their final sizes in the first three windows
    windows = combinations(enumerate(sizes), 2)
    # The median of all slopes: a buffer that grows once more on a busy machine is no slope.
    slope = median((later - earlier) / (last - first) / window_nodes for (first, earlier), (last, later) in windows)
    assert slope < 100, sizes  # the reference system: 33,000
    ended = select(func.count()).where(TaskTreeNode.status == TaskStatus.SUCCEEDED)
    assert await results_of(tmp_path, ended) == [8 * (window_nodes + 2) + 1]
    counted = ask(tmp_path / "memory.db", 'SELECT "index", count(*) FROM count_action GROUP BY 1 ORDER BY 1')
    assert counted == [(0, 17), *((index, 1) for index in range(1, 8 * window_nodes))]


IMPORTING = """
import importlib, json, pkgutil, sys
started, opened = [], []

def watch(event, arguments):
    if event in ("subprocess.Popen", "os.fork", "os.forkpty", "os.exec", "os.posix_spawn", "os.spawn", "os.system"):
        started.append((event, repr(arguments)[:200]))
    if event == "open" and "/.git" in str(arguments[0]):
        opened.append(str(arguments[0]))

sys.addaudithook(watch)
import pycrorm_async
names = [each.name for each in pkgutil.walk_packages(pycrorm_async.__path__, "pycrorm_async.")]
for name in names:
    if not name.endswith("__main__"):
        importlib.import_module(name)
loaded = [name for name in ("git", "rospkg", "rospy") if name in sys.modules]
print(json.dumps([len(names), started, opened, loaded]))
"""


async def test_importing_runs_no_process_and_reads_no_repository(tmp_path: Path) -> None:
    done = await in_a_process(IMPORTING)
    assert done.returncode == 0, done.stderr
    count, started, opened, loaded = json.loads(done.stdout)
    assert count > 100
    assert (started, opened, loaded) == ([], [], [])


async def in_a_process(script: str, *arguments: str, **variables: str) -> subprocess.CompletedProcess[str]:
    return await asyncio.to_thread(
        subprocess.run,
        [sys.executable, "-c", script, *arguments],
        env=environment() | variables,
        capture_output=True,
        text=True,
        timeout=300,
        check=False,
    )


async def test_long_texts_and_small_differences_are_kept_exactly(tmp_path: Path) -> None:
    long = "Grüße, 机器人! " * 1_000
    numbers = (0.1 + 0.2, math.pi * 1e-9, 1 / 3)
    async with Memory.open(url_of(tmp_path)) as memory:
        async with memory.episode(description=long[:10_000]):
            with lab() as scene:
                WorldObject("w" * 300, ObjectType.BOWL, pose=Pose(numbers, (0.1, 0.2, 0.3, 0.4)))
                await NoteActionPerformable(long).perform()
                await NavigateActionPerformable(Pose(numbers)).perform()
                with pytest.raises(PlanFailure):
                    await FailingActionPerformable(PlanFailure(long[:1_999])).perform()
                turn = scene.world.object("w" * 300).pose.orientation
        await memory.flush()
        (note,) = await every(memory, select(memory.mapped("NoteAction")))
        assert note.text == long
        (drive,) = await every(memory, select(Action).where(Action.dtype == "NavigateAction"))
        assert at(drive.pose) == numbers
        (bowl,) = await every(memory, select(Object).where(Object.obj_type == ObjectType.BOWL))
        assert (bowl.name, at(bowl.pose), turned(bowl.pose)) == ("w" * 300, numbers, turn)
        (failed,) = await every(memory, select(TaskTreeNode).where(TaskTreeNode.dtype == "FailingAction"))
        assert failed.failure_message == long[:1_999]
        (episode,) = await every(memory, select(ProcessMetaData))
        assert episode.description == long[:10_000]


@dataclass
class StackActionPerformable(ActionAbstract):
    upper: ObjectDesignator
    lower: ObjectDesignator
    before: Pose
    after: Pose
    spare: ObjectDesignator | None = None
    by_the_way: list[Pose] | None = None

    async def perform(self) -> None:
        """Succeed without doing anything."""


async def test_an_action_keeps_all_its_poses_and_all_its_objects(tmp_path: Path) -> None:
    async with recorded(tmp_path) as memory:
        with lab() as scene:
            bowl = WorldObject("bowl", ObjectType.BOWL, pose=Pose([0, 1, 0.5]))
            upper, lower, spare = (
                ObjectDesignator(each.name, each.object_type, each) for each in (scene.milk, scene.cereal, bowl)
            )
            way = [Pose([1, 0, 0]), Pose([2, 0, 0])]
            await StackActionPerformable(upper, lower, Pose([3, 0, 0]), Pose([4, 0, 0]), spare, way).perform()
        await memory.flush()
        (stack,) = await every(memory, select(memory.mapped("StackAction")))
        assert [each.name for each in (stack.upper, stack.lower, stack.spare)] == ["milk", "cereal", "bowl"]
        assert [at(each.pose) for each in (stack.upper, stack.lower, stack.spare)] == [
            MILK_AT,
            (1.3, 0.7, 0.95),
            (0, 1, 0.5),
        ]
        assert [at(each) for each in (stack.before, stack.after)] == [(3, 0, 0), (4, 0, 0)]
        assert [at(each) for each in stack.entries("by_the_way")] == [(1, 0, 0), (2, 0, 0)]
        assert (stack.object.name, at(stack.pose)) == ("milk", (3, 0, 0))  # the names in the queries of the thesis


async def test_all_rows_of_an_episode_are_found_by_an_index(tmp_path: Path) -> None:
    async with recorded(tmp_path):
        with lab():
            await NavigateActionPerformable(WITHIN_REACH).perform()
    with closing(sqlite3.connect(tmp_path / "memory.db")) as file, file:
        asked_of = 0
        for mapper in Base.registry.mappers:
            mapped: Any = mapper.class_
            if not hasattr(mapped, "process_metadata_id"):
                continue
            row = mapped.id if hasattr(mapped, "id") else mapped.process_metadata_id
            assert scans(file, select(row).where(mapped.process_metadata_id == 1)) == [], mapped
            asked_of += 1
        assert asked_of > 30
        assert scans(file, select(TaskTreeNode.id).where(TaskTreeNode.reason == "IKError"))  # `reason` has no index
        # and all that refers to one row: children of a node, an object's life, the node of a status
        parent, identity = TaskTreeNode.parent_id == 34, Object.identity_id == 32
        assert scans(file, select(TaskTreeNode.id).where(parent)) == []
        assert scans(file, select(Object.id).where(identity)) == []
        assert scans(file, select(TaskTreeNode.id).where(TaskTreeNode.status == TaskStatus.FAILED)) == []
    file.close()


def scans(file: sqlite3.Connection, statement: Any) -> list[str]:
    """Return the steps of the query plan that read a whole table of rows.

    Constants, the boxes of links, which belong to descriptions and not to episodes, and results of subqueries are none;
    the steps that make such a result are checked too.
    """
    sql = str(statement.compile(dialect=sqlite.dialect(), compile_kwargs={"literal_binds": True}))
    steps = [step for *_, step in file.execute(f"EXPLAIN QUERY PLAN {sql}")]
    assert steps
    results = [words[1] for step in steps if (words := step.split())[0] in ("MATERIALIZE", "CO-ROUTINE")]
    none = {f"SCAN {name}" for name in results}
    return [step for step in steps if step.startswith("SCAN") and step not in none and not NO_TABLE.search(step)]


NO_TABLE = re.compile("CONSTANT ROW|VIRTUAL TABLE|pycrorm_link_box__")  # json_each is a virtual table
