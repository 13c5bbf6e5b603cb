"""A memory whose events a daemon stores: the same promises, clear errors, also when the daemon has faults."""

import asyncio
import logging
import shutil
from collections.abc import Callable
from dataclasses import replace
from pathlib import Path

import pytest
from sqlalchemy import select

from pycrorm_async import Memory, Reading, Settings, UserView, recover
from pycrorm_async.errors import CallerError, DatabaseForeign, DatabaseUnavailable, EpisodeParked, FlushTimeout
from pycrorm_async.orm import ProcessMetaData
from pycrorm_async.queue import Spool
from pycrorm_async.queue.sources import LiveSource
from pycrorm_async.store.address import DatabaseAddress
from pycrorm_async.store.log import EventLog
from tests.databases import ask, ask_to_change
from tests.memory.note_actions import NoteActionPerformable, texts
from tests.writer.running_writers import QUICKLY_SYNCED, Daemon, Start, memory_at

pytestmark = [pytest.mark.slow, pytest.mark.soak_on("postgresql")]


# === delegated writer =========================================================================================
#
# A memory whose events a daemon stores: the same promises, no connection for writing, clear errors without a daemon.


async def test_flushed_records_are_in_the_tables_and_closing_leaves_no_folder(
    database_url: str, spool: Path, daemon: Start
) -> None:
    async with memory_at(database_url, spool) as memory:
        async with memory.episode(description="before the daemon"):
            await NoteActionPerformable("a").perform()
        async with daemon() as started:
            await memory.flush()
            assert await texts(memory) == ["a"]
            async with memory.episode(description="beside the daemon"):
                await NoteActionPerformable("b").perform()
                await memory.flush()
                assert await texts(memory) == ["a", "b"]
            await memory.flush()
            status = memory.status
            assert status.written == status.synced == status.stored == status.folded
            assert (status.drained, status.writer, status.faults.total) == (True, None, 0)
            assert [each.status for each in await memory.reading.episodes()] == ["SUCCEEDED", "SUCCEEDED"]
            await NoteActionPerformable("c").perform()
            await memory.__aexit__(None, None, None)
            async with Reading.open(database_url) as reading:
                assert await texts(reading) == ["a", "b", "c"]
            assert Spool(spool).recorders() == []
            await started.wait_for_line("has ended")
    assert [line.split("; ")[-1] for line in started.lines if "has ended" in line] == [
        f"{status.written + 6} events stored"
    ]


async def test_the_daemon_may_start_before_the_database_exists(tmp_path: Path, spool: Path) -> None:
    url = f"sqlite:///{tmp_path / 'memory.db'}"
    async with memory_at(url, spool) as memory:
        await NoteActionPerformable("early").perform()
        await memory.synced()
        assert not (tmp_path / "memory.db").exists()
        with pytest.raises(DatabaseUnavailable, match="does not exist"):
            await texts(memory)
        with pytest.raises(DatabaseUnavailable, match="does not exist"):
            memory.mapped(NoteActionPerformable)
        started = Daemon(url, spool)
        await memory.flush()
        assert await texts(memory) == ["early"]
        async with memory.session() as session:
            assert (await session.scalars(select(ProcessMetaData.status))).all() == ["SUCCEEDED"]
    started.leave.set()
    await started.task


async def test_without_a_daemon_flush_raises_and_closing_leaves_the_events_to_the_next_drainer(
    database_url: str, spool: Path, caplog: pytest.LogCaptureFixture
) -> None:
    async with memory_at(database_url, spool, replace(QUICKLY_SYNCED, flush_timeout_s=0.3)) as memory:
        await NoteActionPerformable("a").perform()
        with pytest.raises(FlushTimeout, match="no process drains this spool: start `pycrorm writer`"):
            await memory.flush()
        assert not memory.status.drained
    [line] = [each.getMessage() for each in caplog.records if each.levelno == logging.WARNING]
    assert line.startswith(f"7 events are safe in {spool} and not in the database yet (no process drains this spool")
    report = await recover(database_url, spool=spool)
    assert (report.lost, report.failed) == ((), {})
    async with Reading.open(database_url) as reading:
        assert await texts(reading) == ["a"]


async def test_closing_reports_that_all_is_stored_and_the_tables_are_behind(
    database_url: str, spool: Path, caplog: pytest.LogCaptureFixture
) -> None:
    async with memory_at(database_url, spool, replace(QUICKLY_SYNCED, flush_timeout_s=0.3)) as memory:
        await NoteActionPerformable("a").perform()
        await memory.synced()
        [folder] = Spool(spool).recorders()
        drainer = LiveSource.take(folder.path)
        assert drainer is not None
        batch = await drainer.get_batch(events_max=100, bytes_max=2**20, age_s_max=0.0)
        await drainer.acknowledge(batch[-1].position)
    drainer.release()
    [line] = [each.getMessage() for each in caplog.records if each.levelno == logging.WARNING]
    assert line.startswith("all events are stored, but the last 7 are not visible in the tables yet (")


async def test_a_flush_returns_when_a_daemon_died_between_storing_and_folding_and_the_next_one_folds(
    database_url: str, spool: Path, daemon: Start
) -> None:
    async with memory_at(database_url, spool, replace(QUICKLY_SYNCED, flush_timeout_s=10.0)) as memory:
        await NoteActionPerformable("a").perform()
        await memory.synced()
        [folder] = Spool(spool).recorders()
        killed = LiveSource.take(folder.path)
        assert killed is not None
        batch = await killed.get_batch(events_max=100, bytes_max=2**20, age_s_max=0.0)
        log = await EventLog.open(DatabaseAddress.parse(database_url), create=True)
        await log.append(batch)
        await log.close()
        await killed.acknowledge(batch[-1].position)
        killed.release()
        async with daemon():
            await memory.flush()
            assert await texts(memory) == ["a"]


async def test_one_round_stores_what_a_live_process_has_synced_and_its_flush_returns(
    database_url: str, spool: Path
) -> None:
    async with memory_at(database_url, spool) as memory:
        await NoteActionPerformable("a").perform()
        await memory.synced()
        report = await recover(database_url, spool=spool)
        assert (report.living, len(report.drained.drained), report.failed) == (1, 1, {})
        await memory.flush()
        assert await texts(memory) == ["a"]
        await NoteActionPerformable("b").perform()
        await memory.synced()
        assert (await recover(database_url, spool=spool)).drained.drained[0].records == 6
        await memory.flush()
        assert await texts(memory) == ["a", "b"]


async def test_a_full_spool_is_drained_and_the_plan_continues(database_url: str, spool: Path) -> None:
    tiny = replace(
        QUICKLY_SYNCED, segment_bytes=2**14, record_bytes_max=2**12, spool_bytes_max=2**17, spool_reserve_bytes=2**15
    )
    async with memory_at(database_url, spool, tiny, writer="process") as memory, memory.episode(description="e"):

        async def many() -> None:
            for index in range(1000):
                await NoteActionPerformable(f"{index:04}").perform()

        task = asyncio.create_task(many())
        await asyncio.sleep(0)
        assert not task.done()
        await asyncio.wait_for(task, 60)
        await memory.flush()
        assert await texts(memory) == [f"{index:04}" for index in range(1000)]
        assert memory.status.faults.total == 0


async def test_a_flush_reports_a_parked_episode_once_and_the_others_continue(
    database_url: str, spool: Path, daemon: Start
) -> None:
    async with memory_at(database_url, spool) as memory, daemon():
        async with memory.episode(description="parked") as parked:
            await NoteActionPerformable("a").perform()
            await memory.flush()
            ask_to_change(database_url, "UPDATE episode SET parked = 'by hand' WHERE number = 1")
            await NoteActionPerformable("b").perform()
            with pytest.raises(EpisodeParked, match=f"{parked}: by hand"):
                await memory.flush()
        async with memory.episode(description="other"):
            await NoteActionPerformable("c").perform()
        await memory.flush()
        assert await texts(memory) == ["a", "c"]


async def test_a_refused_episode_is_reported_and_kept_and_stored_by_a_later_daemon_when_possible(
    database_url: str, spool: Path, daemon: Start
) -> None:
    settings = replace(QUICKLY_SYNCED, keep_stored_s=0)  # a daemon that keeps no stored segments repairs nothing
    async with memory_at(database_url, spool, settings) as memory:
        async with memory.episode(description="refused") as refused:
            async with daemon(settings):
                await NoteActionPerformable("a").perform()
                await memory.flush()
                [[head]] = ask(database_url, "SELECT head FROM episode")
                ask_to_change(
                    database_url, "UPDATE episode SET folded = 1, head = 1"
                )  # as after the restore of an older backup
                await NoteActionPerformable("b").perform()
                with pytest.raises(EpisodeParked, match=f"{refused}: events 2 to .* did not arrive before"):
                    await memory.flush()
            async with daemon(settings) as started:  # continues where its predecessor ended
                await NoteActionPerformable("c").perform()
                await memory.flush()
                await started.wait_for_line(
                    f"episode {refused} was refused: events 2 to .*; its events are kept in the spool"
                )
        async with daemon(settings) as started:
            async with memory.episode(description="other"):
                await NoteActionPerformable("d").perform()
            await memory.flush()
            status = memory.status
            assert status.written == status.stored == status.folded
            await memory.__aexit__(None, None, None)
            [kept] = Spool(spool).recorders()
            assert kept.refused == str(refused)
            await started.wait_for_line(f"recorder {kept.name}: episode {refused} .*; the next writer retries")
            segments = {path: path.read_bytes() for path in kept.path.glob("*.segment")}
    assert (len(segments), kept.alive) == (3, False)
    report = await recover(database_url, spool=spool)
    assert list(report.drained.stopped) == [str(refused)]
    assert {path: path.read_bytes() for path in kept.path.glob("*.segment")} == segments
    ask_to_change(database_url, f"UPDATE episode SET folded = {head}, head = {head} WHERE number = 1")
    async with daemon(settings) as started:
        await started.wait_for_line(f"recorder {kept.name} is recovered; ")
    assert Spool(spool).recorders() == []
    async with Reading.open(database_url) as reading:
        assert sorted(await texts(reading)) == ["a", "b", "c", "d"]


# === daemon faults ============================================================================================
#
# A daemon on a database that is replaced, locked or foreign, on a damaged folder, or beside another daemon.


async def test_a_daemon_ends_when_its_database_file_is_replaced_and_waits_when_the_file_is_deleted(
    tmp_path: Path, spool: Path
) -> None:
    file = tmp_path / "memory.db"
    url = f"sqlite:///{file}"
    started = Daemon(url, spool)
    async with memory_at(url, spool, replace(QUICKLY_SYNCED, flush_timeout_s=0.5)):
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


@pytest.mark.parametrize(
    ("open_it", "words"),
    [
        (lambda: Memory.open("sqlite://", writer="daemon"), "sqlite:// is private to this process"),
        (
            lambda: Memory.open("sqlite:///x.db", writer="daemon", views=[UserView("v", select(ProcessMetaData.id))]),
            "without the views of this process",
        ),
        (lambda: Memory.open("sqlite://", writer="process"), "so no other process can write it: use writer='thread'"),
        (lambda: Memory.open("sqlite:///x.db", settings=Settings(writer="cron")), "use 'thread' or 'process' or"),  # type: ignore[arg-type]
    ],
)
def test_an_impossible_writer_is_refused_at_once(open_it: Callable[[], Memory], words: str) -> None:
    with pytest.raises(CallerError, match=words):
        open_it()
