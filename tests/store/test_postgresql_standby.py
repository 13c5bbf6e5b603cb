"""Standbys and restores of PostgreSQL: nothing is acknowledged that they lack, and writers wait."""

from __future__ import annotations

import asyncio
import subprocess
import tempfile
from collections.abc import AsyncIterator, Callable
from contextlib import asynccontextmanager
from pathlib import Path
from urllib.parse import urlsplit

import asyncpg
import pytest

from pycrorm_async import Memory
from pycrorm_async.errors import DatabaseUnavailable
from pycrorm_async.operations.recovery import recover
from pycrorm_async.projections.projector import Projector
from pycrorm_async.projections.verify import verify
from pycrorm_async.store.address import DatabaseAddress
from pycrorm_async.store.dialect import StoredOn
from pycrorm_async.store.log import EventLog
from pycrorm_async.writer.drain import Backoff, Drain
from tests.backups import STANDBY, replicas_in
from tests.crash.step_robot import SETTINGS, StepActionPerformable
from tests.databases import Server, ask
from tests.store.factories import declaration, episode, run_of
from tests.writer.fakes import KeptSource

pytestmark = pytest.mark.slow


# === postgresql standby =======================================================================================
#
# A batch that waits in vain for a synchronous standby is never acknowledged, whatever it holds and however it ends.

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


# === postgresql restore =======================================================================================
#
# During the restore of a backup tables are missing: writers wait, readers get a line, and no log is made.

QUICKLY = Backoff(first_s=0.005, longest_s=0.02)
DROP = "DROP SCHEMA IF EXISTS pycrorm, memory_tables, memory CASCADE"


def run_tool(server: Server, tool: str, *arguments: str) -> None:
    command = [str(server.programs / tool), "--username=postgres", f"--host={server.folder}", *arguments]
    done = subprocess.run(command, check=False, capture_output=True, text=True)
    assert done.returncode == 0, done.stderr


class Backup:
    """A backup of a database by the server's own tools."""

    def __init__(self, server: Server, url: str, file: Path) -> None:
        self._server, self._file = server, file
        self._database = urlsplit(url).path.removeprefix("/")
        run_tool(server, "pg_dump", "--format=custom", f"--file={file}", self._database)

    def restore(self, *sections: str) -> None:
        """Restore all of it, or sections: `pre-data` makes the tables, `data` fills them, `post-data` adds keys."""
        chosen = [f"--section={each}" for each in sections]
        run_tool(self._server, "pg_restore", f"--dbname={self._database}", *chosen, str(self._file))


async def until_refused_again(drain: Drain, *, times: int) -> None:
    """Wait until the drain has met this many more refusals."""
    enough = drain.state.retries + times
    while drain.state.retries < enough:  # noqa: ASYNC110  there is no event for it
        await asyncio.sleep(0.001)


@pytest.mark.soak
async def test_a_writer_waits_while_its_tables_are_dropped_and_restored_step_by_step(
    server: Server, database_url: str, tmp_path: Path
) -> None:
    log = await EventLog.open(DatabaseAddress.parse(database_url), create=True)
    await Projector(log).open()
    first = [declaration(b'{"dtype":"A"}'), *run_of(episode(1), 1, 20, position=2)]
    rest = [declaration(b'{"dtype":"B"}', position=22), *run_of(episode(1), 21, 40, position=23)]
    rest += run_of(episode(2), 1, 10, position=43)
    source = KeptSource(first)
    drain = Drain(source, log.append, settings=SETTINGS, backoff=QUICKLY)
    async with asyncio.timeout(60), asyncio.TaskGroup() as tasks:
        tasks.create_task(drain.run())
        await drain.reached(first[-1].position)
        backup = await asyncio.to_thread(Backup, server, database_url, tmp_path / "backup")
        await asyncio.to_thread(ask, database_url, DROP)
        source.put(rest)
        source.close()
        for sections in ([], ["pre-data"], ["data"]):
            if sections:
                await asyncio.to_thread(backup.restore, *sections)
            await until_refused_again(drain, times=3)
            assert drain.state.unavailable is not None
        await asyncio.to_thread(backup.restore, "post-data")
    assert drain.state.unavailable is None
    assert ask(database_url, "SELECT id FROM pycrorm_log") == [(log.log_id,)]
    heads = ask(
        database_url, "SELECT head, (SELECT count(*) FROM event WHERE episode = number) FROM episode ORDER BY 1"
    )
    assert heads == [(10, 10), (40, 40)]
    assert ask(database_url, "SELECT count(*) FROM pycrorm_declaration") == [(2,)]
    await log.close()


async def test_a_database_whose_keys_are_not_restored_yet_is_unavailable(database_url: str) -> None:
    log = await EventLog.open(DatabaseAddress.parse(database_url), create=True)
    await log.append(run_of(episode(1), 1, 2))
    ask(database_url, "ALTER TABLE pycrorm.episode DROP CONSTRAINT episode_pkey")
    with pytest.raises(DatabaseUnavailable, match="a part of the memory is missing; restore it from a backup"):
        await log.append(run_of(episode(1), 3, 4))
    await log.close()


GONE: dict[str, Callable[[Backup], None]] = {
    "nothing is there": lambda _: None,
    "the tables are there and empty": lambda backup: backup.restore("pre-data"),
}


@pytest.mark.soak_on("nothing is there")
@pytest.mark.parametrize("state", GONE)
async def test_no_log_is_made_in_place_of_the_one_to_which_a_spool_belongs(
    state: str, server: Server, database_url: str, tmp_path: Path
) -> None:
    spool = tmp_path / "spool"
    async with Memory.open(database_url, spool=spool, settings=SETTINGS):
        pass
    backup = Backup(server, database_url, tmp_path / "backup")
    memory = await Memory.open(database_url, spool=spool, writer="daemon", settings=SETTINGS).__aenter__()
    async with memory.episode(description="kept"):
        await StepActionPerformable("a", 1).perform()
    ask(database_url, DROP)
    GONE[state](backup)
    before = ask(database_url, "SELECT count(*) FROM pg_class")
    with pytest.raises(DatabaseUnavailable, match=r"restore|restored"):
        await recover(database_url, spool=spool)
    with pytest.raises(DatabaseUnavailable, match=r"restore|restored"):
        async with Memory.open(database_url, spool=spool, settings=SETTINGS):
            pass
    assert ask(database_url, "SELECT count(*) FROM pg_class") == before
    ask(database_url, DROP)
    backup.restore()
    await recover(database_url, spool=spool)
    await memory.__aexit__(None, None, None)
    assert ask(database_url, "SELECT step FROM step_action") == [(1,)]


@pytest.mark.parametrize("state", GONE)
async def test_a_reader_gets_one_line_while_a_backup_is_restored(
    state: str, server: Server, database_url: str, tmp_path: Path
) -> None:
    log = await EventLog.open(DatabaseAddress.parse(database_url), create=True)
    await Projector(log).open()
    await log.append(run_of(episode(1), 1, 3))
    backup = await asyncio.to_thread(Backup, server, database_url, tmp_path / "backup")
    ask(database_url, DROP)
    GONE[state](backup)
    for asking in (log.episodes, lambda: log.events(1), lambda: verify(log)):
        if state == "nothing is there":
            with pytest.raises(DatabaseUnavailable, match="restore") as caught:
                await asking()
            assert "\n" not in str(caught.value)
    with pytest.raises(DatabaseUnavailable, match=r"holds no memory yet|a restore may be running"):
        await EventLog.open(DatabaseAddress.parse(database_url), create=False)
    await log.close()


# === standby count ============================================================================================
#
# The number of machines that hold a confirmed event, as PostgreSQL reports it with a real standby.


async def stored_on(url: str) -> StoredOn:
    log = await EventLog.open(DatabaseAddress.parse(url), create=False)
    try:
        return await log.stored_on()
    finally:
        await log.close()


@pytest.mark.soak
async def test_a_synchronous_standby_counts_as_a_machine_even_for_a_role_that_may_not_see_its_state() -> None:
    with (
        tempfile.TemporaryDirectory(prefix="pg") as folder,
        replicas_in(Path(folder), synchronous=True) as replicas,
    ):
        url = replicas.url()
        log = await EventLog.open(DatabaseAddress.parse(url), create=True)
        await log.close()
        assert await stored_on(url) == StoredOn(2, (STANDBY,))
        for statement in ("CREATE ROLE guest LOGIN", "GRANT pg_read_all_data TO guest"):
            ask(url, statement)
        as_guest = url.replace("//postgres@", "//guest@")
        assert ask(as_guest, "SELECT sync_state FROM pg_stat_replication") == [(None,)]
        assert await stored_on(as_guest) == StoredOn(2, (STANDBY,))
        replicas.fail_over()
        assert await stored_on(url) == StoredOn(1)
