"""Results and failures of expressions: nested, alternative, concurrent and repeated."""

from __future__ import annotations

import asyncio
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
from pycrorm_async.world import Arms, GripperState
from tests.plan.conftest import Scene
from tests.plan.step_actions import Step, drawn, failing

# --- errors of the reference system -----------------------------------------------------------------------------------


async def test_a_failure_inside_an_inner_expression_fails_the_outer_one() -> None:
    with pytest.raises(PlanFailure, match="b failed"):
        await ((Step("a") + failing("b")) | Step("c")).perform()
    with pytest.raises(PlanFailure, match="a failed"):
        await ((failing("a") | Step("b")) + Step("c")).perform()


async def test_an_expression_in_brackets_is_performed_in_the_order_as_written() -> None:
    log: list[str] = []
    a, b, c, d = (Step(name, log) for name in "abcd")
    await (a + (b + (c + d))).perform()
    assert "".join(log) == "aa.bb.cc.dd."


async def test_a_repetition_continues_after_failed_rounds_and_returns_them() -> None:
    rounds = 0

    def fails_in_two_and_four() -> int:
        nonlocal rounds
        rounds += 1
        if rounds in (2, 4):
            raise ObjectLost(f"gone in {rounds}")
        return rounds

    with pytest.raises(PlanFailures) as caught:
        await (Code(fails_in_two_and_four) * 5).perform()
    assert rounds == 5
    assert str(caught.value) == "2 of 5 rounds failed (2, 4): ObjectLost: gone in 2; ObjectLost: gone in 4"
    with pytest.raises(ObjectLost, match="gone in 2") as single_failure:
        rounds = 0
        await (Code(fails_in_two_and_four) * 3).perform()
    assert single_failure.value.__notes__ == ["this was round 2 of 3; the others succeeded"]
    assert await (Code(int) * 0).perform() == Outcome(rounds=0)


async def test_every_branch_performs_its_own_operand() -> None:
    outcome = await Parallel(*(Step(str(number), turns=5 - number) for number in range(5))).perform()
    assert outcome == Outcome(("0", "1", "2", "3", "4"), (0, 1, 2, 3, 4))


async def test_expressions_are_nodes_with_those_of_their_operands_below() -> None:
    with collected_tree() as tree:
        await ((Step("a") + failing("b") - Step("c")) | Step("d") * 2).perform()
    assert drawn(tree) == [
        "Parallel SUCCEEDED",
        "├── TryInOrder SUCCEEDED",
        "│   ├── Sequential FAILED (PlanFailure)",
        "│   │   ├── Step SUCCEEDED",
        "│   │   └── Step FAILED (PlanFailure)",
        "│   └── Step SUCCEEDED",
        "└── Repeat SUCCEEDED",
        "    ├── Step SUCCEEDED",
        "    └── Step SUCCEEDED",
    ]


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


async def test_a_plan_can_continue_after_one_class_of_failure_and_not_after_another() -> None:
    handled: list[str] = []
    with pytest.raises(PlanFailures) as caught:
        try:
            await (Step("a", fails=ObjectLost("gone")) | Step("b", fails=ObjectUnreachable("far"))).perform()
        except* ObjectLost as lost:
            handled += map(str, lost.exceptions)
    assert handled == ["gone"]
    assert [str(each) for each in caught.value.exceptions] == ["far"]


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


async def test_one_success_is_enough_for_concurrent_alternatives_and_all_run_to_their_end() -> None:
    log: list[str] = []
    outcome = await (failing("a") ^ Step("b", log) ^ Step("c", log, turns=5)).perform()
    assert (outcome.results, outcome.succeeded) == ((None, "b", "c"), (1, 2))
    assert log == ["b", "b.", "c", "c."]


async def test_a_failed_branch_does_not_stop_the_others() -> None:
    log: list[str] = []
    with pytest.raises(PlanFailure):
        await (failing("a") | Step("b", log, turns=5)).perform()
    assert log == ["b", "b."]


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
        (Step, "<class 'tests.plan.step_actions.Step'>: make an instance"),
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


async def test_the_text_of_an_expression_has_the_operations_that_it_performs() -> None:
    plan = Step("a") + NavigateAction([]) + Code(print) * 2
    assert repr(plan) == "Sequential(StepAction, NavigateAction, Repeat)"
    assert repr(Code(print)) == "Code(print)"


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


async def test_the_last_failure_is_raised_when_the_alternatives_end(scene: Scene) -> None:
    with pytest.raises(TorsoGoalUnreachable) as caught:
        await Retry(MoveTorsoAction([5.0, 7.0]), max_tries=10).perform()
    assert caught.value.data == (7.0,)


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
