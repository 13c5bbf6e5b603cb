"""Fill the disk of a recorder, and cut the power of a real disk, on file systems in images."""

from __future__ import annotations

import asyncio
import ctypes
import fcntl
import os
import random
import shutil
import struct
import subprocess
import sys
import time
from collections.abc import Iterator
from contextlib import contextmanager, suppress
from itertools import count
from pathlib import Path
from typing import Final

from bench.breaking.files import events_of, put
from bench.breaking.outcome import Event, Outcome, Step
from bench.breaking.processes import ChildProcess, RecordedSteps, compare_steps, walk
from pycrorm_async.clock import SYSTEM_CLOCK
from pycrorm_async.errors import SpoolFull, SpoolUnavailable
from pycrorm_async.events.codec import Record
from pycrorm_async.events.ids import episode_id, episode_text
from pycrorm_async.operations.recovery import recover
from pycrorm_async.queue import RecorderQueue, Spool, open_dead
from pycrorm_async.settings import Settings
from tests.queue.factories import drain, episode

# === disks ====================================================================================================
#
# Fill the disk of a recorder, on each kind of file system.

_SIZE: Final = {"ext4": "64M", "xfs": "320M", "btrfs": "128M"}
"""The smallest size that each mkfs accepts."""
_SETTINGS: Final = Settings(
    sync_interval_ms=1, segment_bytes=2**17, spool_bytes_max=2**24, spool_reserve_bytes=2**18, record_bytes_max=2**12
)
_LONGEST_LIFE_S: Final = 0.2


# --- a full disk ---------------------------------------------------------------------------------------------------


class FullDisksOn:
    """Fill a disk of one kind of file system: a put must fail with an error, and the process must survive."""

    def __init__(self, kind: str) -> None:
        self._kind = kind

    def __call__(self, rounds: int, rng: random.Random, folder: Path, step: Step) -> Outcome:
        outcome = Outcome(note=f"{self._kind} on a loop image, filled to the last block while a recorder puts events")
        try:
            if not DiskImage.can_make(self._kind):
                raise FileNotFoundError(self._kind)
            disk = DiskImage(folder, kind=self._kind, size=_SIZE[self._kind])
            with disk.mounted():
                pass
        except (OSError, subprocess.CalledProcessError):
            outcome.note = NOT_MADE
            return outcome
        with disk.mounted():
            for _ in range(rounds):
                if self._kind == "btrfs":
                    _refuse_on_btrfs(outcome, disk.root, folder, rng)
                else:
                    _fill_under_a_recorder(outcome, disk.root, rng)
                step()
        if self._kind == "btrfs":
            outcome.note = "a spool on btrfs is refused; the events are of a second recorder on another disk"
        return outcome


def _fill_under_a_recorder(outcome: Outcome, root: Path, rng: random.Random) -> None:
    spool = root / "spool"
    recorder = ChildProcess(_record_on_a_full_disk, str(spool), rng.randrange(2**31))
    try:
        recorder.wait_for("ready")
        _fill(root)
        recorder.wait_for("full")
        time.sleep(rng.random() * _LONGEST_LIFE_S / 4)
        lines = recorder.kill_and_read()  # raises if the recorder ended by itself, for example by SIGBUS
    finally:
        recorder.stop_and_read()
    put_before = [(episode_text(_EPISODE), int(words[1]), words[2]) for words in lines if words[0] == "put"]
    (root / "filler").unlink()
    recovered = [
        each for folder in Spool(spool).recorders() for each in events_of(asyncio.run(_recover_only(folder.path)))
    ]
    attempted = [(episode_text(_EPISODE), len(put_before) + 1, each[2]) for each in recovered[len(put_before) :][:1]]
    outcome.compare(put_before, recovered, put=attempted)
    shutil.rmtree(spool)


def _fill(root: Path) -> None:
    """Allocate all free blocks of the disk without writing to them."""
    with (root / "filler").open("wb") as file:
        end, size = 0, 2**26
        while size >= 2**12:
            try:
                os.posix_fallocate(file.fileno(), end, size)
                end += size
            except OSError:
                size //= 2


def _refuse_on_btrfs(outcome: Outcome, root: Path, folder: Path, rng: random.Random) -> None:
    try:
        _queue(root / "spool").release()
    except SpoolUnavailable as refusal:
        if "lies on btrfs" not in str(refusal):
            raise
    else:
        outcome.corrupted += 1
    queue = _queue(folder / "spool")
    _fill(root)
    expected = [put(queue, "EpisodeStarted", b"{}")]
    expected += [put(queue, "NodeStarted", rng.randbytes(40).hex().encode()) for _ in range(rng.randrange(10, 60))]
    queue.release()
    outcome.compare(expected, events_of(asyncio.run(_recover_only(queue.folder))))
    shutil.rmtree(folder / "spool")
    (root / "filler").unlink()


def _record_on_a_full_disk(spool: str, seed: int) -> None:
    """Put events and print each one; when the disk is full, print `full` once and retry without end."""
    rng = random.Random(seed)
    queue = _queue(Path(spool))
    _print_put(put(queue, "EpisodeStarted", b"{}"))
    is_full = False
    for number in count():
        try:
            _print_put(put(queue, "NodeStarted", rng.randbytes(rng.randrange(1, 900)).hex().encode()))
        except SpoolFull:
            if not is_full:
                print("full", flush=True)
            is_full = True
            time.sleep(0.001)
        if number == 20:
            print("ready", flush=True)
        if 20 < number < 200:
            time.sleep(0.0005)  # slow enough that the disk is filled in the meantime


def _print_put(event: Event) -> None:
    print("put", event[1], event[2], flush=True)


_EPISODE: Final = episode(1)


def _queue(spool: Path, settings: Settings = _SETTINGS) -> RecorderQueue:
    recorder = episode_id(SYSTEM_CLOCK.wall_ns(), os.urandom(10))
    return RecorderQueue.create(spool, settings=settings, clock=SYSTEM_CLOCK, recorder=recorder)


async def _recover_only(folder: Path) -> list[Record]:
    """Recover the only recorder of the spool, and return its records."""
    [recorder] = Spool(folder.parent).recorders()
    queue = open_dead(recorder.path)
    assert queue is not None, "its process is dead"
    records = await drain(queue)
    queue.release()
    return records


# === images ===================================================================================================
#
# Create and mount file systems in image files, for faults that need a disk.

NOT_MADE = "skipped: no permission to mount a loop image"
_MAKE = {"ext4": ["mkfs.ext4", "-q", "-F"], "xfs": ["mkfs.xfs", "-q", "-f"], "btrfs": ["mkfs.btrfs", "-q", "-f"]}


class DiskImage:
    """A file system in an image file, mounted at `root`.

    Raises:
        OSError, CalledProcessError: a program is missing, or failed.
    """

    def __init__(self, folder: Path, *, kind: str = "ext4", size: str = "64M") -> None:
        self._image = folder / "disk.img"
        self.root = folder / "disk"
        self.root.mkdir()
        subprocess.run(["truncate", "-s", size, self._image], check=True)
        subprocess.run([*_MAKE[kind], self._image], check=True, capture_output=True)

    @staticmethod
    def can_make(kind: str) -> bool:
        """Return True if the program that creates this kind of file system is installed."""
        return shutil.which(_MAKE[kind][0]) is not None

    @contextmanager
    def mounted(self) -> Iterator[None]:
        """Mount the image; this replays the journal of the file system."""
        subprocess.run(["mount", "-o", "loop", self._image, self.root], check=True, capture_output=True)
        try:
            yield
        finally:
            subprocess.run(["umount", self.root], check=True)


# === machine ==================================================================================================
#
# Cut the power of a real disk: shut down an ext4 on a loop image while a plan runs, and lose all unsynced data.
#
# An ioctl makes the kernel shut down the file system without flushing its journal, so everything that it had not
# written is lost. Before that, pages are written back at random, so that they reach the disk in an arbitrary order.

_SHUTDOWN = 0x8004587D  # EXT4_IOC_SHUTDOWN
_NO_LOG_FLUSH = 2
_WRITE = 2  # SYNC_FILE_RANGE_WRITE
_PAGE = 4096
_LONGEST_PLAN_S = 0.3


class _Disk(DiskImage):
    """An ext4 that can be shut down like a disk without power."""

    def fail(self) -> None:
        """Shut down the file system: nothing more reaches the image, and every sync fails."""
        place = os.open(self.root, os.O_RDONLY)
        try:
            fcntl.ioctl(place, _SHUTDOWN, struct.pack("I", _NO_LOG_FLUSH))
        finally:
            os.close(place)

    def write_back_a_page(self, rng: random.Random) -> None:
        """Start the write-back of one random page of one random file."""
        with suppress(OSError, IndexError):  # the file was deleted, or no file exists yet
            path = rng.choice([path for path in self.root.rglob("*") if path.is_file()])
            file = os.open(path, os.O_RDONLY)
            try:
                page = rng.randrange(max(1, os.fstat(file).st_size // _PAGE))
                _C.sync_file_range(file, ctypes.c_int64(page * _PAGE), ctypes.c_int64(_PAGE), _WRITE)
            finally:
                os.close(file)


_C = ctypes.CDLL(None)


def power_cuts(rounds: int, rng: random.Random, folder: Path, step: Step) -> Outcome:
    """Run all rounds on one disk; everything synced in this round and in all earlier ones must exist."""
    outcome, steps = Outcome(), RecordedSteps()
    try:
        disk = _Disk(folder)
        with disk.mounted():
            pass
    except (OSError, subprocess.CalledProcessError):
        outcome.note = NOT_MADE
        return outcome
    outcome.note = (
        "ext4 on a loop image, shut down under a plan, its writer and its SQLite; random write-back of pages before"
    )
    url, spool = f"sqlite:///{disk.root}/memory.db", disk.root / "spool"
    for number in range(rounds):
        with disk.mounted():
            plan = ChildProcess(_walk_quietly, url, str(spool), f"plan{number}", rng.randrange(2**31))
            try:
                plan.wait_for("synced")
                deadline = time.monotonic() + rng.random() * _LONGEST_PLAN_S
                while time.monotonic() < deadline:
                    disk.write_back_a_page(rng)
                    time.sleep(0.002)
                disk.fail()
            finally:
                lines = plan.stop_and_read()  # also on SIGTERM: only then can the disk be unmounted
            steps.add(lines, when_synced=True)
        with disk.mounted():
            asyncio.run(recover(url, spool=spool))
            events = outcome.events
            compare_steps(outcome, steps, url)
            outcome.events = max(events, len(steps.certain))
        step()
    return outcome


def _walk_quietly(url: str, spool: str, name: str, seed: int) -> None:
    sys.stderr = open(os.devnull, "w")  # noqa: SIM115, PTH123  hide the expected errors of the disk
    walk(url, spool, "thread", name, seed)
