"""Create an engine for a PostgreSQL server: durable at COMMIT, with a pinned search path and bounded waits."""

# ruff: noqa: S608 - the SQL is composed of our own schema names only

import os
from functools import partial
from typing import Any

from sqlalchemy import URL, event
from sqlalchemy.ext.asyncio import AsyncEngine, create_async_engine
from sqlalchemy.pool import ConnectionPoolEntry

from pycrorm_async.errors import DatabaseUnavailable

ANSWER_S_MAX = 60.0
"""Bounds a statement; a server that takes longer counts as unavailable."""

WARNING = "pycrorm_warning"
"""Key in a connection's `info` for the server's latest warning."""

LOCK_TIMEOUT = "pycrorm.lock_timeout"
"""A setting of the session: its `lock_timeout`, for a statement that changes it for a while."""

POOLED = (
    "a pooler between the memory and the server gives one session of the server to several clients: set pool_mode ="
    " session and server_reset_query = DISCARD ALL for this database in pgbouncer, or connect to the server itself"
)
"""The refusal of a pooler, which would lose or exchange what belongs to a session: search path, locks, statements."""

_FRESH = f"""
DO $$ BEGIN IF pg_catalog.current_setting('{LOCK_TIMEOUT}', true) OPERATOR(pg_catalog.<>) '' THEN
    RAISE EXCEPTION '{POOLED}' USING ERRCODE = 'connection_exception';
END IF; END $$"""
"""Refuses a session of the server in which another connection of this package has been at work."""

_VANISHED = {
    "tcp_keepalives_idle": "10",
    "tcp_keepalives_interval": "5",
    "tcp_keepalives_count": "3",
    "tcp_user_timeout": "25000",
}
"""A machine that loses power during a statement does not close its connection. With these settings the server detects
that and releases its locks after half a minute; the default is two hours, in which its episodes stay locked."""

WHERE = ("host", "port")
"""URL parameters that locate the server, and so may be shown."""

TLS = ("sslmode", "sslrootcert", "sslcert", "sslkey")
"""URL parameters for the encryption of the connection, as in libpq. Their paths are not secret."""

_TLS_FILES = {"sslrootcert", "sslcert", "sslkey"}

_PARAMETERS = (*WHERE, *TLS, "password", "passfile", "target_session_attrs", "krbsrvname")
_SSL_MODES = ("disable", "allow", "prefer", "require", "verify-ca", "verify-full")


def refusal_of_url(url: URL) -> str | None:
    """Return the fault of a PostgreSQL URL, or None. Quotes no part of it, which may belong to a password."""
    if "@" in (url.host or ""):
        return "an @ in a password is written %40"
    if not url.database:
        return "a PostgreSQL URL names its database"
    ports = [url.port, *map(_number, ",".join(url.normalized_query.get("port", ("5432",))).split(","))]
    if any(port is not None and not 0 < port < 2**16 for port in ports):
        return "a port is a number from 1 to 65535"
    if not set(url.query) <= set(_PARAMETERS):
        return f"a PostgreSQL URL takes the parameters {', '.join(_PARAMETERS)} and no other"
    if not set(url.normalized_query.get("sslmode", ())) <= set(_SSL_MODES):
        return f"sslmode is one of {', '.join(_SSL_MODES)}"
    return None


def _number(text: str) -> int:
    return int(text) if text.isascii() and text.isdigit() else 0


def make_engine(url: URL, *, read_only: bool, busy_timeout_s: float) -> AsyncEngine:
    """Create an engine for the server and database of this URL.

    Connecting, and waiting for another session's lock, take at most `busy_timeout_s`; then the database counts as
    unavailable. A read-only engine refuses writes.
    """
    settings = {
        "search_path": "pg_catalog",  # until `PIN` sets it
        "synchronous_commit": "on",  # a segment of the spool is deleted after COMMIT, so COMMIT must mean the disk
        "lock_timeout": f"{int(busy_timeout_s * 1000)}",
        LOCK_TIMEOUT: f"{int(busy_timeout_s * 1000)}",
        "idle_in_transaction_session_timeout": "60000",
        **_VANISHED,
        "default_transaction_read_only": "on" if read_only else "off",
        "timezone": "UTC",
    }
    script = "; ".join([_FRESH, *(f"SET {name} = '{value}'" for name, value in settings.items()), PIN])
    # The driver reads these only from a URL; other parts of the URL are passed as arguments, which take precedence.
    tls = {name: value for name, value in url.query.items() if name in TLS}
    for name in sorted(_TLS_FILES & tls.keys()):
        if not os.access(str(tls[name]), os.R_OK):
            raise DatabaseUnavailable(f"{name} of the database's URL cannot be read: {tls[name]}")
    dsn = {"dsn": URL.create("postgresql", query=tls).render_as_string()} if tls else {}
    engine = create_async_engine(
        url.set(drivername="postgresql+asyncpg").difference_update_query(TLS),
        connect_args={
            **dsn,
            "timeout": busy_timeout_s,
            "command_timeout": ANSWER_S_MAX,
            "async_creator_fn": partial(_connect, script),
            "server_settings": {"application_name": "pycrorm"},
            # A cached plan fails once after its view gets a column, which happens with every new type.
            "prepared_statement_cache_size": 0,
        },
        pool_size=3,  # of a daemon: one appends, one folds, and one is in the fold group
        pool_pre_ping=True,
        hide_parameters=True,
    )
    event.listen(engine.sync_engine, "connect", _keep_warnings)
    return engine


async def _connect(script: str, *arguments: Any, **named: Any) -> Any:
    """Connect, and execute the script before any other statement.

    The settings are statements, because pgbouncer refuses a connection that asks for them at its start.
    """
    import asyncpg  # takes a tenth of a second

    connection = await asyncpg.connect(*arguments, **named)
    try:
        await connection.execute(script, timeout=named["timeout"])  # a full pool lets clients in, and then wait
    except BaseException:
        connection.terminate()
        raise
    return connection


def _keep_warnings(connection: Any, record: ConnectionPoolEntry) -> None:
    """Keep the server's latest warning to a new connection in its `info`."""

    def keep(_: Any, message: Any) -> None:
        if getattr(message, "severity_en", None) == "WARNING":
            record.info[WARNING] = " ".join(str(message).split())

    connection.driver_connection.add_log_listener(keep)


# === search path ==============================================================================================
#
# Pin the search path of each connection, and keep untrusted schemas out of it.
#
# **Theory of operation.** Schema `pycrorm` holds the log and belongs to the memory's owner, the only role that can
# create objects in it. `memory_tables` and `memory` hold the tables and views made from the log, and belong to the role
# that folds: after `roles.GRANTS`, `pycrorm_folder`. A member of that role can put code there: a function that
# PostgreSQL prefers to the one of pg_catalog because its arguments match better, an operator, a trigger, a default
# value, a view that calls a function. Such code runs with the rights of any session that evaluates it.
#
# So a session with all rights on the log must not evaluate it. SET ROLE pycrorm_folder would not help, because the code
# can run RESET ROLE. Therefore each new connection first asks, with only pg_catalog in its path, whether the schemas of
# tables and views belong to a stranger: a role that is not a member of the log's owner, while this session's login is.
# Then these schemas stay out of its path, `HAS_TABLE` detects the stranger again whenever tables are about to be read
# or written, and the dialect refuses. Appending continues, because the log is in the owner's schema.
#
# The owner folds and reads with a separate login that is a member of `pycrorm_folder` or `pycrorm_reader`.

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
