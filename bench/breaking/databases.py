"""Faults of the database and of the connection, and hostile declarations of other programs in the log."""

from __future__ import annotations

import asyncio
import contextlib
import random
import sqlite3
import string
import subprocess
import tempfile
import time
from collections.abc import Callable, Iterator, Sequence
from pathlib import Path
from typing import Any
from urllib.parse import urlsplit

import asyncpg
import msgspec

from bench.breaking.outcome import Event, Outcome, Step
from pycrorm_async.errors import DatabaseUnavailable
from pycrorm_async.events.codec import Record, declaration_of, encode, fingerprint
from pycrorm_async.events.fields import column_name, table_name
from pycrorm_async.events.ids import episode_text
from pycrorm_async.events.types import (
    DesignatorTypeDeclared,
    EpisodeEnded,
    EpisodeStarted,
    FieldDeclared,
    NodeEnded,
    NodeStarted,
)
from pycrorm_async.operations.rebuild import rebuild_memory
from pycrorm_async.projections.projector import Projector
from pycrorm_async.projections.verify import verify
from pycrorm_async.settings import Settings
from pycrorm_async.store.address import DatabaseAddress
from pycrorm_async.store.log import EventLog
from pycrorm_async.testing.postgresql_proxy import Proxy, proxy_before
from pycrorm_async.writer.drain import Backoff, Drain
from tests.crash.disk_machine import small_disk
from tests.databases import Server, ask
from tests.projections.event_script import T0_NS, Script
from tests.store.factories import cancel_at_await, episode, run_of
from tests.writer.fakes import KeptSource

# === databases ================================================================================================
#
# Faults of the database and of the connection: lost replies, cut connections, killed servers, cancelled appends.

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


# === declarations =============================================================================================
#
# Append declarations of other programs to the log: valid types among hostile ones.

_NAMES = "xmin xmax cmin cmax ctid tableoid true FALSE select order rowid oid null user größe".split()
_CRAFTED = (
    *"ID pose object node metadata dtype x%s a:b a.b '' \" _hidden __init__ pose__7".split(),
    "a\0b",
    "x" * 5_000,
    "",
    " ",
)
_DTYPES = ("Pose", "Pose__7", "Evil Action", "E" * 400, "PickUpAction", "a\0b", "", "SimulatedEpisode")
_NO_DECLARATIONS = (b"[]", b"{", b"5", b'{"kind":"action"}', b'"\\u0000"', b"no JSON")


def foreign_declarations(new: Callable[[Path], str]) -> Callable[[int, random.Random, Path, Step], Outcome]:
    """Fill one memory a round; the events of valid types must be in its tables, after live folding and a rebuild."""

    def run(rounds: int, rng: random.Random, folder: Path, step: Step) -> Outcome:
        outcome = Outcome()
        parked = 0
        for number in range(rounds):
            place = folder / str(number)
            place.mkdir()
            parked += asyncio.run(_round(new(place), rng, outcome))
            step()
        outcome.note = f"{parked} episodes of hostile types parked with a reason"
        return outcome

    return run


async def _round(url: str, rng: random.Random, outcome: Outcome) -> int:
    """Append episodes of valid and hostile types in random order; return the number of parked episodes."""
    valid = [*_valid(rng)]
    episodes = [*valid, *_hostile(rng, valid)]
    rng.shuffle(episodes)
    log = await EventLog.open(DatabaseAddress.parse(url), create=True)
    try:
        projector = Projector(log)
        await projector.open()
        await log.append([*map(_declared, rng.sample(valid, len(valid)))])
        expected: list[Event] = []
        remaining = [*enumerate(episodes, 1)]
        while remaining:
            count = rng.randint(3, 12)
            chunk, remaining = remaining[:count], remaining[count:]
            await log.append([each for number, payload in chunk for each in _episode(number, payload)])
            await projector.catch_up()
            expected += [_event(number, payload) for number, payload in chunk if payload in valid]
        parked = await _compare_and_verify(log, outcome, expected, valid)
        await rebuild_memory(url)
        rebuilt = await _compare_and_verify(log, outcome, expected, valid)
        assert rebuilt == parked, f"{parked} episodes are parked after live folding, {rebuilt} after the rebuild"
        outcome.rounds -= 1  # both comparisons belong to one round
        return parked
    finally:
        await log.close()


async def _compare_and_verify(log: EventLog, outcome: Outcome, expected: list[Event], valid: list[bytes]) -> int:
    """Compare the rows of valid types, and verify the memory; return the number of parked episodes."""
    outcome.compare(expected, await asyncio.to_thread(_rows, str(log.address.to_type), valid))
    result = await verify(log)
    assert (result.damage, result.drift) == (0, 0), f"{result.damages[:1]} {result.differences[:1]}"
    assert all(each.reason for each in result.stopped)
    return len(result.stopped)


def _event(number: int, payload: bytes) -> Event:
    """Return the row that the tables must contain for the only node of this episode."""
    script = Script(number)
    return episode_text(script.episode), 1, f"{len(_columns(payload))} values {number}"


def _rows(url: str, valid: list[bytes]) -> list[Event]:
    events: list[Event] = []
    for payload in valid:
        declaration = declaration_of(payload)
        columns = ", ".join(f'leaf."{each}"' for each in _columns(payload))
        rows = ask(
            url,
            f'SELECT uuid, {columns} FROM "{declaration.table}" AS leaf JOIN designator ON designator.id = leaf.id'
            " JOIN process_metadata ON process_metadata.id = designator.process_metadata_id"
            f" WHERE dtype = '{declaration.dtype}'",
        )
        for uuid, *values in rows:
            text = str(values[0]) if len({*values}) == 1 else str(values)
            events.append((uuid, 1, f"{len(values)} values {text}"))
    return events


def _columns(payload: bytes) -> list[str]:
    return [each.column for each in declaration_of(payload).fields if each.type == "integer"]


def _valid(rng: random.Random) -> Iterator[bytes]:
    """Yield declarations as the hooks make them, also with names that are keywords of a database."""
    yield _payload(rng, "RootAction", ())
    for number in range(rng.randint(3, 6)):
        name = "".join(rng.choices(string.ascii_lowercase, k=rng.choice([3, 20, 44, 70, 200])))
        yield _payload(rng, f"{name.capitalize()}{number}Action", rng.choice([(), ("RootAction",)]))


def _payload(rng: random.Random, dtype: str, bases: tuple[str, ...]) -> bytes:
    names = {rng.choice(_NAMES) for _ in range(rng.randint(0, 3))} - {"true", "FALSE"} | {rng.choice(["true", "FALSE"])}
    names |= {rng.choice(["ä", "f"]) * rng.choice([1, 31, 59, 61, 63, 64, 120])}
    fields = [
        FieldDeclared(name, column_name(name, "integer"), "integer", slot) for slot, name in enumerate(sorted(names), 2)
    ]
    fields.append(FieldDeclared("container", "container_id", "object", len(fields) + 2))
    return encode(DesignatorTypeDeclared("action", dtype, table_name(dtype), bases=bases, fields=tuple(fields)))


def _hostile(rng: random.Random, valid: list[bytes]) -> Iterator[bytes]:
    """Yield declarations that the hooks would refuse."""
    field = {"name": "size", "column": "size", "type": "real", "slot": 2}
    for number in range(rng.randint(3, 8)):
        existing = msgspec.to_builtins(declaration_of(rng.choice(valid)))
        evil: dict[str, Any] = {"kind": "action", "dtype": f"Evil{number}Action", "table": f"evil{number}_action"}
        variants: list[dict[str, Any]] = [
            evil | {"fields": [field | dict.fromkeys(("name", "column"), rng.choice(_CRAFTED))]},
            evil | {"fields": [field | {"name": f"f{n}", "column": f"f{n}", "slot": n} for n in range(3_000)]},
            evil | {"fields": [field, field | {"name": "SIZE", "column": "SIZE", "slot": 3}]},
            evil | {"fields": [field | {"slot": rng.choice([-1, 0, 1, 32, 2**40])}]},
            evil | {"dtype": rng.choice(_DTYPES)},
            evil | {"table": rng.choice(["pose", "Task_Tree_Node", "pose__7", "pycrorm_log", "a\0", "", "t" * 99])},
            evil | {"bases": [f"Base{n}" for n in range(2_000)]},
            evil | {"table": rng.choice([existing["table"], existing["table"].upper()])},
            existing | {"kind": rng.choice(["motion", "language", "root"])},
            existing | {"fields": [each | {"type": "text"} for each in existing["fields"]]},
        ]
        yield rng.choice([*map(msgspec.json.encode, variants), rng.choice(_NO_DECLARATIONS)])


def _declared(payload: bytes) -> Record:
    return Record(1, None, 0, "DesignatorTypeDeclared", 1, T0_NS, 0, payload)


def _episode(number: int, payload: bytes) -> list[Record]:
    """Return the declaration, and an episode that performs this type once, with the number in every field."""
    script = Script(number)
    script.put(EpisodeStarted("foreign", "bench", "host", "1", "3.11"))
    try:
        parameters = {each.name: number for each in declaration_of(payload).fields if each.type == "integer"}
    except (ValueError, msgspec.DecodeError):
        parameters = {}
    node = script.put(NodeStarted("action", None, fingerprint(payload), parameters))
    script.put(NodeEnded(node, "SUCCEEDED"))
    script.put(EpisodeEnded("SUCCEEDED"))
    return [_declared(payload), *script.records]
