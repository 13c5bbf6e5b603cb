"""A writer in a thread stores and folds beside a plan, and reports at flush and at close what it could not do."""

from __future__ import annotations

import asyncio
import sqlite3
import threading
import time
from collections.abc import Callable, Coroutine, Mapping
from typing import Any

import pytest

from pycrorm_async.errors import DatabaseForeign, DatabaseUnavailable, EpisodeParked, FlushTimeout, LogDamaged
from pycrorm_async.events.ids import EpisodeId
from pycrorm_async.settings import Settings
from pycrorm_async.store.address import DatabaseAddress
from pycrorm_async.store.log import EventLog, park
from pycrorm_async.writer.drain import Destination
from pycrorm_async.writer.plan_writer import WriterThread
from tests.databases import ask
from tests.store.factories import declaration, episode, name, record, run_of
from tests.writer.fakes import ForwardingDestination, KeptSource
from tests.writer.running_writers import (
    NEVER_IDLE,
    QUICK,
    until,
    until_answer,
    writer_for,
    writers_alive,
    writing,
)

HEADS = "SELECT id, head, folded FROM episode ORDER BY number"


async def test_records_put_before_a_flush_are_stored_and_folded_after_it(address: DatabaseAddress) -> None:
    source = KeptSource()
    async with writing(source, address) as writer:
        source.put([declaration(b"{}"), *run_of(episode(1), 1, 2500, position=2)])
        await writer.flush(2501)
        assert ask(address.path, HEADS) == [(name(1), 2500, 2500)]
        assert source.kept == []
        source.put(run_of(episode(1), 2501, 2600, position=2502))
    assert ask(address.path, HEADS) == [(name(1), 2600, 2600)]
    assert source.kept == []
    assert writers_alive() == []


@pytest.mark.slow
async def test_events_are_stored_beside_a_plan_that_never_suspends(address: DatabaseAddress) -> None:
    source = KeptSource()
    async with writing(source, address) as writer:
        patience_ends = time.monotonic() + 60
        put = 0
        while writer.state.queue.records < 5000:  # without an await, so that the loop of the plan never runs
            assert time.monotonic() < patience_ends
            if put < 20_000:
                source.put(run_of(episode(1), put + 1, put + 100))
                put += 100
            sum(number * number for number in range(1000))
        await writer.flush(put)
    assert ask(address.path, HEADS) == [(name(1), put, put)]
    assert ask(address.path, "SELECT count(*), max(sequence) FROM event") == [(put, put)]


async def test_events_of_an_idle_plan_are_folded_without_a_flush(address: DatabaseAddress) -> None:
    source = KeptSource()
    async with writing(source, address, settings=QUICK):
        source.put(run_of(episode(1), 1, 100))
        await until_answer(address.path, HEADS, [(name(1), 100, 100)])
        source.put(run_of(episode(1), 101, 150))
        await until_answer(address.path, HEADS, [(name(1), 150, 150)])


async def test_events_left_unfolded_by_a_predecessor_are_folded_when_the_new_plan_is_idle(
    address: DatabaseAddress,
) -> None:
    log = await EventLog.open(address, create=True)
    await log.append(run_of(episode(1), 1, 7))
    await log.close()
    source = KeptSource()
    async with writing(source, address, settings=QUICK):
        await until_answer(address.path, HEADS, [(name(1), 7, 7)])


# --- opening --------------------------------------------------------------------------------------------------


async def test_starting_raises_on_a_foreign_database_and_leaves_no_thread(
    address: DatabaseAddress,
) -> None:
    ask(address.path, "CREATE TABLE bookmarks (url)")
    writer = writer_for(KeptSource(), address)
    with pytest.raises(DatabaseForeign):
        await writer.start()
    assert writers_alive() == []


async def test_starting_raises_when_the_database_does_not_answer_in_time(address: DatabaseAddress) -> None:
    await (await EventLog.open(address, create=True)).close()
    holder = sqlite3.connect(address.path, isolation_level=None)
    holder.execute("BEGIN IMMEDIATE")
    settings = Settings(connect_timeout_s=0.05)
    writer = writer_for(KeptSource(), address, settings=settings, busy_timeout_s=0.2)
    with pytest.raises(DatabaseUnavailable):
        await writer.start()
    holder.close()
    assert writers_alive() == []


async def test_a_cancelled_start_leaves_no_thread(address: DatabaseAddress) -> None:
    source = KeptSource()
    writer = writer_for(source, address)
    starting = asyncio.create_task(writer.start())
    await asyncio.sleep(0)
    starting.cancel()
    with pytest.raises(asyncio.CancelledError):
        await starting
    await until(lambda: not writers_alive())


# --- failing --------------------------------------------------------------------------------------------------


async def test_a_gap_is_raised_at_flush_and_at_close_and_other_episodes_are_visible(
    address: DatabaseAddress,
) -> None:
    source = KeptSource()
    writer = writer_for(source, address)
    await writer.start()
    source.put(
        [*run_of(episode(1), 1, 3), *run_of(episode(1), 5, 6, position=4), *run_of(episode(2), 1, 9, position=6)]
    )
    reasons = {name(1): "event 4 did not arrive before event 5"}
    with pytest.raises(EpisodeParked) as caught:
        await writer.flush(14)
    assert caught.value.reasons == reasons
    assert ask(address.path, HEADS) == [(name(1), 3, 3), (name(2), 9, 9)]
    source.put(run_of(episode(2), 10, 20, position=15))
    source.close()
    with pytest.raises(EpisodeParked) as caught:
        await writer.close()
    assert caught.value.reasons == reasons
    assert ask(address.path, HEADS) == [(name(1), 3, 3), (name(2), 20, 20)]
    assert source.kept == []
    assert [(each.episode, each.sequence) for each in source.aside or []] == [(episode(1), n) for n in (1, 2, 3, 5, 6)]
    assert writers_alive() == []


async def test_an_episode_that_was_parked_before_is_not_raised_again(address: DatabaseAddress) -> None:
    log = await EventLog.open(address, create=True)
    await log.append(run_of(episode(1), 1, 3))
    async with log.engine.begin() as connection:
        await park(connection, 1, "an old story")
    await log.close()
    source = KeptSource(run_of(episode(2), 1, 3))
    async with writing(source, address) as writer:
        await writer.flush(3)
    assert ask(address.path, HEADS) == [(name(1), 3, 0), (name(2), 3, 3)]


async def test_damage_is_reported_once_and_raised_at_every_flush_and_at_close_while_the_plan_continues(
    address: DatabaseAddress, caplog: pytest.LogCaptureFixture
) -> None:
    log = await EventLog.open(address, create=True)
    await log.append([record(episode(1), 1, payload=b"{}")])
    await log.close()
    source = KeptSource(run_of(episode(1), 1, 3))
    writer = writer_for(source, address)
    await writer.start()
    for _ in range(2):
        with pytest.raises(LogDamaged):
            await writer.flush(3)
        source.put(run_of(episode(2), 1, 3, position=4))
    assert writer.state.failure == (f"episode {name(1)}, event 1: another event is stored under this number already")
    assert writers_alive() == ["pycrorm writer robot"]
    source.close()
    with pytest.raises(LogDamaged):
        await writer.close()
    assert source.kept == [1, 2, 3, 4, 5, 6, 4, 5, 6]
    assert writers_alive() == []
    assert [each.getMessage() for each in caplog.records] == [
        f"the writer stopped; what the spool still holds is kept: {writer.state.failure}"
    ]


async def test_a_fold_that_fails_is_raised_at_flush(address: DatabaseAddress) -> None:
    class Unfoldable(ForwardingDestination):
        async def fold(self) -> int:
            raise KeyError("no such column")

    source = KeptSource()
    writer = writer_for(source, address, around=Unfoldable, settings=QUICK)
    await writer.start()
    source.put(run_of(episode(1), 1, 5))
    await until(lambda: writer.state.fold_error is not None)
    with pytest.raises(KeyError, match="no such column"):
        await writer.flush(5)
    source.close()
    with pytest.raises(KeyError, match="no such column"):
        await writer.close()
    assert ask(address.path, HEADS) == [(name(1), 5, 0)]
    assert writers_alive() == []


@pytest.mark.slow
@pytest.mark.every_python
async def test_a_fold_on_an_unavailable_database_is_retried(address: DatabaseAddress) -> None:
    class OftenUnavailable(ForwardingDestination):
        requests = 0

        async def fold(self) -> int:
            self.requests += 1
            if self.requests % 3:
                raise DatabaseUnavailable("the database is locked")
            return await super().fold()

        async def stopped(self) -> Mapping[str, str]:
            self.requests += 1
            if self.requests % 3:
                raise DatabaseUnavailable("the database is locked")
            return await super().stopped()

    source = KeptSource(run_of(episode(1), 1, 5))
    async with writing(source, address, around=OftenUnavailable, settings=NEVER_IDLE) as writer:
        await writer.flush(5)
        assert ask(address.path, HEADS) == [(name(1), 5, 5)]
        assert writer.state.fold_error is None


async def test_a_cancelled_flush_stops_the_wait_and_not_the_work(address: DatabaseAddress) -> None:
    entered, release = threading.Event(), threading.Event()

    class Slow(ForwardingDestination):
        async def append(self, *batch: Any, **options: Any) -> Mapping[EpisodeId, str]:
            entered.set()
            await asyncio.to_thread(release.wait)
            return await super().append(*batch, **options)

    source = KeptSource(run_of(episode(1), 1, 5))
    async with writing(source, address, around=Slow, settings=NEVER_IDLE) as writer:
        flushing = asyncio.create_task(writer.flush(5))
        await asyncio.to_thread(entered.wait)
        flushing.cancel()
        with pytest.raises(asyncio.CancelledError):
            await flushing
        release.set()
        await until_answer(address.path, HEADS, [(name(1), 5, 5)])


async def test_the_database_is_closed_in_the_loop_that_opened_it(address: DatabaseAddress) -> None:
    threads: list[str] = []

    def around(destination: Destination) -> Destination:
        threads.append(threading.current_thread().name)
        return destination

    source = KeptSource()
    closed = lambda: threads.append(threading.current_thread().name)  # noqa: E731
    writer = writer_for(source, address, around=around, closed=closed)
    await writer.start()
    source.close()
    await writer.close()
    assert threads == ["pycrorm writer robot"] * 2


# === flush ====================================================================================================
#
# A flush of the writer's thread ends in time, and names the reason for which it cannot store everything.


@pytest.mark.slow
async def test_a_flush_that_times_out_names_the_reason_and_loses_nothing(address: DatabaseAddress) -> None:
    source = KeptSource()
    settings = Settings(idle_ms=10**9, flush_timeout_s=1.0)
    writer = writer_for(source, address, settings=settings, busy_timeout_s=0.01)
    await writer.start()
    holder = sqlite3.connect(address.path, isolation_level=None)
    holder.execute("BEGIN IMMEDIATE")
    source.put(run_of(episode(1), 1, 5))
    with pytest.raises(FlushTimeout, match=r"database is locked\); everything recorded is safe in the spool"):
        await writer.flush(5)
    source.close()
    with pytest.raises(FlushTimeout, match=r"database is locked\); everything recorded is safe in the spool"):
        await writer.close()
    holder.close()
    assert writers_alive() == []
    assert source.kept == [1, 2, 3, 4, 5]
    assert ask(address.path, "SELECT count(*) FROM event") == [(0,)]


async def test_a_failing_query_for_stopped_episodes_is_reported_once_and_raised_at_flush_and_close(
    address: DatabaseAddress,
) -> None:
    class Unreadable(ForwardingDestination):
        async def stopped(self) -> Mapping[str, str]:
            raise KeyError("no such column")

    source = KeptSource(run_of(episode(1), 1, 5))
    settings = Settings(flush_timeout_s=1000.0)
    writer = writer_for(source, address, around=Unreadable, settings=settings)
    await writer.start()
    async with asyncio.timeout(30):
        with pytest.raises(KeyError, match="no such column"):
            await writer.flush(5)
    assert source.given_up == ["the writer stopped: 'no such column'"]
    assert writer.state.failure == "'no such column'"
    source.close()
    with pytest.raises(KeyError, match="no such column"):
        await writer.close()
    assert source.kept == [1, 2, 3, 4, 5]
    assert writers_alive() == []


@pytest.mark.slow
async def test_flushes_during_the_close_end_with_it(address: DatabaseAddress) -> None:
    for _ in range(15):
        source = KeptSource(run_of(episode(1), 1, 5))
        writer = writer_for(source, address)
        await writer.start()
        over = threading.Event()
        flushed: list[int] = []

        async def flush_all_the_time(
            writer: WriterThread = writer, over: threading.Event = over, flushed: list[int] = flushed
        ) -> None:
            while not over.is_set():
                await writer.flush(5)
                flushed.append(5)
                await asyncio.sleep(0)

        def flush_beside(work: Callable[[], Coroutine[None, None, None]] = flush_all_the_time) -> None:
            asyncio.run(work())

        flushing = [asyncio.create_task(asyncio.to_thread(flush_beside)) for _ in range(2)]
        await until(lambda flushed=flushed: len(flushed) > 3)  # type: ignore[misc]
        source.close()
        await writer.close()
        over.set()
        async with asyncio.timeout(30):
            await asyncio.gather(*flushing)


@pytest.mark.slow
@pytest.mark.every_python
async def test_a_flush_that_closing_stops_waiting_for_reports_that(address: DatabaseAddress) -> None:
    entered = threading.Event()

    class Endless(ForwardingDestination):
        async def fold(self) -> int:
            entered.set()
            await asyncio.Event().wait()
            return 0

    source = KeptSource(run_of(episode(1), 1, 5))
    settings = Settings(idle_ms=10**9, flush_timeout_s=3.0)
    writer = writer_for(source, address, around=Endless, settings=settings)
    await writer.start()
    source.close()
    closing = asyncio.create_task(writer.close())
    await asyncio.to_thread(entered.wait)
    await asyncio.sleep(1.5)  # so that on a busy machine too the flush's own limit passes after that of closing
    flushing = asyncio.create_task(writer.flush(5))
    for each in (closing, flushing):
        with pytest.raises(FlushTimeout, match=r"not finished after 3 s \(closed with work left"):
            await asyncio.wait_for(each, 30)
    with pytest.raises(FlushTimeout, match=r"not finished after 3 s \(closed with work left"):
        await asyncio.wait_for(writer.flush(5), 30)
