"""A machine without power: a real ext4 on a loop image is shut down under a plan, with all that no sync covered.

The kernel is told to drop the file system where it stands, its journal not flushed: what it had not written itself is
gone. Before that, pages are pushed out at random, so that they reach the disk in an order that nobody asked for.
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

from bench.breaking.images import NOT_MADE, DiskImage
from bench.breaking.outcome import Outcome, Step
from bench.breaking.robots import Walked, compare_steps, walk
from bench.breaking.speaking import Speaker
from pycrorm_async.operations.recovery import recover

__all__ = ["power_cuts"]

_SHUTDOWN = 0x8004587D  # EXT4_IOC_SHUTDOWN
_NO_LOG_FLUSH = 2
_WRITE = 2  # SYNC_FILE_RANGE_WRITE
_PAGE = 4096
_LONGEST_LIFE_S = 0.3


class _Disk(DiskImage):
    """An ext4 that can lose its power."""

    def fail(self) -> None:
        """From now on nothing reaches the image, and every sync is an error."""
        place = os.open(self.root, os.O_RDONLY)
        try:
            fcntl.ioctl(place, _SHUTDOWN, struct.pack("I", _NO_LOG_FLUSH))
        finally:
            os.close(place)

    def push_out(self, rng: random.Random) -> None:
        """The kernel writes one page of one file, whenever it likes."""
        with suppress(OSError, IndexError):  # the file is gone, or not there yet
            path = rng.choice([path for path in self.root.rglob("*") if path.is_file()])
            file = os.open(path, os.O_RDONLY)
            try:
                page = rng.randrange(max(1, os.fstat(file).st_size // _PAGE))
                _C.sync_file_range(file, ctypes.c_int64(page * _PAGE), ctypes.c_int64(_PAGE), _WRITE)
            finally:
                os.close(file)


_C = ctypes.CDLL(None)


def power_cuts(rounds: int, rng: random.Random, folder: Path, step: Step) -> Outcome:
    """Round after round on one disk; in each what was synced before, in this round and all before it, must be there."""
    outcome, walked = Outcome(), Walked()
    try:
        disk = _Disk(folder)
        with disk.mounted():
            pass
    except (OSError, subprocess.CalledProcessError):
        outcome.note = NOT_MADE
        return outcome
    outcome.note = "ext4 on a loop image, shut down under a plan, its writer and its SQLite; pages pushed out at random"
    url, spool = f"sqlite:///{disk.root}/memory.db", disk.root / "spool"
    for number in range(rounds):
        with disk.mounted():
            plan = Speaker(_walk_until_the_end, url, str(spool), f"plan{number}", rng.randrange(2**31))
            try:
                plan.wait_for("synced")
                until = time.monotonic() + rng.random() * _LONGEST_LIFE_S
                while time.monotonic() < until:
                    disk.push_out(rng)
                    time.sleep(0.002)
                disk.fail()
            finally:
                said = plan.stop()  # also when the bench is told to end: the disk can be unmounted then
            walked.add(said, when_synced=True)
        with disk.mounted():
            asyncio.run(recover(url, spool=spool))
            events = outcome.events
            compare_steps(outcome, walked, url)
            outcome.events = max(events, len(walked.sure))
        step()
    return outcome


def _walk_until_the_end(url: str, spool: str, name: str, seed: int) -> None:
    sys.stderr = open(os.devnull, "w")  # noqa: SIM115, PTH123  what it says of the dead disk is not ours to show
    walk(url, spool, "thread", name, seed)
