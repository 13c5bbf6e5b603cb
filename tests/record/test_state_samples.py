"""The samples of a robot's state during a motion: their times, channels and values, also in the tables."""

from __future__ import annotations

import asyncio
import threading
import time
from collections.abc import Callable, Iterator
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import pytest

from pycrorm_async import Memory
from pycrorm_async.events.codec import Heading
from pycrorm_async.events.types import Happening, NodeEnded, NodeStarted, StateSampled
from pycrorm_async.plan import (
    ActionAbstract,
    ChosenRobot,
    LookAtActionPerformable,
    MoveMotion,
    MoveTorsoActionPerformable,
    NavigateActionPerformable,
    SimulatedTaskTree,
    simulated_robot,
)
from pycrorm_async.plan.objects import require_robot
from pycrorm_async.settings import Settings
from pycrorm_async.world import BulletWorld, Object, ObjectType, Pose
from pycrorm_async.world.pose import yaw_quaternion
from tests.memory.note_actions import url_of
from tests.record.fakes import RecorderCase, findings, recorder_case

# === sampler ==================================================================================================
#
# The sampling of the robot's state during a motion: times, channels and values.

TURNED = yaw_quaternion(1.0)


async def test_the_first_sample_of_an_episode_has_every_channel_and_the_next_one_only_changes(
    case: RecorderCase,
) -> None:
    with case.episode():
        await NavigateActionPerformable(Pose([0.5, 0, 0])).perform()
        await MoveTorsoActionPerformable(0.25).perform()
        await NavigateActionPerformable(Pose([0.5, 0.25, 0], TURNED)).perform()
    robot = require_robot().body
    first, *others = samples(case)
    assert set(first.channels) == BASE | set(robot.joints)
    assert (first.channels["base.x"], first.channels["base.qw"], first.channels["torso_lift_joint"]) == (0.0, 1.0, 0.0)
    assert [each.channels for each in others] == [
        {"base.x": 0.5},
        {"torso_lift_joint": 0.25},
        {"base.y": 0.25, "base.qz": TURNED.z, "base.qw": TURNED.w},
    ]


async def test_a_motion_that_changes_nothing_has_no_sample(case: RecorderCase) -> None:
    with case.episode():
        await NavigateActionPerformable(Pose([0.5, 0, 0])).perform()
        count = len(samples(case))
        await NavigateActionPerformable(Pose([0.5, 0, 0])).perform()
        await LookAtActionPerformable(Pose([9, 0, 1.2])).perform()
        looked = samples(case)[count:]
    assert len(looked) == 1
    assert set(looked[0].channels) <= {"head_pan_joint", "head_tilt_joint"}


async def test_changes_between_motions_are_in_the_first_sample_of_the_next(case: RecorderCase) -> None:
    with case.episode():
        await NavigateActionPerformable(Pose([0.5, 0, 0])).perform()
        require_robot().body.set_pose(Pose([2, 3, 0]))
        await NavigateActionPerformable(Pose([4, 3, 0])).perform()
    assert [each.channels for each in samples(case)[2:]] == [{"base.x": 2.0, "base.y": 3.0}, {"base.x": 4.0}]


async def test_every_episode_begins_with_all_channels(case: RecorderCase) -> None:
    for _ in range(2):
        with case.episode():
            await NavigateActionPerformable(Pose([0.5, 0, 0])).perform()
    whole = [each for each in samples(case) if len(each.channels) > len(BASE)]
    assert [each.channels["base.x"] for each in whole] == [0.0, 0.5]


async def test_a_motion_without_an_await_is_sampled_too(case: RecorderCase) -> None:
    def drive(body: Object, target: Pose) -> None:
        for x in (0.5, target.position.x):
            body.set_pose(Pose([x, 0, 0]))
            end_s = time.monotonic() + 10
            while not written(case, "base.x", x) and time.monotonic() < end_s:
                pass

    with case.episode(), ChosenRobot("mine", Robot(drive)):
        await NavigateActionPerformable(Pose([1, 0, 0])).perform()
    assert values(case, "base.x") == [0.0, 0.5, 1.0]


async def test_between_start_and_end_only_changes_beyond_the_margin_are_written() -> None:
    settings = Settings(sample_interval_ms=1, sample_change_min=0.1)
    with recorder_case(settings) as case, BulletWorld():

        async def drive(body: Object, target: Pose) -> None:
            body.set_pose(Pose([0.5, 0.0, 0]))
            await seen(case, "base.x", 0.5)
            body.set_pose(Pose([0.59, 0.09, 0]))
            await asyncio.sleep(0.03)
            body.set_pose(Pose([0.62, 0.09, 0]))
            await seen(case, "base.x", 0.62)
            body.set_pose(target)

        Object("pr2", ObjectType.ROBOT)
        with case.episode(), ChosenRobot("mine", Robot(drive)):
            await NavigateActionPerformable(Pose([0.625, 0.095, 0])).perform()
        assert [each.channels for each in samples(case)[1:]] == [
            {"base.x": 0.5},
            {"base.x": 0.62},
            {"base.x": 0.625, "base.y": 0.095},  # the final position, to the last bit
        ]


async def test_a_cancelled_motion_ends_with_the_state_in_which_it_stopped(case: RecorderCase) -> None:
    arrived = asyncio.Event()

    async def drive(body: Object, _target: Pose) -> None:
        body.set_pose(Pose([0.25, 0, 0]))
        await seen(case, "base.x", 0.25)
        body.set_pose(Pose([0.375, 0, 0]))
        arrived.set()
        await asyncio.sleep(60)

    with case.episode(), ChosenRobot("mine", Robot(drive)):
        task = asyncio.create_task(NavigateActionPerformable(Pose([1, 0, 0])).perform())
        await arrived.wait()
        task.cancel()
        with pytest.raises(asyncio.CancelledError):
            await task
        count = len(samples(case))
        require_robot().body.set_pose(Pose([7, 0, 0]))
        await asyncio.sleep(0.02)
        assert len(samples(case)) == count
    assert values(case, "base.x") == [0.0, 0.25, 0.375]


async def test_a_sample_without_space_is_left_out_and_the_next_one_has_all_changes_since_the_last_written(
    case: RecorderCase,
) -> None:
    with case.episode():
        await NavigateActionPerformable(Pose([0.5, 0, 0])).perform()
        count = len(samples(case))
        case.sink.full = True
        target = MoveMotion(Pose([1, 0, 0]))
        case.sink.space.set()
        await target.perform()
        assert len(samples(case)) == count
        assert case.recorder.samples_left_out == 1
        case.sink.full = False
        await NavigateActionPerformable(Pose([1, 2, 0])).perform()
    assert [each.channels for each in samples(case)[count:]] == [{"base.x": 1.0}, {"base.y": 2.0}]
    assert case.recorder.samples_left_out == 1
    assert case.emitter.faults.total == 0


async def test_a_fault_of_the_recorder_is_counted_and_the_motion_continues(case: RecorderCase) -> None:
    with case.episode():
        await NavigateActionPerformable(Pose([0.5, 0, 0])).perform()
        before = case.emitter.faults.total

        put = case.sink.put_nowait

        def broken(heading: Heading, payload: bytes, *, reserved: bool = False, **placed: Any) -> int:
            if heading.type == "StateSampled":
                raise RuntimeError("the sampler is on fire")
            return put(heading, payload, reserved=reserved, **placed)

        case.sink.put_nowait = broken  # type: ignore[method-assign]
        await NavigateActionPerformable(Pose([1, 0, 0])).perform()
    assert require_robot().body.pose == Pose([1, 0, 0])
    assert case.emitter.faults.total == before + 1
    assert case.emitter.faults.last == "StateSampled: RuntimeError: the sampler is on fire"


# === sampled motions ==========================================================================================
#
# Move a robot of the user during a recorded motion, and read the samples of its state.

SAMPLED = Settings(sample_interval_ms=1)
BASE = {"base.x", "base.y", "base.z", "base.qx", "base.qy", "base.qz", "base.qw"}


class Robot:
    """A user's robot, whose base goes where the test sends it."""

    def __init__(self, drive: Callable[[Object, Pose], object]) -> None:
        self.drive = drive

    async def navigate(self, motion: MoveMotion) -> None:
        going = self.drive(require_robot().body, motion.target)
        if asyncio.iscoroutine(going):
            await going

    async def move_tcp(self, motion: object) -> None: ...
    async def looking(self, motion: object) -> None: ...
    async def move_gripper(self, motion: object) -> None: ...
    async def move_arm_joints(self, motion: object) -> None: ...
    async def move_joints(self, motion: object) -> None: ...


def samples(case: RecorderCase) -> list[StateSampled]:
    """Return all samples in the order of writing, and assert that each is inside its motion."""
    result = []
    for name in case.sink.sequences:
        events = case.sink.of(name)
        assert findings(events) == []
        started = {sequence: event for sequence, event in events if isinstance(event, NodeStarted)}
        ended = {event.node: sequence for sequence, event in events if isinstance(event, NodeEnded)}
        for sequence, event in events:
            if isinstance(event, StateSampled):
                assert event.node is not None
                assert started[event.node].kind == "motion"
                assert event.node < sequence < ended.get(event.node, sequence + 1)
                result.append(event)
    return result


def values(case: RecorderCase, channel: str) -> list[float]:
    return [each.channels[channel] for each in samples(case) if channel in each.channels]


def written(case: RecorderCase, channel: str, value: float) -> bool:
    """Return whether a sample with this value is written yet, while other threads write."""
    with case.sink.lock:
        events: list[Happening] = [event for _, _, event in case.sink.records]
    return any(isinstance(each, StateSampled) and each.channels.get(channel) == value for each in events)


async def seen(case: RecorderCase, channel: str, value: float) -> None:
    async with asyncio.timeout(10):
        while not written(case, channel, value):  # noqa: ASYNC110  the sampler sets no event of ours
            await asyncio.sleep(0.001)


# === fixtures =================================================================================================
#
# Provide a recorder that samples the state of a PR2 in a world.


@pytest.fixture
def case() -> Iterator[RecorderCase]:
    with recorder_case(SAMPLED) as sampled_case, BulletWorld(), simulated_robot:
        Object("pr2", ObjectType.ROBOT)
        yield sampled_case


# === sampler lifetime =========================================================================================
#
# The sampler follows the robot, the simulation and the episode of a motion, and ends with all of them.


@dataclass
class ThinkActionPerformable(ActionAbstract):
    async def perform(self) -> None:
        with SimulatedTaskTree():
            await NavigateActionPerformable(Pose([3, 0, 0])).perform()


async def test_the_robot_of_a_simulation_is_sampled_in_the_simulation(case: RecorderCase) -> None:
    with case.episode() as episode:
        await NavigateActionPerformable(Pose([1, 0, 0])).perform()
        await ThinkActionPerformable().perform()
        await NavigateActionPerformable(Pose([2, 0, 0])).perform()
    (simulated,) = (name for name in case.sink.sequences if name != episode.id)
    real = [event for _, event in case.sink.of(episode) if isinstance(event, StateSampled)]
    only_thought = [event for _, event in case.sink.of(simulated) if isinstance(event, StateSampled)]
    assert [each.channels["base.x"] for each in real] == [0.0, 1.0, 2.0]
    assert [each.channels["base.x"] for each in only_thought] == [1.0, 3.0]
    assert len(samples(case)) == 5


async def test_a_motion_that_outlives_its_episode_is_not_sampled_afterwards(case: RecorderCase) -> None:
    going = asyncio.Event()

    async def drive(body: Object, _target: Pose) -> None:
        body.set_pose(Pose([0.25, 0, 0]))
        await going.wait()
        body.set_pose(Pose([0.5, 0, 0]))

    with ChosenRobot("mine", Robot(drive)):
        with case.episode():
            task = asyncio.create_task(NavigateActionPerformable(Pose([1, 0, 0])).perform())
            await seen(case, "base.x", 0.25)
        going.set()
        await task
        await asyncio.sleep(0.01)
    assert values(case, "base.x") == [0.0, 0.25]


async def test_a_thread_samples_only_on_request_and_ends_with_the_memory() -> None:
    def threads() -> list[str]:
        return [each.name for each in threading.enumerate() if each.name == "pycrorm sampler"]

    for settings, running in ((Settings(), []), (SAMPLED, ["pycrorm sampler"])):
        with recorder_case(settings) as case, BulletWorld(), simulated_robot:
            Object("pr2", ObjectType.ROBOT)
            await NavigateActionPerformable(Pose([1, 0, 0])).perform()
            await NavigateActionPerformable(Pose([2, 0, 0])).perform()
            assert threads() == running
            assert bool(samples(case)) is bool(running)
        assert threads() == []


@pytest.mark.slow
async def test_a_memory_that_is_closed_during_a_motion_ends_its_thread(tmp_path: Path) -> None:
    async def drive(body: Object, target: Pose) -> None:
        await asyncio.sleep(0.1)
        body.set_pose(target)

    with BulletWorld(), ChosenRobot("mine", Robot(drive)):
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
