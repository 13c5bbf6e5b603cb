"""Kill or stop fold workers of a daemon at random moments while a plan records."""

from __future__ import annotations

import asyncio
import os
import random
import signal
import tempfile
import time
from collections.abc import Callable
from contextlib import suppress
from dataclasses import replace
from pathlib import Path

import msgspec

from bench.breaking.child_process import ChildProcess
from bench.breaking.outcome import Outcome, Step
from bench.breaking.robots import RecordedSteps, compare_steps, walk
from pycrorm_async.operations.daemon import serve
from pycrorm_async.operations.recovery import recover
from pycrorm_async.operations.workers import DaemonNote
from pycrorm_async.projections.verify import verify
from pycrorm_async.queue.spool import Spool
from pycrorm_async.store.address import DatabaseAddress
from pycrorm_async.store.log import EventLog
from tests.crash.step_robot import SETTINGS, report
from tests.databases import Server

__all__ = ["faulty_workers"]

_SETTINGS = replace(
    SETTINGS,
    fold_worker_restart_s=0.02,
    fold_worker_healthy_s=0.01,
    fold_worker_report_s=0.05,
    fold_worker_stopped_s=0.2,
)
_REPLACED_S_MAX = 120.0
_LONGEST_LIFE_S = 0.2


def _serve(url: str, spool: str) -> None:
    """Run a daemon with one fold worker, so that the daemon must use the worker that is stopped."""
    leave = asyncio.Event()
    asyncio.run(serve(url, spool=Path(spool), stop=leave, report=report, settings=_SETTINGS, fold_workers=1))


def faulty_workers(
    server: Server | None, end_signal: signal.Signals
) -> Callable[[int, random.Random, Path, Step], Outcome]:
    """Send a signal to the fold worker, and wait for its replacement; at the end verify log and tables."""

    def run(rounds: int, rng: random.Random, folder: Path, step: Step) -> Outcome:
        outcome, steps = Outcome(note="each worker was replaced; the tables are compared and verified"), RecordedSteps()
        place = Path(tempfile.mkdtemp(dir=folder))
        url = f"sqlite:///{place}/memory.db" if server is None else server.new_database()
        spool = place / "spool"
        daemon = ChildProcess(_serve, url, str(spool))
        daemon.wait_for("draining")
        plan = ChildProcess(walk, url, str(spool), "daemon", "plan", rng.randrange(2**31))
        try:
            for _ in range(rounds):
                worker = _worker(Spool(spool), other_than=None)
                time.sleep(rng.random() * _LONGEST_LIFE_S)
                with suppress(ProcessLookupError):  # the daemon has just replaced it
                    os.kill(worker, end_signal)
                _worker(Spool(spool), other_than=worker)
                step()
        finally:
            steps.add(plan.kill())
            daemon.kill()
        asyncio.run(recover(url, spool=spool))
        compare_steps(outcome, steps, url)
        outcome.corrupted += asyncio.run(_differences(url))
        outcome.rounds = rounds
        return outcome

    return run


def _worker(spool: Spool, *, other_than: int | None) -> int:
    """Wait for a running fold worker with another pid than `other_than`; return its pid."""
    deadline_s = time.monotonic() + _REPLACED_S_MAX
    while time.monotonic() < deadline_s:
        note = spool.writer_note()
        if note is not None:
            for each in msgspec.json.decode(note, type=DaemonNote).fold_workers:
                if each.state == "running" and each.pid is not None and each.pid != other_than:
                    return each.pid
        time.sleep(0.01)
    raise TimeoutError(
        f"no fold worker replaced pid {other_than} within {_REPLACED_S_MAX:g} s; the daemon's note is {note!r}"
    )


async def _differences(url: str) -> int:
    log = await EventLog.open(DatabaseAddress.parse(url), create=False)
    try:
        return len((await verify(log)).differences)
    finally:
        await log.close()
