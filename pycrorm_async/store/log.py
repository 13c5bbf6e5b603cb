"""Append to the event log of one database, and read it.

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
from collections.abc import AsyncIterator, Collection, Iterator, Mapping, Sequence
from contextlib import asynccontextmanager, contextmanager, nullcontext
from pathlib import Path
from types import MappingProxyType

from sqlalchemy.ext.asyncio import AsyncConnection, AsyncEngine

from pycrorm_async.clock import SYSTEM_CLOCK, Clock
from pycrorm_async.errors import DatabaseUnavailable, LogDamaged, PycrormError
from pycrorm_async.events.codec import declared_dtype, fingerprint
from pycrorm_async.events.envelope import Record
from pycrorm_async.events.ids import EPISODE_NUMBER_MAX, EpisodeId, episode_text
from pycrorm_async.settings import FileAccess
from pycrorm_async.store.address import BUSY_TIMEOUT_S, DatabaseAddress
from pycrorm_async.store.append import Appending
from pycrorm_async.store.blobs import Blobs
from pycrorm_async.store.dialect import Birth, Dialect, Progress, StoredOn
from pycrorm_async.store.dialects import dialect_of
from pycrorm_async.store.digests.digest_table import RunningDigests, last_digests
from pycrorm_async.store.digests.episode_digest import DigestRow
from pycrorm_async.store.limits import EVENTS_MANY, events_warning, number_warning
from pycrorm_async.store.schema import make_file, make_or_migrate, must_exist, recognise
from pycrorm_async.store.sqlite.engine import BEGIN, READ
from pycrorm_async.store.stored import (
    NOTHING_KNOWN,
    Basis,
    EpisodeRow,
    Incarnation,
    Span,
    Stored,
    StoredEvent,
    beyond,
    consecutive,
    share_out,
)

_log = logging.getLogger("pycrorm_async")
_MANY_EVENTS = 1_000
"""Batch size from which preparing the append before its transaction pays off."""
_PAGE_EVENTS = 250
"""Bounds the events of a page, so that its memory stays small even if each has the maximal size."""


class EventLog:
    """An open log; it belongs to the loop it was opened in.

    Every method raises `DatabaseUnavailable` if the database does not answer, or after waiting `busy_timeout_s` for
    another writer; the call may then be repeated.
    """

    def __init__(self, *, address: DatabaseAddress, engine: AsyncEngine, log_id: str, writable: bool) -> None:
        self.address = address
        self.writes = 0
        """Number of committed writing transactions."""
        self.advice = "put it back, or open the memory again"
        """Advice to the user about a missing SQLite file."""
        self.engine = engine
        self.log_id = log_id
        self._process = os.getpid()
        self._reads = engine.execution_options(**{BEGIN: READ})
        self._dialect = dialect_of(engine)
        self._file = _identity(address.path) if address.is_sqlite and writable else None
        self._write_turn = asyncio.Lock() if address.is_sqlite else None
        self._warned: set[str] = set()
        self.blobs = Blobs(self._dialect, self.reading, self.writing)
        self.digests: RunningDigests | None = RunningDigests(self._dialect)
        """The digests of the episodes that this process appends to; None, for a benchmark, stores none."""

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
        """Open the log at a located address.

        With `create` the log is writable, and is created or migrated if necessary; otherwise it is read-only and
        nothing is written. `belongs_to` is the id of the expected log: if it is given, no log is created in an empty
        database, because a restore may be running. `file_access` applies to a new SQLite file.

        Raises `DatabaseUnavailable` (no such database, or no connection to it) or `DatabaseForeign` (another program's
        or a newer version's).
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
        """Translate driver errors raised inside to errors of this package; for code that uses `engine` directly."""
        with _translated(self._dialect, str(self.address)):
            yield

    async def close(self) -> None:
        """Close every connection. Does nothing in a forked child, because the connections belong to the parent."""
        if os.getpid() == self._process:
            await self.engine.dispose()

    # --- append -----------------------------------------------------------------------------------------------

    async def append(self, records: Sequence[Record]) -> dict[EpisodeId, str]:
        """Store a batch in one transaction, durable on return; return the reasons of refusals by episode.

        Records stored before with the same bytes are stored once. Of an episode with a gap, or with a record that no
        database can hold, the records before it are stored; the caller must keep the rest and append it later. Raises
        `LogDamaged`, and stores nothing, if another event is stored under a record's key.
        """
        return dict((await self.store(records)).refusals)

    async def store(self, records: Sequence[Record], basis: Basis = NOTHING_KNOWN) -> Stored:
        """Append, but raise `LogWentBack`, and store nothing, if the log holds less than `basis` states."""
        if not records:
            return Stored({}, {})
        with self.translated():
            await self.blobs.store_for(records)  # again, because the log may have lost them since
            appending = Appending(self._dialect, records, basis, self.digests)
            if self._write_turn is not None and len(records) >= _MANY_EVENTS:
                async with self.reading() as connection:
                    await appending.prepare(connection)
            async with self.writing() as connection:
                stored = await appending.write(connection)
            if self.digests is not None and appending.extension is not None:
                self.digests.keep(appending.extension)
        for subject, warning in appending.warnings.items():
            if subject not in self._warned:
                self._warned.add(subject)
                _log.warning("%s: %s", self.address, warning)
        return stored

    async def store_blobs(self, records: Sequence[Record]) -> None:
        """Store the blobs that these records refer to, durable on return. `store` does so as well."""
        with self.translated():
            await self.blobs.store_for(records)

    async def heads(self, episodes: Sequence[EpisodeId]) -> dict[EpisodeId, EpisodeRow]:
        """Read the rows of these episodes, without those that have no stored event."""
        names = {episode_text(each): each for each in episodes}
        async with self.reading() as connection:
            return {names[row.id]: row for row in await self._dialect.heads(connection, list(names))}

    async def skip_numbers(self, above: int) -> None:
        """Never assign the numbers up to `above`, nor the reserve behind it, to new episodes."""
        with self.translated():
            async with self.writing() as connection:
                await self._dialect.skip_numbers(connection, above)

    async def note_incarnation(self, noticed_wall_ns: int, noticed_by: str, reason: str) -> None:
        """Record that the log went back. Raises `DatabaseError` also if this role lacks the privilege."""
        with self.translated():
            async with self.writing() as connection:
                await self._dialect.note_incarnation(connection, Incarnation(noticed_wall_ns, noticed_by, reason))

    async def incarnations(self) -> list[Incarnation]:
        """Read each time the log went back, the oldest first."""
        async with self.reading() as connection:
            return await self._dialect.incarnations(connection)

    async def stored_on(self) -> StoredOn:
        """Return the number of machines that hold a stored event."""
        async with self.reading() as connection:
            return await self._dialect.stored_on(connection)

    @property
    def loss(self) -> str | None:
        """The reason not to write: the SQLite file was removed or replaced. None if it is in place, and for a server.

        SQLite itself would keep writing into the removed file, and the events would be lost.
        """
        if self._file is None or _identity(self.address.path) == self._file:
            return None
        return f"{self.address}: the file was removed or replaced while it was open; {self.advice}"

    # --- read -------------------------------------------------------------------------------------------------

    async def episodes(self) -> list[EpisodeRow]:
        """Read every episode, by number."""
        async with self.reading() as connection:
            return await self._dialect.episodes(connection)

    async def episode(self, episode: EpisodeId) -> EpisodeRow | None:
        """Read an episode's row; None if no event of it is stored."""
        async with self.reading() as connection:
            return await self._dialect.episode(connection, episode_text(episode))

    async def last_digests(self) -> dict[int, DigestRow]:
        """Read the last kept digest of each episode that has one, by number."""
        async with self.reading() as connection:
            return await last_digests(self._dialect, connection)

    async def episode_number(self, episode: EpisodeId) -> int | None:
        """Return an episode's number; None if no event of it is stored."""
        row = await self.episode(episode)
        return row.number if row is not None else None

    async def events(self, number: int, *, after: int = 0, limit: int = 10_000) -> list[StoredEvent]:
        """Read at most `limit` events of an episode, behind sequence `after`."""
        async with self.reading() as connection:
            return await self._dialect.events(connection, number, after=after, limit=limit)

    async def pages(self, episode: EpisodeRow, *, after: int = 0) -> AsyncIterator[Sequence[StoredEvent]]:
        """Yield the events up to the episode's head in pages. Raises `LogDamaged` at the first missing event."""
        while after < episode.head:
            limit = min(_PAGE_EVENTS, episode.head - after)
            whole = consecutive(await self.events(episode.number, after=after, limit=limit), after)
            if whole:
                yield whole
            after += len(whole)
            if len(whole) < limit:
                raise LogDamaged(episode.id, after + 1, f"is missing in {self.address}")

    async def spans(self, spans: Sequence[Span]) -> list[StoredEvent]:
        """Read the events of each span, in the order of the spans."""
        async with self.reading() as connection:
            return await self._dialect.spans(connection, spans)

    async def unfolded(
        self, limit: int = 10_000, *, after: int = 0, reached: Mapping[int, int] = MappingProxyType({})
    ) -> list[Span]:
        """Return spans of unfolded events, at most `limit` in total, some of each episode; without parked episodes.

        Begins with the episodes whose number is above `after`, or with the first if there are none. `reached` is the
        last sequence, by number, of a fold that is running.
        """
        async with self.reading() as connection:
            behind = beyond(await self._dialect.behind(connection, after=after, limit=limit), reached)
            if not behind and after:
                behind = beyond(await self._dialect.behind(connection, after=0, limit=limit), reached)
            return share_out(behind, limit)

    async def behind(self) -> list[EpisodeRow]:
        """Read the episodes with unfolded events, without parked ones."""
        async with self.reading() as connection:
            return await self._dialect.behind(connection, after=0, limit=EPISODE_NUMBER_MAX)

    async def stopped(self) -> list[EpisodeRow]:
        """Read the refused and parked episodes; the rows hold the reasons."""
        async with self.reading() as connection:
            return await self._dialect.stopped(connection)

    async def limits_near(self) -> list[str]:
        """Return a warning for each limit of numbers that the memory, or an episode that has not ended, comes near."""
        async with self.reading() as connection:
            last = await self._dialect.last_number(connection)
            episodes = await self._dialect.long_episodes(connection, EVENTS_MANY)
        return [each for each in (number_warning(last), *map(events_warning, episodes)) if each is not None]

    async def declarations(self) -> list[bytes]:
        """Read the payloads of all DesignatorTypeDeclared, in the order of first arrival."""
        async with self.reading() as connection:
            return await self._dialect.declarations(connection)

    async def dtypes(self) -> dict[str, str]:
        """Read the dtypes of all declared designator types, by fingerprint, without those that cannot be read."""
        dtypes = {fingerprint(each): declared_dtype(each) for each in await self.declarations()}
        return {name: dtype for name, dtype in dtypes.items() if dtype is not None}

    async def descriptions(self, fingerprints: Collection[str]) -> dict[str, bytes]:
        """Read the payloads of these DescriptionDeclared, by fingerprint; those that are not stored are left out."""
        if not fingerprints:
            return {}
        async with self.reading() as connection:
            payloads = await self._dialect.descriptions(connection, sorted(fingerprints))
        return {fingerprint(payload, "DescriptionDeclared"): payload for payload in payloads}

    @asynccontextmanager
    async def writing(self) -> AsyncIterator[AsyncConnection]:
        """Open a writing transaction, committed at the end.

        On SQLite the transactions of this log take turns here, because SQLite's own wait for the write lock polls.
        """
        async with self._write_turn or nullcontext():
            self._check_file()  # a new connection would write into the file of this name
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
        """Open a connection whose transaction is a snapshot."""
        async with self.reading() as connection:
            await self._dialect.begin_snapshot(connection)
            yield connection

    @asynccontextmanager
    async def reading(self) -> AsyncIterator[AsyncConnection]:
        """Open a connection for reading, which neither waits for writers nor delays them."""
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
        raise dialect.translate_error(error, name) from error


async def advance_folded(connection: AsyncConnection, steps: Sequence[Progress]) -> bool:
    """Advance `folded` of each episode from the sequence before to the sequence now.

    Returns False if another process has folded one of them meanwhile; the caller must then roll back.
    """
    return await dialect_of(connection).advance_folded(connection, steps) == len(steps)


async def park(connection: AsyncConnection, number: int, reason: str | None) -> None:
    """Stop folding an episode, with the reason; None releases it. The log still accepts its events."""
    await dialect_of(connection).park(connection, number, reason)
