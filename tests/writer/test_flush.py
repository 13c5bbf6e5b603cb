"""A flush of the writer's thread ends in time, and names the reason for which it cannot store everything."""

from __future__ import annotations

import asyncio
import sqlite3
import threading
from collections.abc import Callable, Coroutine, Mapping

import pytest

from pycrorm_async.errors import FlushTimeout
from pycrorm_async.settings import Settings
from pycrorm_async.store.address import DatabaseAddress
from pycrorm_async.writer.plan_writer import WriterThread
from tests.databases import ask
from tests.store.factories import episode, run_of
from tests.writer.fakes import ForwardingDestination, KeptSource, opener
from tests.writer.writer_threads import no_writer_alive, until, writer_for, writers_alive


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
    writer = WriterThread(
        source=source, open_destination=opener(address, around=Unreadable), adopt=no_writer_alive, settings=settings
    )
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
    writer = WriterThread(
        source=source, open_destination=opener(address, around=Endless), adopt=no_writer_alive, settings=settings
    )
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
