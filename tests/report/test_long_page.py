"""The page of a long episode: collapsed, opened at failures, with few elements, below 20 MB."""

import random
from pathlib import Path

import pytest

from pycrorm_async.memory import Memory
from pycrorm_async.query.reading import Reading
from pycrorm_async.report.write import report
from pycrorm_async.world import Pose
from tests.report.browser import Browser

pytestmark = pytest.mark.slow


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
    async with Reading.open(url) as reading:
        written = await report(reading, 1, tmp_path / "long.html")
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
