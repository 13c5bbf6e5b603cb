"""The plan language, in the cases of the reference system's own tests.

Where this language differs by design the test notes it: expressions raise when they fail, and two branches may require
the same hand, because they take turns.
"""

from __future__ import annotations

import asyncio
import math
from collections.abc import Callable
from typing import Any

import pytest

from pycrorm_async.plan import (
    Code,
    Designator,
    Monitor,
    MoveTorsoAction,
    NavigateAction,
    NavigateActionPerformable,
    Outcome,
    Parallel,
    ParkArmsAction,
    PickUpAction,
    PlanFailure,
    Repeat,
    Sequential,
    TaskStatus,
    TryAll,
    TryInOrder,
    collected_tree,
)
from pycrorm_async.plan.failures import NotALanguageExpression
from pycrorm_async.plan.language import Composable, Expression
from pycrorm_async.world import Arms, Grasp, Pose
from pycrorm_async.world.urdf import PR2
from tests.plan.conftest import Scene

OPERATORS = "__add__ __sub__ __or__ __xor__ __mul__ __rmul__ __rshift__".split()


def navigate(x: float = 1.0, y: float = 1.0) -> NavigateAction:
    return NavigateAction([Pose([x, y, 0])])


def park() -> ParkArmsAction:
    return ParkArmsAction([Arms.BOTH])


LEFT, RIGHT = (PickUpAction([], [arm], [Grasp.FRONT]) for arm in (Arms.LEFT, Arms.RIGHT))
A, B, C, D = navigate(), park(), MoveTorsoAction([0.3]), navigate(2.0)


def test_every_designator_description_and_expression_has_the_operators() -> None:
    for each in (A, A.resolve(), Code(print), A + B):
        assert isinstance(each, Composable)
        assert all(hasattr(each, operator) for operator in OPERATORS)
    assert isinstance(A + B, Expression)


EXPRESSIONS: list[tuple[Expression, type[Expression], tuple[Composable, ...]]] = [
    (A + B, Sequential, (A, B)),
    (A | B, Parallel, (A, B)),
    (A - B, TryInOrder, (A, B)),
    (A ^ B, TryAll, (A, B)),
    (A + (B + C), Sequential, (A, B, C)),
    ((A + B) + (C + D), Sequential, (A, B, C, D)),
    (A | (B | (C | D)), Parallel, (A, B, C, D)),
    (A ^ (B ^ C), TryAll, (A, B, C)),
    (A - B - (C - D), TryInOrder, (A, B, C, D)),
    (Sequential(A, Sequential(B, C)), Sequential, (A, B, C)),
    (LEFT | RIGHT, Parallel, (LEFT, RIGHT)),  # the reference system refuses it; here both take turns
    (LEFT ^ RIGHT, TryAll, (LEFT, RIGHT)),
    (A * 5, Repeat, (A,)),
    (5 * A, Repeat, (A,)),
]


def test_an_operator_makes_an_expression_of_its_kind_without_nesting_it_in_another() -> None:
    for plan, kind, operands in EXPRESSIONS:
        assert type(plan) is kind
        assert plan.operands == operands
        assert plan.simplify() is plan
        assert not isinstance(plan, Repeat) or plan.times == 5


def test_expressions_of_different_kinds_nest() -> None:
    plan = A + B | C
    assert type(plan) is Parallel
    sequence, lift = plan.operands
    assert isinstance(sequence, Sequential)
    assert (sequence.operands, lift) == ((A, B), C)


def test_code_is_a_designator_of_its_function() -> None:
    code = Code(math.hypot)
    assert isinstance(code, Designator)
    assert (A + code).operands[1] is code
    assert (code.function, code.arguments) == ("math.hypot", {})
    with pytest.raises(NotALanguageExpression, match="Code needs a function, got 3"):
        Code(3)  # type: ignore[arg-type]  # what is refused


def test_a_monitor_has_the_name_of_its_condition_and_one_operand() -> None:
    def sees_milk() -> bool:
        return True

    sequence = A + B
    plan = sequence >> Monitor(sees_milk)
    assert type(plan) is Monitor
    assert plan.operands == (sequence,)
    assert plan.condition.endswith("<locals>.sees_milk")
    assert plan.interval_s == 0.1


@pytest.mark.parametrize(
    ("make", "message"),
    [
        (lambda: Monitor(lambda: True) >> Monitor(lambda: False), "this Monitor has no operand"),
        (lambda: Monitor(True), r"Monitor needs a callable or an asyncio\.Event, got bool"),  # type: ignore[arg-type]
        (lambda: A >> B, "the right operand of >> must be a Monitor"),
        (lambda: A >> (B >> Monitor(lambda: True)), "this Monitor has an operand already"),
        *(
            (lambda times=times: A * times, "Repeat needs an integer times >= 0")
            for times in (1.5, "2", -1, True, None)
        ),
        (lambda: -1 * A, "Repeat needs an integer times >= 0"),
    ],
)
def test_an_impossible_expression_is_refused_when_it_is_made(make: Callable[[], Any], message: str) -> None:
    with pytest.raises(NotALanguageExpression, match=message):
        make()


async def test_designators_are_performed_in_order(scene: Scene) -> None:
    outcome = await (navigate(0.3, 0.3) + MoveTorsoAction([0.3]) + park()).perform()
    assert outcome == Outcome((None, None, None), (0, 1, 2))
    assert scene.robot.pose.position == pytest.approx((0.3, 0.3, 0))
    assert scene.robot.joint_position("torso_lift_joint") == pytest.approx(0.3)
    for arm in PR2.arms.values():
        for joint, position in arm.park.items():
            assert scene.robot.joint_position(joint) == pytest.approx(position)


async def test_code_may_be_a_function_or_a_coroutine_function() -> None:
    def add(a: int, b: int) -> int:
        return a + b

    async def slowly(text: str) -> str:
        await asyncio.sleep(0)
        return text

    outcome = await (Code(add, a=2, b=40) + Code(slowly, text="done")).perform()
    assert outcome.results == (42, "done")


async def test_branches_are_tasks_with_names() -> None:
    seen: list[asyncio.Task[None] | None] = []
    plan = Code(lambda: seen.append(asyncio.current_task())) | Code(lambda: seen.append(asyncio.current_task()))
    await plan.perform()
    assert len({*seen, asyncio.current_task()}) == 3
    assert [task.get_name() for task in seen if task is not None] == ["Parallel 0: Code", "Parallel 1: Code"]


async def test_a_repetition_returns_the_result_of_each_round() -> None:
    count = iter(range(1, 11))
    outcome = await (Code(lambda: next(count)) * 10).perform()
    assert (outcome.rounds, outcome.results) == (10, tuple(range(1, 11)))


@pytest.mark.parametrize(
    ("combine", "succeeds", "moves"),
    [
        (lambda failing, then: failing + then, False, False),
        (lambda failing, then: failing - then, True, True),
        (lambda failing, then: failing | then, False, True),
        (lambda failing, then: failing ^ then, True, True),
    ],
    ids=["sequential", "in order", "parallel", "try all"],
)
async def test_a_failure_ends_a_sequence_and_fails_branches_and_alternatives_go_on(
    scene: Scene, combine: Callable[[Composable, Composable], Expression], succeeds: bool, moves: bool
) -> None:
    failure = PlanFailure("no")

    def fail() -> None:
        raise failure

    with collected_tree() as tree:
        if succeeds:
            outcome = await combine(Code(fail), A).perform()
            assert (outcome.failures, outcome.succeeded) == ((failure,), (1,))
        else:
            with pytest.raises(PlanFailure) as caught:
                await combine(Code(fail), A).perform()
            assert caught.value is failure
    status = TaskStatus.SUCCEEDED if succeeds else TaskStatus.FAILED
    assert (tree.roots[0].status, tree.roots[0].failure) == (status, None if succeeds else failure)
    assert scene.robot.pose.position == pytest.approx((1, 1, 0) if moves else (0, 0, 0))


async def test_descriptions_are_resolved_when_they_are_performed(scene: Scene) -> None:
    places: list[Pose] = []

    class Later(NavigateAction):
        def resolve(self) -> NavigateActionPerformable:
            return NavigateActionPerformable(places[-1])

    await (Code(lambda: places.append(Pose([0.5, 0.2, 0]))) + Later([])).perform()
    assert scene.robot.pose.position == pytest.approx((0.5, 0.2, 0))
