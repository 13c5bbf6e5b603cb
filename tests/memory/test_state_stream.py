"""A robot's trajectory during a motion, as a memory has it: times and positions, to the last bit."""

from __future__ import annotations

import asyncio
import subprocess
import sys
import threading
from pathlib import Path

import pytest
from sqlalchemy import select

from pycrorm_async import Memory, Settings
from pycrorm_async.clock import monotonic_ns
from pycrorm_async.orm import Object as ObjectRow
from pycrorm_async.orm import StateSample, TaskTreeNode
from pycrorm_async.plan import (
    ChosenRobot,
    MoveMotion,
    MoveTorsoActionPerformable,
    NavigateActionPerformable,
    simulated_robot,
)
from pycrorm_async.plan.objects import require_robot
from pycrorm_async.world import BulletWorld, Object, ObjectType, Pose
from tests.commands import environment
from tests.memory.note_actions import url_of

pytestmark = pytest.mark.slow

STEPS = 20
SAMPLED = Settings(sample_interval_ms=2)


class Driving:
    """Move the base along x to its goal in 20 steps of 5 ms, and log the time and position of each step."""

    def __init__(self) -> None:
        self.log: list[tuple[int, float]] = []

    async def navigate(self, motion: MoveMotion) -> None:
        body = require_robot().body
        start = body.pose.position.x
        for step in range(1, STEPS + 1):
            await asyncio.sleep(0.005)
            x = start + (motion.target.position.x - start) * step / STEPS
            body.set_pose(Pose([x, 0, 0]))
            self.log.append((monotonic_ns(), x))

    async def move_tcp(self, motion: object) -> None: ...
    async def looking(self, motion: object) -> None: ...
    async def move_gripper(self, motion: object) -> None: ...
    async def move_arm_joints(self, motion: object) -> None: ...
    async def move_joints(self, motion: object) -> None: ...


async def test_a_trajectory_is_recorded_with_its_values_and_times(tmp_path: Path) -> None:
    robot = Driving()
    async with Memory.open(url_of(tmp_path), settings=SAMPLED) as memory:
        with BulletWorld(), ChosenRobot("mine", robot):
            body = Object("pr2", ObjectType.ROBOT)
            joints = body.joint_positions()
            async with memory.episode(description="driving"):
                await NavigateActionPerformable(Pose([1, 0, 0])).perform()
        await memory.flush()
        assert memory.status.faults.total == 0
        assert memory.status.samples_left_out == 0
        async with memory.session() as session:
            motion = (await session.scalars(select(TaskTreeNode).where(TaskTreeNode.dtype == "MoveMotion"))).one()
            rows = (await session.scalars(select(StateSample).order_by(StateSample.id, StateSample.channel))).all()
            robot_row = await session.get(ObjectRow, rows[-1].object_id)
    assert {row.node_id for row in rows} == {motion.id}
    assert robot_row is not None
    assert robot_row.name == "pr2"
    assert motion.end_ns is not None

    times = [row.ns for row in rows]
    assert times == sorted(times)
    assert motion.start_ns < times[0]
    assert times[-1] < motion.end_ns

    first = {row.channel: row.value for row in rows if row.id == rows[0].id}
    base = {"base.x": 0.0, "base.y": 0.0, "base.z": 0.0, "base.qx": 0.0, "base.qy": 0.0, "base.qz": 0.0, "base.qw": 1.0}
    assert first == base | joints
    way = [(row.ns, row.value) for row in rows if row.channel == "base.x"]
    assert all(row.channel == "base.x" for row in rows if row.id != rows[0].id)
    assert [x for _, x in way] == sorted(
        {x for _, x in way}
    )  # the base never moved back, and no sample is written twice
    assert way[-1][1] == 1.0
    stations = [0.0, *(x for _, x in robot.log)]
    for ns, value in way:
        # The value in force when the sample was written, or the one before or after if a step fell in between.
        so_far = sum(set_ns <= ns for set_ns, _ in robot.log)
        assert value in stations[max(0, so_far - 1) : so_far + 2]


async def test_the_state_at_any_moment_is_the_last_written_value_of_each_channel(tmp_path: Path) -> None:
    """Over several motions of several parts, the samples up to the end of a motion add up to the robot's state then."""
    stood: list[dict[str, float]] = []
    async with Memory.open(url_of(tmp_path), settings=Settings(sample_interval_ms=1)) as memory:
        async with memory.episode(description="moving"):
            with BulletWorld(), simulated_robot:
                body = Object("pr2", ObjectType.ROBOT)
                for round_ in range(1, 5):
                    for moving in (
                        NavigateActionPerformable(Pose([round_ / 8, -round_ / 3, 0])),
                        MoveTorsoActionPerformable(round_ / 16),
                    ):
                        await moving.perform()
                        x, y, z = body.pose.position
                        stood.append({"base.x": x, "base.y": y, "base.z": z, **body.joint_positions()})
        await memory.flush()
        async with memory.session() as session:
            node = TaskTreeNode
            motions = (await session.scalars(select(node).where(node.kind == "motion").order_by(node.id))).all()
            rows = (await session.scalars(select(StateSample).order_by(StateSample.id))).all()
    assert len(motions) == len(stood) == 8
    for motion, expected in zip(motions, stood, strict=True):
        assert motion.end_ns is not None
        state = {row.channel: row.value for row in rows if row.ns <= motion.end_ns}
        assert {channel: state[channel] for channel in expected} == expected


async def test_no_samples_are_taken_unless_requested(tmp_path: Path) -> None:
    async with Memory.open(url_of(tmp_path)) as memory:
        with BulletWorld(), simulated_robot:
            Object("pr2", ObjectType.ROBOT)
            await NavigateActionPerformable(Pose([1, 0, 0])).perform()
        await memory.flush()
        assert "pycrorm sampler" not in [each.name for each in threading.enumerate()]
        async with memory.session() as session:
            assert (await session.scalars(select(StateSample))).all() == []


async def test_a_memory_that_is_closed_during_a_motion_ends_its_thread(tmp_path: Path) -> None:
    with BulletWorld(), ChosenRobot("mine", Driving()):
        Object("pr2", ObjectType.ROBOT)
        memory = Memory.open(url_of(tmp_path), settings=SAMPLED)
        await memory.__aenter__()
        driving = asyncio.create_task(NavigateActionPerformable(Pose([1, 0, 0])).perform())
        async with asyncio.timeout(10):
            while "pycrorm sampler" not in [each.name for each in threading.enumerate()]:  # noqa: ASYNC110  it sets no event of ours
                await asyncio.sleep(0.001)
        await memory.__aexit__(None, None, None)
        assert "pycrorm sampler" not in [each.name for each in threading.enumerate()]
        await driving
        assert require_robot().body.pose == Pose([1, 0, 0])


@pytest.mark.soak
def test_a_forked_child_continues_without_sampling_and_its_parent_keeps_sampling(tmp_path: Path) -> None:
    script = (
        "import asyncio, os, sys, threading, warnings\n"
        "warnings.simplefilter('ignore')\n"
        "from sqlalchemy import select\n"
        "from pycrorm_async import Memory, Settings\n"
        "from pycrorm_async.orm import StateSample\n"
        "from pycrorm_async.plan import *\n"
        "from pycrorm_async.plan.objects import require_robot\n"
        "from pycrorm_async.world import BulletWorld, Object, ObjectType, Pose\n"
        "from tests.memory.test_state_stream import Driving\n"
        "class Forking(Driving):\n"
        "    child = None\n"
        "    async def navigate(self, motion):\n"
        "        if self.child is None:\n"
        "            self.child = os.fork()\n"
        "        require_robot().body.set_pose(motion.target)\n"
        "async def main():\n"
        "    robot = Forking()\n"
        "    async with Memory.open(sys.argv[1], settings=Settings(sample_interval_ms=1)) as memory:\n"
        "        with BulletWorld(), ChosenRobot('mine', robot):\n"
        "            Object('pr2', ObjectType.ROBOT)\n"
        "            await NavigateActionPerformable(Pose([1, 0, 0])).perform()\n"
        "            if robot.child == 0:\n"
        "                await NavigateActionPerformable(Pose([2, 0, 0])).perform()\n"
        "                names = [each.name for each in threading.enumerate()]\n"
        "                os._exit(7 if 'pycrorm sampler' not in names else 1)\n"
        "            assert os.waitstatus_to_exitcode(os.waitpid(robot.child, 0)[1]) == 7\n"
        "            await NavigateActionPerformable(Pose([3, 0, 0])).perform()\n"
        "        await memory.flush()\n"
        "        async with memory.session() as session:\n"
        "            rows = (await session.scalars(select(StateSample).order_by(StateSample.id))).all()\n"
        "            values = [row.value for row in rows if row.channel == 'base.x']\n"
        "            print(values, memory.status.faults.total)\n"
        "asyncio.run(main())\n"
    )
    done = subprocess.run(
        [sys.executable, "-c", script, url_of(tmp_path)],
        env=environment(), capture_output=True, text=True, timeout=60, check=False,
    )  # fmt: skip
    assert (done.stdout, done.returncode) == ("[0.0, 1.0, 1.0, 3.0] 0\n", 0), done.stderr
