"""`pycrorm recall` lists the actions most like a cue, explains them, and refuses a wrong cue in one line."""

from __future__ import annotations

import asyncio
from pathlib import Path
from typing import Any

import pytest

from pycrorm_async import Memory
from pycrorm_async.cli.output import Form
from pycrorm_async.cli.reading import ReadingPlace
from pycrorm_async.cli.recall import _parse, recall
from pycrorm_async.errors import CallerError
from pycrorm_async.recall import blocks
from pycrorm_async.world import Arms, Pose
from tests.commands import answer, one_line_of, pycrorm
from tests.recall.sliding_grips import FETCH, GRIP, GripSlidingActionPerformable, record

pytestmark = pytest.mark.slow

DRIVE = "DriveAction"


@pytest.fixture(scope="module")
def folder(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """A folder with a memory of two episodes without a robot, and one with two robots, of which one drives."""
    folder = tmp_path_factory.mktemp("recall")

    async def fill() -> None:
        async with Memory.open(f"sqlite:///{folder / 'pycrorm.db'}") as memory:
            await record(memory)
            drive = memory.recording.type("action", DRIVE, {"speed": float})
            with memory.recording.episode(description="a drive") as episode:
                for robot in ("pr2", "turtle"):
                    episode.object_added(robot, robot, "ROBOT", Pose([0, 0, 0]))
                episode.start("go", drive, {"speed": 0.5}, robot="pr2")
                episode.end("go", "SUCCEEDED")

    asyncio.run(fill())
    return folder


def test_the_words_of_a_cue_are_texts_numbers_and_conditions() -> None:
    assert _parse(
        ["PickUp", "arm=LEFT", "near=A", "near=B", "x~-1.5±0.1", "y~2+-1e-3", "z~3", "not:a=b=c", "only:d=e"]
    ) == (
        "PickUp",
        {"arm": ["LEFT"], "near": ["A", "B"]},
        {"x": (-1.5, 0.1), "y": (2.0, 0.001), "z": (3.0,)},
        {"a": ["b=c"]},
        {"d": ["e"]},
    )


def test_the_actions_most_like_a_cue_are_a_table_with_their_success(folder: Path) -> None:
    done = pycrorm("recall", GRIP, "arm=LEFT", "level~1.1±0.3", "--k", "3", cwd=folder)
    assert (done.returncode, done.stderr) == (0, "")
    assert f"Most like {GRIP} arm=LEFT level~1.1±0.3" in done.stdout
    assert "1.000 │ FAILED" in done.stdout
    assert "pycrorm show 1 --at e" in done.stdout
    assert "  2 of 3 succeeded" in done.stdout or "  1 of 3 succeeded" in done.stdout
    assert "reasons: SlipperyFailure" in done.stdout


def test_why_explains_each_action(folder: Path) -> None:
    done = pycrorm("recall", GRIP, "arm=LEFT", "item=cup", "level~1.2±0.3", "--k", "1", "--why", cwd=folder)
    assert done.returncode == 0
    assert "  alike   item: wanted cup, was cup" in done.stdout
    assert "off, tolerance 0.3)" in done.stdout


def test_json_has_the_cases_with_what_matched(folder: Path) -> None:
    document = answer("recall", GRIP, "arm=LEFT", "item=plate", "--k", "2", cwd=folder)
    assert document["cue"] == f"{GRIP} arm=LEFT item=plate"
    assert document["considered"] == 12
    assert document["never_seen"] == [["item", "plate"]]
    assert document["success"]["tries"] == 2
    first = document["cases"][0]
    assert first["symbols"]["arm"] == "LEFT"
    assert [each["feature"] for each in first["matched"]] == ["arm"]
    assert [each["feature"] for each in first["missed"]] == ["item"]


def test_what_is_like_an_action_is_asked_by_the_event_that_began_it(folder: Path) -> None:
    first = answer("recall", GRIP, "only:status=FAILED", "--episode", "1", cwd=folder)["cases"][0]
    place = f"{first['episode']}/e{first['sequence']}"
    alike = answer("recall", "--like", place, cwd=folder)
    assert len(alike["cases"]) == 10
    assert first["node"] not in [each["node"] for each in alike["cases"]]


def test_what_follows_is_a_table_of_types(folder: Path) -> None:
    done = pycrorm("recall", "--follows", GRIP, "--reason", "SlipperyFailure", cwd=folder)
    assert f"After 4 {GRIP} (SlipperyFailure)" in done.stdout
    assert "(nothing)" in done.stdout
    assert done.stderr == ""
    document = answer("recall", "--follows", FETCH, cwd=folder)
    assert document["cases"] == 2
    assert [each["type"] for each in document["followers"]] == [None, FETCH]


def test_a_type_that_never_occurred_is_an_empty_answer_with_a_note(folder: Path) -> None:
    done = pycrorm("recall", "GripSlidingActon", cwd=folder)
    assert done.returncode == 0
    near = "did you mean GripSlidingAction or FetchSlidingAction?"
    assert done.stdout.splitlines() == [
        "0 of 0 cases for GripSlidingActon", f"  never seen: type GripSlidingActon; {near}",
    ]  # fmt: skip
    assert done.stderr == ""
    as_json = pycrorm("recall", "GripSlidingActon", "--json", cwd=folder)
    assert as_json.stderr == f"no GripSlidingActon has ended in this memory; {near}\n"


@pytest.mark.parametrize(
    ("dtype", "line"),
    [
        (GRIP, "no GripSlidingAction has ended with the reason SlipyFailure; did you mean SlipperyFailure?\n"),
        (FETCH, "no FetchSlidingAction has ended with the reason SlipyFailure\n"),
        ("FlySlidingAction", "no FlySlidingAction has ended in this memory; did you mean"),
    ],
)
def test_a_reason_that_never_occurred_is_an_empty_answer_with_a_note(folder: Path, dtype: str, line: str) -> None:
    done = pycrorm("recall", "--follows", dtype, "--reason", "SlipyFailure", cwd=folder)
    assert done.returncode == 0
    assert f"After 0 {dtype} (SlipyFailure)" in done.stdout
    assert done.stderr.startswith(line)
    assert done.stderr.count("\n") == 1


def test_a_robot_without_an_action_of_the_type_is_an_empty_answer(folder: Path) -> None:
    done = pycrorm("recall", DRIVE, "--robot", "turtle", cwd=folder)
    assert done.returncode == 0
    assert done.stdout.splitlines() == ["0 of 1 cases for DriveAction", "  never seen: robot=turtle"]


WRONG: dict[str, tuple[list[str], dict[str, Any]]] = {
    "name a type or a feature to rank by: `pycrorm recall PickUpAction arm=LEFT`": ([], {}),
    "or add --like": (["only:arm=LEFT"], {}),
    "(FEATURE~NUMBER)": ([GRIP, "level=high"], {}),
    "'high' is not a number": ([GRIP, "level~high"], {}),
    "level is given twice": ([GRIP, "level~1", "level~2"], {}),
    "only texts can be excluded or required": ([GRIP, "not:level~1"], {}),
    "is not a feature: write FEATURE=TEXT or FEATURE~NUMBER": ([GRIP, FETCH], {}),
    "'yesterday' is not a moment": ([GRIP], {"before": "yesterday"}),
    "there is no episode '77'": ([GRIP], {"episode": "77"}),
    "belong to --follows": ([GRIP], {"reason": "IKError"}),
    "write EPISODE/EVENT": ([], {"like": "1"}),
    "leave out the type and the features": ([GRIP], {"like": "1/e3"}),
    "--follows takes one type": ([GRIP, "arm=LEFT"], {"follows": True}),
    "--follows does not take --tag, --limit: leave them out": ([GRIP], {"follows": True, "tag": "kitchen", "k": 3}),
    "--like does not take --episode: leave it out": ([], {"like": "1/e3", "episode": "1"}),
    "no episode has the robot 'pr22'; did you mean pr2?": ([DRIVE], {"robot": "pr22"}),
}


@pytest.mark.parametrize("line", WRONG)
def test_a_wrong_cue_is_refused_in_one_line(folder: Path, line: str) -> None:
    words, options = WRONG[line]
    with pytest.raises(CallerError) as refused:
        recall(cue=words, **options, place=ReadingPlace(f"sqlite:///{folder / 'pycrorm.db'}"), form=Form())
    assert line in str(refused.value)
    assert "\n" not in str(refused.value)


def test_a_wrong_cue_ends_with_the_code_of_usage(folder: Path) -> None:
    done = pycrorm("recall", GRIP, "amr=LEFT", cwd=folder)
    assert done.returncode == 2
    assert "did you mean arm?" in one_line_of(done)


async def test_a_feature_with_too_many_texts_is_left_out_and_status_names_it(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setattr(blocks, "WORDS_MAX", 3)
    async with Memory.open(f"sqlite:///{tmp_path / 'pycrorm.db'}") as memory, memory.episode():
        for number in range(5):
            await GripSlidingActionPerformable(Arms.LEFT, 0.5, f"cup {number}").perform()
    warnings = answer("status", cwd=tmp_path)["warnings"]
    assert warnings == ["recall does not compare item: it has more than 16,384 different texts"]
    done = pycrorm("recall", GRIP, "item=cup 1", cwd=tmp_path)
    assert "item has more than 16,384 different values, so it is not compared" in one_line_of(done)
    assert answer("recall", GRIP, "arm=LEFT", cwd=tmp_path)["considered"] == 5
