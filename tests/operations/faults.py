"""Inject a fault into a fold worker: at the next batch that it has written and not committed, the fault happens.

A daemon passes its workers the projection `Trapped`, so that they import this module. The daemon's own process is not
affected. The word in the file that PYCRORM_TRAP names is removed before the fault, so that it happens once.
"""

from __future__ import annotations

import os
import signal
import time
from collections.abc import Callable
from pathlib import Path
from typing import Any, ClassVar

from pycrorm_async.projections.custom import Changes, Event, Projection
from pycrorm_async.projections.fold import TableRows

TRAP = "PYCRORM_TRAP"


class Trapped(Projection):
    name = "trapped"
    version = 1
    tables: ClassVar = {"trapped": {"what": "text"}}

    def fold(self, event: Event, rows: Changes) -> None:
        """Fold nothing: the projection exists so that workers import this module."""


def arm(trap: Path, word: str) -> None:
    """Set the fault: a signal's name, `exit`, `raise` or `hang`."""
    trap.with_suffix(".making").write_text(word)
    trap.with_suffix(".making").rename(trap)


def _spring() -> None:
    trap = Path(os.environ[TRAP])
    try:
        word = trap.read_text()
        trap.unlink()
    except FileNotFoundError:
        return
    match word:
        case "exit":
            os._exit(3)
        case "raise":
            raise MemoryError("no memory left")
        case "hang":
            time.sleep(3600)
        case _:
            os.kill(os.getpid(), signal.Signals[word])


def _trapped(write_rows: Callable[..., Any]) -> Callable[..., Any]:
    async def write(*values: Any) -> None:
        await write_rows(*values)
        _spring()

    return write


if TRAP in os.environ and os.environ[TRAP + "_DAEMON"] != str(os.getpid()):
    TableRows.write = _trapped(TableRows.write)  # type: ignore[method-assign]
