"""Impossible actions and wrongly built expressions are recorded as failed, and the plan around them continues."""

from __future__ import annotations

from collections.abc import Awaitable, Callable
from dataclasses import dataclass, replace
from pathlib import Path
from typing import Any, NamedTuple

import pytest
from sqlalchemy import select

from pycrorm_async import Memory
from pycrorm_async.errors import CallerError
from pycrorm_async.orm import Action, Detection, LocationResolution, ProcessMetaData, TaskTreeNode
from pycrorm_async.plan import (
    ActionAbstract,
    BelieveObject,
    Code,
    CostmapLocation,
    DetectAction,
    DetectActionPerformable,
    Monitor,
    MoveTorsoAction,
    NavigateAction,
    NavigateActionPerformable,
    ObjectDesignatorDescription,
    ObjectPart,
    OpenActionPerformable,
    ParkArmsAction,
    PickUpAction,
    PickUpActionPerformable,
    PlaceActionPerformable,
    PlanFailure,
    PlanFailures,
    Repeat,
    Retry,
    SetGripperAction,
    TransportActionPerformable,
)
from pycrorm_async.task_status import TaskStatus
from pycrorm_async.world import Arms, BulletWorld, Grasp, GripperState, ObjectType, Pose
from pycrorm_async.world.urdf import PR2
from tests.memory.note_actions import NoteActionPerformable
from tests.promises.lab import Lab, lab, nodes_of, recorded, results_of, statuses, url_of, written

pytestmark = pytest.mark.slow


# === bad input in plans =======================================================================================
#
# An impossible action is recorded with class, message and data at every node it passes, and the plan continues.

FAR = Pose([9, 9, 1], time_ns=1)


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


async def without_right_arm(scene: Lab) -> object:
    scene.robot.robot_description = replace(PR2, arms={Arms.LEFT: PR2.arms[Arms.LEFT]})
    return await resolved(SetGripperAction([Arms.RIGHT], [GripperState.OPEN]))


async def removed(scene: Lab) -> None:
    scene.milk.remove()
    await PickUpActionPerformable(scene.milk, Arms.LEFT, Grasp.FRONT).perform()


async def opened_a_part_of_a_removed_object(scene: Lab) -> None:
    lid = ObjectPart("lid", scene.milk)
    scene.milk.remove()
    await OpenActionPerformable(lid, Arms.LEFT).perform()


async def located(location: Any) -> object:
    return location.resolve()


async def looked_away(scene: Lab) -> object:
    scene.milk.set_pose(Pose([-1, 0, 1]))
    return await DetectActionPerformable(scene.milk).perform()


async def transported_from(scene: Lab, place: Pose) -> None:
    scene.milk.set_pose(place)
    await TransportActionPerformable(scene.milk, Arms.LEFT, Pose([1, 0, 0.9])).perform()


async def without_robot(scene: Lab) -> object:
    scene.robot.remove()
    return await resolved(MoveTorsoAction([0.1]))


CASES = {
    "no place to go": Case(
        lambda _: resolved(NavigateAction([])),
        "IllPosedGoalFailure",
        "NavigateAction has no alternative for target_location",
        ["target_location"],
    ),
    "no arm to park": Case(
        lambda _: resolved(ParkArmsAction([])),
        "IllPosedGoalFailure",
        "ParkArmsAction has no alternative for arm",
        ["arm"],
    ),
    "no grasp": Case(
        lambda scene: resolved(PickUpAction(scene.milk, [Arms.LEFT], [])),
        "IllPosedGoalFailure",
        "PickUpAction has no alternative for grasp",
        ["grasp"],
    ),
    "no object": Case(
        lambda _: resolved(PickUpAction([], [Arms.LEFT], [Grasp.FRONT])),
        "IllPosedGoalFailure",
        "PickUpAction has no alternative for object_designator",
        ["object_designator"],
    ),
    "an arm it lacks": Case(
        without_right_arm,
        "CapabilityAbsenceFailure",
        "pr2 has no RIGHT arm",
        ["pr2", "RIGHT"],
        ("SetGripperAction", "MoveGripperMotion"),
    ),
    "both arms for one thing": Case(
        lambda scene: PickUpActionPerformable(scene.milk, Arms.BOTH, Grasp.FRONT).perform(),
        "IllPosedGoalFailure",
        "this designator needs one arm, LEFT or RIGHT, and does not work with BOTH",
        ["BOTH"],
        ("PickUpAction",),
    ),
    "nothing of that name": Case(
        lambda _: resolved(PickUpAction(ObjectDesignatorDescription(names=["ghost"]), [Arms.LEFT], [Grasp.FRONT])),
        "ObjectNotFound",
        "no object is named ghost; in the world: pr2, milk, cereal",
        [["ghost"], None],
    ),
    "nothing of that type": Case(
        lambda _: resolved(
            PickUpAction(ObjectDesignatorDescription(types=[ObjectType.BOWL]), [Arms.LEFT], [Grasp.TOP])
        ),
        "ObjectNotFound",
        "no object is of type BOWL; in the world: pr2, milk, cereal",
        [None, ["BOWL"]],
    ),
    "an object that was removed": Case(
        removed,
        "PerceptionObjectNotInWorld",
        "milk is not an object of the world",
        ["milk"],
        ("PickUpAction",),
    ),
    "a part of an object that was removed": Case(
        opened_a_part_of_a_removed_object,
        "PerceptionObjectNotInWorld",
        "milk is not an object of the world",
        ["milk"],
        ("OpenAction",),
    ),
    "an object that is only believed": Case(
        lambda _: PickUpActionPerformable(
            BelieveObject("cup", ObjectType.JEROEN_CUP, Pose([1, 0, 1])), Arms.LEFT, Grasp.FRONT
        ).perform(),
        "PerceptionObjectNotInWorld",
        "cup is not an object of the world",
        ["cup"],
        ("PickUpAction",),
    ),
    "an object the hand does not hold": Case(
        lambda scene: PlaceActionPerformable(scene.milk, Arms.LEFT, Pose([1.2, 1, 0.9])).perform(),
        "ObjectLost",
        "the LEFT gripper does not hold milk",
        ["milk"],
        ("PlaceAction",),
    ),
    "too high for the torso": Case(
        lambda _: resolved(MoveTorsoAction([1.5])),
        "TorsoGoalUnreachable",
        "'pr2': torso_lift_joint cannot be set to 1.5; its limits are 0 to 0.33",
        [1.5],
        ("MoveTorsoAction", "MoveJointsMotion"),
    ),
    "perception of what there is not": Case(
        lambda _: DetectActionPerformable(BelieveObject("bowl", ObjectType.BOWL, Pose([1, 0, 1]))).perform(),
        "PerceptionObjectNotFound",
        "no BOWL is seen; there is none in the world",
        ["BOWL", {}],
        ("DetectAction", "DetectingMotion"),
    ),
    "perception of what is out of sight": Case(
        looked_away,
        "PerceptionObjectNotFound",
        "no MILK is seen; 1 in the world: milk is outside the camera's field of view",
        ["MILK", {"milk": "is outside the camera's field of view"}],
        ("DetectAction", "DetectingMotion"),
    ),
    "a pose no place reaches": Case(
        lambda scene: located(CostmapLocation(Pose([9, 9, 9], time_ns=1), reachable_for=scene.robot)),
        "ReachabilityFailure",
        f"there is no place to stand and reach {Pose([9, 9, 9])}",
        [written(Pose([9, 9, 9], time_ns=1))],
    ),
    "an object no place reaches": Case(
        lambda scene: transported_from(scene, Pose([9, 9, 9])),
        "ObjectUnfetchable",
        "there is no place to stand and pick up milk",
        ["milk"],
        ("TransportAction",),
    ),
    "to open what is no part of anything": Case(
        lambda scene: OpenActionPerformable(ObjectPart("milk", scene.milk), Arms.LEFT).perform(),
        "EnvironmentManipulationImpossible",
        "no joint of milk moves milk",
        ["milk", "milk"],
        ("OpenAction",),
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


async def test_an_unreachable_pose_is_recorded_with_the_pose_and_the_arm(tmp_path: Path) -> None:
    async with recorded(tmp_path):
        with lab() as scene:
            scene.milk.set_pose(FAR)
            attempt = AttemptActionPerformable(PickUpActionPerformable(scene.milk, Arms.RIGHT, Grasp.TOP).perform)
            await ServingActionPerformable(attempt).perform()
    _, _, *failed, note = await nodes_of(tmp_path)
    assert statuses([*failed, note]) == [
        ("AttemptAction", "FAILED"),
        ("PickUpAction", "FAILED"),
        ("MoveTCPMotion", "FAILED"),
        ("NoteAction", "SUCCEEDED"),
    ]
    for node in failed:
        assert node.reason == "IKError"
        assert node.failure_arguments is not None
        pose, arm, tip, why, milk = node.failure_arguments
        # 0.1 m before the milk along the gripper, which points along x of the map, turned to point down
        assert pose["position"] == pytest.approx([8.9, 9, 1])
        assert pose["orientation"] == pytest.approx([0, 0.5**0.5, 0, 0.5**0.5])
        assert (arm, tip, milk) == ("RIGHT", "r_gripper_tool_frame", "milk")
        assert why
        reach = f"{tip} cannot reach (8.900, 9.000, 1.000) with the RIGHT arm: {why}"
        assert node.failure_message == f"{reach}, reaching for milk"


async def test_an_uncaught_failure_is_recorded_up_to_the_episode(tmp_path: Path) -> None:
    with pytest.raises(PlanFailure):
        async with Memory.open(url_of(tmp_path)) as memory, memory.episode():
            with lab() as scene:
                scene.milk.remove()
                attempt = AttemptActionPerformable(PickUpActionPerformable(scene.milk, Arms.LEFT, Grasp.TOP).perform)
                await AttemptActionPerformable(attempt.perform).perform()
    nodes = await nodes_of(tmp_path)
    assert statuses(nodes) == [
        (None, "FAILED"),
        ("AttemptAction", "FAILED"),
        ("AttemptAction", "FAILED"),
        ("PickUpAction", "FAILED"),
    ]
    for node in nodes:
        assert (node.reason, node.failure_message) == (
            "PerceptionObjectNotInWorld",
            "milk is not an object of the world",
        )
        assert node.failure_arguments == ["milk is not an object of the world", "milk"]
    (episode,) = await results_of(tmp_path, select(ProcessMetaData))
    assert (episode.status, episode.failure_message) == ("FAILED", "milk is not an object of the world")
    assert episode.failure_type == "pycrorm_async.plan.failures.PerceptionObjectNotInWorld"


async def test_a_failed_search_is_recorded_as_a_node_of_its_own(tmp_path: Path) -> None:
    async with recorded(tmp_path):
        with lab() as scene:
            for name in ("perception of what there is not", "a pose no place reaches"):
                attempt = AttemptActionPerformable(lambda name=name: CASES[name].attempt(scene))  # type: ignore[misc]  # bound now
                await ServingActionPerformable(attempt).perform()
    assert await results_of(tmp_path, select(Detection)) == []
    (search,) = await results_of(tmp_path, select(LocationResolution))
    assert (search.location, search.offered, search.taken, search.pose) == ("CostmapLocation", 0, None, None)
    assert search.considered == 600
    assert search.node.dtype == "AttemptAction"


MISTAKES: dict[str, tuple[Callable[[Lab], Awaitable[object]], str, str]] = {
    "a pose in another frame": (
        lambda _: NavigateActionPerformable(Pose([1, 0, 0], frame="table")).perform(),
        "PoseRefused",
        "'pr2' cannot be moved to",
    ),
    "a grasp that is none": (
        lambda scene: resolved(PickUpAction(scene.milk, [Arms.LEFT], ["front"])),  # type: ignore[list-item]  # the fault here
        "ResolutionError",
        "PickUpActionPerformable cannot be built; wrong: grasp: expected Grasp, got str 'front'",
    ),
    "an object that is a name": (
        lambda _: resolved(PickUpAction(["milk"], [Arms.LEFT], [Grasp.TOP])),  # type: ignore[list-item]  # the fault here
        "ResolutionError",
        "PickUpActionPerformable cannot be built; wrong: object_designator: expected",
    ),
    "a world without a robot": (
        without_robot,
        "NoRobotHere",
        'no robot in the world: add one, e.g. Object("pr2", ObjectType.ROBOT)',
    ),
}


@pytest.mark.parametrize("name", MISTAKES)
async def test_an_authors_mistake_is_recorded_as_an_error_with_a_clear_message(tmp_path: Path, name: str) -> None:
    attempt, reason, message = MISTAKES[name]
    async with recorded(tmp_path):
        with lab() as scene, pytest.raises(CallerError, match=r"."):
            await ServingActionPerformable(AttemptActionPerformable(lambda: attempt(scene))).perform()
        await NoteActionPerformable("the episode goes on").perform()
    root, *nodes, note = await nodes_of(tmp_path)
    assert statuses([root, note]) == [(None, "SUCCEEDED"), ("NoteAction", "SUCCEEDED")]
    assert {node.status for node in nodes} == {TaskStatus.ERROR}
    assert {node.reason for node in nodes} == {reason}
    for node in nodes:
        assert node.failure_message is not None
        assert node.failure_message.startswith(message)
        assert "\n" not in node.failure_message


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
