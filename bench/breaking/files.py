"""Faults of the queue's files: torn writes, flipped bits, crafted frames, power cuts, and all of them simulated."""

from __future__ import annotations

import asyncio
import contextlib
import random
import shutil
import tempfile
from collections.abc import Iterable, Mapping, Sequence
from contextlib import suppress
from pathlib import Path

from bench.breaking.outcome import Event, Outcome, Step
from pycrorm_async.clock import SYSTEM_CLOCK, Clock
from pycrorm_async.errors import (
    DatabaseUnavailable,
    PycrormError,
    SpoolDamaged,
    SpoolForeign,
    SpoolFull,
    SpoolUnavailable,
)
from pycrorm_async.events.codec import LOST, Heading, Record
from pycrorm_async.events.ids import EpisodeId, episode_id, episode_text
from pycrorm_async.operations.recovery import recover as recover_spool
from pycrorm_async.queue import RecorderQueue, Spool, open_dead
from pycrorm_async.queue.maintenance import RepairReport, inspect_spool, repair_folder
from pycrorm_async.settings import Settings
from pycrorm_async.store.address import DatabaseAddress
from pycrorm_async.store.log import EventLog
from pycrorm_async.writer.drain import Backoff, Drain
from tests.crash.disk_machine import (
    ON_A_SMALL_DISK,
    ROOMY,
    SLOW,
    Machine,
    break_next_sync,
    disk_of_256_kib,
    live_through_cuts,
    machine_on,
)
from tests.databases import ask
from tests.queue.factories import RECORDER, FolderWriter, drain, ended, episode, make, node, recover, started
from tests.queue.forged_segments import change_a_frame, change_the_header
from tests.writer.fakes import CountingFold, ForwardingDestination

# === files ====================================================================================================
#
# Faults of the queue's files and disk: torn writes, flipped bits, power cuts, failed syncs, full disks, clocks.


def events_of(records: Iterable[Record]) -> list[Event]:
    """Return the events of the records, without the `EpisodeEnded` events that recovery computes."""
    return [
        (episode_text(each.episode), each.sequence, each.payload.hex())
        for each in records
        if each.episode is not None and each.payload != LOST
    ]


def torn_writes(rounds: int, rng: random.Random, folder: Path, step: Step) -> Outcome:
    """Cut the unsynced bytes at every byte, and replace the rest with zeros, ones or noise."""
    outcome = Outcome(note="cut at every byte of three unsynced records; zeros, ones or noise behind the cut")
    author = FolderWriter(folder / "spool")
    author.put(started())
    for size in (6, 0, 33):
        author.put(node(), b"s" * size)
    author.sync()
    synced = len(author.records)
    first = author.end
    for size in (0, 1, 200):
        author.put(node(), rng.randbytes(size).hex().encode())
    path, content = author.segments[0], author.segments[0].read_bytes()
    cuts = range(first, author.end + 1)
    for cut in cuts[:: max(1, 3 * len(cuts) // rounds)]:
        for filling in (bytes(len(content) - cut), b"\xff" * (len(content) - cut), rng.randbytes(len(content) - cut)):
            path.write_bytes(content[:cut] + filling)
            complete = sum(offset + size <= cut for _, offset, size in author.places)
            expected = events_of(author.records[: max(synced, complete)])
            outcome.compare(expected, events_of(asyncio.run(recover(author.folder))), put=events_of(author.records))
            step()
    return outcome


def flipped_bits(rounds: int, rng: random.Random, folder: Path, step: Step) -> Outcome:
    """Flip each bit of a spool folder and repair it; every record must be read back or be reported as unreadable."""
    refused = 0
    outcome = Outcome()
    author = _journal(folder / "first", rng)
    bits = [
        (number, bit)
        for number, path in enumerate(author.segments)
        for bit in range(len(path.read_bytes().rstrip(b"\0")) * 8)
    ]
    for number, bit in bits[:: max(1, len(bits) // rounds)]:
        copy = folder / "copy" / author.folder.name
        shutil.copytree(author.folder, copy)
        path = copy / author.segments[number].name
        content = bytearray(path.read_bytes())
        content[bit // 8] ^= 1 << bit % 8
        path.write_bytes(content)
        reported: set[int] = set()
        try:
            report = repair_folder(copy)
        except SpoolForeign:  # the bit changed the format's number: the file is refused as one of a newer program
            refused += 1
        else:
            reported = _positions(report) if report is not None else reported
            records = asyncio.run(recover(copy))
            affected = _from_byte_on(author, author.segments[number], bit // 8)
            missing = events_of(each for each in affected if each.position in reported)
            outcome.compare(events_of(author.records), events_of(records), reported=missing)
        shutil.rmtree(copy.parent)
        step()
    outcome.note = (
        f"of {len(bits):,} bits; {refused} changed the format's number, and the file is refused without a change"
    )
    return outcome


def _journal(spool: Path, rng: random.Random) -> FolderWriter:
    author = FolderWriter(spool, settings=ROOMY)
    for number in (1, 2, 3):
        author.put(started(number))
    for _ in range(14):
        number = rng.choice((1, 2, 3))
        author.put(node(number), b"n" * rng.randrange(900))
        if rng.random() < 0.4:
            author.sync()
    author.put(ended(2))
    author.sync()
    return author


def _from_byte_on(author: FolderWriter, path: Path, byte: int) -> list[Record]:
    """Return the record that contains this byte and the later ones of its episode; only these may be missing."""
    for index, (file, offset, size) in enumerate(author.places):
        if file == path and offset <= byte < offset + size:
            hit = author.records[index]
            return [each for each in author.records[index:] if each.episode == hit.episode]
    return []


def _positions(report: RepairReport) -> set[int]:
    spans = [*report.unreadable, *(span for each in report.given_up for span in each.positions)]
    return {position for first, last in spans for position in range(first, last + 1)}


def power_cuts(rounds: int, rng: random.Random, folder: Path, step: Step) -> Outcome:
    """Cut the power of a simulated disk that keeps any subset of unsynced sectors; synced records must exist."""
    outcome = Outcome(note="simulated disk: each unsynced sector is kept or lost at random")
    while outcome.rounds < rounds:
        place = Path(tempfile.mkdtemp(dir=folder))
        with machine_on(place, random.Random(rng.random())) as machine:
            asyncio.run(live_through_cuts(machine, random.Random(rng.random())))
            for cut, synced, stored, count in machine.cuts[: rounds - outcome.rounds]:
                put_records = machine.put_so_far[:count]
                try:
                    recovered = [each for each in asyncio.run(recover(cut)) if each.payload != LOST]
                except SpoolDamaged:  # a power cut must not be mistaken for damage
                    outcome.corrupted += 1
                    recovered = []
                deleted = recovered[0].position - 1 if recovered else stored
                expected = events_of(put_records[min(deleted, stored) : synced])
                before = events_of(put_records[: min(deleted, stored)])
                outcome.compare([*before, *expected], [*before, *events_of(recovered)], put=events_of(put_records))
                step()
        shutil.rmtree(place)
    return outcome


def failed_syncs(rounds: int, rng: random.Random, folder: Path, step: Step) -> Outcome:
    """Let a sync fail: no unsynced event leaves the queue, and all written events exist after the process."""
    outcome = Outcome(note="no unsynced event left the queue")
    for _ in range(rounds):
        asyncio.run(_failed_sync(outcome, Path(tempfile.mkdtemp(dir=folder)), rng))
        step()
    return outcome


async def _failed_sync(outcome: Outcome, place: Path, rng: random.Random) -> None:
    queue = make(place / "spool", settings=SLOW)
    expected = [put(queue, "EpisodeStarted", b"{}")]
    expected += [put(queue, "NodeStarted", b"synced") for _ in range(rng.randrange(5))]
    await queue.synced_to()
    synced = len(expected)
    expected += [put(queue, "NodeStarted", b"not synced") for _ in range(rng.randrange(1, 5))]
    break_next_sync(queue)
    with contextlib.suppress(SpoolUnavailable):
        await queue.synced_to()
    batch = await queue.get_batch(events_max=100, bytes_max=2**20, age_s_max=0.0)
    outcome.corrupted += len(batch) > synced
    queue.release()
    outcome.compare(expected, events_of(await recover(queue.folder)))


def put(queue: RecorderQueue, kind: str, payload: bytes) -> Event:
    """Put one event of the only episode, and return it as the event that must exist later."""
    heading = started() if kind == "EpisodeStarted" else node()
    assert heading.episode is not None
    sequence = queue.put_nowait(heading, payload, reserved=True)
    return episode_text(heading.episode), sequence, payload.hex()


def full_disk(rounds: int, rng: random.Random, folder: Path, step: Step) -> Outcome:
    """Fill the disk under the queue and empty it again; refused events must not exist later."""
    outcome = Outcome()
    for _ in range(rounds):
        place = Path(tempfile.mkdtemp(dir=folder))
        with disk_of_256_kib(place) as kind:
            asyncio.run(_fill_and_empty(outcome, place / "spool", rng))
        outcome.note = kind
        step()
    return outcome


async def _fill_and_empty(outcome: Outcome, spool: Path, rng: random.Random) -> None:
    queue = RecorderQueue.create(spool, settings=ON_A_SMALL_DISK, clock=SYSTEM_CLOCK, recorder=RECORDER)
    expected = [put(queue, "EpisodeStarted", b"{}")]
    drained: list[Event] = []
    for _ in range(3):
        with contextlib.suppress(SpoolFull):
            while True:
                expected.append(put(queue, "NodeStarted", rng.randbytes(rng.randrange(1, 900)).hex().encode()))
        await queue.synced_to()
        batch = await queue.get_batch(events_max=10_000, bytes_max=2**22, age_s_max=0.0)
        drained += events_of(batch)
        await queue.acknowledge(batch[-1].position)
        await asyncio.wait_for(queue.room(), 30)
    queue.close()
    drained += events_of(await drain(queue))
    queue.release()
    outcome.compare(expected, drained)


def clock_jumps(rounds: int, rng: random.Random, folder: Path, step: Step) -> Outcome:
    """Let clocks stop and jump back and ahead; the order of events is their sequence, never their time."""
    outcome = Outcome(note="wall clock and monotonic clock jump by up to a century, ahead and back")
    for _ in range(rounds):
        clock = Clock(wall_ns=lambda: rng.randrange(2**62), monotonic_ns=lambda: rng.choice((0, rng.randrange(2**62))))
        queue = make(Path(tempfile.mkdtemp(dir=folder)) / "spool", settings=ROOMY, clock=clock)
        expected = [put(queue, "EpisodeStarted", b"{}")]
        expected += [put(queue, "NodeStarted", b"t" * rng.randrange(300)) for _ in range(rng.randrange(40))]
        queue.release()
        recovered = open_dead(queue.folder)
        assert recovered is not None
        recovered.release()
        outcome.compare(expected, events_of(asyncio.run(recover(queue.folder))))
        shutil.rmtree(queue.folder.parent)
        step()
    return outcome


# === crafted frames ===========================================================================================
#
# Change frames and headers of folders and correct all checksums; damage must not affect any other folder.

_STORED_EVENTS = "SELECT e.id, v.sequence, v.payload FROM event v JOIN episode e ON e.number = v.episode ORDER BY 1, 2"


_FOLDERS = 10
"""Folders to change in one round; several share a round, because opening the database takes most of its time."""


def crafted_folders(rounds: int, rng: random.Random, folder: Path, step: Step) -> Outcome:
    """Change ten of eleven folders; the other is stored completely, and each changed one up to its first change."""
    outcome = Outcome()
    changes_total = refused = 0
    for _ in range(rounds):
        place = Path(tempfile.mkdtemp(dir=folder))
        spool, url = place / "spool", f"sqlite:///{place / 'memory.db'}"
        authors = [_author(spool, number, rng) for number in range(1, _FOLDERS + 2)]
        intact_author = authors.pop(rng.randrange(len(authors)))
        expected = events_of(intact_author.records)
        for crafted in authors:
            path, changes_of_folder, intact_records = rng.choice(crafted.segments), rng.choice((1, 1, 2, 5)), 0
            if rng.random() < 0.2:
                change_the_header(path, rng)
            else:
                intact_records = (
                    max(1, min(change_a_frame(path, rng, fitting=rng.random() < 0.8) for _ in range(changes_of_folder)))
                    - 1
                )
            expected += events_of(crafted.records[:intact_records])
            changes_total += changes_of_folder
        refused += _recover_spool(url, spool)
        inspect_spool(spool)
        for each in Spool(spool).recorders():
            with suppress(PycrormError):  # a segment of another recorder is reported and not repaired
                repair_folder(each.path)
        _recover_spool(url, spool)
        stored = [(name, sequence, payload.encode().hex()) for name, sequence, payload in ask(url, _STORED_EVENTS)]
        expected_events = set(expected)
        outcome.compare(expected, [each for each in stored if each in expected_events])
        shutil.rmtree(place)
        step()
    outcome.note = f"{changes_total:,} changes; {refused:,} folders refused as damaged; all intact folders stored"
    return outcome


def _recover_spool(url: str, spool: Path) -> int:
    """Recover the spool; return the number of folders that were refused. Any other error ends the benchmark."""
    return len(asyncio.run(recover_spool(url, spool=spool)).failed)


def _author(spool: Path, number: int, rng: random.Random) -> FolderWriter:
    author = FolderWriter(spool, settings=ROOMY, recorder=episode(90 + number))
    author.put(started(number))
    for _ in range(rng.randrange(12, 30)):
        author.put(node(number), b'{"n":"%s"}' % (b"n" * rng.randrange(900)))
        if rng.random() < 0.4:
            author.sync()
    author.put(ended(number))
    author.sync()
    author.appender.close()
    return author


# === simulation ===============================================================================================
#
# Simulate the path from the queue to the log with all faults combined, drawn from one seed.
#
# Files, queue, writer and SQLite log are real. The seed decides when the sync thread runs, when the power fails on a
# disk that loses unsynced data, when the database is unavailable or loses its reply, and when the drain is cancelled.
# After the death of each recorder the next one starts, and the dead folder is drained under the same faults. At the end
# everything that was synced before a power cut must be in the log once, and nothing that was never put.

_NO_BACKOFF = Backoff(first_s=1e-6, longest_s=1e-6)
_STORED = "SELECT id, sequence, payload FROM event JOIN episode ON number = event.episode ORDER BY number, sequence"


class _FaultyLog(ForwardingDestination):
    """A log that at random is unavailable, or commits and loses the reply."""

    def __init__(self, log: EventLog, rng: random.Random) -> None:
        super().__init__(CountingFold(log))
        self._rng = rng

    async def append(self, records: Sequence[Record]) -> Mapping[EpisodeId, str]:
        chance = self._rng.random()
        if chance < 0.2:
            raise DatabaseUnavailable("unavailable before the append")
        refused = await super().append(records)
        if chance < 0.4:
            raise DatabaseUnavailable("the reply to the COMMIT was lost")
        return refused


class _Life:
    """One recorder from its start to its death."""

    def __init__(self, machine: Machine, rng: random.Random, number: int) -> None:
        self.machine = machine
        self._rng = rng
        self._number = number
        self._episodes = 0
        self._open: list[EpisodeId] = []
        self._count = 0
        self.taken = 0
        machine.meanwhile = self._node

    def act(self) -> None:
        """Put a few events."""
        for _ in range(self._rng.randrange(1, 6)):
            if not self._open or (len(self._open) < 9 and self._rng.random() < 0.2):
                self._episodes += 1
                randomness = self._number.to_bytes(4) + self._episodes.to_bytes(6)
                self._open.append(episode_id(1_700_000_000_000_000_000, randomness))
                self._put(Heading(self._open[-1], "EpisodeStarted", 1))
                continue
            episode = self._rng.choice(self._open)
            ends = len(self._open) > 1 and self._rng.random() < 0.15
            self._put(Heading(episode, "EpisodeEnded" if ends else "NodeStarted", 1))
            if ends:
                self._open.remove(episode)

    def _node(self) -> Heading:
        return Heading(self._rng.choice(self._open), "NodeStarted", 1)

    def _put(self, heading: Heading) -> None:
        self._count += 1
        self.machine.put(heading, b'{"n":%d,"x":"%s"}' % (self._count, b"x" * self._rng.randrange(900)))


class _PowerFails(BaseException):
    """The power of the simulated machine has failed."""


def _fail_power_at(machine: Machine, moment: int) -> None:
    """Let the power fail at the `moment`-th call of `machine.cut`."""
    original_cut, calls_left = machine.cut, moment

    def cut_or_fail() -> None:
        nonlocal calls_left
        calls_left -= 1
        if calls_left == 0:
            original_cut()
            raise _PowerFails

    machine.cut = cut_or_fail  # type: ignore[method-assign]


async def _record_until_cut(
    machine: Machine, life: _Life, log: EventLog, rng: random.Random
) -> tuple[Path, list[Event]]:
    """Record, sync and drain until the power fails; return the folder after the cut, and the synced events."""
    destination = _FaultyLog(log, rng)
    _fail_power_at(machine, rng.randrange(1, 150))
    with contextlib.suppress(_PowerFails):
        while True:
            await _step(machine, life, destination, rng)
    [(folder, synced, _, _)] = machine.cuts
    return folder, events_of(machine.put_so_far[:synced])


async def _step(machine: Machine, life: _Life, destination: _FaultyLog, rng: random.Random) -> None:
    queue = machine.queue
    life.act()
    machine.cut()
    if rng.random() < 0.7:
        machine.turn()
    if queue.synced > life.taken and rng.random() < 0.6:
        batch = await queue.get_batch(events_max=rng.choice((1, 3, 50)), bytes_max=2**20, age_s_max=0.0)
        life.taken = batch[-1].position
        stored = False
        while not stored:
            machine.cut()
            with contextlib.suppress(DatabaseUnavailable):
                await destination.append(batch)
                stored = True
        machine.cut()
        await queue.acknowledge(life.taken)
        machine.turn()


async def _drain(folder: Path, log: EventLog, rng: random.Random) -> None:
    """Drain the dead folder as the next process would; cancel the drain and restart it at random."""
    for attempt in range(30):
        recovered = open_dead(folder, check=rng.random() < 0.5)
        assert recovered is not None
        settings = Settings(batch_events_max=rng.choice((1, 5, 100)))
        drain = Drain(recovered, _FaultyLog(log, rng).append, settings=settings, backoff=_NO_BACKOFF)
        running = asyncio.create_task(drain.run())
        if attempt < 29 and rng.random() < 0.5:
            for _ in range(rng.randrange(40)):
                await asyncio.sleep(0)
            running.cancel()
        with contextlib.suppress(asyncio.CancelledError):
            await running
        if recovered.release() is not None:
            return


def simulated(rounds: int, rng: random.Random, folder: Path, step: Step) -> Outcome:
    """Run one memory a round, each with a few recorders that record, die and are recovered."""
    outcome = Outcome(note="queue, disk, power, writer, lost replies, cancellation: one seed for each memory")
    for _ in range(rounds):
        place = Path(tempfile.mkdtemp(dir=folder))
        asyncio.run(_memory(outcome, place, random.Random(rng.random())))
        shutil.rmtree(place)
        step()
    return outcome


async def _memory(outcome: Outcome, place: Path, rng: random.Random) -> None:
    url = f"sqlite:///{place}/memory.db"
    log = await EventLog.open(DatabaseAddress.parse(url), create=True)
    expected: list[Event] = []
    put: list[Event] = []
    for number in range(1, rng.randrange(2, 4)):
        with machine_on(place / str(number), rng) as machine:
            life = _Life(machine, rng, number)
            folder, synced = await _record_until_cut(machine, life, log, rng)
            expected += synced
            put += events_of(machine.put_so_far)
            await _drain(folder, log, rng)
    await log.close()
    stored = [
        (name, sequence, payload.encode().hex())
        for name, sequence, payload in ask(url, _STORED)
        if payload.encode() != LOST
    ]
    outcome.compare(expected, stored, put=put)
