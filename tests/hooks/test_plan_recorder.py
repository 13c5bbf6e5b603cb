"""A plan in a Bullet world becomes events: in legal order, with the values at that moment."""

import asyncio
import math
from dataclasses import dataclass

import pytest

from pycrorm_async.errors import Unrecordable
from pycrorm_async.events.types import (
    CellsValue,
    EpisodeEnded,
    EpisodeStarted,
    JointsMoved,
    LocationResolved,
    NodeEnded,
    NodeStarted,
    ObjectAdded,
    ObjectAttached,
    ObjectDetached,
    ObjectMoved,
    ObjectReference,
    ObjectRemoved,
    PoseValue,
)
from pycrorm_async.plan.actions import MoveTorsoActionPerformable, NavigateActionPerformable
from pycrorm_async.plan.execution import Candidate, Cells, Refusal
from pycrorm_async.plan.language import ActionAbstract
from pycrorm_async.plan.motions import simulated_robot
from pycrorm_async.plan.objects import ObjectDesignator, ObjectPart
from pycrorm_async.record.plan_recorder import current_episode
from pycrorm_async.settings import Settings
from pycrorm_async.world import Arms, BulletWorld, Object, ObjectType, Pose
from tests.hooks.fakes import CarryActionPerformable, NoteActionPerformable, findings, kinds, recorder_case


async def test_an_episode_is_framed_by_its_start_its_root_and_its_end() -> None:
    with recorder_case() as case, case.episode() as episode:
        await NoteActionPerformable("hello").perform()
    events = case.sink.of(episode)
    assert kinds(events) == ["EpisodeStarted", "NodeStarted", "NodeStarted", "NodeEnded", "NodeEnded", "EpisodeEnded"]
    assert findings(events) == []
    start, root, note, noted, rooted, end = (event for _, event in events)
    assert isinstance(start, EpisodeStarted)
    assert (start.description, start.software) == ("d", "test")
    assert root == NodeStarted("root")
    assert isinstance(note, NodeStarted)
    assert note.parent == 2
    assert note.parameters == {"text": "hello", "weight": 0.0, "ran": False}
    assert note.robot is None
    assert noted == NodeEnded(3, "SUCCEEDED", result="hello")
    assert rooted == NodeEnded(2, "SUCCEEDED")
    assert end == EpisodeEnded("SUCCEEDED")


async def test_a_type_is_declared_once_per_recorder_before_its_first_node() -> None:
    with recorder_case() as case:
        for _ in range(2):
            with case.episode():
                await NoteActionPerformable().perform()
    declared = [index for index, (owner, _, _) in enumerate(case.sink.records) if owner is None]
    assert len(declared) == 1
    first_node = next(
        index
        for index, (_, _, event) in enumerate(case.sink.records)
        if isinstance(event, NodeStarted) and event.kind == "action"
    )
    assert declared[0] < first_node


async def test_the_robot_state_is_that_at_the_start_of_the_node() -> None:
    with recorder_case() as case, case.episode() as episode, BulletWorld(), simulated_robot:
        Object("pr2", ObjectType.ROBOT)
        await MoveTorsoActionPerformable(0.25).perform()
        await NavigateActionPerformable(Pose([0.6, 0.4, 0.0])).perform()
        await NoteActionPerformable().perform()
    starts = [event for _, event in case.sink.of(episode) if isinstance(event, NodeStarted) and event.kind == "action"]
    robots = [start.robot for start in starts]
    assert [robot.torso_height for robot in robots if robot] == [0.0, 0.25, 0.25]
    assert [robot.pose.position for robot in robots if robot] == [(0, 0, 0), (0, 0, 0), (0.6, 0.4, 0.0)]
    assert [robot.object_type for robot in robots if robot] == ["ROBOT"] * 3


async def test_an_object_parameter_names_its_current_row() -> None:
    with recorder_case() as case, case.episode() as episode, BulletWorld():
        milk = Object("milk", ObjectType.MILK, pose=Pose([1.3, 1.0, 0.9]))
        await CarryActionPerformable(ObjectDesignator("milk", ObjectType.MILK, milk)).perform()
        milk.set_pose(Pose([5.0, 5.0, 0.0]))
        await CarryActionPerformable(milk).perform()  # type: ignore[arg-type]  # a world object serves as well
        milk.set_pose(Pose([6.0, 6.0, 0.0]))
    events = case.sink.of(episode)
    added = next(sequence for sequence, event in events if isinstance(event, ObjectAdded))
    moved = [sequence for sequence, event in events if isinstance(event, ObjectMoved)]
    carried = [
        event.parameters["what"] for _, event in events if isinstance(event, NodeStarted) and event.kind == "action"
    ]
    assert carried == [{"object": added, "row": added}, {"object": added, "row": moved[0]}]
    poses = dict(events)
    assert isinstance(poses[moved[0]], ObjectMoved)
    assert poses[moved[0]].pose.position == (5.0, 5.0, 0.0)  # type: ignore[attr-defined]
    assert findings(events) == []


async def test_a_part_brings_its_own_value_and_its_whole() -> None:
    with recorder_case() as case, case.episode() as episode, BulletWorld():
        kitchen = Object("kitchen", ObjectType.ENVIRONMENT)
        part = ObjectPart("kitchen_island_surface", kitchen)
        await CarryActionPerformable(ObjectDesignator("kitchen", ObjectType.ENVIRONMENT, kitchen), part).perform()
        where = kitchen.link_pose("kitchen_island_surface")
    value = next(
        event.parameters["part"]
        for _, event in case.sink.of(episode)
        if isinstance(event, NodeStarted) and event.kind == "action"
    )
    assert value["dtype"] == "ObjectPart"
    assert value["name"] == "kitchen_island_surface"
    assert value["part_of"] == {"object": 3, "row": 3}
    assert value["pose"]["position"] == list(where.position)


async def test_attaching_carrying_and_detaching_are_events_with_their_cause() -> None:
    @dataclass
    class HoldActionPerformable(ActionAbstract):
        async def perform(self) -> None:
            robot.attach(milk, "l_gripper_tool_frame")
            robot.set_pose(Pose([1.0, 0.0, 0.0]))
            robot.detach(milk)

    with recorder_case() as case, case.episode() as episode, BulletWorld():
        robot = Object("pr2", ObjectType.ROBOT)
        milk = Object("milk", ObjectType.MILK, pose=Pose([0.5, 0.0, 0.9]))
        await HoldActionPerformable().perform()
        robot.set_joint_position("torso_lift_joint", 0.1)
    events = case.sink.of(episode)
    node = next(sequence for sequence, event in events if isinstance(event, NodeStarted) and event.kind == "action")
    attached, detached = (
        next(event for _, event in events if isinstance(event, kind)) for kind in (ObjectAttached, ObjectDetached)
    )
    assert attached == ObjectAttached(ObjectReference(3, 3), ObjectReference(4, 4), "l_gripper_tool_frame", node)
    moves = [(event.name, event.pose.position, event.node) for _, event in events if isinstance(event, ObjectMoved)]
    assert [(name, cause) for name, _, cause in moves] == [("pr2", node), ("milk", node)]
    assert moves[1][1] == pytest.approx((1.5, 0.0, 0.9), abs=1e-6)
    assert isinstance(detached, ObjectDetached)
    assert detached.child.object == 4
    assert detached.child.row > 4
    joints = [event for _, event in events if isinstance(event, JointsMoved)]
    assert [(each.joints, each.node) for each in joints] == [({"torso_lift_joint": 0.1}, None)]
    assert findings(events) == []


async def test_a_world_entered_before_belongs_to_each_open_episode() -> None:
    with recorder_case() as case, BulletWorld():
        robot = Object("pr2", ObjectType.ROBOT)
        milk = Object("milk", ObjectType.MILK, pose=Pose([0.5, 0.0, 0.9]))
        robot.attach(milk, "l_gripper_tool_frame")
        with case.episode() as first:
            milk.set_pose(Pose([0.6, 0.0, 0.9]))
        milk.set_pose(Pose([0.7, 0.0, 0.9]))
        with case.episode() as second:
            pass
    added = [
        [(e.name, e.pose.position) for _, e in case.sink.of(each) if isinstance(e, ObjectAdded)]
        for each in (first, second)
    ]
    assert added == [
        [("pr2", (0.0, 0.0, 0.0)), ("milk", (0.5, 0.0, 0.9))],
        [("pr2", (0.0, 0.0, 0.0)), ("milk", (0.7, 0.0, 0.9))],
    ]
    assert kinds(case.sink.of(first)).count("ObjectMoved") == 1
    assert kinds(case.sink.of(second)).count("ObjectMoved") == 0
    assert kinds(case.sink.of(second)).count("ObjectAttached") == 1


async def test_successive_worlds_belong_to_the_same_episode() -> None:
    with recorder_case() as case, case.episode() as episode:
        for name in ("one", "two"):
            with BulletWorld():
                Object(name, ObjectType.MILK)
    assert [e.name for _, e in case.sink.of(episode) if isinstance(e, ObjectAdded)] == ["one", "two"]
    assert findings(case.sink.of(episode)) == []


async def test_a_perform_outside_any_episode_opens_one_of_its_own() -> None:
    with recorder_case() as case:
        await NoteActionPerformable("a").perform()
        await NoteActionPerformable("b").perform()
    assert len(case.sink.sequences) == 2
    for name in case.sink.sequences:
        events = case.sink.of(name)
        assert findings(events) == []
        assert isinstance(events[0][1], EpisodeStarted)
        assert events[0][1].description == "NoteAction"
        assert events[-1][1] == EpisodeEnded("SUCCEEDED")


async def test_nan_in_a_pose_names_the_designator_and_the_field() -> None:
    refusal = r"^NavigateAction\.target_location cannot be recorded: the pose holds"
    strict = Settings(on_unrecordable="refuse")
    with recorder_case(strict) as case, case.episode(), pytest.raises(Unrecordable, match=refusal):
        await NavigateActionPerformable(Pose([math.nan, 0, 0])).perform()
    assert case.emitter.faults.total == 0


async def test_nodes_that_outlive_their_episode_are_lost_to_it() -> None:
    begun, leave = asyncio.Event(), asyncio.Event()

    @dataclass
    class WaitActionPerformable(ActionAbstract):
        async def perform(self) -> None:
            begun.set()
            await leave.wait()
            await NoteActionPerformable("after").perform()

    with recorder_case() as case:
        with case.episode() as episode:
            task = asyncio.create_task(WaitActionPerformable().perform())
            await begun.wait()
        leave.set()
        await task
    events = case.sink.of(episode)
    assert findings(events) == []
    assert events[-3][1] == NodeEnded(3, "LOST")
    assert len(case.sink.sequences) == 2  # a later perform has an episode of its own


async def test_a_resolved_location_is_recorded_with_its_node() -> None:
    with recorder_case() as case, case.episode() as episode:
        pose = Pose([1.0, 2.0, 0.0], time_ns=5)
        case.recorder.location_resolved(
            location="CostmapLocation",
            offered=(Candidate(pose, (Arms.LEFT,)),),
            taken=0,
            considered=7,
            refused=(Refusal(pose, "LEFT: too far"), Refusal(pose, "hidden\0")),
            offered_beyond=0,
            cells=Cells(occupied=3, hidden=2, free=9),
            node=None,
        )
    event = next(e for _, e in case.sink.of(episode) if isinstance(e, LocationResolved))
    assert event.offered[0].pose == PoseValue((1.0, 2.0, 0.0), (0.0, 0.0, 0.0, 1.0), "map", 5)
    assert (event.offered[0].arms, event.taken, event.considered, event.node) == (("LEFT",), 0, 7, None)
    assert [each.reason for each in event.refused] == ["LEFT: too far", "hidden\\x00"]
    assert {each.pose for each in event.refused} == {event.offered[0].pose}
    assert event.cells == CellsValue(3, 2, 9)


async def test_three_plans_in_three_tasks_never_share_a_parent() -> None:
    @dataclass
    class OuterActionPerformable(ActionAbstract):
        name: str

        async def perform(self) -> None:
            for index in range(5):
                await asyncio.sleep(0)
                await NoteActionPerformable(f"{self.name}{index}").perform()

    with recorder_case() as case, case.episode() as episode:
        await asyncio.gather(*(OuterActionPerformable(name).perform() for name in "abc"))
    events = case.sink.of(episode)
    assert findings(events) == []
    starts = {sequence: event for sequence, event in events if isinstance(event, NodeStarted)}
    for event in starts.values():
        if "text" in event.parameters:
            assert event.parent is not None
            assert starts[event.parent].parameters["name"] == event.parameters["text"][0]


async def test_leaving_a_world_removes_its_objects() -> None:
    with recorder_case() as case, case.episode() as episode:
        for _ in range(2):
            with BulletWorld():
                Object("milk", ObjectType.MILK)
    changes = [(type(e).__name__, e.object.object) for _, e in case.sink.of(episode) if isinstance(e, ObjectRemoved)]
    assert changes == [("ObjectRemoved", 3), ("ObjectRemoved", 5)]
    assert findings(case.sink.of(episode)) == []


async def test_an_implicit_episode_restores_the_context() -> None:
    with recorder_case() as outer, outer.episode() as episode, recorder_case() as inner:
        await NoteActionPerformable("inner").perform()
        assert current_episode.get() is episode
    assert len(inner.sink.sequences) == 1
