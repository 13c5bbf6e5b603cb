"""Provide a lock that disables garbage collection while held, so that a finalizer cannot try to acquire it again.

**Theory of operation.** The garbage collector may run at any allocation, from Python 3.12 on at the first call after
it, in any thread, and close a suspended plan there; the plan's `finally` records its end. In a thread that holds the
queue's lock, this put would write a record inside a half-written one. So the lock's holder disables the collector.

The thread takes the lock first and disables the collector second. In the other order two threads could interleave,
and leave the collector off for ever, or on while one of them holds the lock. `paused` records whether this lock's
holder turned the collector off; only the holder reads or writes it.

A collection that became due before may still run until `gc.disable` has returned, and the next one as soon as
`gc.enable` has. Nothing is half-written at these moments, so the lock is reentrant: a put from a finalizer is done
there, inside the other one. It leaves `paused` as it needs it itself, so the outer put assigns it once more.

The `owner` of the protected object is set while a record may be half-written. The collector is one switch for the whole
process, so another queue or the program itself may turn it on meanwhile, and a signal handler may run at any time. A
thread that meets its own id raises `InternalError`. Other threads may read a stale `owner`, but never their own id. The
compiled core appends without this lock, in one step that no thread, finalizer or handler interrupts, and not while
`owner` is set: so it never meets a half-written record, and never makes one.

`pause_gc` extends the pause beyond the lock, for a thread that takes a second lock which a put may need too
(`Appender._making`). It hands the pause from `paused` to `_pause_extended` under the lock, so there is no moment in
between at which the collector is on; `resume_gc` hands it back.
"""

import gc
import threading
from collections.abc import Callable
from functools import partial, wraps
from typing import Concatenate, ParamSpec, Protocol, TypeVar, cast

from pycrorm_async.errors import InternalError

_T = TypeVar("_T")


class Owned(Protocol):
    """An object whose state a lock protects. `owner` is the id of the thread that changes it now, or 0."""

    owner: int


class GcSafeLock:
    """A lock and the pause of the garbage collector that belongs to it. `Appender.put` inlines `run` for speed."""

    __slots__ = ("_guarded", "_pause_extended", "lock", "paused")

    def __init__(self, guarded: Owned) -> None:
        self._guarded = guarded
        self.lock = threading.RLock()
        self.paused = False
        self._pause_extended = False

    def run(self, work: Callable[[], _T]) -> _T:
        """Do the work under the lock. Raises `InternalError` if this thread is doing such work already.

        Not a context manager, because a KeyboardInterrupt in our `__enter__` would leave the lock taken.
        """
        guarded, thread = self._guarded, threading.get_ident()
        if guarded.owner == thread:
            raise self.reentered()
        with self.lock:
            try:
                self.paused = paused = gc.isenabled()
                gc.disable()
                self.paused, guarded.owner = paused, thread
                return work()
            finally:
                guarded.owner = 0
                if self.paused:
                    self.paused = False
                    gc.enable()

    def reentered(self) -> InternalError:
        """Return the error for a thread that would wait for itself."""
        return InternalError("this thread is recording already: a signal handler or a finalizer cannot record now")

    def pause_gc(self) -> None:
        """Disable the collector until `resume_gc`, without the lock; for one thread that takes another lock inside."""
        self.run(self._pause_gc)

    def resume_gc(self) -> None:
        """Undo `pause_gc`. Idempotent."""
        self.run(self._resume_gc)

    def abandon(self) -> None:
        """Enable the collector in a forked child, which may lack the thread that would end the pause."""
        if self._pause_extended or self.paused:
            gc.enable()

    def _pause_gc(self) -> None:
        # `run` keeps the collector off here, so handing over the pause leaves no gap.
        self._pause_extended, self.paused = self.paused, False

    def _resume_gc(self) -> None:
        self._pause_extended, self.paused = False, self.paused or self._pause_extended


class _Guarded(Protocol):
    _gc_lock: GcSafeLock


_Self = TypeVar("_Self", bound=_Guarded)
_P = ParamSpec("_P")


def locked(method: Callable[Concatenate[_Self, _P], _T]) -> Callable[Concatenate[_Self, _P], _T]:
    """Run the method under its object's `_gc_lock`, which `GcSafeLock.run` takes."""

    @wraps(method)
    def run(self: _Self, *args: _P.args, **kwargs: _P.kwargs) -> _T:
        return self._gc_lock.run(partial(method, self, *args, **kwargs))

    return cast("Callable[Concatenate[_Self, _P], _T]", run)
