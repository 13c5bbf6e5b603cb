"""Questions as texts of SQL and as calls: their arguments, wrong names and values, and answers without rows."""

from __future__ import annotations

import itertools
from datetime import datetime
from pathlib import Path
from typing import Any

import pytest

from pycrorm_async.errors import CallerError, UnknownEpisode
from pycrorm_async.events.types import EpisodeEnded, EpisodeStarted, FailureValue, NodeEnded, NodeStarted, RobotValue
from pycrorm_async.memory import Memory
from pycrorm_async.query.questions import QUESTIONS
from pycrorm_async.query.reading import Reading
from pycrorm_async.world import Pose
from tests.databases import ask_each
from tests.projections.event_script import PICK_UP, Script, declarations, declared, field, name_of, pose
from tests.projections.factories import append_and_fold

pytestmark = pytest.mark.slow


ARGUMENTS: dict[str, dict[str, Any]] = {
    "object_history": {"name": "milk"},
    "moves_of": {"name": "milk"},
    "experience_at": {"x": 0.0, "y": 0.0},
}
OF_EPISODES = [each for each in QUESTIONS if each not in ("experience_at", "episodes")]


async def test_the_sql_of_each_question_returns_its_rows(reading: Reading, filled_url: str) -> None:
    identity = (await reading.episode("3")).id
    questions = [getattr(reading.ask, name)(**ARGUMENTS.get(name, {})) for name in QUESTIONS]
    for episode in (3, identity, "last"):
        questions += [getattr(reading.ask, name)(**ARGUMENTS.get(name, {}), episode=episode) for name in OF_EPISODES]
    texts = [each.sql for each in questions]  # compiled at each access
    by_hand = ask_each(filled_url, texts)
    for each, text, rows in zip(questions, texts, by_hand, strict=True):
        assert len(rows) == len(await each.rows()), text
        assert str(each) == text
    of_three, of_identity, of_last = (
        by_hand[len(QUESTIONS) + start * len(OF_EPISODES) :][: len(OF_EPISODES)] for start in range(3)
    )
    assert of_three == of_identity
    durations = OF_EPISODES.index("durations")
    assert of_identity[durations] != of_last[durations]


@pytest.mark.parametrize("name", ["05", "005", "00", "-5", "aa"])
async def test_a_text_that_is_neither_a_number_nor_begins_an_id_is_no_episode_of_a_statement_either(
    reading: Reading, name: str
) -> None:
    question = reading.ask.durations(episode=name)
    with pytest.raises(UnknownEpisode, match=f"there is no episode '{name}'"):
        await question.rows()
    for write in (lambda: question.statement, lambda: question.sql):
        with pytest.raises(UnknownEpisode, match=f"there is no episode '{name}'; `pycrorm episodes` lists all"):
            write()
    for number in ("5", 5):
        five = reading.ask.durations(episode=number)
        assert await reading.rows(five.statement) == await five.rows() != []


async def test_digits_with_which_several_ids_begin_name_no_episode_of_a_statement(reading: Reading) -> None:
    identity = (await reading.episode("5")).id
    for episode, rows in {
        "0000": [],
        "ffff": [],
        identity: await reading.ask.durations(episode=5).rows(),
    }.items():
        assert await reading.rows(reading.ask.durations(episode=episode).statement) == rows, episode
    with pytest.raises(UnknownEpisode, match="25 episodes have an id that begins with '0000': use more of its digits"):
        await reading.ask.durations(episode="0000").rows()


async def test_a_question_is_awaited_for_a_frame_of_its_columns(reading: Reading) -> None:
    for name in QUESTIONS:
        question = getattr(reading.ask, name)(**ARGUMENTS.get(name, {}))
        frame = await question
        assert list(frame.columns) == list(question.statement.selected_columns.keys())
        assert len(frame) == len(await question.rows())


async def test_a_question_to_an_empty_memory_has_no_rows(database_url: str) -> None:
    await append_and_fold(database_url, [])
    async with Reading.open(database_url) as reading:
        for name in QUESTIONS:
            question = getattr(reading.ask, name)(**ARGUMENTS.get(name, {}))
            assert await question.rows() == []
            assert (await question).empty


async def test_the_plan_of_each_question_about_an_episode_uses_an_index(reading: Reading, filled_url: str) -> None:
    """The memory is small: the server is kept from reading a whole table because it is small."""
    names = [each for each in QUESTIONS if each != "episodes"]
    statements = [
        getattr(reading.ask, name)(**ARGUMENTS.get(name, {}), **({"episode": 3} if name in OF_EPISODES else {})).sql
        for name in names
    ]
    if filled_url.startswith("sqlite"):
        plans = ask_each(filled_url, [f"EXPLAIN QUERY PLAN {each}" for each in statements])
    else:
        plans = ask_each(filled_url, ["SET enable_seqscan = off", *(f"EXPLAIN {each}" for each in statements)])[1:]
    for name, plan in zip(names, plans, strict=True):
        steps = [str(step[-1]) for step in plan]
        of_tables = [each for each in steps if each.startswith("SCAN zz_") or "Seq Scan on zz_" in each]
        scans = [each for each in of_tables if "INDEX" not in each and "simulated_episode" not in each]
        # The places of robots have no index: a question about a place reads the actions and looks up each pose.
        assert len(scans) <= (name == "experience_at"), "\n".join(steps)
        assert any("INDEX" in each.upper() for each in steps), "\n".join(steps)


@pytest.mark.soak_on("postgresql")
async def test_wrong_names_and_values_are_answered_with_the_right_ones(reading: Reading) -> None:
    ask = reading.ask
    with pytest.raises(AttributeError, match=r"no question root_failure; did you mean root_failures"):
        ask.root_failure  # type: ignore[attr-defined]  # noqa: B018
    with pytest.raises(CallerError, match=r"root_failures has no argument objekt; did you mean object\?$"):
        ask.root_failures(objekt="milk")  # type: ignore[call-arg]
    with pytest.raises(CallerError, match="no status 'SUCEEDED'; did you mean SUCCEEDED"):
        ask.episodes(status="SUCEEDED")
    with pytest.raises(CallerError, match="no arm 'lefft'; did you mean LEFT"):
        ask.successful_pick_ups(arm="lefft")
    with pytest.raises(CallerError, match="no grasp 'tip'; did you mean TOP"):
        ask.successful_pick_ups(grasp="tip")
    with pytest.raises(CallerError, match="limit must be a whole number from 1"):
        ask.root_failures(limit=0)
    with pytest.raises(CallerError, match="steps must be a whole number from 1 to 100, got 1000"):
        ask.steps_before_failures(steps=1_000)
    with pytest.raises(CallerError, match="x must be a number of metres, got 'left'"):
        ask.experience_at("left", 0)  # type: ignore[arg-type]
    with pytest.raises(CallerError, match="x must be a number of metres, got 1000"):
        ask.experience_at(10**400, 0)
    for name, value in (("arm", 3), ("object", b"milk"), ("text", ["a"]), ("reason", 1.5), ("message", True)):
        with pytest.raises(CallerError, match=f"{name} must be a text, got"):
            ask.root_failures(**{name: value})  # type: ignore[arg-type]
    for text in ("a\0b", "\ud800"):
        with pytest.raises(CallerError, match=r"tag has U\+0000 or half of a surrogate pair"):
            ask.episodes(tag=text)
        with pytest.raises(CallerError, match=r"name has U\+0000"):
            ask.object_history(text)
    with pytest.raises(CallerError, match="text has 31 words, and at most 30 are searched for"):
        ask.root_failures(text="x " * 31)
    with pytest.raises(CallerError, match="dtype must be a text"):
        ask.durations(dtype=int)  # type: ignore[arg-type]
    with pytest.raises(CallerError, match="recovered must be True or False, got 'yes'"):
        ask.root_failures(recovered="yes")  # type: ignore[arg-type]
    with pytest.raises(CallerError, match="since must be a datetime with a time zone, got 'today'"):
        ask.episodes(since="today")  # type: ignore[arg-type]
    with pytest.raises(CallerError, match="radius_m must be > 0"):
        ask.experience_at(0, 0, radius_m=0)
    with pytest.raises(CallerError, match="kind must be"):
        ask.durations(kind="actions")  # type: ignore[arg-type]
    with pytest.raises(CallerError, match="since has no time zone"):
        ask.episodes(since=datetime(2026, 1, 1))  # noqa: DTZ001
    with pytest.raises(CallerError, match=r"got 1\.5"):
        await ask.durations(episode=1.5).rows()  # type: ignore[arg-type]
    with pytest.raises(UnknownEpisode, match="there is no episode '99'"):
        await ask.durations(episode=99)


@pytest.mark.parametrize(
    ("question", "arguments", "suggests"),
    [
        ("root_failures", {"arm": "lefft"}, "no arm lefft; did you mean LEFT"),
        ("root_failures", {"object": "mlik"}, "no object mlik; did you mean milk"),
        ("root_failures", {"reason": "unreachabel"}, "no reason unreachabel; did you mean unreachable"),
        ("failures_by_cause", {"reason": "ColisionEror"}, "no reason ColisionEror; did you mean CollisionError"),
        ("moves_of", {"name": "mlik"}, "no object mlik; did you mean milk"),
        ("object_history", {"name": "mil"}, "no object mil; did you mean milk"),
        ("durations", {"dtype": "PickUpActoin"}, "no type PickUpActoin; did you mean PickUpAction"),
        ("successful_pick_ups", {"object": "mlik"}, "no object mlik; did you mean milk"),
    ],
)
@pytest.mark.soak_on("postgresql")
async def test_an_empty_answer_about_an_unknown_name_warns_with_the_nearest_one(
    reading: Reading, question: str, arguments: dict[str, str], suggests: str
) -> None:
    with pytest.warns(UserWarning, match=rf"^no row answers: the memory has {suggests}"):
        assert await getattr(reading.ask, question)(**arguments).rows() == []


async def test_an_empty_answer_about_a_name_of_the_memory_or_an_unlike_one_warns_of_nothing(reading: Reading) -> None:
    assert await reading.ask.root_failures(object="MILK", message="no such text").rows() == []
    assert await reading.ask.root_failures(object="helicopter").rows() == []
    with pytest.warns(UserWarning, match="mlik"):
        assert (await reading.ask.moves_of("mlik")).empty


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


def test_a_memory_without_asyncio_answers_with_frames_and_rows(tmp_path: Path) -> None:
    with Memory.sync(f"sqlite:///{tmp_path}/memory.db") as memory:
        note = memory.recording.type("action", "NoteAction", {"text": str})
        with memory.recording.episode(description="notes") as episode:
            for number in range(3):
                episode.start(number, note, {"text": "a"})
                episode.end(number, "FAILED" if number == 1 else "SUCCEEDED", "broken" if number == 1 else None)
        memory.flush()
        question = memory.ask.durations(episode="last")
        assert [(each.dtype, each.times, each.failed) for each in question.rows()] == [("NoteAction", 3, 1)]
        assert question.frame()["succeeded"].tolist() == [2]
        assert "GROUP BY" in question.sql
        assert memory.query("SELECT count(*) FROM action").rows == [(3,)]
    with pytest.raises(CallerError, match="not open"):
        memory.ask.durations()
    assert list(itertools.islice(QUESTIONS, 2)) == ["root_failures", "failures_by_cause"]


# --- names that are not ASCII, or not as they are written -----------------------------------------------------


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
    script.put(EpisodeStarted("", "me", "host", "1", "3.11"))
    for type_, arm in ((numbered, 3), (listed, ["LEFT", "RIGHT"]), (PICK_UP, "LEFT")):
        robot = RobotValue(pose(), "ROBOT", None)
        node = script.put(NodeStarted("action", None, name_of(type_), {"arm": arm}, robot))
        script.put(NodeEnded(node, "FAILED", FailureValue("ValueError", "")))
    script.put(EpisodeEnded("FAILED"))
    await append_and_fold(database_url, [*declarations(numbered, listed, PICK_UP), *script.records])
    async with Reading.open(database_url) as reading:
        assert (await reading.ask.root_failures()).arm.tolist() == ["3", '["LEFT","RIGHT"]', "LEFT"]
        assert sorted((await reading.ask.arms_used()).arm) == ["3", "LEFT", '["LEFT","RIGHT"]']
        assert sorted((await reading.ask.experience_at(0, 0)).arm) == ["3", "LEFT", '["LEFT","RIGHT"]']
        assert [each.dtype for each in await reading.ask.root_failures(arm="3").rows()] == ["NumberedArm"]
