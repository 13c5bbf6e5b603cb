"""Finalizers may record at any moment of a garbage collection, and no thread ever waits for itself."""

import asyncio
import gc
import threading
import time
from collections.abc import Callable, Iterator
from concurrent.futures import Future, ThreadPoolExecutor
from pathlib import Path

import pytest

from pycrorm_async.clock import Clock
from pycrorm_async.errors import InternalError, SpoolFull
from pycrorm_async.queue import RecorderQueue
from pycrorm_async.queue.format import Segment
from pycrorm_async.queue.sync_thread import Notifier
from pycrorm_async.settings import Settings
from tests.queue.factories import DECLARED, MONOTONIC_NS, WALL_NS, drain, make, node, started

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
