"""Implement the log on PostgreSQL: its triggers, statements of its own, schemas, locks and roles.

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

# ruff: noqa: S608 - the SQL is composed of names only; every value is a parameter

import logging
from collections.abc import AsyncIterator, Collection, Iterable, Mapping, Sequence
from contextlib import asynccontextmanager
from itertools import chain, groupby
from operator import itemgetter
from typing import Any, ClassVar, NamedTuple

from sqlalchemy import Select, Table
from sqlalchemy.dialects.postgresql.asyncpg import PGDialect_asyncpg
from sqlalchemy.exc import DBAPIError
from sqlalchemy.ext.asyncio import AsyncConnection, AsyncEngine

from pycrorm_async import core, errors
from pycrorm_async.bulk_records import make
from pycrorm_async.events import ids
from pycrorm_async.events.codec import Record
from pycrorm_async.store import dialect, postgresql_errors, schema
from pycrorm_async.store.placement import PLAIN, SHARD_SCHEMA, Placement, Shard
from pycrorm_async.store.postgresql_engine import LOCK_TIMEOUT, PATH, STRANGER, WARNING
from pycrorm_async.store.postgresql_engine import LOG_SCHEMA as LOG
from pycrorm_async.store.postgresql_engine import TABLES_SCHEMA as TABLES
from pycrorm_async.store.postgresql_engine import VIEWS_SCHEMA as VIEWS
from pycrorm_async.store.stored import Span, StoredEvent

_log = logging.getLogger("pycrorm_async")

# === statements ===============================================================================================
#
# Every function is qualified with its schema, so that no function of another role in the search path replaces it. Only
# `unnest` with several arrays cannot be qualified, because it is syntax; it always means the one in pg_catalog.

SYSTEM_COLUMNS = frozenset("xmin xmax cmin cmax ctid tableoid".split())
"""Names that every table reserves for system columns; a view may use them."""

CLAIM = f"SELECT pg_catalog.pg_try_advisory_lock({dialect.LOG_CHANGES + 1})"
RELEASE = f"SELECT pg_catalog.pg_advisory_unlock({dialect.LOG_CHANGES + 1})"

JOIN_FOLDING = f"SELECT pg_catalog.pg_advisory_lock_shared({dialect.FOLDING})"
SHOW_LOOK = f"SELECT pg_catalog.pg_advisory_lock_shared({dialect.FOLDING_LOOKS}, $1::int)"
FORGET_LOOK = f"SELECT pg_catalog.pg_advisory_unlock_shared({dialect.FOLDING_LOOKS}, $1::int)"
SELECT_LOOKS = f"""
SELECT pid, pg_catalog.max(objid::bigint) FILTER (WHERE objsubid = 2), pid = pg_catalog.pg_backend_pid()
FROM pg_catalog.pg_locks WHERE locktype = 'advisory' AND granted
AND database = (SELECT oid FROM pg_catalog.pg_database WHERE datname = pg_catalog.current_database())
AND (objsubid = 1 AND (classid::bigint << 32 | objid::bigint) = {dialect.FOLDING}
    OR objsubid = 2 AND classid = {dialect.FOLDING_LOOKS})
GROUP BY pid HAVING pg_catalog.bool_or(objsubid = 1)"""

# Less than deadlock_timeout, so that the session that changes tables fails, never a reader.
WAIT_BRIEFLY = "SET LOCAL lock_timeout = '300ms'"
WAIT_FOR_NOBODY = "SET LOCAL lock_timeout = '20ms'"
WAIT_AS_EVER = f"SELECT pg_catalog.set_config('lock_timeout', pg_catalog.current_setting('{LOCK_TIMEOUT}'), true)"

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

_REFUSAL = f"""
CREATE FUNCTION {LOG}.refuse_change() RETURNS trigger LANGUAGE plpgsql AS $$
BEGIN
    IF TG_OP = 'DELETE' AND pg_catalog.current_setting('pycrorm.removes', true) = 'yes' THEN
        RETURN NULL;
    END IF;
    RAISE EXCEPTION 'the event log is append-only: % refuses %', TG_TABLE_NAME, TG_OP
    USING ERRCODE = 'integrity_constraint_violation';
END $$"""

PARTITIONS = f"""
SELECT srvoptions FROM pg_catalog.pg_inherits LEFT JOIN pg_catalog.pg_foreign_table ON ftrelid = inhrelid
LEFT JOIN pg_catalog.pg_foreign_server AS server ON server.oid = ftserver
WHERE inhparent = pg_catalog.to_regclass('{LOG}.event')::oid
ORDER BY pg_catalog.length(srvname), srvname"""
"""Selects, for each partition of the log, the options of the shard that has it; null on this server."""
HAS_POSTGRES_FDW = "SELECT name FROM pg_catalog.pg_available_extensions WHERE name = 'postgres_fdw'"

_PERMIT_REMOVAL = (
    _REFUSAL.replace("CREATE FUNCTION", "CREATE OR REPLACE FUNCTION"),  # of memories that an earlier version made
    f"""
DO $$
DECLARE
    role text;
BEGIN
    FOREACH role IN ARRAY ARRAY['pycrorm_recorder', 'pycrorm_folder', 'pycrorm_reader'] LOOP
        IF pg_catalog.has_schema_privilege(pg_catalog.to_regrole(role), '{LOG}', 'USAGE') THEN
            EXECUTE pg_catalog.format('GRANT SELECT ON {LOG}.pycrorm_removed_episode TO %I', role);
        END IF;
    END LOOP;
END $$""",
)
"""Lets the owner delete in a transaction that removes episodes, and the roles read which ones were removed."""

COLUMNS_OF_TABLES = f"""
SELECT relname, pg_catalog.array_agg(attname::text) FROM pg_catalog.pg_class
JOIN pg_catalog.pg_attribute ON attrelid = pg_class.oid
WHERE relnamespace = pg_catalog.to_regnamespace('{TABLES}')::oid AND relkind IN ('r', 'p') AND NOT relispartition
AND attnum > 0 AND NOT attisdropped GROUP BY relname"""

TABLE_NAMES = f"""
SELECT relname FROM pg_catalog.pg_class WHERE relnamespace = pg_catalog.to_regnamespace('{LOG}')::oid"""
HAS_TABLE = f"""
SELECT is_withheld, CASE WHEN is_withheld THEN false
ELSE pg_catalog.to_regclass(pg_catalog.format('{TABLES}.%I', $1::text)) IS NOT NULL END, ({STRANGER}), session_user
FROM (
    SELECT pg_catalog.has_schema_privilege(pg_catalog.to_regnamespace('{TABLES}')::oid, $2::text) IS FALSE
    AND pg_catalog.has_table_privilege(pg_catalog.to_regclass('{LOG}.event')::oid, 'INSERT')
) AS login (is_withheld)"""
TABLE_STATE = f"""
SELECT relation IS NOT NULL,
relation IS NULL AND pg_catalog.has_schema_privilege('{LOG}', 'CREATE'),
coalesce(pg_catalog.has_table_privilege(relation, 'SELECT'), false),
coalesce(pg_catalog.has_table_privilege(relation, 'SELECT')
    AND pg_catalog.has_table_privilege(relation, 'INSERT'), false)
FROM (SELECT pg_catalog.to_regclass($1::text)::oid) AS named (relation)"""

HAS_FORMER_NUMBERS = f"""
SELECT EXISTS (
    SELECT FROM pg_catalog.pg_constraint WHERE conrelid = pg_class.oid AND conname = 'episode_number_check'
    AND pg_catalog.strpos(pg_catalog.pg_get_constraintdef(oid), '{ids.EPISODE_NUMBER_MAX_0_1}') > 0
), pg_catalog.pg_has_role(relowner, 'USAGE')
FROM pg_catalog.pg_class WHERE pg_class.oid = pg_catalog.to_regclass('{LOG}.episode')::oid"""
PERMIT_NUMBERS = f"""
ALTER TABLE {LOG}.episode DROP CONSTRAINT episode_number_check,
ADD CONSTRAINT episode_number_check CHECK (number BETWEEN 1 AND {ids.EPISODE_NUMBER_MAX})"""

NEW_NUMBERS = f"SELECT pg_catalog.nextval('{LOG}.episode_number') FROM pg_catalog.generate_series(1, $1::int)"
SKIP_NUMBERS = f"""
SELECT pg_catalog.max(pg_catalog.nextval('{LOG}.episode_number')) FROM pg_catalog.generate_series(1, $1::int)"""

SYNCHRONOUS_STANDBYS = "SELECT pg_catalog.current_setting('synchronous_standby_names')"
SELECT_SYNCHRONOUS = """
SELECT application_name FROM pg_catalog.pg_stat_replication
WHERE sync_state IN ('sync', 'quorum') ORDER BY application_name"""

WRITE_AHEAD = "SELECT pg_catalog.pg_logical_emit_message(true, 'pycrorm', '')"
"""Writes an empty message to the server's write-ahead log. A COMMIT without any record there waits for no standby, and
could acknowledge events of another transaction that no standby has yet."""

EVENT_SIZES = "pycrorm_event_sizes"
"""Key in a connection's `info` for the sizes of the columns of the events."""
SELECT_EVENT_SIZES = f"""
SELECT attlen FROM pg_catalog.pg_attribute
WHERE attrelid = '{LOG}.event'::regclass AND attnum > 0 AND NOT attisdropped ORDER BY attnum"""
"""Selects the size of each column in bytes, which the binary format needs; -1 for a text. Logs of earlier versions have
columns of another size."""

# LATERAL, so that each span is read by the primary key, whatever the size of the table.
SELECT_SPANS = f"""
SELECT event.* FROM unnest($1::bigint[], $2::bigint[], $3::bigint[])
WITH ORDINALITY AS span (number, after, last, place) CROSS JOIN LATERAL (
    SELECT episode, sequence, type, version, wall_ns, monotonic_ns, pg_catalog.convert_to(payload, 'UTF8')
    FROM {LOG}.event
    WHERE episode = span.number AND sequence > span.after AND sequence <= span.last ORDER BY sequence
) AS event ORDER BY span.place, event.sequence"""


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


# === dialect ==================================================================================================

_VERSION_MIN = 14
"""The oldest version of the server that is supported."""
_RESTORING = "a restore may be running; try again when it has finished"


class PostgreSQL(dialect.Dialect):
    """Implements `Dialect`. Events are inserted by COPY; an append locks its episodes' rows until COMMIT."""

    syntax = PGDialect_asyncpg()  # type: ignore[no-untyped-call]  # SQLAlchemy's
    log_schema = LOG
    episode_id = schema.VALID_ID["postgresql"]
    # By equality, because the order of letters and digits depends on the database's collation.
    select_declarations: ClassVar[Select[Any]] = schema.select_declarations(
        "pg_catalog.substr(fingerprint, 1, 5) <> 'urdf-'"
    )
    has_former_numbers = HAS_FORMER_NUMBERS
    permit_numbers = (PERMIT_NUMBERS,)
    begin_snapshot = "SET TRANSACTION ISOLATION LEVEL REPEATABLE READ"
    place = (f"CREATE SCHEMA IF NOT EXISTS {TABLES}",)
    faults = postgresql_errors.FAULTS

    def first_format(self, placement: Placement) -> tuple[str, ...]:
        # Numbers come from a sequence, so that no robot waits for another one's transaction; a rollback leaves a hole.
        before = (f"CREATE SCHEMA {LOG}", f"CREATE SEQUENCE {LOG}.episode_number", _REFUSAL)
        return (*before, *super().first_format(placement))

    # --- the log --------------------------------------------------------------------------------------------------

    def creation(self, table: Table, *, if_missing: bool) -> str:
        text = super().creation(table, if_missing=if_missing)
        if table not in (schema.EVENT, schema.DIGEST):
            return text
        # No room in the pages of the key, because rows are only appended.
        return text.replace(
            "PRIMARY KEY (episode, sequence)", "PRIMARY KEY (episode, sequence) WITH (fillfactor = 100)"
        )

    @asynccontextmanager
    async def deletion(self, connection: AsyncConnection, tables: Sequence[Table]) -> AsyncIterator[None]:  # noqa: ARG002
        await connection.exec_driver_sql("SET LOCAL pycrorm.removes = 'yes'")
        yield
        await connection.exec_driver_sql("SET LOCAL pycrorm.removes = 'no'")

    async def made_tables(self, connection: AsyncConnection) -> dict[str, set[str]]:
        rows = await connection.exec_driver_sql(COLUMNS_OF_TABLES)
        return {name: set(columns) for name, columns in map(tuple, rows) if dialect.MADE.search(name)}

    async def purge(self, engine: AsyncEngine, tables: Sequence[str]) -> str | None:
        log = [f"{LOG}.{each.name}" for each in (schema.EVENT, schema.DIGEST, schema.EPISODE)]
        async with engine.connect() as connection:
            connection = await connection.execution_options(isolation_level="AUTOCOMMIT")
            # Also samples the columns again, because statistics have common values of them.
            names = ", ".join([*log, *(f"{TABLES}.{_quote(each)}" for each in tables)])
            shards = (await self.placement(connection)).shards
            if shards:
                names = names.replace(f"{log[0]}, ", "")
            await connection.exec_driver_sql(f"VACUUM (ANALYZE) {names}")
        if shards:
            _log.warning(
                "the shards keep deleted bytes in their pages until `VACUUM %s.event` runs there", SHARD_SCHEMA
            )
        return None

    def completion(self, table: Table, name: str, *, if_missing: bool) -> list[str]:
        if table is schema.REMOVED:
            return list(_PERMIT_REMOVAL)
        if "noun" not in table.info:
            return []
        noun, fixed = table.info["noun"], table.info["fixed"]
        changes = {"changed": "UPDATE OR DELETE OR TRUNCATE"}
        if fixed:
            changes = {"renamed": f"UPDATE OF {fixed}", "deleted": "DELETE OR TRUNCATE"}
        return [
            f"CREATE {'OR REPLACE ' * if_missing}TRIGGER {noun}_is_not_{effect} BEFORE {change} ON {name}"
            f" FOR EACH STATEMENT EXECUTE FUNCTION {LOG}.refuse_change()"
            for effect, change in changes.items()
        ]

    def definition(self, table: Table, placement: Placement = PLAIN, *, if_missing: bool = False) -> list[str]:
        if table is not schema.EVENT or not placement.shards:
            return super().definition(table, placement, if_missing=if_missing)
        kinds = self.syntax.type_compiler_instance
        columns = ", ".join(f"{each.name} {kinds.process(each.type)} NOT NULL" for each in table.c)
        name = f"{LOG}.{table.name}"
        return [
            *placement.foreign_creation(columns, name, f"{LOG}.refuse_change"),
            *self.completion(table, name, if_missing=if_missing),
        ]

    async def placement(self, connection: AsyncConnection) -> Placement:
        options = (await connection.exec_driver_sql(PARTITIONS)).scalars().all()
        if not options or options[0] is None:
            return Placement(len(options))
        of_each = (dict(each.split("=", 1) for each in several) for several in options)
        return Placement(shards=tuple(Shard(each["host"], each["port"], each["dbname"]) for each in of_each))

    async def lock_log_changes(self, connection: AsyncConnection, key: int = dialect.LOG_CHANGES) -> None:
        await connection.exec_driver_sql(f"SELECT pg_catalog.pg_advisory_xact_lock({key})")

    async def find_log(self, connection: AsyncConnection, name: str) -> dialect.LogIdentity | None:
        version: Any = (connection.dialect.server_version_info or (0,))[0]
        if version < _VERSION_MIN:
            raise errors.DatabaseUnavailable(f"{name}: PostgreSQL {_VERSION_MIN} or newer is needed, this is {version}")
        names = set((await connection.exec_driver_sql(TABLE_NAMES)).scalars())
        if not names:
            return None
        if "pycrorm_log" not in names:
            if names.isdisjoint(each.name for each in schema.FORMAT_1):
                raise errors.DatabaseForeign(f"{name} has a schema {LOG!r} of another program: it has no pycrorm_log")
            raise errors.DatabaseUnavailable(f"{name}: the table pycrorm_log is missing: {_RESTORING}")
        row = (await self.execute(connection, schema.SELECT_LOG)).one_or_none()
        if row is None:
            raise errors.DatabaseUnavailable(f"{name}: the table pycrorm_log is empty: {_RESTORING}")
        return dialect.LogIdentity._make(row)

    async def execute_all(self, connection: AsyncConnection, statements: Sequence[str]) -> None:
        # One message, bypassing SQLAlchemy, in the transaction that an earlier statement through SQLAlchemy began.
        await (await _driver(connection)).execute("; ".join(statements))

    async def table_state(self, connection: AsyncConnection, table: Table) -> dialect.TableState:
        row = (await connection.exec_driver_sql(TABLE_STATE, (f"{LOG}.{table.name}",))).one()
        return dialect.TableState._make(row)

    async def new_numbers(self, connection: AsyncConnection, count: int, *, above: int = 0) -> list[int]:  # noqa: ARG002
        return list((await connection.exec_driver_sql(NEW_NUMBERS, (count,))).scalars())

    async def skip_numbers(self, connection: AsyncConnection, above: int) -> None:
        # Uses nextval, because setval needs a privilege and could move the sequence back behind another session.
        [number] = await self.new_numbers(connection, 1)
        if number < above:
            await connection.exec_driver_sql(SKIP_NUMBERS, (above - number,))

    async def stored_on(self, connection: AsyncConnection) -> dialect.StoredOn:
        configured = (await connection.exec_driver_sql(SYNCHRONOUS_STANDBYS)).scalar_one().strip()
        if not configured:
            return dialect.StoredOn(1)
        # Without pg_read_all_stats their states are null, but COMMIT still waits for them.
        names = tuple((await connection.exec_driver_sql(SELECT_SYNCHRONOUS)).scalars())
        return dialect.StoredOn(1 + max(1, _confirming(configured)), names or (configured,))

    async def force_durable_commit(self, connection: AsyncConnection) -> None:
        await connection.exec_driver_sql(WRITE_AHEAD)

    async def commit(self, connection: AsyncConnection) -> None:
        # A COMMIT that is cancelled while it waits for a synchronous standby succeeds, with a warning.
        connected = (await connection.get_raw_connection()).info
        connected.pop(WARNING, None)
        await connection.commit()
        if WARNING in connected:
            raise postgresql_errors.CommitInDoubt(connected[WARNING])

    async def spans(self, connection: AsyncConnection, spans: Sequence[Span]) -> list[StoredEvent]:
        # Bypasses SQLAlchemy, which processes every row twice.
        rows = await (await _driver(connection)).fetch(SELECT_SPANS, *_arrays(spans, 3))
        return [make(StoredEvent, row) for row in rows]

    async def keep(self, connection: AsyncConnection, tables: Sequence[str]) -> bool:
        named = ", ".join(f"{TABLES}.{_quote(each)}" for each in tables)
        try:
            await connection.exec_driver_sql(f"LOCK TABLE {named} IN ACCESS SHARE MODE")
        except DBAPIError as error:
            if postgresql_errors.is_missing_table(error):
                return False
            raise
        return True

    async def fetch(self, connection: AsyncConnection, sql: str, parameters: tuple[Any, ...]) -> Sequence[Any]:
        # The driver prepares a statement once, and SQLAlchemy each time; but only the latter begins a transaction.
        adapted = (await connection.get_raw_connection()).dbapi_connection
        assert adapted is not None
        if adapted.autocommit:
            rows: Sequence[Any] = await (await _driver(connection)).fetch(sql, *parameters)
            return rows
        return await super().fetch(connection, sql, parameters)

    async def join_fold_group(self, connection: AsyncConnection, look: int) -> tuple[int, Mapping[int, int | None]]:
        await self.fetch(connection, SHOW_LOOK, (look,))
        rows = await self.fetch(connection, SELECT_LOOKS, ())
        if any(is_own for _, _, is_own in rows):
            await self.fetch(connection, FORGET_LOOK, (look - 1,))
        else:
            await self.fetch(connection, JOIN_FOLDING, ())
            rows = await self.fetch(connection, SELECT_LOOKS, ())
        [own] = [process for process, _, is_own in rows if is_own]
        return own, {process: number for process, number, _ in rows}

    # --- tables and views ---------------------------------------------------------------------------------------

    async def has_table(self, connection: AsyncConnection, name: str, *, to_change: bool = False) -> bool:
        parameters = (name, "CREATE" if to_change else "USAGE")
        is_withheld, exists, stranger, login = tuple((await connection.exec_driver_sql(HAS_TABLE, parameters)).one())
        if stranger is not None:
            raise errors.TablesUntrusted(
                f"the tables belong to {stranger}, whose members could run their code with the rights of {login}:"
                f" fold with a login that is a member of {stranger} and has no right to the log, read with one of"
                " pycrorm_reader"
            )
        if is_withheld:
            raise errors.TablesWithheld(
                f"{login} may {'not change' if to_change else 'neither read nor change'} the tables: fold with"
                " `pycrorm writer` and a login that may, read with one of pycrorm_reader"
            )
        return bool(exists)

    async def gather_statistics(self, connection: AsyncConnection, tables: Sequence[str]) -> None:
        await connection.exec_driver_sql(f"ANALYZE {', '.join(f'{TABLES}.{_quote(each)}' for each in tables)}")

    def stored_column(self, name: str) -> str:
        return f"_{name}" if name in SYSTEM_COLUMNS else name

    async def add_column(self, connection: AsyncConnection, table: str, definition: str) -> None:
        await connection.exec_driver_sql(WAIT_BRIEFLY)
        await connection.exec_driver_sql(f"ALTER TABLE {_quote(table)} ADD COLUMN {definition}")
        await connection.exec_driver_sql(WAIT_AS_EVER)

    async def only_views(self, connection: AsyncConnection, views: Collection[str]) -> None:
        names = await connection.exec_driver_sql(IN_VIEWS_SCHEMA, (list(views),))
        strangers = list(names.scalars())
        if strangers:
            raise errors.DatabaseError(
                f"{VIEWS}.{strangers[0]} does not belong to the memory, which replaces the schema {VIEWS}"
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
        creations = [f"CREATE VIEW {_quote(name)} AS {text}" for name, text in after.items()]
        await self.execute_all(connection, [*NEW_VIEWS_SCHEMA, *creations, *SHOW_NEW_VIEWS_SCHEMA, LET_READ_VIEWS])

    async def comment_views(self, connection: AsyncConnection, comments: Mapping[str, Mapping[str, str]]) -> None:
        columns = (await connection.exec_driver_sql(COLUMNS_OF_VIEWS)).all()
        await self.execute_all(connection, comment_statements(map(tuple, columns), comments))

    async def sweep(self, connection: AsyncConnection) -> None:
        for row in (await connection.exec_driver_sql(GONE_SCHEMAS)).all():
            name, views = tuple(row)
            try:
                async with connection.begin_nested():
                    await connection.exec_driver_sql(WAIT_FOR_NOBODY)
                    if views:
                        await connection.exec_driver_sql(f"DROP VIEW {', '.join(views)}")
                    await connection.exec_driver_sql(f"DROP SCHEMA {name}")
            except DBAPIError as error:
                if error.connection_invalidated:
                    raise
                continue  # still read, or used by another view: the next sweep retries

    async def drop(self, connection: AsyncConnection, table: str) -> None:
        await connection.exec_driver_sql(WAIT_FOR_NOBODY)
        await connection.exec_driver_sql(f"DROP TABLE IF EXISTS {TABLES}.{_quote(table)}")

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
        # Also on a read-only connection, because a temporary view belongs to the session alone.
        await connection.exec_driver_sql("SET TRANSACTION READ WRITE")
        await self.execute_all(
            connection, [f"CREATE TEMP VIEW {_quote(name)} AS {text}" for name, text in views.items()]
        )

    async def insertion(self, rows: dialect.RowsByTable) -> dialect.Insertion:
        return rows  # the driver encodes a row while the server stores the previous ones

    async def event_insertion(self, parts: Iterable[tuple[int, list[Record]]]) -> dialect.Insertion:
        return {(schema.EVENT.name, schema.EVENT_COLUMNS): parts}

    async def insert(self, connection: AsyncConnection, insertion: dialect.Insertion) -> None:
        # In the transaction that an earlier statement through SQLAlchemy began.
        raw = await connection.get_raw_connection()
        driver: Any = raw.driver_connection
        for (table, columns), some in insertion.items():
            if table != schema.EVENT.name:
                with postgresql_errors.rows_refused():
                    await driver.copy_records_to_table(table, schema_name=TABLES, columns=columns, records=some)
                continue
            if EVENT_SIZES not in raw.info:
                raw.info[EVENT_SIZES] = tuple((await connection.exec_driver_sql(SELECT_EVENT_SIZES)).scalars())
            rows = _binary(some, raw.info[EVENT_SIZES])
            with postgresql_errors.rows_refused():
                await driver.copy_to_table(table, schema_name=LOG, columns=columns, source=rows, format="binary")

    async def update_rows(
        self,
        connection: AsyncConnection,
        table: str,
        columns: Mapping[str, str],
        rows: Sequence[tuple[Any, ...]],
        *,
        episode: str | None = None,
    ) -> None:
        arrays = ", ".join(f"${index}::{kind}[]" for index, kind in enumerate(columns.values(), 1))
        changes = ", ".join(f"{column} = change.{column}" for column in list(columns)[1:])
        within = f" AND {table}.{episode} = (change.id >> {ids.NUMBER_SHIFT})::int" if episode else ""
        with postgresql_errors.rows_refused():
            await connection.exec_driver_sql(
                f"UPDATE {table} SET {changes}"
                f" FROM unnest({arrays}) AS change ({', '.join(columns)}) WHERE {table}.id = change.id{within}",
                _arrays(rows, len(columns)),
            )

    refusal = staticmethod(postgresql_errors.refusal)
    translate_error = staticmethod(postgresql_errors.translate_error)


_quote = PostgreSQL.syntax.identifier_preparer.quote


def _confirming(configured: str) -> int:
    """Return the number of standbys that confirm each COMMIT, from `synchronous_standby_names`.

    >>> _confirming("ANY 2 (a, b, c)"), _confirming("FIRST 1 (a)"), _confirming("2 (a, b)"), _confirming("a, b")
    (2, 1, 2, 1)
    """
    words = configured.partition("(")[0].split()
    return int(words[-1]) if "(" in configured and words and words[-1].isdigit() else 1


async def _driver(connection: AsyncConnection) -> Any:
    driver = (await connection.get_raw_connection()).driver_connection
    assert driver is not None
    return driver


async def _binary(parts: Iterable[tuple[int, list[Record]]], sizes: Sequence[int]) -> AsyncIterator[bytes]:
    """Yield events in the binary format of COPY, one part at a time: the server stores it while the next is made."""
    yield b"PGCOPY\n\xff\r\n\0" + bytes(8)
    for number, records in parts:
        yield core.copy_rows(records, number, sizes)
    yield b"\xff\xff"


def _arrays(rows: Sequence[tuple[Any, ...]], columns: int) -> tuple[list[Any], ...]:
    """Transpose rows to one array per column, the form in which a statement takes many rows."""
    return tuple([row[column] for row in rows] for column in range(columns))


# === shards ===================================================================================================


async def must_be_free(engine: AsyncEngine, name: str) -> None:
    """Raise `CallerError` if the database is a shard already."""
    async with engine.connect() as connection:
        exists = "SELECT pg_catalog.to_regnamespace($1::text) IS NOT NULL"
        if (await connection.exec_driver_sql(exists, (SHARD_SCHEMA,))).scalar_one():
            raise errors.CallerError(
                f"{name} has a schema {SHARD_SCHEMA} already: name another database, or drop the schema if no memory"
                " keeps events in it"
            )


async def make_shard(engine: AsyncEngine, name: str) -> None:
    """Create the table of events on a shard. Raises as `must_be_free` does: two URLs may name one database."""
    await must_be_free(engine, name)
    log = _DIALECT.definition(schema.EVENT)
    # Also the name of the setting that permits a deletion (`placement`).
    statements = [each.replace(f"{LOG}.", f"{SHARD_SCHEMA}.") for each in (_REFUSAL, *log)]
    async with engine.begin() as connection:
        await _DIALECT.execute_all(connection, [f"CREATE SCHEMA {SHARD_SCHEMA}", *statements])


async def needs_shards(engine: AsyncEngine, name: str) -> bool:
    """Return whether the database holds no log yet. Raises `CallerError` if the server cannot reach others."""
    async with engine.connect() as connection:
        if not (await connection.exec_driver_sql(HAS_POSTGRES_FDW)).all():
            raise errors.CallerError(f"the server of {name} has no postgres_fdw: install PostgreSQL's contrib modules")
        return await _DIALECT.find_log(connection, name) is None


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


_DIALECT = PostgreSQL()
_READING = "pycrorm_recorder, pycrorm_folder, pycrorm_reader"
_TRANSFER = (
    _roles(_READING, "pycrorm_folder", f"EXECUTE format('ALTER SCHEMA {TABLES} OWNER TO pycrorm_folder');")
    + f"""
    EXECUTE format('GRANT CREATE ON DATABASE %I TO pycrorm_folder', current_database());
    EXECUTE 'ALTER SCHEMA {TABLES} OWNER TO pycrorm_folder';
    EXECUTE 'ALTER SCHEMA {VIEWS} OWNER TO pycrorm_folder';
    FOR name IN SELECT oid::regclass FROM pg_class
        WHERE relnamespace IN ('{TABLES}'::regnamespace, '{VIEWS}'::regnamespace)
        AND relkind IN ('r', 'v', 'm', 'p') LOOP
        EXECUTE format('ALTER TABLE %s OWNER TO pycrorm_folder', name);
    END LOOP;
END $$"""
)
_TAKE = "SET LOCAL ROLE pycrorm_reader; RESET ROLE;"


_LATER = (schema.INCARNATION, schema.BLOB, schema.DIGEST, schema.REMOVED)


def _grants(appending: str) -> tuple[str, ...]:
    """Return the rights of roles that append, and of the reader."""
    reading = f"{appending}, pycrorm_reader"
    return (
        *chain.from_iterable(_DIALECT.definition(each, if_missing=True) for each in _LATER),
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
    f"GRANT UPDATE (finished_wall_ns) ON {LOG}.pycrorm_removed_episode TO pycrorm_folder",
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
    return [RoleState._make(row) for row in await connection.exec_driver_sql(_ROLE_STATES)]


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
