"""The earlier actions most like those of a page: which they are, where they lead, and when there are none."""

import asyncio
import json
import re
import shutil
import sqlite3
from contextlib import closing
from pathlib import Path
from typing import Any

import pytest
from sqlalchemy import select

from pycrorm_async.events.ids import row_id
from pycrorm_async.memory import Memory
from pycrorm_async.orm import TaskTreeNode
from pycrorm_async.query.reading import Reading
from pycrorm_async.recall.recall import Recall
from pycrorm_async.report import write as similar_cases
from pycrorm_async.report.overview import overview
from pycrorm_async.report.write import SimilarCases, report
from tests.report.browser import Browser

HOSTILE = "</script><b onload=alert(1)>"


@pytest.fixture(scope="module")
def url(tmp_path_factory: pytest.TempPathFactory) -> str:
    """Return the URL of a memory with two episodes: each grasps with the left arm and fails, then with the right."""
    url = f"sqlite:///{tmp_path_factory.mktemp('similar') / 'memory.db'}"
    with Memory.sync(url) as memory:
        grasp = memory.recording.type("action", "GraspAction", {"arm": str, "grams": float, "tool": str})
        close = memory.recording.type("motion", "CloseMotion", {"arm": str})
        for grams in (100.0, 120.0):
            with memory.recording.episode(description="grasps") as episode:
                episode.start("left", grasp, {"arm": "LEFT", "grams": grams, "tool": HOSTILE})
                episode.start("closes", close, {"arm": "LEFT"}, parent="left")
                episode.end("closes", "FAILED", "it slipped")
                episode.end("left", "FAILED", "it slipped")
                episode.start("right", grasp, {"arm": "RIGHT", "grams": grams, "tool": HOSTILE})
                episode.end("right", "SUCCEEDED")
        memory.flush()
    return url


async def starts_of(reading: Reading, number: int) -> list[int]:
    nodes = select(TaskTreeNode.sequence).where(TaskTreeNode.process_metadata_id == number)
    async with reading.session() as session:
        return [*(await session.scalars(nodes))]


async def document_of(url: str, number: int) -> Any:
    async with Reading.open(url) as reading:
        return await SimilarCases(reading).document(number, await starts_of(reading, number))


def in_page(page: Path) -> Any:
    """Return the similar cases that a page holds."""
    found = re.search(r'<script [^>]*id="document"[^>]*>(.*?)</script>', page.read_text(), re.DOTALL)
    assert found is not None
    return json.loads(found[1])["similar"]


async def test_they_are_those_that_recall_finds_before_the_action(url: str) -> None:
    async with Reading.open(url) as reading:
        recall = Recall.of(reading)
        document = await SimilarCases(reading).document(2, await starts_of(reading, 2))
        assert document is not None
        assert document["actions"] == len(document["nodes"]) == 2
        for start, entry in document["nodes"].items():
            case = await recall.case(row_id(2, int(start), 0))
            expected = [each for each in await recall.like(case) if each.case.started_us < case.started_us]
            assert [each[:5] for each in entry["cases"]] == [
                [each.case.episode, each.case.sequence, round(each.score, 3), each.status, each.case.reason or ""]
                for each in expected
            ]
    left, right = document["nodes"].values()
    assert (left["success"], left["reasons"]) == ("1 of 2 succeeded (9-91 %)", "it slipped 1")
    assert (right["success"], len(right["cases"])) == ("1 of 3 succeeded (6-79 %)", 3)
    texts = document["texts"]
    first, other = right["cases"][0], right["cases"][1]
    assert "arm RIGHT" in [texts[each] for each in first[6]]
    assert [texts[each] for each in first[7]] == ["grams 100, here 120"]
    assert "arm LEFT, here RIGHT" in [texts[each] for each in other[7]]


async def test_an_action_without_an_earlier_one_has_an_empty_answer(url: str) -> None:
    left, right = (await document_of(url, 1))["nodes"].values()
    assert left == {"success": "", "reasons": "", "cases": []}
    assert len(right["cases"]) == 1


async def test_failures_are_compared_first_and_a_large_memory_compares_fewer(
    url: str, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setattr(similar_cases, "ACTIONS_MAX", 1)
    document = await document_of(url, 2)
    assert (document["actions"], len(document["nodes"])) == (2, 1)
    assert min(document["nodes"], key=int) == min(map(str, (await document_of(url, 2))["nodes"]), key=int)
    monkeypatch.setattr(similar_cases, "ACTIONS_MAX", 200)
    monkeypatch.setattr(similar_cases, "ACTIONS_MIN", 0)
    monkeypatch.setattr(similar_cases, "_COMPARED_MAX", 4)
    assert len((await document_of(url, 2))["nodes"]) == 1
    monkeypatch.setattr(similar_cases, "_COMPARED_MAX", 3)
    assert (await document_of(url, 2))["nodes"] == {}


async def test_a_memory_without_cases_of_this_version_has_pages_without_them(url: str, tmp_path: Path) -> None:
    for change in ("UPDATE pycrorm_generation SET version = 0", "DELETE FROM pycrorm_generation"):
        with closing(sqlite3.connect(copy_of(url, tmp_path))) as database, database:
            database.execute(f"{change} WHERE projection LIKE '%recall'")
        async with Reading.open(f"sqlite:///{tmp_path / 'memory.db'}") as reading:
            await report(reading, 2, tmp_path / "page.html", force=True)
        assert in_page(tmp_path / "page.html") is None


async def test_a_page_reports_that_its_cases_are_damaged(url: str, tmp_path: Path) -> None:
    with closing(sqlite3.connect(copy_of(url, tmp_path))) as database, database:
        (table,) = database.execute("SELECT name FROM sqlite_master WHERE name LIKE 'zz_%_recall_block%'").fetchone()
        database.execute(f"UPDATE {table} SET data = x'00'")
    async with Reading.open(f"sqlite:///{tmp_path / 'memory.db'}") as reading:
        await report(reading, 2, tmp_path / "page.html")
    assert "block" in in_page(tmp_path / "page.html")["fault"]


def copy_of(url: str, folder: Path) -> Path:
    return Path(shutil.copy(url.removeprefix("sqlite:///"), folder / "memory.db"))


async def test_pages_of_one_report_lead_to_each_other_and_to_no_page_that_is_missing(url: str, tmp_path: Path) -> None:
    async with Reading.open(url) as reading:
        await overview(reading, tmp_path / "all.html")
        await report(reading, 2, tmp_path / "alone.html")
    assert in_page(tmp_path / "all.pages" / "episode-2.html")["pages"] == {"1": "episode-1.html"}
    assert in_page(tmp_path / "alone.html")["pages"] == {}
    with closing(sqlite3.connect(copy_of(url, tmp_path))) as database, database:
        database.execute("DROP TRIGGER event_is_not_updated")
        database.execute("UPDATE event SET payload = '{' WHERE episode = 1 AND sequence = 3")
    async with Reading.open(f"sqlite:///{tmp_path / 'memory.db'}") as reading:
        written = await overview(reading, tmp_path / "damaged.html")
    assert [*written.unreadable] == [1]
    assert in_page(tmp_path / "damaged.pages" / "episode-2.html")["pages"] == {}


@pytest.mark.slow
def test_a_node_shows_them_as_text_and_leads_to_them(chrome: Browser, url: str, tmp_path: Path) -> None:
    async def write() -> None:
        async with Reading.open(url) as reading:
            await overview(reading, tmp_path / "all.html")

    asyncio.run(write())
    for width, dark in ((1400, False), (420, True)):
        with chrome.open(tmp_path / "all.pages" / "episode-2.html", width=width, dark=dark) as tab:
            tab.ask("pycrormPage.select(pycrormPage.episode.rootFailures[0])")
            assert tab.ask("document.querySelectorAll('.panel h2')[1].textContent") == (
                "Earlier actions most like GraspAction"
            )
            shown = tab.ask("[...document.querySelectorAll('.similar')].map((each) => each.innerText)")
            assert len(shown) == 2
            assert "FAILED it slipped" in shown[0]
            assert f"tool {HOSTILE}" in shown[0]
            assert tab.ask("document.querySelectorAll('.panel b').length") == 0
            assert tab.ask("document.documentElement.scrollWidth") == width
            tab.ask(
                "pycrormPage.select(pycrormPage.episode.nodes.find((each) => each.status === 'SUCCEEDED' && each.type))"
            )
            tab.ask("[...document.querySelectorAll('.similar button')].at(-1).click()")
            assert tab.ask("pycrormPage.selected.status") == "FAILED"
            tab.ask("document.querySelector('.similar a').click()")
            tab.wait_for("globalThis.pycrormPage?.episode.number === 1")
            assert tab.ask("location.hash") == tab.ask("`#e${pycrormPage.event}`")
            assert tab.problems() == []
