"""Define the log's SQL for SQLite. A batch is one statement per table.

A statement takes a batch as one JSON array or as many rows of VALUES, not row by row: `executemany` releases the
interpreter lock at every row and waits up to 5 ms to get it back beside a busy plan. Fetching many rows costs the same,
so events are read as one row per few hundred, with their payloads as one blob. A blob needs no escaping, so the
payloads keep the bytes of the queue.
"""

# ruff: noqa: S608 - the SQL is composed of column lists only; every value is a parameter

from __future__ import annotations

from pycrorm_async.store.dialect import DigestStatements
from pycrorm_async.store.sqlite.tables import DIGEST

# --- append ---------------------------------------------------------------------------------------------------

INSERT_DECLARATIONS = """
INSERT INTO pycrorm_declaration (fingerprint, payload)
SELECT value->>0, value->>1 FROM json_each(?) WHERE true ON CONFLICT (fingerprint) DO NOTHING"""

SELECT_NUMBER_MAX = "SELECT coalesce(max(number), 0) FROM episode"
SELECT_NUMBERS_TAKEN = "SELECT number FROM episode WHERE number IN (SELECT value FROM json_each(?))"

INSERT_INCARNATION = "INSERT INTO pycrorm_incarnation (noticed_wall_ns, noticed_by, reason) VALUES (?, ?, ?)"
SELECT_INCARNATIONS = "SELECT noticed_wall_ns, noticed_by, reason FROM pycrorm_incarnation ORDER BY number"

EVENT_COLUMNS = ("episode", "sequence", "type", "version", "wall_ns", "monotonic_ns", "payload")

UPSERT_EPISODES = """
INSERT INTO episode (number, id, head, started_wall_ns, ended_wall_ns, refused)
SELECT value->>0, value->>1, value->>2, value->>3, value->>4, value->>5 FROM json_each(?) WHERE true
ON CONFLICT (number) DO UPDATE
SET head = excluded.head, ended_wall_ns = excluded.ended_wall_ns, refused = excluded.refused"""

_EVENT = (
    "event.episode, event.sequence, event.type, event.version, event.wall_ns, event.monotonic_ns,"
    " CAST(event.payload AS BLOB)"
)

SELECT_STORED_AGAIN = f"""
SELECT {_EVENT} FROM json_each(?) JOIN event ON event.episode = value->>0 AND event.sequence = value->>1"""

_IS_DIGEST = "FROM sqlite_master WHERE type = 'table' AND name = 'pycrorm_digest'"
DIGEST_STATEMENTS = DigestStatements(
    table=DIGEST,
    creatable=f"SELECT count(*) = 0 {_IS_DIGEST}",
    usable=f"SELECT count(*), count(*) {_IS_DIGEST}",
    insert="""
INSERT INTO pycrorm_digest (episode, sequence, digest)
SELECT value->>0, value->>1, value->>2 FROM json_each(?) WHERE true ON CONFLICT DO NOTHING""",
)

# --- read -----------------------------------------------------------------------------------------------------

_EPISODE = "number, id, head, folded, started_wall_ns, ended_wall_ns, refused, parked"

SELECT_EPISODES_BY_ID = f"SELECT {_EPISODE} FROM episode WHERE id IN (SELECT value FROM json_each(?))"
SELECT_EPISODES = f"SELECT {_EPISODE} FROM episode ORDER BY number"
SELECT_BEHIND = f"""
SELECT {_EPISODE} FROM episode WHERE folded < head AND parked IS NULL AND number > ? ORDER BY number LIMIT ?"""
SELECT_STOPPED = f"SELECT {_EPISODE} FROM episode WHERE refused IS NOT NULL OR parked IS NOT NULL ORDER BY number"
SELECT_LONG = f"SELECT {_EPISODE} FROM episode WHERE head >= ? AND ended_wall_ns IS NULL ORDER BY number"

SELECT_EVENTS = f"SELECT {_EVENT} FROM event WHERE episode = ? AND sequence > ? ORDER BY sequence LIMIT ?"

# Ordered by the primary key, the only usable index. Selects sequence to monotonic_ns and the payload's length.
SELECT_SPAN = """
SELECT json_group_array(json_array(sequence, type, version, wall_ns, monotonic_ns, length(CAST(payload AS BLOB)))),
       CAST(group_concat(payload, '') AS BLOB)
FROM event WHERE episode = ? AND sequence > ? AND sequence <= ?"""

# The prefix of a description's fingerprint is behind the hexadecimal digits, so the index on fingerprints leads to the
# designator types alone, however many descriptions there are; `+` keeps SQLite from a scan in rowid order.
SELECT_DECLARATIONS = "SELECT CAST(payload AS BLOB) FROM pycrorm_declaration WHERE fingerprint < 'g' ORDER BY +ordinal"
SELECT_DESCRIPTIONS = (
    "SELECT CAST(payload AS BLOB) FROM pycrorm_declaration WHERE fingerprint IN (SELECT value FROM json_each(?))"
)

# --- what a projector adds to its own transaction -------------------------------------------------------------

ADVANCE_FOLDED = """
UPDATE episode SET folded = step.folded
FROM (SELECT value->>0 AS number, value->>1 AS before, value->>2 AS folded FROM json_each(?)) AS step
WHERE episode.number = step.number AND episode.folded = step.before"""

PARK = "UPDATE episode SET parked = ? WHERE number = ?"

# --- the planner ----------------------------------------------------------------------------------------------

EXPECT = """
INSERT INTO sqlite_stat1 (tbl, idx, stat) SELECT value->>0, value->>1, value->>2 FROM json_each(?)"""
