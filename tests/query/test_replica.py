"""Questions go to a streaming replica: its lag is reported, and what a memory has flushed is always in its answers."""

from __future__ import annotations

import asyncio
import tempfile
import time
from collections.abc import Iterator
from pathlib import Path
from urllib.parse import urlsplit

import pytest
from sqlalchemy import func, select

from pycrorm_async import Memory
from pycrorm_async.errors import CallerError, DatabaseUnavailable
from pycrorm_async.live import follower
from pycrorm_async.live.follower import LogFollower
from pycrorm_async.plan import SimulatedTaskTree
from pycrorm_async.query import reading as reading_module
from pycrorm_async.query.reading import Reading
from pycrorm_async.store import replica
from pycrorm_async.store.address import DatabaseAddress
from tests.backups import Replicas, replicas_in
from tests.commands import NOTES_PLAN, answer, pycrorm
from tests.crash.step_robot import SETTINGS, StepActionPerformable
from tests.databases import Server, ask

pytestmark = pytest.mark.slow

ON_REPLICA = select(func.pg_is_in_recovery())


@pytest.fixture(scope="module")
def replicas() -> Iterator[Replicas]:
    with tempfile.TemporaryDirectory(prefix="pg") as folder, replicas_in(Path(folder), synchronous=False) as pair:
        yield pair


@pytest.fixture
def database(replicas: Replicas, request: pytest.FixtureRequest) -> str:
    name = f"memory{abs(hash(request.node.name))}"
    ask(replicas.url(), f"CREATE DATABASE {name}")
    while not ask(replicas.standby_url(), f"SELECT 1 FROM pg_database WHERE datname = '{name}'"):
        time.sleep(0.01)
    return name


async def record(memory: Memory, step: int) -> None:
    async with memory.episode(description=f"step {step}"):
        await StepActionPerformable("a", step).perform()
    await memory.flush()


async def steps(reading: Reading | Memory) -> list[int]:
    async with reading.session() as session:
        return sorted(each.step for each in await session.scalars(select(reading.mapped("StepAction"))))


async def test_what_a_memory_flushed_is_in_its_answers_whatever_the_replica_does(
    replicas: Replicas, database: str, tmp_path: Path, caplog: pytest.LogCaptureFixture, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setattr(reading_module, "LAG_S_MAX", 0.5)
    url, standby = replicas.url(database), replicas.standby_url(database)
    async with Memory.open(url, read_url=standby, spool=tmp_path / "spool", settings=SETTINGS) as memory:

        async def is_on_replica() -> bool:
            [(answers,)] = await memory.reading.rows(ON_REPLICA)
            return bool(answers)

        await record(memory, 1)
        assert (await steps(memory), await is_on_replica()) == ([1], True)
        for step in range(2, 10):
            await record(memory, step)
            assert await steps(memory) == [*range(1, step + 1)]
        assert await is_on_replica()
        for count in (9, 10):  # simulations, as soon as there are some, are read from the memory
            async with memory.session(simulated=True) as session:
                assert len((await session.scalars(select(memory.mapped("StepAction")))).all()) == count
            with SimulatedTaskTree():
                await StepActionPerformable("a", 0).perform()
            await memory.flush()
        assert not caplog.records

        ask(standby, "SELECT pg_wal_replay_pause()")
        await record(memory, 10)
        assert (await steps(memory), await is_on_replica()) == ([*range(1, 11)], False)
        ask(standby, "SELECT pg_wal_replay_resume()")
        await record(memory, 11)
        assert (await steps(memory), await is_on_replica()) == ([*range(1, 12)], True)
    behind, current = (each.getMessage() for each in caplog.records)
    assert "KiB of its primary's changes; its last change is" in behind
    assert behind.endswith(f"reading from {memory._address}")
    assert f"shows all that its primary has committed; reading from {memory._replica}" in current


async def test_a_reader_is_told_how_far_the_replica_is_behind_and_reads_it_while_the_primary_is_away(
    replicas: Replicas, database: str, tmp_path: Path, caplog: pytest.LogCaptureFixture, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setattr(replica, "LAG_S_MAX", 0.0)
    url, standby = replicas.url(database), replicas.standby_url(database)
    async with Memory.open(url, spool=tmp_path / "spool", settings=SETTINGS) as memory:
        await record(memory, 1)
        async with Reading.open(url, read_url=standby) as reading:
            assert await steps(reading) == [1]
        assert not caplog.records
        ask(standby, "SELECT pg_wal_replay_pause()")
        await record(memory, 2)
    async with Reading.open(url, read_url=standby) as reading:
        assert await steps(reading) == [1]
    assert [each.getMessage().count("lacks ") for each in caplog.records] == [1]
    status = pycrorm("status", "--url", url, "--read-url", standby, "--spool", tmp_path / "spool", cwd=tmp_path)
    assert "The replica lacks " in status.stdout
    ask(standby, "SELECT pg_wal_replay_resume()")
    replicas.stop_primary()
    try:
        async with Reading.open(url, read_url=standby) as reading:
            assert await steps(reading) == [1, 2]
        assert "its primary does not answer" in caplog.records[-1].getMessage()
    finally:
        replicas.start_primary()


async def test_a_replica_that_does_not_answer_is_replaced_by_the_memory_and_another_memory_is_refused(
    server: Server, replicas: Replicas, database: str, tmp_path: Path, caplog: pytest.LogCaptureFixture
) -> None:
    url = replicas.url(database)
    async with Memory.open(url, spool=tmp_path / "spool", settings=SETTINGS) as memory:
        await record(memory, 1)
    async with Reading.open(url, read_url=f"postgresql://postgres@/{database}?host={tmp_path}") as reading:
        assert await steps(reading) == [1]
    assert "the replica does not answer" in caplog.records[0].getMessage()
    ask(server.url(), f"CREATE DATABASE {database}")
    other = server.url(database)
    async with Memory.open(other, spool=tmp_path / "other", settings=SETTINGS) as memory:
        pass
    for wrong in (other, server.url(), "sqlite:///memory.db"):
        with pytest.raises(CallerError, match=r"holds another memory|is no replica of"):
            async with Reading.open(url, read_url=wrong):
                pass


async def test_a_page_and_an_agent_read_the_replica_are_told_its_lag_and_read_the_memory_while_it_is_away(
    replicas: Replicas, database: str, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setattr(replica, "LAG_S_MAX", 0.0)
    monkeypatch.setattr(follower, "_LAG_INTERVAL_S", 0.0)
    url, standby = (DatabaseAddress.parse(each) for each in (replicas.url(database), replicas.standby_url(database)))
    from mcp import Client

    from pycrorm_async.integrations.mcp_server import memory_server

    page = LogFollower(url, standby)

    async def now() -> str:
        """Return the answer of the server of the agent, also one that is an error."""
        return str((await client.call_tool("now", {})).content[0].text)  # type: ignore[union-attr]

    async with (
        Client(memory_server(url, standby)) as client,
        Memory.open(url.to_type, spool=tmp_path / "spool", settings=SETTINGS) as memory,
    ):
        await record(memory, 1)
        following = asyncio.create_task(page.run())
        async with page.listening(page.overview):

            async def until(fault: str | None) -> None:
                async with asyncio.timeout(20):
                    while page.fault != fault if fault is None else fault not in (page.fault or ""):  # noqa: ASYNC110
                        await asyncio.sleep(0.05)

            await until(None)
            assert ((await page.log()).address, await now()) == (standby, "no episode runs")
            ask(replicas.standby_url(database), "SELECT pg_wal_replay_pause()")
            await record(memory, 2)
            await until("KiB of its primary's changes")
            assert "KiB of its primary's changes" in await now()
            assert await (await page.log()).last_number() == 1
            ask(replicas.standby_url(database), "SELECT pg_wal_replay_resume()")
            await until(None)
            assert await (await page.log()).last_number() == 2
            replicas.stop_standby()
            try:
                async with asyncio.timeout(20):
                    while (await page.log()).address != url:  # noqa: ASYNC110
                        await asyncio.sleep(0.05)
                await until(None)
                assert await now() != "no episode runs"  # the connection is lost
                assert await now() == "no episode runs"
            finally:
                replicas.start_standby()
        following.cancel()
        await asyncio.gather(following, return_exceptions=True)


async def test_a_question_that_cannot_be_asked_leaves_no_connection_open(
    replicas: Replicas, database: str, tmp_path: Path
) -> None:
    url, standby = replicas.url(database), replicas.standby_url(database)
    async with Memory.open(url, read_url=standby, spool=tmp_path / "spool", settings=SETTINGS) as memory:
        await record(memory, 1)
        replicas.stop_primary()
        try:
            for _ in range(3):
                with pytest.raises(DatabaseUnavailable):
                    await steps(memory)
            sessions = "SELECT count(*) FROM pg_stat_activity WHERE datname = current_database()"
            assert ask(standby, sessions) == [(1,)]  # the one that asks
        finally:
            replicas.start_primary()
        assert await steps(memory) == [1]


async def test_a_replica_that_was_promoted_beside_its_primary_is_not_read(
    tmp_path: Path, caplog: pytest.LogCaptureFixture
) -> None:
    with tempfile.TemporaryDirectory(prefix="pg") as folder, replicas_in(Path(folder), synchronous=False) as pair:
        url, promoted = pair.url(), pair.standby_url()
        async with Memory.open(url, read_url=promoted, spool=tmp_path / "spool", settings=SETTINGS) as memory:
            await record(memory, 1)
            ask(promoted, "SELECT pg_promote(true, 60)")
            async with Reading.open(promoted, read_url=promoted) as reading:  # a URL may lead to the same server
                assert (await steps(reading), caplog.records) == ([1], [])
            await record(memory, 2)
            assert await steps(memory) == [1, 2]
        async with Reading.open(url, read_url=promoted) as reading:
            assert await steps(reading) == [1, 2]
        assert ["follows no other server" in each.getMessage() for each in caplog.records] == [True, True]
        status = pycrorm("status", "--url", url, "--read-url", promoted, "--spool", tmp_path / "spool", cwd=tmp_path)
        assert (status.returncode, "follows no other server" in status.stderr) == (0, True)


async def test_a_url_may_name_both_servers_and_leads_to_the_one_that_takes_writes(
    replicas: Replicas, database: str, tmp_path: Path
) -> None:
    hosts = [urlsplit(each).query.removeprefix("host=") for each in (replicas.standby_url(), replicas.url())]
    for number, order in enumerate((hosts, hosts[::-1])):
        url = f"postgresql://postgres@/{database}?host={','.join(order)}&port=5432,5432&target_session_attrs=read-write"
        async with Memory.open(url, spool=tmp_path / "spool", settings=SETTINGS) as memory:
            await record(memory, number)
            assert await steps(memory) == [*range(number + 1)]


def test_each_reading_verb_answers_from_a_replica_alone(replicas: Replicas, database: str, tmp_path: Path) -> None:
    url, standby = replicas.url(database), replicas.standby_url(database)
    (tmp_path / "notes.py").write_text(NOTES_PLAN)
    at = ("--url", url, "--read-url", standby, "--spool", str(tmp_path / "spool"))
    done = pycrorm("run", "notes.py", *at, cwd=tmp_path)
    assert (done.returncode, done.stderr.count("replica")) == (0, 0)
    refused = pycrorm("learn", *at, cwd=tmp_path)
    assert (refused.returncode, "learn with --from-memory" in refused.stderr) == (2, True)
    assert answer("episodes", *at, cwd=tmp_path) == answer("episodes", *at[:2], *at[4:], cwd=tmp_path)
    replicas.stop_primary()
    try:
        for verb in (
            ("episodes",),
            ("watch", "last", "--terminal"),
            ("show", "last"),
            ("events", "last"),
            ("verify",),
            ("schema",),
            ("recall", "NoteAction"),
            ("ask", "durations"),
            ("diff", "last", "last"),
            ("report", "last", "--out", "page.html"),
            ("export", "episodes", "--out", "episodes.csv"),
        ):
            done = pycrorm(*verb, *at, cwd=tmp_path)
            assert done.returncode == 0, (verb, done.stderr)
            assert "may be behind, because its primary does not answer" in done.stderr
    finally:
        replicas.start_primary()
