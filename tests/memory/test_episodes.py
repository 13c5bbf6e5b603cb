"""What an episode states of itself: tags and metadata, what it was recorded with, and its number."""

from __future__ import annotations

import asyncio
import logging
import math
from collections.abc import Sequence
from importlib.metadata import version
from importlib.util import find_spec
from pathlib import Path
from typing import Any
from urllib.parse import urlsplit

import pytest
from sqlalchemy import select

from pycrorm_async import Memory, Reading, Settings, recover
from pycrorm_async.clock import SYSTEM_CLOCK, Clock, clock_quality
from pycrorm_async.errors import CallerError, DatabaseUnavailable, EpisodeParked
from pycrorm_async.events.ids import EPISODE_NUMBER_MAX, episode_text
from pycrorm_async.operations.copy import copy_episodes, tag_episode
from pycrorm_async.operations.rebuild import rebuild_memory
from pycrorm_async.orm import EpisodeTag, PickUpWithContextView, ProcessMetaData
from pycrorm_async.plan import ParkArmsActionPerformable, PickUpActionPerformable, simulated_robot
from pycrorm_async.plan.failures import PlanFailure
from pycrorm_async.projections.verify import verify
from pycrorm_async.queue.spool import Spool
from pycrorm_async.record.opening import PlanSource
from pycrorm_async.store.address import DatabaseAddress
from pycrorm_async.store.log import EventLog
from pycrorm_async.store.log import tags_of as log_tags
from pycrorm_async.store.postgresql import GRANTS
from pycrorm_async.world import Arms, BulletWorld, Grasp, Object, ObjectType, Pose
from tests.bullet import ENGINE, INSTALLED_ENGINES
from tests.commands import answer, one_line_of, pycrorm, run_script
from tests.databases import Server, ask, ask_to_change, change_each
from tests.memory.note_actions import NoteActionPerformable, texts, url_of
from tests.projections.verify_cases import TYPES, full
from tests.store.factories import episode, run_of
from tests.table_comparison import differences, tables_of

# === tags =====================================================================================================
#
# Tags and metadata of episodes, given at the start, by the recorder, and after the end, on both kinds of database.


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


@pytest.mark.slow
@pytest.mark.soak_on("postgresql")
async def test_tags_change_during_and_after_an_episode_and_survive_copy_and_rebuild(
    database_url: str, tmp_path: Path
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
    other = f"sqlite:///{tmp_path}/copy.db"
    await copy_episodes(database_url, other)
    await tag_episode(DatabaseAddress.parse(other), "1", ("in the copy",), ())
    async with Reading.open(other) as reading:
        assert await tags_of(reading) == {"one": ["good", "in the copy", "late"], "two": ["second"]}
    await assert_intact(other)


@pytest.mark.slow
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


@pytest.mark.slow
async def test_an_episode_that_another_process_records_is_refused_with_one_line(tmp_path: Path) -> None:
    url = f"sqlite:///{tmp_path}/pycrorm.db"
    async with Memory.open(url) as memory, memory.episode(description="one"):
        await memory.flush()
        done = await asyncio.to_thread(pycrorm, "tag", "1", "good", cwd=tmp_path)
        assert done.returncode == 2
        assert one_line_of(done).startswith("pycrorm: episode 1 has not ended: tag it in the process that records it")
    async with Reading.open(url) as reading:
        assert await tags_of(reading) == {"one": []}


@pytest.mark.slow
async def test_a_tag_that_is_no_short_text_is_refused_before_the_episode_begins(tmp_path: Path) -> None:
    refused: list[tuple[Any, str]] = [
        ("kitchen", "tags must be a list of texts, not 'kitchen'"),
        ([7], "a tag must be a text of 1 to 100 characters, not 7"),
        ([" "], "a tag must be a text of 1 to 100 characters"),
        (["x" * 2**20], "a tag must be a text of 1 to 100 characters"),
        ([str(number) for number in range(101)], "at most 100 tags may be given at once, not 101"),
    ]
    async with Memory.open(f"sqlite:///{tmp_path}/memory.db") as memory:
        for tags, line in refused:
            with pytest.raises(CallerError, match=line):
                async with memory.episode(description="one", tags=tags):
                    raise AssertionError
        assert memory.opened_count == 0


@pytest.mark.slow
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


@pytest.mark.slow
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


@pytest.mark.slow
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


@pytest.mark.slow
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


# === episode numbers ==========================================================================================
#
# A memory that has used up its episode numbers keeps further episodes in its spool; it warns before.


def take_numbers_up_to(url: str, last: int) -> None:
    """Make the database assign episode numbers up to this one."""
    row = f"{last}, '{episode_text(episode(99))}', 0, 0"
    ask_to_change(url, f"INSERT INTO episode (number, id, head, started_wall_ns) VALUES ({row})")
    if url.startswith("postgresql"):  # PostgreSQL takes the numbers from a sequence
        ask_to_change(url, f"SELECT setval('pycrorm.episode_number', {last})")


async def record_one(url: str) -> None:
    await (await EventLog.open(DatabaseAddress.parse(url), create=True)).close()


@pytest.mark.slow
@pytest.mark.soak_on("postgresql")
async def test_the_last_number_is_used_and_further_episodes_are_kept_in_the_spool_and_tried_again(
    database_url: str, tmp_path: Path
) -> None:
    await record_one(database_url)
    take_numbers_up_to(database_url, EPISODE_NUMBER_MAX - 1)
    spool = tmp_path / "spool"
    async with Memory.open(database_url, spool=spool) as memory:
        await NoteActionPerformable("the last").perform()
        await NoteActionPerformable("one too many").perform()
        with pytest.raises(EpisodeParked, match="all 2,147,483,647 episode numbers"):
            await memory.flush()
        assert await texts(memory) == ["the last"]
        assert memory.status.writer is not None
        last, beyond = memory.recent_episodes
    assert ask(database_url, f"SELECT id, head FROM episode WHERE number = {EPISODE_NUMBER_MAX}") == [(last, 6)]
    async with Reading.open(database_url) as reading:
        assert [(each.id, each.nodes) for each in await reading.episodes()] == [(last, 2)]
    (kept,) = [each for each in Spool(spool).recorders() if each.refused is not None]
    assert kept.refused == beyond

    recovered = await recover(database_url, spool=spool)  # as the next start does
    assert recovered.dead_letters.keys() == {beyond}
    assert "all 2,147,483,647 episode numbers" in recovered.drained.stopped[beyond]
    assert [each.refused for each in Spool(spool).recorders() if each.refused is not None] == [beyond]
    other = f"sqlite:///{tmp_path}/other.db"
    await copy_episodes(database_url, other)
    assert ask(other, f"SELECT number, head FROM episode WHERE id = '{last}'") == [
        (1, 6)
    ]  # a new memory assigns new numbers
    done = pycrorm("spool", "rebind", "--url", other, "--spool", spool, cwd=tmp_path)
    assert done.returncode == 0, done.stderr
    assert ask(other, f"SELECT number, head, refused FROM episode WHERE id = '{beyond}'") == [(2, 6, None)]
    assert [each for each in Spool(spool).recorders() if each.refused is not None] == []


@pytest.mark.slow
@pytest.mark.soak_on("postgresql")
async def test_status_and_log_warn_once_nine_tenths_of_the_episode_numbers_are_used(
    database_url: str, tmp_path: Path, caplog: pytest.LogCaptureFixture
) -> None:
    await record_one(database_url)
    take_numbers_up_to(database_url, 1_932_735_281)
    log = await EventLog.open(DatabaseAddress.parse(database_url), create=True)
    with caplog.at_level(logging.WARNING, logger="pycrorm_async"):
        await log.append(run_of(episode(1), 1, 2))
        assert (await log.limits_near(), caplog.messages) == ([], [])
        for number in (2, 3):
            await log.append(run_of(episode(number), 1, 2))
    warning = "{} of 2,147,483,647 episode numbers are used (90 %): record into a new database before none is left"
    assert await log.limits_near() == [warning.format("1,932,735,284")]
    [message] = caplog.messages
    assert message.endswith(f": {warning.format('1,932,735,283')}")
    await log.close()
    options = ("--url", database_url, "--spool", tmp_path / "spool")
    assert answer("status", *options, cwd=tmp_path)["warnings"] == [warning.format("1,932,735,284")]
    assert f"warning: {warning.format('1,932,735,284')}" in pycrorm("status", *options, cwd=tmp_path).stderr


@pytest.mark.slow
@pytest.mark.soak_on("postgresql")
async def test_status_and_log_warn_once_nine_tenths_of_an_episodes_sequences_are_used(
    database_url: str, caplog: pytest.LogCaptureFixture
) -> None:
    log = await EventLog.open(DatabaseAddress.parse(database_url), create=True)
    await log.append(run_of(episode(1), 1, 2))
    first = 60_397_977
    ask_to_change(database_url, f"UPDATE episode SET head = {first - 2}")
    with caplog.at_level(logging.WARNING, logger="pycrorm_async"):
        for sequence in range(first - 1, first + 2):
            await log.append(run_of(episode(1), sequence, sequence))
    assert len(caplog.messages) == 1
    (warning,) = await log.limits_near()
    assert warning.startswith("episode 1 (")
    assert "has 60,397,978 of 67,108,863 events (90 %): it records nothing but ends beyond" in warning
    await log.close()


# === provenance ===============================================================================================
#
# Every episode holds what it was recorded with: source, libraries, settings, quality of the clock, and the world.

SOURCE = PlanSource("ab" * 32, "cd" * 20, git_dirty=True)


async def episodes_of(memory: Memory) -> list[ProcessMetaData]:
    await memory.flush()
    async with memory.session() as session:
        return list(await session.scalars(select(ProcessMetaData).order_by(ProcessMetaData.id)))


async def test_an_episode_holds_source_libraries_settings_and_clock(tmp_path: Path) -> None:
    settings = Settings(sync_interval_ms=20, on_full="fail")
    async with Memory.open(url_of(tmp_path), settings=settings, plan_source=SOURCE) as memory:
        async with memory.episode(description="with all"):
            pass
        (episode,) = await episodes_of(memory)
        (summary,) = await memory.reading.episodes()
    quality = clock_quality()
    for each in (episode, summary):
        assert (each.plan_sha256, each.git_commit, each.git_dirty) == SOURCE
        assert each.settings == {"sync_interval_ms": 20, "on_full": "fail"}
        assert each.libraries is not None
        assert each.libraries["numpy"] == version("numpy")
        assert {"msgspec", "SQLAlchemy", "optik-py", *INSTALLED_ENGINES} <= set(each.libraries)
        assert ("pyjpt" in each.libraries) is (find_spec("jpt") is not None)  # it has no wheel for every Python
        assert each.clock_synchronized is (quality.synchronized if quality else None)
    assert "password" not in str(episode.settings)


async def test_what_is_not_known_is_null(tmp_path: Path) -> None:
    own_clock = Clock(SYSTEM_CLOCK.wall_ns, SYSTEM_CLOCK.monotonic_ns)
    async with Memory.open(url_of(tmp_path), clock=own_clock) as memory:
        async with memory.episode(description="without source"):
            pass
        (episode,) = await episodes_of(memory)
    assert (episode.plan_sha256, episode.git_commit, episode.git_dirty, episode.settings) == (None,) * 4
    assert (episode.clock_synchronized, episode.clock_error_us, episode.world) == (None,) * 3


async def test_the_scene_of_a_pick_up_is_the_world_that_its_episode_entered(tmp_path: Path) -> None:
    async with Memory.open(url_of(tmp_path)) as memory:

        async def scenes() -> Sequence[str | None]:
            await memory.flush()
            async with memory.session() as session:
                return (await session.scalars(select(PickUpWithContextView.scene))).all()

        async with memory.episode(description="a pick-up"):
            with BulletWorld(), simulated_robot:
                Object("pr2", ObjectType.ROBOT)
                milk = Object("milk", ObjectType.MILK, pose=Pose([0.6, 0.2, 0.9]))
                with pytest.raises(PlanFailure):
                    await PickUpActionPerformable(milk, Arms.LEFT, Grasp.TOP).perform()
                assert await scenes() == ["pr2 (ROBOT), milk (MILK)"]  # while it runs
        assert await scenes() == [f"BulletWorld (DIRECT, {ENGINE}): pr2 (ROBOT), milk (MILK)"]


async def test_a_world_that_is_entered_inside_an_episode_is_described(tmp_path: Path) -> None:
    async with Memory.open(url_of(tmp_path)) as memory:
        async with memory.episode(description="left before the end"):
            with BulletWorld(), simulated_robot:
                Object("pr2", ObjectType.ROBOT)
                await ParkArmsActionPerformable(Arms.BOTH).perform()
        with BulletWorld():
            Object("milk", ObjectType.MILK)
            async with memory.episode(description="entered before"):
                Object("bowl", ObjectType.BOWL)
        episode = memory.episode(description="open at the end")
        await episode.__aenter__()
        with BulletWorld():
            Object("spoon", ObjectType.SPOON)
            await episode.__aexit__(None, None, None)
        await memory.flush()
        worlds = [each.world for each in await episodes_of(memory)]
    assert worlds == [
        f"BulletWorld (DIRECT, {ENGINE}): pr2 (ROBOT)",
        f"BulletWorld (DIRECT, {ENGINE}): milk (MILK)",
        f"BulletWorld (DIRECT, {ENGINE}): spoon (SPOON)",
    ]


@pytest.mark.slow
def test_a_plans_process_starts_no_git_on_its_own(tmp_path: Path) -> None:
    program = """
import asyncio, subprocess, sys
def refuse(event, arguments):
    if event in ("subprocess.Popen", "os.posix_spawn", "os.system"):
        print("started", arguments)
sys.addaudithook(refuse)
from pycrorm_async import Memory
async def main():
    async with Memory.open("sqlite:///memory.db") as memory:
        async with memory.episode(description="quiet"):
            pass
asyncio.run(main())
"""
    ran = run_script(program, cwd=tmp_path)
    assert (ran.returncode, ran.stderr) == (0, "")
    assert "git" not in ran.stdout
