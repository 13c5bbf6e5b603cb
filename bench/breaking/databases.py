"""The database and the way to it: lost replies, cut connections, a server killed under load, cancellation."""

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
from pycrorm_async.events.envelope import Record
from pycrorm_async.events.ids import episode_text
from pycrorm_async.settings import Settings
from pycrorm_async.store.address import DatabaseAddress
from pycrorm_async.store.log import EventLog
from pycrorm_async.testing.postgresql_proxy import Proxy, proxy_before
from pycrorm_async.writer.drain import Drain
from pycrorm_async.writer.retry import Backoff
from tests.databases import Server, ask
from tests.store.factories import episode, run_of
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

_QUICKLY = Backoff(first_s=0.002, longest_s=0.02)
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


def _found(url: str) -> list[Event]:
    return [(name, sequence, payload) for name, sequence, payload in ask(url, _STORED)]


def _interleaved(batches: int) -> list[Record]:
    """Batches of two episodes."""
    half = _BATCH // 2
    records: list[Record] = []
    for first in range(1, batches * half + 1, half):
        for number in (1, 2):
            records += run_of(episode(number), first, first + half - 1, position=len(records) + 1)
    return records


def _compared(outcome: Outcome, rounds: int, records: list[Record], url: str) -> None:
    outcome.compare(_events(records), _found(url))
    outcome.rounds += rounds - 1


def lost_replies(server: Server) -> Callable[[int, random.Random, Path, Step], Outcome]:
    """Every COMMIT is done, and its reply is lost; then the batch is appended again."""

    async def swallowed(rounds: int, step: Step, url: str, records: list[Record]) -> None:
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
        asyncio.run(swallowed(rounds, step, url, records))
        _compared(outcome, rounds, records, url)
        return outcome

    return run


def cut_connections(server: Server) -> Callable[[int, random.Random, Path, Step], Outcome]:
    """A writer's connection ends after a random number of bytes, is reset or closed, again and again."""

    async def drained(rounds: int, rng: random.Random, step: Step, url: str, records: list[Record]) -> None:
        async with proxy_before(server.folder) as proxy:
            log = await EventLog.open(_through(proxy, url), create=True, busy_timeout_s=2.0)
            source = KeptSource(records, closed=True)
            settings = Settings(batch_events_max=_BATCH)
            drain = Drain(source, log.append, settings=settings, backoff=_QUICKLY)
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
        asyncio.run(drained(rounds, rng, step, url, records))
        _compared(outcome, rounds, records, url)
        return outcome

    return run


def start_again(server: Server) -> None:
    """Until it answers: on a busy machine that may be after the patience of the command that starts it.

    That gives up after ten seconds, and asserts that a server which is there is ready.
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
    """The server ends while a writer appends, and comes back: killed with all its processes, or stopped for a while."""

    async def drained(rounds: int, rng: random.Random, step: Step, url: str, records: list[Record]) -> int:
        log = await EventLog.open(DatabaseAddress.parse(url), create=True, busy_timeout_s=2.0)
        source = KeptSource(records, closed=True)
        drain = Drain(source, log.append, settings=Settings(batch_events_max=_BATCH), backoff=_QUICKLY)
        running = asyncio.create_task(drain.run())
        forgotten = 0
        for round_ in range(1, rounds + 1):
            while drain.state.appended < round_ * len(records) // (rounds + 1):  # noqa: ASYNC110
                await asyncio.sleep(0.001)
            await asyncio.sleep(rng.random() * 0.02)
            await asyncio.to_thread(server.kill if killed else server.stop)
            acknowledged = drain.state.acknowledged
            await asyncio.sleep(0.0 if killed else rng.random() * 0.3)
            await asyncio.to_thread(start_again, server)
            [[count]] = await asyncio.to_thread(ask, url, "SELECT count(*) FROM event")
            forgotten += max(0, acknowledged - count)
            step()
        await running
        await log.close()
        return forgotten

    def run(rounds: int, rng: random.Random, folder: Path, step: Step) -> Outcome:
        del folder
        url, records = server.new_database(), _interleaved(rounds * 40)
        outcome = Outcome(
            note="PostgreSQL: SIGKILL of every process of it" if killed else "PostgreSQL: stopped at once"
        )
        outcome.lost += asyncio.run(drained(rounds, rng, step, url, records))
        _compared(outcome, rounds, records, url)
        return outcome

    return run


def locked_files(rounds: int, rng: random.Random, folder: Path, step: Step) -> Outcome:
    """Another program holds the lock of the SQLite file for longer than a writer waits, again and again."""
    outcome = Outcome(note="SQLite: BEGIN EXCLUSIVE by another connection")
    url, records = f"sqlite:///{folder}/memory.db", _interleaved(rounds * 4)

    async def drained() -> None:
        log = await EventLog.open(DatabaseAddress.parse(url), create=True, busy_timeout_s=0.005)
        drain = Drain(
            KeptSource(records, closed=True),
            log.append,
            settings=Settings(batch_events_max=_BATCH),
            backoff=_QUICKLY,
        )
        other = sqlite3.connect(folder / "memory.db", isolation_level=None, timeout=300, check_same_thread=False)
        running = None
        for _ in range(rounds):
            # In a thread: who holds the lock meanwhile needs this loop to let go of it.
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

    asyncio.run(drained())
    _compared(outcome, rounds, records, url)
    return outcome


def full_disks(rounds: int, rng: random.Random, folder: Path, step: Step) -> Outcome:
    """The disk that holds the database is full, and has room again, while a writer appends."""
    outcome = Outcome(note="SQLite on a tmpfs that another file fills")
    url, records = f"sqlite:///{folder}/disk/memory.db", _interleaved(rounds * 4)
    size = 2**21 + 2 * sum(len(each.payload) + 200 for each in records)

    async def drained() -> None:
        log = await EventLog.open(DatabaseAddress.parse(url), create=True)
        drain = Drain(
            KeptSource(records, closed=True),
            log.append,
            settings=Settings(batch_events_max=_BATCH),
            backoff=_QUICKLY,
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
            outcome.note = "not made: there is no right to mount a small disk here"
            return outcome
        asyncio.run(drained())
        _compared(outcome, rounds, records, url)
    return outcome


def cancelled_appends(server: Server) -> Callable[[int, random.Random, Path, Step], Outcome]:
    """An append is cancelled at its first await, its second, its third …, on SQLite and on PostgreSQL."""

    def run(rounds: int, rng: random.Random, folder: Path, step: Step) -> Outcome:
        del rng
        outcome = Outcome()
        awaits: list[int] = []
        while outcome.rounds < rounds:
            file = Path(tempfile.mkdtemp(dir=folder)) / "memory.db"
            urls = (f"sqlite:///{file}", server.new_database())
            awaits += [asyncio.run(_cancelled_everywhere(outcome, url, step)) for url in urls]
        outcome.note = f"{min(awaits)} to {max(awaits)} awaits each time; whole batches or nothing"
        return outcome

    return run


async def _cancelled_everywhere(outcome: Outcome, url: str, step: Step) -> int:
    log = await EventLog.open(DatabaseAddress.parse(url), create=True)
    known = at = 0
    cancelled = True
    while cancelled:
        at += 1
        batch = run_of(episode(1), known + 1, known + _BATCH)
        appending = asyncio.create_task(log.append(batch))
        awaited: list[object] = []
        while len(awaited) < at and not appending.done():
            waiter = getattr(appending, "_fut_waiter", None)
            if waiter is not None and waiter not in awaited[-1:]:
                awaited.append(waiter)
            await asyncio.sleep(0)
        appending.cancel()
        await asyncio.wait([appending])
        cancelled = appending.cancelled()
        head = await log.append(batch[:1]) or (await log.episodes())[0].head  # nobody holds what it needs
        known += _BATCH if head == known + _BATCH or not cancelled else 1
        outcome.compare(_events(run_of(episode(1), 1, known)), _found(url))
        step()
    await log.close()
    return at


def _through(proxy: Proxy, url: str) -> DatabaseAddress:
    return DatabaseAddress.parse(proxy.url(urlsplit(url).path.removeprefix("/")))
