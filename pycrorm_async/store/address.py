"""Parse a database's URL once, and never show its password again.

    sqlite:///memory.db                 a file, relative to the working directory at that moment
    sqlite:////data/memory.db           a file by its absolute path
    sqlite://                           private to this process, in memory, deleted when it is closed
    postgresql://user@host/database     a server

The program chooses the driver; a URL written for another driver (`_SCHEMES`) means the same database.
"""

from __future__ import annotations

import fcntl
import os
import re
import shutil
import tempfile
from collections.abc import Iterator
from contextlib import contextmanager, suppress
from dataclasses import dataclass, replace
from pathlib import Path
from urllib.parse import unquote

from sqlalchemy import URL, make_url
from sqlalchemy.exc import ArgumentError
from sqlalchemy.ext.asyncio import AsyncEngine

from pycrorm_async.errors import CallerError, DatabaseUnavailable, UnknownUrl
from pycrorm_async.store import postgresql_engine as postgresql
from pycrorm_async.store import sqlite_engine as sqlite
from pycrorm_async.store.placement import Shard

BUSY_TIMEOUT_S = 5.0
"""Bounds the wait of a statement for another writer; beyond it the database counts as unavailable."""

_SCHEMES = {
    "sqlite": "sqlite",
    "sqlite+aiosqlite": "sqlite",
    "postgresql": "postgresql",
    "postgres": "postgresql",
    "postgresql+asyncpg": "postgresql",
    "postgresql+psycopg": "postgresql",
}
"""The database by URL scheme, as hosting services, libpq and SQLAlchemy write it."""

_HARMLESS = frozenset({"host", "port", "user", *postgresql.TLS})
"""Query parameters that locate a server and are not secret."""

_BEYOND_ASCII = re.compile("(?:%[89A-F][0-9A-F])+")
"""Escaped letters that are not ASCII, which a URL may have unescaped."""

_VALID_URLS = (
    "valid URLs: sqlite:///memory.db (a file here), sqlite:////data/memory.db (a file by its absolute path),"
    " sqlite:// (private, gone when closed), postgresql://user@host/database (a server)"
)


@dataclass(frozen=True, repr=False)
class DatabaseAddress:
    """A database's address; `str` returns the URL without its password.

    >>> str(DatabaseAddress.parse("postgresql://robot:secret@lab/memory"))
    'postgresql://robot:***@lab/memory'
    """

    _url: URL
    _path: Path | None

    @classmethod
    def parse(cls, url: str) -> DatabaseAddress:
        """Parse a URL. Raises `UnknownUrl`, with the valid forms, for any other scheme or form."""
        try:
            url.encode()  # of an argument that is not UTF-8, the interpreter makes halves of surrogate pairs
            parsed = make_url(url)
        except (ArgumentError, ValueError):  # no message repeats the URL, which may hold a password
            raise UnknownUrl(f"this is not a database URL; {_VALID_URLS}") from None
        database = _SCHEMES.get(parsed.drivername)
        if database is None:
            raise UnknownUrl(f"{parsed.drivername}:// is not a supported database; {_VALID_URLS}")
        parsed = parsed.set(drivername=database)
        if database == "sqlite":
            return cls(parsed, _sqlite_path(parsed))
        if reason := postgresql.refusal_of_url(parsed):
            raise UnknownUrl(f"{reason}; {_VALID_URLS}")
        return cls(parsed, None)

    @property
    def is_sqlite(self) -> bool:
        return self._url.drivername == "sqlite"

    @property
    def is_private(self) -> bool:
        """True if this is `sqlite://`."""
        return self.is_sqlite and self._url.database is None

    @property
    def path(self) -> Path:
        """The absolute path of a SQLite file; a private database has one only inside `located()`."""
        assert self._path is not None, f"{self} has no path"
        return self._path

    @property
    def database(self) -> str | None:
        """The name of the database on a server; the path of a SQLite file as in the URL."""
        return self._url.database

    @property
    def default_spool(self) -> Path:
        """The default spool: `x.db.spool` beside `x.db`; `database.spool` in the working directory for a server."""
        if self.is_sqlite:
            return self.path.with_name(f"{self.path.name}.spool")
        return Path(f"{self._url.database}.spool").absolute()

    @contextmanager
    def located(self) -> Iterator[DatabaseAddress]:
        """Give a private database a path for the duration of the context: create its folder, and remove it at the end.

        >>> with DatabaseAddress.parse("sqlite://").located() as address:
        ...     address.path.name
        'memory.db'
        """
        if not self.is_private or self._path is not None:
            yield self
            return
        with private_folder(usual_place()) as folder:
            yield replace(self, _path=folder / "memory.db")

    def engine(self, *, read_only: bool = False, busy_timeout_s: float = BUSY_TIMEOUT_S) -> AsyncEngine:
        """Create an engine with the right driver and settings, for use in one loop.

        It never creates a missing file. A transaction takes the write lock at its start; in a `read_only` engine it is
        a snapshot. Raises `DatabaseUnavailable` for settings of the URL that cannot be used.
        """
        if not self.is_sqlite:
            return postgresql.make_engine(self._url, read_only=read_only, busy_timeout_s=busy_timeout_s)
        return sqlite.make_engine(self.path, read_only=read_only, busy_timeout_s=busy_timeout_s)

    def as_shard(self) -> Shard:
        """Return this database on a server as one that keeps events of a memory."""
        where = {name: self._url.normalized_query.get(name, ("",))[-1] for name in postgresql.WHERE}
        url = self._url
        host, port = url.host or where["host"] or "localhost", str(url.port or where["port"] or 5432)
        return Shard(host, port, url.database or "", url.username, str(url.password) if url.password else None)

    @property
    def to_type(self) -> str:
        """The URL for a command line, without its password and without parameters that lead to one.

        >>> DatabaseAddress.parse("postgresql://robot:secret@lab/memory?host=/tmp&passfile=x").to_type
        'postgresql://robot@lab/memory?host=/tmp'
        """
        query = {name: value for name, value in self._url.query.items() if name in _HARMLESS}
        url = URL.create(
            self._url.drivername, self._url.username, None, self._url.host, self._url.port, self._url.database, query
        )
        return url.render_as_string()

    def __str__(self) -> str:
        # Most query parameters are left out, because drivers accept passwords there.
        public_query = {name: value for name, value in self._url.query.items() if name in postgresql.WHERE}
        url = self._url.set(query=public_query).render_as_string(hide_password=True)
        return _BEYOND_ASCII.sub(lambda escaped: unquote(escaped[0]), url.replace("%2F", "/"))

    def __repr__(self) -> str:
        return f"DatabaseAddress({str(self)!r})"


def _sqlite_path(url: URL) -> Path | None:
    if url.host or url.username or url.query:
        raise UnknownUrl(f"a SQLite URL has three slashes, a path and nothing else; {_VALID_URLS}")
    if url.database is None:
        return None
    if url.database in ("", ":memory:") or url.database.startswith("file:"):
        raise UnknownUrl(f"{url.database!r} is not a path; {_VALID_URLS}")
    return Path(url.database).absolute()


def no_tables(address: DatabaseAddress) -> str:
    """Return the reason why a log without tables cannot be read, with the command that makes them."""
    return f"{address} has a log but no tables yet: run `pycrorm writer --once --url {address.to_type}`"


# === temporary database =======================================================================================
#
# Create the folder behind `sqlite://`: private to one process, in shared memory if possible, removed at the end.
#
# The database is a file and not SQLite's `:memory:`, because the writer thread and the readers need one that several
# connections share. Only the owner can enter the folder, which is locked by `flock` while its process lives. The next
# process of the same user removes the folders that it can lock, which killed processes left.
#
# Every user may write to the parent folder. So no name there is predictable, and a process touches only folders of its
# own user. A process may remove a folder between its creation and its locking; the creator detects that and creates
# another.

_ATTEMPTS = 100
"""Bounds the attempts to create a folder; each fails only if another process sweeps at that moment."""


def usual_place() -> Path:
    """Return `/dev/shm` if it is writable, else the temporary folder."""
    shared_memory = Path("/dev/shm")  # noqa: S108 - mkdtemp creates the folders for their owner alone
    return shared_memory if os.access(shared_memory, os.W_OK | os.X_OK) else Path(tempfile.gettempdir())


@contextmanager
def private_folder(parent: Path) -> Iterator[Path]:
    """Create a folder below `parent` for the duration of the context. Raises `DatabaseUnavailable`."""
    prefix = f"pycrorm-private-{os.geteuid()}-"  # of earlier versions a file in the folder is locked, not the folder
    try:
        _sweep(parent, prefix)
        folder, lock = _make_locked(parent, prefix)
    except OSError as error:
        raise DatabaseUnavailable(f"sqlite:// needs a folder in {parent}: {error.strerror}") from error
    owner = os.getpid()
    try:
        yield folder
    finally:
        if os.getpid() == owner:  # a forked child must not remove its parent's folder
            shutil.rmtree(folder, ignore_errors=True)
        os.close(lock)


def _make_locked(parent: Path, prefix: str) -> tuple[Path, int]:
    """Create a folder; return it with the descriptor that locks it."""
    for _ in range(_ATTEMPTS):
        folder = Path(tempfile.mkdtemp(prefix=prefix, dir=parent))
        with suppress(FileNotFoundError, BlockingIOError):
            lock = _lock(folder)
            if folder.exists():
                return folder, lock
            os.close(lock)
    raise FileNotFoundError(None, f"{_ATTEMPTS} new folders were removed at once")


def _sweep(parent: Path, prefix: str) -> None:
    for entry in [each for each in os.scandir(parent) if each.name.startswith(prefix)]:
        with suppress(OSError):  # it is no folder, its process lives, or another process sweeps it
            if entry.stat(follow_symlinks=False).st_uid == os.geteuid():
                lock = _lock(Path(entry.path))
                shutil.rmtree(entry.path, ignore_errors=True)
                os.close(lock)


def _lock(folder: Path) -> int:
    descriptor = os.open(folder, os.O_RDONLY | os.O_DIRECTORY | os.O_NOFOLLOW | os.O_CLOEXEC)
    try:
        fcntl.flock(descriptor, fcntl.LOCK_EX | fcntl.LOCK_NB)
    except OSError:
        os.close(descriptor)
        raise
    return descriptor


def shared_address(url: str | DatabaseAddress) -> DatabaseAddress:
    """The address of a database that another process can open too. Raises `UnknownUrl`, `CallerError`."""
    address = DatabaseAddress.parse(url) if isinstance(url, str) else url
    if address.is_private:
        raise CallerError("sqlite:// exists only in its own process, no other can open it: name a file")
    return address


def check_replica(replica: DatabaseAddress, primary: DatabaseAddress) -> None:
    """Raise `CallerError` for an address that cannot be a replica of this one."""
    if replica.is_sqlite or primary.is_sqlite or replica.database != primary.database:
        raise CallerError(
            f"{replica} is no replica of {primary}: a replica of a PostgreSQL server has the same databases; leave"
            " --read-url (PYCRORM_READ_URL, read_url) out for this memory"
        )
