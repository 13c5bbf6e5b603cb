"""Decide whether a frame may be put: limit one recorder's bytes, and reserve space for ends and observations. Pure.

Space is assigned in whole segments, so the files never exceed `spool_bytes_max`. Each segment reserves space for two
commit frames at its end: that of a sync that began before the last record, and that of the sync that covers it.
"""

from __future__ import annotations

from typing import NamedTuple

from pycrorm_async.errors import CallerError
from pycrorm_async.queue.files.frame import COMMIT_BYTES, TYPE_BYTES_MAX, frame_bytes
from pycrorm_async.queue.files.segment import SEGMENT_BYTES_MAX, header_bytes
from pycrorm_async.settings import Settings

_COMMITS_BYTES = 2 * COMMIT_BYTES
_EPISODES_MIN = 16
"""Open episodes that every segment's header has space for beside the largest record."""


class Capacity(NamedTuple):
    """The limits of one recorder.

    Every segment begins with a header that lists the open episodes, and with the declarations in use. With up to
    `episodes_max` open episodes the largest record still fits into a segment; declarations use part of that space.

    In the methods `spare` is the number of segments that may still begin, `episodes` the number of open episodes, and
    `declared` the bytes of the declarations in use.
    """

    segment_bytes: int
    segments_max: int
    reserve_bytes: int
    episodes_max: int

    @classmethod
    def of(cls, settings: Settings) -> Capacity:
        """Derive the limits. Raises `CallerError` for settings that could block the queue for ever or lose a record."""
        if settings.spool_bytes_max - settings.spool_reserve_bytes < 3 * settings.segment_bytes:
            raise CallerError(
                f"spool_bytes_max ({settings.spool_bytes_max:,}) must hold the reserve"
                f" ({settings.spool_reserve_bytes:,}) and three segments ({settings.segment_bytes:,} each)"
            )
        if settings.segment_bytes > SEGMENT_BYTES_MAX:
            raise CallerError(f"segment_bytes ({settings.segment_bytes:,}) must be at most {SEGMENT_BYTES_MAX:,}")
        needed = header_bytes(_EPISODES_MIN) + frame_bytes(TYPE_BYTES_MAX, settings.record_bytes_max) + _COMMITS_BYTES
        left = settings.segment_bytes - needed
        if left < 0:
            raise CallerError(
                f"segment_bytes ({settings.segment_bytes:,}) must hold a record of record_bytes_max"
                f" ({settings.record_bytes_max:,}) and {_EPISODES_MIN} open episodes: {needed:,} at least"
            )
        return cls(
            settings.segment_bytes,
            settings.spool_bytes_max // settings.segment_bytes,
            settings.spool_reserve_bytes,
            _EPISODES_MIN + left // (header_bytes(1) - header_bytes(0)),
        )

    @property
    def end(self) -> int:
        """The largest offset at which a segment's records may end."""
        return self.segment_bytes - _COMMITS_BYTES

    @property
    def descriptions_bytes_max(self) -> int:
        """Bounds the bytes of descriptions that a segment repeats: an eighth; by default 1 MiB, written in 0.4 ms."""
        return self.segment_bytes // 8

    def room_to_declare(self, *, episodes: int, declared: int) -> int:
        """Return the largest size of a further declaration that segments can repeat.

        Behind the declarations and the open episodes, at least sixteen, the largest record must still fit.
        """
        return header_bytes(self.episodes_max) - header_bytes(max(episodes, _EPISODES_MIN)) - declared

    def takes_episode(self, *, episodes: int, declared: int) -> bool:
        """Return whether one more episode may be open."""
        return header_bytes(episodes + 1) + declared <= header_bytes(self.episodes_max)

    def frame_bytes_max(self, *, episodes: int, declared: int = 0) -> int:
        """Return the largest frame that fits into a segment behind its header and declarations."""
        return self.end - header_bytes(episodes) - declared

    def ordinary_end(self, *, spare: int, episodes: int, declared: int = 0) -> int:
        """Return the offset at which ordinary records of the current segment must end to keep the reserve free."""
        return min(
            self.end, self.end + spare * self.frame_bytes_max(episodes=episodes, declared=declared) - self.reserve_bytes
        )

    def admits(
        self, frame_bytes: int, *, offset: int, spare: int, episodes: int, reserved: bool, declared: int = 0
    ) -> bool:
        """Return whether a frame may be put when the current segment is filled up to `offset`."""
        empty = self.frame_bytes_max(episodes=episodes, declared=declared)
        free = spare * empty - frame_bytes
        if offset + frame_bytes <= self.end:
            free += self.end - offset
        elif spare == 0 or frame_bytes > empty:
            return False
        return free >= (0 if reserved else self.reserve_bytes)
