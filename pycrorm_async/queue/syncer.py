"""The background thread of a live queue: when it takes its turns, and nothing about what a turn does.

It sleeps while nobody has work for it. The first record after a turn wakes it, and it lets further ones gather for the
sync interval, so that they share one sync; whoever waits for the disk calls `hurry` and the turn begins at once.
"""

from __future__ import annotations

import threading
from collections.abc import Callable

__all__ = ["Syncer"]


class Syncer:
    """Takes turns until stopped; a last one after that. `turn` says whether another is wanted without being woken."""

    def __init__(self, *, name: str, interval_s: float, turn: Callable[[], bool]) -> None:
        self._interval_s = interval_s
        self._turn = turn
        self._work = threading.Event()
        self._hurry = threading.Event()
        self._stopping = False
        self._thread = threading.Thread(target=self._run, name=f"pycrorm sync {name}", daemon=True)

    def start(self) -> None:
        self._thread.start()

    def wake(self) -> None:
        """There is work: a turn will come within the interval."""
        self._work.set()

    def hurry(self) -> None:
        """There is work and somebody waits for it: a turn begins at once, or after the one that runs now."""
        self._hurry.set()
        self._work.set()

    def stop(self, *, timeout_s: float) -> bool:
        """Takes the last turn and ends the thread; False if it has not ended in time."""
        self._stopping = True
        self.hurry()
        self._thread.join(timeout_s)
        return not self._thread.is_alive()

    def _run(self) -> None:
        again = False
        while not self._stopping:
            if not again:
                self._work.wait()
            self._work.clear()
            self._hurry.wait(self._interval_s)
            self._hurry.clear()
            again = self._turn()
        self._turn()
