"""The queries of the thesis, and the attributes of a row that are loaded without another query."""

from __future__ import annotations

from datetime import UTC, datetime

import pytest
from sqlalchemy import func, select
from sqlalchemy.orm import selectinload, undefer

import pycrorm_async.orm
from pycrorm_async.errors import CallerError
from pycrorm_async.events.ids import row_key
from pycrorm_async.events.types import NodeStarted, ObjectAdded, ObjectReference
from pycrorm_async.orm import (
    Action,
    Attachment,
    Base,
    BelieveObject,
    Concept,
    ConceptAncestor,
    Designator,
    JointChange,
    LocationResolution,
    Motion,
    MoveJointsMotion,
    MoveMotion,
    NavigateAction,
    Object,
    ObjectConcept,
    ObjectPart,
    ObjectRemoval,
    OpenAction,
    PickUpAction,
    Pose,
    Position,
    ProcessMetaData,
    Quaternion,
    RobotState,
    RootFailure,
    TaskTreeNode,
)
from pycrorm_async.orm.base import Moment
from pycrorm_async.projections.projector import Projector
from pycrorm_async.store.log import EventLog
from pycrorm_async.task_status import TaskStatus
from pycrorm_async.world.pose import Arms, Grasp, ObjectType
from tests.orm.recorded_breakfast import every, moment
from tests.projections.event_script import PICK_UP, T0_NS, Script, declarations, name_of, pose, row
from tests.projections.sql_queries import stored_and_folded
from tests.sessions import session_on

pytestmark = pytest.mark.slow


CLASSES = sorted(
    (each for each in vars(pycrorm_async.orm).values() if isinstance(each, type) and issubclass(each, Base)),
    key=lambda each: each.__name__,
)


async def test_a_fresh_memory_has_no_rows_of_any_class(log: EventLog) -> None:
    await Projector(log).open()
    always_filled = (Base, Concept, ConceptAncestor, ObjectConcept)  # the concepts belong to the program
    mapped = [each for each in CLASSES if each not in always_filled]
    assert len(mapped) > 50
    assert {each.__name__: await every(log, select(each)) for each in mapped} == {each.__name__: [] for each in mapped}


async def test_the_episode_has_its_author_and_its_outcome(breakfast: EventLog) -> None:
    (metadata,) = await every(breakfast, select(ProcessMetaData))
    assert repr(metadata) == (
        "ProcessMetaData(id=1, uuid='00000000-0000-7000-8000-000000000001',"
        f" created_at={moment(1)!r}, created_by='me', description='Tutorial', version='1.0', host='host',"
        f" python='3.11', plan='breakfast', world='pr2 (ROBOT), fridge (ENVIRONMENT)', status='LOST',"
        f" ended_at={moment(19)!r},"
        " end_sequence=19, simulated=False)"
    )


async def test_the_version_of_an_episode_has_the_name_from_the_thesis_as_a_synonym(breakfast: EventLog) -> None:
    (metadata,) = await every(breakfast, select(ProcessMetaData).where(ProcessMetaData.pycram_version == "1.0"))
    assert metadata.pycram_version == metadata.version == "1.0"
    assert await every(breakfast, select(ProcessMetaData.pycram_version)) == ["1.0"]


async def test_a_navigation_has_its_start_and_its_target(breakfast: EventLog) -> None:
    (drive,) = await every(breakfast, select(NavigateAction))
    assert (drive.id, drive.dtype, drive.kind) == (row(6), "NavigateAction", "action")
    state = drive.robot_state
    assert (state.torso_height, state.type, state.pose_id) == (0.25, ObjectType.ROBOT, row(6, 1))
    assert (state.pose.position.x, state.pose.orientation.z, state.pose.orientation.w) == (0.5, 0.6, 0.8)
    assert drive.pose is drive.target_location
    assert drive.pose_id == drive.target_location_id == row(6, 2)
    assert (drive.pose.position.x, drive.pose.position.y, drive.pose.frame) == (7.0, 8.0, "map")
    assert drive.pose.time == datetime(2023, 11, 14, 22, 13, 19, 998_999, tzinfo=UTC)
    assert drive.process_metadata.description == "Tutorial"
    assert state.pose.process_metadata is drive.process_metadata


async def test_the_text_of_an_action_has_its_fields_and_its_robot(breakfast: EventLog) -> None:
    (pick,) = await every(breakfast, select(PickUpAction))
    assert repr(pick) == (
        f"PickUpAction(id={row(11)}, process_metadata_id=1, dtype='PickUpAction', kind='action',"
        f" robot_state_id={row(11)}, object_id={row(4)}, arm=<Arms.LEFT: 1>, grasp=<Grasp.TOP: 3>,"
        f" robot_state=RobotState(id={row(11)}, process_metadata_id=1, torso_height=0.25,"
        f" type=<ObjectType.ROBOT: 8>, pose_id={row(11, 1)}))"
    )


async def test_every_action_is_an_instance_of_its_own_class(breakfast: EventLog) -> None:
    actions = await every(breakfast, select(Action).order_by(Action.id))
    assert [type(each) for each in actions] == [NavigateAction, PickUpAction, OpenAction]
    assert actions[1].arm is Arms.LEFT
    assert actions[1].grasp is Grasp.TOP
    assert actions[1].object.pose.position.z == 3.0
    assert actions[2].robot_state is None
    motions = await every(breakfast, select(Motion).order_by(Motion.id))
    assert [type(each) for each in motions] == [MoveMotion, MoveJointsMotion]
    assert motions[0].robot_state.pose.position.x == 0.5
    assert (motions[1].names, motions[1].positions) == (["a", "b"], [0.5, -1.0])
    designators = await every(breakfast, select(Designator).order_by(Designator.id))
    assert [type(each).__name__ for each in designators] == [
        "NavigateAction", "MoveMotion", "PickUpAction", "OpenAction", "MoveJointsMotion",
    ]  # fmt: skip
    assert designators[0].target_location.position.x == 7.0


async def test_the_pose_of_a_picked_up_object_is_the_one_at_execution(breakfast: EventLog) -> None:
    for picked in (PickUpAction.object, PickUpAction.object_designator):
        poses = await every(breakfast, select(Pose).join(picked).join(Object.pose))
        assert [(each.position.x, each.position.y, each.position.z) for each in poses] == [(1.0, 2.0, 3.0)]


async def test_nodes_carry_their_action_parent_status_and_reason(breakfast: EventLog) -> None:
    nodes = {each.id: each for each in await every(breakfast, select(TaskTreeNode))}
    assert sorted(nodes) == [row(2), row(6), row(8), row(11), row(15), row(16)]
    pick = nodes[row(11)]
    assert (pick.status, pick.reason, pick.failure_message) == (TaskStatus.FAILED, "IKError", "too far")
    assert (pick.failure_arguments, pick.duration_s) == (["LEFT"], 3.0)
    assert (pick.start_time, pick.end_time) == (moment(11), moment(14))
    assert pick.action.object.pose.position.x == 1.0
    assert pick.parent is nodes[row(2)]
    assert nodes[row(2)].action is None
    assert nodes[row(8)].parent.action.target_location.position.x == 7.0
    assert (nodes[row(15)].status, nodes[row(15)].end_time) == (TaskStatus.LOST, None)
    lost = select(TaskTreeNode.id).where(TaskTreeNode.status == TaskStatus.LOST).order_by(TaskTreeNode.id)
    assert await every(breakfast, lost) == [row(2), row(15), row(16)]


async def test_one_node_alone_has_its_parent_loaded(breakfast: EventLog) -> None:
    (node,) = await every(breakfast, select(TaskTreeNode).where(TaskTreeNode.id == row(8)))
    assert node.parent.id == row(6)
    assert node.parent.action.robot_state.pose.position.x == 0.5


async def test_a_node_has_children_and_ancestors(breakfast: EventLog) -> None:
    async with session_on(breakfast) as session:
        move = (await session.scalars(select(TaskTreeNode).where(TaskTreeNode.id == row(8)))).one()
        ancestors = await move.awaitable_attrs.ancestors
        assert [each.id for each in ancestors] == [row(6), row(2)]
        children = await ancestors[1].awaitable_attrs.children
        assert [each.id for each in children] == [row(6), row(11), row(15), row(16)]
        assert [each.id for each in ancestors[1].children] == [row(6), row(11), row(15), row(16)]
        assert await move.awaitable_attrs.children == []
        around = select(TaskTreeNode.id).where(TaskTreeNode.children.any(dtype="MoveMotion"))
        assert (await session.scalars(around)).all() == [row(6)]
        milk = (await session.scalars(select(Object).where(Object.id == row(12)))).one()
        assert (await milk.awaitable_attrs.node).action.dtype == "PickUpAction"
    drive, root = row(6), row(2)
    question = select(TaskTreeNode).where(TaskTreeNode.id == root).options(selectinload(TaskTreeNode.children))
    (node,) = await every(breakfast, question)
    assert (node.children[0].id, node.children[0].action.dtype) == (drive, "NavigateAction")
    moved = await every(breakfast, select(Object).options(selectinload(Object.node)).order_by(Object.id))
    assert [each.node and each.node.id for each in moved if each.name == "milk"] == [None, row(11)]


@pytest.mark.parametrize(
    ("class_", "sequence", "name"),
    [(TaskTreeNode, 2, "children"), (TaskTreeNode, 8, "ancestors"), (Object, 12, "node")],
)
async def test_an_attribute_that_is_not_loaded_names_the_remedy(
    breakfast: EventLog, class_: type[Base], sequence: int, name: str
) -> None:
    message = rf"^{name} of {class_.__name__} \(\d+,\) is not loaded: .*awaitable_attrs.{name}`"
    async with session_on(breakfast) as session:
        loaded = await session.get_one(class_, row(sequence))
        with pytest.raises(CallerError, match=message):
            getattr(loaded, name)
        assert await getattr(loaded.awaitable_attrs, name)  # the session is still usable
        getattr(loaded, name)
    (closed,) = await every(breakfast, select(class_).where(class_.id == row(sequence)))  # type: ignore[attr-defined]
    with pytest.raises(CallerError, match=message):
        getattr(closed, name)


async def test_nodes_join_their_designators(breakfast: EventLog) -> None:
    question = (
        select(PickUpAction.arm, TaskTreeNode.status).join(PickUpAction.node).where(PickUpAction.arm == Arms.LEFT)
    )
    async with session_on(breakfast) as session:
        assert (await session.execute(question)).all() == [(Arms.LEFT, TaskStatus.FAILED)]
        other = select(TaskTreeNode).join(TaskTreeNode.action.of_type(PickUpAction)).where(PickUpAction.arm == "LEFT")
        assert [each.id for each in await session.scalars(other)] == [row(11)]


async def test_the_parts_of_a_pose_can_be_joined(breakfast: EventLog) -> None:
    question = (
        select(Position.x, Quaternion.z)
        .select_from(NavigateAction)
        .join(NavigateAction.robot_state)
        .join(RobotState.pose)
        .join(Pose.position)
        .join(Pose.orientation)
    )
    async with session_on(breakfast) as session:
        assert (await session.execute(question)).all() == [(0.5, 0.6)]


async def test_objects_are_rows_of_moments_and_parts_refer_to_their_whole(breakfast: EventLog) -> None:
    milk = await every(breakfast, select(Object).where(Object.identity_id == row(4)).order_by(Object.id))
    assert [(each.id, each.pose.position.x, each.node_id) for each in milk] == [
        (row(4), 1.0, None),
        (row(12), 9.0, row(11)),
    ]
    (handle,) = await every(breakfast, select(ObjectPart))
    assert (handle.name, handle.part_of.name, handle.pose.position.x) == ("handle", "fridge", 1.0)
    assert await every(breakfast, select(BelieveObject)) == []
    (robot,) = await every(breakfast, select(Object).where(Object.obj_type == ObjectType.ROBOT))
    assert robot.joints == {"torso": 0.25}


async def test_the_changes_of_objects_can_be_queried(breakfast: EventLog) -> None:
    (held,) = await every(breakfast, select(Attachment))
    assert (held.kind, held.parent.name, held.child.name, held.link) == (
        "attached", "pr2", "milk", "l_gripper_tool_frame",
    )  # fmt: skip
    (turned,) = await every(breakfast, select(JointChange))
    assert (turned.joint, turned.position, turned.object.name, turned.time) == ("a", 0.5, "pr2", moment(17))
    (gone,) = await every(breakfast, select(ObjectRemoval))
    assert (gone.object.name, gone.identity_id, gone.node_id) == ("milk", row(4), None)


async def test_a_resolved_location_has_its_candidates(breakfast: EventLog) -> None:
    (resolved,) = await every(breakfast, select(LocationResolution))
    assert (resolved.location, resolved.considered, resolved.offered, resolved.taken) == ("CostmapLocation", 9, 1, 0)
    assert (resolved.pose.position.x, resolved.node.action.dtype) == (7.0, "NavigateAction")
    assert [(each.x, each.reachable_arms, each.taken) for each in resolved.candidates] == [(7.0, [Arms.LEFT], True)]


async def test_the_recorded_parameters_are_loaded_on_request(breakfast: EventLog) -> None:
    async with session_on(breakfast) as session:
        pick = (await session.scalars(select(PickUpAction))).one()
        awaited_parameters = await pick.awaitable_attrs.parameters
        assert awaited_parameters == {"object_designator": {"object": 4, "row": 4}, "arm": "LEFT", "grasp": "TOP"}
    (joints,) = await every(breakfast, select(MoveJointsMotion).options(undefer(MoveJointsMotion.parameters)))
    assert joints.parameters == {"names": ["a", "b"], "positions": [0.5, -1.0]}


async def test_an_object_type_that_is_unknown_to_this_process_is_its_name_and_an_arm_is_a_named_one(
    log: EventLog,
) -> None:
    script = Script()
    milk = script.put(ObjectAdded("milk", "OAT_MILK", pose()))
    parameters = {"object_designator": ObjectReference(milk, milk), "arm": "THIRD", "grasp": "TOP"}
    script.put(NodeStarted("action", None, name_of(PICK_UP), parameters))
    await stored_and_folded(log, [*declarations(PICK_UP), *script.records])
    (pick,) = await every(log, select(PickUpAction))
    assert (pick.arm, pick.grasp, pick.object.obj_type) == (Arms.named("THIRD"), Grasp.TOP, "OAT_MILK")


async def test_times_can_be_compared_and_a_naive_one_is_refused(breakfast: EventLog) -> None:
    later = select(TaskTreeNode.id).where(TaskTreeNode.start_time > moment(11)).order_by(TaskTreeNode.id)
    assert await every(breakfast, later) == [row(15), row(16)]
    with pytest.raises(ValueError, match="has no time zone"):
        Moment().process_bind_param(datetime(2026, 1, 1), None)  # type: ignore[arg-type]  # noqa: DTZ001  the point
    assert int(moment(0).timestamp()) * 10**9 == T0_NS


async def test_a_row_has_its_event_and_queries_filter_and_order_by_it(breakfast: EventLog) -> None:
    nodes = await every(breakfast, select(TaskTreeNode).order_by(TaskTreeNode.sequence.desc()))
    assert [each.sequence for each in nodes] == sorted((each.sequence for each in nodes), reverse=True)
    assert all(each.id == row(each.sequence) for each in nodes)
    assert await every(breakfast, select(Action.id).where(Action.sequence == 6)) == [row(6)]
    ends = {each.sequence: each.end_sequence for each in nodes}
    assert await every(breakfast, select(Action.end_sequence).where(Action.sequence == 6)) == [ends[6]]
    for class_ in (Object, Pose, Attachment, JointChange, ObjectRemoval, RootFailure, PickUpAction):
        (sequences,) = (await every(breakfast, select(func.sum(class_.sequence)))) or [None]
        assert sequences == sum(each.sequence for each in await every(breakfast, select(class_))) > 0, class_


async def test_plain_sql_has_the_events_of_a_row(breakfast: EventLog) -> None:
    nodes = await every(breakfast, select(TaskTreeNode).order_by(TaskTreeNode.id))
    expected = [(each.sequence, each.end_sequence) for each in nodes]
    async with breakfast.engine.connect() as connection:
        for view in ("task_tree_node", "designator"):
            rows = await connection.exec_driver_sql(f"SELECT id, sequence, end_sequence FROM {view} ORDER BY id")
            by_id = {row.id: (row.sequence, row.end_sequence) for row in rows}
            assert by_id.items() <= {each.id: pair for each, pair in zip(nodes, expected, strict=True)}.items()
        for view in ("action", "motion", "object", "pose", "robot_state", "attachment", "object_removal"):
            for row_ in await connection.exec_driver_sql(f"SELECT id, sequence FROM {view}"):
                assert row_.sequence == row_key(row_.id).sequence
