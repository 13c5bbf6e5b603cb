"""A simulation is an episode of its own, beside the one around it and never mixed with it."""

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
    NodeReference,
    NodeStarted,
    ObjectAdded,
    ObjectAttached,
    ObjectMoved,
    ObjectReference,
)
from pycrorm_async.plan import (
    ActionAbstract,
    NavigateActionPerformable,
    PlanFailure,
    SimulatedTaskTree,
    simulated_robot,
)
from pycrorm_async.plan.objects import ObjectDesignator, designator_of, in_world
from pycrorm_async.record.plan_recorder import current_episode
from pycrorm_async.world import BulletWorld, Object, ObjectType, Pose
from tests.record.fakes import (
    CarryActionPerformable,
    NoteActionPerformable,
    RecorderCase,
    findings,
    kinds,
    recorder_case,
)

THERE = Pose([0.5, 0.25, 0])


@dataclass
class ThinkActionPerformable(ActionAbstract):
    """Simulate a note, and take another one."""

    text: str = ""

    async def perform(self) -> None:
        with SimulatedTaskTree():
            await NoteActionPerformable(self.text).perform()
        await NoteActionPerformable("real").perform()


def simulated_episodes(case: RecorderCase) -> list[EpisodeId]:
    """Return the simulated episodes in order; every event of every episode is in its legal place."""
    result = []
    for name in case.sink.sequences:
        events = case.sink.of(name)
        assert findings(events) == []
        started = events[0][1]
        assert isinstance(started, EpisodeStarted)
        marks = {event.simulated for _, event in events if isinstance(event, NodeStarted)}
        assert marks == {started.simulated}
        if started.simulated:
            result.append(name)
    return result


def only(events: list[tuple[int, Happening]], kind: type) -> list[Any]:
    return [event for _, event in events if isinstance(event, kind)]


def started(case: RecorderCase, name: EpisodeId) -> EpisodeStarted:
    event = case.sink.of(name)[0][1]
    assert isinstance(event, EpisodeStarted)
    return event


async def test_a_simulation_is_an_episode_that_names_the_node_that_simulates() -> None:
    with recorder_case() as case, case.episode() as real:
        await ThinkActionPerformable("thought").perform()
        assert current_episode.get() is real
    assert (case.recorder.episodes.recent, case.recorder.episodes.opened_count) == ((str(real),), 1)
    (simulation,) = simulated_episodes(case)
    assert kinds(case.sink.of(real)) == [
        "EpisodeStarted", "NodeStarted", "NodeStarted", "NodeStarted", "NodeEnded", "NodeEnded", "NodeEnded",
        "EpisodeEnded",
    ]  # fmt: skip
    assert [each.parameters for each in only(case.sink.of(real), NodeStarted)[1:]] == [
        {"text": "thought"},
        {"text": "real", "weight": 0.0, "ran": False},
    ]
    beginning = started(case, simulation)
    assert beginning.thought_by == NodeReference(episode_text(real.id), 3)
    assert beginning.description == "simulation in ThinkAction"
    assert [each.parameters.get("text") for each in only(case.sink.of(simulation), NodeStarted)] == [None, "thought"]
    assert only(case.sink.of(simulation), EpisodeEnded)[0].status == "SUCCEEDED"


async def test_a_simulation_outside_any_node_is_caused_by_the_root_and_without_an_episode_by_none() -> None:
    with recorder_case() as case:
        with case.episode() as real, SimulatedTaskTree(description="what if"):
            await NoteActionPerformable("a").perform()
        with SimulatedTaskTree():
            await NoteActionPerformable("b").perform()
        assert current_episode.get() is None
    first, second = simulated_episodes(case)
    assert started(case, first).thought_by == NodeReference(episode_text(real.id), 2)
    assert started(case, first).description == "what if"
    assert (started(case, second).thought_by, started(case, second).description) == (None, "simulation")
    assert len(case.sink.sequences) == 3


async def test_a_simulation_has_the_copy_as_its_world_and_the_episode_the_real_one() -> None:
    with recorder_case() as case, BulletWorld(), simulated_robot:
        robot = Object("pr2", ObjectType.ROBOT)
        milk = Object("milk", ObjectType.MILK, pose=Pose([1, 0, 1]))
        robot.attach(milk, "r_gripper_tool_frame")
        with case.episode() as real:
            with SimulatedTaskTree():
                await NavigateActionPerformable(THERE).perform()
            robot.set_pose(Pose([0, 1, 0]))
    (simulation,) = simulated_episodes(case)
    events = case.sink.of(simulation)
    assert [(each.name, each.pose.position) for each in only(events, ObjectAdded)] == [
        ("pr2", (0.0, 0.0, 0.0)), ("milk", (1.0, 0.0, 1.0)),
    ]  # fmt: skip
    assert len(only(events, ObjectAttached)) == 1
    moved = only(events, ObjectMoved)
    motion = next(sequence for sequence, event in events if isinstance(event, NodeStarted) and event.kind == "motion")
    assert [(each.name, each.pose.position, each.node) for each in moved] == [
        ("pr2", (0.5, 0.25, 0.0), motion), ("milk", (1.5, 0.25, 1.0), motion),
    ]  # fmt: skip
    really = only(case.sink.of(real), ObjectMoved)
    assert [(each.name, each.pose.position, each.node) for each in really] == [
        ("pr2", (0.0, 1.0, 0.0), None), ("milk", (1.0, 1.0, 1.0), None),
    ]  # fmt: skip
    assert "ObjectRemoved" not in kinds(events)


async def test_objects_belong_to_the_episode_that_names_them_in_both_directions() -> None:
    with recorder_case() as case, BulletWorld():
        milk = designator_of(Object("milk", ObjectType.MILK))
        inside: list[ObjectDesignator] = []
        with case.episode() as real:
            with SimulatedTaskTree():
                in_world(milk).set_pose(Pose([1, 0, 0]))
                await CarryActionPerformable(milk).perform()
                inside.append(designator_of(in_world(milk)))
                spoon = designator_of(Object("spoon", ObjectType.SPOON, pose=Pose([2, 0, 0])))
            await CarryActionPerformable(inside[0]).perform()
            await CarryActionPerformable(spoon).perform()
    (simulation,) = simulated_episodes(case)

    def named(name: EpisodeId) -> list[Any]:
        return [each.parameters["what"] for each in only(case.sink.of(name), NodeStarted) if each.parameters]

    added = {event.name: sequence for sequence, event in case.sink.of(simulation) if isinstance(event, ObjectAdded)}
    row = next(sequence for sequence, event in case.sink.of(simulation) if isinstance(event, ObjectMoved))
    assert named(simulation) == [{"object": added["milk"], "row": row}]
    really = next(sequence for sequence, event in case.sink.of(real.id) if isinstance(event, ObjectAdded))
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
async def test_a_simulation_ends_with_the_outcome_of_its_block_and_the_episode_continues(
    raised: BaseException | None, status: str
) -> None:
    with recorder_case() as case, case.episode() as real:
        with suppress(BaseException), SimulatedTaskTree():
            if raised is not None:
                raise raised
        await NoteActionPerformable("a").perform()
    (simulation,) = simulated_episodes(case)
    assert only(case.sink.of(simulation), EpisodeEnded)[0].status == status
    assert only(case.sink.of(real), EpisodeEnded)[0].status == "SUCCEEDED"
    assert len(only(case.sink.of(real), NodeStarted)) == 2


async def test_simulations_in_two_tasks_mix_neither_with_each_other_nor_with_real_events() -> None:
    with recorder_case() as case, BulletWorld(), simulated_robot:
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

        with case.episode() as real:
            await asyncio.gather(dreaming("a"), dreaming("b"), acting())
    for name, text, moves in zip((real.id, *simulated_episodes(case)), ("real", "a", "b"), (0, 5, 5), strict=True):
        events = case.sink.of(name)
        texts = [each.parameters["text"] for each in only(events, NodeStarted) if "text" in each.parameters]
        assert texts == [text] * 5
        assert len(only(events, ObjectMoved)) == moves


async def test_a_task_that_outlives_its_simulation_is_still_simulated() -> None:
    with recorder_case() as case:
        over = asyncio.Event()

        async def late() -> None:
            await over.wait()
            await NoteActionPerformable("late").perform()

        with case.episode() as real:
            with SimulatedTaskTree():
                task = asyncio.create_task(late())
                await asyncio.sleep(0)
            over.set()
            await task
    first, second = simulated_episodes(case)
    assert len(only(case.sink.of(first), NodeStarted)) == 1
    assert [each.parameters.get("text") for each in only(case.sink.of(second), NodeStarted)] == [None, "late"]
    assert started(case, second).thought_by == NodeReference(episode_text(real.id), 2)
    assert len(only(case.sink.of(real), NodeStarted)) == 1


async def test_an_episode_opened_in_a_simulation_is_a_simulation_too() -> None:
    with recorder_case() as case, case.episode() as real, SimulatedTaskTree():
        with pytest.raises(EpisodeRefused, match="is open in this task already"):
            case.recorder.open_episode(description="second")

        async def another() -> None:
            with case.episode():
                await NoteActionPerformable("a").perform()

        await asyncio.create_task(another())
    _, inner = simulated_episodes(case)
    assert started(case, inner).thought_by == NodeReference(episode_text(real.id), 2)


async def test_a_world_entered_in_a_simulation_without_one_belongs_to_it() -> None:
    with recorder_case() as case, case.episode() as real, SimulatedTaskTree(), BulletWorld():
        Object("milk", ObjectType.MILK)
    (simulation,) = simulated_episodes(case)
    assert [each.name for each in only(case.sink.of(simulation), ObjectAdded)] == ["milk"]
    assert only(case.sink.of(real), ObjectAdded) == []


async def test_a_simulation_whose_start_fails_by_a_fault_of_the_recorder_leaves_no_events() -> None:
    with recorder_case() as case, BulletWorld(), simulated_robot:
        Object("pr2", ObjectType.ROBOT)
        with case.episode() as real:
            simulation = SimulatedTaskTree()
            case.sink.broken = True
            with simulation:
                case.sink.broken = False
                await NavigateActionPerformable(THERE).perform()
                assert current_episode.get() is None
            assert current_episode.get() is real
            await NoteActionPerformable("real").perform()
    assert case.emitter.faults.total == 1
    (simulated_alone,) = simulated_episodes(case)
    assert started(case, simulated_alone).thought_by == NodeReference(episode_text(real.id), 2)
    assert [each.kind for each in only(case.sink.of(simulated_alone), NodeStarted)] == ["root", "action", "motion"]
    assert [each.parameters.get("text") for each in only(case.sink.of(real), NodeStarted)] == [None, "real"]
    assert only(case.sink.of(real), ObjectMoved) == []
