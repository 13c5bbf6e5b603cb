"""How the databases go about a question, and what SQLite is told of new tables, for it never counts by itself."""

import sqlite3
from contextlib import closing
from pathlib import Path

import pytest

from pycrorm_async import Memory
from pycrorm_async.operations.rebuild import rebuild_memory
from tests.databases import Server, ask, ask_to_change

pytestmark = pytest.mark.slow

VIEW = 'SELECT arm, relative_x FROM "PickUpWithContextView" WHERE {}'


@pytest.mark.parametrize(
    ("question", "begins"),
    [
        (VIEW.format("status = 'SUCCEEDED'"), "SCAN pick_up_action__1"),
        (VIEW.format("obj_type = 'MILK'"), "SCAN pick_up_action__1"),
        (VIEW.format("process_metadata_id = 3"), "SEARCH task_tree_node__1 USING INDEX task_tree_node__1_by_process"),
        ("SELECT id FROM task_tree_node WHERE status = 'FAILED'", "SEARCH task_tree_node__1 USING INDEX"),
        ("SELECT n.id FROM action a JOIN task_tree_node n USING (id) WHERE n.parent_id = 64", "SEARCH task_tree_node"),
    ],
)
async def test_a_question_begins_with_what_is_fewest(tmp_path: Path, question: str, begins: str) -> None:
    async with Memory.open(f"sqlite:///{tmp_path}/memory.db"):
        pass
    with closing(sqlite3.connect(tmp_path / "memory.db")) as file:
        first, *_ = [row[3] for row in file.execute(f"EXPLAIN QUERY PLAN {question}")]
    assert first.startswith(begins)


async def test_of_a_pick_up_with_context_it_is_asked_once_whether_it_happened(
    database_url: str, tmp_path: Path
) -> None:
    async with Memory.open(database_url, spool=tmp_path / "spool"):
        pass
    explain = "EXPLAIN QUERY PLAN" if database_url.startswith("sqlite") else "EXPLAIN"
    plan = "\n".join(str(row) for row in ask(database_url, f"{explain} {VIEW.format('true')}"))
    assert "pick_up_action__1" in plan
    assert "simulated_episode" not in plan


@pytest.fixture
async def new_on_a_server(server: Server, tmp_path: Path) -> str:
    """The URL of a memory in which nothing is yet."""
    url = server.new_database()
    async with Memory.open(url, spool=tmp_path / "spool"):
        pass
    return url


def test_a_server_finds_the_pick_ups_that_succeeded_without_reading_all_nodes_that_did(new_on_a_server: str) -> None:
    question = VIEW.format("status = 'SUCCEEDED'")
    plan = "\n".join(step for (step,) in ask(new_on_a_server, f"EXPLAIN {question}"))
    assert "dtype = 'PickUpAction'" in plan


def test_a_server_knows_from_its_index_where_the_robot_was_when_the_pick_ups_ended(new_on_a_server: str) -> None:
    database = new_on_a_server.partition("?")[0].rpartition("/")[2]
    for way in ("seqscan", "bitmapscan"):
        ask_to_change(new_on_a_server, f'ALTER DATABASE "{database}" SET enable_{way} = off')
    question = "SELECT id, robot_pose_id, torso_height, status FROM memory_tables.task_tree_node__1 WHERE NOT simulated"
    plan = "\n".join(step for (step,) in ask(new_on_a_server, f"EXPLAIN {question} AND dtype = 'PickUpAction'"))
    assert "Index Only Scan" in plan


async def test_what_is_expected_of_a_table_goes_with_it_when_it_is_made_anew(tmp_path: Path) -> None:
    url = f"sqlite:///{tmp_path}/memory.db"
    async with Memory.open(url):
        pass

    def told() -> set[str]:
        with closing(sqlite3.connect(tmp_path / "memory.db")) as file:
            tables = file.execute("SELECT name FROM sqlite_schema WHERE type = 'table'").fetchall()
            known = {name for (name,) in file.execute("SELECT DISTINCT tbl FROM sqlite_stat1")}
            assert known <= {name for (name,) in tables}
            return {name for name in known if name.startswith("task_tree_node")}

    assert told() == {"task_tree_node__1"}
    await rebuild_memory(url)
    assert told() == {"task_tree_node__2"}
