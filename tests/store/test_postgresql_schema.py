"""The log on PostgreSQL: made once by many openers, append-only for every login, with separate rights for each role."""

from __future__ import annotations

import asyncio
from urllib.parse import urlsplit

import asyncpg
import pytest

from pycrorm_async.errors import DatabaseUnavailable, TablesWithheld
from pycrorm_async.events.codec import Record
from pycrorm_async.projections.projector import Projector
from pycrorm_async.query.reading import Reading
from pycrorm_async.store.address import DatabaseAddress
from pycrorm_async.store.append import Appending
from pycrorm_async.store.dialects import dialect_of
from pycrorm_async.store.log import EventLog
from pycrorm_async.store.postgresql import GRANTS
from tests.databases import Server, ask, change_each
from tests.store.factories import declaration, episode, record, run_of

pytestmark = pytest.mark.slow

TABLES = (
    "SELECT relname FROM pg_class WHERE relnamespace = 'pycrorm'::regnamespace AND relkind IN ('r', 'S') ORDER BY 1"
)
COUNTS = "SELECT count(*) FROM pycrorm.event"


@pytest.fixture
def database_url(server: Server) -> str:
    """Use PostgreSQL alone: these tests are about its schema."""
    return server.new_database()


# --- roles ------------------------------------------------------------------------------------------------------


def started(number: int) -> Record:
    payload = b'{"description":"Tutorial","created_by":"ada","host":"lab","software":"0.1.0","python":"3.11.7"}'
    return record(episode(number), 1, kind="EpisodeStarted", payload=payload)


@pytest.fixture
async def roles(server: Server, database_url: str) -> dict[str, str]:
    """Return the URL of a member of each role, in a memory to which the documented rights were granted twice."""
    database = urlsplit(database_url).path.removeprefix("/")
    log = await EventLog.open(DatabaseAddress.parse(database_url), create=True)
    await Projector(log).open()
    await log.append([started(1)])
    await log.close()
    changes = [*GRANTS, *GRANTS]
    urls = {}
    for role in ("recorder", "folder", "reader"):
        member = f"{role}_of_{database}"
        changes += [
            f"CREATE ROLE {member} LOGIN IN ROLE pycrorm_{role}",
            f"ALTER ROLE {member} IN DATABASE {database} SET role = 'pycrorm_{role}'",
        ]
        urls[role] = server.url(database, user=member)
    change_each(database_url, changes)
    return urls


CANNOT = "permission denied"


async def test_a_recorder_appends_and_cannot_fold(roles: dict[str, str], database_url: str) -> None:
    log = await EventLog.open(DatabaseAddress.parse(roles["recorder"]), create=True)
    new = [declaration(b'{"dtype":"A"}'), *run_of(episode(2), 1, 5)]
    assert await log.append(new) == {}
    assert await log.append([*new, *run_of(episode(2), 6, 7)]) == {}
    assert ask(database_url, "SELECT number, head FROM episode ORDER BY 1") == [(1, 1), (2, 7)]
    with pytest.raises(TablesWithheld, match="may not change the tables: fold with `pycrorm writer`"):
        await Projector(log).open()
    await log.close()
    for statement in ("UPDATE pycrorm.episode SET folded = 1", "CREATE TABLE pycrorm.mine (a int)"):
        with pytest.raises(asyncpg.InsufficientPrivilegeError):
            ask(roles["recorder"], statement)


async def test_a_folder_appends_and_folds_also_tables_that_another_folder_made(
    roles: dict[str, str], database_url: str
) -> None:
    address = DatabaseAddress.parse(roles["folder"])
    log = await EventLog.open(address, create=True)
    projector = Projector(log)
    await projector.open()
    assert await log.append([started(2)]) == {}
    assert await projector.catch_up() == 2
    await log.close()
    assert ask(database_url, "SELECT count(*) FROM memory.process_metadata") == [(2,)]
    assert ask(database_url, "SELECT number, folded FROM episode ORDER BY 1") == [(1, 1), (2, 1)]
    for statement in ("DROP TRIGGER event_is_not_changed ON pycrorm.event", "DROP TABLE pycrorm.event"):
        with pytest.raises(asyncpg.InsufficientPrivilegeError):
            ask(roles["folder"], statement)


async def test_a_reader_reads_log_tables_and_views_including_later_ones_and_writes_nothing(
    roles: dict[str, str], database_url: str
) -> None:
    ask(roles["folder"], "CREATE TABLE memory.later (id int)")
    ask(roles["folder"], "CREATE VIEW memory.later_still AS SELECT * FROM memory.later")
    assert ask(roles["reader"], "SELECT count(*) FROM later") == [(0,)]
    assert ask(roles["reader"], "SELECT count(*) FROM later_still") == [(0,)]
    ask(roles["folder"], "DROP VIEW memory.later_still")
    ask(roles["folder"], "DROP TABLE memory.later")
    log = await EventLog.open(DatabaseAddress.parse(roles["reader"]), create=False)
    assert [each.sequence for each in await log.events(1)] == [1]
    await log.close()
    async with Reading.open(roles["reader"]) as reading:
        await reading.episodes()
    log = await EventLog.open(DatabaseAddress.parse(roles["reader"]), create=True)
    with pytest.raises(DatabaseUnavailable, match=CANNOT):
        await log.append(run_of(episode(3), 1, 1))
    await log.close()


async def test_no_role_can_change_or_delete_an_event(roles: dict[str, str], database_url: str) -> None:
    for statement in (
        "UPDATE pycrorm.event SET payload = '{}'",
        "DELETE FROM pycrorm.event",
        "TRUNCATE pycrorm.event",
        "DELETE FROM pycrorm.episode",
        "UPDATE pycrorm.episode SET id = 'x'",
        "DELETE FROM pycrorm.pycrorm_declaration",
        "UPDATE pycrorm.pycrorm_log SET id = 'x'",
        "ALTER TABLE pycrorm.event DISABLE TRIGGER ALL",
        "SET session_replication_role = replica",
        "DROP SCHEMA pycrorm CASCADE",
    ):
        with pytest.raises(asyncpg.PostgresError, match=r"permission denied|must be owner|append-only"):
            ask(roles["folder"], statement)  # the others have no right that it has not (`test_postgresql_rights`)
    assert ask(database_url, COUNTS) == [(1,)]


# --- concurrency ------------------------------------------------------------------------------------------------------


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


@pytest.mark.soak
async def test_sixteen_concurrent_appends_of_different_episodes_lose_nothing_and_share_no_number(
    database_url: str,
) -> None:
    address = DatabaseAddress.parse(database_url)

    async def robot(number: int) -> None:
        log = await EventLog.open(address, create=True, busy_timeout_s=30.0)
        try:
            for round_ in range(5):
                mine = 100 * number + round_
                await log.append([declaration(b'{"dtype":"%d"}' % (mine % 7)), *run_of(episode(mine), 1, 50)])
                await log.append([*run_of(episode(mine), 51, 80), *run_of(episode(mine + 50), 1, 3)])
        finally:
            await log.close()

    async with asyncio.TaskGroup() as robots:
        for number in range(1, 17):
            robots.create_task(robot(number))
    rows = ask(database_url, "SELECT id, number, head FROM episode")
    assert len(rows) == 16 * 10
    assert len({number for _, number, _ in rows}) == 160
    assert sorted(head for *_, head in rows) == [3] * 80 + [80] * 80
    counted = ask(database_url, "SELECT episode, count(*), min(sequence), max(sequence) FROM event GROUP BY 1")
    assert {(number, head, 1, head) for _, number, head in rows} == set(counted)
    assert ask(database_url, "SELECT count(*) FROM pycrorm_declaration") == [(7,)]


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
