"""A restored database receives again what it had confirmed: events, declarations, numbers and row ids."""

from __future__ import annotations

import asyncio
import logging
import shutil
from collections.abc import AsyncIterator, Callable
from contextlib import asynccontextmanager
from dataclasses import dataclass, replace
from hashlib import sha256
from pathlib import Path
from typing import Any

import pytest

from pycrorm_async import Blob, Memory, Settings, recover
from pycrorm_async.plan import ActionAbstract
from pycrorm_async.projections.verify import verify
from pycrorm_async.queue import Spool
from pycrorm_async.store.address import DatabaseAddress
from pycrorm_async.store.log import EventLog
from tests.backups import Backup
from tests.databases import Server, ask
from tests.memory.daemon_in_loop import QUICK, Daemon
from tests.memory.note_actions import NoteActionPerformable, texts

pytestmark = pytest.mark.slow

SMALL = replace(QUICK, segment_bytes=128 * 1024, spool_reserve_bytes=64 * 1024, record_bytes_max=16 * 1024)
TakeBackup = Callable[[], Backup]
ALL = "SELECT id, number, head, folded, refused, parked FROM episode ORDER BY id"
EVENTS = "SELECT episode, sequence, type, payload FROM event ORDER BY episode, sequence"
ROWS = "SELECT id, dtype FROM task_tree_node ORDER BY id"


@dataclass
class LateActionPerformable(ActionAbstract):
    """A designator that is declared after the backup."""

    number: int

    async def perform(self) -> None:
        """Succeed without doing anything."""


@pytest.fixture
def take_backup(database_url: str, request: pytest.FixtureRequest) -> TakeBackup:
    running: Server | None = None
    if database_url.startswith("postgresql"):
        running = request.getfixturevalue("server")

    def take() -> Backup:
        backup = Backup(database_url, running)
        request.addfinalizer(backup.drop)
        return backup

    return take


@asynccontextmanager
async def memory_at(url: str, spool: Path, settings: Settings = QUICK) -> AsyncIterator[Memory]:
    async with Memory.open(url, spool=spool, settings=settings) as memory:
        yield memory


async def note(memory: Memory, *words: str) -> None:
    async with memory.episode(description=words[0]):
        for word in words:
            await NoteActionPerformable(word).perform()


def everything(url: str) -> list[list[Any]]:
    return [ask(url, question) for question in (ALL, EVENTS, ROWS)]


async def is_clean(url: str) -> bool:
    log = await EventLog.open(DatabaseAddress.parse(url), create=False)
    try:
        result = await verify(log)
        stopped = await log.stopped()
    finally:
        await log.close()
    return (result.damage, result.drift, result.behind, stopped) == (0, 0, 0, [])


async def incarnations(url: str) -> list[str]:
    log = await EventLog.open(DatabaseAddress.parse(url), create=False)
    try:
        return [each.reason for each in await log.incarnations()]
    finally:
        await log.close()


@pytest.mark.soak_on("postgresql")
async def test_a_plan_that_continues_stores_again_all_that_was_flushed(
    database_url: str, spool: Path, take_backup: TakeBackup
) -> None:
    async with memory_at(database_url, spool) as memory:
        await note(memory, "before")
        async with memory.episode(description="through it all"):
            await NoteActionPerformable("a").perform()
            await memory.flush()
            backup = take_backup()
            await NoteActionPerformable("b").perform()
            await LateActionPerformable(1).perform()
            await memory.flush()
            stored = everything(database_url)
            backup.restore()
            assert everything(database_url) != stored
            await memory.flush()  # without a new event the writer checks that confirmed events are still stored
            assert everything(database_url) == stored

            backup.restore()
            await LateActionPerformable(2).perform()  # a gap in the episode, and a type that is no longer declared
            await memory.flush()
        after = everything(database_url)
        assert after[1][: len(stored[1])] == stored[1]
        assert await texts(memory) == ["before", "a", "b"]
        assert ask(database_url, "SELECT number FROM late_action ORDER BY id") == [(1,), (2,)]
    assert await is_clean(database_url)


@pytest.mark.soak_on("postgresql")
async def test_lost_blobs_are_stored_again_with_the_events_that_refer_to_them(
    database_url: str, spool: Path, take_backup: TakeBackup
) -> None:
    kept, still_held = sha256(b"ended").hexdigest(), sha256(b"running").hexdigest()
    async with memory_at(database_url, spool) as memory:
        await note(memory, "before")
        await memory.flush()
    backup = take_backup()
    async with memory_at(database_url, spool) as memory, memory.episode(description="seen"):
        memory.observe("camera", Blob(b"ended", "image/png"))
    async with memory_at(database_url, spool) as memory, memory.episode(description="seen"):
        memory.observe("camera", Blob(b"running", "image/png"))
        await memory.flush()
        backup.restore()
        await memory.flush()
        assert await memory.blob(kept) == Blob(b"ended", "image/png")
        assert await memory.blob(still_held) == Blob(b"running", "image/png")
    log = await EventLog.open(DatabaseAddress.parse(database_url), create=False)
    assert (await verify(log)).damage == 0
    await log.close()


@pytest.mark.soak_on("postgresql")
async def test_lost_episodes_get_their_own_numbers_and_new_ones_get_others(
    database_url: str, spool: Path, take_backup: TakeBackup
) -> None:
    async with memory_at(database_url, spool) as memory:
        await note(memory, "monday")
        await memory.flush()
    backup = take_backup()
    async with memory_at(database_url, spool) as memory:
        await note(memory, "tuesday")
        await note(memory, "tuesday evening")
        await memory.flush()
        stored = everything(database_url)
    assert not [each.name for each in Spool(spool).recorders()]
    backup.restore()
    async with memory_at(database_url, spool) as memory:
        await note(memory, "wednesday")
        await memory.flush()
        assert await texts(memory) == ["monday", "tuesday", "tuesday evening", "wednesday"]
    after = everything(database_url)
    assert [row for row in after[0] if row in stored[0]] == stored[0]
    assert [row for row in after[2] if row in stored[2]] == stored[2]
    numbers = sorted(number for _, number, *_ in after[0])  # two ids of one millisecond have any order
    assert numbers[:3] == [1, 2, 3]
    reserve = 4_096 if database_url.startswith("postgresql") else 0  # for episodes that other spools had stored there
    assert numbers[3] > 3 + reserve
    assert await is_clean(database_url)
    [reason] = await incarnations(database_url)
    assert "events were appended again; 0 of 2 episodes stay incomplete" in reason


@pytest.mark.soak_on("sqlite")
async def test_a_lost_episode_of_a_dead_recorder_ends_lost_again(
    database_url: str, spool: Path, take_backup: TakeBackup, tmp_path: Path
) -> None:
    async with memory_at(database_url, spool) as memory:
        await note(memory, "first")
        await memory.flush()
    backup = take_backup()
    elsewhere = tmp_path / "copy"
    async with memory_at(database_url, spool) as memory, memory.episode(description="broken off"):
        await NoteActionPerformable("half").perform()
        await memory.synced()
        [folder] = [each for each in spool.iterdir() if (each / "alive").exists()]
        shutil.copytree(folder, elsewhere / folder.name)
    backup.restore()
    shutil.rmtree(spool / "stored")
    (elsewhere / folder.name).rename(spool / folder.name)
    report = await recover(database_url, spool=spool, settings=QUICK)
    assert len(report.lost) == 1
    stored = everything(database_url)
    backup.restore()
    report = await recover(database_url, spool=spool, settings=QUICK)
    assert everything(database_url) == stored
    assert ask(database_url, "SELECT status FROM process_metadata ORDER BY id") == [("SUCCEEDED",), ("LOST",)]
    assert (report.drained.stopped, report.failed) == ({}, {})
    assert await is_clean(database_url)


@pytest.mark.soak_on("postgresql")
async def test_an_idle_daemon_stores_again_what_dead_recorders_had_stored(
    database_url: str, spool: Path, take_backup: TakeBackup
) -> None:
    daemon = Daemon(database_url, spool)
    settings = replace(QUICK, writer="daemon")
    async with memory_at(database_url, spool, settings) as memory:
        await note(memory, "one")
        await memory.flush()
    await daemon.stop()
    backup = take_backup()
    daemon = Daemon(database_url, spool)
    async with memory_at(database_url, spool, settings) as memory:
        await note(memory, "two")
        await LateActionPerformable(2).perform()
        await memory.flush()
        stored = everything(database_url)
        backup.restore()
        await note(memory, "three")
        await memory.flush()
        assert await texts(memory) == ["one", "two", "three"]
    after = everything(database_url)
    assert [row for row in after[0] if row in stored[0]] == stored[0]
    await daemon.stop()
    stored = everything(database_url)
    backup.restore()
    daemon = Daemon(database_url, spool)
    async with memory_at(database_url, spool, settings) as memory:
        while everything(database_url) != stored:  # noqa: ASYNC110
            await asyncio.sleep(0.02)
        await memory.flush()
    await daemon.stop()
    assert await is_clean(database_url)


@pytest.mark.soak_on("postgresql")
async def test_records_that_are_no_longer_kept_are_refused_with_their_gap_and_not_searched_again(
    database_url: str,
    spool: Path,
    take_backup: TakeBackup,
    caplog: pytest.LogCaptureFixture,
) -> None:
    settings = replace(SMALL, keep_stored_bytes=160 * 1024)  # one segment
    async with memory_at(database_url, spool, settings) as memory:
        await note(memory, "kept")
        await memory.flush()
    backup = take_backup()
    async with memory_at(database_url, spool, settings) as memory, memory.episode(description="long"):
        for _ in range(300):
            await NoteActionPerformable("x" * 2_000).perform()
        await memory.flush()
    backup.restore()
    caplog.set_level(logging.WARNING)
    report = await recover(database_url, spool=spool, settings=settings)
    [reason] = report.drained.stopped.values()
    assert reason.startswith("events 1 to ")
    assert "stay incomplete" in caplog.text
    caplog.clear()
    async with memory_at(database_url, spool, settings) as memory:
        await note(memory, "afterwards")
        await memory.flush()
        assert await texts(memory) == ["kept", "afterwards"]
    assert "went back" not in caplog.text
    [note_text] = await incarnations(database_url)
    assert "1 of 1 episodes stay incomplete" in note_text
