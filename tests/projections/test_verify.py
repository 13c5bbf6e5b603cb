"""Verify finds every change of every table and nothing else, whatever the log and the size of its parts."""

from __future__ import annotations

import shutil
from collections.abc import AsyncIterator
from pathlib import Path
from typing import Any

import pytest

from pycrorm_async import Memory
from pycrorm_async.projections import verify as parts
from pycrorm_async.projections.findings import TableDifference
from pycrorm_async.projections.projector import Projector
from pycrorm_async.projections.verify import verify
from pycrorm_async.store.log import EventLog
from tests.databases import ask, put_memory, run_in_own_loop
from tests.projections.event_script import Script
from tests.projections.verify_cases import (
    another,
    assert_clean,
    delete,
    event_of,
    findings,
    fold_in_batches,
    full,
    in_own_loop,
    in_parts,
    insert,
    look,
    lost,
    opened,
    parked,
    rebuilt,
    rows_of,
    running,
    set_columns,
    visible_tables,
)
from tests.promises.test_random_plans import play

pytestmark = pytest.mark.slow


@pytest.fixture
def database_url(tmp_path: Path) -> str:
    """Use SQLite alone: other modules verify memories on a server."""
    return put_memory(tmp_path / "memory.db")


async def fill(url: str) -> None:
    """Store and fold episodes of every kind of end; the third is a simulation."""
    log_of_episodes = await opened(url)
    scripts = [full(1), full(2), full(3, simulated=True), lost(4), running(5), parked(6), full(7)]
    await fold_in_batches(log_of_episodes, scripts, 10_000)
    await log_of_episodes.close()


@pytest.fixture(scope="module")
def prepared(tmp_path_factory: pytest.TempPathFactory) -> Path:
    file = tmp_path_factory.mktemp("prepared") / "memory.db"
    run_in_own_loop(fill(f"sqlite:///{file}"))
    return file


@pytest.fixture
async def log(database_url: str, prepared: Path) -> AsyncIterator[EventLog]:
    """Open a log of these episodes."""
    shutil.copyfile(prepared, database_url.removeprefix("sqlite:///"))
    async with await opened(database_url) as log_of_episodes:
        yield log_of_episodes


# --- no differences ---------------------------------------------------------------------------------------------------


async def test_verify_finds_nothing_in_random_plans_with_failures(
    database_url: str, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    async with Memory.open(database_url, spool=tmp_path / "spool") as memory:
        for seed in range(10):
            await play(seed, memory)
    log = await opened(database_url)
    result = await look(log)
    assert_clean(result)
    assert (result.episodes, result.behind) == (10, 0)
    assert result.events == ask(database_url, "SELECT count(*) FROM event")[0][0]
    assert result.rows == sum(len(rows_of(database_url, each)) for each in visible_tables(database_url))
    for events in (60, 400):
        assert findings(await in_parts(log, events, monkeypatch)) == findings(result)
    await log.close()


async def test_verify_finds_nothing_in_batches_that_separate_starts_from_ends(
    database_url: str, monkeypatch: pytest.MonkeyPatch
) -> None:
    log = await opened(database_url)
    await fold_in_batches(log, [full(1), lost(2), full(3, simulated=True), running(4)], 1)
    assert_clean(await look(log))
    assert_clean(await in_parts(log, 10, monkeypatch))
    await log.close()


async def test_unfolded_events_are_no_fault(log: EventLog, database_url: str) -> None:
    result = await look(log)
    assert_clean(result)
    head = len(full(1).records)
    assert (result.episodes, result.behind, result.remarks) == (7, head - 10, 0)
    await log.append(full(5).records)
    assert_clean(await look(log))
    assert (await look(log)).behind == 2 * head - 26
    assert_clean(await look(log, episode=5))
    assert (await look(log, episode=5)).behind == head - 16
    assert (await look(log, episode=3)).rows == sum(
        event_of(table, row)[0] == 3 for table in visible_tables(database_url) for row in rows_of(database_url, table)
    )


async def test_a_rebuild_between_two_parts_is_no_fault(
    log: EventLog, database_url: str, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setattr(parts, "_PART_EVENTS", 10)
    event = 0

    async def rebuild() -> None:
        other = await opened(database_url)
        await rebuilt(other)
        await other.close()

    def record_once(_done: int, _total: int, _what: str | None = None) -> None:
        nonlocal event
        event += 1
        if event in (2, 5, 6):
            in_own_loop(rebuild)

    assert_clean(await verify(log, report_progress=record_once))
    assert {table.physical.rpartition("__")[2].strip('"') for table in visible_tables(database_url)} == {"1004"}


async def test_an_episode_that_grows_between_two_parts_is_no_fault(
    database_url: str, monkeypatch: pytest.MonkeyPatch
) -> None:
    log = await opened(database_url)
    whole, beginning = full(2, rounds=3), Script(2)
    beginning.records = whole.records[:12]
    await fold_in_batches(log, [full(1), beginning, full(3)], 10_000)
    monkeypatch.setattr(parts, "_PART_EVENTS", 5)
    stored = 12

    async def record() -> None:
        other = await opened(database_url)
        await other.append(whole.records[stored : stored + 6])
        projector = Projector(other)
        await projector.open()
        await projector.catch_up()
        await other.close()

    def record_more(_done: int, _total: int, _what: str | None = None) -> None:
        nonlocal stored
        in_own_loop(record)
        stored += 6

    result = await verify(log, report_progress=record_more)
    assert_clean(result)
    assert (result.events, result.behind) == (2 * len(full(1).records) + 18, 0)
    await log.close()


# --- every change -----------------------------------------------------------------------------------------------------


async def test_every_changed_value_is_reported_and_nothing_else(log: EventLog, database_url: str) -> None:
    filled = 0
    for table in visible_tables(database_url):
        rows = rows_of(database_url, table)
        if not rows:
            continue
        filled += 1
        row = rows[len(rows) // 2]
        values = {each: another(row[each], table.kinds[each]) for each in table.kinds if each not in table.key}
        if not values:
            continue
        set_columns(database_url, table, row, values)
        result = await look(log)
        number, sequence = event_of(table, row)
        assert result.differences == [
            TableDifference(number, sequence, table.name, column, value, row[column])
            for column, value in values.items()
        ]
        assert (result.drift, result.damage) == (len(values), 0)
        set_columns(database_url, table, row, {each: row[each] for each in values})
    assert filled == 17
    assert_clean(await look(log))


async def test_a_deleted_row_is_reported(log: EventLog, database_url: str) -> None:
    for table in visible_tables(database_url):
        for row in rows_of(database_url, table)[-1:]:
            delete(database_url, table, row)
            number, sequence = event_of(table, row)
            whole = tuple(row.values())
            assert (await look(log)).differences == [TableDifference(number, sequence, table.name, None, None, whole)]
            insert(database_url, table, row)
    assert_clean(await look(log))


@pytest.mark.parametrize(
    ("number", "sequence"),
    [(1, 999), (6, 11), (2**22 - 1, 5), (0, 0), (-1, 3)],
    ids=["after its last event", "parked", "last", "zero", "negative"],
)
async def test_a_row_without_an_event_is_reported_in_every_table(
    log: EventLog, database_url: str, number: int, sequence: int
) -> None:
    expected = []
    for table in visible_tables(database_url):
        added: dict[str, Any] = dict.fromkeys(table.kinds)
        added |= {each: "x" if "text" in table.kinds[each] else 0 for each in table.key}
        of_episode = table.name in ("process_metadata", "simulated_episode")
        if of_episode and number in (1, 6):
            continue
        added["id" if "id" in table.key else table.key[0]] = number if of_episode else number * 2**31 + sequence * 32
        insert(database_url, table, added)
        event = (number, 1) if of_episode else (number, sequence)
        expected.append(TableDifference(*event, table.name, None, tuple(added.values()), None))
    result = await look(log)
    assert sorted(result.differences, key=repr) == sorted(expected, key=repr)
    assert result.drift == len(expected) > 30
    if number in (1, 6):
        assert (await look(log, episode=number)).drift == len(expected)
    assert (await look(log, episode=7)).drift == 0
