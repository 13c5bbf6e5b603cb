"""Query plans of both databases, with and without statistics: none reads what it need not read."""

from __future__ import annotations

import json
import re
import sqlite3
from collections.abc import Callable, Coroutine, Iterator
from contextlib import closing
from pathlib import Path
from typing import Any

import pytest
from sqlalchemy import Engine, event, select

from bench.material.rollouts import spool_rollouts
from pycrorm_async import Memory, Reading
from pycrorm_async.operations.rebuild import rebuild_memory
from pycrorm_async.operations.recovery import recover
from pycrorm_async.orm import Object, PickUpAction, PickUpWithContextView, Pose, SpatialRelation, TaskTreeNode
from pycrorm_async.plan import Code
from pycrorm_async.query.questions import QUESTIONS
from pycrorm_async.recall.experience import PickUpExperience
from pycrorm_async.store.address import DatabaseAddress
from pycrorm_async.store.log import EventLog
from pycrorm_async.world import ObjectType
from tests.databases import Server, ask, ask_each, ask_to_change, run_in_own_loop

pytestmark = pytest.mark.slow


# === question plans ===========================================================================================
#
# Query plans among many episodes. None reads all nodes; on a server none reads an episode once for each row.

EPISODES, PICK_UPS = 2, 120
"""So many that the table of nodes has 40 pages. Of half of them a server without statistics expects six failed nodes,
and compares each with each, because a hash table would cost more."""
TURNS_A_ROW = 10
"""Bounds the rows that one step of a plan reads: this many times all rows of the largest table. A step that reads an
episode for each pick-up reads more."""

Question = Callable[[Reading], Coroutine[Any, Any, None]]


@pytest.fixture(scope="module", params=["without statistics", "with statistics"])
def rollouts(request: pytest.FixtureRequest, server: Server, tmp_path_factory: pytest.TempPathFactory) -> Iterator[str]:
    """The URL of a memory of rollouts."""
    url, spool = server.new_database(), Path(tmp_path_factory.mktemp("spool"))
    spool_rollouts(EPISODES * PICK_UPS, spool, seed=69, an_episode=PICK_UPS)

    async def store() -> None:
        await recover(url, spool=spool)

    run_in_own_loop(store())
    assert ask(url, "SELECT count(*) FROM pg_stats WHERE schemaname = 'memory_tables'") == [(0,)]
    if request.param == "with statistics":
        ask_to_change(url, "ANALYZE")
    yield url
    server.drop(url)


WHOLE_MEMORY = "success_rates longest_actions durations arms_used successful_pick_ups experience_at episodes".split()
"""The questions that without an episode read all nodes, pick-ups or episodes, because they are about all of them."""


@pytest.mark.empty_database
def test_a_question_reads_no_table_of_nodes_poses_or_events_as_a_whole(database_url: str, tmp_path: Path) -> None:
    """At this size a server chooses an index by itself. The statistics of SQLite are the same at every size."""
    url, on_server = database_url, database_url.startswith("postgresql")
    spool_rollouts(1_200 if on_server else 40, tmp_path / "spool", seed=69, an_episode=100 if on_server else 2)

    async def asked() -> list[dict[str, str]]:
        await recover(url, spool=tmp_path / "spool")
        if on_server:
            ask_to_change(url, "ANALYZE")
        async with Reading.open(url) as reading:
            questions = {name: getattr(reading.ask, name) for name in QUESTIONS}
            named: dict[str, dict[str, Any]] = {name: {"name": "milk"} for name in ("object_history", "moves_of")}
            named["experience_at"] = {"x": 0.5, "y": 0.5}
            about_all = {
                name: question(**named.get(name, {}))
                for name, question in questions.items()
                if name not in WHOLE_MEMORY
            }
            about_one = {
                f"{name} of an episode": question(**named.get(name, {}), episode=1)
                for name, question in questions.items()
            }
            return [{name: each.sql for name, each in {**about_all, **about_one}.items()}]

    [statements] = run_in_own_loop(asked())
    assert len(statements) == 6 + 13
    explain = "EXPLAIN" if on_server else "EXPLAIN QUERY PLAN"
    plans = dict(zip(statements, ask_each(url, [f"{explain} {each}" for each in statements.values()]), strict=True))
    scans = {name: [step for *_, step in plan if _WHOLE_TABLE.search(step)] for name, plan in plans.items()}
    assert {name: steps for name, steps in scans.items() if steps} == {}


_WHOLE_TABLE = re.compile(r"(Seq Scan on|SCAN) (zz_(task_tree_node|pose)__|event\b|named\b)")
"""Also of the log, from which views read the parameters of nodes by the primary key of their events."""


def rows_of(statement: Any) -> Question:
    async def read(reading: Reading) -> None:
        async with reading.session() as session:
            (await session.scalars(statement)).all()

    return read


def frame_of(statement: Any) -> Question:
    async def read(reading: Reading) -> None:
        await reading.dataframe(statement)

    return read


def answer_of(name: str, *arguments: Any) -> Question:
    async def read(reading: Reading) -> None:
        await getattr(reading.ask, name)(*arguments).rows()

    return read


async def what_went_well(reading: Reading) -> None:
    assert await PickUpExperience.of(reading).successes(ObjectType.MILK, arm=None)


async def the_tree(reading: Reading) -> None:
    assert await reading.tree(1)


async def rows_read(log: EventLog, statements: list[tuple[str, Any]]) -> dict[str, float]:
    """Return the largest number of rows that a step of its plan reads, for each query."""
    most: dict[str, float] = {}
    async with log.engine.connect() as connection:
        await connection.exec_driver_sql("SET LOCAL statement_timeout = '10s'")
        for text, parameters in statements:
            if text.startswith("SET LOCAL"):
                await connection.exec_driver_sql(text)
            if not text.lstrip().startswith(("SELECT", "WITH")) or "set_config" in text:
                continue
            explain = f"EXPLAIN (ANALYZE, FORMAT JSON) {text}"
            plan: Any = (await connection.exec_driver_sql(explain, tuple(parameters))).scalar_one()
            pending = [(json.loads(plan) if isinstance(plan, str) else plan)[0]["Plan"]]
            while pending:
                step = pending.pop()
                pending += step.get("Plans", [])
                rows = sum(value for name, value in step.items() if name.startswith(("Actual Rows", "Rows Removed")))
                most[text] = max(most.get(text, 0), rows * step["Actual Loops"])
    return most


@pytest.mark.parametrize(
    "question",
    [
        pytest.param(what_went_well, id="what went well"),
        pytest.param(frame_of(select(PickUpWithContextView)), id="pick-ups with context"),
        pytest.param(
            frame_of(select(PickUpWithContextView.arm).where(PickUpWithContextView.status == "SUCCEEDED")),
            id="the learning question",
        ),
        pytest.param(
            frame_of(select(PickUpWithContextView.arm).where(PickUpWithContextView.relative_x > 0.5)),
            id="pick-ups by the place of the robot",
        ),
        pytest.param(
            frame_of(select(PickUpWithContextView.arm).where(PickUpWithContextView.object_z > 0.5)),
            id="pick-ups by the place in the object's frame",
        ),
        pytest.param(rows_of(select(SpatialRelation)), id="spatial relations"),
        pytest.param(rows_of(select(Pose).join(PickUpAction.object).join(Object.pose)), id="a join"),
        pytest.param(the_tree, id="the task tree"),
        pytest.param(answer_of("root_failures"), id="root_failures"),
        pytest.param(answer_of("steps_before_failures"), id="steps_before_failures"),
        pytest.param(answer_of("object_history", "milk"), id="object_history"),
        pytest.param(answer_of("moves_of", "milk"), id="moves_of"),
        pytest.param(answer_of("experience_at", 0.5, 0.5), id="experience_at"),
        pytest.param(rows_of(select(PickUpAction)), id="actions as objects"),
        pytest.param(rows_of(select(TaskTreeNode)), id="nodes as objects"),
    ],
)
async def test_no_query_reads_an_episode_once_for_each_row(rollouts: str, question: Question) -> None:
    await assert_few_rows_read(rollouts, question)


async def assert_few_rows_read(rollouts: str, question: Question) -> None:
    statements: list[tuple[str, Any]] = []

    def note(_connection: Any, _cursor: Any, text: str, parameters: Any, _context: Any, _many: bool) -> None:
        statements.append((text, parameters))

    event.listen(Engine, "before_cursor_execute", note)
    try:
        async with Reading.open(rollouts) as reading:
            await question(reading)
    finally:
        event.remove(Engine, "before_cursor_execute", note)
    log = await EventLog.open(DatabaseAddress.parse(rollouts), create=False)
    read = await rows_read(log, statements)
    await log.close()
    [(poses,)] = ask(rollouts, "SELECT count(*) FROM memory.pose")
    assert {text: rows for text, rows in read.items() if rows > TURNS_A_ROW * poses} == {}
    assert read


# === query plans ==============================================================================================
#
# Query plans of both databases, and the statistics that SQLite gets for new tables because it never collects them.

VIEW = 'SELECT arm, relative_x FROM "PickUpWithContextView" WHERE {}'


FIRST_STEPS = {
    VIEW.format("status = 'SUCCEEDED'"): "SCAN zz_pick_up_action__1001",
    VIEW.format("obj_type = 'MILK'"): "SCAN zz_pick_up_action__1001",
    VIEW.format("process_metadata_id = 3"): "SEARCH zz_task_tree_node__1001 USING INDEX zz_task_tree_node__1001_by_pro",
    "SELECT id FROM task_tree_node WHERE status = 'FAILED'": "SEARCH zz_task_tree_node__1001 USING INDEX",
    "SELECT n.id FROM action a JOIN task_tree_node n USING (id) WHERE n.parent_id = 64": "SEARCH zz_task_tree_node",
}


async def test_a_query_plan_begins_with_the_smallest_table(tmp_path: Path) -> None:
    async with Memory.open(f"sqlite:///{tmp_path}/memory.db"):
        pass
    with closing(sqlite3.connect(tmp_path / "memory.db")) as file:
        for question, begins in FIRST_STEPS.items():
            first, *_ = [row[3] for row in file.execute(f"EXPLAIN QUERY PLAN {question}")]
            assert first.startswith(begins), question


async def test_the_pick_up_view_looks_up_the_status_of_each_pick_up_once(database_url: str, tmp_path: Path) -> None:
    async with Memory.open(database_url, spool=tmp_path / "spool"):
        pass
    explain = "EXPLAIN QUERY PLAN" if database_url.startswith("sqlite") else "EXPLAIN"
    plan = "\n".join(str(row) for row in ask(database_url, f"{explain} {VIEW.format('true')}"))
    assert "zz_pick_up_action__1001" in plan
    assert "simulated_episode" not in plan


@pytest.fixture
async def new_on_a_server(server: Server, tmp_path: Path) -> str:
    """Return the URL of an empty memory."""
    url = server.new_database()
    async with Memory.open(url, spool=tmp_path / "spool"):
        pass
    return url


def test_a_server_finds_successful_pick_ups_without_reading_all_successful_nodes(new_on_a_server: str) -> None:
    question = VIEW.format("status = 'SUCCEEDED'")
    plan = "\n".join(step for (step,) in ask(new_on_a_server, f"EXPLAIN {question}"))
    assert "task_tree_node__1001_by_pick_up" in plan  # has no other nodes


def test_a_server_reads_the_robots_pose_at_the_end_of_pick_ups_from_its_index(new_on_a_server: str) -> None:
    database = new_on_a_server.partition("?")[0].rpartition("/")[2]
    for way in ("seqscan", "bitmapscan"):
        ask_to_change(new_on_a_server, f'ALTER DATABASE "{database}" SET enable_{way} = off')
    question = (
        "SELECT id, robot_pose_id, torso_height, status FROM memory_tables.zz_task_tree_node__1001 WHERE NOT simulated"
    )
    plan = "\n".join(step for (step,) in ask(new_on_a_server, f"EXPLAIN {question} AND dtype = 'PickUpAction'"))
    assert "Index Only Scan" in plan


async def test_the_statistics_of_a_table_follow_it_through_a_rebuild(tmp_path: Path) -> None:
    url = f"sqlite:///{tmp_path}/memory.db"
    async with Memory.open(url):
        pass

    def analysed_tables() -> set[str]:
        with closing(sqlite3.connect(tmp_path / "memory.db")) as file:
            tables = file.execute("SELECT name FROM sqlite_schema WHERE type = 'table'").fetchall()
            counted = {name for (name,) in file.execute("SELECT DISTINCT tbl FROM sqlite_stat1")}
            assert counted <= {name for (name,) in tables}
            return {name for name in counted if "task_tree_node" in name}

    assert analysed_tables() == {"zz_task_tree_node__1001"}
    await rebuild_memory(url)
    assert analysed_tables() == {"zz_task_tree_node__1002"}


async def test_a_server_has_counted_the_rows_of_rebuilt_tables_before_they_are_shown(
    server: Server, tmp_path: Path
) -> None:
    """The server of the tests never gathers statistics by itself, and others only after a minute."""
    url = server.new_database()
    async with Memory.open(url, spool=tmp_path / "spool") as memory, memory.episode():
        for _ in range(20):
            await Code(lambda: None).perform()
    await rebuild_memory(url)
    counted = dict(ask(url, "SELECT relname, reltuples FROM pg_class WHERE relname LIKE 'zz_%1002' AND relkind = 'r'"))
    assert counted["zz_task_tree_node__1002"] == 21
    assert min(counted.values()) == 0  # -1 means that the rows were never counted
    sampled = "SELECT attname FROM pg_stats WHERE tablename = 'zz_task_tree_node__1002' AND n_distinct = 1"
    assert ("process_metadata_id",) in ask(url, sampled)
