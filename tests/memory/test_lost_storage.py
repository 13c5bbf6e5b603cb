"""Databases and spools that are deleted, replaced or restored under a plan: noticed, reported, filled again."""

from __future__ import annotations

import asyncio
import logging
import shutil
from collections.abc import AsyncIterator, Callable
from contextlib import AsyncExitStack, asynccontextmanager
from dataclasses import dataclass, replace
from hashlib import sha256
from pathlib import Path
from typing import Any
from urllib.parse import urlsplit

import pytest

from pycrorm_async import Blob, Memory, Settings
from pycrorm_async.errors import DatabaseUnavailable, FlushTimeout, SpoolForeign, SpoolTaken, SpoolUnavailable
from pycrorm_async.operations.recovery import Rebinding, rebind, recover
from pycrorm_async.plan import ActionAbstract
from pycrorm_async.projections.verify import verify
from pycrorm_async.queue.spool import Spool, make_folder
from pycrorm_async.settings import Writer
from pycrorm_async.store.address import DatabaseAddress
from pycrorm_async.store.log import EventLog
from tests.backups import Backup
from tests.databases import Server, ask
from tests.memory.note_actions import NoteActionPerformable, texts
from tests.store.factories import episode, run_of
from tests.writer.running_writers import QUICKLY_SYNCED, Daemon

pytestmark = pytest.mark.slow


# === deleted database =========================================================================================
#
# A deleted or replaced database is noticed, no record is acknowledged to it, and `rebind` stores the rest.

IMPATIENT = Settings(flush_timeout_s=0.3, connect_timeout_s=60)
RECORDER = "0190a000-0000-7000-8000-000000000001"
NOTES = "SELECT count(*) FROM event WHERE type = 'NodeEnded'"


@pytest.mark.parametrize("replaced", [False, True])
async def test_a_file_deleted_or_replaced_during_a_run_is_named_and_all_events_are_stored_in_the_new_one(
    tmp_path: Path, caplog: pytest.LogCaptureFixture, *, replaced: bool
) -> None:
    file, other = tmp_path / "memory.db", tmp_path / "other.db"
    url, spool = f"sqlite:///{file}", tmp_path / "memory.db.spool"
    command = f"pycrorm spool rebind --url {url} --spool {spool}"
    async with Memory.open(f"sqlite:///{other}"):
        await NoteActionPerformable("of another memory").perform()
    with pytest.raises(FlushTimeout, match=r"removed or replaced while it was open.*pycrorm spool rebind"):
        async with Memory.open(url, settings=IMPATIENT) as memory, memory.episode(description="a day"):
            await NoteActionPerformable("before").perform()
            await memory.synced()
            file.unlink()
            if replaced:
                shutil.copy(other, file)
            await _logged(caplog, command)  # also without a new event
            await NoteActionPerformable("after").perform()
            with pytest.raises(FlushTimeout, match="pycrorm spool rebind"):
                await memory.flush()
            assert memory.status.stored < memory.status.written
    with pytest.raises((SpoolForeign, DatabaseUnavailable), match="pycrorm spool rebind"):
        await recover(url)
    reports: list[Rebinding] = []
    done = await rebind(url, on_rebinding=reports.append)
    assert (reports, done.recorders, done.before != done.after) == ([done], 1, True)
    report = await recover(url)
    assert (report.drained.stopped, report.failed, report.dead_letters) == ({}, {}, {})
    assert ask(file, NOTES) == [(5 if replaced else 3,)]
    async with Memory.open(url):  # from now on the spool belongs to this database
        await NoteActionPerformable("the next day").perform()
    assert ask(file, "SELECT count(*) FROM episode") == [(3 if replaced else 2,)]


async def _logged(caplog: pytest.LogCaptureFixture, text: str) -> None:
    async with asyncio.timeout(60):
        while not any(text in each.getMessage() for each in caplog.records if each.levelno == logging.ERROR):  # noqa: ASYNC110
            await asyncio.sleep(0.02)


@pytest.mark.soak_on("postgresql")
async def test_events_of_a_replaced_database_are_stored_by_rebind_and_not_before(
    database_url: str, server: Server, tmp_path: Path
) -> None:
    spool = tmp_path / "spool"
    async with Memory.open(database_url, spool=spool, settings=Settings(connect_timeout_s=60)) as memory:
        await NoteActionPerformable("gone with its database").perform()
        await memory.flush()
    async with Memory.open(database_url, spool=spool, writer="daemon", settings=IMPATIENT):
        await NoteActionPerformable("kept in the spool").perform()
    if database_url.startswith("postgresql:"):
        server.drop(database_url)
        ask(server.url(), f"CREATE DATABASE {urlsplit(database_url).path.removeprefix('/')}")
    else:
        Path(database_url.removeprefix("sqlite:///")).unlink()
    with pytest.raises((SpoolForeign, DatabaseUnavailable), match="pycrorm spool rebind"):
        async with Memory.open(database_url, spool=spool):
            pass
    await rebind(database_url, spool=spool, on_rebinding=lambda _: None)
    report = await recover(database_url, spool=spool)
    assert (report.failed, report.drained.stopped) == ({}, {})
    assert ask(database_url, "SELECT text FROM note_action ORDER BY text")[-1:] == [("kept in the spool",)]


@pytest.mark.parametrize("holder", ["recorder", "daemon", "drainer"])
def test_a_spool_in_use_is_not_rebound(tmp_path: Path, holder: str) -> None:
    spool = Spool(tmp_path)
    spool.bind("a")
    folder, alive = make_folder(tmp_path, RECORDER)
    if holder != "recorder":
        alive.release()
    lock = spool.take_writer() if holder == "daemon" else None
    if holder == "drainer":
        lock = type(alive).take(folder / "drain")
    reasons = {"recorder": "still records", "daemon": "`pycrorm writer` drains it", "drainer": "drains it"}
    with pytest.raises(SpoolTaken, match=reasons[holder]):
        spool.rebind("b")
    assert spool.log_id() == "a"
    for each in (alive, lock):
        if each is not None:
            each.release()
    spool.rebind("b")
    assert spool.log_id() == "b"


def test_rebind_moves_kept_segments_of_the_former_log(tmp_path: Path) -> None:
    spool = Spool(tmp_path)
    spool.bind("a")
    (tmp_path / "stored" / "a" / RECORDER).mkdir(parents=True)
    spool.rebind("b")
    assert [each.name for each in (tmp_path / "stored").iterdir()] == ["b"]
    assert (tmp_path / "stored" / "b" / RECORDER).is_dir()


async def test_a_new_database_shares_nothing_with_a_removed_one_that_a_process_still_has_open(tmp_path: Path) -> None:
    address = DatabaseAddress.parse(f"sqlite:///{tmp_path}/memory.db")
    old = await EventLog.open(address, create=True)
    await old.append(run_of(episode(1), 1, 300))
    address.path.unlink()
    wal = (tmp_path / "memory.db-wal").read_bytes()
    assert wal
    new = await EventLog.open(address, create=True)
    assert (tmp_path / "memory.db-wal.orphaned").read_bytes() == wal
    await new.append(run_of(episode(2), 1, 30))
    with pytest.raises(DatabaseUnavailable, match="removed or replaced while it was open"):
        await old.append(run_of(episode(3), 1, 3))
    await old.close()
    await new.append(run_of(episode(2), 31, 40))
    await new.close()
    assert ask(address.path, "PRAGMA integrity_check") == [("ok",)]
    assert ask(address.path, "SELECT id, head FROM episode") == [("00000000-0000-0000-0000-000000000002", 40)]


# === deleted spool ============================================================================================
#
# A spool that is deleted under a running plan: the plan continues, and the log, `status` and `flush` report the loss.

GONE = "was deleted or replaced"


@asynccontextmanager
async def drained_by(writer: Writer, url: str, spool: Path) -> AsyncIterator[None]:
    daemon = Daemon(url, spool) if writer == "daemon" else None
    yield
    if daemon is not None:
        await daemon.stop()


@pytest.mark.soak_on("postgresql")
@pytest.mark.parametrize(
    ("writer", "deleted"), [("thread", "folder"), ("thread", "spool"), ("daemon", "spool"), ("process", "folder")]
)
async def test_the_plan_continues_and_the_next_memory_records_again(
    database_url: str, tmp_path: Path, writer: Writer, deleted: str, caplog: pytest.LogCaptureFixture
) -> None:
    spool = tmp_path / "spool"
    async with AsyncExitStack() as stack:
        await stack.enter_async_context(drained_by(writer, database_url, spool))
        memory = Memory.open(database_url, spool=spool, writer=writer, settings=QUICKLY_SYNCED)
        await memory.__aenter__()
        async with memory.episode(description="e"):
            await NoteActionPerformable("a").perform()
            await memory.flush()
            assert memory.status.spool_fault is None
            [recorder] = Spool(spool).recorders()
            (spool if deleted == "spool" else recorder.path).rename(tmp_path / "taken away")
            await NoteActionPerformable("b").perform()
            for wait in (memory.synced, memory.flush):
                with pytest.raises(SpoolUnavailable, match=GONE):
                    await wait()
            await NoteActionPerformable("c").perform()
        status = memory.status
        assert status.faults.total > 0
        assert GONE in (status.spool_fault or "")
        assert status.spool_lost == (f"positions {status.stored + 1} to {status.written}",)
        with pytest.raises(SpoolUnavailable, match=GONE):
            await memory.__aexit__(None, None, None)
        async with Memory.open(database_url, spool=spool, settings=QUICKLY_SYNCED) as memory:
            await NoteActionPerformable("d").perform()
            await memory.flush()
            assert await texts(memory) == ["a", "d"]
    errors = [each.getMessage() for each in caplog.records if each.levelno == logging.ERROR]
    assert [GONE in each for each in errors].count(True) >= 1


# === restored database ========================================================================================
#
# A restored database receives again what it had confirmed: events, declarations, numbers and row ids.

SMALL = replace(QUICKLY_SYNCED, segment_bytes=128 * 1024, spool_reserve_bytes=64 * 1024, record_bytes_max=16 * 1024)
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
async def memory_at(url: str, spool: Path, settings: Settings = QUICKLY_SYNCED) -> AsyncIterator[Memory]:
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
    assert sorted(number for _, number, *_ in after[0]) == [1, 2, 3, 4]
    assert await is_clean(database_url)
    [reason] = await incarnations(database_url)
    assert "events were appended again; 0 of 2 episodes stay incomplete" in reason


@pytest.mark.soak_on("postgresql")
async def test_an_idle_daemon_stores_again_what_dead_recorders_had_stored(
    database_url: str, spool: Path, take_backup: TakeBackup
) -> None:
    daemon = Daemon(database_url, spool)
    settings = replace(QUICKLY_SYNCED, writer="daemon")
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
async def test_records_that_are_no_longer_kept_are_refused_with_their_gap_and_reported_once(
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


async def test_kept_segments_that_cannot_be_read_stop_no_event(spool: Path, caplog: pytest.LogCaptureFixture) -> None:
    spool.mkdir()
    (spool / "stored").write_text("not a folder")
    async with memory_at(f"sqlite:///{spool.parent}/memory.db", spool) as memory:
        await note(memory, "a")
        await memory.flush()
        assert await texts(memory) == ["a"]
    assert "cannot compare with the kept segments" in caplog.text
