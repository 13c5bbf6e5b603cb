"""Locks have one holder at a time, finalizers never wait for themselves, and forked children release nothing."""

import asyncio
import gc
import os
import signal
import subprocess
import sys
import threading
import time
from collections.abc import Callable, Iterator
from concurrent.futures import Future, ThreadPoolExecutor
from pathlib import Path

import pytest

from pycrorm_async.clock import Clock
from pycrorm_async.errors import InternalError, SpoolClosed, SpoolFull
from pycrorm_async.queue import RecorderQueue, Spool
from pycrorm_async.queue.format import Segment
from pycrorm_async.queue.locks import FileLock, is_locked
from pycrorm_async.queue.sync_thread import Notifier
from pycrorm_async.settings import Settings
from tests.queue.factories import (
    DECLARED,
    MONOTONIC_NS,
    WALL_NS,
    drain,
    ended,
    lost,
    make,
    node,
    record,
    recover,
    started,
)

# === locks ====================================================================================================
#
# File locks: one holder at a time, released when the holder dies, and never held by a forked child.


def test_a_lock_has_one_holder_and_can_be_taken_after_its_release(tmp_path: Path) -> None:
    path = tmp_path / "alive"
    assert is_locked(path) is False
    first = FileLock.take(path)
    assert first is not None
    assert is_locked(path) is True
    assert FileLock.take(path) is None
    first.release()
    first.release()
    assert is_locked(path) is False
    second = FileLock.take(path, create=False)
    assert second is not None
    second.release()


def test_the_kernel_releases_the_lock_of_a_killed_holder(tmp_path: Path) -> None:
    path = tmp_path / "alive"
    program = (
        "import sys, pathlib; from pycrorm_async.queue.locks import FileLock;"
        "lock = FileLock.take(pathlib.Path(sys.argv[1])); print('held', flush=True); sys.stdin.read()"
    )
    holder = subprocess.Popen([sys.executable, "-c", program, str(path)], stdin=subprocess.PIPE, stdout=subprocess.PIPE)
    with holder:
        assert holder.stdout is not None
        assert holder.stdout.readline() == b"held\n"
        assert is_locked(path) is True
        holder.send_signal(signal.SIGSTOP)
        assert FileLock.take(path) is None
        holder.kill()
        holder.wait()
    assert is_locked(path) is False


@pytest.mark.filterwarnings("ignore:.*fork.*:DeprecationWarning")
def test_a_forked_child_neither_keeps_nor_releases_a_lock(tmp_path: Path) -> None:
    path = tmp_path / "alive"
    lock = FileLock.take(path)
    assert lock is not None
    begin_read, begin_write = os.pipe()
    child = os.fork()
    if child == 0:
        lock.release()  # already closed: the child must not unlock what the parent holds
        os.read(begin_read, 1)
        os._exit(0)
    try:
        assert is_locked(path) is True
        lock.release()
        assert is_locked(path) is False
    finally:
        os.write(begin_write, b"x")
        os.waitpid(child, 0)
        os.close(begin_read)
        os.close(begin_write)


def test_a_lock_whose_file_was_deleted_meanwhile_is_not_taken(tmp_path: Path) -> None:
    """Between open and lock the previous holder may delete the file, so that the lock would protect nothing."""
    path = tmp_path / "alive"
    held = FileLock.take(path)
    assert held is not None
    path.unlink()
    assert FileLock.take(path, create=False) is None
    again = FileLock.take(path)
    assert again is not None
    held.release()
    assert is_locked(path) is True
    again.release()


# === fork =====================================================================================================
#
# Forked children: they can neither write to the parent's files nor keep or release its locks.


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


@pytest.mark.filterwarnings("ignore:.*fork.*:DeprecationWarning")
def test_a_child_cannot_put(queue: RecorderQueue) -> None:
    queue.put_nowait(started(), b"{}")
    assert in_child(lambda: queue.put_nowait(node(), b"from the child")) == 17
    assert queue.put_nowait(node(), b"from the parent") == 2


@pytest.mark.filterwarnings("ignore:.*fork.*:DeprecationWarning")
def test_a_child_can_neither_read_nor_wait_and_does_not_hang(queue: RecorderQueue) -> None:
    queue.put_nowait(started(), b"{}")
    limits = {"events_max": 1, "bytes_max": 1, "age_s_max": 0.0}
    assert in_child(lambda: asyncio.run(queue.get_batch(**limits))) == 17  # type: ignore[arg-type]  # int and float
    assert in_child(lambda: asyncio.run(queue.synced_to(1000))) == 17
    assert in_child(lambda: asyncio.run(queue.room())) == 0
    assert in_child(lambda: queue.block_until_room(1000.0)) == 0


@pytest.mark.filterwarnings("ignore:.*fork.*:DeprecationWarning")
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


@pytest.mark.filterwarnings("ignore:.*fork.*:DeprecationWarning")
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


@pytest.mark.filterwarnings("ignore:.*fork.*:DeprecationWarning")
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


# === gc safe lock =============================================================================================
#
# Finalizers may record at any moment of a garbage collection, and no thread ever waits for itself.

PATIENCE_S = 20.0


class Dropped:
    """A plan in a reference cycle: the collector closes it, which calls a function and leaves `again` further ones."""

    def __init__(self, at_its_end: Callable[[], object], again: int = 0) -> None:
        self.itself = self
        self.at_its_end = at_its_end
        self.again = again

    def __del__(self) -> None:
        self.at_its_end()
        if self.again:
            Dropped(self.at_its_end, self.again - 1)


class ClockWithHook:
    """A frozen clock that calls a function when a queue reads it in the middle of its work."""

    def __init__(self) -> None:
        self.meanwhile: Callable[[], object] = lambda: None

    def __call__(self) -> int:
        meanwhile, self.meanwhile = self.meanwhile, lambda: None
        meanwhile()
        return WALL_NS

    @property
    def clock(self) -> Clock:
        return Clock(wall_ns=self, monotonic_ns=lambda: MONOTONIC_NS)


@pytest.fixture
def busy_collector() -> Iterator[None]:
    """Make the collector run at nearly every allocation."""
    before = gc.get_threshold()
    gc.collect()
    gc.set_threshold(1)
    yield
    gc.set_threshold(*before)


def finishes(work: Callable[[], object]) -> bool:
    """Return whether the work ends in a thread of its own."""
    thread = threading.Thread(target=work, daemon=True)
    thread.start()
    thread.join(PATIENCE_S)
    return not thread.is_alive()


def leave_garbage(queue: RecorderQueue, count: int, *, payload: bytes = b"from a plan that was dropped") -> None:
    Dropped(lambda: queue.put_nowait(node(), payload, reserved=True), again=count - 1)
    assert [[] for _ in range(10)]  # objects that the collector counts


@pytest.mark.slow
@pytest.mark.usefixtures("busy_collector")
async def test_a_finalizer_that_runs_during_a_put_records_after_it(tmp_path: Path) -> None:
    hooked = ClockWithHook()
    queue = make(tmp_path, clock=hooked.clock)
    queue.put_nowait(started(), b"{}")

    def put() -> None:
        hooked.meanwhile = lambda: leave_garbage(queue, 3)
        queue.put_nowait(node(), b"written")

    assert finishes(put)
    gc.collect()
    gc.collect()
    gc.collect()
    queue.close()
    records = await drain(queue)
    assert [each.sequence for each in records] == [1, 2, 3, 4, 5]
    assert [each.payload for each in records] == [b"{}", b"written", *[b"from a plan that was dropped"] * 3]
    queue.release()


@pytest.mark.usefixtures("busy_collector")
def test_every_finalizer_between_puts_records_whenever_its_collection_becomes_due(tmp_path: Path) -> None:
    """From Python 3.12 on a due collection runs at the next call, also when the put has taken the lock meanwhile."""
    queue = make(tmp_path, settings=Settings())
    queue.put_nowait(started(), b"{}")
    sequences: list[int] = []

    def work() -> None:
        for _ in range(500):
            Dropped(lambda: sequences.append(queue.put_nowait(node(), b"from a plan", reserved=True)))
            queue.put_nowait(node(), b"x")

    assert finishes(work)
    gc.collect()
    assert len(set(sequences)) == len(sequences) == 500
    assert gc.isenabled()
    queue.close()
    queue.release()


@pytest.mark.slow
@pytest.mark.usefixtures("busy_collector")
async def test_a_finalizer_that_runs_in_the_sync_thread_does_not_stop_it(tmp_path: Path) -> None:
    hooked = ClockWithHook()
    queue = make(tmp_path, clock=hooked.clock)
    queue.put_nowait(started(), b"{}")
    await asyncio.wait_for(queue.synced_to(), PATIENCE_S)
    at: list[str] = []

    def meanwhile() -> None:
        at.append(threading.current_thread().name)
        leave_garbage(queue, 3)

    def when_a_commit_is_written() -> None:
        hooked.meanwhile = meanwhile

    hooked.meanwhile = when_a_commit_is_written
    queue.put_nowait(node(), b"written")
    await asyncio.wait_for(queue.synced_to(), PATIENCE_S)
    assert at == [f"pycrorm sync {queue.name}"]
    gc.collect()
    assert finishes(lambda: queue.put_nowait(node(), b"after"))
    queue.release()


@pytest.mark.usefixtures("busy_collector")
async def test_a_finalizer_that_runs_during_the_creation_of_a_segment_may_need_that_segment(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    queue = make(tmp_path)
    queue.put_nowait(started(), b"{}")
    allocate = Segment.allocate
    reentered: list[int] = []
    third = threading.Event()

    def watched(folder: Path, *, number: int, size: int) -> Segment:
        if not reentered:
            leave_garbage(queue, 6, payload=b"x" * 900)  # more than one segment holds
        reentered.append(number)
        segment = allocate(folder, number=number, size=size)
        if number == 3:
            third.set()
        return segment

    monkeypatch.setattr(Segment, "allocate", watched)
    assert finishes(lambda: [queue.put_nowait(node(), b"x" * 900) for _ in range(4)])
    assert await asyncio.to_thread(third.wait, PATIENCE_S)
    monkeypatch.undo()
    assert finishes(lambda: queue.put_nowait(node(), b"after"))
    assert await asyncio.to_thread(finishes, queue.release)


@pytest.mark.usefixtures("busy_collector")
def test_a_finalizer_that_runs_during_a_notification_may_wait_for_it() -> None:
    bell = Notifier()
    waits: list[bool] = []

    def work() -> None:
        Dropped(lambda: waits.append(bell.block_until(lambda: True, remaining_s=lambda: 0.0)), again=30)
        for _ in range(30):
            bell.notify_all()
            bell.block_until(lambda: True, remaining_s=lambda: 0.0)

    assert finishes(work)
    assert waits


def test_of_two_concurrent_notifications_one_wakes_the_waiter_and_neither_fails() -> None:
    notifier, both_have_copied = Notifier(), threading.Barrier(2)

    class Tickets(set[Future[None]]):
        """Hold each thread after its copy of the tickets until the other thread has one too."""

        def __iter__(self) -> Iterator[Future[None]]:
            copy = list(super().__iter__())
            both_have_copied.wait(PATIENCE_S)
            return iter(copy)

    notifier._tickets = Tickets()
    answers = iter([False, True])
    with ThreadPoolExecutor(3) as threads:
        woken = threads.submit(notifier.block_until, lambda: next(answers), remaining_s=lambda: PATIENCE_S)
        while not notifier.awaited:
            time.sleep(0.001)
        for each in [threads.submit(notifier.notify_all) for _ in range(2)]:
            each.result(PATIENCE_S)
        assert woken.result(PATIENCE_S)
    assert not notifier.awaited


@pytest.mark.parametrize("running", [True, False])
async def test_the_collector_keeps_the_state_in_which_it_was(tmp_path: Path, running: bool) -> None:
    if not running:
        gc.disable()
    try:
        queue = make(tmp_path)
        queue.put_nowait(started(), b"{}")
        with pytest.raises(SpoolFull):
            while True:
                queue.put_nowait(node(), b"x" * 900)
        await queue.synced_to()
        assert queue.bytes_spooled > 0
        queue.release()
        assert gc.isenabled() is running
    finally:
        gc.enable()


async def test_a_record_inside_a_record_is_refused_and_both_threads_continue(tmp_path: Path) -> None:
    hooked = ClockWithHook()
    queue = make(tmp_path, clock=hooked.clock)
    queue.put_nowait(started(), b"{}")

    def as_a_signal_handler() -> None:
        with pytest.raises(InternalError, match="this thread is recording already"):
            queue.put_nowait(DECLARED, b"inside")
        with pytest.raises(InternalError, match="this thread is recording already"):
            queue.close()

    def put() -> None:
        hooked.meanwhile = as_a_signal_handler
        assert queue.put_nowait(node(), b"outside") == 2

    assert finishes(put)
    assert queue.put_nowait(node(), b"after") == 3
    queue.close()
    assert [each.payload for each in await drain(queue)] == [b"{}", b"outside", b"after"]
    queue.release()


async def test_the_sync_thread_never_waits_for_the_space_that_it_frees(tmp_path: Path) -> None:
    hooked = ClockWithHook()
    queue = make(tmp_path, clock=hooked.clock)
    queue.put_nowait(started(), b"{}")
    with pytest.raises(SpoolFull):
        while True:
            queue.put_nowait(node(), b"x" * 900, reserved=True)
    await queue.synced_to()
    answers: list[bool] = []

    def when_a_commit_is_written() -> None:
        hooked.meanwhile = lambda: answers.append(queue.block_until_room(1000.0))

    hooked.meanwhile = when_a_commit_is_written
    queue.put_nowait(node(), b"", reserved=True)
    await asyncio.wait_for(queue.synced_to(), PATIENCE_S)
    assert answers == [False]
    queue.release()
