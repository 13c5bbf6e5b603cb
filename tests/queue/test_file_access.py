"""The files of a spool and a SQLite database belong to their owner alone, or to a group, whatever the umask."""

from __future__ import annotations

import os
from collections.abc import Iterator
from contextlib import contextmanager
from pathlib import Path

import pytest

from pycrorm_async import Memory, Settings
from pycrorm_async.clock import SYSTEM_CLOCK
from pycrorm_async.events.codec import Record
from pycrorm_async.events.ids import parse_episode_id
from pycrorm_async.queue.locks import open_file
from pycrorm_async.queue.sources import DeadLetters
from pycrorm_async.queue.spool import Spool
from pycrorm_async.queue.stored_segments import StoredSegments
from pycrorm_async.settings import FileAccess
from tests.memory.note_actions import NoteActionPerformable

pytestmark = pytest.mark.slow

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


async def test_an_older_spool_still_works_and_its_new_files_are_for_its_owner(tmp_path: Path) -> None:
    spool = tmp_path / "memory.db.spool"
    spool.mkdir()
    spool.chmod(0o775)
    async with Memory.open(f"sqlite:///{tmp_path}/memory.db"):
        await NoteActionPerformable("a").perform()
        [recorder] = Spool(spool).recorders()
        assert modes(recorder.path) == {"folders": 0o700, "files": 0o600}
        assert spool.stat().st_mode & 0o7777 == 0o775


def test_a_spool_becomes_the_groups_when_a_recorder_is_opened_for_the_group(tmp_path: Path) -> None:
    Spool(tmp_path / "spool").bind("a")
    Spool(tmp_path / "spool", "group").bind("b")
    os.close(open_file(tmp_path / "spool" / "later", os.O_WRONLY))
    assert (tmp_path / "spool").stat().st_mode & 0o7777 == 0o2770
    assert (tmp_path / "spool" / "later").stat().st_mode & 0o7777 == 0o660


def test_an_existing_file_keeps_its_content_and_its_mode(tmp_path: Path) -> None:
    path = tmp_path / "progress"
    path.write_text("whole")
    path.chmod(0o640)
    os.close(open_file(path, os.O_RDWR))
    assert (path.read_text(), path.stat().st_mode & 0o777) == ("whole", 0o640)
