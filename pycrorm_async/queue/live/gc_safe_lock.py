"""A lock whose holder is not disturbed: while it is held the garbage collector does not run.

The collector may close a suspended plan in any thread at any allocation, and the plan's `finally` records its end. In a
thread that held the queue's lock at that moment it would wait for itself for ever. A lock that may be taken twice would
be worse: a record inside a half-written one.
"""

from __future__ import annotations

import gc
import threading
from collections.abc import Callable
from typing import TypeVar

from pycrorm_async.errors import InternalError

__all__ = ["GcSafeLock"]

_T = TypeVar("_T")


class GcSafeLock:
    """One lock, and the pause of the collector that belongs to it. `Appender.put` does by itself what `run` does.

    The lock is taken first, then the collector is paused, for two threads that switch it without a lock could leave it
    off, or on in the middle of the other's work. It is one switch for the whole process: another queue, or a program
    that switches it too, may still turn it on in between. Then `owner` is what keeps a thread from waiting for itself.
    """

    __slots__ = ("_held_off", "lock", "owner", "paused")

    def __init__(self) -> None:
        self.lock = threading.Lock()
        self.owner = 0
        self.paused = False
        self._held_off = False

    def run(self, work: Callable[[], _T]) -> _T:
        """Does this alone. Raises `InternalError` inside work of the same thread.

        Not a context manager: a KeyboardInterrupt in an `__enter__` of ours would leave the lock behind, taken.
        """
        me = threading.get_ident()
        if self.owner == me:
            raise self.reentered()
        try:
            with self.lock:
                try:
                    self.owner = me
                    self.paused = gc.isenabled()
                    gc.disable()
                    return work()
                finally:
                    if self.paused:
                        gc.enable()
        finally:
            # Not before the lock is free: letting go of it allocates.
            if self.owner == me:
                self.owner = 0

    def reentered(self) -> InternalError:
        """What is raised instead of waiting for oneself."""
        return InternalError("this thread is recording already: a signal handler or a finalizer cannot record now")

    def hold_off(self) -> None:
        """No collection until `go_on`, though the lock is free: for one thread that takes another lock inside."""
        self.run(self._hold_off)

    def go_on(self) -> None:
        """Undoes `hold_off`; twice is once."""
        self.run(self._go_on)

    def abandon(self) -> None:
        """In a forked child: the thread that would end the pause may not be here."""
        if self._held_off or (self.owner and self.paused):
            gc.enable()

    def _hold_off(self) -> None:
        # Both only while `run` keeps it paused, and so the pause goes from one to the other without a gap.
        self._held_off, self.paused = self.paused, False

    def _go_on(self) -> None:
        self._held_off, self.paused = False, self.paused or self._held_off
