"""A backup of a memory, and putting it back while programs have the database open: what a failover that loses does."""

from __future__ import annotations

import contextlib
import sqlite3
from contextlib import closing
from urllib.parse import urlsplit

import asyncpg

from tests.databases import Server, ask

__all__ = ["Backup"]


class Backup:
    """Of the database of this URL, as it is when this is made. `server` may be None for SQLite."""

    def __init__(self, url: str, server: Server | None) -> None:
        self._url = url
        self._server = server
        self._name = f"{urlsplit(url).path.removeprefix('/')}"
        if server is None:
            _copy(self._file, f"{self._file}.backup")
        else:
            self._clone(self._name, f"{self._name}_backup")

    def restore(self) -> None:
        """The database is as it was. Connections to a server are cut; those to a file stay."""
        if self._server is None:
            _copy(f"{self._file}.backup", self._file)
        else:
            ask(self._server.url(), f"DROP DATABASE {self._name} WITH (FORCE)")
            self._clone(f"{self._name}_backup", self._name)

    def drop(self) -> None:
        """The server has room for others."""
        if self._server is not None:
            ask(self._server.url(), f"DROP DATABASE IF EXISTS {self._name}_backup WITH (FORCE)")

    @property
    def _file(self) -> str:
        return self._url.removeprefix("sqlite:///")

    def _clone(self, source: str, target: str) -> None:
        assert self._server is not None
        while True:  # connections come back as fast as they are cut
            ask(
                self._server.url(),
                "SELECT pg_terminate_backend(pid, 10000) FROM pg_stat_activity WHERE datname = $1",
                (source,),
            )
            with contextlib.suppress(asyncpg.ObjectInUseError):
                ask(self._server.url(), f"CREATE DATABASE {target} TEMPLATE {source}")
                return


def _copy(source: str, target: str) -> None:
    """As one transaction, which those who have it open see."""
    with closing(sqlite3.connect(source)) as read, closing(sqlite3.connect(target, timeout=10)) as written:
        read.backup(written)
