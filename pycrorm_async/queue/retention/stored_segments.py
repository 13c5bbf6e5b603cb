"""Keeps segments after all their records are stored, so that a log that went back can be offered them again.

    spool/stored/<log id>/<recorder>/00000001.segment

A segment gets here by one rename, when it would otherwise be deleted, and is never written again. What was stored in
another log, before an empty spool was bound to this one, stays apart from what was stored in this one.

Kept segments are a copy of what a database holds: they take no room from what is still to be stored. They are deleted
the oldest first: after `keep_stored_s`, above `keep_stored_bytes`, above `FILES_MAX`, and when the disk is full.
"""

from __future__ import annotations

import logging
import os
from collections.abc import Callable, Iterator
from contextlib import suppress
from pathlib import Path
from typing import Final, NamedTuple

from pycrorm_async.errors import SpoolUnavailable
from pycrorm_async.queue.files.file_access import create_folders
from pycrorm_async.queue.files.names import STORED
from pycrorm_async.queue.files.segment import segment_numbers, segment_path
from pycrorm_async.queue.files.spool import Spool
from pycrorm_async.settings import Settings

__all__ = ["StoredSegments", "KeptSegment", "FILES_MAX", "kept_segments", "stored_in"]

FILES_MAX: Final = 4_096
"""Bounds how many segments are kept: to list so many takes some 20 ms, which every recorder that ends waits for."""

_LOOK_NS: Final = 60 * 10**9
"""How often a process that keeps segments looks for those that are too old."""
_BLOCK_BYTES: Final = 4_096
_TRIES: Final = 5

_log = logging.getLogger("pycrorm_async")


class KeptSegment(NamedTuple):
    """A segment that is kept. `stored_ns` is the wall time at which all in it was stored, or later."""

    stored_ns: int
    bytes: int
    path: Path


def stored_in(spool: Path, log_id: str | None) -> Path | None:
    """The folder for what was stored in this log; None for an id that cannot name a folder."""
    if not log_id or "/" in log_id or log_id.startswith("."):
        return None
    return spool / STORED / log_id


def kept_segments(spool: Path) -> list[KeptSegment]:
    """All that are kept, in the order in which they go; of one recorder always the lowest number first.

    What is deleted or moved meanwhile is left out. Raises other `OSError`.
    """
    return sorted(segment for folder in _folders(spool / STORED) for segment in _segments(folder))


def _folders(stored: Path) -> Iterator[Path]:
    for log in _children(stored):
        yield from _children(log)


def _children(folder: Path) -> list[Path]:
    try:
        with os.scandir(folder) as entries:
            return [Path(entry.path) for entry in entries if entry.is_dir(follow_symlinks=False)]
    except FileNotFoundError:
        return []


def _segments(folder: Path) -> Iterator[KeptSegment]:
    after_ns = 0
    with suppress(FileNotFoundError):
        for number in segment_numbers(folder):
            path = segment_path(folder, number)
            with suppress(FileNotFoundError):
                status = path.stat()
                after_ns = max(after_ns, status.st_mtime_ns)  # a clock that was set back makes no hole
                yield KeptSegment(after_ns, -(-status.st_size // _BLOCK_BYTES) * _BLOCK_BYTES, path)


class StoredSegments:
    """What one process does to the kept segments of a spool. Any number of processes may do so at once."""

    def __init__(self, spool: Path, settings: Settings, *, wall_ns: Callable[[], int]) -> None:
        self._spool = spool
        self._keep_ns = round(settings.keep_stored_s * 1e9)
        self._keep_bytes = settings.keep_stored_bytes
        self._wall_ns = wall_ns
        self._looked_ns: int | None = None
        self._bytes = 0

    def keep(self, segment: Path, *, length: int | None = None) -> None:
        """Move this segment away, cut to `length`, or delete it where nothing is kept. Raises `OSError`.

        Nobody may have the part of it mapped that is cut off.
        """
        kept = self._moved(segment, length) if self._keep_ns and self._keep_bytes else 0
        if not kept:
            segment.unlink(missing_ok=True)
            return
        self._bytes += kept
        now_ns = self._wall_ns()
        if self._looked_ns is None or self._bytes > self._keep_bytes or abs(now_ns - self._looked_ns) > _LOOK_NS:
            try:
                self.prune()
            except OSError as error:
                _log.warning("kept segments cannot be looked through: %s", error)

    def prune(self) -> None:
        """Delete what is too old or too much. Raises `OSError`."""
        now_ns = self._looked_ns = self._wall_ns()
        segments = kept_segments(self._spool)
        self._bytes = sum(each.bytes for each in segments)
        for place, each in enumerate(segments):
            if (
                each.stored_ns > now_ns - self._keep_ns
                and self._bytes <= self._keep_bytes
                and len(segments) - place <= FILES_MAX
            ):
                break
            self._bytes -= each.bytes
            _delete(each.path)

    def make_room(self, size: int) -> bool:
        """Delete the oldest ones, of so many bytes together; False if nothing is kept any more."""
        freed = 0
        with suppress(OSError):  # the caller names the full disk
            for each in kept_segments(self._spool):
                if freed >= size:
                    break
                _delete(each.path)
                freed += each.bytes
        return freed > 0

    def _moved(self, segment: Path, length: int | None) -> int:
        """How many bytes are kept of it now; 0 if it cannot be kept."""
        try:
            folder = stored_in(self._spool, Spool(self._spool).log_id())
            if folder is None:
                return 0
            if length is not None:
                os.truncate(segment, length)
            now_ns = self._wall_ns()
            os.utime(segment, ns=(now_ns, now_ns))
            target = folder / segment.parent.name / segment.name
            for _ in range(_TRIES):
                create_folders(self._spool, target.parent)
                with suppress(FileNotFoundError):  # another process deleted the folder, which was empty
                    segment.rename(target)
                    return target.stat().st_size
        except FileNotFoundError:  # a process that was killed had moved it before
            return 0
        except (OSError, SpoolUnavailable) as error:
            _log.warning("%s is stored and cannot be kept: %s", segment, getattr(error, "strerror", None) or error)
        return 0


def _delete(segment: Path) -> None:
    segment.unlink(missing_ok=True)
    with suppress(OSError):  # more segments are in it
        segment.parent.rmdir()
