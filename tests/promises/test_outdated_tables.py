"""A program that is newer than the tables of a memory records as before, and makes the tables of a small one again."""

from __future__ import annotations

import asyncio
import json
import logging
import subprocess
from dataclasses import dataclass
from pathlib import Path

import pytest

from pycrorm_async import Memory
from pycrorm_async.errors import TablesOutdated, TablesPending
from pycrorm_async.operations import rebuild
from pycrorm_async.operations.daemon import serve
from pycrorm_async.operations.recovery import recover
from pycrorm_async.plan import ActionAbstract
from pycrorm_async.projections.generations import PROJECTION_VERSION
from pycrorm_async.projections.verify import verify
from pycrorm_async.query.reading import Reading
from pycrorm_async.store.address import DatabaseAddress
from pycrorm_async.store.log import EventLog
from tests.commands import run_script
from tests.databases import ask, ask_to_change, put_memory
from tests.golden.unpacking import unpack_memory_v1
from tests.writer.running_writers import until

pytestmark = [pytest.mark.slow, pytest.mark.soak_on("postgresql")]
"""Whether tables are outdated is decided above the database, so that servers test it in turns."""
OLD = PROJECTION_VERSION - 1


@pytest.fixture(autouse=True)
def _in_own_folder(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    """The spools of PostgreSQL's memories are in the working directory."""
    monkeypatch.chdir(tmp_path)


@dataclass
class StepActionPerformable(ActionAbstract):
    number: int

    async def perform(self) -> None:
        """Succeed without doing anything."""


async def recorded(url: str, *numbers: int) -> None:
    async with Memory.open(url) as memory, memory.episode(description="steps"):
        for number in numbers:
            await StepActionPerformable(number).perform()
        assert memory.status.faults.total == 0


def numbers_in(url: str) -> list[int]:
    return [number for (number,) in ask(url, "SELECT number FROM step_action ORDER BY id")]


async def outdated(url: str) -> None:
    """Record a memory, and let it look as if an older fold had made its tables."""
    await recorded(url, 1, 2)
    at = "memory_tables." if url.startswith("postgresql:") else ""
    ask_to_change(url, f"UPDATE {at}pycrorm_generation SET version = {OLD} WHERE projection = 'tables'")


def warnings_in(caplog: pytest.LogCaptureFixture) -> list[str]:
    return [each.getMessage() for each in caplog.records if each.levelno >= logging.WARNING]


@pytest.mark.parametrize("opened_by", ["memory", "writer", "recovery"])
async def test_the_tables_of_a_small_memory_are_made_again_when_it_is_opened(
    database_url: str, caplog: pytest.LogCaptureFixture, opened_by: str
) -> None:
    await outdated(database_url)
    if opened_by == "memory":
        await recorded(database_url, 3)
    elif opened_by == "recovery":
        await recover(database_url)
    else:
        done = await asyncio.to_thread(pycrorm, "writer", "--once", "--url", database_url, small=8)
        assert done.returncode == 0, done.stderr
    if opened_by != "writer":
        [warning] = warnings_in(caplog)
        assert warning.startswith(f"the tables were made by version {OLD} of the fold")
        assert "rebuilding them from 8 events" in warning
    assert numbers_in(database_url) == ([1, 2, 3] if opened_by == "memory" else [1, 2])


async def test_the_memory_of_the_first_version_is_continued_by_opening_it(tmp_path: Path) -> None:
    url = unpack_memory_v1(tmp_path)
    await recorded(url, 7)
    async with Reading.open(url) as reading:
        episodes = await reading.episodes()
        assert sorted(each.description for each in episodes) == ["Cut short", "Everything once", "steps"]
    assert numbers_in(url) == [7]


async def test_a_plan_in_a_large_outdated_memory_is_stored_and_raises_nothing(
    database_url: str, monkeypatch: pytest.MonkeyPatch, caplog: pytest.LogCaptureFixture
) -> None:
    await outdated(database_url)
    small = rebuild.SMALL_EVENTS_MAX
    monkeypatch.setattr(rebuild, "SMALL_EVENTS_MAX", 5)
    await recorded(database_url, 3)
    [warning] = warnings_in(caplog)
    assert "run `pycrorm rebuild`; events are stored in the log but not folded until then" in warning
    async with Memory.open(database_url) as memory:
        await StepActionPerformable(4).perform()
        with pytest.raises(TablesOutdated, match="run `pycrorm rebuild`"):
            await memory.flush()
        await memory.flush()  # reported once, as a parked episode
        assert memory.status.stored == memory.status.written
    monkeypatch.setattr(rebuild, "SMALL_EVENTS_MAX", small)
    await recorded(database_url, 5)
    assert numbers_in(database_url) == [1, 2, 3, 4, 5]


@pytest.mark.parametrize("drained_by", ["daemon", "writer --once"])
async def test_a_plan_whose_events_another_process_stores_waits_for_no_rebuild(
    database_url: str,
    monkeypatch: pytest.MonkeyPatch,
    caplog: pytest.LogCaptureFixture,
    tmp_path: Path,
    drained_by: str,
) -> None:
    await outdated(database_url)
    small = rebuild.SMALL_EVENTS_MAX
    monkeypatch.setattr(rebuild, "SMALL_EVENTS_MAX", 5)
    spool, stop, lines = tmp_path / "spool", asyncio.Event(), list[str]()
    serving = serve(database_url, spool=spool, stop=stop, report=lines.append)
    async with Memory.open(database_url, spool=spool, writer="daemon") as memory:
        drains = asyncio.create_task(serving if drained_by == "daemon" else asyncio.sleep(0))
        async with memory.episode(description="steps"):
            await StepActionPerformable(3).perform()
        if drained_by == "daemon":
            with pytest.raises(TablesPending, match="run `pycrorm rebuild`"):
                await memory.flush()
            await memory.flush()  # reported once
            monkeypatch.setattr(rebuild, "SMALL_EVENTS_MAX", small)
            await rebuild.rebuild_memory(database_url)  # beside the daemon, which goes on folding
            async with memory.episode(description="steps"):
                await StepActionPerformable(4).perform()
            await until(lambda: numbers_in(database_url) == [1, 2, 3, 4])  # the daemon tries to fold again at intervals
        else:
            serving.close()
            await memory.synced()
            once = await asyncio.to_thread(pycrorm, "writer", "--once", "--url", database_url, "--spool", str(spool))
            assert (once.returncode, once.stderr.count("run `pycrorm rebuild`")) == (0, 1), once.stderr
            assert memory.status.stored > 0
            with pytest.raises(TablesPending):
                await memory.flush()
    stop.set()
    await drains
    assert sum("run `pycrorm rebuild`" in each for each in warnings_in(caplog)) <= 2  # the plan's and the daemon's
    assert numbers_in(database_url) == ([1, 2, 3, 4] if drained_by == "daemon" else [1, 2])
    assert [each for each in lines if "not finished" in each] == []


async def test_verify_checks_the_log_of_an_outdated_memory(database_url: str) -> None:
    await outdated(database_url)
    log = await EventLog.open(DatabaseAddress.parse(database_url), create=True)
    try:
        result = await verify(log)
        assert (result.events, result.episodes, result.rows) == (8, 1, 0)
        assert (result.damage, result.drift, result.behind) == (0, 0, 0)
        assert result.outdated is not None
        if database_url.startswith("postgresql:"):
            ask_to_change(database_url, "ALTER TABLE pycrorm.event DISABLE TRIGGER ALL")
        else:
            ask_to_change(database_url, "DROP TRIGGER event_is_not_deleted")
        ask_to_change(database_url, "DELETE FROM event WHERE sequence = 3")
        damaged = await verify(log)
        assert damaged.damage > 0
        assert damaged.outdated is not None
    finally:
        await log.close()


@pytest.mark.soak
async def test_every_command_says_that_the_tables_are_outdated_and_run_succeeds(tmp_path: Path) -> None:
    url = put_memory(tmp_path / "memory.db")
    await outdated(url)
    plan = tmp_path / "steps.py"
    plan.write_text(
        "from tests.promises.test_outdated_tables import StepActionPerformable\n"
        "async def plan():\n    await StepActionPerformable(3).perform()\n"
    )
    done = await asyncio.to_thread(pycrorm, "run", str(plan), "--url", url)
    assert (done.returncode, done.stdout) == (0, ""), done.stderr
    assert done.stderr.count("run `pycrorm rebuild`") == 1
    assert ask(url, "SELECT count(*) FROM event") == [(14,)]
    status = await asyncio.to_thread(pycrorm, "status", "--url", url)
    assert status.returncode == 0
    assert "The tables show all stored events" not in status.stdout
    assert "all 14 events of 2 episodes are stored, but queries cannot show them" in status.stderr
    report = json.loads((await asyncio.to_thread(pycrorm, "status", "--json", "--url", url)).stdout)
    assert report["warnings"][0].endswith("run `pycrorm rebuild`")
    verified = await asyncio.to_thread(pycrorm, "verify", "--url", url)
    assert verified.returncode == 1
    assert "14 events of 2 episodes" in verified.stdout
    assert "the tables are outdated; run `pycrorm rebuild`" in verified.stdout
    assert (await asyncio.to_thread(pycrorm, "rebuild", "--url", url)).returncode == 0
    status = await asyncio.to_thread(pycrorm, "status", "--url", url)
    assert (status.returncode, "The tables show all stored events." in status.stdout) == (0, True)


def pycrorm(*arguments: str, small: int = 5) -> subprocess.CompletedProcess[str]:
    """Run a command for which a memory of more events than this is large."""
    program = (
        f"from pycrorm_async.operations import rebuild; rebuild.SMALL_EVENTS_MAX = {small}\n"
        "from pycrorm_async.__main__ import main; main()"
    )
    return run_script(program, *arguments)
