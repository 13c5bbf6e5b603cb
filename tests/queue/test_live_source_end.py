"""Draining a live recorder's folder ends when the recorder closes, is released, is killed or forks."""

import asyncio
import contextlib
import os
import signal
import subprocess
import sys
from pathlib import Path

from pycrorm_async.errors import SpoolFull
from pycrorm_async.events.codec import Record
from pycrorm_async.queue import LiveSource, RecorderQueue, Spool, open_dead
from pycrorm_async.queue.spool import RecorderStatus
from tests.queue.factories import drain, ended, episode, lost, make, overwrite, record, recover, started
from tests.queue.live_sources import eventually, next_positions, take

ROOT = Path(__file__).parents[2]


async def test_a_closed_queue_ends_and_deletes_itself_when_all_is_stored(spool: Path) -> None:
    queue = make(spool, offered=True)
    source = take(queue)
    queue.put_nowait(started(), b"{}")
    queue.put_nowait(ended(), b"{}")
    queue.close()
    assert [each.sequence for each in await drain(source)] == [1, 2]
    await source.acknowledge(2)
    await eventually(lambda: queue.stored == 2)
    assert LiveSource.take(queue.folder) is None
    queue.release()
    assert not queue.folder.exists()
    source.mark_visible(2, {})  # written to a deleted file, which harms no process
    source.release()


async def test_a_queue_that_is_released_before_all_is_stored_leaves_a_dead_folder(spool: Path) -> None:
    queue = make(spool, offered=True)
    source = take(queue)
    queue.put_nowait(started(), b"{}")
    queue.put_nowait(ended(), b"{}")
    await queue.synced_to()
    assert await next_positions(source, events_max=1) == [1]
    await source.acknowledge(1)
    queue.release()
    async with asyncio.timeout(30):
        while await source.get_batch(events_max=1, bytes_max=2**20, age_s_max=0.0):
            pass
    assert open_dead(queue.folder) is None  # while the source holds the folder
    source.release()
    assert LiveSource.take(queue.folder) is None
    assert await recover(queue.folder) == [record(1, started(), 1, b"{}"), record(2, ended(), 2, b"{}")]


async def test_recovery_ignores_and_deletes_the_progress_file(spool: Path) -> None:
    queue = make(spool, offered=True)
    queue.put_nowait(started(), b"{}")
    await queue.synced_to()
    queue.release()
    overwrite(queue.folder / "progress", 128, b"\xff" * 64)
    recovered = open_dead(queue.folder)
    assert recovered is not None
    assert await drain(recovered) == [record(1, started(), 1, b"{}"), lost(2, 1, 2)]
    await recovered.acknowledge(2)
    recovered.release()
    assert not queue.folder.exists()


async def test_a_recorder_killed_while_it_is_drained_ends_the_source_and_recovery_supplies_all_again(
    spool: Path,
) -> None:
    script = (
        "import sys, threading\n"
        "from pathlib import Path\n"
        "from tests.queue.factories import make, node, started\n"
        "queue = make(Path(sys.argv[1]), offered=True)\n"
        "queue.put_nowait(started(), b'{}')\n"
        "for number in range(10):\n"
        "    queue.put_nowait(node(), b'%d' % number)\n"
        "print('put', flush=True)\n"
        "threading.Event().wait()\n"
    )
    process = subprocess.Popen(  # noqa: ASYNC220
        [sys.executable, "-c", script, str(spool)], stdout=subprocess.PIPE, cwd=ROOT
    )
    with process:
        assert process.stdout is not None
        assert process.stdout.readline() == b"put\n"
        (folder,) = Spool(spool).recorders()
        source = LiveSource.take(folder.path)
        assert source is not None
        supplied: list[Record] = []
        while len(supplied) < 11:
            supplied += await source.get_batch(events_max=4, bytes_max=2**20, age_s_max=0.0)
        await source.acknowledge(6)
        waiting = asyncio.ensure_future(next_positions(source))
        await asyncio.sleep(0.05)
        process.send_signal(signal.SIGKILL)
        assert await waiting == []
        assert not source.is_alive
        source.release()
    assert supplied[0].episode == episode(1)
    assert await recover(folder.path) == [*supplied, lost(12, 1, 12)]


async def test_a_forked_child_writes_nothing_in_the_name_of_its_parent(offered: RecorderQueue) -> None:
    source = take(offered)
    offered.put_nowait(started(), b"{}")
    await offered.synced_to()
    child = os.fork()
    if child == 0:
        offered.close()
        offered.release()
        os._exit(0)
    os.waitpid(child, 0)  # noqa: ASYNC222
    assert source._progress.recorded() == RecorderStatus(1, closed=False)
    assert await next_positions(source) == [1]
    with contextlib.suppress(SpoolFull):
        offered.put_nowait(ended(), b"{}")
    assert await next_positions(source) == [2]
    source.release()
