"""The comparison of two memories detects every difference except the numbers that databases assign."""

from __future__ import annotations

import asyncio
import random
import shutil
from collections.abc import Sequence
from pathlib import Path

import pytest

from pycrorm_async.events.codec import Record
from pycrorm_async.events.types import (
    EpisodeEnded,
    EpisodeStarted,
    JointsMoved,
    NodeEnded,
    NodeStarted,
    ObjectAdded,
    ObjectReference,
)
from pycrorm_async.store.address import DatabaseAddress
from pycrorm_async.store.log import EventLog
from tests.databases import Server, ask, ask_to_change
from tests.projections.event_script import NAVIGATE, SAYING, Script, declarations, declared, field, name_of, pose
from tests.projections.sql_queries import stored_and_folded
from tests.table_comparison import declarations_of, differences, logs_of, tables_of, united

pytestmark = pytest.mark.slow

COUNTING = declared("CountingAction", "counting_action", field("robot_id", "integer", 2), field("milk", "object", 3))


def episode(number: int) -> Script:
    """Return an episode in which a robot is added, drives, counts and speaks; it has each kind of id column."""
    script = Script(number)
    script.put(EpisodeStarted(description=f"e{number}", created_by="me", host="h", software="0", python="3"))
    robot = script.put(ObjectAdded(name="pr2", object_type="ROBOT", pose=pose(number)))
    root = script.put(NodeStarted(kind="root"))
    for of, parameters in (
        (
            NAVIGATE,
            {
                "target_location": {
                    "position": [1, 2, number],
                    "orientation": [0, 0, 0, 1],
                    "frame": "map",
                    "time_ns": 5,
                }
            },
        ),
        (COUNTING, {"robot_id": 2**31 * 9, "milk": {"object": robot, "row": robot}}),
        (SAYING, {"text": "a"}),
    ):
        node = script.put(NodeStarted(kind="action", parent=root, designator=name_of(of), parameters=parameters))
        script.put(NodeEnded(node=node, status="SUCCEEDED"))
    script.put(JointsMoved(object=ObjectReference(robot, robot), joints={"a": 0.5, "b": -0.25}, node=root))
    script.put(NodeEnded(node=root, status="SUCCEEDED"))
    script.put(EpisodeEnded(status="SUCCEEDED"))
    return script


@pytest.fixture(scope="module")
def three_episodes(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """A memory that tests copy and do not change."""
    file = tmp_path_factory.mktemp("memory") / "memory.db"
    asyncio.run(fill(f"sqlite:///{file}", [episode(number) for number in (1, 2, 3)]))
    return file


async def fill(url: str, episodes: Sequence[Script]) -> None:
    log = await EventLog.open(DatabaseAddress.parse(url), create=True)
    records: list[Record] = [*declarations(NAVIGATE, COUNTING, SAYING)]
    try:
        for each in episodes:
            await stored_and_folded(log, [*records, *each.records])
    finally:
        await log.close()


async def test_the_same_episodes_under_other_numbers_on_another_kind_of_database_are_the_same(
    tmp_path: Path, server: Server
) -> None:
    scripts = [episode(number) for number in range(1, 6)]
    file, other = f"sqlite:///{tmp_path}/memory.db", server.new_database()
    await fill(file, scripts)
    await fill(other, random.Random(1).sample(scripts, 5))
    numbers = "SELECT id, number FROM episode ORDER BY id"
    assert ask(file, numbers) != ask(other, numbers)
    tables = tables_of(file)
    assert differences(tables, tables_of(other)) == []
    assert logs_of(file) == logs_of(other)
    assert declarations_of(file) == declarations_of(other)
    identity = "00000000-0000-7000-8000-000000000001"
    assert tables["counting_action"][((identity, 6, 0),)] == {
        "process_metadata_id": identity, "robot_id": 2**31 * 9, "milk_id": (identity, 2, 0)
    }  # fmt: skip
    assert tables["navigate_action"][((identity, 4, 0),)] == {
        "process_metadata_id": identity, "target_location_id": (identity, 4, 2)
    }  # fmt: skip
    assert tables["joint_change"][((identity, 2 + 8, 0), "b")]["position"] == -0.25
    assert tables["process_metadata"][(identity,)]["description"] == "e1"
    assert {len(rows) for rows in tables.values()} == {5, 10, 20}
    parts = [f"sqlite:///{tmp_path}/{name}.db" for name in "ab"]
    await fill(parts[0], scripts[:3])
    await fill(parts[1], scripts[2:])
    assert differences(united(*map(tables_of, parts)), tables) == []
    assert len(differences(tables_of(parts[0]), tables)) == sum(map(len, tables.values())) * 2 // 5


@pytest.mark.parametrize(
    ("change", "table"),
    [
        ("DELETE FROM zz_pose__1001 WHERE z = 3", "pose"),
        ("UPDATE zz_pose__1001 SET x = x + 1e-12 WHERE z = 3", "pose"),
        ("UPDATE zz_pose__1001 SET frame = NULL WHERE z = 3", "pose"),
        (
            "UPDATE zz_task_tree_node__1001 SET parent_id = parent_id + 32 WHERE dtype = 'SayingAction'",
            "task_tree_node",
        ),
        ("UPDATE zz_counting_action__1001 SET milk_id = milk_id + 2147483648 WHERE id < 4294967296", "counting_action"),
        ("UPDATE zz_joint_change__1001 SET process_metadata_id = 2 WHERE process_metadata_id = 1", "joint_change"),
        ("UPDATE zz_process_metadata__1001 SET created_at = created_at + 1 WHERE id = 1", "process_metadata"),
    ],
)
def test_every_difference_is_reported(three_episodes: Path, tmp_path: Path, change: str, table: str) -> None:
    one, other = f"sqlite:///{three_episodes}", f"sqlite:///{tmp_path}/b.db"
    shutil.copy(three_episodes, tmp_path / "b.db")
    assert differences(tables_of(one), tables_of(other)) == []
    ask_to_change(other, change)
    lines = differences(tables_of(one), tables_of(other))
    assert lines
    assert {line.split()[0] for line in lines} == {table}
