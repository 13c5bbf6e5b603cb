"""The sampling of the robot's state during a motion: times, channels and values."""

from __future__ import annotations

import asyncio
import time

import pytest

from pycrorm_async.plan import (
    ChosenRobot,
    LookAtActionPerformable,
    MoveMotion,
    MoveTorsoActionPerformable,
    NavigateActionPerformable,
)
from pycrorm_async.plan.objects import require_robot
from pycrorm_async.settings import Settings
from pycrorm_async.world import BulletWorld, Object, ObjectType, Pose
from pycrorm_async.world.pose import yaw_quaternion
from tests.hooks.fakes import RecorderCase, recorder_case
from tests.hooks.sampled_motions import BASE, Robot, samples, seen, values, written

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


async def test_a_long_motion_is_sampled_in_between(case: RecorderCase) -> None:
    steps = [step / 20 for step in range(1, 21)]

    async def drive(body: Object, target: Pose) -> None:
        for share in steps:
            body.set_pose(Pose([target.position.x * share, 0, 0]))
            await seen(case, "base.x", share)

    with case.episode(), ChosenRobot("mine", Robot(drive)):
        await NavigateActionPerformable(Pose([1, 0, 0])).perform()
    assert values(case, "base.x") == [0.0, *steps]
    assert {tuple(each.channels) for each in samples(case)[1:]} == {("base.x",)}


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


async def test_concurrent_motions_each_have_the_state_in_which_they_ended(case: RecorderCase) -> None:
    first_ended = asyncio.Event()

    async def drive(body: Object, target: Pose) -> None:
        await seen(case, "base.z", 0.0)
        if target.position.x:
            body.set_pose(Pose([target.position.x, body.pose.position.y, 0]))
            await seen(case, "base.x", 1.0)
        else:
            await first_ended.wait()
            body.set_pose(Pose([body.pose.position.x, target.position.y, 0]))

    async def first() -> None:
        await NavigateActionPerformable(Pose([1, 0, 0])).perform()
        first_ended.set()

    with case.episode(), ChosenRobot("mine", Robot(drive)):
        await asyncio.gather(first(), NavigateActionPerformable(Pose([0, 2, 0])).perform())
    # A channel is written when it differs from its last value: the state at a moment is the last written one before it.
    state: dict[str, float] = {}
    ends: dict[int, dict[str, float]] = {}
    for each in samples(case):
        assert each.node is not None
        state |= each.channels
        ends.pop(each.node, None)
        ends[each.node] = dict(state)
    one, two = ends.values()  # by their last samples: a plan yields to the loop now and then, so either may start first
    assert one["base.x"] == 1.0
    assert (two["base.x"], two["base.y"]) == (1.0, 2.0)


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

        def broken(*_arguments: object) -> None:
            raise RuntimeError("the sampler is on fire")

        case.emitter.offer = broken  # type: ignore[method-assign,assignment]
        await NavigateActionPerformable(Pose([1, 0, 0])).perform()
    assert require_robot().body.pose == Pose([1, 0, 0])
    assert case.emitter.faults.total == before + 1
    assert case.emitter.faults.last == "StateSampled: RuntimeError: the sampler is on fire"
