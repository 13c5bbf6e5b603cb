"""Files deleted or replaced under a queue: their records are never acknowledged, losses are reported, recording
continues.
"""

import asyncio
import logging
import shutil
import tempfile
import threading
from collections.abc import Callable, Iterator
from contextlib import contextmanager, suppress
from dataclasses import replace
from itertools import cycle
from pathlib import Path

import pytest

from pycrorm_async.errors import SpoolUnavailable
from pycrorm_async.events.codec import LOST, Record
from pycrorm_async.queue import LiveSource, RecorderQueue, Spool, open_dead
from pycrorm_async.queue.maintenance import inspect_spool
from pycrorm_async.queue.spool import finish_folder
from tests.crash.test_disk import SLOW
from tests.queue.factories import SMALL, copy_beside_recording, drain, ended, make, node, recover, started

ROOMY = replace(SLOW, spool_bytes_max=64 * SMALL.segment_bytes)
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


def events(records: list[Record]) -> list[tuple[int, int]]:
    return [(each.position, each.sequence) for each in records if each.payload != LOST]


def killed(queue: RecorderQueue, tmp_path: Path) -> Path:
    """Return the spool as `kill -9` would leave it now."""
    return copy_beside_recording(queue.folder.parent, tmp_path / "killed")


async def recovered(spool: Path) -> list[tuple[int, int]]:
    """Return what recovery supplies of every folder, in the order of recovery."""
    return [each for folder in Spool(spool).recorders() for each in events(await recover(folder.path))]


@contextmanager
def suppress_all_but_losses() -> Iterator[None]:
    """A sync that meets the deletion raises before the loss is known."""
    try:
        yield
    except SpoolUnavailable as error:
        if "lost are" in str(error):
            raise


@pytest.mark.parametrize("displace", DELETIONS)
@pytest.mark.parametrize("answer", ["with news", "without news"])
async def test_a_sync_is_refused_once_and_a_kill_leaves_all_that_was_mapped(
    tmp_path: Path, displace: Callable[[RecorderQueue], None], answer: str, caplog: pytest.LogCaptureFixture
) -> None:
    queue = make(tmp_path / "spool", settings=SLOW)
    queue.put_nowait(started(), b"{}")
    await queue.synced_to()
    before = queue.folder
    displace(queue)
    if answer == "with news":
        put(queue, 3)
    count = queue.written
    with pytest.raises(SpoolUnavailable, match=GONE):
        await queue.synced_to()
    synced = queue.synced  # read before the folder, which the sync thread may change at any moment
    assert synced == 1 or (synced, queue.folder != before) == (count, True)
    await queue.synced_to()
    assert (queue.synced, queue.lost, queue.folder.parent) == (count, (), before.parent)
    assert queue.folder != before
    assert queue.setback is not None
    assert f"recording continues in {queue.folder}, no record is lost" in queue.setback
    assert [GONE in each.getMessage() for each in caplog.records if each.levelno == logging.ERROR] == [True, True]
    put(queue, 2)
    assert await recovered(killed(queue, tmp_path)) == [(n, n) for n in range(1, count + 3)]
    assert [each.path for each in Spool(queue.folder.parent).recorders()] == [queue.folder]
    mine = before / "mine"
    assert mine.exists() == (displace is put_another_in_its_place)
    queue.close()
    assert events(await drain(queue)) == [(n, n) for n in range(1, count + 3)]
    queue.release()


async def test_what_was_only_in_deleted_segments_is_reported_and_recording_continues_behind_it(tmp_path: Path) -> None:
    queue = make(tmp_path / "spool", settings=ROOMY)
    queue.put_nowait(started(), b"{}")
    while len(queue._appender.begun) < 4:
        put(queue, 1)
    await queue.synced_to()
    base = queue._appender.begun[-1].base
    batch = await queue.get_batch(events_max=5, bytes_max=2**20, age_s_max=0.0)
    await queue.acknowledge(3)
    delete_the_folder(queue)
    with pytest.raises(SpoolUnavailable, match=f"{GONE}; .* lost are positions 4 to"):
        for _ in range(2):
            with suppress_all_but_losses():
                await queue.synced_to()
    put(queue, 3)
    await queue.synced_to()
    firsts, lasts = zip(*[(each.split()[1], each.split()[3].rstrip(":")) for each in queue.lost], strict=True)
    assert (firsts[0], lasts[-1], len(queue.lost)) == ("4", str(base - 1), 3)
    assert queue.lost[0].startswith("positions 4 to ")
    assert "events 1 to " in queue.lost[0]
    assert queue.lost[-1].split(": ")[1].startswith("events ")
    assert queue.setback is not None
    assert queue.lost[0] in queue.setback
    queue.close()
    supplied = await drain(queue)
    assert events([*batch, *supplied]) == [(n, n) for n in (*range(1, 6), *range(base, queue.written + 1))]
    queue.release()


async def test_losses_are_reported_even_when_the_new_folder_is_deleted_before_its_rename(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    queue = make(tmp_path / "spool", settings=ROOMY)
    queue.put_nowait(started(), b"{}")
    while len(queue._appender.begun) < 4:
        put(queue, 1)
    await queue.synced_to()
    base = queue._appender.begun[-1].base
    deleted: list[Path] = []

    def finish(unfinished: Path, *, replaced: Path | None) -> Path:
        if not deleted:
            deleted.append(unfinished)
            delete(unfinished)
        return finish_folder(unfinished, replaced=replaced)

    monkeypatch.setattr("pycrorm_async.queue.relocation.finish_folder", finish)
    delete_the_folder(queue)
    raised: list[str] = []
    while not raised or queue.synced < queue.written or "continues in" not in (queue.setback or ""):
        assert len(raised) < 1_000, raised[-1]
        try:
            await queue.synced_to()
        except SpoolUnavailable as error:
            raised.append(str(error))
    with suppress(SpoolUnavailable):
        await queue.synced_to()
    put(queue, 2)
    await queue.synced_to()
    assert queue.lost[-1].startswith(f"positions {int(queue.lost[-1].split()[1])} to {base - 1}:")
    assert len(queue.lost) == 3
    assert await recovered(killed(queue, tmp_path)) == [(n, n) for n in range(base, queue.written + 1)]
    queue.release()


async def test_readable_segments_are_copied_and_no_second_copy_is_left(tmp_path: Path) -> None:
    queue = make(tmp_path / "spool", settings=ROOMY)
    queue.put_nowait(started(), b"{}")
    while len(queue._appender.begun) < 4:
        put(queue, 1)
    await queue.synced_to()
    delete_the_segment(queue)
    before = queue.folder
    with pytest.raises(SpoolUnavailable, match=GONE):
        await queue.synced_to()
    await queue.synced_to()
    assert (queue.lost, before.exists()) == ((), False)
    assert await recovered(killed(queue, tmp_path)) == [(n, n) for n in range(1, queue.written + 1)]
    queue.release()


async def test_a_plan_continues_while_no_folder_can_be_made_and_all_of_it_is_stored_in_the_next_one(
    tmp_path: Path,
) -> None:
    spool = tmp_path / "spool"
    queue = make(spool, settings=replace(SLOW, sync_interval_ms=5))
    queue.put_nowait(started(), b"{}")
    await queue.synced_to()
    delete_the_spool(queue)
    spool.write_text("in the way")
    for _ in range(3):
        put(queue, 2)
        with pytest.raises(SpoolUnavailable):
            await queue.synced_to()
    with pytest.raises(SpoolUnavailable, match="recording cannot continue in a new folder"):
        await queue.synced_to()
    assert (queue.synced, queue.written) == (1, 7)
    assert queue.setback is not None
    assert "cannot continue" in queue.setback
    spool.unlink()
    while queue.synced < 7:
        try:
            await queue.synced_to()
        except SpoolUnavailable:
            await asyncio.sleep(0.01)
    put(queue, 1)
    await queue.synced_to()
    assert await recovered(killed(queue, tmp_path)) == [(n, n) for n in range(1, 9)]
    queue.release()


async def test_a_queue_that_is_closed_while_no_folder_can_be_made_ends_with_the_reason(tmp_path: Path) -> None:
    queue = make(tmp_path / "spool", settings=SLOW)
    queue.put_nowait(started(), b"{}")
    delete_the_spool(queue)
    (tmp_path / "spool").write_text("in the way")
    queue.close()
    with pytest.raises(SpoolUnavailable, match=GONE):
        await queue.synced_to()
    with pytest.raises(SpoolUnavailable, match="recording cannot continue"):
        await drain(queue)
    queue.release()


@pytest.mark.slow
async def test_threads_that_put_meanwhile_leave_no_gap_that_is_not_reported(tmp_path: Path) -> None:
    queue = make(tmp_path / "spool", settings=replace(ROOMY, sync_interval_ms=1, spool_bytes_max=2**23))
    begin = threading.Barrier(3)

    def produce(number: int) -> None:
        begin.wait()
        for heading in (started(number), *[node(number)] * 2_000, ended(number)):
            while True:
                try:
                    queue.put_nowait(heading, b"x" * 50)
                except SpoolUnavailable:  # both segments are full, and the folder was not made yet
                    assert queue.failure is None
                else:
                    break

    threads = [threading.Thread(target=produce, args=(number,)) for number in (1, 2, 3)]

    def close_behind_them() -> None:
        for thread in threads:
            thread.join()
        queue.close()

    for thread in (*threads, closing := threading.Thread(target=close_behind_them)):
        thread.start()
    supplied: list[Record] = []
    folders = {queue.folder}
    deletions = cycle(DELETIONS)
    while batch := await queue.get_batch(events_max=200, bytes_max=2**20, age_s_max=0.0):
        supplied += batch
        if len(folders) < 9 and queue.folder in folders:
            with suppress(OSError):  # the queue has already moved on
                next(deletions)(queue)
        folders.add(queue.folder)
    closing.join()
    assert len(folders) > 1
    assert queue.failure is None
    queue.release()
    positions = [each.position for each in supplied]
    named = [range(int(words[1]), int(words[3].rstrip(":")) + 1) for words in map(str.split, queue.lost)]
    missing = set(range(1, queue.written + 1)) - set(positions)
    assert positions == sorted(set(positions))
    assert all(any(each in span for span in named) for each in missing)
    assert queue.written == 6_006


@pytest.mark.parametrize("displace", DELETIONS)
async def test_a_drainer_in_another_process_ends_with_the_old_folder_and_drains_the_new_one(
    tmp_path: Path, displace: Callable[[RecorderQueue], None]
) -> None:
    queue = make(tmp_path / "spool", settings=SLOW, offered=True)
    queue.put_nowait(started(), b"{}")
    await queue.synced_to()
    first = LiveSource.take(queue.folder)
    assert first is not None
    [one] = await first.get_batch(events_max=10, bytes_max=2**20, age_s_max=0.0)
    await first.acknowledge(1)
    first.mark_visible(1, {})
    displace(queue)
    put(queue, 2)
    with pytest.raises(SpoolUnavailable, match=GONE):
        await queue.synced_to()
    await queue.synced_to()
    assert await first.get_batch(events_max=10, bytes_max=2**20, age_s_max=0.0) == []
    first.release()
    [recorder] = [each for each in Spool(tmp_path / "spool").recorders() if each.alive]
    assert open_dead(recorder.path) is None
    second = LiveSource.take(recorder.path)
    assert second is not None
    again = await second.get_batch(events_max=10, bytes_max=2**20, age_s_max=0.0)
    assert events(again) == [(1, 1), (2, 2), (3, 3)]
    assert again[0] == one
    await second.acknowledge(3)
    second.mark_visible(3, {})
    queue.close()
    await queue.synced_to()
    assert queue.external_drain_status is not None
    assert (queue.external_drain_status.stored, queue.external_drain_status.folded) == (3, 3)
    second.release()
    queue.release()


async def test_a_folder_that_was_moved_away_stays_alive_until_the_process_ends(tmp_path: Path) -> None:
    queue = make(tmp_path / "spool", settings=SLOW)
    queue.put_nowait(started(), b"{}")
    before, name = queue.folder, queue.name
    put_another_in_its_place(queue)
    with pytest.raises(SpoolUnavailable, match=GONE):
        await queue.synced_to()
    await queue.synced_to()
    back = tmp_path / "elsewhere" / name
    back.parent.mkdir()
    (tmp_path / "taken away").rename(back)
    assert [each.alive for each in Spool(back.parent).recorders()] == [True]
    assert open_dead(back) is None
    assert before.exists()
    queue.release()
    assert [each.damage for each in inspect_spool(back.parent).recorders] == [None]
