"""Define three roles of a memory on PostgreSQL, each with only the rights that its work needs.

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
`pycrorm_folder` could plant code there that would run with the owner's rights (see `search_path`). The owner folds and
reads with logins that have no other rights:

    CREATE ROLE lab LOGIN IN ROLE pycrorm_folder; ALTER ROLE lab IN DATABASE memory SET role = 'pycrorm_folder';

All recorders and folders of a memory trust each other: each can append to the others' episodes, end them, and use up
the episode numbers, because checking each event's episode against the login that began it costs an eighth of the append
rate. All readers trust the folders, whose views they read.
"""

from __future__ import annotations

from pycrorm_async.store.postgresql.search_path import LOG_SCHEMA as LOG
from pycrorm_async.store.postgresql.search_path import TABLES_SCHEMA as TABLES
from pycrorm_async.store.postgresql.search_path import VIEWS_SCHEMA as VIEWS
from pycrorm_async.store.postgresql.tables import BLOB, DIGEST, INCARNATION

_TRANSFER = f"""
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
        SELECT each FROM unnest(ARRAY['pycrorm_recorder', 'pycrorm_folder', 'pycrorm_reader']) AS each
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
            ) || format('GRANT pycrorm_folder TO %I', current_user);
    END;
    BEGIN
        EXECUTE format('ALTER SCHEMA {TABLES} OWNER TO pycrorm_folder');
    EXCEPTION WHEN insufficient_privilege THEN
        BEGIN  -- the creator of a role is not a member of it, but may become one
            EXECUTE format('GRANT pycrorm_folder TO %I', current_user);
        EXCEPTION WHEN insufficient_privilege THEN
            RAISE EXCEPTION '% cannot hand the tables over; a role with CREATEROLE runs: GRANT pycrorm_folder TO %',
                current_user, quote_ident(current_user);
        END;
    END;
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
    _TRANSFER,
    INCARNATION,
    *BLOB,
    *DIGEST,
    f"REVOKE ALL ON SCHEMA {LOG}, {TABLES}, {VIEWS} FROM PUBLIC",
    f"GRANT USAGE ON SCHEMA {LOG} TO {_READING}",
    f"GRANT SELECT ON ALL TABLES IN SCHEMA {LOG} TO {_READING}",
    f"GRANT INSERT ON {LOG}.event, {LOG}.episode, {LOG}.pycrorm_declaration TO {_APPENDING}",
    f"GRANT INSERT ON {LOG}.pycrorm_incarnation, {LOG}.pycrorm_blob, {LOG}.pycrorm_digest TO {_APPENDING}",
    f"GRANT UPDATE (head, ended_wall_ns, refused) ON {LOG}.episode TO {_APPENDING}",
    f"GRANT USAGE ON SEQUENCE {LOG}.episode_number TO {_APPENDING}",
    f"GRANT UPDATE (folded, parked) ON {LOG}.episode TO pycrorm_folder",
    f"GRANT USAGE ON SCHEMA {TABLES}, {VIEWS} TO pycrorm_reader",
    f"GRANT SELECT ON ALL TABLES IN SCHEMA {TABLES} TO pycrorm_reader",
    f"GRANT SELECT ON ALL TABLES IN SCHEMA {VIEWS} TO pycrorm_reader",
    # For later objects of the folder: tables, and the schema of the views, which each change of the views replaces.
    "ALTER DEFAULT PRIVILEGES FOR ROLE pycrorm_folder GRANT USAGE ON SCHEMAS TO pycrorm_reader",
    "ALTER DEFAULT PRIVILEGES FOR ROLE pycrorm_folder GRANT SELECT ON TABLES TO pycrorm_reader",
)
"""Statements for the owner of the database, in order; each may be run again."""
