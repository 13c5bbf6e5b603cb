"""Puts events into the queue, and counts every fault of ours instead of letting it reach a plan."""

from __future__ import annotations

import logging
from typing import NamedTuple

from pycrorm_async.config import Settings
from pycrorm_async.errors import SpoolFull
from pycrorm_async.events.codec import encode
from pycrorm_async.events.envelope import Heading
from pycrorm_async.events.happenings import Happening
from pycrorm_async.events.ids import EpisodeId
from pycrorm_async.hooks.ports import EventSink

__all__ = ["Emitter", "Faults"]

_log = logging.getLogger("pycrorm_async")
_BLOCK_S = 1.0


class Faults(NamedTuple):
    """How often the hooks failed to record something, and the last reason; status shows both."""

    total: int
    last: str | None


class Emitter:
    """The hooks' way to the queue.

    Ends and world observations are `reserved`: they use the room kept free for them, and when that is gone as well they
    block the calling thread until something was stored. Nothing is dropped.
    """

    def __init__(self, sink: EventSink, settings: Settings) -> None:
        self.sink = sink
        self.settings = settings
        self._fault_count = 0
        self._last_fault: str | None = None

    @property
    def faults(self) -> Faults:
        return Faults(self._fault_count, self._last_fault)

    def put(self, episode: EpisodeId | None, event: Happening, *, reserved: bool = True) -> int:
        """Append the event; its sequence. Raises `NotEncodable` before anything was written."""
        payload = encode(event, bytes_max=self.settings.record_bytes_max)
        return self.put_payload(episode, type(event).__name__, type(event).version, payload, reserved=reserved)

    def put_payload(
        self, episode: EpisodeId | None, kind: str, version: int, payload: bytes, *, reserved: bool = True
    ) -> int:
        heading = Heading(episode, kind, version)
        while True:
            try:
                return self.sink.put_nowait(heading, payload, reserved=reserved)
            except SpoolFull:
                if not reserved:
                    raise
                self.sink.block_until_room(_BLOCK_S)

    def note_fault(self, where: str, error: BaseException) -> None:
        """A fault of ours: counted, kept, logged once in a while, never raised into the plan."""
        self._fault_count += 1
        self._last_fault = f"{where}: {type(error).__name__}: {error}"
        if self._fault_count & (self._fault_count - 1) == 0:
            _log.error("not recorded (%d so far): %s", self._fault_count, self._last_fault, exc_info=error)
