"""Concurrent appends to a log on PostgreSQL store every event once and never deadlock."""

from __future__ import annotations

import asyncio

import asyncpg
import pytest

from pycrorm_async.errors import DatabaseUnavailable
from pycrorm_async.projections.projector import Projector
from pycrorm_async.store.address import DatabaseAddress
from pycrorm_async.store.append import Appending
from pycrorm_async.store.dialects import dialect_of
from pycrorm_async.store.log import EventLog
from tests.databases import Server, ask
from tests.store.factories import episode, run_of, started

pytestmark = pytest.mark.slow


@pytest.fixture
def database_url(server: Server) -> str:
    """Use PostgreSQL alone: SQLite has one writer at a time."""
    return server.new_database()


async def test_two_concurrent_appends_of_one_episode_store_it_once(database_url: str) -> None:
    address = DatabaseAddress.parse(database_url)
    logs = [await EventLog.open(address, create=True) for _ in range(2)]
    for first in range(1, 400, 20):
        batch = run_of(episode(1), first, first + 19)
        while True:
            answers = await asyncio.gather(*(each.append(batch) for each in logs), return_exceptions=True)
            assert all(each == {} or type(each) is DatabaseUnavailable for each in answers), answers
            if list(answers) == [{}, {}]:
                break
    assert ask(database_url, "SELECT count(*), min(sequence), max(sequence) FROM event") == [(400, 1, 400)]
    assert ask(database_url, "SELECT number, head, refused FROM episode")[0][1:] == (400, None)
    for each in logs:
        await each.close()


async def test_an_append_waits_for_a_row_that_another_session_locks_and_then_the_database_is_unavailable(
    database_url: str,
) -> None:
    log = await EventLog.open(DatabaseAddress.parse(database_url), create=True, busy_timeout_s=0.3)
    await log.append(run_of(episode(1), 1, 3))
    holder = await asyncpg.connect(database_url)
    transaction = holder.transaction()
    await transaction.start()
    await holder.execute("SELECT * FROM pycrorm.episode FOR UPDATE")
    with pytest.raises(DatabaseUnavailable, match=r"canceling statement due to lock timeout$"):
        await log.append(run_of(episode(1), 4, 5))
    assert await log.append(run_of(episode(2), 1, 2)) == {}  # another episode does not wait
    await transaction.rollback()
    await holder.close()
    assert await log.append(run_of(episode(1), 4, 5)) == {}
    assert [each.head for each in await log.episodes()] == [5, 2]
    await log.close()


async def test_concurrent_appends_of_the_same_episodes_in_opposite_order_do_not_deadlock(
    database_url: str,
) -> None:
    log = await EventLog.open(DatabaseAddress.parse(database_url), create=True)
    await log.append([*run_of(episode(1), 1, 1), *run_of(episode(2), 1, 1)])
    ask(database_url, "ALTER SYSTEM SET deadlock_timeout = '50ms'")
    ask(database_url, "SELECT pg_reload_conf()")
    for _ in range(20):
        # The orders are opposite; appends lock rows by number, so that they cannot deadlock.
        heads = {each.number: each.head for each in await log.episodes()}
        one = [*run_of(episode(1), heads[1] + 1, heads[1] + 1), *run_of(episode(2), heads[2] + 1, heads[2] + 1)]
        answers = await asyncio.gather(log.append(one), log.append(one[::-1]), return_exceptions=True)
        assert list(answers) == [{}, {}]
    assert [each.head for each in await log.episodes()] == [21, 21]
    ask(database_url, "ALTER SYSTEM RESET deadlock_timeout")
    ask(database_url, "SELECT pg_reload_conf()")
    await log.close()


async def test_no_event_is_skipped_when_an_earlier_number_is_committed_later(database_url: str) -> None:
    address = DatabaseAddress.parse(database_url)
    log = await EventLog.open(address, create=True)
    projector = Projector(log)
    await projector.open()
    slow = await log.engine.connect()
    transaction = await slow.begin()
    assert (
        await Appending(dialect_of(slow), [started(1)]).write(slow)
    ).refusals == {}  # it has its number, and is not committed
    assert await log.append([started(2)]) == {}
    rolled_back = await asyncpg.connect(database_url)
    await rolled_back.execute("SELECT nextval('pycrorm.episode_number')")  # a number that no event will have
    await rolled_back.close()
    assert await log.append([started(3)]) == {}
    assert await projector.catch_up() == 2
    await transaction.commit()
    await slow.close()
    assert await projector.catch_up() == 1
    rows = ask(database_url, "SELECT number, head, folded FROM episode ORDER BY number")
    assert rows == [(1, 1, 1), (2, 1, 1), (4, 1, 1)]
    assert ask(database_url, "SELECT count(*) FROM memory.process_metadata") == [(3,)]
    await log.close()
