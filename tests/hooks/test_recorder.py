"""What a plan does in a Bullet world becomes events: in legal order, with the values of the moment."""

import asyncio
import math
from collections.abc import Awaitable, Iterator
from contextlib import contextmanager
from dataclasses import dataclass
from typing import Any

import pytest

from pycrorm_async.clock import SYSTEM_CLOCK
from pycrorm_async.config import Settings
from pycrorm_async.errors import EpisodeRefused, SpoolFull, Unrecordable
from pycrorm_async.events.codec import decode
from pycrorm_async.events.envelope import Heading
from pycrorm_async.events.happenings import (
    EpisodeEnded,
    EpisodeStarted,
    Happening,
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
from pycrorm_async.events.ids import EpisodeId
from pycrorm_async.events.order import OrderCheck
from pycrorm_async.hooks.emitter import Emitter
from pycrorm_async.hooks.episode import Episode
from pycrorm_async.hooks.recorder import Recorder, current_episode
from pycrorm_async.plan.actions import MoveTorsoActionPerformable, NavigateActionPerformable
from pycrorm_async.plan.designator import ActionAbstract
from pycrorm_async.plan.failures import PlanFailure
from pycrorm_async.plan.objects import ObjectDesignator, ObjectPart
from pycrorm_async.plan.ports import Candidate, recorder
from pycrorm_async.plan.process_modules import simulated_robot
from pycrorm_async.plan.task_tree import current_node
from pycrorm_async.world import Arms, BulletWorld, Object, ObjectType, Pose
from pycrorm_async.world.watch import watcher


class ListSink:
    """The queue's promise in a list: sequences without gaps, room or none."""

    def __init__(self) -> None:
        self.records: list[tuple[EpisodeId | None, int, Happening]] = []
        self.sequences: dict[EpisodeId, int] = {}
        self.full = False
        self.broken = False
        self.broken_starts = 0
        self.space = asyncio.Event()

    def put_nowait(self, heading: Heading, payload: bytes, *, reserved: bool = False) -> int:
        if heading.type == "NodeStarted" and self.broken_starts and b'"action"' in payload:
            self.broken_starts -= 1
            raise RuntimeError("the disk is on fire")
        if self.broken:
            raise RuntimeError("the disk is on fire")
        if self.full and not reserved:
            raise SpoolFull("full")
        sequence = 0
        if heading.episode is not None:
            sequence = self.sequences[heading.episode] = self.sequences.get(heading.episode, 0) + 1
        self.records.append((heading.episode, sequence, decode(heading.type, payload)))
        return sequence

    async def room(self) -> None:
        await self.space.wait()

    def block_until_room(self, timeout_s: float) -> bool:
        return True

    def of(self, episode: Episode | EpisodeId) -> list[tuple[int, Happening]]:
        name = episode.id if isinstance(episode, Episode) else episode
        return [(sequence, event) for owner, sequence, event in self.records if owner == name]

    def only(self) -> list[tuple[int, Happening]]:
        (name,) = self.sequences
        return self.of(name)


class Rig:
    def __init__(self, settings: Settings) -> None:
        self.sink = ListSink()
        self.emitter = Emitter(self.sink, settings)
        self.recorder = Recorder(self.emitter, clock=SYSTEM_CLOCK, software="test")

    @contextmanager
    def episode(self) -> Iterator[Episode]:
        episode = self.recorder.open_episode(description="d")
        token = current_episode.set(episode)
        try:
            yield episode
        except BaseException as failure:
            self.recorder.close_episode(episode, failure)
            raise
        else:
            self.recorder.close_episode(episode, None)
        finally:
            current_episode.reset(token)


@contextmanager
def rigged(settings: Settings | None = None) -> Iterator[Rig]:
    rig = Rig(settings or Settings())
    tokens = recorder.set(rig.recorder), watcher.set(rig.recorder)
    try:
        yield rig
    finally:
        recorder.reset(tokens[0])
        watcher.reset(tokens[1])


def findings(events: list[tuple[int, Happening]]) -> list[Any]:
    check = OrderCheck()
    return [found for sequence, event in events for found in check.read(sequence, event)]


@dataclass
class NoteActionPerformable(ActionAbstract):
    text: str = ""
    weight: float = 0.0
    ran: bool = False

    async def perform(self) -> Any:
        self.ran = True
        return self.text


@dataclass
class CarryActionPerformable(ActionAbstract):
    what: ObjectDesignator
    part: ObjectPart | None = None

    async def perform(self) -> None:
        """Nothing."""


def kinds(events: list[tuple[int, Happening]]) -> list[str]:
    return [type(event).__name__ for _, event in events]


async def test_an_episode_is_framed_by_its_start_its_root_and_its_end() -> None:
    with rigged() as rig, rig.episode() as episode:
        await NoteActionPerformable("hello").perform()
    events = rig.sink.of(episode)
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
    with rigged() as rig:
        for _ in range(2):
            with rig.episode():
                await NoteActionPerformable().perform()
    declared = [index for index, (owner, _, _) in enumerate(rig.sink.records) if owner is None]
    assert len(declared) == 1
    first_node = next(
        index
        for index, (_, _, event) in enumerate(rig.sink.records)
        if isinstance(event, NodeStarted) and event.kind == "action"
    )
    assert declared[0] < first_node


async def test_the_robot_state_is_that_of_the_moment_a_node_starts() -> None:
    with rigged() as rig, rig.episode() as episode, BulletWorld(), simulated_robot:
        Object("pr2", ObjectType.ROBOT)
        await MoveTorsoActionPerformable(0.25).perform()
        await NavigateActionPerformable(Pose([0.6, 0.4, 0.0])).perform()
        await NoteActionPerformable().perform()
    starts = [event for _, event in rig.sink.of(episode) if isinstance(event, NodeStarted) and event.kind == "action"]
    robots = [start.robot for start in starts]
    assert [robot.torso_height for robot in robots if robot] == [0.0, 0.25, 0.25]
    assert [robot.pose.position for robot in robots if robot] == [(0, 0, 0), (0, 0, 0), (0.6, 0.4, 0.0)]
    assert [robot.object_type for robot in robots if robot] == ["ROBOT"] * 3


async def test_an_object_parameter_names_the_row_in_force() -> None:
    with rigged() as rig, rig.episode() as episode, BulletWorld():
        milk = Object("milk", ObjectType.MILK, pose=Pose([1.3, 1.0, 0.9]))
        await CarryActionPerformable(ObjectDesignator("milk", ObjectType.MILK, milk)).perform()
        milk.set_pose(Pose([5.0, 5.0, 0.0]))
        await CarryActionPerformable(milk).perform()  # type: ignore[arg-type]  # a world object serves as well
        milk.set_pose(Pose([6.0, 6.0, 0.0]))
    events = rig.sink.of(episode)
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
    with rigged() as rig, rig.episode() as episode, BulletWorld():
        kitchen = Object("kitchen", ObjectType.ENVIRONMENT)
        part = ObjectPart("kitchen_island_surface", kitchen)
        await CarryActionPerformable(ObjectDesignator("kitchen", ObjectType.ENVIRONMENT, kitchen), part).perform()
        where = kitchen.link_pose("kitchen_island_surface")
    value = next(
        event.parameters["part"]
        for _, event in rig.sink.of(episode)
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

    with rigged() as rig, rig.episode() as episode, BulletWorld():
        robot = Object("pr2", ObjectType.ROBOT)
        milk = Object("milk", ObjectType.MILK, pose=Pose([0.5, 0.0, 0.9]))
        await HoldActionPerformable().perform()
        robot.set_joint_position("torso_lift_joint", 0.1)
    events = rig.sink.of(episode)
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


async def test_a_world_entered_before_belongs_to_each_episode_while_it_is_open() -> None:
    with rigged() as rig, BulletWorld():
        robot = Object("pr2", ObjectType.ROBOT)
        milk = Object("milk", ObjectType.MILK, pose=Pose([0.5, 0.0, 0.9]))
        robot.attach(milk, "l_gripper_tool_frame")
        with rig.episode() as first:
            milk.set_pose(Pose([0.6, 0.0, 0.9]))
        milk.set_pose(Pose([0.7, 0.0, 0.9]))
        with rig.episode() as second:
            pass
    added = [
        [(e.name, e.pose.position) for _, e in rig.sink.of(each) if isinstance(e, ObjectAdded)]
        for each in (first, second)
    ]
    assert added == [
        [("pr2", (0.0, 0.0, 0.0)), ("milk", (0.5, 0.0, 0.9))],
        [("pr2", (0.0, 0.0, 0.0)), ("milk", (0.7, 0.0, 0.9))],
    ]
    assert kinds(rig.sink.of(first)).count("ObjectMoved") == 1
    assert kinds(rig.sink.of(second)).count("ObjectMoved") == 0
    assert kinds(rig.sink.of(second)).count("ObjectAttached") == 1


async def test_two_worlds_at_once_in_one_episode_are_refused() -> None:
    with rigged() as rig, rig.episode() as episode, BulletWorld():
        with pytest.raises(EpisodeRefused, match="has a world already"), BulletWorld():
            pass
        Object("milk", ObjectType.MILK)
    assert kinds(rig.sink.of(episode)).count("ObjectAdded") == 1


async def test_worlds_one_after_the_other_belong_to_the_same_episode() -> None:
    with rigged() as rig, rig.episode() as episode:
        for name in ("one", "two"):
            with BulletWorld():
                Object(name, ObjectType.MILK)
    assert [e.name for _, e in rig.sink.of(episode) if isinstance(e, ObjectAdded)] == ["one", "two"]
    assert findings(rig.sink.of(episode)) == []


async def test_a_second_episode_in_the_same_task_is_refused_and_in_a_child_task_is_its_own() -> None:
    async def child() -> Episode:
        with rig.episode() as own:
            await NoteActionPerformable("child").perform()
        return own

    with rigged() as rig, rig.episode() as outer:
        with pytest.raises(EpisodeRefused, match="is open in this task already"), rig.episode():
            pass
        inner = await asyncio.create_task(child())
        await NoteActionPerformable("parent").perform()
    for episode, text in ((outer, "parent"), (inner, "child")):
        events = rig.sink.of(episode)
        assert findings(events) == []
        notes = [e for _, e in events if isinstance(e, NodeStarted) and e.kind == "action"]
        assert [(note.parameters["text"], note.parent) for note in notes] == [(text, 2)]


async def test_a_perform_outside_any_episode_opens_one_of_its_own() -> None:
    with rigged() as rig:
        await NoteActionPerformable("a").perform()
        await NoteActionPerformable("b").perform()
    assert len(rig.sink.sequences) == 2
    for name in rig.sink.sequences:
        events = rig.sink.of(name)
        assert findings(events) == []
        assert isinstance(events[0][1], EpisodeStarted)
        assert events[0][1].description == "NoteAction"
        assert events[-1][1] == EpisodeEnded("SUCCEEDED")


async def test_a_parameter_that_cannot_be_recorded_is_refused_before_perform_runs() -> None:
    with rigged() as rig, rig.episode() as episode:
        note = NoteActionPerformable("x", weight=math.nan)
        with pytest.raises(Unrecordable, match=r"^NoteAction\.weight cannot be recorded: nan is not a finite number$"):
            await note.perform()
        assert not note.ran
        assert current_node.get() is None
        await NoteActionPerformable("y").perform()
    assert kinds(rig.sink.of(episode)).count("NodeStarted") == 2
    assert findings(rig.sink.of(episode)) == []


async def test_nan_in_a_pose_names_the_designator_and_the_field() -> None:
    refusal = r"^NavigateAction\.target_location cannot be recorded: the pose holds"
    with rigged() as rig, rig.episode(), pytest.raises(Unrecordable, match=refusal):
        await NavigateActionPerformable(Pose([math.nan, 0, 0])).perform()
    assert rig.emitter.faults.total == 0


async def test_a_parameter_that_cannot_be_recorded_is_recorded_as_missing_if_so_chosen() -> None:
    with rigged(Settings(on_unrecordable="record_missing")) as rig, rig.episode() as episode:
        note = NoteActionPerformable("x", weight=math.nan)
        await note.perform()
        assert note.ran
    start = next(e for _, e in rig.sink.of(episode) if isinstance(e, NodeStarted) and e.kind == "action")
    assert start.parameters["weight"] == {"missing": "nan is not a finite number", "repr": "nan"}


async def test_a_start_that_is_too_large_is_refused_with_the_limit() -> None:
    small = Settings(record_bytes_max=2_000)
    with rigged(small) as rig, rig.episode(), pytest.raises(Unrecordable, match=r"2,000 are allowed"):
        await NoteActionPerformable("x" * 3_000).perform()


async def test_a_result_that_is_too_large_is_recorded_as_missing() -> None:
    @dataclass
    class LongActionPerformable(ActionAbstract):
        async def perform(self) -> str:
            return "x" * 3_000

    with rigged(Settings(record_bytes_max=2_000)) as rig, rig.episode() as episode:
        assert len(await LongActionPerformable().perform()) == 3_000
    end = next(e for _, e in rig.sink.of(episode) if isinstance(e, NodeEnded))
    assert end.status == "SUCCEEDED"
    assert "2,000 are allowed" in end.result["missing"]


@pytest.mark.parametrize(
    ("raised", "node_status", "episode_status"),
    [
        (PlanFailure("spilled", 3), "FAILED", "FAILED"),
        (ValueError("spilled", 3), "ERROR", "ERROR"),
        (asyncio.CancelledError("spilled", 3), "CANCELLED", "INTERRUPTED"),
        (KeyboardInterrupt("spilled", 3), "ERROR", "INTERRUPTED"),
    ],
)
def test_a_failure_keeps_class_message_and_arguments(
    raised: BaseException, node_status: str, episode_status: str
) -> None:
    @dataclass
    class FailActionPerformable(ActionAbstract):
        async def perform(self) -> None:
            raise raised

    async def plan(rig: Rig) -> None:
        with rig.episode():
            await FailActionPerformable().perform()

    with rigged() as rig:
        loop = asyncio.new_event_loop()
        try:
            with pytest.raises(type(raised)):
                loop.run_until_complete(plan(rig))
        finally:
            loop.close()
    events = rig.sink.only()
    assert findings(events) == []
    end = events[-3][1]
    assert isinstance(end, NodeEnded)
    assert end.failure is not None
    kind = type(raised)
    assert (end.status, end.failure.type) == (node_status, f"{kind.__module__}.{kind.__qualname__}")
    assert end.failure.message == str(raised)
    assert "spilled" in end.failure.message
    assert end.failure.arguments == ["spilled", 3]
    assert isinstance(events[-1][1], EpisodeEnded)
    assert events[-1][1].status == episode_status


async def test_a_fault_of_the_memory_never_reaches_the_plan_and_is_counted() -> None:
    with rigged() as rig, rig.episode(), BulletWorld():
        rig.sink.broken = True
        Object("milk", ObjectType.MILK)
        note = NoteActionPerformable("x")
        assert await note.perform() == "x"
        assert note.ran
        assert rig.emitter.faults.total == 2
        assert rig.emitter.faults.last == "NodeStarted: RuntimeError: the disk is on fire"
        rig.sink.broken = False


async def test_a_full_spool_fails_the_start_if_so_chosen_and_keeps_the_ends() -> None:
    @dataclass
    class FillActionPerformable(ActionAbstract):
        async def perform(self) -> None:
            rig.sink.full = True
            with pytest.raises(SpoolFull, match="on_full is 'fail'"):
                await NoteActionPerformable("x").perform()

    with rigged(Settings(on_full="fail")) as rig, rig.episode() as episode:
        await FillActionPerformable().perform()
    assert findings(rig.sink.of(episode)) == []
    assert rig.sink.of(episode)[-1][1] == EpisodeEnded("SUCCEEDED")


async def test_a_full_spool_makes_the_start_wait_by_default() -> None:
    with rigged() as rig, rig.episode() as episode:
        rig.sink.full = True
        note = NoteActionPerformable("x")
        task: Awaitable[Any] = asyncio.create_task(note.perform())
        await asyncio.sleep(0)
        await asyncio.sleep(0)
        assert not note.ran
        rig.sink.full = False
        rig.sink.space.set()
        await task
        assert note.ran
    assert findings(rig.sink.of(episode)) == []


async def test_nodes_that_outlive_their_episode_are_lost_to_it() -> None:
    begun, leave = asyncio.Event(), asyncio.Event()

    @dataclass
    class WaitActionPerformable(ActionAbstract):
        async def perform(self) -> None:
            begun.set()
            await leave.wait()
            await NoteActionPerformable("after").perform()

    with rigged() as rig:
        with rig.episode() as episode:
            task = asyncio.create_task(WaitActionPerformable().perform())
            await begun.wait()
        leave.set()
        await task
    events = rig.sink.of(episode)
    assert findings(events) == []
    assert events[-3][1] == NodeEnded(3, "LOST")
    assert len(rig.sink.sequences) == 2  # what was performed afterwards has an episode of its own


async def test_a_resolved_location_is_remembered_with_its_node() -> None:
    with rigged() as rig, rig.episode() as episode:
        pose = Pose([1.0, 2.0, 0.0], time_ns=5)
        rig.recorder.location_resolved(
            location="CostmapLocation", offered=(Candidate(pose, (Arms.LEFT,)),), taken=0, considered=7, node=None
        )
    event = next(e for _, e in rig.sink.of(episode) if isinstance(e, LocationResolved))
    assert event.offered[0].pose == PoseValue((1.0, 2.0, 0.0), (0.0, 0.0, 0.0, 1.0), "map", 5)
    assert (event.offered[0].arms, event.taken, event.considered, event.node) == (("LEFT",), 0, 7, None)


async def test_three_plans_in_three_tasks_never_share_a_parent() -> None:
    @dataclass
    class OuterActionPerformable(ActionAbstract):
        name: str

        async def perform(self) -> None:
            for index in range(5):
                await asyncio.sleep(0)
                await NoteActionPerformable(f"{self.name}{index}").perform()

    with rigged() as rig, rig.episode() as episode:
        await asyncio.gather(*(OuterActionPerformable(name).perform() for name in "abc"))
    events = rig.sink.of(episode)
    assert findings(events) == []
    starts = {sequence: event for sequence, event in events if isinstance(event, NodeStarted)}
    for event in starts.values():
        if "text" in event.parameters:
            assert event.parent is not None
            assert starts[event.parent].parameters["name"] == event.parameters["text"][0]


async def test_a_parameter_whose_reading_raises_is_refused_before_perform_runs() -> None:
    class Heavy:
        def __float__(self) -> float:
            raise RuntimeError("too heavy")

    with rigged() as rig, rig.episode() as episode:
        note = NoteActionPerformable("x", weight=Heavy())  # type: ignore[arg-type]
        with pytest.raises(Unrecordable, match=r"NoteAction\.weight .* reading it raised RuntimeError: too heavy"):
            await note.perform()
        assert not note.ran
    assert kinds(rig.sink.of(episode)).count("NodeStarted") == 1


async def test_a_start_that_fails_by_our_fault_leaves_no_episode_open() -> None:
    with rigged() as rig:
        await NoteActionPerformable("first").perform()
        rig.sink.broken_starts = 1
        await NoteActionPerformable("second").perform()
        await NoteActionPerformable("third").perform()
        assert rig.emitter.faults.total == 1
        assert rig.recorder.open_episodes == ()
    for name in rig.sink.sequences:
        assert findings(rig.sink.of(name)) == []


async def test_a_world_that_is_left_takes_its_objects_with_it() -> None:
    with rigged() as rig, rig.episode() as episode:
        for _ in range(2):
            with BulletWorld():
                Object("milk", ObjectType.MILK)
    changes = [(type(e).__name__, e.object.object) for _, e in rig.sink.of(episode) if isinstance(e, ObjectRemoved)]
    assert changes == [("ObjectRemoved", 3), ("ObjectRemoved", 5)]
    assert findings(rig.sink.of(episode)) == []


async def test_an_implicit_episode_gives_the_context_back_as_it_was() -> None:
    with rigged() as outer, outer.episode() as episode, rigged() as inner:
        await NoteActionPerformable("inner").perform()
        assert current_episode.get() is episode
    assert len(inner.sink.sequences) == 1
