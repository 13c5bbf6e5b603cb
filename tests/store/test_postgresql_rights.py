"""Rights on PostgreSQL: `GRANTS` run by an owner, and a member who plants code and gains nothing."""

from __future__ import annotations

from collections.abc import Iterator, Sequence
from contextlib import suppress
from pathlib import Path
from urllib.parse import urlsplit

import asyncpg
import pytest
from sqlalchemy import text

from pycrorm_async import Memory
from pycrorm_async.errors import DatabaseUnavailable, PycrormError, TablesUntrusted, TablesWithheld
from pycrorm_async.events.types import BlobReference
from pycrorm_async.operations.rebuild import rebuild_memory
from pycrorm_async.operations.recovery import recover
from pycrorm_async.projections.projector import Projector
from pycrorm_async.projections.verify import verify
from pycrorm_async.query.reading import Reading
from pycrorm_async.store.address import DatabaseAddress
from pycrorm_async.store.log import EventLog
from pycrorm_async.store.postgresql import GRANTS
from tests.commands import NOTES_PLAN, pycrorm
from tests.crash.step_robot import SETTINGS, StepActionPerformable
from tests.databases import Server, ask, change_each, server_in_memory
from tests.store.factories import declaration, episode, run_of, started

pytestmark = pytest.mark.slow


# === postgresql grants ========================================================================================
#
# `GRANTS` run by an owner of a database without superuser rights, with and without the right to create roles.


@pytest.fixture(scope="module")
def new_server() -> Iterator[Server]:
    """A server without the roles of a memory, which belong to the whole server."""
    with server_in_memory() as running:
        yield running


def owned(server: Server, *, may: str) -> str:
    """Return the URL of an ordinary owner, with this attribute, of a new database."""
    url = server.new_database()
    database = urlsplit(url).path.removeprefix("/")
    ask(url, f"CREATE ROLE owner_of_{database} LOGIN {may}")
    ask(url, f"ALTER DATABASE {database} OWNER TO owner_of_{database}")
    return server.url(database, user=f"owner_of_{database}")


async def make_log(url: str) -> EventLog:
    log = await EventLog.open(DatabaseAddress.parse(url), create=True)
    await Projector(log).open()
    await log.append([started(1)])
    return log


def grant(url: str) -> None:
    change_each(url, GRANTS)


async def test_an_owner_is_shown_the_missing_statements_has_another_login_run_them_and_keeps_the_log(
    new_server: Server,
) -> None:
    # In this order: the roles are missing only on a server without a memory that has them.
    url = owned(new_server, may="NOCREATEROLE")
    login = urlsplit(url).username
    superuser = new_server.url(urlsplit(url).path.removeprefix("/"))
    with pytest.raises(asyncpg.RaiseError, match="the memory has no tables yet: run `pycrorm writer --once` first"):
        grant(url)
    log = await make_log(url)
    with pytest.raises(asyncpg.RaiseError, match="may not create roles; a role with CREATEROLE runs: ") as missing:
        grant(url)
    assert "pycrorm_recorder, pycrorm_folder, pycrorm_reader are missing" in str(missing.value)
    *create, member = str(missing.value).partition("runs: ")[2].split("; ")
    assert member == f"GRANT pycrorm_folder TO {login}"
    for statement in create:
        ask(superuser, statement)
    with pytest.raises(asyncpg.RaiseError, match=f"a role with CREATEROLE runs: GRANT pycrorm_folder TO {login}$"):
        grant(url)
    ask(superuser, member)
    grant(url)
    grant(url)
    # The log still belongs to the owner, through earlier and new connections.
    assert await log.append(run_of(episode(1), 2, 3)) == {}
    await log.close()
    log = await EventLog.open(DatabaseAddress.parse(url), create=True)
    assert await log.append(run_of(episode(2), 1, 2)) == {}
    assert [each.head for each in await log.episodes()] == [3, 2]
    with pytest.raises(TablesUntrusted):
        await Projector(log).open()
    await log.close()

    # An owner who may create roles needs no other login.
    url = owned(new_server, may="CREATEROLE")
    for role in ("recorder", "folder", "reader"):
        ask(superuser, f"DROP OWNED BY pycrorm_{role}")
    for role in ("recorder", "folder", "reader"):
        ask(superuser, f"DROP ROLE pycrorm_{role}")
    await (await make_log(url)).close()
    grant(url)
    grant(url)
    tables_owner = "SELECT nspowner::regrole::text FROM pg_namespace WHERE nspname = 'memory_tables'"
    assert ask(url, tables_owner) == [("pycrorm_folder",)]


@pytest.mark.parametrize("roles", ["pycrorm_recorder", "pycrorm_recorder, pycrorm_reader"])
async def test_a_login_that_only_records_runs_plans_which_another_login_folds(
    server: Server, roles: str, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.chdir(tmp_path)
    url = server.new_memory()
    database = urlsplit(url).path.removeprefix("/")
    assert pycrorm("roles", "--create", "--url", url, cwd=tmp_path).returncode == 0
    login = f"robot_of_{database}_{len(roles)}"
    ask(url, f"CREATE ROLE {login} LOGIN IN ROLE {roles}")
    robot = server.url(database, user=login)
    (tmp_path / "notes.py").write_text(NOTES_PLAN)
    done = pycrorm("run", "notes.py", "--url", robot, cwd=tmp_path)
    assert (done.returncode, done.stderr.count(f"{login} may ")) == (0, 1), done.stderr
    async with Memory.open(robot) as memory, memory.episode(description="steps"):
        await StepActionPerformable("a", 1).perform()
        with pytest.raises(TablesWithheld, match="fold with `pycrorm writer` and a login that may"):
            await memory.flush()
        assert memory.status.faults.total == 0
    once = pycrorm("writer", "--once", "--url", robot, cwd=tmp_path)
    assert (once.returncode, once.stderr.count(f"{login} may ")) == (0, 1), once.stderr
    steps = "SELECT count(*) FROM memory.step_action"
    assert pycrorm("writer", "--once", "--url", url, cwd=tmp_path).returncode == 0
    assert ask(url, steps) == [(1,)]
    shown = pycrorm("episodes", "--url", robot, cwd=tmp_path)
    assert (shown.returncode, shown.stderr.count("\n")) == ((0, 0) if "reader" in roles else (3, 1))


async def test_each_role_does_its_work_and_has_no_other_right_to_change_the_log(server: Server) -> None:
    owner = server.new_database()
    await (await make_log(owner)).close()
    grant(owner)
    grant(owner)
    recorder, folder, reader = (member(server, owner, role) for role in ("recorder", "folder", "reader"))

    # A recorder appends, with digests and blobs where it may insert them, and cannot fold.
    log = await EventLog.open(DatabaseAddress.parse(recorder), create=True)
    new = [declaration(b'{"dtype":"A"}'), *run_of(episode(2), 1, 300)]
    assert await log.append(new) == {}
    assert await log.append([*new, *run_of(episode(2), 301, 307)]) == {}
    await log.blobs.add(BlobReference("1" * 64, "a/b", 3), b"abc")
    with pytest.raises(TablesWithheld, match="may not change the tables: fold with `pycrorm writer`"):
        await Projector(log).open()
    await log.close()
    ask(owner, "REVOKE ALL ON pycrorm.pycrorm_digest FROM pycrorm_recorder")
    log = await EventLog.open(DatabaseAddress.parse(recorder), create=True)
    assert await log.append(run_of(episode(3), 1, 300)) == {}
    assert await log.last_digests() == {}
    await log.close()
    assert ask(owner, "SELECT episode, sequence FROM pycrorm.pycrorm_digest") == [(2, 256)]
    grant(owner)

    # A folder appends and folds, also tables that another folder made.
    log = await EventLog.open(DatabaseAddress.parse(folder), create=True)
    projector = Projector(log)
    await projector.open()
    assert await log.append([started(4)]) == {}
    await projector.catch_up()
    await log.close()
    assert ask(owner, "SELECT count(*) FROM memory.process_metadata") == [(2,)]

    # A reader reads log, tables and views, later ones too, and writes nothing.
    ask(folder, "CREATE TABLE memory.later (id int)")
    ask(folder, "CREATE VIEW memory.later_still AS SELECT * FROM memory.later")
    for name in ("later", "later_still"):
        assert ask(reader, f"SELECT count(*) FROM {name}") == [(0,)]
    ask(folder, "DROP TABLE memory.later CASCADE")
    async with Reading.open(reader) as reading:
        await reading.episodes()
    log = await EventLog.open(DatabaseAddress.parse(reader), create=True)
    assert [each.sequence for each in await log.events(1)] == [1]
    with pytest.raises(DatabaseUnavailable, match="permission denied"):
        await log.append(run_of(episode(3), 1, 1))
    await log.close()

    log_of = "relnamespace = 'pycrorm'::regnamespace AND grantee::regrole::text LIKE 'pycrorm%'"
    tables = f"SELECT grantee::regrole::text, privilege_type, relname FROM pg_class, aclexplode(relacl) WHERE {log_of}"
    inserted = {
        ("INSERT", name)
        for name in ("event", "episode", "pycrorm_declaration", "pycrorm_incarnation", "pycrorm_blob", "pycrorm_digest")
    }
    changes = {tuple(each) for each in ask(owner, tables) if each[1] != "SELECT"}
    assert changes == {
        (role, *each)
        for role in ("pycrorm_recorder", "pycrorm_folder")
        for each in (*inserted, ("USAGE", "episode_number"))
    }
    columns = (
        "SELECT grantee::regrole::text, privilege_type, relname || '.' || attname FROM pg_class"
        f" JOIN pg_attribute ON attrelid = pg_class.oid, aclexplode(attacl) WHERE {log_of}"
    )
    appended = {("UPDATE", f"episode.{name}") for name in ("head", "ended_wall_ns", "refused")}
    assert {tuple(each) for each in ask(owner, columns)} == {
        *(("pycrorm_recorder", *each) for each in appended),
        *(("pycrorm_folder", *each) for each in appended),
        ("pycrorm_folder", "UPDATE", "episode.folded"),
        ("pycrorm_folder", "UPDATE", "pycrorm_removed_episode.finished_wall_ns"),
        ("pycrorm_folder", "UPDATE", "episode.parked"),
    }
    for statement in ("ALTER TABLE pycrorm.event DISABLE TRIGGER ALL", "CREATE TABLE pycrorm.mine (a int)"):
        with pytest.raises(asyncpg.InsufficientPrivilegeError):
            ask(folder, statement)


# === postgresql attacks =======================================================================================
#
# A member of `pycrorm_folder` who plants code in the tables' schemas gains no right of the owner.
#
# Each attack is a real login. It plants a payload that rewrites the log, which only the owner may do, after RESET ROLE
# has restored the owner's rights. Then the owner performs every operation that touches the tables.

PAYLOAD = """
CREATE FUNCTION memory_tables.payload() RETURNS void LANGUAGE plpgsql AS $$
BEGIN
    RESET ROLE;
    SET LOCAL default_transaction_read_only = off;
    ALTER TABLE pycrorm.event DISABLE TRIGGER ALL;
    UPDATE pycrorm.event SET payload = '{"rewritten":true}';
EXCEPTION WHEN OTHERS THEN
    RETURN;
END $$"""


def shadow(signature: str, result: str, value: str) -> str:
    """Return a function that PostgreSQL prefers to its own because the arguments match better."""
    return (
        f"CREATE FUNCTION memory_tables.{signature} RETURNS {result} LANGUAGE plpgsql AS"
        f" $$ BEGIN PERFORM memory_tables.payload(); RETURN {value}; END $$"
    )


def trigger_on(table: str, when: str) -> str:
    return (
        f"CREATE TRIGGER planted BEFORE {when} ON memory_tables.{table}"
        " FOR EACH ROW EXECUTE FUNCTION memory_tables.planted()"
    )


def view_instead_of(table: str) -> Sequence[str]:
    return (
        f"ALTER TABLE memory_tables.{table} RENAME TO moved",
        f"CREATE VIEW memory_tables.{table} AS SELECT * FROM memory_tables.moved WHERE memory_tables.is_shown()",
    )


FUNCTIONS = (
    PAYLOAD,
    shadow("planted()", "trigger", "NEW"),
    shadow("is_shown()", "boolean", "true"),
    shadow("one()", "integer", "1"),
    shadow("same(oid, regnamespace)", "boolean", "true"),
)
ATTACKS: dict[str, Sequence[str]] = {
    "functions and an operator that shadow those of the catalogue": (
        shadow("starts_with(name, text)", "boolean", "false"),
        shadow("format(text, text)", "text", "'memory_tables.pycrorm_generation'"),
        shadow("convert_to(text, text)", "bytea", "'\\x7b7d'"),
        shadow("nextval(text)", "bigint", "77"),
        "CREATE OPERATOR memory_tables.= (LEFTARG = oid, RIGHTARG = regnamespace, FUNCTION = memory_tables.same)",
    ),
    "triggers on tables that are folded into": (
        trigger_on("zz_process_metadata__1001", "INSERT"),
        trigger_on("pycrorm_generation", "INSERT OR UPDATE"),
    ),
    "a view in the place of a table": view_instead_of("zz_object__1001"),
    "a view in the place of the note of the generations": view_instead_of("pycrorm_generation"),
    "a default value": (
        "ALTER TABLE memory_tables.zz_process_metadata__1001 ADD COLUMN planted integer DEFAULT memory_tables.one()",
    ),
}


@pytest.fixture
async def owner(server: Server, tmp_path: Path) -> str:
    """Return the URL of the owner of a memory with roles and with one action in its tables."""
    url = server.new_database()
    await _record_one(url, tmp_path / "spool", "first", 1)
    change_each(url, GRANTS)
    return url


def member(server: Server, url: str, role: str) -> str:
    """Return the URL of a login that is a member of this role only."""
    database = urlsplit(url).path.removeprefix("/")
    name = f"{role}_of_{database}"
    ask(server.url(database), f"CREATE ROLE {name} LOGIN IN ROLE pycrorm_{role}")
    ask(server.url(database), f"ALTER ROLE {name} IN DATABASE {database} SET role = 'pycrorm_{role}'")
    return server.url(database, user=name)


async def _record_one(url: str, spool: Path, description: str, step: int) -> None:
    opening = Memory.open(url, spool=spool, settings=SETTINGS)
    async with opening as memory, memory.episode(description=description):
        await StepActionPerformable("a", step).perform()


async def _perform_every_operation(url: str, spool: Path) -> None:
    """Perform everything an owner does with a memory; a refused operation must raise an error of this package."""
    address = DatabaseAddress.parse(url)
    with suppress(PycrormError):
        await _record_one(url, spool, "more", 2)
    with suppress(PycrormError):
        await recover(url, spool=spool)
    log = await EventLog.open(address, create=False)
    for each in await log.episodes():
        await log.events(each.number)
    await log.declarations()
    with suppress(PycrormError):
        await verify(log)
    await log.close()
    with suppress(PycrormError):
        async with Reading.open(url) as reading:
            await reading.episodes()
            await reading.tree(1)
    with suppress(PycrormError):
        await rebuild_memory(url, workers=1)
    change_each(url, GRANTS)


@pytest.mark.soak_on(
    "a view in the place of a table", "a default value", "a view in the place of the note of the generations"
)
@pytest.mark.parametrize("attack", ATTACKS)
async def test_a_folder_cannot_rewrite_the_log_by_code_that_the_owner_executes(
    attack: str, owner: str, server: Server, tmp_path: Path
) -> None:
    attacker = member(server, owner, "folder")
    before = ask(owner, "SELECT episode, sequence, payload FROM pycrorm.event ORDER BY 1, 2")
    for statement in (*FUNCTIONS, *ATTACKS[attack]):
        ask(attacker, statement)
    await _perform_every_operation(owner, tmp_path / "spool")
    after = ask(owner, "SELECT episode, sequence, payload FROM pycrorm.event ORDER BY 1, 2")
    assert after[: len(before)] == before
    assert len(after) > len(before)  # the owner's own episode was appended
    enabled = "SELECT DISTINCT tgenabled FROM pg_trigger WHERE tgrelid = 'pycrorm.event'::regclass"
    assert ask(owner, enabled) == [(b"O",)]


async def test_the_owner_is_refused_at_the_tables_and_another_login_folds_what_the_owner_appended(
    owner: str, server: Server, tmp_path: Path
) -> None:
    folder, reader = (member(server, owner, role) for role in ("folder", "reader"))
    with pytest.raises(TablesUntrusted, match="fold with a login that is a member of pycrorm_folder"):
        await _record_one(owner, tmp_path / "spool", "more", 2)
    log = await EventLog.open(DatabaseAddress.parse(folder), create=True)
    projector = Projector(log)
    await projector.open()
    assert await projector.catch_up() > 0
    assert (await verify(log)).drift == 0
    await log.close()
    assert ask(reader, "SELECT step FROM memory.step_action ORDER BY step") == [(1,), (2,)]
    async with Reading.open(reader) as reading:
        assert [each.description for each in await reading.episodes()] == ["first", "more"]
    log = await EventLog.open(DatabaseAddress.parse(owner), create=True)
    async with log.reading() as connection:  # so that no object there hides one of pg_catalog
        assert (await connection.execute(text("SHOW search_path"))).scalar_one() == "pycrorm"
    await log.close()
    with pytest.raises(TablesUntrusted, match="read with one of pycrorm_reader"):
        async with Reading.open(owner):
            pass
    (tmp_path / "notes.py").write_text(NOTES_PLAN)
    for words in (("run", "notes.py"), ("writer", "--once")):  # the plan's events are stored, and the command says so
        done = pycrorm(*words, "--url", owner, "--spool", tmp_path / "spool", cwd=tmp_path)
        assert (done.returncode, "fold with a login that is a member of pycrorm_folder" in done.stderr) == (3, True)
    notes = "SELECT count(*) FROM pycrorm.event WHERE type = 'NodeEnded' AND episode > 2"
    assert ask(owner, notes) == [(4,)]
