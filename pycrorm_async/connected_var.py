"""Extend context variables by a default value for the whole process, and by values that are made when they are read.

A notebook runs each cell that awaits in its own copy of the context, so a value set in one cell is invisible in the
next. A *connected* value is the default of every context in the process that has no value of its own: later cells,
other tasks and threads. Of several connected values the last one counts; disconnecting it restores the one before.

A memory reaches plans and worlds by the four variables at the end of this module. A program that records another
executive loads neither plans nor worlds: there a memory sets a `Late` value, which loads what it needs when a plan or a
world first reads the variable.

This is the package's only module state that is not a ContextVar. It keeps a value from `connect` to `disconnect`. While
no value is connected and none was late, `get` is the ContextVar's own method and costs the same.
"""

from collections.abc import Callable, Iterator
from contextlib import contextmanager, suppress
from contextvars import ContextVar, Token
from typing import Any, Final, Generic, TypeVar

T = TypeVar("T")


class Late(Generic[T]):
    """A value of a `ConnectedVar` that is made when it is first read.

    Args:
        make: returns the value, the same one at each call, from any thread.
        is_closed: returns whether the value is closed, without making it.
    """

    __slots__ = ("_is_closed", "make")

    def __init__(self, make: Callable[[], T], is_closed: Callable[[], bool]) -> None:
        self.make = make
        self._is_closed = is_closed

    @property
    def is_closed(self) -> bool:
        """True once the value is closed."""
        return self._is_closed()


class ConnectedVar(Generic[T]):
    """A ContextVar whose default is the last connected value.

    Attributes:
        get: the value of this context, else the last connected value, else None.
        here: the value of this context alone.
        stored: the value of this context alone, as it was set: a late one is not made.
        reset: the method of the ContextVar.
    """

    __slots__ = ("_connected", "_set", "get", "here", "reset", "stored")

    def __init__(self, name: str) -> None:
        variable: ContextVar[T | Late[T] | None] = ContextVar(name, default=None)
        self._connected: tuple[T | Late[T], ...] = ()
        self._set = variable.set
        self.stored: Callable[[], T | Late[T] | None] = variable.get
        self.here: Callable[[], T | None] = self.stored  # type: ignore[assignment]  # no late value was set
        self.get: Callable[[], T | None] = self.here
        self.reset: Callable[[Token[T | Late[T] | None]], None] = variable.reset

    def set(self, value: T | Late[T] | None) -> Token[T | Late[T] | None]:
        """Set the value of this context, as the method of the ContextVar does."""
        self._expect(value)
        return self._set(value)

    def connect(self, value: T | Late[T]) -> None:
        """Make this value the default of every context without a value of its own."""
        self._expect(value)
        self._connected = (*self._connected, value)
        self.get = self._here_or_connected

    def disconnect(self, value: T | Late[T]) -> None:
        """Remove this value from the defaults, if it is one; a context that has set it keeps it."""
        self._connected = tuple(each for each in self._connected if each is not value)
        if not self._connected:
            self.get = self.here

    def _expect(self, value: T | Late[T] | None) -> None:
        """Make late values from now on where they are read, which takes 0.1 µs longer."""
        if isinstance(value, Late) and self.here is self.stored:
            self.here = lambda: _made(self.stored())
            if not self._connected:
                self.get = self.here

    def _here_or_connected(self) -> T | None:
        value, connected = self.here(), self._connected
        return _made(connected[-1]) if value is None and connected else value


def _made(value: T | Late[T] | None) -> T | None:
    return value.make() if isinstance(value, Late) else value


@contextmanager
def set_inside(variable: ConnectedVar[Any] | ContextVar[Any], value: object) -> Iterator[None]:
    """Set the variable inside the `with` block; leaving it in another context resets nothing."""
    stored = variable.stored if isinstance(variable, ConnectedVar) else variable.get
    before = stored()
    token = variable.set(value)
    try:
        yield
    finally:
        # Memories may close in another order than they opened: reset only the value set by this block.
        if stored() is value:
            with suppress(ValueError):
                variable.reset(token)
            if getattr(before, "is_closed", False):
                variable.set(None)


plan_observer: Final[ConnectedVar[Any]] = ConnectedVar("recorder")
"""The `PlanObserver` of the current context; `plan.execution.recorder` is the same variable."""
called_performs: Final[ConnectedVar[Any]] = ConnectedVar("called_performs")
"""The `CalledPerforms` of the current context, see `plan.execution.called_performs`."""
experience: Final[ConnectedVar[Any]] = ConnectedVar("experience")
"""The `Experience` of the current context, see `plan.task.experience`."""
world_watcher: Final[ConnectedVar[Any]] = ConnectedVar("watcher")
"""The `WorldWatcher` of the current context; `world.bullet.watcher` is the same variable."""
