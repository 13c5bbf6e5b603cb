"""Handle Ctrl-C and SIGTERM while a plan runs and while its events are being stored.

Theory of operation. The first signal cancels the plan's task, as asyncio does; the plan ends and its events are stored.
If the plan does not end, the second signal raises `KeyboardInterrupt` in it. The next signal, and any signal once the
plan has ended, terminates the process with exit code 130. That loses no event: all of them are in the spool on the
disk, and the next process that uses this spool stores them. Only a memory of `sqlite://` ends with its process, and the
last line states it.

Signal handlers run in the main thread between two bytecodes, so the handler may interrupt a write to stderr. It
therefore writes its last line with one system call (`write_last`) and leaves with `os._exit`.
"""

import asyncio
import os
import signal
from collections.abc import Iterator
from contextlib import contextmanager
from types import FrameType

from pycrorm_async.cli.output import note, write_last

_NOTE_DELAY_S = 1.0
"""Delays the note that events are being stored, so that it appears only if storing takes noticeably long."""
_PLAN_SIGNALS_MAX = 2
"""Bounds the signals passed to a plan: one cancels it, one breaks off a plan that cannot be cancelled."""
_LAST_LINE = "interrupted; events not stored yet are safe in the spool, and the next start stores them"
_LAST_LINE_OF_PRIVATE = "interrupted; the events of sqlite:// are lost, because this memory ends with its process"


class Interruption:
    """Handles SIGINT and SIGTERM for one plan. Use it in the thread of the event loop, the main thread.

    With `plan_signals_max=1`, for code that performs many plans, the second signal terminates the process. A memory
    that `is_private`, of `sqlite://`, ends with the process.
    """

    def __init__(self, *, plan_signals_max: int = _PLAN_SIGNALS_MAX, is_private: bool = False) -> None:
        self._plan_signals_max = plan_signals_max
        self._is_private = is_private
        self._count = 0
        self._storing = False

    @contextmanager
    def handled(self) -> Iterator[None]:
        """Install the signal handlers while the plan runs and its events are stored, then restore the former ones.

        Raises `KeyboardInterrupt` if a signal cancelled the plan. A handler that the program itself installed, and an
        ignored signal, stay as they are.
        """
        task, loop = asyncio.current_task(), asyncio.get_running_loop()
        assert task is not None

        def handle_signal(_number: int, _frame: FrameType | None) -> None:
            self._count += 1
            if self._storing or self._count > self._plan_signals_max:
                write_last(_LAST_LINE_OF_PRIVATE if self._is_private else _LAST_LINE)
                os._exit(130)
            if self._count > 1:  # the plan never suspends, or suppresses its cancellation
                raise KeyboardInterrupt
            task.cancel()
            # The loop may be waiting for I/O; without this call it would not notice the cancellation.
            loop.call_soon_threadsafe(self.plan_ended if self._plan_signals_max == 1 else lambda: None)

        former_handlers = {number: signal.getsignal(number) for number in (signal.SIGINT, signal.SIGTERM)}
        numbers = [number for number, handler in former_handlers.items() if _is_default(handler)]
        for number in numbers:
            signal.signal(number, handle_signal)
        try:
            yield
        except asyncio.CancelledError:
            if self._count:
                raise KeyboardInterrupt from None
            raise
        finally:
            for number in numbers:
                signal.signal(number, former_handlers[number])

    @property
    def requested(self) -> bool:
        """True once a signal has requested the interruption."""
        return self._count > 0

    def plan_ended(self) -> None:
        """Let the next signal terminate the process, because the plan has ended; after a signal also print a note."""
        if self._count:
            consequence = "and all events of sqlite:// are lost" if self._is_private else "without losing any"
            asyncio.get_running_loop().call_later(
                _NOTE_DELAY_S, note, f"recorded events are being stored; Ctrl-C again exits at once {consequence}"
            )
        self._storing = True


def interrupt_on_termination() -> None:
    """Let SIGTERM do what Ctrl-C does, so that a verb of the command deletes a file that it has written in part."""

    def interrupt(*_: object) -> None:
        # Python has no handler for SIGINT here, so the signal would do nothing, or end the process without clean-up.
        if signal.getsignal(signal.SIGINT) in (signal.SIG_IGN, signal.SIG_DFL):
            raise KeyboardInterrupt
        signal.raise_signal(signal.SIGINT)

    signal.signal(signal.SIGTERM, interrupt)


def _is_default(handler: object) -> bool:
    """Return whether the handler is that of the system, Python or asyncio; False if a parent ignores the signal."""
    if handler in (signal.default_int_handler, signal.SIG_DFL):
        return True
    return getattr(getattr(handler, "func", handler), "__module__", None) == "asyncio.runners"
