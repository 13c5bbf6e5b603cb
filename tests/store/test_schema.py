from __future__ import annotations

import asyncio
import sqlite3
import subprocess
import sys
from pathlib import Path

import pytest

from pycrorm_async.clock import Clock
from pycrorm_async.errors import DatabaseForeign, DatabaseUnavailable
from pycrorm_async.store.address import DatabaseAddress
from pycrorm_async.store.dialect import Birth
from pycrorm_async.store.log import EventLog, make_or_migrate, recognise
from pycrorm_async.store.sqlite import SQLite
from tests.databases import ask
from tests.store.concurrent_openers import open_at_once
from tests.store.factories import declaration, episode, run_of

pytestmark = pytest.mark.slow

MIGRATIONS = SQLite().migrations

ALL_OF_IT = "SELECT type, name, sql FROM sqlite_master ORDER BY type, name"


@pytest.fixture
def database_url(tmp_path: Path) -> str:
    """Use SQLite alone: these tests are about files."""
    return f"sqlite:///{tmp_path / 'memory.db'}"


async def test_a_new_log_has_an_id_that_does_not_change(address: DatabaseAddress) -> None:
    clock = Clock(wall_ns=lambda: 1_700_000_000_000_000_007, monotonic_ns=lambda: 1)
    log = await EventLog.open(address, create=True, clock=clock)
    await log.close()
    again = await EventLog.open(address, create=True)
    await again.close()
    reading = await EventLog.open(address, create=False)
    await reading.close()
    assert log.log_id == again.log_id == reading.log_id
    rows = ask(address.path, "SELECT id, format, created_wall_ns FROM pycrorm_log")
    assert rows == [(log.log_id, 1, 1_700_000_000_000_000_007)]
    assert ask(address.path, "PRAGMA journal_mode") == [("wal",)]


async def test_a_log_opened_twice_in_one_process_stays_locked_against_others(address: DatabaseAddress) -> None:
    """Another process would take the log of a live process for an abandoned one and delete it."""
    log = await EventLog.open(address, create=True)
    await log.append(run_of(episode(1), 1, 2))
    await (await EventLog.open(address, create=True)).close()
    program = "import sqlite3; c = sqlite3.connect({!r}); print(*c.execute('SELECT count(*) FROM event')); c.close()"
    subprocess.run([sys.executable, "-c", program.format(str(address.path))], check=True)  # noqa: ASYNC221
    assert address.path.with_name("memory.db-wal").exists()
    await log.append(run_of(episode(1), 3, 4))
    assert ask(address.path, "SELECT count(*) FROM event") == [(4,)]
    await log.close()


async def test_a_link_to_a_missing_file_is_followed(tmp_path: Path) -> None:
    (tmp_path / "link.db").symlink_to("memory.db")
    log = await EventLog.open(DatabaseAddress.parse(f"sqlite:///{tmp_path}/link.db"), create=True)
    await log.close()
    assert ask(tmp_path / "memory.db", "SELECT id FROM pycrorm_log") == [(log.log_id,)]


async def test_two_logs_have_two_ids(tmp_path: Path) -> None:
    ids = set()
    for name in ("a", "b"):
        log = await EventLog.open(DatabaseAddress.parse(f"sqlite:///{tmp_path}/{name}.db"), create=True)
        ids.add(log.log_id)
        await log.close()
    assert len(ids) == 2


@pytest.mark.parametrize("content", [None, b""])
async def test_reading_a_missing_log_names_the_command_that_makes_one_and_makes_nothing(
    address: DatabaseAddress, content: bytes | None
) -> None:
    if content is not None:
        address.path.write_bytes(content)
    with pytest.raises(DatabaseUnavailable, match=r"record one with `pycrorm run` or `pycrorm demo`$"):
        await EventLog.open(address, create=False)
    assert (address.path.read_bytes() if address.path.exists() else None) == content


@pytest.mark.parametrize("create", [True, False])
async def test_a_database_of_another_program_is_refused_unchanged(address: DatabaseAddress, create: bool) -> None:
    theirs = sqlite3.connect(address.path)
    theirs.execute("CREATE TABLE bookmarks (url)")
    theirs.close()
    before = address.path.read_bytes()
    with pytest.raises(DatabaseForeign, match="it has tables but no pycrorm_log"):
        await EventLog.open(address, create=create)
    assert address.path.read_bytes() == before


@pytest.mark.parametrize("create", [True, False])
async def test_a_file_that_is_no_database_is_refused_unchanged(address: DatabaseAddress, create: bool) -> None:
    address.path.write_bytes(b"dear diary, " * 500)
    with pytest.raises(DatabaseForeign, match="is not a database: SQLite"):
        await EventLog.open(address, create=create)
    assert address.path.read_bytes() == b"dear diary, " * 500


@pytest.mark.parametrize("create", [True, False])
async def test_a_log_of_a_newer_version_is_refused(address: DatabaseAddress, create: bool) -> None:
    await (await EventLog.open(address, create=True)).close()
    newer = sqlite3.connect(address.path)
    newer.execute("UPDATE pycrorm_log SET format = 2")
    newer.commit()
    newer.close()
    with pytest.raises(DatabaseForeign, match=r"its format is 2, this version reads 1$"):
        await EventLog.open(address, create=create)


async def test_a_missing_folder_is_named(tmp_path: Path) -> None:
    address = DatabaseAddress.parse(f"sqlite:///{tmp_path}/no/memory.db")
    with pytest.raises(DatabaseUnavailable, match=r"cannot be opened: No such file or directory \(.*/no/memory"):
        await EventLog.open(address, create=True)
    with pytest.raises(DatabaseUnavailable, match="does not exist"):
        await EventLog.open(address, create=False)


async def test_a_folder_in_place_of_the_file_is_unavailable(address: DatabaseAddress) -> None:
    address.path.mkdir()
    for create in (True, False):
        with pytest.raises(DatabaseUnavailable, match="Is a directory"):
            await EventLog.open(address, create=create)


async def test_an_older_log_is_migrated_and_equals_a_new_one(tmp_path: Path) -> None:
    older = DatabaseAddress.parse(f"sqlite:///{tmp_path}/older.db")
    newer = DatabaseAddress.parse(f"sqlite:///{tmp_path}/newer.db")
    log = await EventLog.open(older, create=True)
    await log.append(run_of(episode(1), 1, 3))
    await log.close()
    grown = (*MIGRATIONS, ("ALTER TABLE episode ADD COLUMN robot TEXT", "CREATE INDEX by_robot ON episode (robot)"))
    newer.path.touch()
    ids = []
    for address in (older, newer):
        engine = address.engine()
        birth = Birth("a-new-id", 5)
        ids.append(await make_or_migrate(engine, "name", birth=birth, migrations=grown))
        ids.append(await make_or_migrate(engine, "name", birth=birth, migrations=grown))
        await engine.dispose()
    assert ids == [log.log_id, log.log_id, "a-new-id", "a-new-id"]
    assert ask(older.path, ALL_OF_IT) == ask(newer.path, ALL_OF_IT)
    assert ask(older.path, "SELECT format FROM pycrorm_log") == [(2,)]
    assert ask(older.path, "SELECT count(*) FROM event") == [(3,)]


async def test_a_migration_that_fails_leaves_the_log_as_it_was(address: DatabaseAddress) -> None:
    await (await EventLog.open(address, create=True)).close()
    before = ask(address.path, ALL_OF_IT)
    broken = (*MIGRATIONS, ("ALTER TABLE episode ADD COLUMN robot TEXT", "CREATE TABLE event (a)"))
    engine = address.engine()
    with pytest.raises(Exception, match="table event already exists"):
        await make_or_migrate(engine, "name", birth=Birth("a", 5), migrations=broken)
    await engine.dispose()
    assert ask(address.path, ALL_OF_IT) == before
    assert ask(address.path, "SELECT format FROM pycrorm_log") == [(1,)]


async def test_reading_does_not_migrate_an_older_log(address: DatabaseAddress) -> None:
    await (await EventLog.open(address, create=True)).close()
    engine = address.engine(read_only=True)
    async with engine.connect() as connection:
        with pytest.raises(DatabaseUnavailable, match="`pycrorm writer --once` brings it up to date"):
            await recognise(connection, "name", migrations=(*MIGRATIONS, ("CREATE TABLE t (a)",)))
    await engine.dispose()


def test_many_processes_that_open_a_new_log_concurrently_agree_on_one(tmp_path: Path) -> None:
    ids = open_at_once(f"sqlite:///{tmp_path}/memory.db", 6, tables=False)
    assert ids == [ids[0]] * 6
    assert len(ids[0]) == 36


@pytest.mark.parametrize("hold", ["BEGIN IMMEDIATE", "BEGIN EXCLUSIVE"])
async def test_a_process_that_opens_a_new_log_waits_for_another_that_makes_it(
    address: DatabaseAddress, hold: str
) -> None:
    address.path.touch()
    other = sqlite3.connect(address.path, isolation_level=None)
    other.execute(hold)
    opening = asyncio.create_task(EventLog.open(address, create=True))
    await asyncio.sleep(0.3)
    assert not opening.done()
    other.execute("COMMIT")
    other.close()
    await (await opening).close()
    assert ask(address.path, "PRAGMA journal_mode") == [("wal",)]


@pytest.mark.parametrize("rounds", [20, pytest.param(200, marks=pytest.mark.soak)])
async def test_four_tasks_that_make_a_log_concurrently_make_one(tmp_path: Path, rounds: int) -> None:
    for number in range(rounds):
        address = DatabaseAddress.parse(f"sqlite:///{tmp_path}/{number}.db")
        logs = await asyncio.gather(*(EventLog.open(address, create=True) for _ in range(4)))
        for each in logs:
            await each.close()
        assert ask(address.path, "SELECT id FROM pycrorm_log") == [(logs[0].log_id,)]
        assert {each.log_id for each in logs} == {logs[0].log_id}


@pytest.mark.parametrize(
    "statement",
    [
        "UPDATE event SET payload = '{}'",
        "DELETE FROM event",
        "DELETE FROM event WHERE sequence = 2",
        "UPDATE pycrorm_declaration SET payload = '{}'",
        "DELETE FROM pycrorm_declaration",
        "UPDATE episode SET number = 9",
        "UPDATE episode SET id = 'x'",
        "DELETE FROM episode",
        "UPDATE pycrorm_log SET id = 'x'",
        "DELETE FROM pycrorm_log",
    ],
)
async def test_the_database_refuses_to_change_or_delete_an_event(log: EventLog, statement: str) -> None:
    await log.append([declaration(b'{"dtype":"A"}'), *run_of(episode(1), 1, 3)])
    with pytest.raises(sqlite3.IntegrityError, match="the event log is append-only"):
        ask(log.address.path, statement)
