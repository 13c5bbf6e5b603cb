from __future__ import annotations

import os
from pathlib import Path

import pytest

from pycrorm_async.errors import DatabaseUnavailable
from pycrorm_async.store.address import DatabaseAddress, private_folder
from tests.crash.forked_processes import ForkedProcess


def _hold_one(place: str) -> None:
    with private_folder(Path(place)) as folder:
        print(folder, flush=True)
        os.read(0, 1)


def held_by_another_process(place: Path) -> tuple[ForkedProcess, Path]:
    process = ForkedProcess(_hold_one, str(place))
    process.wait_for("\n")
    return process, Path(process.lines[0])


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
    killed.kill()
    assert left_behind.is_dir()
    with private_folder(tmp_path) as mine:
        assert not left_behind.exists()
        assert in_use.is_dir()
        assert mine.is_dir()
    living.send_byte()
    assert living.wait() == 0
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
    running = [ForkedProcess(_make_and_delete, str(tmp_path)) for _ in range(4)]
    assert [each.wait() for each in running] == [0] * 4
    assert list(tmp_path.iterdir()) == []


def _make_and_delete(place: str) -> None:
    for _ in range(200):
        with private_folder(Path(place)) as folder:
            (folder / "memory.db").touch(exist_ok=False)


def test_a_forked_child_that_leaves_the_context_keeps_its_parents_folder(tmp_path: Path) -> None:
    parent = ForkedProcess(_fork_inside, str(tmp_path))
    assert (parent.wait(), parent.lines) == (0, ["True"])
    assert list(tmp_path.glob("*/")) == []


def _fork_inside(place: str) -> None:
    with private_folder(Path(place)) as folder:
        if child := os.fork():
            os.waitpid(child, 0)
            print(folder.is_dir(), flush=True)


def test_a_missing_place_is_an_unavailable_database(tmp_path: Path) -> None:
    with pytest.raises(DatabaseUnavailable, match="No such file or directory"), private_folder(tmp_path / "no"):
        pass
