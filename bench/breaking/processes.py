"""Faults of processes: killed recorders and appenders, forks, exits with a full queue, several drains of one folder."""

from __future__ import annotations

import asyncio
import contextlib
import os
import random
import shutil
import signal
import sys
import tempfile
import time
from collections import deque
from collections.abc import Callable
from itertools import count
from pathlib import Path
from typing import NamedTuple

from bench.breaking.child_process import SPAWN, ChildProcess, kill_me_after
from bench.breaking.files import ROOMY, events_of, put
from bench.breaking.outcome import Outcome, Step
from pycrorm_async.errors import SpoolClosed, SpoolFull
from pycrorm_async.events.codec import LOST
from pycrorm_async.events.ids import episode_text
from pycrorm_async.queue import Spool, open_dead
from pycrorm_async.store.address import DatabaseAddress
from tests.crash import recorder_process
from tests.databases import ask
from tests.queue.factories import SMALL, episode, make, node, recover
from tests.store.test_crash import PER_BATCH, append_all, batch

__all__ = ["killed_recorders", "killed_appenders", "forks", "exits_with_a_full_queue", "second_openers"]

_LONGEST_LIFE_S = 0.1
_AT_ONCE = 4
_LONGEST_CPU_S = 0.05


def _lines_until_killed(target: Callable[..., None], arguments: tuple[object, ...], life_s: float) -> list[list[str]]:
    """Run the target, kill it `life_s` after its first line, and return its complete lines."""
    process = ChildProcess(target, *arguments)
    process.wait_for("\n")
    time.sleep(life_s)
    return process.kill()


# --- recorders ------------------------------------------------------------------------------------------------------


def _record(spool: str, seed: int, threads: int, mode: str, cpu_s: float) -> None:
    kill_me_after(cpu_s)
    sys.argv = ["recording", spool, str(seed), str(threads), mode]
    recorder_process.main()


class _Life(NamedTuple):
    """A recorder that kills itself after some CPU time: its spool, its number of threads, and its process."""

    spool: Path
    threads: int
    recorder: ChildProcess


def killed_recorders(rounds: int, rng: random.Random, folder: Path, step: Step) -> Outcome:
    """Kill recorders after up to 0.05 s of CPU time; every event whose put returned must exist."""
    outcome = Outcome(note="one to three threads; in half of the processes a consumer stores events at the same time")
    lives: deque[_Life] = deque()
    for rounds_left in range(rounds, 0, -1):
        while len(lives) < min(_AT_ONCE, rounds_left):
            lives.append(_start(Path(tempfile.mkdtemp(dir=folder)), rng))
        life = lives.popleft()
        _compare_recovered(outcome, life)
        shutil.rmtree(life.spool.parent)
        step()
    return outcome


def _start(place: Path, rng: random.Random) -> _Life:
    spool, threads = place / "spool", rng.choice((1, 1, 2, 3))
    seed, mode, cpu_s = rng.randrange(2**31), rng.choice(("recording", "storing")), rng.random() * _LONGEST_CPU_S
    return _Life(spool, threads, ChildProcess(_record, str(spool), seed, threads, mode, cpu_s))


def _compare_recovered(outcome: Outcome, life: _Life) -> None:
    lines = life.recorder.wait_until_killed()
    acknowledged = {(line[1], int(line[2])) for line in lines if line[0] == "put"}
    by_position = {int(line[1]): (line[2], int(line[3]), line[4]) for line in lines if line[0] == "stored"}
    for recorder in Spool(life.spool).recorders():
        for each in asyncio.run(recover(recorder.path)):
            if each.episode is not None and each.payload != LOST:
                event = (episode_text(each.episode), each.sequence, each.payload.rstrip(b"x").decode())
                outcome.corrupted += by_position.get(each.position, event) != event
                by_position[each.position] = event
    events = [by_position[position] for position in sorted(by_position)]
    outcome.corrupted += sum(text != f"{name}/{sequence}/" for name, sequence, text in events)
    # Each thread may have been killed after it wrote an event and before it printed it.
    outcome.corrupted += max(0, len(events) - len(acknowledged) - life.threads)
    outcome.compare([(*each, f"{each[0]}/{each[1]}/") for each in acknowledged], events, put=events)


# --- appenders ------------------------------------------------------------------------------------------------------

_STORED = (
    "SELECT id, sequence, payload FROM event JOIN episode ON number = event.episode ORDER BY episode.number, sequence"
)


def _append(url: str, first: int) -> None:
    asyncio.run(append_all(DatabaseAddress.parse(url), count(first)))


def killed_appenders(new_database: Callable[[Path], str]) -> Callable[[int, random.Random, Path, Step], Outcome]:
    """Kill a process that appends batches to a database; the next one starts at the last batch that is stored."""

    def killed(rounds: int, rng: random.Random, folder: Path, step: Step) -> Outcome:
        outcome, url = Outcome(note=f"batches of {2 * PER_BATCH} events of two episodes"), new_database(folder)
        stored = appended = 0
        for _ in range(rounds):
            lines = _lines_until_killed(_append, (url, max(stored - 1, 0)), rng.random() * _LONGEST_LIFE_S)
            appended = max([stored, *(int(line[1]) + 1 for line in lines if line[0] == "appended")])
            heads = _wait_for_heads(url) or [0, 0]
            outcome.lost += sum(max(0, appended * PER_BATCH - head) for head in heads)
            outcome.misordered += sum(head % PER_BATCH != 0 for head in heads)  # a batch is stored in part
            stored = heads[0] // PER_BATCH
            step()
        events = [
            (episode_text(each.episode), each.sequence, each.payload.decode())
            for number in range(stored)
            for each in batch(number)
            if each.episode is not None
        ]
        outcome.compare(events[: 2 * PER_BATCH * appended], ask(url, _STORED), put=events)
        outcome.rounds = rounds
        return outcome

    return killed


def _wait_for_heads(url: str) -> list[int]:
    """Return the heads once they no longer change, because a server may still execute a dead client's COMMIT."""
    previous: list[int] = [-1]
    while True:
        heads = [row[0] for row in ask(url, "SELECT head FROM episode ORDER BY number")] if _has_log(url) else []
        if heads == previous:
            return heads
        previous = heads
        time.sleep(0.005 if url.startswith("postgresql") else 0)


def _has_log(url: str) -> bool:
    if url.startswith("postgresql"):
        return bool(ask(url, "SELECT to_regclass('pycrorm.episode') IS NOT NULL")[0][0])
    return bool(ask(url, "SELECT count(*) FROM sqlite_master WHERE name = 'episode'")[0][0])


# --- forks and exits ------------------------------------------------------------------------------------------------


def forks(rounds: int, rng: random.Random, folder: Path, step: Step) -> Outcome:
    """Fork a child while the parent records; the child tries to record and is killed or terminated."""
    outcome = Outcome(note="the child's puts are refused, and the parent's events stay")
    for _ in range(rounds):
        queue = make(Path(tempfile.mkdtemp(dir=folder)) / "spool", settings=ROOMY)
        expected = [put(queue, "EpisodeStarted", b"{}")]
        expected += [put(queue, "NodeStarted", b"before") for _ in range(rng.randrange(9))]
        child = os.fork()
        if child == 0:
            signal.signal(signal.SIGTERM, signal.SIG_DFL)  # the benchmark's handler would delete all folders
            with contextlib.suppress(SpoolClosed):
                queue.put_nowait(node(), b"of the child", reserved=True)
            queue.release()
            os.kill(os.getpid(), rng.choice((signal.SIGKILL, signal.SIGTERM)))
        expected += [put(queue, "NodeStarted", b"after") for _ in range(rng.randrange(9))]
        os.waitpid(child, 0)
        expected += [put(queue, "NodeStarted", b"alone again")]
        queue.release()
        outcome.compare(expected, events_of(asyncio.run(recover(queue.folder))))
        shutil.rmtree(queue.folder.parent)
        step()
    return outcome


def _fill_and_exit(spool: str, exit_by: str) -> None:
    queue = make(Path(spool), settings=SMALL)
    with contextlib.suppress(SpoolFull):
        kind = "EpisodeStarted"
        while True:
            _, sequence, payload = put(queue, kind, b"f" * 200)
            recorder_process.report("put", sequence, payload)
            kind = "NodeStarted"
    recorder_process.report("full", 0, "-")
    if exit_by == "exit":
        raise SystemExit(3)
    if exit_by == "raise":
        sys.stderr = open(os.devnull, "w")  # noqa: SIM115, PTH123  hide the expected traceback
        raise ValueError("the plan failed")
    os._exit(0)


def exits_with_a_full_queue(rounds: int, rng: random.Random, folder: Path, step: Step) -> Outcome:
    """Let a process fill its spool and exit without a drain: by `sys.exit`, by an exception, by `os._exit`."""
    outcome = Outcome(note="sys.exit, an uncaught exception, os._exit")
    for _ in range(rounds):
        spool = Path(tempfile.mkdtemp(dir=folder)) / "spool"
        lines = ChildProcess(_fill_and_exit, str(spool), rng.choice(("exit", "raise", "_exit"))).wait()
        (recorder,) = Spool(spool).recorders()
        recovered = events_of(asyncio.run(recover(recorder.path)))
        name = episode_text(episode(1))
        outcome.compare([(name, int(line[1]), line[2]) for line in lines if line[0] == "put"], recovered)
        shutil.rmtree(spool.parent)
        step()
    return outcome


# --- several drains -------------------------------------------------------------------------------------------------


def _drain_if_unlocked(folder: str, barrier: object) -> None:
    barrier.wait()  # type: ignore[attr-defined]
    recovered = open_dead(Path(folder))
    if recovered is None:
        recorder_process.report("locked")
        return
    records = asyncio.run(recovered.get_batch(events_max=10_000, bytes_max=2**24, age_s_max=0.0))
    for name, sequence, payload in events_of(records):
        recorder_process.report("drained", name, sequence, payload)
    asyncio.run(recovered.acknowledge(records[-1].position))
    recovered.release()


def second_openers(rounds: int, rng: random.Random, folder: Path, step: Step) -> Outcome:
    """Let four processes drain the folder of one dead recorder at the same moment; exactly one of them may."""
    outcome = Outcome(note="four processes, started by one barrier")
    for _ in range(rounds):
        queue = make(Path(tempfile.mkdtemp(dir=folder)) / "spool", settings=ROOMY)
        expected = [put(queue, "EpisodeStarted", b"{}")]
        expected += [put(queue, "NodeStarted", b"x" * rng.randrange(200)) for _ in range(30)]
        queue.release()
        barrier = SPAWN.Barrier(4)
        drainers = [ChildProcess(_drain_if_unlocked, str(queue.folder), barrier) for _ in range(4)]
        drained = [line for each in drainers for line in each.wait() if line[0] == "drained"]
        outcome.compare(expected, [(line[1], int(line[2]), line[3] if len(line) > 3 else "") for line in drained])
        shutil.rmtree(queue.folder.parent)
        step()
    return outcome
