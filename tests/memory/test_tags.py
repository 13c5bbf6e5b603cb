"""Tags and metadata of episodes, given at the start, by the recorder, and after the end, on both kinds of database."""

from __future__ import annotations

import asyncio
import math
import os
import threading
from pathlib import Path
from typing import Any
from urllib.parse import urlsplit

import pytest
from sqlalchemy import select

from pycrorm_async import Memory, Reading, Settings, recover
from pycrorm_async.errors import CallerError, DatabaseUnavailable, LogDamaged, UnknownEpisode
from pycrorm_async.operations import copy as operation
from pycrorm_async.operations.copy import copy_episodes, tag_episode
from pycrorm_async.operations.rebuild import rebuild_memory
from pycrorm_async.orm import EpisodeTag, ProcessMetaData
from pycrorm_async.projections.verify import verify
from pycrorm_async.store.address import DatabaseAddress
from pycrorm_async.store.log import EventLog
from pycrorm_async.store.log import tags_of as log_tags
from pycrorm_async.store.postgresql import GRANTS
from tests.commands import answer, one_line_of, pycrorm
from tests.databases import Server, ask, ask_to_change, change_each
from tests.memory.note_actions import NoteActionPerformable
from tests.projections.verify_cases import TYPES, full
from tests.table_comparison import differences, tables_of

pytestmark = pytest.mark.slow


async def tags_of(memory: Memory | Reading) -> dict[str, list[str]]:
    async with memory.session() as session:
        return {each.description: each.tags for each in await session.scalars(select(ProcessMetaData))}


async def assert_intact(url: str, *, behind: int = 0) -> None:
    log = await EventLog.open(DatabaseAddress.parse(url), create=False)
    try:
        result = await verify(log)
    finally:
        await log.close()
    assert (result.damage, result.drift, result.behind, list(map(str, result.damages))) == (0, 0, behind, [])


@pytest.mark.soak_on("postgresql")
async def test_tags_change_during_and_after_an_episode_and_survive_copy_and_rebuild(
    database_url: str, tmp_path: Path, server: Server
) -> None:
    async with Memory.open(database_url, spool=tmp_path / "spool") as memory:
        async with memory.episode(description="one", tags=["kitchen", "night"], metadata={"batch": 7}) as one:
            await NoteActionPerformable("hello").perform()
            await memory.tag(one, "good", remove=["night"])
            with pytest.raises(CallerError, match="the episode has no tag 'night'; its tags: kitchen, good"):
                await memory.tag(str(one), remove=["night"])
        async with memory.episode(description="two"):
            pass
        await memory.tag(one, "late", "good", remove=["kitchen"])
        await memory.tag("last", "second")
        assert await tags_of(memory) == {"one": ["good", "late"], "two": ["second"]}
        async with memory.session() as session:
            episode = (await session.scalars(select(ProcessMetaData).where(ProcessMetaData.id == 1))).one()
            assert episode.episode_metadata == {"batch": 7}
            assert episode.status == "SUCCEEDED"
            tagged = select(ProcessMetaData.id).join(EpisodeTag).where(EpisodeTag.tag == "late")
            assert list(await session.scalars(tagged)) == [1]
        summary = await memory.reading.episode("1")
        assert (summary.tags, summary.metadata) == (("good", "late"), {"batch": 7})
        assert (await memory.as_of(1, sequence=2)).tags == ("kitchen", "night")
        assert (await memory.as_of(1, time=1e9)).tags == ("good", "late")
        assert (await memory.as_of(1, time=1e9)).status == "SUCCEEDED"
        assert memory.status.faults.total == 0, memory.status.faults.last
    await assert_intact(database_url)
    before = tables_of(database_url)
    await rebuild_memory(database_url)
    assert differences(before, tables_of(database_url)) == []
    other = f"sqlite:///{tmp_path}/copy.db" if database_url.startswith("postgresql") else server.new_database()
    await copy_episodes(database_url, other)
    async with Reading.open(other) as reading:
        assert await tags_of(reading) == {"one": ["good", "late"], "two": ["second"]}
    log = await EventLog.open(DatabaseAddress.parse(other), create=False)
    assert all(each.ended_wall_ns is not None for each in await log.episodes())
    await log.close()
    await assert_intact(other)
    await tag_episode(DatabaseAddress.parse(other), "1", ("in the copy",), ())
    await assert_intact(other)
    if other.startswith("postgresql"):
        server.drop(other)


@pytest.mark.soak_on("sqlite")
async def test_several_processes_tag_an_episode_at_once_and_every_tag_is_there(
    database_url: str, tmp_path: Path
) -> None:
    async with Memory.open(database_url, spool=tmp_path / "spool") as memory, memory.episode(description="one"):
        pass
    address = DatabaseAddress.parse(database_url)
    await asyncio.gather(*(tag_episode(address, "1", (f"tag {number}",), ()) for number in range(6)))
    async with Reading.open(database_url) as reading:
        assert await tags_of(reading) == {"one": [f"tag {number}" for number in range(6)]}
    await assert_intact(database_url)


async def test_a_tagger_that_loses_a_race_decides_again_from_the_new_tags(
    database_url: str, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    opened = Memory.open(database_url, spool=tmp_path / "spool")
    async with opened as memory, memory.episode(description="one", tags=["kitchen"]):
        pass
    address, append = DatabaseAddress.parse(database_url), operation._append
    raced = False

    async def race(*arguments: Any) -> bool:
        nonlocal raced
        if not raced:
            raced = True
            await tag_episode(address, "1", ("first",), ("kitchen",))
        return await append(*arguments)

    monkeypatch.setattr(operation, "_append", race)
    with pytest.raises(CallerError, match="the episode has no tag 'kitchen'; its tags: first"):
        await tag_episode(address, "1", ("second",), ("kitchen",))
    async with Reading.open(database_url) as reading:
        assert await tags_of(reading) == {"one": ["first"]}
    await assert_intact(database_url)


async def test_tagging_an_episode_with_a_damaged_tag_names_the_event(tmp_path: Path) -> None:
    url = f"sqlite:///{tmp_path}/memory.db"
    async with Memory.open(url, spool=tmp_path / "spool") as memory, memory.episode(description="one"):
        pass
    tagged = await tag_episode(DatabaseAddress.parse(url), "1", ("kitchen",), ())
    ask_to_change(url, "DROP TRIGGER event_is_not_updated")
    ask_to_change(url, "UPDATE event SET payload = '{\"added' WHERE type = 'EpisodeTagged'")
    with pytest.raises(LogDamaged, match="its payload cannot be read") as refused:
        await tag_episode(DatabaseAddress.parse(url), "1", ("night",), ())
    assert (refused.value.episode, refused.value.sequence) == (tagged.id, 5)


@pytest.mark.soak_on("postgresql")
async def test_a_process_killed_between_event_and_tables_leaves_a_tag_that_the_next_fold_shows(
    database_url: str, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    async with Memory.open(database_url, spool=tmp_path / "spool") as memory, memory.episode(description="one"):
        pass
    pid = os.fork()
    if pid == 0:

        async def kill(*_: object) -> bool:
            os.kill(os.getpid(), 9)
            return True

        monkeypatch.setattr(operation, "_fold", kill)
        thread = threading.Thread(
            target=lambda: asyncio.run(tag_episode(DatabaseAddress.parse(database_url), "1", ("late",), ()))
        )
        thread.start()
        thread.join()
        os._exit(1)
    _, status = await asyncio.to_thread(os.waitpid, pid, 0)
    assert os.WTERMSIG(status) == 9
    await assert_intact(database_url, behind=1)
    await recover(database_url, spool=tmp_path / "spool")
    async with Reading.open(database_url) as reading:
        assert await tags_of(reading) == {"one": ["late"]}


async def test_an_episode_that_another_process_records_is_refused_with_one_line(tmp_path: Path) -> None:
    url = f"sqlite:///{tmp_path}/pycrorm.db"
    async with Memory.open(url) as memory, memory.episode(description="one"):
        await memory.flush()
        done = await asyncio.to_thread(pycrorm, "tag", "1", "good", cwd=tmp_path)
        assert done.returncode == 2
        assert one_line_of(done).startswith("pycrorm: episode 1 has not ended: tag it in the process that records it")
    async with Reading.open(url) as reading:
        assert await tags_of(reading) == {"one": []}


async def test_a_follow_up_has_the_tags_that_the_episode_had_when_it_was_continued(tmp_path: Path) -> None:
    settings = Settings(episode_events_max=100)
    async with Memory.open(f"sqlite:///{tmp_path}/memory.db", settings=settings) as memory:
        async with memory.episode(description="long", tags=["a", "b"], metadata={"n": 1}) as episode:
            await memory.tag(episode, "c", remove=["a"])
            for number in range(60):
                await NoteActionPerformable(str(number)).perform()
        await memory.flush()
        async with memory.session() as session:
            rows = (await session.scalars(select(ProcessMetaData).order_by(ProcessMetaData.id))).all()
            assert [(each.tags, each.episode_metadata) for each in rows] == [(["b", "c"], {"n": 1})] * len(rows)
            assert len(rows) > 1


@pytest.mark.parametrize(
    ("tags", "line"),
    [
        ("kitchen", "tags must be a list of texts, not 'kitchen'"),
        ([7], "a tag must be a text of 1 to 100 characters, not 7"),
        ([" "], "a tag must be a text of 1 to 100 characters"),
        (["x" * 2**20], "a tag must be a text of 1 to 100 characters"),
        (["a\0b"], "the text holds U\\+0000"),
        ([str(number) for number in range(101)], "at most 100 tags may be given at once, not 101"),
    ],
)
async def test_a_tag_that_is_no_short_text_is_refused_before_the_episode_begins(
    tmp_path: Path, tags: Any, line: str
) -> None:
    async with Memory.open(f"sqlite:///{tmp_path}/memory.db") as memory:
        with pytest.raises(CallerError, match=line):
            async with memory.episode(description="one", tags=tags):
                raise AssertionError
        assert memory.opened_count == 0


async def test_metadata_that_cannot_be_recorded_is_missing_and_counted(tmp_path: Path) -> None:
    async with Memory.open(f"sqlite:///{tmp_path}/memory.db") as memory:
        async with memory.episode(description="one", metadata={"nan": math.nan, "nul": "a\0", "good": [1]}):
            pass
        async with memory.episode(description="two", metadata={"long": "x" * 2**20}):
            pass
        with pytest.raises(CallerError, match="must be a dict with text keys"):
            async with memory.episode(description="three", metadata={1: 2}):  # type: ignore[dict-item]
                raise AssertionError
        await memory.flush()
        assert memory.status.missing.total == 3
        assert memory.status.faults.total == 0
        summaries = await memory.reading.episodes()
        assert [each.metadata for each in summaries] == [{"nan": None, "nul": None, "good": [1]}, None]


def test_the_command_tags_lists_and_names_what_it_cannot_do(tmp_path: Path) -> None:
    (tmp_path / "hello.py").write_text("async def plan():\n    pass\n\nasync def own(memory):\n    pass\n")
    done = pycrorm("run", "hello.py", "--tag", "kitchen", "--tag", "night", cwd=tmp_path)
    assert done.returncode == 0, done.stderr
    assert pycrorm("run", "hello.py", cwd=tmp_path).returncode == 0
    done = pycrorm("run", "hello.py:own", "--tag", "kitchen", cwd=tmp_path)
    assert (done.returncode, "opens its own episodes" in one_line_of(done)) == (2, True)
    done = pycrorm("tag", "1", "good", "--remove", "night", cwd=tmp_path)
    assert (done.returncode, done.stdout) == (0, "episode 1: good, kitchen\n")
    assert answer("tag", "2", "other", cwd=tmp_path)["tags"] == ["other"]
    listed = answer("episodes", "--tag", "kitchen", "--tag", "good", cwd=tmp_path)
    assert [(each["number"], each["tags"]) for each in listed] == [(1, ["good", "kitchen"])]
    assert answer("episodes", "--tag", "night", cwd=tmp_path) == []
    assert "good, kitchen" in pycrorm("episodes", cwd=tmp_path).stdout
    assert "good, kitchen" in pycrorm("show", "1", cwd=tmp_path).stdout
    done = pycrorm("tag", "1", "--remove", "night", cwd=tmp_path)
    assert (done.returncode, one_line_of(done)) == (
        2,
        "pycrorm: the episode has no tag 'night'; its tags: kitchen, good",
    )
    done = pycrorm("tag", "1", cwd=tmp_path)
    assert (done.returncode, "name a tag" in one_line_of(done)) == (2, True)
    done = pycrorm("tag", "9", "good", cwd=tmp_path)
    assert (done.returncode, "there is no episode '9'" in one_line_of(done)) == (2, True)
    assert pycrorm("verify", cwd=tmp_path).returncode == 0


async def test_an_unknown_episode_cannot_be_tagged(tmp_path: Path) -> None:
    async with Memory.open(f"sqlite:///{tmp_path}/memory.db") as memory:
        with pytest.raises(UnknownEpisode):
            await memory.tag("last", "good")


async def test_an_episode_that_lacks_events_cannot_be_tagged(tmp_path: Path) -> None:
    address = DatabaseAddress.parse(f"sqlite:///{tmp_path}/memory.db")
    records = full(1).records
    log = await EventLog.open(address, create=True)
    await log.append([*TYPES, *records])
    await log.append([records[-1]._replace(sequence=len(records) + 3)])  # the two events before it are lost
    with pytest.raises(CallerError, match=r"episode 1 cannot be tagged, because events of it are missing: events \d+"):
        await tag_episode(address, "1", ("good",), ())
    [row] = await log.episodes()
    await log.close()
    assert row.head == len(records)


async def test_a_recorders_role_tags_and_a_readers_role_does_not(server: Server, tmp_path: Path) -> None:
    url = server.new_database()
    async with Memory.open(url, spool=tmp_path / "spool") as memory, memory.episode(description="one"):
        pass
    change_each(url, GRANTS)
    database = urlsplit(url).path.removeprefix("/")
    for login, role in ((f"tags_{database}", "pycrorm_recorder"), (f"reads_{database}", "pycrorm_reader")):
        ask(url, f"CREATE ROLE {login} LOGIN IN ROLE {role}")
    recorder = DatabaseAddress.parse(server.url(database, user=f"tags_{database}"))
    done = await tag_episode(recorder, "1", ("good",), ())
    assert (done.tags, done.visible) == (("good",), False)
    with pytest.raises(DatabaseUnavailable, match="permission denied"):
        await tag_episode(DatabaseAddress.parse(server.url(database, user=f"reads_{database}")), "1", ("bad",), ())
    await assert_log_has(url, "good")


async def assert_log_has(url: str, *tags: str) -> None:
    log = await EventLog.open(DatabaseAddress.parse(url), create=False)
    try:
        [row] = await log.episodes()
        assert await log_tags(log, row) == tags
    finally:
        await log.close()
