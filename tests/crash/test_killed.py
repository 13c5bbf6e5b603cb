"""Recorders and plans that are killed, that exit with a full queue, or whose clock is set back, lose no event."""

from __future__ import annotations

import asyncio
import itertools
import os
import random
import select
import shutil
import signal
import subprocess
import sys
import threading
import time
from pathlib import Path

import pytest

from pycrorm_async import Memory, Reading, Settings, recover
from pycrorm_async.clock import SYSTEM_CLOCK, Clock
from pycrorm_async.errors import SpoolFull
from pycrorm_async.events.codec import LOST, Heading
from pycrorm_async.events.ids import episode_id, episode_text
from pycrorm_async.queue import RecorderQueue, Spool
from tests.commands import COMMAND, answer, environment, pycrorm
from tests.crash.forked_processes import ForkedProcess, die_after
from tests.crash.step_robot import RecordedSteps, report, verify_kept, walk
from tests.databases import ask
from tests.memory.note_actions import NoteActionPerformable, texts
from tests.queue.factories import recover as recover_records

pytestmark = pytest.mark.slow


# === queue kill ===============================================================================================
#
# Kill recorders with SIGKILL at any moment: every record whose `put_nowait` returned is stored once and in order.
#
# A recorder prints `put EPISODE SEQUENCE TYPE` when `put_nowait` has returned, and before it acknowledges a batch
# `stored POSITION EPISODE SEQUENCE PAYLOAD` for each record of it. A payload begins with EPISODE/SEQUENCE/TYPE/.

RECORDING = Settings(
    sync_interval_ms=2, segment_bytes=2**14, spool_bytes_max=2**26, spool_reserve_bytes=1, record_bytes_max=2**12
)


def record_until_killed(spool: str, seed: int, threads: int, is_drained: bool, cpu_s: float) -> None:
    die_after(cpu_s)
    rng = random.Random(seed)
    name = episode_id(time.time_ns(), rng.randbytes(10))
    queue = RecorderQueue.create(Path(spool), settings=RECORDING, clock=SYSTEM_CLOCK, recorder=name)
    for number in range(threads):
        threading.Thread(target=_put, args=(queue, random.Random(f"{seed} {number}")), daemon=True).start()
    if is_drained:
        asyncio.run(_store(queue, rng))
    threading.Event().wait()


def _put(queue: RecorderQueue, rng: random.Random) -> None:
    while True:
        episode = episode_id(time.time_ns(), rng.randbytes(10))
        name = episode_text(episode)
        kinds = ["EpisodeStarted", *["NodeStarted"] * rng.randrange(1, 40), "EpisodeEnded"]
        for index, kind in enumerate(kinds, start=1):
            payload = f"{name}/{index}/{kind}/".encode() + b"x" * rng.randrange(0, 1200)
            report("put", name, queue.put_nowait(Heading(episode, kind, 1), payload), kind)


async def _store(queue: RecorderQueue, rng: random.Random) -> None:
    while batch := await queue.get_batch(events_max=rng.randrange(1, 50), bytes_max=2**16, age_s_max=0.001):
        for each in batch:
            assert each.episode is not None
            name = episode_text(each.episode)
            report("stored", each.position, name, each.sequence, each.payload.rstrip(b"x").decode())
        await queue.acknowledge(batch[-1].position)


def verify_recovered(spool: Path, lines: list[list[str]], threads: int) -> int:
    """Compare what a killed recorder printed with what is left of it; return the number of acknowledged events."""
    acknowledged = [(line[1], int(line[2]), "/".join((*line[1:4], ""))) for line in lines if line[0] == "put"]
    by_position = {int(line[1]): (line[2], int(line[3]), line[4]) for line in lines if line[0] == "stored"}
    ends: list[tuple[str, int]] = []
    for recorder in Spool(spool).recorders():
        records = asyncio.run(recover_records(recorder.path))
        if records:
            assert asyncio.run(recover_records(recorder.path)) == records
        for each in records:
            assert each.episode is not None
            name = episode_text(each.episode)
            if each.payload == LOST:
                ends.append((name, each.sequence))
                continue
            event = name, each.sequence, each.payload.rstrip(b"x").decode()
            assert by_position.setdefault(each.position, event) == event
    assert sorted(by_position) == list(range(1, len(by_position) + 1))
    events = [by_position[position] for position in sorted(by_position)]
    assert all(text.startswith(f"{name}/{sequence}/") for name, sequence, text in events)
    verify_kept(acknowledged, events, possible=events)
    assert len(events) <= len(acknowledged) + threads  # each thread may die before it prints its last event
    last = {name: (sequence, text) for name, sequence, text in events}
    is_open = {name: sequence + 1 for name, (sequence, text) in last.items() if not text.endswith("/EpisodeEnded/")}
    assert sorted(ends) == sorted(is_open.items())
    return len(acknowledged)


@pytest.mark.parametrize("kills", [12, pytest.param(10_000, marks=pytest.mark.soak)])
def test_every_written_record_survives_a_kill_once_and_in_order(
    tmp_path: Path, kills: int, in_turn: bool, rng: random.Random
) -> None:
    rounds = min(kills, 1_000) if in_turn else kills
    events = 0
    for first in range(0, rounds, 4):
        lives: list[tuple[Path, int, ForkedProcess]] = []
        for number in range(first, min(first + 4, rounds)):
            spool, threads = tmp_path / str(number), rng.choice((1, 1, 2, 3))
            options = rng.randrange(2**31), threads, rng.random() < 0.5, rng.random() * 0.05
            lives.append((spool, threads, ForkedProcess(record_until_killed, str(spool), *options)))
        for spool, threads, recorder in lives:
            events += verify_recovered(spool, recorder.wait_until_killed(), threads)
            shutil.rmtree(spool, ignore_errors=True)  # it may have died before it made its spool
    assert events > 10 * rounds


@pytest.mark.soak  # test_daemon kills plans and the daemon that drains them
def test_killed_plans_leave_every_step_stored_once(tmp_path: Path, in_turn: bool, rng: random.Random) -> None:
    url, spool, steps = f"sqlite:///{tmp_path}/memory.db", tmp_path / "spool", RecordedSteps()
    for number in range(25 if in_turn else 500):
        plan = ForkedProcess(walk, url, str(spool), "thread", f"plan{number}", rng.randrange(2**31))
        plan.wait_for("did")
        time.sleep(rng.random() * 0.2)
        steps.add(plan.kill_and_read())
    asyncio.run(recover(url, spool=spool))
    steps.verify(url)


# === exit and clock ===========================================================================================
#
# A process that exits with a full queue, and a wall clock that is set back while a plan runs.

SMALL = Settings(
    sync_interval_ms=5,
    segment_bytes=2**14,
    record_bytes_max=2**12,
    spool_bytes_max=2**17,
    spool_reserve_bytes=2**15,
    on_full="fail",
)
HOUR_NS = 3600 * 10**9


def fill_and_leave(url: str, spool: str, how: str) -> None:
    """Record notes until the spool is full, and exit in the middle of the episode."""
    asyncio.run(_fill(url, Path(spool), how))


async def _fill(url: str, spool: Path, how: str) -> None:
    opened = Memory.open(url, spool=spool, writer="daemon", settings=SMALL)
    async with opened as memory, memory.episode(description="until it is full"):
        try:
            for number in itertools.count():
                await NoteActionPerformable(f"{number}").perform()
                os.write(1, b"%d\n" % number)
        except SpoolFull:
            if how == "exit":
                sys.exit(3)
            if how == "_exit":
                os._exit(3)
            raise


@pytest.mark.soak_on("postgresql")
@pytest.mark.parametrize("how", ["exit", "_exit", "raise"])
async def test_a_process_that_exits_with_a_full_queue_loses_nothing(
    database_url: str, tmp_path: Path, how: str
) -> None:
    spool = tmp_path / "spool"
    leaving = ForkedProcess(fill_and_leave, database_url, str(spool), how)
    assert await asyncio.to_thread(leaving.wait) == (1 if how == "raise" else 3)
    lines = leaving.lines
    assert lines == [str(number) for number in range(len(lines))]
    assert len(lines) > 50
    report = await recover(database_url, spool=spool)
    assert report.failed == {}
    async with Reading.open(database_url) as reading:
        assert await texts(reading) == lines
        [episode] = await reading.episodes()
    # Events that end an episode use space that is reserved for them.
    assert episode.status == {"exit": "ERROR", "raise": "ERROR", "_exit": "LOST"}[how]
    assert [path for path in spool.iterdir() if path.is_dir() and path.name != "stored"] == []


@pytest.mark.soak_on("postgresql")
async def test_a_clock_that_is_set_back_an_hour_repeatedly_changes_no_order(database_url: str, tmp_path: Path) -> None:
    back_ns = 0
    clock = Clock(wall_ns=lambda: time.time_ns() - back_ns, monotonic_ns=time.monotonic_ns)
    words = list("abcdefg")
    patient = Settings(connect_timeout_s=300)
    async with Memory.open(database_url, spool=tmp_path / "spool", clock=clock, settings=patient) as memory:
        for description in ("first", "second"):
            async with memory.episode(description=description):
                for word in words:
                    await NoteActionPerformable(f"{description} {word}").perform()
                    back_ns += HOUR_NS
                    if word == "d":
                        await memory.flush()
        await memory.flush()
        assert await texts(memory) == [f"{description} {word}" for description in ("first", "second") for word in words]
        assert [each.status for each in await memory.reading.episodes()] == ["SUCCEEDED", "SUCCEEDED"]
    times = ask(database_url, "SELECT wall_ns, event.monotonic_ns FROM event ORDER BY episode, sequence")
    assert times[0][0] - times[-1][0] > 12 * HOUR_NS
    assert [monotonic for _, monotonic in times] == sorted(monotonic for _, monotonic in times)
    took = ask(database_url, "SELECT end_ns - start_ns FROM task_tree_node")
    assert all(0 <= ns < HOUR_NS for (ns,) in took)


# === killed plan ==============================================================================================
#
# Kill a plan in the middle: every node whose hook returned is stored once, and the episode has the status LOST.

PLAN = '''
import itertools, os
from dataclasses import dataclass
from pycrorm_async.plan import ActionAbstract, NavigateActionPerformable, simulated_robot
from pycrorm_async.world import BulletWorld, Object, ObjectType, Pose

def say(*words):
    os.write(1, (" ".join(map(str, words)) + "\\n").encode())

@dataclass
class StepActionPerformable(ActionAbstract):
    index: int

    async def perform(self):
        say("started", self.index)
        await NavigateActionPerformable(Pose([self.index / 1000, 0, 0])).perform()

async def plan():
    """Walk until killed."""
    with BulletWorld(), simulated_robot:
        Object("pr2", ObjectType.ROBOT)
        for index in itertools.count():
            await StepActionPerformable(index).perform()
            say("ended", index)
'''


def killed_steps(folder: Path, seconds: float) -> tuple[set[int], set[int]]:
    """Kill the plan this long after its first step, and return the steps that it reported as started and as ended."""
    process = subprocess.Popen(
        [*COMMAND, "run", "walk.py"], cwd=folder, env=environment(), stdout=subprocess.PIPE, bufsize=0
    )
    assert process.stdout is not None
    output = process.stdout.readline()
    assert output == b"started 0\n"
    read_end = process.stdout.fileno()
    deadline = time.monotonic() + seconds
    while (left_s := deadline - time.monotonic()) > 0:
        if select.select([read_end], [], [], left_s)[0]:
            output += os.read(read_end, 1 << 16)
    process.send_signal(signal.SIGKILL)
    process.wait()
    output += process.stdout.read()
    process.stdout.close()
    whole = output[: output.rfind(b"\n")].decode().splitlines()
    steps = [line.split() for line in whole]
    return (
        {int(step[1]) for step in steps if step[0] == "started"},
        {int(step[1]) for step in steps if step[0] == "ended"},
    )


@pytest.mark.parametrize("seed", [0, pytest.param(1, marks=pytest.mark.soak)])
def test_a_killed_plan_has_every_node_whose_hook_returned_and_its_episode_is_lost(tmp_path: Path, seed: int) -> None:
    (tmp_path / "walk.py").write_text(PLAN)
    seconds = random.Random(seed).uniform(0.0, 0.6)
    print(f"seed {seed}: killed after {seconds:.3f} s")
    started, ended = killed_steps(tmp_path, seconds)

    waiting = pycrorm("episodes", cwd=tmp_path)
    assert "pycrorm writer --once" in waiting.stderr
    report = answer("writer", "--once", cwd=tmp_path)
    assert len(report["lost"]) == 1
    shown = answer("show", "last", cwd=tmp_path)
    assert shown["episode"]["status"] == "LOST"

    steps = [node for node in shown["tree"] if node["dtype"] == "StepAction"]
    status_by_index = {node["parameters"]["index"]: node["status"] for node in steps}
    assert len(status_by_index) == len(steps)
    assert started <= set(status_by_index) <= started | {len(started)}
    assert {index for index in ended if status_by_index[index] != "SUCCEEDED"} == set()
    assert set(status_by_index.values()) <= {"SUCCEEDED", "LOST"}
    assert len([index for index in status_by_index if status_by_index[index] == "LOST"]) <= 1
    root = next(node for node in shown["tree"] if node["dtype"] is None)
    assert root["status"] == "LOST"

    again = answer("writer", "--once", cwd=tmp_path)
    assert (again["recorders"], again["events_stored"], again["lost"]) == ([], 0, [])
    assert answer("show", "last", cwd=tmp_path) == shown
    assert not [path for path in (tmp_path / "pycrorm.db.spool").iterdir() if path.is_dir() and path.name != "stored"]
