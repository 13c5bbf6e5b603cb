"""Faults of the queue's files and disk: torn writes, flipped bits, power cuts, failed syncs, full disks, clocks."""

from __future__ import annotations

import asyncio
import contextlib
import os
import random
import shutil
import subprocess
import tempfile
from collections.abc import Iterable, Iterator
from contextlib import contextmanager
from dataclasses import replace
from pathlib import Path

from bench.breaking.outcome import Event, Outcome, Step
from pycrorm_async.clock import SYSTEM_CLOCK, Clock
from pycrorm_async.errors import SpoolDamaged, SpoolForeign, SpoolFull, SpoolUnavailable
from pycrorm_async.events.codec import LOST, Record
from pycrorm_async.events.ids import episode_text
from pycrorm_async.queue import RecorderQueue, open_dead
from pycrorm_async.queue.maintenance import RepairReport, repair_folder
from tests.crash.test_queue_disk import ON_A_SMALL_DISK, SLOW, break_next_sync
from tests.crash.test_queue_power import live_through_cuts, machine_on
from tests.queue.factories import RECORDER, SMALL, FolderWriter, drain, ended, make, node, recover, started

__all__ = [
    "torn_writes",
    "flipped_bits",
    "power_cuts",
    "failed_syncs",
    "full_disk",
    "clock_jumps",
    "events_of",
    "put",
    "small_disk",
    "ROOMY",
]

ROOMY = replace(SMALL, spool_bytes_max=64 * SMALL.segment_bytes)


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
        with _small_disk(place) as kind:
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


@contextmanager
def small_disk(place: Path, size: str) -> Iterator[bool]:
    """Mount a tmpfs of this size; yield False without the permission to mount."""
    place.mkdir(exist_ok=True)
    mount = ["mount", "-t", "tmpfs", "-o", f"size={size}", "tmpfs", str(place)]
    mounted = subprocess.run(mount, capture_output=True, check=False).returncode == 0
    try:
        yield mounted
    finally:
        if mounted:
            subprocess.run(["umount", str(place)], check=True)


@contextmanager
def _small_disk(place: Path) -> Iterator[str]:
    with small_disk(place, "256k") as mounted:
        if mounted:
            yield "a tmpfs of 256 KiB"
            return
    allocate = os.posix_fallocate

    def refusing(descriptor: int, offset: int, size: int) -> None:
        if sum(path.stat().st_size for path in place.rglob("*")) + size > 2**18:
            raise OSError(28, os.strerror(28))
        allocate(descriptor, offset, size)

    os.posix_fallocate = refusing
    try:
        yield "simulated: no permission to mount a small disk"
    finally:
        os.posix_fallocate = allocate


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
