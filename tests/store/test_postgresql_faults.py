"""Whatever happens to the way to PostgreSQL or to the server: every event is stored once and in order.

The oracle is what was put into the source; it is compared with what a connection of its own finds in the end.
"""

from __future__ import annotations

import asyncio
import contextlib
import random
from collections.abc import AsyncIterator, Callable, Coroutine, Iterator
from typing import Any
from urllib.parse import urlsplit

import pytest
from sqlalchemy import text

from pycrorm_async.errors import DatabaseUnavailable
from pycrorm_async.events.envelope import Record
from pycrorm_async.settings import Settings
from pycrorm_async.store.address import DatabaseAddress
from pycrorm_async.store.log import EventLog
from pycrorm_async.store.postgresql import engine
from pycrorm_async.testing.postgresql_proxy import Proxy, proxy_before
from pycrorm_async.writer.drain import Drain
from pycrorm_async.writer.retry import Backoff
from tests.databases import Server, ask, server_in_memory
from tests.store.factories import declaration, episode, run_of
from tests.writer.fakes import KeptSource

pytestmark = pytest.mark.slow

SETTINGS = Settings(batch_events_max=250)
QUICKLY = Backoff(first_s=0.005, longest_s=0.05)
EVENTS = (
    "SELECT id, sequence, type, version, wall_ns, event.monotonic_ns, payload FROM event"
    " JOIN episode ON number = event.episode ORDER BY id, sequence"
)


def made(rng: random.Random, events: int) -> list[Record]:
    """Records of three episodes, mixed, with a declaration now and then."""
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
    """Waits for what no event tells."""
    while not condition():  # noqa: ASYNC110
        await asyncio.sleep(0.001)


@pytest.fixture
def direct(server: Server) -> str:
    """The database's own URL, without a proxy."""
    return server.new_database()


@pytest.fixture
async def proxy(server: Server) -> AsyncIterator[Proxy]:
    async with proxy_before(server.folder) as between:
        yield between


def through(proxy: Proxy, direct: str) -> DatabaseAddress:
    return DatabaseAddress.parse(proxy.url(urlsplit(direct).path.removeprefix("/"), password="s3cr"))


async def drained(
    address: DatabaseAddress, records: list[Record], meanwhile: Callable[[Drain], Coroutine[Any, Any, None]]
) -> tuple[Drain, KeptSource]:
    """Drains all of it while something else happens; told of nothing but a database that is away."""
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


def proved(direct: str, records: list[Record], drain: Drain, source: KeptSource) -> None:
    assert stored(direct) == expected(records)
    assert source.kept == []
    state = drain.state
    assert (state.appended, state.acknowledged, state.refused, state.away) == (len(records), len(records), {}, None)
    assert "s3cr" not in (state.last_error or "")
    heads = ask(direct, "SELECT head FROM episode ORDER BY id")
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


@pytest.mark.parametrize("fault", FAULTS)
async def test_a_connection_that_fails_again_and_again_costs_nothing(fault: str, proxy: Proxy, direct: str) -> None:
    records = made(random.Random(7), 3000)
    happened = 0

    async def again_and_again(drain: Drain) -> None:
        nonlocal happened
        rng = random.Random(11)
        while drain.state.appended < len(records) and happened < 12:
            before, seen = drain.state.retries, proxy.faults
            FAULTS[fault](proxy)
            while drain.state.retries == before and drain.state.appended < len(records):
                if fault in ("cut", "reset"):
                    FAULTS[fault](proxy)
                await asyncio.sleep(rng.uniform(0, 0.01))
            happened += drain.state.retries > before or proxy.faults > seen

    drain, source = await drained(through(proxy, direct), records, again_and_again)
    assert drain.state.retries > 0
    assert happened > 0
    proved(direct, records, drain, source)


async def test_a_lost_reply_to_every_single_commit_stores_everything_once(proxy: Proxy, direct: str) -> None:
    records = made(random.Random(8), 1500)
    address = through(proxy, direct)
    log = await EventLog.open(address, create=True)
    for first in range(0, len(records), 100):
        proxy.swallow_reply_to(b"COMMIT")
        with pytest.raises(DatabaseUnavailable):
            await log.append(records[first : first + 100])
        # It was done, and is done once.
        assert stored(direct) == expected(records[: first + 100])
        assert await log.append(records[first : first + 100]) == {}
    await log.close()
    assert proxy.faults == 15
    assert stored(direct) == expected(records)


async def test_a_batch_cut_at_any_byte_is_stored_whole_or_not_at_all(proxy: Proxy, direct: str) -> None:
    address = through(proxy, direct)
    log = await EventLog.open(address, create=True)
    known = 0
    for count in [*range(1, 400, 13), *range(400, 16_000, 397)]:
        batch = [
            each._replace(sequence=each.sequence + known, position=each.position + known)
            for each in run_of(episode(1), 1, 60)
        ]
        proxy.cut_after_bytes(count)
        with contextlib.suppress(DatabaseUnavailable):
            assert await log.append(batch) == {}
        [[head]] = ask(direct, "SELECT coalesce(max(head), 0) FROM episode")
        assert head in (known, known + 60)
        assert ask(direct, "SELECT count(*), coalesce(max(sequence), 0) FROM event") == [(head, head)]
        known = head
    assert known > 0
    assert proxy.faults > 20
    await log.close()


async def test_a_dribbling_connection_stores_everything(proxy: Proxy, direct: str) -> None:
    proxy.dribble(64)
    records = made(random.Random(10), 1000)

    async def nothing(_: Drain) -> None:
        return

    drain, source = await drained(through(proxy, direct), records, nothing)
    assert drain.state.retries == 0
    proved(direct, records, drain, source)


async def test_a_server_that_refuses_every_connection_is_away_until_it_takes_one(proxy: Proxy, direct: str) -> None:
    records = made(random.Random(12), 1000)

    async def refusing(drain: Drain) -> None:
        proxy.refuse()
        proxy.cut()
        await until(lambda: drain.state.retries >= 5)
        assert drain.state.away is not None
        proxy.refuse(refusing=False)

    drain, source = await drained(through(proxy, direct), records, refusing)
    proved(direct, records, drain, source)


async def test_a_connection_that_goes_silent_is_given_up_and_the_batch_goes_through_another(
    proxy: Proxy, direct: str, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setattr(engine, "ANSWER_S_MAX", 0.5)
    records = made(random.Random(13), 1000)

    async def silent(drain: Drain) -> None:
        proxy.stall()
        await until(lambda: drain.state.retries >= 2)
        assert drain.state.away is not None
        proxy.reset()
        proxy.flow()

    drain, source = await drained(through(proxy, direct), records, silent)
    proved(direct, records, drain, source)


async def test_the_server_asks_after_a_machine_that_says_nothing_any_more_in_the_middle_of_a_statement(
    direct: str,
) -> None:
    asked = "SELECT name, reset_val::int FROM pg_settings WHERE source = 'client' AND name LIKE 'tcp%' ORDER BY name"
    log = await EventLog.open(DatabaseAddress.parse(direct), create=True)
    async with log.engine.connect() as connection:
        answer = {row.name: row.reset_val for row in await connection.execute(text(asked))}
    await log.close()
    idle, interval, count = (answer[f"tcp_keepalives_{each}"] for each in ("idle", "interval", "count"))
    assert 5 <= idle + interval * count <= 30  # seconds until a silent machine is given up, and its locks
    assert answer["tcp_user_timeout"] <= 30_000


# --- the server itself ------------------------------------------------------------------------------------------


@pytest.fixture
def own_server() -> Iterator[Server]:
    """A server to be killed."""
    with server_in_memory() as running:
        yield running


async def test_a_server_killed_under_load_again_and_again_has_everything_once_in_the_end(own_server: Server) -> None:
    url = own_server.new_database()
    records = made(random.Random(14), 20_000)
    rng = random.Random(15)

    async def killing(drain: Drain) -> None:
        for round_ in range(1, 5):
            enough = round_ * 4000
            await until(lambda: drain.state.appended >= enough)  # noqa: B023  awaited at once
            await asyncio.sleep(rng.uniform(0, 0.02))
            await asyncio.to_thread(own_server.kill)
            await until(lambda: drain.state.away is not None or drain.state.appended == len(records))
            acknowledged = drain.state.acknowledged
            await asyncio.to_thread(own_server.start)
            # What was acknowledged before the server died is there when it is back.
            [[count]] = await asyncio.to_thread(ask, url, "SELECT count(*) FROM event")
            assert count >= sum(each.episode is not None for each in records[:acknowledged])

    drain, source = await drained(DatabaseAddress.parse(url), records, killing)
    assert drain.state.retries >= 3
    proved(url, records, drain, source)


@pytest.mark.parametrize("what", ["pg_terminate_backend", "pg_cancel_backend"])
async def test_an_administrator_who_ends_sessions_or_statements_costs_nothing(what: str, direct: str) -> None:
    records = made(random.Random(16), 6000)

    async def ending(drain: Drain) -> None:
        sessions = "pg_stat_activity WHERE application_name = 'pycrorm' AND datname = current_database()"
        statement = f"SELECT {what}(pid) FROM {sessions}"
        while drain.state.appended < len(records):
            await asyncio.to_thread(ask, direct, statement)
            await asyncio.sleep(0.05)

    drain, source = await drained(DatabaseAddress.parse(direct), records, ending)
    proved(direct, records, drain, source)


async def test_an_append_cancelled_at_each_of_its_awaits_leaves_a_whole_batch_or_nothing_and_no_lock(
    direct: str,
) -> None:
    known = at = 0
    address = DatabaseAddress.parse(direct)
    while True:
        at += 1
        log = await EventLog.open(address, create=True, busy_timeout_s=2.0)
        appending = asyncio.create_task(log.append(run_of(episode(1), known + 1, known + 30)))
        awaited: list[object] = []
        while len(awaited) < at and not appending.done():
            waiter = getattr(appending, "_fut_waiter", None)
            if waiter is not None and waiter not in awaited[-1:]:
                awaited.append(waiter)
            await asyncio.sleep(0)
        appending.cancel()
        await asyncio.wait([appending])
        [[head]] = ask(direct, "SELECT coalesce(max(head), 0) FROM episode")
        assert head in (known, known + 30)
        assert ask(direct, "SELECT count(*) FROM event") == [(head,)]
        known = head
        second = await EventLog.open(address, create=True, busy_timeout_s=2.0)
        assert await second.append(run_of(episode(1), known + 1, known + 1)) == {}  # nobody holds its row
        known += 1
        await second.close()
        await log.close()
        if not appending.cancelled():
            break
    assert at > 10
