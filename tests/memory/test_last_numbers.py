"""A memory whose episodes have the last numbers answers every reader as one whose episodes have the first."""

from __future__ import annotations

import json
import re
from collections.abc import AsyncIterator
from pathlib import Path
from typing import Any, NamedTuple

import pandas as pd
import pyarrow.parquet as pq
import pytest

from pycrorm_async import Reading, orm
from pycrorm_async.errors import UnknownEpisode
from pycrorm_async.events.ids import EPISODE_NUMBER_MAX, row_id_min
from pycrorm_async.export.export import export
from pycrorm_async.operations.copy import copy_episodes
from pycrorm_async.operations.rebuild import rebuild_memory
from pycrorm_async.projections.custom import own_projections
from pycrorm_async.projections.verify import verify
from pycrorm_async.query.memory_schema import read_schema
from pycrorm_async.query.questions import QUESTIONS
from pycrorm_async.recall.recall import Recall
from pycrorm_async.report.overview import overview
from pycrorm_async.report.write import report
from pycrorm_async.store.address import DatabaseAddress
from pycrorm_async.store.log import EventLog
from tests.commands import answer
from tests.databases import Server, ask, put_memory, run_in_own_loop
from tests.memory.test_episodes import take_numbers_up_to
from tests.operations.memories import everything
from tests.query.test_questions import ARGUMENTS
from tests.report.browser import Browser
from tests.table_comparison import differences, tables_of

pytestmark = pytest.mark.slow


def shifted(value: Any, by: int) -> Any:
    """Return a value, or all in a document, with the numbers and row ids of the last episodes made those of the first.

    Integers in texts count too.
    """
    match value:
        case bool():
            return value
        case int() if value >= row_id_min(EPISODE_NUMBER_MAX - 100):
            return value - row_id_min(by)
        case int() if EPISODE_NUMBER_MAX - 100 <= value <= EPISODE_NUMBER_MAX:
            return value - by
        case str():
            return re.sub(r"\b\d{10,19}\b", lambda number: str(shifted(int(number[0]), by)), value)
        case dict():
            return {shifted(name, by): shifted(each, by) for name, each in value.items()}
        case list() | tuple():
            return [shifted(each, by) for each in value]
    return value


class Memories(NamedTuple):
    """The URLs of two memories of the same episodes, with the first and the last numbers, and their distance."""

    first: str
    last: str
    by: int


BY_FAILURES = """
SELECT episode.id FROM episode LEFT JOIN root_failure ON process_metadata_id = number
GROUP BY episode.id ORDER BY count(process_metadata_id), episode.id"""
"""Selects the episodes, last the one with most failures, which gets the last number."""


@pytest.fixture(scope="module", params=["sqlite", "postgresql"])
def both(request: pytest.FixtureRequest, tmp_path_factory: pytest.TempPathFactory) -> Memories:
    folder = tmp_path_factory.mktemp("numbers")
    recorded, first, last = (put_memory(folder / f"{name}.db") for name in ("recorded", "first", "last"))
    if request.param == "postgresql":
        server: Server = request.getfixturevalue("server")
        first, last = server.new_memory(), server.new_memory()
    run_in_own_loop(everything(recorded))
    ids = [each for (each,) in ask(recorded, BY_FAILURES)]
    take_numbers_up_to(last, EPISODE_NUMBER_MAX - len(ids))
    for each in (first, last):
        done = run_in_own_loop(copy_episodes(recorded, each, episodes=ids))
        assert [each for each in done.episodes if each.damage or each.stopped] == []
    assert ask(last, "SELECT max(number) FROM episode") == [(EPISODE_NUMBER_MAX,)]
    return Memories(first, last, EPISODE_NUMBER_MAX - len(ids))


@pytest.fixture
async def readings(both: Memories) -> AsyncIterator[tuple[Reading, Reading]]:
    async with Reading.open(both.first) as first, Reading.open(both.last) as last:
        yield first, last


@pytest.mark.soak_on("postgresql")
async def test_they_are_folded_verified_and_folded_again(both: Memories) -> None:
    assert differences(tables_of(both.first), tables_of(both.last)) == []
    log = await EventLog.open(DatabaseAddress.parse(both.last), create=True)
    [row] = await log.episodes(EPISODE_NUMBER_MAX, EPISODE_NUMBER_MAX)
    for of in (None, row):
        result = await verify(log, episode=of, projections=own_projections())
        assert (result.damages, result.differences, result.not_compared) == ([], [], {})
    await log.close()
    await rebuild_memory(both.last)
    assert differences(tables_of(both.first), tables_of(both.last)) == []


@pytest.mark.soak_on("postgresql")
async def test_views_and_frames_have_every_digit_of_their_ids(
    both: Memories, readings: tuple[Reading, Reading]
) -> None:
    first, last = readings
    for view in await read_schema(first):
        if view.name == "recall_block":  # read by recall
            continue
        rows, others = [ask(url, f'SELECT * FROM "{view.name}"') for url in both[:2]]
        assert sorted(map(repr, shifted(others, both.by))) == sorted(map(repr, shifted(rows, 0))), view.name
    for class_ in (orm.TaskTreeNode, orm.Object, orm.ProcessMetaData, orm.Pose, orm.NavigateAction):
        one, other = [await each.dataframe(class_, to="arrow") for each in readings]
        assert one.schema == other.schema
        assert shifted(other.to_pylist(), both.by) == shifted(one.to_pylist(), 0)
    frame = await last.dataframe(orm.TaskTreeNode)
    assert [*frame.dtypes] == [*(await first.dataframe(orm.TaskTreeNode)).dtypes]
    assert frame["parent_id"].dtype == pd.Int64Dtype()
    parents = {int(each) for each in frame["parent_id"].dropna()}
    assert parents
    assert parents <= {*map(int, frame["id"])}


@pytest.mark.soak_on("postgresql")
async def test_questions_and_recall_find_them(both: Memories, readings: tuple[Reading, Reading]) -> None:
    first, last = readings
    for name in QUESTIONS:
        for options in ({}, {"episode": EPISODE_NUMBER_MAX}):
            asked = [
                getattr(each.ask, name)(**ARGUMENTS.get(name, {}), **shifted(options, by))
                for each, by in ((first, both.by), (last, 0))
            ]
            rows, others = [[tuple(row) for row in await each.rows()] for each in asked]
            assert shifted(others, both.by) == shifted(rows, 0), name
    recalled = [[case async for case in cases(each)] for each in readings]
    assert recalled[0]
    assert shifted(recalled[1], both.by) == recalled[0]
    summary = await last.episode(str(EPISODE_NUMBER_MAX))
    assert summary.number == EPISODE_NUMBER_MAX
    for beyond in ("2147483648", "99999999999999999999"):
        with pytest.raises(UnknownEpisode):
            await last.episode(beyond)
        with pytest.raises(UnknownEpisode):
            await last.ask.durations(episode=beyond).rows()


async def cases(reading: Reading) -> AsyncIterator[list[int]]:
    """Yield the nodes of recalled actions, each with those of its episode that happened during it."""
    recall = Recall.of(reading)
    for each in await recall("NavigateAction", k=3):
        yield [each.case.node, *(other.node for other in await recall.related(each.case, "during"))]


@pytest.mark.soak_on("postgresql")
async def test_exports_have_every_digit(both: Memories, readings: tuple[Reading, Reading], tmp_path: Path) -> None:
    for suffix in ("parquet", "csv", "jsonl"):
        texts: list[str] = []
        for reading in readings:
            file = tmp_path / f"{len(texts)}.{suffix}"
            await export(reading, "task_tree_node", file)
            if suffix == "parquet":
                table = pq.read_table(file)
                assert str(table.schema.field("parent_id").type) == "int64"
                texts.append(json.dumps(table.to_pylist(), default=str))
            else:
                texts.append(file.read_text())
        assert shifted(texts[1], both.by) == shifted(texts[0], 0), suffix
        assert texts[0] != texts[1]
    last = str(EPISODE_NUMBER_MAX)
    shown = [
        answer("show", each, "--url", url, cwd=tmp_path)
        for each, url in ((shifted(last, both.by), both.first), (last, both.last))
    ]
    assert shifted(shown[1], both.by) == shifted(shown[0], 0)


async def test_pages_name_them(
    both: Memories, readings: tuple[Reading, Reading], tmp_path: Path, chrome: Browser
) -> None:
    page, listed = tmp_path / "page.html", tmp_path / "overview.html"
    await report(readings[1], EPISODE_NUMBER_MAX, page)
    await overview(readings[1], listed)
    for each in (page, listed):
        with chrome.open(each) as tab:
            assert str(EPISODE_NUMBER_MAX) in tab.ask("document.body.innerText")
            assert tab.problems() == []
