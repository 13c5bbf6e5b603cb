"""The life of a memory: opened, recorded into, queried and closed; what it refuses and what it notices."""

from __future__ import annotations

import asyncio
import gc
import sqlite3
import warnings
from collections.abc import Iterator
from contextlib import closing, contextmanager, suppress
from dataclasses import replace
from pathlib import Path
from typing import Any

import pytest

from pycrorm_async import Memory, Reading, Settings
from pycrorm_async.errors import (
    CallerError,
    DatabaseUnavailable,
    FlushTimeout,
    SpoolForeign,
    SpoolStuck,
)
from tests.commands import answer
from tests.memory.note_actions import NoteActionPerformable, texts, url_of

# === memory ===================================================================================================
#
# The life of a memory: opened, recorded into, queried, and closed.


@pytest.mark.slow
async def test_a_temporary_memory_answers_queries_and_leaves_no_files() -> None:
    place = Path("/dev/shm")
    before = {path.name for path in place.glob("pycrorm-*/")}
    async with Memory.open("sqlite://") as memory:
        await NoteActionPerformable("gone soon").perform()
        await memory.flush()
        assert await texts(memory) == ["gone soon"]
        assert {path.name for path in place.glob("pycrorm-*/")} - before
    assert {path.name for path in place.glob("pycrorm-*/")} <= before


@pytest.mark.slow
async def test_flushed_records_are_in_the_tables_and_in_the_database_file(tmp_path: Path) -> None:
    only_flush_folds = Settings(fold="at_end")
    async with Memory.open(url_of(tmp_path), settings=only_flush_folds) as memory:
        async with memory.episode(description="e"):
            await NoteActionPerformable("a").perform()
            await memory.flush()
            assert await texts(memory) == ["a"]
            with closing(sqlite3.connect(tmp_path / "memory.db")) as plain, plain:
                rows = plain.execute("SELECT text, status FROM note_action JOIN task_tree_node USING (id)").fetchall()
                assert rows == [("a", "SUCCEEDED")]
            plain.close()
            await NoteActionPerformable("b").perform()
        status = memory.status
        assert status.written >= status.synced >= status.stored
        assert status.faults.total == 0
    async with Reading.open(url_of(tmp_path)) as reading:
        assert await texts(reading) == ["a", "b"]


# === refusals =================================================================================================
#
# Refusals by a memory and their messages; no recorded event is lost by one.


@pytest.mark.slow
async def test_a_spool_belongs_to_one_database_while_it_holds_a_recorder(tmp_path: Path) -> None:
    spool = tmp_path / "spool"
    async with Memory.open(f"sqlite:///{tmp_path}/1.db", spool=spool):
        await NoteActionPerformable("a").perform()
    async with Memory.open(f"sqlite:///{tmp_path}/2.db", spool=spool) as memory:
        await NoteActionPerformable("b").perform()
        await memory.flush()
        with pytest.raises(SpoolForeign, match="pycrorm spool rebind"):
            async with Memory.open(f"sqlite:///{tmp_path}/1.db", spool=spool):
                pass
        with pytest.raises(DatabaseUnavailable, match="the spool belongs to log"):  # no other file is made
            async with Memory.open(f"sqlite:///{tmp_path}/3.db", spool=spool):
                pass
        assert not (tmp_path / "3.db").exists()
        assert await texts(memory) == ["b"]


@pytest.mark.slow
async def test_a_flush_that_cannot_reach_the_database_raises_and_loses_nothing(tmp_path: Path) -> None:
    settings = Settings(flush_timeout_s=0.3)
    async with Memory.open(url_of(tmp_path), settings=settings) as memory:
        await NoteActionPerformable("before").perform()
        await flushed(memory)
        other = sqlite3.connect(tmp_path / "memory.db", isolation_level=None)
        other.execute("BEGIN IMMEDIATE")
        await NoteActionPerformable("meanwhile").perform()
        with pytest.raises(FlushTimeout, match="safe in the spool"):
            await memory.flush()
        other.execute("ROLLBACK")
        other.close()
        await flushed(memory)
        assert await texts(memory) == ["before", "meanwhile"]


async def flushed(memory: Memory) -> None:
    """Flush, and repeat it when its short timeout expires on a busy machine."""
    async with asyncio.timeout(60):
        while True:
            with suppress(FlushTimeout):
                return await memory.flush()


@pytest.mark.slow
async def test_an_impossible_argument_of_an_episode_is_refused_by_name(tmp_path: Path) -> None:
    impossible: list[tuple[str, Any]] = [("seed", 2**63), ("seed", True), ("seed", 1.5), ("description", 5)]
    async with Memory.open(url_of(tmp_path), settings=Settings(on_unrecordable="refuse")) as memory:
        for named, value in impossible:
            with pytest.raises(CallerError, match=f"the {named} of an episode must be"):
                async with memory.episode(**{named: value}):
                    pass
        async with memory.episode(description="fine", seed=-1):
            await NoteActionPerformable("a").perform()
        await memory.flush()
        assert [each.description for each in await memory.reading.episodes()] == ["fine"]


@pytest.mark.slow
@pytest.mark.parametrize(
    "arguments",
    [
        {"on_full": "waait"},
        {"batch_events_max": 0},
        {"flush_timeout_s": -1.0},
        {"sample_interval_ms": "5"},
        {"sample_change_min": -0.1},
        {"sample_change_min": None},
    ],
)
def test_an_impossible_setting_is_refused_by_name(arguments: dict[str, Any]) -> None:
    with pytest.raises(CallerError, match=rf"Settings\.{next(iter(arguments))} is "):
        Settings(**arguments)


def test_a_removed_setting_is_accepted_with_a_warning(caplog: pytest.LogCaptureFixture) -> None:
    assert replace(Settings(batch_age_ms=10), idle_ms=5) == Settings(idle_ms=5)
    assert [each.getMessage() for each in caplog.records] == [
        "Settings.batch_age_ms has no effect any more, and the next release refuses it"
    ]


@pytest.mark.slow
async def test_a_memory_that_is_not_open_names_the_call_that_opens_it(tmp_path: Path) -> None:
    memory = Memory.open(url_of(tmp_path))
    async with memory:
        pass
    with pytest.raises(CallerError, match=r"async with Memory\.open"):
        await memory.flush()
    memory = Memory.open(url_of(tmp_path))
    for use in (
        lambda: memory.status,
        lambda: memory.reading,
        memory.session,
        lambda: memory.mapped("NoteAction"),
        lambda: memory.recent_episodes,
    ):
        with pytest.raises(CallerError, match=r"async with Memory\.open"):
            use()


@pytest.mark.slow
async def test_closing_logs_a_parked_episode_and_raises_nothing_over_a_plan_that_succeeded(
    tmp_path: Path, caplog: pytest.LogCaptureFixture
) -> None:
    async with Memory.open(url_of(tmp_path)) as memory:
        with sqlite3.connect(tmp_path / "memory.db") as plain:
            plain.execute("CREATE TABLE note_action (mine TEXT)")
        plain.close()
        async with memory.episode(description="well done") as episode:
            await NoteActionPerformable("a").perform()
    [line] = [each.message for each in caplog.records if each.name == "pycrorm_async"]
    assert line.startswith(f"when closing the memory: not everything could be stored or folded: episode {episode}: ")
    done = answer("status", "--url", url_of(tmp_path), cwd=tmp_path, code=1)
    assert [(each["id"], "note_action already exists" in each["parked"]) for each in done["episodes"]] == [
        (str(episode), True)
    ]
    assert [*done["unmade"]] == ["NoteAction"]


@pytest.mark.slow
async def test_a_full_spool_without_a_drainer_fails_a_start_instead_of_blocking_for_ever(tmp_path: Path) -> None:
    settings = Settings(
        segment_bytes=2**18, record_bytes_max=2**12, spool_bytes_max=2**20 + 2**18, spool_reserve_bytes=2**18
    )
    reached = 0
    async with Memory.open(url_of(tmp_path), settings=settings) as memory:
        other = sqlite3.connect(tmp_path / "memory.db", isolation_level=None)
        other.execute("BEGIN IMMEDIATE")  # nothing can be stored, so that no space is freed
        with pytest.raises(SpoolStuck, match="the writer has stopped"):
            async with memory.episode(description="e"):
                memory._open_parts.queue.fail("the writer has stopped")
                while reached < 5_000:  # ten times as many as fit
                    await asyncio.wait_for(NoteActionPerformable("x" * 2_000).perform(), 30)
                    reached += 1
        other.execute("ROLLBACK")
        other.close()
    assert reached > 100
    async with Reading.open(url_of(tmp_path)) as reading:
        assert len(await texts(reading)) == reached


# === unawaited performs =======================================================================================
#
# A perform that was called and never awaited is noticed and named, and differs from a cancelled one.

SENTENCE = "NoteAction.perform() was called and never awaited, so it did not run: write `await`"
FAULT = "NoteAction.perform() was called and never awaited"


@contextmanager
def quiet() -> Iterator[None]:
    """Ignore Python's own warning: the test is about the package's."""
    with warnings.catch_warnings():
        warnings.simplefilter("ignore", RuntimeWarning)
        yield
        gc.collect()


@pytest.mark.slow
async def test_a_perform_that_is_not_awaited_is_a_fault_of_its_episode(tmp_path: Path) -> None:
    async with Memory.open(url_of(tmp_path)) as memory:
        async with memory.episode() as episode:
            with quiet():
                NoteActionPerformable("lost").perform()  # type: ignore[unused-coroutine]  # the fault here
                NoteActionPerformable("lost again").perform()  # type: ignore[unused-coroutine]  # the fault here
            await NoteActionPerformable("kept").perform()
            assert episode.faults == (FAULT,)
        async with memory.episode() as other:
            await NoteActionPerformable("fine").perform()
        assert other.faults == ()
        assert memory.status.faults == (2, SENTENCE)
        with quiet():
            NoteActionPerformable("outside").perform()  # type: ignore[unused-coroutine]  # the fault here
        assert memory.status.faults == (3, SENTENCE)
        async with memory.episode() as third:
            forgotten = NoteActionPerformable("forgotten").perform()
        assert third.faults == (FAULT,)  # it still exists, and is noticed once
        with quiet():
            del forgotten
        assert memory.status.faults == (4, SENTENCE)
        assert memory.status.unawaited == (SENTENCE,)
        await memory.flush()
        assert await texts(memory) == ["kept", "fine"]


@pytest.mark.slow
async def test_a_perform_that_was_cancelled_before_its_start_or_starts_later_is_no_fault(tmp_path: Path) -> None:
    async with Memory.open(url_of(tmp_path)) as memory:
        async with memory.episode() as episode:
            cancelled = asyncio.create_task(NoteActionPerformable("cancelled").perform())
            cancelled.cancel()
            with pytest.raises(asyncio.CancelledError):
                await cancelled
            with pytest.raises(TimeoutError):
                await asyncio.wait_for(NoteActionPerformable("too late").perform(), 0)
            later = asyncio.create_task(NoteActionPerformable("later").perform())
            del cancelled
            gc.collect()
        await later
        assert episode.faults == ()
        assert memory.status.faults.total == 0
