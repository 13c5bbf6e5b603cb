"""The chart of the nodes: statuses readable without colour at any width, labels that are whole, an axis in sight."""

from itertools import pairwise
from pathlib import Path

import pytest

from pycrorm_async.events.types import NodeStatus
from pycrorm_async.memory import Memory
from pycrorm_async.query.reading import Reading
from pycrorm_async.report.write import report
from pycrorm_async.world import Pose
from tests.report.browser import Browser
from tests.report.test_long_page import record_pick_ups

pytestmark = pytest.mark.slow

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
            async with Reading.open(url) as reading:
                await report(reading, 1, tmp_path / "running.html")
        memory.flush()
    async with Reading.open(url) as reading:
        await report(reading, 1, tmp_path / "ended.html")
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
    async with Reading.open(url) as reading:
        await report(reading, 1, tmp_path / "page.html")
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
            tab.ask("pycrormPage.gantt.lanes.nodes.push(...Array(12).fill([])); pycrormPage.gantt.draw()")
            bottoms = "[...document.querySelectorAll('#gantt, #gantt .axis')]"
            holder, axis = tab.ask(f"{bottoms}.map((each) => each.getBoundingClientRect().bottom)")
            assert holder == axis
            assert tab.problems() == []
