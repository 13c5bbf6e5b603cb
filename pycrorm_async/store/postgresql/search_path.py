"""The search path of a connection, and the schemas that are kept out of it.

Theory of operation. Schema `pycrorm` holds the log and belongs to the memory's owner, who alone can create in it.
`memory_tables` and `memory` hold what is made from the log, and belong to whichever role folds: once `roles.GRANTS` ran
that is `pycrorm_folder`. A member of it can put code there: a function that PostgreSQL prefers to the one of pg_catalog
because its arguments match better, an operator, a trigger, a default value, a view that calls a function. Such code
runs with the rights of the session that comes across it.

So a session that can do everything to the log must not come across it. SET ROLE pycrorm_folder would not help, because
the code can run RESET ROLE. Therefore each new connection asks first, with nothing but pg_catalog in its path, whether
the schemas of tables and views belong to a stranger: a role that is not itself trusted with the log, while the login of
this session is. Then these schemas stay out of its path, `HAS_TABLE` finds the stranger again whenever tables are about
to be read or written, and the dialect refuses. Appending goes on, since the log is in a schema of the owner's.

The owner folds and reads with a login of its own that is a member of `pycrorm_folder` or `pycrorm_reader`.
"""

# ruff: noqa: S608 - only names of our own schemas are put together here

from __future__ import annotations

__all__ = ["LOG_SCHEMA", "TABLES_SCHEMA", "VIEWS_SCHEMA", "PATH", "PIN", "STRANGER"]

LOG_SCHEMA = "pycrorm"
"""Where the log is."""
TABLES_SCHEMA = "memory_tables"
"""Where the tables made from it are, generation beside generation."""
VIEWS_SCHEMA = "memory"
"""Where the views in front of them are: what people read. Replaced as a whole."""

PATH = f"{TABLES_SCHEMA}, {VIEWS_SCHEMA}, {LOG_SCHEMA}"
"""What is made without a schema is a table."""

STRANGER = f"""
SELECT pg_catalog.min(pg_catalog.pg_get_userbyid(derived.nspowner)::text)
FROM pg_catalog.pg_namespace AS log CROSS JOIN pg_catalog.pg_namespace AS derived
WHERE log.nspname = '{LOG_SCHEMA}' AND derived.nspname IN ('{TABLES_SCHEMA}', '{VIEWS_SCHEMA}')
AND pg_catalog.pg_has_role(session_user, log.nspowner, 'MEMBER')
AND NOT pg_catalog.pg_has_role(derived.nspowner, log.nspowner, 'MEMBER')"""
"""The role whose code this session must not come across; null if there is none."""

PIN = f"""
SELECT pg_catalog.set_config(
    'search_path', CASE WHEN ({STRANGER}) IS NULL THEN '{PATH}' ELSE '{LOG_SCHEMA}' END, false
)"""
"""The first statement of each connection."""
