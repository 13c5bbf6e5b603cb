"""Whether a frame may be put: how much one recorder may hold, and what is kept back for ends and observations. Pure.

Space is given out in whole segments, so that the files never hold more than `spool_bytes_max`. At the end of each there
is room for two commit frames: a sync that began before the last record came, and the one that covers it.
"""

from __future__ import annotations

from typing import NamedTuple

from pycrorm_async.config import Settings
from pycrorm_async.errors import CallerError
from pycrorm_async.queue.frame import COMMIT_BYTES, TYPE_BYTES_MAX, frame_bytes
from pycrorm_async.queue.segment import header_bytes

__all__ = ["Capacity"]

_COMMITS_BYTES = 2 * COMMIT_BYTES
_EPISODES_MIN = 16


class Capacity(NamedTuple):
    """What is allowed. `spare` below is how many segments may still be begun, `episodes` how many are open.

    With up to `episodes_max` open episodes, which every segment's header names, the largest record fits into a segment.
    """

    segment_bytes: int
    segments_max: int
    reserve_bytes: int
    episodes_max: int

    @classmethod
    def of(cls, settings: Settings) -> Capacity:
        """Raises `CallerError` for settings with which a queue could fill up and never be emptied, or lose a record."""
        if settings.spool_bytes_max - settings.spool_reserve_bytes < 3 * settings.segment_bytes:
            raise CallerError(
                f"spool_bytes_max ({settings.spool_bytes_max:,}) must hold the reserve"
                f" ({settings.spool_reserve_bytes:,}) and three segments ({settings.segment_bytes:,} each)"
            )
        least = header_bytes(_EPISODES_MIN) + frame_bytes(TYPE_BYTES_MAX, settings.record_bytes_max) + _COMMITS_BYTES
        left = settings.segment_bytes - least
        if left < 0:
            raise CallerError(
                f"segment_bytes ({settings.segment_bytes:,}) must hold a record of record_bytes_max"
                f" ({settings.record_bytes_max:,}) and {_EPISODES_MIN} open episodes: {least:,} at least"
            )
        return cls(
            settings.segment_bytes,
            settings.spool_bytes_max // settings.segment_bytes,
            settings.spool_reserve_bytes,
            _EPISODES_MIN + left // (header_bytes(1) - header_bytes(0)),
        )

    @property
    def end(self) -> int:
        """Records of a segment end here at the latest."""
        return self.segment_bytes - _COMMITS_BYTES

    def frame_bytes_max(self, *, episodes: int) -> int:
        """The largest frame that fits into an empty segment."""
        return self.end - header_bytes(episodes)

    def ordinary_end(self, *, spare: int, episodes: int) -> int:
        """Ordinary records of the current segment end here, so that the reserve stays free."""
        return min(self.end, self.end + spare * self.frame_bytes_max(episodes=episodes) - self.reserve_bytes)

    def admits(self, frame_bytes: int, *, offset: int, spare: int, episodes: int, reserved: bool) -> bool:
        """Whether a frame may be put when the current segment is full up to `offset`."""
        free = spare * self.frame_bytes_max(episodes=episodes) - frame_bytes
        if offset + frame_bytes <= self.end:
            free += self.end - offset
        elif spare == 0 or frame_bytes > self.frame_bytes_max(episodes=episodes):
            return False
        return free >= (0 if reserved else self.reserve_bytes)
