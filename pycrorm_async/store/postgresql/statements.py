"""What the log says to PostgreSQL. A batch is one statement a table: COPY for events, arrays for the rest."""

# ruff: noqa: S608 - what is put together here are lists of columns; every value is a parameter

from __future__ import annotations

__all__ = [
    "INSERT_DECLARATIONS",
    "SELECT_EPISODES_BY_ID",
    "NEW_NUMBERS",
    "EVENT_COLUMNS",
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
]

INSERT_DECLARATIONS = """
INSERT INTO pycrorm.pycrorm_declaration (fingerprint, payload)
SELECT fingerprint, payload FROM unnest($1::text[], $2::text[]) WITH ORDINALITY AS one (fingerprint, payload, place)
ORDER BY place ON CONFLICT (fingerprint) DO NOTHING"""

NEW_NUMBERS = "SELECT nextval('pycrorm.episode_number') FROM generate_series(1, $1::int)"

EVENT_COLUMNS = ("episode", "sequence", "type", "version", "wall_ns", "monotonic_ns", "payload")

UPSERT_EPISODES = """
INSERT INTO pycrorm.episode (number, id, head, started_wall_ns, ended_wall_ns, refused)
SELECT * FROM unnest($1::bigint[], $2::text[], $3::bigint[], $4::bigint[], $5::bigint[], $6::text[])
ON CONFLICT (number) DO UPDATE
SET head = excluded.head, ended_wall_ns = excluded.ended_wall_ns, refused = excluded.refused"""

_EVENT = (
    "event.episode, event.sequence, event.type, event.version, event.wall_ns, event.monotonic_ns,"
    " convert_to(event.payload, 'UTF8')"
)

SELECT_STORED_AGAIN = f"""
SELECT {_EVENT} FROM unnest($1::bigint[], $2::bigint[]) AS wanted (episode, sequence)
JOIN pycrorm.event USING (episode, sequence)"""

_EPISODE = "number, id, head, folded, started_wall_ns, ended_wall_ns, refused, parked"

# In one order, so that two writers of the same episodes wait for each other and never in a circle.
SELECT_EPISODES_BY_ID = f"""
SELECT {_EPISODE} FROM pycrorm.episode WHERE id = ANY ($1::text[]) ORDER BY number FOR UPDATE"""

SELECT_EPISODE_BY_ID = f"SELECT {_EPISODE} FROM pycrorm.episode WHERE id = $1"
SELECT_EPISODES = f"SELECT {_EPISODE} FROM pycrorm.episode ORDER BY number"
SELECT_BEHIND = f"""
SELECT {_EPISODE} FROM pycrorm.episode
WHERE folded < head AND parked IS NULL AND number > $1 ORDER BY number LIMIT $2"""
SELECT_STOPPED = f"""
SELECT {_EPISODE} FROM pycrorm.episode WHERE refused IS NOT NULL OR parked IS NOT NULL ORDER BY number"""

SELECT_EVENTS = f"""
SELECT {_EVENT} FROM pycrorm.event WHERE episode = $1 AND sequence > $2 ORDER BY sequence LIMIT $3"""

# LATERAL, so that each span is read by the key, however much there is.
SELECT_SPANS = f"""
SELECT event.* FROM unnest($1::bigint[], $2::bigint[], $3::bigint[])
WITH ORDINALITY AS span (number, after, last, place) CROSS JOIN LATERAL (
    SELECT {_EVENT} FROM pycrorm.event
    WHERE episode = span.number AND sequence > span.after AND sequence <= span.last ORDER BY sequence
) AS event ORDER BY span.place, event.sequence"""

SELECT_DECLARATIONS = "SELECT convert_to(payload, 'UTF8') FROM pycrorm.pycrorm_declaration ORDER BY ordinal"

# The rows are taken by number first, as everywhere: an UPDATE by itself takes them in whatever order it meets them, and
# two who fold the same episodes would now and then wait for each other in a circle, for a second each time.
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
