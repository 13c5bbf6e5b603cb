"""An erased episode is gone from every table and file, whatever stopped the erasure, and nothing brings it back."""

from __future__ import annotations

import asyncio
from hashlib import sha256
from pathlib import Path

import pytest

from pycrorm_async import Blob, Memory, Reading
from pycrorm_async.errors import CallerError, UnknownEpisode
from pycrorm_async.events.codec import Record
from pycrorm_async.events.ids import parse_episode_id
from pycrorm_async.operations.copy import copy_episodes
from pycrorm_async.operations.rebuild import rebuild_memory
from pycrorm_async.operations.recovery import recover
from pycrorm_async.operations.removal import ErasedEpisode, erasable, erase
from pycrorm_async.projections.custom import own_projections
from pycrorm_async.projections.verify import verify
from pycrorm_async.settings import Settings
from pycrorm_async.store.address import DatabaseAddress
from pycrorm_async.store.log import EventLog
from pycrorm_async.store.postgresql import GRANTS
from tests.commands import pycrorm
from tests.crash.forked_processes import ForkedProcess, die_at_statement
from tests.databases import Server, ask, ask_to_change, change_each
from tests.golden.unpacking import unpack_memory
from tests.golden.zoo import ZOO
from tests.memory.note_actions import NoteActionPerformable
from tests.table_comparison import Tables, differences, logs_of, tables_of

pytestmark = pytest.mark.slow

SECRET = "Rosamunde-4711-Quittengelee"
PATIENT = Settings(connect_timeout_s=120, flush_timeout_s=300)


async def recorded(url: str, *texts: str) -> list[str]:
    """Record an episode for each text, which it notes and describes, with an image of it; return their ids."""
    ids = []
    async with Memory.open(url, settings=PATIENT) as memory:
        for each in texts:
            async with memory.episode(description=each, tags=(each[:6],)) as episode:
                await NoteActionPerformable(each).perform()
                memory.observe("page", {"image": Blob(each.encode() * 10, "text/plain")})
            ids.append(str(episode))
        await memory.flush()
    return ids


async def erased(
    url: str, *names: str, spool: Path | None = None, reason: str = "asked to", lake: str | None = None
) -> list[ErasedEpisode]:
    address = DatabaseAddress.parse(url)
    async with await EventLog.open(address, create=True) as log:
        rows = await erasable(log, names)
        return await erase(log, rows, reason=reason, spool=spool or address.default_spool, lake=lake)


async def assert_clean(url: str) -> None:
    async with await EventLog.open(DatabaseAddress.parse(url), create=False) as log:
        result = await verify(log, projections=own_projections())
    found = [*map(str, result.damages), *map(str, result.differences), *result.not_compared, *map(str, result.stopped)]
    assert found == []


def places_with(secret: str, url: str) -> list[str]:
    """Return the files of the memory and of its spool, and the tables of a server, that contain this text."""
    address = DatabaseAddress.parse(url)
    files = [each for each in address.default_spool.rglob("*") if each.is_file()]
    found = []
    if address.is_sqlite:
        files += address.path.parent.glob(f"{address.path.name}*")
    else:
        for schema in ("pycrorm", "memory_tables"):
            names = ask(
                url,
                f"SELECT relname::text FROM pg_class WHERE relnamespace = '{schema}'::regnamespace AND relkind = 'r'",
            )
            for (name,) in names:
                rows = ask(
                    url,
                    f"SELECT count(*) FROM {schema}.\"{name}\" AS r WHERE r::text LIKE '%{secret}%'"
                    f" OR r::text LIKE '%{secret.encode().hex()}%'",
                )
                found += [name] if rows != [(0,)] else []
    return found + [str(each) for each in files if each.is_file() and secret.encode() in each.read_bytes()]


def without(tables: Tables, episode: str) -> Tables:
    kept = {name: {key: row for key, row in rows.items() if episode not in str(key)} for name, rows in tables.items()}
    return {name: rows for name, rows in kept.items() if rows}


@pytest.fixture
def in_folder(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> Path:
    monkeypatch.chdir(tmp_path)  # the default spool of a server is in the working directory
    return tmp_path


async def test_an_erased_episode_is_in_no_table_and_no_file_and_the_others_are_as_before(
    database_url: str, in_folder: Path
) -> None:
    ids = await recorded(database_url, "first", SECRET, "third")
    assert len(places_with(SECRET, database_url)) >= 2  # the database, and a segment that the spool keeps
    before, blobs = tables_of(database_url), dict(ask(database_url, "SELECT hash, size FROM pycrorm_blob"))
    [done] = await erased(database_url, "2")
    assert done.left == ()
    assert (done.removed.id, done.removed.number, done.removed.reason) == (ids[1], 2, "asked to")
    assert places_with(SECRET, database_url) == []
    assert blobs.keys() - dict(ask(database_url, "SELECT hash, size FROM pycrorm_blob")).keys() == {
        sha256(SECRET.encode() * 10).hexdigest()
    }
    assert differences(without(before, ids[1]), tables_of(database_url)) == []
    await assert_clean(database_url)
    await rebuild_memory(database_url)
    assert differences(without(before, ids[1]), tables_of(database_url)) == []
    async with Reading.open(database_url) as reading:
        with pytest.raises(UnknownEpisode, match=rf"episode 2 \({ids[1]}\) was erased on .* \(asked to\)"):
            await reading.episode("2")
        with pytest.raises(UnknownEpisode, match="was erased on"):
            await reading.tree(ids[1])
    await recorded(database_url, "fourth")
    assert [number for (number,) in ask(database_url, "SELECT number FROM episode ORDER BY number")] == [1, 3, 4]


@pytest.mark.parametrize("member", ["fold_1", "fold_4_cases", "fold_9_cases_2"])
async def test_an_episode_is_erased_from_tables_and_cases_of_an_earlier_version(member: str, tmp_path: Path) -> None:
    url = unpack_memory(ZOO / f"{member}.tar.gz", tmp_path)
    await erased(url, "1")
    assert places_with("poured", url) == []
    assert ask(url, "SELECT number, reason FROM pycrorm_removed_episode") == [(1, "asked to")]


async def test_what_arrives_of_an_erased_episode_is_discarded_and_its_number_is_not_given_again(
    database_url: str, in_folder: Path, caplog: pytest.LogCaptureFixture
) -> None:
    [_, identity] = await recorded(database_url, "first", SECRET)
    copy = f"sqlite:///{in_folder}/copy.db"
    await copy_episodes(database_url, copy)
    events = logs_of(database_url)[identity]
    await erased(database_url, "2")
    async with await EventLog.open(DatabaseAddress.parse(database_url), create=True) as log:
        [row] = [each for each in await log.all_removed() if each.id == identity]
        episode = parse_episode_id(identity)
        records = [
            Record(0, episode, sequence, kind, version, wall_ns, monotonic_ns, payload.encode())
            for sequence, kind, version, wall_ns, monotonic_ns, payload in events
        ]
        assert await log.append(records) == {}  # not refused, so that no spool offers them again
        assert log.discarded == {identity: row.head}
        assert f"events that arrive of it are discarded: {row}" in caplog.text
    summary = await copy_episodes(copy, database_url)
    assert [(each.copied, "was erased" in (each.stopped or "")) for each in summary.episodes] == [(0, False), (0, True)]
    assert places_with(SECRET, database_url) == []
    await recorded(database_url, "third")  # which does not get the number of the erased one
    assert [number for (number,) in ask(database_url, "SELECT number FROM episode ORDER BY number")] == [1, 3]
    await assert_clean(database_url)


async def test_a_running_episode_is_not_erased_and_the_log_still_refuses_deletions(
    database_url: str, in_folder: Path
) -> None:
    async with Memory.open(database_url, settings=PATIENT) as memory, memory.episode(description="first"):
        await NoteActionPerformable("a").perform()
        await memory.flush()
        with pytest.raises(CallerError, match="episode 1 still runs"):
            await erased(database_url, "1")
    await recorded(database_url, "second")
    await erased(database_url, "1")
    for table in ("event", "episode", "pycrorm_digest"):
        with pytest.raises(Exception, match=f"append-only: {table} refuses DELETE"):
            ask_to_change(database_url, f"DELETE FROM {'pycrorm.' * ('postgresql' in database_url)}{table}")
    await assert_clean(database_url)


async def test_a_memory_that_is_open_goes_on_and_what_its_recorder_still_holds_is_named(
    database_url: str, in_folder: Path, caplog: pytest.LogCaptureFixture
) -> None:
    async with Memory.open(database_url, settings=PATIENT) as memory:
        async with memory.episode(description=SECRET):
            await NoteActionPerformable(SECRET).perform()
        await memory.flush()
        [done] = await erased(database_url, "1")
        assert [each.partition(".segment: ")[2] for each in done.left] == [
            "run `pycrorm writer --once` if its process has ended"
        ]
        async with memory.episode(description="second"):
            await NoteActionPerformable("b").perform()
        await memory.flush()
    assert "went back" not in caplog.text
    [done] = await erased(database_url, "1")
    assert done.left == ()
    assert done.removed.finished_wall_ns is None  # as it was before this call
    assert places_with(SECRET, database_url) == []
    assert ask(database_url, "SELECT number, finished_wall_ns IS NULL FROM pycrorm_removed_episode") == [(1, False)]
    await assert_clean(database_url)
    assert (await recover(database_url)).drained.stopped == {}


def erase_until(url: str, name: str, last: int) -> None:
    """Erase an episode, and die before statement number `last`; with 0 erase to the end and print their count."""
    print_count = die_at_statement(last)
    asyncio.run(erased(url, name))
    print_count()


@pytest.mark.soak_on("postgresql")
async def test_an_erasure_that_is_killed_at_any_step_is_finished_by_the_next(
    database_url: str, in_folder: Path
) -> None:
    await recorded(database_url, "first", SECRET)
    whole = ForkedProcess(erase_until, database_url, "2", 0)
    assert whole.wait() == 0
    count = int(whole.lines[-1])
    for last in (*range(1, count, count // 5), count - 1, count):
        [identity] = await recorded(database_url, SECRET)
        process = ForkedProcess(erase_until, database_url, identity, last)
        assert process.wait() in (-9, 0), process.lines
        await assert_clean(database_url)
        await erased(database_url, identity)
        assert places_with(SECRET, database_url) == [], f"killed at statement {last} of {count}"
        await assert_clean(database_url)
        assert ask(database_url, "SELECT id FROM pycrorm_removed_episode WHERE finished_wall_ns IS NULL") == []


def test_the_command_asks_lists_and_keeps_a_journal(tmp_path: Path) -> None:
    url = f"sqlite:///{tmp_path}/memory.db"
    asyncio.run(recorded(url, "a note", SECRET))
    assert "say why with --reason" in pycrorm("erase", "2", "--url", url, cwd=tmp_path).stderr
    asked = pycrorm("erase", "2", "--reason", "asked", "--url", url, cwd=tmp_path)
    assert (asked.returncode, "nothing was erased" in asked.stderr) == (2, True)
    listed = pycrorm("erase", "--keep", "1min", "--dry-run", "--url", url, cwd=tmp_path)
    assert (listed.returncode, SECRET[:6] in listed.stdout, " 6 " in listed.stdout) == (0, False, False)
    rule = ("--keep", "2100-01-01", "--tag", SECRET[:6])
    dry = pycrorm("erase", *rule, "--dry-run", "--url", url, cwd=tmp_path)
    assert ("│       2 │" in dry.stdout, "│       1 │" in dry.stdout) == (True, False)
    done = pycrorm("erase", *rule, "--yes", "--url", url, cwd=tmp_path)
    assert (done.returncode, done.stderr) == (0, "")
    journal = pycrorm("erase", "--url", url, cwd=tmp_path)
    assert f"--keep 2100-01-01 --tag {SECRET[:6]}" in journal.stdout
    assert "0 archived and 1 erased episodes" in pycrorm("verify", "--url", url, cwd=tmp_path).stdout
    shown = pycrorm("show", "2", "--url", url, cwd=tmp_path)
    assert (shown.returncode, "was erased on" in shown.stderr) == (2, True)
    assert places_with(SECRET, url) == []


async def test_where_the_tables_belong_to_another_role_each_login_erases_its_part(
    server: Server, in_folder: Path
) -> None:
    url = server.new_memory()
    await recorded(url, SECRET)
    change_each(url, [*GRANTS, "CREATE ROLE lab LOGIN IN ROLE pycrorm_folder"])
    database = url.partition("@/")[2].partition("?")[0]
    change_each(url, [f"ALTER ROLE lab IN DATABASE {database} SET role = 'pycrorm_folder'"])
    folder = server.url(database, user="lab")
    with pytest.raises(Exception, match="permission denied"):
        await erased(folder, "1")
    [done] = await erased(url, "1")
    assert [each[:10] for each in done.left] == ["the tables"]
    assert {each[:3] for each in places_with(SECRET, url)} == {"zz_"}
    [done] = await erased(folder, "1")
    assert done.left == ()
    assert places_with(SECRET, url) == []
    assert ask(url, "SELECT finished_wall_ns IS NULL FROM pycrorm.pycrorm_removed_episode") == [(False,)]
    change_each(url, ["DROP OWNED BY lab", "DROP ROLE lab"])
