"""The event log of one database: append to it, read it.

log = await EventLog.open(DatabaseAddress.parse("sqlite:///memory.db"), create=True)
await log.append(records)
for episode in await log.episodes(): ...
await log.close()
"""

from __future__ import annotations

import asyncio
import logging
import os
import uuid
from collections.abc import AsyncIterator, Iterator, Mapping, Sequence
from contextlib import asynccontextmanager, contextmanager, nullcontext
from pathlib import Path
from types import MappingProxyType

from sqlalchemy.ext.asyncio import AsyncConnection, AsyncEngine

from pycrorm_async.clock import SYSTEM_CLOCK, Clock
from pycrorm_async.errors import DatabaseUnavailable, LogDamaged, PycrormError
from pycrorm_async.events.envelope import Record
from pycrorm_async.events.ids import EPISODE_NUMBER_MAX, EpisodeId, episode_text
from pycrorm_async.settings import FileAccess
from pycrorm_async.store.address import BUSY_TIMEOUT_S, DatabaseAddress
from pycrorm_async.store.append import Appending
from pycrorm_async.store.dialect import Dialect, Progress, StoredOn
from pycrorm_async.store.dialects import dialect_of
from pycrorm_async.store.limits import EVENTS_MANY, events_warning, number_warning
from pycrorm_async.store.schema import Birth, make_file, make_or_migrate, must_exist, recognise
from pycrorm_async.store.sqlite.engine import BEGIN
from pycrorm_async.store.stored import (
    NOTHING_KNOWN,
    Basis,
    EpisodeRow,
    Incarnation,
    Span,
    Stored,
    StoredEvent,
    beyond,
    share_out,
)

__all__ = ["EventLog", "advance_folded", "park"]

_log = logging.getLogger("pycrorm_async")
_MANY_EVENTS = 1_000
"""So many are worth a look before the transaction that stores them."""
_PAGE_EVENTS = 250
"""Few enough for a page to be small in memory also when each of them is as large as an event can be."""


class EventLog:
    """An open log; it belongs to the loop it was opened in. Every method raises `DatabaseUnavailable` when the database
    is away, after waiting `busy_timeout_s` for another writer, and may then be called again."""

    def __init__(self, *, address: DatabaseAddress, engine: AsyncEngine, log_id: str, writable: bool) -> None:
        self.address = address
        self.writes = 0
        """How many transactions that write were committed."""
        self.advice = "put it back, or open the memory again"
        """What the user can do about a SQLite file that is gone."""
        self.engine = engine
        self.log_id = log_id
        self._process = os.getpid()
        self._reads = engine.execution_options(**{BEGIN: "BEGIN"})
        self._dialect = dialect_of(engine)
        self._file = _identity(address.path) if address.is_sqlite and writable else None
        self._turn = asyncio.Lock() if address.is_sqlite else None
        self._warned: set[str] = set()

    @classmethod
    async def open(
        cls,
        address: DatabaseAddress,
        *,
        create: bool,
        busy_timeout_s: float = BUSY_TIMEOUT_S,
        clock: Clock = SYSTEM_CLOCK,
        file_access: FileAccess = "owner",
        belongs_to: str | None = None,
    ) -> EventLog:
        """Opens the log at a located address.

        With `create` it can be appended to, and is made or brought up to date if need be; but an empty database is not
        made one where the log of the id `belongs_to` should be, which may be restored at this moment. Without `create`
        it can only be read and nothing is written. `file_access` is that of a SQLite file that is made.

        Raises `DatabaseUnavailable` (no such database, no way to it) or `DatabaseForeign`
        (another program's, a newer version's).
        """
        engine = address.engine(read_only=not create, busy_timeout_s=busy_timeout_s)
        name = str(address)
        try:
            with _translated(dialect_of(engine), name):
                if create:
                    if address.is_sqlite:
                        make_file(address.path, name, file_access, belongs_to=belongs_to)
                    birth = Birth(str(uuid.uuid4()), clock.wall_ns())
                    log_id = await make_or_migrate(engine, name, birth=birth, belongs_to=belongs_to)
                else:
                    if address.is_sqlite:
                        must_exist(address.path, name)
                    async with engine.connect() as connection:
                        log_id = await recognise(connection, name)
            return cls(address=address, engine=engine, log_id=log_id, writable=create)
        except BaseException:
            await engine.dispose()
            raise

    @contextmanager
    def translated(self) -> Iterator[None]:
        """Inside, a fault of the database is raised as the error of ours it is: for what others do with `engine`."""
        with _translated(self._dialect, str(self.address)):
            yield

    async def close(self) -> None:
        """Closes every connection. In a forked child it does nothing: connections and threads are the parent's."""
        if os.getpid() == self._process:
            await self.engine.dispose()

    # --- append -----------------------------------------------------------------------------------------------

    async def append(self, records: Sequence[Record]) -> dict[EpisodeId, str]:
        """Stores a batch, whole or not at all, durable when it returns. Gives why episodes refused records.

        What is stored already with the same bytes is stored once. Of an episode with a gap, or a record no database can
        hold, what comes before that is stored; the rest must be kept elsewhere and given again. Raises `LogDamaged`,
        and stores nothing, when a record's key holds another event.
        """
        return dict((await self.store(records)).refusals)

    async def store(self, records: Sequence[Record], basis: Basis = NOTHING_KNOWN) -> Stored:
        """As `append`, but for a log that holds less than the basis says: raises `LogWentBack` and stores nothing."""
        if not records:
            return Stored({}, {})
        with self.translated():
            appending = Appending(self._dialect, records, basis)
            if self._turn is not None and len(records) >= _MANY_EVENTS:
                async with self.reading() as connection:
                    await appending.prepare(connection)
            async with self.writing() as connection:
                stored = await appending.write(connection)
        for what, warning in appending.warnings.items():
            if what not in self._warned:
                self._warned.add(what)
                _log.warning("%s: %s", self.address, warning)
        return stored

    async def heads(self, episodes: Sequence[EpisodeId]) -> dict[EpisodeId, EpisodeRow]:
        """How far each of these episodes is; without those of which nothing is stored."""
        names = {episode_text(each): each for each in episodes}
        async with self.reading() as connection:
            return {names[row.id]: row for row in await self._dialect.heads(connection, list(names))}

    async def skip_numbers(self, above: int) -> None:
        """No new episode gets a number up to `above`, nor one of the reserve behind it."""
        with self.translated():
            async with self.writing() as connection:
                await self._dialect.skip_numbers(connection, above)

    async def note_incarnation(self, noticed_wall_ns: int, noticed_by: str, reason: str) -> None:
        """Notes that the log went back. Raises `DatabaseError` also where this role may not."""
        with self.translated():
            async with self.writing() as connection:
                await self._dialect.note_incarnation(connection, Incarnation(noticed_wall_ns, noticed_by, reason))

    async def incarnations(self) -> list[Incarnation]:
        """Each time that the log was found to have gone back, the oldest first."""
        async with self.reading() as connection:
            return await self._dialect.incarnations(connection)

    async def stored_on(self) -> StoredOn:
        """On how many machines an event is when it is stored."""
        async with self.reading() as connection:
            return await self._dialect.stored_on(connection)

    @property
    def loss(self) -> str | None:
        """Why nothing may be written: the SQLite file was removed or replaced. None while it is there, and of a server.

        SQLite itself goes on writing into such a file, where nobody will find it.
        """
        if self._file is None or _identity(self.address.path) == self._file:
            return None
        return f"{self.address}: the file was removed or replaced while it was open; {self.advice}"

    # --- read -------------------------------------------------------------------------------------------------

    async def episodes(self) -> list[EpisodeRow]:
        """Every episode, by number."""
        async with self.reading() as connection:
            return await self._dialect.episodes(connection)

    async def episode(self, episode: EpisodeId) -> EpisodeRow | None:
        """How far an episode is here; None if nothing of it is stored."""
        async with self.reading() as connection:
            return await self._dialect.episode(connection, episode_text(episode))

    async def episode_number(self, episode: EpisodeId) -> int | None:
        """The number of an episode here; None if nothing of it is stored."""
        found = await self.episode(episode)
        return found.number if found is not None else None

    async def events(self, number: int, *, after: int = 0, limit: int = 10_000) -> list[StoredEvent]:
        """The events of an episode that follow sequence `after`, at most `limit`."""
        async with self.reading() as connection:
            return await self._dialect.events(connection, number, after=after, limit=limit)

    async def pages(self, episode: EpisodeRow, *, after: int = 0) -> AsyncIterator[list[StoredEvent]]:
        """The same up to the episode's head, a few at a time. Raises `LogDamaged` at the first that is missing."""
        while after < episode.head:
            limit = min(_PAGE_EVENTS, episode.head - after)
            page = await self.events(episode.number, after=after, limit=limit)
            whole = [event for sequence, event in enumerate(page, after + 1) if event.sequence == sequence]
            if whole:
                yield whole
            after += len(whole)
            if len(whole) < limit:
                raise LogDamaged(episode.id, after + 1, f"is missing in {self.address}")

    async def spans(self, spans: Sequence[Span]) -> list[StoredEvent]:
        """The events of each span, in the order of the spans."""
        async with self.reading() as connection:
            return await self._dialect.spans(connection, spans)

    async def unfolded(
        self, limit: int = 10_000, *, after: int = 0, reached: Mapping[int, int] = MappingProxyType({})
    ) -> list[Span]:
        """What the tables do not show yet, at most `limit` events, some of each episode; nothing of parked episodes.

        Begins with the episodes that follow number `after`, and with the first one when there are none. `reached` is
        how far episodes are, by number, once what is being folded is in the tables.
        """
        async with self.reading() as connection:
            behind = beyond(await self._dialect.behind(connection, after=after, limit=limit), reached)
            if not behind and after:
                behind = beyond(await self._dialect.behind(connection, after=0, limit=limit), reached)
            return share_out(behind, limit)

    async def behind(self) -> list[EpisodeRow]:
        """The episodes of which the tables do not show all; without the parked ones."""
        async with self.reading() as connection:
            return await self._dialect.behind(connection, after=0, limit=EPISODE_NUMBER_MAX)

    async def stopped(self) -> list[EpisodeRow]:
        """The episodes that the log refused something of, or that are parked; the rows say why."""
        async with self.reading() as connection:
            return await self._dialect.stopped(connection)

    async def limits_near(self) -> list[str]:
        """A sentence for each limit of numbers that the memory, or an episode that has not ended, comes near."""
        async with self.reading() as connection:
            last = await self._dialect.last_number(connection)
            episodes = await self._dialect.long_episodes(connection, EVENTS_MANY)
        return [each for each in (number_warning(last), *map(events_warning, episodes)) if each is not None]

    async def declarations(self) -> list[bytes]:
        """The payloads of all DesignatorTypeDeclared, in the order of their first arrival."""
        async with self.reading() as connection:
            return await self._dialect.declarations(connection)

    @asynccontextmanager
    async def writing(self) -> AsyncIterator[AsyncConnection]:
        """A transaction that writes, committed at the end. Those of this log wait for each other here if the database
        has one writer at a time: whoever waits there sleeps and looks again, and looks too late."""
        async with self._turn or nullcontext():
            self._check_file()  # a new connection would write into the file that is there now
            async with self.engine.begin() as connection:
                yield connection
                await self._dialect.commit(connection)
        self._check_file()
        self.writes += 1

    def _check_file(self) -> None:
        if (loss := self.loss) is not None:
            raise DatabaseUnavailable(loss)

    @asynccontextmanager
    async def snapshot(self) -> AsyncIterator[AsyncConnection]:
        """A connection whose transaction sees everything as it is at one moment."""
        async with self.reading() as connection:
            await self._dialect.hold_still(connection)
            yield connection

    @asynccontextmanager
    async def reading(self) -> AsyncIterator[AsyncConnection]:
        """A connection for reading, which waits for nobody who writes and for which nobody waits."""
        self._check_file()
        with self.translated():
            async with self._reads.connect() as connection:
                yield connection


def _identity(path: Path) -> tuple[int, int] | None:
    try:
        status = path.stat()
    except OSError:
        return None
    return status.st_dev, status.st_ino


@contextmanager
def _translated(dialect: Dialect, name: str) -> Iterator[None]:
    try:
        yield
    except PycrormError:
        raise
    except dialect.faults as error:
        raise dialect.ours(error, name) from error


async def advance_folded(connection: AsyncConnection, steps: Sequence[Progress]) -> bool:
    """Notes (episode number, folded before, folded now) of each episode.

    False if one of them is not where the caller believed: someone else folded it, and the caller must roll back.
    """
    return await dialect_of(connection).advance_folded(connection, steps) == len(steps)


async def park(connection: AsyncConnection, number: int, reason: str | None) -> None:
    """Stops folding an episode, with the reason; None releases it. The log goes on taking its events."""
    await dialect_of(connection).park(connection, number, reason)
