"""The tables of a custom projection are rebuilt and verified, and continued after a kill."""

from __future__ import annotations

import asyncio
import os
import signal

import pytest
from sqlalchemy.ext.asyncio import AsyncConnection

from pycrorm_async.projections.custom import CustomRows
from pycrorm_async.projections.findings import Difference
from pycrorm_async.projections.rebuild import Rebuild, claimed, clear
from pycrorm_async.projections.verify import verify
from pycrorm_async.store.address import DatabaseAddress
from pycrorm_async.store.log import EventLog
from tests.commands import FORKED, fork
from tests.projections.event_script import PICK_UP, declarations, mixed, row
from tests.projections.grasp_rate import (
    GraspRate,
    NextGraspRate,
    NoLeftHand,
    folded,
    rebuilt,
    rows_of,
    tries,
    visible_rows,
)
from tests.projections.sql_queries import names

pytestmark = [pytest.mark.soak_on("postgresql"), pytest.mark.slow]
"""These tests take long on a server, where they run in turns; other modules show that the server behaves alike."""


async def test_a_new_version_is_not_folded_before_a_rebuild(log: EventLog, caplog: pytest.LogCaptureFixture) -> None:
    await folded(log, [*declarations(PICK_UP), *tries(1).records], GraspRate())
    before = await folded(log, [], GraspRate())
    projector = await folded(log, tries(2).records, NextGraspRate())
    assert "have version 1, its code has version 2: run `pycrorm rebuild grasp_rate`" in caplog.text
    assert await visible_rows(log) == rows_of(1)
    await rebuilt(log, NextGraspRate())
    new = [(each[0], each[1], each[2], each[3] == "TOP") for episode in (1, 2) for each in rows_of(episode)]
    assert await visible_rows(log) == new
    assert "grasp_tries_per_arm" not in await names(log, "view")
    caplog.clear()
    await log.append(tries(3).records)
    await before.catch_up()  # this process has version 1, and leaves the table
    assert await visible_rows(log) == new
    assert "this process stops folding the projection grasp_rate" in caplog.text
    assert await projector.catch_up() == 0


async def test_a_rebuild_makes_the_same_rows_as_live_folding(log: EventLog) -> None:
    projector = await folded(log, [*declarations(PICK_UP), *mixed(tries(1), tries(2))], GraspRate())
    await rebuilt(log, GraspRate())
    assert await visible_rows(log) == [*rows_of(1), *rows_of(2)]
    assert "zz_pycrorm_own_grasp_try__1002" in await names(log, "table")
    assert not [each for each in await names(log, "table") if "grasp_" in each and each.endswith("__1001")]
    await log.append(tries(3).records)  # a process that folded the old tables continues with the new ones
    await projector.catch_up()
    assert await visible_rows(log) == [*rows_of(1), *rows_of(2), *rows_of(3)]


async def test_a_rebuild_of_the_memorys_tables_leaves_a_custom_projection_unchanged(log: EventLog) -> None:
    await folded(log, [*declarations(PICK_UP), *mixed(tries(1), tries(2, simulated=True))], GraspRate())
    async with claimed(log):
        rebuild = await Rebuild.begin(log)
        await rebuild.show()
        assert await clear(log) == []
    assert await visible_rows(log) == rows_of(1)


async def test_an_interrupted_rebuild_is_continued(log: EventLog, monkeypatch: pytest.MonkeyPatch) -> None:
    await folded(log, [*declarations(PICK_UP), *mixed(tries(1), tries(2))], GraspRate())
    monkeypatch.setattr("pycrorm_async.projections.rebuild._BATCH_EVENTS", 5)
    async with claimed(log):
        broken = await Rebuild.begin(log, projection=GraspRate())
        assert await broken.fold_next_batch() == 5
    assert await visible_rows(log) == [*rows_of(1), *rows_of(2)]
    async with claimed(log):
        again = await Rebuild.begin(log, projection=GraspRate())
        assert again.number == broken.number
        assert await again.left() == 18 - 5
    await rebuilt(log, GraspRate())
    assert await visible_rows(log) == [*rows_of(1), *rows_of(2)]


async def test_verify_finds_every_change_and_nothing_else(log: EventLog, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr("pycrorm_async.projections.findings._PART_EVENTS", 10)  # several parts
    records = [*declarations(PICK_UP), *mixed(*(tries(episode) for episode in range(1, 5)))]
    await folded(log, [*records, *tries(5).records[:6]], GraspRate())
    result = await verify(log, projections=[GraspRate()])
    assert (result.drift, result.damage, result.not_compared) == (0, 0, {})
    assert result.rows == (await verify(log)).rows + 4 * 4 + 2
    assert (await verify(log)).not_compared == {"grasp_rate": "its code is not installed here"}
    table = "zz_pycrorm_own_grasp_try__1001"
    first, second = rows_of(2)[:2]
    async with log.engine.begin() as connection:
        for change in (
            f"UPDATE {table} SET arm = 'BOTH' WHERE id = {first[0]}",
            f"DELETE FROM {table} WHERE id = {second[0]}",
            f"INSERT INTO {table} (id, process_metadata_id) VALUES ({row(5, number=9)}, 9)",
        ):
            await connection.exec_driver_sql(change)
    result = await verify(log, projections=[GraspRate()])
    assert result.differences == [
        Difference(2, 3, "grasp_try", "arm", "BOTH", "LEFT"),
        Difference(2, 5, "grasp_try", None, None, second),
        Difference(9, 5, "grasp_try", None, (row(5, number=9), 9, None, None, None), None),
    ]
    (only,) = [each for each in await log.episodes() if each.number == 1]
    assert (await verify(log, episode=only, projections=[GraspRate()])).drift == 0
    await rebuilt(log, GraspRate())
    assert (await verify(log, projections=[GraspRate()])).drift == 0


async def test_verify_reports_a_fold_that_was_changed_without_a_new_version(log: EventLog) -> None:
    await folded(log, [*declarations(PICK_UP), *tries().records], GraspRate())
    result = await verify(log, projections=[NoLeftHand()])
    (difference,) = map(str, result.differences)
    assert difference == (
        "grasp_rate.fold is 'folded in the tables', and should be"
        " 'parked: grasp_rate raised ZeroDivisionError: no right hand'"
    )
    assert (await verify(log, projections=[NextGraspRate()])).not_compared.keys() == {"grasp_rate"}


def _die_in_batch(url: str, last: int, *, rebuilding: bool) -> None:
    """Fold four events at a time, and die when the rows of that many batches are written but the last is not
    committed.
    """
    write, count = CustomRows.write, 0

    async def count_written(self: CustomRows, connection: AsyncConnection, generation: int) -> None:
        nonlocal count
        await write(self, connection, generation)
        count += 1
        if count == last:
            os.kill(os.getpid(), signal.SIGKILL)

    async def fold() -> None:
        log = await EventLog.open(DatabaseAddress.parse(url), create=True)
        if rebuilding:
            async with claimed(log):
                await (await Rebuild.begin(log, projection=GraspRate())).show()
        await folded(log, [], GraspRate(), batch_events=4)

    with pytest.MonkeyPatch.context() as patch:
        patch.setattr(CustomRows, "write", count_written)
        patch.setattr("pycrorm_async.projections.rebuild._BATCH_EVENTS", 4)
        asyncio.run(fold())


@pytest.mark.parametrize("rebuilding", [pytest.param(False, marks=pytest.mark.soak), True])
async def test_a_killed_fold_continues_where_it_was(log: EventLog, database_url: str, *, rebuilding: bool) -> None:
    await folded(log, [*declarations(PICK_UP), *mixed(tries(1), tries(2))], *([GraspRate()] if rebuilding else []))
    for last in (1, 2):
        process = FORKED.Process(target=_die_in_batch, args=(database_url, last), kwargs={"rebuilding": rebuilding})
        fork(process)
        await asyncio.to_thread(process.join)
        assert process.exitcode == -signal.SIGKILL
    if rebuilding:
        assert await visible_rows(log) == [*rows_of(1), *rows_of(2)]
        async with claimed(log):
            assert await (await Rebuild.begin(log, projection=GraspRate())).left() == 18 - 4
        await rebuilt(log, GraspRate())
    else:
        assert await visible_rows(log) == rows_of(1)[:1]
        await folded(log, [], GraspRate())
    assert await visible_rows(log) == [*rows_of(1), *rows_of(2)]
    assert (await verify(log, projections=[GraspRate()])).drift == 0
