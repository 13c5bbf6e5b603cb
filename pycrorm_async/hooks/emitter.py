"""Puts events into the queue, and counts every fault of ours instead of letting it reach a plan."""

from __future__ import annotations

import logging
import threading
from typing import NamedTuple

from pycrorm_async.errors import SpoolFull
from pycrorm_async.events.codec import encode
from pycrorm_async.events.envelope import Heading
from pycrorm_async.events.ids import EpisodeId
from pycrorm_async.events.types import Happening
from pycrorm_async.hooks.event_sink import EventSink
from pycrorm_async.hooks.values.missing_values import MissingValues
from pycrorm_async.hooks.values.texts import clean, cut, message_of
from pycrorm_async.settings import Settings

__all__ = ["Emitter", "Faults"]

_log = logging.getLogger("pycrorm_async")
_BLOCK_S = 1.0
_OUR_THREADS = "pycrorm "
_REASON_MAX = 2_000
UNAWAITED_MAX = 100
"""Designator types that are named; the latest, if there are more."""


class Faults(NamedTuple):
    """How often the hooks failed to record something, and the last reason; status shows both."""

    total: int
    last: str | None


class Emitter:
    """The hooks' way to the queue.

    Only the start of a node or an episode waits for room, before it is written (`Recorder.admit`). Everything else, a
    thought's start too, must not wait, so all that is put may use the reserve; when that is gone as well, the calling
    thread blocks until something was stored. Nothing is dropped.
    """

    def __init__(self, sink: EventSink, settings: Settings) -> None:
        self.sink = sink
        self.settings = settings
        self.over = False
        """Whether the memory is closed, or belongs to the process that forked this one: nothing is told any more."""
        self.missing = MissingValues()
        self.unawaited: tuple[str, ...] = ()
        """For each designator type whose perform was called and never awaited: a sentence that says so."""
        self._fault_count = 0
        self._last_fault: str | None = None

    @property
    def faults(self) -> Faults:
        return Faults(self._fault_count, self._last_fault)

    def put(self, episode: EpisodeId | None, event: Happening) -> int:
        """Append the event; its sequence. Raises `NotEncodable` before anything was written."""
        kind = type(event)
        payload = encode(event, bytes_max=self.settings.record_bytes_max)
        return self.put_payload(Heading(episode, kind.__name__, kind.version), payload)

    def put_payload(self, heading: Heading, payload: bytes) -> int:
        """The same for an event that is encoded already."""
        while True:
            try:
                return self.sink.put_nowait(heading, payload, reserved=True)
            except SpoolFull:
                # The collector may close a dropped plan in a thread of ours, and these are the ones that make room.
                if threading.current_thread().name.startswith(_OUR_THREADS):
                    raise
                self.sink.block_until_room(_BLOCK_S)

    def offer(self, episode: EpisodeId, event: Happening) -> int:
        """As `put`, only if there is ordinary room for it: raises `SpoolFull` otherwise, and never waits."""
        kind = type(event)
        payload = encode(event, bytes_max=self.settings.record_bytes_max)
        return self.sink.put_nowait(Heading(episode, kind.__name__, kind.version), payload)

    def note_unawaited(self, dtype: str) -> None:
        """A perform of the plan that never ran: counted among the faults, and named."""
        text = f"{dtype}.perform() was called and never awaited, so it did not run: write `await`"
        self._fault_count += 1
        self._last_fault = text
        if text not in self.unawaited:
            self.unawaited = (*self.unawaited[1 - UNAWAITED_MAX :], text)
            _log.warning("%s", text)

    def note_fault(self, where: str, error: BaseException) -> None:
        """A fault of ours: counted, kept, logged once in a while, never raised into the plan."""
        self._fault_count += 1
        self._last_fault = f"{where}: {type(error).__name__}: {cut(clean(message_of(error)), _REASON_MAX)}"
        if self._fault_count & (self._fault_count - 1) == 0:
            _log.error("not recorded (%d so far): %s", self._fault_count, self._last_fault)
            _log.debug("where it happened", exc_info=error)
