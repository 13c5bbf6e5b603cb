"""What the log says to SQLite. A batch is one statement a table.

A statement that takes a batch gets it as one JSON array, not row by row: `executemany` gives up the interpreter's lock
at every row and waits up to 5 ms to get it back beside a busy plan. The payloads of events travel as one blob that
`substr` cuts, so that no escaping comes between the bytes of the queue and those of the log.
"""

# ruff: noqa: S608 - what is put together here are lists of columns; every value is a parameter

from __future__ import annotations

__all__ = [
    "INSERT_DECLARATIONS",
    "SELECT_EPISODES_BY_ID",
    "SELECT_NUMBER_MAX",
    "INSERT_EVENTS",
    "UPSERT_EPISODES",
    "SELECT_STORED_AGAIN",
    "SELECT_EPISODES",
    "SELECT_BEHIND",
    "SELECT_STOPPED",
    "SELECT_EVENTS",
    "SELECT_SPANS",
    "SELECT_DECLARATIONS",
    "ADVANCE_FOLDED",
    "PARK",
    "EXPECT",
]

# --- append ---------------------------------------------------------------------------------------------------

INSERT_DECLARATIONS = """
INSERT INTO pycrorm_declaration (fingerprint, payload)
SELECT value->>0, value->>1 FROM json_each(?) WHERE true ON CONFLICT (fingerprint) DO NOTHING"""

SELECT_NUMBER_MAX = "SELECT coalesce(max(number), 0) FROM episode"

# The blob of payloads first, then the array: their order in the text is the order of the parameters.
INSERT_EVENTS = """
INSERT INTO event (episode, sequence, type, version, wall_ns, monotonic_ns, payload)
SELECT value->>0, value->>1, value->>2, value->>3, value->>4, value->>5,
       CAST(substr(?, value->>6, value->>7) AS TEXT)
FROM json_each(?)"""

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

# --- read -----------------------------------------------------------------------------------------------------

_EPISODE = "number, id, head, folded, started_wall_ns, ended_wall_ns, refused, parked"

SELECT_EPISODES_BY_ID = f"SELECT {_EPISODE} FROM episode WHERE id IN (SELECT value FROM json_each(?))"
SELECT_EPISODES = f"SELECT {_EPISODE} FROM episode ORDER BY number"
SELECT_BEHIND = f"""
SELECT {_EPISODE} FROM episode WHERE folded < head AND parked IS NULL AND number > ? ORDER BY number LIMIT ?"""
SELECT_STOPPED = f"SELECT {_EPISODE} FROM episode WHERE refused IS NOT NULL OR parked IS NOT NULL ORDER BY number"

SELECT_EVENTS = f"SELECT {_EVENT} FROM event WHERE episode = ? AND sequence > ? ORDER BY sequence LIMIT ?"

# CROSS JOIN is how SQLite is told to begin with the spans.
SELECT_SPANS = f"""
SELECT {_EVENT} FROM json_each(?) AS span CROSS JOIN event ON event.episode = span.value->>0
AND event.sequence > span.value->>1 AND event.sequence <= span.value->>2 ORDER BY span.key, event.sequence"""

SELECT_DECLARATIONS = "SELECT CAST(payload AS BLOB) FROM pycrorm_declaration ORDER BY ordinal"

# --- what a projector adds to its own transaction -------------------------------------------------------------

ADVANCE_FOLDED = """
UPDATE episode SET folded = step.folded
FROM (SELECT value->>0 AS number, value->>1 AS before, value->>2 AS folded FROM json_each(?)) AS step
WHERE episode.number = step.number AND episode.folded = step.before"""

PARK = "UPDATE episode SET parked = ? WHERE number = ?"

# --- the planner ----------------------------------------------------------------------------------------------

EXPECT = """
INSERT INTO sqlite_stat1 (tbl, idx, stat) SELECT value->>0, value->>1, value->>2 FROM json_each(?)"""
