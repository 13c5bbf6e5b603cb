"""A database that is none, is newer, belongs to another program or may only be read is refused in one line."""

import json
import os
import sqlite3
import subprocess
import sys
from contextlib import closing
from pathlib import Path

import pytest

from tests.cli.bad_plans import PLANS
from tests.commands import COMMAND, answer, environment, one_line_of, pycrorm

pytestmark = pytest.mark.slow


def test_a_database_of_another_program_is_left_unchanged(folder: Path) -> None:
    other = folder / "other.db"
    with closing(sqlite3.connect(other)) as connection, connection:
        connection.execute("CREATE TABLE recipe (name TEXT)")
    connection.close()
    before = other.read_bytes()
    for arguments in (["run", "plans.py"], ["episodes"], ["writer", "--once"]):
        done = pycrorm(*arguments, "--url", "sqlite:///other.db", cwd=folder)
        assert "other.db" in one_line_of(done)
        assert done.returncode == 3
    assert other.read_bytes() == before


def test_a_file_that_is_no_database_is_left_unchanged(folder: Path) -> None:
    for arguments in (["run", "plans.py"], ["episodes"]):
        done = pycrorm(*arguments, "--url", "sqlite:///plans.py", cwd=folder)
        assert "plans.py" in one_line_of(done)
        assert done.returncode == 3
    assert (folder / "plans.py").read_text() == PLANS


def test_a_database_in_a_folder_without_write_permission_is_reported_with_its_path(folder: Path) -> None:
    assert pycrorm("run", "plans.py", cwd=folder).returncode == 0
    (folder / "pycrorm.db-wal").mkdir()  # SQLite cannot make its file there: as on a read-only disk
    for arguments in (["run", "plans.py"], ["episodes"]):
        done = pycrorm(*arguments, "--url", f"sqlite:///{folder}/pycrorm.db", cwd=folder)
        assert one_line_of(done) == (
            f"pycrorm: sqlite:///{folder}/pycrorm.db cannot be opened: the file must be readable and its folder"
            " writable, because SQLite creates files beside it, also for reading"
        )
        assert done.returncode == 3
    (folder / "pycrorm.db-wal").rmdir()
    assert len(answer("episodes", cwd=folder)) == 1


def bound() -> list[str]:
    """Return the command that runs another one as a user whom the modes of files bind, as they do not bind root."""
    return ["setpriv", "--bounding-set=-dac_override,-dac_read_search"] if os.geteuid() == 0 else []


def without_rights(*arguments: str, cwd: Path) -> subprocess.CompletedProcess[str]:
    command = [*bound(), *COMMAND, *arguments]
    return subprocess.run(command, cwd=cwd, env=environment(), capture_output=True, text=True, timeout=60, check=False)


def test_a_file_that_may_only_be_read_is_not_opened_for_recording(tmp_path: Path) -> None:
    (tmp_path / "memory.db").touch(0o444)
    opening = "from pycrorm_async.store.log import make_file; make_file(Path('memory.db'), 'memory.db', 'owner')"
    command = [*bound(), sys.executable, "-c", f"from pathlib import Path; {opening}"]
    done = subprocess.run(command, cwd=tmp_path, env=environment(), capture_output=True, text=True, check=False)
    reason = "this user may only read it: record with a user who may write it, or name another file"
    assert done.stderr.endswith(f"DatabaseUnavailable: memory.db cannot be written: {reason}\n")


@pytest.mark.soak  # the test before it opens the file only
def test_a_file_that_may_only_be_read_is_refused_before_the_plan_runs_and_can_be_read(folder: Path) -> None:
    assert pycrorm("run", "plans.py", cwd=folder).returncode == 0
    (folder / "pycrorm.db").chmod(0o444)
    done = without_rights("run", "plans.py", cwd=folder)
    reason = "this user may only read it: record with a user who may write it, or name another file"
    assert one_line_of(done) == f"pycrorm: sqlite:///pycrorm.db cannot be written: {reason}"
    assert (done.returncode, done.stdout) == (3, "")
    assert json.loads(without_rights("episodes", "--json", cwd=folder).stdout)[0]["number"] == 1
    for each in folder.glob("pycrorm.db-*"):
        each.unlink()
    folder.chmod(0o555)
    done = without_rights("episodes", cwd=folder)
    folder.chmod(0o755)
    assert "the file must be readable and its folder writable" in one_line_of(done)
    assert done.returncode == 3


def test_a_database_of_a_newer_version_is_refused(folder: Path) -> None:
    assert pycrorm("run", "plans.py", cwd=folder).returncode == 0
    with closing(sqlite3.connect(folder / "pycrorm.db")) as connection, connection:
        connection.execute("UPDATE pycrorm_log SET format = 99")
    connection.close()
    for arguments in (["run", "plans.py"], ["episodes"]):
        done = pycrorm(*arguments, cwd=folder)
        assert "newer" in one_line_of(done)
        assert done.returncode == 3
