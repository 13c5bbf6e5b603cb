"""Run the background thread of a live queue: decide when a turn begins; `QueueFiles` has its steps.

**Theory of operation.** The thread sleeps in `_calls.get` while it has no work. A call puts a delay in seconds into
`_calls`: `wake` the sync interval, so that further records gather and share one sync; `hurry` zero, for a waiter;
`call_in` any other. The turn begins at the earliest time that any call asked for. Before the turn the thread empties
`_calls`, because the turn serves all of them; a call during the turn leads to another one. A turn may itself return the
delay until the next. After `stop` the thread takes a last turn and ends.

Calls go through a `SimpleQueue` and not an `Event`, because a KeyboardInterrupt inside `Event.set` can leave its lock
taken for ever, and the plan's next event would hang. `SimpleQueue.put` is reentrant and holds no Python lock, so a
producer may call it under the queue's lock, and so may a finalizer.
"""

import asyncio
import threading
from collections.abc import Callable
from concurrent.futures import CancelledError, Future
from concurrent.futures import TimeoutError as NotInTime
from contextlib import suppress
from functools import partial
from queue import Empty, SimpleQueue
from typing import Final

from pycrorm_async.clock import monotonic_ns


class SyncThread:
    """Takes turns until stopped. `turn` returns the seconds until it wants the next turn, or None."""

    def __init__(self, *, name: str, interval_s: float, turn: Callable[[], float | None]) -> None:
        self._turn = turn
        self._calls: SimpleQueue[float] = SimpleQueue()  # seconds for which further work may gather
        self.wake: Final[Callable[[], None]] = partial(self._calls.put, interval_s)
        """Request a turn within the sync interval. From any thread, at any time; runs no Python, so it is never
        interrupted."""
        self._stopping = False
        self._thread = threading.Thread(target=self._run, name=f"pycrorm sync {name}", daemon=True)

    def start(self) -> None:
        self._thread.start()

    @property
    def is_this_thread(self) -> bool:
        """True if the caller runs in this thread; a finalizer here must not wait for this thread's own work."""
        return threading.current_thread() is self._thread

    def call_in(self, seconds: float) -> None:
        """Request a turn within this many seconds."""
        self._calls.put(seconds)

    def hurry(self) -> None:
        """Request a turn at once, or right after the current one."""
        self._calls.put(0.0)

    def stop(self, *, timeout_s: float) -> bool:
        """Take the last turn and end the thread; False if it has not ended in time."""
        self._stopping = True
        self.hurry()
        self._thread.join(timeout_s)
        return not self._thread.is_alive()

    def _run(self) -> None:
        while not self._stopping:
            self._gather()
            again_s = self._turn()
            if again_s is not None:
                self.call_in(again_s)
        self._turn()

    def _gather(self) -> None:
        """Wait for a call and then until the earliest due time; remove all calls, because the next turn serves them."""
        due_ns = self._due_ns(self._calls.get())
        with suppress(Empty):
            while (left_ns := due_ns - monotonic_ns()) > 0:
                due_ns = min(due_ns, self._due_ns(self._calls.get(timeout=left_ns / 1e9)))
            while True:
                self._calls.get_nowait()

    def _due_ns(self, gather_s: float) -> int:
        return monotonic_ns() + round(gather_s * 1e9)


# === notifier =================================================================================================
#
# Wake coroutines of any loop, and blocked threads, that wait for a change of shared state.
#
# **Theory of operation.** A waiter puts a ticket (a future) into the set, then tests its condition, and only then waits
# for the ticket. A notifier first changes the state and then completes the tickets. So a change between the waiter's
# test and its wait completes the ticket, and no change is missed.
#
# The notifier uses no lock, because a finalizer or a signal handler could run in the thread that holds it and wait for
# itself (`appender.py`). Each operation on the set is atomic under the interpreter lock: `notify_all` iterates over a
# copy and removes each ticket before completing it, so of two concurrent calls only one completes a ticket, and a
# waiter that leaves at the same moment discards its ticket without harm. `set_running_or_notify_cancel` skips a ticket
# that its waiter has cancelled.


class Notifier:
    """Wakes all coroutines and threads that wait at the time of the call."""

    def __init__(self) -> None:
        self._tickets: set[Future[None]] = set()

    def notify_all(self) -> None:
        """Wake all waiters. From any thread."""
        for ticket in list(self._tickets):
            try:
                self._tickets.remove(ticket)
            except KeyError:  # another call completed it, or its waiter has left
                continue
            if ticket.set_running_or_notify_cancel():
                ticket.set_result(None)

    @property
    def awaited(self) -> bool:
        """True if a coroutine or a thread waits now."""
        return bool(self._tickets)

    async def until(self, reached: Callable[[], bool]) -> None:
        """Wait until `reached` returns true; calls it now and after every notification, in the caller's loop."""
        while True:
            ticket = self._ticket()
            try:
                if reached():
                    return
                await asyncio.wrap_future(ticket)
            finally:
                self._forget(ticket)

    def block_until(self, reached: Callable[[], bool], *, remaining_s: Callable[[], float]) -> bool:
        """Block this thread until `reached` returns true; return False when no time remains."""
        while True:
            ticket = self._ticket()
            try:
                if reached():
                    return True
                ticket.result(max(0.0, remaining_s()))
            except (NotInTime, CancelledError):
                return reached()
            finally:
                self._forget(ticket)

    def _ticket(self) -> Future[None]:
        ticket: Future[None] = Future()
        self._tickets.add(ticket)
        return ticket

    def _forget(self, ticket: Future[None]) -> None:
        self._tickets.discard(ticket)
