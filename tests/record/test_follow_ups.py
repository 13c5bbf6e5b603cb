"""An episode that comes near its last sequence is continued in a follow-up episode, without effect on the plan."""

from __future__ import annotations

import asyncio
import contextvars
import math
import threading
from collections import Counter
from collections.abc import Callable, Coroutine
from dataclasses import dataclass
from itertools import pairwise
from pathlib import Path
from typing import Any

import pytest
from sqlalchemy import func, select

from pycrorm_async import Memory, Reading
from pycrorm_async.errors import CallerError
from pycrorm_async.events.ids import SEQUENCE_MAX, EpisodeId, episode_text
from pycrorm_async.events.types import (
    EpisodeEnded,
    EpisodeStarted,
    Happening,
    NodeEnded,
    NodeReference,
    NodeStarted,
    ObjectAdded,
    ObjectAttached,
    ObjectMoved,
    ObjectReference,
    ObjectRemoved,
    StateSampled,
)
from pycrorm_async.operations.copy import copy_episodes
from pycrorm_async.operations.rebuild import rebuild_memory
from pycrorm_async.orm import Action, ProcessMetaData, TaskTreeNode
from pycrorm_async.plan import ChosenRobot, MoveMotion, SimulatedTaskTree
from pycrorm_async.plan.actions import MoveTorsoActionPerformable, NavigateActionPerformable
from pycrorm_async.plan.language import ActionAbstract
from pycrorm_async.plan.motions import simulated_robot
from pycrorm_async.plan.objects import ObjectDesignator, require_robot
from pycrorm_async.projections.verify import verify
from pycrorm_async.record.plan_recorder import current_episode
from pycrorm_async.settings import Settings
from pycrorm_async.store.address import DatabaseAddress
from pycrorm_async.store.log import EventLog
from pycrorm_async.task_status import TaskStatus
from pycrorm_async.world import BulletWorld, Object, ObjectType, Pose
from tests.commands import answer, pycrorm
from tests.memory.note_actions import NoteActionPerformable as RememberedNoteAction
from tests.record.fakes import (
    CarryActionPerformable,
    ListSink,
    NoteActionPerformable,
    RecorderCase,
    findings,
    recorder_case,
)
from tests.table_comparison import differences, tables_of

pytestmark = pytest.mark.slow


MAX = 100
SMALL = Settings(episode_events_max=MAX)


@dataclass
class ShiftActionPerformable(ActionAbstract):
    """Take this many notes and return the number."""

    notes: int
    of: str = "day"

    async def perform(self) -> int:
        for number in range(self.notes):
            await NoteActionPerformable(f"{self.of} {number}").perform()
        return self.notes


@dataclass
class SpoilingActionPerformable(ActionAbstract):
    """Change its own parameter to an unrecordable value, and continue for more than an episode."""

    weight: float

    async def perform(self) -> None:
        self.weight = math.nan
        await ShiftActionPerformable(60).perform()


class LeavingActionPerformable(ActionAbstract):
    """Leave a task behind, which continues in its context."""

    def __init__(self, work: Callable[[], Coroutine[Any, Any, None]]) -> None:
        self.work = work
        self.task: asyncio.Task[None] | None = None

    async def perform(self) -> None:
        self.task = asyncio.create_task(self.work())


def parts_of(sink: ListSink) -> list[list[tuple[int, Happening]]]:
    """Return the events of each episode, in the order of their starts."""
    return [sink.of(each) for each in sink.sequences]


def only(events: list[tuple[int, Happening]], kind: type[Happening]) -> list[tuple[int, Happening]]:
    return [(sequence, event) for sequence, event in events if isinstance(event, kind)]


def assert_no_faults(case: RecorderCase) -> bool:
    assert case.emitter.faults.total == 0, case.emitter.faults.last
    for events in parts_of(case.sink):
        assert findings(events) == []
        assert [sequence for sequence, _ in events] == list(range(1, len(events) + 1))
        assert isinstance(events[0][1], EpisodeStarted)
        assert isinstance(events[-1][1], EpisodeEnded)
        assert len(events) <= MAX
    return True


async def test_each_part_names_the_next_and_every_perform_has_one_row_with_its_outcome() -> None:
    with recorder_case(SMALL) as case:
        with case.episode() as episode:
            assert await ShiftActionPerformable(200).perform() == 200
            last = episode.id
        names: list[EpisodeId] = list(case.sink.sequences)
        assert names[-1] == last
        assert len(names) == 1 + case.recorder.episodes.continued_count > 4
        assert case.recorder.episodes.recent == tuple(map(episode_text, names))
        assert case.recorder.episodes.all == ()
    assert assert_no_faults(case)

    parts = parts_of(case.sink)
    starts = [events[0][1] for events in parts]
    ends = [events[-1][1] for events in parts]
    assert all(isinstance(each, EpisodeStarted) and each.description == "d" for each in starts)
    assert [getattr(each, "continues", 0) for each in starts] == [None, *map(episode_text, names[:-1])]
    assert [getattr(each, "continued_in", 0) for each in ends] == [*map(episode_text, names[1:]), None]
    assert [getattr(each, "status", 0) for each in ends] == ["INTERRUPTED"] * (len(parts) - 1) + ["SUCCEEDED"]

    performed: Counter[str] = Counter()
    for events in parts:
        nodes = dict(only(events, NodeStarted))
        for _, end in only(events, NodeEnded):
            assert isinstance(end, NodeEnded)
            node = nodes[end.node]
            assert isinstance(node, NodeStarted)
            if end.failure is not None:
                assert (end.status, end.failure.type) == ("INTERRUPTED", "EpisodeContinued")
            else:
                assert end.status == "SUCCEEDED"
                performed[str(node.parameters.get("text", node.parameters.get("notes", "root")))] += 1
    assert performed == Counter(["root", "200", *(f"day {number}" for number in range(200))])


async def test_an_open_node_is_started_again_under_its_parent_and_names_the_sequence_it_continues() -> None:
    with recorder_case(SMALL) as case, case.episode():
        await ShiftActionPerformable(60).perform()
    assert assert_no_faults(case)
    first, second = parts_of(case.sink)
    # The 88th event starts a note. Open nodes are cut, innermost first, and start again, outermost first.
    why = f"the episode continues in episode {episode_text(list(case.sink.sequences)[1])}"
    assert [sequence for sequence, _ in first][-5:] == [88, 89, 90, 91, 92]
    assert [event.node for _, event in first[-4:] if isinstance(event, NodeEnded)] == [88, 3, 2]
    assert {event.failure.message for _, event in first[-4:] if isinstance(event, NodeEnded) and event.failure} == {why}
    again = [event for _, event in only(second, NodeStarted)[:4] if isinstance(event, NodeStarted)]
    assert [(each.kind, each.parent, each.continues) for each in again] == [
        ("root", None, 2), ("action", 2, 3), ("action", 3, 88), ("action", 3, None),
    ]  # fmt: skip
    assert [each.parameters.get("text") for each in again] == [None, None, "day 42", "day 43"]
    assert next((event.node, event.status) for _, event in second if isinstance(event, NodeEnded)) == (4, "SUCCEEDED")


async def test_the_world_is_announced_again_in_its_state_and_later_events_name_its_new_rows() -> None:
    with recorder_case(SMALL) as case, case.episode(), BulletWorld(), simulated_robot:
        robot = Object("pr2", ObjectType.ROBOT)
        milk = Object("milk", ObjectType.MILK, pose=Pose([1, 0, 1]))
        bowl = Object("bowl", ObjectType.BOWL, pose=Pose([2, 0, 1]))
        robot.attach(milk)
        while len(case.sink.sequences) == 1:
            bowl.set_pose(Pose([2, bowl.pose.position.y + 0.01, 1]))  # of no node: the world itself announces it
        bowl_position = bowl.pose.position
        bowl.set_pose(Pose([3, 3, 1]))
        await CarryActionPerformable(ObjectDesignator("bowl", ObjectType.BOWL, bowl)).perform()
        milk.remove()
    assert assert_no_faults(case)
    _, second = parts_of(case.sink)
    assert [(event.name, event.pose.position) for _, event in second[2:5] if isinstance(event, ObjectAdded)] == [
        ("pr2", (0, 0, 0)), ("milk", (1, 0, 1)), ("bowl", tuple(bowl_position)),
    ]  # fmt: skip
    assert second[5][1] == ObjectAttached(ObjectReference(3, 3), ObjectReference(4, 4))
    (moved,) = only(second, ObjectMoved)
    assert isinstance(moved[1], ObjectMoved)
    assert (moved[1].object, moved[1].pose.position) == (5, (3, 3, 1))
    (carried,) = [event for _, event in only(second, NodeStarted) if getattr(event, "kind", "") == "action"]
    assert isinstance(carried, NodeStarted)
    assert carried.parameters["what"] == {"object": 5, "row": moved[0]}
    assert carried.robot is not None
    assert carried.robot.object == ObjectReference(3, 3)
    removed = [event.object for _, event in only(second, ObjectRemoved) if isinstance(event, ObjectRemoved)]
    assert sorted(each.object for each in removed) == [3, 4, 5]


async def test_the_first_sample_after_it_holds_all_channels() -> None:
    settings = Settings(episode_events_max=MAX, sample_interval_ms=1_000_000)
    with recorder_case(settings) as case, case.episode(), BulletWorld(), simulated_robot:
        Object("pr2", ObjectType.ROBOT)
        height = 0.0
        while len(case.sink.sequences) == 1:
            height = 0.3 - height
            await MoveTorsoActionPerformable(height).perform()
        await MoveTorsoActionPerformable(0.1).perform()
    assert assert_no_faults(case)
    first, second = (
        [event.channels for _, event in only(part, StateSampled) if isinstance(event, StateSampled)]
        for part in parts_of(case.sink)
    )
    assert len(first[0]) > 20
    assert {tuple(each) for each in first[1:]} == {("torso_lift_joint",)}
    assert first[0].keys() == second[0].keys()
    assert second[-1] == {"torso_lift_joint": 0.1}


class Driving:
    """Move the base in small steps until the episode was continued, and once more."""

    def __init__(self, sink: ListSink) -> None:
        self._sink = sink

    async def navigate(self, motion: MoveMotion) -> None:
        body = require_robot().body
        while len(self._sink.sequences) == 1:
            body.set_pose(Pose([body.pose.position.x + 0.01, 0, 0]))
        body.set_pose(Pose([5, 0, 0]))

    async def move_tcp(self, motion: object) -> None: ...
    async def looking(self, motion: object) -> None: ...
    async def move_gripper(self, motion: object) -> None: ...
    async def move_arm_joints(self, motion: object) -> None: ...
    async def move_joints(self, motion: object) -> None: ...


async def test_a_motion_across_the_cut_is_sampled_further_with_all_channels() -> None:
    settings = Settings(episode_events_max=MAX, sample_interval_ms=1_000_000)
    with recorder_case(settings) as case, case.episode(), BulletWorld(), ChosenRobot("mine", Driving(case.sink)):
        Object("pr2", ObjectType.ROBOT)
        await NavigateActionPerformable(Pose([5, 0, 0])).perform()
    assert assert_no_faults(case)
    first, second = (only(part, StateSampled) for part in parts_of(case.sink))
    assert len(first) == len(second) == 1
    whole, rest = first[0][1], second[0][1]
    assert isinstance(whole, StateSampled)
    assert isinstance(rest, StateSampled)
    assert len(whole.channels) > 20
    assert rest.channels.keys() == whole.channels.keys()
    assert (whole.channels["base.x"], rest.channels["base.x"]) == (0.0, 5.0)
    assert rest.node in dict(only(parts_of(case.sink)[1], NodeStarted))


async def test_concurrent_plans_in_one_episode_are_continued_together() -> None:
    with recorder_case(SMALL) as case, case.episode() as episode:
        async with asyncio.TaskGroup() as tasks:
            for name in ("one", "two"):
                tasks.create_task(ShiftActionPerformable(60, name).perform())
        assert current_episode.get() is episode
    assert assert_no_faults(case)
    noted = Counter(
        event.parameters["text"]
        for part in parts_of(case.sink)
        for _, event in only(part, NodeStarted)
        if isinstance(event, NodeStarted) and "text" in event.parameters and event.continues is None
    )
    assert noted == Counter([f"{name} {number}" for name in ("one", "two") for number in range(60)])


async def test_a_parameter_that_became_unrecordable_is_missing_in_the_rest_of_its_node_and_refuses_nothing() -> None:
    with recorder_case(Settings(episode_events_max=MAX, on_unrecordable="refuse")) as case, case.episode():
        await SpoilingActionPerformable(0.5).perform()
    assert assert_no_faults(case)
    first, second = ([event for _, event in only(part, NodeStarted)] for part in parts_of(case.sink))
    assert getattr(first[1], "parameters", None) == {"weight": 0.5}
    assert getattr(second[1], "parameters", None) == {
        "weight": {"missing": "nan is not a finite number", "repr": "nan"}
    }


async def test_a_task_of_a_node_that_ended_in_the_former_part_belongs_to_the_root_of_the_follow_up() -> None:
    with recorder_case(SMALL) as case, case.episode(), BulletWorld():
        milk = Object("milk", ObjectType.MILK)
        waiting = asyncio.Event()

        async def late() -> None:
            await waiting.wait()
            await NoteActionPerformable("late").perform()
            milk.set_pose(Pose([1, 2, 3]))

        leaving = LeavingActionPerformable(late)
        await leaving.perform()
        assert leaving.task is not None
        await ShiftActionPerformable(60).perform()
        waiting.set()
        await leaving.task
    assert assert_no_faults(case)
    _, second = parts_of(case.sink)
    notes = [event for _, event in only(second, NodeStarted) if getattr(event, "parameters", {}).get("text") == "late"]
    assert [getattr(each, "parent", None) for each in notes] == [2]
    assert [getattr(event, "node", 0) for _, event in only(second, ObjectMoved)] == [None]


async def test_a_simulation_is_continued_as_a_simulation_of_the_same_node() -> None:
    with recorder_case(SMALL) as case, case.episode() as episode:
        with SimulatedTaskTree():
            await ShiftActionPerformable(60).perform()
        thinker = NodeReference(str(episode), 2)
    assert assert_no_faults(case)
    _, *simulated_episodes = [part[0][1] for part in parts_of(case.sink)]
    assert len(simulated_episodes) == 2
    for each in simulated_episodes:
        assert isinstance(each, EpisodeStarted)
        assert (each.simulated, each.thought_by) == (True, thinker)


async def test_a_world_with_more_objects_than_an_episode_has_events_is_not_continued_for_ever() -> None:
    with recorder_case(SMALL) as case, case.episode(), BulletWorld():
        for number in range(2 * MAX):
            Object(f"milk {number}", ObjectType.MILK)
        count = len(case.sink.sequences)
        for _ in range(2 * MAX):
            await NoteActionPerformable().perform()
        assert len(case.sink.sequences) < count + 3
    assert case.emitter.faults.total == 0


def test_the_limit_on_the_events_of_an_episode_is_checked() -> None:
    assert Settings().episode_events_max == SEQUENCE_MAX
    for wrong in (0, 99, SEQUENCE_MAX + 1, 150.5):
        with pytest.raises(CallerError, match="from 100 to 67,108,863"):
            Settings(episode_events_max=wrong)  # type: ignore[arg-type]


def outcomes(case: RecorderCase) -> Counter[str]:
    """Count the ends of each note with an outcome of its own, by text; every part is in legal order."""
    ended: Counter[str] = Counter()
    for events in parts_of(case.sink):
        assert [each for each in findings(events) if each.kind != "remark"] == []
        assert isinstance(events[-1][1], EpisodeEnded)
        nodes = dict(only(events, NodeStarted))
        for _, end in only(events, NodeEnded):
            assert isinstance(end, NodeEnded)
            if end.failure is None or end.failure.type != "EpisodeContinued":
                ended[f"{getattr(nodes[end.node], 'parameters', {}).get('text', 'other')} {end.status}"] += 1
    return ended


@pytest.mark.parametrize("put", range(1, 6))
async def test_a_follow_up_whose_event_cannot_be_written_is_retried_and_every_node_ends_once(put: int) -> None:
    """Fail one put of the follow-up: an end of note, shift or move, or that of the root or the episode."""
    with recorder_case(SMALL) as case, case.episode(), BulletWorld():
        milk = Object("milk", ObjectType.MILK)

        @dataclass
        class MovingActionPerformable(ActionAbstract):
            async def perform(self) -> None:
                case.sink.fails_at = MAX - MAX // 8 + put
                await ShiftActionPerformable(60).perform()
                milk.set_pose(Pose([1, 2, 3]))

        await MovingActionPerformable().perform()
    assert case.emitter.faults.total == 1
    assert case.recorder.episodes.continued_count == 1
    ended = {f"day {number} SUCCEEDED": 1 for number in range(60)} | {"other SUCCEEDED": 3}
    if put > 1:  # it ended before the second attempt, and its end names the episode that continues it
        del ended["day 41 SUCCEEDED"]
    assert outcomes(case) == Counter(ended)
    moves = [event for events in parts_of(case.sink) for _, event in only(events, ObjectMoved)]
    assert [getattr(each, "pose", None).position for each in moves] == [(1, 2, 3)]  # type: ignore[union-attr]


@pytest.mark.parametrize("continued", [True, False])
async def test_the_end_of_an_episode_waits_for_a_node_that_another_thread_is_ending(*, continued: bool) -> None:
    with recorder_case(SMALL) as case, case.episode():

        async def late() -> None:
            await NoteActionPerformable("late").perform()

        ending, go = threading.Event(), threading.Event()

        def pause() -> None:
            if threading.current_thread() is thread:
                ending.set()
                go.wait(5)

        case.sink.before_end = pause
        context = contextvars.copy_context()
        thread = threading.Thread(target=lambda: context.run(asyncio.run, late()))
        thread.start()
        await asyncio.to_thread(ending.wait, 5)
        timer = threading.Timer(0.1, go.set)
        timer.start()
        if continued:
            await ShiftActionPerformable(60).perform()
    thread.join()
    timer.join()
    assert case.emitter.faults.total == 0
    shifts = {f"day {number} SUCCEEDED": 1 for number in range(60)} | {"other SUCCEEDED": 2}
    assert outcomes(case) == Counter({"late SUCCEEDED": 1} | (shifts if continued else {"other SUCCEEDED": 1}))


# === follow ups ===============================================================================================
#
# A memory whose episodes were continued in follow-ups: queried, rebuilt, verified and copied.

THOUSAND_EVENTS = Settings(episode_events_max=1_000)
NOTES = 1_000


@dataclass
class PatrolActionPerformable(ActionAbstract):
    notes: int

    async def perform(self) -> None:
        for number in range(self.notes):
            await RememberedNoteAction(f"note {number}").perform()


async def recorded(url: str, spool: Path) -> list[str]:
    """Record a patrol of a thousand notes in a world with one object; return the ids of its episodes."""
    async with Memory.open(url, spool=spool, settings=THOUSAND_EVENTS) as memory:
        async with memory.episode(description="patrol", seed=7):
            with BulletWorld():
                Object("milk", ObjectType.MILK, pose=Pose([1, 2, 3]))
                await PatrolActionPerformable(NOTES).perform()
        await memory.flush()
        assert memory.status.faults.total == 0, memory.status.faults.last
        assert memory.status.episodes_continued == 2
        return list(memory.recent_episodes)


@pytest.mark.soak_on("postgresql")
async def test_every_perform_is_stored_once_with_its_outcome_and_the_parts_name_each_other(
    database_url: str, tmp_path: Path
) -> None:
    first, second, third = await recorded(database_url, tmp_path / "spool")
    async with Reading.open(database_url) as reading:
        parts = await reading.episodes()
        assert [(each.id, each.status, each.continues, each.continued_in) for each in parts] == [
            (first, "INTERRUPTED", None, second),
            (second, "INTERRUPTED", first, third),
            (third, "SUCCEEDED", second, None),
        ]  # fmt: skip
        assert [(each.description, each.failed) for each in parts] == [("patrol", 0)] * 3
        async with reading.session() as session:
            succeeded = select(Action).where(TaskTreeNode.id == Action.id, TaskTreeNode.status == TaskStatus.SUCCEEDED)
            actions = (await session.scalars(succeeded)).all()
            assert len(actions) == NOTES + 1
            cut = select(TaskTreeNode.dtype, func.count()).where(TaskTreeNode.reason == "EpisodeContinued")
            cut = cut.where(TaskTreeNode.status == TaskStatus.INTERRUPTED).group_by(TaskTreeNode.dtype)
            assert {tuple(row) for row in await session.execute(cut)} == {
                ("NoteAction", 2), ("PatrolAction", 2), (None, 2),
            }  # fmt: skip
            rows = (await session.scalars(select(ProcessMetaData).order_by(ProcessMetaData.id))).all()
            assert [(each.continues, each.continued_in, each.seed) for each in rows] == [
                (None, second, 7), (first, third, 7), (second, None, 7),
            ]  # fmt: skip
            spans = select(TaskTreeNode.start_ns, TaskTreeNode.end_ns).where(TaskTreeNode.dtype == "PatrolAction")
            times: list[tuple[Any, ...]] = [
                tuple(row) for row in await session.execute(spans.order_by(TaskTreeNode.id))
            ]
        assert len(times) == 3
        assert all(end <= following for (_, end), (following, _) in pairwise(times))
        moment = await reading.as_of(third, sequence=5)
        assert [(each.name, each.pose.position) for each in moment.world.objects] == [("milk", (1.0, 2.0, 3.0))]

    before = tables_of(database_url)
    await rebuild_memory(database_url)
    assert differences(before, tables_of(database_url)) == []
    log = await EventLog.open(DatabaseAddress.parse(database_url), create=False)
    verified = await verify(log)
    await log.close()
    assert (verified.episodes, verified.damages, verified.differences, verified.remarks) == (3, [], [], 0)
    other = f"sqlite:///{tmp_path}/other.db"
    await copy_episodes(database_url, other)
    assert differences(before, tables_of(other)) == []


async def test_episodes_and_show_name_the_parts(tmp_path: Path) -> None:
    first, second, third = await recorded(f"sqlite:///{tmp_path}/pycrorm.db", tmp_path / "pycrorm.db.spool")
    listed = answer("episodes", cwd=tmp_path)
    assert [(each["continues"], each["continued_in"]) for each in listed] == [
        (None, second), (first, third), (second, None),
    ]  # fmt: skip
    assert "patrol (continues episode 2)" in pycrorm("episodes", cwd=tmp_path).stdout
    shown = pycrorm("show", "2", cwd=tmp_path).stdout
    assert f"continues episode {first}" in " ".join(shown.split())
    assert f"continued in episode {third}" in " ".join(shown.split())
    assert answer("show", "3", cwd=tmp_path)["episode"]["continues"] == second
