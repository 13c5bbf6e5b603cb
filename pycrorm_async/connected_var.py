"""Extend context variables by a default value for the whole process, for notebooks.

A notebook runs each cell that awaits in its own copy of the context, so a value set in one cell is invisible in the
next. A *connected* value is the default of every context in the process that has no value of its own: later cells,
other tasks and threads. Of several connected values the last one counts; disconnecting it restores the one before.

This is the package's only module state that is not a ContextVar. It keeps a value from `connect` to `disconnect`. While
no value is connected, `get` is the ContextVar's own method and costs the same.
"""

from __future__ import annotations

from collections.abc import Callable, Iterator
from contextlib import contextmanager, suppress
from contextvars import ContextVar, Token
from typing import Any, Generic, TypeVar

T = TypeVar("T")


class ConnectedVar(Generic[T]):
    """A ContextVar whose default is the last connected value.

    Attributes:
        get: the value of this context, else the last connected value, else None.
        here: the value of this context alone.
        set, reset: the methods of the ContextVar.
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
        """Make this value the default of every context without a value of its own."""
        self._connected = (*self._connected, value)
        self.get = self._here_or_connected

    def disconnect(self, value: T) -> None:
        """Remove this value from the defaults, if it is one; a context that has set it keeps it."""
        self._connected = tuple(each for each in self._connected if each is not value)
        if not self._connected:
            self.get = self.here

    def _here_or_connected(self) -> T | None:
        value, connected = self.here(), self._connected
        return connected[-1] if value is None and connected else value


@contextmanager
def set_inside(variable: ConnectedVar[Any] | ContextVar[Any], value: object) -> Iterator[None]:
    """Set the variable inside the `with` block; leaving it in another context resets nothing."""
    before = variable.get()
    token = variable.set(value)
    try:
        yield
    finally:
        # Memories may close in another order than they opened: reset only the value set by this block.
        if variable.get() is value:
            with suppress(ValueError):
                variable.reset(token)
            if getattr(before, "is_closed", False):
                variable.set(None)
