"""`ObservingMemory` takes observations of a program's own, and passes recorded events to programs in the process."""

from __future__ import annotations

from collections.abc import Callable

from pycrorm_async.hooks.event_feed import BUFFER_EVENTS, EventStream, RecordedEvent, Subscription
from pycrorm_async.memory_parts import PartsHolder
from pycrorm_async.plan.task_tree import TaskTreeNode

__all__ = ["ObservingMemory"]


class ObservingMemory(PartsHolder):
    """The observations and subscriptions of a memory. Each method raises `CallerError` while it is not open."""

    def observe(self, name: str, values: object, *, node: TaskTreeNode | None = None) -> None:
        """Record an observation of your own in the open episode: a measurement, a message, an image.

        >>> memory.observe("wrist force", {"x": 1.5, "y": -0.25, "contact": True})
        >>> memory.observe("camera", Blob(png, "image/png"))

        May be called from any thread. A thread outside the plan's context observes for the episode opened last. A value
        that cannot be recorded, or finds no space in the spool, is recorded as missing and counted; a plan never waits.

        Args:
            name: by which observations are queried.
            values: a number, bool, text, array or `Blob`, or a dict or list of these. An array of more than 64 elements
                is stored as a blob of the media type `application/x-npy`.
            node: the node that observed it; by default the current one, or the root of the episode.

        Raises `Unrecordable` with `on_unrecordable="refuse"` only.
        """
        self._open_parts.observations.observe(name, values, node=node)

    # --- subscribing ------------------------------------------------------------------------------------------

    def subscribe(self, callback: Callable[[RecordedEvent], object], *, buffer: int = BUFFER_EVENTS) -> Subscription:
        """Call `callback` with each event from now on, in a thread of its own, until closed or the memory is closed.

        Use the result as a context manager, or call its `close()`. The plan never waits: an event that finds more than
        `buffer` others waiting is left out, and `left_out` counts it. Exceptions of the callback are counted in
        `failed`, and the first is logged.
        """
        return self._open_parts.emitter.feed.subscribe(callback, buffer=buffer)

    def events(self, *, buffer: int = BUFFER_EVENTS) -> EventStream:
        """Return each event from now on as an asynchronous iterator in this loop, which ends when the memory is closed.

        A plan that never suspends lets no other task of its loop run: observe it from a thread, or after the plan.
        """
        return self._open_parts.emitter.feed.stream(buffer=buffer)
