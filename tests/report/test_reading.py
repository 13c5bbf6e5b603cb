"""Pages are easy to read: contrast, room, whole words, signs for control characters, shapes as recorded."""

from pathlib import Path
from typing import Any

import pytest

from pycrorm_async.memory import Memory
from pycrorm_async.query.reading import Reading
from pycrorm_async.report.write import report
from tests.report.browser import Browser
from tests.report.test_document import HOSTILE, record
from tests.report.test_page import NO_WEBGL

pytestmark = pytest.mark.slow

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
    with chrome.open(pages["plan"], width=800) as tab:
        cut = "[...document.querySelectorAll('.row .name')].filter((each) => each.scrollWidth > each.clientWidth)"
        names = tab.ask(f"{cut}.map((each) => each.textContent)")
        assert set(names) <= {"MoveArmJointsMotion", "MoveGripperMotion"}  # the longest, where they are deepest
        widths = """[...document.querySelectorAll('.parameters bdi')].filter((each) => each.textContent
          && getComputedStyle(each).visibility === 'visible').map((each) => each.parentElement.clientWidth)"""
        assert min(tab.ask(widths)) >= 60


@pytest.mark.soak_on(1400)
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
    async with Reading.open(url) as reading:
        await report(reading, 1, tmp_path / "page.html")
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


def test_a_capsule_has_round_ends(chrome: Browser, pages: dict[str, Path]) -> None:
    corners = """(() => {
      const model = { root: "base", joints: [], shapes: { base: [["capsule", [0.3, 1], [0, 0, 0], [0, 0, 0], null]] } };
      const { group } = new (pycrormPage.bodies.of(pycrormPage.episode.objects[0]).constructor)({}, model);
      let positions = [];
      group.traverse((each) => each.isMesh && (positions = [...each.geometry.attributes.position.array]));
      return positions;
    })()"""
    with chrome.open(pages["drives"]) as tab:
        numbers = tab.ask(corners)
    points = [numbers[at : at + 3] for at in range(0, len(numbers), 3)]
    assert max(z for _, _, z in points) == pytest.approx(0.8)
    assert min(z for _, _, z in points) == pytest.approx(-0.8)
    for x, y, z in points:
        assert (x * x + y * y + (abs(z) - 0.5) ** 2) ** 0.5 == pytest.approx(0.3)
