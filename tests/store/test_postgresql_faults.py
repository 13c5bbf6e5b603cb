"""Faults of the network or of the PostgreSQL server: every event is stored once and in order.

The tests compare what was put into the source with what a connection of their own reads at the end.
"""

from __future__ import annotations

import asyncio
import contextlib
import random
from collections.abc import AsyncIterator, Callable, Coroutine
from typing import Any
from urllib.parse import urlsplit

import pytest
from sqlalchemy import text

from pycrorm_async.errors import DatabaseUnavailable
from pycrorm_async.events.codec import Record
from pycrorm_async.settings import Settings
from pycrorm_async.store import postgresql_engine
from pycrorm_async.store.address import DatabaseAddress
from pycrorm_async.store.log import EventLog
from pycrorm_async.testing.postgresql_proxy import Proxy, proxy_before
from pycrorm_async.writer.drain import Backoff, Drain
from tests.databases import Server, ask, ask_each
from tests.store.factories import declaration, episode, run_of
from tests.writer.fakes import KeptSource

pytestmark = pytest.mark.slow

SETTINGS = Settings(batch_events_max=250)
QUICKLY = Backoff(first_s=0.005, longest_s=0.05)
EVENTS = (
    "SELECT id, sequence, type, version, wall_ns, event.monotonic_ns, payload FROM event"
    " JOIN episode ON number = event.episode ORDER BY id, sequence"
)

HEAD = "SELECT coalesce(max(head), 0) FROM episode"


def records_of_three_episodes(rng: random.Random, events: int) -> list[Record]:
    """Return records of three interleaved episodes, with some declarations."""
    records: list[Record] = []
    heads = dict.fromkeys((1, 2, 3), 0)
    while len(records) < events:
        if rng.random() < 0.02:
            records.append(declaration(b'{"dtype":"%d"}' % rng.randrange(9), position=len(records) + 1))
            continue
        number = rng.choice((1, 2, 3))
        heads[number] += 1
        records += run_of(episode(number), heads[number], heads[number], position=len(records) + 1)
    return records


def stored(url: str) -> list[tuple[object, ...]]:
    return ask(url, EVENTS)


def expected(records: list[Record]) -> list[tuple[object, ...]]:
    return sorted(
        (
            f"00000000-0000-0000-0000-{int.from_bytes(each.episode):012x}",
            *each[2:7],
            each.payload.decode(),
        )
        for each in records
        if each.episode is not None
    )


async def until(condition: Callable[[], bool]) -> None:
    """Wait for a condition for which there is no event."""
    while not condition():  # noqa: ASYNC110
        await asyncio.sleep(0.001)


@pytest.fixture
def direct_url(server: Server) -> str:
    """The database's own URL, without a proxy."""
    return server.new_database()


@pytest.fixture
async def proxy(server: Server) -> AsyncIterator[Proxy]:
    async with proxy_before(server.folder) as between:
        yield between


def url_through_proxy(proxy: Proxy, direct_url: str) -> DatabaseAddress:
    return DatabaseAddress.parse(proxy.url(urlsplit(direct_url).path.removeprefix("/"), password="s3cr"))


async def drained(
    address: DatabaseAddress, records: list[Record], meanwhile: Callable[[Drain], Coroutine[Any, Any, None]]
) -> tuple[Drain, KeptSource]:
    """Drain everything while a fault happens; only an unavailable database is reported."""
    log = await EventLog.open(address, create=True, busy_timeout_s=2.0)
    source = KeptSource(records, closed=True)
    drain = Drain(source, log.append, settings=SETTINGS, backoff=QUICKLY)
    try:
        async with asyncio.timeout(60), asyncio.TaskGroup() as both:
            both.create_task(drain.run())
            both.create_task(meanwhile(drain))
    finally:
        await log.close()
    return drain, source


def verify_stored_once(direct_url: str, records: list[Record], drain: Drain, source: KeptSource) -> None:
    assert stored(direct_url) == expected(records)
    assert source.kept == []
    state = drain.state
    assert (state.appended, state.acknowledged) == (len(records), len(records))
    assert (state.refused, state.unavailable) == ({}, None)
    assert "s3cr" not in (state.last_error or "")
    heads = ask(direct_url, "SELECT head FROM episode ORDER BY id")
    assert heads == [(sum(each.episode == episode(number) for each in records),) for number in (1, 2, 3)]


FAULTS: dict[str, Callable[[Proxy], None]] = {
    "cut": Proxy.cut,
    "reset": Proxy.reset,
    "cut before COMMIT": lambda proxy: proxy.cut_before(b"COMMIT"),
    "reply to COMMIT lost": lambda proxy: proxy.swallow_reply_to(b"COMMIT"),
    "cut before COPY": lambda proxy: proxy.cut_before(b"COPY"),
    "reply to COPY lost": lambda proxy: proxy.swallow_reply_to(b"COPY"),
    "cut inside": lambda proxy: proxy.cut_after_bytes(random.randrange(1, 60_000)),
}


@pytest.mark.soak_on("reset", "cut before COPY", "reply to COPY lost")
@pytest.mark.parametrize("fault", FAULTS)
async def test_a_connection_that_fails_repeatedly_costs_no_event(fault: str, proxy: Proxy, direct_url: str) -> None:
    records = records_of_three_episodes(random.Random(7), 1500)
    happened = 0

    async def again_and_again(drain: Drain) -> None:
        nonlocal happened
        rng = random.Random(11)
        while drain.state.appended < len(records) and happened < 6:
            before, seen = drain.state.retries, proxy.faults
            FAULTS[fault](proxy)
            while drain.state.retries == before and drain.state.appended < len(records):
                if fault in ("cut", "reset"):
                    FAULTS[fault](proxy)
                await asyncio.sleep(rng.uniform(0, 0.01))
            happened += drain.state.retries > before or proxy.faults > seen

    drain, source = await drained(url_through_proxy(proxy, direct_url), records, again_and_again)
    assert drain.state.retries > 0
    assert happened > 0
    verify_stored_once(direct_url, records, drain, source)


async def test_a_batch_cut_at_any_byte_is_stored_whole_or_not_at_all(proxy: Proxy, direct_url: str) -> None:
    address = url_through_proxy(proxy, direct_url)
    log = await EventLog.open(address, create=True)
    stored_events = 0
    for count in [*range(1, 400, 13), *range(400, 16_000, 397)]:
        batch = [
            each._replace(sequence=each.sequence + stored_events, position=each.position + stored_events)
            for each in run_of(episode(1), 1, 60)
        ]
        proxy.cut_after_bytes(count)
        with contextlib.suppress(DatabaseUnavailable):
            assert await log.append(batch) == {}
        [[(head,)], numbers] = ask_each(direct_url, (HEAD, "SELECT count(*), coalesce(max(sequence), 0) FROM event"))
        assert head in (stored_events, stored_events + 60)
        assert numbers == [(head, head)]
        stored_events = head
    assert stored_events > 0
    assert proxy.faults > 20
    await log.close()


async def test_a_silent_connection_is_closed_and_the_batch_is_sent_through_another(
    proxy: Proxy, direct_url: str, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setattr(postgresql_engine, "ANSWER_S_MAX", 0.5)
    records = records_of_three_episodes(random.Random(13), 1000)

    async def silent(drain: Drain) -> None:
        proxy.stall()
        await until(lambda: drain.state.retries >= 2)
        assert drain.state.unavailable is not None
        proxy.reset()
        proxy.flow()

    drain, source = await drained(url_through_proxy(proxy, direct_url), records, silent)
    verify_stored_once(direct_url, records, drain, source)


async def test_the_server_probes_a_machine_that_goes_silent_in_the_middle_of_a_statement(
    direct_url: str,
) -> None:
    # Their values are those of the operating system, which has none for the socket of these tests.
    query = "SELECT name FROM pg_settings WHERE source = 'session' AND name LIKE 'tcp%' ORDER BY name"
    log = await EventLog.open(DatabaseAddress.parse(direct_url), create=True)
    async with log.engine.connect() as connection:
        names = list((await connection.execute(text(query))).scalars())
    await log.close()
    assert names == sorted(postgresql_engine._VANISHED)
    idle, interval, count, timeout_ms = map(int, postgresql_engine._VANISHED.values())
    assert 5 <= idle + interval * count <= 30  # seconds until the server ends the session and releases its locks
    assert timeout_ms <= 30_000


# --- the server itself ------------------------------------------------------------------------------------------


@pytest.mark.parametrize("what", ["pg_terminate_backend", "pg_cancel_backend"])
async def test_an_administrator_who_ends_sessions_or_statements_costs_no_event(what: str, direct_url: str) -> None:
    records = records_of_three_episodes(random.Random(16), 6000)

    async def ending(drain: Drain) -> None:
        sessions = "pg_stat_activity WHERE application_name = 'pycrorm' AND datname = current_database()"
        statement = f"SELECT {what}(pid) FROM {sessions}"
        pause_s = 0.05
        while drain.state.appended < len(records):
            await asyncio.to_thread(ask, direct_url, statement)
            await asyncio.sleep(pause_s)
            pause_s *= 1.1  # on a busy machine a batch may take longer than any fixed pause

    drain, source = await drained(DatabaseAddress.parse(direct_url), records, ending)
    verify_stored_once(direct_url, records, drain, source)
