"""A named episode can be recorded again: events that are stored are compared with the log, and only new ones written.

Theory of operation. The name of an episode gives its id, a UUIDv5. A recorder that died leaves such an episode without
an end, so that a further recording of the same name continues it: the executive reports everything again from the
start, and as long as the log has the next event, `RecordedBefore` returns its sequence instead of writing it. So the
keys of nodes and objects name the same events as before, and the first event behind the last stored one is written
with the next sequence. An executive must report the same again; an event of another type, or with other values, shows
that the source has changed, and ends the recording. The times at which values of poses were created are not compared.
"""

import re
from collections import deque
from collections.abc import Callable, Sequence
from typing import Final, NamedTuple, Protocol

from pycrorm_async.errors import CallerError
from pycrorm_async.events.codec import Heading
from pycrorm_async.events.ids import EpisodeId, episode_text

_CREATED: Final = re.compile(rb'"time_ns":-?[0-9]+')


class StoredPayload(NamedTuple):
    """A stored event: its sequence, type, version and payload."""

    sequence: int
    type: str
    version: int
    payload: bytes


class StoredEpisode(NamedTuple):
    """What the log has of an episode.

    Attributes:
        head: the last stored sequence.
        has_ended: whether its end is stored.
        page: returns some events behind a sequence, in order; none behind the head. Raises errors of the database.
    """

    head: int
    has_ended: bool
    page: Callable[[int], Sequence[StoredPayload]]


class StoredEpisodes(Protocol):
    """The episodes of the memory's log."""

    def find(self, episode: EpisodeId) -> StoredEpisode | None:
        """Return what the log has of an episode, once all that was recorded before this call is in it.

        Blocks. Raises errors of the database and of the spool, and `FlushTimeout`.
        """
        ...


class RecordedBefore:
    """The stored events of an episode that is recorded again, up to `head`."""

    def __init__(self, episode: EpisodeId, stored: StoredEpisode) -> None:
        self.head: Final = stored.head
        self._episode = episode
        self._read_page = stored.page
        self._page: deque[StoredPayload] = deque()
        self._last = 0

    def sequence_of(self, heading: Heading, payload: bytes) -> int:
        """Return the sequence of the next stored event, which must be this one; 0 behind the last one.

        Raises `CallerError` for another event.
        """
        if self._last == self.head:
            return 0
        if not self._page:
            self._page.extend(self._read_page(self._last))
        stored = self._page.popleft()
        is_same = stored.type == heading.type and (
            stored.version != heading.version
            or stored.type == "EpisodeStarted"  # of another day: versions of libraries, host, user
            or _CREATED.sub(b"", stored.payload) == _CREATED.sub(b"", payload)
        )
        if not is_same:
            raise CallerError(
                f"event {stored.sequence} of the episode {episode_text(self._episode)}, a {stored.type}, differs from"
                f" the {heading.type} that is reported now: the source has changed since, so nothing more is recorded;"
                " give the episode another name to record it too"
            )
        self._last = stored.sequence
        return stored.sequence
