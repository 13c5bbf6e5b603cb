from __future__ import annotations

from pathlib import Path

import pytest
from sqlalchemy import text
from sqlalchemy.exc import OperationalError

from pycrorm_async.errors import UnknownUrl
from pycrorm_async.store.address import DatabaseAddress


@pytest.fixture
def database_url(tmp_path: Path) -> str:
    """Use SQLite alone: these tests are about files."""
    return f"sqlite:///{tmp_path / 'memory.db'}"


def test_three_slashes_name_a_file_in_the_working_directory_and_four_one_by_its_absolute_path(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.chdir(tmp_path)
    address = DatabaseAddress.parse("sqlite:///memory.db")
    monkeypatch.chdir("/")
    assert (address.path, address.default_spool) == (tmp_path / "memory.db", tmp_path / "memory.db.spool")
    address = DatabaseAddress.parse("sqlite:////data/lab 1/memory.db")
    assert (address.path, address.is_sqlite, address.is_private) == (Path("/data/lab 1/memory.db"), True, False)
    assert str(address) == "sqlite:////data/lab 1/memory.db"


async def test_a_path_may_contain_characters_that_a_url_must_escape_and_others_are_shown(tmp_path: Path) -> None:
    address = DatabaseAddress.parse(f"sqlite:///{tmp_path}/Ümläute 50%25 of%3F a #memory.db")
    assert address.path == tmp_path / "Ümläute 50% of? a #memory.db"
    assert str(address) == f"sqlite:///{tmp_path}/Ümläute 50%25 of%3F a %23memory.db"
    assert DatabaseAddress.parse(str(address)).path == address.path
    address.path.touch()
    engine = address.engine()
    async with engine.begin() as connection:
        await connection.execute(text("CREATE TABLE t (a)"))
    await engine.dispose()
    assert address.path.read_bytes()[:15] == b"SQLite format 3"


def test_no_text_of_an_address_contains_the_password() -> None:
    address = DatabaseAddress.parse("postgresql://robot:s3cret@lab:5433/memory?password=s3cret")
    assert str(address) == "postgresql://robot:***@lab:5433/memory"
    assert repr(address) == "DatabaseAddress('postgresql://robot:***@lab:5433/memory')"
    assert not address.is_sqlite
    by_socket = DatabaseAddress.parse("postgresql://robot:s3cret@/memory?host=/run/postgresql&passfile=s3cret")
    assert str(by_socket) == "postgresql://robot:***@/memory?host=/run/postgresql"


@pytest.mark.parametrize("scheme", ["postgres", "postgresql+psycopg", "postgresql+asyncpg", "sqlite+aiosqlite"])
def test_the_scheme_of_another_program_names_the_same_database(scheme: str) -> None:
    kind = "sqlite" if scheme.startswith("sqlite") else "postgresql"
    rest = "/memory.db" if kind == "sqlite" else "robot:s3cret@lab:5433/memory?sslmode=require"
    address, plain = (DatabaseAddress.parse(f"{each}://{rest}") for each in (scheme, kind))
    assert address == plain
    assert (str(address), address.to_type) == (str(plain), plain.to_type)
    assert address.engine().dialect.driver == ("aiosqlite" if kind == "sqlite" else "asyncpg")


@pytest.mark.parametrize(
    ("url", "reason"),
    [
        ("sqlite:///\udcff.db", "this is not a database URL"),
        ("mysql://u:s3cret@h/db", "mysql:// is not a supported database"),
        ("sqlite+pysqlcipher:///x.db", "sqlite+pysqlcipher:// is not a supported database"),
        ("postgresql+pg8000://u:s3cret@h/db", "postgresql+pg8000:// is not a supported database"),
        ("memory.db", "this is not a database URL"),
        ("", "this is not a database URL"),
        ("postgresql://u:s3cret@h:port/db", "this is not a database URL"),
        ("sqlite://memory.db", "a SQLite URL has three slashes, a path and nothing else"),
        ("sqlite:///memory.db?mode=ro", "a SQLite URL has three slashes, a path and nothing else"),
        ("sqlite:///", "'' is not a path"),
        ("sqlite:///:memory:", "':memory:' is not a path"),
        ("postgresql://u:s3cret@h", "a PostgreSQL URL names its database"),
        ("postgresql://u:my@s3cret@h/db", "an @ in a password is written %40"),
        ("postgresql://u:s3cret@h:99999/db", "a port is a number from 1 to 65535"),
        ("postgresql://u:s3cret@/db?port=s3cret", "a port is a number from 1 to 65535"),
        (
            "postgresql://u@h/db?s3cret=1",
            "a PostgreSQL URL takes the parameters host, port, sslmode, sslrootcert, sslcert, sslkey, password,",
        ),
        ("postgresql://u@h/db?sslmode=s3cret", "sslmode is one of disable, allow, prefer, require, verify-ca"),
    ],
)
def test_another_url_is_refused_with_the_supported_ones_and_without_its_password(url: str, reason: str) -> None:
    with pytest.raises(UnknownUrl) as caught:
        DatabaseAddress.parse(url)
    message = str(caught.value)
    assert message.startswith(reason)
    assert "; valid URLs: sqlite:///memory.db" in message
    assert "s3cret" not in message


async def test_an_engine_never_makes_a_missing_file(tmp_path: Path) -> None:
    address = DatabaseAddress.parse(f"sqlite:///{tmp_path}/memory.db")
    for engine in (address.engine(read_only=True), address.engine()):
        with pytest.raises(OperationalError, match="unable to open database file"):
            async with engine.connect():
                pass
        await engine.dispose()
    assert not address.path.exists()


async def test_a_commit_waits_for_the_disk_and_a_reader_cannot_write(address: DatabaseAddress) -> None:
    address.path.touch()
    writing, reading = address.engine(), address.engine(read_only=True)
    async with writing.begin() as connection:
        assert (await connection.execute(text("PRAGMA synchronous"))).scalar_one() == 2  # 2 is FULL
        await connection.execute(text("CREATE TABLE t (a)"))
    async with reading.connect() as connection:
        with pytest.raises(OperationalError, match="readonly database"):
            await connection.execute(text("INSERT INTO t VALUES (1)"))
    await writing.dispose()
    await reading.dispose()
