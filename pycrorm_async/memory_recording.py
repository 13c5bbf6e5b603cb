"""`RecordingMemory` is an open memory as plans and programs use it: episodes, observations, flushes, subscriptions."""

from __future__ import annotations

from abc import ABC, abstractmethod
from collections.abc import AsyncIterator, Callable, Mapping, Sequence
from contextlib import asynccontextmanager
from types import MappingProxyType, TracebackType
from typing import Any, Self

from pycrorm_async.connected_var import set_inside
from pycrorm_async.errors import EpisodeParked, PycrormError
from pycrorm_async.events.tags import checked_tags
from pycrorm_async.hooks.episode import Episode
from pycrorm_async.hooks.plan_recorder import current_episode
from pycrorm_async.memory_parts import MemoryStatus
from pycrorm_async.memory_reading import ReadableMemory
from pycrorm_async.operations.tag import tag_episode
from pycrorm_async.plan.execution.unawaited_performs import called_performs
from pycrorm_async.plan.task_tree import TaskTreeNode
from pycrorm_async.query.as_of import AnyEpisode
from pycrorm_async.query.named_queries import EpisodeSummary
from pycrorm_async.recording.recording import Recording
from pycrorm_async.recording.values.episode_arguments import read_labels
from pycrorm_async.recording.writing.event_feed import BUFFER_EVENTS, EventStream, RecordedEvent, Subscription


class RecordingMemory(ReadableMemory, ABC):
    """The recording methods of a memory. Each raises `CallerError` while the memory is not open."""

    _unadopted: dict[str, PycrormError]
    _reported: set[str]

    @abstractmethod
    async def __aenter__(self) -> Self:
        """Open the memory, once."""

    @abstractmethod
    async def __aexit__(
        self, kind: type[BaseException] | None, error: BaseException | None, traceback: TracebackType | None
    ) -> None:
        """Store and fold all recorded events; open episodes end as INTERRUPTED."""

    @property
    def status(self) -> MemoryStatus:
        """The present state of the memory."""
        return MemoryStatus.of(self._open_parts, self._unadopted)

    @property
    def is_open(self) -> bool:
        """True while the memory is open."""
        return self._parts is not None

    # --- episodes ---------------------------------------------------------------------------------------------

    @asynccontextmanager
    async def episode(
        self,
        *,
        description: str | None = None,
        plan: str | None = None,
        seed: int | None = None,
        tags: Sequence[str] = (),
        metadata: Mapping[str, Any] = MappingProxyType({}),
    ) -> AsyncIterator[Episode]:
        """Record an episode: plans performed inside, and the world that was entered before or is entered inside.

        If the spool is full, waits for space or raises `SpoolFull`, according to `Settings.on_full`.

        Args:
            description: the purpose; default: the plan's name.
            plan: the plan's name.
            seed: of the plan's random numbers, 64 bits, so that it can be repeated.
            tags: short texts to find the episode by; `tag` changes them later.
            metadata: JSON values of your own, at most 64 KiB.

        Raises:
            EpisodeRefused: an episode is open in this task already. A child task may open its own.
            CallerError: for an argument of the wrong type, and a tag that is not a text of 1 to 100 characters.
        """
        parts = self._open_parts
        recorder = parts.recorder
        if (room := recorder.admit()) is not None:
            await room
        labels = read_labels(tags, metadata, parts.emitter)
        text = description or plan or "an episode"
        episode = recorder.open_episode(description=text, plan=plan, seed=seed, labels=labels)
        failure: BaseException | None = None
        with (
            parts.in_context(),
            set_inside(current_episode, episode),
            set_inside(called_performs, episode.calls),
        ):
            try:
                yield episode
            except BaseException as raised:
                failure = raised
                raise
            finally:
                recorder.close_episode(episode, failure)

    async def tag(self, episode: AnyEpisode, *tags: str, remove: Sequence[str] = ()) -> None:
        """Add and remove tags of an episode of this database: a number, id, `last`, or object.

        Tags of an episode that is open in this memory are recorded in it; those of one that has ended are written
        directly to the log, after a flush.

        Raises `CallerError` for an episode that another process still records, and for a removed tag that the episode
        does not have; `UnknownEpisode`; `DatabaseUnavailable`, also if this login may not append.
        """
        parts = self._open_parts
        added, removed = checked_tags(tags), checked_tags(remove)
        name = str(episode.id if isinstance(episode, EpisodeSummary) else episode)
        for each in parts.recorder.episodes.all:
            if str(each) == name:
                each.change_tags(added, removed)
                return
        await self.flush()
        await tag_episode(self._located, name, added, removed, clock=self._clock)

    async def synced(self) -> None:
        """Wait until all events recorded so far survive a power loss.

        Raises `SpoolUnavailable` if the disk fails, or if files of the spool were deleted or replaced. Recording then
        continues in a new folder if one can be created, and `status` lists the lost records.
        """
        await self._open_parts.queue.synced_to(self._open_parts.queue.written)

    async def flush(self) -> None:
        """Wait until all events recorded so far are stored and visible in the tables.

        Raises:
            EpisodeParked: an episode could not be stored or folded, with the reason; each episode is reported once.
            FlushTimeout: nothing was stored or folded for `flush_timeout_s`. The events are safe in the spool.
        """
        parts = self._open_parts
        try:
            await parts.flush()
        except EpisodeParked as fault:
            unreported = self._unreported(fault)
            if unreported is not None:
                raise unreported from fault
        if parts.reading.is_open:
            await parts.reading.refresh(maps=False)

    def _unreported(self, fault: PycrormError) -> PycrormError | None:
        """Return the fault without parked episodes that a flush has reported; None if no other is left."""
        if not isinstance(fault, EpisodeParked):
            return fault
        reasons = {episode: reason for episode, reason in fault.reasons.items() if episode not in self._reported}
        self._reported.update(reasons)
        return EpisodeParked(reasons) if reasons else None

    # --- other executives and programs ------------------------------------------------------------------------

    @property
    def recording(self) -> Recording:
        """Writes episodes of an executive that is not ours, from any thread and without asyncio."""
        return self._open_parts.recording

    @property
    def recent_episodes(self) -> tuple[str, ...]:
        """The ids of the last hundred episodes this memory opened."""
        return self._open_parts.recorder.episodes.recent

    @property
    def opened_count(self) -> int:
        """The number of episodes this memory opened."""
        return self._open_parts.recorder.episodes.opened_count

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
