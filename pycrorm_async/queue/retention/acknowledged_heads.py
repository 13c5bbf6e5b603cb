"""Remembers how far each episode was stored, below the spool, so that a log that went back is noticed.

    spool/stored/<log id>/heads        one line for each episode of each batch that was stored
    0192f3c0-…-9ab0 17 4002 1763845200 + 9f3c2a1b      id, number, head, UTC in seconds, mark, crc32 of all that

The number is 0 in lines that were taken along from another log (`forget_numbers`), because a number belongs to one log.

Of the lines of an episode the highest head counts (mark `+`), for compacting may change their order; one with the mark
`=` lowers it, where the log holds less and no segment has the rest.

All processes of a spool append to one file, each batch by one write after the log committed it and before the queue is
acknowledged: so what a process reads here was stored, by itself or by another. Lines that are torn or changed are left
out. The file is not synced: with a machine that loses power the last lines may go, and with them only what they could
prove.

Theory of operation. `refresh` reads what was appended since the last time; a file of another inode, or one that begins
differently, is read from its beginning. The inode alone does not tell: a file system gives the number of a file that
was replaced to the next one, so each compacted file begins with a random line. `note` appends, and appends again if the
file was replaced meanwhile. `_compact` writes what is still of use to a new file, gives it the name, and then copies
what was appended to the old one while it did: a writer that appended before the renaming is copied, one that appends
after it sees the new file and repeats. One process compacts at a time.
"""

from __future__ import annotations

import os
import secrets
from collections.abc import Callable, Mapping
from contextlib import suppress
from pathlib import Path
from typing import Final, NamedTuple
from zlib import crc32

from pycrorm_async.events.ids import EpisodeId, episode_text, parse_episode_id
from pycrorm_async.queue.files.file_access import create_folders, open_file
from pycrorm_async.queue.files.locks import FileLock
from pycrorm_async.queue.files.recorder_folder import write_safely

__all__ = ["AcknowledgedHeads", "Head", "forget_numbers"]

_NAME: Final = "heads"
_FILE_BYTES_MAX: Final = 2**20
"""A larger file is compacted: reading one takes some 20 ms at a start."""
_EPISODES_MAX: Final = 4_096
"""So many episodes are remembered, the latest; a third of what a file may hold, so that compacting is rare."""
_TRIES: Final = 5
_BEGINNING_BYTES: Final = 80
"""What tells a file from one that was given its inode: a compacted file's random line, or its first head."""


class Head(NamedTuple):
    """How far an episode was stored, under which number (0: that of another log), and when that was noted."""

    number: int
    head: int
    wall_s: int


class AcknowledgedHeads:
    """One process' view of the file. Raises nothing for a file that cannot be read or written: it proves nothing then.

    `faults` counts how often that was so.
    """

    def __init__(self, folder: Path, *, keep_s: float, wall_ns: Callable[[], int]) -> None:
        self.path = folder / _NAME
        self.faults = 0
        self._keep_s = keep_s
        self._wall_ns = wall_ns
        self._heads: dict[EpisodeId, Head] = {}
        self._last: EpisodeId | None = None
        self._number_max = 0
        self._inode = 0
        self._beginning = b""
        self._read_to = 0

    @property
    def all(self) -> Mapping[EpisodeId, Head]:
        """By episode, as read at the last refresh."""
        return self._heads

    @property
    def last(self) -> tuple[EpisodeId, int] | None:
        """The episode that was stored last, and how far."""
        return None if self._last is None else (self._last, self._heads[self._last].head)

    @property
    def number_max(self) -> int:
        """The highest number that an episode of this spool was given."""
        return self._number_max

    def refresh(self) -> None:
        """Read what was appended since, by whatever process."""
        try:
            with self.path.open("rb") as file:
                status = os.fstat(file.fileno())
                beginning = file.read(_BEGINNING_BYTES)
                is_same = status.st_ino == self._inode and beginning.startswith(self._beginning)
                if not is_same or status.st_size < self._read_to:
                    self._inode, self._read_to = status.st_ino, 0
                self._beginning = beginning
                if status.st_size > self._read_to:
                    file.seek(self._read_to)
                    content = file.read()
                    whole = content[: content.rfind(b"\n") + 1]
                    self._read_to += len(whole)
                    for line in whole.splitlines():
                        self._take(line)
        except FileNotFoundError:
            return
        except OSError:
            self.faults += 1

    def note(self, heads: Mapping[EpisodeId, tuple[int, int]], *, lowered: bool = False) -> None:
        """These episodes, by id, have this number and are stored up to this sequence, and no further if `lowered`."""
        now_s, mark = self._wall_ns() // 10**9, "=" if lowered else "+"
        lines = b"".join(_line(each, Head(number, head, now_s), mark) for each, (number, head) in heads.items())
        try:
            for _ in range(_TRIES):
                size = self._append(lines)
                if size is not None:
                    break
            else:
                self.faults += 1
                return
            if size > _FILE_BYTES_MAX:
                self._compact()
        except OSError:
            self.faults += 1

    def _append(self, lines: bytes) -> int | None:
        """The size of the file afterwards; None if it was replaced meanwhile."""
        try:
            descriptor = open_file(self.path, os.O_WRONLY | os.O_APPEND)
        except FileNotFoundError:  # of the folder, or the file was replaced at this moment
            create_folders(self.path.parents[2], self.path.parent)
            descriptor = open_file(self.path, os.O_WRONLY | os.O_APPEND)
        try:
            os.write(descriptor, b"\n" + lines)  # behind whatever a process that was killed left torn
            status = os.fstat(descriptor)
        finally:
            os.close(descriptor)
        with suppress(FileNotFoundError):
            if self.path.stat().st_ino == status.st_ino:
                return status.st_size
        return None

    def _compact(self) -> None:
        lock = FileLock.take(self.path.with_name(f"{_NAME}.lock"))
        if lock is None:  # another process does it
            return
        try:
            with self.path.open("rb") as old:
                self.refresh()
                old.seek(self._read_to)
                kept = self._of_use()
                write_safely(self.path, _content(kept))
                late = old.read()
            if late:
                self._append(late)
            self._heads = kept
        finally:
            lock.release()

    def _of_use(self) -> dict[EpisodeId, Head]:
        """The latest, in the order in which they were noted, and the one with the highest number."""
        oldest_s = self._wall_ns() // 10**9 - self._keep_s
        latest = dict(list(self._heads.items())[-_EPISODES_MAX:])
        return {
            episode: head
            for episode, head in self._heads.items()
            if head.number == self._number_max
            or episode == self._last
            or (episode in latest and head.wall_s >= oldest_s)
        }

    def _take(self, line: bytes) -> None:
        parts = line.split()
        if len(parts) != len(Head._fields) + 3:
            return
        *_, mark, checksum = parts
        try:
            if int(checksum, 16) != crc32(line[: line.rindex(b" ")]):
                return
            episode = parse_episode_id(parts[0].decode())
            head = Head(int(parts[1]), int(parts[2]), int(parts[3]))
        except ValueError:
            return
        before = self._heads.pop(episode, None)
        if before is not None and before.head > head.head and mark != b"=":
            head = before
        self._heads[episode] = head  # the latest last
        self._last = episode
        self._number_max = max(self._number_max, head.number)


def forget_numbers(folder: Path) -> None:
    """Replace every number in the file of this folder, which is taken along to another log, by 0. Raises `OSError`.

    No process may append meanwhile.
    """
    heads = AcknowledgedHeads(folder, keep_s=0, wall_ns=lambda: 0)
    heads.refresh()
    if heads.all:
        write_safely(heads.path, _content({each: head._replace(number=0) for each, head in heads.all.items()}))


def _content(heads: Mapping[EpisodeId, Head]) -> bytes:
    """A whole file; its first line is random, so that no other file begins as it does."""
    return secrets.token_hex(16).encode() + b"\n" + b"".join(_line(each, head) for each, head in heads.items())


def _line(episode: EpisodeId, head: Head, mark: str = "+") -> bytes:
    said = f"{episode_text(episode)} {head.number} {head.head} {head.wall_s} {mark}".encode()
    return said + b" %08x\n" % crc32(said)
