"""Define the log's tables on PostgreSQL as numbered migrations; the first N of them create format N."""

from __future__ import annotations

from collections.abc import Iterable, Mapping, Sequence
from itertools import groupby
from operator import itemgetter

from pycrorm_async.events.ids import EPISODE_NUMBER_MAX, SEQUENCE_MAX
from pycrorm_async.store.postgresql.search_path import LOG_SCHEMA as LOG
from pycrorm_async.store.postgresql.search_path import PATH, STRANGER
from pycrorm_async.store.postgresql.search_path import TABLES_SCHEMA as TABLES
from pycrorm_async.store.postgresql.search_path import VIEWS_SCHEMA as VIEWS

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
AND classid <> 'pg_catalog.pg_default_acl'::regclass::oid"""  # noqa: S608
"""Selects the objects in the views' schema other than these views."""

NEW_VIEWS_SCHEMA = (
    f"CREATE SCHEMA {_NEW}",
    f"SET LOCAL search_path = {_NEW}, {TABLES}, {LOG}",
)
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
GROUP BY nspname"""  # noqa: S608
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
SELECT relname FROM pg_catalog.pg_class WHERE relnamespace = pg_catalog.to_regnamespace('{LOG}')::oid"""  # noqa: S608
HAS_TABLE = f"""
SELECT pg_catalog.to_regclass(pg_catalog.format('{TABLES}.%I', $1::text)) IS NOT NULL, ({STRANGER}), session_user"""
READ_LOG = f"SELECT id, format FROM {LOG}.pycrorm_log"  # noqa: S608
INSERT_LOG = f"INSERT INTO {LOG}.pycrorm_log (one, id, format, created_wall_ns) VALUES (1, $1, $2, $3)"  # noqa: S608
SET_FORMAT = f"UPDATE {LOG}.pycrorm_log SET format = $1"  # noqa: S608


COLUMNS_OF_VIEWS = f"""
SELECT relname, attname FROM pg_catalog.pg_class JOIN pg_catalog.pg_attribute ON attrelid = pg_class.oid
WHERE relnamespace = '{VIEWS}'::regnamespace AND relkind = 'v' AND attnum > 0 ORDER BY relname, attnum"""  # noqa: S608


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
