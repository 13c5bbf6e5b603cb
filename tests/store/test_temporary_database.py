from __future__ import annotations

import os
import signal
import subprocess
import sys
from pathlib import Path

import pytest

from pycrorm_async.errors import DatabaseUnavailable
from pycrorm_async.store.address import DatabaseAddress, private_folder

HOLD_ONE = """
import sys
from pathlib import Path
from pycrorm_async.store.address import private_folder
with private_folder(Path(sys.argv[1])) as folder:
    print(folder, flush=True)
    sys.stdin.read()
"""


def held_by_another_process(place: Path) -> tuple[subprocess.Popen[str], Path]:
    process = subprocess.Popen(
        [sys.executable, "-c", HOLD_ONE, str(place)], stdin=subprocess.PIPE, stdout=subprocess.PIPE, text=True
    )
    assert process.stdout is not None
    return process, Path(process.stdout.readline().strip())


def test_a_temporary_database_has_a_folder_only_while_it_is_used() -> None:
    unlocated = DatabaseAddress.parse("sqlite://")
    assert unlocated.is_private
    with unlocated.located() as address:
        folder = address.path.parent
        assert folder.is_dir()
        assert (folder.stat().st_mode & 0o777) == 0o700
        assert address.default_spool == folder / "memory.db.spool"
        assert str(address) == "sqlite://"
        with address.located() as again, DatabaseAddress.parse("sqlite://").located() as other:
            assert again.path == address.path != other.path
    assert not folder.exists()


def test_an_address_with_a_path_is_used_as_it_is(tmp_path: Path) -> None:
    address = DatabaseAddress.parse(f"sqlite:///{tmp_path}/x.db")
    with address.located() as located:
        assert located is address
    assert list(tmp_path.iterdir()) == []


def test_the_folder_of_a_killed_process_is_deleted_and_that_of_a_live_one_is_not(tmp_path: Path) -> None:
    killed, left_behind = held_by_another_process(tmp_path)
    living, in_use = held_by_another_process(tmp_path)
    killed.send_signal(signal.SIGKILL)
    killed.communicate()
    assert left_behind.is_dir()
    with private_folder(tmp_path) as mine:
        assert not left_behind.exists()
        assert in_use.is_dir()
        assert mine.is_dir()
    living.communicate()
    assert not in_use.exists()


def test_files_with_matching_names_neither_delay_it_nor_are_touched(tmp_path: Path) -> None:
    prefix = f"pycrorm-private-{os.geteuid()}-"
    victim = tmp_path / "victim"
    victim.mkdir()
    (tmp_path / f"{prefix}link").symlink_to(victim)
    (tmp_path / f"{prefix}loop").symlink_to(tmp_path / f"{prefix}loop")
    os.mkfifo(tmp_path / f"{prefix}pipe")
    (tmp_path / f"{prefix}file").touch()
    before = sorted(tmp_path.iterdir())
    with private_folder(tmp_path) as folder:
        assert (folder.parent, folder.stat().st_mode & 0o777) == (tmp_path, 0o700)
    assert sorted(tmp_path.iterdir()) == before


@pytest.mark.slow
def test_many_processes_that_make_and_delete_concurrently_each_have_a_folder(tmp_path: Path) -> None:
    script = """
import sys
from pathlib import Path
from pycrorm_async.store.address import private_folder
for _ in range(200):
    with private_folder(Path(sys.argv[1])) as folder:
        (folder / "memory.db").touch(exist_ok=False)
"""
    command = [sys.executable, "-c", script, str(tmp_path)]
    running = [subprocess.Popen(command, stderr=subprocess.PIPE, text=True) for _ in range(4)]
    assert [each.communicate()[1] for each in running] == [""] * 4
    assert list(tmp_path.iterdir()) == []


def test_a_forked_child_that_leaves_the_context_keeps_its_parents_folder(tmp_path: Path) -> None:
    script = """
import os, sys
from pathlib import Path
from pycrorm_async.store.address import private_folder
with private_folder(Path(sys.argv[1])) as folder:
    child = os.fork()
    if child:
        os.waitpid(child, 0)
        print("still there" if folder.is_dir() else "gone", flush=True)
"""
    ran = subprocess.run([sys.executable, "-c", script, str(tmp_path)], capture_output=True, text=True, check=True)
    assert ran.stdout == "still there\n"
    assert list(tmp_path.glob("*/")) == []


def test_a_missing_place_is_an_unavailable_database(tmp_path: Path) -> None:
    with pytest.raises(DatabaseUnavailable, match="No such file or directory"), private_folder(tmp_path / "no"):
        pass
