"""Forked children: they can neither write to the parent's files nor keep or release its locks."""

import asyncio
import gc
import os
import threading
from collections.abc import Callable
from pathlib import Path

import pytest

from pycrorm_async.clock import Clock
from pycrorm_async.errors import SpoolClosed
from pycrorm_async.queue import RecorderQueue, Spool, open_dead
from pycrorm_async.queue.locks import is_locked
from tests.queue.factories import drain, ended, lost, make, node, record, recover, started

pytestmark = pytest.mark.filterwarnings("ignore:.*fork.*:DeprecationWarning")


def in_child(work: Callable[[], object]) -> int:
    """Return the exit status of a forked child: 0 if the work succeeded, 17 if it raised `SpoolClosed`."""
    child = os.fork()
    if child == 0:
        try:
            work()
        except SpoolClosed:
            os._exit(17)
        else:
            os._exit(0)
        finally:
            os._exit(1)
    return os.waitstatus_to_exitcode(os.waitpid(child, 0)[1])


def test_a_child_cannot_put(queue: RecorderQueue) -> None:
    queue.put_nowait(started(), b"{}")
    assert in_child(lambda: queue.put_nowait(node(), b"from the child")) == 17
    assert queue.put_nowait(node(), b"from the parent") == 2


def test_a_child_can_neither_read_nor_wait_and_does_not_hang(queue: RecorderQueue) -> None:
    queue.put_nowait(started(), b"{}")
    limits = {"events_max": 1, "bytes_max": 1, "age_s_max": 0.0}
    assert in_child(lambda: asyncio.run(queue.get_batch(**limits))) == 17  # type: ignore[arg-type]  # int and float
    assert in_child(lambda: asyncio.run(queue.synced_to(1000))) == 17
    assert in_child(lambda: asyncio.run(queue.room())) == 0
    assert in_child(lambda: queue.block_until_room(1000.0)) == 0


def test_the_collector_runs_in_a_child_that_was_forked_while_another_thread_was_recording(spool: Path) -> None:
    recording, forked = threading.Event(), threading.Event()

    def wall_ns() -> int:
        if threading.current_thread() is not threading.main_thread():
            recording.set()
            forked.wait()
        return 0

    queue = make(spool, clock=Clock(wall_ns=wall_ns, monotonic_ns=lambda: 0))
    thread = threading.Thread(target=lambda: queue.put_nowait(started(), b"{}"))
    thread.start()
    recording.wait()
    assert not gc.isenabled()
    status = in_child(lambda: None if gc.isenabled() else os._exit(18))
    forked.set()
    thread.join()
    assert status == 0
    assert gc.isenabled()
    queue.release()


async def test_a_child_that_releases_its_queue_takes_nothing_from_the_parent(queue: RecorderQueue) -> None:
    queue.put_nowait(started(), b"{}")

    def release_folder() -> None:
        queue.close()
        queue.release()

    assert in_child(release_folder) == 0
    assert is_locked(queue.folder / "alive")
    queue.put_nowait(ended(), b"{}")
    queue.close()
    assert await drain(queue) == [record(1, started(), 1, b"{}"), record(2, ended(), 2, b"{}")]


def test_a_child_that_outlives_the_parent_does_not_keep_the_parents_folder_alive(spool: Path) -> None:
    queue = make(spool)
    queue.put_nowait(started(), b"{}")
    begin_read, begin_write = os.pipe()
    child = os.fork()
    if child == 0:
        os.read(begin_read, 1)
        os._exit(0)
    try:
        queue.release()
        assert [each.alive for each in Spool(spool).recorders()] == [False]
        recovered = open_dead(queue.folder)
        assert recovered is not None
        recovered.release()
    finally:
        os.write(begin_write, b"x")
        os.waitpid(child, 0)
        os.close(begin_read)
        os.close(begin_write)


async def test_a_recorder_killed_while_its_child_lives_counts_as_dead(spool: Path) -> None:
    """The recorder is a child of this test and forks a worker that outlives it."""
    done_read, done_write = os.pipe()
    begin_read, begin_write = os.pipe()
    recorder = os.fork()
    if recorder == 0:
        queue = make(spool)
        queue.put_nowait(started(), b"{}")
        if os.fork() == 0:
            os.write(done_write, b"x")
            os.read(begin_read, 1)
            os._exit(0)
        os.read(begin_read, 1)
        os._exit(1)
    os.read(done_read, 1)
    (folder,) = Spool(spool).recorders()
    assert folder.alive
    os.kill(recorder, 9)
    os.waitpid(recorder, 0)  # noqa: ASYNC222  # it was killed
    try:
        assert [each.alive for each in Spool(spool).recorders()] == [False]
        assert await recover(folder.path) == [record(1, started(), 1, b"{}"), lost(2, 1, 2)]
    finally:
        os.write(begin_write, b"xx")
        for descriptor in (done_read, done_write, begin_read, begin_write):
            os.close(descriptor)
