"""The writer between the real queue and the real log, also for the folders of dead recorders."""

from __future__ import annotations

import asyncio
import contextlib
from collections.abc import Iterator, Sequence
from dataclasses import replace
from pathlib import Path

import pytest

from pycrorm_async.clock import SYSTEM_CLOCK
from pycrorm_async.errors import EpisodeParked, PycrormError, SpoolDamaged, SpoolFull, SpoolStuck
from pycrorm_async.events.codec import Heading, Record
from pycrorm_async.events.ids import EpisodeId, episode_id, episode_text
from pycrorm_async.operations.recovery import dead_queues
from pycrorm_async.queue.recorder_queue import RecorderQueue
from pycrorm_async.queue.spool import Spool
from pycrorm_async.settings import Settings
from pycrorm_async.store.address import DatabaseAddress
from pycrorm_async.store.log import EventLog
from pycrorm_async.writer.drain import Source, drain_once
from pycrorm_async.writer.plan_writer import WriterThread
from tests.databases import ask, ask_to_change
from tests.store.factories import episode, name, record, run_of
from tests.writer.fakes import CountingFold, KeptSource, opener
from tests.writer.running_writers import QUICK, until, until_answer, writer_for, writers_alive, writing

# === queue to log =============================================================================================
#
# Checks of the writer between the real queue and the real log.

SETTINGS = Settings(
    segment_bytes=2**17, record_bytes_max=2**12, batch_events_max=700, sync_interval_ms=5, idle_ms=10**9
)
STORED = "SELECT episode, count(*), min(sequence), max(sequence) FROM event GROUP BY episode ORDER BY episode"


def queue_in(spool: Path, settings: Settings = SETTINGS) -> RecorderQueue:
    return RecorderQueue.create(
        spool, settings=settings, clock=SYSTEM_CLOCK, recorder=episode_id(1_700_000_000_000_000_000, bytes(10))
    )


def kind(of: EpisodeId, number: int) -> Heading:
    return Heading(of, "EpisodeStarted" if number == 1 else "NodeStarted", 1)


def payload(number: int) -> bytes:
    return b'{"kind":"action","parent":%d,"text":"%s"}' % (number, "é🤖\\u0007".encode() * 20)


async def test_the_log_holds_byte_for_byte_what_was_put(tmp_path: Path, address: DatabaseAddress) -> None:
    queue = queue_in(tmp_path / "spool")
    writer = WriterThread(source=queue, open_destination=opener(address), adopt=tuple, settings=SETTINGS)
    await writer.start()
    queue.put_nowait(Heading(None, "DesignatorTypeDeclared", 1), b'{"dtype":"SayingAction"}')
    for number in range(1, 2001):
        assert queue.put_nowait(kind(episode(1), number), payload(number)) == number
        if number % 10 == 0:
            queue.put_nowait(kind(episode(2), number // 10), payload(number))
    await queue.synced_to(queue.written)
    await writer.flush(queue.written)
    assert ask(address.path, STORED) == [(1, 2000, 1, 2000), (2, 200, 1, 200)]
    repeated = queue._appender._current.number - 1  # the declaration begins each segment after the first
    assert repeated > 1
    assert queue.stored == queue.written == 2201 + repeated
    queue.put_nowait(Heading(episode(1), "EpisodeEnded", 1), b'{"status":"SUCCEEDED"}')
    queue.close()
    await writer.close()
    queue.release()
    rows = ask(address.path, "SELECT payload FROM event WHERE episode = 1 ORDER BY sequence")
    assert [row[0].encode() for row in rows] == [payload(number) for number in range(1, 2001)] + [
        b'{"status":"SUCCEEDED"}'
    ]
    assert ask(address.path, "SELECT payload FROM pycrorm_declaration") == [('{"dtype":"SayingAction"}',)]
    assert ask(address.path, "SELECT head, folded FROM episode ORDER BY number") == [(2001, 2001), (200, 200)]


SMALL = replace(SETTINGS, segment_bytes=2**14, spool_bytes_max=2**17, spool_reserve_bytes=2**15)


async def refused_in(tmp_path: Path, address: DatabaseAddress) -> tuple[RecorderQueue, WriterThread]:
    """Yield a queue and a log that have worked together, after the database has lost two events of the first
    episode.
    """
    queue = queue_in(tmp_path / "spool", SMALL)
    writer = WriterThread(source=queue, open_destination=opener(address), adopt=tuple, settings=SMALL)
    for number in (1, 2, 3):
        queue.put_nowait(kind(episode(1), number), payload(number))
    await writer.start()
    await writer.flush(3)
    ask_to_change(address.path, "UPDATE episode SET head = 1, folded = 1")  # as after the restore of a backup
    return queue, writer


async def put_when_space_is_free(queue: RecorderQueue, heading: Heading, content: bytes) -> None:
    async with asyncio.timeout(60):
        while True:
            try:
                queue.put_nowait(heading, content)
                break
            except SpoolFull:
                await queue.room()


@pytest.mark.slow
async def test_a_refused_episode_becomes_dead_letters_and_the_others_always_have_space(
    tmp_path: Path, address: DatabaseAddress
) -> None:
    queue, writer = await refused_in(tmp_path, address)
    queue.put_nowait(kind(episode(2), 1), payload(1))
    for number in range(2, 2001):  # many times the size of the spool
        for which in (1, 2):
            await put_when_space_is_free(queue, kind(episode(which), number + 2 * (which == 1)), payload(number))
    with pytest.raises(EpisodeParked, match="events 2 to 3 did not arrive before event 4"):
        await writer.flush(queue.written)
    for which in (1, 2):
        queue.put_nowait(Heading(episode(which), "EpisodeEnded", 1), b'{"status":"SUCCEEDED"}')
    queue.close()
    with pytest.raises(EpisodeParked):
        await writer.close()
    queue.release()
    assert ask(address.path, STORED) == [(1, 3, 1, 3), (2, 2001, 1, 2001)]
    [kept] = Spool(tmp_path / "spool").recorders()
    assert kept.refused == episode_text(episode(1))

    ask_to_change(address.path, "UPDATE episode SET head = 3 WHERE number = 1")  # the missing events arrive
    failures: dict[str, PycrormError] = {}
    log = await EventLog.open(address, create=True)
    report = await drain_once(dead_queues(Spool(tmp_path / "spool"), failures), CountingFold(log), settings=SETTINGS)
    await log.close()
    assert (failures, report.failed, report.stopped) == ({}, {}, {})
    assert ask(address.path, STORED) == [(1, 2003, 1, 2003), (2, 2001, 1, 2001)]
    rows = ask(address.path, "SELECT payload FROM event WHERE episode = 1 AND sequence > 3 ORDER BY sequence")
    assert [row[0].encode() for row in rows[:-1]] == [payload(number) for number in range(2, 2001)]
    assert Spool(tmp_path / "spool").recorders() == []


async def test_a_refused_episode_without_dead_letters_ends_the_wait_for_space_of_all_others(
    tmp_path: Path, address: DatabaseAddress
) -> None:
    queue, writer = await refused_in(tmp_path, address)
    queue.folder.with_name(f"{queue.name}.{episode_text(episode(1))}.refused").touch()  # no folder can be made there
    queue.put_nowait(kind(episode(1), 4), payload(4))
    with pytest.raises(EpisodeParked):
        await writer.flush(4)
    queue.put_nowait(kind(episode(2), 1), payload(1))
    put = 1
    with pytest.raises(
        SpoolStuck,
        match=r"events 2 to 3 did not arrive .* cannot be kept as dead letters: .*refused/alive: Not a directory",
    ):
        async with asyncio.timeout(60):
            while True:
                await queue.room()
                put += 1
                with contextlib.suppress(SpoolFull):
                    queue.put_nowait(kind(episode(2), 2), payload(put))
    assert put > 100
    assert queue.block_until_room(60.0) is True  # the reserve is still free
    queue.put_nowait(Heading(episode(2), "EpisodeEnded", 1), b'{"status":"FAILED"}', reserved=True)
    queue.close()
    with pytest.raises(EpisodeParked):
        await writer.close()
    queue.release()
    assert [each.path for each in Spool(tmp_path / "spool").recorders()] == [queue.folder]


# === recovery =================================================================================================
#
# A writer drains the folders of dead recorders beside its own queue.


async def test_the_folders_of_dead_recorders_are_stored_and_folded(address: DatabaseAddress) -> None:
    dead = [KeptSource(run_of(episode(which), 1, 30), closed=True, name=f"dead {which}") for which in (2, 3)]
    source = KeptSource(run_of(episode(1), 1, 10))
    writer = writer_for(source, address, settings=QUICK, adopt=dead)
    await writer.start()
    folded = "SELECT id, folded FROM episode ORDER BY id"
    await until_answer(address.path, folded, [(name(1), 10), (name(2), 30), (name(3), 30)])
    source.close()
    await writer.close()
    assert [each.kept for each in dead] == [[], []]
    assert [each.source for each in writer.state.adopted] == ["dead 2", "dead 3"]


async def test_a_damaged_folder_of_another_recorder_is_shown_and_not_raised(address: DatabaseAddress) -> None:
    class Damaged(KeptSource):
        async def get_batch(self, *, events_max: int, bytes_max: int, age_s_max: float) -> Sequence[Record]:
            raise SpoolDamaged(Path("/spool/2/1.seg"), 4096, "a frame does not match its checksum")

    after = KeptSource(run_of(episode(3), 1, 4), closed=True, name="dead 3")

    def open_sources() -> Iterator[Source]:
        yield Damaged(name="dead 2")
        yield after
        raise SpoolDamaged(Path("/spool/4/1.seg"), 0, "no header")

    source = KeptSource(run_of(episode(1), 1, 3))
    writer = writer_for(source, address, adopt=open_sources())
    await writer.start()
    await until(lambda: len(writer.state.adoption_errors) == 2)
    await writer.flush(3)
    source.close()
    await writer.close()
    assert writer.state.adoption_errors == (
        "dead 2: /spool/2/1.seg is damaged at byte 4096: a frame does not match its checksum",
        "/spool/4/1.seg is damaged at byte 0: no header",
    )
    assert after.kept == []


async def test_a_contradiction_between_a_dead_recorder_and_the_log_is_reported_once(
    address: DatabaseAddress, caplog: pytest.LogCaptureFixture
) -> None:
    log = await EventLog.open(address, create=True)
    await log.append([record(episode(2), 1, payload=b'{"other":1}')])
    await log.close()
    source = KeptSource(run_of(episode(1), 1, 3))
    async with writing(
        source, address, adopt=[KeptSource(run_of(episode(2), 1, 4), closed=True, name="dead 2")]
    ) as writer:
        await until(lambda: bool(writer.state.adoption_errors))
        await writer.flush(3)
    [line] = [each.getMessage() for each in caplog.records]
    assert line == (f"recorder dead 2: episode {name(2)}, event 1: another event is stored under this number already")


async def test_refusals_in_many_dead_folders_are_reported_in_one_line(
    address: DatabaseAddress, caplog: pytest.LogCaptureFixture
) -> None:
    dead = [
        KeptSource([*run_of(episode(n), 1, 3), record(episode(n), 5, position=4)], closed=True, name=f"dead {n}")
        for n in (2, 3, 4)
    ]
    source = KeptSource(run_of(episode(1), 1, 3))
    writer = writer_for(source, address, adopt=dead)
    await writer.start()
    await until(lambda: bool(caplog.records))
    source.close()
    with pytest.raises(EpisodeParked):
        await writer.close()
    [line] = [each.getMessage() for each in caplog.records if each.levelname == "ERROR"]
    assert line == (
        f"recorder dead 2: episode {name(2)} was refused: event 4 did not arrive before event 5;"
        " its events are kept in the spool (and 2 more: see `pycrorm status`)"
    )
    assert [len(each.aside or []) for each in dead] == [4, 4, 4]


async def test_closing_does_not_wait_for_the_records_of_other_recorders(address: DatabaseAddress) -> None:
    release_folder: list[str] = []

    def open_sources() -> Iterator[Source]:
        try:
            yield KeptSource(run_of(episode(2), 1, 5), name="never closed")
        finally:
            release_folder.append("never closed")

    folders = open_sources()
    source = KeptSource(run_of(episode(1), 1, 3))
    async with writing(source, address, adopt=folders):
        await until_answer(address.path, "SELECT count(*) FROM event", [(8,)])
    assert writers_alive() == []
    assert release_folder == ["never closed"]
    assert ask(address.path, "SELECT id, folded FROM episode ORDER BY id") == [(name(1), 3), (name(2), 5)]
