"""`OrderedCalls` runs the calls of one episode one after the other, whichever threads make them.

Theory of operation. A thread runs its call under the lock of the episode, so its call has run when it returns. It must
not wait for a lock if it runs a call of any episode already, because the garbage collector, or a method of a key, may
have made the call in the middle of another one, and two episodes could wait for each other: such a call is left in
`_this_thread.left`, and the thread runs it after that other one. A thread of the memory must not wait either, because
the holder of the lock may wait for the room in the spool that this thread makes: it takes the lock only if it is free,
and otherwise leaves the call in `_left` to the holder.

A signal handler may raise KeyboardInterrupt in the main thread when any call returns. `with` on the lock itself cannot
be interrupted between taking the lock and entering the block, nor before the lock is released; `acquire` and `release`
in a `try` can. Only threads of the memory, which run no signal handlers, use these. A handler may also run where a loop
begins its next round, and there Python 3.12 and 3.13 leave the block without releasing the lock, because they take the
jump back for one that cannot raise. So no loop, and no comprehension, is directly in such a block.
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
    """The state of one thread: busy with a call, the calls left to run after it, and if it is one of the memory."""

    def __init__(self) -> None:
        self.is_busy = False
        self.left: deque[tuple[OrderedCalls, Callable[[], object]]] = deque()
        self.is_of_memory = threading.current_thread().name.startswith(THREAD_NAME_PREFIX)


_this_thread = _ThreadState()


def may_wait() -> bool:
    """Return whether this thread may wait for room in the spool: it runs no call, and does not make room itself."""
    return not _this_thread.is_busy and not _this_thread.is_of_memory


class OrderedCalls:
    """The calls of one episode."""

    def __init__(self) -> None:
        self._left: deque[Callable[[], object]] = deque()
        self._lock = threading.Lock()

    def run(self, call: Callable[[], object]) -> None:
        """Run a call, which must not raise, after all earlier ones."""
        thread = _this_thread
        if thread.is_of_memory:
            self._left.append(call)
            self._run_if_free()
            return
        if thread.is_busy:
            thread.left.append((self, call))
            return
        thread.is_busy = True  # followed by `try` without a call, so that Ctrl-C cannot separate the two
        try:
            self._run(call)
            _run_left(thread)
        finally:
            thread.is_busy = False

    def _run(self, call: Callable[[], object]) -> None:
        with self._lock:
            if self._left:
                self._drain()
            call()
        while self._left:  # a thread of the memory came before the lock was released
            with self._lock:
                self._drain()

    def _run_if_free(self) -> None:
        while self._left and self._lock.acquire(blocking=False):
            try:
                self._drain()
            finally:
                self._lock.release()

    def _drain(self) -> None:
        while self._left:
            self._left.popleft()()


def _run_left(thread: _ThreadState) -> None:
    while thread.left:
        calls, each = thread.left.popleft()
        calls._run(each)  # noqa: SLF001  of this module


class CountingEpisode(Protocol):
    """An episode whose methods never raise."""

    @property
    def emitter(self) -> Emitter:
        """Counts the faults."""
        ...


E = TypeVar("E", bound=CountingEpisode)


def counted(event_type: str) -> Callable[[Callable[Concatenate[E, P], R]], Callable[Concatenate[E, P], R | None]]:
    """Count the exceptions of a method; do nothing if the memory is closed or belongs to a parent process."""

    def wrap(method: Callable[Concatenate[E, P], R]) -> Callable[Concatenate[E, P], R | None]:
        @functools.wraps(method)
        def run(self: E, /, *args: P.args, **kwargs: P.kwargs) -> R | None:
            emitter = self.emitter
            if emitter.is_closed:
                return None
            try:
                return method(self, *args, **kwargs)
            except Exception as error:  # noqa: BLE001  a fault of the memory must not reach a plan
                emitter.note_fault(event_type, error)
                return None

        return run

    return wrap


def noted(emitter: Any, event_type: str, read: Callable[P, R], /, *args: P.args, **kwargs: P.kwargs) -> R | None:
    """Call `read` with these arguments and return its result; if it raises, count the exception and return None."""
    try:
        return read(*args, **kwargs)
    except Exception as error:  # noqa: BLE001  the code of an executive's values may raise anything
        emitter.note_fault(event_type, error)
        return None
