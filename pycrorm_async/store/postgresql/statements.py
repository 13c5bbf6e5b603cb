"""Define the log's SQL for PostgreSQL. A batch is one statement per table: COPY for events, arrays for the rest.

Every function is qualified with its schema, so that no function of another role in the search path replaces it. Only
`unnest` with several arrays cannot be qualified, because it is syntax; it always means the one in pg_catalog.
"""

# ruff: noqa: S608 - the SQL is composed of column lists only; every value is a parameter

from __future__ import annotations

from pycrorm_async.store.dialect import DigestStatements
from pycrorm_async.store.postgresql.tables import DIGEST

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

_EVENT = (
    "event.episode, event.sequence, event.type, event.version, event.wall_ns, event.monotonic_ns,"
    " pg_catalog.convert_to(event.payload, 'UTF8')"
)

SELECT_STORED_AGAIN = f"""
SELECT {_EVENT} FROM unnest($1::bigint[], $2::bigint[]) AS wanted (episode, sequence)
JOIN pycrorm.event USING (episode, sequence)"""

_EPISODE = "number, id, head, folded, started_wall_ns, ended_wall_ns, refused, parked"

# Locks in a fixed order, so that two writers of the same episodes cannot deadlock.
SELECT_EPISODES_BY_ID = f"""
SELECT {_EPISODE} FROM pycrorm.episode WHERE id = ANY ($1::text[]) ORDER BY number FOR UPDATE"""

# Reads the witness without a lock, so that the appends of two recorders do not wait for each other.
SELECT_EPISODES_AND_WITNESS = f"""
WITH locked AS MATERIALIZED ({SELECT_EPISODES_BY_ID})
SELECT * FROM locked UNION ALL SELECT {_EPISODE} FROM pycrorm.episode WHERE id = $2"""

SELECT_HEADS = f"SELECT {_EPISODE} FROM pycrorm.episode WHERE id = ANY ($1::text[])"
SELECT_EPISODE_BY_ID = f"SELECT {_EPISODE} FROM pycrorm.episode WHERE id = $1"
SELECT_EPISODES = f"SELECT {_EPISODE} FROM pycrorm.episode ORDER BY number"
SELECT_BEHIND = f"""
SELECT {_EPISODE} FROM pycrorm.episode
WHERE folded < head AND parked IS NULL AND number > $1 ORDER BY number LIMIT $2"""
SELECT_STOPPED = f"""
SELECT {_EPISODE} FROM pycrorm.episode WHERE refused IS NOT NULL OR parked IS NOT NULL ORDER BY number"""
SELECT_NUMBER_MAX = "SELECT coalesce(max(number), 0) FROM pycrorm.episode"
SELECT_LONG = f"""
SELECT {_EPISODE} FROM pycrorm.episode WHERE head >= $1 AND ended_wall_ns IS NULL ORDER BY number"""

SELECT_EVENTS = f"""
SELECT {_EVENT} FROM pycrorm.event WHERE episode = $1 AND sequence > $2 ORDER BY sequence LIMIT $3"""

# LATERAL, so that each span is read by the primary key, whatever the size of the table.
SELECT_SPANS = f"""
SELECT event.* FROM unnest($1::bigint[], $2::bigint[], $3::bigint[])
WITH ORDINALITY AS span (number, after, last, place) CROSS JOIN LATERAL (
    SELECT {_EVENT} FROM pycrorm.event
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
