"""`OpenEpisodes` holds the open episodes of one memory, whichever executive writes them.

Theory of operation. `continue_episode` moves an episode to its follow-up. `_continuing` holds the former id meanwhile,
so that another event cannot start a second move, and `by_id` holds the episode under both ids, because it is looked up
by its current id, which changes during the move.
"""

from __future__ import annotations

import logging
import os
import threading
from collections import deque
from collections.abc import Callable
from contextlib import AbstractContextManager, nullcontext
from typing import Any

from pycrorm_async.clock import Clock
from pycrorm_async.errors import CallerError
from pycrorm_async.events.ids import EpisodeId, episode_id, episode_text
from pycrorm_async.recording.writing.emitter import Emitter
from pycrorm_async.recording.writing.episode_writer import EpisodeWriter

_log = logging.getLogger("pycrorm_async")
RECENT_MAX = 100
"""Bounds the ids in `recent`, because a process may open any number of episodes."""

AnyWriter = EpisodeWriter[Any]
"""The writer of an episode, whatever it identifies nodes by."""


class OpenEpisodes:
    """The open episodes of one memory, and the ids of those opened last.

    Attributes:
        by_id: the open episodes.
        opened_count, continued_count: the numbers of episodes opened and of follow-ups, without simulations.
    """

    def __init__(self, emitter: Emitter, clock: Clock, randomness: Callable[[int], bytes] = os.urandom) -> None:
        self._emitter = emitter
        self._clock = clock
        self._randomness = randomness
        self.by_id: dict[EpisodeId, AnyWriter] = {}
        self._recent: deque[EpisodeId] = deque(maxlen=RECENT_MAX)
        self._continuing: set[EpisodeId] = set()
        self._is_closing = False
        self._adding = threading.RLock()
        self.opened_count = 0
        self.continued_count = 0

    def new_id(self) -> EpisodeId:
        """Make the id of a new episode."""
        return episode_id(self._clock.wall_ns(), self._randomness(10))

    def add(self, episode: AnyWriter) -> None:
        """Add an episode. Raises `CallerError` after `refuse_new`."""
        with self._adding:
            if self._is_closing:
                raise CallerError("the memory is being closed")
            self.by_id[episode.id] = episode
        self._note_opened(episode)

    def refuse_new(self) -> None:
        """Add no episode from now on, because the memory is being closed."""
        with self._adding:
            self._is_closing = True

    def _note_opened(self, episode: AnyWriter) -> None:
        if not episode.simulated:
            self._recent.append(episode.id)
            self.opened_count += 1

    @property
    def all(self) -> tuple[AnyWriter, ...]:
        """The open episodes, oldest first."""
        return tuple(self.by_id.copy().values())

    @property
    def recent(self) -> tuple[str, ...]:
        """The ids of the last 100 episodes opened, including ended ones, without simulations."""
        return tuple(map(episode_text, self._recent.copy()))

    def last_opened(self) -> AnyWriter | None:
        """Return the open episode that was opened last in any context, without simulations; None without one."""
        return next((each for each in reversed(self.all) if not each.simulated and not each.closed), None)

    def continue_episode(
        self,
        episode: AnyWriter,
        around: AbstractContextManager[Callable[[dict[int, int]], None] | None] = nullcontext(),  # noqa: B008  stateless
    ) -> None:
        """Continue an episode that reached `continue_at` in a follow-up episode. Exceptions are counted, not raised.

        `around` is entered meanwhile; it yields a function for the new sequences of open nodes, or None.
        """
        if episode.id in self._continuing or self._emitter.is_closed:
            return
        former, follow_up = episode.id, self.new_id()
        self._continuing.add(former)
        self.by_id[follow_up] = episode
        try:
            with around as renumber:
                renumbered = episode.continue_as(follow_up)
                if renumber is not None:
                    renumber(renumbered)
        except Exception as error:  # noqa: BLE001  a fault of the memory must not reach a plan
            self._emitter.note_fault("EpisodeStarted", error)
        finally:
            self.by_id.pop(former if episode.id == follow_up else follow_up, None)
            self._continuing.discard(former)
        if episode.id == follow_up:
            self.continued_count += 1
            self._note_opened(episode)
            _log.info("episode %s reached its event limit and continues in episode %s", episode_text(former), episode)

    def close(self, episode: AnyWriter, failure: BaseException | None) -> None:
        """Write the end of an episode; `failure` is the exception that ended it, or None. Exceptions are counted."""
        if self._emitter.is_closed:
            return
        try:
            episode.end_episode(failure)
        except Exception as error:  # noqa: BLE001  a fault of the memory must not replace the plan's outcome
            self._emitter.note_fault("EpisodeEnded", error)
        self.by_id.pop(episode.id, None)  # last, so that the memory ends an episode whose end Ctrl-C interrupted
