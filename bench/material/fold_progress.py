"""Read from the database how many events are in the log and in the tables, over an independent connection."""

from __future__ import annotations

import time
from typing import NamedTuple

from tests.databases import ask

__all__ = ["Progress", "progress", "until_folded"]

_POLL_S = 0.05
_STALLED_S = 60.0
_NO_LOG = ("no such table", "does not exist", "unable to open", "locked")


class Progress(NamedTuple):
    """Numbers of events in the log and in the tables."""

    appended: int
    folded: int


def progress(url: str) -> Progress:
    """Return the sums over all episodes; 0 if the log does not exist yet."""
    try:
        [(head, folded)] = ask(url, "SELECT coalesce(sum(head), 0), coalesce(sum(folded), 0) FROM episode")
    except Exception as error:
        if any(each in str(error) for each in _NO_LOG):
            return Progress(0, 0)
        raise
    return Progress(int(head), int(folded))


def until_folded(url: str, events: int) -> tuple[float, float]:
    """Wait until `events` events are in the tables; return the seconds until they were in the log and in the tables.

    Raises:
        TimeoutError: the numbers did not change for a minute.
    """
    begin_s = changed_s = time.perf_counter()
    appended_s = 0.0
    previous = Progress(0, 0)
    while True:
        current = progress(url)
        now_s = time.perf_counter() - begin_s
        if current != previous:
            previous, changed_s = current, time.perf_counter()
        elif time.perf_counter() - changed_s > _STALLED_S:
            raise TimeoutError(f"{url}: {current} of {events} events, without progress for {_STALLED_S:g} s")
        if not appended_s and current.appended >= events:
            appended_s = now_s
        if current.folded >= events:
            return appended_s, now_s
        time.sleep(_POLL_S)
