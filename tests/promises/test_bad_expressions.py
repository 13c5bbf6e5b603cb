"""An expression that was built wrongly, or of impossible parts, is recorded as failed, and the plan around it
continues.
"""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import pytest

from pycrorm_async.plan import (
    ActionAbstract,
    BelieveObject,
    Code,
    DetectAction,
    Monitor,
    NavigateAction,
    NavigateActionPerformable,
    ParkArmsAction,
    PickUpAction,
    PlanFailure,
    PlanFailures,
    Repeat,
    Retry,
)
from pycrorm_async.task_status import TaskStatus
from pycrorm_async.world import Arms, Grasp, ObjectType, Pose
from tests.memory.note_actions import NoteActionPerformable
from tests.promises.lab import lab, nodes_of, recorded, statuses

pytestmark = pytest.mark.slow

well: Any = NoteActionPerformable("well")
nothing: Any = 7
"""Any, because a type checker would refuse these expressions."""


@dataclass
class PlanningActionPerformable(ActionAbstract):
    """Build an expression during the perform, and perform it."""

    _made: Callable[[], Any]

    async def perform(self) -> None:
        await self._made().perform()


WRONG: dict[str, tuple[Callable[[], Any], str]] = {
    "a number on the right": (lambda: well + 7, "Sequential needs designators or descriptions of actions, got 7"),
    "a text on the left": (
        lambda: "milk" - well,
        "TryInOrder needs designators or descriptions of actions, got 'milk'",
    ),
    "a class and no instance": (lambda: well | NavigateActionPerformable, "make an instance"),
    "a function": (lambda: well | print, "wrap it in Code"),
    "half a repetition": (lambda: well * 1.5, "an integer times >= 0"),
    "repeated less than never": (lambda: Repeat(well, -1), "an integer times >= 0"),
    "a monitor that asks nobody": (lambda: well >> Monitor(nothing), "a callable or an asyncio.Event"),
    "a monitor of nothing": (lambda: well + Monitor(lambda: True), "has no operand"),
    "watched by an action": (lambda: well >> well, "must be a Monitor"),
    "a call of nothing": (lambda: Code(nothing), "needs a function"),
    "tried less than once": (lambda: Retry(well, max_tries=0), "an integer max_tries >= 1"),
}


@pytest.mark.parametrize("name", WRONG)
async def test_an_expression_that_was_built_wrongly_fails_with_the_reason(tmp_path: Path, name: str) -> None:
    wrong_expression, why = WRONG[name]
    async with recorded(tmp_path):
        await (PlanningActionPerformable(wrong_expression) - NoteActionPerformable("went on")).perform()
    _, expression, planning, note = await nodes_of(tmp_path)
    assert statuses([expression, planning, note]) == [
        ("TryInOrder", "SUCCEEDED"),
        ("PlanningAction", "FAILED"),
        ("NoteAction", "SUCCEEDED"),
    ]
    assert planning.reason == "NotALanguageExpression"
    assert planning.failure_message is not None
    assert why in planning.failure_message
    assert "\n" not in planning.failure_message
    assert planning.failure_arguments is not None
    assert planning.failure_arguments[0] == planning.failure_message


async def test_an_empty_alternative_among_others_is_skipped_and_recorded(tmp_path: Path) -> None:
    async with recorded(tmp_path):
        with lab():
            await (NavigateAction([]) - ParkArmsAction([Arms.LEFT])).perform()
    _, expression, park, motion = await nodes_of(tmp_path)
    assert statuses([expression, park, motion]) == [
        ("TryInOrder", "SUCCEEDED"),
        ("ParkArmsAction", "SUCCEEDED"),
        ("MoveArmJointsMotion", "SUCCEEDED"),
    ]
    # It was never performed, so that it has no node; the expression has its type.
    message = "IllPosedGoalFailure: NavigateAction has no alternative for target_location"
    assert expression.result == {"succeeded": [1], "failures": [message]}


async def test_a_retry_without_any_alternative_fails_with_the_description_named(tmp_path: Path) -> None:
    async with recorded(tmp_path):
        with pytest.raises(PlanFailure):
            await Retry(ParkArmsAction([]), max_tries=3).perform()
    _, retry = await nodes_of(tmp_path)
    assert (retry.dtype, retry.status, retry.reason) == ("Retry", TaskStatus.FAILED, "IllPosedGoalFailure")
    assert retry.failure_message == "ParkArmsAction has no alternative for arm"
    assert retry.failure_arguments == ["ParkArmsAction has no alternative for arm", "arm"]


async def test_a_retry_tries_again_when_a_pose_is_out_of_reach(tmp_path: Path) -> None:
    async with recorded(tmp_path):
        with lab() as scene:
            scene.robot.set_pose(Pose([0.6, 0.4, 0]))
            await Retry(PickUpAction(scene.milk, [Arms.RIGHT, Arms.LEFT], [Grasp.FRONT]), max_tries=2).perform()
    nodes = await nodes_of(tmp_path)
    assert statuses(nodes)[1:5] == [
        ("Retry", "SUCCEEDED"),
        ("PickUpAction", "FAILED"),
        ("MoveTCPMotion", "FAILED"),
        ("PickUpAction", "SUCCEEDED"),
    ]
    for node in nodes[2:4]:
        assert node.reason == "IKError"
        assert node.failure_arguments is not None
        assert node.failure_arguments[1:3] == ["RIGHT", "r_gripper_tool_frame"]


async def test_concurrent_failures_are_recorded_with_each_of_them(tmp_path: Path) -> None:
    bowl = BelieveObject("bowl", ObjectType.BOWL, Pose([1, 0, 1]))
    async with recorded(tmp_path):
        with lab() as scene:
            scene.milk.remove()
            gone = PickUpAction(scene.milk, [Arms.LEFT], [Grasp.FRONT])
            plan = (gone | DetectAction(bowl) | NoteActionPerformable("well")) - NoteActionPerformable("went on")
            await plan.perform()
            with pytest.raises(PlanFailures) as caught:
                await (gone | DetectAction(bowl)).perform()
            assert sorted(type(each).__name__ for each in caught.value.exceptions) == [
                "PerceptionObjectNotFound",
                "PerceptionObjectNotInWorld",
            ]
    _, *nodes = await nodes_of(tmp_path)
    assert sorted(statuses(nodes[:6])) == [
        ("DetectAction", "FAILED"),
        ("DetectingMotion", "FAILED"),
        ("NoteAction", "SUCCEEDED"),
        ("Parallel", "FAILED"),
        ("PickUpAction", "FAILED"),
        ("TryInOrder", "SUCCEEDED"),
    ]
    assert statuses(nodes[6:7]) == [("NoteAction", "SUCCEEDED")]
    parallel = next(node for node in nodes if node.dtype == "Parallel")
    assert parallel.reason == "PlanFailures"
    assert parallel.failure_message is not None
    assert "milk is not an object of the world" in parallel.failure_message
    assert "no BOWL is seen" in parallel.failure_message
    gone_message, unseen = "milk is not an object of the world", "no BOWL is seen; there is none in the world"
    assert parallel.failure_arguments == [
        parallel.failure_message,
        [
            {
                "type": "PerceptionObjectNotInWorld",
                "message": gone_message,
                "arguments": [gone_message, "milk"],
            },
            {
                "type": "PerceptionObjectNotFound",
                "message": unseen,
                "arguments": [unseen, "BOWL", {}],
            },
        ],
    ]
