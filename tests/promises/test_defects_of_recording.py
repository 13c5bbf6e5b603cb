"""Measured defects in recording of the system of the thesis, each with the property that this package keeps instead.

Numbers as in tests/README.md. Every test covers the whole way: a plan in a Bullet world, a memory in a SQLite file, the
mapped classes.
"""

from __future__ import annotations

import asyncio
import math
import re
import threading
import time
from collections.abc import Iterator
from contextvars import copy_context
from dataclasses import dataclass, field
from datetime import UTC, datetime, timedelta
from pathlib import Path

import pytest
from sqlalchemy import select

import pycrorm_async.plan.failures
from pycrorm_async import Memory, Reading
from pycrorm_async.orm import (
    Action,
    Attachment,
    BelieveObject,
    ClosingMotion,
    Designator,
    Detection,
    JointChange,
    LocationCandidate,
    LocationRefusal,
    LocationResolution,
    MoveAndPickUpAction,
    MoveArmJointsMotion,
    MoveJointsMotion,
    Object,
    ObjectPart,
    OpeningMotion,
    PickUpAction,
    ProcessMetaData,
    TaskTreeNode,
)
from pycrorm_async.orm import Pose as PoseRow
from pycrorm_async.plan import (
    ActionAbstract,
    CloseActionPerformable,
    CostmapLocation,
    DetectingMotion,
    IKError,
    LookAtActionPerformable,
    MoveAndPickUpPerformable,
    MoveTCPMotion,
    MoveTorsoActionPerformable,
    NavigateActionPerformable,
    ObjectDesignator,
    OpenActionPerformable,
    ParkArmsActionPerformable,
    PickUpActionPerformable,
    PlanFailure,
)
from pycrorm_async.plan import BelieveObject as Believed
from pycrorm_async.plan import ObjectPart as Part
from pycrorm_async.plan.failures import CollisionError, PerceptionObjectNotInWorld, ReachabilityFailure, ReasoningError
from pycrorm_async.task_status import TaskStatus
from pycrorm_async.world import Arms, Grasp, ObjectType, Pose
from pycrorm_async.world import Object as WorldObject
from tests.memory.note_actions import NoteActionPerformable
from tests.promises.lab import (
    MILK_AT,
    WITHIN_REACH,
    FailingActionPerformable,
    at,
    every,
    lab,
    nodes_of,
    recorded,
    results_of,
    statuses,
    turned,
    url_of,
    written,
)

pytestmark = pytest.mark.slow

DEFECTS = {
    "1": "test_an_object_is_stored_where_it_was_when_the_action_started",
    "4": "test_an_action_on_a_believed_object_is_stored_with_its_believed_pose",
    "6": "test_an_error_in_an_action_differs_from_a_plan_failure_and_from_an_action_that_never_ran",
    "7": "test_a_failure_keeps_its_message_and_its_arguments",
    "8": "test_concurrent_plans_never_nest_into_each_other",
    "11": "test_a_node_is_running_until_it_ends_and_the_root_ends_too",
    "12": "test_all_times_are_moments_in_utc_whatever_the_local_time_is",
    "13": "test_joint_targets_places_detections_and_attachments_are_recorded",
    "14": "test_an_action_without_a_mapped_class_is_stored_with_the_rest_of_the_tree",
    "15": "test_opening_and_closing_keep_their_object",
    "16": "test_every_class_of_failure_can_be_raised_and_is_recorded",
}


@dataclass
class MoveAsideActionPerformable(ActionAbstract):
    """Move its object while it runs."""

    what: ObjectDesignator
    where: Pose

    async def perform(self) -> None:
        assert self.what.world_object is not None
        self.what.world_object.set_pose(self.where)


async def test_an_object_is_stored_where_it_was_when_the_action_started(tmp_path: Path) -> None:
    async with recorded(tmp_path) as memory:
        with lab() as scene:
            scene.milk.set_pose(Pose([1.3, 0.95, 0.9]))
            await NavigateActionPerformable(WITHIN_REACH).perform()
            await PickUpActionPerformable(scene.milk, Arms.LEFT, Grasp.FRONT).perform()
            scene.cereal.set_pose(Pose([4, 4, 0.9]))
            meant = ObjectDesignator("cereal", ObjectType.BREAKFAST_CEREAL, scene.cereal)
            await MoveAsideActionPerformable(meant, Pose([5, 5, 0.9])).perform()
            scene.robot.detach(scene.milk)
            scene.milk.set_pose(Pose([5, 5, 1]))
        await memory.flush()
        (pick,) = await every(memory, select(PickUpAction))
        assert at(pick.object.pose) == (1.3, 0.95, 0.9)
        (aside,) = await every(memory, select(memory.mapped("MoveAsideAction")))
        assert at(aside.what.pose) == (4, 4, 0.9)
        assert at(aside.where) == (5, 5, 0.9)
        milk = await every(memory, select(Object).where(Object.name == "milk").order_by(Object.id))
        assert [at(each.pose) for each in milk[:2]] == [MILK_AT, (1.3, 0.95, 0.9)]
        assert at(milk[-1].pose) == (5, 5, 1)
        assert {row.identity_id for row in milk} == {milk[0].id}


async def test_an_action_on_a_believed_object_is_stored_with_its_believed_pose(tmp_path: Path) -> None:
    cup = Believed("cup", ObjectType.JEROEN_CUP, Pose([2, 3, 0.5]))
    async with recorded(tmp_path):
        with lab():
            with pytest.raises(PerceptionObjectNotInWorld):
                await PickUpActionPerformable(cup, Arms.LEFT, Grasp.TOP).perform()
            await NavigateActionPerformable(cup.pose).perform()
    (pick,) = await results_of(tmp_path, select(PickUpAction))
    assert isinstance(pick.object, BelieveObject)
    assert (pick.object.name, pick.object.obj_type, pick.object.identity_id) == ("cup", ObjectType.JEROEN_CUP, None)
    assert at(pick.object.pose) == (2, 3, 0.5)
    assert statuses(await nodes_of(tmp_path)) == [
        (None, "SUCCEEDED"),
        ("PickUpAction", "FAILED"),
        ("NavigateAction", "SUCCEEDED"),
        ("MoveMotion", "SUCCEEDED"),
    ]


async def test_an_error_in_an_action_differs_from_a_plan_failure_and_from_an_action_that_never_ran(
    tmp_path: Path,
) -> None:
    with pytest.raises(ZeroDivisionError):
        async with Memory.open(url_of(tmp_path)) as memory, memory.episode():
            with pytest.raises(PlanFailure):
                await FailingActionPerformable(PlanFailure("the milk is gone", "milk", 3)).perform()
            await FailingActionPerformable(ZeroDivisionError("division by zero", 7)).perform()
            await NoteActionPerformable("never ran").perform()
    root, failed, crashed = await nodes_of(tmp_path)
    assert (root.status, root.reason) == (TaskStatus.ERROR, "ZeroDivisionError")
    assert (failed.status, failed.reason, failed.failure_message) == (
        TaskStatus.FAILED,
        "PlanFailure",
        "the milk is gone",
    )
    assert (crashed.status, crashed.reason) == (TaskStatus.ERROR, "ZeroDivisionError")
    assert crashed.failure_message == "('division by zero', 7)"
    assert crashed.failure_arguments == ["division by zero", 7]
    assert all(node.end_time is not None and node.end_time >= node.start_time for node in (root, failed, crashed))
    (episode,) = await results_of(tmp_path, select(ProcessMetaData))
    assert (episode.status, episode.failure_type) == ("ERROR", "builtins.ZeroDivisionError")


async def test_a_failure_keeps_its_message_and_its_arguments(tmp_path: Path) -> None:
    async with recorded(tmp_path):
        with lab() as scene:
            with pytest.raises(PlanFailure):
                await FailingActionPerformable(PlanFailure("the milk is gone", "milk", 3)).perform()
            with pytest.raises(IKError) as caught:
                await PickUpActionPerformable(scene.milk, Arms.LEFT, Grasp.FRONT).perform()
    nodes = await nodes_of(tmp_path)
    assert nodes[1].failure_arguments == ["the milk is gone", "milk", 3]
    # 0.1 m before the milk along the gripper, which points along x of the map with all joints at zero
    goal = caught.value.pose
    assert goal.position == pytest.approx((1.2, 1.0, 0.9))
    for node in nodes[2:]:
        assert (node.status, node.reason) == (TaskStatus.FAILED, "IKError")
        assert node.failure_message == str(caught.value)
        assert node.failure_message.startswith(
            "l_gripper_tool_frame cannot reach (1.200, 1.000, 0.900) with the LEFT arm"
        )
        assert node.failure_message.endswith(", reaching for milk")
        assert node.failure_arguments == [written(goal), "LEFT", "l_gripper_tool_frame", caught.value.reason, "milk"]


async def test_every_class_of_failure_can_be_raised_and_is_recorded(tmp_path: Path) -> None:
    module = pycrorm_async.plan.failures
    kinds = [getattr(module, name) for name in module.__all__]
    # The other classes are built from more than a message, by the code that raises them.
    kinds = [kind for kind in kinds if isinstance(kind, type) and (kind is PlanFailure or "__init__" not in vars(kind))]
    assert {CollisionError, ReasoningError} < set(kinds)
    assert len(kinds) >= 52
    async with recorded(tmp_path):
        for kind in kinds:
            with pytest.raises(kind):
                await FailingActionPerformable(kind(f"this is {kind.__name__}", kind.__name__, 1.5)).perform()
    _, *nodes = await nodes_of(tmp_path)
    assert [(node.status, node.reason, node.failure_message, node.failure_arguments) for node in nodes] == [
        (TaskStatus.FAILED, name, f"this is {name}", [f"this is {name}", name, 1.5])
        for name in (kind.__name__ for kind in kinds)
    ]


@dataclass
class InnerActionPerformable(ActionAbstract):
    owner: str

    async def perform(self) -> None:
        await asyncio.sleep(0)


@dataclass
class SlowActionPerformable(ActionAbstract):
    owner: str

    async def perform(self) -> None:
        await asyncio.to_thread(ALL_STARTED.wait, 30)
        for _ in range(5):
            await InnerActionPerformable(self.owner).perform()


ALL_STARTED = threading.Barrier(6)


async def test_concurrent_plans_never_nest_into_each_other(tmp_path: Path) -> None:
    def run_in_own_loop(owner: str) -> None:
        asyncio.run(SlowActionPerformable(owner).perform())

    ALL_STARTED.reset()
    async with recorded(tmp_path):
        tasks = [asyncio.create_task(SlowActionPerformable(f"task {index}").perform()) for index in range(3)]
        contexts = [copy_context() for _ in range(3)]
        threads = [
            threading.Thread(target=context.run, args=(run_in_own_loop, f"thread {index}"))
            for index, context in enumerate(contexts)
        ]
        for thread in threads:
            thread.start()
        await asyncio.gather(*tasks)
        for thread in threads:
            await asyncio.to_thread(thread.join)
    async with Reading.open(url_of(tmp_path)) as reading:
        nodes = {node.id: node for node in await reading.tree(1)}
    owners = {f"{kind} {index}" for kind in ("task", "thread") for index in range(3)}
    slow = [node for node in nodes.values() if node.dtype == "SlowAction"]
    assert {node.parameters["owner"] for node in slow} == owners
    assert {node.depth for node in slow} == {1}
    inner = [node for node in nodes.values() if node.dtype == "InnerAction"]
    assert len(inner) == 30
    for node in inner:
        assert node.parent_id is not None
        parent = nodes[node.parent_id]
        assert (parent.dtype, parent.parameters["owner"]) == ("SlowAction", node.parameters["owner"])
    # They ran concurrently: all six began before the first of them ended.
    assert max(node.started_at for node in slow) <= min(node.started_at for node in inner)


@dataclass
class LookingBackActionPerformable(ActionAbstract):
    """Query the memory about the running action itself."""

    _memory: Memory
    _seen: list[TaskTreeNode] = field(default_factory=list)

    async def perform(self) -> None:
        await NoteActionPerformable("before").perform()
        await self._memory.flush()
        self._seen += await every(self._memory, select(TaskTreeNode).order_by(TaskTreeNode.id))


async def test_a_node_is_running_until_it_ends_and_the_root_ends_too(tmp_path: Path) -> None:
    async with recorded(tmp_path) as memory:
        action = LookingBackActionPerformable(memory)
        await action.perform()
    assert [(node.dtype, node.status, node.end_time is None) for node in action._seen] == [
        (None, TaskStatus.RUNNING, True),
        ("LookingBackAction", TaskStatus.RUNNING, True),
        ("NoteAction", TaskStatus.SUCCEEDED, False),
    ]
    root, looking, nothing = await nodes_of(tmp_path)
    assert {node.status for node in (root, looking, nothing)} == {TaskStatus.SUCCEEDED}
    assert None not in (root.end_time, looking.end_time, nothing.end_time)
    assert root.start_ns <= looking.start_ns <= nothing.start_ns
    assert nothing.end_ns is not None
    assert looking.end_ns is not None
    assert root.end_ns is not None
    assert nothing.start_ns <= nothing.end_ns <= looking.end_ns <= root.end_ns


@pytest.fixture
def far_from_greenwich(monkeypatch: pytest.MonkeyPatch) -> Iterator[None]:
    """The local time of the process is five hours and three quarters ahead of UTC."""
    with monkeypatch.context() as changed:
        changed.setenv("TZ", "XYZ-05:45")
        time.tzset()
        assert datetime.now().astimezone().utcoffset() == timedelta(hours=5, minutes=45)
        yield
    time.tzset()


async def test_all_times_are_moments_in_utc_whatever_the_local_time_is(
    tmp_path: Path, far_from_greenwich: None
) -> None:
    begun = datetime.fromtimestamp(time.time_ns() // 1000 / 1e6, UTC)
    async with recorded(tmp_path):
        with lab() as scene:
            await NavigateActionPerformable(Pose(WITHIN_REACH.position)).perform()
            await PickUpActionPerformable(scene.milk, Arms.LEFT, Grasp.FRONT).perform()
    ended = datetime.now(UTC)
    moments = [
        *await results_of(tmp_path, select(ProcessMetaData.created_at)),
        *await results_of(tmp_path, select(ProcessMetaData.ended_at)),
        *await results_of(tmp_path, select(TaskTreeNode.start_time)),
        *await results_of(tmp_path, select(TaskTreeNode.end_time)),
        *await results_of(tmp_path, select(PoseRow.time)),
        *await results_of(tmp_path, select(Object.time)),
        *await results_of(tmp_path, select(Attachment.time)),
    ]
    assert len(moments) > 30
    assert {moment.utcoffset() for moment in moments} == {timedelta(0)}
    millisecond = timedelta(milliseconds=1)
    assert begun - millisecond <= min(moments) <= max(moments) <= ended + millisecond


TOO_HIGH = Pose([1.3, 1, 2.5])
TOO_FAR = re.compile(r"LEFT: too far: from shoulder to wrist \d\.\d{3} m or more, but the arm reaches 0\.719 m")


async def test_joint_targets_places_detections_and_attachments_are_recorded(tmp_path: Path) -> None:
    async with recorded(tmp_path):
        with lab() as scene:
            await ParkArmsActionPerformable(Arms.LEFT).perform()
            await MoveTorsoActionPerformable(0.3).perform()
            stand = CostmapLocation(scene.milk, reachable_for=scene.robot, reachable_arm=Arms.LEFT).resolve()
            with pytest.raises(ReachabilityFailure):
                CostmapLocation(TOO_HIGH, reachable_for=scene.robot, reachable_arm=Arms.LEFT).resolve()
            await MoveAndPickUpPerformable(stand.pose, scene.milk, Arms.LEFT, Grasp.FRONT).perform()
            scene.robot.detach(scene.milk)
            await LookAtActionPerformable(scene.cereal.pose).perform()
            await DetectingMotion(ObjectType.BREAKFAST_CEREAL).perform()
            parked = {name: scene.robot.robot_description.arms[Arms.LEFT].park[name] for name in LEFT_ARM}  # type: ignore[union-attr]  # it is a PR2
    rows = {row.dtype: row for row in await results_of(tmp_path, select(Designator).order_by(Designator.id))}
    arm = rows["MoveArmJointsMotion"]
    assert isinstance(arm, MoveArmJointsMotion)
    assert (arm.left_arm_poses, arm.right_arm_poses) == (parked, {})
    torso = rows["MoveJointsMotion"]
    assert isinstance(torso, MoveJointsMotion)
    assert (torso.names, torso.positions) == (["torso_lift_joint"], [0.3])
    both = rows["MoveAndPickUpAction"]
    assert isinstance(both, MoveAndPickUpAction)
    assert (at(both.pose), at(both.object.pose), both.arm, both.grasp) == (
        stand.pose.position,
        MILK_AT,
        Arms.LEFT,
        Grasp.FRONT,
    )
    resolved, failed = await results_of(tmp_path, select(LocationResolution).order_by(LocationResolution.id))
    assert (resolved.location, resolved.offered, resolved.taken) == ("CostmapLocation", 1, 0)
    assert resolved.considered >= 1
    assert (failed.offered, failed.taken, failed.considered, failed.refused) == (0, None, 600, 600)
    assert resolved.refused == resolved.considered - 1
    for each in (resolved, failed):
        assert (each.occupied_cells or 0) + (each.free_cells or 0) == 200 * 200
        assert (each.hidden_cells, (each.occupied_cells or 0) > 1_000) == (0, True)
    refused = await results_of(tmp_path, select(LocationRefusal).order_by(LocationRefusal.position))
    refused = [each for each in refused if each.resolution_id == failed.id]
    assert [each.position for each in refused] == list(range(600))
    assert len({(each.x, each.y) for each in refused}) == 600
    for each in refused:  # each on the floor, near the pose that is too high, facing it
        assert math.dist((each.x, each.y, each.z), TOO_HIGH.position) < 4
        assert math.isclose(math.atan2(1 - each.y, 1.3 - each.x), Pose((0, 0, 0), turned(each)).yaw, abs_tol=1e-9)
        assert TOO_FAR.fullmatch(each.reason), each.reason
    with lab() as again:
        await MoveTorsoActionPerformable(0.3).perform()
        for each in refused[::200]:  # the arm itself refuses with the same words
            again.robot.set_pose(Pose(at(each), turned(each)))
            with pytest.raises(IKError) as unreachable:
                await MoveTCPMotion(TOO_HIGH, Arms.LEFT).perform()
            assert each.reason.removeprefix("LEFT: ") in str(unreachable.value)
    (candidate,) = await results_of(tmp_path, select(LocationCandidate))
    assert ((candidate.x, candidate.y, candidate.z), candidate.arms) == (stand.pose.position, "LEFT")
    (seen,) = await results_of(tmp_path, select(Detection))
    assert (seen.source, seen.looked_for, seen.name) == ("camera", ObjectType.BREAKFAST_CEREAL, "cereal")
    assert ((seen.x, seen.y, seen.z), seen.visible, seen.node.dtype) == ((1.3, 0.7, 0.95), 1.0, "DetectingMotion")
    held = await results_of(tmp_path, select(Attachment).order_by(Attachment.id))
    assert [(each.kind, each.parent.name, each.child.name, each.link) for each in held] == [
        ("attached", "pr2", "milk", "l_gripper_tool_frame"),
        ("detached", "pr2", "milk", "l_gripper_tool_frame"),
    ]


LEFT_ARM = [
    "l_shoulder_pan_joint",
    "l_shoulder_lift_joint",
    "l_upper_arm_roll_joint",
    "l_elbow_flex_joint",
    "l_forearm_roll_joint",
    "l_wrist_flex_joint",
    "l_wrist_roll_joint",
]


async def test_an_action_without_a_mapped_class_is_stored_with_the_rest_of_the_tree(tmp_path: Path) -> None:
    async with recorded(tmp_path):
        with lab() as scene:
            await NoteActionPerformable("no class of the ORM knows of this").perform()
            await MoveAndPickUpPerformable(WITHIN_REACH, scene.milk, Arms.LEFT, Grasp.FRONT).perform()
    assert statuses(await nodes_of(tmp_path)) == [
        (None, "SUCCEEDED"),
        ("NoteAction", "SUCCEEDED"),
        ("MoveAndPickUpAction", "SUCCEEDED"),
        ("NavigateAction", "SUCCEEDED"),
        ("MoveMotion", "SUCCEEDED"),
        ("FaceAtAction", "SUCCEEDED"),
        ("NavigateAction", "SUCCEEDED"),
        ("MoveMotion", "SUCCEEDED"),
        ("LookAtAction", "SUCCEEDED"),
        ("LookingMotion", "SUCCEEDED"),
        ("PickUpAction", "SUCCEEDED"),
        *[("MoveTCPMotion", "SUCCEEDED"), ("MoveGripperMotion", "SUCCEEDED")] * 2,
        ("MoveTCPMotion", "SUCCEEDED"),
    ]
    async with Reading.open(url_of(tmp_path)) as reading:
        (nothing,) = await every(reading, select(reading.mapped("NoteAction")))
        assert nothing.text == "no class of the ORM knows of this"
        assert isinstance(nothing, Action)


async def test_opening_and_closing_keep_their_object(tmp_path: Path) -> None:
    async with recorded(tmp_path):
        with lab():
            handle = Part("sink_area_drawer_handle", WorldObject("kitchen", ObjectType.ENVIRONMENT))
            await NavigateActionPerformable(Pose([0.1, 1.1, 0])).perform()
            await MoveTorsoActionPerformable(0.1).perform()
            await OpenActionPerformable(handle, Arms.LEFT).perform()
            await CloseActionPerformable(handle, Arms.LEFT).perform()
    for mapped, x in ((OpeningMotion, 1.0), (ClosingMotion, 0.7)):
        (motion,) = await results_of(tmp_path, select(mapped))
        assert isinstance(motion.object, ObjectPart)
        assert motion.object.part_of is not None
        assert (motion.object.name, motion.object.part_of.name) == ("sink_area_drawer_handle", "kitchen")
        assert motion.object.pose is not None
        assert motion.object.pose.x == pytest.approx(x)  # the drawing of the kitchen; 0.3 m further out when open
        assert motion.arm is Arms.LEFT
    turns = await results_of(tmp_path, select(JointChange).where(JointChange.joint == "sink_area_drawer_joint"))
    assert [each.position for each in turns] == [pytest.approx(0.3), 0.0]
