"""Fill and unplug real file systems, in images that are mounted: a put fails with an error and no signal kills it, and
a power cut takes nothing that was synced.

The machines without power of `disk_machine.py` and `faulty_disk.c` run at each commit and meet every state. These show
that a kernel behaves as they do. They are skipped where no image can be mounted.
"""

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

import pytest

from pycrorm_async import recover
from pycrorm_async.clock import SYSTEM_CLOCK
from pycrorm_async.errors import SpoolFull
from pycrorm_async.events.codec import LOST
from pycrorm_async.queue import RecorderQueue, Spool
from pycrorm_async.settings import Settings
from tests.crash.forked_processes import ForkedProcess
from tests.crash.step_robot import RecordedSteps, report, verify_kept, walk
from tests.queue.factories import RECORDER, node, started
from tests.queue.factories import recover as recover_records

pytestmark = pytest.mark.soak

SIZES = {"ext4": "64M", "xfs": "320M"}
"""The smallest size that each mkfs accepts."""
SETTINGS = Settings(
    sync_interval_ms=1, segment_bytes=2**17, spool_bytes_max=2**24, spool_reserve_bytes=2**18, record_bytes_max=2**12
)
_C = ctypes.CDLL(None)
_SHUTDOWN, _NO_LOG_FLUSH = 0x8004587D, 2  # EXT4_IOC_SHUTDOWN
_WRITE = 2  # SYNC_FILE_RANGE_WRITE
_PAGE = 4096


class DiskImage:
    """A file system in an image file, mounted at `root`."""

    def __init__(self, folder: Path, kind: str) -> None:
        self._image = folder / "disk.img"
        self.root = folder / "disk"
        self.root.mkdir()
        subprocess.run(["truncate", "-s", SIZES[kind], self._image], check=True)
        try:
            force = "-F" if kind == "ext4" else "-f"
            subprocess.run([f"mkfs.{kind}", "-q", force, self._image], check=True, capture_output=True)
            with self.mounted():
                pass
        except (OSError, subprocess.CalledProcessError):
            pytest.skip(f"no {kind} in an image can be made and mounted here")

    @contextmanager
    def mounted(self) -> Iterator[None]:
        """Mount the image; this replays the journal of the file system."""
        subprocess.run(["mount", "-o", "loop", self._image, self.root], check=True, capture_output=True)
        try:
            yield
        finally:
            subprocess.run(["umount", self.root], check=True)

    def fill(self) -> None:
        """Allocate all free blocks without writing to them."""
        with (self.root / "filler").open("wb") as file:
            end, size = 0, 2**26
            while size >= 2**12:
                try:
                    os.posix_fallocate(file.fileno(), end, size)
                    end += size
                except OSError:
                    size //= 2

    def cut_power(self) -> None:
        """Let the kernel shut down the file system without its journal: nothing more reaches the image."""
        place = os.open(self.root, os.O_RDONLY)
        try:
            fcntl.ioctl(place, _SHUTDOWN, struct.pack("I", _NO_LOG_FLUSH))
        finally:
            os.close(place)

    def write_back_a_page(self, rng: random.Random) -> None:
        """Start the write-back of one random page of one random file, so that pages reach the disk in any order."""
        with suppress(OSError, IndexError):  # the file was deleted, or no file exists yet
            path = rng.choice([path for path in self.root.rglob("*") if path.is_file()])
            file = os.open(path, os.O_RDONLY)
            try:
                page = rng.randrange(max(1, os.fstat(file).st_size // _PAGE))
                _C.sync_file_range(file, ctypes.c_int64(page * _PAGE), ctypes.c_int64(_PAGE), _WRITE)
            finally:
                os.close(file)


def record_on_a_full_disk(spool: str, seed: int) -> None:
    """Put events and print each one; when the disk is full, print `full` once and retry without end."""
    rng = random.Random(seed)
    queue = RecorderQueue.create(Path(spool), settings=SETTINGS, clock=SYSTEM_CLOCK, recorder=RECORDER)
    is_full = False
    for number in count():
        payload = rng.randbytes(rng.randrange(1, 900)).hex().encode()
        try:
            sequence = queue.put_nowait(node() if number else started(), payload, reserved=True)
        except SpoolFull:
            if not is_full:
                report("full")
            is_full = True
            time.sleep(0.001)
        else:
            report("put", sequence, payload.decode())
        if number == 20:
            report("ready")
        if 20 < number < 200:
            time.sleep(0.0005)  # slow enough that the disk is filled in the meantime


@pytest.mark.parametrize("kind", SIZES)
def test_a_full_disk_kills_no_recorder_and_takes_no_event(
    tmp_path: Path, kind: str, in_turn: bool, rng: random.Random
) -> None:
    disk = DiskImage(tmp_path, kind)
    spool = disk.root / "spool"
    for _ in range(10 if in_turn else 200):
        with disk.mounted():
            recorder = ForkedProcess(record_on_a_full_disk, str(spool), rng.randrange(2**31))
            try:
                recorder.wait_for("ready")
                disk.fill()
                recorder.wait_for("full")
                time.sleep(rng.random() * 0.05)
                lines = recorder.kill_and_read()  # fails if it ended by itself, for example by SIGBUS
            finally:
                recorder.process.kill()
            put = [("", int(line[1]), line[2]) for line in lines if line[0] == "put"]
            (disk.root / "filler").unlink()
            [folder] = Spool(spool).recorders()
            records = [each for each in asyncio.run(recover_records(folder.path)) if each.payload != LOST]
            events = [("", each.sequence, each.payload.decode()) for each in records]
            verify_kept(put, events, possible=events[len(put) :][:1])
            shutil.rmtree(spool)


def test_a_power_cut_of_a_real_disk_takes_no_step_that_was_synced(
    tmp_path: Path, in_turn: bool, rng: random.Random
) -> None:
    disk, steps = DiskImage(tmp_path, "ext4"), RecordedSteps()
    url, spool = f"sqlite:///{disk.root}/memory.db", disk.root / "spool"
    for number in range(25 if in_turn else 500):
        with disk.mounted():
            plan = ForkedProcess(walk_quietly, url, str(spool), f"plan{number}", rng.randrange(2**31))
            try:
                plan.wait_for("synced")
                deadline = time.monotonic() + rng.random() * 0.3
                while time.monotonic() < deadline:
                    disk.write_back_a_page(rng)
                    time.sleep(0.002)
                disk.cut_power()
            finally:
                plan.kill()  # only then can the disk be unmounted
            steps.add(plan.words, when_synced=True)
        with disk.mounted():
            asyncio.run(recover(url, spool=spool))
            steps.verify(url)


def walk_quietly(url: str, spool: str, name: str, seed: int) -> None:
    sys.stderr = open(os.devnull, "w")  # noqa: SIM115, PTH123  hides the expected errors of the disk
    walk(url, spool, "thread", name, seed)
