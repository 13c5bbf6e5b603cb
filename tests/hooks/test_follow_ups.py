"""An episode that comes near its last sequence goes on in a follow-up episode; the plan notices nothing."""

from __future__ import annotations

import asyncio
import contextvars
import math
import threading
from collections import Counter
from collections.abc import Callable, Coroutine
from dataclasses import dataclass
from typing import Any

import pytest

from pycrorm_async.errors import CallerError
from pycrorm_async.events.ids import SEQUENCE_MAX, EpisodeId, episode_text
from pycrorm_async.events.types import (
    EpisodeEnded,
    EpisodeStarted,
    Happening,
    NodeEnded,
    NodeStarted,
    ObjectAdded,
    ObjectAttached,
    ObjectMoved,
    ObjectRemoved,
    StateSampled,
)
from pycrorm_async.events.values import NodeReference, ObjectReference
from pycrorm_async.hooks.plan_recorder import current_episode
from pycrorm_async.plan import ChosenRobot, MoveMotion, SimulatedTaskTree
from pycrorm_async.plan.actions.basic import MoveTorsoActionPerformable, NavigateActionPerformable
from pycrorm_async.plan.current_robot import require_robot
from pycrorm_async.plan.designator import ActionAbstract
from pycrorm_async.plan.motions.process_modules import simulated_robot
from pycrorm_async.plan.object_designators import ObjectDesignator
from pycrorm_async.settings import Settings
from pycrorm_async.world import BulletWorld, Object, ObjectType, Pose
from tests.hooks.fakes import CarryActionPerformable, ListSink, NoteActionPerformable, Rig, findings, rigged

pytestmark = pytest.mark.slow

MAX = 100
SMALL = Settings(episode_events_max=MAX)


@dataclass
class ShiftActionPerformable(ActionAbstract):
    """Notes so many times, and gives back how often."""

    notes: int
    of: str = "day"

    async def perform(self) -> int:
        for number in range(self.notes):
            await NoteActionPerformable(f"{self.of} {number}").perform()
        return self.notes


@dataclass
class SpoilingActionPerformable(ActionAbstract):
    """Changes its own parameter to what no event can hold, and goes on for more than an episode."""

    weight: float

    async def perform(self) -> None:
        self.weight = math.nan
        await ShiftActionPerformable(60).perform()


class LeavingActionPerformable(ActionAbstract):
    """Leaves a task behind, which goes on in its context."""

    def __init__(self, work: Callable[[], Coroutine[Any, Any, None]]) -> None:
        self.work = work
        self.task: asyncio.Task[None] | None = None

    async def perform(self) -> None:
        self.task = asyncio.create_task(self.work())


def parts_of(sink: ListSink) -> list[list[tuple[int, Happening]]]:
    """The events of each episode, in the order they began."""
    return [sink.of(each) for each in sink.sequences]


def only(events: list[tuple[int, Happening]], kind: type[Happening]) -> list[tuple[int, Happening]]:
    return [(sequence, event) for sequence, event in events if isinstance(event, kind)]


def no_faults(rig: Rig) -> bool:
    assert rig.emitter.faults.total == 0, rig.emitter.faults.last
    for events in parts_of(rig.sink):
        assert findings(events) == []
        assert [sequence for sequence, _ in events] == list(range(1, len(events) + 1))
        assert isinstance(events[0][1], EpisodeStarted)
        assert isinstance(events[-1][1], EpisodeEnded)
        assert len(events) <= MAX
    return True


async def test_each_part_names_the_next_and_every_perform_has_one_row_that_says_how_it_ended() -> None:
    with rigged(SMALL) as rig:
        with rig.episode() as episode:
            assert await ShiftActionPerformable(200).perform() == 200
            last = episode.id
        names: list[EpisodeId] = list(rig.sink.sequences)
        assert names[-1] == last
        assert len(names) == 1 + rig.recorder.continued_count > 4
        assert rig.recorder.recent_episodes == tuple(map(episode_text, names))
        assert rig.recorder.open_episodes == ()
    assert no_faults(rig)

    parts = parts_of(rig.sink)
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


async def test_a_node_that_was_open_is_started_again_under_its_parent_and_names_the_sequence_it_continues() -> None:
    with rigged(SMALL) as rig, rig.episode():
        await ShiftActionPerformable(60).perform()
    assert no_faults(rig)
    first, second = parts_of(rig.sink)
    # The 88th event starts a note. What is open is cut, innermost first, and begins again, outermost first.
    why = f"the episode continues in episode {episode_text(list(rig.sink.sequences)[1])}"
    assert [sequence for sequence, _ in first][-5:] == [88, 89, 90, 91, 92]
    assert [event.node for _, event in first[-4:] if isinstance(event, NodeEnded)] == [88, 3, 2]
    assert {event.failure.message for _, event in first[-4:] if isinstance(event, NodeEnded) and event.failure} == {why}
    again = [event for _, event in only(second, NodeStarted)[:4] if isinstance(event, NodeStarted)]
    assert [(each.kind, each.parent, each.continues) for each in again] == [
        ("root", None, 2), ("action", 2, 3), ("action", 3, 88), ("action", 3, None),
    ]  # fmt: skip
    assert [each.parameters.get("text") for each in again] == [None, None, "day 42", "day 43"]
    assert next((event.node, event.status) for _, event in second if isinstance(event, NodeEnded)) == (4, "SUCCEEDED")


async def test_the_world_is_announced_again_as_it_is_then_and_what_follows_names_its_new_rows() -> None:
    with rigged(SMALL) as rig, rig.episode(), BulletWorld(), simulated_robot:
        robot = Object("pr2", ObjectType.ROBOT)
        milk = Object("milk", ObjectType.MILK, pose=Pose([1, 0, 1]))
        bowl = Object("bowl", ObjectType.BOWL, pose=Pose([2, 0, 1]))
        robot.attach(milk)
        while len(rig.sink.sequences) == 1:
            bowl.set_pose(Pose([2, bowl.pose.position.y + 0.01, 1]))  # of no node: the world itself brings it near
        there = bowl.pose.position
        bowl.set_pose(Pose([3, 3, 1]))
        await CarryActionPerformable(ObjectDesignator("bowl", ObjectType.BOWL, bowl)).perform()
        milk.remove()
    assert no_faults(rig)
    _, second = parts_of(rig.sink)
    assert [(event.name, event.pose.position) for _, event in second[2:5] if isinstance(event, ObjectAdded)] == [
        ("pr2", (0, 0, 0)), ("milk", (1, 0, 1)), ("bowl", tuple(there)),
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
    with rigged(settings) as rig, rig.episode(), BulletWorld(), simulated_robot:
        Object("pr2", ObjectType.ROBOT)
        height = 0.0
        while len(rig.sink.sequences) == 1:
            height = 0.3 - height
            await MoveTorsoActionPerformable(height).perform()
        await MoveTorsoActionPerformable(0.1).perform()
    assert no_faults(rig)
    first, second = (
        [event.channels for _, event in only(part, StateSampled) if isinstance(event, StateSampled)]
        for part in parts_of(rig.sink)
    )
    assert len(first[0]) > 20
    assert {tuple(each) for each in first[1:]} == {("torso_lift_joint",)}
    assert first[0].keys() == second[0].keys()
    assert second[-1] == {"torso_lift_joint": 0.1}


class Driving:
    """Moves the base in small steps until the episode was continued, and once more."""

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


async def test_a_motion_that_runs_meanwhile_is_sampled_on_as_the_rest_of_it_with_all_channels() -> None:
    settings = Settings(episode_events_max=MAX, sample_interval_ms=1_000_000)
    with rigged(settings) as rig, rig.episode(), BulletWorld(), ChosenRobot("mine", Driving(rig.sink)):
        Object("pr2", ObjectType.ROBOT)
        await NavigateActionPerformable(Pose([5, 0, 0])).perform()
    assert no_faults(rig)
    first, second = (only(part, StateSampled) for part in parts_of(rig.sink))
    assert len(first) == len(second) == 1
    whole, rest = first[0][1], second[0][1]
    assert isinstance(whole, StateSampled)
    assert isinstance(rest, StateSampled)
    assert len(whole.channels) > 20
    assert rest.channels.keys() == whole.channels.keys()
    assert (whole.channels["base.x"], rest.channels["base.x"]) == (0.0, 5.0)
    assert rest.node in dict(only(parts_of(rig.sink)[1], NodeStarted))


async def test_plans_at_once_in_one_episode_go_on_together() -> None:
    with rigged(SMALL) as rig, rig.episode() as episode:
        async with asyncio.TaskGroup() as tasks:
            for name in ("one", "two"):
                tasks.create_task(ShiftActionPerformable(60, name).perform())
        assert current_episode.get() is episode
    assert no_faults(rig)
    noted = Counter(
        event.parameters["text"]
        for part in parts_of(rig.sink)
        for _, event in only(part, NodeStarted)
        if isinstance(event, NodeStarted) and "text" in event.parameters and event.continues is None
    )
    assert noted == Counter([f"{name} {number}" for name in ("one", "two") for number in range(60)])


async def test_a_parameter_that_became_unrecordable_is_missing_in_the_rest_of_its_node_and_refuses_nothing() -> None:
    with rigged(Settings(episode_events_max=MAX, on_unrecordable="refuse")) as rig, rig.episode():
        await SpoilingActionPerformable(0.5).perform()
    assert no_faults(rig)
    first, second = ([event for _, event in only(part, NodeStarted)] for part in parts_of(rig.sink))
    assert getattr(first[1], "parameters", None) == {"weight": 0.5}
    assert getattr(second[1], "parameters", None) == {
        "weight": {"missing": "nan is not a finite number", "repr": "nan"}
    }


async def test_what_a_node_that_ended_in_the_former_part_left_behind_belongs_to_the_root_of_the_follow_up() -> None:
    with rigged(SMALL) as rig, rig.episode(), BulletWorld():
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
    assert no_faults(rig)
    _, second = parts_of(rig.sink)
    notes = [event for _, event in only(second, NodeStarted) if getattr(event, "parameters", {}).get("text") == "late"]
    assert [getattr(each, "parent", None) for each in notes] == [2]
    assert [getattr(event, "node", 0) for _, event in only(second, ObjectMoved)] == [None]


async def test_a_thought_goes_on_as_a_thought_of_the_same_thinker() -> None:
    with rigged(SMALL) as rig, rig.episode() as episode:
        with SimulatedTaskTree():
            await ShiftActionPerformable(60).perform()
        thinker = NodeReference(str(episode), 2)
    assert no_faults(rig)
    _, *thoughts = [part[0][1] for part in parts_of(rig.sink)]
    assert len(thoughts) == 2
    for each in thoughts:
        assert isinstance(each, EpisodeStarted)
        assert (each.simulated, each.thought_by) == (True, thinker)


async def test_a_world_with_more_objects_than_an_episode_has_events_is_not_continued_for_ever() -> None:
    with rigged(SMALL) as rig, rig.episode(), BulletWorld():
        for number in range(2 * MAX):
            Object(f"milk {number}", ObjectType.MILK)
        count = len(rig.sink.sequences)
        for _ in range(2 * MAX):
            await NoteActionPerformable().perform()
        assert len(rig.sink.sequences) < count + 3
    assert rig.emitter.faults.total == 0


def test_how_many_events_an_episode_may_have_is_checked() -> None:
    assert Settings().episode_events_max == SEQUENCE_MAX
    for wrong in (0, 99, SEQUENCE_MAX + 1, 150.5):
        with pytest.raises(CallerError, match="from 100 to 67,108,863"):
            Settings(episode_events_max=wrong)  # type: ignore[arg-type]


def outcomes(rig: Rig) -> Counter[str]:
    """How often each note ended with an outcome of its own, by text; every part is in legal order."""
    ended: Counter[str] = Counter()
    for events in parts_of(rig.sink):
        assert [each for each in findings(events) if each.kind != "remark"] == []
        assert isinstance(events[-1][1], EpisodeEnded)
        nodes = dict(only(events, NodeStarted))
        for _, end in only(events, NodeEnded):
            assert isinstance(end, NodeEnded)
            if end.failure is None or end.failure.type != "EpisodeContinued":
                ended[f"{getattr(nodes[end.node], 'parameters', {}).get('text', 'other')} {end.status}"] += 1
    return ended


@pytest.mark.parametrize("put", range(1, 6))
async def test_a_follow_up_whose_event_cannot_be_written_is_tried_again_and_every_node_ends_once(put: int) -> None:
    """The put of the follow-up that fails: the ends of note, shift and move, then of the root and the episode."""
    with rigged(SMALL) as rig, rig.episode(), BulletWorld():
        milk = Object("milk", ObjectType.MILK)

        @dataclass
        class MovingActionPerformable(ActionAbstract):
            async def perform(self) -> None:
                rig.sink.fails_at = MAX - MAX // 8 + put
                await ShiftActionPerformable(60).perform()
                milk.set_pose(Pose([1, 2, 3]))

        await MovingActionPerformable().perform()
    assert rig.emitter.faults.total == 1
    assert rig.recorder.continued_count == 1
    ended = {f"day {number} SUCCEEDED": 1 for number in range(60)} | {"other SUCCEEDED": 3}
    if put > 1:  # its end says that the episode continues, and it had ended before the second attempt
        del ended["day 41 SUCCEEDED"]
    assert outcomes(rig) == Counter(ended)
    moves = [event for events in parts_of(rig.sink) for _, event in only(events, ObjectMoved)]
    assert [getattr(each, "pose", None).position for each in moves] == [(1, 2, 3)]  # type: ignore[union-attr]


@pytest.mark.parametrize("continued", [True, False])
async def test_the_end_of_an_episode_waits_for_a_node_that_another_thread_is_ending(*, continued: bool) -> None:
    with rigged(SMALL) as rig, rig.episode():

        async def late() -> None:
            await NoteActionPerformable("late").perform()

        ending, go = threading.Event(), threading.Event()

        def pause() -> None:
            if threading.current_thread() is thread:
                ending.set()
                go.wait(5)

        rig.sink.before_end = pause
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
    assert rig.emitter.faults.total == 0
    shifts = {f"day {number} SUCCEEDED": 1 for number in range(60)} | {"other SUCCEEDED": 2}
    assert outcomes(rig) == Counter({"late SUCCEEDED": 1} | (shifts if continued else {"other SUCCEEDED": 1}))
