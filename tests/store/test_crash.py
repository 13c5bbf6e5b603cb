"""Processes that are killed while they append, and a database on a full disk: no event is lost or doubled."""

from __future__ import annotations

import asyncio
import gc
import os
import random
import signal
import sqlite3
import subprocess
import sys
import time
from collections.abc import Iterable, Iterator
from pathlib import Path
from typing import Any

import pytest
from sqlalchemy import event
from sqlalchemy.ext.asyncio import AsyncEngine

from pycrorm_async.errors import DatabaseUnavailable
from pycrorm_async.events.codec import Record
from pycrorm_async.settings import Settings
from pycrorm_async.store.address import DatabaseAddress
from pycrorm_async.store.log import EventLog
from pycrorm_async.store.sqlite_engine import translate_error
from pycrorm_async.writer.drain import Backoff, Drain
from tests.crash.recorder_process import report
from tests.databases import ask
from tests.store.factories import cancel_at_await, episode, record, run_of
from tests.writer.fakes import KeptSource

PER_BATCH = 300


@pytest.fixture
def database_url(tmp_path: Path) -> str:
    """Use SQLite alone: these tests are about files."""
    return f"sqlite:///{tmp_path / 'memory.db'}"


# This script imports once, then forks a child for every line it reads, which appends batches from that number on.
APPENDER = """
import asyncio, os, sys
from itertools import count
from pycrorm_async.store.address import DatabaseAddress
from tests.store.test_crash import append_all

for line in sys.stdin:
    child = os.fork()
    if child == 0:
        asyncio.run(append_all(DatabaseAddress.parse(sys.argv[1]), count(int(line))))
    os.write(1, b"running %d\\n" % child)
    os.waitpid(child, 0)
    os.write(1, b"dead 0\\n")
"""


def batch(number: int) -> list[Record]:
    first = number * PER_BATCH + 1
    last = first + PER_BATCH - 1
    return [*run_of(episode(1), first, last), *run_of(episode(2), first, last)]


async def append_all(address: DatabaseAddress, numbers: Iterable[int]) -> None:
    log = await EventLog.open(address, create=True)
    for number in numbers:
        assert await log.append(batch(number)) == {}
        report("appended", number)
    await log.close()


@pytest.mark.slow
def test_a_process_killed_during_an_append_leaves_whole_batches_and_the_next_one_continues(
    address: DatabaseAddress,
) -> None:
    seed = int.from_bytes(os.urandom(4))
    print(f"seed {seed}")
    chance = random.Random(seed)
    stored_batches = 0  # the number of batches in the log
    with subprocess.Popen(
        [sys.executable, "-c", APPENDER, str(address)],
        stdin=subprocess.PIPE,
        stdout=subprocess.PIPE,
        text=True,
        cwd=Path(__file__).parents[2],
    ) as appender:
        assert appender.stdin is not None
        assert appender.stdout is not None
        for _ in range(12):
            appender.stdin.write(f"{max(stored_batches - 1, 0)}\n")  # the last batch again
            appender.stdin.flush()
            child, killed, appended, wanted = 0, False, stored_batches, chance.randrange(1, 4)
            for line in appender.stdout:
                word, number = line.split()
                if word == "running":
                    child = int(number)
                elif word == "appended":
                    appended = int(number) + 1
                    wanted -= 1
                if child and wanted <= 0 and not killed:
                    killed = True
                    time.sleep(chance.uniform(0, 0.02))
                    os.kill(child, signal.SIGKILL)
                if word == "dead":
                    break
            heads = ask(address.path, "SELECT head FROM episode ORDER BY number")
            counts = ask(address.path, "SELECT count(*), min(sequence), max(sequence) FROM event GROUP BY episode")
            stored_batches = heads[0][0] // PER_BATCH
            assert stored_batches in (
                appended,
                appended + 1,
            )  # the kill may fall between the commit and the report of it
            assert heads == [(stored_batches * PER_BATCH,)] * 2
            assert counts == [(stored_batches * PER_BATCH, 1, stored_batches * PER_BATCH)] * 2

    asyncio.run(append_all(address, range(stored_batches)))
    assert ask(address.path, "SELECT count(*) FROM event") == [(stored_batches * PER_BATCH * 2,)]
    assert ask(address.path, "PRAGMA integrity_check") == [("ok",)]


@pytest.mark.slow
def test_an_append_cancelled_at_any_await_leaves_a_whole_batch_or_nothing_and_no_lock(
    address: DatabaseAddress,
) -> None:
    async def append_and_cancel(number: int, at: int) -> bool:
        log = await EventLog.open(address, create=True)
        appending: asyncio.Task[object] = asyncio.create_task(log.append(batch(number)))
        await cancel_at_await(appending, at)
        # A lock that only the garbage collector would release is detected here: it has not run yet.
        ask(address.path, "BEGIN IMMEDIATE")
        await log.close()
        return appending.cancelled()

    gc.collect()
    gc.disable()
    try:
        stored_batches, at = 0, 0
        stored_though_cancelled: set[bool] = set()
        while True:
            at += 1
            cancelled = asyncio.run(append_and_cancel(stored_batches, at))
            heads = ask(address.path, "SELECT head FROM episode ORDER BY number")
            assert heads in (
                [(stored_batches * PER_BATCH,)] * 2 if stored_batches else [],
                [((stored_batches + 1) * PER_BATCH,)] * 2,
            )
            before, stored_batches = stored_batches, heads[0][0] // PER_BATCH if heads else 0
            if not cancelled:
                break
            stored_though_cancelled.add(stored_batches > before)
    finally:
        gc.enable()
    assert at > 6  # an append has more awaits than that
    assert stored_though_cancelled == {False, True}  # cancelled before the commit, and during it
    asyncio.run(append_all(address, range(stored_batches + 1)))
    assert ask(address.path, "SELECT count(*) FROM event") == [((stored_batches + 1) * PER_BATCH * 2,)]


# === full disk ================================================================================================
#
# A database on a full disk is unavailable: events stay in the source, and are stored when there is space again.


class SmallDisk:
    """A disk of 2 MiB; where the machine permits no mount, a limit on SQLite's pages replaces it."""

    def __init__(self, place: Path, *, mounted: bool) -> None:
        self.place = place
        self._mounted = mounted and self._mount("size=2m") == 0
        self._pages = 256

    def fill(self) -> None:
        if self._mounted:
            (self.place / "ballast").write_bytes(bytes(2**20))

    def limit(self, engine: AsyncEngine) -> None:
        if not self._mounted:
            event.listen(engine.sync_engine, "checkout", self._limit_pages)

    def free_space(self) -> None:
        self._pages = 2**20
        if self._mounted:
            (self.place / "ballast").unlink()
            assert self._mount("remount,size=8m") == 0

    def release(self) -> None:
        if self._mounted:
            subprocess.run(["umount", str(self.place)], check=True)

    def _mount(self, options: str) -> int:
        command = ["mount", "-t", "tmpfs", "-o", options, "tmpfs", str(self.place)]
        return subprocess.run(command, capture_output=True, check=False).returncode

    def _limit_pages(self, connection: Any, *_: object) -> None:
        cursor = connection.cursor()
        cursor.execute(f"PRAGMA max_page_count = {self._pages}")
        cursor.close()


@pytest.fixture(params=["mounted", "simulated"])
def small_disk(request: pytest.FixtureRequest, tmp_path: Path) -> Iterator[SmallDisk]:
    disk = SmallDisk(tmp_path, mounted=request.param == "mounted")
    yield disk
    disk.release()


@pytest.mark.parametrize("code", [sqlite3.SQLITE_IOERR_SHMSIZE, sqlite3.SQLITE_IOERR_WRITE])
def test_a_disk_without_room_for_the_files_of_sqlite_is_named_as_the_cause(code: int) -> None:
    fault = sqlite3.OperationalError("disk I/O error")
    fault.sqlite_errorcode = code
    error = translate_error(fault, "sqlite:///memory.db")
    assert isinstance(error, DatabaseUnavailable)
    assert str(error).startswith("sqlite:///memory.db: disk I/O error: the disk may be full; SQLite needs some space")


async def test_a_database_on_a_full_disk_is_unavailable_and_stores_everything_once_when_there_is_space(
    small_disk: SmallDisk,
) -> None:
    small_disk.fill()
    file = small_disk.place / "memory.db"
    records = [record(episode(1), sequence, payload=b'"%s"' % (b"x" * 1000)) for sequence in range(1, 1001)]
    log = await EventLog.open(DatabaseAddress.parse(f"sqlite:///{file}"), create=True)
    small_disk.limit(log.engine)
    source = KeptSource(records, closed=True)
    backoff = Backoff(first_s=0.005, longest_s=0.02)
    drain = Drain(source, log.append, settings=Settings(batch_events_max=50), backoff=backoff)
    running = asyncio.create_task(drain.run())
    while drain.state.retries < 5:  # noqa: ASYNC110
        await asyncio.sleep(0.001)
    assert "database or disk is full" in (drain.state.unavailable or "")
    assert 0 < len(source.kept) < 1000
    with pytest.raises(DatabaseUnavailable, match="full"):
        await log.append(records)
    await asyncio.to_thread(small_disk.free_space)
    await asyncio.wait_for(running, 60)
    await log.close()
    assert source.kept == []
    assert ask(file, "SELECT count(*), min(sequence), max(sequence) FROM event") == [(1000, 1, 1000)]
    assert ask(file, "PRAGMA integrity_check") == [("ok",)]
