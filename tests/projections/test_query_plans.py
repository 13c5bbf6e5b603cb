"""Query plans of both databases, and the statistics that SQLite gets for new tables because it never collects them."""

import sqlite3
from contextlib import closing
from pathlib import Path

import pytest

from pycrorm_async import Memory
from pycrorm_async.operations.rebuild import rebuild_memory
from pycrorm_async.plan import Code
from tests.databases import Server, ask, ask_to_change

pytestmark = pytest.mark.slow

VIEW = 'SELECT arm, relative_x FROM "PickUpWithContextView" WHERE {}'


@pytest.mark.parametrize(
    ("question", "begins"),
    [
        (VIEW.format("status = 'SUCCEEDED'"), "SCAN zz_pick_up_action__1001"),
        (VIEW.format("obj_type = 'MILK'"), "SCAN zz_pick_up_action__1001"),
        (
            VIEW.format("process_metadata_id = 3"),
            "SEARCH zz_task_tree_node__1001 USING INDEX zz_task_tree_node__1001_by_process",
        ),
        ("SELECT id FROM task_tree_node WHERE status = 'FAILED'", "SEARCH zz_task_tree_node__1001 USING INDEX"),
        (
            "SELECT n.id FROM action a JOIN task_tree_node n USING (id) WHERE n.parent_id = 64",
            "SEARCH zz_task_tree_node",
        ),
    ],
)
async def test_a_query_plan_begins_with_the_smallest_table(tmp_path: Path, question: str, begins: str) -> None:
    async with Memory.open(f"sqlite:///{tmp_path}/memory.db"):
        pass
    with closing(sqlite3.connect(tmp_path / "memory.db")) as file:
        first, *_ = [row[3] for row in file.execute(f"EXPLAIN QUERY PLAN {question}")]
    assert first.startswith(begins)


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
