"""The sampler follows the robot, the simulation and the episode of a motion, and ends with all of them."""

from __future__ import annotations

import asyncio
import contextvars
import threading
from collections.abc import Callable, Generator
from dataclasses import dataclass

import pytest

from pycrorm_async.errors import CallerError
from pycrorm_async.events.types import StateSampled
from pycrorm_async.plan import (
    ActionAbstract,
    ChosenRobot,
    MoveMotion,
    NavigateActionPerformable,
    SimulatedTaskTree,
    simulated_robot,
)
from pycrorm_async.settings import Settings
from pycrorm_async.world import BulletWorld, Object, ObjectType, Pose
from tests.hooks.fakes import RecorderCase, recorder_case
from tests.hooks.sampled_motions import BASE, SAMPLED, Robot, samples, seen, values


async def test_another_robot_begins_with_every_channel(case: RecorderCase) -> None:
    async def drive(body: Object, target: Pose) -> None:
        body.set_pose(target)
        await seen(case, "base.x", target.position.x)
        body.remove()
        other = Object("pr2", ObjectType.ROBOT, pose=Pose([8, 8, 0]))
        await seen(case, "base.x", 8.0)
        other.set_pose(Pose([9, 8, 0]))

    with case.episode(), ChosenRobot("mine", Robot(drive)):
        await NavigateActionPerformable(Pose([1, 0, 0])).perform()
    result = samples(case)
    objects = [each.object.object for each in result]
    assert [len(each.channels) > len(BASE) for each in result] == [True, False, True, False]
    assert objects[0] == objects[1] != objects[2] == objects[3]
    assert result[3].channels == {"base.x": 9.0}


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


async def test_without_a_robot_or_a_world_no_samples_are_taken_and_no_thread_runs() -> None:
    async def drive(*_: object) -> None: ...

    class Bodiless(Robot):
        async def navigate(self, motion: MoveMotion) -> None: ...

    with recorder_case(SAMPLED) as case, ChosenRobot("mine", Bodiless(drive)):
        with case.episode():
            await MoveMotion(Pose()).perform()
        with case.episode(), BulletWorld():
            await MoveMotion(Pose()).perform()
        assert "pycrorm sampler" not in [each.name for each in threading.enumerate()]
        assert samples(case) == []


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


class Interrupting(Object):
    """At its first reading in the sampler's thread, the collector closes the plan that moves this robot."""

    def __init__(self) -> None:
        self.close: Callable[[], None] | None = None
        self.closed = asyncio.Event()
        super().__init__("pr2", ObjectType.ROBOT)

    def joint_positions(self) -> dict[str, float]:
        if self.close is not None and threading.current_thread().name == "pycrorm sampler":
            close, self.close = self.close, None
            close()
        return super().joint_positions()


async def test_a_motion_that_ends_during_its_own_sample_has_none_after_its_end() -> None:
    """The collector, which may run in any thread, closes an abandoned plan like this."""
    with recorder_case(SAMPLED) as case, BulletWorld():
        robot = Interrupting()
        with case.episode() as episode:
            driving, ended = threading.Event(), threading.Event()

            async def drive(_body: Object, _target: Pose) -> None:
                driving.set()
                await Suspended()

            with ChosenRobot("mine", Robot(drive)):
                dropped = MoveMotion(Pose([1, 0, 0])).perform()
                context = contextvars.copy_context()
                while not driving.is_set():  # the hook may let the loop run first
                    context.run(dropped.send, None)
            robot.set_pose(Pose([0.5, 0, 0]))

            def close() -> None:
                robot.set_pose(Pose([0.75, 0, 0]))
                dropped.close()
                ended.set()

            robot.close = close
            assert await asyncio.to_thread(ended.wait, 10)
            await asyncio.sleep(0.01)
            events = [type(event).__name__ for _, event in case.sink.of(episode)]
        last_end = len(events) - 1 - events[::-1].index("NodeEnded")
        assert "StateSampled" not in events[last_end:]
        assert values(case, "base.x")[-1] == 0.75
        assert case.emitter.faults.total == 0


class Suspended:
    """An await that never ends."""

    def __await__(self) -> Generator[None, None, None]:
        yield


@pytest.mark.parametrize("interval", [0, -1, "5", float("nan")])
def test_an_invalid_interval_is_refused(interval: object) -> None:
    with pytest.raises(CallerError, match=r"sample_interval_ms is .*: it must be a number above zero"):
        Settings(sample_interval_ms=interval)  # type: ignore[arg-type]


@pytest.mark.parametrize("margin", [-0.1, float("nan"), float("inf"), None, "1"])
def test_an_invalid_margin_is_refused(margin: object) -> None:
    with pytest.raises(CallerError, match=r"sample_change_min is .*: it must be a number, zero or above"):
        Settings(sample_change_min=margin)  # type: ignore[arg-type]
