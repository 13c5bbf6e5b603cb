"""Recorders and plans that are killed, that exit with a full queue, or whose clock is set back, lose no event."""

from __future__ import annotations

import asyncio
import itertools
import os
import random
import select
import signal
import subprocess
import sys
import time
from pathlib import Path

import pytest

from bench.breaking import processes
from pycrorm_async import Memory, Reading, Settings, recover
from pycrorm_async.clock import Clock
from pycrorm_async.errors import SpoolFull
from tests.commands import COMMAND, answer, environment, pycrorm
from tests.crash.forked_processes import ForkedProcess
from tests.databases import ask
from tests.memory.note_actions import NoteActionPerformable, texts

pytestmark = pytest.mark.slow


# === queue kill ===============================================================================================
#
# Kill recorders with SIGKILL at any moment: every record whose `put_nowait` returned is stored once and in order.


@pytest.mark.parametrize("kills", [24, pytest.param(10_000, marks=pytest.mark.soak)])
def test_every_written_record_survives_a_kill_once_and_in_order(tmp_path: Path, kills: int, in_turn: bool) -> None:
    seed = random.SystemRandom().randrange(2**20)
    print(f"seed {seed}")
    rounds = min(kills, 1_000) if in_turn else kills
    outcome = processes.killed_recorders(rounds, random.Random(seed), tmp_path, lambda: None)
    assert (outcome.clean, outcome.rounds) == (True, rounds), outcome
    assert outcome.events > 10 * rounds


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
