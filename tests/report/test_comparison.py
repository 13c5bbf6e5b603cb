"""`pycrorm diff` of two episodes as a page, and of more than two as the nodes at which they part."""

from __future__ import annotations

import itertools
import json
from pathlib import Path

import pytest
from typer.testing import CliRunner

from pycrorm_async import Memory
from pycrorm_async.cli.main import app
from pycrorm_async.query.episode_diff import _united
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


def test_runs_that_are_one_episode_are_refused(url: str, tmp_path: Path) -> None:
    reason = "pycrorm: all 3 episodes are episode 1: name others to compare it with\n"
    assert diff(url, 1, 1, 1) == (2, reason)
    assert diff(url, 1, 1, 1, "--html", tmp_path / "diff.html") == (2, reason)


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
    assert shown.endswith("\n4 nodes that ended in several ways; first root > TakeAction > Look\n")
    assert [each["where"] for each in json.loads(text) if each["first"]] == ["root > TakeAction > Look"]
    assert diff(url, 1, 3, 1)[1] == "0 nodes that ended in several ways\n"


def test_nodes_of_more_runs_are_in_the_order_of_the_tree() -> None:
    first = [(), "a", "ax", "aw", "b"]
    trees = [first, [(), "a", "ax", "f"], [(), "c", "cy", "a", "ay", "aw", "b", "bz"], first]
    paths = [[tuple((name, 1) for name in f"r{''.join(each)}") for each in tree] for tree in trees]
    united = ["".join(name for name, _ in path) for path in _united(paths)]
    assert united == ["r", "rc", "rcy", "ra", "ray", "rax", "raw", "rf", "rb", "rbz"]


@pytest.mark.slow
def test_both_scenes_are_played_on_one_clock(chrome: Browser, url: str, tmp_path: Path) -> None:
    page = tmp_path / "diff.html"
    assert diff(url, 1, 2, "--html", page)[0] == 0
    note = """const { onEvent } = pycrormComparison.playback; globalThis.shown = [];
      pycrormComparison.playback.onEvent = (index) => { onEvent(index);
        shown.push([pycrormComparison.seconds,
          ...[...document.querySelectorAll('.twin > .hint')].map(
            (each) => Number(each.textContent.split('event ')[1]))]); }; 0"""
    times = "pycrormComparison.sides.map(({ episode }) => episode.times)"
    with chrome.open(page) as tab:
        tab.ask(note)
        button = "document.querySelector('#controls button')"
        assert tab.ask(f"[{button}.getAttribute('aria-label'), document.activeElement.tagName]") == ["play", "BODY"]
        tab.press(" ")
        assert tab.ask(f"[{button}.getAttribute('aria-label'), {button}.textContent]") == ["pause", "❚❚"]
        tab.wait_for("shown.length > 2")
        tab.press(" ")
        assert tab.ask(f"[{button}.getAttribute('aria-label'), pycrormComparison.playback.running]") == ["play", False]
        paused = tab.ask("pycrormComparison.seconds")
        tab.ask(
            f"{button}.click(); pycrormComparison.slider.value = 900; "
            "pycrormComparison.slider.dispatchEvent(new Event('input'))"
        )  # the playback continues from this moment
        tab.wait_for("!pycrormComparison.playback.running")
        shown, (first, second) = tab.ask("shown"), tab.ask(times)
        assert [each[0] for each in shown] == sorted(each[0] for each in shown)
        assert shown[-1][0] == tab.ask("pycrormComparison.longest") > paused
        assert not any(paused < each[0] < 0.9 * shown[-1][0] for each in shown)
        for seconds, *events in shown:
            for event, side in zip(events, (first, second), strict=True):
                assert event == sum(each <= seconds * 1e6 + 1 for each in side)
        assert tab.ask(f"{button}.getAttribute('aria-label')") == "play"
        tab.ask("document.querySelector('#nodes h2 button').focus()")
        tab.press(" ")  # presses the focused button, and does not play
        pressed = "document.querySelector('#nodes h2 button').getAttribute('aria-pressed')"
        assert tab.ask(f"[{pressed}, pycrormComparison.playback.running]") == ["true", False]
        tab.ask(f"{button}.click()")
        assert tab.ask("[pycrormComparison.playback.running, pycrormComparison.seconds < 1]") == [True, True]
        tab.ask("document.querySelector('#nodes .link').click()")
        assert not tab.ask("pycrormComparison.playback.running")
        assert tab.problems() == []


@pytest.mark.slow
def test_the_page_of_more_runs_counts_their_ways_marks_the_first_parting_and_leads_to_each(
    chrome: Browser, url: str, tmp_path: Path
) -> None:
    page = tmp_path / "four runs.html"
    assert diff(url, 1, 2, 3, 4, "--html", page) == (0, f"{page}\n")
    folder = tmp_path / "four runs.pages"
    assert sorted(each.name for each in folder.iterdir()) == [f"episode-{each}.html" for each in (1, 2, 3, 4)]
    rows = """[...document.querySelectorAll('#nodes tbody tr')].map((each) =>
      [...each.querySelectorAll('bdi.name, .mark, .way, td.run')].map((part) => part.textContent))"""
    slipped = f"FAILED (slipped {visible(HOSTILE.replace('1', '#'))})"
    none = "\N{EN DASH}"
    parted = [
        ["TakeAction", "✓2 SUCCEEDED", "✗2 FAILED (not taken) 2 4", *"✓✗✓✗"],
        ["Look", "they part here first", f"{none}2 not started", "✓2 SUCCEEDED 2 4", none, "✓", none, "✓"],
        ["Grip", "✓3 SUCCEEDED", f"✗1 {slipped} 2", *"✓✗✓✓"],
        ["Lift", "✓2 SUCCEEDED", f"{none}1 not started 2", "✗1 FAILED (too heavy) 4", "✓", none, *"✓✗"],
    ]
    for width in (1400, 390):
        with chrome.open(page, width=width) as tab:
            root, *others = tab.ask(rows)
            assert root == ["root", "✓4 SUCCEEDED", *"✓✓✓✓"]
            assert others == parted
            facts = "[...document.querySelectorAll('#facts span')].map((each) => each.textContent)"
            assert tab.ask(facts) == ["4 of 4 runs succeeded", "they part first at root > TakeAction > Look"]
            runs = "[...document.querySelectorAll('#runs tbody tr')].map((each) => each.children[4].textContent)"
            assert tab.ask(runs) == ["nowhere", "root > TakeAction > Look", "nowhere", "root > TakeAction > Look"]
            assert tab.ask("document.documentElement.scrollWidth") == width
            tab.ask("document.querySelector('[data-key=all]').focus()")
            tab.press(" ")
            assert [each[0] for each in tab.ask(rows)] == ["root", "TakeAction", "Look", "Reach", "Grip", "Lift"]
            assert tab.ask("document.activeElement.dataset.key") == "all"
            assert tab.problems() == []
            tab.ask("document.querySelectorAll('#nodes tbody tr')[4].querySelector('.way a').click()")  # Grip of 2
            tab.wait_for("globalThis.pycrormPage !== undefined")
            assert tab.ask("[pycrormPage.episode.number, pycrormPage.selected.name]") == [2, "Grip"]
            tab.ask("document.querySelector('#facts a').click()")
            tab.wait_for("globalThis.pycrormRuns !== undefined")
    assert diff(url, 1, 2, 3, "--html", page)[0] == 2
    assert diff(url, *[1, 3] * 3, "--html", page, "--force") == (0, f"{page}\n")
    with chrome.open(page) as tab:
        assert tab.ask("document.querySelector('#nodes p').textContent") == "All runs ended alike at every node."
        assert tab.problems() == []


def test_a_page_that_cannot_be_written_is_one_line(url: str, tmp_path: Path) -> None:
    for arguments, message in (
        ((1, 9, "--html", tmp_path / "a.html"), "there is no episode '9' (`pycrorm episodes` lists all 5)"),
        ((1, 2, "--html", tmp_path), f"{tmp_path} is a folder: give the name of a file in it"),
        ((1, 2, 3, "--sql"), "--sql compares two episodes: name two"),
        ((1, 2, 9, "--html", tmp_path / "a.html"), "there is no episode '9'"),
        ((1, 2, 3, "--html", tmp_path / "no" / "a.html"), "does not exist: create it first"),
        ((1, 2, 99), "there is no episode '99' (`pycrorm episodes` lists all 5)"),
    ):
        code, text = diff(url, *arguments)
        assert (code, text.count("\n"), list(tmp_path.iterdir())) == (2, 1, []), text
        assert message in text
