"""Name the memory that a verb opens, read from it, and warn about events that the answer cannot contain yet."""

from __future__ import annotations

import asyncio
from collections.abc import Awaitable, Callable
from pathlib import Path
from typing import TYPE_CHECKING, Annotated, NamedTuple, TypeVar

import typer

from pycrorm_async.cli.output import counted, note
from pycrorm_async.queue.spool import Spool
from pycrorm_async.store.address import DatabaseAddress, check_replica, shared_address

if TYPE_CHECKING:
    from pycrorm_async.query.reading import Reading
    from pycrorm_async.store.log import EventLog

T = TypeVar("T")

DEFAULT_URL = "sqlite:///pycrorm.db"

UrlOption = Annotated[
    str,
    typer.Option(
        "--url",
        envvar="PYCRORM_URL",
        help="The database: sqlite:///memory.db, sqlite:////absolute/path.db, postgresql://user@host/database."
        " The list of processes shows a password in this option; put it into the environment variable or ~/.pgpass.",
        show_envvar=True,
    ),
]
SpoolOption = Annotated[
    Path | None,
    typer.Option(
        "--spool", envvar="PYCRORM_SPOOL", help="Folder of the write-ahead queue; default: beside the database."
    ),
]


ReadUrlOption = Annotated[
    str | None,
    typer.Option(
        "--read-url",
        envvar="PYCRORM_READ_URL",
        help="A streaming replica of the PostgreSQL server, which answers in its place; a line says when it is behind.",
    ),
]


class Place(NamedTuple):
    """The memory that a verb opens: the URL of its database, and the folder of its write-ahead queue."""

    url: UrlOption = DEFAULT_URL
    spool: SpoolOption = None

    @property
    def address(self) -> DatabaseAddress:
        """The address of the database, of any kind."""
        return DatabaseAddress.parse(self.url)

    @property
    def shared_address(self) -> DatabaseAddress:
        """The address. Raises `CallerError` for `sqlite://`, as every verb that opens the memory of another process."""
        return shared_address(self.url)

    def note_pending_events(self) -> None:
        """Print a line on stderr for dead recorders with events left to store, and one for living recorders.

        Verbs that read never store these events themselves.
        """
        folders = Spool(self.spool or self.address.default_spool).recorders()
        recorders = [each for each in folders if each.refused is None]  # `pycrorm status` reports dead letters
        alive = sum(each.alive for each in recorders)
        dead = len(recorders) - alive
        if dead:
            option = f" --spool {self.spool}" if self.spool else ""
            note(
                f"{counted(dead, 'dead recorder')} left events that are not in the database:"
                f" run `pycrorm writer --once --url {self.address.to_type}{option}` to store them."
            )
        if alive:
            note(f"{alive} recorder{'s are' if alive > 1 else ' is'} running: the latest events may not be stored yet.")


class ReadingPlace(NamedTuple):
    """The memory that a verb reads: a `Place`, and the replica that answers instead of its database."""

    url: UrlOption = DEFAULT_URL
    spool: SpoolOption = None
    read_url: ReadUrlOption = None

    @property
    def place(self) -> Place:
        """The memory itself."""
        return Place(self.url, self.spool)

    @property
    def replica(self) -> DatabaseAddress | None:
        """The address of the replica. Raises `CallerError` if it can be none of this database."""
        if not self.read_url:
            return None
        replica = DatabaseAddress.parse(self.read_url)
        check_replica(replica, self.place.address)
        return replica

    def read(self, read: Callable[[Reading], Awaitable[T]]) -> T:
        """Open the memory, call `read` with it, and return the result; then note pending events."""
        from pycrorm_async.query.reading import Reading  # loads the mapped classes, which not every verb needs

        async def run() -> T:
            async with Reading.open(self.url, read_url=self.read_url) as reading:
                return await read(reading)

        shared_address(self.url)
        answer = asyncio.run(run())
        self.place.note_pending_events()
        return answer

    async def open_log(self) -> EventLog:
        """Open the log for reading."""
        from pycrorm_async.store.replica import open_to_read

        return await open_to_read(self.place.shared_address, self.replica)
