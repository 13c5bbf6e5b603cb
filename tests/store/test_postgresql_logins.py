"""Logins to PostgreSQL: TLS with libpq's parameters, and refusals in one line that shows no password."""

from __future__ import annotations

import asyncio
import logging
import socket
import ssl
import subprocess
import traceback
from collections.abc import AsyncIterator
from contextlib import asynccontextmanager, suppress
from pathlib import Path
from urllib.parse import urlsplit

import pytest

from pycrorm_async.errors import DatabaseForeign, DatabaseUnavailable, PycrormError
from pycrorm_async.store import postgresql
from pycrorm_async.store.address import DatabaseAddress
from pycrorm_async.store.log import EventLog
from tests.databases import Server, ask
from tests.store.factories import episode, run_of

# === postgresql refusals ======================================================================================
#
# Refusals by PostgreSQL: one line that names the database and the reason, and shows no password.

SECRET = "s3cr et/@#?&:%"
WRITTEN = "s3cr%20et%2F%40%23%3F%26%3A%25"
GUARDED = "local all guarded scram-sha-256\n"


def guarded_in(server: Server) -> str:
    """Return the name of a new database that requires a password of the user `guarded`."""
    rules = server.folder / "pg_hba.conf"
    if not rules.read_text().startswith(GUARDED):
        rules.write_text(GUARDED + rules.read_text())
        url = server.url()
        ask(url, f"CREATE ROLE guarded LOGIN PASSWORD '{SECRET}'")
        ask(url, "SELECT pg_reload_conf()")
    database = urlsplit(server.new_database()).path.removeprefix("/")
    ask(server.url(), f"GRANT CREATE ON DATABASE {database} TO guarded")
    return database


@pytest.fixture
def guarded(server: Server) -> str:
    return guarded_in(server)


async def refused(
    url: str, caplog: pytest.LogCaptureFixture, *, create: bool = True, busy_timeout_s: float = 2.0
) -> PycrormError:
    """Return the error that opening raises: one line, with no password in it, its causes, or the logs."""
    caplog.set_level(logging.DEBUG)
    with pytest.raises(PycrormError) as caught:
        log = await EventLog.open(DatabaseAddress.parse(url), create=create, busy_timeout_s=busy_timeout_s)
        await log.close()
    output = "".join(traceback.format_exception(caught.value)) + caplog.text + repr(caught.value.__dict__)
    assert "s3cr" not in output
    assert "\n" not in str(caught.value)
    return caught.value


async def test_a_password_with_any_characters_opens_the_database(server: Server, guarded: str) -> None:
    address = DatabaseAddress.parse(server.url(guarded, user="guarded", password=WRITTEN))
    log = await EventLog.open(address, create=True)
    await log.append(run_of(episode(1), 1, 3))
    assert [each.head for each in await log.episodes()] == [3]
    await log.close()


async def test_a_login_a_database_or_a_server_that_is_wrong_is_named_with_what_to_do(
    server: Server, guarded: str, caplog: pytest.LogCaptureFixture
) -> None:
    admit = "correct the user in the URL, or let the server's administrator create or admit it"
    unlocked = "put the right password into PYCRORM_URL or ~/.pgpass"
    full = urlsplit(server.new_database()).path.removeprefix("/")
    ask(server.url(), f"ALTER DATABASE {full} CONNECTION LIMIT 0")
    ask(server.url(), "CREATE ROLE guest LOGIN")
    for url, reason in (
        (server.url(user="stranger", password="s3cr"), f'role "stranger" does not exist: {admit}'),
        (server.url(user="pg_monitor", password="s3cr"), f'role "pg_monitor" is not permitted to log in: {admit}'),
        (
            server.url(guarded, user="guarded", password="s3cr-wrong"),
            f'password authentication failed for user "guarded": {unlocked}',
        ),
        (
            server.url(guarded, user="guarded", password=""),
            f'password authentication failed for user "guarded": {unlocked}',
        ),
        (
            server.url("nothing", password="s3cr"),
            'database "nothing" does not exist: create it with `createdb`, or correct the URL',
        ),
        (server.url(full, user="guest"), f'too many connections for database "{full}"'),
        ("postgresql://ada:s3cr@/memory?host=/tmp/no/server", "cannot be reached: No such file or directory"),
        (
            "postgresql://ada:s3cr@127.0.0.1:1/memory",
            "cannot be reached: Connection refused: start the server, or correct the URL",
        ),
    ):
        for create in (True, False):
            error = await refused(url, caplog, create=create)
            assert type(error) is DatabaseUnavailable
            assert str(error).endswith(reason)
            assert str(error).startswith("postgresql://")
    error = await refused("postgresql://ada:s3cr@no-such-host.invalid/memory", caplog)
    assert str(error).startswith("postgresql://ada:***@no-such-host.invalid/memory: cannot be reached: ")


@pytest.mark.parametrize(
    ("answer", "parameters"), [(b"HTTP/1.1 400 Bad Request\r\n\r\n", ""), (b"", "?sslmode=require")]
)
async def test_another_program_at_the_port_is_refused(
    caplog: pytest.LogCaptureFixture, answer: bytes, parameters: str
) -> None:
    async def other(reader: asyncio.StreamReader, writer: asyncio.StreamWriter) -> None:
        await reader.read(8)
        writer.write(answer)
        writer.close()

    listening = await asyncio.start_server(other, "127.0.0.1", 0)
    port = listening.sockets[0].getsockname()[1]
    error = await refused(f"postgresql://ada:s3cr@127.0.0.1:{port}/memory{parameters}", caplog)
    assert type(error) is DatabaseUnavailable
    assert "another program answers at this address" in str(error)
    listening.close()
    await listening.wait_closed()


async def test_opening_waits_for_a_silent_server_no_longer_than_allowed(
    caplog: pytest.LogCaptureFixture,
) -> None:
    with socket.create_server(("127.0.0.1", 0)) as silent:
        url = f"postgresql://ada:s3cr@127.0.0.1:{silent.getsockname()[1]}/memory"
        error = await refused(url, caplog, busy_timeout_s=0.2)
    assert type(error) is DatabaseUnavailable
    assert str(error).endswith("no answer in time")


async def test_a_server_that_is_too_old_is_refused(
    server: Server, monkeypatch: pytest.MonkeyPatch, caplog: pytest.LogCaptureFixture
) -> None:
    url = server.new_database()
    [[version]] = ask(url, "SELECT current_setting('server_version_num')::int / 10000")
    # A server of today's version, checked by a program that requires the next one.
    monkeypatch.setattr(postgresql, "_VERSION_MIN", version + 1)
    error = await refused(url, caplog)
    assert type(error) is DatabaseUnavailable
    assert str(error).endswith(f"PostgreSQL {version + 1} or newer is needed, this is {version}")
    ours = "('pycrorm', 'memory', 'memory_tables')"
    assert ask(url, f"SELECT count(*) FROM pg_namespace WHERE nspname IN {ours}") == [(0,)]


async def test_a_login_without_rights_is_refused(
    server: Server, guarded: str, caplog: pytest.LogCaptureFixture
) -> None:
    url = server.url(guarded)
    ask(url, f"REVOKE CREATE ON DATABASE {guarded} FROM guarded")
    theirs = server.url(guarded, user="guarded", password=WRITTEN)
    error = await refused(theirs, caplog)
    advice = "use a login with this right (operations/README.md, PostgreSQL)"
    assert str(error).endswith(f"permission denied for database {guarded}: {advice}")
    await (await EventLog.open(DatabaseAddress.parse(url), create=True)).close()
    for create in (True, False):
        error = await refused(theirs, caplog, create=create)
        assert type(error) is DatabaseUnavailable
        assert str(error).endswith(f"permission denied for schema pycrorm: {advice}")


async def test_a_schema_of_another_program_is_left_alone(server: Server, caplog: pytest.LogCaptureFixture) -> None:
    url = server.new_database()
    ask(url, "CREATE SCHEMA pycrorm")
    ask(url, "CREATE TABLE pycrorm.bookmarks (url text)")
    for create in (True, False):
        error = await refused(url, caplog, create=create)
        assert type(error) is DatabaseForeign
        assert str(error).endswith("has a schema 'pycrorm' of another program: it has no pycrorm_log")
    assert ask(url, "SELECT relname FROM pg_class WHERE relnamespace = 'pycrorm'::regnamespace AND relkind = 'r'") == [
        ("bookmarks",)
    ]


# === tls ======================================================================================================
#
# TLS to a PostgreSQL server, with libpq's parameters sslmode, sslrootcert, sslcert and sslkey.
#
# The server of the tests is built without TLS. A proxy ends the encryption before it, with PostgreSQL's own SSLRequest
# exchange, so that the driver behaves as with a server that encrypts.

SSL_REQUEST = bytes.fromhex("0000000804d2162f")


def openssl(folder: Path, *arguments: str) -> None:
    subprocess.run(["openssl", *arguments], cwd=folder, check=True, capture_output=True)


@pytest.fixture(scope="module")
def certificates(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """Return `ca.crt`, another `other.crt`, and `server` and `client` signed by the first; the server's is for
    localhost.
    """
    folder = tmp_path_factory.mktemp("certificates")
    key = ("-newkey", "ec", "-pkeyopt", "ec_paramgen_curve:prime256v1", "-nodes")
    for name in ("ca", "other"):
        usage = ("-subj", f"/CN={name}", "-addext", "keyUsage=critical,keyCertSign")
        openssl(folder, "req", "-x509", *key, "-keyout", f"{name}.key", "-out", f"{name}.crt", *usage)
    for name in ("server", "client"):
        openssl(folder, "req", *key, "-keyout", f"{name}.key", "-out", f"{name}.csr", "-subj", f"/CN={name}")
        # Python 3.13 accepts only certificates that name the key of their issuer.
        (folder / "extensions").write_text("subjectAltName=DNS:localhost\nauthorityKeyIdentifier=keyid:always\n")
        signed = ("-CA", "ca.crt", "-CAkey", "ca.key", "-CAcreateserial", "-extfile", "extensions")
        openssl(folder, "x509", "-req", "-in", f"{name}.csr", *signed, "-out", f"{name}.crt", "-days", "2")
    return folder


@asynccontextmanager
async def encrypting(server: Server, certificates: Path, *, asks: bool = False) -> AsyncIterator[int]:
    """Yield the port of a proxy that accepts only encrypted connections; with `asks`, only of known clients."""
    context = ssl.create_default_context(ssl.Purpose.CLIENT_AUTH, cafile=str(certificates / "ca.crt"))
    context.load_cert_chain(certificates / "server.crt", certificates / "server.key")
    context.verify_mode = ssl.CERT_REQUIRED if asks else ssl.CERT_NONE
    open_ones: set[asyncio.Task[None]] = set()

    async def pump(reader: asyncio.StreamReader, writer: asyncio.StreamWriter) -> None:
        with suppress(OSError):
            while part := await reader.read(2**16):
                writer.write(part)
                await writer.drain()
        writer.close()

    async def serve(reader: asyncio.StreamReader, writer: asyncio.StreamWriter) -> None:
        task = asyncio.current_task()
        assert task is not None
        open_ones.add(task)
        with suppress(OSError, asyncio.IncompleteReadError):
            if await reader.readexactly(8) == SSL_REQUEST:
                writer.write(b"S")
                await writer.drain()
                await writer.start_tls(context)
                behind = await asyncio.open_unix_connection(f"{server.folder}/.s.PGSQL.5432")
                await asyncio.gather(pump(reader, behind[1]), pump(behind[0], writer))
        writer.close()

    listening = await asyncio.start_server(serve, "127.0.0.1", 0)
    try:
        yield listening.sockets[0].getsockname()[1]
    finally:
        listening.close()
        for each in open_ones:
            each.cancel()
        await asyncio.gather(*open_ones, return_exceptions=True)


async def opened(url: str) -> None:
    log = await EventLog.open(DatabaseAddress.parse(url), create=True)
    await log.close()


@pytest.mark.parametrize(
    ("host", "parameters", "asks", "refused"),
    [
        ("localhost", "sslmode=verify-full&sslrootcert={}/ca.crt", False, None),
        ("127.0.0.1", "sslmode=verify-ca&sslrootcert={}/ca.crt", False, None),
        (
            "localhost",
            "sslmode=verify-full&sslrootcert={0}/ca.crt&sslcert={0}/client.crt&sslkey={0}/client.key",
            True,
            None,
        ),
        (
            "127.0.0.1",
            "sslmode=verify-full&sslrootcert={}/ca.crt",
            False,
            "certificate is not accepted: IP address mismatch",
        ),
        (
            "localhost",
            "sslmode=verify-full&sslrootcert={}/none.crt",
            False,
            "sslrootcert of the database's URL cannot be read",
        ),
        ("localhost", "sslmode=require", True, ""),
    ],
)
async def test_a_connection_is_encrypted_and_verified_as_the_url_demands(
    server: Server, certificates: Path, host: str, parameters: str, asks: bool, refused: str | None
) -> None:
    database = urlsplit(server.new_database()).path
    async with encrypting(server, certificates, asks=asks) as port:
        url = f"postgresql://postgres:s3cret@{host}:{port}{database}?{parameters.format(certificates)}"
        if refused is None:
            await opened(url)
            return
        with pytest.raises(DatabaseUnavailable) as caught:
            await opened(url)
        message = str(caught.value)
        assert refused in message
        assert "s3cret" not in message
        assert "\n" not in message


def test_the_printed_command_encrypts_as_the_url_demands() -> None:
    address = DatabaseAddress.parse("postgresql://u:s3cret@lab/m?sslmode=verify-full&sslrootcert=/ca.crt&passfile=x")
    assert address.to_type == "postgresql://u@lab/m?sslmode=verify-full&sslrootcert=%2Fca.crt"
