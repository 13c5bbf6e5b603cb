"""Implement the log on PostgreSQL: connections, roles, tables, statements and errors.

**Roles.** Define three roles of a memory on PostgreSQL, each with only the rights that its work needs.

    pycrorm_recorder   appends to the log
    pycrorm_folder     appends, and makes tables and views from the log: plans, `pycrorm writer`, `pycrorm rebuild`
    pycrorm_reader     reads log, tables and views: `pycrorm episodes`, `show`, `verify`, notebooks

No role can change or delete an event: they lack the privilege, and triggers refuse it to the owner too. The owner of
the database creates the log by opening the memory once (`pycrorm writer --once`), and then runs `GRANTS`, which may be
repeated. `GRANTS` transfers the tables and views, which can be rebuilt from the log, to `pycrorm_folder`; the log stays
with the owner. An owner without CREATEROLE gets the statements that a role with it must run first. Users and programs
get a role by membership:

    GRANT pycrorm_reader TO ada;
    GRANT pycrorm_folder TO robot; ALTER ROLE robot IN DATABASE memory SET role = 'pycrorm_folder';

The second line makes the objects that one robot creates belong to all robots, so that each can extend the others'
tables.

From then on the owner's own login can append and migrate the log, but is refused at tables and views: members of
`pycrorm_folder` could plant code there that would run with the owner's rights (see `postgresql_engine`). The owner
folds and reads with logins that have no other rights:

    CREATE ROLE lab LOGIN IN ROLE pycrorm_folder; ALTER ROLE lab IN DATABASE memory SET role = 'pycrorm_folder';

All recorders and folders of a memory trust each other: each can append to the others' episodes, end them, and use up
the episode numbers, because checking each event's episode against the login that began it costs an eighth of the append
rate. All readers trust the folders, whose views they read.
"""

# ruff: noqa: S608 - the SQL is composed of column lists only; every value is a parameter

from __future__ import annotations

from collections.abc import AsyncIterator, Collection, Iterable, Iterator, Mapping, Sequence
from contextlib import asynccontextmanager
from itertools import groupby
from operator import itemgetter
from typing import Any, NamedTuple

from sqlalchemy.exc import DBAPIError
from sqlalchemy.ext.asyncio import AsyncConnection, AsyncEngine

from pycrorm_async.bulk_records import make
from pycrorm_async.errors import (
    DatabaseError,
    DatabaseForeign,
    DatabaseUnavailable,
    PycrormError,
    TablesUntrusted,
    TablesWithheld,
)
from pycrorm_async.events.ids import EPISODE_NUMBER_MAX, SEQUENCE_MAX
from pycrorm_async.store import postgresql_errors
from pycrorm_async.store.dialect import (
    Birth,
    DigestStatements,
    Expected,
    Insertion,
    LogIdentity,
    Migrations,
    Progress,
    RowsByTable,
    StoredOn,
)
from pycrorm_async.store.postgresql_engine import LOG_SCHEMA, PATH, STRANGER, TABLES_SCHEMA, VIEWS_SCHEMA, WARNING
from pycrorm_async.store.postgresql_engine import LOG_SCHEMA as LOG
from pycrorm_async.store.postgresql_engine import TABLES_SCHEMA as TABLES
from pycrorm_async.store.postgresql_engine import VIEWS_SCHEMA as VIEWS
from pycrorm_async.store.stored import EpisodeRow, Incarnation, Span, StoredEvent

# === tables ===================================================================================================
#
# Define the log's tables on PostgreSQL as numbered migrations; the first N of them create format N.

SYSTEM_COLUMNS = frozenset("xmin xmax cmin cmax ctid tableoid".split())
"""Names that every table reserves for system columns; a view may use them."""

SERVER_VERSION = "SELECT pg_catalog.current_setting('server_version_num')::int"

ALONE = "SELECT pg_catalog.pg_advisory_xact_lock(7266203370152417861)"
"""Serialises creation and migration, because IF NOT EXISTS alone races. The key encodes our name."""
CLAIM = "SELECT pg_catalog.pg_try_advisory_lock(7266203370152417862)"
RELEASE = "SELECT pg_catalog.pg_advisory_unlock(7266203370152417862)"

# Less than deadlock_timeout, so that the session that changes tables fails, never a reader.
WAIT_BRIEFLY = "SET LOCAL lock_timeout = '300ms'"
WAIT_FOR_NOBODY = "SET LOCAL lock_timeout = '20ms'"
WAIT_AS_EVER = "SET LOCAL lock_timeout TO DEFAULT"

_NEW = f"{VIEWS}_new"

IN_VIEWS_SCHEMA = f"""
SELECT coalesce(relname, objid::text) FROM pg_catalog.pg_namespace
JOIN pg_catalog.pg_depend ON refclassid = 'pg_catalog.pg_namespace'::regclass::oid AND refobjid = pg_namespace.oid
LEFT JOIN pg_catalog.pg_class ON classid = 'pg_catalog.pg_class'::regclass::oid AND pg_class.oid = objid
WHERE nspname = '{VIEWS}' AND (relname = ANY ($1::text[])) IS NOT TRUE
AND classid <> 'pg_catalog.pg_default_acl'::regclass::oid"""
"""Selects the objects in the views' schema other than these views."""

NEW_VIEWS_SCHEMA = (
    f"CREATE SCHEMA {_NEW}",
    f"SET LOCAL search_path = {_NEW}, {TABLES}, {LOG}",
)
LET_READ_VIEWS = f"""
DO $$
BEGIN
    IF pg_catalog.has_schema_privilege(pg_catalog.to_regrole('pycrorm_reader'), '{TABLES}', 'USAGE') THEN
        GRANT USAGE ON SCHEMA {VIEWS} TO pycrorm_reader;
        GRANT SELECT ON ALL TABLES IN SCHEMA {VIEWS} TO pycrorm_reader;
    END IF;
END $$"""
"""Gives the reader the views of a new schema, where it may read the tables (`OWNER_GRANTS`)."""
SHOW_NEW_VIEWS_SCHEMA = (
    f"""
DO $$
BEGIN
    IF pg_catalog.to_regnamespace('{VIEWS}') IS NOT NULL THEN
        EXECUTE pg_catalog.format(
            'ALTER SCHEMA {VIEWS} RENAME TO %I',
            pg_catalog.concat(
                '{VIEWS}_gone_', pg_catalog.pg_current_xact_id(), '_', pg_catalog.to_regnamespace('{VIEWS}')::oid
            )
        );
    END IF;
END $$""",
    f"ALTER SCHEMA {_NEW} RENAME TO {VIEWS}",
    f"SET LOCAL search_path = {PATH}",
)

GONE_SCHEMAS = f"""
SELECT pg_catalog.quote_ident(nspname),
pg_catalog.array_agg(pg_catalog.format('%I.%I', nspname, relname)) FILTER (WHERE relkind = 'v')
FROM pg_catalog.pg_namespace LEFT JOIN pg_catalog.pg_class ON relnamespace = pg_namespace.oid
WHERE pg_catalog.starts_with(nspname::text, '{VIEWS}_gone_') AND pg_catalog.pg_has_role(nspowner, 'USAGE')
GROUP BY nspname"""
"""Selects the schemas of replaced views, with their views."""

_LOG = f"""
CREATE TABLE {LOG}.pycrorm_log (
    one integer PRIMARY KEY CHECK (one = 1),
    id text NOT NULL,
    format integer NOT NULL,
    created_wall_ns bigint NOT NULL
)"""

_DECLARATION = f"""
CREATE TABLE {LOG}.pycrorm_declaration (
    ordinal bigint GENERATED ALWAYS AS IDENTITY PRIMARY KEY,
    fingerprint text NOT NULL UNIQUE,
    payload text NOT NULL
)"""

# Numbers come from a sequence, so that no robot waits for another one's transaction; a rollback leaves a hole.
_NUMBERS = f"CREATE SEQUENCE {LOG}.episode_number"

_EPISODE = f"""
CREATE TABLE {LOG}.episode (
    number bigint PRIMARY KEY CHECK (number BETWEEN 1 AND {EPISODE_NUMBER_MAX}),
    id text NOT NULL UNIQUE,
    head bigint NOT NULL CHECK (head BETWEEN 0 AND {SEQUENCE_MAX}),
    folded bigint NOT NULL DEFAULT 0 CHECK (folded BETWEEN 0 AND head),
    started_wall_ns bigint NOT NULL,
    ended_wall_ns bigint,
    refused text,
    parked text
)"""

# Each append and each fold changes whether an episode is in this index, so no update is heap-only, whatever space its
# page has. In return a poll costs the same with any number of episodes.
_BEHIND = f"CREATE INDEX episode_behind ON {LOG}.episode (number) WHERE folded < head AND parked IS NULL"
_STOPPED = f"CREATE INDEX episode_stopped ON {LOG}.episode (number) WHERE refused IS NOT NULL OR parked IS NOT NULL"

# integer holds both parts of the key (`events.ids`) in half the bytes. Logs of 0.1.0 have bigint, which reads alike.
# The fill factor leaves no room in the pages of the key, because events are only appended.
# The payload is text, which keeps the bytes of the queue: jsonb refuses U+0000, reorders keys and rounds numbers.
_EVENT = f"""
CREATE TABLE {LOG}.event (
    episode integer NOT NULL,
    sequence integer NOT NULL,
    type text NOT NULL,
    version integer NOT NULL,
    wall_ns bigint NOT NULL,
    monotonic_ns bigint NOT NULL,
    payload text NOT NULL,
    PRIMARY KEY (episode, sequence) WITH (fillfactor = 100)
)"""

_REFUSAL = f"""
CREATE FUNCTION {LOG}.refuse_change() RETURNS trigger LANGUAGE plpgsql AS $$
BEGIN
    RAISE EXCEPTION 'the event log is append-only: % refuses %', TG_TABLE_NAME, TG_OP
    USING ERRCODE = 'integrity_constraint_violation';
END $$"""


def _refuse(name: str, changes: str, table: str) -> str:
    return (
        f"CREATE TRIGGER {name} BEFORE {changes} ON {LOG}.{table}"
        f" FOR EACH STATEMENT EXECUTE FUNCTION {LOG}.refuse_change()"
    )


_FIRST = (
    f"CREATE SCHEMA {LOG}",
    _LOG,
    _DECLARATION,
    _NUMBERS,
    _EPISODE,
    _BEHIND,
    _STOPPED,
    _EVENT,
    _REFUSAL,
    _refuse("event_is_not_changed", "UPDATE OR DELETE OR TRUNCATE", "event"),
    _refuse("declaration_is_not_changed", "UPDATE OR DELETE OR TRUNCATE", "pycrorm_declaration"),
    _refuse("episode_is_not_renamed", "UPDATE OF number, id", "episode"),
    _refuse("episode_is_not_deleted", "DELETE OR TRUNCATE", "episode"),
    _refuse("log_is_not_renamed", "UPDATE OF id", "pycrorm_log"),
    _refuse("log_is_not_deleted", "DELETE OR TRUNCATE", "pycrorm_log"),
)

MIGRATIONS: tuple[tuple[str, ...], ...] = (_FIRST,)

INCARNATION = f"""
CREATE TABLE IF NOT EXISTS {LOG}.pycrorm_incarnation (
    number bigint GENERATED ALWAYS AS IDENTITY PRIMARY KEY,
    noticed_wall_ns bigint NOT NULL,
    noticed_by text NOT NULL,
    reason text NOT NULL
)"""
"""Created when a log is first found to have gone back. Not part of the format: older programs still use the log."""
DIGEST = (
    f"""
CREATE TABLE IF NOT EXISTS {LOG}.pycrorm_digest (
    episode integer NOT NULL,
    sequence integer NOT NULL,
    digest text NOT NULL,
    PRIMARY KEY (episode, sequence) WITH (fillfactor = 100)
)""",
    f"""
CREATE OR REPLACE TRIGGER digest_is_not_changed BEFORE UPDATE OR DELETE OR TRUNCATE ON {LOG}.pycrorm_digest
FOR EACH STATEMENT EXECUTE FUNCTION {LOG}.refuse_change()""",
)
"""Created when a log is opened for writing. Not part of the format: older programs still use the log."""

HAS_INCARNATION = f"SELECT pg_catalog.to_regclass('{LOG}.pycrorm_incarnation') IS NOT NULL"

BLOB = (
    f"""
CREATE TABLE IF NOT EXISTS {LOG}.pycrorm_blob (
    hash text NOT NULL,
    part bigint NOT NULL,
    parts bigint NOT NULL,
    media_type text NOT NULL,
    size bigint NOT NULL,
    content bytea NOT NULL,
    PRIMARY KEY (hash, part)
)""",
    f"""
CREATE OR REPLACE TRIGGER blob_is_not_changed BEFORE UPDATE OR DELETE OR TRUNCATE ON {LOG}.pycrorm_blob
FOR EACH STATEMENT EXECUTE FUNCTION {LOG}.refuse_change()""",
)
"""Created with the first blob. Not part of the format: older programs still use the log."""

TABLE_NAMES = f"""
SELECT relname FROM pg_catalog.pg_class WHERE relnamespace = pg_catalog.to_regnamespace('{LOG}')::oid"""
HAS_TABLE = f"""
SELECT is_withheld, CASE WHEN is_withheld THEN false
ELSE pg_catalog.to_regclass(pg_catalog.format('{TABLES}.%I', $1::text)) IS NOT NULL END, ({STRANGER}), session_user
FROM (
    SELECT pg_catalog.has_schema_privilege(pg_catalog.to_regnamespace('{TABLES}')::oid, $2::text) IS FALSE
    AND pg_catalog.has_table_privilege(pg_catalog.to_regclass('{LOG}.event')::oid, 'INSERT')
) AS login (is_withheld)"""
READ_LOG = f"SELECT id, format FROM {LOG}.pycrorm_log"
INSERT_LOG = f"INSERT INTO {LOG}.pycrorm_log (one, id, format, created_wall_ns) VALUES (1, $1, $2, $3)"
SET_FORMAT = f"UPDATE {LOG}.pycrorm_log SET format = $1"


COLUMNS_OF_VIEWS = f"""
SELECT relname, attname FROM pg_catalog.pg_class JOIN pg_catalog.pg_attribute ON attrelid = pg_class.oid
WHERE relnamespace = '{VIEWS}'::regnamespace AND relkind = 'v' AND attnum > 0 ORDER BY relname, attnum"""


def comment_statements(columns: Iterable[Sequence[str]], comments: Mapping[str, Mapping[str, str]]) -> list[str]:
    """Return the statements that describe these columns of views, and the views themselves."""
    statements = []
    for view, named in groupby(columns, key=itemgetter(0)):
        texts = comments.get(view, {})
        place = f'{VIEWS}."{view}"'
        statements += [f"COMMENT ON VIEW {place} IS {_literal(texts[''])}"] if "" in texts else []
        statements += [
            f'COMMENT ON COLUMN {place}."{name}" IS {_literal(texts[name])}' for _, name in named if name in texts
        ]
    return statements


def _literal(text: str) -> str:
    return "'" + text.replace("'", "''") + "'"


# === statements ===============================================================================================
#
# Define the log's SQL for PostgreSQL. A batch is one statement per table: COPY for events, arrays for the rest.
#
# Every function is qualified with its schema, so that no function of another role in the search path replaces it. Only
# `unnest` with several arrays cannot be qualified, because it is syntax; it always means the one in pg_catalog.

# Transactions that insert new declarations take turns, so that the order by `ordinal` is that of their commits.
# Otherwise a fold could read the second before the first, and name contradicting fields otherwise than a rebuild.
INSERT_DECLARATIONS = """
WITH new AS MATERIALIZED (
    SELECT one.* FROM unnest($1::text[], $2::text[]) WITH ORDINALITY AS one (fingerprint, payload, place)
    WHERE NOT EXISTS (SELECT FROM pycrorm.pycrorm_declaration AS stored WHERE stored.fingerprint = one.fingerprint)
), turn AS MATERIALIZED (
    SELECT pg_catalog.pg_advisory_xact_lock(7266203370152417863) FROM new LIMIT 1
)
INSERT INTO pycrorm.pycrorm_declaration (fingerprint, payload)
SELECT fingerprint, payload FROM new CROSS JOIN (SELECT pg_catalog.count(*) FROM turn) AS taken
ORDER BY place ON CONFLICT (fingerprint) DO NOTHING"""

NEW_NUMBERS = "SELECT pg_catalog.nextval('pycrorm.episode_number') FROM pg_catalog.generate_series(1, $1::int)"
SKIP_NUMBERS = (
    "SELECT pg_catalog.max(pg_catalog.nextval('pycrorm.episode_number')) FROM pg_catalog.generate_series(1, $1::int)"
)
SELECT_NUMBERS_TAKEN = "SELECT number FROM pycrorm.episode WHERE number = ANY ($1::bigint[])"

INSERT_INCARNATION = """
INSERT INTO pycrorm.pycrorm_incarnation (noticed_wall_ns, noticed_by, reason) VALUES ($1, $2, $3)"""
SELECT_INCARNATIONS = """
SELECT noticed_wall_ns, noticed_by, reason FROM pycrorm.pycrorm_incarnation ORDER BY number"""

SYNCHRONOUS_STANDBYS = "SELECT pg_catalog.current_setting('synchronous_standby_names')"
SELECT_SYNCHRONOUS = """
SELECT application_name FROM pg_catalog.pg_stat_replication
WHERE sync_state IN ('sync', 'quorum') ORDER BY application_name"""

EVENT_COLUMNS = ("episode", "sequence", "type", "version", "wall_ns", "monotonic_ns", "payload")

UPSERT_EPISODES = """
INSERT INTO pycrorm.episode (number, id, head, started_wall_ns, ended_wall_ns, refused)
SELECT * FROM unnest($1::bigint[], $2::text[], $3::bigint[], $4::bigint[], $5::bigint[], $6::text[])
ON CONFLICT (number) DO UPDATE
SET head = excluded.head, ended_wall_ns = excluded.ended_wall_ns, refused = excluded.refused"""

_DIGEST = "pg_catalog.to_regclass('pycrorm.pycrorm_digest')"
DIGEST_STATEMENTS = DigestStatements(
    table=DIGEST,
    creatable=f"SELECT {_DIGEST} IS NULL AND pg_catalog.has_schema_privilege('pycrorm', 'CREATE')",
    usable=f"""
SELECT coalesce(pg_catalog.has_table_privilege({_DIGEST}::oid, 'SELECT'), false),
coalesce(pg_catalog.has_table_privilege({_DIGEST}::oid, 'SELECT')
    AND pg_catalog.has_table_privilege({_DIGEST}::oid, 'INSERT'), false)""",
    insert="""
INSERT INTO pycrorm.pycrorm_digest (episode, sequence, digest)
SELECT (value->>0)::bigint, (value->>1)::bigint, value->>2
FROM pg_catalog.json_array_elements($1::text::json) AS one (value) ON CONFLICT DO NOTHING""",
)

WRITE_AHEAD = "SELECT pg_catalog.pg_logical_emit_message(true, 'pycrorm', '')"
"""Writes an empty message to the server's write-ahead log. A COMMIT without any record there waits for no standby, and
could acknowledge events of another transaction that no standby has yet."""

_EVENT_ROW = (
    "event.episode, event.sequence, event.type, event.version, event.wall_ns, event.monotonic_ns,"
    " pg_catalog.convert_to(event.payload, 'UTF8')"
)

SELECT_STORED_AGAIN = f"""
SELECT {_EVENT_ROW} FROM unnest($1::bigint[], $2::bigint[]) AS wanted (episode, sequence)
JOIN pycrorm.event USING (episode, sequence)"""

_EPISODE_ROW = "number, id, head, folded, started_wall_ns, ended_wall_ns, refused, parked"

# Locks in a fixed order, so that two writers of the same episodes cannot deadlock.
SELECT_EPISODES_BY_ID = f"""
SELECT {_EPISODE_ROW} FROM pycrorm.episode WHERE id = ANY ($1::text[]) ORDER BY number FOR UPDATE"""

# Reads the witness without a lock, so that the appends of two recorders do not wait for each other.
SELECT_EPISODES_AND_WITNESS = f"""
WITH locked AS MATERIALIZED ({SELECT_EPISODES_BY_ID})
SELECT * FROM locked UNION ALL SELECT {_EPISODE_ROW} FROM pycrorm.episode WHERE id = $2"""

SELECT_HEADS = f"SELECT {_EPISODE_ROW} FROM pycrorm.episode WHERE id = ANY ($1::text[])"
SELECT_EPISODE_BY_ID = f"SELECT {_EPISODE_ROW} FROM pycrorm.episode WHERE id = $1"
SELECT_EPISODES = f"SELECT {_EPISODE_ROW} FROM pycrorm.episode WHERE number BETWEEN $1 AND $2 ORDER BY number"
SELECT_BEHIND = f"""
SELECT {_EPISODE_ROW} FROM pycrorm.episode
WHERE folded < head AND parked IS NULL AND number > $1 ORDER BY number LIMIT $2"""
SELECT_STOPPED = f"""
SELECT {_EPISODE_ROW} FROM pycrorm.episode WHERE refused IS NOT NULL OR parked IS NOT NULL ORDER BY number"""
SELECT_NUMBER_MAX = "SELECT coalesce(max(number), 0) FROM pycrorm.episode"
SELECT_LONG = f"""
SELECT {_EPISODE_ROW} FROM pycrorm.episode WHERE head >= $1 AND ended_wall_ns IS NULL ORDER BY number"""

SELECT_EVENTS = f"""
SELECT {_EVENT_ROW} FROM pycrorm.event WHERE episode = $1 AND sequence > $2 ORDER BY sequence LIMIT $3"""

# LATERAL, so that each span is read by the primary key, whatever the size of the table.
SELECT_SPANS = f"""
SELECT event.* FROM unnest($1::bigint[], $2::bigint[], $3::bigint[])
WITH ORDINALITY AS span (number, after, last, place) CROSS JOIN LATERAL (
    SELECT {_EVENT_ROW} FROM pycrorm.event
    WHERE episode = span.number AND sequence > span.after AND sequence <= span.last ORDER BY sequence
) AS event ORDER BY span.place, event.sequence"""

_PAYLOADS = "SELECT pg_catalog.convert_to(payload, 'UTF8') FROM pycrorm.pycrorm_declaration"
# By equality, because the order of letters and digits depends on the database's collation.
SELECT_DECLARATIONS = f"{_PAYLOADS} WHERE pg_catalog.substr(fingerprint, 1, 5) <> 'urdf-' ORDER BY ordinal"
SELECT_DESCRIPTIONS = f"{_PAYLOADS} WHERE fingerprint = ANY ($1::text[])"

# Locks the rows by number first, as elsewhere. An UPDATE alone locks them in any order, so that two processes that fold
# the same episodes would sometimes deadlock, for a second each time.
ADVANCE_FOLDED = """
WITH step AS MATERIALIZED (
    SELECT * FROM unnest($1::bigint[], $2::bigint[], $3::bigint[]) AS one (number, before, folded)
), taken AS MATERIALIZED (
    SELECT number FROM pycrorm.episode WHERE number = ANY ($1::bigint[]) ORDER BY number FOR UPDATE
)
UPDATE pycrorm.episode SET folded = step.folded
FROM step JOIN taken USING (number)
WHERE episode.number = step.number AND episode.folded = step.before"""

PARK = "UPDATE pycrorm.episode SET parked = $1 WHERE number = $2"


# === dialect ==================================================================================================
#
# Implement `Dialect` for PostgreSQL; the SQL is in the sections before.

_SERVER_MIN = 140_000
"""The lowest supported `server_version_num`: PostgreSQL 14."""
_RESTORING = "a restore may be running; try again when it has finished"


class PostgreSQL:
    """Implements `Dialect`. Events are inserted by COPY; an append locks its episodes' rows until COMMIT."""

    migrations: Migrations = MIGRATIONS
    digest_statements = DIGEST_STATEMENTS
    episode_id = "episode.id"
    blob_table: Sequence[str] = BLOB
    faults: tuple[type[Exception], ...] = postgresql_errors.FAULTS

    # --- finding and creating a log ---------------------------------------------------------------------------------

    async def prepare(self, engine: AsyncEngine, name: str) -> None:
        """Do nothing: PostgreSQL needs no preparation outside a transaction."""

    async def lock_log_changes(self, connection: AsyncConnection) -> None:
        await connection.exec_driver_sql(ALONE)

    async def find_log(self, connection: AsyncConnection, name: str) -> LogIdentity | None:
        version = (await connection.exec_driver_sql(SERVER_VERSION)).scalar_one()
        if version < _SERVER_MIN:
            raise DatabaseUnavailable(f"{name}: PostgreSQL 14 or newer is needed, this is {version // 10_000}")
        names = set((await connection.exec_driver_sql(TABLE_NAMES)).scalars())
        if not names:
            return None
        if "pycrorm_log" not in names:
            if names & {"episode", "event", "pycrorm_declaration"} == set():
                raise DatabaseForeign(f"{name} has a schema {LOG_SCHEMA!r} of another program: it has no pycrorm_log")
            raise DatabaseUnavailable(f"{name}: the table pycrorm_log is missing: {_RESTORING}")
        row = (await connection.exec_driver_sql(READ_LOG)).one_or_none()
        if row is None:
            raise DatabaseUnavailable(f"{name}: the table pycrorm_log is empty: {_RESTORING}")
        return LogIdentity._make(row)

    async def execute_all(self, connection: AsyncConnection, statements: Sequence[str]) -> None:
        # One message, bypassing SQLAlchemy, in the transaction that an earlier statement through SQLAlchemy began.
        await (await _driver(connection)).execute("; ".join(statements))

    async def insert_log(self, connection: AsyncConnection, birth: Birth, format_now: int) -> None:
        await connection.exec_driver_sql(INSERT_LOG, (birth.log_id, format_now, birth.created_wall_ns))

    async def set_format(self, connection: AsyncConnection, format_now: int) -> None:
        await connection.exec_driver_sql(SET_FORMAT, (format_now,))

    # --- appending ----------------------------------------------------------------------------------------------

    async def insert_declarations(self, connection: AsyncConnection, named: Sequence[tuple[str, str]]) -> None:
        await connection.exec_driver_sql(INSERT_DECLARATIONS, _arrays(named, 2))

    async def episodes_by_id(
        self, connection: AsyncConnection, ids: Sequence[str], *, witness: str | None = None
    ) -> list[EpisodeRow]:
        if witness is None:
            return await _rows(EpisodeRow, connection, SELECT_EPISODES_BY_ID, list(ids))
        return await _rows(EpisodeRow, connection, SELECT_EPISODES_AND_WITNESS, list(ids), witness)

    async def new_numbers(self, connection: AsyncConnection, count: int, *, above: int = 0) -> list[int]:  # noqa: ARG002
        return list((await connection.exec_driver_sql(NEW_NUMBERS, (count,))).scalars())

    async def skip_numbers(self, connection: AsyncConnection, above: int) -> None:
        # Uses nextval, because setval needs a privilege and could move the sequence back behind another session.
        number = (await connection.exec_driver_sql(NEW_NUMBERS, (1,))).scalar_one()
        if number < above:
            await connection.exec_driver_sql(SKIP_NUMBERS, (above - number,))

    async def numbers_taken(self, connection: AsyncConnection, numbers: Sequence[int]) -> set[int]:
        return set((await connection.exec_driver_sql(SELECT_NUMBERS_TAKEN, (list(numbers),))).scalars())

    async def heads(self, connection: AsyncConnection, ids: Sequence[str]) -> list[EpisodeRow]:
        return await _rows(EpisodeRow, connection, SELECT_HEADS, list(ids))

    async def note_incarnation(self, connection: AsyncConnection, incarnation: Incarnation) -> None:
        # A role without the privilege to create tables relies on the owner's (`roles.GRANTS`).
        if not await self._has_incarnations(connection):
            await self.lock_log_changes(connection)
            await connection.exec_driver_sql(INCARNATION)
        await connection.exec_driver_sql(INSERT_INCARNATION, tuple(incarnation))

    async def incarnations(self, connection: AsyncConnection) -> list[Incarnation]:
        if not await self._has_incarnations(connection):
            return []
        return await _rows(Incarnation, connection, SELECT_INCARNATIONS)

    async def _has_incarnations(self, connection: AsyncConnection) -> bool:
        return bool((await connection.exec_driver_sql(HAS_INCARNATION)).scalar_one())

    async def stored_on(self, connection: AsyncConnection) -> StoredOn:
        configured = (await connection.exec_driver_sql(SYNCHRONOUS_STANDBYS)).scalar_one().strip()
        if not configured:
            return StoredOn(1)
        # Without pg_read_all_stats their states are null, but COMMIT still waits for them.
        names = tuple((await connection.exec_driver_sql(SELECT_SYNCHRONOUS)).scalars())
        return StoredOn(1 + max(1, _confirming(configured)), names or (configured,))

    async def event_insertion(self, rows: Iterator[tuple[Any, ...]]) -> Insertion:
        return rows  # read while COPY runs, so that the server stores the first rows while the last are computed

    async def insert_events(self, connection: AsyncConnection, insertion: Insertion) -> None:
        await _copy(connection, LOG_SCHEMA, "event", EVENT_COLUMNS, insertion)

    async def upsert_episodes(self, connection: AsyncConnection, episodes: Sequence[EpisodeRow]) -> None:
        rows = [
            (each.number, each.id, each.head, each.started_wall_ns, each.ended_wall_ns, each.refused)
            for each in sorted(episodes)
        ]
        await connection.exec_driver_sql(UPSERT_EPISODES, _arrays(rows, 6))

    async def force_durable_commit(self, connection: AsyncConnection) -> None:
        await connection.exec_driver_sql(WRITE_AHEAD)

    async def commit(self, connection: AsyncConnection) -> None:
        # A COMMIT that is cancelled while it waits for a synchronous standby succeeds, with a warning.
        connected = (await connection.get_raw_connection()).info
        connected.pop(WARNING, None)
        await connection.commit()
        if WARNING in connected:
            raise postgresql_errors.CommitInDoubt(connected[WARNING])

    async def events_by_key(self, connection: AsyncConnection, keys: Sequence[tuple[int, int]]) -> list[StoredEvent]:
        return await _rows(StoredEvent, connection, SELECT_STORED_AGAIN, *_arrays(keys, 2))

    # --- reading ------------------------------------------------------------------------------------------------

    async def episode(self, connection: AsyncConnection, identity: str) -> EpisodeRow | None:
        return next(iter(await _rows(EpisodeRow, connection, SELECT_EPISODE_BY_ID, identity)), None)

    async def episodes(self, connection: AsyncConnection, first: int, last: int) -> list[EpisodeRow]:
        return await _rows(EpisodeRow, connection, SELECT_EPISODES, first, last)

    async def behind(self, connection: AsyncConnection, *, after: int, limit: int) -> list[EpisodeRow]:
        return await _rows(EpisodeRow, connection, SELECT_BEHIND, after, limit)

    async def stopped(self, connection: AsyncConnection) -> list[EpisodeRow]:
        return await _rows(EpisodeRow, connection, SELECT_STOPPED)

    async def last_number(self, connection: AsyncConnection) -> int:
        return int((await connection.exec_driver_sql(SELECT_NUMBER_MAX)).scalar_one())

    async def long_episodes(self, connection: AsyncConnection, events_min: int) -> list[EpisodeRow]:
        return await _rows(EpisodeRow, connection, SELECT_LONG, events_min)

    async def events(self, connection: AsyncConnection, number: int, *, after: int, limit: int) -> list[StoredEvent]:
        return await _rows(StoredEvent, connection, SELECT_EVENTS, number, after, limit)

    async def spans(self, connection: AsyncConnection, spans: Sequence[Span]) -> list[StoredEvent]:
        # Bypasses SQLAlchemy, which processes every row twice.
        rows = await (await _driver(connection)).fetch(SELECT_SPANS, *_arrays(spans, 3))
        return [make(StoredEvent, row) for row in rows]

    async def declarations(self, connection: AsyncConnection) -> list[bytes]:
        return [bytes(row[0]) for row in await connection.exec_driver_sql(SELECT_DECLARATIONS)]

    async def descriptions(self, connection: AsyncConnection, fingerprints: Sequence[str]) -> list[bytes]:
        wanted = list(fingerprints)
        return [bytes(row[0]) for row in await connection.exec_driver_sql(SELECT_DESCRIPTIONS, (wanted,))]

    async def begin_snapshot(self, connection: AsyncConnection) -> None:
        await connection.exec_driver_sql("SET TRANSACTION ISOLATION LEVEL REPEATABLE READ")

    async def keep(self, connection: AsyncConnection, tables: Sequence[str]) -> bool:
        quote = connection.dialect.identifier_preparer.quote
        named = ", ".join(f"{TABLES_SCHEMA}.{quote(each)}" for each in tables)
        try:
            await connection.exec_driver_sql(f"LOCK TABLE {named} IN ACCESS SHARE MODE")
        except DBAPIError as error:
            if postgresql_errors.is_missing_table(error):
                return False
            raise
        return True

    async def faults_of_file(self, connection: AsyncConnection) -> list[str]:  # noqa: ARG002
        return []  # a server checks its pages itself

    # --- folding ------------------------------------------------------------------------------------------------

    async def advance_folded(self, connection: AsyncConnection, steps: Sequence[Progress]) -> int:
        return (await connection.exec_driver_sql(ADVANCE_FOLDED, _arrays(steps, 3))).rowcount

    async def park(self, connection: AsyncConnection, number: int, reason: str | None) -> None:
        await connection.exec_driver_sql(PARK, (reason, number))

    # --- tables and views ---------------------------------------------------------------------------------------

    async def make_place(self, connection: AsyncConnection) -> None:
        await connection.exec_driver_sql(f"CREATE SCHEMA IF NOT EXISTS {TABLES_SCHEMA}")

    async def has_table(self, connection: AsyncConnection, name: str, *, to_change: bool = False) -> bool:
        parameters = (name, "CREATE" if to_change else "USAGE")
        is_withheld, exists, stranger, login = tuple((await connection.exec_driver_sql(HAS_TABLE, parameters)).one())
        if stranger is not None:
            raise TablesUntrusted(
                f"the tables belong to {stranger}, whose members could run their code with the rights of {login}:"
                f" fold with a login that is a member of {stranger} and has no right to the log, read with one of"
                " pycrorm_reader"
            )
        if is_withheld:
            raise TablesWithheld(
                f"{login} may {'not change' if to_change else 'neither read nor change'} the tables: fold with"
                " `pycrorm writer` and a login that may, read with one of pycrorm_reader"
            )
        return bool(exists)

    async def expect(self, connection: AsyncConnection, tables: Sequence[Expected]) -> None:
        """Do nothing: the server gathers statistics itself."""

    async def gather_statistics(self, connection: AsyncConnection, tables: Sequence[str]) -> None:
        quote = connection.dialect.identifier_preparer.quote
        await connection.exec_driver_sql(f"ANALYZE {', '.join(f'{TABLES_SCHEMA}.{quote(each)}' for each in tables)}")

    def stored_column(self, name: str) -> str:
        return f"_{name}" if name in SYSTEM_COLUMNS else name

    async def add_column(self, connection: AsyncConnection, table: str, definition: str) -> None:
        quote = connection.dialect.identifier_preparer.quote
        await connection.exec_driver_sql(WAIT_BRIEFLY)
        await connection.exec_driver_sql(f"ALTER TABLE {quote(table)} ADD COLUMN {definition}")
        await connection.exec_driver_sql(WAIT_AS_EVER)

    async def only_views(self, connection: AsyncConnection, views: Collection[str]) -> None:
        names = await connection.exec_driver_sql(IN_VIEWS_SCHEMA, (list(views),))
        strangers = list(names.scalars())
        if strangers:
            raise DatabaseError(
                f"{VIEWS_SCHEMA}.{strangers[0]} does not belong to the memory, which replaces the schema {VIEWS_SCHEMA}"
                " with every change of its views: move it to another schema"
            )

    async def replace_views(
        self, connection: AsyncConnection, before: Mapping[str, str], after: Mapping[str, str]
    ) -> None:
        """Create all views in a new schema and rename it into place.

        Replacing a view in place would lock it: wait for every reader's transaction, with new readers queued behind.
        """
        if before == after:
            return
        await self.only_views(connection, before)
        quote = connection.dialect.identifier_preparer.quote
        creations = [f"CREATE VIEW {quote(name)} AS {text}" for name, text in after.items()]
        await self.execute_all(connection, [*NEW_VIEWS_SCHEMA, *creations, *SHOW_NEW_VIEWS_SCHEMA, LET_READ_VIEWS])

    async def comment_views(self, connection: AsyncConnection, comments: Mapping[str, Mapping[str, str]]) -> None:
        columns = (await connection.exec_driver_sql(COLUMNS_OF_VIEWS)).all()
        await self.execute_all(connection, comment_statements(map(tuple, columns), comments))

    async def sweep(self, connection: AsyncConnection) -> None:
        for schema, views in await _rows(_ReplacedSchema, connection, GONE_SCHEMAS):
            try:
                async with connection.begin_nested():
                    await connection.exec_driver_sql(WAIT_FOR_NOBODY)
                    if views:
                        await connection.exec_driver_sql(f"DROP VIEW {', '.join(views)}")
                    await connection.exec_driver_sql(f"DROP SCHEMA {schema}")
            except DBAPIError as error:
                if error.connection_invalidated:
                    raise
                continue  # still read, or used by another view: the next sweep retries

    async def empty(self, connection: AsyncConnection, table: str, *, rows_max: int) -> bool:  # noqa: ARG002
        return False  # dropping deletes files, whatever their size

    async def drop(self, connection: AsyncConnection, table: str) -> None:
        await connection.exec_driver_sql(WAIT_FOR_NOBODY)
        name = connection.dialect.identifier_preparer.quote(table)
        await connection.exec_driver_sql(f"DROP TABLE IF EXISTS {TABLES_SCHEMA}.{name}")

    @asynccontextmanager
    async def claim(self, engine: AsyncEngine) -> AsyncIterator[bool]:
        async with engine.connect() as connection:
            # Autocommit, because an idle transaction would be terminated; the lock belongs to the session.
            connection = await connection.execution_options(isolation_level="AUTOCOMMIT")
            claimed = bool((await connection.exec_driver_sql(CLAIM)).scalar_one())
            try:
                yield claimed
            finally:
                if claimed:
                    await connection.exec_driver_sql(RELEASE)

    async def shadow_views(self, connection: AsyncConnection, views: Mapping[str, str]) -> None:
        quote = connection.dialect.identifier_preparer.quote
        # Also on a read-only connection, because a temporary view belongs to the session alone.
        await connection.exec_driver_sql("SET TRANSACTION READ WRITE")
        await self.execute_all(
            connection, [f"CREATE TEMP VIEW {quote(name)} AS {text}" for name, text in views.items()]
        )

    async def insertion(self, rows: RowsByTable) -> Insertion:
        return rows  # the driver encodes a row while the server stores the previous ones

    async def insert(self, connection: AsyncConnection, insertion: Insertion) -> None:
        for (table, columns), some in insertion.items():
            await _copy(connection, TABLES_SCHEMA, table, columns, some)

    async def update_rows(
        self, connection: AsyncConnection, table: str, columns: Mapping[str, str], rows: Sequence[tuple[Any, ...]]
    ) -> None:
        arrays = ", ".join(f"${index}::{kind}[]" for index, kind in enumerate(columns.values(), 1))
        changes = ", ".join(f"{column} = change.{column}" for column in list(columns)[1:])
        with postgresql_errors.rows_refused():
            await connection.exec_driver_sql(
                f"UPDATE {table} SET {changes}"
                f" FROM unnest({arrays}) AS change ({', '.join(columns)}) WHERE {table}.id = change.id",
                _arrays(rows, len(columns)),
            )

    # --- faults -------------------------------------------------------------------------------------------------

    def refusal(self, error: Exception) -> str | None:
        return postgresql_errors.refusal(error)

    def translate_error(self, error: Exception, name: str) -> PycrormError:
        return postgresql_errors.translate_error(error, name)


def _confirming(configured: str) -> int:
    """Return the number of standbys that confirm each COMMIT, from `synchronous_standby_names`.

    >>> _confirming("ANY 2 (a, b, c)"), _confirming("FIRST 1 (a)"), _confirming("2 (a, b)"), _confirming("a, b")
    (2, 1, 2, 1)
    """
    words = configured.partition("(")[0].split()
    return int(words[-1]) if "(" in configured and words and words[-1].isdigit() else 1


class _ReplacedSchema(NamedTuple):
    """A schema of replaced views."""

    schema: str
    views: list[str] | None


async def _copy(
    connection: AsyncConnection, schema: str, table: str, columns: Sequence[str], rows: Iterable[tuple[Any, ...]]
) -> None:
    """Insert rows by COPY, in the transaction that an earlier statement through SQLAlchemy began."""
    driver = await _driver(connection)
    with postgresql_errors.rows_refused():
        await driver.copy_records_to_table(table, schema_name=schema, columns=columns, records=rows)


async def _driver(connection: AsyncConnection) -> Any:
    driver = (await connection.get_raw_connection()).driver_connection
    assert driver is not None
    return driver


async def _rows(kind: Any, connection: AsyncConnection, statement: str, *parameters: Any) -> list[Any]:
    return [make(kind, row) for row in await connection.exec_driver_sql(statement, parameters)]


def _arrays(rows: Sequence[tuple[Any, ...]], columns: int) -> tuple[list[Any], ...]:
    """Transpose rows to one array per column, the form in which a statement takes many rows."""
    return tuple([row[column] for row in rows] for column in range(columns))


# === roles ====================================================================================================


def _roles(names: str, member_of: str, then: str) -> str:
    """Return the block that makes the missing roles, and the login a member of one, before it runs other statements."""
    return f"""
DO $$
DECLARE
    name text;
    missing text[];
BEGIN
    PERFORM pg_catalog.set_config('search_path', 'pg_catalog', true);
    IF to_regnamespace('{TABLES}') IS NULL OR to_regnamespace('{VIEWS}') IS NULL THEN
        RAISE EXCEPTION 'the memory has no tables yet: run `pycrorm writer --once` first';
    END IF;
    missing := ARRAY(
        SELECT each FROM unnest(string_to_array('{names}', ', ')) AS each
        WHERE NOT EXISTS (SELECT FROM pg_roles WHERE rolname = each)
    );
    BEGIN
        FOREACH name IN ARRAY missing LOOP
            EXECUTE format('CREATE ROLE %I NOLOGIN', name);
        END LOOP;
    EXCEPTION WHEN insufficient_privilege THEN
        RAISE EXCEPTION 'the roles % are missing and % may not create roles; a role with CREATEROLE runs: %',
            array_to_string(missing, ', '), current_user, (
                SELECT string_agg(format('CREATE ROLE %I NOLOGIN; ', each), '') FROM unnest(missing) AS each
            ) || format('GRANT {member_of} TO %I', current_user);
    END;
    BEGIN
        {then}
    EXCEPTION WHEN insufficient_privilege THEN
        BEGIN  -- the creator of a role is not a member of it, but may become one
            EXECUTE format('GRANT {member_of} TO %I', current_user);
        EXCEPTION WHEN insufficient_privilege THEN
            RAISE EXCEPTION '% is not a member of {member_of}; a role with CREATEROLE runs: GRANT {member_of} TO %',
                current_user, quote_ident(current_user);
        END;
    END;
"""


_READING = "pycrorm_recorder, pycrorm_folder, pycrorm_reader"
_TRANSFER = (
    _roles(_READING, "pycrorm_folder", f"EXECUTE format('ALTER SCHEMA {TABLES} OWNER TO pycrorm_folder');")
    + f"""
    EXECUTE format('GRANT CREATE ON DATABASE %I TO pycrorm_folder', current_database());
    EXECUTE 'ALTER SCHEMA {TABLES} OWNER TO pycrorm_folder';
    EXECUTE 'ALTER SCHEMA {VIEWS} OWNER TO pycrorm_folder';
    FOR name IN SELECT oid::regclass FROM pg_class
        WHERE relnamespace IN ('{TABLES}'::regnamespace, '{VIEWS}'::regnamespace) AND relkind IN ('r', 'v', 'm') LOOP
        EXECUTE format('ALTER TABLE %s OWNER TO pycrorm_folder', name);
    END LOOP;
END $$"""
)
_TAKE = "SET LOCAL ROLE pycrorm_reader; RESET ROLE;"


def _grants(appending: str) -> tuple[str, ...]:
    """Return the rights of roles that append, and of the reader."""
    reading = f"{appending}, pycrorm_reader"
    return (
        INCARNATION,
        *BLOB,
        *DIGEST,
        f"REVOKE ALL ON SCHEMA {LOG}, {TABLES}, {VIEWS} FROM PUBLIC",
        f"GRANT USAGE ON SCHEMA {LOG} TO {reading}",
        f"GRANT SELECT ON ALL TABLES IN SCHEMA {LOG} TO {reading}",
        f"GRANT INSERT ON {LOG}.event, {LOG}.episode, {LOG}.pycrorm_declaration TO {appending}",
        f"GRANT INSERT ON {LOG}.pycrorm_incarnation, {LOG}.pycrorm_blob, {LOG}.pycrorm_digest TO {appending}",
        f"GRANT UPDATE (head, ended_wall_ns, refused) ON {LOG}.episode TO {appending}",
        f"GRANT USAGE ON SEQUENCE {LOG}.episode_number TO {appending}",
        f"GRANT USAGE ON SCHEMA {TABLES}, {VIEWS} TO pycrorm_reader",
        f"GRANT SELECT ON ALL TABLES IN SCHEMA {TABLES} TO pycrorm_reader",
        f"GRANT SELECT ON ALL TABLES IN SCHEMA {VIEWS} TO pycrorm_reader",
    )


OWNER_GRANTS: tuple[str, ...] = (
    _roles("pycrorm_recorder, pycrorm_reader", "pycrorm_reader", _TAKE) + "END $$",
    *_grants("pycrorm_recorder"),
    # For later tables; `replace_views` does the same for the schema of the views, which each change of them replaces.
    f"ALTER DEFAULT PRIVILEGES IN SCHEMA {TABLES} GRANT SELECT ON TABLES TO pycrorm_reader",
)
"""Statements for an owner who goes on folding: roles that read and append, while the tables stay the owner's."""

GRANTS: tuple[str, ...] = (
    _TRANSFER,
    *_grants("pycrorm_recorder, pycrorm_folder"),
    f"GRANT UPDATE (folded, parked) ON {LOG}.episode TO pycrorm_folder",
    # For later objects of the folder: tables, and the schema of the views, which each change of the views replaces.
    "ALTER DEFAULT PRIVILEGES FOR ROLE pycrorm_folder GRANT USAGE ON SCHEMAS TO pycrorm_reader",
    "ALTER DEFAULT PRIVILEGES FOR ROLE pycrorm_folder GRANT SELECT ON TABLES TO pycrorm_reader",
)
"""Statements for the owner of a database that several logins fold, in order; each may be run again."""


class RoleState(NamedTuple):
    """A role of a memory and the logins that have it, beside this connection's login and the owner of the tables."""

    name: str
    exists: bool
    members: list[str]
    login: str
    tables_owner: str | None


async def roles_of(connection: AsyncConnection) -> list[RoleState]:
    """Return the state of the three roles."""
    return await _rows(RoleState, connection, _ROLE_STATES)


async def make_roles(connection: AsyncConnection, *, shared: bool) -> None:
    """Make the roles: with `shared`, or where `GRANTS` did it before, by `GRANTS`, else by `OWNER_GRANTS`."""
    shared = shared or (await roles_of(connection))[0].tables_owner == "pycrorm_folder"
    for statement in GRANTS if shared else OWNER_GRANTS:
        await connection.exec_driver_sql(statement)


_ROLE_STATES = f"""
SELECT role, to_regrole(role) IS NOT NULL, ARRAY(
    SELECT rolname::text FROM pg_roles
    WHERE rolcanlogin AND NOT rolsuper AND pg_has_role(oid, to_regrole(role), 'MEMBER')
    ORDER BY 1
), session_user::text, (SELECT pg_get_userbyid(nspowner)::text FROM pg_namespace WHERE nspname = '{TABLES}')
FROM unnest(string_to_array('{_READING}', ', ')) AS role"""
