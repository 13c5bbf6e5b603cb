"""An engine for a PostgreSQL server: durable at COMMIT, the search path pinned, every wait bounded."""

from __future__ import annotations

import os
from typing import Any

from sqlalchemy import URL, event
from sqlalchemy.ext.asyncio import AsyncEngine, create_async_engine
from sqlalchemy.pool import ConnectionPoolEntry

from pycrorm_async.errors import DatabaseUnavailable
from pycrorm_async.store.postgresql.search_path import PIN

__all__ = [
    "make_engine",
    "refusal",
    "WHERE",
    "TLS",
    "ANSWER_S_MAX",
    "WARNING",
]

ANSWER_S_MAX = 60.0
"""A statement that takes longer counts as a server that is away."""

WARNING = "pycrorm_warning"
"""Key of a connection's `info` under which the server's latest warning is kept."""

_VANISHED = {
    "tcp_keepalives_idle": "10",
    "tcp_keepalives_interval": "5",
    "tcp_keepalives_count": "3",
    "tcp_user_timeout": "25000",
}
"""A machine that vanishes in the middle of a statement says no goodbye. The server asks after it, and lets go of its
locks half a minute later; as it comes, it waits two hours, and nobody can go on with what was being appended."""

WHERE = ("host", "port")
"""The parameters of a URL that say where the server is, and so may be shown."""

TLS = ("sslmode", "sslrootcert", "sslcert", "sslkey")
"""The parameters of a URL that say how the connection is encrypted, as libpq understands them. Paths are no secret."""

_TLS_FILES = {"sslrootcert", "sslcert", "sslkey"}

_PARAMETERS = (*WHERE, *TLS, "password", "passfile", "target_session_attrs", "krbsrvname")
_SSL_MODES = ("disable", "allow", "prefer", "require", "verify-ca", "verify-full")


def refusal(url: URL) -> str | None:
    """What is wrong with a PostgreSQL URL, without a word of it, which may be of a password; None if nothing is."""
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
    """An engine for the server and database this URL names. Connecting takes at most `busy_timeout_s`.

    A read-only one refuses to write. A lock of another session is waited for as long, then the database counts as away.
    """
    settings = {
        "application_name": "pycrorm",
        "search_path": "pg_catalog",  # until it is pinned
        "synchronous_commit": "on",  # a segment of the spool is deleted after COMMIT, so COMMIT must mean the disk
        "lock_timeout": f"{int(busy_timeout_s * 1000)}",
        "idle_in_transaction_session_timeout": "60000",
        **_VANISHED,
        "default_transaction_read_only": "on" if read_only else "off",
        "timezone": "UTC",
    }
    # The driver reads these from a URL alone; what else is in it comes as arguments, which count for more.
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
            # A plan that is kept fails once when a view it reads has got a column, which happens with every new type.
            "prepared_statement_cache_size": 0,
        },
        pool_size=2,
        pool_pre_ping=True,
        hide_parameters=True,
    )
    event.listen(engine.sync_engine, "connect", _set_up)
    return engine


def _set_up(connection: Any, record: ConnectionPoolEntry) -> None:
    """Pins the search path of a new connection, and keeps the server's latest warning in its `info`."""

    def keep(_: Any, message: Any) -> None:
        if getattr(message, "severity_en", None) == "WARNING":
            record.info[WARNING] = " ".join(str(message).split())

    connection.driver_connection.add_log_listener(keep)
    connection.run_async(lambda driver: driver.execute(PIN))
