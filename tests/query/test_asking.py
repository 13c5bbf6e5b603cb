"""The named questions, against answers reckoned from the events of random memories, on both databases."""

from __future__ import annotations

import math
from collections import Counter
from datetime import UTC, datetime, timedelta
from typing import Any

import pytest

from pycrorm_async.events.types import EpisodeEnded, EpisodeStarted, ObjectMoved
from pycrorm_async.query.reading import Reading
from pycrorm_async.task_status import TaskStatus
from pycrorm_async.world.pose import Arms, Grasp
from tests.projections.event_script import T0_NS
from tests.query.random_episodes import EPISODES
from tests.query.random_memory import NAMES, Node, course_of, nodes_of, root_failures_of

pytestmark = pytest.mark.slow
NODES = nodes_of(EPISODES)
ROOT_FAILURES = root_failures_of(EPISODES)


def names_of(*members: Any) -> tuple[Any, ...]:
    return tuple(each.name if isinstance(each, TaskStatus | Arms | Grasp) else each for each in members)


def actions() -> list[Node]:
    return [each for each in NODES if each.started.kind == "action"]


def test_the_random_memories_have_what_is_asked_for() -> None:
    assert len(ROOT_FAILURES) > 40
    assert {each.recovered for each in ROOT_FAILURES} == {True, False}
    assert any(each.status == "RUNNING" for each in actions())
    assert any(each.is_failed and any(child.is_failed for child in each.children) for each in NODES)


# --- failures -------------------------------------------------------------------------------------------------


async def failures_found(reading: Reading, **search: Any) -> list[tuple[int, int]]:
    return [(each.episode, each.sequence) for each in await reading.ask.root_failures(**search).rows()]


async def test_root_failures_are_failed_nodes_without_a_failed_child(reading: Reading) -> None:
    rows = await reading.ask.root_failures().rows()
    assert [
        (
            *names_of(each.episode, each.sequence, each.dtype, each.object, each.arm),
            each.reason,
            each.message,
            each.recovered,
        )
        for each in rows
    ] == [
        (each.episode, each.sequence, each.dtype, each.object, each.arm, each.reason, each.message, each.recovered)
        for each in ROOT_FAILURES
    ]


async def test_failures_are_found_by_their_columns(reading: Reading) -> None:
    def reckoned(condition: Any) -> list[tuple[int, int]]:
        places = [(each.episode, each.sequence) for each in ROOT_FAILURES if condition(each)]
        assert 0 < len(places) < len(ROOT_FAILURES)
        return places

    assert await failures_found(reading, episode=7) == reckoned(lambda each: each.episode == 7)
    assert await failures_found(reading, object="MILK") == reckoned(lambda each: "milk" in (each.object or ""))
    assert await failures_found(reading, object="milk_") == reckoned(lambda each: each.object == "milk_2")
    assert await failures_found(reading, arm="left") == reckoned(lambda each: each.arm == "LEFT")
    assert await failures_found(reading, arm=Arms.RIGHT) == reckoned(lambda each: each.arm == "RIGHT")
    assert await failures_found(reading, reason="collision") == reckoned(lambda each: each.reason == "CollisionError")
    assert await failures_found(reading, reason="Out of reach") == reckoned(lambda each: each.reason == "IKError")
    assert await failures_found(reading, reason="dropped") == reckoned(lambda each: each.reason == "ObjectLost")
    assert await failures_found(reading, message="50%") == reckoned(lambda each: each.message == "50% of the way")
    assert await failures_found(reading, recovered=True) == reckoned(lambda each: each.recovered)
    assert await failures_found(reading, recovered=False) == reckoned(lambda each: not each.recovered)
    assert await failures_found(reading, text="cereal unreachable") == reckoned(
        lambda each: each.object == "Cereal" and each.reason == "IKError"
    )
    assert await failures_found(reading, text="far") == reckoned(lambda each: each.message == "Too far")
    assert await failures_found(reading, text="too far") == reckoned(
        lambda each: each.reason == "IKError" or each.message == "Too far"
    )
    assert await failures_found(reading, limit=3) == [(each.episode, each.sequence) for each in ROOT_FAILURES[:3]]


async def test_no_failure_answers_to_the_description_of_its_episode(reading: Reading) -> None:
    assert await failures_found(reading, text="run of") == []


async def test_failures_are_counted_by_their_cause(reading: Reading) -> None:
    groups = Counter((each.reason, each.dtype, each.object) for each in ROOT_FAILURES)
    rows = await reading.ask.failures_by_cause().rows()
    assert {(each.reason, each.dtype, each.object): each.times for each in rows} == dict(groups)
    assert [each.times for each in rows] == sorted(groups.values(), reverse=True)
    for each in rows:
        own = [
            one
            for one in ROOT_FAILURES
            if (one.reason, one.dtype, one.object) == (each.reason, each.dtype, each.object)
        ]
        assert each.recovered == sum(one.recovered for one in own)
        assert each.episodes == len({one.episode for one in own})
        assert each.a_message == min(one.message or "" for one in own)
    fewer = await reading.ask.failures_by_cause(object="bowl", recovered=False).rows()
    assert sum(each.times for each in fewer) == sum(
        each.object == "bowl" and not each.recovered for each in ROOT_FAILURES
    )


async def test_the_steps_before_a_failure_had_ended_when_it_started(reading: Reading) -> None:
    reckoned = []
    for failure in ROOT_FAILURES:
        ended = [
            each
            for each in NODES
            if each.episode == failure.episode
            and each.started.kind in ("action", "motion")
            and each.end is not None
            and each.end < failure.sequence
        ]
        latest = sorted(ended, key=lambda each: -each.sequence)[:3]
        reckoned += [
            (failure.episode, failure.sequence, number, each.sequence, each.dtype, each.status)
            for number, each in enumerate(latest, 1)
        ]
    rows = await reading.ask.steps_before_failures(steps=3).rows()
    assert [
        names_of(each.episode, each.failure_sequence, each.steps_before, each.sequence, each.dtype, each.status)
        for each in rows
    ] == reckoned


# --- actions --------------------------------------------------------------------------------------------------


async def test_the_longest_actions_come_first(reading: Reading) -> None:
    ended = sorted(
        (each for each in actions() if each.end is not None),
        key=lambda each: (-(each.duration or 0), each.episode, each.sequence),
    )
    rows = await reading.ask.longest_actions(limit=50).rows()
    assert [(each.episode, each.sequence, each.duration_s) for each in rows] == [
        (each.episode, each.sequence, each.duration) for each in ended[:50]
    ]
    assert len(await reading.ask.longest_actions().rows()) == 10
    picked = [each for each in ended if each.dtype == "PickUpAction" and each.status == "SUCCEEDED"]
    rows = await reading.ask.longest_actions(dtype="PickUpAction", status=TaskStatus.SUCCEEDED, limit=None).rows()
    assert [(each.episode, each.sequence) for each in rows] == [(each.episode, each.sequence) for each in picked]


@pytest.mark.parametrize("kind", ["action", "motion"])
async def test_durations_are_summed_up_for_each_type(reading: Reading, kind: Any) -> None:
    rows = {each.dtype: each for each in await reading.ask.durations(kind=kind).rows()}
    nodes = [each for each in NODES if each.started.kind == kind]
    assert rows.keys() == {each.dtype for each in nodes}
    for dtype, row in rows.items():
        own = [each for each in nodes if each.dtype == dtype]
        took = [each.duration for each in own if each.duration is not None]
        assert (row.times, row.succeeded) == (len(own), sum(each.status == "SUCCEEDED" for each in own))
        assert row.failed == sum(each.is_failed for each in own)
        assert (row.total_s, row.shortest_s, row.longest_s) == (sum(took), min(took), max(took))
        assert row.mean_s == pytest.approx(sum(took) / len(took))


async def test_the_uses_of_each_arm_are_counted(reading: Reading) -> None:
    with_arm = [each for each in actions() if "arm" in each.started.parameters and each.episode == 3]
    reckoned = Counter((each.started.parameters["arm"], each.dtype) for each in with_arm)
    rows = await reading.ask.arms_used(episode=3).rows()
    assert {(each.arm, each.dtype): each.times for each in rows} == reckoned
    every = await reading.ask.arms_used().rows()
    assert sum(each.succeeded for each in every) == sum(
        "arm" in each.started.parameters and each.status == "SUCCEEDED" for each in actions()
    )


async def test_successful_pick_ups_have_their_object_arm_and_place(reading: Reading) -> None:
    reckoned = []
    for each in actions():
        if each.dtype == "PickUpAction" and each.status == "SUCCEEDED" and each.started.robot is not None:
            asked, robot = each.started.parameters, each.started.robot
            place = robot.pose.position[:2]
            way = asked["arm"], asked["grasp"]
            reckoned.append((each.episode, each.sequence, each.object, *way, *place, robot.torso_height, robot.name))
    columns = "episode sequence object arm grasp robot_x robot_y torso_height robot".split()

    async def found(**search: Any) -> list[tuple[Any, ...]]:
        rows = await reading.ask.successful_pick_ups(**search).rows()
        return [names_of(*(getattr(row, each) for each in columns)) for row in rows]

    assert await found() == reckoned
    assert await found(object="bowl", arm=Arms.LEFT) == [row for row in reckoned if row[2:4] == ("bowl", "LEFT")]
    assert await found(grasp="top", robot="pr2") == [row for row in reckoned if (row[4], row[8]) == ("TOP", "pr2")]
    assert {row[2] for row in await found(object_type="bowl")} <= set(NAMES)


async def test_the_experience_at_a_place_is_that_of_actions_started_near_it(reading: Reading) -> None:
    groups: dict[tuple[str | None, str | None], list[Node]] = {}
    for each in actions():
        if each.started.robot is not None and each.end is not None:
            x, y, _ = each.started.robot.pose.position
            if math.hypot(x - 0.4, y) <= 0.45:
                groups.setdefault((each.dtype, each.started.parameters.get("arm")), []).append(each)
    rows = await reading.ask.experience_at(0.4, 0.0, radius_m=0.45).rows()
    assert {(each.dtype, each.arm): (each.times, each.succeeded, each.failed) for each in rows} == {
        key: (len(own), sum(each.status == "SUCCEEDED" for each in own), sum(each.is_failed for each in own))
        for key, own in groups.items()
    }
    assert [row.share for row in rows] == pytest.approx([row.succeeded / row.times for row in rows])
    assert await reading.ask.experience_at(100, 100).rows() == []


# --- objects --------------------------------------------------------------------------------------------------


async def test_the_history_of_an_object_is_all_that_happened_to_it(reading: Reading) -> None:
    for name in NAMES:
        rows = await reading.ask.object_history(name.upper()).rows()
        assert [(each.episode, each.sequence, each.what, each.other, each.detail) for each in rows] == [
            (episode.number, *each) for episode in EPISODES for each in course_of(episode, name)
        ]
    of_one = await reading.ask.object_history("milk", episode=2).rows()
    assert [(each.sequence, each.what) for each in of_one] == [each[:2] for each in course_of(EPISODES[1], "milk")]


async def test_each_move_of_an_object_has_the_action_that_moved_it(reading: Reading) -> None:
    by_place = {(each.episode, each.sequence): each for each in NODES}
    reckoned = []
    for episode in EPISODES:
        for sequence, happening in enumerate(episode.happenings, 1):
            if isinstance(happening, ObjectMoved) and happening.name == "milk":
                mover = by_place.get((episode.number, happening.node or 0))
                around = mover.up() if mover is not None else iter(())
                action = next((each for each in around if each.started.kind == "action"), None)
                reckoned.append(
                    (
                        episode.number,
                        sequence,
                        happening.pose.position[0],
                        mover.dtype if mover is not None else None,
                        action.dtype if action is not None else None,
                        action.status if action is not None else None,
                    )
                )
    rows = await reading.ask.moves_of("milk").rows()
    assert {each[3] for each in reckoned} > {None, "MoveMotion"}
    assert [
        names_of(each.episode, each.sequence, each.x, each.moved_by, each.action, each.action_status) for each in rows
    ] == reckoned


# --- episodes -------------------------------------------------------------------------------------------------


async def test_episodes_are_chosen_by_each_condition(reading: Reading) -> None:
    started = {each.number: each.happenings[0] for each in EPISODES}
    ended = {each.number: each.happenings[-1] for each in EPISODES}

    async def chosen(**search: Any) -> list[int]:
        return [each.episode for each in await reading.ask.episodes(**search).rows()]

    def reckoned(condition: Any) -> list[int]:
        numbers = [each for each in sorted(started, reverse=True) if condition(each)]
        assert 0 < len(numbers) < len(EPISODES)
        return numbers

    def start_of(number: int) -> EpisodeStarted:
        happening = started[number]
        assert isinstance(happening, EpisodeStarted)
        return happening

    assert await chosen(status="running") == reckoned(lambda each: not isinstance(ended[each], EpisodeEnded))
    assert await chosen(status=TaskStatus.FAILED) == reckoned(
        lambda each: getattr(ended[each], "status", "") == "FAILED"
    )
    assert await chosen(tag="night") == reckoned(lambda each: "night" in start_of(each).tags)
    assert await chosen(text="TIDY") == reckoned(lambda each: start_of(each).plan == "tidy")
    assert await chosen(text="run 25") == [25]
    assert await chosen(text="kitch") == reckoned(lambda each: "kitchen" in start_of(each).tags)
    assert await chosen(text="_") == []
    assert await chosen(limit=2, text="milk") == [25, 24]
    first = datetime.fromtimestamp(T0_NS / 1e9, UTC)
    assert await chosen(since=first + timedelta(seconds=1)) == list(range(25, 0, -1))
    assert await chosen(since=first + timedelta(seconds=2)) == []
    assert await chosen(robot="pr2") == []
