"""The page of a fleet: nodes are found and linked, robots and differences named, all by keys and for all readers."""

import json
import shutil
import subprocess
from collections.abc import Iterator
from pathlib import Path

import pytest

from pycrorm_async.memory import Memory
from pycrorm_async.world import Pose
from tests.commands import pycrorm
from tests.report.browser import Browser, Tab
from tests.report.test_page import NO_WEBGL
from tests.shared_folders import made_once

pytestmark = pytest.mark.slow

AXE = "axe-core@4.14.1"
NAMES = "[...document.querySelectorAll('.row:not(.message)')].map((each) => each.querySelector('.name').textContent)"
HOSTILE = '</script><b onload=alert(1)> type:"x'


def _record(folder: Path) -> None:
    with Memory.sync(f"sqlite:///{folder / 'fleet.db'}") as memory:
        recording = memory.recording
        drive = recording.type("action", "NavigateAction", {"target": "pose"})
        pick = recording.type("action", "PickUpAction", {"arm": "text", "grip": "object", "poses": ("list", "real")})
        move = recording.type("motion", "MoveTCPMotion", {"speed": "real"})
        with recording.episode(description="Two robots carry a parcel", plan="carry_" * 60) as episode:
            episode.object_added("one", "agv-1", "ROBOT", Pose([0, 0, 0]))
            episode.object_added("two", HOSTILE, "ROBOT", Pose([1, 1, 0]))
            episode.object_added("parcel", "parcel", "GENERIC_OBJECT", Pose([2, 0, 1]))
            for turn, arm in enumerate(("LEFT", "RIGHT", "RIGHT")):
                for robot in ("one", "two"):
                    episode.start((robot, turn), drive, {"target": Pose([turn, 0.123456789, 0])}, robot=robot)
                    episode.object_moved(robot, Pose([turn, robot == "two", 0]))
                for robot in ("one", "two"):
                    episode.end((robot, turn), result={"moved_m": turn})
                values = {"arm": arm, "grip": "parcel", "poses": [0.5, turn]}
                episode.start("pick", pick, values, robot="two")
                episode.start("move", move, {"speed": 0.5}, parent="pick", robot="two")
                failed = ("IKError", f"cannot reach 1.{turn} m") if turn < 2 else None
                episode.end("move", failure=failed)
                if turn == 2:
                    episode.object_attached("two", "parcel", link="r_gripper_tool_frame")
                episode.end("pick", failure=failed)
        with recording.episode(description="one node") as episode:
            pass
        with recording.episode(description="another robot picks up") as episode:
            episode.object_added("one", "agv-1", "ROBOT", Pose([0, 0, 0]))
            episode.start("pick", pick, {}, robot="one")
            episode.start("move", move, {"speed": 0.5}, parent="pick", robot="one")
            episode.end("move", failure=("IKError", "cannot reach " * 200))
        memory.flush()
    for number in (1, 2, 3):
        done = pycrorm("report", str(number), "--url", "sqlite:///fleet.db", "--out", f"{number}.html", cwd=folder)
        assert done.returncode == 0, done.stderr
    for command in (
        ("report", "--all", "--out", "all.html"),
        ("diff", "1", "3", "--html", "diff.html"),
        ("diff", "1", "2", "3", "--html", "runs.html"),
    ):
        done = pycrorm(*command, "--url", "sqlite:///fleet.db", cwd=folder)
        assert done.returncode == 0, done.stderr


@pytest.fixture(scope="module")
def fleet(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """Return a folder with pages: of an episode of two robots, one of a single node without a world, all, and two."""
    return made_once(tmp_path_factory, "fleet", _record)


@pytest.fixture
def opened(chrome: Browser, fleet: Path) -> Iterator[Tab]:
    with chrome.open(fleet / "1.html") as tab:
        yield tab
        assert tab.problems() == []


def test_a_search_lists_matches_and_their_ways_and_is_kept_in_the_address(
    chrome: Browser, fleet: Path, opened: Tab
) -> None:
    opened.press("/")
    for key in "status:failed pick":
        opened.press(key)
    assert opened.ask(NAMES) == ["root", "PickUpAction", "PickUpAction"]
    assert opened.ask("document.querySelector('#find output').textContent") == "2 nodes"
    opened.press("Enter")
    first = opened.ask("pycrormPage.selected.start")
    opened.press("Enter")
    opened.wait_for("location.hash === `#n${pycrormPage.selected.start}&q=status%3Afailed%20pick`")
    address = opened.ask("location.hash")
    assert opened.ask("pycrormPage.selected.start") > first
    with chrome.open(fleet / "1.html", fragment=address) as tab:
        assert tab.ask(NAMES) == ["root", "PickUpAction", "PickUpAction"]
        assert tab.ask("document.querySelector('#find input').value") == "status:failed pick"
        tab.ask("document.activeElement.blur()")
        tab.press("Escape")
        assert len(tab.ask(NAMES)) == 13


FOUND = {
    "robot:agv-1": 3,
    "object:parcel": 3,
    "object:grip": 0,
    "type:motion text:0.5": 3,
    '"cannot reach 1.1"': 2,
    "nosuch:field": 0,
    'type:"': 13,
    "</script>": 9,
    "IKERROR move": 2,
}


def test_terms_find_nodes_by_their_field(opened: Tab) -> None:
    for query, count in FOUND.items():
        opened.ask(f"pycrormPage.search({query!r})")
        assert opened.ask("pycrormPage.tree.found.matches.size") == count, query


def test_an_address_with_a_node_selects_it_and_one_that_is_wrong_opens_the_page(chrome: Browser, fleet: Path) -> None:
    with chrome.open(fleet / "1.html") as tab:
        start = tab.ask("pycrormPage.episode.nodes.find((each) => each.name === 'MoveTCPMotion').start")
    for fragment, selected in (
        (f"#n{start}", start),
        (f"#n{start}&e9", start),
        ("#n1", None),
        ("#n%&q=%E0%A4%A", None),
    ):
        with chrome.open(fleet / "1.html", fragment=fragment) as tab:
            assert tab.ask("pycrormPage.selected?.start ?? null") == selected
            if fragment.endswith("&e9"):
                assert tab.ask("pycrormPage.event") == 9
            assert tab.problems() == []


def test_details_have_all_parameters_the_result_the_robot_and_a_link(opened: Tab) -> None:
    opened.ask("pycrormPage.select(pycrormPage.episode.nodes.find((each) => each.type === 'NavigateAction'))")
    text = opened.ask("document.getElementById('panel').innerText")
    assert "(0.0, 0.123457, 0.0) turned (0.0, 0.0, 0.0, 1.0)" in text
    assert '{"moved_m":0}' in text
    assert "agv-1" in text
    opened.ask("navigator.clipboard.writeText = (text) => { globalThis.copied = text; return Promise.resolve(); }")
    opened.ask("document.querySelector('button.copy').click()")
    assert opened.ask("globalThis.copied.endsWith(`#n${pycrormPage.selected.start}`)")
    opened.ask("pycrormPage.select(pycrormPage.episode.nodes.find((each) => each.type === 'PickUpAction'))")
    assert "[0.5,0.0]" in opened.ask("document.getElementById('panel').innerText")


def test_failures_that_are_alike_show_what_differs(opened: Tab) -> None:
    cells = "[...each.cells].slice(1).map((cell) => cell.innerText)"
    assert opened.ask(f"[...document.querySelectorAll('.failure tr')].map((each) => {cells})") == [
        ["PickUpAction arm", "PickUpAction poses", "reach …"],
        ["LEFT", "[0.5,0.0]", "1.0"],
        ["RIGHT", "[0.5,1.0]", "1.1"],
    ]


def test_each_robot_has_lanes_a_colour_and_its_name_and_what_an_arm_holds_is_said(opened: Tab) -> None:
    robots = "new Set(nodes.map((each) => each.robot)).size"
    lanes = f"pycrormPage.gantt.lanes.drawn.map(({{ nodes, robot }}) => [robot ?? '', {robots}])"
    assert [each for each in opened.ask(lanes) if each[0]] == [["agv-1", 1], [HOSTILE, 1]]
    assert {size for _, size in opened.ask(lanes)} == {1}
    assert opened.ask("document.querySelectorAll('.row .robot bdi').length") == 9  # not again at what it does inside
    assert opened.ask("document.querySelectorAll('.row .robot').length") == 12
    opened.ask("pycrormPage.colors.value = 'robot'; pycrormPage.colors.dispatchEvent(new Event('change'))")
    assert opened.ask("[...document.querySelectorAll('#hues .robot')].map((each) => each.textContent)") == [
        "agv-1",
        HOSTILE,
    ]
    hue = opened.ask("getComputedStyle(document.documentElement).getPropertyValue('--hue-1').trim()")
    pixel = """(() => {
      const { gantt } = pycrormPage, { drawn } = gantt.lanes, node = drawn.at(-1).nodes[0], y = drawn.at(-1).y + 3;
      const place = [Math.round(gantt.xOf(node.start)) + 2, y];
      return [...gantt.canvas.getContext("2d").getImageData(...place, 1, 1).data].slice(0, 3);
    })()"""
    opened.settle()
    assert f"#{bytes(opened.ask(pixel)).hex()}" == hue
    opened.press("End")
    opened.settle()
    assert f"{HOSTILE} holds parcel in its right arm" in opened.ask("document.getElementById('legend').textContent")
    assert "parcel in the right arm" in opened.ask("document.querySelector('.names').textContent")


def test_show_and_diff_name_the_robot_where_another_one_begins_to_act(fleet: Path) -> None:
    shown = pycrorm("show", "1", "--url", "sqlite:///fleet.db", cwd=fleet).stdout
    assert shown.count("NavigateAction  by agv-1  ") == 3
    assert [line for line in shown.splitlines() if "MoveTCPMotion" in line and " by " in line] == []
    compared = pycrorm("diff", "1", "3", "--url", "sqlite:///fleet.db", "--json", cwd=fleet).stdout
    robots = [each for each in json.loads(compared)["differences"] if each["what"] == "robot"]
    named = [(each["where"], each["first"], each["second"]) for each in robots]
    assert named == [("root > PickUpAction", HOSTILE, "agv-1")]  # and not again at what is inside


def test_the_chart_moves_and_zooms_by_keys_and_shows_its_part_of_the_whole(opened: Tab) -> None:
    opened.ask("pycrormPage.seek(20); pycrormPage.gantt.canvas.focus()")
    whole = opened.ask("pycrormPage.gantt.window")
    opened.press("w")
    opened.press("w")
    low, high = opened.ask("pycrormPage.gantt.window")
    assert low < 20 < high
    assert high - low < 0.5 * (whole[1] - whole[0])
    opened.press("d")
    moved = opened.ask("pycrormPage.gantt.window")
    assert moved[0] > low
    assert round(moved[1] - moved[0], 6) == round(high - low, 6)
    for _ in range(20):
        opened.press("a")
    assert opened.ask("pycrormPage.gantt.window[0]") == whole[0]
    opened.press("0")
    assert opened.ask("pycrormPage.gantt.window") == whole
    assert opened.ask("pycrormPage.event") == 20


@pytest.mark.parametrize("script", ["", NO_WEBGL])
def test_a_page_of_one_node_without_a_world_opens_and_is_searched(chrome: Browser, fleet: Path, script: str) -> None:
    with chrome.open(fleet / "2.html", script=script) as tab:
        tab.ask("pycrormPage.search('nothing')")
        assert tab.ask(NAMES) == []
        tab.ask("document.getElementById('tree').focus()")
        tab.press("ArrowDown")
        tab.ask("pycrormPage.search('')")
        assert tab.ask(NAMES) == ["root"]
        tab.ask("pycrormPage.colors.value = 'type'; pycrormPage.colors.dispatchEvent(new Event('change'))")
        assert tab.problems() == []


def test_play_shows_few_pictures_where_less_motion_is_preferred(opened: Tab) -> None:
    opened.call("Emulation.setEmulatedMedia", features=[{"name": "prefers-reduced-motion", "value": "reduce"}])
    opened.ask("pycrormPage.seek(1); pycrormPage.shows = 0")
    counting = "pycrormPage.playback.onEvent = (event) => { pycrormPage.shows += 1; onEvent(event); };"
    opened.ask(f"(() => {{ const {{ onEvent }} = pycrormPage.playback; {counting} }})()")
    opened.press(" ")
    opened.wait_for("pycrormPage.event >= 8")
    assert opened.ask("pycrormPage.shows") <= 4  # and not one for each event
    opened.press(" ")


@pytest.fixture(scope="module")
def axe(tmp_path_factory: pytest.TempPathFactory) -> str:
    """Return the program axe-core (Deque, MPL-2.0), which npm brings; it is in no package of ours."""
    npm = shutil.which("npm")
    if npm is None:
        pytest.skip("no npm is installed")

    def install(folder: Path) -> None:
        command = [npm, "install", "--silent", "--ignore-scripts", "--no-save", "--prefix", str(folder), AXE]
        subprocess.run(command, check=False, capture_output=True, timeout=120)

    file = made_once(tmp_path_factory, "axe", install) / "node_modules" / "axe-core" / "axe.min.js"
    if not file.is_file():
        pytest.skip(f"{AXE} cannot be installed")
    return file.read_text(encoding="utf-8")


@pytest.mark.parametrize(("dark", "width"), [(False, 1400), (True, 390)])
def test_axe_finds_nothing_critical_or_serious(
    chrome: Browser, fleet: Path, pages: dict[str, Path], axe: str, dark: bool, width: int
) -> None:
    names = "globalThis.pycrormPage?.panels.tabs.map(([name]) => name) ?? ['the whole']"
    opening = "globalThis.pycrormPage?.panels.open('{}')"
    serious = "axe.run().then(({ violations }) => violations.map(({ impact, id }) => [impact, id]))"
    shown = [fleet / f"{each}.html" for each in ("1", "2", "3", "all", "diff", "runs")]
    for page in (*shown, pages["plan"]):
        fragment = "#by=robot&vs=agv-1&vs=none" if page.name == "all.html" else "#e20"
        with chrome.open(page, width=width, dark=dark, fragment=fragment) as tab:
            tab.ask(f"{axe}; 0")
            for name in tab.ask(names):
                tab.ask(opening.format(name))
                found = [each for each in tab.ask(serious) if each[0] in ("critical", "serious")]
                assert found == [], (page.name, name)
