"""`counted` keeps the faults of a recorded episode away from the executive that reports to it."""

from __future__ import annotations

import functools
from collections.abc import Callable
from contextlib import AbstractContextManager
from typing import Any, Concatenate, ParamSpec, Protocol, TypeVar

from pycrorm_async.errors import CallerError
from pycrorm_async.recording.writing.emitter import Emitter

__all__ = ["CountingEpisode", "counted"]

P = ParamSpec("P")
R = TypeVar("R")


class CountingEpisode(Protocol):
    """An episode whose methods never raise."""

    closed: bool

    @property
    def emitter(self) -> Emitter:
        """Counts the faults."""
        ...

    @property
    def lock(self) -> AbstractContextManager[Any]:
        """Makes each call whole; reentrant."""
        ...


E = TypeVar("E", bound=CountingEpisode)


def counted(what: str) -> Callable[[Callable[Concatenate[E, P], R]], Callable[Concatenate[E, P], R | None]]:
    """Run a method under the episode's lock; count what it raises, and a call after the end of the episode."""

    def wrap(method: Callable[Concatenate[E, P], R]) -> Callable[Concatenate[E, P], R | None]:
        @functools.wraps(method)
        def run(self: E, /, *args: P.args, **kwargs: P.kwargs) -> R | None:
            emitter = self.emitter
            if emitter.is_closed:  # before the lock, which another thread may have held when the process forked
                return None
            try:
                with self.lock:
                    if not self.closed:
                        return method(self, *args, **kwargs)
            except Exception as error:  # noqa: BLE001  a fault of the memory must not reach a plan
                emitter.note_fault(what, error)
                return None
            emitter.note_fault(what, CallerError(f"episode {self} has ended"))
            return None

        return run

    return wrap
