"""A pgbouncer in front of a PostgreSQL server."""

from __future__ import annotations

import shutil
import subprocess
import tempfile
import time
from collections.abc import Iterator
from contextlib import contextmanager
from pathlib import Path
from typing import Literal

from tests.databases import Server


def program() -> str | None:
    """Return the path of pgbouncer, None if it is not installed. Debian's is in a folder of the administrator."""
    return shutil.which("pgbouncer") or shutil.which("pgbouncer", path="/usr/sbin")


@contextmanager
def pooler_of(
    server: Server, url: str, mode: Literal["session", "transaction"], *, users: str = "postgres"
) -> Iterator[str]:
    """Yield the URL of the same database behind a pgbouncer with its own defaults but the mode."""
    command, user = program(), server.system_user
    assert command is not None
    with tempfile.TemporaryDirectory(prefix="pgb") as name:
        folder = Path(name)
        users_file = folder / "users"
        users_file.write_text("".join(f'"{each}" ""\n' for each in users.split()))
        (folder / "ini").write_text(
            f"[databases]\n* = host={server.folder}\n[pgbouncer]\nlisten_port = 6432\nunix_socket_dir = {folder}\n"
            f"auth_type = trust\nauth_file = {users_file}\npool_mode = {mode}\nlogfile = {folder / 'log'}\n"
        )
        if user is not None:  # it refuses to run as root
            for each in (folder, *folder.iterdir()):
                shutil.chown(each, user)
        process = subprocess.Popen([command, "--quiet", str(folder / "ini")], user=user)
        try:
            deadline = time.monotonic() + 20
            while not (folder / ".s.PGSQL.6432").exists():
                assert process.poll() is None, (folder / "log").read_text()
                assert time.monotonic() < deadline
                time.sleep(0.01)
            yield url.replace(f"host={server.folder}", f"host={folder}&port=6432")
        finally:
            process.terminate()
            process.wait()
