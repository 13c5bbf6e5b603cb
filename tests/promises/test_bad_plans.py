"""Impossible actions and wrongly built expressions are recorded as failed, and the plan around them continues."""

from __future__ import annotations

from collections.abc import Awaitable, Callable
from dataclasses import dataclass
from pathlib import Path
from typing import Any, NamedTuple

import pytest
from sqlalchemy import select

from pycrorm_async.errors import CallerError
from pycrorm_async.orm import Action, TaskTreeNode
from pycrorm_async.plan import (
    ActionAbstract,
    BelieveObject,
    DetectAction,
    DetectActionPerformable,
    MoveTorsoAction,
    NavigateAction,
    NavigateActionPerformable,
    ObjectDesignatorDescription,
    ParkArmsAction,
    PickUpAction,
    PlanFailure,
    PlanFailures,
)
from pycrorm_async.task_status import TaskStatus
from pycrorm_async.world import Arms, BulletWorld, Grasp, ObjectType, Pose
from tests.memory.note_actions import NoteActionPerformable
from tests.promises.lab import Lab, lab, nodes_of, recorded, results_of, statuses

pytestmark = pytest.mark.slow


# === bad input in plans =======================================================================================
#
# An impossible action is recorded with class, message and data at every node it passes, and the plan continues.


@dataclass
class AttemptActionPerformable(ActionAbstract):
    """Perform the given part, and ignore its failures."""

    _what: Callable[[], Awaitable[object]]

    async def perform(self) -> None:
        await self._what()


@dataclass
class ServingActionPerformable(ActionAbstract):
    """Try to perform the part, and continue with another one when it fails."""

    _attempt: AttemptActionPerformable

    async def perform(self) -> None:
        try:
            await self._attempt.perform()
        except PlanFailure:
            await NoteActionPerformable("went on").perform()


class Case(NamedTuple):
    """An attempt, and what must be recorded of it.

    `arguments` follow the message; `below` are the nodes that failed inside the attempt.
    """

    attempt: Callable[[Lab], Awaitable[object]]
    reason: str
    message: str
    arguments: list[Any]
    below: tuple[str, ...] = ()


async def resolved(description: Any) -> object:
    return await description.resolve().perform()


async def located(location: Any) -> object:
    return location.resolve()


async def looked_away(scene: Lab) -> object:
    scene.milk.set_pose(Pose([-1, 0, 1]))
    return await DetectActionPerformable(scene.milk).perform()


CASES = {
    "nothing of that type": Case(
        lambda _: resolved(
            PickUpAction(ObjectDesignatorDescription(types=[ObjectType.BOWL]), [Arms.LEFT], [Grasp.TOP])
        ),
        "ObjectNotFound",
        "no object is of type BOWL; in the world: pr2, milk, cereal",
        [None, ["BOWL"]],
    ),
    "too high for the torso": Case(
        lambda _: resolved(MoveTorsoAction([1.5])),
        "TorsoGoalUnreachable",
        "'pr2': torso_lift_joint cannot be set to 1.5; its limits are 0 to 0.33",
        [1.5],
        ("MoveTorsoAction", "MoveJointsMotion"),
    ),
    "perception of what is out of sight": Case(
        looked_away,
        "PerceptionObjectNotFound",
        "no MILK is seen; 1 in the world: milk is outside the camera's field of view",
        ["MILK", {"milk": "is outside the camera's field of view"}],
        ("DetectAction", "DetectingMotion"),
    ),
}


@pytest.mark.parametrize("case", CASES.values(), ids=CASES)
async def test_an_impossible_action_is_recorded_and_the_plan_continues(tmp_path: Path, case: Case) -> None:
    async with recorded(tmp_path):
        with lab() as scene:
            await ServingActionPerformable(AttemptActionPerformable(lambda: case.attempt(scene))).perform()
    root, serving, *nodes = await nodes_of(tmp_path)
    assert statuses([root, serving]) == [(None, "SUCCEEDED"), ("ServingAction", "SUCCEEDED")]
    assert (root.reason, serving.reason) == (None, None)
    failed = [node for node in nodes if node.status is TaskStatus.FAILED]
    assert [node.dtype for node in failed] == ["AttemptAction", *case.below]
    for node in failed:
        assert (node.reason, node.failure_message) == (case.reason, case.message)
        assert node.failure_arguments == [case.message, *case.arguments]
        assert node.end_time is not None
    assert statuses(nodes[-1:]) == [("NoteAction", "SUCCEEDED")]
    assert nodes[-1].parent is not None
    assert nodes[-1].parent.id == serving.id


async def test_a_plan_without_world_or_robot_fails_with_the_next_step_and_is_recorded(tmp_path: Path) -> None:
    async with recorded(tmp_path):
        with pytest.raises(CallerError, match="with simulated_robot:"):
            await NavigateActionPerformable(Pose()).perform()
        with pytest.raises(CallerError, match=r"call it inside `with BulletWorld\(\) as world:`"):
            await resolved(MoveTorsoAction([0.1]))
        with BulletWorld(), pytest.raises(CallerError, match="add one"):
            await resolved(MoveTorsoAction([0.1]))
    actions = await results_of(tmp_path, select(Action).order_by(Action.id))
    assert [each.dtype for each in actions] == ["NavigateAction", "MoveTorsoAction", "MoveTorsoAction"]
    reasons = select(TaskTreeNode.reason).where(TaskTreeNode.kind == "action").order_by(TaskTreeNode.id)
    assert await results_of(tmp_path, reasons) == ["NoRobotChosen", "NoWorld", "NoRobotHere"]


# === bad expressions ==========================================================================================
#
# An expression that was built wrongly, or of impossible parts, is recorded as failed, and the plan around it continues.


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
