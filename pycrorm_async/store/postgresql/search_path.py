"""Pin the search path of each connection, and keep untrusted schemas out of it.

**Theory of operation.** Schema `pycrorm` holds the log and belongs to the memory's owner, the only role that can create
objects in it. `memory_tables` and `memory` hold the tables and views made from the log, and belong to the role that
folds: after `roles.GRANTS`, `pycrorm_folder`. A member of that role can put code there: a function that PostgreSQL
prefers to the one of pg_catalog because its arguments match better, an operator, a trigger, a default value, a view
that calls a function. Such code runs with the rights of any session that evaluates it.

So a session with all rights on the log must not evaluate it. SET ROLE pycrorm_folder would not help, because the code
can run RESET ROLE. Therefore each new connection first asks, with only pg_catalog in its path, whether the schemas of
tables and views belong to a stranger: a role that is not a member of the log's owner, while this session's login is.
Then these schemas stay out of its path, `HAS_TABLE` detects the stranger again whenever tables are about to be read or
written, and the dialect refuses. Appending continues, because the log is in the owner's schema.

The owner folds and reads with a separate login that is a member of `pycrorm_folder` or `pycrorm_reader`.
"""

# ruff: noqa: S608 - the SQL is composed of our own schema names only

from __future__ import annotations

LOG_SCHEMA = "pycrorm"
"""Schema of the log."""
TABLES_SCHEMA = "memory_tables"
"""Schema of the tables made from the log, all generations."""
VIEWS_SCHEMA = "memory"
"""Schema of the public views on the tables. Replaced as a whole."""

PATH = f"{TABLES_SCHEMA}, {VIEWS_SCHEMA}, {LOG_SCHEMA}"
"""The search path. The schema of tables comes first, so that objects created without a schema go there."""

STRANGER = f"""
SELECT pg_catalog.min(pg_catalog.pg_get_userbyid(derived.nspowner)::text)
FROM pg_catalog.pg_namespace AS log CROSS JOIN pg_catalog.pg_namespace AS derived
WHERE log.nspname = '{LOG_SCHEMA}' AND derived.nspname IN ('{TABLES_SCHEMA}', '{VIEWS_SCHEMA}')
AND pg_catalog.pg_has_role(session_user, log.nspowner, 'MEMBER')
AND NOT pg_catalog.pg_has_role(derived.nspowner, log.nspowner, 'MEMBER')"""
"""Selects the role whose code this session must not evaluate; null if there is none."""

PIN = f"""
SELECT pg_catalog.set_config(
    'search_path', CASE WHEN ({STRANGER}) IS NULL THEN '{PATH}' ELSE '{LOG_SCHEMA}' END, false
)"""
"""The first statement of each connection; sets its search path."""
