"""An engine for a PostgreSQL server: durable at COMMIT, our schemas first in the path, every wait bounded."""

from __future__ import annotations

from sqlalchemy import URL
from sqlalchemy.ext.asyncio import AsyncEngine, create_async_engine

__all__ = ["make_engine", "refusal", "WHERE", "LOG_SCHEMA", "TABLES_SCHEMA", "VIEWS_SCHEMA", "ANSWER_S_MAX"]

LOG_SCHEMA = "pycrorm"
"""Where the log is."""
TABLES_SCHEMA = "memory_tables"
"""Where the tables made from it are, generation beside generation."""
VIEWS_SCHEMA = "memory"
"""Where the views in front of them are: what people read. Replaced as a whole."""

ANSWER_S_MAX = 60.0
"""A statement that takes longer counts as a server that is away."""

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

_PARAMETERS = (*WHERE, "password", "passfile", "sslmode", "target_session_attrs", "krbsrvname")
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
        "search_path": f"{TABLES_SCHEMA}, {VIEWS_SCHEMA}, {LOG_SCHEMA}",  # what is made without a schema is a table
        "synchronous_commit": "on",  # a segment of the spool is deleted after COMMIT, so COMMIT must mean the disk
        "lock_timeout": f"{int(busy_timeout_s * 1000)}",
        "idle_in_transaction_session_timeout": "60000",
        **_VANISHED,
        "default_transaction_read_only": "on" if read_only else "off",
        "timezone": "UTC",
    }
    # The driver has another name for what everybody else calls sslmode.
    ssl = {"ssl": url.query["sslmode"]} if "sslmode" in url.query else {}
    return create_async_engine(
        url.set(drivername="postgresql+asyncpg").difference_update_query(["sslmode"]),
        connect_args={
            **ssl,
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
