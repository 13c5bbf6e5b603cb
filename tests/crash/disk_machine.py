"""A queue on a disk that fails, fills or loses its power, for the tests and for the faults of the bench.

The queue and its files are real. The caller calls each turn of the sync thread itself, and the machine observes each
system call that syncs. A power cut mixes, sector by sector, the state that the last sync of a file made durable with
all states since. A file whose name no sync of its folder covers may be missing, and a deleted file may exist again. The
recorder may also be killed, and the power may fail after another program has recovered its folder.
"""

from __future__ import annotations

import os
import random
import subprocess
from collections.abc import Callable, Iterator
from contextlib import contextmanager, suppress
from dataclasses import replace
from functools import partial
from pathlib import Path

import pytest

from pycrorm_async.events.codec import Heading, Record
from pycrorm_async.events.ids import EpisodeId
from pycrorm_async.queue import RecorderQueue
from pycrorm_async.queue.appender import Appender, SyncSpan
from pycrorm_async.queue.format import Segment
from pycrorm_async.queue.sync_thread import SyncThread
from pycrorm_async.settings import Settings
from tests.queue.factories import SMALL, ended, episode, make, node, record, started

ON_A_SMALL_DISK = Settings(
    sync_interval_ms=5, segment_bytes=2**15, spool_bytes_max=2**30, spool_reserve_bytes=2**16, record_bytes_max=2**12
)


def break_next_sync(queue: RecorderQueue) -> None:
    """Make the next sync of the current segment fail: its descriptor refers to a pipe, which cannot be synced."""
    read, write = os.pipe()
    os.dup2(write, queue._appender._current.descriptor)
    os.close(read)
    os.close(write)


SECTOR = 512


ROOMY = replace(SMALL, spool_bytes_max=64 * SMALL.segment_bytes)


class Machine:
    """A queue on a disk that forgets, and the record of what was put."""

    def __init__(self, place: Path, rng: random.Random) -> None:
        self.put_so_far: list[Record] = []
        self.cuts: list[tuple[Path, int, int, int]] = []
        self._place = place
        self._rng = rng
        self.meanwhile: Callable[[], Heading] = node  # records of other threads
        self.sequences: dict[EpisodeId, int] = {}
        self._safe: dict[Path, bytes] = {}
        self._allocated: set[int] = set()  # inodes
        self._named: set[Path] = set()
        self._since: dict[Path, list[bytes]] = {}
        self._deleted: list[tuple[Path, bytes]] = []

    def start(self) -> None:
        self.queue: RecorderQueue = make(self._place / "running", settings=ROOMY)

    def put(self, heading: Heading, payload: bytes) -> None:
        assert heading.episode is not None
        sequence = self.sequences[heading.episode] = self.sequences.get(heading.episode, 0) + 1
        assert self.queue.put_nowait(heading, payload, reserved=True) == sequence
        self.put_so_far.append(record(len(self.put_so_far) + 1, heading, sequence, payload))
        path = self.queue._appender.begun[-1].path
        self._since.setdefault(path, []).append(path.read_bytes())

    def put_meanwhile(self) -> None:
        """Put what other threads put during a turn of the sync thread: nothing, a few records, or enough for a new
        segment.
        """
        for size in self._rng.choice([[], [], [], [], [], [10], [3000], [10, 3000]]):
            self.put(self.meanwhile(), b"m" * size)

    def synced(self, descriptor: int) -> None:
        """Note that a system call has synced this file or folder."""
        path = Path(f"/proc/self/fd/{descriptor}").readlink()
        if path.is_dir():
            self._named.update(path.iterdir())
        elif path.suffix == ".segment":
            self._safe[path], self._since[path] = path.read_bytes(), []
        else:  # an allocated segment before it gets its name
            self._allocated.add(path.stat().st_ino)

    def turn(self) -> None:
        """Run one turn of the sync thread."""
        before = {path: self._mixed(path) for path in self._files()}
        self.queue._turn()
        self._deleted += [(path, before[path]) for path in before if not path.exists()]

    def cut(self) -> None:
        """Keep the files as they may be after a power cut, with what the queue reports as synced at this moment."""
        folder = self._place / str(len(self.cuts)) / self.queue.name
        folder.mkdir(parents=True)
        (folder / "alive").touch()
        for path in self._files():
            if path in self._named or self._rng.random() < 0.5:
                (folder / path.name).write_bytes(self._mixed(path))
        for path, content in self._deleted[self._rng.randrange(len(self._deleted) + 1) :]:
            (folder / path.name).write_bytes(content)
        self.cuts.append((folder, self.queue.synced, self.queue.stored, len(self.put_so_far)))

    def kill(self) -> Path:
        """Return the folder as other processes find it while there is power, with everything that was written."""
        folder = self._place / "killed" / self.queue.name
        folder.mkdir(parents=True)
        (folder / "alive").touch()
        for path in self._files():
            (folder / path.name).write_bytes(path.read_bytes())
        return folder

    def cut_after_kill(self, killed: Path, *, safe: set[str]) -> Path:
        """Return what is left of that folder without power if the program that recovered it had made these files
        durable.
        """
        folder = self._place / "cut" / self.queue.name
        folder.mkdir(parents=True)
        (folder / "alive").touch()
        deleted = sum(not (killed / path.name).exists() for path in self._files())
        for path in self._files()[self._rng.randrange(deleted + 1) :]:
            (folder / path.name).write_bytes(path.read_bytes() if path.name in safe else self._mixed(path))
        return folder

    def _files(self) -> list[Path]:
        return sorted(self.queue.folder.glob("*.segment"))

    def _mixed(self, path: Path) -> bytes:
        now = path.read_bytes()
        if path.stat().st_ino not in self._allocated:
            return now[: self._rng.randrange(len(now))]
        states = [self._safe.get(path, bytes(len(now))), *self._since.get(path, []), now]
        if self._rng.random() < 0.2:
            states = [self._rng.choice(states)]
        return b"".join(self._rng.choice(states)[at : at + SECTOR] for at in range(0, len(now), SECTOR))


@contextmanager
def machine_on(place: Path, rng: random.Random) -> Iterator[Machine]:
    """Return a machine whose every sync is observed, with a power cut before and after each."""
    with pytest.MonkeyPatch.context() as patch:
        patch.setattr(SyncThread, "start", lambda self: None)
        machine = Machine(place, rng)
        sync = Segment.sync
        for name in ("fsync", "fdatasync"):
            patch.setattr(os, name, partial(observed, getattr(os, name), machine))
        machine.start()

        def watched(segment: Segment) -> None:
            machine.cut()
            machine.put_meanwhile()
            sync(segment)
            machine.put_meanwhile()
            machine.cut()

        begin_sync = Appender.begin_sync

        def begun(appender: Appender) -> SyncSpan:
            span = begin_sync(appender)
            machine.put_meanwhile()
            return span

        patch.setattr(Segment, "sync", watched)
        patch.setattr(Appender, "begin_sync", begun)
        try:
            yield machine
        finally:
            machine.queue._appender.close()
            machine.queue._source.reader.close()


def observed(system_call: Callable[[int], None], machine: Machine, descriptor: int) -> None:
    system_call(descriptor)
    machine.synced(descriptor)


async def live_through_cuts(machine: Machine, rng: random.Random) -> None:
    """Run a recorder that puts, syncs, stores and deletes, with a power cut at every step."""
    for number in (1, 2, 3):
        machine.put(started(number), b"{}")
    for _ in range(6):
        for _ in range(rng.randrange(5)):
            number = rng.choice([1, 1, 2])
            machine.put(node(number), b"y" * rng.randrange(1500))
        machine.cut()
        machine.turn()
        machine.cut()
        if machine.queue.synced > machine.queue._source.reader.cursor.position and rng.random() < 0.7:
            batch = await machine.queue.get_batch(events_max=rng.choice([1, 4, 1000]), bytes_max=2**20, age_s_max=0.0)
            await machine.queue.acknowledge(batch[-1].position)
            machine.turn()
            machine.cut()
        if rng.random() < 0.1 and machine.sequences[episode(2)] > 0:
            machine.put(node(3), b"third")
    machine.put(ended(1), b"{}")
    machine.cut()


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
def disk_of_256_kib(place: Path) -> Iterator[str]:
    with small_disk(place, "256k") as mounted:
        if mounted:
            yield "a tmpfs of 256 KiB"
            return
    allocate = os.posix_fallocate

    def refusing(descriptor: int, offset: int, size: int) -> None:
        used = 0
        for path in place.rglob("*"):
            with suppress(FileNotFoundError):  # the other thread renames files
                used += path.stat().st_size
        if used + size > 2**18:
            raise OSError(28, os.strerror(28))
        allocate(descriptor, offset, size)

    os.posix_fallocate = refusing
    try:
        yield "simulated: no permission to mount a small disk"
    finally:
        os.posix_fallocate = allocate
