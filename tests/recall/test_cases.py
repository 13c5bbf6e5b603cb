"""A case is made of each action that ends, and the stored cases are those that the log makes."""

from __future__ import annotations

import asyncio
import os
import signal
from collections.abc import AsyncIterator
from contextlib import asynccontextmanager
from math import cos, pi, radians, sin
from pathlib import Path
from random import Random

import pytest
from sqlalchemy import column, table, update
from sqlalchemy.ext.asyncio import AsyncConnection

from pycrorm_async import Reading
from pycrorm_async.errors import DamageError, TablesOutdated
from pycrorm_async.events import types as events
from pycrorm_async.memory import Memory
from pycrorm_async.operations.copy import copy_episodes
from pycrorm_async.operations.rebuild import rebuild_memory, rebuild_projection
from pycrorm_async.projections import pipeline
from pycrorm_async.projections.custom import own_projections
from pycrorm_async.projections.custom_tables import states
from pycrorm_async.projections.findings import VerifyResult
from pycrorm_async.projections.generations import PROJECTION, read_generation
from pycrorm_async.projections.projector import Projector
from pycrorm_async.projections.rebuild import Rebuild, claimed, clear
from pycrorm_async.projections.verify import verify
from pycrorm_async.recall import cases as stored_blocks
from pycrorm_async.recall.blocks import CaseBlock
from pycrorm_async.recall.cases import BLOCK_COLUMNS, BlockHeading, read_blocks, read_headings, rows_of
from pycrorm_async.recall.columns import RESERVED, Case
from pycrorm_async.recall.recall import Recall
from pycrorm_async.settings import Settings
from pycrorm_async.store.address import DatabaseAddress
from pycrorm_async.store.log import EventLog
from tests.commands import FORKED, fork
from tests.golden.unpacking import unpack_memory, unpack_memory_v1
from tests.golden.zoo import ZOO
from tests.memory.note_actions import NoteActionPerformable
from tests.projections.event_script import T0_NS, declared, mixed, name_of, pose, row, time_us
from tests.projections.sql_queries import ask
from tests.recall.cases import LEFT_TURN, TYPES, CaseScript, cases_of, in_order, random_script

# === stored cases =============================================================================================
#
# Stored cases are those that the log makes: in any batches, on both databases, after merges, kills and rebuilds.


async def projector_of(log: EventLog, *, batch_events: int = 10_000) -> Projector:
    projector = Projector(log, installed=own_projections(), batch_events=batch_events)
    await projector.open()
    return projector


async def stored(log: EventLog) -> tuple[list[BlockHeading], list[Case]]:
    """Read all blocks; return their headings, and their cases by node."""
    async with log.snapshot() as connection:
        generation = await read_generation(connection, f"{PROJECTION}recall")
        assert generation is not None
        headings = await read_headings(connection, generation.number)
        blocks = await read_blocks(connection, generation.number, [each.number for each in headings])
    assert [each.cases for each in headings] == [len(blocks[each.number]) for each in headings]
    return headings, in_order(case for each in blocks.values() for case in each.cases())


async def verified(log: EventLog) -> VerifyResult:
    return await verify(log, projections=own_projections())


async def rebuilt(log: EventLog) -> None:
    async with claimed(log):
        rebuild = await Rebuild.begin(log, projection=own_projections()[0])
        await rebuild.show()
        assert await clear(log) == []


def small_blocks(monkeypatch: pytest.MonkeyPatch) -> None:
    """Merge two blocks of a level, so that a block of 16 cases is full."""
    monkeypatch.setattr(stored_blocks, "_MERGED", 2)


@pytest.mark.soak_on("postgresql")
@pytest.mark.slow
async def test_cases_do_not_depend_on_batches_restarts_processes_or_merges(
    log: EventLog, monkeypatch: pytest.MonkeyPatch
) -> None:
    small_blocks(monkeypatch)
    monkeypatch.setattr(pipeline, "_PAGE_EVENTS", 11)
    random = Random(7)
    scripts = [random_script(number, random, actions=40) for number in range(1, 13)]
    records = [each for first in range(0, len(scripts), 4) for each in mixed(*scripts[first : first + 4])]
    await log.append(TYPES)
    projectors = [await projector_of(log, batch_events=8)]
    while records:
        size = random.randint(20, 90)
        await log.append(records[:size])
        del records[:size]
        if random.random() < 0.2:  # a restart, or another process beside the first
            kept = projectors[: random.randint(0, 1)]
            projectors = [*kept, await projector_of(log, batch_events=random.randint(5, 60) // 4)]
        if random.random() < 0.7:
            await random.choice(projectors).catch_up()
    await asyncio.gather(*(each.catch_up() for each in projectors))
    headings, cases = await stored(log)
    expected = cases_of(*scripts)
    assert cases == expected
    assert len(headings) < 25
    assert len({each.level for each in headings}) > 1
    result = await verified(log)
    assert (result.drift, result.damage, result.not_compared) == (0, 0, {})
    await rebuilt(log)
    assert (await stored(log))[1] == expected


@pytest.mark.slow
@pytest.mark.soak_on("postgresql")
async def test_blocks_are_merged_as_they_grow(log: EventLog) -> None:
    script = CaseScript()
    await log.append([*TYPES, *script.records])
    projector = await projector_of(log)
    for _ in range(40):
        script.end(script.wait())
        await log.append(script.records[-2:])
        await projector.catch_up()
    headings, cases = await stored(log)
    assert sorted(each.level for each in headings) == [0] * 8 + [1] * 2
    assert [each.cases for each in headings if each.level == 1] == [16, 16]
    assert cases == cases_of(script)
    (state,) = await states(log, own_projections())
    assert (state.name, state.behind, state.parked, state.fault) == ("recall", 0, {}, None)


@pytest.mark.slow
@pytest.mark.soak_on("postgresql")
async def test_cases_are_folded_at_intervals_unless_a_caller_waits_for_them(
    log: EventLog, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setattr("pycrorm_async.projections.custom_tables._CHECK_S", 60.0)
    script = CaseScript()
    await log.append([*TYPES, *script.records])
    projector = await projector_of(log)
    for count in (1, 2, 3):
        script.end(script.wait())
        await log.append(script.records[-2:])
        while await projector.fold_next_batch():
            pass
        assert len((await stored(log))[1]) == 1, f"the cases of the first of {count} batches are stored"
    await projector.catch_up()
    assert (await stored(log))[1] == cases_of(script)


@pytest.mark.slow
async def test_a_memory_of_an_earlier_version_has_its_cases_after_a_rebuild_and_so_has_a_copy(tmp_path: Path) -> None:
    url = unpack_memory_v1(tmp_path)
    await rebuild_memory(url)
    await rebuild_projection(url, own_projections()[0])
    query = "SELECT id, dtype, status FROM task_tree_node WHERE kind = 'action' AND status <> 'RUNNING' ORDER BY id"
    async with opened(url) as log:
        before = (await stored(log))[1]
        actions = await ask(log, query)
        assert [(each.node, each.type, each.status) for each in before if not each.simulated] == actions
        assert [each.type for each in before if each.simulated] == ["GreetAction"]
        assert (await verified(log)).drift == 0
    copy = f"sqlite:///{tmp_path}/copy.db"
    await copy_episodes(url, copy)
    async with opened(copy) as log:
        assert [each._replace(node=0, parent=None) for each in (await stored(log))[1]] == [
            each._replace(node=0, parent=None) for each in before
        ]


@pytest.mark.slow
async def test_blocks_of_an_earlier_format_stop_no_other_fold_and_a_rebuild_makes_them_again(tmp_path: Path) -> None:
    url = unpack_memory(ZOO / "fold_9_cases_2.tar.gz", tmp_path)
    async with Memory.open(url) as memory:
        await NoteActionPerformable("one").perform()
        await memory.flush()
        with pytest.raises(TablesOutdated, match="version 2 instead of 3: run `pycrorm rebuild recall`"):
            await memory.recall("PourAction")
    async with opened(url) as log:
        assert await ask(log, "SELECT count(*) FROM task_tree_node WHERE dtype = 'NoteAction'") == [(1,)]
        (state,) = await states(log, own_projections())
        assert state.fault is not None
        assert "run `pycrorm rebuild recall`" in state.fault
    await rebuild_projection(url, own_projections()[0])
    async with Reading.open(url) as reading:
        poured = await Recall.of(reading)("PourAction", has={"into": "bowl"})
        assert (poured[0].symbols["into"], poured[0].status) == ("bowl", "FAILED")
        assert (await Recall.of(reading)("NoteAction")).considered == 1
    async with opened(url) as log:
        assert (await verified(log)).drift == 0
        views = await ask(log, "SELECT name FROM sqlite_master WHERE name LIKE '%recall%' AND name NOT LIKE 'zz%'")
        assert views == [("recall_block",)]


async def test_a_memory_that_makes_no_cases_leaves_them_to_the_next(tmp_path: Path) -> None:
    url = f"sqlite:///{tmp_path}/memory.db"
    async with Memory.open(url, settings=Settings(recall=False)) as memory:
        await NoteActionPerformable("one").perform()
    async with opened(url) as log:
        assert await states(log, own_projections()) == []
    async with Memory.open(url) as memory:
        await NoteActionPerformable("two").perform()
        await memory.flush()
        async with opened(url) as log:
            assert [each.symbols["text"] for each in (await stored(log))[1]] == ["one", "two"]


@pytest.mark.soak
async def test_processes_that_fold_and_merge_at_once_lose_and_double_nothing(
    log: EventLog, database_url: str, monkeypatch: pytest.MonkeyPatch
) -> None:
    small_blocks(monkeypatch)
    scripts = [random_script(number, Random(number), actions=60) for number in range(1, 41)]
    await log.append([*TYPES, *mixed(*scripts)])
    plain = Projector(log)
    await plain.open()
    await plain.catch_up()
    logs = [await EventLog.open(DatabaseAddress.parse(database_url), create=True) for _ in range(4)]
    try:
        projectors = [
            await projector_of(each, batch_events=size) for each, size in zip(logs, (7, 11, 13, 29), strict=True)
        ]
        await asyncio.gather(*(each.catch_up() for each in projectors))
    finally:
        for each in logs:
            await each.close()
    assert (await stored(log))[1] == cases_of(*scripts)
    assert (await verified(log)).drift == 0


@asynccontextmanager
async def opened(url: str) -> AsyncIterator[EventLog]:
    log = await EventLog.open(DatabaseAddress.parse(url), create=False)
    try:
        yield log
    finally:
        await log.close()


async def filled(log: EventLog) -> list[Case]:
    """Fold four episodes of which each makes one block; return their cases."""
    random = Random(3)
    scripts = [random_script(number, random, actions=30) for number in range(1, 5)]
    await log.append(TYPES)
    projector = await projector_of(log)
    for script in scripts:
        await log.append(script.records)
        await projector.catch_up()
    return cases_of(*scripts)


BLOCK = "zz_pycrorm_own_recall_block__1001"
SECOND = f"id = (SELECT id FROM {BLOCK} ORDER BY id LIMIT 1 OFFSET 1)"
COLUMNS = ", ".join(["process_metadata_id", *BLOCK_COLUMNS])
CHANGES: dict[str, tuple[str | dict[str, str], str]] = {
    "a changed byte": (
        {"sqlite": f"UPDATE {BLOCK} SET data = CAST(substr(data, 1, 99) || x'02' || substr(data, 101) AS BLOB)"
                   f" WHERE {SECOND}",
         "postgresql": f"UPDATE {BLOCK} SET data = set_byte(data, 99, 2) WHERE {SECOND}"},
        "is damaged: its bytes were changed",
    ),
    "a text": (f"UPDATE {BLOCK} SET data = 'text' WHERE {SECOND}", "is damaged: its bytes were changed"),
    "another word": ("", "recall_block.arm is 'RIGHT', and should be 'LEFT'"),
    "a missing block": (f"DELETE FROM {BLOCK} WHERE {SECOND}", "recall_block lacks a row: Case(node="),
    "another number of cases": (f"UPDATE {BLOCK} SET cases = cases + 1 WHERE {SECOND}", "cases, and should have"),
    "doubled cases": (
        f"INSERT INTO {BLOCK} (id, {COLUMNS}) SELECT id + 3, {COLUMNS} FROM {BLOCK} WHERE {SECOND}",
        "recall_block.blocks with it is 2, and should be 1",
    ),
}  # fmt: skip


async def take_right_arms(connection: AsyncConnection) -> None:
    """Write a block whose cases have another arm than in the log."""
    number = (await read_headings(connection, 1001))[1].number
    block = (await read_blocks(connection, 1001, [number]))[number]
    changed = [case._replace(symbols={**case.symbols, "arm": "RIGHT"}) for case in block.cases() if case.symbols]
    [[row]] = rows_of(CaseBlock.of(changed), 1001).values()
    values = dict(zip(BLOCK_COLUMNS, row[2:], strict=True))
    table_ = table(BLOCK, column("id"), column("data"), column("checksum"), column("cases"))
    values = {name: values[name] for name in ("data", "checksum", "cases")}
    await connection.execute(update(table_).where(table_.c.id == number).values(values))


@pytest.mark.soak_on("postgresql")
@pytest.mark.slow
async def test_verify_finds_what_was_changed_and_a_rebuild_repairs_it(log: EventLog) -> None:
    expected = await filled(log)
    assert len((await stored(log))[0]) == 4
    assert (await verified(log)).drift == 0
    kind = log.engine.dialect.name
    async with log.engine.begin() as connection:
        await connection.exec_driver_sql(f"CREATE TABLE kept AS SELECT * FROM {BLOCK}")
    for change, message in CHANGES.values():
        async with log.engine.begin() as connection:
            await connection.exec_driver_sql(f"DELETE FROM {BLOCK}")
            await connection.exec_driver_sql(f"INSERT INTO {BLOCK} SELECT * FROM kept")
            if change:
                await connection.exec_driver_sql(change[kind] if isinstance(change, dict) else change)
            else:
                await take_right_arms(connection)
        result = await verified(log)
        assert any(message in str(each) for each in result.differences), (message, result.differences)
        assert result.damage == 0
    await rebuilt(log)
    assert (await stored(log))[1] == expected
    assert (await verified(log)).drift == 0


@pytest.mark.slow
@pytest.mark.soak_on("postgresql")
async def test_a_damaged_block_stops_the_merge_with_its_reason_and_no_other_fold(
    log: EventLog, monkeypatch: pytest.MonkeyPatch
) -> None:
    await filled(log)
    async with log.engine.begin() as connection:
        await connection.exec_driver_sql(f"UPDATE {BLOCK} SET checksum = checksum + 1 WHERE {SECOND}")
    with pytest.raises(DamageError, match=r"block [0-9]+ of recall is damaged.*run `pycrorm rebuild recall`"):
        await stored(log)
    small_blocks(monkeypatch)
    script = random_script(5, Random(5), actions=30)
    await log.append(script.records)
    await (await projector_of(log)).catch_up()
    assert await ask(log, "SELECT count(*) FROM episode WHERE folded < head") == [(0,)]
    (state,) = await states(log, own_projections())
    assert state.fault is not None
    assert "of recall is damaged" in state.fault
    assert state.behind == len(script.records)
    await rebuilt(log)
    (state,) = await states(log, own_projections())
    assert (state.fault, state.behind) == (None, 0)


def _die(url: str, place: str, last: int) -> None:
    """Fold 24 events at a time, and die where a function of `stored_blocks` is called for that time."""
    count, real = 0, getattr(stored_blocks, place)

    def counted(*arguments: object) -> object:
        nonlocal count
        count += 1
        if count == last:
            os.kill(os.getpid(), signal.SIGKILL)
        return real(*arguments)

    async def fold() -> None:
        log = await EventLog.open(DatabaseAddress.parse(url), create=True)
        await (await projector_of(log, batch_events=6)).catch_up()

    with pytest.MonkeyPatch.context() as patch:
        small_blocks(patch)
        patch.setattr(stored_blocks, place, counted)
        asyncio.run(fold())


@pytest.mark.slow
@pytest.mark.soak_on("postgresql")
@pytest.mark.parametrize(
    ("place", "last"),
    [
        pytest.param("_lock_blocks", 3, id="a block is written"),
        pytest.param("_level_of", 8, id="the blocks of a merge are deleted"),
    ],
)
async def test_a_fold_that_is_killed_in_a_block_or_a_merge_continues(
    log: EventLog, database_url: str, monkeypatch: pytest.MonkeyPatch, place: str, last: int
) -> None:
    scripts = [random_script(number, Random(number), actions=40) for number in range(1, 4)]
    await log.append([*TYPES, *mixed(*scripts)])
    plain = Projector(log)
    await plain.open()
    await plain.catch_up()
    process = FORKED.Process(target=_die, args=(database_url, place, last))
    fork(process)
    await asyncio.to_thread(process.join)
    assert process.exitcode == -signal.SIGKILL
    expected = cases_of(*scripts)
    _, before = await stored(log)
    assert 0 < len(before) < len(expected)
    assert before == [each for each in expected if each in before]
    small_blocks(monkeypatch)
    await (await projector_of(log)).catch_up()
    assert (await stored(log))[1] == expected
    assert (await verified(log)).drift == 0


# === episode cases ============================================================================================
#
# A case is made of each action that ends: the situation in which it started, and its outcome.


def test_a_case_has_the_situation_before_the_action_and_its_outcome() -> None:
    script = CaseScript()
    milk = script.add("milk", "MILK", pose(1.0, 0.5, 0.9, turned=LEFT_TURN))
    script.add("bowl", "BOWL", pose(1.0, 0.9, 0.9))
    script.add("cup", "JEROEN_CUP", pose(1.0, 0.5, 0.3))
    table = script.add("table", "GENERIC_OBJECT", pose(5.0))
    root = script.put(events.NodeStarted("root"))
    before = script.wait(root)
    script.end(before, "FAILED", "PerceptionTimeout")
    node = script.fetch(
        milk, root, status="urgent", grams=200, gently=True, at="2026-11-23T10:00:00.000000Z",
        goal=pose(2.0, 1.0, 0.5), surface={"object": table, "row": table},
    )  # fmt: skip
    script.put(events.ObjectMoved(milk, "milk", "MILK", pose(9.0)))
    script.end(node, "FAILED", "IKError")
    waited, fetched = cases_of(script)
    assert waited == Case(
        row(before), time_us(before), "WaitAction", {}, {"seconds": 1.5}, "FAILED", "PerceptionTimeout", 1.0
    )
    assert fetched._replace(numbers={}) == Case(
        row(node),
        time_us(node),
        "FetchAction",
        {
            "after": "WaitAction",
            "after_status": "FAILED",
            "robot": "pr2",
            "object_type": "MILK",
            "object_name": "milk",
            "near": ("BOWL",),
            "arm": "LEFT",
            "status_parameter": "urgent",
            "gently": "True",
            "surface_type": "GENERIC_OBJECT",
        },
        {},
        "FAILED",
        "IKError",
        2.0,
    )
    # The robot stands at (2, 0), turned to the left as the milk is: in the milk's frame it is 0.5 m behind its right.
    assert fetched.numbers == pytest.approx(
        {
            "stand_x": -0.5, "stand_y": -1.0, "stand_yaw": 0.0, "torso": 0.25, "object_z": 0.9, "height": 0.65,
            "grams": 200.0, "goal_x": 1.0, "goal_y": 0.0, "goal_z": 0.5, "goal_yaw": -pi / 2,
        },
        abs=1e-6,
    )  # fmt: skip


def test_beside_an_object_that_lies_or_leans_the_robot_has_no_place_in_its_frame() -> None:
    script = CaseScript()
    for degrees in (0, 7, 9, 90, 180):
        turn = radians(degrees) / 2
        milk = script.add(
            "milk", "MILK", events.PoseValue((1.0, 0.0, 0.9), (sin(turn), 0.0, 0.0, cos(turn)), "map", T0_NS)
        )
        script.end(script.fetch(milk))
    places = [{"stand_x", "stand_y", "stand_yaw"} & each.numbers.keys() for each in cases_of(script)]
    assert [len(each) for each in places] == [3, 3, 0, 0, 0]
    assert all(each.numbers["object_z"] == pytest.approx(0.9) for each in cases_of(script))


def test_the_outcome_is_no_feature_of_the_situation_and_a_simulation_is_marked() -> None:
    script = CaseScript(simulated=True)
    milk = script.add("milk", "MILK", pose())
    first = script.fetch(milk)
    second = script.fetch(milk)
    script.end(first, "SUCCEEDED")
    script.end(second, "FAILED", "IKError")
    succeeded, failed = cases_of(script)
    assert succeeded.simulated
    assert (succeeded.symbols, succeeded.numbers) == (failed.symbols, failed.numbers)
    assert not RESERVED & (failed.symbols.keys() | failed.numbers.keys())


def test_an_action_has_the_action_around_it_and_the_one_before_it_inside_that() -> None:
    script = CaseScript()
    outer = script.wait()
    sequential = script.put(events.NodeStarted("language", outer))
    one = script.wait(sequential)
    inner = script.wait(one)
    script.end(inner)
    script.end(one, "CANCELLED")
    two = script.wait(script.put(events.NodeStarted("motion", outer)))
    script.end(two)
    script.end(outer)
    last = script.wait()
    script.end(last)
    around = {each.sequence: (each.symbols, each.parent) for each in cases_of(script)}
    assert around == {
        outer: ({}, None),
        one: ({"inside": "WaitAction"}, row(outer)),
        inner: ({"inside": "WaitAction"}, row(one)),
        two: ({"inside": "WaitAction", "after": "WaitAction", "after_status": "CANCELLED"}, row(outer)),
        last: ({"after": "WaitAction", "after_status": "SUCCEEDED"}, None),
    }


def test_what_the_robot_holds_and_what_is_near_follows_the_world() -> None:
    script = CaseScript()
    milk, bowl = script.add("milk", "MILK", pose()), script.add("bowl", "BOWL", pose(0.501))  # not near
    robot, held = events.ObjectReference(script.robot, script.robot), events.ObjectReference(bowl, bowl)
    nodes = [script.fetch(milk)]
    script.put(events.ObjectAttached(robot, held, "gripper"))
    script.put(events.ObjectMoved(bowl, "bowl", "BOWL", pose(0.5)))
    nodes.append(script.fetch(milk))
    script.put(events.ObjectDetached(robot, held))
    nodes.append(script.fetch(milk))
    script.put(events.ObjectRemoved(held))
    nodes.append(script.fetch(milk))
    script.put(events.ObjectRemoved(events.ObjectReference(milk, milk)))
    nodes.append(script.fetch(milk))
    for node in nodes:
        script.end(node)
    seen = [{name: each.symbols.get(name) for name in ("near", "held", "object_type")} for each in cases_of(script)]
    assert seen == [
        {"near": None, "held": None, "object_type": "MILK"},
        {"near": ("BOWL",), "held": ("BOWL",), "object_type": "MILK"},
        {"near": ("BOWL",), "held": None, "object_type": "MILK"},
        {"near": None, "held": None, "object_type": "MILK"},
        {"near": None, "held": None, "object_type": None},
    ]


def test_an_object_outside_of_the_recorded_world_has_what_its_value_has() -> None:
    script = CaseScript()
    believed = {"dtype": "BelieveObject", "name": "cup", "object_type": "JEROEN_CUP"}
    for pose_ in ({}, {"pose": {"position": [2, 1, 1], "orientation": [0, 0, 0, 1], "frame": "map", "time_ns": 1}}):
        script.end(script.fetch({**believed, **pose_}))
    unplaced, placed = cases_of(script)
    assert unplaced.symbols["object_type"] == placed.symbols["object_type"] == "JEROEN_CUP"
    assert unplaced.numbers.keys() == {"torso"}
    assert (placed.numbers["object_z"], placed.numbers["height"], placed.numbers["stand_y"]) == (1.0, 0.75, -1.0)


def test_running_actions_become_lost_cases_when_their_episode_is_lost_and_none_otherwise() -> None:
    lost, ended = CaseScript(), CaseScript()
    for script, status in ((lost, "LOST"), (ended, "SUCCEEDED")):
        outer = script.wait()
        script.end(script.wait(outer), "LOST")
        script.wait(outer)
        script.put(events.EpisodeEnded(status))  # type: ignore[arg-type]
    assert [(each.status, each.duration_s) for each in cases_of(lost)] == [("LOST", None)] * 3
    assert [(each.status, each.duration_s) for each in cases_of(ended)] == [("LOST", None)]


def test_an_action_whose_type_was_never_declared_is_no_case_and_stops_nothing() -> None:
    script = CaseScript()
    strange = script.put(events.NodeStarted("action", designator=name_of(declared("Strange", "strange"))))
    inside = script.wait(strange)
    script.end(inside)
    script.end(strange)
    assert [each.sequence for each in cases_of(script)] == [inside]


@pytest.mark.parametrize("seconds", [None, 10**400, 1e308])
def test_a_number_that_is_missing_or_has_no_float_is_left_out(seconds: object) -> None:
    script = CaseScript()
    script.end(script.wait(seconds=seconds))
    assert [each.numbers for each in cases_of(script)] == [{}]
