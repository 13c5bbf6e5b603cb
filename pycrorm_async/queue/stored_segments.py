"""Keep segments after all their records are stored, to refill a log that went back.

    spool/stored/<log id>/<recorder>/00000001.segment
    spool/stored/<log id>/<recorder>/00000001.segment.blobs/<sha256>
    spool/stored/<log id>/numbers        the numbers of episodes in that log

One rename moves a segment here instead of deleting it; it is not written again. Its blobs are deleted with it. Segments
stored in another log, before an empty spool was bound to this one, are in that log's folder.

Kept segments duplicate records of the database, so they must not compete with records still to be stored. They are
deleted, oldest first, after `keep_stored_s`, above `keep_stored_bytes`, above `FILES_MAX`, and when the disk is full.
"""

import logging
import mmap
import os
import shutil
from collections.abc import Callable, Iterable, Iterator, Mapping, Sequence
from contextlib import suppress
from pathlib import Path
from typing import Final, NamedTuple
from zlib import crc32

from pycrorm_async.errors import SpoolUnavailable
from pycrorm_async.events.ids import EpisodeId, episode_text, parse_episode_id
from pycrorm_async.queue.blobs import file_bytes, kept_with, rounded
from pycrorm_async.queue.format import segments_in
from pycrorm_async.queue.locks import NUMBERS, STORED, create_folders, open_file
from pycrorm_async.queue.spool import Spool
from pycrorm_async.settings import Settings

FILES_MAX: Final = 4_096
"""Bounds the number of kept segments: every recorder that ends lists them, which takes some 20 ms for this many."""

_PRUNE_INTERVAL_NS: Final = 60 * 10**9
"""Interval at which a process that keeps segments deletes those that are too old."""

_log = logging.getLogger("pycrorm_async")


class KeptSegment(NamedTuple):
    """A kept segment with its blobs. `stored_ns` is the wall time at which its records were all stored, or later."""

    stored_ns: int
    bytes: int
    path: Path


def stored_in(spool: Path, log_id: str | None) -> Path | None:
    """Return the folder for segments stored in this log; None for an id that cannot name a folder."""
    if not log_id or "/" in log_id or log_id.startswith("."):
        return None
    return spool / STORED / log_id


def kept_segments(spool: Path) -> list[KeptSegment]:
    """List all kept segments in the order of deletion; of one recorder the lowest number comes first.

    Leaves out files deleted or moved during the listing. Raises other `OSError`.
    """
    folders = [folder for log in _children(spool / STORED) for folder in _children(log)]
    return sorted(segment for folder in folders for segment in _segments(folder))


def _children(folder: Path) -> list[Path]:
    try:
        with os.scandir(folder) as entries:
            return [Path(entry.path) for entry in entries if entry.is_dir(follow_symlinks=False)]
    except FileNotFoundError:
        return []


def _segments(folder: Path) -> Iterator[KeptSegment]:
    after_ns = 0
    with suppress(FileNotFoundError):
        for path in segments_in(folder).values():
            with suppress(FileNotFoundError):
                status = path.stat()
                after_ns = max(after_ns, status.st_mtime_ns)  # keeps the order by number if the clock was set back
                yield KeptSegment(after_ns, rounded(status.st_size) + _blob_bytes(path), path)


def _blob_bytes(segment: Path) -> int:
    blobs = kept_with(segment)
    return sum(rounded(file_bytes([each])) for each in blobs.iterdir()) if blobs.is_dir() else 0


class StoredSegments:
    """One process' access to the kept segments of a spool. Any number of processes may use it at once."""

    def __init__(self, spool: Path, settings: Settings, *, wall_ns: Callable[[], int]) -> None:
        self._spool = spool
        self._keep_ns = round(settings.keep_stored_s * 1e9)
        self._keep_bytes = settings.keep_stored_bytes
        self._wall_ns = wall_ns
        self._pruned_ns: int | None = None
        self._bytes = 0

    def keep(self, segment: Path, *, length: int | None = None, blobs: Sequence[Path] = ()) -> None:
        """Move a segment and these blobs here; delete them if they cannot be kept. Raises `OSError`.

        Truncates the segment to `length`. No process may have the truncated part mapped, because reading it would raise
        SIGBUS.
        """
        kept_bytes = self._move(segment, length, blobs) if self._keep_ns and self._keep_bytes else 0
        if not kept_bytes:
            for path in (*blobs, segment):
                path.unlink(missing_ok=True)
            return
        self._bytes += kept_bytes
        now_ns = self._wall_ns()
        if (
            self._pruned_ns is None
            or self._bytes > self._keep_bytes
            or abs(now_ns - self._pruned_ns) > _PRUNE_INTERVAL_NS
        ):
            try:
                self.prune()
            except OSError as error:
                _log.warning("kept segments cannot be listed, so old ones are not deleted: %s", error)

    def prune(self) -> None:
        """Delete the segments beyond the limits of age, bytes and number. Raises `OSError`."""
        now_ns = self._pruned_ns = self._wall_ns()
        segments = kept_segments(self._spool)
        self._bytes = sum(each.bytes for each in segments)
        for index, each in enumerate(segments):
            if (
                each.stored_ns > now_ns - self._keep_ns
                and self._bytes <= self._keep_bytes
                and len(segments) - index <= FILES_MAX
            ):
                break
            self._bytes -= each.bytes
            _delete(each.path)

    def make_room(self, size: int) -> bool:
        """Delete the oldest kept segments, at least `size` bytes; False if there is none to delete."""
        freed = 0
        with suppress(OSError):  # the caller reports the full disk
            for each in kept_segments(self._spool):
                if freed >= size:
                    break
                _delete(each.path)
                freed += each.bytes
        return freed > 0

    def _move(self, segment: Path, length: int | None, blobs: Sequence[Path]) -> int:
        """Move a segment and its blobs; return their size in bytes, or 0 if they cannot be kept."""
        try:
            folder = stored_in(self._spool, Spool(self._spool).log_id())
            if folder is None:
                return 0
            if length is not None:
                os.truncate(segment, length)
            now_ns = self._wall_ns()
            os.utime(segment, ns=(now_ns, now_ns))
            target = folder / segment.parent.name / segment.name
            create_folders(self._spool, kept_with(target) if blobs else target.parent)
            for blob in blobs:
                with suppress(FileNotFoundError):
                    blob.replace(kept_with(target) / blob.name)
            segment.rename(target)
            return target.stat().st_size + _blob_bytes(target)
        except FileNotFoundError:  # a process that was then killed has moved it, or another deleted the empty folder
            return 0
        except (OSError, SpoolUnavailable) as error:
            _log.warning(
                "stored segment %s cannot be kept, so it is deleted: %s",
                segment,
                getattr(error, "strerror", None) or error,
            )
        return 0


def files_with(files: Iterable[Path], episode: EpisodeId) -> Iterator[Path]:
    """Yield those of these files that have events of an episode, by its id; files may be deleted meanwhile."""
    for path in files:
        with (
            suppress(FileNotFoundError, IsADirectoryError, ValueError),  # ValueError: an empty file
            path.open("rb") as file,
            mmap.mmap(file.fileno(), 0, access=mmap.ACCESS_READ) as content,
        ):
            if content.find(episode) >= 0:
                yield path


def forget_stored(spool: Path, episodes: Iterable[EpisodeId]) -> dict[EpisodeId, list[Path]]:
    """Delete the kept segments with events of these episodes; return, by episode, the files that still have some.

    Deletes also the segments before them of the same recorder, because a healing reads segments without a gap. Files in
    recorders' own folders stay: a process writes them, or their other records are still to be stored.
    """
    held: dict[EpisodeId, list[Path]] = {}
    for episode in episodes:
        for folder in [folder for log in _children(spool / STORED) for folder in _children(log)]:
            segments = segments_in(folder)
            last = max(files_with(segments.values(), episode), default=None)
            for each in segments.values():
                if last is not None and each <= last:
                    _delete(each)
        if held_in := [*files_with(sorted(spool.rglob("*")), episode)]:
            held[episode] = held_in
    return held


def _delete(segment: Path) -> None:
    shutil.rmtree(kept_with(segment), ignore_errors=True)
    segment.unlink(missing_ok=True)
    with suppress(OSError):  # it contains more segments
        segment.parent.rmdir()


# === episode numbers ==========================================================================================

_NUMBERS_BYTES_MAX: Final = 2**20
"""Bounds each of the two files: together they hold the numbers of the last 20,000 to 40,000 episodes."""
_NOTED_MAX: Final = 10_000
"""Bounds the episodes that a process remembers to have noted; it may note the others again."""


class EpisodeNumbers:
    """The numbers that a log gave to episodes, so that an episode that the log lost gets its own number again.

        0192f3c0-…-9ab0 17 9f3c2a1b      id, number, crc32 of both

    All processes of a spool append lines to one file; a full file replaces the one before it. A line that is torn or
    missing costs an episode its number, and no event.
    """

    def __init__(self, folder: Path) -> None:
        self._path = folder / NUMBERS
        self._full = folder / f"{NUMBERS}.full"
        self._noted: set[EpisodeId] = set()

    def note(self, numbers: Mapping[EpisodeId, int]) -> None:
        """Append the numbers that this process has not noted yet. An `OSError` is logged."""
        new = {each: number for each, number in numbers.items() if each not in self._noted}
        if not new:
            return
        if len(self._noted) > _NOTED_MAX:
            self._noted.clear()
        self._noted.update(new)
        fields = [f"{episode_text(each)} {number}".encode() for each, number in new.items()]
        lines = b"".join(b"\n%b %08x" % (each, crc32(each)) for each in fields)  # "\n" ends a torn line
        try:
            create_folders(self._path.parents[2], self._path.parent)
            with os.fdopen(open_file(self._path, os.O_WRONLY | os.O_APPEND), "ab") as file:
                file.write(lines)
                if file.tell() > _NUMBERS_BYTES_MAX:
                    self._path.replace(self._full)
        except OSError as error:
            _log.warning("numbers of episodes cannot be noted in %s: %s", self._path, error)

    def read(self) -> dict[EpisodeId, int]:
        """Return the numbers that any process has noted; none from a file that cannot be read."""
        numbers = {}
        for path in (self._full, self._path):
            with suppress(OSError):
                for line in path.read_bytes().splitlines():
                    fields, _, checksum = line.rpartition(b" ")
                    if checksum == b"%08x" % crc32(fields):
                        episode, number = fields.decode().split()
                        numbers[parse_episode_id(episode)] = int(number)
        return numbers
