"""The page in a real Chromium: it opens by one request and shows the episode, at any width and without WebGL."""

from collections.abc import Iterator
from pathlib import Path
from typing import Any

import pytest

from pycrorm_async import world_of
from pycrorm_async.query.reading import Reading
from tests.commands import pycrorm
from tests.report.browser import Browser, Tab

pytestmark = pytest.mark.slow

NO_WEBGL = """
HTMLCanvasElement.prototype.getContext = ((original) => function (kind, ...rest) {
  return kind.startsWith("webgl") ? null : original.call(this, kind, ...rest);
})(HTMLCanvasElement.prototype.getContext);
"""

POSE = "pycrormPage.bodies.of(pycrormPage.episode.objects.find((each) => each.name === '{}')).group.position.toArray()"


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


@pytest.mark.parametrize(
    ("dark", "width"),
    [
        (False, 420),
        (True, 800),
        *(pytest.param(*each, marks=pytest.mark.soak) for each in ((True, 420), (False, 800), (True, 1400))),
    ],
)
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


def test_an_address_with_an_event_opens_the_page_at_that_moment(chrome: Browser, pages: dict[str, Path]) -> None:
    with chrome.open(pages["plan"], fragment="#e10") as tab:
        assert tab.ask("pycrormPage.event") == 10
        assert position(tab, "milk") == [1.3, 1.0, 0.9]
        tab.ask("location.hash = '#e12'")
        tab.wait_for("pycrormPage.event === 12")


def test_keys_and_the_slider_move_the_moment_and_the_address_follows(chrome: Browser, pages: dict[str, Path]) -> None:
    with chrome.open(pages["plan"], fragment="#e10") as tab:
        tab.press("ArrowRight")
        tab.press("ArrowRight", modifiers=8)
        assert tab.ask("pycrormPage.event") == 21
        tab.press("Home")
        assert tab.ask("pycrormPage.event") == 1
        tab.ask("{const s = document.querySelector('input'); s.value = 30; s.dispatchEvent(new Event('input'))}")
        assert tab.ask("pycrormPage.event") == 30
        tab.wait_for("location.hash === '#e30'")
        tab.press("f")
        assert tab.ask("pycrormPage.selected.reason") == "IKError"
        shown = tab.ask("pycrormPage.event")
        tab.press(" ", code="Space")
        tab.wait_for(f"pycrormPage.event > {max(shown, 40)}")
        tab.press(" ", code="Space")
        assert_quiet(tab, pages["plan"])


def test_failures_are_grouped_by_reason_with_their_count(opened: Tab) -> None:
    opened.ask("pycrormPage.panels.open('failures')")
    assert opened.ask("[...document.querySelectorAll('.failure')].map((each) => each.children[0].textContent)") == [
        "✗ 2 × IKError"  # noqa: RUF001  the page's sign
    ]
    assert "4 failed from 2 causes" in opened.ask("document.getElementById('facts').textContent")


def test_every_tab_draws(opened: Tab, pages: dict[str, Path]) -> None:
    names = opened.ask("pycrormPage.panels.tabs.map(([name]) => name)")
    assert names == ["details", "failures", "objects", "attachments", "states"]
    for name in names:
        opened.ask(f"pycrormPage.panels.open('{name}')")
        assert len(opened.ask("document.querySelector('.panel').textContent")) > 20
    assert_quiet(opened, pages["plan"])


def test_the_scene_is_drawn_with_forward_kinematics(chrome: Browser, pages: dict[str, Path]) -> None:
    gripper = "pycrormPage.bodies.of(pycrormPage.episode.objects[1]).links.get('l_gripper_tool_frame')"
    where = f"(new THREE.Vector3()).setFromMatrixPosition({gripper}.matrixWorld).toArray()"
    with chrome.open(pages["plan"]) as tab:
        tab.ask("pycrormPage.seek(pycrormPage.episode.attachments[0][3])")
        held, milk = tab.ask(where), tab.ask(POSE.format("milk"))
        assert max(abs(one - other) for one, other in zip(held, milk, strict=True)) < 0.05


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


@pytest.mark.soak_on(1400)
@pytest.mark.parametrize("width", [420, 1400])
def test_the_names_on_the_map_cover_no_other_and_are_inside(
    chrome: Browser, pages: dict[str, Path], width: int
) -> None:
    with chrome.open(pages["plan"], width=width, script=NO_WEBGL) as tab:
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
        assert tab.ask("document.querySelectorAll('.panel h2').length") == 5
        assert tab.print(tmp_path / "page.pdf").stat().st_size > 10_000
        assert_quiet(tab, pages["plan"])


def test_the_page_of_a_lost_episode_shows_the_world_at_its_last_event(chrome: Browser, pages: dict[str, Path]) -> None:
    with chrome.open(pages["dies"]) as tab:
        assert tab.ask("document.getElementById('status').textContent") == "? LOST"
        assert tab.ask("pycrormPage.episode.presentAt(pycrormPage.event).length") == 4
        assert tab.ask("pycrormPage.episode.nodes[0].status") == "LOST"
        assert_quiet(tab, pages["dies"])


def test_a_robot_that_is_not_the_pr2_is_drawn(opened_drive: Tab, pages: dict[str, Path]) -> None:
    assert position(opened_drive, "courier") == [1.0, 0.5, 0.0]
    assert opened_drive.ask("pycrormPage.bodies.of(pycrormPage.episode.objects[0]).links.size") > 5
    assert_quiet(opened_drive, pages["drives"])


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


@pytest.mark.soak_on(1400)
@pytest.mark.parametrize("width", [420, 1400])
def test_a_table_of_episodes_counts_failures_by_reason_and_leads_to_the_pages(
    chrome: Browser, recorded: Path, tmp_path: Path, width: int
) -> None:
    done = pycrorm("report", "--all", "--out", tmp_path / "all of them.html", cwd=recorded)
    assert done.returncode == 0, done.stderr
    with chrome.open(tmp_path / "all of them.html", width=width) as tab:
        rows = "[...document.querySelectorAll('{} tr')].map((each) => each.children[{}].textContent)"
        assert tab.ask(rows.format("#episodes tbody", 0)) == ["3", "2", "1"]
        assert tab.ask(rows.format("#episodes tbody", 2)) == ["✓ SUCCEEDED", "? LOST", "✓ SUCCEEDED"]
        assert tab.ask(rows.format("#reasons", 0)) == ["4"]
        assert tab.ask(rows.format("#reasons", 1)) == ["IKError"]
        assert "67 % succeeded" in tab.ask("document.getElementById('facts').textContent")
        assert tab.ask("document.querySelector('#success h2').textContent") == "Pick-ups: 20 % of 5 succeeded"
        hints = "[...document.querySelectorAll('#success svg:last-child title')].map((each) => each.textContent)"
        assert tab.ask(hints) == ["LEFT, FRONT: 33 % of 3", "RIGHT, FRONT: 0 % of 2"]
        tab.ask("document.querySelector('th button').click()")
        assert tab.ask(rows.format("#episodes tbody", 0)) == ["1", "2", "3"]
        assert tab.ask("document.documentElement.scrollWidth") == width
        assert tab.ask("document.querySelectorAll('b, script:not([type])').length") == 1
        assert_quiet(tab, tmp_path / "all of them.html")
        tab.ask("document.querySelector('td a').click()")
        tab.wait_for("globalThis.pycrormPage?.episode.number === 1")


@pytest.mark.soak_on("courier")
@pytest.mark.parametrize(
    ("page", "number", "name"), [("opened", 1, "pr2"), ("opened_drive", 3, "courier"), ("opened_drive", 3, "other")]
)
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


def test_curves_have_values_with_units_and_their_range(opened: Tab) -> None:
    opened.ask("pycrormPage.panels.open('states')")
    texts = "[...document.querySelectorAll('figure')].map((each) => each.innerText.split('\\n').filter(Boolean))"
    curves = {name: rest for name, *rest in opened.ask(texts)}
    assert curves["pr2 base.y"] == ["0.44 m", "-1.5 to 0.89 m"]
    assert curves["pr2 l_elbow_flex_joint"][0].endswith(" rad")


def test_a_moment_at_which_nothing_runs_shows_the_episode(chrome: Browser, pages: dict[str, Path]) -> None:
    with chrome.open(pages["drives"], fragment="#e1") as tab:
        text = tab.ask("document.querySelector('.panel').innerText")
        assert text.startswith("No node runs at this moment.\n\nEpisode\nid\n")
        assert "plan\nbreakfast.py:drives" in text
