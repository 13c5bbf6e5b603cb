"""The overview of many episodes in a browser: it chooses, groups and compares them, and keeps that in its address."""

from __future__ import annotations

import asyncio
import json
from pathlib import Path
from typing import Any

import pytest
from typer.testing import CliRunner

from pycrorm_async import Memory, Reading
from pycrorm_async.cli.main import app
from pycrorm_async.plan import PlanFailure
from pycrorm_async.report.overview import newest_episodes, overview_document, overview_page_of
from pycrorm_async.world.pose import Pose
from tests.report.browser import Browser

pytestmark = pytest.mark.slow

HOSTILE = "</script><b onload=alert(1)>\u202e"
GROUPS = """[...document.querySelectorAll('#groups table')].map((table) =>
  [...table.querySelectorAll('tbody tr')].map((each) => each.textContent))"""
NEWCOMBE = """Array.from({ length: 150 }, (_, index) => ({
  ...pycrormOverview.episodes[0], number: index, robots: [index < 80 ? 'a' : 'b'],
  status: index < 48 || index >= 94 ? 'SUCCEEDED' : 'FAILED' }))"""
"""48 of 80 and 56 of 70 succeed, as in example (a) of Newcombe 1998: the difference is 20 %, 5.24 to 33.39 %."""
ROWS = "[...document.querySelectorAll('#episodes tbody tr')].map((each) => each.querySelector('td').textContent)"


def record(url: str) -> None:
    """Record six episodes: those of `pr2` succeed, of those of `hsrb` one does, and the last one has hostile names."""
    with Memory.sync(url) as memory:
        grasp = memory.recording.type("action", "GraspAction", {"object": str})
        for number, robot in enumerate(["pr2", "hsrb", "pr2", "hsrb", "pr2", HOSTILE]):
            tags = ["night"] if number % 2 else []
            name = HOSTILE if robot == HOSTILE else "milk" if number < 3 else "bowl"
            facts: dict[str, Any] = {"description": f"bring the {name}", "plan": f"bring {name}", "tags": tags}
            with memory.recording.episode(**facts, failures=(PlanFailure,)) as episode:
                episode.object_added("base", robot, "ROBOT", Pose([0, 0, 0]))
                episode.object_added("it", name, "GENERIC_OBJECT", Pose([1, 0, 0]))
                fails = robot == HOSTILE or number == 3
                episode.start("a", grasp, {"object": name}, robot="base")
                episode.end("a", "FAILED" if fails else "SUCCEEDED", f"slipped {HOSTILE}" if fails else None)
                if fails:
                    episode.close(PlanFailure("not brought"))
        memory.flush()


@pytest.fixture(scope="module")
def page(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """Return the overview of the six episodes, in a folder with their pages."""
    folder = tmp_path_factory.mktemp("fleet")
    record(f"sqlite:///{folder}/memory.db")
    options = ["--all", "--out", str(folder / "all"), "--url", f"sqlite:///{folder}/memory.db"]
    done = CliRunner().invoke(app("report"), ["report", *options])
    assert (done.exit_code, done.output.splitlines()[1:]) == (0, ["It has 6 episodes; pages of 6 are beside it."])
    again = CliRunner().invoke(app("report"), ["report", *options])
    assert (again.exit_code, again.output.count("\n")) == (2, 1)
    assert f"{folder / 'all'} exists: add --force" in again.output
    names = ["index.html", *(f"episode-{number}.html" for number in range(1, 7))]
    assert sorted(each.name for each in (folder / "all").iterdir()) == sorted(names)
    return folder / "all" / "index.html"


def test_filters_choose_episodes_are_in_the_address_and_come_back_with_it(chrome: Browser, page: Path) -> None:
    with chrome.open(page) as tab:
        assert tab.ask(ROWS) == ["6", "5", "4", "3", "2", "1"]
        options = "[...document.querySelector('[aria-label=robot]').options].map((each) => each.value)"
        assert tab.ask(options) == ["", "pr2", "hsrb", HOSTILE]
        for name, value, rows in (
            ("robot", "hsrb", ["4", "2"]), ("object", "milk", ["2"]), ("robot", "", ["3", "2", "1"]),
            ("tag", "night", ["2"]), ("object", "", ["6", "4", "2"]), ("status", "FAILED", ["6", "4"]),
            ("plan", f"bring {HOSTILE}", ["6"]),
        ):  # fmt: skip
            control = f"document.querySelector('#filters [aria-label={name}]')"
            tab.ask(f"{control}.value = {json.dumps(value)}; {control}.dispatchEvent(new Event('input'))")
            assert tab.ask(ROWS) == rows, name
        address = tab.ask("location.href")
        facts = tab.ask("document.getElementById('facts').textContent")
        assert facts.startswith("1 episode of 60 % of 1 (0 to 79 %) succeeded")
        tab.ask("document.querySelector('#episodes a').click()")
        tab.wait_for("globalThis.pycrormPage !== undefined")
        tab.ask("document.querySelector('#facts a').click()")
        tab.wait_for("globalThis.pycrormOverview !== undefined")
        assert (tab.ask("location.href"), tab.ask(ROWS)) == (address, ["6"])
        tab.ask("[...document.querySelectorAll('#filters button')].at(-1).click()")
        assert (tab.ask("location.hash"), len(tab.ask(ROWS))) == ("", 6)
        assert tab.problems() == []
    for fragment, rows in (
        ("#text=BRING+bowl", ["5", "4"]), ("#from=2020-01-01&to=2020-01-02", []), ("#from=2020-01-01&sort=robots&up=1",
        ["6", "2", "4", "1", "3", "5"]), ("#robot=unknown", []), ("#by=__proto__", [*"654321"]),
        ("#by=none&of=none&sort=none&vs=a&vs=b", [*"654321"]),
    ):  # fmt: skip
        with chrome.open(page, fragment=fragment) as tab:
            assert sorted(tab.ask(ROWS)) == sorted(rows), fragment
            assert tab.problems() == []


def test_groups_have_their_success_and_two_of_them_are_compared(chrome: Browser, page: Path) -> None:
    with chrome.open(page, fragment="#by=robot&of=GraspAction&vs=pr2&vs=hsrb") as tab:
        groups, compared = tab.ask(GROUPS)
        assert [each[:30] for each in groups][:2] == [
            "pr23100 % of 3 (44 to 100 %)10",
            "hsrb250 % of 2 (9 to 91 %)50 %",
        ]
        assert [each.split(" of ")[0] for each in compared[:2]] == ["episodes100 %", "GraspAction100 %"]
        assert compared[1].endswith("-50 (-91 to +19)")
        assert tab.problems() == []
        causes = "[...document.querySelectorAll('#reasons tr')].map((each) => each.textContent)"
        assert tab.ask(causes)[0].startswith("1slipped </script><b onload=alert(#)><U+202E> in GraspAction 1 ")
        tab.ask("document.querySelector('#reasons button').click()")
        assert tab.ask(ROWS) in (["4"], ["6"])
        tab.ask("pycrormOverview.settings.set({ cause: '', vs: ['a', 'b'], of: '' })")
        tab.ask(f"pycrormOverview.extend({{ episodes: {NEWCOMBE} }})")
        tab.wait_for("pycrormOverview.chosen.length === 150")
        assert tab.ask(GROUPS)[1][0].endswith("+20 (+5 to +33)")


@pytest.mark.parametrize("width", [390, 1400])
def test_ten_thousand_episodes_are_one_small_page_in_which_a_part_is_listed(
    chrome: Browser, page: Path, tmp_path: Path, width: int
) -> None:
    async def document() -> dict[str, Any]:
        async with Reading.open(f"sqlite:///{page.parents[1]}/memory.db") as reading:
            episodes, total = await newest_episodes(reading)
            return await overview_document(reading, "Many", episodes, total, {6: "episode-6.html"}, {})

    some = asyncio.run(document())
    entries = [{**some["episodes"][number % 6], "number": number + 1} for number in range(10_000)]
    many = tmp_path / "many.html"
    many.write_text(overview_page_of({**some, "total": 10_000, "episodes": entries, "successes": []}))
    assert many.stat().st_size < 4_000_000
    with chrome.open(many, width=width, fragment="#by=week") as tab:
        assert len(tab.ask(ROWS)) == 100
        assert "10000 episodes" in tab.ask("document.getElementById('facts').textContent")
        tab.ask("[...document.querySelectorAll('#episodes button')].at(-1).click()")
        assert len(tab.ask(ROWS)) == 200
        assert tab.ask("document.documentElement.scrollWidth") == width
        assert tab.problems() == []
