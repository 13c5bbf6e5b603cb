"""Exceptions that are no plan failures, and cancellations, end an expression and leave no task behind."""

from __future__ import annotations

import asyncio
import gc
from typing import Any

import pytest

from pycrorm_async.plan import (
    ActionAbstract,
    Code,
    Outcome,
    Parallel,
    PlanFailure,
    Retry,
    TaskStatus,
    TaskTreeNode,
    TryAll,
    collected_tree,
)
from pycrorm_async.plan.failures import ObjectLost
from pycrorm_async.plan.language import Attempt, Composable
from tests.plan.step_actions import Around, Step, drawn, failing

# --- exceptions that are no plan failures -----------------------------------------------------------------------------


@pytest.mark.parametrize("kind", [Parallel, TryAll])
async def test_any_other_exception_cancels_the_other_branches_and_is_raised(kind: type[Parallel]) -> None:
    bug = ValueError("bug")
    with collected_tree() as tree, pytest.raises(ValueError, match="bug") as caught:
        await kind(Step("a", turns=50), Step("b", turns=1, fails=bug), failing("c")).perform()
    assert caught.value is bug
    assert drawn(tree) == [
        f"{kind.__name__} ERROR (ValueError)",
        "├── Step CANCELLED (CancelledError)",
        "├── Step ERROR (ValueError)",
        "└── Step FAILED (PlanFailure)",
    ]


async def test_several_other_exceptions_are_raised_as_a_group() -> None:
    one, two = ValueError("one"), KeyError("two")
    with pytest.raises(ExceptionGroup) as caught:
        await (Step("a", fails=one) | Step("b", fails=two)).perform()
    assert caught.value.exceptions == (one, two)


async def test_an_exception_of_a_cleanup_precedes_the_cancellation() -> None:
    sleeping = asyncio.Event()

    class Careless(ActionAbstract):
        async def perform(self) -> None:
            sleeping.set()
            try:
                await asyncio.sleep(60)
            finally:
                raise KeyError("cleanup")

    task = asyncio.create_task((Careless() | Step("a", turns=1000)).perform())
    await sleeping.wait()
    task.cancel()
    with pytest.raises(KeyError, match="cleanup"):
        await task


@pytest.mark.parametrize("kind", [Parallel, TryAll])
async def test_a_branch_that_is_cancelled_ends_the_expression_as_cancelled(kind: type[Parallel]) -> None:
    plan = kind(Step("a", turns=50), Step("b", turns=1, fails=asyncio.CancelledError()))
    with collected_tree() as tree, pytest.raises(asyncio.CancelledError):
        await plan.perform()
    assert {node.status for node in tree} == {TaskStatus.CANCELLED}


async def test_sequences_alternatives_and_retries_do_not_continue_after_a_bug() -> None:
    bug, log = Step("a", fails=ValueError("bug")), list[str]()
    then = Step("b", log)
    for plan in (bug + then, bug - then, Retry(bug), bug * 3):
        with collected_tree() as tree, pytest.raises(ValueError, match="bug"):
            await plan.perform()
        assert [node.status for node in tree] == [TaskStatus.ERROR] * 2
    assert log == []


# --- cancellation -----------------------------------------------------------------------------------------------------


def everything(log: list[str]) -> Composable:
    def step(name: str) -> Step:
        return Step(name, log, turns=2)

    inner = (step("a") ^ failing("b", turns=1)) + (step("c") | step("d") | Around(step("e")))
    return (inner * 2 - step("f")) | Retry(failing("g", turns=1) - step("h")) | step("i") + Code(asyncio.sleep, delay=0)


async def test_a_plan_can_be_cancelled_at_every_await_and_leaves_no_task_behind() -> None:
    before = asyncio.all_tasks()
    turns = 0
    while True:
        with collected_tree() as tree:
            plan: Any = everything([])
            task = asyncio.create_task(plan.perform())
            for _ in range(turns):
                await asyncio.sleep(0)
            if task.done():
                break
            task.cancel()
            with pytest.raises(asyncio.CancelledError):
                await task
        assert asyncio.all_tasks() == before
        statuses = {node.status for node in tree}
        assert TaskStatus.RUNNING not in statuses
        assert TaskStatus.ERROR not in statuses
        assert all(node.status is TaskStatus.CANCELLED for node in tree.roots)
        turns += 1
    assert turns > 15
    assert (await task).succeeded == (0, 1, 2)


async def test_a_branch_that_ignores_its_cancellation_is_waited_for_and_the_cancellation_not_forgotten() -> None:
    log: list[str] = []

    class Stubborn(ActionAbstract):
        async def perform(self) -> None:
            for number in range(3):
                try:
                    await asyncio.sleep(60)
                except asyncio.CancelledError:
                    log.append(str(number))
            log.append("end")

    task = asyncio.create_task((Stubborn() | Step("a", turns=1000)).perform())
    for number in range(3):
        for _ in range(5):
            await asyncio.sleep(0)
        assert log == [str(each) for each in range(number)]
        task.cancel()
    with pytest.raises(asyncio.CancelledError):
        await task
    assert log == ["0", "1", "2", "end"]


async def test_a_branch_that_cleans_up_is_not_cancelled_a_second_time_by_the_same_cause() -> None:
    log: list[str] = []

    class Tidy(ActionAbstract):
        async def perform(self) -> None:
            try:
                await asyncio.sleep(60)
            finally:
                for number in range(10):
                    await asyncio.sleep(0)
                    log.append(str(number))

    async def cancels_all() -> None:
        task.cancel()
        raise asyncio.CancelledError

    task = asyncio.create_task((Step("a", turns=1000) | (Tidy() ^ Tidy() ^ Code(cancels_all))).perform())
    with pytest.raises(asyncio.CancelledError):
        await task
    assert sorted(log) == sorted("0123456789" * 2)


async def test_an_abandoned_plan_cancels_its_branches() -> None:
    before = asyncio.all_tasks()
    coroutine = (Step("a", turns=1000) | Step("b", turns=1000)).perform()
    while asyncio.all_tasks() == before:
        coroutine.send(None)
    for _ in range(3):
        await asyncio.sleep(0)
    assert len(asyncio.all_tasks() - before) == 2
    coroutine.close()
    for _ in range(3):
        await asyncio.sleep(0)
    assert asyncio.all_tasks() == before


@pytest.mark.slow
@pytest.mark.every_python
async def test_failed_expressions_leave_nothing_for_the_garbage_collector() -> None:
    async def plan() -> None:
        fails = [Step("x", fails=ObjectLost("gone")), Step("y", fails=PlanFailure("no"))]
        for each in (
            fails[0] + Step("a"), fails[0] - fails[1], fails[0] | fails[1], fails[0] | Step("a"), fails[0] ^ fails[1],
            fails[0] * 2, Retry(fails[0]), Step("z", fails=ValueError("bug")) | Step("a"), fails[0] - Step("a"),
            Step("c", fails=asyncio.CancelledError()) | Step("a"),
        ):  # fmt: skip
            try:
                await each.perform()
            except (PlanFailure, ValueError, asyncio.CancelledError):
                continue

    def left() -> int:
        return sum(isinstance(each, TaskTreeNode | Outcome | Attempt) for each in gc.get_objects())

    await plan()
    gc.collect()
    before = left()
    gc.disable()
    try:
        await plan()
        await asyncio.sleep(0)
        assert left() == before
    finally:
        gc.enable()
