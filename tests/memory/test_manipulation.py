"""The actions of hands and cameras are in the tables of a real memory, with the node that performed them."""

from __future__ import annotations

from collections.abc import AsyncIterator, Sequence
from pathlib import Path
from typing import Any, NamedTuple

import pytest
from sqlalchemy import select
from sqlalchemy.ext.asyncio import AsyncSession

from pycrorm_async import Memory, orm
from pycrorm_async.plan import (
    AccessingMotion,
    BelieveObject,
    CloseActionPerformable,
    DetectActionPerformable,
    GripActionPerformable,
    LookAtActionPerformable,
    MoveTCPMotion,
    MoveTorsoActionPerformable,
    NavigateActionPerformable,
    ObjectPart,
    OpenActionPerformable,
    OpeningMotion,
    PickUpActionPerformable,
    ReleaseActionPerformable,
    TransportActionPerformable,
    WorldStateDetectingMotion,
    simulated_robot,
)
from pycrorm_async.plan.failures import EnvironmentManipulationImpossible, PerceptionObjectNotFound
from pycrorm_async.task_status import TaskStatus
from pycrorm_async.world import Arms, BulletWorld, Grasp, GripperState, Object, ObjectType, Pose
from tests.memory.note_actions import url_of

pytestmark = pytest.mark.slow

HANDLE, JOINT = "sink_area_drawer_handle", "sink_area_drawer_joint"
LEFT_TOOL = "l_gripper_tool_frame"


class Recorded(NamedTuple):
    """A memory with an open episode, and the kitchen in it."""

    memory: Memory
    robot: Object
    kitchen: Object
    milk: Object

    async def rows(self, question: Any) -> Sequence[Any]:
        await self.memory.flush()
        async with self.memory.session() as session:
            return (await session.scalars(question)).all()

    async def only(self, question: Any) -> Any:
        (row,) = await self.rows(question)
        return row


@pytest.fixture
async def recorded(tmp_path: Path) -> AsyncIterator[Recorded]:
    async with Memory.open(url_of(tmp_path)) as memory, memory.episode(description="hands"):
        with BulletWorld(), simulated_robot:
            yield Recorded(
                memory,
                Object("pr2", ObjectType.ROBOT),
                Object("kitchen", ObjectType.ENVIRONMENT),
                Object("milk", ObjectType.MILK, pose=Pose([1.3, 1, 0.9])),
            )


async def node_of(session: AsyncSession, row: Any) -> Any:
    return await session.get(orm.TaskTreeNode, row.node_id)


async def test_an_opened_and_a_closed_drawer_are_recorded_with_their_joints(recorded: Recorded) -> None:
    part = ObjectPart(HANDLE, recorded.kitchen)
    await NavigateActionPerformable(Pose([0.1, 1.1, 0])).perform()
    await MoveTorsoActionPerformable(0.1).perform()
    await OpenActionPerformable(part, Arms.LEFT).perform()
    await CloseActionPerformable(part, Arms.LEFT).perform()
    for mapped, x in (
        (orm.OpenAction, 1.0),
        (orm.CloseAction, 0.7),
        (orm.OpeningMotion, 1.0),
        (orm.ClosingMotion, 0.7),
    ):
        row: Any = await recorded.only(select(mapped))
        assert type(row.object).__name__ == "ObjectPart"
        assert (row.arm, row.object.name, row.object.part_of.name) == (Arms.LEFT, HANDLE, "kitchen")
        where = row.object.pose.position
        assert (where.x, where.y, where.z) == pytest.approx((x, 1.3, 0.665), abs=1e-6)
    grasped = await recorded.rows(select(orm.GraspingAction).order_by(orm.GraspingAction.id))
    assert [(each.arm, each.object.name, each.object_desig.pose.position.x) for each in grasped] == [
        (Arms.LEFT, HANDLE, pytest.approx(1.0)),
        (Arms.LEFT, HANDLE, pytest.approx(0.7)),
    ]
    changes = await recorded.rows(
        select(orm.JointChange).where(orm.JointChange.joint == JOINT).order_by(orm.JointChange.id)
    )
    async with recorded.memory.session() as session:
        by = [(each.object.name, each.position, (await node_of(session, each)).dtype) for each in changes]
        assert by == [
            ("kitchen", pytest.approx(0.30), "OpeningMotion"),
            ("kitchen", 0.0, "ClosingMotion"),
        ]
        arm = await session.scalars(
            select(orm.JointChange.node_id).where(orm.JointChange.joint == "l_elbow_flex_joint")
        )
        assert {each.node_id for each in changes} < set(arm)
    assert await recorded.rows(select(orm.Attachment)) == []


async def test_a_drawer_that_is_moved_by_a_distance_is_recorded(recorded: Recorded) -> None:
    await NavigateActionPerformable(Pose([0.1, 1.1, 0])).perform()
    await MoveTorsoActionPerformable(0.1).perform()
    await MoveTCPMotion(Pose([1.0, 1.3, 0.665]), Arms.LEFT).perform()
    await AccessingMotion(recorded.kitchen, Arms.LEFT, LEFT_TOOL, JOINT, HANDLE, 0.2).perform()
    row = await recorded.only(select(orm.AccessingMotion))
    assert (row.object.name, row.part_of.name, row.arm, row.gripper) == ("kitchen", "kitchen", Arms.LEFT, LEFT_TOOL)
    assert (row.drawer_joint, row.drawer_handle, row.distance) == (JOINT, HANDLE, 0.2)
    change = await recorded.only(select(orm.JointChange).where(orm.JointChange.joint == JOINT))
    assert (change.node_id, change.position) == (row.id, pytest.approx(0.2))


async def test_an_attached_and_a_detached_object_are_recorded(recorded: Recorded) -> None:
    await NavigateActionPerformable(Pose([0.6, 0.9, 0])).perform()
    await MoveTCPMotion(Pose([1.3, 1, 0.9]), Arms.LEFT).perform()
    await GripActionPerformable(Arms.LEFT, recorded.milk, 12.5).perform()
    await MoveTCPMotion(Pose([1.2, 1.1, 1.0]), Arms.LEFT).perform()
    await ReleaseActionPerformable(Arms.LEFT, recorded.milk).perform()
    grip, release = await recorded.only(select(orm.GripAction)), await recorded.only(select(orm.ReleaseAction))
    assert (grip.gripper, grip.effort, grip.object.name, grip.object.pose.position.x) == (Arms.LEFT, 12.5, "milk", 1.3)
    assert (release.gripper, release.object.name) == (Arms.LEFT, "milk")
    position = release.object.pose.position
    assert (position.x, position.y, position.z) == pytest.approx((1.2, 1.1, 1.0), abs=1e-6)
    attachments = await recorded.rows(select(orm.Attachment).order_by(orm.Attachment.id))
    assert [(each.kind, each.parent.name, each.child.name, each.link, each.node_id) for each in attachments] == [
        ("attached", "pr2", "milk", LEFT_TOOL, grip.id),
        ("detached", "pr2", "milk", LEFT_TOOL, release.id),
    ]
    motions = await recorded.rows(select(orm.MoveGripperMotion).order_by(orm.MoveGripperMotion.id))
    assert [each.motion for each in motions] == [GripperState.CLOSE, GripperState.OPEN]


async def test_detections_and_failed_searches_are_recorded(recorded: Recorded) -> None:
    second = Object("second", ObjectType.MILK, pose=Pose([1.4, 1.3, 0.9]))
    await NavigateActionPerformable(Pose([0.2, 1, 0])).perform()
    believed = BelieveObject("some milk", ObjectType.MILK, Pose([1.3, 0.9, 0.9]))
    await LookAtActionPerformable(believed.pose).perform()
    await DetectActionPerformable(believed).perform()
    detected = await WorldStateDetectingMotion(ObjectType.MILK).perform()
    assert detected.world_object is recorded.milk
    with pytest.raises(PerceptionObjectNotFound):
        await DetectActionPerformable(BelieveObject("spoon", ObjectType.SPOON, Pose())).perform()

    actions = await recorded.rows(select(orm.DetectAction).order_by(orm.DetectAction.id))
    assert [(type(each.object), each.object.name) for each in actions] == [
        (orm.BelieveObject, "some milk"),
        (orm.BelieveObject, "spoon"),
    ]
    motions = await recorded.rows(select(orm.DetectingMotion).order_by(orm.DetectingMotion.id))
    assert [each.object_type for each in motions] == [ObjectType.MILK, ObjectType.SPOON]
    motion_row = await recorded.only(select(orm.WorldStateDetectingMotion))
    assert motion_row.object_type is ObjectType.MILK

    rows = await recorded.rows(select(orm.Detection).order_by(orm.Detection.id, orm.Detection.position))
    camera = [each for each in rows if each.source == "camera"]
    assert {each.object.name for each in camera} == {"milk", "second"}
    assert [each.position for each in camera] == [0, 1]
    assert all(each.visible >= 0.8 for each in camera)
    assert {(each.looked_for, each.node_id) for each in camera} == {(ObjectType.MILK, motions[0].id)}
    for each in camera:
        expected_object = {"milk": recorded.milk, "second": second}[each.name]
        assert (each.x, each.y, each.z, each.obj_type) == (*expected_object.pose.position, ObjectType.MILK)
    in_world_state = [each for each in rows if each.source == "world_state"]
    assert [(each.name, each.visible, each.node_id) for each in in_world_state] == [
        ("milk", None, motion_row.id),
        ("second", None, motion_row.id),
    ]
    async with recorded.memory.session() as session:
        failed = await session.get(orm.TaskTreeNode, motions[1].id)
        assert failed is not None
        assert (failed.status, failed.reason) == (
            TaskStatus.FAILED,
            "PerceptionObjectNotFound",
        )
        assert failed.failure_message == "no SPOON is seen; there is none in the world"
        assert failed.failure_arguments == ["no SPOON is seen; there is none in the world", "SPOON", {}]
        seen = await session.get(orm.TaskTreeNode, motions[0].id)
        assert seen is not None
        assert seen.result is not None


async def test_a_transported_object_is_recorded(recorded: Recorded) -> None:
    goal = Pose([1.3, 0.5, 0.936])
    await MoveTorsoActionPerformable(0.3).perform()
    await TransportActionPerformable(recorded.milk, Arms.LEFT, goal).perform()
    row = await recorded.only(select(orm.TransportAction))
    assert (row.arm, row.object.name, row.object.pose.position.y) == (Arms.LEFT, "milk", 1.0)
    assert (row.pose.position.x, row.pose.position.y, row.pose.position.z) == (1.3, 0.5, 0.936)
    children = await recorded.rows(
        select(orm.TaskTreeNode).where(orm.TaskTreeNode.parent_id == row.id).order_by(orm.TaskTreeNode.id)
    )
    assert [each.dtype for each in children] == [
        "ParkArmsAction",
        "NavigateAction",
        "PickUpAction",
        "ParkArmsAction",
        "NavigateAction",
        "PlaceAction",
        "ParkArmsAction",
    ]
    attachments = await recorded.rows(select(orm.Attachment).order_by(orm.Attachment.id))
    assert [(each.kind, each.node_id) for each in attachments] == [
        ("attached", children[2].id),
        ("detached", children[5].id),
    ]
    places = await recorded.rows(select(orm.LocationResolution).order_by(orm.LocationResolution.id))
    assert [each.node_id for each in places] == [row.id, row.id]
    moved = await recorded.rows(select(orm.Object).where(orm.Object.name == "milk").order_by(orm.Object.id))
    last = moved[-1].pose.position
    assert (last.x, last.y, last.z) == pytest.approx((1.3, 0.5, 0.936), abs=1e-6)


async def test_a_failure_is_recorded_with_its_object_and_arm(recorded: Recorded) -> None:
    with pytest.raises(EnvironmentManipulationImpossible):
        await OpeningMotion(ObjectPart(HANDLE, recorded.kitchen), Arms.LEFT).perform()
    node = await recorded.only(select(orm.TaskTreeNode).where(orm.TaskTreeNode.dtype == "OpeningMotion"))
    assert node.reason == "EnvironmentManipulationImpossible"
    message, handle, apart = node.failure_arguments
    assert (message, handle) == (node.failure_message, HANDLE)
    assert f"{apart:.3f} m away" in message
    await NavigateActionPerformable(Pose([0.6, 0.9, 0])).perform()
    await PickUpActionPerformable(recorded.milk, Arms.RIGHT, Grasp.FRONT).perform()
    assert len(await recorded.rows(select(orm.PickUpAction))) == 1
