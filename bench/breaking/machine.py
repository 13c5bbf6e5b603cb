"""Cut the power of a real disk: shut down an ext4 on a loop image while a plan runs, and lose all unsynced data.

An ioctl makes the kernel shut down the file system without flushing its journal, so everything that it had not written
is lost. Before that, pages are written back at random, so that they reach the disk in an arbitrary order.
"""

from __future__ import annotations

import asyncio
import ctypes
import fcntl
import os
import random
import struct
import subprocess
import sys
import time
from contextlib import suppress
from pathlib import Path

from bench.breaking.child_process import ChildProcess
from bench.breaking.images import NOT_MADE, DiskImage
from bench.breaking.outcome import Outcome, Step
from bench.breaking.robots import RecordedSteps, compare_steps, walk
from pycrorm_async.operations.recovery import recover

__all__ = ["power_cuts"]

_SHUTDOWN = 0x8004587D  # EXT4_IOC_SHUTDOWN
_NO_LOG_FLUSH = 2
_WRITE = 2  # SYNC_FILE_RANGE_WRITE
_PAGE = 4096
_LONGEST_LIFE_S = 0.3


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
                deadline = time.monotonic() + rng.random() * _LONGEST_LIFE_S
                while time.monotonic() < deadline:
                    disk.write_back_a_page(rng)
                    time.sleep(0.002)
                disk.fail()
            finally:
                lines = plan.stop()  # also on SIGTERM to the benchmark, because the disk can be unmounted only then
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
