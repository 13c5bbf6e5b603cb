"""Open a memory for reading: sessions, data frames and named queries. Nothing is ever written through it.

async with Reading.open("sqlite:///memory.db") as reading:
    async with reading.session() as session:
        actions = (await session.scalars(select(Action))).all()
    frame = await reading.dataframe(select(PickUpWithContextView))
"""

from __future__ import annotations

import asyncio
import html
import logging
import re
import sys
import threading
from collections.abc import AsyncGenerator, AsyncIterator, Callable, Mapping, Sequence
from concurrent.futures import ThreadPoolExecutor
from contextlib import AbstractAsyncContextManager, AbstractContextManager, aclosing, asynccontextmanager
from contextvars import ContextVar
from dataclasses import replace
from datetime import datetime
from functools import partial
from shlex import quote
from typing import TYPE_CHECKING, Any, Literal, NamedTuple, Self, TypeVar, overload
from weakref import ref

import sqlalchemy as sa
from sqlalchemy.dialects import registry
from sqlalchemy.engine import ExceptionContext
from sqlalchemy.ext.asyncio import AsyncConnection, AsyncEngine, AsyncSession, async_sessionmaker
from sqlalchemy.orm import ORMExecuteState, Session
from sqlalchemy.orm.identity import IdentityMap
from sqlalchemy.sql import visitors
from sqlalchemy.sql.operators import in_op
from sqlalchemy.util.concurrency import in_greenlet

from pycrorm_async.bulk_records import collecting_seldom
from pycrorm_async.errors import CallerError, DatabaseUnavailable, PycrormError, TablesOutdated, UnknownEpisode
from pycrorm_async.events.ids import parse_episode_id, row_key
from pycrorm_async.events.types import Blob
from pycrorm_async.orm import ProcessMetaData
from pycrorm_async.orm.base import EPISODE, KEYS, Base, load_related
from pycrorm_async.orm.dynamic import DynamicClasses
from pycrorm_async.projections.columns import physical_name, unite
from pycrorm_async.projections.generations import Generation, all_views, current_generation, with_views
from pycrorm_async.query import named_queries
from pycrorm_async.query import sql as read_only_sql
from pycrorm_async.query.episode_diff import EpisodeDiff, diff_episodes
from pycrorm_async.query.frames import BATCH_ROWS, Library, arrow_batches, columns_of, dataframe, select_of
from pycrorm_async.query.named_queries import EpisodeChoice, EpisodeSummary
from pycrorm_async.query.notebook import Episodes, TaskTree  # and registers the views of values
from pycrorm_async.query.question import AskedEpisode, FrameQuery, Question, SyncQuestion, translated_errors
from pycrorm_async.query.questions import Ask
from pycrorm_async.query.snapshot import Moment, as_of
from pycrorm_async.query.sql import DEFAULT_LIMITS, SqlLimits, SqlResult, SqlRows
from pycrorm_async.query.text import quiet, view
from pycrorm_async.store.address import DatabaseAddress, check_replica, no_tables
from pycrorm_async.store.lake import open_lake
from pycrorm_async.store.log import EventLog
from pycrorm_async.store.replica import LAG_S_MAX, lag_between, open_to_read

if TYPE_CHECKING:
    import pandas as pd
    import pyarrow as pa

    from pycrorm_async.query.observed_images import ObservedPicture

_logger = logging.getLogger("pycrorm_async")
_ABSENT = re.compile(
    r'no such (?:table|column): (?:main\.)?"?(\w+)|relation "(\w+)" does not exist|column "?(\w+)"?\.\S+ does not exist'
)
"""The messages of SQLite and PostgreSQL about what does not exist, with the name of the table."""


def _draws(images: bool | None) -> bool:  # noqa: FBT001  a choice that may be left to the program
    """Return whether pictures are read: as asked, or in a notebook."""
    return "ipykernel" in sys.modules if images is None else images


class Reading:
    """The reading side of one memory. Belongs to the loop it was opened in.

    Every result excludes simulations (`plan.SimulatedTaskTree`). With `simulated=True` a session or frame includes
    them, marked by `TaskTreeNode.simulated` and `ProcessMetaData.simulated`, and costs some ms more.

    With a replica (`store.replica`) it asks that instead, but where simulations are wanted and the memory has some.
    """

    def __init__(
        self, log: EventLog | DatabaseAddress, *, replica: DatabaseAddress | None = None, follows: bool = False
    ) -> None:
        """Read an open log, or one at an address, which is opened at the first query and closed by `close`.

        With `follows` the replica is asked only while it shows all that was committed at the opening and at `follow`.
        """
        self._address = log if isinstance(log, DatabaseAddress) else log.address
        self._replica, self._follows = replica, follows
        if replica is not None:
            check_replica(replica, self._address)
        self._sources: dict[DatabaseAddress, _Source] = {}
        self._opened: EventLog | None = None
        self._is_closed = False
        self._opening = asyncio.Lock()
        self._classes = DynamicClasses()
        self._declarations: list[bytes] = []
        self._all_views: tuple[int, dict[str, str]] = (-1, {})
        if isinstance(log, EventLog):
            self._use(log)

    @classmethod
    @asynccontextmanager
    async def open(cls, url: str, *, read_url: str | None = None) -> AsyncIterator[Self]:
        """Open the existing memory at a URL; with `read_url`, that of a streaming replica, read from there.

        A warning says when the replica is behind, or does not answer: then the memory at `url` is read.

        Raises `UnknownUrl`; `CallerError` for a `read_url` of another memory; `DatabaseUnavailable` if no memory exists
        there, `DatabaseForeign` for a database of another program or of a newer version.
        """
        replica = DatabaseAddress.parse(read_url) if read_url else None
        with DatabaseAddress.parse(url).located() as address:
            async with cls.open_address(address, replica) as reading:
                yield reading

    @classmethod
    @asynccontextmanager
    async def open_address(
        cls, address: DatabaseAddress, replica: DatabaseAddress | None = None
    ) -> AsyncIterator[Self]:
        """Open the existing memory at a located address. Raises `DatabaseUnavailable` and `DatabaseForeign`."""
        reading = cls(address, replica=replica)
        try:
            await reading.refresh(maps=False)
            yield reading
        finally:
            await reading.close()

    @property
    def is_open(self) -> bool:
        """True from the first query on, which opens the log, until `close`."""
        return self._opened is not None

    async def close(self) -> None:
        """Close the connections and unmap the classes, once; every query after it raises `CallerError`."""
        self._is_closed = True
        async with self._opening:
            self._opened = None
            self._classes.dispose()
            await self._close_sources()

    async def _close_sources(self) -> None:
        while self._sources:
            await self._sources.popitem()[1].log.close()

    async def follow(self) -> None:
        """Read from the replica once it shows what has been committed, which is awaited; until then from the memory."""
        if self._replica is not None:
            await self._ready()
            async with self._opening:
                self._use(await self._current_log())

    async def _current_log(self) -> EventLog:
        """Wait until the replica, if it could be opened, shows what has been committed; return the log to read."""
        primary = (await self._open_primary()).log
        replica = self._sources[self._replica].log if self._replica in self._sources else primary
        if replica is primary:
            return primary
        try:
            lag = await lag_between(replica, primary, LAG_S_MAX)
            state, is_current = str(lag), lag.behind_bytes == 0
        except DatabaseUnavailable as fault:
            state, is_current = f"does not answer: {fault}", False
        log = replica if is_current else primary
        if log is not (self._opened or replica):
            _logger.warning("the replica %s %s; reading from %s", self._replica, state, log.address)
        return log

    async def refresh(self, *, maps: bool = True) -> None:
        """Learn the designator types that were declared since the last call, and map them unless `maps` is false."""
        await self._ready()
        await self._learn(self._log)
        if maps:  # every session does this first
            self._classes.map()

    async def _learn(self, log: EventLog) -> None:
        declarations = await log.declarations()
        if declarations != self._declarations:
            generation = await _generation(log)
            united = unite(generation.layout, declarations)
            self._classes.learn(united.accepted.values(), united.layout.renamed)
            self._declarations = declarations

    async def _learn_apart(self) -> None:
        """Learn the types on a connection of its own, in any loop."""
        async with await EventLog.open(self._address, create=False) as log:
            await self._learn(log)

    async def present_names(self) -> Mapping[str, str]:
        """Return the present name of each type that was declared, by all the names that it had."""
        await self.refresh()
        return self._classes.present_names

    @asynccontextmanager
    async def session(self, *, simulated: bool = False) -> AsyncIterator[AsyncSession]:
        """Open an ordinary SQLAlchemy session. Its objects stay readable after it is closed."""
        await self.refresh()
        if await self._shows_wanted(simulated=simulated):
            async with self._sessions() as session:
                yield session
            return
        async with self._connection(simulated=True) as connection:
            connect = partial(with_views, views=self._all_views[1])
            async with (await self._primary()).sessions(bind=connection, connect=connect) as session:
                yield session

    @overload
    async def dataframe(
        self,
        statement: FrameQuery,
        *,
        to: Literal["pandas"] = "pandas",
        simulated: bool = False,
        deferred: bool = False,
    ) -> pd.DataFrame: ...

    @overload
    async def dataframe(
        self, statement: FrameQuery, *, to: Library, simulated: bool = False, deferred: bool = False
    ) -> Any: ...

    async def dataframe(
        self, statement: FrameQuery, *, to: Library = "pandas", simulated: bool = False, deferred: bool = False
    ) -> Any:
        """Return the rows as a frame of pandas, polars or Arrow, typed as the columns are declared.

        `pycrorm_async.query.frames` lists the types. `statement` is a select, a union of selects, a mapped class, or a
        question of `ask`. With `deferred` a mapped class contributes the columns too that its objects load on request.

        Raises `MissingExtra`; `QueryRefused` for a wrong select; `CallerError` for SQL as text, which `query` runs.
        """
        await self._ready()
        plain = await self._select_of(statement)
        with translated_errors(self._log, statement):
            async with self._connection(simulated=simulated) as connection:
                return await dataframe(connection, plain, to=to, deferred=deferred)

    async def batches(
        self,
        statement: FrameQuery,
        *,
        rows: int = BATCH_ROWS,
        simulated: bool = False,
        deferred: bool = False,
        enums_as_text: bool = False,
    ) -> AsyncGenerator[pa.RecordBatch]:
        """Yield the rows as Arrow record batches of one schema, so that a large answer needs no memory of its size.

        >>> async for batch in reading.batches(select(PickUpWithContextView)):
        ...     writer.write_batch(batch)

        An answer without rows is one empty batch. `enums_as_text` makes enum members plain text. Other arguments and
        errors are those of `dataframe`.
        """
        await self._ready()
        plain = await self._select_of(statement)
        with translated_errors(self._log, statement):
            columns = columns_of(plain, deferred=deferred)
            async with (
                self._connection(simulated=simulated) as connection,
                aclosing(arrow_batches(connection, plain, columns, rows=rows, enums_as_text=enums_as_text)) as batches,
            ):
                async for batch in batches:
                    yield batch

    async def _select_of(self, query: FrameQuery) -> sa.Select[*tuple[Any, ...]]:
        question = query.question if isinstance(query, SyncQuestion) else query
        return await question.resolved() if isinstance(question, Question) else select_of(question)

    async def query(self, sql: str, limits: SqlLimits = DEFAULT_LIMITS) -> SqlResult:
        """Return the rows of one query in SQL that can only read; see `pycrorm_async.query.sql`.

        >>> await reading.query("SELECT dtype, count(*) AS nodes FROM task_tree_node GROUP BY dtype")

        Raises `QueryRefused`, on PostgreSQL also for a login that may not take the role `pycrorm_reader`.
        """
        await self._ready()
        return await read_only_sql.query(self._log, sql, limits)

    @asynccontextmanager
    async def stream(self, sql: str, limits: SqlLimits = DEFAULT_LIMITS) -> AsyncIterator[SqlRows]:
        """Run such a query and read its rows, with `async for`, while it runs; see `query`."""
        await self._ready()
        async with read_only_sql.stream(self._log, sql, limits) as rows:
            yield rows

    @property
    def ask(self) -> Ask[Question]:
        """The named questions: `await reading.ask.root_failures(object="milk")` is a frame."""
        return Ask(partial(Question, self))

    @property
    def dialect(self) -> sa.Dialect:
        """The dialect of the database, to write a statement in its SQL."""
        found: sa.Dialect = registry.load("sqlite" if self._address.is_sqlite else "postgresql")()
        return found

    async def rows(
        self, statement: sa.Select[*tuple[Any, ...]], *, simulated: bool = False
    ) -> list[sa.Row[*tuple[Any, ...]]]:
        """Return the rows of a select over columns as named tuples."""
        await self._ready()
        with self._log.translated():
            async with self._connection(simulated=simulated) as connection:
                return list((await connection.execute(statement)).all())

    def mapped(self, designator: str | type) -> Any:
        """Return the mapped class of a dtype, a table or a designator class, as of the last `refresh`.

        Before the first query that reads the types it reads them itself. Raises `CallerError` for a type that was never
        declared in this memory, and once it is closed; `DatabaseUnavailable` if it does not exist yet.
        """
        if self._is_closed:
            raise CallerError("this memory is closed: open it again")
        if not self.is_open or not self._declarations:  # a query without types opens the log and learns none
            with ThreadPoolExecutor(1, thread_name_prefix="pycrorm-types") as thread:
                thread.submit(asyncio.run, self._learn_apart()).result()
        return self._classes.of(designator)

    # --- named queries ----------------------------------------------------------------------------------------

    async def episodes(self, choice: EpisodeChoice | None = None, *, simulated: bool = False) -> Episodes:
        """Return the episodes, all or a choice, the oldest first, as a list that a notebook draws as a table."""
        await self._ready()
        with self._log.translated():
            async with self._connection(simulated=simulated) as connection:
                summaries = await named_queries.episodes(connection, choice)
            folding = len(await self._log.behind()) if choice is None else 0
            listed = Episodes(await self._with_digests(summaries))
        listed.folding = folding
        return listed

    async def diff(self, first: AskedEpisode, second: AskedEpisode) -> EpisodeDiff:
        """Compare two episodes: facts, task trees, and the last places of objects. Raises `UnknownEpisode`."""
        return await diff_episodes(self, first, second)

    async def episode(self, name: str) -> EpisodeSummary:
        """Return the episode with this number, id, or first digits of its id, simulations included.

        `last` is the newest except simulations. Raises `UnknownEpisode`.
        """
        await self._ready()
        with self._log.translated():
            async with self._connection(simulated=True) as connection:
                summary = await named_queries.episode_named(connection, name)
            return (await self._with_digests([summary]))[0]

    async def _with_digests(self, summaries: Sequence[EpisodeSummary]) -> list[EpisodeSummary]:
        """Return the episodes, which are in the order of their numbers, each with the last digest of the log."""
        digests = await self._log.last_digests(summaries[0].number, summaries[-1].number) if summaries else {}
        return [
            replace(each, digest_sequence=digest.sequence, digest=digest.digest)
            if (digest := digests.get(each.number)) is not None
            else each
            for each in summaries
        ]

    async def tree(self, episode: AskedEpisode, *, images: bool | None = None) -> TaskTree:
        """Return the task tree of an episode, simulations included, as a list: each node comes before its children.

        A notebook draws it. `images` reads at most 24 pictures of what the nodes observed, evenly over the episode; by
        default in a notebook only. Raises `UnknownEpisode` for a name that no episode has; for an unknown number it is
        empty.
        """
        await self._ready()
        with self._log.translated():
            async with self._connection(simulated=True) as connection:
                if isinstance(episode, int):
                    summary = next(iter(await named_queries.episodes(connection, episode)), None)
                elif isinstance(episode, EpisodeSummary):
                    summary = episode
                else:
                    summary = await named_queries.episode_named(connection, str(episode))
                if summary is None:
                    return TaskTree()
                tree = TaskTree(await named_queries.task_tree(connection, summary.number), summary)
                seen = await named_queries.observed_contents(connection, summary.number) if _draws(images) else []
            tree.pictures = await self._pictures(summary.number, seen)
            return tree

    async def as_of(
        self,
        episode: AskedEpisode,
        *,
        time: float | datetime | None = None,
        sequence: int | None = None,
        meshes: bool = False,
        images: bool | None = None,
    ) -> Moment:
        """Return the task tree and the world of an episode at any moment, read from the log, also while it runs.

        Args:
            episode: its number, its id or the first digits of it, `last`, or the object from `memory.episode` or
                `episodes`. Simulations are included.
            time: seconds since the episode's start by the monotonic clock; or an aware datetime by the wall clock,
                which includes the events before the first later one.
            sequence: of the last event to include.
            meshes: read the mesh files of the objects too, which `Settings(record_meshes="files")` records.
            images: read pictures of what had been observed last, for a notebook; by default in a notebook only.

        A moment beyond the last event in the log gives the state after that event. Raises `UnknownEpisode`;
        `CallerError` for a moment before the start, or without exactly one of `time` and `sequence`; `LogDamaged` or
        `DatabaseForeign` for an event that cannot be read.
        """
        await self._ready()
        then = await as_of(self._log, episode, time=time, sequence=sequence, meshes=meshes)
        if not _draws(images):
            return then
        seen = [(name, each.sequence, each.node) for name, each in then.observations.items()]
        return replace(then, pictures=await self._pictures(then.number, seen))

    async def _pictures(self, number: int, seen: Sequence[tuple[str, int, int | None]]) -> tuple[ObservedPicture, ...]:
        if not seen:
            return ()
        from pycrorm_async.query.observed_images import read_pictures  # here, because it loads numpy

        return await read_pictures(self._log, number, seen)

    async def blob(self, name: str) -> Blob | None:
        """Return the blob with this SHA-256, as hexadecimal digits; None if it is not stored."""
        await self._ready()
        with self._log.translated():
            return await self._log.blobs.read(name)

    async def lake(self, address: str | None = None, sql: str = "FROM event") -> Any:
        """Return the events of a lake, or a query of it, as a relation of DuckDB, which can only read.

        >>> (await memory.lake("ducklake:/nfs/lake")).aggregate("type, count(*)")

        Without an address, of the lake in which this memory archived last. Raises `CallerError`, `MissingExtra`,
        `DatabaseUnavailable`.
        """
        if address is None:
            await self._ready()
            archived = [each for each in await self._log.all_removed() if each.archived_in is not None]
            if not archived:
                raise CallerError("this memory has archived nothing yet: name the lake")
            address = max(archived, key=lambda each: each.removed_wall_ns).archived_in
        return open_lake(str(address)).sql(sql)

    async def number_of(self, episode: object) -> int:
        """Return the number that this database gave to an episode or its UUID. Raises `UnknownEpisode`."""
        await self._ready()
        number = await self._log.episode_number(parse_episode_id(str(episode)))
        if number is None:
            raise UnknownEpisode(f"this database has no event of the episode {episode} yet")
        return number

    async def log(self) -> EventLog:
        """Return the log of events, open until `close`."""
        await self._ready()
        return self._log

    # --- connections ------------------------------------------------------------------------------------------

    async def _ready(self) -> None:
        """Open the log if it is not open; every query calls this first."""
        if self._is_closed:
            raise CallerError("this memory is closed: open it again")
        if self._opened is None:
            async with self._opening:
                if self._opened is None:
                    log = await open_to_read(self._address, self._replica)
                    try:
                        await _generation(log)
                        self._source(log)
                        self._use(await self._current_log() if self._follows and self._replica is not None else log)
                    except BaseException:
                        await self._close_sources()
                        await log.close()  # which may be none of them
                        raise

    def _use(self, log: EventLog) -> None:
        self._sessions = self._source(log).sessions
        self._opened = log

    def _source(self, log: EventLog) -> _Source:
        """Return the sessions of a log, with the classes and the errors of this memory."""
        if log.address not in self._sources:
            self._classes.use_in(log.engine)
            on_access = LoadOnAccess(log.address.engine(read_only=True), log.translated)
            self._classes.use_in(on_access.engine)
            explain = partial(_explain_absent, self._address)
            for engine in (log.engine, on_access.engine):
                sa.event.listen(engine.sync_engine, "handle_error", explain)
            sessions = async_sessionmaker(
                log.engine, expire_on_commit=False, sync_session_class=EpisodeSession, on_access=on_access
            )
            self._sources[log.address] = _Source(log, sessions)
        return self._sources[log.address]

    async def _primary(self) -> _Source:
        """Return the source that is no replica."""
        async with self._opening:
            return await self._open_primary()

    async def _open_primary(self) -> _Source:
        if self._address not in self._sources:
            self._source(await EventLog.open(self._address, create=False))
        return self._sources[self._address]

    @property
    def _log(self) -> EventLog:
        assert self._opened is not None, "`_ready` was awaited before"
        return self._opened

    @asynccontextmanager
    async def _connection(self, *, simulated: bool) -> AsyncIterator[AsyncConnection]:
        if await self._shows_wanted(simulated=simulated):
            async with self._log.engine.connect() as connection:
                yield connection
            return
        log = (await self._primary()).log
        generation = await _generation(log)
        if generation.revision != self._all_views[0]:
            async with log.engine.connect() as connection:
                self._all_views = generation.revision, await all_views(connection, generation)
        async with with_views(log.engine, self._all_views[1]) as connection:
            yield connection

    async def _shows_wanted(self, *, simulated: bool) -> bool:
        """Return whether the public views show all that is wanted; others are temporary, which no replica makes."""
        if not simulated or self._log.address != self._replica:
            return not simulated
        simulations = sa.table(physical_name("simulated_episode", (await _generation(self._log)).number))
        async with self._log.reading() as connection:
            return not (await connection.execute(sa.select(sa.literal(1)).select_from(simulations).limit(1))).all()


class _Source(NamedTuple):
    """A log that is read, and its sessions."""

    log: EventLog
    sessions: async_sessionmaker[AsyncSession]


def _explain_absent(memory: DatabaseAddress, context: ExceptionContext) -> None:
    """Raise `TablesOutdated` for an error about the table or a column of a mapped class that this memory lacks."""
    absent = _ABSENT.search(str(context.original_exception))
    name = next(filter(None, absent.groups()), "") if absent is not None else ""
    class_ = next((each.class_ for each in Base.registry.mappers if each.local_table.description == name), None)
    if class_ is None:
        return
    remedy = "open it with `Memory.open` in a program that has this class"
    if class_.__module__.startswith("pycrorm_async."):
        remedy = f"run `pycrorm rebuild --url {quote(memory.to_type)}`"
    raise TablesOutdated(f"{memory} is older than the class {class_.__name__} and has no table for it: {remedy}")


async def _generation(log: EventLog) -> Generation:
    with log.translated():
        async with log.engine.connect() as connection:
            generation = await current_generation(connection)
    if generation is None:
        raise DatabaseUnavailable(no_tables(log.address))
    return generation


# === episode session ==========================================================================================
#
# Load related rows from the part of the tables that has their episode, and unloaded attributes at the first access.
#
# SQLAlchemy loads subclasses' columns and related rows by their ids. An id contains the number of its episode, but no
# database can know that: where the tables are divided by episode, it would look for these ids in every part. So a load
# of rows of one episode names the episode too. A load of rows of several episodes remains as it is.


class _MapReference(ref[IdentityMap]):
    """The reference to a session's identity map that each of its objects holds; keeps `session` alive with them."""

    session: Session | None = None


class EpisodeSession(Session):
    """A session whose objects load attributes at the first access, also without `await` or after it is closed.

    Its loads of related rows name their episode.

    Args:
        on_access: runs the loads of attributes that are read without `await`.
        connect: opens the connections for these loads.
    """

    def __init__(
        self,
        *arguments: Any,
        on_access: LoadOnAccess,
        connect: Callable[[AsyncEngine], AbstractAsyncContextManager[AsyncConnection]] = AsyncEngine.connect,
        **options: Any,
    ) -> None:
        super().__init__(*arguments, **options)
        self._on_access = on_access
        self._connect = connect
        self._reference = self._refer()

    def execute(self, *arguments: Any, **options: Any) -> sa.Result[Any]:
        """Execute a statement; a load of an attribute that is read without `await` runs in a thread of its own."""
        if in_greenlet():
            with collecting_seldom():
                return super().execute(*arguments, **options)
        # frozen: read while the load's connection is open
        load = super().execute
        return self._on_access.run(lambda: load(*arguments, **options).freeze(), self._connect)()

    def close(self) -> None:
        """Release the connection. The objects stay in the session, and it lives as long as one of them does."""
        if self.identity_map:
            self._reference.session = self
        transaction = self.get_transaction()
        while transaction is not None:
            parent = transaction.parent
            transaction.close()
            transaction = parent

    def expunge_all(self) -> None:
        """Remove all objects from the session, which has a new identity map then."""
        super().expunge_all()
        self._reference = self._refer()

    def _refer(self) -> _MapReference:
        # There is no public way to share a reference among the objects, and one of each object would double the time
        # of `close`, which made half a dictionary for each.
        reference = _MapReference(self.identity_map)
        self.identity_map._wr = reference  # noqa: SLF001
        return reference

    def _connection_for_bind(self, engine: Any, *arguments: Any, **options: Any) -> sa.Connection:
        # There is no public way to execute a statement of a session on a connection outside its transaction.
        return self._on_access.connection or super()._connection_for_bind(engine, *arguments, **options)


sa.event.listen(EpisodeSession, "do_orm_execute", load_related)


@sa.event.listens_for(EpisodeSession, "do_orm_execute")
def _name_episode(state: ORMExecuteState) -> None:
    keys = state.parameters.get(KEYS) if isinstance(state.parameters, Mapping) else None
    if not keys or not isinstance(state.statement, sa.Select) or not all(isinstance(each, int) for each in keys):
        return
    number = row_key(min(keys)).number
    if number != row_key(max(keys)).number:
        return
    column = _loaded_by(state.statement)
    if column is not None and column.key != EPISODE and EPISODE in column.table.c:  # else the keys are episodes
        state.statement = state.statement.where(column.table.c[EPISODE] == number)


def _loaded_by(statement: sa.Select[Any]) -> Any:
    """Return the column that a load compares with the ids."""
    criteria: sa.ColumnElement[bool] | None = statement.whereclause
    for each in visitors.iterate(criteria) if criteria is not None else ():
        if (
            isinstance(each, sa.BinaryExpression)
            and each.operator is in_op
            and getattr(each.right, "key", None) == KEYS
        ):
            return each.left
    return None


# === load on access ===========================================================================================
#
# Load attributes that are read without `await`, on a connection of their own.
#
# Theory of operation. Reading `action.arm` is not a coroutine, so the loop of the session cannot await the database
# meanwhile, and the session's connection belongs to that loop. So the load runs in a loop of its own, in a thread, on
# another connection, and blocks the loop of the reader until it has ended, for the time of a query or two. Only that
# thread uses the session meanwhile, because the session's loop is blocked. Each load sees the present state of the
# database, as each statement of a PostgreSQL session does. The engine keeps no connection between two loads, because a
# connection belongs to the loop that opened it; a lock makes the loads of several threads take turns.

_Result = TypeVar("_Result")


class LoadOnAccess:
    """Runs loads of attributes in a thread, on connections of an engine that nothing else uses.

    Args:
        engine: of the memory; its connections are opened and closed for each load.
        translated: translates the driver's errors.
    """

    def __init__(self, engine: AsyncEngine, translated: Callable[[], AbstractContextManager[None]]) -> None:
        self.engine = engine
        self._translated = translated
        self._lock = threading.Lock()
        self._connection: ContextVar[sa.Connection | None] = ContextVar("connection_of_load", default=None)

    @property
    def connection(self) -> sa.Connection | None:
        """The connection of the load that runs in this context; None outside of loads."""
        return self._connection.get()

    def run(
        self,
        load: Callable[[], _Result],
        connect: Callable[[AsyncEngine], AbstractAsyncContextManager[AsyncConnection]] = AsyncEngine.connect,
    ) -> _Result:
        """Run a load with a connection from `connect`, and wait for its result. Raises as the load does."""

        def with_connection(connection: sa.Connection) -> _Result:
            self._connection.set(connection)
            return load()

        async def in_own_loop() -> _Result:
            try:
                async with connect(self.engine) as connection:
                    return await connection.run_sync(with_connection)
            finally:
                await self.engine.dispose()

        with self._lock, self._translated(), ThreadPoolExecutor(1, thread_name_prefix="pycrorm-load") as thread:
            return thread.submit(asyncio.run, in_own_loop()).result()


# === memory view ==============================================================================================
#
# Draw a memory: its address and the table of its newest episodes.
#
# A notebook asks for a view while its event loop waits for the answer, so a thread with a loop of its own reads.

_ANSWER_S_MAX = 10.0
"""Bounds the wait for a database, so that a cell ends although the server does not answer."""


def memory_html(address: DatabaseAddress, located: DatabaseAddress | None) -> str:
    """Return the view of the memory at an address; it is not open if it is not `located`."""
    title = f"<b>Memory {html.escape(str(address))}</b>"
    if located is None:
        return view(f"{title} · not open", quiet("it is closed, or was never entered: await Memory.connect(url)"))
    return view(f"{title} · open", _episodes(located))


def _episodes(address: DatabaseAddress) -> str:
    answers: list[str] = []
    reader = threading.Thread(target=lambda: answers.append(asyncio.run(_read(address))), daemon=True)
    reader.start()
    reader.join(_ANSWER_S_MAX)
    return answers[0] if answers else quiet(f"the database did not answer within {_ANSWER_S_MAX:g} s")


async def _read(address: DatabaseAddress) -> str:
    from pycrorm_async.query.notebook_html import EPISODES_MAX, episodes_html  # imported when a notebook draws

    try:
        async with Reading.open_address(address) as reading, reading.session() as session:
            total = await session.scalar(sa.select(sa.func.count()).select_from(ProcessMetaData))
            newest = await named_queries.episodes(await session.connection(), EpisodeChoice(limit=EPISODES_MAX))
            folding = len(await (await reading.log()).behind())
            return episodes_html(newest, total or 0, folding=folding)
    except PycrormError as error:
        return html.escape(str(error))
