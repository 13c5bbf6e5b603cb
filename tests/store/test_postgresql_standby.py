"""A batch that waits in vain for a synchronous standby is never acknowledged, whatever it holds and however it ends."""

from __future__ import annotations

import asyncio
from collections.abc import AsyncIterator
from contextlib import asynccontextmanager

import asyncpg
import pytest

from pycrorm_async.errors import DatabaseUnavailable
from pycrorm_async.store.address import DatabaseAddress
from pycrorm_async.store.dialect import StoredOn
from pycrorm_async.store.log import EventLog
from tests.databases import Server, ask
from tests.store.factories import declaration, episode, run_of

pytestmark = pytest.mark.slow

_WAITING = "SELECT pid FROM pg_stat_activity WHERE wait_event = 'SyncRep' AND datname = current_database()"
_PROBE = "SELECT pg_logical_emit_message(true, 'test', '')"

BATCHES = {
    "declarations only": [declaration(b'{"dtype":"A"}')],
    "the first events of an episode, which take its number": run_of(episode(2), 1, 5),
    "more events of an episode": run_of(episode(1), 4, 6),
    "events that are stored already": run_of(episode(1), 1, 3),
    "a gap, which the log notes": run_of(episode(1), 9, 9),
    "declarations and events": [declaration(b'{"dtype":"B"}'), *run_of(episode(3), 1, 2)],
}


@pytest.fixture
def database_url(server: Server) -> str:
    """Use PostgreSQL alone: these tests are about its standbys."""
    return server.new_database()


@asynccontextmanager
async def standby_missing(url: str) -> AsyncIterator[asyncpg.Connection]:
    """Make every COMMIT on the server wait for a standby that does not exist, inside the context."""
    watch = await asyncpg.connect(url)
    try:
        await watch.execute("ALTER SYSTEM SET synchronous_standby_names = 'nowhere'")
        await watch.execute("SELECT pg_reload_conf()")
        while not await _is_in_force(url, watch):
            pass
        yield watch
    finally:
        await watch.execute("ALTER SYSTEM RESET synchronous_standby_names")
        await watch.execute("SELECT pg_reload_conf()")
        await watch.close()


async def _is_in_force(url: str, watch: asyncpg.Connection) -> bool:
    probe = await asyncpg.connect(url)
    committing = asyncio.create_task(probe.execute(_PROBE))
    waits = await _ended_while_waiting(committing, watch, "pg_cancel_backend")
    await committing
    await probe.close()
    return waits


async def _ended_while_waiting(committing: asyncio.Task[object], watch: asyncpg.Connection, how: str) -> bool:
    """Cancel or terminate the session that waits for the standby; return False if the task ended without waiting."""
    while not committing.done():
        pids = [row["pid"] for row in await watch.fetch(_WAITING)]
        for pid in pids:
            await watch.execute(f"SELECT {how}({pid})")
        if pids:
            await asyncio.wait([committing])
            return True
        await asyncio.sleep(0)
    return False


async def test_the_standby_for_which_each_commit_waits_counts_as_a_machine_and_is_named(database_url: str) -> None:
    log = await EventLog.open(DatabaseAddress.parse(database_url), create=True)
    try:
        assert await log.stored_on() == StoredOn(1)
        async with standby_missing(database_url):
            assert await log.stored_on() == StoredOn(2, ("nowhere",))
    finally:
        await log.close()


@pytest.mark.parametrize("how", ["pg_cancel_backend", "pg_terminate_backend"])
async def test_a_batch_that_is_ended_while_it_waits_for_a_standby_is_not_stored_however_often_it_is_tried(
    how: str, database_url: str
) -> None:
    log = await EventLog.open(DatabaseAddress.parse(database_url), create=True)
    assert await log.append(run_of(episode(1), 1, 3)) == {}
    try:
        async with standby_missing(database_url) as watch:
            for name, records in BATCHES.items():
                for _ in range(2):  # the first attempt commits, the second one finds all of it stored
                    appending = asyncio.create_task(log.append(records))
                    assert await _ended_while_waiting(appending, watch, how), f"{name}: {appending}"
                    assert isinstance(appending.exception(), DatabaseUnavailable), name
        refusals = [await log.append(records) for records in BATCHES.values()]  # now each attempt is answered
        assert [each.keys() for each in refusals] == [{episode(1)} if "gap" in name else set() for name in BATCHES]
    finally:
        await log.close()
    rows = ask(database_url, "SELECT number, head, refused IS NULL FROM episode ORDER BY number")
    assert rows == [(1, 6, False), (2, 5, True), (3, 2, True)]
    stored = ask(database_url, "SELECT episode, count(*), max(sequence) FROM event GROUP BY episode ORDER BY episode")
    assert stored == [(number, head, head) for number, head, _ in rows]
