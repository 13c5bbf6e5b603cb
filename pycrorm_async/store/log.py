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
import sqlite3
import stat
import uuid
from collections.abc import AsyncIterator, Callable, Collection, Iterable, Mapping, Sequence
from contextlib import AbstractContextManager, asynccontextmanager, nullcontext
from functools import partial
from pathlib import Path
from types import MappingProxyType
from typing import Any, Self

import msgspec
from sqlalchemy import ColumnElement, Executable, Select, func, select
from sqlalchemy.ext.asyncio import AsyncConnection, AsyncEngine

from pycrorm_async.clock import SYSTEM_CLOCK, Clock
from pycrorm_async.errors import DatabaseForeign, DatabaseUnavailable, LogDamaged, UnknownEpisode
from pycrorm_async.events.codec import Record, declared_dtype, fingerprint, short_name
from pycrorm_async.events.fields import retagged
from pycrorm_async.events.ids import EPISODE_NUMBER_MAX, SEQUENCE_MAX, EpisodeId, episode_text, is_episode_id, number_in
from pycrorm_async.settings import FILE_MODES, FileAccess
from pycrorm_async.store import append as appends
from pycrorm_async.store import schema
from pycrorm_async.store import stored as storeds
from pycrorm_async.store.address import BUSY_TIMEOUT_S, DatabaseAddress
from pycrorm_async.store.dialect import LogIdentity, Progress, StoredOn
from pycrorm_async.store.dialects import dialect_of
from pycrorm_async.store.placement import PLAIN, Placement
from pycrorm_async.store.sqlite_engine import BEGIN, READ, move_leftovers

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
        self.discarded: dict[str, int] = {}
        """The number of events that arrived of removed episodes and were discarded, by the id of the episode."""
        self._shards: bool | None = False if address.is_sqlite else None
        self.blobs = appends.Blobs(self._dialect, self.reading, self.writing)
        self.digests: appends.RunningDigests | None = appends.RunningDigests(self._dialect)
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
        placement: Placement = PLAIN,
    ) -> EventLog:
        """Open the log at a located address.

        With `create` the log is writable, and is created or migrated if necessary; otherwise it is read-only and
        nothing is written. `belongs_to` is the id of the expected log: if it is given, no log is created in an empty
        database, because a restore may be running. `file_access` applies to a new SQLite file, `placement` to a new log
        on PostgreSQL.

        Raises `DatabaseUnavailable` (no such database, or no connection to it) or `DatabaseForeign` (another program's
        or a newer version's).
        """
        engine = address.engine(read_only=not create, busy_timeout_s=busy_timeout_s)
        name = str(address)
        try:
            with dialect_of(engine).translated(name):
                if create:
                    if address.is_sqlite:
                        make_file(address.path, name, file_access, belongs_to=belongs_to)
                    log_id = await _make_or_migrate(engine, name, clock.wall_ns(), placement, belongs_to=belongs_to)
                else:
                    if address.is_sqlite:
                        must_exist(address.path, name)
                    log_id = await _recognise(engine, name)
            return cls(address=address, engine=engine, log_id=log_id, writable=create)
        except BaseException:
            await engine.dispose()
            raise

    def translated(self) -> AbstractContextManager[None]:
        """Translate driver errors raised inside to errors of this package; for code that uses `engine` directly."""
        return self._dialect.translated(str(self.address))

    @classmethod
    async def open_to_change(cls, address: DatabaseAddress) -> EventLog:
        """Open an existing log for writing. Raises `DatabaseUnavailable` where there is none, instead of making one."""
        async with await cls.open(address, create=False) as existing:
            log_id = existing.log_id
        return await cls.open(address, create=True, belongs_to=log_id)

    async def __aenter__(self) -> Self:
        return self

    async def __aexit__(self, *_raised: object) -> None:
        await self.close()

    async def close(self) -> None:
        """Close every connection. Does nothing in a forked child, because the connections belong to the parent."""
        if os.getpid() == self._process:
            await self.engine.dispose()

    # --- append -----------------------------------------------------------------------------------------------

    async def append(
        self, records: Sequence[Record], on_wait: Callable[[], None] = lambda: None
    ) -> dict[EpisodeId, str]:
        """Store a batch in one transaction, durable on return; return the reasons of refusals by episode.

        Calls `on_wait` when a server stores the events, while this process waits most of the time.
        Records stored before with the same bytes are stored once. Of an episode with a gap, or with a record that no
        database can hold, the records before it are stored; the caller must keep the rest and append it later. Raises
        `LogDamaged`, and stores nothing, if another event is stored under a record's key.
        """
        return dict((await self.store(records, on_wait=on_wait)).refusals)

    async def store(
        self,
        records: Sequence[Record],
        *,
        on_wait: Callable[[], None] = lambda: None,
        witness: tuple[EpisodeId, int] | None = None,
        numbers: Mapping[EpisodeId, int] = MappingProxyType({}),
    ) -> storeds.Stored:
        """Append; give a new episode its number in `numbers` if no other episode has it.

        Raises `LogWentBack`, and stores nothing, if the log holds less of the witness than this head.
        """
        if not records:
            return storeds.Stored({}, {})
        appending = partial(
            appends.Appending,
            self._dialect,
            records,
            self.digests,
            on_wait=(lambda: None) if self.address.is_sqlite else on_wait,
            witness=witness,
            numbers=numbers,
            restoring=self.blobs.restores,
        )
        await self.blobs.store_for(records)  # again, because the log may have lost them since
        if not await self._has_shards():
            return await self._append(appending())
        async with self.writing() as connection:  # before an event with its number is on a shard
            await appending().create_rows(connection)
        try:
            return await self._append(appending())
        except appends.StoredAhead:
            await self._adopt({each.episode for each in records if each.episode is not None})
            return await self._append(appending(on_wait=lambda: None))

    async def _has_shards(self) -> bool:
        if self._shards is None:
            self._shards = bool((await self.placement()).shards)
        return self._shards

    async def _adopt(self, episodes: Collection[EpisodeId]) -> None:
        """Advance the heads of these episodes over events that a crash left on a shard (`store.placement`)."""
        for row in (await self.heads(list(episodes))).values():
            ahead = await self.spans([storeds.Span(row.number, row.head, SEQUENCE_MAX)])
            if ahead:
                records = [Record(0, row.identity, *each[1:]) for each in ahead]
                await self._append(appends.Appending(self._dialect, records, self.digests, are_stored=True))
                _log.warning("%s: %d events that a crash left on a shard are adopted", self.address, len(ahead))

    async def _append(self, appending: appends.Appending) -> storeds.Stored:
        if self._write_turn is not None and sum(map(len, appending.episodes.values())) >= _MANY_EVENTS:
            async with self.reading() as connection:
                await appending.prepare(connection)
        async with self.writing() as connection:
            stored = await appending.write(connection)
        if self.digests is not None and appending.extension is not None:
            self.digests.keep(appending.extension)
        for episode, removed in appending.discarded.items():
            self.discarded[removed.id] = self.discarded.get(removed.id, 0) + len(appending.episodes[episode])
            if removed.archived_in is None:  # what was archived is stored there
                appending.warnings[f"removed {removed.id}"] = f"events that arrive of it are discarded: {removed}"
        for subject, warning in appending.warnings.items():
            if subject not in self._warned:
                self._warned.add(subject)
                _log.warning("%s: %s", self.address, warning)
        return stored

    async def heads(self, episodes: Sequence[EpisodeId]) -> dict[EpisodeId, storeds.EpisodeRow]:
        """Read the rows of these episodes, without those that have no stored event."""
        names = {episode_text(each): each for each in episodes}
        rows = await self.read(storeds.EpisodeRow, schema.SELECT_HEADS, ids=[(each,) for each in names])
        return {names[row.id]: row for row in rows}

    async def skip_numbers(self, above: int) -> None:
        """Never assign the numbers up to `above` to new episodes."""
        async with self.writing() as connection:
            await self._dialect.skip_numbers(connection, above)

    async def note_incarnation(self, noticed_wall_ns: int, noticed_by: str, reason: str) -> None:
        """Record that the log went back. Raises `DatabaseError` also if this role lacks the privilege."""
        async with self.writing() as connection:
            await self._dialect.create_if_missing(connection, schema.INCARNATION)
            incarnation = storeds.Incarnation(noticed_wall_ns, noticed_by, reason)
            await self._dialect.execute(connection, schema.INSERT_INCARNATION, **incarnation._asdict())

    async def incarnations(self) -> list[storeds.Incarnation]:
        """Read each time the log went back, the oldest first."""
        table, query = schema.INCARNATION, schema.SELECT_INCARNATIONS
        async with self.reading() as connection:
            return await self._dialect.rows_if_created(connection, table, storeds.Incarnation, query)

    async def placement(self) -> Placement:
        """Return the placement of the memory's rows."""
        async with self.reading() as connection:
            return await self._dialect.placement(connection)

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

    async def read(self, kind: Any, statement: Executable, **values: Any) -> list[Any]:
        """Execute a query of `store.schema` whose rows have the fields of this NamedTuple."""
        async with self.reading() as connection:
            return await self._dialect.rows(connection, kind, statement, **values)

    async def episodes(self, first: int = 1, last: int = EPISODE_NUMBER_MAX) -> list[storeds.EpisodeRow]:
        """Read every episode from number `first` to `last`, by number."""
        return await self.read(
            storeds.EpisodeRow, schema.SELECT_EPISODES, first=first, last=last, limit=EPISODE_NUMBER_MAX
        )

    async def last_number(self) -> int:
        """Return the highest episode number; 0 for a log without episodes."""
        [(number,)] = await self.read(tuple, schema.SELECT_NUMBER_MAX)
        return int(number)

    async def episode(self, episode: EpisodeId) -> storeds.EpisodeRow | None:
        """Read an episode's row; None if no event of it is stored."""
        return (await self.heads([episode])).get(episode)

    async def last_digests(self, first: int = 1, last: int = EPISODE_NUMBER_MAX) -> dict[int, storeds.DigestRow]:
        """Read the last kept digest of each episode from number `first` to `last` that has one, by number."""
        async with self.reading() as connection:
            if not (await self._dialect.table_state(connection, schema.DIGEST)).readable:
                return {}
            if first == last:
                rows = await self._dialect.rows(connection, storeds.DigestRow, schema.SELECT_LAST_DIGEST, first=first)
            else:
                rows = await self._dialect.rows(
                    connection, storeds.DigestRow, schema.SELECT_LAST_DIGESTS, first=first, last=last
                )
        return {each.number: each for each in rows}

    async def removed(self, episodes: Collection[EpisodeId]) -> dict[EpisodeId, storeds.RemovedEpisode]:
        """Read which of these episodes were erased or archived."""
        async with self.reading() as connection:
            return await appends.removed_of(self._dialect, connection, episodes)

    async def restored(self, ids: Iterable[str]) -> list[storeds.RemovedEpisode]:
        """Return those of these episodes that came back from a lake, which has them still."""
        async with self.reading() as connection:
            return await self._dialect.removed(connection, schema.SELECT_RESTORED, ids=[(each,) for each in ids])

    async def all_removed(self) -> list[storeds.RemovedEpisode]:
        """Read every erased and archived episode, by number."""
        async with self.reading() as connection:
            return await self._dialect.removed(connection, schema.SELECT_REMOVED)

    async def episode_number(self, episode: EpisodeId) -> int | None:
        """Return an episode's number; None if no event of it is stored."""
        row = await self.episode(episode)
        return row.number if row is not None else None

    async def events(self, number: int, *, after: int = 0, limit: int = 10_000) -> list[storeds.StoredEvent]:
        """Read at most `limit` events of an episode, behind sequence `after`."""
        return await self.read(storeds.StoredEvent, schema.SELECT_EVENTS, number=number, after=after, limit=limit)

    async def pages(
        self, episode: storeds.EpisodeRow, *, after: int = 0
    ) -> AsyncIterator[Sequence[storeds.StoredEvent]]:
        """Yield the events up to the episode's head in pages. Raises `LogDamaged` at the first missing event."""
        while after < episode.head:
            limit = min(_PAGE_EVENTS, episode.head - after)
            whole = storeds.consecutive(await self.events(episode.number, after=after, limit=limit), after)
            if whole:
                yield whole
            after += len(whole)
            if len(whole) < limit:
                raise LogDamaged(episode.id, after + 1, f"is missing in {self.address}")

    async def spans(self, spans: Sequence[storeds.Span]) -> list[storeds.StoredEvent]:
        """Read the events of each span, in the order of the spans."""
        async with self.reading() as connection:
            return await self._dialect.spans(connection, spans)

    async def behind(self, after: int = 0, limit: int = EPISODE_NUMBER_MAX) -> list[storeds.EpisodeRow]:
        """Read the episodes with unfolded events whose number is above `after`, by number, without parked ones."""
        return await self.read(storeds.EpisodeRow, schema.SELECT_BEHIND, after=after, limit=limit, part=0, many=1)

    async def stopped(self) -> list[storeds.EpisodeRow]:
        """Read the refused and parked episodes; the rows hold the reasons."""
        return await self.read(storeds.EpisodeRow, schema.SELECT_STOPPED)

    async def limits_near(self) -> list[str]:
        """Return a warning for each limit of numbers that the memory, or an episode that has not ended, comes near."""
        episodes = await self.read(storeds.EpisodeRow, schema.SELECT_LONG, events_min=appends.EVENTS_MANY)
        warnings = (appends.number_warning(await self.last_number()), *map(appends.events_warning, episodes))
        return [each for each in warnings if each is not None]

    async def declarations(self) -> list[bytes]:
        """Read the payloads of all DesignatorTypeDeclared, in the order of first arrival."""
        async with self.reading() as connection:
            return await self._dialect.declarations(connection)

    async def dtypes(self) -> dict[str, str]:
        """Read the dtypes of all designator types that can be read, by their short names."""
        dtypes = {short_name(fingerprint(each)): declared_dtype(each) for each in await self.declarations()}
        return {name: dtype for name, dtype in dtypes.items() if dtype is not None}

    async def descriptions(self, fingerprints: Collection[str]) -> dict[str, bytes]:
        """Read the payloads of these DescriptionDeclared, by fingerprint; those that are not stored are left out."""
        if not fingerprints:
            return {}
        async with self.reading() as connection:
            payloads = await self._dialect.descriptions(connection, fingerprints)
        return {fingerprint(payload, "DescriptionDeclared"): payload for payload in payloads}

    @asynccontextmanager
    async def writing(self) -> AsyncIterator[AsyncConnection]:
        """Open a writing transaction, committed at the end.

        On SQLite the transactions of this log take turns here, because SQLite's own wait for the write lock polls.
        """
        async with self._write_turn or nullcontext():
            self._check_file()  # a new connection would write into the file of this name
            with self.translated():
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
            if (statement := self._dialect.begin_snapshot) is not None:
                await connection.exec_driver_sql(statement)
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


async def advance_folded(connection: AsyncConnection, steps: Sequence[Progress]) -> bool:
    """Advance `folded` of each episode from the sequence before to the sequence now.

    Returns False if another process has folded one of them meanwhile; the caller must then roll back.
    """
    advanced = await dialect_of(connection).rows(connection, tuple, schema.ADVANCE_FOLDED, steps=list(steps))
    return len(advanced) == len(steps)


async def park(connection: AsyncConnection, number: int, reason: str | None) -> None:
    """Stop folding an episode, with the reason; None releases it. The log still accepts its events."""
    await dialect_of(connection).execute(connection, schema.PARK, of=number, reason=reason)


# === schema ===================================================================================================
#
# Recognise, create and migrate the log in a database, without changing a foreign one.
#
# Opening for writing creates a log in an empty database and migrates an older format, in one transaction. Opening for
# reading never writes.

_HOW_TO_CREATE = "record one with `pycrorm run` or `pycrorm demo`"


async def _recognise(engine: AsyncEngine, name: str) -> str:
    async with engine.connect() as connection:
        identity = await _find_log(connection, name)
    if identity is None:
        raise DatabaseUnavailable(f"{name} holds no memory yet: {_HOW_TO_CREATE}")
    if identity.format < len(dialect_of(engine).migrations):
        raise DatabaseUnavailable(f"{name} was made by an older version: `pycrorm writer --once` brings it up to date")
    return identity.log_id


async def _make_or_migrate(
    engine: AsyncEngine, name: str, now_ns: int, placement: Placement, *, belongs_to: str | None
) -> str:
    """Create or migrate the log in this database if necessary; return its id.

    With `belongs_to`, the id of the log that should be here, raises `DatabaseUnavailable` instead of creating another.
    """
    dialect = dialect_of(engine)
    await dialect.prepare(engine, name)
    async with engine.begin() as connection:
        await dialect.lock_log_changes(connection)
        identity = await _find_log(connection, name)
        if identity is None and belongs_to is not None:
            raise DatabaseUnavailable(f"{name} {_missing_log(belongs_to)}")
        steps = dialect.migrations[identity.format if identity else 0 :]
        for statements in steps if identity else (dialect.first_format(placement), *steps[1:]):
            await dialect.execute_all(connection, statements)
        if (await dialect.table_state(connection, schema.DIGEST)).creatable:
            placed = await dialect.placement(connection)
            await dialect.execute_all(connection, dialect.definition(schema.DIGEST, placed, if_missing=True))
        await dialect.permit_all_numbers(connection)
        format_now = len(dialect.migrations)
        if identity is None:
            identity = LogIdentity(str(uuid.uuid4()), format_now)
            values = {"one": 1, "id": identity.log_id, "format": format_now, "created_wall_ns": now_ns}
            await dialect.execute(connection, schema.INSERT_LOG, **values)
        elif identity.format < format_now:
            await dialect.execute(connection, schema.SET_FORMAT, to=format_now)
    return identity.log_id


async def _find_log(connection: AsyncConnection, name: str) -> LogIdentity | None:
    identity = await dialect_of(connection).find_log(connection, name)
    readable = len(dialect_of(connection).migrations)
    if identity is not None and identity.format > readable:
        reason = f"its format is {identity.format}, this version reads {readable}"
        raise DatabaseForeign(f"{name} was made by a newer version: {reason}")
    return identity


def make_file(path: Path, name: str, access: FileAccess, *, belongs_to: str | None = None) -> None:
    """Create an empty file, an empty database for SQLite, unless it exists.

    SQLite creates its side files with the same mode. An existing file keeps its mode. Raises `DatabaseUnavailable`;
    with `belongs_to`, the id of the log whose file should be here, also instead of creating another.

    Creates the file without opening it, because closing a descriptor drops all POSIX locks of the process on that file,
    SQLite's included; another process that closes the database could then delete the write-ahead log in use.
    """
    if sqlite3.sqlite_version_info < (3, 38):
        raise DatabaseUnavailable(f"SQLite 3.38 or newer is needed, this is {sqlite3.sqlite_version}")
    try:
        if belongs_to is not None and not path.exists():
            raise DatabaseUnavailable(f"{name} {_missing_log(belongs_to)}")
        real = Path(os.path.realpath(path))
        if not real.exists():
            move_leftovers(real)
        try:
            os.mknod(real, 0o600 | stat.S_IFREG)
            real.chmod(FILE_MODES[access])  # independent of the umask
        except FileExistsError:
            if path.is_dir():
                raise DatabaseUnavailable(f"{name} cannot be opened: Is a directory ({path})") from None
            if not os.access(real, os.W_OK):
                reason = "this user may only read it: record with a user who may write it, or name another file"
                raise DatabaseUnavailable(f"{name} cannot be written: {reason}") from None
    except FileNotFoundError as error:
        reason = f"{error.strerror} ({path}): create the folder {path.parent} first"
        raise DatabaseUnavailable(f"{name} cannot be opened: {reason}") from error
    except OSError as error:
        raise DatabaseUnavailable(f"{name} cannot be opened: {error.strerror} ({path})") from error


def must_exist(path: Path, name: str) -> None:
    """Raise `DatabaseUnavailable` for a missing file, with the command that creates one, and for what is no file."""
    try:
        mode = path.stat().st_mode
    except FileNotFoundError:
        raise DatabaseUnavailable(f"{name} does not exist: {_HOW_TO_CREATE}") from None
    except OSError as error:
        raise DatabaseUnavailable(f"{name} cannot be opened: {error.strerror} ({path})") from error
    if not stat.S_ISREG(mode):
        reason = "Is a directory" if stat.S_ISDIR(mode) else "Is no file"
        raise DatabaseUnavailable(f"{name} cannot be opened: {reason} ({path})")


def _missing_log(log_id: str) -> str:
    return (
        f"holds no memory, and the spool belongs to log {log_id}: restore that log, choose another spool, or"
        " move the spool's records to a new log with `pycrorm spool rebind`"
    )


# === episode lookup ===========================================================================================
#
# Find an episode by its number, its id, the first digits of its id, or `last`.
#
# `last` is the newest episode that is not a simulation. The lookup in the log works without tables. It costs the same
# however many episodes there are.

_DIGITS_OF_ID = 4
"""Fewer digits are a number and not the first ones of an id."""
_LOOKED_AT = 100
"""The episodes that are read at once in search of the last one that is not a simulation."""

_NO_ID, _LAST_ID = (str(uuid.UUID(32 * each)) for each in "0f")


async def number_named(
    connection: AsyncConnection, name: str, numbers: ColumnElement[int], ids: ColumnElement[str], listed: Select[Any]
) -> int:
    """Return the number of the named episode; `numbers` and `ids` are columns with an index each.

    `listed` selects the number of episodes that `pycrorm episodes` lists. Raises `UnknownEpisode`, also if several ids
    match; for an episode that was erased or archived, the message says when, and where it is.
    """
    meant = {"number": 0, "first": "", "last": ""}
    # Four digits may be a number, or the beginning of an id without a letter: the number wins.
    if (meant_number := number_in(name)) is not None:
        number = (await connection.execute(select(numbers).where(numbers == meant_number))).scalar()
        if number is not None:
            return int(number)
        meant["number"] = meant_number
    # Between two whole ids, because no order of texts then depends on where their hyphens are.
    first, last = (name.lower() + end[len(name) :] for end in (_NO_ID, _LAST_ID))
    if len(name) >= _DIGITS_OF_ID and is_episode_id(first):
        begins = select(func.count(), func.min(numbers)).where(ids.between(first, last))
        count, number = (await connection.execute(begins)).one()
        if count > 1:
            raise UnknownEpisode(f"{count} episodes have an id that begins with {name!r}: use more of its digits")
        if count:
            return int(number)
        meant |= {"first": first, "last": last}
    for removed in await dialect_of(connection).removed(connection, schema.SELECT_REMOVED_NAMED, **meant):
        raise UnknownEpisode(str(removed))
    raise UnknownEpisode(f"there is no episode {name!r} ({_present((await connection.execute(listed)).scalar_one())})")


def _present(listed: int) -> str:
    if listed == 0:
        return "this memory has none yet: record one with `pycrorm run` or `pycrorm demo`"
    return f"`pycrorm episodes` lists {'the only one' if listed == 1 else f'all {listed}'}"


async def episode_named(log: EventLog, name: str) -> storeds.EpisodeRow:
    """Find the named episode. Raises `UnknownEpisode`."""
    last = await log.last_number() if name == "last" else 0
    while last > 0:
        first = max(1, last - _LOOKED_AT + 1)
        for row in reversed(await log.episodes(first, last)):
            if not await is_simulated(log, row):
                return row
        last = first - 1
    async with log.reading() as connection:
        episodes = schema.EPISODE.c
        listed = select(func.count(episodes.number))
        number = await number_named(connection, name, episodes.number, episodes.id, listed)
    (row,) = await log.episodes(number, number)
    return row


async def grown_episodes(log: EventLog, *, above: int, numbers: Collection[int]) -> list[storeds.EpisodeRow]:
    """Read the episodes that may have grown: with a number above `above`, not ended, or with one of these numbers."""
    return await log.read(storeds.EpisodeRow, schema.SELECT_GROWN, above=above, numbers=[(each,) for each in numbers])


async def tags_of(log: EventLog, row: storeds.EpisodeRow) -> tuple[str, ...]:
    """Return the tags of an episode according to its events. Raises `LogDamaged` if one of these cannot be read."""
    tags: tuple[str, ...] = ()
    for sequence, payload in await log.read(tuple, schema.SELECT_TAGGING, number=row.number):
        try:
            change = msgspec.json.decode(payload, type=_Tagging)
        except msgspec.DecodeError as error:
            raise LogDamaged(row.id, sequence, f"its payload cannot be read: {error}") from error
        tags = retagged(tags, (*change.tags, *change.added), change.removed)
    return tags


class _Tagging(msgspec.Struct):
    """The parts of `EpisodeStarted` and `EpisodeTagged` that concern tags."""

    tags: tuple[str, ...] = ()
    added: tuple[str, ...] = ()
    removed: tuple[str, ...] = ()


class _Started(msgspec.Struct):
    simulated: bool = False


async def is_simulated(log: EventLog, row: storeds.EpisodeRow) -> bool:
    """Return whether the episode is a simulation, according to its first event."""
    first = await log.events(row.number, limit=1)
    try:
        return bool(first) and msgspec.json.decode(first[0].payload, type=_Started).simulated
    except msgspec.DecodeError:  # damaged; reading the episode reports it
        return False
