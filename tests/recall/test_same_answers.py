"""The answers of a memory are the same on both databases and after a rebuild; damage and other versions are named."""

from __future__ import annotations

import contextlib
import random
import sqlite3
from pathlib import Path
from typing import Any

import pytest

from pycrorm_async import Memory, Reading
from pycrorm_async.errors import DamageError, TablesOutdated
from pycrorm_async.operations.copy import copy_episodes
from pycrorm_async.operations.rebuild import rebuild_projection
from pycrorm_async.projections.custom import own_projections
from pycrorm_async.recall.cases import CaseProjection
from pycrorm_async.recall.recall import Recall
from tests.databases import Server
from tests.recall.sliding_grips import FETCH, GRIP, record

pytestmark = pytest.mark.slow
Shape = tuple[tuple[float, int, int, str], ...]


async def answers(url: str) -> list[Shape]:
    """The answers of a memory to random cues: score, episode and event of each case, and what was different."""
    chance = random.Random(3)
    shapes = []
    async with Reading.open(url) as reading:
        recall = Recall.of(reading)
        for _ in range(50):
            pairs = [("arm", "LEFT"), ("arm", "RIGHT"), ("item", "cup"), ("item", "plate"), ("inside", FETCH)]
            has: dict[str, Any] = {}
            for feature, word in chance.sample(pairs, chance.randrange(4)):
                has.setdefault(feature, []).append(word)
            near = {"level": chance.choice((chance.random() + 0.5, (1.0, 0.2)))} if chance.random() < 0.5 else {}
            answer = await recall(GRIP, has=has, near=near, k=chance.choice((3, 50)))
            shapes.append(
                tuple((each.score, each.case.episode, each.case.sequence, each.difference()) for each in answer)
            )
    return shapes


@pytest.mark.soak
async def test_both_databases_and_a_rebuild_return_the_same_answers(tmp_path: Path, server: Server) -> None:
    here, there = f"sqlite:///{tmp_path / 'memory.db'}", server.new_database()
    async with Memory.open(here) as memory:
        await record(memory)
        await memory.flush()
        await record(memory)
    expected = await answers(here)
    assert sum(map(len, expected)) > 300
    await copy_episodes(here, there)
    assert await answers(there) == expected
    for url in (here, there):
        await rebuild_projection(url, own_projections()[0])
        assert await answers(url) == expected


async def test_cases_of_another_version_are_named(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    url = f"sqlite:///{tmp_path / 'memory.db'}"
    async with Memory.open(url) as memory:
        await record(memory)
    monkeypatch.setattr(CaseProjection, "version", 99)
    with pytest.raises(TablesOutdated, match=r"its cases have version \d+ instead of 99: run `pycrorm rebuild recall`"):
        await answers(url)


async def test_a_changed_byte_is_an_error_that_names_the_block(tmp_path: Path) -> None:
    url = f"sqlite:///{tmp_path / 'memory.db'}"
    async with Memory.open(url) as memory:
        await record(memory)
    with contextlib.closing(sqlite3.connect(tmp_path / "memory.db")) as plain:
        tables = "SELECT name FROM sqlite_master WHERE type = 'table' AND name LIKE '%own_recall_column%'"
        [(name,)] = plain.execute(tables).fetchall()
        [(data,)] = plain.execute(f"SELECT data FROM {name} WHERE feature = 'arm'").fetchall()
        plain.execute(f"UPDATE {name} SET data = ? WHERE feature = 'arm'", (bytes([data[0] ^ 1]) + data[1:],))
        plain.commit()
    with pytest.raises(DamageError, match="'arm' were changed"):
        await answers(url)
    with contextlib.closing(sqlite3.connect(tmp_path / "memory.db")) as plain:
        plain.execute(f"UPDATE {name} SET data = 'LEFT' WHERE feature = 'arm'")
        plain.commit()
    with pytest.raises(DamageError, match="'arm' is a text"):
        await answers(url)


def test_a_memory_without_asyncio_recalls_too(tmp_path: Path) -> None:
    with Memory.sync(f"sqlite:///{tmp_path / 'memory.db'}") as memory:
        call = memory.recording.type("action", "CallAction", {"whom": "text"})
        with memory.recording.episode(description="calls") as episode:
            episode.start("call", call, {"whom": "Ada"})
            episode.end("call")
            assert [each.status for each in memory.recall("CallAction", has={"whom": "Ada"})] == ["SUCCEEDED"]
