"""Record the observations that a program makes itself, from any thread.

A thread without the plan's context, such as the callback of a sensor, observes for the episode that this memory opened
last. Such a thread does not continue a long episode in a follow-up, which is up to the plan's thread; it stops
recording at the same event.
"""

from __future__ import annotations

from collections.abc import Callable
from typing import Any

from pycrorm_async.connected_var import ConnectedVar
from pycrorm_async.errors import Unrecordable
from pycrorm_async.events.blobs import Blob
from pycrorm_async.hooks.plan_recorder import Recorder
from pycrorm_async.plan.task_tree import TaskTreeNode, current_node
from pycrorm_async.recording.writing.emitter import Emitter
from pycrorm_async.recording.writing.episode_writer import EpisodeWriter
from pycrorm_async.recording.writing.observing import name_of, put_observation


class Observations:
    """Records observations of one memory."""

    def __init__(self, emitter: Emitter, recorder: Recorder) -> None:
        self._emitter = emitter
        self._recorder = recorder
        self._full: EpisodeWriter[Any] | None = None  # that has no room for observations of other threads
        self._kept: set[tuple[str, str]] = set()

    @property
    def is_closed(self) -> bool:
        """True if the memory is closed, or belongs to the process that forked this one."""
        return self._emitter.is_closed

    def observe(self, name: str, values: object, *, node: TaskTreeNode | None) -> None:
        """Record values under this name. Raises `Unrecordable` with `on_unrecordable="refuse"` only."""
        if self.is_closed:
            return
        try:
            self._observe(name, values, node)
        except Unrecordable:
            raise
        except Exception as error:  # noqa: BLE001  a fault of the memory must not reach a plan
            self._emitter.note_fault("Observed", error)

    def keep(self, name: str, key: str, content: Callable[[], Blob]) -> None:
        """Record a content that nodes name by this key, once for all episodes of the memory.

        Outside an episode nothing is recorded; the next call tries again, also where the spool had no room.
        """
        if self.is_closed or (name, key) in self._kept or self._recorder.episode_here() is None:
            return
        try:
            if self._observe(name, {key: content()}, None):
                self._kept.add((name, key))
        except Exception as error:  # noqa: BLE001  a fault of the memory must not reach a plan
            self._emitter.note_fault("Observed", error)

    def _observe(self, name: str, values: object, node: TaskTreeNode | None) -> int:
        """Return the sequence of the event; 0 if it was counted as missing."""
        own = self._recorder.episode_here()
        episode: EpisodeWriter[Any] | None
        if node is not None:
            episode = self._recorder.episode_of(node)
        elif own is not None:
            episode, node = own, current_node.get()
        else:
            episode = self._recorder.episodes.last_opened()
        if episode is None or (episode is not own and episode is self._full):
            reason = "no episode is open" if episode is None else "its episode has no more room for observations"
            self._emitter.missing.note("observation", name_of(name), reason)
            return 0
        sequence = put_observation(self._emitter, episode, name, values, episode.node_or_root(node), may_refuse=True)
        if sequence >= episode.continue_at:
            if episode is own:
                self._recorder.continue_episode(own)
            else:
                self._full = episode
        return sequence


observations: ConnectedVar[Observations] = ConnectedVar("observations")
"""The observations of the memory that records this context; None without an open memory."""
