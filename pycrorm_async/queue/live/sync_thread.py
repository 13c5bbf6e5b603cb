"""The background thread of a live queue: when it takes its turns, and nothing about what a turn does.

It sleeps while nobody has work for it. The first record after a turn wakes it, and it lets further ones gather for the
sync interval, so that they share one sync; whoever waits for the disk calls `hurry` and the turn begins at once. A turn
may ask for another one by itself; of several calls the earliest counts.

It is woken through a `SimpleQueue` and not an `Event`: a KeyboardInterrupt in the middle of `Event.set` leaves a lock
behind that nobody will ever open, and the plan's next event would hang.
"""

from __future__ import annotations

import threading
from collections.abc import Callable
from contextlib import suppress
from queue import Empty, SimpleQueue

from pycrorm_async.clock import monotonic_ns

__all__ = ["SyncThread"]


class SyncThread:
    """Takes turns until stopped; a last one after that. `turn` says in how many seconds it wants another, or None."""

    def __init__(self, *, name: str, interval_s: float, turn: Callable[[], float | None]) -> None:
        self._interval_s = interval_s
        self._turn = turn
        self._calls: SimpleQueue[float] = SimpleQueue()  # how long further work may gather
        self._stopping = False
        self._thread = threading.Thread(target=self._run, name=f"pycrorm sync {name}", daemon=True)

    def start(self) -> None:
        self._thread.start()

    @property
    def is_this_thread(self) -> bool:
        """Whether the caller runs in it: what the collector closes there must not wait for what only it does."""
        return threading.current_thread() is self._thread

    def wake(self) -> None:
        """There is work: a turn begins within the interval. From any thread, at any moment."""
        self._calls.put(self._interval_s)

    def call_in(self, seconds: float) -> None:
        """There may be work by then."""
        self._calls.put(seconds)

    def hurry(self) -> None:
        """There is work and somebody waits for it: a turn begins at once, or after the one that runs now."""
        self._calls.put(0.0)

    def stop(self, *, timeout_s: float) -> bool:
        """Takes the last turn and ends the thread; False if it has not ended in time."""
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
        """Waits for a call and then as long as it allows, or a later one: the turn is for all who have called."""
        due_ns = self._due_ns(self._calls.get())
        with suppress(Empty):
            while (left_ns := due_ns - monotonic_ns()) > 0:
                due_ns = min(due_ns, self._due_ns(self._calls.get(timeout=left_ns / 1e9)))
            while True:
                self._calls.get_nowait()

    def _due_ns(self, gather_s: float) -> int:
        return monotonic_ns() + round(gather_s * 1e9)
