"""`EventSink` is the port of `recording` that a queue implements: put an event from any thread, without awaiting."""

from __future__ import annotations

from collections.abc import Awaitable
from typing import Protocol

from pycrorm_async.events.envelope import Heading, Receipt


class EventSink(Protocol):
    """The producing end of a queue."""

    def put_nowait(
        self, heading: Heading, payload: bytes, *, reserved: bool = False, receipt: Receipt | None = None
    ) -> int:
        """Append one event and return its sequence in its episode (0 for a recorder-level record).

        Writing the event sets the sequence of the receipt as well, even if Ctrl-C interrupts the call afterwards.

        Any thread may call it. Once it returns, the event survives the death of the process. Raises `SpoolFull` if
        there is no room; with `reserved`, only if the reserve for ends and world observations is used up as well.
        Raises `SpoolClosed` after closing or in a forked child. A refused event leaves no gap in the sequence.
        """
        ...

    def put_blob(self, content: bytes) -> str:
        """Write a blob and return its name, the SHA-256 of the content, for events put afterwards to refer to.

        Any thread may call it. Raises `SpoolFull` without waiting if there is no room, and other errors of the spool.
        """
        ...

    def release_blob(self, name: str) -> None:
        """State that no event put from now on refers to this blob because of one of its puts."""
        ...

    @property
    def full(self) -> bool:
        """True if the queue would refuse an event without `reserved` now."""
        ...

    def room(self) -> Awaitable[None]:
        """Wait until an event without `reserved` fits again."""
        ...

    def block_until_room(self, timeout_s: float, *, reserved: bool = True) -> bool:
        """Block the calling thread until an event fits; return False after `timeout_s` seconds.

        Logs a warning if it waits for more than two seconds. Raises `SpoolStuck` when waiting cannot help.
        """
        ...
