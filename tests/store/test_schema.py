"""A log is created, recognised, migrated and protected in the same way on both databases, and never twice."""

from __future__ import annotations

import asyncio
import sqlite3
import subprocess
import sys
from pathlib import Path
from typing import Any

import pytest

from pycrorm_async.clock import Clock
from pycrorm_async.errors import DatabaseForeign, DatabaseUnavailable
from pycrorm_async.store.address import DatabaseAddress
from pycrorm_async.store.dialects import dialect_of
from pycrorm_async.store.log import EventLog
from pycrorm_async.store.schema import DIGEST, FORMAT_1
from tests.databases import Server, ask, ask_to_change, change_each
from tests.store.concurrent_openers import open_at_once
from tests.store.factories import declaration, episode, run_of

ALL_OF_SQLITE = "SELECT type, name, sql FROM sqlite_master ORDER BY type, name"
ALL_OF_POSTGRESQL = """
SELECT relkind::text AS kind, relname::text AS name, reloptions::text AS meaning FROM pg_class
WHERE relnamespace = 'pycrorm'::regnamespace
UNION ALL SELECT 'column', attrelid::regclass || '.' || attname,
concat_ws(' ', format_type(atttypid, atttypmod), attnotnull, attidentity, pg_get_expr(adbin, adrelid))
FROM pg_attribute JOIN pg_class ON pg_class.oid = attrelid LEFT JOIN pg_attrdef ON (adrelid, adnum) = (attrelid, attnum)
WHERE relnamespace = 'pycrorm'::regnamespace AND attnum > 0
UNION ALL SELECT 'index', indexname, indexdef FROM pg_indexes WHERE schemaname = 'pycrorm'
UNION ALL SELECT 'constraint', conname, pg_get_constraintdef(oid) FROM pg_constraint
WHERE connamespace = 'pycrorm'::regnamespace
UNION ALL SELECT 'trigger', tgname, pg_get_triggerdef(pg_trigger.oid) FROM pg_trigger
JOIN pg_class ON pg_class.oid = tgrelid WHERE relnamespace = 'pycrorm'::regnamespace AND NOT tgisinternal
UNION ALL SELECT 'function', proname, pg_get_functiondef(oid) FROM pg_proc WHERE pronamespace = 'pycrorm'::regnamespace
ORDER BY kind, name"""


def catalogue_of(url: str) -> list[Any]:
    """Return all that the database holds of a log but its rows."""
    return ask(url, ALL_OF_POSTGRESQL if url.startswith("postgresql") else ALL_OF_SQLITE)


async def opened(address: DatabaseAddress, *, create: bool = True) -> EventLog:
    log = await EventLog.open(address, create=create)
    await log.close()
    return log


# --- both databases -----------------------------------------------------------------------------------------------


async def test_a_new_log_has_an_id_that_does_not_change(address: DatabaseAddress, database_url: str) -> None:
    with pytest.raises(DatabaseUnavailable, match=r"record one with `pycrorm run` or `pycrorm demo`$"):
        await opened(address, create=False)
    clock = Clock(wall_ns=lambda: 1_700_000_000_000_000_007, monotonic_ns=lambda: 1)
    log = await EventLog.open(address, create=True, clock=clock)
    await log.close()
    assert (await opened(address)).log_id == (await opened(address, create=False)).log_id == log.log_id
    rows = ask(database_url, "SELECT id, format, created_wall_ns FROM pycrorm_log")
    assert rows == [(log.log_id, 1, 1_700_000_000_000_000_007)]


async def test_an_older_log_is_migrated_and_equals_a_new_one(
    address: DatabaseAddress, database_url: str, request: pytest.FixtureRequest, monkeypatch: pytest.MonkeyPatch
) -> None:
    log = await EventLog.open(address, create=True)
    await log.append(run_of(episode(1), 1, 3))
    await log.close()
    place = "" if address.is_sqlite else "pycrorm."
    if address.is_sqlite:
        new = f"sqlite:///{address.path.with_name('new.db')}"
    else:
        server: Server = request.getfixturevalue("server")
        new = server.new_database()
    dialect = dialect_of(log.engine)
    second = (f"ALTER TABLE {place}episode ADD COLUMN robot text", f"CREATE INDEX by_robot ON {place}episode (robot)")
    monkeypatch.setattr(dialect, "migrations", (*dialect.migrations, second))
    with pytest.raises(DatabaseUnavailable, match="`pycrorm writer --once` brings it up to date"):
        await opened(address, create=False)
    for _ in range(2):
        assert (await opened(address)).log_id == log.log_id
    await opened(DatabaseAddress.parse(new))
    catalogue = catalogue_of(database_url)
    assert catalogue == catalogue_of(new)
    assert {"by_robot", "episode_behind", "episode_stopped", "event"} < {name for _, name, _ in catalogue}
    assert ask(database_url, "SELECT format FROM pycrorm_log") == [(2,)]
    assert ask(database_url, "SELECT count(*) FROM event") == [(3,)]


async def test_a_migration_that_fails_leaves_the_log_as_it_was(
    address: DatabaseAddress, database_url: str, monkeypatch: pytest.MonkeyPatch
) -> None:
    dialect = dialect_of((await opened(address)).engine)
    before = catalogue_of(database_url)
    place = "" if address.is_sqlite else "pycrorm."
    broken = (f"CREATE TABLE {place}robot (id int)", f"CREATE TABLE {place}event (a int)")
    with monkeypatch.context() as patch:
        patch.setattr(dialect, "migrations", (*dialect.migrations, broken))
        with pytest.raises(Exception, match=r'"?event"? already exists'):
            await opened(address)
    assert catalogue_of(database_url) == before
    assert ask(database_url, "SELECT format FROM pycrorm_log") == [(1,)]


FORMER = "number BETWEEN 1 AND 4194303"
FORMER_NUMBERS = {
    True: (
        "PRAGMA writable_schema = ON",
        f"UPDATE sqlite_master SET sql = replace(sql, 'number BETWEEN 1 AND 2147483647', '{FORMER}')",
        "CREATE VIEW changed AS SELECT 1",
        "DROP VIEW changed",
    ),
    False: (
        "ALTER TABLE pycrorm.episode DROP CONSTRAINT episode_number_check",
        f"ALTER TABLE pycrorm.episode ADD CONSTRAINT episode_number_check CHECK ({FORMER})",
    ),
}
"""The statements that give a log the numbers of version 0.1.0, on SQLite and on PostgreSQL."""


async def test_a_log_of_version_0_1_0_is_read_as_it_is_and_gets_all_numbers_when_its_owner_writes(
    address: DatabaseAddress, database_url: str
) -> None:
    log = await EventLog.open(address, create=True)
    await log.append(run_of(episode(1), 1, 3))
    catalogue = catalogue_of(database_url)
    change_each(database_url, FORMER_NUMBERS[address.is_sqlite])
    assert catalogue_of(database_url) != catalogue
    await log.close()
    assert (await opened(address, create=False)).log_id == log.log_id
    assert catalogue_of(database_url) != catalogue
    await opened(address)
    assert catalogue_of(database_url) == catalogue


async def test_a_log_of_a_newer_version_is_refused(address: DatabaseAddress, database_url: str) -> None:
    await opened(address)
    ask_to_change(database_url, "UPDATE pycrorm_log SET format = 2")
    for create in (True, False):
        with pytest.raises(DatabaseForeign, match=r"its format is 2, this version reads 1$"):
            await opened(address, create=create)


CHANGES = """
UPDATE event SET payload = '{}'
DELETE FROM event WHERE sequence = 2
UPDATE pycrorm_declaration SET payload = '{}'
DELETE FROM pycrorm_declaration
UPDATE episode SET number = 9
UPDATE episode SET id = 'x'
DELETE FROM episode
UPDATE pycrorm_log SET id = 'x'
DELETE FROM pycrorm_log
UPDATE pycrorm_digest SET digest = ''
DELETE FROM pycrorm_digest
"""
OF_THE_SERVER = """
TRUNCATE event
TRUNCATE pycrorm_declaration
TRUNCATE episode
TRUNCATE pycrorm_log
TRUNCATE pycrorm_digest
INSERT INTO event SELECT * FROM event ON CONFLICT (episode, sequence) DO UPDATE SET payload = 'x'
MERGE INTO event USING event AS other ON event.sequence = other.sequence WHEN MATCHED THEN DELETE
"""


async def test_the_database_refuses_even_its_owner_to_change_or_delete_an_event(
    log: EventLog, database_url: str
) -> None:
    await log.append([declaration(b'{"dtype":"A"}'), *run_of(episode(1), 1, 256)])
    before = [ask(database_url, f"SELECT * FROM {table.name}") for table in (*FORMAT_1, DIGEST)]
    statements = CHANGES if log.address.is_sqlite else CHANGES + OF_THE_SERVER
    for statement in filter(None, statements.split("\n")):
        with pytest.raises(Exception, match="the event log is append-only"):
            ask_to_change(database_url, statement)
        assert [ask(database_url, f"SELECT * FROM {table.name}") for table in (*FORMAT_1, DIGEST)] == before


@pytest.mark.slow
def test_many_processes_that_open_a_new_log_at_once_agree_on_one(database_url: str) -> None:
    tables = database_url.startswith("postgresql")
    ids = set(open_at_once(database_url, 6, tables=tables))
    assert ask(database_url, "SELECT id FROM pycrorm_log") == [(each,) for each in ids]
    if tables:
        notes = ask(database_url, "SELECT projection FROM memory_tables.pycrorm_generation ORDER BY projection")
        assert [name for (name,) in notes if name != "projection/recall"] == ["tables"]


# --- files --------------------------------------------------------------------------------------------------------


@pytest.mark.slow
async def test_a_log_opened_twice_in_one_process_stays_locked_against_others(file_address: DatabaseAddress) -> None:
    """Another process would take the log of a live process for an abandoned one and delete it."""
    log = await EventLog.open(file_address, create=True)
    await log.append(run_of(episode(1), 1, 2))
    await opened(file_address)
    program = "import sqlite3; c = sqlite3.connect({!r}); print(*c.execute('SELECT count(*) FROM event')); c.close()"
    subprocess.run([sys.executable, "-c", program.format(str(file_address.path))], check=True)  # noqa: ASYNC221
    assert file_address.path.with_name("memory.db-wal").exists()
    await log.append(run_of(episode(1), 3, 4))
    assert ask(file_address.path, "SELECT count(*) FROM event") == [(4,)]
    await log.close()


async def test_a_link_to_a_missing_file_is_followed(tmp_path: Path) -> None:
    (tmp_path / "link.db").symlink_to("memory.db")
    log = await opened(DatabaseAddress.parse(f"sqlite:///{tmp_path}/link.db"))
    assert ask(tmp_path / "memory.db", "SELECT id FROM pycrorm_log") == [(log.log_id,)]


@pytest.mark.parametrize("create", [True, False])
async def test_a_file_of_another_program_is_refused_unchanged(file_address: DatabaseAddress, create: bool) -> None:
    ask_to_change(file_address.path, "CREATE TABLE bookmarks (url)")
    for reason in ("it has tables but no pycrorm_log", "is not a database: SQLite"):
        before = file_address.path.read_bytes()
        with pytest.raises(DatabaseForeign, match=reason):
            await opened(file_address, create=create)
        assert file_address.path.read_bytes() == before
        file_address.path.write_bytes(b"dear diary, " * 500)


async def test_reading_an_empty_file_makes_nothing(file_address: DatabaseAddress) -> None:
    file_address.path.touch()
    with pytest.raises(DatabaseUnavailable, match=r"record one with `pycrorm run` or `pycrorm demo`$"):
        await opened(file_address, create=False)
    assert file_address.path.read_bytes() == b""


async def test_a_missing_folder_and_a_folder_in_place_of_the_file_are_named(tmp_path: Path) -> None:
    (tmp_path / "folder.db").mkdir()
    for name, create, reason in (
        ("no/memory.db", True, r"cannot be opened: No such file or directory \(.*/no/memory"),
        ("no/memory.db", False, "does not exist"),
        ("folder.db", True, "Is a directory"),
        ("folder.db", False, "Is a directory"),
    ):
        with pytest.raises(DatabaseUnavailable, match=reason):
            await opened(DatabaseAddress.parse(f"sqlite:///{tmp_path}/{name}"), create=create)


@pytest.mark.parametrize("hold", ["BEGIN IMMEDIATE", "BEGIN EXCLUSIVE"])
async def test_a_process_that_opens_a_new_log_waits_for_another_that_makes_it(
    file_address: DatabaseAddress, hold: str
) -> None:
    file_address.path.touch()
    other = sqlite3.connect(file_address.path, isolation_level=None)
    other.execute(hold)
    opening = asyncio.create_task(opened(file_address))
    await asyncio.sleep(0.3)
    assert not opening.done()
    other.execute("COMMIT")
    other.close()
    await opening
    assert ask(file_address.path, "PRAGMA journal_mode") == [("wal",)]
