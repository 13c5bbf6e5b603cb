"""TLS to a PostgreSQL server, with libpq's parameters sslmode, sslrootcert, sslcert and sslkey.

The server of the tests is built without TLS. A proxy ends the encryption before it, with PostgreSQL's own SSLRequest
exchange, so that the driver behaves as with a server that encrypts.
"""

from __future__ import annotations

import asyncio
import ssl
import subprocess
from collections.abc import AsyncIterator
from contextlib import asynccontextmanager, suppress
from pathlib import Path
from urllib.parse import urlsplit

import pytest

from pycrorm_async.errors import DatabaseUnavailable
from pycrorm_async.store.address import DatabaseAddress
from pycrorm_async.store.log import EventLog
from tests.databases import Server

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
        ("localhost", "sslmode=require", False, None),
        ("localhost", "sslmode=prefer", False, None),
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
        ("localhost", "sslmode=verify-ca&sslrootcert={}/other.crt", False, "certificate is not accepted"),
        (
            "localhost",
            "sslmode=verify-full&sslrootcert={}/none.crt",
            False,
            "sslrootcert of the database's URL cannot be read",
        ),
        ("localhost", "sslmode=require", True, ""),
        ("localhost", "sslmode=disable", False, ""),
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
