"""`pycrorm erase`, and the end of `pycrorm archive`: remove episodes from a memory.

Theory of operation. One transaction deletes the events of some episodes from the log, with their digests and blobs,
and the rows made from them, in every generation and of every projection, and writes a row of `pycrorm_removed_episode`
for each. From then on an append discards the events of these episodes (`store.append`), so that spools, copies and
imports cannot bring them back. The transaction raises the revision of every generation, so that a process that has
folded such an event, and not written its rows yet, rolls that batch back (`projections.generations`). The database
refuses the deletion outside of such a transaction, and on PostgreSQL to all logins but the owner of the log.

A lake is erased before this transaction, because the transaction overwrites the row that names the lake. After it
follow the pages of the file and the segments that the spool keeps. The row says when nothing was left
(`finished_wall_ns`); until then the same command continues, also after a kill at any step. It visits a lake again in
which files were left, where `--lake` names it or the episode was archived in it.

On PostgreSQL the tables may belong to another role, whose code must not run with the rights of the owner. The owner
then removes only the events; the same command, run by a login of that role, removes the rows of the tables.
"""

from collections.abc import Collection, Iterator, Mapping, Sequence
from dataclasses import replace
from datetime import datetime
from pathlib import Path
from typing import Final, NamedTuple

from sqlalchemy import text
from sqlalchemy.ext.asyncio import AsyncConnection

from pycrorm_async.clock import SYSTEM_CLOCK
from pycrorm_async.errors import CallerError, TablesForeign
from pycrorm_async.events.ids import parse_episode_id, row_id_min
from pycrorm_async.events.types import references_in
from pycrorm_async.projections.columns import EPISODE, OWN
from pycrorm_async.projections.generations import read_generation, read_generations, write_generation
from pycrorm_async.queue.stored_segments import forget_stored
from pycrorm_async.recall.cases import BLOCKS, remove_cases
from pycrorm_async.store import schema
from pycrorm_async.store.dialects import dialect_of
from pycrorm_async.store.lake import erase_in_lake
from pycrorm_async.store.log import EventLog, episode_named, tags_of
from pycrorm_async.store.stored import EpisodeRow, RemovedEpisode

EVENTS_AT_ONCE: Final = 50_000
"""Bounds the events that one transaction deletes, unless one episode has more, and so the wait of other writers."""
_ROW_KEYS: Final = ("id", "resolution_id", "node_id")
"""Possible names of the column with row ids, which begins a table's key; the first that the table has counts."""
_BLOB_EVENTS = "SELECT type, payload FROM event WHERE payload LIKE '%\"$blob\"%' AND episode IN "
_REFERRED = text("SELECT 1 FROM event WHERE payload LIKE :pattern LIMIT 1")
_REFERRED_BY_TYPE = text("SELECT 1 FROM pycrorm_declaration WHERE payload LIKE :pattern LIMIT 1")
_DELETE_BLOB = text("DELETE FROM pycrorm_blob WHERE hash = :hash")


class ErasedEpisode(NamedTuple):
    """The erasure of one episode. `left` names each place that still holds parts of it, with the next step."""

    removed: RemovedEpisode
    left: tuple[str, ...]


async def erasable(
    log: EventLog, names: Sequence[str], *, ended_before: datetime | None = None, tags: Collection[str] = ()
) -> list[EpisodeRow | RemovedEpisode]:
    """Return the named episodes; with `ended_before`, those older than it (`ages_from`) that have all these tags.

    A name may be that of an erased or archived episode. Raises `CallerError` for one that runs, and `UnknownEpisode`.
    """
    removed = {key: each for each in await log.all_removed() for key in (str(each.number), each.id)}
    if ended_before is None:
        rows = {name: removed[name] if name in removed else await episode_named(log, name) for name in names}
        for row in rows.values():
            _refuse_running(row)
        return list({row.number: row for row in rows.values()}.values())
    end_ns = ended_before.timestamp() * 1e9
    old = [row for row, from_ns in ages_from(await log.episodes(), SYSTEM_CLOCK.wall_ns()) if from_ns < end_ns]
    return [each for each in old if not tags or {*tags} <= {*await tags_of(log, each)}]


def ages_from(rows: Sequence[EpisodeRow], now_ns: int) -> Iterator[tuple[EpisodeRow, int]]:
    """Yield each episode that has ended, of those of a memory by number, with the time from which its age counts.

    This is its end, as the clock of its recorder had it, and at the earliest the start of each episode that the memory
    stored before it: a robot whose clock was years behind when it recorded does not lose what it just stored. Starts
    that are still to come, of a clock that was ahead, do not count.

    >>> rows = [EpisodeRow(1, "", 2, 2, 900, 950), EpisodeRow(2, "", 2, 2, 5000, 5050), EpisodeRow(3, "", 2, 2, 0, 50)]
    >>> [from_ns for _, from_ns in ages_from(rows, 1000)]
    [950, 5050, 900]
    """
    stored_ns = 0
    for row in rows:
        if row.ended_wall_ns is not None:
            yield row, max(row.ended_wall_ns, stored_ns)
        if row.started_wall_ns <= now_ns:
            stored_ns = max(stored_ns, row.started_wall_ns)


def _refuse_running(row: EpisodeRow | RemovedEpisode) -> None:
    if isinstance(row, EpisodeRow) and row.ended_wall_ns is None and row.refused is None:
        raise CallerError(
            f"episode {row.number} still runs: end it first; if its process died, run `pycrorm writer --once`"
        )


async def erase(
    log: EventLog,
    rows: Sequence[EpisodeRow | RemovedEpisode],
    *,
    reason: str,
    spool: Path,
    lake: str | None = None,
) -> list[ErasedEpisode]:
    """Erase these episodes, or finish their erasure, also in `lake` and in each lake to which one was archived.

    Raises `CallerError` for one that runs, and `MissingExtra` for a lake if the extra `[lake]` is not installed.
    """
    lakes: dict[str, list[str]] = {} if lake is None else {lake: [each.id for each in rows]}
    archived = [each for each in rows if isinstance(each, RemovedEpisode) and each.archived_in is not None]
    for each in [*archived, *await log.restored(each.id for each in rows)]:
        lakes.setdefault(each.archived_in or "", []).append(each.id)
    left: list[str] = []
    held_in: dict[str | None, str] = {}
    for address, ids in lakes.items():
        again = f"of an archive that runs or was killed: run `pycrorm erase` in an hour, with --lake {address}"
        if files := erase_in_lake(address, ids, reason):
            left += [f"{each}, {again}" for each in files]
            held_in[address] = address
    if archived:
        async with log.writing() as connection:
            now_ns = SYSTEM_CLOCK.wall_ns()
            begun = [each._replace(removed_wall_ns=now_ns, reason=reason, finished_wall_ns=None) for each in archived]
            changed = [each._replace(archived_in=held_in.get(each.archived_in)) for each in begun]
            await dialect_of(connection).execute(connection, schema.UPSERT_REMOVED, removed=changed)
    there = [each for each in rows if isinstance(each, EpisodeRow)]
    for some in parts(there, EVENTS_AT_ONCE):
        await remove(log, some, reason=reason)
    numbers = [each.number for each in rows]
    tables = await _remove_rows(log, numbers, left)
    if fault := await dialect_of(log.engine).purge(log.engine, tables):
        left.append(f"{fault}: run the command again when that process has ended")
    identities = {parse_episode_id(each.id): each for each in rows}
    held = forget_stored(spool, identities)
    now = {each.number: each for each in await log.all_removed()}
    done: list[ErasedEpisode] = []
    for identity, row in identities.items():
        files = [f"{each}: run `pycrorm writer --once` if its process has ended" for each in held.get(identity, ())]
        done.append(ErasedEpisode(now[row.number], (*left, *files)))
    finished = [each.removed for each in done if not each.left and each.removed.finished_wall_ns is None]
    if finished:
        async with log.writing() as connection:
            statement = schema.UPDATE_FINISHED
            await dialect_of(connection).execute(
                connection, statement, now_ns=SYSTEM_CLOCK.wall_ns(), numbers=[(each.number,) for each in finished]
            )
    return done


def parts(rows: Sequence[EpisodeRow], events_max: int) -> Iterator[list[EpisodeRow]]:
    """Yield the episodes in parts of at most `events_max` events; an episode with more is a part of its own."""
    part: list[EpisodeRow] = []
    events = 0
    for row in rows:
        if part and events + row.head > events_max:
            yield part
            part, events = [], 0
        part.append(row)
        events += row.head
    if part:
        yield part


async def remove(
    log: EventLog,
    rows: Sequence[EpisodeRow],
    *,
    reason: str,
    archived_in: str | None = None,
    digests: Mapping[int, str] | None = None,
) -> list[RemovedEpisode]:
    """Remove these episodes from log and tables, in one transaction; return those removed.

    With `archived_in`, an episode that got events since its row was read stays. If this login may not use the tables,
    raises `TablesForeign` with `archived_in`, else leaves their rows. Raises `CallerError` for an episode that runs.
    """
    now_ns = SYSTEM_CLOCK.wall_ns()
    if digests is None:
        kept = [await log.last_digests(row.number, row.number) for row in rows]
        digests = {number: each.digest for some in kept for number, each in some.items()}
    with log.translated():
        async with log.writing() as connection:
            dialect = dialect_of(connection)
            await dialect.lock_log_changes(connection)
            await dialect.create_if_missing(connection, schema.REMOVED)
            try:
                tables = await _lock_tables(connection)
            except TablesForeign:
                if archived_in is not None:
                    raise
                tables = {}
            names = [(each.id,) for each in rows]
            present = await dialect.rows(connection, EpisodeRow, schema.LOCK_EPISODES, ids=names)
            if archived_in is not None:
                heads = {each.number: each.head for each in rows}
                present = [each for each in present if each.head == heads[each.number]]
            removed = []
            for row in present:
                _refuse_running(row)
                fields = row.number, row.id, row.head, row.started_wall_ns, row.ended_wall_ns
                finished_ns = None if archived_in is None else now_ns
                digest = digests.get(row.number)
                removed.append(RemovedEpisode(*fields, digest, now_ns, reason, archived_in, finished_ns))
            if removed:
                numbers = [each.number for each in removed]
                await _delete_rows(connection, tables, numbers)
                await dialect.execute(connection, schema.UPSERT_REMOVED, removed=removed)
                await _delete_events(connection, numbers)
    return removed


async def _delete_events(connection: AsyncConnection, numbers: Sequence[int]) -> None:
    dialect = dialect_of(connection)
    hashes: set[str] = set()
    for kind, payload in await connection.execute(text(f"{_BLOB_EVENTS}{_list(numbers)}")):
        hashes |= {each.hash for each in references_in(kind, payload.encode())}
    digests = [schema.DIGEST] if (await dialect.table_state(connection, schema.DIGEST)).exists else []
    if not (await dialect.table_state(connection, schema.BLOB)).exists:
        hashes.clear()
    tables = [schema.EVENT, *digests, schema.EPISODE, *([schema.BLOB] if hashes else [])]
    async with dialect.deletion(connection, tables):
        for each in (schema.EVENT, *digests, schema.EPISODE):
            key = "number" if each is schema.EPISODE else "episode"
            await connection.exec_driver_sql(f"DELETE FROM {each.name} WHERE {key} IN {_list(numbers)}")  # noqa: S608
        for blob in sorted(hashes):  # a blob that an event of another episode, or a type, refers to stays
            pattern = {"pattern": f"%{blob}%"}
            for statement in (_REFERRED, _REFERRED_BY_TYPE):
                if (await connection.execute(statement, pattern)).first() is not None:
                    break
            else:
                await connection.execute(_DELETE_BLOB, {"hash": blob})


async def _remove_rows(log: EventLog, numbers: Sequence[int], left: list[str]) -> Sequence[str]:
    """Delete the rows that tables still have of these episodes; return the tables. Note foreign tables in `left`."""
    try:
        with log.translated():
            async with log.writing() as connection:
                await dialect_of(connection).lock_log_changes(connection)
                tables = await _lock_tables(connection)
                await _delete_rows(connection, tables, numbers)
    except TablesForeign as fault:
        left.append(f"the tables: {fault}; run the command again with the login that folds")
        return []
    return list(tables)


async def _lock_tables(connection: AsyncConnection) -> dict[str, set[str]]:
    """Return the columns of all made tables, by name; make other processes roll back folded batches not yet written."""
    dialect = dialect_of(connection)
    if not await dialect.has_table(connection, "pycrorm_generation", to_change=True):
        return {}
    for key in await read_generations(connection):
        generation = await read_generation(connection, key, hold="change")
        if generation is not None:
            await write_generation(connection, key, replace(generation, revision=generation.revision + 1))
    return await dialect.made_tables(connection)


async def _delete_rows(connection: AsyncConnection, tables: Mapping[str, set[str]], numbers: Sequence[int]) -> None:
    lowest, end = row_id_min(min(numbers)), row_id_min(max(numbers) + 1)
    for name, columns in tables.items():
        is_keyed = columns <= {"id", "folded", "parked"} or "process_metadata__" in name
        if is_keyed or EPISODE in columns:
            key = "id" if is_keyed else EPISODE
            row = None if is_keyed else next((each for each in _ROW_KEYS if each in columns), None)
            # Not every table has an index on the episode; each has one on row ids, which begin with the episode number.
            within = f" AND {row} >= {lowest} AND {row} < {end}" if row else ""
            await connection.exec_driver_sql(f'DELETE FROM "{name}" WHERE {key} IN {_list(numbers)}{within}')  # noqa: S608
        if f"{OWN}{BLOCKS}__" in name and "checksum" not in columns:  # of an earlier version: a rebuild makes all again
            await connection.exec_driver_sql(f'DELETE FROM "{name}"')  # noqa: S608
        elif f"{OWN}{BLOCKS}__" in name:
            await remove_cases(connection, int(name.rpartition("__")[2]), numbers)


def _list(numbers: Sequence[int]) -> str:
    return f"({', '.join(str(int(each)) for each in numbers)})"
