"""Back up a memory, and restore it while programs have the database open, as a failover that loses events does."""

from __future__ import annotations

import contextlib
import sqlite3
from contextlib import closing
from urllib.parse import urlsplit

import asyncpg

from tests.databases import Server, ask

__all__ = ["Backup"]


class Backup:
    """A backup of the database of this URL, made at once. `server` may be None for SQLite."""

    def __init__(self, url: str, server: Server | None) -> None:
        self._url = url
        self._server = server
        self._name = f"{urlsplit(url).path.removeprefix('/')}"
        if server is None:
            _copy(self._file, f"{self._file}.backup")
        else:
            self._clone(self._name, f"{self._name}_backup")

    def restore(self) -> None:
        """Restore the database. Connections to a server are cut; those to a file stay open."""
        if self._server is None:
            _copy(f"{self._file}.backup", self._file)
        else:
            ask(self._server.url(), f"DROP DATABASE {self._name} WITH (FORCE)")
            self._clone(f"{self._name}_backup", self._name)

    def drop(self) -> None:
        """Delete the backup on the server, so that its space is free."""
        if self._server is not None:
            ask(self._server.url(), f"DROP DATABASE IF EXISTS {self._name}_backup WITH (FORCE)")

    @property
    def _file(self) -> str:
        return self._url.removeprefix("sqlite:///")

    def _clone(self, source: str, target: str) -> None:
        assert self._server is not None
        while True:  # new connections come as fast as old ones are cut
            ask(
                self._server.url(),
                "SELECT pg_terminate_backend(pid, 10000) FROM pg_stat_activity WHERE datname = $1",
                (source,),
            )
            with contextlib.suppress(asyncpg.ObjectInUseError):
                ask(self._server.url(), f"CREATE DATABASE {target} TEMPLATE {source}")
                return


def _copy(source: str, target: str) -> None:
    """Copy it in one transaction, which programs that have it open see."""
    with closing(sqlite3.connect(source)) as read, closing(sqlite3.connect(target, timeout=10)) as written:
        read.backup(written)
