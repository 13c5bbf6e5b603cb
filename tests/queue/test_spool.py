"""The spool: its recorders, its database, foreign files, its owner, and the file systems on which it may be."""

from __future__ import annotations

import os
import shutil
import subprocess
import threading
from collections.abc import Iterator
from contextlib import contextmanager
from pathlib import Path

import pytest

from pycrorm_async import Memory, Settings
from pycrorm_async.clock import SYSTEM_CLOCK
from pycrorm_async.errors import SpoolForeign, SpoolUnavailable
from pycrorm_async.events.codec import Record
from pycrorm_async.events.ids import episode_text, parse_episode_id
from pycrorm_async.queue import RecorderQueue, Spool, locks
from pycrorm_async.queue.locks import FileLock, check_file_system, file_system_type, open_file
from pycrorm_async.queue.sources import DeadLetters
from pycrorm_async.queue.spool import make_folder
from pycrorm_async.queue.stored_segments import StoredSegments
from pycrorm_async.settings import FileAccess
from tests.memory.note_actions import NoteActionPerformable, texts
from tests.queue.factories import RECORDER, episode, make, opened_dead, started

# === spool ====================================================================================================
#
# The spool: live and dead recorders, the database to which it belongs, and foreign files.


def test_a_missing_spool_has_no_recorders_and_is_not_made(spool: Path) -> None:
    assert Spool(spool).recorders() == []
    assert Spool(spool).strangers() == []
    assert Spool(spool).log_id() is None
    assert not spool.exists()


def test_a_recorder_is_alive_until_it_is_released(spool: Path) -> None:
    queue = make(spool)
    queue.put_nowait(started(), b"{}")
    (living,) = Spool(spool).recorders()
    queue.release()
    (dead,) = Spool(spool).recorders()
    assert (living.name, living.alive, dead.alive) == (episode_text(RECORDER), True, False)
    assert dead.path == living.path == queue.folder


@pytest.mark.slow
def test_listing_recorders_does_not_prevent_the_recovery_of_a_dead_folder(spool: Path) -> None:
    queue = make(spool)
    queue.put_nowait(started(), b"{}")
    queue.release()
    looking = True

    def look() -> None:
        while looking:
            Spool(spool).recorders()

    thread = threading.Thread(target=look)
    thread.start()
    try:
        for _ in range(200):
            recovered = opened_dead(queue.folder)
            recovered.release()
    finally:
        looking = False
        thread.join()


def test_a_spool_stays_bound_to_its_log_while_a_recorder_is_in_it(spool: Path, queue: RecorderQueue) -> None:
    Spool(spool).bind("0190-log-of-a")
    Spool(spool).bind("0190-log-of-a")
    assert Spool(spool).log_id() == "0190-log-of-a"
    queue.put_nowait(started(), b"{}")
    for _ in ("alive", "dead"):
        with pytest.raises(SpoolForeign) as refused:
            Spool(spool).bind("0190-log-of-b")
        assert str(refused.value) == (
            f"spool {spool} belongs to log 0190-log-of-a, not to log 0190-log-of-b:"
            " open the database it belongs to, choose another spool, or move its records to this database with"
            " `pycrorm spool rebind`"
        )
        queue.release()
    assert sorted(path.name for path in spool.iterdir()) == [queue.name, "log"]
    assert (spool / "log").read_bytes() == b"0190-log-of-a\n"


def test_an_empty_spool_can_be_bound_to_another_log(spool: Path) -> None:
    Spool(spool).bind("0190-log-of-a")
    make(spool).release()  # nothing was recorded, so that its folder is deleted
    (spool / "notes.txt").write_text("mine")
    Spool(spool).bind("0190-log-of-b")
    assert Spool(spool).log_id() == "0190-log-of-b"
    assert sorted(path.name for path in spool.iterdir()) == ["log", "notes.txt"]


def test_of_many_recorders_for_different_logs_all_that_remain_use_one(spool: Path) -> None:
    """Each binds the spool, makes its folder, and binds again, as `Memory.open` does."""
    stay: list[str] = []
    alive: list[FileLock] = []
    begin = threading.Barrier(6)

    def record(number: int) -> None:
        begin.wait()
        try:
            Spool(spool).bind(f"log-{number % 2}")
            alive.append(make_folder(spool, episode_text(episode(number)))[1])
            Spool(spool).bind(f"log-{number % 2}")
        except SpoolForeign:
            return
        stay.append(f"log-{number % 2}")

    threads = [threading.Thread(target=record, args=(number,)) for number in range(6)]
    for thread in threads:
        thread.start()
    for thread in threads:
        thread.join()
    for lock in alive:
        lock.release()
    assert set(stay) == {Spool(spool).log_id()}


def test_foreign_files_in_the_spool_are_named_and_not_touched(spool: Path, queue: RecorderQueue) -> None:
    (spool / "notes.txt").write_text("mine")
    (spool / "0190f0f0-0000-7000-8000-000000000000").mkdir()
    (spool / "lost+found").mkdir()
    Spool(spool).bind("log")
    assert [path.name for path in Spool(spool).strangers()] == [
        "0190f0f0-0000-7000-8000-000000000000",
        "lost+found",
        "notes.txt",
    ]
    assert [each.path for each in Spool(spool).recorders()] == [queue.folder]


def test_a_spool_that_cannot_be_created_is_one_line_with_the_next_command() -> None:
    with pytest.raises(SpoolUnavailable) as refused:
        Spool(Path("/proc/none")).bind("a-log")
    assert str(refused.value) == (
        "spool /proc/none: cannot be created: No such file or directory; name another folder with --spool"
    )


def test_a_file_in_place_of_the_spool_is_reported_in_one_clear_line(tmp_path: Path) -> None:
    blocking = tmp_path / "blocking"
    blocking.touch()
    for path in (blocking, blocking / "spool"):
        for attempt in (Spool(path).recorders, Spool(path).strangers, lambda path=path: Spool(path).bind("log")):
            with pytest.raises(SpoolUnavailable) as refused:
                attempt()
            assert str(blocking) in str(refused.value)
            assert "\n" not in str(refused.value)


# === file access ==============================================================================================
#
# The files of a spool and a SQLite database belong to their owner alone, or to a group, whatever the umask.

EPISODE = parse_episode_id("0190a000-0000-7000-8000-000000000002")


@contextmanager
def umask(mask: int) -> Iterator[None]:
    before = os.umask(mask)
    try:
        yield
    finally:
        os.umask(before)


def modes(*paths: Path) -> dict[str, int]:
    """Return the only mode of all folders, and that of all files, at and below these paths."""
    every = [each for path in paths for each in (path, *path.rglob("*"))]
    seen = {(each.is_dir(), each.stat().st_mode & 0o7777) for each in every}
    assert len(seen) == 2, {each.name: oct(each.stat().st_mode) for each in every}
    return {"folders" if is_folder else "files": mode for is_folder, mode in seen}


@pytest.mark.slow
@pytest.mark.parametrize("mask", [0o000, 0o022, 0o377])
@pytest.mark.parametrize(("access", "folders", "files"), [("owner", 0o700, 0o600), ("group", 0o2770, 0o660)])
async def test_every_file_has_the_chosen_mode(
    tmp_path: Path, mask: int, access: FileAccess, folders: int, files: int
) -> None:
    settings = Settings(file_access=access, segment_bytes=2**16, record_bytes_max=2**12, spool_reserve_bytes=2**16)
    spool = tmp_path / "spool"
    with umask(mask):
        async with Memory.open(f"sqlite:///{tmp_path}/memory.db", spool=spool, settings=settings) as memory:
            await NoteActionPerformable("a").perform()
            await memory.flush()
            [recorder] = Spool(spool).recorders()
            refused = DeadLetters(recorder.path)
            refused.put([Record(1, EPISODE, 5, "NodeStarted", 1, 7, 8, b"{}")])
            refused.release()
            segment = recorder.path / "00000009.segment"
            os.close(open_file(segment, os.O_WRONLY))
            StoredSegments(spool, settings, wall_ns=SYSTEM_CLOCK.wall_ns).keep(segment)
            writer = Spool(spool).take_writer()
            assert writer is not None
            writer.release()
            database = [tmp_path / f"memory.db{suffix}" for suffix in ("", "-wal", "-shm")]
            assert modes(spool, *database) == {"folders": folders, "files": files}
            names = {each.name for each in spool.rglob("*") if not each.is_dir()}
            assert names >= {"log", "writer", "alive", "drain", "00000001.segment", "00000009.segment"}
            assert not segment.exists()


@pytest.mark.slow
async def test_an_older_spool_still_works_and_its_new_files_are_for_its_owner(tmp_path: Path) -> None:
    spool = tmp_path / "memory.db.spool"
    spool.mkdir()
    spool.chmod(0o775)
    async with Memory.open(f"sqlite:///{tmp_path}/memory.db"):
        await NoteActionPerformable("a").perform()
        [recorder] = Spool(spool).recorders()
        assert modes(recorder.path) == {"folders": 0o700, "files": 0o600}
        assert spool.stat().st_mode & 0o7777 == 0o775


@pytest.mark.slow
def test_a_spool_becomes_the_groups_when_a_recorder_is_opened_for_the_group(tmp_path: Path) -> None:
    Spool(tmp_path / "spool").bind("a")
    Spool(tmp_path / "spool", "group").bind("b")
    os.close(open_file(tmp_path / "spool" / "later", os.O_WRONLY))
    assert (tmp_path / "spool").stat().st_mode & 0o7777 == 0o2770
    assert (tmp_path / "spool" / "later").stat().st_mode & 0o7777 == 0o660


@pytest.mark.slow
def test_an_existing_file_keeps_its_content_and_its_mode(tmp_path: Path) -> None:
    path = tmp_path / "progress"
    path.write_text("whole")
    path.chmod(0o640)
    os.close(open_file(path, os.O_RDWR))
    assert (path.read_text(), path.stat().st_mode & 0o777) == ("whole", 0o640)


# === file system ==============================================================================================
#
# A spool on a file system where a full disk would kill the plan is refused in one line before anything is made.

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


@pytest.mark.parametrize(
    ("kind", "name"),
    [
        (BTRFS, "btrfs"),
        (0x6969, "NFS"),
        (0x00C36400, "Ceph"),
    ],
)
def test_other_file_systems_are_refused_by_their_name(
    tmp_path: Path, kind: int, name: str, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setattr(locks, "file_system_type", lambda _: kind)
    with pytest.raises(SpoolUnavailable, match=f"lies on {name}, where"):
        make(tmp_path / "spool")
    assert not (tmp_path / "spool").exists()
