"""What is thought through is an episode of its own, beside the one around it and never mixed with it."""

from __future__ import annotations

import asyncio
from contextlib import suppress
from dataclasses import dataclass
from typing import Any

import pytest

from pycrorm_async.errors import EpisodeRefused
from pycrorm_async.events.ids import EpisodeId, episode_text
from pycrorm_async.events.types import (
    EpisodeEnded,
    EpisodeStarted,
    Happening,
    NodeStarted,
    ObjectAdded,
    ObjectAttached,
    ObjectMoved,
)
from pycrorm_async.events.values import NodeReference, ObjectReference
from pycrorm_async.hooks.plan_recorder import current_episode
from pycrorm_async.plan import (
    ActionAbstract,
    NavigateActionPerformable,
    PlanFailure,
    SimulatedTaskTree,
    simulated_robot,
)
from pycrorm_async.plan.object_designators import ObjectDesignator, designator_of, in_world
from pycrorm_async.world import BulletWorld, Object, ObjectType, Pose
from tests.hooks.fakes import CarryActionPerformable, NoteActionPerformable, Rig, findings, kinds, rigged

THERE = Pose([0.5, 0.25, 0])


@dataclass
class ThinkActionPerformable(ActionAbstract):
    """Thinks a note, and takes another one."""

    text: str = ""

    async def perform(self) -> None:
        with SimulatedTaskTree():
            await NoteActionPerformable(self.text).perform()
        await NoteActionPerformable("real").perform()


def thoughts(rig: Rig) -> list[EpisodeId]:
    """Which episodes were only thought, in order; every event of every episode is in its legal place."""
    found = []
    for name in rig.sink.sequences:
        events = rig.sink.of(name)
        assert findings(events) == []
        started = events[0][1]
        assert isinstance(started, EpisodeStarted)
        marks = {event.simulated for _, event in events if isinstance(event, NodeStarted)}
        assert marks == {started.simulated}
        if started.simulated:
            found.append(name)
    return found


def only(events: list[tuple[int, Happening]], kind: type) -> list[Any]:
    return [event for _, event in events if isinstance(event, kind)]


def started(rig: Rig, name: EpisodeId) -> EpisodeStarted:
    event = rig.sink.of(name)[0][1]
    assert isinstance(event, EpisodeStarted)
    return event


async def test_a_thought_is_an_episode_that_names_the_node_that_thinks() -> None:
    with rigged() as rig, rig.episode() as real:
        await ThinkActionPerformable("thought").perform()
        assert current_episode.get() is real
    (thought,) = thoughts(rig)
    assert kinds(rig.sink.of(real)) == [
        "EpisodeStarted", "NodeStarted", "NodeStarted", "NodeStarted", "NodeEnded", "NodeEnded", "NodeEnded",
        "EpisodeEnded",
    ]  # fmt: skip
    assert [each.parameters for each in only(rig.sink.of(real), NodeStarted)[1:]] == [
        {"text": "thought"},
        {"text": "real", "weight": 0.0, "ran": False},
    ]
    beginning = started(rig, thought)
    assert beginning.thought_by == NodeReference(episode_text(real.id), 3)
    assert beginning.description == "simulation in ThinkAction"
    assert [each.parameters.get("text") for each in only(rig.sink.of(thought), NodeStarted)] == [None, "thought"]
    assert only(rig.sink.of(thought), EpisodeEnded)[0].status == "SUCCEEDED"


async def test_a_thought_outside_any_node_is_thought_by_the_root_and_without_an_episode_by_nobody() -> None:
    with rigged() as rig:
        with rig.episode() as real, SimulatedTaskTree(description="what if"):
            await NoteActionPerformable("a").perform()
        with SimulatedTaskTree():
            await NoteActionPerformable("b").perform()
        assert current_episode.get() is None
    first, second = thoughts(rig)
    assert started(rig, first).thought_by == NodeReference(episode_text(real.id), 2)
    assert started(rig, first).description == "what if"
    assert (started(rig, second).thought_by, started(rig, second).description) == (None, "simulation")
    assert len(rig.sink.sequences) == 3


async def test_in_a_perform_without_an_episode_the_one_it_opened_is_the_thinkers() -> None:
    with rigged() as rig:
        await ThinkActionPerformable("t").perform()
    (thought,) = thoughts(rig)
    real = next(name for name in rig.sink.sequences if name != thought)
    assert started(rig, thought).thought_by == NodeReference(episode_text(real), 3)
    assert [each.parameters.get("text") for each in only(rig.sink.of(real), NodeStarted)] == [None, "t", "real"]


async def test_the_world_of_a_thought_is_the_copy_and_that_of_the_episode_the_real_one() -> None:
    with rigged() as rig, BulletWorld(), simulated_robot:
        robot = Object("pr2", ObjectType.ROBOT)
        milk = Object("milk", ObjectType.MILK, pose=Pose([1, 0, 1]))
        robot.attach(milk, "r_gripper_tool_frame")
        with rig.episode() as real:
            with SimulatedTaskTree():
                await NavigateActionPerformable(THERE).perform()
            robot.set_pose(Pose([0, 1, 0]))
    (thought,) = thoughts(rig)
    events = rig.sink.of(thought)
    assert [(each.name, each.pose.position) for each in only(events, ObjectAdded)] == [
        ("pr2", (0.0, 0.0, 0.0)), ("milk", (1.0, 0.0, 1.0)),
    ]  # fmt: skip
    assert len(only(events, ObjectAttached)) == 1
    moved = only(events, ObjectMoved)
    motion = next(sequence for sequence, event in events if isinstance(event, NodeStarted) and event.kind == "motion")
    assert [(each.name, each.pose.position, each.node) for each in moved] == [
        ("pr2", (0.5, 0.25, 0.0), motion), ("milk", (1.5, 0.25, 1.0), motion),
    ]  # fmt: skip
    really = only(rig.sink.of(real), ObjectMoved)
    assert [(each.name, each.pose.position, each.node) for each in really] == [
        ("pr2", (0.0, 1.0, 0.0), None), ("milk", (1.0, 1.0, 1.0), None),
    ]  # fmt: skip
    assert "ObjectRemoved" not in kinds(events)


async def test_objects_are_those_of_the_episode_that_names_them_in_both_directions() -> None:
    with rigged() as rig, BulletWorld():
        milk = designator_of(Object("milk", ObjectType.MILK))
        inside: list[ObjectDesignator] = []
        with rig.episode() as real:
            with SimulatedTaskTree():
                in_world(milk).set_pose(Pose([1, 0, 0]))
                await CarryActionPerformable(milk).perform()
                inside.append(designator_of(in_world(milk)))
                spoon = designator_of(Object("spoon", ObjectType.SPOON, pose=Pose([2, 0, 0])))
            await CarryActionPerformable(inside[0]).perform()
            await CarryActionPerformable(spoon).perform()
    (thought,) = thoughts(rig)

    def named(name: EpisodeId) -> list[Any]:
        return [each.parameters["what"] for each in only(rig.sink.of(name), NodeStarted) if each.parameters]

    added = {event.name: sequence for sequence, event in rig.sink.of(thought) if isinstance(event, ObjectAdded)}
    row = next(sequence for sequence, event in rig.sink.of(thought) if isinstance(event, ObjectMoved))
    assert named(thought) == [{"object": added["milk"], "row": row}]
    really = next(sequence for sequence, event in rig.sink.of(real.id) if isinstance(event, ObjectAdded))
    first, second = named(real.id)
    assert first == {"object": really, "row": really}
    assert (second["dtype"], second["name"], second["pose"]["position"]) == ("Object", "spoon", [2.0, 0.0, 0.0])
    assert ObjectReference(really, really).object == really


@pytest.mark.parametrize(
    ("raised", "status"),
    [
        (None, "SUCCEEDED"),
        (PlanFailure("no"), "FAILED"),
        (ValueError("sour"), "ERROR"),
        (asyncio.CancelledError(), "INTERRUPTED"),
    ],
)
async def test_a_thought_ends_as_what_leaves_it_says_and_the_episode_goes_on(
    raised: BaseException | None, status: str
) -> None:
    with rigged() as rig, rig.episode() as real:
        with suppress(BaseException), SimulatedTaskTree():
            if raised is not None:
                raise raised
        await NoteActionPerformable("a").perform()
    (thought,) = thoughts(rig)
    assert only(rig.sink.of(thought), EpisodeEnded)[0].status == status
    assert only(rig.sink.of(real), EpisodeEnded)[0].status == "SUCCEEDED"
    assert len(only(rig.sink.of(real), NodeStarted)) == 2


async def test_thoughts_nest_and_each_names_the_node_of_the_one_around() -> None:
    @dataclass
    class ThinkTwiceActionPerformable(ActionAbstract):
        async def perform(self) -> None:
            with SimulatedTaskTree():
                await ThinkActionPerformable("deep").perform()

    with rigged() as rig, rig.episode() as real:
        await ThinkTwiceActionPerformable().perform()
    outer, inner = thoughts(rig)
    assert started(rig, outer).thought_by == NodeReference(episode_text(real.id), 3)
    assert started(rig, inner).thought_by == NodeReference(episode_text(outer), 3)
    texts = [[each.parameters.get("text") for each in only(rig.sink.of(name), NodeStarted)] for name in (outer, inner)]
    assert texts == [[None, "deep", "real"], [None, "deep"]]


async def test_thoughts_of_two_tasks_never_mix_with_each_other_or_with_what_happens() -> None:
    with rigged() as rig, BulletWorld(), simulated_robot:
        Object("pr2", ObjectType.ROBOT)
        together = asyncio.Barrier(3)

        async def dreaming(text: str) -> None:
            with SimulatedTaskTree(text):
                for _ in range(5):
                    await together.wait()
                    await NoteActionPerformable(text).perform()
                    await NavigateActionPerformable(THERE).perform()

        async def acting() -> None:
            for _ in range(5):
                await together.wait()
                await NoteActionPerformable("real").perform()

        with rig.episode() as real:
            await asyncio.gather(dreaming("a"), dreaming("b"), acting())
    for name, text, moves in zip((real.id, *thoughts(rig)), ("real", "a", "b"), (0, 5, 5), strict=True):
        events = rig.sink.of(name)
        texts = [each.parameters["text"] for each in only(events, NodeStarted) if "text" in each.parameters]
        assert texts == [text] * 5
        assert len(only(events, ObjectMoved)) == moves


async def test_what_outlives_its_thought_is_still_only_thought() -> None:
    with rigged() as rig:
        over = asyncio.Event()

        async def late() -> None:
            await over.wait()
            await NoteActionPerformable("late").perform()

        with rig.episode() as real:
            with SimulatedTaskTree():
                task = asyncio.create_task(late())
                await asyncio.sleep(0)
            over.set()
            await task
    first, second = thoughts(rig)
    assert len(only(rig.sink.of(first), NodeStarted)) == 1
    assert [each.parameters.get("text") for each in only(rig.sink.of(second), NodeStarted)] == [None, "late"]
    assert started(rig, second).thought_by == NodeReference(episode_text(real.id), 2)
    assert len(only(rig.sink.of(real), NodeStarted)) == 1


async def test_an_episode_opened_in_a_thought_is_one_too() -> None:
    with rigged() as rig, rig.episode() as real, SimulatedTaskTree():
        with pytest.raises(EpisodeRefused, match="is open in this task already"):
            rig.recorder.open_episode(description="second")

        async def another() -> None:
            with rig.episode():
                await NoteActionPerformable("a").perform()

        await asyncio.create_task(another())
    _, inner = thoughts(rig)
    assert started(rig, inner).thought_by == NodeReference(episode_text(real.id), 2)


async def test_a_world_entered_in_a_thought_without_one_belongs_to_it() -> None:
    with rigged() as rig, rig.episode() as real, SimulatedTaskTree(), BulletWorld():
        Object("milk", ObjectType.MILK)
    (thought,) = thoughts(rig)
    assert [each.name for each in only(rig.sink.of(thought), ObjectAdded)] == ["milk"]
    assert only(rig.sink.of(real), ObjectAdded) == []


async def test_a_thought_that_could_not_be_begun_is_a_fault_of_ours_and_nothing_of_it_happened() -> None:
    with rigged() as rig, BulletWorld(), simulated_robot:
        Object("pr2", ObjectType.ROBOT)
        with rig.episode() as real:
            thought = SimulatedTaskTree()
            rig.sink.broken = True
            with thought:
                rig.sink.broken = False
                await NavigateActionPerformable(THERE).perform()
                assert current_episode.get() is None
            assert current_episode.get() is real
            await NoteActionPerformable("real").perform()
    assert rig.emitter.faults.total == 1
    (alone,) = thoughts(rig)
    assert started(rig, alone).thought_by == NodeReference(episode_text(real.id), 2)
    assert [each.kind for each in only(rig.sink.of(alone), NodeStarted)] == ["root", "action", "motion"]
    assert [each.parameters.get("text") for each in only(rig.sink.of(real), NodeStarted)] == [None, "real"]
    assert only(rig.sink.of(real), ObjectMoved) == []


async def test_a_thought_whose_end_cannot_be_written_goes_on_as_it_would_without_a_memory() -> None:
    with rigged() as rig, rig.episode() as real:
        with SimulatedTaskTree():
            rig.sink.broken = True
        rig.sink.broken = False
        await NoteActionPerformable("real").perform()
        assert current_episode.get() is real
    assert rig.emitter.faults.total == 1


async def test_thoughts_are_not_among_the_recent_episodes() -> None:
    with rigged() as rig:
        with rig.episode() as real, SimulatedTaskTree():
            pass
        assert rig.recorder.recent_episodes == (str(real),)
        assert rig.recorder.opened_count == 1
        assert rig.recorder.open_episodes == ()


async def test_a_description_that_is_too_long_is_cut() -> None:
    with rigged() as rig, SimulatedTaskTree("x" * 20_000):
        pass
    (thought,) = thoughts(rig)
    assert started(rig, thought).description == "x" * 10_000
