"""The owner of a memory on PostgreSQL queries it in SQL: as a role that can only read, out of which no query gets."""

from __future__ import annotations

import asyncio
from pathlib import Path
from urllib.parse import urlsplit

import pytest

from pycrorm_async.errors import PycrormError, QueryRefused
from pycrorm_async.memory import Memory
from pycrorm_async.operations.rebuild import rebuild_memory
from pycrorm_async.query.reading import Reading
from pycrorm_async.store.postgresql import OWNER_GRANTS
from tests.commands import answer, pycrorm
from tests.databases import Server, ask, change_each
from tests.projections.event_script import append_and_fold
from tests.query.read_only_queries import RECORDS, login, opened_reader
from tests.query.test_sql import ON_BOTH, ON_POSTGRESQL, _state_of

pytestmark = pytest.mark.slow

ESCAPES = {
    "RESET ROLE": "RESET ROLE",
    "SET ROLE NONE": "SET ROLE NONE",
    "SET SESSION AUTHORIZATION": "SET SESSION AUTHORIZATION DEFAULT",
    "set_config of the role": "SELECT set_config('role', 'postgres', true)",
    "set_config of the session": "SELECT set_config('session_authorization', 'postgres', true)",
    "set_config in quotes": """SELECT "set_config"('role', 'none', false)""",
    "set_config in WITH": "WITH x AS MATERIALIZED (SELECT set_config('role', 'none', true)) SELECT * FROM x",
    "two statements": "SELECT 1; RESET ROLE",
    "the end of the transaction": "COMMIT; RESET ROLE",
    "a text that a function runs": "SELECT public.run_text('SELECT set_' || 'config(''role'', ''none'', true)')",
    "an operator that runs a text": "SELECT 'SELECT 1' OPERATOR(public.@!) ''",
    "an update of the settings": "UPDATE pg_settings SET setting = 'none' WHERE name = 'role'",
    "the passwords": "SELECT rolpassword FROM pg_authid",
    "a file": "SELECT pg_read_file('/etc/hostname')",
    "a table of the owner's that the reader may not read": "SELECT * FROM public.diary",
}


@pytest.fixture
async def owner_url(server: Server) -> str:
    """The URL of the superuser who made the memory and its roles, with code of their own that runs any text."""
    url = server.new_database()
    await append_and_fold(url, RECORDS)
    run = "BEGIN EXECUTE command; RETURN command; END"
    change_each(
        url,
        [
            *OWNER_GRANTS,
            *OWNER_GRANTS,
            "CREATE TABLE public.diary (x text)",
            f"CREATE FUNCTION public.run_text(command text) RETURNS text STABLE LANGUAGE plpgsql AS $$ {run} $$",
            f"CREATE FUNCTION public.two(command text, y text) RETURNS text IMMUTABLE LANGUAGE plpgsql AS $$ {run} $$",
            "CREATE OPERATOR public.@! (FUNCTION = public.two, LEFTARG = text, RIGHTARG = text)",
        ],
    )
    return url


@pytest.mark.soak
async def test_the_owner_queries_as_the_reader_and_no_attack_gets_out(owner_url: str, tmp_path: Path) -> None:
    async with opened_reader(owner_url) as sql:
        who = "SELECT current_user::text, session_user::text, count(*) FROM process_metadata"
        assert (await sql.query(who))[1] == [("pycrorm_reader", "postgres", 2)]
        before = [ask(owner_url, each) for each in _state_of(owner_url)]
        for attack, text in {**ON_BOTH, **ON_POSTGRESQL, **ESCAPES}.items():
            with pytest.raises(PycrormError) as refused:
                pytest.fail(f"{attack} was answered with {await sql.query(text.format(folder=tmp_path))}")
            assert isinstance(refused.value, QueryRefused), (attack, refused.value)
        assert list(tmp_path.iterdir()) == []
        assert [ask(owner_url, each) for each in _state_of(owner_url)] == before
        assert (await sql.query(who))[1] == [("pycrorm_reader", "postgres", 2)]


PLANTED = {
    "a function": ("CREATE FUNCTION public.plant() RETURNS text LANGUAGE sql IMMUTABLE AS $$ SELECT 'x' $$",),
    "a view": ("CREATE VIEW public.plant AS SELECT set_config('role', 'postgres', true)",),
    "a domain": ("CREATE DOMAIN public.plant AS text CHECK (set_config('role', 'postgres', true) <> '')",),
    "a policy": (
        "CREATE TABLE public.plant (x text)",
        "ALTER TABLE public.plant ENABLE ROW LEVEL SECURITY",
        "CREATE POLICY plant ON public.plant USING (set_config('role', 'postgres', true) <> '')",
    ),
    "an operator": ("CREATE OPERATOR public.@? (FUNCTION = pg_catalog.texteq, LEFTARG = text, RIGHTARG = text)",),
    "an aggregate": ("CREATE AGGREGATE public.plant (text, boolean) (SFUNC = set_config, STYPE = text)",),
}


async def test_the_owner_takes_no_role_where_another_login_may_have_planted_code(server: Server) -> None:
    for what, statements in PLANTED.items():
        url = server.new_database()
        await append_and_fold(url, RECORDS[:20])
        change_each(url, [*OWNER_GRANTS, "GRANT CREATE ON SCHEMA public TO PUBLIC"])
        change_each(login(url, ""), statements)
        async with opened_reader(url) as sql:
            with pytest.raises(QueryRefused, match=r"whose rights the .* could use; make one: CREATE ROLE") as refused:
                pytest.fail(f"{what} did not matter: {await sql.query('SELECT 1')}")
            assert "public." in str(refused.value)
        async with opened_reader(login(url, "IN ROLE pycrorm_reader")) as sql:  # has no rights that code could use
            assert (await sql.query("SELECT 1"))[1] == [(1,)]


async def test_the_owner_makes_the_roles_by_one_command_and_goes_on_working(server: Server, tmp_path: Path) -> None:
    url = server.new_database()
    database = urlsplit(url).path.removeprefix("/")
    change_each(
        url, [f"CREATE ROLE lab_{database} LOGIN CREATEROLE", f"ALTER DATABASE {database} OWNER TO lab_{database}"]
    )
    owner = server.url(database, user=f"lab_{database}")
    for number, each in enumerate((url, owner)):
        is_superuser = number == 0
        if not is_superuser:
            change_each(url, [f"DROP SCHEMA {name} CASCADE" for name in ("memory", "memory_tables", "pycrorm")])
        await _record(each, tmp_path / f"spool{number}")
        refused = await asyncio.to_thread(pycrorm, "query", "SELECT 1", "--url", each, cwd=tmp_path)
        assert (refused.returncode, "run `pycrorm roles --create` once" in refused.stderr) == (2, True)
        if not is_superuser:  # another database's owner made the roles of this server
            change_each(
                url, [f"GRANT pycrorm_{name} TO lab_{database} WITH ADMIN OPTION" for name in ("reader", "recorder")]
            )
        for _ in range(2):
            made = await asyncio.to_thread(answer, "roles", "--create", "--url", each, cwd=tmp_path)
            assert {(role["tables_owner"], role["login"]) for role in made} == {(urlsplit(each).username,) * 2}
            assert {"pycrorm_recorder", "pycrorm_reader"} <= {role["name"] for role in made if role["exists"]}
        await _record(each, tmp_path / f"spool{number}")  # the owner folds into new tables and views
        await rebuild_memory(each, workers=1)
        count = "SELECT count(*) AS n, (SELECT count(*) FROM step_action) AS steps FROM process_metadata"
        for user in (each, login(url, "IN ROLE pycrorm_reader")):
            assert (await asyncio.to_thread(answer, "query", count, "--url", user, cwd=tmp_path))["rows"] == [
                {"n": 2, "steps": 2}
            ]
            async with Reading.open(user) as reading:
                assert len(await reading.episodes()) == 2
        assert "SQLite has no roles" in pycrorm("roles", "--url", "sqlite:///m.db", cwd=tmp_path).stderr


async def _record(url: str, spool: Path) -> None:
    async with Memory.open(url, spool=spool) as memory:
        step = memory.recording.type("action", "StepAction", {"step": int})
        with memory.recording.episode(description="step") as episode:
            episode.start("one", step, {"step": 1})
            episode.end("one", "SUCCEEDED")
        await memory.flush()
