"""Keep episodes in a lake, a DuckLake: Parquet files in a folder, and a catalog in a SQLite file or on PostgreSQL.

    ducklake:/nfs/lake                                      catalog.sqlite and data/ in this folder
    ducklake:postgresql://user@host/catalog#/nfs/lake       a catalog on a server; the folder, needed once, behind #

Several memories share one lake: an episode has its UUID as the key, an event the UUID and its sequence. Any DuckDB
reads the tables `episode`, `event`, `declaration` and `blob`; `erased` has the ids of episodes that the lake takes from
no memory any more, with times and reasons. The catalog keeps the least and the greatest value of a column, of texts
too, so those of payloads are cleared: otherwise they would outlive an erased episode.
"""

# ruff: noqa: S608 - the SQL is composed of names and of paths that the caller gave

import asyncio
import logging
import math
import sqlite3
import threading
import time
from collections.abc import AsyncIterator, Callable, Collection, Mapping, Sequence
from contextlib import closing, suppress
from hashlib import sha256
from importlib import import_module
from itertools import chain, groupby, islice, repeat
from pathlib import Path
from typing import Any, Final, NamedTuple

from pycrorm_async import errors
from pycrorm_async.bulk_records import make
from pycrorm_async.clock import SYSTEM_CLOCK
from pycrorm_async.events.ids import SEQUENCE_MAX
from pycrorm_async.events.types import references_in
from pycrorm_async.store.address import DatabaseAddress
from pycrorm_async.store.placement import PLAIN, Placement
from pycrorm_async.store.stored import EpisodeRow, RunningDigest, StoredEvent, consecutive, when_and_why

_log = logging.getLogger("pycrorm_async")

PREFIX: Final = "ducklake:"
_FORMAT: Final = 1
_TABLES: Final = {
    "pycrorm_lake": "format INTEGER",
    "episode": "id UUID, head INTEGER, started_wall_ns BIGINT, ended_wall_ns BIGINT, digest VARCHAR, memory VARCHAR",
    "event": "episode UUID, sequence INTEGER, type VARCHAR, version INTEGER, wall_ns BIGINT, monotonic_ns BIGINT,"
    " payload VARCHAR",
    "declaration": "fingerprint VARCHAR, payload VARCHAR",
    "blob": "hash VARCHAR, media_type VARCHAR, content BLOB",
    "erased": "id UUID, erased_wall_ns BIGINT, reason VARCHAR",
}
_LATER: Final = {"erased"}
"""The tables, one with a later column, that lakes made before them lack until a process writes."""
_ORPHAN_AGE_S: Final = 3600.0
"""Age from which a file that the catalog does not know is not one of an archive that runs: it commits after seconds."""
_ATTEMPTS: Final = 5
"""Bounds the attempts to make a lake while other processes do."""
_PAGE_EVENTS: Final = 5_000
_EVENTS_AT_ONCE: Final = 120_000
"""Bounds the events that one query reads, unless an episode has more; it reads whole groups of 122,880 rows."""


class LakeEpisode(NamedTuple):
    """An episode of a lake, with the digest of its events."""

    id: str
    head: int
    started_wall_ns: int
    ended_wall_ns: int
    digest: str

    @property
    def row(self) -> EpisodeRow:
        """The row that a log would have of it; the number belongs to a memory, and is 0."""
        return EpisodeRow(0, self.id, self.head, self.head, self.started_wall_ns, self.ended_wall_ns)


def open_lake(address: str, *, write: bool = False) -> Any:
    """Return a connection of DuckDB whose default database is the lake; with `write` it is made if it is missing.

    Loads the extensions from the installed wheels and downloads nothing. Raises `CallerError`, `MissingExtra`,
    `DatabaseForeign`, `DatabaseUnavailable`.
    """
    catalog, place, data = _parsed(address)
    if catalog == "sqlite" and write:
        try:
            Path(place).parent.mkdir(parents=True, exist_ok=True)
        except OSError as error:
            raise errors.DatabaseUnavailable(f"{address}: the folder cannot be made: {error.strerror}") from error
    elif catalog == "sqlite" and not Path(place).exists():
        raise errors.DatabaseUnavailable(f"{address}: there is no lake: `pycrorm archive --to {address}` makes one")
    options = ["DATA_INLINING_ROW_LIMIT 0", *([f"DATA_PATH '{_quoted(data)}'"] if data else [])]
    options += [] if write else ["READ_ONLY"]
    options += ["META_BUSY_TIMEOUT 30000"] if catalog == "sqlite" else []  # ms; other archives commit meanwhile
    attach = f"ATTACH 'ducklake:{catalog}:{_quoted(place)}' AS lake ({', '.join(options)}); USE lake"
    for attempt in range(1, _ATTEMPTS + 1):
        connection = _connect("ducklake", f"{catalog}_scanner")
        if catalog == "sqlite":
            _refuse_other_program(address, Path(place))
        try:
            connection.execute(attach)
            fault = _prepare(connection, write=write)
        except import_module("duckdb").Error as error:
            connection.close()
            if not write or attempt == _ATTEMPTS:
                raise unavailable(address, error) from error
            time.sleep(0.1 * attempt)  # another process may be making the lake
            continue
        if fault is None:
            return connection
        connection.close()
        break
    raise errors.DatabaseForeign(f"{shown(address)} {fault}")


def check_present(address: str) -> None:
    """Raise `DatabaseUnavailable` if the folder of a lake that was made is away: a new one would be below its mount."""
    catalog, place, data = _parsed(address)
    for each in (place if catalog == "sqlite" else "", "" if "://" in data else data):
        if each and not Path(each).exists():
            advice = f"is away: mount {each}, or name another lake"
            raise errors.DatabaseUnavailable(f"{shown(address)} has episodes of this memory, and {advice}")


def _parsed(address: str) -> tuple[str, str, str]:
    """Return the kind of the catalog, its place, and the folder of the data. Raises `CallerError`."""
    place, _, data = address.removeprefix(PREFIX).partition("#")
    if not address.startswith(PREFIX) or not place:
        raise errors.CallerError("a lake is named ducklake:FOLDER, or ducklake:postgresql://user@host/database#FOLDER")
    if place.startswith(("postgresql:", "postgres:")):
        return "postgres", place, data
    if "://" in place:
        raise errors.CallerError(
            f"a lake has its catalog in a folder or on PostgreSQL, not at {place.partition('://')[0]}://"
        )
    if "#" in address:
        raise errors.CallerError(f"a lake in a folder has its data there: leave out #{data}")
    folder = Path(place).absolute()
    return "sqlite", f"{folder}/catalog.sqlite", f"{folder}/data"


def _connect(*extensions: str) -> Any:
    """Return a connection of DuckDB with these extensions from the installed wheels. Raises `MissingExtra`."""
    try:
        duckdb: Any = import_module("duckdb")
        wheels = [import_module(f"duckdb_extension_{each}") for each in extensions]
        import_module("pyarrow")
    except ImportError as error:
        raise errors.MissingExtra(f"a lake needs DuckDB ({error.name}): pip install 'pycrorm-async[lake]'") from None
    connection = duckdb.connect(config={"allow_unsigned_extensions": True, "autoinstall_known_extensions": False})
    connection.execute("SET enable_progress_bar = false")  # it would be among the rows on stdout, after two seconds
    for wheel in wheels:
        [file] = Path(str(wheel.__file__)).parent.rglob("*.duckdb_extension")
        connection.execute(f"LOAD '{_quoted(str(file))}'")
    return connection


def _refuse_other_program(address: str, catalog: Path) -> None:
    """Raise `DatabaseForeign` for a file that is not the catalog of a lake: DuckLake would write its tables into it."""
    if not catalog.exists() or not catalog.stat().st_size:
        return
    try:
        with closing(sqlite3.connect(f"{catalog.as_uri()}?mode=ro", uri=True)) as connection:
            tables = {name for (name,) in connection.execute("SELECT name FROM sqlite_master")}
    except sqlite3.DatabaseError as error:
        raise errors.DatabaseForeign(f"{shown(address)}: {catalog.name} is no catalog of a lake: {error}") from None
    if tables and "ducklake_metadata" not in tables:
        raise errors.DatabaseForeign(f"{shown(address)}: {catalog.name} is a database of another program")


def _prepare(connection: Any, *, write: bool) -> str | None:
    """Create the tables of a new lake; return the reason why this version cannot use it."""
    present = {name for (name,) in connection.execute("SHOW TABLES").fetchall()}
    missing = [name for name in _TABLES if name not in present]
    if not {*missing} <= _LATER and (present or not write):
        return "is a lake of another program"
    if missing and write:
        connection.execute("BEGIN")
        for name in missing:
            connection.execute(f"CREATE TABLE {name} ({_TABLES[name]})")
        if not present:
            connection.execute(f"INSERT INTO pycrorm_lake VALUES ({_FORMAT})")
        connection.execute("COMMIT")
        connection.execute("CALL lake.set_option('parquet_compression', 'zstd')")
    described = [] if "erased" in missing else connection.execute("DESCRIBE lake.erased").fetchall()
    if described and "reason" not in {name for name, *_ in described}:  # an earlier lake
        if write:
            connection.execute("ALTER TABLE erased ADD COLUMN reason VARCHAR")
        else:
            connection.execute("CREATE TEMP VIEW erased AS SELECT *, NULL::VARCHAR AS reason FROM lake.erased")
    elif missing and not write:
        connection.execute(f"CREATE TEMP TABLE erased ({_TABLES['erased']})")
    [(number,)] = connection.execute("SELECT max(format) FROM pycrorm_lake").fetchall()
    return f"was made by a newer version: its format is {number}, this reads {_FORMAT}" if number > _FORMAT else None


def shown(address: str) -> str:
    """Return the address of a lake with the absolute path of its folder, or without the password of its catalog.

    >>> shown("ducklake:postgresql://lab:secret@server/catalog#/nfs/lake")
    'ducklake:postgresql://lab@server/catalog#/nfs/lake'
    """
    catalog, place, data = _parsed(address)
    if catalog == "sqlite":
        return f"{PREFIX}{Path(place).parent}"
    return f"{PREFIX}{DatabaseAddress.parse(place).to_type}{f'#{data}' if data else ''}"


def unavailable(address: str, error: Exception) -> errors.DatabaseUnavailable:
    """Return the error to raise instead of one of DuckDB, whose further lines may have a password."""
    return errors.DatabaseUnavailable(f"{shown(address)}: {_first_line(error, address)}")


def _first_line(error: Exception, address: str) -> str:
    """Return the first line of an error of DuckDB; that of a server's catalog may repeat its URL."""
    place = _parsed(address)[1]
    return str(error).splitlines()[0].replace(place, "the catalog")


def _modified_s(file: Path) -> float:
    """Return when a file was written, in s since 1970; infinity for one that is gone."""
    try:
        return file.stat().st_mtime
    except FileNotFoundError:
        return math.inf


def _quoted(text: str) -> str:
    return text.replace("'", "''")


def _listed(names: Collection[str]) -> str:
    """Return SQL for a list of ids or hashes.

    The names are part of the statement, because DuckDB imports pandas to examine a parameter, which takes 0.3 s. They
    are one text: 100,000 names take 0.4 s so, and 1.7 s as a list of texts.
    """
    return f"string_split('{_quoted(','.join(names))}', ',')" if names else "[]::VARCHAR[]"


def _one_of(names: Collection[str], column: str) -> str:
    """Return the condition that a column has one of these ids or hashes."""
    kind = "::UUID" if column in ("id", "episode") else ""
    return f"{column} IN (SELECT unnest({_listed(names)}){kind})"


class Lake:
    """An open lake, also as the source of a copy. Calls block while DuckDB works; a thread may make them."""

    def __init__(self, address: str, *, write: bool = False) -> None:
        self.address = shown(address)
        self.log_id = self.address
        self._given = address
        self.blobs = self
        self._connection = open_lake(address, write=write)
        self._turn = threading.RLock()  # a task that is cancelled does not wait for its thread, and closes the lake
        self._listed: list[LakeEpisode] = []
        self._places: dict[str, int] = {}
        self._events: dict[str, list[StoredEvent]] = {}

    async def close(self) -> None:
        """Close the connection, when no thread uses it."""
        with self._turn:
            self._connection.close()

    def execute(self, sql: str) -> list[tuple[Any, ...]]:
        """Return the rows of a statement. Raises `DatabaseUnavailable`."""
        rows: list[tuple[Any, ...]] = self._answer(sql, lambda answer: answer.fetchall())
        return rows

    def _answer(self, sql: str, fetch: Callable[[Any], Any]) -> Any:
        """Return what is fetched of DuckDB's answer: a table of Arrow costs a quarter of tuples."""
        try:
            with self._turn:
                return fetch(self._connection.execute(sql))
        except import_module("duckdb").Error as error:
            raise unavailable(self._given, error) from error

    # --- the source of a copy -----------------------------------------------------------------------------------

    def episode_rows(self, ids: Collection[str] | None = None) -> dict[str, LakeEpisode]:
        """Return the episodes, or those of these ids, by id; without those that a killed erasure has not deleted."""
        chosen = "" if ids is None else f"AND {_one_of(ids, 'id')}"
        columns = "id::VARCHAR, max(head), min(started_wall_ns), max(ended_wall_ns), arg_max(digest, head)"
        where = f"WHERE id NOT IN (SELECT id FROM erased) {chosen}"
        query = f"SELECT {columns} FROM episode {where} GROUP BY id ORDER BY id"
        rows = {row[0]: LakeEpisode(*row) for row in self.execute(query)}
        new = [each for each in rows.values() if each.id not in self._places]
        self._places |= {each.id: place for place, each in enumerate(new, len(self._listed))}
        self._listed += new
        return rows

    async def placement(self) -> Placement:
        """Return the placement of a memory that is made for these episodes."""
        return PLAIN

    async def episodes(self) -> list[EpisodeRow]:
        """Read every episode, by id."""
        return [each.row for each in self.episode_rows().values()]

    def named(self, name: str) -> EpisodeRow:
        """Find an episode by its id or first digits of it. Raises `UnknownEpisode`."""
        begins = f"starts_with(id::VARCHAR, '{_quoted(name.lower())}')"
        ids = [each for (each,) in self.execute(f"SELECT DISTINCT id::VARCHAR FROM episode WHERE {begins}")]
        rows = self.episode_rows(ids)
        if not rows:
            for identity, why in self._erased(begins).items():
                raise errors.UnknownEpisode(f"{self.address}: episode {identity} was erased on {why}")
        if len(rows) != 1:
            how = "no episode has" if not rows else f"{len(rows)} episodes have"
            raise errors.UnknownEpisode(f"{self.address}: {how} an id that begins with {name!r}")
        [episode] = rows.values()
        return episode.row

    async def pages(self, episode: EpisodeRow, *, after: int = 0) -> AsyncIterator[Sequence[StoredEvent]]:
        """Yield the events of an episode in pages; one that two memories archived at the same time, once.

        Raises `LogDamaged` at the first missing event.
        """
        events = consecutive((await self._read(episode))[: episode.head], 0)
        del self._events[episode.id]
        for first in range(after, len(events), _PAGE_EVENTS):
            yield events[first : first + _PAGE_EVENTS]
        if len(events) < episode.head:
            raise errors.LogDamaged(episode.id, len(events) + 1, f"is missing in {self.address}")

    async def is_intact(self, episode: EpisodeRow) -> bool:
        """Return whether the events of an episode have the digest that they had in the memory that archived them."""
        digest = digest_after(RunningDigest.at_start(episode.identity), await self._read(episode))
        return digest == self._listed[self._places[episode.id]].digest

    async def _read(self, episode: EpisodeRow) -> list[StoredEvent]:
        """Read an episode with those that were listed behind it, because a query costs more than an episode."""
        if episode.id not in self._events:
            first = place = self._places[episode.id]
            left = _EVENTS_AT_ONCE - self._listed[first].head
            while (place := place + 1) < len(self._listed) and self._listed[place].head <= left:
                left -= self._listed[place].head
            ids = [each.id for each in self._listed[first:place]]
            self._events = await asyncio.to_thread(self._events_of, ids)
        return self._events[episode.id]

    def _events_of(self, ids: Sequence[str]) -> dict[str, list[StoredEvent]]:
        """Read the events of these episodes, each once; none of an episode that the lake lacks."""
        events: dict[str, list[StoredEvent]] = {each: [] for each in ids}
        if ids:
            listed = f"SELECT unnest({_listed(ids)}::UUID[]) AS id, unnest(range({len(ids)})) AS place"
            table = self._answer(
                "SELECT place, sequence, type, version, wall_ns, monotonic_ns, encode(payload)"
                f" FROM event JOIN ({listed}) ON episode = id"
                f" WHERE episode BETWEEN '{_quoted(min(ids))}' AND '{_quoted(max(ids))}' ORDER BY place, sequence",
                lambda answer: answer.to_arrow_table(),
            )
            places, *columns = table.combine_chunks().columns
            values = zip(repeat(0), *(each.to_pylist() for each in columns), strict=False)
            rows = map(make, repeat(StoredEvent), values)
            for place, run in groupby(places.to_pylist()):
                some = [*islice(rows, sum(1 for _ in run))]
                events[ids[place]] = some if some[-1].sequence == len(some) else [each for each, _ in groupby(some)]
        return events

    async def declarations(self) -> list[bytes]:
        """Read the payloads of all declarations of designator types."""
        query = "SELECT DISTINCT payload FROM declaration WHERE fingerprint < 'g'"
        return [payload.encode() for (payload,) in self.execute(query)]

    async def descriptions(self, fingerprints: Collection[str]) -> dict[str, bytes]:
        """Read the payloads of these descriptions, by fingerprint."""
        if not fingerprints:
            return {}
        query = f"SELECT DISTINCT fingerprint, payload FROM declaration WHERE {_one_of(fingerprints, 'fingerprint')}"
        return {name: payload.encode() for name, payload in self.execute(query)}

    async def read_blob(self, name: str) -> bytes | None:
        """Return a blob; None if it is missing. Implements `BlobSource`."""
        for (content,) in self.execute(f"SELECT content FROM blob WHERE hash = '{_quoted(name)}' LIMIT 1"):
            return bytes(content) if sha256(content).hexdigest() == name else None
        return None

    # --- archive and erase ----------------------------------------------------------------------------------------

    def digests(self, ids: Collection[str]) -> dict[str, str]:
        """Compute the digests of these episodes from the events in the lake."""
        starts = {name: RunningDigest.at_start(EpisodeRow(0, name, 0, 0, 0).identity) for name in ids}
        return {name: digest_after(starts[name], events) for name, events in self._events_of([*ids]).items()}

    def add(
        self,
        episodes: Sequence[tuple[LakeEpisode, Sequence[StoredEvent]]],
        declarations: Mapping[str, bytes],
        blobs: Mapping[str, tuple[str, bytes]],
        memory: str,
    ) -> None:
        """Add episodes, each with the events that the lake lacks, and what they refer to, in one transaction.

        Erases those again that another process erased meanwhile: it keeps their ids before it deletes, so that either
        this check or its deletion comes last.
        """
        ids = [each.id for each, _ in episodes]
        try:
            self.execute("BEGIN")
            self.execute(f"DELETE FROM episode WHERE {_one_of(ids, 'id')}")
            self._insert("episode", [(*each, memory) for each, _ in episodes])
            self._insert_events(episodes)
            self._insert("declaration", list(declarations.items()))
            self._insert("blob", [(name, *blob) for name, blob in blobs.items()])
            self.execute("COMMIT")
        except BaseException:  # an interruption too
            with suppress(errors.DatabaseUnavailable):
                self.execute("ROLLBACK")
            raise
        if erased := self.erased(ids):
            self.erase([*erased])
        self._clear_bounds()

    def _insert(self, table: str, rows: Sequence[tuple[Any, ...]]) -> None:
        """Insert rows in one statement, which writes one file."""
        if rows:
            arrow: Any = import_module("pyarrow")
            columns = [arrow.array(values) for values in zip(*rows, strict=True)]
            self._insert_columns(table, columns, "* REPLACE (decode(c1) AS c1)" if table == "declaration" else "*")

    def _insert_events(self, episodes: Sequence[tuple[LakeEpisode, Sequence[StoredEvent]]]) -> None:
        """Insert events in the order of episodes and sequences, in which DuckDB keeps them."""
        arrow: Any = import_module("pyarrow")
        of_episode = sorted((each.id, some) for each, some in episodes if some)
        if of_episode:
            _, *columns = zip(*chain.from_iterable(some for _, some in of_episode), strict=True)
            places = chain.from_iterable(repeat(place, len(some)) for place, (_, some) in enumerate(of_episode))
            ids = arrow.DictionaryArray.from_arrays(arrow.array(places, "int32"), [each for each, _ in of_episode])
            self._insert_columns("event", [ids, *map(arrow.array, columns)], "* REPLACE (decode(c6) AS c6)")

    def _insert_columns(self, table: str, columns: Sequence[Any], selected: str) -> None:
        named = {f"c{place}": column for place, column in enumerate(columns)}
        with self._turn:
            self._connection.register("new_rows", import_module("pyarrow").table(named))
            try:
                self.execute(f"INSERT INTO {table} SELECT {selected} FROM new_rows")
            finally:
                self._connection.unregister("new_rows")

    def erased(self, ids: Collection[str]) -> dict[str, str]:
        """Return when and why those of these episodes were erased that the lake takes from no memory, by id."""
        return self._erased(_one_of(ids, "id"))

    def _erased(self, condition: str) -> dict[str, str]:
        columns = "id::VARCHAR, min(erased_wall_ns), arg_min(reason, erased_wall_ns)"
        rows = self.execute(f"SELECT {columns} FROM erased WHERE {condition} GROUP BY id")
        return {name: when_and_why(wall_ns, reason) for name, wall_ns, reason in rows}

    def clear_orphans(self, ids: Collection[str] = ()) -> list[str]:
        """Delete files that a killed archive left; return those that stay and may have events of these episodes.

        The catalog does not know such a file. If the lake lacks an event in an old one, all stay: the catalog is an
        earlier one then, restored from a backup, and they may be the only copy.
        """
        call = "ducklake_delete_orphaned_files('lake', dry_run => true, cleanup_all => true)"
        files = [Path(path) for (path,) in self.execute(f"SELECT path FROM {call}")]
        old = {each for each in files if _modified_s(each) < time.time() - _ORPHAN_AGE_S}
        heads = {each: self._heads_in(each) for each in files if each.parent.name == "event"}
        names = {name for each in heads.values() for name in each or ()}
        there, erased = self.episode_rows(names), self.erased(names)
        known = {name: row.head for name, row in there.items()} | dict.fromkeys(erased, SEQUENCE_MAX)
        unknown = [file for file in old for name, head in (heads.get(file) or {}).items() if known.get(name, 0) < head]
        if unknown:
            _log.warning(
                "%s: the catalog does not know %s, whose events the lake lacks: was it restored from a backup?",
                self.address,
                unknown[0],
            )
            old.clear()
        for each in old:
            each.unlink(missing_ok=True)
        left = heads.keys() - old
        return [str(each) for each in left if heads[each] is None or not {*ids}.isdisjoint(heads[each] or ())]

    def _heads_in(self, file: Path) -> dict[str, int] | None:
        """Return the last event of each episode in a file of events; None for one that was not written to its end."""
        query = f"SELECT episode::VARCHAR, max(sequence) FROM read_parquet('{_quoted(str(file))}') GROUP BY 1"
        with suppress(errors.DatabaseUnavailable):
            return dict(self.execute(query))
        return None

    def absent(self, table: str, key: str, names: Collection[str]) -> set[str]:
        """Return those of these keys that a table of the lake lacks."""
        if not names:
            return set()
        query = f"SELECT DISTINCT {key} FROM {table} WHERE {_one_of(names, key)}"
        return {*names} - {name for (name,) in self.execute(query)}

    def erase(self, ids: Sequence[str], reason: str = "") -> list[str]:
        """Erase episodes: write the files again without them, delete the old ones, and keep ids and reason.

        Does so too where a call that was killed has deleted their rows. Returns files that still have events of them:
        those of an archive that runs or was killed a short time ago. Close the lake after an error.
        """
        now_ns, before = SYSTEM_CLOCK.wall_ns(), self.erased(ids)
        if new := [(name, now_ns, reason) for name in ids if name not in before]:
            self._insert("erased", new)
        query = f"SELECT type, encode(payload) FROM event WHERE {_one_of(ids, 'episode')}"
        referring = self.execute(f"{query} AND contains(payload, '\"$blob\"')")
        blobs = [each.hash for kind, payload in referring for each in references_in(kind, payload)]
        self.execute("BEGIN")
        for table, key in (("event", "episode"), ("episode", "id")):
            self.execute(f"DELETE FROM {table} WHERE {_one_of(ids, key)}")
        referred = " AND ".join(
            f"NOT EXISTS (SELECT 1 FROM {each} AS e WHERE contains(e.payload, blob.hash))"
            for each in ("event", "declaration")
        )
        self.execute(f"DELETE FROM blob WHERE {_one_of(blobs, 'hash')} AND {referred}")
        self.execute("COMMIT")
        for call in (
            "ducklake_rewrite_data_files('lake', delete_threshold => 0)",
            "ducklake_expire_snapshots('lake', older_than => TIMESTAMP '9999-01-01')",
            "ducklake_cleanup_old_files('lake', cleanup_all => true)",
        ):
            self.execute(f"SELECT count(*) FROM {call}")  # not its rows, whose times Python would convert with pytz
        self._clear_bounds()
        return self.clear_orphans(ids)

    def _clear_bounds(self) -> None:
        catalog, place, _ = _parsed(self._given)
        try:  # on a connection of its own, because that of the lake has read the catalog and locks it
            with closing(_connect(f"{catalog}_scanner")) as connection:
                connection.execute(f"ATTACH '{_quoted(place)}' AS catalog (TYPE {catalog}); USE catalog")
                for name in ("ducklake_file_column_stats", "ducklake_table_column_stats"):
                    connection.execute(
                        f"UPDATE {name} SET min_value = NULL, max_value = NULL WHERE EXISTS (FROM ducklake_column AS c"
                        f" WHERE c.table_id = {name}.table_id AND c.column_id = {name}.column_id"
                        " AND c.column_name IN ('payload', 'content'))"
                    )
        except import_module("duckdb").Error as error:
            raise unavailable(self._given, error) from error


def digest_after(running: RunningDigest, events: Sequence[StoredEvent]) -> str:
    """Add events to a digest and return it."""
    ends = running.add(events)
    return ends[-1][1] if ends and ends[-1][0] == running.sequence else running.digest()


def erase_in_lake(address: str, ids: Sequence[str], reason: str) -> list[str]:
    """Erase episodes in a lake, which has to be there, also from the free pages of a catalog in a file.

    Returns files that still have events of them, as `Lake.erase` does.
    """
    open_lake(address).close()  # makes none: a folder that is not mounted still holds them
    lake = Lake(address, write=True)
    try:
        left = lake.erase(ids, reason)
    finally:
        lake._connection.close()  # noqa: SLF001 - of this module
    catalog, place, _ = _parsed(address)
    if catalog == "sqlite":
        with closing(sqlite3.connect(place)) as connection:
            connection.execute("VACUUM")
    return left


def query_lake(address: str, sql: str) -> tuple[tuple[str, ...], list[tuple[Any, ...]]]:
    """Return the columns and the rows of one query. Raises `QueryRefused` for a wrong one, and for what may change."""
    with closing(open_lake(address)) as connection:
        try:
            statements = connection.extract_statements(sql)
            if [each.type.name for each in statements] not in (["SELECT"], ["EXPLAIN"]):
                raise errors.QueryRefused(f"{shown(address)}: give one query that only reads, such as SELECT")
            answer = connection.execute(statements[0])
            return tuple(each[0] for each in answer.description), answer.fetchall()
        except import_module("duckdb").Error as error:
            raise errors.QueryRefused(f"{shown(address)}: {_first_line(error, address)}") from error
