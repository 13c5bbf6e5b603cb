"""The queries of the thesis: rows with their attributes, their outcomes, their events and their failures."""

from __future__ import annotations

from datetime import UTC, datetime
from typing import Any

import pytest
from sqlalchemy import select
from sqlalchemy.orm import Mapped, selectinload, undefer

from pycrorm_async import orm
from pycrorm_async.events import types as events
from pycrorm_async.events.ids import row_key
from pycrorm_async.orm.base import UtcTime
from pycrorm_async.projections.generations import current_generation
from pycrorm_async.store.log import EventLog
from pycrorm_async.task_status import TaskStatus
from pycrorm_async.world.pose import Arms, Grasp, ObjectType
from tests.orm.recorded_breakfast import OPEN, every, moment, session_on
from tests.projections.event_script import (
    MOVE,
    NAVIGATE,
    PICK_UP,
    T0_NS,
    Script,
    declarations,
    declared,
    field,
    name_of,
    pose,
    row,
    time_us,
)
from tests.projections.sql_queries import ask, stored_and_folded

pytestmark = pytest.mark.slow

# === queries ==================================================================================================
#
# The queries of the thesis, and the attributes of a row that are loaded without another query.


async def test_the_episode_has_its_author_and_its_outcome(breakfast: EventLog) -> None:
    (metadata,) = await every(breakfast, select(orm.ProcessMetaData))
    assert repr(metadata) == (
        "ProcessMetaData(id=1, uuid='00000000-0000-7000-8000-000000000001',"
        f" created_at={moment(1)!r}, created_by='me', description='Tutorial', version='1.0', host='host',"
        f" python='3.11', plan='breakfast', world='pr2 (ROBOT), fridge (ENVIRONMENT)', status='LOST',"
        f" start_ns=1000000005, end_ns=19000000005, end_sequence=19, simulated=False, ended_at={moment(19)!r},"
        " duration_s=18.0)"
    )


async def test_rows_are_joined_along_their_relationships_and_names_of_the_thesis(breakfast: EventLog) -> None:
    async with session_on(breakfast) as session:
        for question, rows in (
            (select(orm.ProcessMetaData.pycram_version).where(orm.ProcessMetaData.pycram_version == "1.0"), [("1.0",)]),
            (
                select(orm.ProcessMetaData.description, orm.PickUpAction.duration).join(orm.PickUpAction.episode),
                [("Tutorial", 3.0)],
            ),
            (
                select(orm.PickUpAction.arm, orm.TaskTreeNode.status)
                .join(orm.PickUpAction.node)
                .where(orm.PickUpAction.arm == "LEFT"),
                [(Arms.LEFT, TaskStatus.FAILED)],
            ),
            (
                select(orm.TaskTreeNode.id)
                .join(orm.TaskTreeNode.action.of_type(orm.PickUpAction))
                .where(orm.PickUpAction.arm == Arms.LEFT),
                [(row(11),)],
            ),
            (
                select(orm.Position.x, orm.Quaternion.z)
                .select_from(orm.NavigateAction)
                .join(orm.NavigateAction.robot_state)
                .join(orm.RobotState.pose)
                .join(orm.Pose.position)
                .join(orm.Pose.orientation),
                [(0.5, 0.6)],
            ),
            *(  # the pose of the object at execution, and not after it has moved
                (select(orm.Pose.x, orm.Pose.z).join(picked).join(orm.Object.pose), [(1.0, 3.0)])
                for picked in (orm.PickUpAction.object, orm.PickUpAction.object_designator)
            ),
        ):
            assert list(map(tuple, await session.execute(question))) == rows


async def test_a_navigation_has_its_start_and_its_target(breakfast: EventLog) -> None:
    (drive,) = await every(breakfast, select(orm.NavigateAction))
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


async def test_every_action_is_an_instance_of_its_own_class(breakfast: EventLog) -> None:
    actions = await every(breakfast, select(orm.Action).order_by(orm.Action.id))
    assert [type(each) for each in actions] == [orm.NavigateAction, orm.PickUpAction, orm.OpenAction]
    assert actions[1].arm is Arms.LEFT
    assert actions[1].grasp is Grasp.TOP
    assert actions[1].object.pose.position.z == 3.0
    assert actions[2].robot_state is None
    motions = await every(breakfast, select(orm.Motion).order_by(orm.Motion.id))
    assert [type(each) for each in motions] == [orm.MoveMotion, orm.MoveJointsMotion]
    assert motions[0].robot_state.pose.position.x == 0.5
    assert (motions[1].names, motions[1].positions) == (["a", "b"], [0.5, -1.0])
    designators = await every(breakfast, select(orm.Designator).order_by(orm.Designator.id))
    assert [type(each).__name__ for each in designators] == [
        "NavigateAction", "MoveMotion", "PickUpAction", "OpenAction", "MoveJointsMotion",
    ]  # fmt: skip
    assert designators[0].target_location.position.x == 7.0


async def test_nodes_carry_their_action_parent_status_and_reason(breakfast: EventLog) -> None:
    nodes = {each.id: each for each in await every(breakfast, select(orm.TaskTreeNode))}
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
    lost = select(orm.TaskTreeNode.id).where(orm.TaskTreeNode.status == TaskStatus.LOST).order_by(orm.TaskTreeNode.id)
    assert await every(breakfast, lost) == [row(2), row(15), row(16)]


async def test_a_node_has_children_and_ancestors(breakfast: EventLog) -> None:
    async with session_on(breakfast) as session:
        move = (await session.scalars(select(orm.TaskTreeNode).where(orm.TaskTreeNode.id == row(8)))).one()
        ancestors = await move.awaitable_attrs.ancestors
        assert [each.id for each in ancestors] == [row(6), row(2)]
        children = await ancestors[1].awaitable_attrs.children
        assert [each.id for each in children] == [row(6), row(11), row(15), row(16)]
        assert [each.id for each in ancestors[1].children] == [row(6), row(11), row(15), row(16)]
        assert await move.awaitable_attrs.children == []
        around = select(orm.TaskTreeNode.id).where(orm.TaskTreeNode.children.any(dtype="MoveMotion"))
        assert (await session.scalars(around)).all() == [row(6)]
        milk = (await session.scalars(select(orm.Object).where(orm.Object.id == row(12)))).one()
        assert (await milk.awaitable_attrs.node).action.dtype == "PickUpAction"
    drive, root = row(6), row(2)
    question = (
        select(orm.TaskTreeNode).where(orm.TaskTreeNode.id == root).options(selectinload(orm.TaskTreeNode.children))
    )
    (node,) = await every(breakfast, question)
    assert (node.children[0].id, node.children[0].action.dtype) == (drive, "NavigateAction")
    moved = await every(breakfast, select(orm.Object).options(selectinload(orm.Object.node)).order_by(orm.Object.id))
    assert [each.node and each.node.id for each in moved if each.name == "milk"] == [None, row(11)]


async def test_objects_are_rows_of_moments_and_parts_refer_to_their_whole(breakfast: EventLog) -> None:
    milk = await every(breakfast, select(orm.Object).where(orm.Object.identity_id == row(4)).order_by(orm.Object.id))
    assert [(each.id, each.pose.position.x, each.node_id) for each in milk] == [
        (row(4), 1.0, None),
        (row(12), 9.0, row(11)),
    ]
    (handle,) = await every(breakfast, select(orm.ObjectPart))
    assert (handle.name, handle.part_of.name, handle.pose.position.x) == ("handle", "fridge", 1.0)
    assert await every(breakfast, select(orm.BelieveObject)) == []
    (robot,) = await every(breakfast, select(orm.Object).where(orm.Object.obj_type == ObjectType.ROBOT))
    assert robot.joints == {"torso": 0.25}


async def test_the_changes_of_objects_can_be_queried(breakfast: EventLog) -> None:
    (held,) = await every(breakfast, select(orm.Attachment))
    assert (held.kind, held.parent.name, held.child.name, held.link) == (
        "attached", "pr2", "milk", "l_gripper_tool_frame",
    )  # fmt: skip
    (turned,) = await every(breakfast, select(orm.JointChange))
    assert (turned.joint, turned.position, turned.object.name, turned.time) == ("a", 0.5, "pr2", moment(17))
    (gone,) = await every(breakfast, select(orm.ObjectRemoval))
    assert (gone.object.name, gone.identity_id, gone.node_id) == ("milk", row(4), None)


async def test_a_resolved_location_has_its_candidates(breakfast: EventLog) -> None:
    (resolved,) = await every(breakfast, select(orm.LocationResolution))
    assert (resolved.location, resolved.considered, resolved.offered, resolved.taken) == ("CostmapLocation", 9, 1, 0)
    assert (resolved.pose.position.x, resolved.node.action.dtype) == (7.0, "NavigateAction")
    assert [(each.x, each.reachable_arms, each.taken) for each in resolved.candidates] == [(7.0, [Arms.LEFT], True)]


async def test_the_recorded_parameters_are_loaded_on_request(breakfast: EventLog) -> None:
    async with session_on(breakfast) as session:
        pick = (await session.scalars(select(orm.PickUpAction))).one()
        awaited_parameters = await pick.awaitable_attrs.parameters
        assert awaited_parameters == {"object_designator": {"object": 4, "row": 4}, "arm": "LEFT", "grasp": "TOP"}
    (joints,) = await every(breakfast, select(orm.MoveJointsMotion).options(undefer(orm.MoveJointsMotion.parameters)))
    assert joints.parameters == {"names": ["a", "b"], "positions": [0.5, -1.0]}


async def test_an_object_type_that_is_unknown_to_this_process_is_its_name_and_an_arm_is_a_named_one(
    log: EventLog,
) -> None:
    script = Script()
    milk = script.put(events.ObjectAdded("milk", "OAT_MILK", pose()))
    parameters = {"object_designator": events.ObjectReference(milk, milk), "arm": "THIRD", "grasp": "TOP"}
    script.put(events.NodeStarted("action", None, name_of(PICK_UP), parameters))
    await stored_and_folded(log, [*declarations(PICK_UP), *script.records])
    (pick,) = await every(log, select(orm.PickUpAction))
    assert (pick.arm, pick.grasp, pick.object.obj_type) == (Arms.named("THIRD"), Grasp.TOP, "OAT_MILK")


async def test_times_can_be_compared_and_a_naive_one_is_refused(breakfast: EventLog) -> None:
    later = select(orm.TaskTreeNode.id).where(orm.TaskTreeNode.start_time > moment(11)).order_by(orm.TaskTreeNode.id)
    assert await every(breakfast, later) == [row(15), row(16)]
    with pytest.raises(ValueError, match="has no time zone"):
        UtcTime().process_bind_param(datetime(2026, 1, 1), None)  # type: ignore[arg-type]  # noqa: DTZ001  the point
    assert int(moment(0).timestamp()) * 10**9 == T0_NS


# === action attributes ========================================================================================
#
# Actions have their node, their times and their outcome, also in filters and in plain SQL.

WAIT = declared("WaitAction", "orm_wait", field("duration", "real", 2), field("status", "text", 3))


class ORMWait(orm.Action):
    """A class whose fields have the names of attributes that every action has."""

    __tablename__ = "orm_wait"

    duration: Mapped[float]
    status: Mapped[str]  # type: ignore[assignment]


async def test_an_action_has_its_times_and_its_outcome_also_in_filters(breakfast: EventLog) -> None:
    drive, pick, opening = await every(breakfast, select(orm.Action).order_by(orm.Action.start_time))
    assert (drive.status, drive.reason, drive.duration) == (TaskStatus.SUCCEEDED, None, 4.0)
    assert (pick.status, pick.reason, pick.duration) == (TaskStatus.FAILED, "IKError", 3.0)
    assert (pick.start_time, pick.end_time) == (moment(11), moment(14))
    assert (opening.status, opening.end_time, opening.duration) == (TaskStatus.LOST, None, None)
    assert pick.episode is pick.process_metadata
    for condition, sequences in (
        (orm.Action.status == TaskStatus.FAILED, [11]),
        (orm.Action.duration >= 3, [6, 11]),
        (orm.Action.end_time.is_(None), [15]),
        (orm.Action.start_time > moment(6), [11, 15]),
        (orm.Action.reason == "IKError", [11]),
        (orm.Action.episode.has(description="Tutorial"), [6, 11, 15]),
        (orm.Action.sequence == 6, [6]),
    ):
        in_order = select(orm.Action.id).where(condition).order_by(orm.Action.duration.is_(None), orm.Action.start_time)
        assert await every(breakfast, in_order) == [row(each) for each in sequences]


async def test_plain_sql_reads_times_and_outcome_of_an_action_from_one_view(breakfast: EventLog) -> None:
    move = (1, "MoveMotion", "SUCCEEDED", time_us(8), time_us(9), 1.0, None)
    pick = (1, "PickUpAction", "FAILED", time_us(11), time_us(14), 3.0, "IKError")
    columns = "process_metadata_id, dtype, status, start_time, end_time, duration, reason"
    chosen = "WHERE dtype IN ('PickUpAction', 'MoveMotion') ORDER BY id"
    views = {"action": [pick], "motion": [move], "designator": [move, pick], "task_tree_node": [move, pick]}
    for view, rows in views.items():
        assert await ask(breakfast, f"SELECT {columns} FROM {view} {chosen}") == rows


async def test_a_field_with_the_name_of_an_action_attribute_hides_it(log: EventLog) -> None:
    script = Script()
    node = script.put(events.NodeStarted("action", None, name_of(WAIT), {"duration": 60.0, "status": "patient"}))
    script.put(events.NodeEnded(node, "SUCCEEDED"))
    await stored_and_folded(log, [*declarations(WAIT), *script.records])
    (wait,) = await every(log, select(ORMWait).where(ORMWait.duration > 50, orm.Action.duration < 50))
    assert (wait.duration, wait.status, wait.reason) == (60.0, "patient", None)
    assert await every(log, select(orm.Action.duration)) == [1.0]


# === event of rows ============================================================================================
#
# Every row of what happened has its event: as an attribute of the mapped classes, and in plain SQL.

PLACE = declared("PlaceAction", "place_action", field("object_designator", "object", 2), field("arm", "enum", 3))
SETS = declared("SetAction", "set_action", field("things", "list", 2, item="object"), field("sequence", "integer", 3))
WITHOUT_EVENT = {"process_metadata", "position", "quaternion"}
"""The views of episodes, and of the parts of a pose."""
EVENTS: dict[Any, int] = {
    orm.EpisodeTag: 1,
    orm.LocationCandidate: 5,
    orm.LocationRefusal: 5,
    orm.ParameterItem: 6,
    orm.PickUpAction: 7,
    orm.PickUpWithContextView: 7,
    orm.RootFailure: 7,
    orm.SpatialRelation: 7,
}


@pytest.fixture
async def filled(log: EventLog) -> EventLog:
    """The log of an episode with a tag and a failed pick-up of milk beside a bowl."""
    script = Script()
    put = script.put
    put(events.EpisodeStarted("Tutorial", "me", "host", "1.0", "3.11", tags=("kitchen",)))
    root = put(events.NodeStarted("root"))
    milk = put(events.ObjectAdded("milk", "MILK", pose(1, 2, 1)))
    put(events.ObjectAdded("bowl", "BOWL", pose(1.15, 2, 1)))
    offered, refused = (events.CandidateValue(pose(7, 8), ("LEFT",)),), (events.RefusalValue(pose(8, 8), "too far"),)
    put(events.LocationResolved("CostmapLocation", offered, 0, 9, root, refused))
    seen, state = events.ObjectReference(milk, milk), events.RobotValue(pose(0.5), "ROBOT", 0.25)
    put(events.NodeStarted("action", root, name_of(SETS), {"things": [seen], "sequence": 70}, state))
    parameters = {"object_designator": seen, "arm": "LEFT", "grasp": "TOP"}
    pick = put(events.NodeStarted("action", root, name_of(PICK_UP), parameters, state))
    put(events.NodeEnded(pick, "FAILED", events.FailureValue("plan.failures.IKError", "too far")))
    await stored_and_folded(log, [*declarations(PICK_UP, PLACE, SETS), *script.records])
    return log


async def test_every_view_and_class_of_what_happened_has_the_event_of_its_rows(filled: EventLog) -> None:
    tables = {mapper.class_.__tablename__: mapper.class_ for mapper in orm.Base.registry.mappers}
    async with filled.engine.connect() as connection:
        generation = await current_generation(connection)
        assert generation is not None
        for view in generation.views:
            answer = await connection.exec_driver_sql(f'SELECT * FROM "{view}"')
            columns = list(answer.keys())
            if "process_metadata_id" not in columns or view in WITHOUT_EVENT:
                continue
            assert columns.count("sequence") == 1, view
            key = getattr(tables.get(view), "_row", "id")
            for row in answer.mappings():
                # A field of a type that has this name takes precedence.
                assert row["sequence"] == (70 if view == "set_action" else row_key(row[key]).sequence), view
    async with session_on(filled) as session:
        for class_, event in EVENTS.items():
            loaded = (await session.scalars(select(class_).order_by(class_.sequence))).all()
            assert {each.sequence for each in loaded} == {event}, class_


# === failures =================================================================================================
#
# The view of failures: where each began, with its path, its object, its arm and its message.

RETRY = declared("Retry", "retry", field("times", "integer", 2), kind="language")


def failing() -> Script:
    """A transport fails in a motion of its second attempt, and the plan continues; then the plan itself raises."""
    script = Script()
    put = script.put
    put(events.EpisodeStarted("Breakfast", "me", "host", "1.0", "3.11"))  # 1
    root = put(events.NodeStarted("root"))  # 2
    milk = put(events.ObjectAdded("milk", "MILK", pose(1, 2, 3)))  # 3
    retry = put(events.NodeStarted("language", root, name_of(RETRY), {"times": 2}))  # 4
    for arm in ("LEFT", "RIGHT"):  # 5 to 9, 10 to 14
        seen = {"object_designator": events.ObjectReference(milk, milk), "arm": arm, "grasp": "TOP"}
        pick = put(events.NodeStarted("action", retry, name_of(PICK_UP), seen))
        move = put(events.NodeStarted("motion", pick, name_of(MOVE), {"target": pose(7, 8)}))
        put(events.ObjectMoved(milk, "milk", "MILK", pose(9, 9, 9), move))
        fault = events.FailureValue("plan.failures.IKError", f"{arm} is too short", [])
        put(events.NodeEnded(move, "FAILED", fault))
        put(events.NodeEnded(pick, "FAILED", fault))
    put(events.NodeEnded(retry, "SUCCEEDED"))  # 15
    handle = events.ObjectValue("ObjectPart", "handle", "GENERIC_OBJECT", pose(1))
    opening = put(events.NodeStarted("action", root, name_of(OPEN), {"object_designator": handle, "arm": "LEFT"}))  # 16
    put(events.NodeEnded(opening, "CANCELLED"))  # 17
    drive = put(events.NodeStarted("action", root, name_of(NAVIGATE), {"target_location": pose(7)}))  # 18
    put(events.NodeEnded(drive, "SUCCEEDED"))  # 19
    opening = put(events.NodeStarted("action", root, name_of(OPEN), {"object_designator": handle, "arm": "LEFT"}))  # 20
    put(events.NodeEnded(opening, "ERROR", events.FailureValue("builtins.KeyError", "door")))  # 21
    put(events.NodeEnded(root, "ERROR", events.FailureValue("builtins.KeyError", "door")))  # 22
    put(events.EpisodeEnded("ERROR"))  # 23
    put = (second := Script(2)).put
    put(events.EpisodeStarted("Lunch", "me", "host", "1.0", "3.11"))  # 1
    root = put(events.NodeStarted("root"))  # 2
    put(events.NodeEnded(root, "ERROR", events.FailureValue("builtins.ValueError", "no table")))  # 3
    script.records += second.records
    return script


async def test_a_failure_is_listed_where_it_began_with_path_object_arm_and_message(log: EventLog) -> None:
    await stored_and_folded(log, [*declarations(PICK_UP, MOVE, OPEN, NAVIGATE, RETRY), *failing().records])
    first, second, opening, plan = await every(log, select(orm.RootFailure).order_by(orm.RootFailure.id))
    path = "root > Retry > PickUpAction > MoveMotion"
    assert (first.id, first.dtype, first.status) == (row(6), "MoveMotion", TaskStatus.FAILED)
    assert (first.path, first.object, first.arm) == (path, "milk", Arms.LEFT)
    assert (first.reason, first.message, first.recovered) == ("IKError", "LEFT is too short", True)
    assert (first.start_time, first.end_time, first.episode.description) == (moment(6), moment(8), "Breakfast")
    assert (second.id, second.path, second.arm, second.message) == (row(11), path, Arms.RIGHT, "RIGHT is too short")
    assert (opening.id, opening.path, opening.status) == (row(20), "root > OpenAction", TaskStatus.ERROR)
    assert (opening.object, opening.arm, opening.reason) == ("handle", Arms.LEFT, "KeyError")
    assert (opening.message, opening.recovered) == ("door", False)
    assert (plan.id, plan.dtype, plan.path, plan.object) == (row(2, number=2), None, "root", None)
    assert (plan.arm, plan.message, plan.recovered) == (None, "no table", False)
    lost = select(orm.RootFailure.path).where(~orm.RootFailure.recovered, orm.RootFailure.object == "handle")
    assert await every(log, lost) == ["root > OpenAction"]


async def test_object_and_arm_of_a_failure_are_those_of_the_nearest_node(log: EventLog) -> None:
    script = Script()
    put = script.put
    milk = put(events.ObjectAdded("milk", "MILK", pose(1, 2, 3)))
    seen = {"object_designator": events.ObjectReference(milk, milk), "arm": "RIGHT", "grasp": "TOP"}
    pick = put(events.NodeStarted("action", None, name_of(PICK_UP), seen))
    handle = {"object_designator": events.ObjectValue("ObjectPart", "handle"), "arm": "LEFT"}
    opening = put(events.NodeStarted("action", pick, name_of(OPEN), handle))
    for node in (opening, pick):
        put(events.NodeEnded(node, "FAILED", events.FailureValue("plan.failures.PlanFailure", "")))
    await stored_and_folded(log, [*declarations(PICK_UP, OPEN), *script.records])
    (failure,) = await every(log, select(orm.RootFailure))
    assert (failure.path, failure.object, failure.arm) == ("PickUpAction > OpenAction", "handle", Arms.LEFT)
