"""Fold workers of a daemon that are killed, or stopped for good, at random moments while a plan records."""

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

from bench.breaking.outcome import Outcome, Step
from bench.breaking.robots import Walked, compare_steps, walk
from bench.breaking.speaking import Speaker
from pycrorm_async.operations.daemon import serve
from pycrorm_async.operations.fold_workers import DaemonNote
from pycrorm_async.operations.recovery import recover
from pycrorm_async.projections.verify.verify import verify
from pycrorm_async.queue.files.spool import Spool
from pycrorm_async.store.address import DatabaseAddress
from pycrorm_async.store.log import EventLog
from tests.crash.step_robot import SETTINGS, say
from tests.databases import Server

__all__ = ["faulty_workers"]

_SETTINGS = replace(
    SETTINGS,
    fold_worker_restart_s=0.02,
    fold_worker_healthy_s=0.01,
    fold_worker_report_s=0.05,
    fold_worker_stopped_s=0.2,
)
_HANGS_S = 120.0
_LONGEST_LIFE_S = 0.2


def _serve(url: str, spool: str) -> None:
    """A daemon with one worker, so that the one that is stopped is the one that is asked next."""
    leave = asyncio.Event()
    asyncio.run(serve(url, spool=Path(spool), leave=leave, say=say, settings=_SETTINGS, fold_workers=1))


def faulty_workers(server: Server | None, end: signal.Signals) -> Callable[[int, random.Random, Path, Step], Outcome]:
    """A worker gets this signal; the daemon replaces it and folds on. In the end log and tables are verified."""

    def made(rounds: int, rng: random.Random, folder: Path, step: Step) -> Outcome:
        outcome, walked = Outcome(note="each was replaced; the tables are compared and verified"), Walked()
        place = Path(tempfile.mkdtemp(dir=folder))
        url = f"sqlite:///{place}/memory.db" if server is None else server.new_database()
        spool = place / "spool"
        daemon = Speaker(_serve, url, str(spool))
        daemon.wait_for("draining")
        plan = Speaker(walk, url, str(spool), "daemon", "plan", rng.randrange(2**31))
        try:
            for _ in range(rounds):
                worker = _worker(Spool(spool), but=None)
                time.sleep(rng.random() * _LONGEST_LIFE_S)
                with suppress(ProcessLookupError):  # it has just been replaced
                    os.kill(worker, end)
                _worker(Spool(spool), but=worker)
                step()
        finally:
            walked.add(plan.kill())
            daemon.kill()
        asyncio.run(recover(url, spool=spool))
        compare_steps(outcome, walked, url)
        outcome.changed += asyncio.run(_differences(url))
        outcome.rounds = rounds
        return outcome

    return made


def _worker(spool: Spool, *, but: int | None) -> int:
    """The process of the worker as soon as it runs and is another one than this."""
    until_s = time.monotonic() + _HANGS_S
    while time.monotonic() < until_s:
        note = spool.writer_note()
        if note is not None:
            for each in msgspec.json.decode(note, type=DaemonNote).fold_workers:
                if each.state == "running" and each.pid is not None and each.pid != but:
                    return each.pid
        time.sleep(0.01)
    raise TimeoutError(f"no worker took the place of {but}: {note!r}")


async def _differences(url: str) -> int:
    log = await EventLog.open(DatabaseAddress.parse(url), create=False)
    try:
        return len((await verify(log)).differences)
    finally:
        await log.close()
