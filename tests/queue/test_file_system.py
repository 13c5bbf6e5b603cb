"""A spool on a file system where a full disk would kill the plan is refused in one line before anything is made."""

import shutil
import subprocess
from collections.abc import Iterator
from pathlib import Path

import pytest

from pycrorm_async import Memory
from pycrorm_async.errors import SpoolUnavailable
from pycrorm_async.queue import locks
from pycrorm_async.queue.locks import check_file_system, file_system_type
from tests.memory.note_actions import NoteActionPerformable, texts
from tests.queue.factories import make

BTRFS = 0x9123683E


@pytest.fixture(params=["mounted", "simulated"])
def btrfs(request: pytest.FixtureRequest, tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> Iterator[Path]:
    """A btrfs that the test mounts, and a simulated one for machines that cannot make or mount one."""
    disk, image = tmp_path / "disk", tmp_path / "disk.img"
    disk.mkdir()
    if request.param == "mounted" and shutil.which("mkfs.btrfs"):
        subprocess.run(["truncate", "-s", "128M", image], check=True)
        subprocess.run(["mkfs.btrfs", "-q", image], check=True, capture_output=True)
        mount = ["mount", "-o", "loop", str(image), str(disk)]
        if subprocess.run(mount, capture_output=True, check=False).returncode == 0:
            yield disk
            subprocess.run(["umount", "--lazy", str(disk)], check=True)  # a failed test may have left a queue open
            return

    def simulated_btrfs(path: Path) -> int:
        return BTRFS if path.is_relative_to(disk) else file_system_type(path)

    monkeypatch.setattr(locks, "file_system_type", simulated_btrfs)
    yield disk


@pytest.mark.slow
async def test_a_spool_on_btrfs_is_refused_in_one_line_that_names_suitable_places(btrfs: Path, tmp_path: Path) -> None:
    url = f"sqlite:///{btrfs / 'memory.db'}"
    for spool in (btrfs / "spool", btrfs / "not" / "there"):
        with pytest.raises(
            SpoolUnavailable, match=r"lies on btrfs, .*: name a folder on ext4, XFS or tmpfs"
        ) as refused:
            make(spool)
        assert "\n" not in str(refused.value)
        assert not spool.exists()
    with pytest.raises(SpoolUnavailable, match="lies on btrfs"):
        async with Memory.open(url):
            pass
    async with Memory.open(url, spool=tmp_path / "spool") as memory:
        await NoteActionPerformable("a").perform()
        await memory.flush()
        assert await texts(memory) == ["a"]


def test_the_file_systems_of_robots_are_accepted(tmp_path: Path) -> None:
    for place in (tmp_path, Path("/dev/shm"), Path("/"), tmp_path / "not" / "there"):
        check_file_system(place)
    assert file_system_type(Path("/dev/shm")) == 0x01021994  # tmpfs
    assert file_system_type(tmp_path / "gone") == 0


@pytest.mark.parametrize(("kind", "name"), [(0x6969, "NFS"), (0xFF534D42, "CIFS"), (0x2FC12FC1, "ZFS")])
def test_other_file_systems_are_refused_by_their_name(
    tmp_path: Path, kind: int, name: str, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setattr(locks, "file_system_type", lambda _: kind)
    with pytest.raises(SpoolUnavailable, match=f"lies on {name}, where"):
        check_file_system(tmp_path / "spool")
