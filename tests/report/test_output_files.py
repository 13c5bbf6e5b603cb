"""A file or folder has its name only when it is complete and on the disk."""

import errno
import os
from functools import partial
from pathlib import Path
from typing import Any

import pytest

from pycrorm_async.errors import CallerError
from pycrorm_async.report.output_files import new_file, new_folder, write_file


class WatchedSyncs:
    """Notes, for each sync, the file or folder, its bytes, and whether the target has its name already."""

    def __init__(self, target: Path, monkeypatch: pytest.MonkeyPatch) -> None:
        self.noted: list[tuple[str, bytes | None, bool]] = []
        fsync = os.fsync

        def watched(descriptor: int) -> None:
            path = Path(f"/proc/self/fd/{descriptor}").readlink()
            content = path.read_bytes() if path.is_file() else None
            self.noted.append((path.name, content, target.exists()))
            fsync(descriptor)

        monkeypatch.setattr(os, "fsync", watched)


@pytest.mark.parametrize("force", [False, True])
def test_a_file_is_synced_before_it_gets_its_name_and_its_folder_afterwards(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch, *, force: bool
) -> None:
    target = tmp_path / "rows.csv"
    syncs = WatchedSyncs(target, monkeypatch)
    write_file(b"all of it", target, force=force)
    assert [(content, named) for _, content, named in syncs.noted] == [(b"all of it", False), (None, True)]
    assert syncs.noted[-1][0] == tmp_path.name
    assert [each.name for each in tmp_path.iterdir()] == ["rows.csv"]


@pytest.mark.parametrize("below", ["rows.csv", "folder/rows.csv"])
@pytest.mark.parametrize("force", [False, True])
def test_a_file_that_is_named_as_a_folder_is_called_a_file(tmp_path: Path, below: str, *, force: bool) -> None:
    file = tmp_path / "notes.txt"
    file.write_bytes(b"notes")
    with pytest.raises(CallerError) as refused:
        write_file(b"rows", file / below, force=force)
    assert str(refused.value) == (
        f"{file} is a file, so {file / below} cannot be written below it: give the name of a folder"
    )
    assert file.read_bytes() == b"notes"


@pytest.mark.parametrize("exists", [False, True])
def test_a_new_file_gets_its_name_on_a_file_system_without_links_too(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch, *, exists: bool
) -> None:
    target = tmp_path / "rows.csv"

    def link(*_: object, **__: object) -> None:
        if exists:
            target.write_bytes(b"of another process")
        raise PermissionError(errno.EPERM, "Operation not permitted")

    monkeypatch.setattr(os, "link", link)
    if exists:
        with pytest.raises(CallerError, match="exists: add --force"):
            write_file(b"all of it", target)
    else:
        write_file(b"all of it", target)
    assert target.read_bytes() == (b"of another process" if exists else b"all of it")
    assert [each.name for each in tmp_path.iterdir()] == ["rows.csv"]


def test_all_files_of_a_folder_are_synced_before_it_gets_its_name(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    target = tmp_path / "set"
    syncs = WatchedSyncs(target, monkeypatch)
    with new_folder(target, force=False, marker="info") as written:
        (written / "info").write_bytes(b"1")
        (written / "data").mkdir()
        (written / "data" / "rows").write_bytes(b"2")
    *before, after = syncs.noted
    assert {name: content for name, content, _ in before} | {written.name: None} == {
        "info": b"1",
        "data": None,
        "rows": b"2",
        written.name: None,
    }
    assert [named for *_, named in before] == [False] * 4
    assert (after[0], after[2]) == (tmp_path.name, True)


@pytest.mark.parametrize("new", [new_file, partial(new_folder, marker="meta")])
def test_an_error_of_a_part_names_the_file_that_the_user_asked_for_and_another_keeps_its_name(
    new: Any, tmp_path: Path
) -> None:
    manifest = tmp_path / "a.manifest.json"
    with (
        pytest.raises(OSError, match="No space left") as refused,
        new_file(manifest, force=False),
        new(tmp_path / "a", force=False) as part,
    ):
        raise OSError(errno.ENOSPC, os.strerror(errno.ENOSPC), str(part))
    assert refused.value.filename == str(tmp_path / "a")
    with pytest.raises(FileNotFoundError) as missing, new(tmp_path / "a", force=False):
        (tmp_path / "mesh.stl").read_bytes()
    assert missing.value.filename == str(tmp_path / "mesh.stl")
    assert list(tmp_path.iterdir()) == []
