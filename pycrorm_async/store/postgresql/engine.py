"""Create an engine for a PostgreSQL server: durable at COMMIT, with a pinned search path and bounded waits."""

from __future__ import annotations

import os
from typing import Any

from sqlalchemy import URL, event
from sqlalchemy.ext.asyncio import AsyncEngine, create_async_engine
from sqlalchemy.pool import ConnectionPoolEntry

from pycrorm_async.errors import DatabaseUnavailable
from pycrorm_async.store.postgresql.search_path import PIN

ANSWER_S_MAX = 60.0
"""Bounds a statement; a server that takes longer counts as unavailable."""

WARNING = "pycrorm_warning"
"""Key in a connection's `info` for the server's latest warning."""

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


def refusal(url: URL) -> str | None:
    """Return the fault of a PostgreSQL URL, or None. Quotes no part of it, which may belong to a password."""
    if "@" in (url.host or ""):
        return "an @ in a password is written %40"
    if not url.database:
        return "a PostgreSQL URL names its database"
    ports = [url.port, *(_number(each) for each in url.normalized_query.get("port", ()))]
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
        "application_name": "pycrorm",
        "search_path": "pg_catalog",  # until `PIN` sets it
        "synchronous_commit": "on",  # a segment of the spool is deleted after COMMIT, so COMMIT must mean the disk
        "lock_timeout": f"{int(busy_timeout_s * 1000)}",
        "idle_in_transaction_session_timeout": "60000",
        **_VANISHED,
        "default_transaction_read_only": "on" if read_only else "off",
        "timezone": "UTC",
    }
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
            "server_settings": settings,
            # A cached plan fails once after its view gets a column, which happens with every new type.
            "prepared_statement_cache_size": 0,
        },
        pool_size=2,
        pool_pre_ping=True,
        hide_parameters=True,
    )
    event.listen(engine.sync_engine, "connect", _set_up)
    return engine


def _set_up(connection: Any, record: ConnectionPoolEntry) -> None:
    """Pin the search path of a new connection, and keep the server's latest warning in its `info`."""

    def keep(_: Any, message: Any) -> None:
        if getattr(message, "severity_en", None) == "WARNING":
            record.info[WARNING] = " ".join(str(message).split())

    connection.driver_connection.add_log_listener(keep)
    connection.run_async(lambda driver: driver.execute(PIN))
