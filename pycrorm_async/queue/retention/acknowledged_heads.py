"""Remember the stored head of each episode in a file below the spool, to detect a log that went back.

    spool/stored/<log id>/heads        one line for each episode of each stored batch
    0192f3c0-…-9ab0 17 4002 1763845200 + 9f3c2a1b      id, number, head, UTC in seconds, mark, crc32 of the rest

The number is 0 in lines moved from another log (`forget_numbers`), because a number belongs to one log. Of an episode's
lines the highest head counts (mark `+`), because compacting may reorder lines. A line with the mark `=` lowers the
head, where the log holds less and no segment has the missing records.

All processes of a spool append to one file. Each batch is one write, after the log committed it and before the queue
is acknowledged, so every line states a committed fact. Readers skip torn and changed lines. The file is not synced: a
power cut may lose its last lines, and with them only the ability to detect that the log lost these events.

**Theory of operation.** `refresh` reads the lines appended since the last call. It reads a file with another inode or
another beginning from the start. The inode alone is not enough, because a file system reuses the inode number of a
replaced file; therefore each compacted file begins with a random line. `note` appends, and appends again if the file
was replaced meanwhile. `_compact` writes the useful lines to a new file, renames it, and then copies the lines appended
to the old file during that time: a line appended before the renaming is copied, and a writer that appends after it sees
the new file and repeats. A lock file admits one compacting process at a time.
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
from pycrorm_async.queue.files.recorder_folder import write_durably

_NAME: Final = "heads"
_FILE_BYTES_MAX: Final = 2**20
"""Bounds the file before it is compacted: reading this much takes some 20 ms at every start."""
_EPISODES_MAX: Final = 4_096
"""Bounds the episodes that compacting keeps, the latest ones; a third of a file, so that compacting is rare."""
_ATTEMPTS: Final = 5
"""Bounds the attempts to append while other processes replace the file."""
_BEGINNING_BYTES: Final = 80
"""Length of the beginning that identifies a file with a reused inode: a random line, or the first head."""


class Head(NamedTuple):
    """An episode's number (0 if that of another log), its stored head, and the time of the note."""

    number: int
    head: int
    wall_s: int


class AcknowledgedHeads:
    """One process' view of the file.

    An operating system error raises no exception, because losing the file only weakens detection; `faults` counts them.
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
        """The heads by episode, as of the last refresh."""
        return self._heads

    @property
    def last(self) -> tuple[EpisodeId, int] | None:
        """The episode stored last, and its head."""
        return None if self._last is None else (self._last, self._heads[self._last].head)

    @property
    def number_max(self) -> int:
        """The highest number of an episode of this spool."""
        return self._number_max

    def refresh(self) -> None:
        """Read the lines that any process appended since the last call."""
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
                        self._add_line(line)
        except FileNotFoundError:
            return
        except OSError:
            self.faults += 1

    def note(self, heads: Mapping[EpisodeId, tuple[int, int]], *, lowered: bool = False) -> None:
        """Append number and stored head of these episodes; with `lowered` the head counts even if it is lower."""
        now_s, mark = self._wall_ns() // 10**9, "=" if lowered else "+"
        lines = b"".join(_line(episode, Head(number, head, now_s), mark) for episode, (number, head) in heads.items())
        try:
            for _ in range(_ATTEMPTS):
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
        """Append the lines; return the file's new size, or None if the file was replaced meanwhile."""
        try:
            descriptor = open_file(self.path, os.O_WRONLY | os.O_APPEND)
        except FileNotFoundError:  # the folder is missing, or the file was replaced just now
            create_folders(self.path.parents[2], self.path.parent)
            descriptor = open_file(self.path, os.O_WRONLY | os.O_APPEND)
        try:
            os.write(descriptor, b"\n" + lines)  # "\n" ends a line that a killed process left torn
            status = os.fstat(descriptor)
        finally:
            os.close(descriptor)
        with suppress(FileNotFoundError):
            if self.path.stat().st_ino == status.st_ino:
                return status.st_size
        return None

    def _compact(self) -> None:
        lock = FileLock.take(self.path.with_name(f"{_NAME}.lock"))
        if lock is None:  # another process compacts
            return
        try:
            with self.path.open("rb") as old:
                self.refresh()
                old.seek(self._read_to)
                useful = self._useful_heads()
                write_durably(self.path, _content(useful))
                late = old.read()
            if late:
                self._append(late)
            self._heads = useful
        finally:
            lock.release()

    def _useful_heads(self) -> dict[EpisodeId, Head]:
        """Return the latest heads in the order of their notes, the last one, and the one with the highest number."""
        oldest_s = self._wall_ns() // 10**9 - self._keep_s
        latest = dict(list(self._heads.items())[-_EPISODES_MAX:])
        return {
            episode: head
            for episode, head in self._heads.items()
            if head.number == self._number_max
            or episode == self._last
            or (episode in latest and head.wall_s >= oldest_s)
        }

    def _add_line(self, line: bytes) -> None:
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
        self._heads[episode] = head  # a dict keeps the order of the notes
        self._last = episode
        self._number_max = max(self._number_max, head.number)


def forget_numbers(folder: Path) -> None:
    """Set every number in the file of this folder to 0, before it moves to another log. Raises `OSError`.

    No process may append during this call.
    """
    heads = AcknowledgedHeads(folder, keep_s=0, wall_ns=lambda: 0)
    heads.refresh()
    if heads.all:
        write_durably(heads.path, _content({episode: head._replace(number=0) for episode, head in heads.all.items()}))


def _content(heads: Mapping[EpisodeId, Head]) -> bytes:
    """Encode a whole file; its first line is random, so that no other file begins like it."""
    return secrets.token_hex(16).encode() + b"\n" + b"".join(_line(episode, head) for episode, head in heads.items())


def _line(episode: EpisodeId, head: Head, mark: str = "+") -> bytes:
    fields = f"{episode_text(episode)} {head.number} {head.head} {head.wall_s} {mark}".encode()
    return fields + b" %08x\n" % crc32(fields)
