"""Archived episodes are in the lake and not in the memory, and a restored memory is as it was."""

from __future__ import annotations

import asyncio
import os
import re
import signal
import sqlite3
import subprocess
import sys
import time
from collections.abc import Sequence
from contextlib import closing
from datetime import UTC, datetime
from pathlib import Path
from typing import Any

import pytest

from pycrorm_async import Memory, Reading, read_archived
from pycrorm_async.errors import CallerError, DatabaseForeign, DatabaseUnavailable, UnknownEpisode
from pycrorm_async.operations import archive
from pycrorm_async.operations.archive import ArchiveSummary, archive_episodes
from pycrorm_async.operations.copy import copy_episodes
from pycrorm_async.operations.removal import erasable, erase
from pycrorm_async.orm import PickUpWithContextView
from pycrorm_async.recall.recall import Recall
from pycrorm_async.store.address import DatabaseAddress
from pycrorm_async.store.lake import Lake, LakeEpisode, erase_in_lake, open_lake, query_lake
from pycrorm_async.store.log import EventLog
from pycrorm_async.store.stored import EpisodeRow, StoredEvent
from tests.commands import pycrorm
from tests.crash.forked_processes import ForkedProcess, die_at_statement
from tests.databases import ask, put_memory
from tests.operations.memories import common_plan, everything, notes
from tests.operations.test_removal import SECRET, assert_clean, erased, places_with, recorded
from tests.plan.conftest import kitchen
from tests.table_comparison import differences, logs_of, tables_of

pytest.importorskip("duckdb_extension_ducklake", reason="the extra [lake] is not installed")
pytestmark = pytest.mark.slow

LATER = datetime(2100, 1, 1, tzinfo=UTC)


@pytest.fixture
def lake(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> str:
    monkeypatch.chdir(tmp_path)
    return f"ducklake:{tmp_path}/lake"


async def archived(url: str, lake: str) -> ArchiveSummary:
    return await archive_episodes(url, lake, before=LATER, reason="old")


def shown_digests(url: str) -> list[tuple[object, ...]]:
    return ask(
        url,
        "SELECT e.number, e.id, d.sequence, d.digest FROM pycrorm_digest AS d"
        " JOIN episode AS e ON e.number = d.episode ORDER BY 1, 3",
    )


@pytest.mark.soak_on("postgresql")
async def test_a_restored_memory_has_the_rows_numbers_and_digests_that_it_had(database_url: str, lake: str) -> None:
    await everything(database_url)
    tables, logs, digests = tables_of(database_url), logs_of(database_url), shown_digests(database_url)
    summary = await archived(database_url, lake)
    assert (len(summary.removed), summary.stayed) == (len(logs), {})
    assert (logs_of(database_url), tables_of(database_url), shown_digests(database_url)) == ({}, {}, [])
    await assert_clean(database_url)
    _, rows = query_lake(
        lake,
        "SELECT episode::VARCHAR, sequence, type, version, wall_ns, monotonic_ns, payload FROM event ORDER BY 1, 2",
    )
    assert rows == [(each, *some) for each, events in sorted(logs.items()) for some in events]
    async with Reading.open(database_url) as reading:
        with pytest.raises(UnknownEpisode, match=rf"`pycrorm restore {min(logs)} --from {lake}` brings it back"):
            await reading.episode(min(logs))
        assert (await reading.lake()).aggregate("count(DISTINCT episode)").fetchall() == [(len(logs),)]
    for _ in range(2):  # what is there already is compared
        done = await copy_episodes(lake, database_url)
        assert [(each.damage, each.stopped) for each in done.episodes if each.damage or each.stopped] == []
    assert logs_of(database_url) == logs
    assert differences(tables, tables_of(database_url)) == []
    assert shown_digests(database_url) == digests
    await assert_clean(database_url)


async def test_several_memories_archive_into_one_lake_and_what_arrives_of_an_archived_episode_is_not_stored_again(
    tmp_path: Path, lake: str
) -> None:
    sites = [put_memory(tmp_path / f"{name}.db") for name in "abc"]
    for each in sites:
        await recorded(each, each[-4:], "second")
    logs = {episode: events for each in sites for episode, events in logs_of(each).items()}
    copy = put_memory(tmp_path / "copy.db")
    await copy_episodes(sites[0], copy)
    processes = [ForkedProcess(archive_until, each, lake, 0) for each in sites]  # one makes the lake
    assert [(each.wait(), each.lines[:-1]) for each in processes] == [(0, [])] * 3
    rows = query_lake(lake, "SELECT episode::VARCHAR, count(*) FROM event GROUP BY 1 ORDER BY 1")[1]
    assert rows == [(episode, len(events)) for episode, events in sorted(logs.items())]
    done = await copy_episodes(copy, sites[0])
    assert ["was archived" in (each.stopped or "") for each in done.episodes] == [True, True]
    assert (await archived(copy, lake)).stayed == {}  # the lake has them already
    assert query_lake(lake, "SELECT episode::VARCHAR, count(*) FROM event GROUP BY 1 ORDER BY 1")[1] == rows


def archive_until(url: str, lake: str, last: int) -> None:
    """Archive, and die before statement number `last` of the memory; with 0 to the end, and print their count.

    Each episode is a group of its own, so that several are read, added and removed at once.
    """
    archive._EVENTS_AT_ONCE = 1  # type: ignore[misc]  # final, but for this process
    print_count = die_at_statement(last)
    asyncio.run(archived(url, lake))
    print_count()


@pytest.mark.soak_on("postgresql")
async def test_an_archive_that_is_killed_at_any_step_is_finished_by_the_next(database_url: str, lake: str) -> None:
    await recorded(database_url, "first")
    whole = ForkedProcess(archive_until, database_url, lake, 0)
    assert whole.wait() == 0, whole.lines
    count = int(whole.lines[-1])
    for last in (count // 4, count // 2, count - 2, count):
        ids = await recorded(database_url, "a", "b")
        logs = logs_of(database_url)
        process = ForkedProcess(archive_until, database_url, lake, last)
        assert process.wait() in (-9, 0), process.lines
        await assert_clean(database_url)
        assert (await archived(database_url, lake)).stayed == {}
        assert logs_of(database_url) == {}
        source = Lake(lake)
        try:
            for each in ids:
                events = [event for page in [page async for page in source.pages(source.named(each))] for event in page]
                assert [(*some[1:6], some[6].decode()) for some in events] == logs[each]
        finally:
            await source.close()


async def test_an_archive_that_fails_keeps_what_it_has_moved_and_the_next_one_moves_the_rest(
    tmp_path: Path, lake: str, monkeypatch: pytest.MonkeyPatch
) -> None:
    url = put_memory(tmp_path / "memory.db")
    ids = await recorded(url, "first", "second", "third", "fourth")
    monkeypatch.setattr(archive, "_EVENTS_AT_ONCE", 1)
    add, summary = Lake.add, ArchiveSummary([], {})

    def fail_at_last(self: Lake, episodes: Sequence[tuple[LakeEpisode, Sequence[StoredEvent]]], *others: Any) -> None:
        if episodes[0][0].id == ids[-1]:
            raise CallerError("the disk of the lake is full")
        add(self, episodes, *others)

    monkeypatch.setattr(Lake, "add", fail_at_last)
    with pytest.raises(CallerError, match="the disk of the lake is full"):  # one error, not a group
        await archive_episodes(url, lake, before=LATER, reason="old", summary=summary)
    moved = {each.id for each in summary.removed}
    assert moved < {*ids}
    assert logs_of(url).keys() == {*ids} - moved
    await assert_clean(url)
    monkeypatch.undo()
    assert (await archived(url, lake)).stayed == {}
    assert logs_of(url) == {}
    rows = query_lake(lake, "SELECT DISTINCT episode::VARCHAR FROM event ORDER BY 1")[1]
    assert rows == [(each,) for each in sorted(ids)]


async def test_an_episode_is_erased_from_the_lake_too_and_cannot_be_restored(tmp_path: Path, lake: str) -> None:
    url = put_memory(tmp_path / "memory.db")
    ids = await recorded(url, "first", SECRET)
    await archived(url, lake)
    folder = tmp_path / "lake"
    folder.rename(tmp_path / "away")
    with pytest.raises(DatabaseUnavailable, match="there is no lake"):
        await erased(url, ids[1])
    (tmp_path / "away").rename(folder)
    [done] = await erased(url, ids[1])
    assert (done.left, done.removed.archived_in) == ((), None)
    files = [each for each in folder.rglob("*") if each.is_file()]
    assert [each for each in files if SECRET.encode() in each.read_bytes()] == []
    parquet = [str(each) for each in files if each.parent.name == "event"]
    query = f"SELECT count(*) FROM read_parquet({parquet}) WHERE payload LIKE '%{SECRET}%'"
    assert query_lake(lake, query)[1] == [(0,)]
    assert places_with(SECRET, url) == []
    with pytest.raises(UnknownEpisode, match=rf"^episode 2 \({ids[1]}\) was erased on .* UTC \(asked to\)$"):
        await copy_episodes(lake, url, episodes=[ids[1]])
    other = put_memory(tmp_path / "other.db")
    with pytest.raises(UnknownEpisode, match=rf"{ids[1]} was erased on .* UTC \(asked to\)$"):
        await copy_episodes(lake, other, episodes=[ids[1]])
    with closing(open_lake(lake, write=True)) as connection:  # as an earlier version left it
        connection.execute("ALTER TABLE erased DROP COLUMN reason")
    with pytest.raises(UnknownEpisode, match=rf"{ids[1]} was erased on .* UTC$"):
        await copy_episodes(lake, other, episodes=[ids[1]])
    # One that came back, and that the lake still holds, is archived nowhere else, and erased there too.
    async with await EventLog.open(DatabaseAddress.parse(url), create=True) as log:
        await copy_episodes(lake, url)
        [stayed] = (await archived(url, f"ducklake:{tmp_path}/other")).stayed.values()
        assert stayed == f"it was restored from {lake}, which has it still: archive it there"
        await erase(log, await erasable(log, ["1"]), reason="asked", spool=tmp_path / "memory.db.spool")
    assert query_lake(lake, "SELECT count(*) FROM event")[1] == [(0,)]


def erase_until(lake: str, episode: str, last: int) -> None:
    """Erase an episode in a lake, and die after statement number `last`."""
    execute, count = Lake.execute, 0

    def die_after_last(self: Lake, sql: str) -> list[tuple[object, ...]]:
        nonlocal count
        rows = execute(self, sql)
        count += 1
        if count == last:
            os.kill(os.getpid(), signal.SIGKILL)
        return rows

    Lake.execute = die_after_last  # type: ignore[method-assign]
    erase_in_lake(lake, [episode], "asked")


async def test_an_erasure_that_is_killed_at_any_step_is_finished_by_the_next(tmp_path: Path, lake: str) -> None:
    url = put_memory(tmp_path / "memory.db")
    for last in (3, 6, 8, 9, 10):
        ids = await recorded(url, "first", SECRET)
        await archived(url, lake)
        process = ForkedProcess(erase_until, lake, ids[1], last)
        assert process.wait() in (-9, 0), process.lines
        with pytest.raises(UnknownEpisode, match="was erased on"):  # what is left of it is not restored
            await copy_episodes(lake, url, episodes=[ids[1]])
        await erased(url, ids[1])
        files = [str(each) for each in (tmp_path / "lake/data/main/event").iterdir()]
        query = f"SELECT count(*) FROM read_parquet({files}, union_by_name => true) WHERE episode = '{ids[1]}'"
        assert query_lake(lake, query)[1] == [(0,)], last


async def test_archived_episodes_are_read_as_those_of_a_memory_without_a_restore(
    tmp_path: Path, lake: str, monkeypatch: pytest.MonkeyPatch
) -> None:
    url = put_memory(tmp_path / "memory.db")
    await notes(url, "a")
    async with Memory.open(url) as memory, memory.episode(description="in the kitchen"):
        with kitchen():
            await common_plan()
    monkeypatch.setattr("tempfile.tempdir", str(tmp_path / "temporary"))
    (tmp_path / "temporary").mkdir()
    ids = [*logs_of(url)]
    async with Reading.open(url) as reading:
        frame = await reading.dataframe(PickUpWithContextView)
        durations = await reading.ask.durations(episode=ids[1]).rows()
    await archived(url, lake)
    async with read_archived(lake, [ids[1][:30]]) as reading:
        assert [each.id for each in await reading.episodes()] == [ids[1]]
        own = await reading.dataframe(PickUpWithContextView)
        assert [row[:2] for row in await reading.ask.durations().rows()] == [row[:2] for row in durations]
        assert len((await Recall.of(reading)("PickUpAction")).cases) > 0
    of_rows = [name for name in frame.columns if not name.endswith("id")]
    assert len(frame) > 0
    assert own[of_rows].equals(frame[of_rows])
    async with read_archived(lake) as reading:
        assert {each.id for each in await reading.episodes()} == {*ids}
    assert [*(tmp_path / "temporary").iterdir()] == []
    assert logs_of(url) == {}
    with pytest.raises(UnknownEpisode):
        async with read_archived(lake, ["ffffffff"]):
            pass


def archive_until_commit(url: str, lake: str) -> None:
    """Archive, and die when all files are written, before the lake knows them."""
    execute = Lake.execute

    def die_before_commit(self: Lake, sql: str) -> list[tuple[object, ...]]:
        if sql == "COMMIT":
            os.kill(os.getpid(), signal.SIGKILL)
        return execute(self, sql)

    Lake.execute = die_before_commit  # type: ignore[method-assign]
    asyncio.run(archived(url, lake))


def parquet_files(lake: str, *, aged: bool = False) -> set[Path]:
    """Return the files of events of a lake; `aged` makes them two hours old."""
    files = {*Path(lake.removeprefix("ducklake:"), "data/main/event").glob("*.parquet")}
    for each in files if aged else ():
        os.utime(each, (time.time() - 7200,) * 2)
    return files


async def test_files_of_an_archive_that_was_killed_before_its_commit_are_deleted_when_they_are_old(
    tmp_path: Path, lake: str, caplog: pytest.LogCaptureFixture
) -> None:
    url = put_memory(tmp_path / "memory.db")
    [kept] = await recorded(url, "first")
    await archived(url, lake)
    [committed] = parquet_files(lake)
    [identity] = await recorded(url, SECRET)
    for _ in range(2):
        assert ForkedProcess(archive_until_commit, url, lake).wait() == -9
    torn = committed.with_name("ducklake-torn.parquet")
    torn.write_bytes(b"PAR1" + SECRET.encode())
    orphans = parquet_files(lake) - {committed}
    assert len(orphans) == 3
    [done] = await erased(url, identity, lake=lake)
    assert sorted(each.partition(", of an archive that runs or was killed")[0] for each in done.left) == sorted(
        map(str, orphans)
    )
    parquet_files(lake, aged=True)
    assert [each.left for each in await erased(url, identity, lake=lake)] == [()]
    assert parquet_files(lake).isdisjoint(orphans)
    assert query_lake(lake, "SELECT DISTINCT episode::VARCHAR FROM event")[1] == [(kept,)]

    again = await recorded(url, "second")
    assert ForkedProcess(archive_until_commit, url, lake).wait() == -9
    before = parquet_files(lake, aged=True)
    await archived(url, lake)
    assert len(before) == len(parquet_files(lake)) == 2
    assert len(before & parquet_files(lake)) == 1
    assert caplog.messages == []

    catalog = tmp_path / "lake/catalog.sqlite"
    earlier = catalog.read_bytes()  # a backup
    await recorded(url, "third")
    await archived(url, lake)
    catalog.write_bytes(earlier)
    only_copies = parquet_files(lake, aged=True)
    await recorded(url, "fourth")
    await archived(url, lake)
    assert only_copies < parquet_files(lake)
    [warning] = caplog.messages
    assert "was it restored from a backup?" in warning
    assert len(again) == 1


async def test_an_erasure_that_left_files_in_the_lake_of_an_archived_episode_visits_that_lake_again(
    tmp_path: Path, lake: str
) -> None:
    url = put_memory(tmp_path / "memory.db")
    [identity] = await recorded(url, SECRET)
    assert ForkedProcess(archive_until_commit, url, lake).wait() == -9
    orphans = parquet_files(lake)
    await archived(url, lake)
    [done] = await erased(url, identity)
    assert len(done.left) == len(orphans) == 1
    parquet_files(lake, aged=True)
    assert [each.left for each in await erased(url, identity)] == [()]
    assert not parquet_files(lake)


async def test_of_an_episode_that_was_changed_in_the_lake_the_events_before_an_unreadable_one_are_restored(
    tmp_path: Path, lake: str
) -> None:
    url = put_memory(tmp_path / "memory.db")
    ids = await recorded(url, "first", "second", "third", "fourth", "fifth")
    logs = logs_of(url)
    await archived(url, lake)
    with closing(open_lake(lake, write=True)) as connection:
        for episode, payload in ((ids[0], "'{'"), (ids[1], "payload || ' '")):
            connection.execute(f"UPDATE event SET payload = {payload} WHERE episode = '{episode}' AND sequence = 3")
        connection.execute(f"DELETE FROM event WHERE episode = '{ids[3]}' AND sequence > 4 OR episode = '{ids[4]}'")
    done = {each.id: each for each in (await copy_episodes(lake, url)).episodes}
    unreadable, changed, whole, *lacking = (done[each] for each in ids)
    for each, head in zip(lacking, (4, 0), strict=True):
        assert each.head == head
        assert f"{each.id}, event {head + 1}: is missing in {lake}" in str(each.damage)
    assert (unreadable.head, changed.head, whole.head) == (2, whole.head, whole.copied)
    assert f"{ids[0]}, event 3: its payload cannot be read" in str(unreadable.damage)
    assert f"{ids[1]}: its digest differs from that in {lake}" in str(changed.damage)
    assert whole.damage is None
    mend = f"UPDATE event SET payload = '{logs[ids[0]][2][-1]}' WHERE episode = '{ids[0]}' AND sequence = 3"
    with closing(open_lake(lake, write=True)) as connection:
        connection.execute(mend)
    [again] = (await copy_episodes(lake, url, episodes=[ids[0]])).episodes
    assert (again.were_there, again.damage, logs_of(url)[ids[0]]) == (2, None, logs[ids[0]])


async def test_of_a_long_episode_that_was_restored_before_each_event_is_compared_again(
    tmp_path: Path, lake: str, monkeypatch: pytest.MonkeyPatch
) -> None:
    url = put_memory(tmp_path / "memory.db")
    await notes(url, *map(str, range(150)))
    [(identity, events)] = logs_of(url).items()
    assert len(events) > 260
    await archived(url, lake)
    with closing(open_lake(lake, write=True)) as connection:  # as two archives at the same time leave it
        connection.execute("INSERT INTO event FROM event")
    for page_events in (5_000, 257):  # a page of the memory has 250
        monkeypatch.setattr("pycrorm_async.store.lake._PAGE_EVENTS", page_events)
        assert [(await copy_episodes(lake, url)).episodes[0].damage for _ in range(2)] == [None, None]
    assert logs_of(url) == {identity: events}
    with closing(open_lake(lake, write=True)) as connection:
        connection.execute(f"UPDATE event SET wall_ns = wall_ns + 1 WHERE sequence = {len(events)}")
    [done] = (await copy_episodes(lake, url)).episodes
    assert f"{identity}, event {len(events)}: {url} has another event with this sequence" in str(done.damage)


async def test_an_episode_that_is_erased_from_the_lake_during_its_restore_is_named(
    tmp_path: Path, lake: str, monkeypatch: pytest.MonkeyPatch
) -> None:
    url = put_memory(tmp_path / "memory.db")
    ids = await recorded(url, "first", "second")
    await archived(url, lake)
    read, done = Lake.is_intact, list[bool]()

    async def erased_then(self: Lake, episode: EpisodeRow) -> bool:
        done.append(await read(self, episode))  # reads both
        if len(done) == 1:
            process = ForkedProcess(erase_until, lake, ids[0], 0)
            assert process.wait() == 0, process.lines
        return done[-1]

    monkeypatch.setattr(Lake, "is_intact", erased_then)
    damage = {each.id: each.damage for each in (await copy_episodes(lake, url)).episodes}
    assert f"{ids[0]} was erased from {lake} meanwhile" in str(damage[ids[0]])
    assert damage[ids[1]] is None


async def test_a_lake_takes_no_episode_again_that_was_erased_from_it(tmp_path: Path, lake: str) -> None:
    url, other = put_memory(tmp_path / "memory.db"), put_memory(tmp_path / "other.db")
    [identity] = await recorded(url, SECRET)
    await copy_episodes(url, other)
    await archived(url, lake)
    source = Lake(lake, write=True)
    row = source.episode_rows([identity])[identity]
    events = [event async for page in source.pages(row.row) for event in page]
    await source.close()
    await erased(url, identity)
    for _ in range(2):
        summary = await archived(other, lake)
        [(name, why)] = summary.stayed.items()
        assert (summary.removed, name) == ([], identity)
        assert why.endswith("`pycrorm erase` removes it here too")
    source = Lake(lake, write=True)
    source.add([(row, events)], {}, {}, "of a process that had checked before")
    await source.close()
    assert query_lake(lake, "SELECT (SELECT count(*) FROM event), (SELECT count(*) FROM episode)")[1] == [(0, 0)]


async def test_a_lake_that_has_episodes_and_is_away_is_not_made_anew(tmp_path: Path, lake: str) -> None:
    url = f"sqlite:///{tmp_path}/memory.db"
    await recorded(url, "archived")
    assert len((await archived(url, lake)).removed) == 1
    await recorded(url, "later")
    (tmp_path / "lake").rename(tmp_path / "away")
    with pytest.raises(DatabaseUnavailable, match="has episodes of this memory, and is away"):
        await archived(url, lake)
    assert ask(url, "SELECT number FROM episode") == [(2,)]
    assert not (tmp_path / "lake").exists()
    (tmp_path / "away").rename(tmp_path / "lake")
    await archived(url, lake)
    assert query_lake(lake, "SELECT count(*) FROM episode")[1] == [(2,)]


async def test_an_archive_waits_for_a_catalog_that_another_process_locks_at_its_commit(
    tmp_path: Path, lake: str, monkeypatch: pytest.MonkeyPatch
) -> None:
    url = put_memory(tmp_path / "memory.db")
    await recorded(url, "first")
    holder = (
        "import sqlite3, time; c = sqlite3.connect('lake/catalog.sqlite', isolation_level=None, timeout=30);"
        " c.execute('BEGIN IMMEDIATE'); print('held', flush=True); time.sleep(1)"
    )
    execute, holders = Lake.execute, list[subprocess.Popen[str]]()

    def locked_once(self: Lake, sql: str) -> list[tuple[object, ...]]:
        if sql == "COMMIT" and not holders:
            holders.append(subprocess.Popen([sys.executable, "-c", holder], stdout=subprocess.PIPE, text=True))
            assert holders[0].stdout is not None
            assert holders[0].stdout.readline() == "held\n"
        return execute(self, sql)

    monkeypatch.setattr(Lake, "execute", locked_once)
    summary = await archived(url, lake)
    assert (len(summary.removed), summary.stayed) == (1, {})
    assert holders[0].communicate()[0] == ""


async def test_an_episode_that_differs_from_the_lake_stays_in_the_memory(tmp_path: Path, lake: str) -> None:
    url, other = put_memory(tmp_path / "memory.db"), put_memory(tmp_path / "other.db")
    await notes(url, "a")
    await copy_episodes(url, other)
    await archived(other, lake)
    with sqlite3.connect(tmp_path / "memory.db") as connection:
        connection.executescript(
            "DROP TRIGGER event_is_not_updated; DROP TRIGGER digest_is_not_deleted; DELETE FROM pycrorm_digest;"
            "UPDATE event SET wall_ns = wall_ns + 1 WHERE sequence = 2"
        )
    summary = await archived(url, lake)
    assert (summary.removed, [*summary.stayed.values()]) == ([], ["the lake holds other events of it than this memory"])
    assert len(logs_of(url)) == 1


async def test_bad_lakes_are_refused_in_one_line(tmp_path: Path, lake: str) -> None:
    url = put_memory(tmp_path / "memory.db")
    await notes(url, "a")
    with pytest.raises(DatabaseUnavailable, match="there is no lake"):
        query_lake(lake, "SELECT 1")
    with pytest.raises(CallerError, match="a lake is named"):
        await archived(url, "s3:x")
    with pytest.raises(CallerError, match=r"not at s3://$"):
        await archived(url, "ducklake:s3://bucket/lake")
    (tmp_path / "file").write_text("")
    with pytest.raises(Exception, match=r"ducklake:.*file"):
        await archived(url, f"ducklake:{tmp_path}/file")
    await archived(url, lake)
    catalog, file = Path(lake.removeprefix("ducklake:")) / "catalog.sqlite", tmp_path / "written"
    for statement in (
        "DELETE FROM event",
        "",
        f"ATTACH '{catalog}' AS c",
        f"COPY event TO '{file}'",
        "SELECT 1; SELECT 2",
    ):
        with pytest.raises(CallerError, match="give one query that only reads"):
            query_lake(lake, statement)
    assert not file.exists()
    assert query_lake(lake, "SELECT now() > TIMESTAMP '2000-01-01'")[1] == [(True,)]
    assert query_lake(lake, "SELECT now()")[1]
    source = Lake(lake, write=True)
    source.execute("DROP TABLE erased")  # as of a lake that was made before that table
    await source.close()
    assert query_lake(lake, "SELECT count(*) FROM episode")[1] == [(1,)]
    source = Lake(lake, write=True)
    assert source.erased(["00000000-0000-7000-8000-000000000000"]) == {}
    source.execute("INSERT INTO pycrorm_lake VALUES (99)")
    await source.close()
    for change, fault in (
        ("", "was made by a newer version: its format is 99"),
        ("UPDATE ducklake_metadata SET value = '99.0' WHERE key = 'version'", "catalog version is 99.0"),
    ):
        with sqlite3.connect(catalog) as connection:
            connection.execute(change)
        for attempt in (asyncio.to_thread(query_lake, lake, "SELECT 1"), archived(url, lake)):
            with pytest.raises((DatabaseForeign, DatabaseUnavailable), match=re.escape(fault)) as refused:
                await attempt
            assert "\n" not in str(refused.value)


async def test_a_file_of_another_program_is_no_catalog_and_stays_as_it_is(tmp_path: Path, lake: str) -> None:
    url, catalog = put_memory(tmp_path / "memory.db"), tmp_path / "lake/catalog.sqlite"
    await notes(url, "a")
    catalog.parent.mkdir()
    with sqlite3.connect(tmp_path / "other.db") as connection:
        connection.execute("CREATE TABLE recipe (name TEXT)")
    for content, fault in (
        ((tmp_path / "other.db").read_bytes(), "is a database of another program"),
        (b"a note " * 100, "is no catalog of a lake: file is not a database"),
    ):
        catalog.write_bytes(content)
        for attempt in (archived(url, lake), asyncio.to_thread(query_lake, lake, "SELECT 1")):
            with pytest.raises(DatabaseForeign, match=fault):
                await attempt
        assert catalog.read_bytes() == content
        assert [*catalog.parent.iterdir()] == [catalog]


def test_the_commands_archive_query_and_restore(tmp_path: Path) -> None:
    url, lake = f"sqlite:///{tmp_path}/memory.db", "ducklake:lake"
    [identity] = asyncio.run(recorded(url, "a note"))
    done = pycrorm("archive", "--before", "2100-01-01", "--to", lake, "--url", url, cwd=tmp_path)
    assert (done.returncode, identity in done.stdout) == (0, True)
    listed = pycrorm("episodes", "--url", url, cwd=tmp_path)
    assert "1 episode archived or erased" in listed.stderr
    answer = pycrorm("lake", "query", "SELECT count(*) AS n FROM event", "--from", lake, "--json", cwd=tmp_path)
    assert (answer.returncode, '"n": 8' in answer.stdout or '"n": 7' in answer.stdout) == (0, True)
    wrong = pycrorm("lake", "query", "SELEC 1", "--from", lake, cwd=tmp_path)
    assert (wrong.returncode, wrong.stderr.count("\n")) == (2, 1)
    back = pycrorm("restore", identity[:20], "--from", lake, "--url", url, cwd=tmp_path)
    assert back.returncode == 0, back.stderr
    assert pycrorm("verify", "--url", url, cwd=tmp_path).returncode == 0
