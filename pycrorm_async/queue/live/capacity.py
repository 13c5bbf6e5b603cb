"""Whether a frame may be put: how much one recorder may hold, and what is kept back for ends and observations. Pure.

Space is given out in whole segments, so that the files never hold more than `spool_bytes_max`. At the end of each there
is room for two commit frames: a sync that began before the last record came, and the one that covers it.
"""

from __future__ import annotations

from typing import NamedTuple

from pycrorm_async.errors import CallerError
from pycrorm_async.queue.files.frame import COMMIT_BYTES, TYPE_BYTES_MAX, frame_bytes
from pycrorm_async.queue.files.segment import SEGMENT_BYTES_MAX, header_bytes
from pycrorm_async.settings import Settings

__all__ = ["Capacity"]

_COMMITS_BYTES = 2 * COMMIT_BYTES
_EPISODES_MIN = 16


class Capacity(NamedTuple):
    """What is allowed. `spare` below is how many segments may still be begun, `episodes` how many are open.

    With up to `episodes_max` open episodes, which every segment's header names, the largest record fits into a segment.
    The declarations in use, which every segment begins with, take their room from that of the episodes: `declared`.
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
        if settings.segment_bytes > SEGMENT_BYTES_MAX:
            raise CallerError(f"segment_bytes ({settings.segment_bytes:,}) must be at most {SEGMENT_BYTES_MAX:,}")
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

    def room_to_declare(self, *, episodes: int, declared: int) -> int:
        """How large a declaration may be that every segment is to begin with, beside those that take `declared` bytes:
        the largest record fits behind them and so many open episodes, and behind sixteen."""
        return header_bytes(self.episodes_max) - header_bytes(max(episodes, _EPISODES_MIN)) - declared

    def takes_episode(self, *, episodes: int, declared: int) -> bool:
        """Whether one more may be open."""
        return header_bytes(episodes + 1) + declared <= header_bytes(self.episodes_max)

    def frame_bytes_max(self, *, episodes: int, declared: int = 0) -> int:
        """The largest frame that fits into a segment behind its header and the declarations in use."""
        return self.end - header_bytes(episodes) - declared

    def ordinary_end(self, *, spare: int, episodes: int, declared: int = 0) -> int:
        """Ordinary records of the current segment end here, so that the reserve stays free."""
        return min(
            self.end, self.end + spare * self.frame_bytes_max(episodes=episodes, declared=declared) - self.reserve_bytes
        )

    def admits(
        self, frame_bytes: int, *, offset: int, spare: int, episodes: int, reserved: bool, declared: int = 0
    ) -> bool:
        """Whether a frame may be put when the current segment is full up to `offset`."""
        empty = self.frame_bytes_max(episodes=episodes, declared=declared)
        free = spare * empty - frame_bytes
        if offset + frame_bytes <= self.end:
            free += self.end - offset
        elif spare == 0 or frame_bytes > empty:
            return False
        return free >= (0 if reserved else self.reserve_bytes)
