"""Kill a plan in the middle: every node whose hook returned is stored once, and the episode has the status LOST."""

import os
import random
import select
import signal
import subprocess
import time
from pathlib import Path

import pytest

from tests.commands import COMMAND, answer, environment, pycrorm

pytestmark = pytest.mark.slow

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


def killed(folder: Path, seconds: float) -> tuple[set[int], set[int]]:
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
    started, ended = killed(tmp_path, seconds)

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
