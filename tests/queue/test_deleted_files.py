"""Files deleted or replaced under a queue: it says so within a sync, acknowledges nothing more, and records nothing."""

import asyncio
import logging
import shutil
import tempfile
from collections.abc import Callable
from pathlib import Path

import pytest

from pycrorm_async.errors import SpoolUnavailable
from pycrorm_async.queue import LiveSource, RecorderQueue, Spool, open_dead
from tests.queue.factories import SLOW, make, node, opened_dead, started

GONE = "was deleted or replaced while the queue wrote to it"


def delete(folder: Path) -> None:
    """Delete the folder at once, although the queue may make files in it."""
    trash = Path(tempfile.mkdtemp(dir=queue_root(folder)))
    folder.rename(trash / "trash")
    shutil.rmtree(trash)


def queue_root(folder: Path) -> Path:
    """A folder outside the spool on the same file system."""
    return folder.parent if folder.name == "spool" else folder.parent.parent


def delete_the_folder(queue: RecorderQueue) -> None:
    delete(queue.folder)


def delete_the_spool(queue: RecorderQueue) -> None:
    delete(queue.folder.parent)


def put_another_in_its_place(queue: RecorderQueue) -> None:
    queue.folder.rename(queue.folder.parent.parent / "taken away")
    queue.folder.mkdir()
    (queue.folder / "mine").touch()


def delete_the_segment(queue: RecorderQueue) -> None:
    queue._appender.begun[-1].path.unlink()


def delete_alive(queue: RecorderQueue) -> None:
    (queue.folder / "alive").unlink()


def put_another_file_in_place_of_the_segment(queue: RecorderQueue) -> None:
    path = queue._appender.begun[-1].path
    content = path.read_bytes()
    path.unlink()
    path.write_bytes(content)


DELETIONS = [
    delete_the_folder,
    delete_the_spool,
    put_another_in_its_place,
    delete_the_segment,
    delete_alive,
    put_another_file_in_place_of_the_segment,
]


def put(queue: RecorderQueue, count: int) -> None:
    for number in range(count):
        queue.put_nowait(node(), b"%d" % number * 20)


@pytest.mark.parametrize(
    ("displace", "with_news"), [*((each, False) for each in DELETIONS), (delete_the_folder, True), (delete_alive, True)]
)
async def test_a_queue_whose_files_were_deleted_says_so_and_acknowledges_nothing_more(
    tmp_path: Path, displace: Callable[[RecorderQueue], None], with_news: bool, caplog: pytest.LogCaptureFixture
) -> None:
    queue = make(tmp_path / "spool", settings=SLOW)
    queue.put_nowait(started(), b"{}")
    put(queue, 1)
    await queue.synced_to()
    [first, _] = await queue.get_batch(events_max=5, bytes_max=2**20, age_s_max=0.0)
    await queue.acknowledge(first.position)
    displace(queue)
    if with_news:
        put(queue, 3)
    for _ in range(2):
        with pytest.raises(SpoolUnavailable, match=GONE):
            await queue.synced_to()
    with pytest.raises(SpoolUnavailable, match=GONE):
        queue.put_nowait(node(), b"{}", reserved=True)
    with pytest.raises(SpoolUnavailable, match=GONE):
        await queue.get_batch(events_max=5, bytes_max=2**20, age_s_max=0.0)
    assert (queue.synced, queue.lost) == (2, (f"positions 2 to {queue.written}",))
    assert [GONE in each.getMessage() for each in caplog.records if each.levelno == logging.ERROR] == [True]
    await queue.room()  # nothing waits for space that never comes
    queue.release()
    assert (queue.folder / "mine").exists() == (displace is put_another_in_its_place)


@pytest.mark.parametrize("displace", [delete_the_folder, delete_the_segment])
async def test_a_drainer_in_another_process_ends_with_the_recorder_of_deleted_files(
    tmp_path: Path, displace: Callable[[RecorderQueue], None]
) -> None:
    queue = make(tmp_path / "spool", settings=SLOW, offered=True)
    queue.put_nowait(started(), b"{}")
    await queue.synced_to()
    source = LiveSource.take(queue.folder)
    assert source is not None
    [one] = await source.get_batch(events_max=10, bytes_max=2**20, age_s_max=0.0)
    await source.acknowledge(one.position)
    displace(queue)
    put(queue, 2)
    with pytest.raises(SpoolUnavailable, match=GONE):
        await queue.synced_to()
    queue.release()
    assert await asyncio.wait_for(source.get_batch(events_max=10, bytes_max=2**20, age_s_max=0.0), 20) == []
    source.release()


async def test_a_folder_that_was_moved_away_stays_alive_until_the_process_ends(tmp_path: Path) -> None:
    queue = make(tmp_path / "spool", settings=SLOW)
    queue.put_nowait(started(), b"{}")
    put_another_in_its_place(queue)
    with pytest.raises(SpoolUnavailable, match=GONE):
        await queue.synced_to()
    back = tmp_path / "elsewhere" / queue.name
    back.parent.mkdir()
    (tmp_path / "taken away").rename(back)
    assert [each.alive for each in Spool(back.parent).recorders()] == [True]
    assert open_dead(back) is None
    queue.release()
    source = opened_dead(back)
    source.release()
