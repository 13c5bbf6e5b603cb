"""Faults of processes: killed recorders, plans, daemons and fold workers, forks, exits, several drains."""

from __future__ import annotations

import asyncio
import contextlib
import ctypes
import itertools
import multiprocessing
import os
import random
import shutil
import signal
import struct
import sys
import tempfile
import time
from collections import deque
from collections.abc import Callable
from contextlib import suppress
from dataclasses import replace
from itertools import count
from multiprocessing.context import ForkServerProcess
from pathlib import Path
from typing import NamedTuple

import msgspec

from bench.breaking.databases import start_again
from bench.breaking.files import events_of, put
from bench.breaking.outcome import Event, Outcome, Step
from pycrorm_async import Memory
from pycrorm_async.errors import SpoolClosed, SpoolFull
from pycrorm_async.events.codec import LOST, Record
from pycrorm_async.events.ids import episode_text
from pycrorm_async.operations.daemon import serve
from pycrorm_async.operations.recovery import recover as recover_spool
from pycrorm_async.operations.workers import DaemonNote
from pycrorm_async.projections.verify import verify
from pycrorm_async.queue import Spool, open_dead
from pycrorm_async.settings import Writer
from pycrorm_async.store.address import DatabaseAddress
from pycrorm_async.store.log import EventLog
from tests.crash import recorder_process
from tests.crash.disk_machine import ROOMY
from tests.crash.forked_processes import ForkedProcess
from tests.crash.step_robot import SETTINGS, StepActionPerformable, report
from tests.databases import Server, ask
from tests.queue.factories import SMALL, episode, make, node, recover
from tests.store.factories import episode as store_episode
from tests.store.factories import run_of

# === child process ============================================================================================
#
# Run a function in a child process that prints its progress; the parent keeps the output when the child is killed.

SPAWN = multiprocessing.get_context("forkserver")
_LOADED = ["bench.breaking.disks", "bench.breaking.files", "rich.progress", "rich.table"]


def _fork(process: ForkServerProcess) -> None:
    """Fork from a server that has imported these modules, instead of starting an interpreter that imports them."""
    SPAWN.set_forkserver_preload(_LOADED)
    process.start()


class ChildProcess(ForkedProcess):
    """A process whose whole output is read when it has ended: lines, split into words."""

    def __init__(self, target: Callable[..., None], *arguments: object) -> None:
        super().__init__(target, *arguments, start=_fork)

    def kill_and_read(self) -> list[list[str]]:
        """Send SIGKILL. Raise `RuntimeError` if the process had already ended."""
        self.process.kill()
        return self.read_when_killed()

    def read_when_killed(self) -> list[list[str]]:
        """Wait until another process, or the child itself, sends SIGKILL. Raise `RuntimeError` if it ends otherwise."""
        if (code := self.wait()) != -signal.SIGKILL:
            raise RuntimeError(f"the process was not killed but ended with exit code {code}")
        return self.words

    def stop_and_read(self) -> list[list[str]]:
        """Kill it if it still runs."""
        self.process.kill()
        return self.read_at_end()

    def read_at_end(self) -> list[list[str]]:
        self.wait()
        return self.words


def kill_me_after(cpu_s: float) -> None:
    """Let the kernel send SIGKILL to this process after `cpu_s` more seconds of CPU time.

    CPU time makes the life of the process equally long on a busy and on an idle machine.
    """
    event, timer = struct.pack("Pii48x", 0, signal.SIGKILL, 0), ctypes.c_void_p()
    assert _C.timer_create(time.CLOCK_PROCESS_CPUTIME_ID, event, ctypes.byref(timer)) == 0
    assert _C.timer_settime(timer, 0, struct.pack("4l", 0, 0, 0, max(1, round(cpu_s * 1e9))), None) == 0


_C = ctypes.CDLL(None)


# === processes ================================================================================================
#
# Faults of processes: killed recorders and appenders, forks, exits with a full queue, several drains of one folder.

_LONGEST_LIFE_S = 0.1
_AT_ONCE = 4
_LONGEST_CPU_S = 0.05


def _lines_until_killed(target: Callable[..., None], arguments: tuple[object, ...], life_s: float) -> list[list[str]]:
    """Run the target, kill it `life_s` after its first line, and return its complete lines."""
    process = ChildProcess(target, *arguments)
    process.wait_for("\n")
    time.sleep(life_s)
    return process.kill_and_read()


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
    lines = life.recorder.read_when_killed()
    acknowledged = {(line[1], int(line[2])) for line in lines if line[0] == "put"}
    by_position = {int(line[1]): (line[2], int(line[3]), line[4]) for line in lines if line[0] == "stored"}
    ends: list[tuple[int, str, int]] = []
    for recorder in Spool(life.spool).recorders():
        records = asyncio.run(recover(recorder.path))
        outcome.corrupted += bool(records) and asyncio.run(recover(recorder.path)) != records
        for each in records:
            assert each.episode is not None, "it declares nothing"
            if each.payload == LOST:
                ends.append((each.position, episode_text(each.episode), each.sequence))
                continue
            event = (episode_text(each.episode), each.sequence, each.payload.rstrip(b"x").decode())
            outcome.corrupted += by_position.get(each.position, event) != event
            by_position[each.position] = event
    events = [by_position[position] for position in sorted(by_position)]
    last = {name: sequence for name, sequence, _ in events}
    outcome.misordered += [*sorted(by_position), *(at for at, *_ in ends)] != [*range(1, len(events) + len(ends) + 1)]
    outcome.corrupted += len(ends) > life.threads
    outcome.misordered += sum(sequence != last.get(name, 0) + 1 for _, name, sequence in ends)
    outcome.corrupted += sum(text != f"{name}/{sequence}/" for name, sequence, text in events)
    # Each thread may have been killed after it wrote an event and before it printed it.
    outcome.corrupted += max(0, len(events) - len(acknowledged) - life.threads)
    outcome.compare([(*each, f"{each[0]}/{each[1]}/") for each in acknowledged], events, put=events)


# --- appenders ------------------------------------------------------------------------------------------------------

_STORED = (
    "SELECT id, sequence, payload FROM event JOIN episode ON number = event.episode ORDER BY episode.number, sequence"
)


_PER_BATCH = 300


def _batch(number: int) -> list[Record]:
    first = number * _PER_BATCH + 1
    return [each for of in (1, 2) for each in run_of(store_episode(of), first, first + _PER_BATCH - 1)]


async def _append_all(url: str, first: int) -> None:
    log = await EventLog.open(DatabaseAddress.parse(url), create=True)
    for number in count(first):
        assert await log.append(_batch(number)) == {}
        recorder_process.report("appended", number)


def _append(url: str, first: int) -> None:
    asyncio.run(_append_all(url, first))


def killed_appenders(new_database: Callable[[Path], str]) -> Callable[[int, random.Random, Path, Step], Outcome]:
    """Kill a process that appends batches to a database; the next one starts at the last batch that is stored."""

    def killed(rounds: int, rng: random.Random, folder: Path, step: Step) -> Outcome:
        outcome, url = Outcome(note=f"batches of {2 * _PER_BATCH} events of two episodes"), new_database(folder)
        stored = appended = 0
        for _ in range(rounds):
            lines = _lines_until_killed(_append, (url, max(stored - 1, 0)), rng.random() * _LONGEST_LIFE_S)
            appended = max([stored, *(int(line[1]) + 1 for line in lines if line[0] == "appended")])
            heads = _wait_for_heads(url) or [0, 0]
            outcome.lost += sum(max(0, appended * _PER_BATCH - head) for head in heads)
            outcome.misordered += sum(head % _PER_BATCH != 0 for head in heads)  # a batch is stored in part
            stored = heads[0] // _PER_BATCH
            step()
        events = [
            (episode_text(each.episode), each.sequence, each.payload.decode())
            for number in range(stored)
            for each in _batch(number)
            if each.episode is not None
        ]
        outcome.compare(events[: 2 * _PER_BATCH * appended], ask(url, _STORED), put=events)
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
        lines = ChildProcess(_fill_and_exit, str(spool), rng.choice(("exit", "raise", "_exit"))).read_at_end()
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
        drained = [line for each in drainers for line in each.read_at_end() if line[0] == "drained"]
        outcome.compare(expected, [(line[1], int(line[2]), line[3] if len(line) > 3 else "") for line in drained])
        shutil.rmtree(queue.folder.parent)
        step()
    return outcome


# === robots ===================================================================================================
#
# Kill plans that record with a writer thread or through the daemon, kill the daemon, and kill its server.
#
# The lines that a plan printed before its death are compared with the rows of its steps. The comparison therefore
# covers everything between `perform` and the tables.

_LONGEST_ROBOT_S = 0.2
_SETTINGS = replace(SETTINGS, connect_timeout_s=3600.0, flush_timeout_s=3600.0)
"""Timeouts that no busy machine reaches: opening a database may take a minute there."""
_STEPS = (
    "SELECT place, step, status FROM step_action JOIN task_tree_node ON step_action.id = task_tree_node.id"
    " ORDER BY step_action.id"
)
_INCOMPLETE = (
    "SELECT count(*) FROM episode WHERE refused IS NOT NULL OR parked IS NOT NULL OR head <> folded OR head <>"
    " (SELECT count(*) FROM event WHERE event.episode = episode.number)"
)


def walk(url: str, spool: str, writer: Writer, name: str, seed: int) -> None:
    """Run an endless plan; print `did PLACE STEP` after each `perform`, and `synced` after a sync of all of them."""
    asyncio.run(_walk(url, Path(spool), writer, name, random.Random(seed)))


async def _walk(url: str, spool: Path, writer: Writer, name: str, rng: random.Random) -> None:
    async with Memory.open(url, spool=spool, writer=writer, settings=_SETTINGS) as memory:
        for number in itertools.count():
            place = f"{name}.{number}"
            async with memory.episode(description=place):
                for step in range(1, rng.randrange(2, 60)):
                    await StepActionPerformable(place, step).perform()
                    report("did", place, step)
                    chance = rng.random()
                    if chance < 0.5:
                        await asyncio.sleep(rng.random() * 0.005)
                    elif chance < 0.55:
                        await memory.synced()
                        report("synced")
            report("ended", place)


class RecordedSteps:
    """Collect the lines of killed plans: `certain` steps must exist, `possible` steps may exist.

    `ended` holds the places whose episodes ended before the plan was killed.
    """

    def __init__(self) -> None:
        self.certain: list[Event] = []
        self.possible: list[Event] = []
        self.ended: set[str] = set()

    def add(self, lines: list[list[str]], *, when_synced: bool = False) -> None:
        """Add the lines of one plan. With `when_synced` only the steps before the last `synced` are certain."""
        returned = [(index, line[1], int(line[2])) for index, line in enumerate(lines) if line[0] == "did"]
        end = max([-1, *(index for index, line in enumerate(lines) if line[0] == "synced")])
        done = [(index, (place, step, "SUCCEEDED")) for index, place, step in returned]
        self.certain += [each for index, each in done if index < end or not when_synced]
        self.ended |= {line[1] for line in lines if line[0] == "ended" and not when_synced}
        uncertain = [each for index, each in done if index > end and when_synced]
        # The plan died in the next step of the episode or in the first of the next one: LOST unless it had ended.
        last, sequence = (returned[-1][1], returned[-1][2]) if returned else ("", 0)
        name, _, number = last.rpartition(".")
        following = [(last, sequence + 1), (f"{name}.{int(number) + 1}", 1)] if returned else []
        self.possible += uncertain + [(place, step, "LOST") for place, step, _ in uncertain]
        self.possible += [(place, step, status) for place, step in following for status in ("SUCCEEDED", "LOST")]


def compare_steps(outcome: Outcome, steps: RecordedSteps, url: str) -> None:
    """Count one round: compare the rows of the steps, and count incomplete episodes. No process may still write."""
    rows = [(place, step, status) for place, step, status in ask(url, _STEPS)]
    outcome.compare(steps.certain, rows, put=steps.possible)
    outcome.corrupted += ask(url, _INCOMPLETE)[0][0]
    episodes = ask(url, "SELECT description, status FROM process_metadata")
    outcome.duplicated += len(episodes) - len(dict(episodes))
    outcome.corrupted += sum(dict(episodes).get(place) != "SUCCEEDED" for place in steps.ended)


def killed_plans(rounds: int, rng: random.Random, folder: Path, step: Step) -> Outcome:
    """Kill a plan with its writer thread; the next plan recovers its folder and is killed too."""
    outcome = Outcome(note="SQLite; each plan recovers the folder of the killed one; the tables are compared")
    url, spool, steps = f"sqlite:///{folder}/memory.db", folder / "spool", RecordedSteps()
    for number in range(rounds):
        plan = ChildProcess(walk, url, str(spool), "thread", f"plan{number}", rng.randrange(2**31))
        plan.wait_for("did")
        time.sleep(rng.random() * _LONGEST_ROBOT_S)
        steps.add(plan.kill_and_read())
        step()
    asyncio.run(recover_spool(url, spool=spool))
    compare_steps(outcome, steps, url)
    outcome.rounds = rounds
    return outcome


def _serve(url: str, spool: str) -> None:
    asyncio.run(serve(url, spool=Path(spool), stop=asyncio.Event(), report=report))


def killed_daemons(server: Server | None) -> Callable[[int, random.Random, Path, Step], Outcome]:
    """Kill the daemon while three plans record; at random also kill a plan, and the server if there is one."""

    def killed(rounds: int, rng: random.Random, folder: Path, step: Step) -> Outcome:
        outcome = Outcome(
            note="SQLite; plans are killed too" if server is None else "PostgreSQL; plans and the server are killed too"
        )
        place = Path(tempfile.mkdtemp(dir=folder))
        url = f"sqlite:///{place}/memory.db" if server is None else server.new_database()
        spool, steps, names = place / "spool", RecordedSteps(), itertools.count()

        def start() -> ChildProcess:
            return ChildProcess(walk, url, str(spool), "daemon", f"plan{next(names)}", rng.randrange(2**31))

        plans = [start() for _ in range(3)]
        for _ in range(rounds):
            daemon = ChildProcess(_serve, url, str(spool))
            daemon.wait_for("draining")
            time.sleep(rng.random() ** 2 * 0.5)
            if rng.random() < 0.3:
                steps.add(plans.pop(rng.randrange(len(plans))).kill_and_read())
                plans.append(start())
            if server is not None and rng.random() < 0.1:
                server.kill()
                time.sleep(rng.random() * 0.1)
                start_again(server)
            daemon.kill_and_read()
            step()
        for each in plans:
            each.wait_for("did")
            steps.add(each.kill_and_read())
        asyncio.run(recover_spool(url, spool=spool))
        compare_steps(outcome, steps, url)
        outcome.rounds = rounds
        return outcome

    return killed


# === workers ==================================================================================================
#
# Kill or stop fold workers of a daemon at random moments while a plan records.

_REPLACED_S_MAX = 120.0


def _serve_with_workers(url: str, spool: str) -> None:
    """Run a daemon with one fold worker, so that the daemon must use the worker that is stopped."""
    leave = asyncio.Event()
    asyncio.run(serve(url, spool=Path(spool), stop=leave, report=report, settings=SETTINGS, fold_workers=1))


def faulty_workers(
    server: Server | None, end_signal: signal.Signals
) -> Callable[[int, random.Random, Path, Step], Outcome]:
    """Send a signal to the fold worker, and wait for its replacement; at the end verify log and tables."""

    def run(rounds: int, rng: random.Random, folder: Path, step: Step) -> Outcome:
        outcome, steps = Outcome(note="each worker was replaced; the tables are compared and verified"), RecordedSteps()
        place = Path(tempfile.mkdtemp(dir=folder))
        url = f"sqlite:///{place}/memory.db" if server is None else server.new_database()
        spool = place / "spool"
        daemon = ChildProcess(_serve_with_workers, url, str(spool))
        daemon.wait_for("draining")
        plan = ChildProcess(walk, url, str(spool), "daemon", "plan", rng.randrange(2**31))
        try:
            for _ in range(rounds):
                worker = _worker(Spool(spool), other_than=None)
                time.sleep(rng.random() * _LONGEST_ROBOT_S)
                with suppress(ProcessLookupError):  # the daemon has just replaced it
                    os.kill(worker, end_signal)
                _worker(Spool(spool), other_than=worker)
                step()
        finally:
            steps.add(plan.kill_and_read())
            daemon.kill_and_read()
        asyncio.run(recover_spool(url, spool=spool))
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
