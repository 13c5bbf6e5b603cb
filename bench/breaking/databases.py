"""Faults of the database and of the connection: lost replies, cut connections, killed servers, cancelled appends."""

from __future__ import annotations

import asyncio
import contextlib
import random
import sqlite3
import subprocess
import tempfile
import time
from collections.abc import Callable, Sequence
from pathlib import Path
from urllib.parse import urlsplit

import asyncpg

from bench.breaking.files import small_disk
from bench.breaking.outcome import Event, Outcome, Step
from pycrorm_async.errors import DatabaseUnavailable
from pycrorm_async.events.codec import Record
from pycrorm_async.events.ids import episode_text
from pycrorm_async.settings import Settings
from pycrorm_async.store.address import DatabaseAddress
from pycrorm_async.store.log import EventLog
from pycrorm_async.testing.postgresql_proxy import Proxy, proxy_before
from pycrorm_async.writer.drain import Backoff, Drain
from tests.databases import Server, ask
from tests.store.factories import episode, run_of
from tests.store.faults import cancel_at_await
from tests.writer.fakes import KeptSource

__all__ = [
    "lost_replies",
    "cut_connections",
    "ended_servers",
    "start_again",
    "locked_files",
    "full_disks",
    "cancelled_appends",
]

_SHORT_BACKOFF = Backoff(first_s=0.002, longest_s=0.02)
_BATCH = 100
_PAGE = 4096
_STORED = (
    "SELECT id, sequence, payload FROM event JOIN episode ON number = event.episode ORDER BY episode.number, sequence"
)


def _events(records: Sequence[Record]) -> list[Event]:
    return [
        (episode_text(each.episode), each.sequence, each.payload.decode())
        for each in records
        if each.episode is not None
    ]


def _stored_events(url: str) -> list[Event]:
    return [(name, sequence, payload) for name, sequence, payload in ask(url, _STORED)]


def _interleaved(batches: int) -> list[Record]:
    """Return records in batches; each batch holds events of two episodes."""
    half = _BATCH // 2
    records: list[Record] = []
    for first in range(1, batches * half + 1, half):
        for number in (1, 2):
            records += run_of(episode(number), first, first + half - 1, position=len(records) + 1)
    return records


def _compare(outcome: Outcome, rounds: int, records: list[Record], url: str) -> None:
    outcome.compare(_events(records), _stored_events(url))
    outcome.rounds += rounds - 1


def lost_replies(server: Server) -> Callable[[int, random.Random, Path, Step], Outcome]:
    """Execute each COMMIT, drop its reply, and append the same batch again."""

    async def append_all(rounds: int, step: Step, url: str, records: list[Record]) -> None:
        async with proxy_before(server.folder) as proxy:
            log = await EventLog.open(_through(proxy, url), create=True)
            for first in range(0, rounds * _BATCH, _BATCH):
                proxy.swallow_reply_to(b"COMMIT")
                with contextlib.suppress(DatabaseUnavailable):
                    await log.append(records[first : first + _BATCH])
                await log.append(records[first : first + _BATCH])
                step()
            assert proxy.faults == rounds
            await log.close()

    def run(rounds: int, rng: random.Random, folder: Path, step: Step) -> Outcome:
        del rng, folder
        outcome, url, records = Outcome(note="PostgreSQL behind a proxy"), server.new_database(), _interleaved(rounds)
        asyncio.run(append_all(rounds, step, url, records))
        _compare(outcome, rounds, records, url)
        return outcome

    return run


def cut_connections(server: Server) -> Callable[[int, random.Random, Path, Step], Outcome]:
    """Close or reset a writer's connection repeatedly, at once or after a random number of bytes."""

    async def drain_all(rounds: int, rng: random.Random, step: Step, url: str, records: list[Record]) -> None:
        async with proxy_before(server.folder) as proxy:
            log = await EventLog.open(_through(proxy, url), create=True, busy_timeout_s=2.0)
            source = KeptSource(records, closed=True)
            settings = Settings(batch_events_max=_BATCH)
            drain = Drain(source, log.append, settings=settings, backoff=_SHORT_BACKOFF)
            running = asyncio.create_task(drain.run())
            for _ in range(rounds):
                retries = drain.state.retries
                rng.choice((proxy.cut, proxy.reset, lambda: proxy.cut_after_bytes(rng.randrange(1, 40_000))))()
                while drain.state.retries == retries and not running.done():  # noqa: ASYNC110
                    await asyncio.sleep(0.001)
                step()
            await running
            await log.close()

    def run(rounds: int, rng: random.Random, folder: Path, step: Step) -> Outcome:
        del folder
        outcome, url = Outcome(note="PostgreSQL behind a proxy"), server.new_database()
        records = _interleaved(rounds * 4)
        asyncio.run(drain_all(rounds, rng, step, url, records))
        _compare(outcome, rounds, records, url)
        return outcome

    return run


def start_again(server: Server) -> None:
    """Start the server and wait until it answers.

    On a busy machine the start takes longer than the ten seconds that `Server.start` waits, and its assertion that the
    server is ready fails; therefore it is repeated.
    """
    deadline = time.monotonic() + 300
    while True:
        try:
            server.start()
            ask(server.url(), "SELECT 1")
        except (AssertionError, OSError, subprocess.SubprocessError, asyncpg.PostgresError):
            if time.monotonic() > deadline:
                raise
            time.sleep(0.2)
        else:
            return


def ended_servers(server: Server, *, killed: bool) -> Callable[[int, random.Random, Path, Step], Outcome]:
    """Kill all processes of the server, or stop it for a while, while a writer appends; then start it again."""

    async def drain_all(rounds: int, rng: random.Random, step: Step, url: str, records: list[Record]) -> int:
        log = await EventLog.open(DatabaseAddress.parse(url), create=True, busy_timeout_s=2.0)
        source = KeptSource(records, closed=True)
        drain = Drain(source, log.append, settings=Settings(batch_events_max=_BATCH), backoff=_SHORT_BACKOFF)
        running = asyncio.create_task(drain.run())
        missing = 0
        for round_ in range(1, rounds + 1):
            while drain.state.appended < round_ * len(records) // (rounds + 1):  # noqa: ASYNC110
                await asyncio.sleep(0.001)
            await asyncio.sleep(rng.random() * 0.02)
            await asyncio.to_thread(server.kill if killed else server.stop)
            acknowledged = drain.state.acknowledged
            await asyncio.sleep(0.0 if killed else rng.random() * 0.3)
            await asyncio.to_thread(start_again, server)
            [[count]] = await asyncio.to_thread(ask, url, "SELECT count(*) FROM event")
            missing += max(0, acknowledged - count)
            step()
        await running
        await log.close()
        return missing

    def run(rounds: int, rng: random.Random, folder: Path, step: Step) -> Outcome:
        del folder
        url, records = server.new_database(), _interleaved(rounds * 40)
        outcome = Outcome(
            note="PostgreSQL: SIGKILL of all server processes" if killed else "PostgreSQL: immediate shutdown"
        )
        outcome.lost += asyncio.run(drain_all(rounds, rng, step, url, records))
        _compare(outcome, rounds, records, url)
        return outcome

    return run


def locked_files(rounds: int, rng: random.Random, folder: Path, step: Step) -> Outcome:
    """Lock the SQLite file from another connection, repeatedly, for longer than a writer waits."""
    outcome = Outcome(note="SQLite: BEGIN EXCLUSIVE by another connection")
    url, records = f"sqlite:///{folder}/memory.db", _interleaved(rounds * 4)

    async def drain_all() -> None:
        log = await EventLog.open(DatabaseAddress.parse(url), create=True, busy_timeout_s=0.005)
        drain = Drain(
            KeptSource(records, closed=True),
            log.append,
            settings=Settings(batch_events_max=_BATCH),
            backoff=_SHORT_BACKOFF,
        )
        other = sqlite3.connect(folder / "memory.db", isolation_level=None, timeout=300, check_same_thread=False)
        running = None
        for _ in range(rounds):
            # Execute it in a thread: the writer may hold the lock, and it needs this loop to release it.
            await asyncio.to_thread(other.execute, "BEGIN EXCLUSIVE")
            running = running or asyncio.create_task(drain.run())
            retries = drain.state.retries
            while drain.state.retries == retries and not running.done():  # noqa: ASYNC110
                await asyncio.sleep(0.001)
            other.execute("ROLLBACK")
            appended = drain.state.appended
            while drain.state.appended < appended + rng.randrange(5) and not running.done():  # noqa: ASYNC110
                await asyncio.sleep(0)
            step()
        assert running is not None
        await running
        other.close()
        await log.close()

    asyncio.run(drain_all())
    _compare(outcome, rounds, records, url)
    return outcome


def full_disks(rounds: int, rng: random.Random, folder: Path, step: Step) -> Outcome:
    """Fill the disk of the database and free it again, while a writer appends."""
    outcome = Outcome(note="SQLite on a tmpfs that another file fills")
    url, records = f"sqlite:///{folder}/disk/memory.db", _interleaved(rounds * 4)
    size = 2**21 + 2 * sum(len(each.payload) + 200 for each in records)

    async def drain_all() -> None:
        log = await EventLog.open(DatabaseAddress.parse(url), create=True)
        drain = Drain(
            KeptSource(records, closed=True),
            log.append,
            settings=Settings(batch_events_max=_BATCH),
            backoff=_SHORT_BACKOFF,
        )
        running = None
        ballast = folder / "disk" / "ballast"
        for _ in range(rounds):
            with contextlib.suppress(OSError), ballast.open("wb", buffering=0) as file:
                while file.write(bytes(_PAGE)) == _PAGE:
                    pass
            running = running or asyncio.create_task(drain.run())
            retries = drain.state.retries
            while drain.state.retries == retries and not running.done():  # noqa: ASYNC110
                await asyncio.sleep(0.001)
            ballast.unlink()
            appended = drain.state.appended
            while drain.state.appended < appended + rng.randrange(5) and not running.done():  # noqa: ASYNC110
                await asyncio.sleep(0)
            step()
        assert running is not None
        await running
        await log.close()

    with small_disk(folder / "disk", f"{size}") as mounted:
        if not mounted:
            outcome.note = "skipped: no permission to mount a small disk"
            return outcome
        asyncio.run(drain_all())
        _compare(outcome, rounds, records, url)
    return outcome


def cancelled_appends(server: Server) -> Callable[[int, random.Random, Path, Step], Outcome]:
    """Cancel an append at its first await, its second, its third …, on SQLite and on PostgreSQL."""

    def run(rounds: int, rng: random.Random, folder: Path, step: Step) -> Outcome:
        del rng
        outcome = Outcome()
        awaits: list[int] = []
        while outcome.rounds < rounds:
            file = Path(tempfile.mkdtemp(dir=folder)) / "memory.db"
            urls = (f"sqlite:///{file}", server.new_database())
            awaits += [asyncio.run(_cancel_at_each_await(outcome, url, step)) for url in urls]
        outcome.note = f"{min(awaits)} to {max(awaits)} awaits each time; whole batches or nothing"
        return outcome

    return run


async def _cancel_at_each_await(outcome: Outcome, url: str, step: Step) -> int:
    log = await EventLog.open(DatabaseAddress.parse(url), create=True)
    stored = awaits = 0
    cancelled = True
    while cancelled:
        awaits += 1
        batch = run_of(episode(1), stored + 1, stored + _BATCH)
        appending = asyncio.create_task(log.append(batch))
        await cancel_at_await(appending, awaits)
        cancelled = appending.cancelled()
        head = (
            await log.append(batch[:1]) or (await log.episodes())[0].head
        )  # raises if the cancelled append still holds a lock
        stored += _BATCH if head == stored + _BATCH or not cancelled else 1
        outcome.compare(_events(run_of(episode(1), 1, stored)), _stored_events(url))
        step()
    await log.close()
    return awaits


def _through(proxy: Proxy, url: str) -> DatabaseAddress:
    return DatabaseAddress.parse(proxy.url(urlsplit(url).path.removeprefix("/")))
