"""Context variables with a value of the whole process behind them, for notebooks.

Each cell of a notebook that awaits runs in a copy of the context of its own, so what one cell sets no other finds. What
is *connected* is found by every context of the process that has no value of its own: by the cells that follow, by other
tasks, and by threads. If several are connected, the last one is found; where it is disconnected, the one before.

This is the only state of a module that is no ContextVar. It holds what its owner connects until the owner disconnects
it, and nothing else. While nothing is connected, `get` is that of the ContextVar itself and costs the same.
"""

from __future__ import annotations

from collections.abc import Callable, Iterator
from contextlib import contextmanager, suppress
from contextvars import ContextVar, Token
from typing import Any, Generic, TypeVar

__all__ = ["ConnectedVar", "set_inside"]

T = TypeVar("T")


class ConnectedVar(Generic[T]):
    """A ContextVar whose default is what was connected last.

    Attributes:
        get: the value of this context, or else what was connected last, or else None.
        here: the value of this context alone.
        set, reset: as of a ContextVar.
    """

    __slots__ = ("_connected", "get", "here", "reset", "set")

    def __init__(self, name: str) -> None:
        variable: ContextVar[T | None] = ContextVar(name, default=None)
        self._connected: tuple[T, ...] = ()
        self.here: Callable[[], T | None] = variable.get
        self.get: Callable[[], T | None] = variable.get
        self.set: Callable[[T | None], Token[T | None]] = variable.set
        self.reset: Callable[[Token[T | None]], None] = variable.reset

    def connect(self, value: T) -> None:
        """Every context without a value of its own finds this one from now on."""
        self._connected = (*self._connected, value)
        self.get = self._here_or_connected

    def disconnect(self, value: T) -> None:
        """No context finds it any more, unless it is its own. Does nothing for what is not connected."""
        self._connected = tuple(each for each in self._connected if each is not value)
        if not self._connected:
            self.get = self.here

    def _here_or_connected(self) -> T | None:
        value, connected = self.here(), self._connected
        return connected[-1] if value is None and connected else value


@contextmanager
def set_inside(variable: ConnectedVar[Any] | ContextVar[Any], value: object) -> Iterator[None]:
    """The variable has this value inside. Left in another context than entered in, there is nothing of ours to undo."""
    before = variable.get()
    token = variable.set(value)
    try:
        yield
    finally:
        # Memories may be closed in another order than they were opened: only what we set is taken back.
        if variable.get() is value:
            with suppress(ValueError):
                variable.reset(token)
            if getattr(before, "over", False):
                variable.set(None)
