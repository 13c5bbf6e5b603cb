"""The named questions: answers reckoned from the events of random memories, arguments, and wrong names."""

from __future__ import annotations

import math
from collections import Counter
from datetime import UTC, datetime, timedelta
from pathlib import Path
from typing import Any

import pytest

from pycrorm_async.errors import CallerError, UnknownEpisode
from pycrorm_async.events import types as events
from pycrorm_async.memory import Memory
from pycrorm_async.query.questions import QUESTIONS
from pycrorm_async.query.reading import Reading
from pycrorm_async.task_status import TaskStatus
from pycrorm_async.world import Pose
from pycrorm_async.world.pose import Arms, Grasp
from tests.databases import ask_each
from tests.projections.event_script import (
    NAVIGATE,
    PICK_UP,
    T0_NS,
    Script,
    append_and_fold,
    declarations,
    declared,
    field,
    name_of,
    pose,
)
from tests.query.random_memory import EPISODES, NAMES, Node, course_of, nodes_of, root_failures_of

pytestmark = pytest.mark.slow


# === asking ===================================================================================================
#
# The named questions, against answers reckoned from the events of random memories, on both databases.

NODES = nodes_of(EPISODES)
ROOT_FAILURES = root_failures_of(EPISODES)


def names_of(*members: Any) -> tuple[Any, ...]:
    return tuple(each.name if isinstance(each, TaskStatus | Arms | Grasp) else each for each in members)


def actions() -> list[Node]:
    return [each for each in NODES if each.started.kind == "action"]


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
    assert await failures_found(reading, text="run of") == []  # which is in the descriptions of the episodes
    assert await failures_found(reading, limit=3) == [(each.episode, each.sequence) for each in ROOT_FAILURES[:3]]


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


async def test_a_missing_value_has_the_same_place_in_the_order_on_both_databases(database_url: str) -> None:
    script = Script(1)
    script.put(events.EpisodeStarted("orders", "me", "host", "1", "3.11"))
    root = script.put(events.NodeStarted("root"))
    milk = script.put(events.ObjectAdded("milk", "MILK", pose(1)))
    script.put(events.NodeStarted("action", root, name_of(NAVIGATE)))  # runs, so that its type has no duration
    for parameters in ({"object_designator": events.ObjectReference(milk, milk)}, {}):
        node = script.put(events.NodeStarted("action", root, name_of(PICK_UP), parameters))
        script.put(events.NodeEnded(node, "FAILED", events.FailureValue("a.IKError", "too far")))
    await append_and_fold(database_url, [*declarations(NAVIGATE, PICK_UP), *script.records])
    async with Reading.open(database_url) as reading:
        assert [each.dtype for each in await reading.ask.durations(limit=1).rows()] == ["PickUpAction"]
        assert [each.object for each in await reading.ask.failures_by_cause(limit=1).rows()] == [None]


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
            assert robot.pose is not None
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
            assert each.started.robot.pose is not None
            x, y, _ = each.started.robot.pose.position
            if math.hypot(x - 0.4, y) <= 0.45:
                groups.setdefault((each.dtype, each.started.parameters.get("arm")), []).append(each)
    rows = await reading.ask.experience_at(0.4, 0.0, radius_m=0.45).rows()
    assert {(each.dtype, each.arm): (each.times, each.succeeded, each.failed) for each in rows} == {
        key: (len(own), sum(each.status == "SUCCEEDED" for each in own), sum(each.is_failed for each in own))
        for key, own in groups.items()
    }
    tried = [(row.succeeded, row.succeeded + row.failed) for row in rows]
    assert [row.share for row in rows] == pytest.approx([good / tries if tries else None for good, tries in tried])
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
            if isinstance(happening, events.ObjectMoved) and happening.name == "milk":
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

    def start_of(number: int) -> events.EpisodeStarted:
        happening = started[number]
        assert isinstance(happening, events.EpisodeStarted)
        return happening

    assert await chosen(status="running") == reckoned(lambda each: not isinstance(ended[each], events.EpisodeEnded))
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


# === question arguments =======================================================================================
#
# Questions as texts of SQL and as calls: their arguments, wrong names and values, and answers without rows.

ARGUMENTS: dict[str, dict[str, Any]] = {
    "object_history": {"name": "milk"},
    "moves_of": {"name": "milk"},
    "experience_at": {"x": 0.0, "y": 0.0},
}


@pytest.mark.soak_on("postgresql")
async def test_the_sql_of_each_question_returns_its_rows(reading: Reading, filled_url: str) -> None:
    identity = (await reading.episode("3")).id
    questions = [getattr(reading.ask, name)(**ARGUMENTS.get(name, {})) for name in QUESTIONS]
    for episode in (3, identity, "last"):
        questions += [getattr(reading.ask, name)(**ARGUMENTS.get(name, {}), episode=episode) for name in QUESTIONS]
    texts = [each.sql for each in questions]  # compiled at each access
    by_hand = ask_each(filled_url, texts)
    for each, text, rows in zip(questions, texts, by_hand, strict=True):
        frame = await each
        assert len(rows) == len(await each.rows()) == len(frame), text
        assert list(frame.columns) == list(each.statement.selected_columns.keys())
        assert str(each) == text
    of_three, of_identity, of_last = (by_hand[start * len(QUESTIONS) :][: len(QUESTIONS)] for start in range(1, 4))
    assert of_three == of_identity
    durations = [*QUESTIONS].index("durations")
    assert of_identity[durations] != of_last[durations]


async def test_a_statement_names_an_episode_by_its_number_or_its_whole_id(reading: Reading) -> None:
    for episode in ("5", 5, (await reading.episode("5")).id.upper()):
        five = reading.ask.durations(episode=episode)
        assert await reading.rows(five.statement) == await five.rows() != []
    for name, refusal in (("0000", "25 episodes have an id that begins with '0000'"), ("05", "no episode '05'")):
        question = reading.ask.durations(episode=name)
        with pytest.raises(UnknownEpisode, match=refusal):
            await question.rows()
        for attribute in ("statement", "sql"):
            with pytest.raises(CallerError, match=f"by its number, its whole id or `last`, got '{name}'"):
                getattr(question, attribute)


@pytest.mark.soak_on("postgresql")
async def test_a_question_to_an_empty_memory_has_no_rows(database_url: str) -> None:
    await append_and_fold(database_url, [])
    async with Reading.open(database_url) as reading:
        for name in QUESTIONS:
            question = getattr(reading.ask, name)(**ARGUMENTS.get(name, {}))
            assert await question.rows() == []
            assert (await question).empty


WRONG: list[tuple[str, dict[str, Any], str]] = [
    ("root_failures", {"objekt": "milk"}, r"root_failures has no argument objekt; did you mean object\?$"),
    ("episodes", {"status": "SUCEEDED"}, "no status 'SUCEEDED'; did you mean SUCCEEDED"),
    ("successful_pick_ups", {"arm": "lefft"}, "no arm 'lefft'; did you mean LEFT"),
    ("successful_pick_ups", {"grasp": "tip"}, "no grasp 'tip'; did you mean TOP"),
    ("root_failures", {"limit": 0}, "limit must be a whole number from 1"),
    ("steps_before_failures", {"steps": 1_000}, "steps must be a whole number from 1 to 100, got 1000"),
    ("experience_at", {"x": "left", "y": 0}, "x must be a number of metres, got 'left'"),
    ("experience_at", {"x": 10**400, "y": 0}, "x must be a number of metres, got 1000"),
    ("experience_at", {"x": 0, "y": 0, "radius_m": 0}, "radius_m must be > 0"),
    *(
        ("root_failures", {name: value}, f"{name} must be a text, got")
        for name, value in (("arm", 3), ("object", b"milk"), ("text", ["a"]), ("reason", 1.5), ("message", True))
    ),
    ("episodes", {"tag": "a\0b"}, r"tag has U\+0000 or half of a surrogate pair"),
    ("object_history", {"name": "\ud800"}, r"name has U\+0000"),
    ("root_failures", {"text": "x " * 31}, "text has 31 words, and at most 30 are searched for"),
    ("durations", {"dtype": int}, "dtype must be a text"),
    ("root_failures", {"recovered": "yes"}, "recovered must be True or False, got 'yes'"),
    ("episodes", {"since": "today"}, "since must be a datetime with a time zone, got 'today'"),
    ("episodes", {"since": datetime(2026, 1, 1)}, "since has no time zone"),  # noqa: DTZ001
    ("durations", {"kind": "actions"}, "kind must be"),
]


@pytest.mark.soak_on("postgresql")
async def test_wrong_names_and_values_are_answered_with_the_right_ones(reading: Reading) -> None:
    for question, arguments, refusal in WRONG:
        with pytest.raises(CallerError, match=refusal):
            getattr(reading.ask, question)(**arguments)
    with pytest.raises(AttributeError, match=r"no question root_failure; did you mean root_failures"):
        reading.ask.root_failure  # type: ignore[attr-defined]  # noqa: B018
    with pytest.raises(CallerError, match=r"got 1\.5"):
        await reading.ask.durations(episode=1.5).rows()  # type: ignore[arg-type]
    with pytest.raises(UnknownEpisode, match="there is no episode '99'"):
        await reading.ask.durations(episode=99)


UNKNOWN: list[tuple[str, dict[str, str], str]] = [
    ("root_failures", {"arm": "lefft"}, "no arm lefft; did you mean LEFT"),
    ("root_failures", {"object": "mlik"}, "no object mlik; did you mean milk"),
    ("root_failures", {"reason": "unreachabel"}, "no reason unreachabel; did you mean unreachable"),
    ("failures_by_cause", {"reason": "ColisionEror"}, "no reason ColisionEror; did you mean CollisionError"),
    ("object_history", {"name": "mil"}, "no object mil; did you mean milk"),
    ("durations", {"dtype": "PickUpActoin"}, "no type PickUpActoin; did you mean PickUpAction"),
]


@pytest.mark.soak_on("postgresql")
async def test_an_empty_answer_about_an_unknown_name_warns_with_the_nearest_one(reading: Reading) -> None:
    for question, arguments, suggests in UNKNOWN:
        with pytest.warns(UserWarning, match=rf"^no row answers: the memory has {suggests}"):
            assert await getattr(reading.ask, question)(**arguments).rows() == []
    with pytest.warns(UserWarning, match="mlik"):
        assert (await reading.ask.moves_of("mlik")).empty
    # A name that the memory has, or one unlike all others, is no mistake.
    assert await reading.ask.root_failures(object="MILK", message="no such text").rows() == []
    assert await reading.ask.root_failures(object="helicopter").rows() == []


async def test_a_question_to_a_closed_memory_is_refused_and_opens_no_connection(tmp_path: Path) -> None:
    url = f"sqlite:///{tmp_path}/memory.db"
    async with Memory.open(url) as memory:
        question = memory.ask.durations()
        assert await question.rows() == []
    for call in (question.rows, question.frame, lambda: memory.query("SELECT 1"), lambda: memory.diff(1, 2)):
        with pytest.raises(CallerError, match=r"closed|not open"):
            await call()
    with pytest.raises(CallerError, match="this memory is not open"):
        memory.ask  # noqa: B018
    async with Reading.open(url) as reading:
        pass
    with pytest.raises(CallerError, match="this memory is closed: open it again"):
        await reading.query("SELECT 1")


# --- names that are not ASCII, or not as they are written -----------------------------------------------------


@pytest.mark.soak_on("postgresql")
@pytest.mark.filterwarnings("ignore:no row answers")
def test_names_are_found_whatever_their_letters_are(database_url: str, tmp_path: Path) -> None:
    with Memory.sync(database_url, spool=tmp_path / "spool") as memory:
        take = memory.recording.type("action", "TakeAction", {"thing": str})
        with memory.recording.episode(description="Fetch the Äpfel", tags=["harvest"]) as episode:
            episode.object_added("base", "turtle", "ROBOT", Pose([0, 0, 0]))
            episode.object_added("apples", "Äpfel", "GENERIC_OBJECT", Pose([0, 0, 0]))
            episode.object_added("share", "50%_A/b", "GENERIC_OBJECT", Pose([0, 0, 0]))
            episode.start("take", take, {"thing": "Äpfel"})
            episode.object_moved("apples", Pose([1, 0, 0]), node="take")
            episode.end("take", "FAILED", "no Äpfel / 50%_A/b")
        memory.flush()
        ask = memory.ask
        for name, moves in (("Äpfel", 1), ("ÄPFEL", 1), ("Äpfe_", 0), ("50%_a/B", 0), ("50%aA/b", 0)):
            assert len(ask.moves_of(name).rows()) == moves, name
        assert [each.what for each in ask.object_history("Äpfel").rows()] == ["added", "moved"]
        assert ask.durations(episode="last").frame()["failed"].tolist() == [1]
        assert "GROUP BY" in ask.durations().sql
        assert [each.what for each in ask.object_history("50%_a/B").rows()] == ["added"]
        for part, failures in (("NO Äpf", 1), ("%_a/B", 1), ("50__A/b", 0), ("Ä%l", 0)):
            assert len(ask.root_failures(message=part).rows()) == failures, part
        assert len(ask.episodes(text="the Äpfel").rows()) == 1
        for question in (ask.episodes(robot="turtel"), ask.successful_pick_ups(robot="turtel")):
            with pytest.warns(UserWarning, match=r"no robot turtel; did you mean turtle\?"):
                assert question.rows() == []
        with pytest.warns(UserWarning, match=r"no tag harvets; did you mean harvest\?"):
            assert ask.episodes(tag="harvets").rows() == []


# --- arms that are not names ----------------------------------------------------------------------------------


async def test_an_arm_that_is_a_number_or_a_list_is_text_on_both_databases(database_url: str) -> None:
    numbered = declared("NumberedArm", "numbered_arm", field("arm", "integer", 2))
    listed = declared("ListedArm", "listed_arm", field("arm", "list", 2, item="text"))
    script = Script(1)
    script.put(events.EpisodeStarted("", "me", "host", "1", "3.11"))
    for type_, arm in ((numbered, 3), (listed, ["LEFT", "RIGHT"]), (PICK_UP, "LEFT")):
        robot = events.RobotValue(pose(), "ROBOT", None)
        node = script.put(events.NodeStarted("action", None, name_of(type_), {"arm": arm}, robot))
        script.put(events.NodeEnded(node, "FAILED", events.FailureValue("ValueError", "")))
    script.put(events.EpisodeEnded("FAILED"))
    await append_and_fold(database_url, [*declarations(numbered, listed, PICK_UP), *script.records])
    async with Reading.open(database_url) as reading:
        assert (await reading.ask.root_failures()).arm.tolist() == ["3", '["LEFT","RIGHT"]', "LEFT"]
        assert sorted((await reading.ask.arms_used()).arm) == ["3", "LEFT", '["LEFT","RIGHT"]']
        assert sorted((await reading.ask.experience_at(0, 0)).arm) == ["3", "LEFT", '["LEFT","RIGHT"]']
        assert [each.dtype for each in await reading.ask.root_failures(arm="3").rows()] == ["NumberedArm"]
