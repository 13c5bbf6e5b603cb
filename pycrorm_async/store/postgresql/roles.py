"""Who may do what in a memory on PostgreSQL: three roles, each with no more than its work needs.

    pycrorm_recorder   appends to the log
    pycrorm_folder     appends, and makes tables and views from the log: plans, `pycrorm writer`, `pycrorm rebuild`
    pycrorm_reader     reads log, tables and views: `pycrorm episodes`, `show`, `verify`, notebooks

Nobody of them can change or delete an event: they lack the privilege, and triggers refuse it to the owner too. The
owner of the database opens the memory once (`pycrorm writer --once`), which makes the log; then he runs `GRANTS`, which
may be run again. It hands the tables and views, which are made from the log and can be made again, to the folder, and
leaves the log with himself. People and programs get a role by membership:

    GRANT pycrorm_reader TO ada;
    GRANT pycrorm_folder TO robot; ALTER ROLE robot IN DATABASE memory SET role = 'pycrorm_folder';

The second line makes what a robot creates belong to all robots, so that each can grow the tables of the others.
"""

from __future__ import annotations

from pycrorm_async.store.postgresql.engine import LOG_SCHEMA as LOG
from pycrorm_async.store.postgresql.engine import TABLES_SCHEMA as TABLES
from pycrorm_async.store.postgresql.engine import VIEWS_SCHEMA as VIEWS

__all__ = ["GRANTS"]

_MADE = f"""
DO $$
DECLARE
    name text;
BEGIN
    FOREACH name IN ARRAY ARRAY['pycrorm_recorder', 'pycrorm_folder', 'pycrorm_reader'] LOOP
        IF NOT EXISTS (SELECT FROM pg_roles WHERE rolname = name) THEN
            EXECUTE format('CREATE ROLE %I NOLOGIN', name);
        END IF;
    END LOOP;
    EXECUTE format('GRANT CREATE ON DATABASE %I TO pycrorm_folder', current_database());
    EXECUTE 'ALTER SCHEMA {TABLES} OWNER TO pycrorm_folder';
    EXECUTE 'ALTER SCHEMA {VIEWS} OWNER TO pycrorm_folder';
    FOR name IN SELECT oid::regclass FROM pg_class
        WHERE relnamespace IN ('{TABLES}'::regnamespace, '{VIEWS}'::regnamespace) AND relkind IN ('r', 'v', 'm') LOOP
        EXECUTE format('ALTER TABLE %s OWNER TO pycrorm_folder', name);
    END LOOP;
END $$"""  # noqa: S608

_READING = "pycrorm_recorder, pycrorm_folder, pycrorm_reader"
_APPENDING = "pycrorm_recorder, pycrorm_folder"

GRANTS: tuple[str, ...] = (
    _MADE,
    f"REVOKE ALL ON SCHEMA {LOG}, {TABLES}, {VIEWS} FROM PUBLIC",
    f"GRANT USAGE ON SCHEMA {LOG} TO {_READING}",
    f"GRANT SELECT ON ALL TABLES IN SCHEMA {LOG} TO {_READING}",
    f"GRANT INSERT ON {LOG}.event, {LOG}.episode, {LOG}.pycrorm_declaration TO {_APPENDING}",
    f"GRANT UPDATE (head, ended_wall_ns, refused) ON {LOG}.episode TO {_APPENDING}",
    f"GRANT USAGE ON SEQUENCE {LOG}.episode_number TO {_APPENDING}",
    f"GRANT UPDATE (folded, parked) ON {LOG}.episode TO pycrorm_folder",
    f"GRANT USAGE ON SCHEMA {TABLES}, {VIEWS} TO pycrorm_reader",
    f"GRANT SELECT ON ALL TABLES IN SCHEMA {TABLES} TO pycrorm_reader",
    f"GRANT SELECT ON ALL TABLES IN SCHEMA {VIEWS} TO pycrorm_reader",
    # What the folder makes later: tables, and the schema of the views, which is made anew with each change of them.
    "ALTER DEFAULT PRIVILEGES FOR ROLE pycrorm_folder GRANT USAGE ON SCHEMAS TO pycrorm_reader",
    "ALTER DEFAULT PRIVILEGES FOR ROLE pycrorm_folder GRANT SELECT ON TABLES TO pycrorm_reader",
)
"""Statements for the owner of the database, in order; each may be run again."""
