"""Blobs: stored before the events that refer to them, in parts, once, and never changed."""

from __future__ import annotations

import os
from hashlib import sha256
from pathlib import Path

import msgspec
import pytest
from sqlalchemy import text

from pycrorm_async.events.codec import Record
from pycrorm_async.events.types import Blob, BlobReference
from pycrorm_async.store import append
from pycrorm_async.store.log import EventLog
from tests.store.factories import episode, record

CONTENT = os.urandom(50)
NAME = sha256(CONTENT).hexdigest()


@pytest.fixture
def database_url(tmp_path: Path) -> str:
    """Use SQLite alone: the SQL is the same, and roles on PostgreSQL have a test of their own."""
    return f"sqlite:///{tmp_path / 'memory.db'}"


class Files:
    """A source of blobs that notes what is read, and what the log held then."""

    def __init__(self, log: EventLog, *contents: bytes) -> None:
        self.log = log
        self.contents = {sha256(each).hexdigest(): each for each in contents}
        self.read: list[tuple[str, int]] = []

    async def read_blob(self, name: str) -> bytes | None:
        self.read.append((name, sum(each.head for each in await self.log.episodes())))
        return self.contents.get(name)


def observed(sequence: int, *contents: bytes, media_type: str = "image/png") -> Record:
    references = [BlobReference(sha256(each).hexdigest(), media_type, len(each)) for each in contents]
    payload = msgspec.json.encode({"name": "camera", "values": references})
    return record(episode(1), sequence, kind="Observed", payload=payload)


async def rows(log: EventLog) -> list[tuple[object, ...]]:
    query = text("SELECT hash, part, parts, media_type, size, length(content) FROM pycrorm_blob ORDER BY hash, part")
    async with log.reading() as connection:
        return [tuple(row) for row in await connection.execute(query)]


async def test_a_blob_is_stored_before_the_batch_and_once(log: EventLog) -> None:
    files = Files(log, CONTENT)
    log.blobs.source = files
    await log.append([record(episode(1), 1, kind="EpisodeStarted"), observed(2, CONTENT), observed(3, CONTENT)])
    assert files.read == [(NAME, 0)]
    assert await rows(log) == [(NAME, 0, 1, "image/png", 50, 50)]
    assert await log.blobs.read(NAME) == Blob(CONTENT, "image/png")
    await log.append([observed(4, CONTENT, media_type="image/jpeg")])
    assert len(files.read) == 1
    assert await rows(log) == [(NAME, 0, 1, "image/png", 50, 50)]


async def test_a_large_blob_is_stored_in_parts_and_continued_where_a_writer_was_killed(
    log: EventLog, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setattr(append, "PART_BYTES", 20)
    log.blobs.source = Files(log, CONTENT)
    writes = log.writes
    await log.blobs.add(BlobReference(NAME, "a/b", 50), CONTENT[:20])  # as if killed behind the first part
    async with log.writing() as connection:
        await connection.execute(
            text("INSERT INTO pycrorm_blob SELECT :name, 1, 3, media_type, 50, content FROM pycrorm_blob"),
            {"name": "0" * 64},
        )
    assert await log.blobs.complete([NAME, "0" * 64]) == {NAME}
    assert await log.blobs.read("0" * 64) is None
    writes = log.writes
    other = os.urandom(41)
    log.blobs.source = Files(log, other)
    await log.append([observed(1, other)])
    assert log.writes == writes + 3 + 1, "each part has a transaction of its own"
    content = await log.blobs.read(sha256(other).hexdigest())
    assert content == Blob(other, "image/png")


async def test_an_event_whose_blob_is_nowhere_is_stored_and_the_fault_names_the_blob(
    log: EventLog, caplog: pytest.LogCaptureFixture
) -> None:
    log.blobs.source = Files(log)
    await log.append([observed(1, CONTENT)])
    assert f"blob {NAME} is missing" in caplog.text
    assert await log.blobs.fault(NAME) == "is missing"
    assert await log.blobs.read(NAME) is None
    (row,) = await log.episodes()
    assert row.head == 1


async def test_a_blob_with_other_bytes_and_an_incomplete_one_are_faults(
    log: EventLog, monkeypatch: pytest.MonkeyPatch
) -> None:
    log.blobs.source = Files(log, CONTENT)
    await log.append([observed(1, CONTENT)])
    assert await log.blobs.fault(NAME) is None
    await log.blobs.add(BlobReference("1" * 64, "a/b", 50), CONTENT)
    assert await log.blobs.fault("1" * 64) == "has a content that does not match its hash"
    assert await log.blobs.read_blob("1" * 64) is None
    async with log.writing() as connection:
        await connection.execute(
            text(
                "INSERT INTO pycrorm_blob"
                " SELECT :name, 0, 2, media_type, 100, content FROM pycrorm_blob WHERE hash = :of"
            ),
            {"name": "2" * 64, "of": NAME},
        )
    assert await log.blobs.fault("2" * 64) == "is incomplete: 1 of 2 parts are stored"
