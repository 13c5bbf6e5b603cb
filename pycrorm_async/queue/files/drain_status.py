"""How far a living recorder's folder is drained, said from process to process in one small file, `progress`.

The recorder says what is synced, whoever holds `drain` says what is stored and folded and why there will be no more. It
is a hint for the living alone: recovery does not look at it, and a reader believes it for nothing the segments do not
show. A folder without it is drained by its own process only.

    offset  type   by        what, in the byte order of the machine, which both sides share
    0       8 s    recorder  magic, "PYCRPROG"
    8       u64    recorder  format, 1
    64      u64    recorder  synced: all up to this position may leave the folder
            u64    recorder  1 when the queue is closed and `synced` is its last position
            u32    recorder  crc32 of these
    128     u64    drainer   stored: all up to this position is durable in the database
            u64    drainer   folded: all up to this position shows in the tables, or never will
            u32    drainer   n, length of the note
            u32    drainer   crc32 of these and the note
            n      drainer   the note, JSON

It is read and written by system calls and not mapped: a mapping of a file that somebody cuts is a SIGBUS, which kills a
plan. Half of what the other side is just writing is not believed: the checksum does not fit, and what was read before
stands.
"""

from __future__ import annotations

import os
from collections.abc import Mapping
from pathlib import Path
from struct import Struct
from typing import Final, NamedTuple
from zlib import crc32

import msgspec

from pycrorm_async.queue.files.file_access import open_file
from pycrorm_async.queue.files.locks import in_forked_child
from pycrorm_async.queue.files.names import DRAIN, PROGRESS

__all__ = ["Progress", "RecorderStatus", "DrainStatus", "DrainNote", "DrainStatusReader"]

_MAGIC: Final = b"PYCRPROG" + (1).to_bytes(8, "little")
_FILE_BYTES: Final = 4096
_RECORDER_AT, _RECORDER = 64, Struct("=QQI")
_DRAINER_AT, _DRAINER = 128, Struct("=QQII")
_NOTE_BYTES_MAX: Final = _FILE_BYTES - _DRAINER_AT - _DRAINER.size
_REASON_CHARACTERS_MAX: Final = 300


class RecorderStatus(NamedTuple):
    """What the recorder says."""

    synced: int = 0
    closed: bool = False


class DrainNote(msgspec.Struct, frozen=True, omit_defaults=True):
    """What the drainer says in words.

    Attributes:
        given_up: why nothing more will be acknowledged.
        away: why the database cannot take anything at this moment.
        stopped: by episode id, why it is refused or parked; the first ones, if there are many.
    """

    given_up: str | None = None
    away: str | None = None
    stopped: Mapping[str, str] = {}


class DrainStatus(NamedTuple):
    """What the drainer says."""

    stored: int = 0
    folded: int = 0
    note: DrainNote = DrainNote()


_NOTHING: Final = DrainStatus()


class Progress:
    """One side's view of the file. Made by the recorder, opened by everybody else."""

    def __init__(self, descriptor: int) -> None:
        self._descriptor = descriptor
        self._recorded = RecorderStatus()
        self._drained = DrainStatus()
        in_forked_child(self.close)

    @classmethod
    def make(cls, folder: Path, drained: DrainStatus = _NOTHING) -> Progress:
        """A new one; it has its name only when it is whole. Raises `OSError`."""
        path = folder / PROGRESS
        unfinished = path.with_suffix(".making")
        descriptor = open_file(unfinished, os.O_RDWR | os.O_TRUNC)
        try:
            os.posix_fallocate(descriptor, 0, _FILE_BYTES)
            os.pwrite(descriptor, _MAGIC, 0)
            made = cls(descriptor)
            made.tell_recorded(RecorderStatus())
            made.tell_drained(drained)
            unfinished.rename(path)
        except BaseException:
            os.close(descriptor)
            unfinished.unlink(missing_ok=True)
            raise
        return made

    @classmethod
    def open(cls, folder: Path, *, writing: bool) -> Progress | None:
        """The one in this folder, None if there is none that is whole and of this format. Raises other `OSError`."""
        flags = (os.O_RDWR if writing else os.O_RDONLY) | os.O_CLOEXEC
        try:
            descriptor = os.open(folder / PROGRESS, flags)
        except (FileNotFoundError, NotADirectoryError):
            return None
        if os.pread(descriptor, len(_MAGIC), 0) != _MAGIC or os.fstat(descriptor).st_size < _FILE_BYTES:
            os.close(descriptor)
            return None
        return cls(descriptor)

    def recorded(self) -> RecorderStatus:
        """What the recorder said last, as far as it could be read."""
        content = self._read(_RECORDER_AT, _RECORDER.size)
        if len(content) == _RECORDER.size:
            synced, closed, checksum = _RECORDER.unpack(content)
            if checksum == crc32(content[:-4]):
                self._recorded = RecorderStatus(synced, bool(closed))
        return self._recorded

    def tell_recorded(self, said: RecorderStatus) -> None:
        """For the recorder alone. Raises `OSError`."""
        content = _RECORDER.pack(said.synced, said.closed, 0)[:-4]
        self._write(content + crc32(content).to_bytes(4, _ORDER), _RECORDER_AT)

    def drained(self) -> DrainStatus:
        """What the drainer said last, as far as it could be read."""
        content = self._read(_DRAINER_AT, _FILE_BYTES - _DRAINER_AT)
        if len(content) < _DRAINER.size:
            return self._drained
        stored, folded, length, checksum = _DRAINER.unpack_from(content)
        note = content[_DRAINER.size : _DRAINER.size + length]
        if len(note) == length and checksum == crc32(note, crc32(content[: _DRAINER.size - 4])):
            try:
                self._drained = DrainStatus(stored, folded, msgspec.json.decode(note, type=DrainNote))
            except ValueError:  # a newer program says it in other words; the numbers are the same
                self._drained = DrainStatus(stored, folded)
        return self._drained

    def tell_drained(self, said: DrainStatus) -> None:
        """For the holder of `drain` alone. A note that is too long is cut. Raises `OSError`."""
        note = _fitting(said.note)
        content = _DRAINER.pack(said.stored, said.folded, len(note), 0)[:-4]
        checksum = crc32(note, crc32(content)).to_bytes(4, _ORDER)
        self._write(content + checksum + note, _DRAINER_AT)

    def close(self) -> None:
        """Gives up the file; what was read last stands. Twice is once."""
        if self._descriptor >= 0:
            os.close(self._descriptor)
            self._descriptor = -1

    def _read(self, offset: int, size: int) -> bytes:
        try:
            return os.pread(self._descriptor, size, offset) if self._descriptor >= 0 else b""
        except OSError:  # a hint that cannot be read is no hint
            return b""

    def _write(self, content: bytes, offset: int) -> None:
        if self._descriptor >= 0:
            os.pwrite(self._descriptor, content, offset)


_ORDER: Final = "little" if Struct("=H").pack(1)[0] else "big"


def _fitting(note: DrainNote) -> bytes:
    """The note as JSON, its reasons cut, and no more episodes than there is room for."""
    stopped = {episode: reason[:_REASON_CHARACTERS_MAX] for episode, reason in note.stopped.items()}
    while True:
        short = DrainNote(_cut(note.given_up), _cut(note.away), stopped)
        encoded = msgspec.json.encode(short)
        if len(encoded) <= _NOTE_BYTES_MAX:
            return encoded
        if not stopped:  # even these few words are too long in bytes
            return msgspec.json.encode(DrainNote("the reason is too long to be told here" if note.given_up else None))
        stopped = dict(list(stopped.items())[: len(stopped) // 2])


def _cut(text: str | None) -> str | None:
    return text if text is None else text[:_REASON_CHARACTERS_MAX]


class DrainStatusReader:
    """The recorder's side of `progress`. Making one offers the folder to whoever drains this spool."""

    def __init__(self, folder: Path, *, before: int = 0) -> None:
        """Nothing up to position `before` is in this folder. Raises `OSError`."""
        # Made here, so that whoever wants to drain need not make it: a folder that is being deleted stays deleted.
        os.close(open_file(folder / DRAIN, os.O_WRONLY))
        self._progress = Progress.make(folder, DrainStatus(before, before))
        self._told = RecorderStatus()

    def tell(self, *, synced: int, closed: bool) -> bool:
        """Says it if it is news; False if the disk did not take it, and then it is to be said again."""
        news = RecorderStatus(synced, closed)
        if news != self._told:
            try:
                self._progress.tell_recorded(news)
            except OSError:  # no reason to refuse the plan's events: the next look says it again
                return False
            self._told = news
        return True

    def believed(self, *, synced: int) -> DrainStatus:
        """What the drainer says. Nothing that is not synced left the folder, so it cannot be stored."""
        said = self._progress.drained()
        if max(said.stored, said.folded) > synced:
            return DrainStatus()
        return said

    def close(self) -> None:
        """Gives up the file; what was heard last stands."""
        self._progress.close()
