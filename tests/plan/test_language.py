"""The plan language, in the reference system's own tests: their names, and what they were meant to test.

Where this language differs by design the test notes it: expressions raise when they fail, and two branches may require
the same hand, because they take turns.
"""

from __future__ import annotations

import asyncio
import math

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
    PlanFailures,
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


def test_inheritance() -> None:
    for each in (navigate(), navigate().resolve(), Code(print), navigate() + park()):
        assert isinstance(each, Composable)
        assert all(hasattr(each, operator) for operator in OPERATORS)
    assert isinstance(navigate() + park(), Expression)


def test_simplify_tree() -> None:
    a, b, c, d = navigate(), park(), MoveTorsoAction([0.3]), navigate(2.0)
    assert (a + b + c).operands == (a, b, c)
    assert (a + (b + c)).operands == (a, b, c)
    assert ((a + b) + (c + d)).operands == (a, b, c, d)
    assert (a | (b | (c | d))).operands == (a, b, c, d)
    assert (a ^ (b ^ c)).operands == (a, b, c)
    assert (a - b - (c - d)).operands == (a, b, c, d)
    assert Sequential(a, Sequential(b, c)).operands == (a, b, c)
    plan = a + (b + c)
    assert plan.simplify() is plan


def test_sequential_construction() -> None:
    a, b = navigate(), park()
    plan = a + b
    assert type(plan) is Sequential
    assert plan.operands == (a, b)


def test_parallel_construction() -> None:
    a, b = navigate(), park()
    plan = a | b
    assert type(plan) is Parallel
    assert plan.operands == (a, b)


def test_try_in_order_construction() -> None:
    a, b = navigate(), park()
    plan = a - b
    assert type(plan) is TryInOrder
    assert plan.operands == (a, b)


def test_try_all_construction() -> None:
    a, b = navigate(), park()
    plan = a ^ b
    assert type(plan) is TryAll
    assert plan.operands == (a, b)


def test_combination_construction() -> None:
    a, b, c = navigate(), park(), MoveTorsoAction([0.3])
    plan = a + b | c
    assert type(plan) is Parallel
    sequence, lift = plan.operands
    assert isinstance(sequence, Sequential)
    assert (sequence.operands, lift) == ((a, b), c)


def test_code_construction() -> None:
    code = Code(math.hypot)
    plan = navigate() + code
    assert isinstance(code, Designator)
    assert plan.operands[1] is code
    assert (code.function, code.arguments) == ("math.hypot", {})
    with pytest.raises(NotALanguageExpression, match="Code needs a function, got 3"):
        Code(3)  # type: ignore[arg-type]  # what is refused


def test_pickup_par_construction() -> None:
    # The reference system refuses this. Here both take turns when they need the same parts, see
    # test_language_resources.
    left, right = (PickUpAction([], [arm], [Grasp.FRONT]) for arm in (Arms.LEFT, Arms.RIGHT))
    assert (left | right).operands == (left, right)


def test_pickup_try_all_construction() -> None:
    left, right = (PickUpAction([], [arm], [Grasp.FRONT]) for arm in (Arms.LEFT, Arms.RIGHT))
    assert (left ^ right).operands == (left, right)


def test_monitor_construction() -> None:
    def sees_milk() -> bool:
        return True

    sequence = navigate() + park()
    plan = sequence >> Monitor(sees_milk)
    assert type(plan) is Monitor
    assert plan.operands == (sequence,)
    assert plan.condition.endswith("test_monitor_construction.<locals>.sees_milk")
    assert plan.interval_s == 0.1


def test_monitor_construction_error() -> None:
    with pytest.raises(NotALanguageExpression, match="this Monitor has no operand"):
        Monitor(lambda: True) >> Monitor(lambda: False)
    with pytest.raises(NotALanguageExpression, match=r"Monitor needs a callable or an asyncio\.Event, got bool"):
        Monitor(True)  # type: ignore[arg-type]  # what is refused
    with pytest.raises(NotALanguageExpression, match="the right operand of >> must be a Monitor"):
        navigate() >> park()
    with pytest.raises(NotALanguageExpression, match="this Monitor has an operand already"):
        navigate() >> (park() >> Monitor(lambda: True))


def test_repeat_construction() -> None:
    a = navigate()
    plan = a * 5
    assert type(plan) is Repeat
    assert (plan.operands, plan.times) == ((a,), 5)


def test_repeat_construction_reverse() -> None:
    a = navigate()
    plan = 5 * a
    assert type(plan) is Repeat
    assert (plan.operands, plan.times) == ((a,), 5)


@pytest.mark.parametrize("times", [1.5, "2", -1, True, None])
def test_repeat_construction_error(times: int) -> None:
    with pytest.raises(NotALanguageExpression, match="Repeat needs an integer times >= 0, got"):
        navigate() * times
    with pytest.raises(NotALanguageExpression, match="Repeat needs an integer times >= 0, got"):
        times * navigate()


async def test_perform_desig(scene: Scene) -> None:
    outcome = await (navigate(0.3, 0.3) + MoveTorsoAction([0.3]) + park()).perform()
    assert outcome == Outcome((None, None, None), (0, 1, 2))
    assert scene.robot.pose.position == pytest.approx((0.3, 0.3, 0))
    assert scene.robot.joint_position("torso_lift_joint") == pytest.approx(0.3)
    for arm in PR2.arms.values():
        for joint, position in arm.park.items():
            assert scene.robot.joint_position(joint) == pytest.approx(position)


async def test_perform_code() -> None:
    def add(a: int, b: int) -> int:
        return a + b

    async def slowly(text: str) -> str:
        await asyncio.sleep(0)
        return text

    outcome = await (Code(add, a=2, b=40) + Code(slowly, text="done")).perform()
    assert outcome.results == (42, "done")


async def test_perform_parallel() -> None:
    # Threads there; tasks here, each with a name.
    seen: list[asyncio.Task[None] | None] = []
    plan = Code(lambda: seen.append(asyncio.current_task())) | Code(lambda: seen.append(asyncio.current_task()))
    await plan.perform()
    assert len({*seen, asyncio.current_task()}) == 3
    assert [task.get_name() for task in seen if task is not None] == ["Parallel 0: Code", "Parallel 1: Code"]


async def test_perform_repeat() -> None:
    count = 0

    def increment() -> int:
        nonlocal count
        count += 1
        return count

    outcome = await (Code(increment) * 10).perform()
    assert count == 10
    assert (outcome.rounds, outcome.results) == (10, tuple(range(1, 11)))


def raiser(failure: PlanFailure) -> Code:
    def fail() -> None:
        raise failure

    return Code(fail)


async def test_exception_sequential(scene: Scene) -> None:
    failure = PlanFailure("no")
    with collected_tree() as tree, pytest.raises(PlanFailure) as caught:
        await (raiser(failure) + navigate()).perform()
    assert caught.value is failure
    assert (tree.roots[0].status, tree.roots[0].failure) == (TaskStatus.FAILED, failure)
    assert scene.robot.pose.position == pytest.approx((0, 0, 0))


async def test_exception_try_in_order(scene: Scene) -> None:
    failure = PlanFailure("no")
    with collected_tree() as tree:
        outcome = await (raiser(failure) - navigate()).perform()
    assert tree.roots[0].status is TaskStatus.SUCCEEDED
    assert (outcome.failures, outcome.succeeded) == ((failure,), (1,))
    assert scene.robot.pose.position == pytest.approx((1, 1, 0))


async def test_exception_parallel(scene: Scene) -> None:
    failure = PlanFailure("no")
    with collected_tree() as tree, pytest.raises(PlanFailure) as caught:
        await (raiser(failure) | navigate()).perform()
    assert caught.value is failure
    assert (tree.roots[0].status, tree.roots[0].failure) == (TaskStatus.FAILED, failure)
    assert scene.robot.pose.position == pytest.approx((1, 1, 0))


async def test_exception_try_all(scene: Scene) -> None:
    failure = PlanFailure("no")
    with collected_tree() as tree:
        outcome = await (raiser(failure) ^ navigate()).perform()
        with pytest.raises(PlanFailures) as caught:
            await (raiser(failure) ^ raiser(failure)).perform()
    assert [node.status for node in tree.roots] == [TaskStatus.SUCCEEDED, TaskStatus.FAILED]
    assert (outcome.failures, outcome.succeeded) == ((failure,), (1,))
    assert caught.value.exceptions == (failure, failure)
    assert isinstance(tree.roots[0].designator, TryAll)


async def test_descriptions_are_resolved_when_they_are_performed(scene: Scene) -> None:
    places: list[Pose] = []

    class Later(NavigateAction):
        def resolve(self) -> NavigateActionPerformable:
            return NavigateActionPerformable(places[-1])

    await (Code(lambda: places.append(Pose([0.5, 0.2, 0]))) + Later([])).perform()
    assert scene.robot.pose.position == pytest.approx((0.5, 0.2, 0))
