"""A deleted or replaced database is noticed, no record is acknowledged to it, and `rebind` stores the rest."""

from __future__ import annotations

import asyncio
import logging
import shutil
from pathlib import Path
from urllib.parse import urlsplit

import pytest

from pycrorm_async import Memory, Settings
from pycrorm_async.errors import DatabaseUnavailable, FlushTimeout, SpoolForeign, SpoolTaken
from pycrorm_async.operations.recovery import Rebinding, rebind, recover
from pycrorm_async.queue.spool import Spool, make_folder
from pycrorm_async.store.address import DatabaseAddress
from pycrorm_async.store.log import EventLog
from tests.databases import Server, ask
from tests.memory.note_actions import NoteActionPerformable
from tests.store.factories import episode, run_of

pytestmark = pytest.mark.slow

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
