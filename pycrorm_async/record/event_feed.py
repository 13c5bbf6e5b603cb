"""Pass recorded events to observers in the same process: callbacks and asynchronous streams.

    with memory.subscribe(print):
        await plan()

    async for event in memory.events(): ...

Theory of operation. The thread that recorded an event adds it to the buffer of each observer and returns; it never
waits for an observer. A thread of each callback, or the event loop of each stream, takes events out of the buffer. If a
buffer is full, the new event is not added, and `left_out` counts it. A hook can run inside the garbage collector, in a
thread that is already adding an event, so a buffer has no lock: it is a `SimpleQueue`, whose `put` is reentrant.

Events of one thread arrive in the order in which they were recorded. Events of several threads may be interleaved
differently; within an episode `sequence` gives their order.
"""

from __future__ import annotations

import asyncio
import logging
import threading
from collections.abc import Callable
from contextlib import suppress
from queue import Empty, SimpleQueue
from types import TracebackType
from typing import Final, NamedTuple, Self

from pycrorm_async.clock import Clock
from pycrorm_async.events.ids import EpisodeId, episode_text
from pycrorm_async.events.types import DesignatorTypeDeclared, Happening, NodeStarted

_log = logging.getLogger("pycrorm_async")
BUFFER_EVENTS: Final = 10_000
"""Bounds the events that wait for one observer: a second of a plan that records 10,000 events a second."""
_LAST_EVENTS_S: Final = 5.0
"""Bounds the wait of a closing memory for a callback that processes its buffer."""


class RecordedEvent(NamedTuple):
    """An event that was recorded: it survives `kill -9`, and need not be in the database yet.

    Attributes:
        episode: id of the episode, a UUID as text.
        sequence: 1, 2, 3 … inside the episode; that of a NodeStarted is the node's id there.
        happening: one of `pycrorm_async.events.types`.
        dtype: the designator type of a NodeStarted; None for other events and for nodes without a type.
    """

    episode: str
    sequence: int
    happening: Happening
    dtype: str | None


class EventFeed:
    """The observers of one memory. Any thread may publish, and may add or remove an observer."""

    def __init__(self) -> None:
        self.observers: tuple[_Buffer, ...] = ()
        self._declarations: dict[str, DesignatorTypeDeclared] = {}
        self._change = threading.Lock()

    def note_type(self, designator: str, declaration: DesignatorTypeDeclared) -> None:
        """Remember a declared designator type, by whose name events of its nodes are published."""
        self._declarations[designator] = declaration

    def declaration(self, designator: str | None) -> DesignatorTypeDeclared | None:
        """Return the designator type that a node names (`NodeStarted.designator`), if this memory declared it."""
        return self._declarations.get(designator) if designator is not None else None

    def publish(self, episode: EpisodeId, sequence: int, happening: Happening) -> None:
        """Add an event to the buffer of each observer. Never waits."""
        declaration = self.declaration(happening.designator) if isinstance(happening, NodeStarted) else None
        dtype = declaration.dtype if declaration is not None else None
        event = RecordedEvent(episode_text(episode), sequence, happening, dtype)
        for each in self.observers:
            each.add(event)

    def subscribe(self, callback: Callable[[RecordedEvent], object], *, buffer: int) -> Subscription:
        """Call this with each event, in a thread of its own."""
        subscription = Subscription(callback, buffer, self._remove)
        self._add(subscription)
        subscription.start()
        return subscription

    def stream(self, *, buffer: int) -> EventStream:
        """Return the events as an asynchronous iterator for the running loop."""
        stream = EventStream(buffer, self._remove)
        self._add(stream)
        return stream

    def keep(self, types: tuple[type[Happening], ...], buffer: int, clock: Clock) -> EventBuffer:
        """Keep the events of these types until they are taken."""
        kept = EventBuffer(types, buffer, self._remove, clock)
        self._add(kept)
        return kept

    async def close(self) -> None:
        """End all observers; wait a limited time until the callbacks have processed their buffers."""
        for each in self.observers:
            each.close()
            if isinstance(each, Subscription):
                await asyncio.to_thread(each.join)

    def _add(self, observer: _Buffer) -> None:
        with self._change:
            self.observers = (*self.observers, observer)

    def _remove(self, observer: _Buffer) -> None:
        with self._change:
            self.observers = tuple(each for each in self.observers if each is not observer)


class _Buffer:
    """Events on their way to one observer; None marks the end.

    Attributes:
        left_out: number of events that found the buffer full.
    """

    def __init__(self, events_max: int, remove: Callable[[_Buffer], None]) -> None:
        self.left_out = 0
        self._events: SimpleQueue[RecordedEvent | None] = SimpleQueue()
        self._events_max = events_max
        self._remove = remove
        self._is_closed = False

    def add(self, event: RecordedEvent) -> None:
        if self._events.qsize() >= self._events_max:
            self.left_out += 1
        else:
            self._events.put(event)

    def close(self) -> None:
        """Take no more events; those in the buffer are still delivered. Closing twice has no further effect."""
        if not self._is_closed:
            self._is_closed = True
            self._remove(self)
            self._events.put(None)


class TimedEvent(NamedTuple):
    """An event with the times at which it was published."""

    event: RecordedEvent
    wall_ns: int
    monotonic_ns: int


class EventBuffer(_Buffer):
    """Events of some types, kept until they are taken, by any thread."""

    def __init__(
        self, types: tuple[type[Happening], ...], events_max: int, remove: Callable[[_Buffer], None], clock: Clock
    ) -> None:
        super().__init__(events_max, remove)
        self._types = types
        self._clock = clock
        self._kept: SimpleQueue[TimedEvent] = SimpleQueue()

    def add(self, event: RecordedEvent) -> None:
        if not isinstance(event.happening, self._types):
            return
        if self._kept.qsize() >= self._events_max:
            self.left_out += 1
        else:
            self._kept.put(TimedEvent(event, self._clock.wall_ns(), self._clock.monotonic_ns()))

    def take(self) -> list[TimedEvent]:
        """Return the events that were added before this call, and keep them no longer."""
        events = []
        with suppress(Empty):
            for _ in range(self._kept.qsize()):
                events.append(self._kept.get_nowait())  # noqa: PERF401  an exception may end the loop
        return events


class Subscription(_Buffer):
    """A callback that is called with each event. A context manager that ends the subscription.

    Attributes:
        failed: number of calls that raised. The first is logged; the subscription continues.
    """

    def __init__(
        self, callback: Callable[[RecordedEvent], object], events_max: int, remove: Callable[[_Buffer], None]
    ) -> None:
        super().__init__(events_max, remove)
        self.failed = 0
        self._callback = callback
        self._thread = threading.Thread(target=self._deliver, name="pycrorm observer", daemon=True)

    def start(self) -> None:
        """Start the thread that calls the callback."""
        self._thread.start()

    def join(self) -> None:
        """Wait until the callback has processed the buffer, for a limited time. Blocks."""
        if self._thread is threading.current_thread():
            return
        self._thread.join(_LAST_EVENTS_S)
        if self._thread.is_alive():
            _log.warning("%r did not process all events within %g s", self._callback, _LAST_EVENTS_S)

    def __enter__(self) -> Self:
        return self

    def __exit__(
        self, kind: type[BaseException] | None, error: BaseException | None, traceback: TracebackType | None
    ) -> None:
        """End the subscription when the callback has processed the buffer, for a limited time. Blocks."""
        self.close()
        self.join()

    def _deliver(self) -> None:
        while (event := self._events.get()) is not None:
            try:
                self._callback(event)
            except Exception:  # noqa: BLE001  the callback is the user's; its failures are counted
                self.failed += 1
                if self.failed == 1:
                    _log.exception("an observer of recorded events raised at %r", event)


class EventStream(_Buffer):
    """Events as an asynchronous iterator, for one task of the loop in which it was made. It ends with the memory.

    A kinematic plan never suspends, so a task of the same loop receives its events when the plan awaits something else
    or is finished.
    """

    def __init__(self, events_max: int, remove: Callable[[_Buffer], None]) -> None:
        super().__init__(events_max, remove)
        self._loop = asyncio.get_running_loop()
        self._arrived = asyncio.Event()
        self._is_woken = False

    def add(self, event: RecordedEvent) -> None:
        super().add(event)
        self._wake()

    def close(self) -> None:
        """End the iteration when the buffer is empty."""
        super().close()
        self._wake()

    def __aiter__(self) -> Self:
        return self

    async def __anext__(self) -> RecordedEvent:
        while True:
            try:
                event = self._events.get_nowait()
            except Empty:
                await self._arrived.wait()
                continue
            finally:
                self._sleep_if_empty()
            if event is None:
                self._events.put(None)  # for a further call
                raise StopAsyncIteration
            return event

    def _wake(self) -> None:
        if self._is_woken:
            return
        self._is_woken = True
        try:
            self._loop.call_soon_threadsafe(self._arrived.set)
        except RuntimeError:  # the loop is closed, so no task receives events any more
            self._remove(self)

    def _sleep_if_empty(self) -> None:
        """Clear the flags before looking: an event that is added after the look sets them again."""
        self._is_woken = False
        self._arrived.clear()
        if not self._events.empty():
            self._arrived.set()
