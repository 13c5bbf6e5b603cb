"""The `Emitter` puts events into the queue and counts faults of the hooks, so that they do not reach a plan."""

from __future__ import annotations

import logging
import threading
from typing import NamedTuple

from pycrorm_async.errors import FilesError, SpoolFull
from pycrorm_async.events.codec import encode
from pycrorm_async.events.envelope import Heading, Receipt
from pycrorm_async.events.ids import EpisodeId
from pycrorm_async.events.types import Happening
from pycrorm_async.events.values import BlobReference
from pycrorm_async.recording.declarations.declared_type import DeclaredType
from pycrorm_async.recording.declarations.descriptions import Descriptions
from pycrorm_async.recording.values.missing_values import MissingValues
from pycrorm_async.recording.values.texts import clean, cut, message_of
from pycrorm_async.recording.writing.event_feed import EventFeed
from pycrorm_async.recording.writing.event_sink import EventSink
from pycrorm_async.settings import Settings

_log = logging.getLogger("pycrorm_async")
_BLOCK_S = 1.0
"""Bounds one wait for room. `put_payload` then tries again, so the value limits only the delay of a missed wake-up."""
THREAD_NAME_PREFIX = "pycrorm "
"""The names of all threads of the memory begin with this."""
_REASON_MAX = 2_000
"""Bounds the characters of the last fault's message in `status`."""
_HEADINGS_MAX = 1_000
"""Bounds the headings kept for reuse: an episode has one for each event type. When it is reached all are dropped."""
UNAWAITED_MAX = 100
"""Bounds the designator types listed with a perform that was never awaited; the latest are kept."""


class BlobRefused(ValueError):
    """The queue does not take a blob; the message is the reason."""


class Faults(NamedTuple):
    """The number of events the hooks failed to record, and the last reason; `status` shows both."""

    total: int
    last: str | None


class Emitter:
    """Puts the events of one memory into its queue.

    Only the start of a node or an episode waits for room, before it is written (`must_wait`). All other events,
    including the start of a simulation, must not wait, so `put` may use the spool's reserve. If the reserve is used up
    as well, `put` blocks the calling thread until a record was stored. It drops no event.

    Attributes:
        is_closed: whether the memory is closed, or belongs to the process that forked this one; hooks then do nothing.
        feed: the observers of this memory, to which recorded events are published.
        missing: counts the values that could not be recorded.
        descriptions: declares the descriptions of objects.
        unawaited: for each designator type whose perform was called and never awaited, a sentence for the user.
    """

    def __init__(self, sink: EventSink, settings: Settings) -> None:
        self.sink = sink
        self.settings = settings
        self.is_closed = False
        self.feed = EventFeed()
        self.missing = MissingValues()
        self.descriptions = Descriptions(self, settings, self.missing)
        self.unawaited: tuple[str, ...] = ()
        self._headings: dict[tuple[EpisodeId, type[Happening]], Heading] = {}
        self._fault_count = 0
        self._last_fault: str | None = None

    @property
    def faults(self) -> Faults:
        return Faults(self._fault_count, self._last_fault)

    def put(self, episode: EpisodeId, event: Happening, receipt: Receipt | None = None) -> int:
        """Append an event and return its sequence. Raises `NotEncodable` before anything is written.

        The sequence of the receipt shows after any exception whether the event was written.
        """
        payload = encode(event, bytes_max=self.settings.record_bytes_max)
        heading = self._heading(episode, type(event))
        try:
            sequence = self.sink.put_nowait(heading, payload, reserved=True, receipt=receipt)
        except SpoolFull:
            sequence = self.put_payload(heading, payload, receipt)
        if self.feed.observers:
            self.feed.publish(episode, sequence, event)
        return sequence

    def put_payload(self, heading: Heading, payload: bytes, receipt: Receipt | None = None) -> int:
        """Append an encoded event and return its sequence."""
        while True:
            try:
                return self.sink.put_nowait(heading, payload, reserved=True, receipt=receipt)
            except SpoolFull:
                # The garbage collector may close a dropped plan in a thread of the memory. Such a thread must not
                # block here, because these threads are the ones that free space.
                if threading.current_thread().name.startswith(THREAD_NAME_PREFIX):
                    raise
                self.sink.block_until_room(_BLOCK_S)

    def must_wait(self) -> bool:
        """Return if a node has to wait for room before it starts. Raises `SpoolFull` with `on_full="fail"`."""
        if not self.sink.full:
            return False
        if self.settings.on_full == "fail":
            raise SpoolFull("the spool is full (spool_bytes_max) and on_full is 'fail': start a writer to drain it")
        return True

    def put_declaration(self, declared: DeclaredType) -> None:
        """Append the declaration of a designator type."""
        kind = type(declared.declaration)
        self.put_payload(Heading(None, kind.__name__, kind.version), declared.payload)
        self.feed.note_type(declared.fingerprint, declared.declaration)

    def offer(self, episode: EpisodeId, event: Happening) -> int:
        """Append an event without using the reserve and without waiting; raise `SpoolFull` if there is no room."""
        payload = encode(event, bytes_max=self.settings.record_bytes_max)
        sequence = self.sink.put_nowait(self._heading(episode, type(event)), payload)
        if self.feed.observers:
            self.feed.publish(episode, sequence, event)
        return sequence

    def put_blob(self, content: bytes, media_type: str) -> BlobReference:
        """Write a blob; return the reference for events put afterwards. Never waits.

        The blob is kept beside the queue as long as these events, until `release_blob`, and for the life of the queue
        without it, as a declaration needs. Raises `BlobRefused` with the reason for a blob that is too large or finds
        no space; the caller records it as missing.
        """
        limit = self.settings.blob_bytes_max
        if len(content) > limit:
            raise BlobRefused(f"the blob takes {len(content):,} bytes, {limit:,} are allowed (blob_bytes_max)")
        try:
            return BlobReference(self.sink.put_blob(content), media_type, len(content))
        except FilesError as error:
            raise BlobRefused(str(error)) from error

    def release_blob(self, reference: BlobReference) -> None:
        """State that no event put from now on refers to this blob because of one of its puts."""
        self.sink.release_blob(reference.hash)

    def _heading(self, episode: EpisodeId, kind: type[Happening]) -> Heading:
        """Return the heading of an event; kept for the next one, because making it takes three times as long."""
        key = (episode, kind)
        heading = self._headings.get(key)
        if heading is None:
            if len(self._headings) >= _HEADINGS_MAX:
                self._headings.clear()
            heading = self._headings[key] = Heading(episode, kind.__name__, kind.version)
        return heading

    def note_unawaited(self, dtype: str) -> None:
        """Count a perform that was called and never awaited as a fault, and log a warning for the first of a type."""
        text = f"{dtype}.perform() was called and never awaited, so it did not run: write `await`"
        self._fault_count += 1
        self._last_fault = text
        if text not in self.unawaited:
            self.unawaited = (*self.unawaited[1 - UNAWAITED_MAX :], text)
            _log.warning("%s", text)

    def note_fault(self, where: str, error: BaseException) -> None:
        """Count an exception of the hooks, and log it when the count is a power of two, so that the log stays short."""
        self._fault_count += 1
        self._last_fault = f"{where}: {type(error).__name__}: {cut(clean(message_of(error)), _REASON_MAX)}"
        if self._fault_count & (self._fault_count - 1) == 0:
            _log.error("a fault of recording (%d so far): %s", self._fault_count, self._last_fault)
            _log.debug("traceback of the fault of recording", exc_info=error)
