"""Monitors: their interruptions, the interrupted nodes, and their conditions in the real world."""

from __future__ import annotations

import asyncio
import functools
from collections.abc import Callable
from contextlib import suppress
from dataclasses import dataclass
from typing import Any

import pytest

from pycrorm_async.plan import (
    ActionAbstract,
    Monitor,
    MoveTorsoAction,
    NavigateActionPerformable,
    Outcome,
    PlanFailure,
    SimulatedTaskTree,
    TaskStatus,
    collected_tree,
)
from pycrorm_async.plan.execution import current_simulation
from pycrorm_async.plan.failures import NotALanguageExpression
from pycrorm_async.world import Pose, current_world
from tests.plan.conftest import Scene
from tests.plan.fakes import Around, Step, drawn, failing

# === language monitors ========================================================================================
#
# Monitors: their interruptions, the interrupted nodes, and the nodes that continue.

INTERRUPTED = Outcome(results=(None,), interrupted=True)


class Waiting(ActionAbstract):
    """Wait for ever, and note whether it was cancelled."""

    def __init__(self) -> None:
        self.begun = asyncio.Event()
        self.cancelled = False

    async def perform(self) -> None:
        self.begun.set()
        try:
            await asyncio.Event().wait()
        except asyncio.CancelledError:
            self.cancelled = True
            raise


def after(count: int) -> Callable[[], bool]:
    """Return a condition that holds after this many checks."""
    checks = 0

    def holds() -> bool:
        nonlocal checks
        checks += 1
        return checks > count

    return holds


async def test_a_plan_whose_monitor_never_holds_is_performed_to_its_end() -> None:
    with collected_tree() as tree:
        outcome = await (Step("a") + Step("b") >> Monitor(lambda: False)).perform()
    assert outcome == Outcome((Outcome(("a", "b"), (0, 1)),), (0,), interrupted=False)
    assert drawn(tree) == [
        "Monitor SUCCEEDED",
        "└── Sequential SUCCEEDED",
        "    ├── Step SUCCEEDED",
        "    └── Step SUCCEEDED",
    ]


async def test_a_plan_that_never_suspends_is_interrupted_between_its_nodes() -> None:
    log: list[str] = []
    with collected_tree() as tree:
        outcome = await ((Step("a", log) * 1000 >> Monitor(after(3))) + Step("b", log)).perform()
    # Checked before the Repeat, before the first step, before the second: it holds at the fourth check.
    assert log == ["a", "a.", "a", "a.", "b", "b."]
    assert outcome.results == (INTERRUPTED, "b")
    assert drawn(tree) == [
        "Sequential SUCCEEDED",
        "├── Monitor INTERRUPTED",
        "│   └── Repeat INTERRUPTED (CancelledError)",
        "│       ├── Step SUCCEEDED",
        "│       └── Step SUCCEEDED",
        "└── Step SUCCEEDED",
    ]


@pytest.mark.parametrize("kind", ["sync", "async", "event"])
async def test_a_plan_is_interrupted_inside_an_await(kind: str) -> None:
    happened = asyncio.Event()

    async def later() -> bool:
        await asyncio.sleep(0)
        return happened.is_set()

    conditions: dict[str, Any] = {"sync": happened.is_set, "async": later, "event": happened}
    waiting = Waiting()
    with collected_tree() as tree:
        plan = asyncio.create_task((Around(waiting) >> Monitor(conditions[kind], interval_s=0.001)).perform())
        await waiting.begun.wait()
        happened.set()
        assert await plan == INTERRUPTED
    assert waiting.cancelled
    assert drawn(tree) == [
        "Monitor INTERRUPTED",
        "└── Around INTERRUPTED (CancelledError)",
        "    └── Waiting INTERRUPTED (CancelledError)",
    ]


async def test_a_monitor_that_holds_from_the_start_lets_no_node_start() -> None:
    with collected_tree() as tree:
        assert await (Step("a") >> Monitor(lambda: True)).perform() == INTERRUPTED
    assert drawn(tree) == ["Monitor INTERRUPTED"]


async def test_all_branches_are_interrupted_whichever_of_them_notices() -> None:
    waiting = Waiting()
    branches = waiting | (Step("a", turns=2) + Step("b")) | Step("c", turns=1000)
    with collected_tree() as tree:
        assert await (branches >> Monitor(after(6), interval_s=60)).perform() == INTERRUPTED
    assert waiting.cancelled
    # Checked once by the monitor's own task, and before Parallel, Waiting, Sequential, a, c: the seventh check is
    # before b.
    assert drawn(tree) == [
        "Monitor INTERRUPTED",
        "└── Parallel INTERRUPTED (CancelledError)",
        "    ├── Waiting INTERRUPTED (CancelledError)",
        "    ├── Sequential INTERRUPTED (CancelledError)",
        "    │   └── Step SUCCEEDED",
        "    └── Step INTERRUPTED (CancelledError)",
    ]


async def test_each_of_nested_monitors_interrupts_what_is_inside_it() -> None:
    inner, outer, log = asyncio.Event(), asyncio.Event(), list[str]()
    first, second = Waiting(), Waiting()
    plan = (first >> Monitor(inner)) + second + Step("never", log) >> Monitor(outer)
    with collected_tree() as tree:
        task = asyncio.create_task((plan + Step("after", log)).perform())
        await first.begun.wait()
        inner.set()
        await second.begun.wait()
        outer.set()
        assert (await task).results == (INTERRUPTED, "after")
    assert log == ["after", "after."]
    assert drawn(tree) == [
        "Sequential SUCCEEDED",
        "├── Monitor INTERRUPTED",
        "│   └── Sequential INTERRUPTED (CancelledError)",
        "│       ├── Monitor INTERRUPTED",
        "│       │   └── Waiting INTERRUPTED (CancelledError)",
        "│       └── Waiting INTERRUPTED (CancelledError)",
        "└── Step SUCCEEDED",
    ]


@pytest.mark.parametrize("between_nodes", [True, False])
@pytest.mark.parametrize("asks_later", [True, False])
@pytest.mark.parametrize(
    ("bug", "status"),
    [(ZeroDivisionError("bug"), TaskStatus.ERROR), (asyncio.CancelledError("no camera"), TaskStatus.CANCELLED)],
)
async def test_an_exception_of_a_condition_interrupts_the_plan_and_is_raised(
    between_nodes: bool, asks_later: bool, bug: BaseException, status: TaskStatus
) -> None:
    checks = 0

    def holds() -> bool:
        nonlocal checks
        checks += 1
        if checks > 4:
            raise bug
        return False

    async def holds_later() -> bool:
        return holds()

    inside: Any = Step("a") * 1000 if between_nodes else Around(Waiting())
    monitor = Monitor(holds_later if asks_later else holds, interval_s=0.001)
    with collected_tree() as tree, pytest.raises(type(bug)) as caught:
        await (inside >> monitor).perform()
    assert caught.value is bug
    statuses = [node.status for node in tree if node.status is not TaskStatus.SUCCEEDED]
    assert statuses[0] is status
    assert set(statuses[1:]) == {TaskStatus.INTERRUPTED}


async def test_a_failure_inside_is_raised_and_nothing_is_interrupted() -> None:
    with collected_tree() as tree, pytest.raises(PlanFailure, match="a failed"):
        await (failing("a") >> Monitor(lambda: False)).perform()
    assert [node.status.name for node in tree] == ["FAILED", "FAILED"]


async def test_a_cancellation_from_outside_is_not_handled_by_the_monitor() -> None:
    waiting = Waiting()
    before = asyncio.all_tasks()
    with collected_tree() as tree:
        task = asyncio.create_task((waiting >> Monitor(lambda: False, interval_s=0.001)).perform())
        await waiting.begun.wait()
        task.cancel()
        with pytest.raises(asyncio.CancelledError):
            await task
    assert [node.status.name for node in tree] == ["CANCELLED", "CANCELLED"]
    assert asyncio.all_tasks() == before


async def test_a_plan_that_cancels_itself_is_not_interrupted() -> None:
    with collected_tree() as tree, pytest.raises(asyncio.CancelledError):
        await (Step("a", fails=asyncio.CancelledError()) >> Monitor(lambda: False)).perform()
    assert [node.status.name for node in tree] == ["CANCELLED", "CANCELLED"]


async def test_an_interrupted_plan_performs_its_finally_blocks() -> None:
    log: list[str] = []

    class Careful(ActionAbstract):
        async def perform(self) -> None:
            try:
                await (Step("a", log) * 1000).perform()
            finally:
                await (Step("tidy", log, turns=3) | Step("up", log, turns=3)).perform()

    with collected_tree() as tree:
        assert await (Careful() >> Monitor(after(5))).perform() == INTERRUPTED
    assert log[-4:] == ["tidy", "up", "tidy.", "up."]
    careful = tree.children(tree.roots[0])[0]
    assert [node.status.name for node in tree.children(careful)] == ["INTERRUPTED", "SUCCEEDED"]


async def test_a_failing_cleanup_of_an_interrupted_plan_is_raised() -> None:
    class Careless(ActionAbstract):
        async def perform(self) -> None:
            try:
                await (Step("a") * 1000).perform()
            finally:
                await failing("cleanup").perform()

    with pytest.raises(PlanFailure, match="cleanup failed"):
        await (Careless() >> Monitor(after(5))).perform()


async def test_nodes_of_a_condition_belong_to_the_monitor_and_are_not_checked() -> None:
    checks = 0

    async def looks() -> bool:
        nonlocal checks
        checks += 1
        await Around(Step("look")).perform()
        return checks > 2

    with collected_tree() as tree:
        assert await (Around(Around(Step("a"))) >> Monitor(looks, interval_s=60)).perform() == INTERRUPTED
    below = [type(node.designator).__name__ for node in tree.children(tree.roots[0])]
    assert sorted(below) == ["Around"] * 4
    assert sum(node.status is TaskStatus.INTERRUPTED for node in tree) == 2 + 1


async def test_a_task_that_the_plan_left_behind_is_not_interrupted_later() -> None:
    left: list[asyncio.Task[Any]] = []

    class Leaving(ActionAbstract):
        async def perform(self) -> None:
            left.append(asyncio.create_task(Around(Step("a"), before=20).perform()))

    held = asyncio.Event()
    outcome = await (Leaving() >> Monitor(held)).perform()
    assert outcome.interrupted is False
    held.set()
    assert await left[0] == "a"


async def test_a_node_in_a_task_of_the_plan_interrupts_the_plan() -> None:
    class AtOnce(ActionAbstract):
        async def perform(self) -> None:
            async with asyncio.TaskGroup() as group:
                for _ in range(3):
                    group.create_task((Step("a", turns=1) * 100).perform())

    before = asyncio.all_tasks()
    with collected_tree() as tree:
        assert await (AtOnce() >> Monitor(after(20), interval_s=60)).perform() == INTERRUPTED
    assert asyncio.all_tasks() == before
    assert {node.status.name for node in tree} == {"INTERRUPTED", "SUCCEEDED"}


async def test_a_monitor_without_an_operand_cannot_be_performed() -> None:
    with pytest.raises(NotALanguageExpression, match="this Monitor has no operand: write plan >> Monitor"):
        await Monitor(lambda: True).perform()
    with pytest.raises(NotALanguageExpression, match="so Parallel cannot perform it"):
        Step("a") | Monitor(lambda: True)


@pytest.mark.parametrize("interval_s", [0, -1, float("inf"), float("nan"), "1", True, None])
def test_an_invalid_interval_is_refused(interval_s: float) -> None:
    with pytest.raises(NotALanguageExpression, match="Monitor needs a finite interval_s > 0, got"):
        Monitor(lambda: True, interval_s)


async def test_a_subclass_of_an_expression_keeps_its_class() -> None:
    class Careful(Monitor):
        async def perform(self) -> Outcome:
            return await super().perform()

    monitor = Careful(lambda: False, 2)
    plan = MoveTorsoAction([0.1]) >> monitor
    assert type(plan) is Careful
    assert (plan.interval_s, monitor.operands) == (2.0, ())


# === monitors in simulation ===================================================================================
#
# A monitor checks its condition in the real world, even while the plan that it monitors only simulates.

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


def test_a_condition_that_awaits_an_event_is_refused_with_the_event_suggested() -> None:
    with pytest.raises(NotALanguageExpression, match="pass the Event itself, not its wait"):
        Monitor(asyncio.Event().wait)
