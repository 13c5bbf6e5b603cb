"""A monitor checks its condition in the real world, even while the plan that it monitors only simulates."""

from __future__ import annotations

import asyncio
import functools
from contextlib import suppress
from dataclasses import dataclass

import pytest

from pycrorm_async.plan import (
    ActionAbstract,
    Monitor,
    NavigateActionPerformable,
    Outcome,
    SimulatedTaskTree,
    TaskStatus,
    collected_tree,
)
from pycrorm_async.plan.execution import current_simulation
from pycrorm_async.plan.failures import NotALanguageExpression
from pycrorm_async.world import Pose, current_world
from tests.plan.conftest import Scene
from tests.plan.step_actions import Step

THERE = Pose([0.6, 0.4, 0])
DONE = Outcome(results=(None,), succeeded=(0,), interrupted=False)


@dataclass
class ThinkOfDrivingActionPerformable(ActionAbstract):
    """Simulate driving there and looking around, for a while."""

    target: Pose

    async def perform(self) -> None:
        with SimulatedTaskTree():
            await NavigateActionPerformable(self.target).perform()
            await Step("look", turns=5).perform()


@pytest.mark.parametrize("asks_later", [True, False])
async def test_a_simulation_does_not_interrupt_a_plan(scene: Scene, asks_later: bool) -> None:
    def has_left() -> bool:
        world = current_world.get()
        assert world is not None
        assert world.robot is not None
        return world.robot.pose.position.x > 0.3

    async def has_left_later() -> bool:
        await asyncio.sleep(0)
        return has_left()

    condition = has_left_later if asks_later else has_left
    plan = ThinkOfDrivingActionPerformable(THERE) + NavigateActionPerformable(THERE) + Step("never")
    with collected_tree() as tree:
        outcome = await (plan >> Monitor(condition, interval_s=60)).perform()
    assert outcome == Outcome(results=(None,), interrupted=True)
    assert [type(each.designator).__name__ for each in tree if each.status is TaskStatus.SUCCEEDED] == [
        "ThinkOfDrivingActionPerformable",
        "NavigateActionPerformable",
        "MoveMotion",
    ]


@pytest.mark.parametrize("asks_later", [True, False])
async def test_a_condition_performs_its_nodes_in_the_real_world_while_the_plan_simulates(
    scene: Scene, asks_later: bool
) -> None:
    simulated: list[bool] = []

    class Looking(ActionAbstract):
        async def perform(self) -> None:
            simulated.append(current_simulation.get() is not None)

    async def looks() -> bool:
        await Looking().perform()
        return False

    condition = looks if asks_later else functools.partial(looks)
    with collected_tree() as tree:
        await (ThinkOfDrivingActionPerformable(THERE) >> Monitor(condition, interval_s=60)).perform()
    # Checked once by the clock, and before each node: the simulating one, the drive, its motion, and the look.
    assert simulated == [False] * 5
    below = [type(node.designator).__name__ for node in tree.children(tree.roots[0])]
    assert sorted(below) == ["Looking"] * 5 + ["ThinkOfDrivingActionPerformable"]


async def test_a_condition_that_ignores_its_cancellation_does_not_outlive_the_plan() -> None:
    begun, checks = asyncio.Event(), asyncio.Event()

    class Waiting(ActionAbstract):
        async def perform(self) -> None:
            begun.set()
            await checks.wait()

    async def stubborn() -> bool:
        if begun.is_set():
            checks.set()
            with suppress(asyncio.CancelledError):
                await asyncio.Event().wait()
        return False

    async with asyncio.timeout(10):
        assert await (Waiting() >> Monitor(stubborn, interval_s=0.001)).perform() == DONE


@pytest.mark.parametrize("asks_later", [True, False])
async def test_a_cancelled_condition_interrupts_like_one_that_raises(asks_later: bool) -> None:
    checks = 0

    def broken() -> bool:
        nonlocal checks
        checks += 1
        if checks > 2:
            raise asyncio.CancelledError("the camera is gone")
        return False

    async def broken_later() -> bool:
        return broken()

    class Waiting(ActionAbstract):
        async def perform(self) -> None:
            await asyncio.Event().wait()

    plan = Waiting() >> Monitor(broken_later if asks_later else broken, interval_s=0.001)
    with pytest.raises(asyncio.CancelledError):
        async with asyncio.timeout(10):
            await plan.perform()


def test_a_condition_that_awaits_an_event_is_refused_with_the_event_suggested() -> None:
    with pytest.raises(NotALanguageExpression, match="pass the Event itself, not its wait"):
        Monitor(asyncio.Event().wait)
