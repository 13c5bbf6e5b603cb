"""A memory behind pgbouncer: whole in session mode, refused in transaction mode."""

from __future__ import annotations

import asyncio
from collections.abc import Iterator
from contextlib import nullcontext
from pathlib import Path

import pytest

from pycrorm_async import Memory
from pycrorm_async.errors import DatabaseUnavailable
from pycrorm_async.operations.rebuild import rebuild_memory
from pycrorm_async.projections.fold_group import FoldGroup
from pycrorm_async.projections.verify import verify
from pycrorm_async.query.reading import Reading
from pycrorm_async.store.address import DatabaseAddress
from pycrorm_async.store.dialects import dialect_of
from pycrorm_async.store.log import EventLog
from tests import pooler
from tests.crash.step_robot import SETTINGS, StepActionPerformable
from tests.databases import Server, ask

pytestmark = [
    pytest.mark.slow,
    pytest.mark.skipif(pooler.program() is None, reason="no pgbouncer is installed (Debian's package pgbouncer)"),
]


@pytest.fixture
def database_url(server: Server) -> Iterator[str]:
    url = server.new_memory()
    yield url
    server.drop_soon(url)


async def test_a_memory_is_recorded_folded_read_and_rebuilt_through_a_pooler_of_sessions(
    server: Server, database_url: str, tmp_path: Path
) -> None:
    with pooler.pooler_of(server, database_url, "session") as url:
        async with Memory.open(url, spool=tmp_path / "spool", settings=SETTINGS) as memory:
            async with memory.episode(description="first"):
                await StepActionPerformable("a", 1).perform()
            await memory.flush()
            async with memory.episode(description="second"):
                await StepActionPerformable("a", 2).perform()
        await rebuild_memory(url)
        async with Reading.open(url) as reading:
            assert len(await reading.episodes()) == 2
            assert (await reading.as_of("last", sequence=2)).status == "RUNNING"
        logs = [await EventLog.open(DatabaseAddress.parse(url), create=True) for _ in range(2)]
        verified = await verify(logs[0])
        assert (verified.damage, verified.drift, verified.behind) == (0, 0, 0)
        groups = [FoldGroup(each) for each in logs]
        assert [(await each.share()).many for each in groups] == [1, 2]
        await groups[0].leave()
        while (await groups[1].share()).many == 2:  # noqa: ASYNC110  until the session's lock is free, and it looks again
            await asyncio.sleep(0.1)
        for group, log in zip(groups, logs, strict=True):
            await group.leave()
            await log.close()
    assert ask(database_url, "SELECT step FROM step_action ORDER BY id") == [(1,), (2,)]


OF_A_SESSION = """
SELECT name, setting FROM pg_settings WHERE name IN ('search_path', 'synchronous_commit', 'lock_timeout', 'TimeZone',
'idle_in_transaction_session_timeout', 'default_transaction_read_only', 'application_name')"""


@pytest.mark.parametrize("is_pooled", [True, False])
async def test_a_session_has_its_own_settings_also_after_a_table_grew(
    server: Server, database_url: str, is_pooled: bool
) -> None:
    ask(database_url, "CREATE TABLE memory_tables.grown (id bigint)")
    with pooler.pooler_of(server, database_url, "session") if is_pooled else nullcontext(database_url) as url:
        for read_only in (True, False):
            engine = DatabaseAddress.parse(url).engine(read_only=read_only, busy_timeout_s=7)
            async with engine.begin() as connection:
                if not read_only:
                    await dialect_of(connection).add_column(connection, "grown", "more bigint")
                settings = dict(map(tuple, await connection.exec_driver_sql(OF_A_SESSION)))
            await engine.dispose()
            assert settings == {
                "search_path": "memory_tables, memory, pycrorm",
                "synchronous_commit": "on",
                "lock_timeout": "7000",
                "TimeZone": "UTC",
                "idle_in_transaction_session_timeout": "60000",
                "default_transaction_read_only": "on" if read_only else "off",
                "application_name": "pycrorm",
            }


async def test_a_pooler_of_transactions_is_refused_with_what_to_do(
    server: Server, database_url: str, tmp_path: Path
) -> None:
    with pooler.pooler_of(server, database_url, "transaction") as url:
        for _ in range(2):
            with pytest.raises(DatabaseUnavailable, match="pool_mode = session and server_reset_query = DISCARD ALL"):
                async with Memory.open(url, spool=tmp_path / "spool", settings=SETTINGS) as memory:
                    await memory.reading.episodes()


async def test_a_session_that_exchanges_prepared_statements_is_refused_with_what_to_do(database_url: str) -> None:
    log = await EventLog.open(DatabaseAddress.parse(database_url), create=True)
    with pytest.raises(DatabaseUnavailable, match="pool_mode = session"), log.translated():
        async with log.reading() as connection:
            await log.episodes()
            await connection.exec_driver_sql("EXECUTE prepared_by_another_client")
    await log.close()
