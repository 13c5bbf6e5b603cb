"""Ctrl-C, or SIGTERM, while a plan runs, and while what it recorded is being stored."""

from __future__ import annotations

import asyncio
import os
import signal
from collections.abc import Iterator
from contextlib import contextmanager
from types import FrameType

from pycrorm_async.cli.output import note, write_last

__all__ = ["Interrupting"]

_SAY_S = 1.0
_PATIENCE = 2
"""A plan that is interrupted may have to wait for room to say so, or to be broken off."""


class Interrupting:
    """Once ends the plan, as asyncio does; then what it recorded is stored. Once more leaves at once.

    To be used in the loop's own thread. Nothing is lost by leaving: what is not in the database is in the spool.
    With a `patience` of 1 there is no plan to break off: what is asked for the second time is to leave.
    """

    def __init__(self, *, patience: int = _PATIENCE) -> None:
        self._patience = patience
        self._count = 0
        self._storing = False

    @contextmanager
    def heeded(self) -> Iterator[None]:
        """While the plan runs, and after it."""
        task, loop = asyncio.current_task(), asyncio.get_running_loop()
        assert task is not None

        def told(_number: int, _frame: FrameType | None) -> None:
            self._count += 1
            if self._storing or self._count > self._patience:
                write_last("interrupted; what is not stored yet is safe in the spool, and the next start brings it in")
                os._exit(130)
            if self._count > 1:  # a plan that never suspends, or does not let itself be cancelled
                raise KeyboardInterrupt
            task.cancel()
            loop.call_soon_threadsafe(self.ended if self._patience == 1 else lambda: None)  # it may be asleep

        before = {number: signal.getsignal(number) for number in (signal.SIGINT, signal.SIGTERM)}
        ours = [number for number, handler in before.items() if _is_nobodys(handler)]
        for number in ours:
            signal.signal(number, told)
        try:
            yield
        except asyncio.CancelledError:
            if self._count:
                raise KeyboardInterrupt from None
            raise
        finally:
            for number in ours:
                signal.signal(number, before[number])

    @property
    def asked(self) -> bool:
        """Whether somebody asked the plan to end."""
        return self._count > 0

    def ended(self) -> None:
        """The plan is over: from now on there is only storing to interrupt."""
        if self._count:
            asyncio.get_running_loop().call_later(
                _SAY_S, note, "what was recorded is being stored. Ctrl-C again leaves at once, and loses nothing"
            )
        self._storing = True


def _is_nobodys(handler: object) -> bool:
    """Whether it is what Python or asyncio does by itself: not ignored, and no handler of somebody else's."""
    if handler in (signal.default_int_handler, signal.SIG_DFL):
        return True
    return getattr(getattr(handler, "func", handler), "__module__", None) == "asyncio.runners"
