"""Perform a plan on a disk that forgets what was not synced, or whose n-th call fails (`faulty_disk.c`).

Each plan runs in a process of its own, forked from one that was started with the disk preloaded and has imported the
package. Its output is a file on another disk, one line for each call that has returned: `did EPISODE STEP` after a
perform, `synced` and `stored` for all that was done until then, and `refused` with the error.
"""

from __future__ import annotations

import asyncio
import ctypes
import errno
import json
import os
import signal
import sqlite3
import subprocess
import sys
import traceback
import warnings
from collections.abc import Callable
from dataclasses import dataclass, replace
from functools import partial
from pathlib import Path
from typing import Any, Final, NamedTuple

from pycrorm_async import Blob, Memory, PycrormError, Settings, recover
from pycrorm_async.clock import SYSTEM_CLOCK
from pycrorm_async.events.codec import Heading
from pycrorm_async.plan import ActionAbstract
from pycrorm_async.projections.verify import verify
from pycrorm_async.queue import RecorderQueue
from pycrorm_async.store.address import DatabaseAddress
from pycrorm_async.store.log import EventLog
from tests.queue.factories import ended, make, node, started
from tests.queue.test_blobs import OBSERVED, referring

__all__ = ["DiskProcess", "Ended", "FaultyDisk", "Found"]

SETTINGS: Final = Settings(
    sync_interval_ms=3_600_000,  # so that the plan alone decides when a sync begins
    segment_bytes=2**14,
    record_bytes_max=2**12,
    spool_bytes_max=2**20,
    spool_reserve_bytes=2**17,
    flush_timeout_s=60,
)
FAULT_SETTINGS: Final = replace(SETTINGS, flush_timeout_s=5)
"""SQLite ignores that an unlock of its index failed. It keeps the lock for all connections of the process ("locking
protocol") until the last of them is closed, so every flush and the close end with their patience."""
EPISODES, STEPS = 2, 4
_HANGS_S = 300


@dataclass
class StepActionPerformable(ActionAbstract):
    episode: int
    step: int
    note: str

    async def perform(self) -> None:
        """Succeed without doing anything."""


class Ended(NamedTuple):
    """The end of a plan's process: exit code (negative for a signal), lines, and number of syncs and calls."""

    code: int
    lines: list[list[str]]
    syncs: int
    calls: int

    def steps(self, word: str) -> set[tuple[int, int]]:
        """Return the steps performed before the last line that begins with this word."""
        last = max((at for at, line in enumerate(self.lines) if line[0] == word), default=-1)
        return {(int(line[1]), int(line[2])) for line in self.lines[: last + 1] if line[0] == "did"}

    @property
    def faults(self) -> int:
        """The events that could not be recorded, as the memory's status counts them."""
        return next((int(line[1]) for line in self.lines if line[0] == "status"), 0)

    @property
    def refusals(self) -> list[str]:
        return [" ".join(line[1:]) for line in self.lines if line[0] == "refused"]


class Found(NamedTuple):
    """What a memory that was opened again holds: the steps in its log, and the problems that `verify` finds."""

    steps: set[tuple[int, int]]
    problems: list[str]


class DiskProcess:
    """The process that was started with the disk preloaded; each call forks another one from it."""

    def __init__(self, folder: Path) -> None:
        library = folder / "faulty_disk.so"
        source = Path(__file__).with_suffix(".c")
        subprocess.run(["gcc", "-shared", "-fPIC", "-O1", "-o", library, source, "-ldl"], check=True)
        root = Path(__file__).parents[2]
        self._process = subprocess.Popen(
            [sys.executable, "-c", "import tests.preloaded\nfrom tests.crash.faulty_disk import serve; serve()"],
            env=os.environ | {"LD_PRELOAD": str(library), "PYTHONPATH": str(root)},
            stdin=subprocess.PIPE,
            stdout=subprocess.PIPE,
            text=True,
            bufsize=1,
        )

    def call(self, name: str, output: Path, *arguments: object) -> tuple[int, str]:
        """Call the function in a fork; return the exit code, negative for a signal, and what was written."""
        assert self._process.stdin is not None
        assert self._process.stdout is not None
        self._process.stdin.write(json.dumps([name, str(output), *arguments]) + "\n")
        code = int(self._process.stdout.readline())
        assert code != -signal.SIGALRM, f"it hangs: {output.read_text()}"
        return code, output.read_text()

    def close(self) -> None:
        assert self._process.stdin is not None
        assert self._process.stdout is not None
        self._process.stdin.close()
        self._process.stdout.close()
        self._process.wait()


class FaultyDisk:
    """A disk with one memory, and the process from which plans on it are forked."""

    def __init__(self, process: DiskProcess, place: Path) -> None:
        self._process = process
        self._place = place
        self.disk = place / "disk"
        self._shadow = place / "shadow"
        for each in (self.disk, self._shadow):
            each.mkdir(parents=True)
        self._identity = self.disk.stat().st_ino

    def perform(self, *, cut: int = 0) -> Ended:
        """Perform the plan on a disk that forgets; cut the power before the n-th sync, or when the plan has ended."""
        return self._ended(self._process.call("perform", self._place / "lines", *self._paths, ["cut", cut, 0]))

    def perform_with_fault(self, n: int, *, number: int = errno.EIO) -> Ended:
        """Perform the plan on a disk whose n-th call fails with this error."""
        fault = ["fail", n, number]
        return self._ended(self._process.call("perform", self._place / "lines", *self._paths, fault))

    def record_with_fault(self, n: int, *, number: int = errno.EIO) -> Ended:
        """Record with a queue alone, on a disk whose n-th call fails with this error."""
        fault = ["fail", n, number]
        return self._ended(self._process.call("record", self._place / "lines", *self._paths, fault))

    def cut_power(self) -> None:
        """Leave on the disk what was durable."""
        self.disk.rename(self._place / "before")
        self._restore(next(self._shadow.glob(f"d-{self._identity}-*")), self.disk)

    def found(self) -> Found:
        """Open the memory again on a disk without faults."""
        code, text = self._process.call("examine", self._place / "found", str(self.disk))
        assert code == 0, text
        found = json.loads(text.splitlines()[-1])
        return Found({(episode, step) for episode, step in found["steps"]}, found["problems"])

    @property
    def _paths(self) -> tuple[str, str]:
        return str(self.disk), str(self._shadow)

    def _ended(self, result: tuple[int, str]) -> Ended:
        code, text = result
        assert "Traceback" not in text, text
        lines = [line.split() for line in text[: text.rfind("\n") + 1].splitlines()]
        counts = next((line for line in lines if line[0] == "counts"), ["counts", "0", "0"])
        return Ended(code, lines, int(counts[1]), int(counts[2]))

    def _restore(self, listing: Path, target: Path) -> None:
        target.mkdir()
        for line in listing.read_text().splitlines() if listing.exists() else ():
            identity, _, name = line.partition(" ")
            copy = self._shadow / identity
            if identity[0] == "d":
                self._restore(copy, target / name)
            else:
                (target / name).write_bytes(copy.read_bytes() if copy.exists() else b"")


# --- in the process with the disk -----------------------------------------------------------------------------------


def serve() -> None:
    """Fork a process for each line of the input, and write its exit code."""
    warnings.simplefilter("error")
    for line in sys.stdin:
        name, output, *arguments = json.loads(line)
        child = os.fork()
        if child == 0:
            for stream, path in ((1, output), (2, f"{output}.err")):
                os.dup2(os.open(path, os.O_WRONLY | os.O_CREAT | os.O_TRUNC), stream)
            signal.alarm(_HANGS_S)
            try:
                globals()[name](*arguments)
                sys.stdout.flush()
                os._exit(0)
            except BaseException:  # noqa: BLE001  as the interpreter would
                _say(traceback.format_exc())
                os._exit(1)
        _, status = os.waitpid(child, 0)
        print(os.waitstatus_to_exitcode(status), flush=True)


def _say(*words: object) -> None:
    os.write(1, (" ".join(map(str, words)) + "\n").encode())


def perform(folder: str, shadow: str, fault: list[Any]) -> None:
    """Perform the plan with a fault of the disk."""
    settings = SETTINGS if fault[0] == "cut" else FAULT_SETTINGS
    _run_with(folder, shadow, fault, partial(_perform, f"sqlite:///{folder}/memory.db", settings))


def record(folder: str, shadow: str, fault: list[Any]) -> None:
    """Record with a queue alone, and read and acknowledge what is synced, with a fault of the disk."""
    _run_with(folder, shadow, fault, partial(_record, Path(folder)))


def _run_with(folder: str, shadow: str, fault: list[Any], plan: Callable[[], Any]) -> None:
    disk = ctypes.CDLL(None)
    disk.disk_failed.restype = ctypes.c_char_p
    disk.disk_watch(folder.encode())
    kind, n, value = fault
    if kind == "cut":
        disk.disk_cut_at(shadow.encode(), n)
    else:
        disk.disk_fail_at(n, value, int(value == errno.ENOSPC))
    asyncio.run(plan())
    _say("counts", disk.disk_syncs(), disk.disk_calls(), disk.disk_failed().decode())


async def _perform(url: str, settings: Settings) -> None:
    memory = Memory.open(url, settings=settings)
    try:
        await memory.__aenter__()
    except PycrormError as error:
        _say("refused", error)
        return
    for episode in range(EPISODES):
        async with memory.episode(description=f"episode {episode}"):
            for step in range(STEPS):
                await StepActionPerformable(episode, step, "x" * 1500).perform()
                memory.observe("camera", Blob(bytes([episode, step]) * 700))
                _say("did", episode, step)
                if step % 2:
                    await _acknowledged("synced", memory.synced)
        await _acknowledged("stored", memory.flush)
    status = memory.status
    _say("status", status.faults.total, status.missing, status.spool_fault, status.spool_lost, status.writer)
    try:
        await memory.__aexit__(None, None, None)
    except PycrormError as error:
        _say("refused", error)


async def _record(folder: Path) -> None:
    try:
        queue = make(folder / "spool", settings=SETTINGS, clock=SYSTEM_CLOCK)
    except PycrormError as error:
        _say("refused", error)
        return
    for turn in range(3):
        if turn == 0:
            _put(queue, started(), b"{}")
        for content in (bytes([turn]) * 900, b"x" * 3000, b"y" * 3000):
            try:
                name = queue.put_blob(content) if turn != 1 else ""
            except PycrormError as error:
                _say("refused", error)
                continue
            _put(queue, OBSERVED if name else node(), referring(name, len(content)) if name else content)
            if name:
                queue.release_blob(name)
        await _acknowledged("synced", queue.synced_to)
        await _store(queue)
    _put(queue, ended(), b"{}")
    queue.close()
    await _store(queue)
    try:
        queue.release()
    except PycrormError as error:
        _say("refused", error)


def _put(queue: RecorderQueue, heading: Heading, payload: bytes) -> None:
    try:
        _say("put", queue.put_nowait(heading, payload))
    except PycrormError as error:
        _say("refused", error)


async def _store(queue: RecorderQueue) -> None:
    """Store what is synced by now, as the writer does."""
    try:
        if queue.stored < queue.synced or queue.ends_at(queue.written):
            batch = await queue.get_batch(events_max=100, bytes_max=2**20, age_s_max=0.0)
            for each in batch:
                _say("stored", each.sequence)
            if batch:
                await queue.acknowledge(batch[-1].position)
    except PycrormError as error:
        _say("refused", error)


async def _acknowledged(word: str, wait: Any) -> None:
    try:
        await wait()
    except PycrormError as error:
        _say("refused", error)
    else:
        _say(word)


def examine(folder: str) -> None:
    """Open the memory, store what dead recorders left, verify everything, and write what there is."""
    print(json.dumps(asyncio.run(_examine(f"sqlite:///{folder}/memory.db"))))


async def _examine(url: str) -> dict[str, Any]:
    async with Memory.open(url, settings=SETTINGS):
        pass  # what dead recorders left is stored meanwhile, or else below
    problems = [f"{name}: {error}" for name, error in (await recover(url, settings=SETTINGS)).failed.items()]
    log = await EventLog.open(DatabaseAddress.parse(url), create=False)
    result = await verify(log)
    await log.close()
    problems += [str(each) for each in (*result.damages, *result.differences, *result.stopped)]
    database = sqlite3.connect(url.removeprefix("sqlite:///"))
    rows = database.execute("SELECT payload FROM event WHERE type = 'NodeStarted' AND payload LIKE '%\"step\"%'")
    steps = [(each["episode"], each["step"]) for (text,) in rows for each in [json.loads(text)["parameters"]]]
    database.close()
    if len(set(steps)) < len(steps):
        problems.append(f"steps are stored twice: {sorted(steps)}")
    return {"steps": steps, "problems": problems}
