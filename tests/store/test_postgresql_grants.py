"""`GRANTS` run by an owner of a database without superuser rights, with and without the right to create roles."""

from __future__ import annotations

from collections.abc import Iterator
from urllib.parse import urlsplit

import asyncpg
import pytest

from pycrorm_async.errors import TablesUntrusted
from pycrorm_async.projections.projector import Projector
from pycrorm_async.store.address import DatabaseAddress
from pycrorm_async.store.log import EventLog
from pycrorm_async.store.postgresql import GRANTS
from tests.databases import Server, ask, change_each, server_in_memory
from tests.store.factories import episode, run_of

pytestmark = pytest.mark.slow


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
    await log.append(run_of(episode(1), 1, 1))
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


async def test_a_recorder_inserts_digests_and_appends_without_them_where_it_may_not(server: Server) -> None:
    url = server.new_database()
    database = urlsplit(url).path.removeprefix("/")
    await (await make_log(url)).close()
    grant(url)
    ask(url, f"CREATE ROLE recorder_of_{database} LOGIN IN ROLE pycrorm_recorder")
    address = DatabaseAddress.parse(server.url(database, user=f"recorder_of_{database}"))
    log = await EventLog.open(address, create=True)
    assert await log.append(run_of(episode(2), 1, 300)) == {}
    for change in ("UPDATE pycrorm.pycrorm_digest SET digest = ''", "DELETE FROM pycrorm.pycrorm_digest"):
        with pytest.raises(asyncpg.InsufficientPrivilegeError):
            ask(server.url(database, user=f"recorder_of_{database}"), change)
    await log.close()
    ask(url, "REVOKE ALL ON pycrorm.pycrorm_digest FROM pycrorm_recorder")
    log = await EventLog.open(address, create=True)
    assert await log.append(run_of(episode(3), 1, 300)) == {}
    assert await log.last_digests() == {}
    await log.close()
    assert [tuple(each) for each in ask(url, "SELECT episode, sequence FROM pycrorm.pycrorm_digest")] == [(2, 256)]


async def test_the_roles_have_no_right_to_change_the_log_but_these(server: Server) -> None:
    url = server.new_database()
    await (await make_log(url)).close()
    grant(url)
    log_of = "relnamespace = 'pycrorm'::regnamespace AND grantee::regrole::text LIKE 'pycrorm%'"
    tables = f"SELECT grantee::regrole::text, privilege_type, relname FROM pg_class, aclexplode(relacl) WHERE {log_of}"
    inserted = {
        ("INSERT", name)
        for name in ("event", "episode", "pycrorm_declaration", "pycrorm_incarnation", "pycrorm_blob", "pycrorm_digest")
    }
    changes = {tuple(each) for each in ask(url, tables) if each[1] != "SELECT"}
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
    assert {tuple(each) for each in ask(url, columns)} == {
        *(("pycrorm_recorder", *each) for each in appended),
        *(("pycrorm_folder", *each) for each in appended),
        ("pycrorm_folder", "UPDATE", "episode.folded"),
        ("pycrorm_folder", "UPDATE", "episode.parked"),
    }
