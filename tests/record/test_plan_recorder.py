"""A plan in a Bullet world becomes events, in legal order, also when the queue or the recorder has faults."""

from __future__ import annotations

import asyncio
import math
from collections.abc import Awaitable
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import pytest

from pycrorm_async.errors import EpisodeRefused, SpoolFull, Unrecordable
from pycrorm_async.events.types import (
    CellsValue,
    DescriptionDeclared,
    EpisodeEnded,
    EpisodeStarted,
    LocationResolved,
    NodeEnded,
    NodeStarted,
    ObjectAdded,
    PoseValue,
)
from pycrorm_async.plan.actions import MoveTorsoActionPerformable, NavigateActionPerformable
from pycrorm_async.plan.execution import Candidate, Cells, Refusal, Search
from pycrorm_async.plan.language import ActionAbstract
from pycrorm_async.plan.motions import simulated_robot
from pycrorm_async.plan.task import current_node
from pycrorm_async.record.plan_recorder import Episode, current_episode
from pycrorm_async.settings import Settings
from pycrorm_async.world import Arms, BulletWorld, Object, ObjectType, Pose
from pycrorm_async.world.models import box_urdf
from tests.record.fakes import (
    NoteActionPerformable,
    RecorderCase,
    findings,
    kinds,
    recorder_case,
)

# === plan recorder ============================================================================================
#
# A plan in a Bullet world becomes events: in legal order, with the values at that moment.


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
    assert [robot.pose for robot in robots if robot] == [None] * 3  # the row of the robot's object has it
    poses = [case.sink.robot_pose(episode, start) for start in starts]
    assert [pose.position for pose in poses] == [(0, 0, 0), (0, 0, 0), (0.6, 0.4, 0.0)]
    assert [robot.object_type for robot in robots if robot] == ["ROBOT"] * 3


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
        refused = [Refusal(pose, "LEFT: too far"), Refusal(pose, "hidden\0")]
        offered, cells = [Candidate(pose, (Arms.LEFT,))], Cells(occupied=3, hidden=2, free=9)
        case.recorder.location_resolved(Search("CostmapLocation", None, offered, 0, 7, refused, cells=cells))
    event = next(e for _, e in case.sink.of(episode) if isinstance(e, LocationResolved))
    assert event.offered[0].pose == PoseValue((1.0, 2.0, 0.0), (0.0, 0.0, 0.0, 1.0), "map", 5)
    assert (event.offered[0].arms, event.taken, event.considered, event.node) == (("LEFT",), 0, 7, None)
    assert [each.reason for each in event.refused] == ["LEFT: too far", "hidden\\x00"]
    assert {each.pose for each in event.refused} == {event.offered[0].pose}
    assert event.cells == CellsValue(3, 2, 9)


async def test_an_implicit_episode_restores_the_context() -> None:
    with recorder_case() as outer, outer.episode() as episode, recorder_case() as inner:
        await NoteActionPerformable("inner").perform()
        assert current_episode.get() is episode
    assert len(inner.sink.sequences) == 1


# === descriptions =============================================================================================
#
# The hooks declare each description once, before the first object made from it, and never raise into the plan.


def declared(case: RecorderCase) -> list[DescriptionDeclared]:
    return [event for _, _, event in case.sink.records if isinstance(event, DescriptionDeclared)]


def added(case: RecorderCase) -> list[ObjectAdded]:
    return [event for _, _, event in case.sink.records if isinstance(event, ObjectAdded)]


def box(number: int) -> str:
    return box_urdf(f"box {number}", x=(0, 0.1), y=(0, 0.1), z=(0, 0.1))


async def test_a_description_is_declared_once_by_a_memory_before_the_first_object() -> None:
    with recorder_case() as case:
        for _ in range(2):
            with case.episode(), BulletWorld():
                for number in range(3):
                    Object(f"box {number}", ObjectType.GENERIC_OBJECT, box(7))
                Object("other", ObjectType.GENERIC_OBJECT, box(8))
    assert [each.text for each in declared(case)] == [box(7), box(8)]
    names = [each.description for each in added(case)]
    assert names == [names[0], names[0], names[0], names[3]] * 2
    types = [type(event) for _, _, event in case.sink.records]
    assert types.index(DescriptionDeclared) + 1 == types.index(ObjectAdded)


@pytest.mark.slow
async def test_a_description_is_put_again_when_many_others_were_put_since() -> None:
    with recorder_case(Settings(segment_bytes=2**20)) as case, case.episode(), BulletWorld():
        Object("first", ObjectType.GENERIC_OBJECT, box(0))
        Object("again", ObjectType.GENERIC_OBJECT, box(0))
        assert len(declared(case)) == 1
        rest = 2**20 // 16 // 200
        for number in range(1, rest):
            Object(f"box {number}", ObjectType.GENERIC_OBJECT, box(number))
        Object("late", ObjectType.GENERIC_OBJECT, box(0))
    texts = [each.text for each in declared(case)]
    assert texts.count(box(0)) == 2
    assert texts[-1] == box(0)
    assert len(texts) == rest + 1


@pytest.mark.parametrize("full", [False, True])
async def test_a_mesh_becomes_a_blob_unless_the_spool_is_full(tmp_path: Path, full: bool) -> None:
    mesh = tmp_path / "wedge.OBJ"
    mesh.write_text("v 0 0 0\nv 1 0 0\nv 0 2 0\nv 0 0 3\nf 1 3 2\nf 1 2 4\nf 2 3 4\nf 1 4 3\n")
    shape = f'<geometry><mesh filename="{mesh}"/></geometry>'
    text = f'<robot name="w">\n<link name="w"><visual>{shape}</visual><collision>{shape}</collision></link></robot>'
    with recorder_case(Settings(record_meshes="files")) as case, case.episode(), BulletWorld():
        case.sink.full = full
        Object("wedge", ObjectType.GENERIC_OBJECT, text)
        Object("wedge 2", ObjectType.GENERIC_OBJECT, text)
    (event,) = declared(case)
    (stored_mesh,) = event.meshes
    size = mesh.stat().st_size
    assert (stored_mesh.name, stored_mesh.size) == ("wedge.OBJ", size)
    assert event.boxes["w"].max == pytest.approx((1, 2, 3), abs=1e-6)
    assert str(tmp_path) not in event.text
    if full:
        assert (stored_mesh.content, stored_mesh.missing, case.sink.blobs) == (None, "full", {})
        assert case.emitter.missing.count == (1, "DescriptionDeclared.meshes: wedge.OBJ: full")
    else:
        assert stored_mesh.content is not None
        assert (stored_mesh.content.hash, stored_mesh.content.media_type) == (stored_mesh.sha256, "model/obj")
        assert case.sink.blobs == {stored_mesh.sha256: mesh.read_bytes()}
        assert case.sink.released == []  # a declaration is repeated for the life of the queue
        assert case.emitter.missing.count.total == 0


# === recorder faults ==========================================================================================
#
# Faults around a recorder: refusals, full spools, failures; no event is lost or out of order.

STRICT = Settings(on_unrecordable="refuse")


async def test_a_second_episode_in_the_same_task_is_refused_and_in_a_child_task_is_its_own() -> None:
    async def child() -> Episode:
        with case.episode() as own:
            await NoteActionPerformable("child").perform()
        return own

    with recorder_case() as case, case.episode() as outer:
        with pytest.raises(EpisodeRefused, match="is open in this task already"), case.episode():
            pass
        inner = await asyncio.create_task(child())
        await NoteActionPerformable("parent").perform()
    for episode, text in ((outer, "parent"), (inner, "child")):
        events = case.sink.of(episode)
        assert findings(events) == []
        notes = [e for _, e in events if isinstance(e, NodeStarted) and e.kind == "action"]
        assert [(note.parameters["text"], note.parent) for note in notes] == [(text, 2)]


async def test_a_parameter_that_cannot_be_recorded_is_refused_before_perform_runs() -> None:
    with recorder_case(STRICT) as case, case.episode() as episode:
        note = NoteActionPerformable("x", weight=math.nan)
        with pytest.raises(Unrecordable, match=r"^NoteAction\.weight cannot be recorded: nan is not a finite number$"):
            await note.perform()
        assert not note.ran
        assert current_node.get() is None
        await NoteActionPerformable("y").perform()
    assert kinds(case.sink.of(episode)).count("NodeStarted") == 2
    assert findings(case.sink.of(episode)) == []


async def test_a_start_that_is_too_large_is_refused_with_the_limit() -> None:
    small = Settings(record_bytes_max=2_000, on_unrecordable="refuse")
    with recorder_case(small) as case, case.episode(), pytest.raises(Unrecordable, match=r"2,000 are allowed"):
        await NoteActionPerformable("x" * 3_000).perform()


async def test_a_result_that_is_too_large_is_recorded_as_missing() -> None:
    @dataclass
    class LongActionPerformable(ActionAbstract):
        async def perform(self) -> str:
            return "x" * 3_000

    with recorder_case(Settings(record_bytes_max=2_000)) as case, case.episode() as episode:
        assert len(await LongActionPerformable().perform()) == 3_000
    end = next(e for _, e in case.sink.of(episode) if isinstance(e, NodeEnded))
    assert end.status == "SUCCEEDED"
    assert "2,000 are allowed" in end.result["missing"]


async def test_a_fault_of_the_memory_never_reaches_the_plan_and_is_counted() -> None:
    @dataclass
    class BreakActionPerformable(ActionAbstract):
        async def perform(self) -> str:
            case.sink.broken = True
            return "done"

    with recorder_case() as case, case.episode(), BulletWorld():
        assert await BreakActionPerformable().perform() == "done"
        assert case.emitter.faults.last == "NodeEnded: RuntimeError: the disk is on fire"
        Object("milk", ObjectType.MILK)
        note = NoteActionPerformable("x")
        assert await note.perform() == "x"
        assert note.ran
        assert case.emitter.faults.total == 3
        assert case.emitter.faults.last == "NodeStarted: RuntimeError: the disk is on fire"
        case.sink.broken = False


async def test_a_full_spool_refuses_the_start_on_request_and_keeps_the_ends() -> None:
    @dataclass
    class FillActionPerformable(ActionAbstract):
        async def perform(self) -> None:
            case.sink.full = True
            with pytest.raises(SpoolFull, match="on_full is 'fail'"):
                await NoteActionPerformable("x").perform()

    with recorder_case(Settings(on_full="fail")) as case, case.episode() as episode:
        await FillActionPerformable().perform()
    assert findings(case.sink.of(episode)) == []
    assert case.sink.of(episode)[-1][1] == EpisodeEnded("SUCCEEDED")


async def test_a_full_spool_makes_the_start_wait_by_default() -> None:
    with recorder_case() as case, case.episode() as episode:
        case.sink.full = True
        note = NoteActionPerformable("x")
        task: Awaitable[Any] = asyncio.create_task(note.perform())
        await asyncio.sleep(0)
        await asyncio.sleep(0)
        assert not note.ran
        case.sink.full = False
        case.sink.space.set()
        await task
        assert note.ran
    assert findings(case.sink.of(episode)) == []


async def test_a_start_that_fails_by_a_fault_of_the_recorder_leaves_no_episode_open() -> None:
    with recorder_case() as case:
        await NoteActionPerformable("first").perform()
        case.sink.broken_starts = 1
        await NoteActionPerformable("second").perform()
        await NoteActionPerformable("third").perform()
        assert case.emitter.faults.total == 1
        assert case.recorder.episodes.all == ()
    for name in case.sink.sequences:
        assert findings(case.sink.of(name)) == []
