"""What the hooks need of a queue: a place to put an event, in the caller's thread, that never awaits."""

from __future__ import annotations

from collections.abc import Awaitable
from typing import Protocol

from pycrorm_async.events.envelope import Heading

__all__ = ["EventSink"]


class EventSink(Protocol):
    """The producer's side of a queue."""

    def put_nowait(self, heading: Heading, payload: bytes, *, reserved: bool = False) -> int:
        """Append one event and return its sequence in its episode (0 for a recorder-level record).

        When it returns the event survives the death of the process. From any thread. Raises `SpoolFull` when there is
        no room, and with `reserved` only when the reserve kept for ends and world observations is gone as well;
        `SpoolClosed` after closing or in a forked child. An event that is refused leaves no gap.
        """
        ...

    @property
    def full(self) -> bool:
        """Whether an ordinary event would be refused now."""
        ...

    def room(self) -> Awaitable[None]:
        """Done when an ordinary event fits again."""
        ...

    def block_until_room(self, timeout_s: float) -> bool:
        """Block this thread until even a reserved event fits; False if the time is over."""
        ...
