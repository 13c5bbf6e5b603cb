"""How far a memory is, as the database says: asked by a connection that knows nothing of ours."""

from __future__ import annotations

import time
from typing import NamedTuple

from tests.databases import ask

__all__ = ["Progress", "progress", "until_folded"]

_LOOK_S = 0.05
_PATIENCE_S = 60.0
_NOT_THERE = ("no such table", "does not exist", "unable to open", "locked")


class Progress(NamedTuple):
    """Events in the log, and in the tables."""

    appended: int
    folded: int


def progress(url: str) -> Progress:
    """Of all episodes together; none while there is no log yet."""
    try:
        [(head, folded)] = ask(url, "SELECT coalesce(sum(head), 0), coalesce(sum(folded), 0) FROM episode")
    except Exception as error:
        if any(each in str(error) for each in _NOT_THERE):
            return Progress(0, 0)
        raise
    return Progress(int(head), int(folded))


def until_folded(url: str, events: int) -> tuple[float, float]:
    """Waits until so many events are in the tables: seconds until they were in the log, and until they were there.

    Raises `TimeoutError` when nothing has moved for a minute.
    """
    began = moved = time.perf_counter()
    appended_s = 0.0
    before = Progress(0, 0)
    while True:
        found = progress(url)
        now_s = time.perf_counter() - began
        if found != before:
            before, moved = found, time.perf_counter()
        elif time.perf_counter() - moved > _PATIENCE_S:
            raise TimeoutError(f"{url}: {found} of {events} events, and nothing has moved for {_PATIENCE_S:g} s")
        if not appended_s and found.appended >= events:
            appended_s = now_s
        if found.folded >= events:
            return appended_s, now_s
        time.sleep(_LOOK_S)
