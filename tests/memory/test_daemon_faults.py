"""A daemon on a database that is replaced, locked or foreign, on a damaged folder, or beside another daemon."""

import asyncio
import logging
import shutil
import sqlite3
import threading
from collections.abc import Callable
from dataclasses import replace
from pathlib import Path

import pytest
from sqlalchemy import select

from pycrorm_async import Memory, Reading, Settings, UserView, recover
from pycrorm_async.errors import CallerError, DatabaseForeign, SpoolForeign, SpoolUnavailable
from pycrorm_async.operations.daemon import serve
from pycrorm_async.orm import ProcessMetaData
from pycrorm_async.queue import Spool
from pycrorm_async.queue.sources import LiveSource
from tests.databases import ask
from tests.memory.daemon_in_loop import QUICK, Daemon, Start, memory_at
from tests.memory.note_actions import NoteActionPerformable, texts

pytestmark = [pytest.mark.slow, pytest.mark.soak_on("postgresql")]
"""Files and processes keep this promise, without SQL of their own, so that servers test it in turns."""


async def test_a_daemon_ends_when_its_database_file_is_replaced_and_waits_when_the_file_is_deleted(
    tmp_path: Path, spool: Path
) -> None:
    file = tmp_path / "memory.db"
    url = f"sqlite:///{file}"
    started = Daemon(url, spool)
    async with memory_at(url, spool, replace(QUICK, flush_timeout_s=0.5)):
        await NoteActionPerformable("a").perform()
        await started.wait_for_line("appeared")
        file.rename(tmp_path / "away.db")
        await NoteActionPerformable("b").perform()
        await started.wait_for_line("the database is unavailable: .*removed or replaced")
        (tmp_path / "away.db").rename(file)
        await started.wait_for_line("the database is available again")
        shutil.copy(file, tmp_path / "copy.db")
        (tmp_path / "copy.db").replace(file)
        await NoteActionPerformable("c").perform()
        async with asyncio.timeout(60):
            with pytest.raises(DatabaseForeign, match=r"memory\.db was replaced while it was open: start"):
                await started.task
    assert not any("Traceback" in line for line in started.lines)
    report = await recover(url, spool=spool)
    assert report.failed == {}


async def test_a_second_daemon_on_the_same_spool_is_refused_in_one_line(
    database_url: str, spool: Path, daemon: Start
) -> None:
    async with daemon() as started:
        await started.wait_for_line("draining")
        with pytest.raises(SpoolUnavailable, match="another `pycrorm writer` drains it already") as refused:
            await serve(database_url, spool=spool, stop=asyncio.Event(), report=print)
        assert "\n" not in str(refused.value)
    async with daemon() as started:
        await started.wait_for_line("draining")


async def test_a_daemon_that_is_cancelled_during_a_scan_leaves_the_folders_to_the_next(
    database_url: str, spool: Path, daemon: Start, monkeypatch: pytest.MonkeyPatch
) -> None:
    looking, cancelled = threading.Event(), threading.Event()

    take = LiveSource.take

    def take_late(folder: Path) -> LiveSource | None:
        looking.set()
        assert cancelled.wait(60)
        return take(folder)

    async with memory_at(database_url, spool) as memory:
        await NoteActionPerformable("a").perform()
        with monkeypatch.context() as patch:
            patch.setattr(LiveSource, "take", take_late)
            first = Daemon(database_url, spool)
            assert await asyncio.to_thread(looking.wait, 60)
            first.task.cancel()
            cancelled.set()
            with pytest.raises(asyncio.CancelledError):
                await first.task
        assert not memory.status.drained
        async with daemon():
            await memory.flush()
            assert await texts(memory) == ["a"]


async def test_a_spool_of_another_database_is_refused_and_left_unchanged(
    database_url: str, spool: Path, tmp_path: Path
) -> None:
    async with memory_at(database_url, spool, replace(QUICK, flush_timeout_s=0.1)):
        await NoteActionPerformable("a").perform()
        await recover(database_url, spool=spool)
        await NoteActionPerformable("b").perform()
        async with Memory.open(f"sqlite:///{tmp_path}/other.db"):
            pass
        with pytest.raises(SpoolForeign, match="belongs to log"):
            await serve(f"sqlite:///{tmp_path}/other.db", spool=spool, stop=asyncio.Event(), report=print)
        await recover(database_url, spool=spool)
    assert ask(f"sqlite:///{tmp_path}/other.db", "SELECT count(*) FROM event") == [(0,)]


async def test_damage_in_one_folder_is_reported_and_the_others_are_drained(
    database_url: str, spool: Path, daemon: Start
) -> None:
    for text in ("damaged", "whole"):
        async with memory_at(database_url, spool, replace(QUICK, flush_timeout_s=0.1)) as memory:
            await NoteActionPerformable(text).perform()
    first, second = Spool(spool).recorders()
    segment = first.path / "00000001.segment"
    content = bytearray(segment.read_bytes())
    content[content.index(b"damaged")] ^= 1
    segment.write_bytes(content)
    async with daemon() as started:
        await started.wait_for_line(f"{first.name}: .*00000001.segment is damaged at byte .*; retrying")
        await started.wait_for_line(f"{second.name} is recovered")
    async with Reading.open(database_url) as reading:
        assert await texts(reading) == ["whole"]
    assert [each.name for each in Spool(spool).recorders()] == [first.name]
    assert memory.is_open is False


@pytest.mark.parametrize(
    ("open_it", "words"),
    [
        (lambda: Memory.open("sqlite://", writer="daemon"), "sqlite:// is private to this process"),
        (
            lambda: Memory.open("sqlite:///x.db", writer="daemon", views=[UserView("v", select(ProcessMetaData.id))]),
            "without the views of this process",
        ),
        (lambda: Memory.open("sqlite:///x.db", settings=Settings(writer="cron")), "use 'thread' or 'daemon'"),  # type: ignore[arg-type]
    ],
)
def test_an_impossible_daemon_is_refused_at_once(open_it: Callable[[], Memory], words: str) -> None:
    with pytest.raises(CallerError, match=words):
        open_it()


async def test_a_locked_database_is_unavailable_to_the_daemon_and_closing_does_not_wait_for_it(
    tmp_path: Path, spool: Path, caplog: pytest.LogCaptureFixture
) -> None:
    url = f"sqlite:///{tmp_path / 'memory.db'}"
    started = Daemon(url, spool)
    async with memory_at(url, spool) as memory:
        await NoteActionPerformable("a").perform()
        await memory.flush()
        other = sqlite3.connect(tmp_path / "memory.db", isolation_level=None)
        other.execute("BEGIN IMMEDIATE")
        await NoteActionPerformable("b").perform()
        await started.wait_for_line("the database is unavailable: .*locked; retrying")
    [line] = [each.getMessage() for each in caplog.records if each.levelno == logging.WARNING]
    assert "the daemon reports that the database is unavailable" in line
    other.execute("COMMIT")
    other.close()
    await started.wait_for_line("the database is available again after")
    await started.wait_for_line("is recovered")
    started.leave.set()
    await started.task
    async with Reading.open(url) as reading:
        assert await texts(reading) == ["a", "b"]
