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
    Parallel,
    ParkArmsAction,
    PickUpAction,
    Repeat,
    Sequential,
    TryAll,
    TryInOrder,
)
from pycrorm_async.plan.failures import NotALanguageExpression
from pycrorm_async.plan.language import Composable, Expression
from pycrorm_async.world import Arms, Grasp, Pose
from tests.plan.conftest import Scene


def navigate(x: float = 1.0, y: float = 1.0) -> NavigateAction:
    return NavigateAction([Pose([x, y, 0])])


def park() -> ParkArmsAction:
    return ParkArmsAction([Arms.BOTH])


LEFT, RIGHT = (PickUpAction([], [arm], [Grasp.FRONT]) for arm in (Arms.LEFT, Arms.RIGHT))
A, B, C, D = navigate(), park(), MoveTorsoAction([0.3]), navigate(2.0)


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


def test_code_is_a_designator_of_its_function() -> None:
    code = Code(math.hypot)
    assert isinstance(code, Designator)
    assert (A + code).operands[1] is code
    assert (code.function, code.arguments) == ("math.hypot", {})
    with pytest.raises(NotALanguageExpression, match="Code needs a function, got 3"):
        Code(3)  # type: ignore[arg-type]  # what is refused


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


async def test_code_may_be_a_function_or_a_coroutine_function() -> None:
    def add(a: int, b: int) -> int:
        return a + b

    async def slowly(text: str) -> str:
        await asyncio.sleep(0)
        return text

    outcome = await (Code(add, a=2, b=40) + Code(slowly, text="done")).perform()
    assert outcome.results == (42, "done")


async def test_descriptions_are_resolved_when_they_are_performed(scene: Scene) -> None:
    places: list[Pose] = []

    class Later(NavigateAction):
        def resolve(self) -> NavigateActionPerformable:
            return NavigateActionPerformable(places[-1])

    await (Code(lambda: places.append(Pose([0.5, 0.2, 0]))) + Later([])).perform()
    assert scene.robot.pose.position == pytest.approx((0.5, 0.2, 0))
