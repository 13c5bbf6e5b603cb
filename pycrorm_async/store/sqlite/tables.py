"""Define the log's tables on SQLite as numbered migrations; the first N of them create format N."""

from __future__ import annotations

from pycrorm_async.events.ids import EPISODE_NUMBER_MAX, SEQUENCE_MAX


def _refuse(name: str, change: str, table: str) -> str:
    return (
        f"CREATE TRIGGER {name} BEFORE {change} ON {table} BEGIN"
        f" SELECT RAISE(ABORT, 'the event log is append-only: {table} refuses {change.split()[0]}'); END"
    )


_LOG = """
CREATE TABLE pycrorm_log (
    one INTEGER PRIMARY KEY CHECK (one = 1),
    id TEXT NOT NULL,
    format INTEGER NOT NULL,
    created_wall_ns INTEGER NOT NULL
) STRICT"""

_DECLARATION = """
CREATE TABLE pycrorm_declaration (
    ordinal INTEGER PRIMARY KEY,
    fingerprint TEXT NOT NULL UNIQUE,
    payload TEXT NOT NULL
) STRICT"""

_EPISODE = f"""
CREATE TABLE episode (
    number INTEGER PRIMARY KEY CHECK (number BETWEEN 1 AND {EPISODE_NUMBER_MAX}),
    id TEXT NOT NULL UNIQUE,
    head INTEGER NOT NULL CHECK (head BETWEEN 0 AND {SEQUENCE_MAX}),
    folded INTEGER NOT NULL DEFAULT 0 CHECK (folded BETWEEN 0 AND head),
    started_wall_ns INTEGER NOT NULL,
    ended_wall_ns INTEGER,
    refused TEXT,
    parked TEXT
) STRICT"""

# Each poll reads this index; it contains few rows, whatever the number of episodes.
_BEHIND = "CREATE INDEX episode_behind ON episode (number) WHERE folded < head AND parked IS NULL"
_STOPPED = "CREATE INDEX episode_stopped ON episode (number) WHERE refused IS NOT NULL OR parked IS NOT NULL"

# The table has a rowid, because the rows are too long for WITHOUT ROWID, which appended a third slower.
_EVENT = """
CREATE TABLE event (
    episode INTEGER NOT NULL,
    sequence INTEGER NOT NULL,
    type TEXT NOT NULL,
    version INTEGER NOT NULL,
    wall_ns INTEGER NOT NULL,
    monotonic_ns INTEGER NOT NULL,
    payload TEXT NOT NULL,
    PRIMARY KEY (episode, sequence)
) STRICT"""

_FIRST = (
    _LOG,
    _DECLARATION,
    _EPISODE,
    _BEHIND,
    _STOPPED,
    _EVENT,
    _refuse("event_is_not_updated", "UPDATE", "event"),
    _refuse("event_is_not_deleted", "DELETE", "event"),
    _refuse("declaration_is_not_updated", "UPDATE", "pycrorm_declaration"),
    _refuse("declaration_is_not_deleted", "DELETE", "pycrorm_declaration"),
    _refuse("episode_is_not_renamed", "UPDATE OF number, id", "episode"),
    _refuse("episode_is_not_deleted", "DELETE", "episode"),
    _refuse("log_is_not_renamed", "UPDATE OF id", "pycrorm_log"),
    _refuse("log_is_not_deleted", "DELETE", "pycrorm_log"),
)

MIGRATIONS: tuple[tuple[str, ...], ...] = (_FIRST,)

INCARNATION = """
CREATE TABLE IF NOT EXISTS pycrorm_incarnation (
    number INTEGER PRIMARY KEY,
    noticed_wall_ns INTEGER NOT NULL,
    noticed_by TEXT NOT NULL,
    reason TEXT NOT NULL
) STRICT"""
"""Created when a log is first found to have gone back. Not part of the format: older programs still use the log."""

BLOB = (
    """
CREATE TABLE IF NOT EXISTS pycrorm_blob (
    hash TEXT NOT NULL,
    part INTEGER NOT NULL,
    parts INTEGER NOT NULL,
    media_type TEXT NOT NULL,
    size INTEGER NOT NULL,
    content BLOB NOT NULL,
    PRIMARY KEY (hash, part)
) STRICT""",
    _refuse("IF NOT EXISTS blob_is_not_updated", "UPDATE", "pycrorm_blob"),
    _refuse("IF NOT EXISTS blob_is_not_deleted", "DELETE", "pycrorm_blob"),
)
"""Created with the first blob. Not part of the format: older programs still use the log."""

DIGEST = (
    """
CREATE TABLE IF NOT EXISTS pycrorm_digest (
    episode INTEGER NOT NULL,
    sequence INTEGER NOT NULL,
    digest TEXT NOT NULL,
    PRIMARY KEY (episode, sequence)
) STRICT, WITHOUT ROWID""",
    _refuse("IF NOT EXISTS digest_is_not_updated", "UPDATE", "pycrorm_digest"),
    _refuse("IF NOT EXISTS digest_is_not_deleted", "DELETE", "pycrorm_digest"),
)
"""Created when a log is opened for writing. Not part of the format: older programs still use the log."""

COUNT_TABLES = (
    "SELECT count(*), total(name = 'pycrorm_log') FROM sqlite_master"
    " WHERE type IN ('table', 'view') AND name NOT LIKE 'sqlite\\_%' ESCAPE '\\'"
)
HAS_TABLE = "SELECT 1 FROM sqlite_master WHERE type = 'table' AND name = ?"
READ_LOG = "SELECT id, format FROM pycrorm_log"
INSERT_LOG = "INSERT INTO pycrorm_log (one, id, format, created_wall_ns) VALUES (1, ?, ?, ?)"
SET_FORMAT = "UPDATE pycrorm_log SET format = ?"
