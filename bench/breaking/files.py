"""The queue's files and their disk: torn writes, flipped bits, power cuts, failed syncs, a full disk, clocks."""

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
from pycrorm_async.events.envelope import LOST, Record
from pycrorm_async.events.ids import episode_text
from pycrorm_async.queue import RecorderQueue, open_dead
from pycrorm_async.queue.maintenance.repair import RepairReport, repair_folder
from tests.crash.test_queue_disk import ON_A_SMALL_DISK, SLOW, break_syncing
from tests.crash.test_queue_power import live_through, machine_on
from tests.queue.factories import RECORDER, SMALL, Author, drain, ended, make, node, recover, started

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
    """Without the ends that recovery computes."""
    return [
        (episode_text(each.episode), each.sequence, each.payload.hex())
        for each in records
        if each.episode is not None and each.payload != LOST
    ]


def torn_writes(rounds: int, rng: random.Random, folder: Path, step: Step) -> Outcome:
    """What was not synced is torn at every byte, once into zeros and once into garbage."""
    outcome = Outcome(note="every byte of three records that no sync covers; zeros, ones, noise behind")
    author = Author(folder / "spool")
    author.put(started())
    for size in (6, 0, 33):
        author.put(node(), b"s" * size)
    author.sync()
    safe = len(author.records)
    first = author.end
    for size in (0, 1, 200):
        author.put(node(), rng.randbytes(size).hex().encode())
    path, whole = author.segments[0], author.segments[0].read_bytes()
    cuts = range(first, author.end + 1)
    for cut in cuts[:: max(1, 3 * len(cuts) // rounds)]:
        for filling in (bytes(len(whole) - cut), b"\xff" * (len(whole) - cut), rng.randbytes(len(whole) - cut)):
            path.write_bytes(whole[:cut] + filling)
            whole_ones = sum(offset + size <= cut for _, offset, size in author.places)
            sure = events_of(author.records[: max(safe, whole_ones)])
            outcome.compare(sure, events_of(asyncio.run(recover(author.folder))), put=events_of(author.records))
            step()
    return outcome


def flipped_bits(rounds: int, rng: random.Random, folder: Path, step: Step) -> Outcome:
    """Each bit of a journal is flipped; damage is refused, mended, and every record found or told."""
    refused = 0
    outcome = Outcome()
    author = _journal(folder / "first", rng)
    bits = [
        (number, bit)
        for number, path in enumerate(author.segments)
        for bit in range(len(path.read_bytes().rstrip(b"\0")) * 8)
    ]
    for number, bit in bits[:: max(1, len(bits) // rounds)]:
        place = folder / "copy" / author.folder.name
        shutil.copytree(author.folder, place)
        path = place / author.segments[number].name
        content = bytearray(path.read_bytes())
        content[bit // 8] ^= 1 << bit % 8
        path.write_bytes(content)
        told: set[int] = set()
        try:
            report = repair_folder(place)
        except SpoolForeign:  # the number of the format: another program's file, which is left alone
            refused += 1
        else:
            told = _told(report) if report is not None else told
            records = asyncio.run(recover(place))
            named = [each for each in _behind(author, author.segments[number], bit // 8) if each.position in told]
            outcome.compare(events_of(author.records), events_of(records), told=events_of(named))
        shutil.rmtree(place.parent)
        step()
    outcome.note = f"of {len(bits):,} bits; {refused} made a file of a newer format, which is refused and left alone"
    return outcome


def _journal(spool: Path, rng: random.Random) -> Author:
    author = Author(spool, settings=ROOMY)
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


def _behind(author: Author, path: Path, byte: int) -> list[Record]:
    """The record that holds this byte, and those that follow it in its episode: more than that may not be given up."""
    for index, (file, offset, size) in enumerate(author.places):
        if file == path and offset <= byte < offset + size:
            hit = author.records[index]
            return [each for each in author.records[index:] if each.episode == hit.episode]
    return []


def _told(report: RepairReport) -> set[int]:
    spans = [*report.unreadable, *(span for each in report.given_up for span in each.positions)]
    return {position for first, last in spans for position in range(first, last + 1)}


def power_cuts(rounds: int, rng: random.Random, folder: Path, step: Step) -> Outcome:
    """A disk that keeps any sectors of what it was not told to keep; synced records must be there."""
    outcome = Outcome(note="simulated disk: what no sync covered reached it or not, sector by sector")
    while outcome.rounds < rounds:
        place = Path(tempfile.mkdtemp(dir=folder))
        with machine_on(place, random.Random(rng.random())) as machine:
            asyncio.run(live_through(machine, random.Random(rng.random())))
            for cut, synced, stored, count in machine.cuts[: rounds - outcome.rounds]:
                truth = machine.put_so_far[:count]
                try:
                    kept = [each for each in asyncio.run(recover(cut)) if each.payload != LOST]
                except SpoolDamaged:  # no power cut may look like damage
                    outcome.changed += 1
                    kept = []
                gone = kept[0].position - 1 if kept else stored
                sure = events_of(truth[min(gone, stored) : synced])
                before = events_of(truth[: min(gone, stored)])
                outcome.compare([*before, *sure], [*before, *events_of(kept)], put=events_of(truth))
                step()
        shutil.rmtree(place)
    return outcome


def failed_syncs(rounds: int, rng: random.Random, folder: Path, step: Step) -> Outcome:
    """The disk refuses a sync: nothing unsynced is given away, and all written is there after the process."""
    outcome = Outcome(note="nothing that was not synced left the queue")
    for _ in range(rounds):
        asyncio.run(_failed_sync(outcome, Path(tempfile.mkdtemp(dir=folder)), rng))
        step()
    return outcome


async def _failed_sync(outcome: Outcome, place: Path, rng: random.Random) -> None:
    queue = make(place / "spool", settings=SLOW)
    sure = [put(queue, "EpisodeStarted", b"{}")]
    sure += [put(queue, "NodeStarted", b"synced") for _ in range(rng.randrange(5))]
    await queue.synced_to()
    synced = len(sure)
    sure += [put(queue, "NodeStarted", b"not synced") for _ in range(rng.randrange(1, 5))]
    break_syncing(queue)
    with contextlib.suppress(SpoolUnavailable):
        await queue.synced_to()
    given = await queue.get_batch(events_max=100, bytes_max=2**20, age_s_max=0.0)
    outcome.changed += len(given) > synced
    queue.release()
    outcome.compare(sure, events_of(await recover(queue.folder)))


def put(queue: RecorderQueue, kind: str, payload: bytes) -> Event:
    """Puts one event of the one episode; what must be found of it."""
    heading = started() if kind == "EpisodeStarted" else node()
    assert heading.episode is not None
    sequence = queue.put_nowait(heading, payload, reserved=True)
    return episode_text(heading.episode), sequence, payload.hex()


def full_disk(rounds: int, rng: random.Random, folder: Path, step: Step) -> Outcome:
    """The disk fills up under the queue and is emptied; what was refused was never put."""
    outcome = Outcome()
    for _ in range(rounds):
        place = Path(tempfile.mkdtemp(dir=folder))
        with _small_disk(place) as kind:
            asyncio.run(_filled(outcome, place / "spool", rng))
        outcome.note = kind
        step()
    return outcome


async def _filled(outcome: Outcome, spool: Path, rng: random.Random) -> None:
    queue = RecorderQueue.create(spool, settings=ON_A_SMALL_DISK, clock=SYSTEM_CLOCK, recorder=RECORDER)
    sure = [put(queue, "EpisodeStarted", b"{}")]
    found: list[Event] = []
    for _ in range(3):
        with contextlib.suppress(SpoolFull):
            while True:
                sure.append(put(queue, "NodeStarted", rng.randbytes(rng.randrange(1, 900)).hex().encode()))
        await queue.synced_to()
        batch = await queue.get_batch(events_max=10_000, bytes_max=2**22, age_s_max=0.0)
        found += events_of(batch)
        await queue.acknowledge(batch[-1].position)
        await asyncio.wait_for(queue.room(), 30)
    queue.close()
    found += events_of(await drain(queue))
    queue.release()
    outcome.compare(sure, found)


@contextmanager
def small_disk(place: Path, size: str) -> Iterator[bool]:
    """A tmpfs of so many bytes at this place; False if there is no right to mount one."""
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
        yield "simulated: there is no right to mount a small disk here"
    finally:
        os.posix_fallocate = allocate


def clock_jumps(rounds: int, rng: random.Random, folder: Path, step: Step) -> Outcome:
    """Clocks that stand still, jump hours back and far ahead: order is by sequence, never by time."""
    outcome = Outcome(note="wall clock and monotonic clock, each by up to a century and back")
    for _ in range(rounds):
        clock = Clock(wall_ns=lambda: rng.randrange(2**62), monotonic_ns=lambda: rng.choice((0, rng.randrange(2**62))))
        queue = make(Path(tempfile.mkdtemp(dir=folder)) / "spool", settings=ROOMY, clock=clock)
        sure = [put(queue, "EpisodeStarted", b"{}")]
        sure += [put(queue, "NodeStarted", b"t" * rng.randrange(300)) for _ in range(rng.randrange(40))]
        queue.release()
        recovered = open_dead(queue.folder)
        assert recovered is not None
        recovered.release()
        outcome.compare(sure, events_of(asyncio.run(recover(queue.folder))))
        shutil.rmtree(queue.folder.parent)
        step()
    return outcome
