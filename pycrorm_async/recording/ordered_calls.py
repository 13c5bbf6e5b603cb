"""`OrderedCalls` runs the calls of one episode one after the other, whichever threads make them.

Theory of operation. Calls queue in `_waiting`, and the holder of the lock runs all of them. A thread that comes while
another holds the lock waits for it, so its call has run when it returns. It must not wait if it holds the lock of any
episode already, because the garbage collector, or a method of a key, may have made the call in the middle of another
one, and two episodes could wait for each other; nor if it is a thread of the memory, because the holder of the lock may
wait for the room in the spool that this thread makes. Such a call is left to the holder of the lock.
"""

from __future__ import annotations

import functools
import threading
from collections import deque
from collections.abc import Callable
from typing import Any, Concatenate, ParamSpec, Protocol, TypeVar

from pycrorm_async.recording.writing.emitter import THREAD_NAME_PREFIX, Emitter

P = ParamSpec("P")
R = TypeVar("R")


class _ThreadState(threading.local):
    """The number of locks that this thread holds or waits for, and whether it is a thread of the memory."""

    def __init__(self) -> None:
        self.depth = 0
        self.is_of_memory = threading.current_thread().name.startswith(THREAD_NAME_PREFIX)


_this_thread = _ThreadState()


class OrderedCalls:
    """The calls of one episode."""

    def __init__(self) -> None:
        self._waiting: deque[Callable[[], object]] = deque()
        self._lock = threading.Lock()

    def run(self, call: Callable[[], object]) -> None:
        """Run a call, which must not raise, after all earlier ones."""
        self._waiting.append(call)
        waits = not _this_thread.depth and not _this_thread.is_of_memory
        _this_thread.depth += 1  # before the lock, so that a call made while it is taken does not wait for it
        try:
            while (waits or self._waiting) and self._lock.acquire(blocking=waits):
                waits = False
                try:
                    while self._waiting:
                        self._waiting.popleft()()
                finally:
                    self._lock.release()
        finally:
            _this_thread.depth -= 1


class CountingEpisode(Protocol):
    """An episode whose methods never raise."""

    @property
    def emitter(self) -> Emitter:
        """Counts the faults."""
        ...


E = TypeVar("E", bound=CountingEpisode)


def counted(what: str) -> Callable[[Callable[Concatenate[E, P], R]], Callable[Concatenate[E, P], R | None]]:
    """Count what a method raises; do nothing if the memory is closed or belongs to a parent process."""

    def wrap(method: Callable[Concatenate[E, P], R]) -> Callable[Concatenate[E, P], R | None]:
        @functools.wraps(method)
        def run(self: E, /, *args: P.args, **kwargs: P.kwargs) -> R | None:
            emitter = self.emitter
            if emitter.is_closed:
                return None
            try:
                return method(self, *args, **kwargs)
            except KeyboardInterrupt:
                raise
            except BaseException as error:  # noqa: BLE001  a fault of the memory must not reach a plan
                emitter.note_fault(what, error)
                return None

        return run

    return wrap


def noted(emitter: Any, what: str, read: Callable[P, R], /, *args: P.args, **kwargs: P.kwargs) -> R | None:
    """Return what `read` returns for these arguments; count what it raises and return None."""
    try:
        return read(*args, **kwargs)
    except KeyboardInterrupt:
        raise
    except BaseException as error:  # noqa: BLE001  the code of an executive's values may raise anything
        emitter.note_fault(what, error)
        return None
