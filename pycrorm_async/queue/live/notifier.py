"""Wake coroutines of any loop, and blocked threads, that wait for a change of shared state.

**Theory of operation.** A waiter puts a ticket (a future) into the set, then tests its condition, and only then waits
for the ticket. A notifier first changes the state and then completes the tickets. So a change between the waiter's test
and its wait completes the ticket, and no change is missed.

The notifier uses no lock, because a finalizer or a signal handler could run in the thread that holds it and wait for
itself (`gc_safe_lock.py`). Each operation on the set is atomic under the interpreter lock: `notify_all` iterates over a
copy and removes each ticket before completing it, so of two concurrent calls only one completes a ticket, and a waiter
that leaves at the same moment discards its ticket without harm. `set_running_or_notify_cancel` skips a ticket that its
waiter has cancelled.
"""

from __future__ import annotations

import asyncio
from collections.abc import Callable
from concurrent.futures import CancelledError, Future
from concurrent.futures import TimeoutError as NotInTime


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
