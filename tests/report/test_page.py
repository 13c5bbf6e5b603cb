"""The page in a real Chromium: it shows the episode at any width and length, readable, also by keyboard."""

import random
from collections.abc import Iterator
from itertools import pairwise
from pathlib import Path
from typing import Any

import numpy as np
import pytest

from pycrorm_async import world_of
from pycrorm_async.events.types import NodeStatus
from pycrorm_async.memory import Memory
from pycrorm_async.query.reading import Reading
from pycrorm_async.report import overview as overviews
from pycrorm_async.world import Pose
from tests.commands import pycrorm
from tests.report.browser import Browser, Tab
from tests.report.conftest import page_of
from tests.report.test_document import HOSTILE, record

pytestmark = pytest.mark.slow


# === page =====================================================================================================
#
# The page in a real Chromium: it opens by one request and shows the episode, at any width and without WebGL.

NO_WEBGL = """
HTMLCanvasElement.prototype.getContext = ((original) => function (kind, ...rest) {
  return kind.startsWith("webgl") ? null : original.call(this, kind, ...rest);
})(HTMLCanvasElement.prototype.getContext);
"""

POSE = "pycrormPage.bodies.of(pycrormPage.episode.objects.find((each) => each.name === '{}')).group.position.toArray()"


FOCUSED = "document.activeElement.textContent"


def assert_quiet(tab: Tab, page: Path) -> None:
    """Assert that the page wrote no error and asked for nothing but itself."""
    assert tab.problems() == []
    assert tab.requests() == [page.as_uri()]


@pytest.fixture(scope="module")
def opened(chrome: Browser, pages: dict[str, Path]) -> Iterator[Tab]:
    """Yield the plan's page as it opens, for the tests that look at it, or open its panels, and leave the moment."""
    with chrome.open(pages["plan"]) as tab:
        tab.settle()
        yield tab


@pytest.fixture(scope="module")
def opened_drive(chrome: Browser, pages: dict[str, Path]) -> Iterator[Tab]:
    """Yield the page of the courier's drive in the same way."""
    with chrome.open(pages["drives"]) as tab:
        tab.settle()
        yield tab


def position(tab: Tab, name: str) -> list[float]:
    return [round(each, 2) for each in tab.ask(POSE.format(name))]


@pytest.mark.parametrize(("dark", "width"), [(False, 420), (True, 800)])
def test_a_page_opens_by_one_request_and_is_no_wider_than_its_window(
    chrome: Browser, pages: dict[str, Path], width: int, dark: bool
) -> None:
    with chrome.open(pages["plan"], width=width, dark=dark) as tab:
        tab.settle()
        assert_fits(tab, width)
        assert_quiet(tab, pages["plan"])


def test_a_wide_page_opens_by_one_request_and_is_no_wider_than_its_window(opened: Tab, pages: dict[str, Path]) -> None:
    assert_fits(opened, 1400)
    assert_quiet(opened, pages["plan"])


def assert_fits(tab: Tab, width: int) -> None:
    assert tab.ask("document.documentElement.scrollWidth") == width
    assert tab.ask("document.querySelectorAll('#tree .row').length") > 5
    assert tab.ask("document.querySelector('#scene canvas').clientWidth") > 300
    cut = "[...document.querySelectorAll('.row, #controls')].filter((each) => each.scrollWidth > each.clientWidth)"
    assert tab.ask(f"{cut}.map((each) => each.textContent)") == []


def test_it_opens_at_the_last_moment_before_the_world_is_emptied(opened: Tab) -> None:
    assert opened.ask("pycrormPage.episode.presentAt(pycrormPage.event).map((each) => each.name)") == [
        "kitchen",
        "pr2",
        "milk",
        "cereal",
    ]
    assert position(opened, "milk") == [1.3, 0.45, 0.9]
    assert opened.ask("pycrormPage.event") < opened.ask("pycrormPage.episode.last")


def test_the_address_keys_and_the_slider_move_the_moment(chrome: Browser, pages: dict[str, Path]) -> None:
    with chrome.open(pages["plan"], fragment="#e10") as tab:
        assert tab.ask("pycrormPage.event") == 10
        assert position(tab, "milk") == [1.3, 1.0, 0.9]
        tab.press("ArrowRight")
        tab.press("ArrowRight", modifiers=8)
        assert tab.ask("pycrormPage.event") == 21
        tab.press("Home")
        assert tab.ask("pycrormPage.event") == 1
        tab.ask(
            "{const s = document.querySelector('#controls input'); s.value = 30; s.dispatchEvent(new Event('input'))}"
        )
        assert tab.ask("pycrormPage.event") == 30
        tab.wait_for("location.hash === '#e30'")
        tab.ask("location.hash = '#e12'")
        tab.wait_for("pycrormPage.event === 12")
        tab.press("f")
        assert tab.ask("pycrormPage.selected.reason") == "IKError"
        shown = tab.ask("pycrormPage.event")
        tab.press(" ", code="Space")
        tab.wait_for(f"pycrormPage.event > {max(shown, 40)}")
        tab.press(" ", code="Space")
        assert_quiet(tab, pages["plan"])


def test_every_tab_draws(opened: Tab, pages: dict[str, Path]) -> None:
    names = opened.ask("pycrormPage.panels.tabs.map(([name]) => name)")
    assert names == ["details", "failures", "objects", "attachments", "states"]
    for name in names:
        opened.ask(f"pycrormPage.panels.open('{name}')")
        assert len(opened.ask("document.querySelector('.panel').textContent")) > 20
    texts = "[...document.querySelectorAll('figure')].map((each) => each.innerText.split('\\n').filter(Boolean))"
    curves = {name: rest for name, *rest in opened.ask(texts)}
    assert curves["pr2 base.y"] == ["0.44 m", "-1.5 to 0.89 m"]
    assert curves["pr2 l_elbow_flex_joint"][0].endswith(" rad")
    opened.ask("pycrormPage.panels.open('failures')")
    assert opened.ask("[...document.querySelectorAll('.failure')].map((each) => each.children[0].textContent)") == [
        "✗ 2 × IKError"  # noqa: RUF001  the page's sign
    ]
    assert "4 failed from 2 causes" in opened.ask("document.getElementById('facts').textContent")
    assert_quiet(opened, pages["plan"])


def test_a_map_takes_the_place_of_the_scene_without_webgl(chrome: Browser, pages: dict[str, Path]) -> None:
    with chrome.open(pages["plan"], script=NO_WEBGL) as tab:
        assert tab.ask("document.body.className") == "no-webgl"
        assert tab.ask("document.querySelectorAll('#map polygon').length") > 20
        assert tab.ask("[...document.querySelectorAll('#map text')].map((each) => each.textContent)") == [
            "pr2",
            "milk",
            "cereal",
        ]
        assert_quiet(tab, pages["plan"])


def test_the_names_on_the_map_cover_no_other_and_are_inside(chrome: Browser, pages: dict[str, Path]) -> None:
    with chrome.open(pages["plan"], width=420, script=NO_WEBGL) as tab:
        places = """[...document.querySelectorAll('#map svg, #map text')].map((each) => {
          const { left, right, top, bottom } = each.getBoundingClientRect();
          return [left, right, top, bottom];
        })"""
        (left, right, top, bottom), *names = tab.ask(places)
        assert len(names) == 3
        for index, (west, east, north, south) in enumerate(names):
            assert left <= west < east <= right
            assert top <= north < south <= bottom
            for begin, end, _, _ in [each for each in names[:index] if each[2] < south - 2 and north + 2 < each[3]]:
                assert end <= west + 1 or east <= begin + 1


def test_print_has_the_map_all_rows_and_all_panels(chrome: Browser, pages: dict[str, Path], tmp_path: Path) -> None:
    with chrome.open(pages["plan"], media="print") as tab:
        tab.wait_for("document.querySelectorAll('#map polygon').length > 20")
        rows = tab.ask("document.querySelectorAll('#tree .row').length")
        assert rows == tab.ask("pycrormPage.tree.rows.length")
        assert tab.ask("document.querySelectorAll('.panel h2.printed').length") == 5
        assert tab.print(tmp_path / "page.pdf").stat().st_size > 10_000
        assert_quiet(tab, pages["plan"])


def test_recorded_text_is_never_markup(opened: Tab, pages: dict[str, Path]) -> None:
    description = "Bring the milk </script><b onload=alert(1)>"
    assert pages["plan"].read_text().count("</script>") == 3
    assert opened.ask("document.querySelector('h1').textContent") == description
    assert opened.ask("document.title") == f"{description} · episode 1"
    assert opened.ask("document.querySelectorAll('h1 b, #tree b').length") == 0


def test_the_policy_lets_no_other_script_run(chrome: Browser, pages: dict[str, Path]) -> None:
    with chrome.open(pages["plan"]) as tab:
        added: Any = (
            "{const s = document.createElement('script'); s.textContent = 'window.ran = 1'; document.body.append(s)}"
        )
        tab.ask(added)
        assert tab.ask("window.ran") is None
        assert any("Content Security Policy" in each for each in tab.problems())


def test_a_table_of_episodes_counts_failures_by_reason_is_sorted_and_leads_to_the_pages(
    chrome: Browser, recorded: Path, tmp_path: Path
) -> None:
    done = pycrorm("report", "--all", "--out", tmp_path / "all of them.html", cwd=recorded)
    assert done.returncode == 0, done.stderr
    with chrome.open(tmp_path / "all of them.html", width=420) as tab:
        rows = "[...document.querySelectorAll('{} tr')].map((each) => each.children[{}].textContent)"
        assert tab.ask(rows.format("#episodes tbody", 0)) == ["3", "2", "1"]
        assert tab.ask(rows.format("#episodes tbody", 2)) == ["✓ SUCCEEDED", "? LOST", "✓ SUCCEEDED, 2 actions failed"]
        assert tab.ask(rows.format("#reasons", 0)) == ["4"]
        assert tab.ask(rows.format("#reasons", 1)) == ["IKError in MoveTCPMotion with milk 2 recovered, 2 failed 2 1"]
        assert "67 % of 3 (21 to 94 %) succeeded" in tab.ask("document.getElementById('facts').textContent")
        heading = tab.ask("document.querySelector('#success h2').textContent")
        assert heading == "Pick-ups: 20 % of 5 (4 to 62 %) succeeded"
        hints = "[...document.querySelectorAll('#success svg:last-child title')].map((each) => each.textContent)"
        assert tab.ask(hints) == ["LEFT, FRONT: 33 % of 3 (6 to 79 %)", "RIGHT, FRONT: 0 % of 2 (0 to 66 %)"]
        sorted_by = "document.querySelector('th').getAttribute('aria-sort')"
        assert tab.ask(sorted_by) == "descending"
        tab.ask("document.querySelector('th button').focus()")
        tab.ask("document.activeElement.click()")
        assert tab.ask(f"[{sorted_by}, {FOCUSED}]") == ["ascending", "episode ▴"]
        assert tab.ask(rows.format("#episodes tbody", 0)) == ["1", "2", "3"]
        assert tab.ask("document.documentElement.scrollWidth") == 420
        assert tab.ask("document.querySelectorAll('b, script:not([type])').length") == 1
        assert_quiet(tab, tmp_path / "all of them.html")
        tab.ask("document.querySelector('td a').click()")
        tab.wait_for("globalThis.pycrormPage?.episode.number === 1")


@pytest.mark.parametrize(("page", "number", "name"), [("opened", 1, "pr2"), ("opened_drive", 3, "other")])
async def test_every_link_is_where_bullet_has_it(
    request: pytest.FixtureRequest, recorded: Path, page: str, number: int, name: str
) -> None:
    body = f"pycrormPage.bodies.of(pycrormPage.episode.objects.find((each) => each.name === '{name}'))"
    point = "new THREE.Vector3().setFromMatrixPosition(link.matrixWorld).toArray()"
    tab: Tab = request.getfixturevalue(page)
    drawn = tab.ask(f"Object.fromEntries([...{body}.links].map(([name, link]) => [name, {point}]))")
    event = tab.ask("pycrormPage.event")
    async with Reading.open(f"sqlite:///{recorded / 'pycrorm.db'}") as reading:
        then = await reading.as_of(number, sequence=event)
    assert then.world.object(name).base_link == ("forearm_link" if name == "other" else None)
    with world_of(then) as world:
        robot = world.object(name)
        assert drawn.keys() == set(robot.links)
        for link, position in drawn.items():
            assert position == pytest.approx(list(robot.link_pose(link).position), abs=2e-3), link


def test_a_moment_at_which_nothing_runs_shows_the_episode(chrome: Browser, pages: dict[str, Path]) -> None:
    with chrome.open(pages["drives"], fragment="#e1") as tab:
        text = tab.ask("document.querySelector('.panel').innerText")
        assert text.startswith("No node runs at this moment.\n\nEpisode\nid\n")
        assert "plan\nbreakfast.py:drives" in text


# === gantt ====================================================================================================
#
# The chart of the nodes: statuses readable without colour at any width, labels that are whole, an axis in sight.

MARKS = """(() => {
  const { gantt, episode } = pycrormPage;
  gantt.setAxis(false);
  gantt.window = [episode.first, episode.first + gantt.width / WIDTH];
  gantt.show(episode.last, null);
  const [from, to] = gantt.window;
  const pen = gantt.canvas.getContext("2d");
  const grey = ([red, green, blue]) => 0.3 * red + 0.59 * green + 0.11 * blue;
  return Object.fromEntries(episode.nodes.filter((each) => each.parent).map((node) => {
    const left = Math.round(8 + ((node.start - from) / (to - from)) * gantt.width);
    const wide = Math.max(1, Math.floor(WIDTH - 2));
    const rows = Array.from({ length: 19 }, (_, y) => {
      const { data } = pen.getImageData(left, gantt.lanes.of.get(node) * 19 + y, wide, 1);
      const pixels = Array.from({ length: wide }, (_, x) => data.slice(4 * x, 4 * x + 4));
      const signOf = (each) => (each[3] < 128 ? "." : grey(each) > 120 ? "o" : grey(each) < 50 ? "x" : "#");
      return pixels.map(signOf).join("");
    });
    return [node.status, rows.join(" ")];
  }));
})()"""
"""The pixels of a node's bar without colour, by status; each bar is WIDTH pixels wide."""

STATUSES: tuple[NodeStatus, ...] = ("SUCCEEDED", "FAILED", "CANCELLED")


async def test_every_status_is_readable_without_colour_on_wide_and_narrow_bars(chrome: Browser, tmp_path: Path) -> None:
    url = f"sqlite:///{tmp_path / 'memory.db'}"
    with Memory.sync(url) as memory:
        drive = memory.recording.type("action", "DriveAction", {"target": Pose})
        with memory.recording.episode(description="statuses") as episode:
            for status in STATUSES:
                episode.start(status, drive, {"target": Pose([0, 0, 0])})
                episode.end(status, status, None if status == "SUCCEEDED" else "why")
                for volts in (24.0, 23.9):  # so that bars are not drawn together
                    episode.observe("battery", volts)
            episode.start("open", drive, {"target": Pose([0, 0, 0])})
            memory.flush()
            await page_of(url, tmp_path / "running.html")
        memory.flush()
    await page_of(url, tmp_path / "ended.html")
    wide: dict[str, str] = {}
    narrow: dict[str, str] = {}
    for page in ("running", "ended"):
        with chrome.open(tmp_path / f"{page}.html") as tab:
            wide |= tab.ask(MARKS.replace("WIDTH", "12"))
            narrow |= tab.ask(MARKS.replace("WIDTH", "2.9"))
    for marks in (wide, narrow):
        assert sorted(marks) == sorted([*STATUSES, "RUNNING", "LOST"])
        plain = marks.pop("SUCCEEDED")
        assert plain not in marks.values()
    assert len(set(wide.values())) == len(wide)
    assert narrow["FAILED"] != narrow["CANCELLED"]


async def test_many_narrow_nodes_are_drawn_as_a_band_without_gaps(chrome: Browser, tmp_path: Path) -> None:
    url = f"sqlite:///{tmp_path / 'memory.db'}"
    record_pick_ups(url, 400)
    await page_of(url, tmp_path / "page.html")
    row = """(() => {
      const { canvas, width } = pycrormPage.gantt;
      const { data } = canvas.getContext("2d").getImageData(12, 2 * 19 + 4, width - 24, 1);
      return new Set(Array.from({ length: width - 24 }, (_, x) => data.slice(4 * x, 4 * x + 4).join())).size;
    })()"""
    with chrome.open(tmp_path / "page.html") as tab:
        tab.ask("pycrormPage.gantt.setAxis(false); pycrormPage.seek(pycrormPage.episode.last)")
        assert tab.ask(row) == 1


def test_the_labels_of_the_axis_differ_and_the_axis_is_in_sight(chrome: Browser, pages: dict[str, Path]) -> None:
    labels = "pycrormPage.gantt.ticks().map(({ text, left, width }) => [left, left + width, text])"
    for width in (420, 1400):
        with chrome.open(pages["drives"], width=width) as tab:
            for window in ("[1, 16]", "[1, 4]", "[1, 2.5]", "[3, 12]", "[0, 0.2336]", "[0.5, 1.03]"):
                by_time = "true" if "0" in window else "false"
                tab.ask(f"pycrormPage.gantt.setAxis({by_time}); pycrormPage.gantt.window = {window}")
                placed = sorted(tab.ask(f"pycrormPage.gantt.draw() ?? {labels}"))
                assert len(placed) == len({text for _, _, text in placed}) >= 2
                assert all(end < begin for (_, end, _), (begin, _, _) in pairwise(placed))
            tab.ask("pycrormPage.gantt.lanes.height += 300; pycrormPage.gantt.draw()")
            bottoms = "[...document.querySelectorAll('#gantt, #gantt .axis')]"
            holder, axis = tab.ask(f"{bottoms}.map((each) => each.getBoundingClientRect().bottom)")
            assert holder == axis
            assert tab.problems() == []


# === keyboard =================================================================================================
#
# The page by keyboard and for screen readers: the focus stays where it was, and each row and control has its words.

CURRENT = "document.getElementById(document.getElementById('tree').getAttribute('aria-activedescendant'))"


def test_the_focus_stays_on_the_control_that_was_used(chrome: Browser, pages: dict[str, Path]) -> None:
    with chrome.open(pages["plan"]) as tab:
        tab.ask("document.querySelector('[role=tab][aria-selected=true]').focus()")
        for name in ("Objects4", "Attachments1"):
            tab.press("ArrowRight")
            assert tab.ask(FOCUSED) == name
        assert tab.ask("document.querySelectorAll('[role=tab][tabindex=\"0\"]').length") == 1
        assert tab.ask("document.getElementById('panel').getAttribute('aria-labelledby')") == "tab-attachments"
        tab.ask("document.querySelector('.panel .moment').focus()")
        moment = tab.ask(FOCUSED)
        tab.ask("document.activeElement.click()")
        assert tab.ask(FOCUSED) == moment
        assert tab.ask("`e${pycrormPage.event}`") == moment
        tab.ask("pycrormPage.panels.open('failures')")
        assert tab.ask("document.activeElement.id") == "panel"  # the control is gone


def test_the_tree_is_walked_from_the_current_row_which_is_announced(chrome: Browser, pages: dict[str, Path]) -> None:
    with chrome.open(pages["plan"]) as tab:
        tab.ask("document.getElementById('tree').focus()")
        spoken_now = (
            f"[...{CURRENT}.children].filter((each) => !each.ariaHidden).map((each) => each.textContent).join('')"
        )
        assert tab.ask(spoken_now).startswith("TransportAction, SUCCEEDED ")
        tab.press("ArrowUp")
        spoken = tab.ask(spoken_now)
        assert spoken.startswith("MoveTCPMotion, FAILED IKError")
        assert ", took " in spoken
        assert "l_gripper_tool_frame cannot reach" in spoken
        assert tab.ask("pycrormPage.selected.reason") == "IKError"
        tab.press("ArrowLeft")
        assert tab.ask("pycrormPage.selected.name") == "PickUpAction"
        tab.press("ArrowLeft")
        assert tab.ask(f"{CURRENT}.getAttribute('aria-expanded')") == "false"
        tab.press("ArrowLeft")
        assert tab.ask("pycrormPage.selected.name") == "root"
        tab.press("ArrowRight")
        assert tab.ask("pycrormPage.selected.name") == "ParkArmsAction"
        places = f"['aria-level', 'aria-posinset', 'aria-setsize'].map((each) => {CURRENT}.getAttribute(each))"
        assert tab.ask(places) == ["2", "1", "5"]


def test_every_control_has_a_name_that_is_no_sign(chrome: Browser, pages: dict[str, Path]) -> None:
    with chrome.open(pages["plan"]) as tab:
        tree = tab.call("Accessibility.getFullAXTree")["nodes"]
        roles = ("button", "slider", "tab", "treeitem")
        names = [
            (each["role"]["value"], each["name"]["value"])
            for each in tree
            if not each["ignored"] and each["role"]["value"] in roles
        ]
        assert {role for role, _ in names} == set(roles)
        assert [each for each in names if not any(map(str.isalnum, each[1]))] == []


@pytest.mark.parametrize("width", [420, 1400])
def test_the_table_of_episodes_is_in_sight_without_scrolling(chrome: Browser, overview: Path, width: int) -> None:
    with chrome.open(overview, width=width) as tab:
        heads = "[...document.querySelectorAll('#episodes th')].map((each) => each.textContent)"
        assert tab.ask(heads) == [
            "episode ▾",
            "started (UTC)",
            "status",
            "took",
            "nodes",
            "failed",
            "robots",
            "description",
        ]
        assert tab.ask("document.documentElement.scrollWidth") == width
        robots = "[...document.querySelectorAll('#episodes tbody td:nth-child(7)')].map((each) => each.textContent)"
        assert tab.ask(robots) == ["courier, other", "pr2", "pr2"]
        texts = tab.ask("[...document.querySelectorAll('#success text')].map((each) => each.textContent)")
        assert [each for each in texts if "_" in each] == ["relative_x (m)", "relative_y (m)"]
        edges = """[...document.querySelectorAll('#episodes td, #episodes th')].map((each) => {
          const { left, right } = each.getBoundingClientRect();
          return [left, right];
        })"""
        assert all(0 <= left <= right <= width for left, right in tab.ask(edges))
        assert tab.ask("document.querySelector('#episodes').scrollHeight") == tab.ask(
            "document.querySelector('#episodes').clientHeight"
        )
        if width == 1400:
            assert tab.ask("document.querySelector('#episodes tbody').getBoundingClientRect().bottom") < 900
        assert tab.problems() == []


def test_episodes_without_a_page_name_the_reason_and_what_still_runs_has_no_chart(
    chrome: Browser, overview: Path
) -> None:
    with chrome.open(overview) as tab:
        assert tab.ask("document.getElementById('trend').textContent").startswith("Success")
        assert "no page" not in tab.ask("document.getElementById('episodes').textContent")
        tab.ask(
            "new pycrormOverview.constructor({ title: '', total: 3, episodes: pycrormOverview.episodes"
            ".map((each) => ({ ...each, status: 'RUNNING', page: null })) })"
        )
        assert tab.ask("document.getElementById('trend').textContent") == ""
        text = tab.ask("document.getElementById('episodes').textContent")
        assert text.count(" no page") == 4
        assert text.endswith(
            "3 older episodes have no page here. One of them gets a page of its own by pycrorm report 3"
        )


# === long page ================================================================================================
#
# The page of a long episode: collapsed, opened at failures, with few elements, below 20 MB.


def record_pick_ups(url: str, count: int) -> None:
    """Record pick-ups of four motions each; the last motion of every seventh fails."""
    generator = random.Random(1)
    with Memory.sync(url) as memory:
        pick_up = memory.recording.type("action", "PickUpAction", {"target_location": Pose, "arm": str})
        move = memory.recording.type("motion", "MoveTCPMotion", {"target": Pose, "arm": str})
        with memory.recording.episode(description="a learning run") as episode:
            episode.object_added("base", "pr2", "ROBOT", Pose([0, 0, 0]))
            for index in range(count):
                pose = Pose([generator.random() * 3, generator.random() * 3, 0])
                failure = "too far away" if index % 7 == 3 else None
                episode.start(index, pick_up, {"target_location": pose, "arm": "LEFT"}, robot="base")
                for step in range(4):
                    episode.start((index, step), move, {"target": pose, "arm": "LEFT"}, robot="base", parent=index)
                    episode.object_moved("base", pose, node=(index, step))
                    failed = failure is not None and step == 3
                    episode.end((index, step), "FAILED" if failed else "SUCCEEDED", failure if failed else None)
                episode.end(index, "FAILED" if failure else "SUCCEEDED", failure)
        memory.flush()


@pytest.mark.parametrize("pick_ups", [1_000, pytest.param(19_999, marks=pytest.mark.soak)])
async def test_a_long_episode_is_collapsed_and_opened_at_its_first_failures(
    chrome: Browser, tmp_path: Path, pick_ups: int
) -> None:
    url = f"sqlite:///{tmp_path / 'memory.db'}"
    record_pick_ups(url, pick_ups)
    written = await page_of(url, tmp_path / "long.html")
    assert written.last == written.events
    assert written.path.stat().st_size < 20_000_000
    with chrome.open(written.path) as tab:
        nodes = pick_ups * 5 + 1
        assert tab.ask("pycrormPage.episode.nodes.length") == nodes
        rows = tab.ask("pycrormPage.tree.rows.length")
        assert pick_ups < rows < pick_ups + 500
        assert tab.ask("document.querySelectorAll('*').length") < 1_000
        failures = len(range(3, pick_ups, 7))
        assert tab.ask("document.querySelector('.failure').textContent").startswith(f"✗ {failures} × ")  # noqa: RUF001
        tab.ask("document.getElementById('tree').scrollTop = 1e9")
        tab.wait_for("document.querySelector('#tree').textContent.includes('PickUpAction')")
        tab.press("f")
        assert tab.ask("pycrormPage.selected.status") == "FAILED"
        assert tab.problems() == []


# === reading ==================================================================================================
#
# Pages are easy to read: contrast, room, whole words, signs for control characters, shapes as recorded.

CONTRASTS = """(() => {
  const linear = (part) => (part <= 0.04045 ? part / 12.92 : ((part + 0.055) / 1.055) ** 2.4);
  const light = (color) => {
    const [red, green, blue] = color.match(/[\\d.]+/g).map((each) => linear(each / 255));
    return 0.2126 * red + 0.7152 * green + 0.0722 * blue;
  };
  const paper = light(getComputedStyle(document.body).backgroundColor);
  return [...document.querySelectorAll(".row.later :is(bdi, .took), .row.message bdi, .panel .later")].map((each) => {
    const ink = light(getComputedStyle(each).color);
    let opacity = 1;
    for (let around = each; around; around = around.parentElement) opacity *= getComputedStyle(around).opacity;
    return (opacity * (Math.max(ink, paper) + 0.05)) / (Math.min(ink, paper) + 0.05);
  });
})()"""
"""The contrasts of the texts of later rows, and of messages, with the page."""


@pytest.mark.parametrize("dark", [False, True])
def test_rows_of_later_moments_can_be_read(chrome: Browser, pages: dict[str, Path], dark: bool) -> None:
    with chrome.open(pages["plan"], dark=dark, fragment="#e10") as tab:
        tab.ask("pycrormPage.panels.open('attachments')")
        contrasts = tab.ask(CONTRASTS)
        assert len(contrasts) > 20
        assert min(contrasts) > 4.5
        later = "document.querySelectorAll('.row.message.later').length"
        assert tab.ask(later) == 2
        tab.press("End")
        assert tab.ask(later) == 0


def test_a_narrow_page_has_room_for_the_slider_the_help_and_whole_names(
    chrome: Browser, pages: dict[str, Path]
) -> None:
    with chrome.open(pages["plan"], width=420) as tab:
        assert tab.ask("document.querySelector('#controls input').clientWidth") > 250
        assert tab.ask("document.querySelector('.help').getBoundingClientRect().width") > 20
        assert tab.ask("document.querySelector('.clock').scrollWidth <= document.querySelector('.clock').clientWidth")
        tab.press("?")
        explained = tab.ask("document.querySelector('#help p:last-child').textContent")
        assert all(f"{word} is" in explained for word in ("an episode", "A node", "An event", "A snapshot"))
    with chrome.open(pages["plan"], width=800) as tab:
        cut = "[...document.querySelectorAll('.row .name')].filter((each) => each.scrollWidth > each.clientWidth)"
        names = tab.ask(f"{cut}.map((each) => each.textContent)")
        assert set(names) <= {"MoveArmJointsMotion", "MoveGripperMotion"}  # the longest, where they are deepest
        widths = """[...document.querySelectorAll('.parameters bdi')].filter((each) => each.textContent
          && getComputedStyle(each).visibility === 'visible').map((each) => each.parentElement.clientWidth)"""
        assert min(tab.ask(widths)) >= 60


@pytest.mark.parametrize("width", [420, 1400])
def test_the_names_in_the_scene_are_inside_it_and_below_no_button(
    chrome: Browser, pages: dict[str, Path], width: int
) -> None:
    places = """[...document.querySelectorAll('#stage, #views button, .names span')].map((each) => {
      const { left, right, top, bottom } = each.getBoundingClientRect();
      return [each.tagName, left, right, top, bottom];
    })"""
    for page, events in (("drives", (8, 12)), ("plan", (25, 60))):
        with chrome.open(pages[page], width=width) as tab:
            for event in events:
                tab.ask(f"pycrormPage.seek({event})")
                tab.press("w")  # as large as can be, so that names are near the edges
                tab.settle()
                stage, *others = tab.ask(places)
                buttons = [each[1:] for each in others if each[0] == "BUTTON" and each[1] != each[2]]
                names = [each[1:] for each in others if each[0] == "SPAN"]
                assert names
                for left, right, top, bottom in names:
                    assert stage[1] <= left < right <= stage[2]
                    assert stage[3] <= top < bottom <= stage[4]
                    for west, east, north, south in buttons:
                        assert right <= west or east <= left or bottom <= north or south <= top


def test_the_page_plays_by_events_or_in_proportion_to_time(chrome: Browser, pages: dict[str, Path]) -> None:
    schedule = "pycrormPage.playback.constructor.schedule({}, {})"
    with chrome.open(pages["drives"]) as tab:

        def ask(times: list[int], by_time: bool) -> Any:
            return tab.ask(schedule.format(times, str(by_time).lower()))

        assert ask([0, 5, 1000, 1001], False) == {"at": [0, 0.25, 0.5, 0.75], "shortened": False}
        even = ask([0, 1_000_000, 1_500_000, 2_500_000, *range(4_000_000, 20_000_001, 2_000_000)], True)
        assert not even["shortened"]
        assert [round(each, 6) for each in even["at"][:4]] == [0, 1, 1.5, 2.5]
        assert ask([0, 0, 1_000_000], True) == {"at": [0, 0, 2], "shortened": True}
        tab.ask("pycrormPage.gantt.setAxis(true); pycrormPage.togglePlay()")
        assert tab.ask("pycrormPage.playback.running")
        assert tab.ask("document.querySelector('.clock').textContent").endswith(" · pauses cut")
        tab.ask("pycrormPage.togglePlay()")
        assert not tab.ask("document.querySelector('.clock').textContent").endswith("cut")


async def test_control_characters_are_signs_in_titles_and_hints(chrome: Browser, tmp_path: Path) -> None:
    url = f"sqlite:///{tmp_path / 'memory.db'}"
    with Memory.sync(url) as memory:
        with memory.recording.episode(description=HOSTILE) as episode:
            record(memory, episode)
        memory.flush()
    await page_of(url, tmp_path / "page.html")
    with chrome.open(tmp_path / "page.html", script=NO_WEBGL, fragment="#e4") as tab:
        assert tab.ask("document.title").endswith("<U+2028><U+202E>]]> {title} <!-- · episode 1")
        hints = """[
          ...[...document.querySelectorAll('[title]')].map((each) => each.title),
          ...[...document.querySelectorAll('[aria-label]')].map((each) => each.getAttribute('aria-label')),
          ...[...document.querySelectorAll('svg title, svg text')].map((each) => each.textContent),
        ].join()"""
        text = tab.ask(hints)
        assert "\u202e" not in text
        assert "turtle<U+202E>" in text
        assert "<U+202E>]]>" in text


@pytest.mark.parametrize("width", [390, 1400])
async def test_long_names_and_control_characters_leave_room_for_the_rest(
    chrome: Browser, tmp_path: Path, width: int
) -> None:
    long = "a\x01\u202e<b>" + "n" * 300
    url = f"sqlite:///{tmp_path / 'memory.db'}"
    with Memory.sync(url) as memory:
        look = memory.recording.type("action", "LookAction", {})
        with memory.recording.episode(description=long) as episode:
            episode.object_added("robot", long, "ROBOT", Pose([0, 0, 0]))
            episode.object_added("milk", f"{long} milk", "MILK", Pose([1, 0, 0.5]))
            episode.object_attached("robot", "milk", long)
            episode.start("look", look, robot="robot")
            episode.observe(long, {long: np.zeros((16, 16, 3), np.uint8)}, node="look")
            episode.end("look", failure=(long, long))
        memory.flush()
    await page_of(url, tmp_path / "page.html")
    async with Reading.open(url) as reading:
        await overviews.overview(reading, tmp_path / "all.html")
    shown = "#facts > *, #notes p, #legend > *, #views button, .seen-row > bdi"
    boxes = f"[...document.querySelectorAll('{shown}')].map((each) => each.getBoundingClientRect())"
    for name in ("page", "all"):
        with chrome.open(tmp_path / f"{name}.html", width=width) as tab:
            assert tab.ask("document.documentElement.scrollWidth") == width
            text = tab.ask("document.body.innerText")
            assert "\u202e" not in text
            assert "a␁<U+202E><b>nnn" in text
            assert max(tab.ask(f"{boxes}.map((each) => each.height)"), default=0) < 60
            assert tab.ask(f"{boxes}.filter((each) => each.left < 0 || each.right > innerWidth).length") == 0
            if name == "all":  # rows of a short list are not stretched over the window
                assert tab.ask("document.querySelector('#filters').getBoundingClientRect().height") < 250
    with chrome.open(tmp_path / "page.html", width=width, script=NO_WEBGL) as tab:
        assert tab.ask("[...document.querySelectorAll('#map text')].some((each) => each.textContent.endsWith('…'))")
        widest = "Math.max(...[...document.querySelectorAll('#map text')].map((each) => each.getBBox().width))"
        assert tab.ask(f"{widest} <= 1.1 * document.querySelector('#map svg').viewBox.baseVal.width")
