"""The chart in a browser: its map of the whole, and the curves on its axis, moved by keys and by the mouse."""

from pathlib import Path
from typing import Any

import pytest

from tests.report.browser import Browser, Tab

pytestmark = pytest.mark.slow

DRAWN = """[...document.querySelectorAll('.overlay path')].map((each) =>
  [...each.getAttribute('d').matchAll(/[MH]([\\d.]+)(?:[V,]([\\d.]+))?/g)].map(
    ([, x, y]) => [Number(x), y && Number(y)]))"""
"""The places at which the steps of each chosen curve begin, in pixels, and the right end of the last one."""
PLACES = """[...pycrormPage.curves.chosen.values()].map(({ track: { at, values } }) => {
  const [first, last] = pycrormPage.gantt.shownEvents;
  const shown = at.map((event, index) => [event, values[index]]).filter(([event]) => event > first && event <= last);
  return shown.map(([event, value]) => [Number(pycrormPage.gantt.xOf(event).toFixed(1)), value]); })"""
"""The places on the chart of the changes of each chosen curve after the left end, and their values."""
MAP = """(() => { const { axis } = pycrormPage.gantt;
  const pen = new OffscreenCanvas(axis.width, 1).getContext('2d', { willReadFrequently: true });
  pen.drawImage(axis, 0, -23);
  const row = pen.getImageData(0, 0, axis.width, 1).data;
  const colors = Array.from({ length: axis.width }, (_, x) => row.slice(4 * x, 4 * x + 4).join());
  const runs = [];
  for (const [x, color] of colors.entries()) {
    if (runs.at(-1)?.color === color) runs.at(-1).to = x + 1;
    else runs.push({ color, from: x, to: x + 1 });
  }
  return runs.filter(({ color }) => color.endsWith(',255')).map(({ color, from, to }) => [color, from, to]); })()"""
"""The runs of one colour on the map of the whole: what is drawn, and the failures."""
WINDOW = "pycrormPage.gantt.window"


def choose(tab: Tab, *names: str) -> None:
    tab.ask("pycrormPage.panels.open('states')")
    for name in names:
        tab.ask(
            f"[...document.querySelectorAll('.curves button')].find((each) => each.textContent === '{name}').click()"
        )


def mouse(tab: Tab, kind: str, selector: str, x: float, y: float, **more: Any) -> None:
    """Send an event of the mouse at a place in an element, in pixels from its upper left corner."""
    left, top = tab.ask(f"(({{ x, y }}) => [x, y])(document.querySelector('{selector}').getBoundingClientRect())")
    more = {"button": "left", "clickCount": 1, **more}
    tab.call("Input.dispatchMouseEvent", type=kind, x=left + x, y=top + y, **more)


def assert_on_axis(tab: Tab, curves: int) -> None:
    """Assert that each chosen curve steps where the chart has the events of its changes, and nowhere else."""
    tab.settle()
    drawn, places = tab.ask(DRAWN), tab.ask(PLACES)
    assert len(drawn) == len(places) == curves
    left, right = tab.ask("pycrormPage.gantt.ends")
    for steps, changes in zip(drawn, places, strict=True):
        assert [x for x, _ in steps if left < x < right] == [x for x, _ in changes if left < x < right]


def test_chosen_curves_lie_over_one_another_on_the_axis_of_the_chart(chrome: Browser, pages: dict[str, Path]) -> None:
    legend = "[...document.querySelectorAll('.legend button')].map((each) => each.innerText.replaceAll('\\n', ' '))"
    ends = "[...document.querySelectorAll('.overlay text')].map((each) => each.textContent)"
    with chrome.open(pages["plan"]) as tab:
        choose(tab, "pr2 base.x", "pr2 base.y", "pr2 l_upper_arm_roll_joint")
        assert_on_axis(tab, 3)
        tops = [[min(y for _, y in steps if y is not None) for steps in tab.ask(DRAWN)]]
        assert tab.ask(ends) == ["0.89 m · 1.466 rad", "-2.6 m · 0 rad"]  # one scale a unit
        assert tab.ask(legend) == [
            "pr2 base.x 0.67 m ✕", "pr2 base.y 0.44 m ✕", "pr2 l_upper_arm_roll_joint 1.38 rad ✕",
            "each in its own scale",
        ]  # fmt: skip
        tab.ask("document.querySelector('.legend [data-key=alone]').click()")
        tops.append([min(y for _, y in steps if y is not None) for steps in tab.ask(DRAWN)])
        assert tops == [[21.3, 16, 16], [16, 16, 16]]
        assert tab.ask(legend)[0] == "pr2 base.x 0.67 m (-2.6 to 0.69) ✕"
        styles = "[...document.querySelectorAll('.overlay path')].map((each) => getComputedStyle(each).{})"
        for style in ("stroke", "strokeDasharray"):
            assert len(set(tab.ask(styles.format(style)))) == 3, style

        tab.ask("pycrormPage.curves.overlay.focus(); pycrormPage.seek(60)")
        for keys, shown in (("ww", 52.4), ("d", 52.4), ("s", 74.3), ("0", 107)):
            for key in keys:
                tab.press(key)
            assert_on_axis(tab, 3)
            low, high = tab.ask(WINDOW)
            assert round(high - low, 1) == shown
        tab.ask("document.querySelectorAll('.curves button')[1].focus()")
        tab.press("w")
        low, high = tab.ask(WINDOW)
        assert round(high - low, 1) == 74.9
        tab.settle()
        assert tab.ask("document.activeElement.textContent") == "pr2 base.y"
        small = "document.querySelector('.curve path').getAttribute('d').match(/H([\\d.]+)V/)[1]"
        (left, right), (moved, _) = tab.ask("pycrormPage.gantt.ends"), tab.ask(PLACES)[0][0]
        assert float(tab.ask(small)) == pytest.approx(220 * (moved - left) / (right - left), abs=0.1)
        tab.ask("pycrormPage.gantt.setAxis(true)")
        assert_on_axis(tab, 3)

        event = tab.ask("pycrormPage.gantt.shownEvents[0]")
        mouse(tab, "mousePressed", ".overlay", 8, 40)
        mouse(tab, "mouseReleased", ".overlay", 8, 40)
        assert tab.ask("pycrormPage.event") == event
        mouse(tab, "mouseWheel", ".overlay", 400, 40, deltaX=0, deltaY=-100)
        tab.wait_for(f"{WINDOW}[1] < pycrormPage.episode.secondsAt(108)")
        assert_on_axis(tab, 3)
        low, high = tab.ask(WINDOW)
        mouse(tab, "mouseWheel", ".overlay", 400, 40, deltaX=-90, deltaY=0)
        tab.wait_for(f"{WINDOW}[0] < {low}")
        assert tab.ask(f"{WINDOW}[1] - {WINDOW}[0]") == pytest.approx(high - low)
        tab.ask("document.querySelector('.legend button').focus()")
        tab.press(" ")
        assert_on_axis(tab, 2)
        assert tab.ask("[document.activeElement.className, pycrormPage.playback.running]") == ["legend", False]
        tab.wait_for("location.hash.split('c=').length === 3")
        address, legend_now = tab.ask("location.hash"), tab.ask(legend)
        assert tab.problems() == []
    with chrome.open(pages["plan"], fragment=f"{address}&c=none&c=%E0%A4%A") as tab:  # two that name no curve
        assert [each.split()[:2] for each in tab.ask(legend)] == [each.split()[:2] for each in legend_now]
        assert_on_axis(tab, 2)
        tab.ask("location.hash = '#e20'")
        tab.wait_for("!document.getElementById('curves').hasChildNodes()")
        assert tab.problems() == []


def test_six_of_many_curves_have_room_and_the_others_are_found_by_name(chrome: Browser, pages: dict[str, Path]) -> None:
    names = "[...document.querySelectorAll('.curves button')].map((each) => each.textContent)"
    with chrome.open(pages["plan"], width=390) as tab:
        tab.ask("pycrormPage.panels.open('states')")
        choose(tab, *tab.ask(names)[:7])
        assert len(tab.ask(DRAWN)) == 6
        tab.wait_for("document.querySelector('.panel').textContent.includes('no more have room')")
        tab.ask("document.querySelector('.panel input').focus()")
        for key in "elbow":  # of which w and a are keys of the page, too
            tab.press(key)
        tab.settle()
        assert tab.ask(names) == ["pr2 l_elbow_flex_joint", "pr2 r_elbow_flex_joint"]
        assert tab.ask("[document.activeElement.value, pycrormPage.gantt.byTime]") == ["elbow", False]
        assert tab.ask("document.documentElement.scrollWidth") == 390
        assert tab.problems() == []


def test_the_map_of_the_chart_shows_the_drawn_part_and_the_failures_and_is_dragged(
    chrome: Browser, pages: dict[str, Path]
) -> None:
    with chrome.open(pages["plan"]) as tab:
        assert tab.ask(MAP) == []  # all is drawn
        tab.ask("pycrormPage.seek(85); pycrormPage.gantt.canvas.focus()")
        tab.press("w")
        tab.press("w")
        (low, high), (left, right) = tab.ask(WINDOW), tab.ask("pycrormPage.gantt.ends")
        places = [left + (each - 1) / 107 * (right - left) for each in (low, high)]
        *failures, drawn = tab.ask(MAP)
        assert drawn[1:] == pytest.approx(places, abs=1)
        events = tab.ask("pycrormPage.episode.rootFailures.map((each) => each.lastEvent)")
        marked = [(begin + end) / 2 for color, begin, end in failures if color != drawn[0]]
        assert marked == pytest.approx([left + (each - 1) / 107 * (right - left) for each in events], abs=1)
        axis = "#gantt .axis"
        mouse(tab, "mousePressed", axis, 500, 22)
        assert sum(tab.ask(WINDOW)) / 2 == pytest.approx(1 + (500 - left) / (right - left) * 107)
        mouse(tab, "mouseMoved", axis, 100, 22)
        assert tab.ask(WINDOW) == pytest.approx([1, 1 + high - low])
        mouse(tab, "mouseReleased", axis, 100, 22)
        mouse(tab, "mouseMoved", axis, 600, 22)
        assert tab.ask(f"{WINDOW}[0]") == 1  # released: nothing is dragged any more
        assert tab.ask("pycrormPage.event") == 85
        mouse(tab, "mousePressed", axis, right, 4)  # above the map are the labels of the axis itself
        mouse(tab, "mouseReleased", axis, right, 4)
        assert tab.ask("pycrormPage.event") == tab.ask("pycrormPage.gantt.shownEvents[1]")
        assert tab.problems() == []
