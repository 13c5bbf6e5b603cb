"""Results, failures and exceptions of expressions: nested, alternative, concurrent, repeated and cancelled."""

from __future__ import annotations

import asyncio
import gc
from typing import Any

import pytest

from pycrorm_async.plan import (
    ActionAbstract,
    Code,
    MoveTorsoAction,
    NavigateAction,
    Outcome,
    Parallel,
    PlanFailure,
    PlanFailures,
    Repeat,
    Retry,
    Sequential,
    SetGripperAction,
    TaskStatus,
    TaskTreeNode,
    TryAll,
    TryInOrder,
    collected_tree,
)
from pycrorm_async.plan.failures import (
    IllPosedGoalFailure,
    NotALanguageExpression,
    ObjectLost,
    ObjectUnreachable,
    TorsoGoalUnreachable,
)
from pycrorm_async.plan.language import Attempt, Composable
from pycrorm_async.world import Arms, GripperState
from tests.plan.conftest import Scene
from tests.plan.fakes import Around, Step, drawn, failing

# === language outcomes ========================================================================================
#
# Results and failures of expressions: nested, alternative, concurrent and repeated.

# --- outcomes ---------------------------------------------------------------------------------------------------------


async def test_alternatives_end_with_the_first_success() -> None:
    log: list[str] = []
    one, two = PlanFailure("a failed"), PlanFailure("b failed")
    outcome = await (Step("a", fails=one) - Step("b", fails=two) - Step("c", log) - Step("d", log)).perform()
    assert outcome == Outcome((None, None, "c", None), (2,), (one, two))
    assert outcome.in_brief() == {
        "succeeded": [2],
        "failures": ["PlanFailure: a failed", "PlanFailure: b failed"],
    }
    assert log == ["c", "c."]


async def test_all_failures_are_raised_together_and_named() -> None:
    one, two = Step("a", fails=ObjectLost("gone")), Step("b", fails=ObjectUnreachable("too far", "milk"))
    for plan, words in (
        (one - two, "none of 2 alternatives succeeded: "),
        (one ^ two, "none of 2 branches succeeded: "),
        (one | two | Step("c"), "2 of 3 branches failed: "),
    ):
        with pytest.raises(PlanFailures) as caught:
            await plan.perform()
        assert caught.value.exceptions == (one.fails, two.fails)
        assert str(caught.value) == f"{words}ObjectLost: gone; ObjectUnreachable: too far"


async def test_of_many_failures_ten_are_named() -> None:
    with pytest.raises(PlanFailures) as caught:
        await Repeat(failing("a", "x"), 14).perform()
    rounds = "1, 2, 3, 4, 5, 6, 7, 8, 9, 10, …"
    named = "; ".join(["PlanFailure: x"] * 10)
    assert str(caught.value) == f"14 of 14 rounds failed ({rounds}): {named}; and 4 more"
    assert len(caught.value.exceptions) == 14


async def test_an_exception_group_of_the_plan_counts_as_a_failure() -> None:
    class AtOnce(ActionAbstract):
        async def perform(self) -> None:
            async with asyncio.TaskGroup() as group:
                group.create_task(failing("a").perform())

    outcome = await (AtOnce() - Step("b")).perform()
    assert isinstance(outcome.failures[0], ExceptionGroup)
    assert outcome.in_brief() == {
        "succeeded": [1],
        "failures": ["ExceptionGroup: unhandled errors in a TaskGroup (1 sub-exception)"],
    }


# --- operands ---------------------------------------------------------------------------------------------------------


class Odd:
    def __repr__(self) -> str:
        raise RuntimeError("no repr")


@pytest.mark.parametrize(
    ("operand", "named"),
    [
        (3, "3"),
        ("a", "'a'"),
        (None, "None"),
        (Step, "<class 'tests.plan.fakes.Step'>: make an instance"),
        (print, "<built-in function print>: wrap it in Code(…)"),
        (Odd(), "<Odd: RuntimeError: no repr>"),
    ],
    ids=["a number", "a text", "none", "a class", "a function", "without repr"],
)
def test_an_invalid_operand_is_refused_on_either_side(operand: Any, named: str) -> None:
    step = Step("a")
    for make, name in (
        (lambda: step + operand, "Sequential"),
        (lambda: operand + step, "Sequential"),
        (lambda: step - operand, "TryInOrder"),
        (lambda: operand - step, "TryInOrder"),
        (lambda: step | operand, "Parallel"),
        (lambda: operand | step, "Parallel"),
        (lambda: step ^ operand, "TryAll"),
        (lambda: operand ^ step, "TryAll"),
        (lambda: Sequential(step, operand), "Sequential"),
        (lambda: Repeat(operand, 2), "Repeat"),
        (lambda: Retry(operand), "Retry"),
    ):
        with pytest.raises(NotALanguageExpression) as caught:
            make()
        assert str(caught.value) == f"{name} needs designators or descriptions of actions, got {named}"


@pytest.mark.parametrize("kind", [Sequential, TryInOrder, Parallel, TryAll])
def test_an_expression_without_operands_is_refused(kind: type[Sequential]) -> None:
    with pytest.raises(NotALanguageExpression, match=f"{kind.__name__} needs something to perform"):
        kind()


async def test_one_operand_may_be_used_in_several_places() -> None:
    log: list[str] = []
    step = Step("a", log)
    plan = (step | step) + step * 2
    assert (await plan.perform()).succeeded == (0, 1)
    assert (await plan.perform()).succeeded == (0, 1)
    assert log == ["a", "a."] * 8


async def test_a_failed_resolution_is_a_failure_of_the_operand(scene: Scene) -> None:
    outcome = await (NavigateAction([]) - SetGripperAction([Arms.LEFT], [GripperState.OPEN])).perform()
    assert [type(each) for each in outcome.failures] == [IllPosedGoalFailure]
    assert outcome.succeeded == (1,)


async def test_the_text_of_an_outcome_has_only_what_is_present() -> None:
    assert repr(await (Step("a") - Step("b")).perform()) == "Outcome(results=('a', None), succeeded=(0,))"
    assert repr(Outcome((None,), interrupted=False)) == "Outcome(results=(None,), interrupted=False)"


async def test_code_keeps_names_and_short_texts_of_its_arguments() -> None:
    code = Code(asyncio.sleep, delay=0, result="x" * 200, odd=Odd())
    assert code.function == "asyncio.tasks.sleep"
    assert code.arguments == {"delay": "0", "result": f"'{'x' * 98}…", "odd": "<Odd: RuntimeError: no repr>"}


# --- retry ------------------------------------------------------------------------------------------------------------


async def test_alternatives_of_a_description_are_tried_in_turn_until_one_succeeds(scene: Scene) -> None:
    with collected_tree() as tree:
        result = await Retry(MoveTorsoAction([5.0, 7.0, 0.2, 0.1]), max_tries=4).perform()
    assert result is None
    assert scene.robot.joint_position("torso_lift_joint") == pytest.approx(0.2)
    assert [node.status.name for node in tree.children(tree.roots[0])] == ["FAILED", "FAILED", "SUCCEEDED"]


async def test_the_last_failure_is_raised_after_the_last_attempt(scene: Scene) -> None:
    with pytest.raises(TorsoGoalUnreachable) as caught:
        await Retry(MoveTorsoAction([5.0, 7.0, 0.2]), max_tries=2).perform()
    assert caught.value.data == (7.0,)
    assert len(caught.value.__notes__) == 1
    assert caught.value.__notes__[0].startswith("try 1: TorsoGoalUnreachable: ")
    assert scene.robot.joint_position("torso_lift_joint") == pytest.approx(0.0)


async def test_a_designator_is_tried_again_and_its_result_returned() -> None:
    tries: list[int] = []

    def third() -> str:
        tries.append(len(tries))
        if len(tries) < 3:
            raise PlanFailure
        return "done"

    assert await Retry(Code(third), max_tries=3).perform() == "done"
    assert tries == [0, 1, 2]


async def test_a_description_without_alternatives_is_a_failure() -> None:
    class Nothing(MoveTorsoAction):
        def __iter__(self) -> Any:
            return iter(())

    with pytest.raises(IllPosedGoalFailure, match=r"Retry\(Nothing\): the description has no alternative"):
        await Retry(Nothing([])).perform()
    with pytest.raises(IllPosedGoalFailure, match="has no alternative for position"):
        await Retry(MoveTorsoAction([])).perform()


@pytest.mark.parametrize("tries", [0, -1, 1.5, None, True])
def test_fewer_attempts_than_one_are_refused(tries: int) -> None:
    with pytest.raises(NotALanguageExpression, match="Retry needs an integer max_tries >= 1, got"):
        Retry(Step("a"), tries)


# === language exceptions ======================================================================================
#
# Exceptions that are no plan failures, and cancellations, end an expression and leave no task behind.

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
