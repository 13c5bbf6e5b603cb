"""The log keeps digests of an episode's events, which depend on the events alone."""

from __future__ import annotations

from hashlib import sha256
from pathlib import Path

import msgspec
import pytest

from pycrorm_async.events.codec import Record
from pycrorm_async.events.ids import EpisodeId
from pycrorm_async.store.address import DatabaseAddress
from pycrorm_async.store.dialects import dialect_of
from pycrorm_async.store.log import EventLog
from pycrorm_async.store.stored import RunningDigest
from tests.databases import ask, ask_to_change
from tests.store.factories import episode, record, run_of

KEPT = "SELECT episode, sequence, digest FROM pycrorm_digest ORDER BY episode, sequence"


@pytest.fixture
def database_url(tmp_path: Path) -> str:
    """Use SQLite alone: the SQL is the same, and roles on PostgreSQL have a test of their own."""
    return f"sqlite:///{tmp_path / 'memory.db'}"


def whole(of: EpisodeId, last: int) -> list[Record]:
    """Return an episode that ends with event `last`."""
    return [*run_of(of, 1, last - 1), record(of, last, kind="EpisodeEnded", payload=b'{"status":"SUCCEEDED"}')]


def expected(of: EpisodeId, records: list[Record]) -> list[tuple[int, str]]:
    """Compute the kept digests of a whole episode by the definition, event by event."""
    hasher, rows = sha256(b"pycrorm episode\0" + of), []
    ended = False
    for each in records:
        fields = (each.sequence, each.type, each.version, each.wall_ns, each.monotonic_ns, each.payload)
        hasher.update(msgspec.msgpack.encode(fields))
        ended = ended or each.type == "EpisodeEnded"
        if each.sequence % 256 == 0 or ended:
            rows.append((each.sequence, hasher.hexdigest()))
        if each.sequence % 256 == 0:
            hasher = sha256(b"pycrorm episode\0" + hasher.digest())
    return rows


async def test_a_digest_is_kept_at_the_end_of_each_block_and_of_the_episode(log: EventLog, database_url: str) -> None:
    ended, exact, still_open = whole(episode(1), 600), whole(episode(2), 512), run_of(episode(3), 1, 300)
    await log.append([*ended, *exact, *still_open])
    rows = ask(database_url, KEPT)
    assert [tuple(row[1:]) for row in rows if row[0] == 1] == expected(episode(1), ended)
    assert [tuple(row[1:]) for row in rows if row[0] == 2] == expected(episode(2), exact)
    assert [tuple(row[:2]) for row in rows] == [(1, 256), (1, 512), (1, 600), (2, 256), (2, 512), (3, 256)]
    assert {number: each.sequence for number, each in (await log.last_digests()).items()} == {1: 600, 2: 512, 3: 256}


def test_the_digest_of_three_events_stays_the_same_for_ever() -> None:
    running = RunningDigest.at_start(episode(1))
    assert running.add(whole(episode(1), 3)) == []
    assert running.digest() == "52cdb8b7daa97644e61fa44ff601794f91ce08079c2006577120d2961acbe0a3"


@pytest.mark.parametrize("size", [255, 256, 257, 601])
@pytest.mark.slow
async def test_each_block_the_end_and_each_tag_behind_it_have_a_digest_whatever_the_sizes_of_batches(
    log: EventLog, database_url: str, size: int
) -> None:
    tagged = [record(episode(1), at, kind="EpisodeTagged", payload=b'{"added":["a"]}') for at in (7, 601, 602)]
    records = [*whole(episode(1), 600), *tagged[1:]]
    records[6] = tagged[0]
    for start in range(0, len(records), size):
        await log.append(records[start : start + size])
    rows = [tuple(row[1:]) for row in ask(database_url, KEPT)]
    assert rows == expected(episode(1), records)
    assert [sequence for sequence, _ in rows] == [256, 512, 600, 601, 602]


@pytest.mark.parametrize("at", [255, 256, 400])
async def test_a_restarted_writer_and_another_process_continue_from_the_log(file_log: EventLog, at: int) -> None:
    records = whole(episode(1), 600)
    await file_log.append(records[:at])
    second = await EventLog.open(file_log.address, create=True)
    await second.append(records[at : at + 50])
    await file_log.append(records[at + 50 :])
    await second.close()
    assert [tuple(row[1:]) for row in ask(file_log.address.path, KEPT)] == expected(episode(1), records)


async def test_an_append_that_was_rolled_back_leaves_the_running_digest(
    log: EventLog, database_url: str, monkeypatch: pytest.MonkeyPatch
) -> None:
    async def fail(*_: object, **__: object) -> None:
        raise RuntimeError

    records = whole(episode(1), 600)
    await log.append(records[:100])
    with monkeypatch.context() as patch:
        patch.setattr(type(log.digests), "insert", fail)
        with pytest.raises(RuntimeError):
            await log.append(records[100:400])
    with monkeypatch.context() as patch:
        patch.setattr(type(dialect_of(log.engine)), "spans", fail)  # no stored event is read again
        await log.append(records[100:])
    assert [tuple(row[1:]) for row in ask(database_url, KEPT)] == expected(episode(1), records)


async def test_an_episode_of_an_earlier_version_gets_no_digest_and_later_ones_do(
    log: EventLog, database_url: str
) -> None:
    digests, log.digests = log.digests, None
    await log.append(run_of(episode(1), 1, 300))
    log.digests = digests
    await log.append(run_of(episode(1), 301, 600))
    await log.append(whole(episode(2), 300))
    assert [tuple(row[:2]) for row in ask(database_url, KEPT)] == [(2, 256), (2, 300)]


async def test_a_log_of_an_earlier_version_gets_the_table_when_it_is_opened_for_writing(
    address: DatabaseAddress, database_url: str
) -> None:
    log = await EventLog.open(address, create=True)
    await log.close()
    ask_to_change(database_url, "DROP TABLE pycrorm_digest")
    reader = await EventLog.open(address, create=False)
    assert await reader.last_digests() == {}
    await reader.close()
    log = await EventLog.open(address, create=True)
    await log.append(whole(episode(1), 300))
    assert [tuple(row[:2]) for row in ask(database_url, KEPT)] == [(1, 256), (1, 300)]
    await log.close()


async def test_a_table_that_vanishes_under_a_writer_does_not_stop_it(log: EventLog, database_url: str) -> None:
    await log.append(run_of(episode(1), 1, 100))
    ask_to_change(database_url, "DROP TABLE pycrorm_digest")
    with pytest.raises(Exception, match="pycrorm_digest"):
        await log.append(run_of(episode(1), 101, 300))
    assert await log.append(run_of(episode(1), 101, 300)) == {}
