"""`pycrorm diff` of two episodes as a page, and of more than two as the nodes at which they part."""

from __future__ import annotations

import itertools
import json
from pathlib import Path

import pytest
from typer.testing import CliRunner

from pycrorm_async import Memory
from pycrorm_async.cli.main import app
from pycrorm_async.visible_text import visible
from pycrorm_async.world.pose import Pose
from tests.report.browser import Browser

HOSTILE = "</script><b onload=alert(1)>\u202e"
RUNS = (
    {"Reach": "", "Grip": "", "Lift": ""},
    {"Look": "", "Reach": "", "Grip": f"slipped {HOSTILE}"},
    {"Reach": "", "Grip": "", "Lift": ""},
    {"Look": "", "Reach": "", "Grip": "", "Lift": "too heavy"},
)
"""The motions of each run in order, with the message of one that fails; the whole fails with it."""
TEXTS = "[...document.querySelectorAll('#nodes tbody tr')].map((each) => each.children[0].textContent + ': ' + {})"
MARKS = TEXTS.format("[...each.querySelectorAll('.mark')].map((mark) => mark.textContent).join()")


@pytest.fixture(scope="module")
def url(tmp_path_factory: pytest.TempPathFactory) -> str:
    """Return the URL of a memory with four runs of one plan, and a fifth episode that still runs and has one node."""
    address = f"sqlite:///{tmp_path_factory.mktemp('runs')}/memory.db"
    with Memory.sync(address) as memory:
        take = memory.recording.type("action", "TakeAction", {"what": str})
        steps = {
            each: memory.recording.type("motion", each, {"speed": float}) for each in ("Look", "Reach", "Grip", "Lift")
        }
        for number, run in enumerate(RUNS):
            times = (1_750_000_000_000_000_000 + second * 1_000_000_000 for second in itertools.count())
            text = f"take it {HOSTILE if number == 1 else ''}"
            episode = memory.recording.episode(description=text, at=next(times))
            if number < 2:
                episode.object_added("milk", "milk", "MILK", Pose([number, 0, 0]), at=next(times))
            episode.start("take", take, {"what": "milk"}, at=next(times))
            for name, message in run.items():
                values = {"speed": 0.1 + (name == "Reach") * number}
                episode.start(name, steps[name], values, parent="take", at=next(times))
                if name == "Reach" and number == 0:
                    next(times)
                episode.end(name, "FAILED" if message else "SUCCEEDED", message or None, at=next(times))
            failed = any(run.values())
            episode.end("take", "FAILED" if failed else "SUCCEEDED", "not taken" if failed else None, at=next(times))
            episode.close(at=next(times))
        memory.recording.episode(description="still open")
        memory.flush()
    return address


def diff(url: str, *arguments: object) -> tuple[int, str]:
    done = CliRunner().invoke(app("diff"), ["diff", *map(str, arguments), "--url", url])
    return done.exit_code, done.output


@pytest.mark.slow
def test_the_page_of_two_episodes_marks_what_differs_in_aligned_trees(
    chrome: Browser, url: str, tmp_path: Path
) -> None:
    page = tmp_path / "diff.html"
    assert diff(url, 1, 2, "--html", page) == (0, f"{page}\n")
    with chrome.open(page) as tab:
        assert tab.ask(MARKS) == [
            "root: ", "TakeAction: ended otherwise", "Look: only in B",
            "Reach: other parameters,A took 2.0 times as long", "Grip: ended otherwise", "Lift: only in A",
        ]  # fmt: skip
        assert f"slipped {HOSTILE}" not in tab.ask("document.getElementById('nodes').innerHTML")
        facts = tab.ask("document.getElementById('differences').textContent")
        assert f"take it {visible(HOSTILE)}" in facts
        assert "object milk(0.000, 0.000, 0.000)(1.000, 0.000, 0.000)place" in facts
        captions = "[...document.querySelectorAll('.twin > .hint')].map((each) => each.textContent.split('event ')[1])"
        ends = tab.ask(captions)
        tab.ask("[...document.querySelectorAll('#nodes .link')][3].click()")  # Reach
        assert tab.ask(captions) == ["6", "8"] != ends
        assert tab.ask("document.querySelector('#nodes tr.lit').textContent").startswith("Reach")
        assert tab.ask("document.documentElement.scrollWidth") == 1400
        assert tab.problems() == []
    for pair, count in ((("1", "1"), "0 of 5 nodes differ"), (("1", "5"), "2 of 5 nodes differ")):
        assert diff(url, *pair, "--html", page, "--force")[0] == 0
        with chrome.open(page, width=390) as tab:
            assert tab.ask("document.querySelector('#nodes h2').textContent").startswith(count), pair
            assert tab.ask("document.documentElement.scrollWidth") == 390
            assert tab.problems() == []


def test_more_episodes_are_the_nodes_at_which_they_part(url: str) -> None:
    code, text = diff(url, 1, 2, 3, 4, "--json")
    assert code == 0
    assert [(each["where"], each["runs"], each["outcomes"]) for each in json.loads(text)] == [
        ("root > TakeAction", 4, {"SUCCEEDED": [1, 3], "FAILED (not taken)": [2, 4]}),
        ("root > TakeAction > Look", 4, {"not started": [1, 3], "SUCCEEDED": [2, 4]}),
        ("root > TakeAction > Grip", 4, {"SUCCEEDED": [1, 3, 4], f"FAILED (slipped {HOSTILE.replace('1', '#')})": [2]}),
        ("root > TakeAction > Lift", 4, {"SUCCEEDED": [1, 3], "not started": [2], "FAILED (too heavy)": [4]}),
    ]
    shown = diff(url, 1, 2, 3, 4)[1]
    assert "2 of 4" in shown
    assert diff(url, 1, 3, 1)[1] == "0 nodes that ended in several ways\n"


def test_a_page_that_cannot_be_written_is_one_line(url: str, tmp_path: Path) -> None:
    for arguments, message in (
        ((1, 9, "--html", tmp_path / "a.html"), "there is no episode '9' (`pycrorm episodes` lists all 5)"),
        ((1, 2, "--html", tmp_path), f"{tmp_path} is a folder: give the name of a file in it"),
        ((1, 2, 3, "--html", tmp_path / "a.html"), "--html compares two episodes: name two"),
        ((1, 2, 99), "there is no episode '99' (`pycrorm episodes` lists all 5)"),
    ):
        code, text = diff(url, *arguments)
        assert (code, text.count("\n"), list(tmp_path.iterdir())) == (2, 1, []), text
        assert message in text
