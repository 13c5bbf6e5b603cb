"""Exchange the drain status of a living recorder's folder between two processes, in one small file, `progress`.

The recorder writes the synced position; the drainer (the process that holds `drain`) writes the stored and folded
positions and why it cannot go further. The file is a hint between living processes: recovery ignores it, and a reader
trusts it only as far as the segments agree. A folder without it is drained by its own process only.

    offset  type   by        content, in the byte order of the machine, which both sides share
    0       8 s    recorder  magic, "PYCRPROG"
    8       u64    recorder  format, 1
    64      u64    recorder  synced: records up to this position may leave the folder
            u64    recorder  1 when the queue is closed and `synced` is its last position
            u32    recorder  crc32 of these
    128     u64    drainer   stored: records up to this position are durable in the database
            u64    drainer   folded: records up to this position are visible in the tables, or never will be
            u32    drainer   n, length of the note
            u32    drainer   crc32 of these and the note
            n      drainer   the note, JSON

Both sides use `pread` and `pwrite` and do not map the file, because truncating a mapped file raises SIGBUS, which kills
a plan. A reader that meets a half-written status sees a wrong checksum and keeps the status it read before.
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
from pycrorm_async.queue.files.locks import call_in_forked_child
from pycrorm_async.queue.files.names import DRAIN, PROGRESS

_MAGIC: Final = b"PYCRPROG" + (1).to_bytes(8, "little")
_FILE_BYTES: Final = 4096
_RECORDER_AT, _RECORDER = 64, Struct("=QQI")
_DRAINER_AT, _DRAINER = 128, Struct("=QQII")
_NOTE_BYTES_MAX: Final = _FILE_BYTES - _DRAINER_AT - _DRAINER.size
_REASON_CHARACTERS_MAX: Final = 300
"""Bounds each reason in the note, so that several fit into the file."""


class RecorderStatus(NamedTuple):
    """The recorder's part: the last synced position, and whether the queue is closed."""

    synced: int = 0
    closed: bool = False


class DrainNote(msgspec.Struct, frozen=True, omit_defaults=True):
    """The drainer's reasons.

    Attributes:
        failure: why the drainer will acknowledge no more records; None while it drains.
        unavailable: why the database is unavailable at the moment; None while it is available.
        stopped: by episode id, why the episode is refused or parked; only the first episodes, if there are many.
    """

    failure: str | None = msgspec.field(default=None, name="given_up")
    unavailable: str | None = msgspec.field(default=None, name="away")
    stopped: Mapping[str, str] = {}


class DrainStatus(NamedTuple):
    """The drainer's part: the stored and folded positions, and its note."""

    stored: int = 0
    folded: int = 0
    note: DrainNote = DrainNote()


_NOTHING_DRAINED: Final = DrainStatus()


class Progress:
    """One process' view of the file. The recorder makes it; every other process opens it."""

    def __init__(self, descriptor: int) -> None:
        self._descriptor = descriptor
        self._recorded = RecorderStatus()
        self._drained = DrainStatus()
        call_in_forked_child(self.close)

    @classmethod
    def make(cls, folder: Path, drained: DrainStatus = _NOTHING_DRAINED) -> Progress:
        """Create the file; it gets its name only when it is complete. Raises `OSError`."""
        path = folder / PROGRESS
        unfinished = path.with_suffix(".making")
        descriptor = open_file(unfinished, os.O_RDWR | os.O_TRUNC)
        try:
            os.posix_fallocate(descriptor, 0, _FILE_BYTES)
            os.pwrite(descriptor, _MAGIC, 0)
            progress = cls(descriptor)
            progress.write_recorder_status(RecorderStatus())
            progress.write_drain_status(drained)
            unfinished.rename(path)
        except BaseException:
            os.close(descriptor)
            unfinished.unlink(missing_ok=True)
            raise
        return progress

    @classmethod
    def open(cls, folder: Path, *, writing: bool) -> Progress | None:
        """Open the file in this folder; None if missing, incomplete or of another format. Raises other `OSError`."""
        flags = (os.O_RDWR if writing else os.O_RDONLY) | os.O_CLOEXEC
        try:
            descriptor = os.open(folder / PROGRESS, flags)
        except (FileNotFoundError, NotADirectoryError):
            return None
        try:
            is_ours = os.pread(descriptor, len(_MAGIC), 0) == _MAGIC and os.fstat(descriptor).st_size >= _FILE_BYTES
        except OSError:
            os.close(descriptor)
            raise
        if not is_ours:
            os.close(descriptor)
            return None
        return cls(descriptor)

    def recorded(self) -> RecorderStatus:
        """Read the recorder's status; a status that cannot be read leaves the previous one in force."""
        content = self._read(_RECORDER_AT, _RECORDER.size)
        if len(content) == _RECORDER.size:
            synced, closed, checksum = _RECORDER.unpack(content)
            if checksum == crc32(content[:-4]):
                self._recorded = RecorderStatus(synced, bool(closed))
        return self._recorded

    def write_recorder_status(self, status: RecorderStatus) -> None:
        """Write the recorder's status; only the recorder may. Raises `OSError`."""
        content = _RECORDER.pack(status.synced, status.closed, 0)[:-4]
        self._write(content + crc32(content).to_bytes(4, _ORDER), _RECORDER_AT)

    def drained(self) -> DrainStatus:
        """Read the drainer's status; a status that cannot be read leaves the previous one in force."""
        content = self._read(_DRAINER_AT, _FILE_BYTES - _DRAINER_AT)
        if len(content) < _DRAINER.size:
            return self._drained
        stored, folded, length, checksum = _DRAINER.unpack_from(content)
        note = content[_DRAINER.size : _DRAINER.size + length]
        if len(note) == length and checksum == crc32(note, crc32(content[: _DRAINER.size - 4])):
            try:
                self._drained = DrainStatus(stored, folded, msgspec.json.decode(note, type=DrainNote))
            except ValueError:  # a newer program may write another note; the positions keep their format
                self._drained = DrainStatus(stored, folded)
        return self._drained

    def write_drain_status(self, status: DrainStatus) -> None:
        """Write the drainer's status; only the holder of `drain` may. Shortens a long note. Raises `OSError`."""
        note = _encode_note(status.note)
        content = _DRAINER.pack(status.stored, status.folded, len(note), 0)[:-4]
        checksum = crc32(note, crc32(content)).to_bytes(4, _ORDER)
        self._write(content + checksum + note, _DRAINER_AT)

    def close(self) -> None:
        """Close the file; the last status read stays in force. Idempotent."""
        if self._descriptor >= 0:
            os.close(self._descriptor)
            self._descriptor = -1

    def _read(self, offset: int, size: int) -> bytes:
        try:
            return os.pread(self._descriptor, size, offset) if self._descriptor >= 0 else b""
        except OSError:  # the file is only a hint: the previous status stays in force
            return b""

    def _write(self, content: bytes, offset: int) -> None:
        if self._descriptor >= 0:
            os.pwrite(self._descriptor, content, offset)


_ORDER: Final = "little" if Struct("=H").pack(1)[0] else "big"


def _encode_note(note: DrainNote) -> bytes:
    """Encode the note as JSON, with reasons shortened and episodes dropped until it fits."""
    stopped = {episode: reason[:_REASON_CHARACTERS_MAX] for episode, reason in note.stopped.items()}
    while True:
        short = DrainNote(_shorten(note.failure), _shorten(note.unavailable), stopped)
        encoded = msgspec.json.encode(short)
        if len(encoded) <= _NOTE_BYTES_MAX:
            return encoded
        if not stopped:  # 300 characters may still take too many bytes
            return msgspec.json.encode(DrainNote("the reason is too long for this file" if note.failure else None))
        stopped = dict(list(stopped.items())[: len(stopped) // 2])


def _shorten(text: str | None) -> str | None:
    return text if text is None else text[:_REASON_CHARACTERS_MAX]


class DrainStatusReader:
    """The recorder's side of `progress`. Constructing one offers the folder to a drainer in another process."""

    def __init__(self, folder: Path, *, before: int = 0) -> None:
        """Create `progress` and `drain`; this folder begins after position `before`. Raises `OSError`."""
        # Create `drain` here: a drainer that created it could recreate a folder that is being deleted.
        os.close(open_file(folder / DRAIN, os.O_WRONLY))
        self._progress = Progress.make(folder, DrainStatus(before, before))
        self._published = RecorderStatus()

    def publish(self, *, synced: int, closed: bool) -> bool:
        """Write the recorder's status if it changed; False if the write failed and must be retried."""
        status = RecorderStatus(synced, closed)
        if status != self._published:
            try:
                self._progress.write_recorder_status(status)
            except OSError:  # must not refuse the plan's events; the sync thread retries
                return False
            self._published = status
        return True

    def read(self, *, synced: int) -> DrainStatus:
        """Read the drainer's status; one with positions beyond `synced`, which no drainer can have, counts as empty."""
        status = self._progress.drained()
        if max(status.stored, status.folded) > synced:
            return DrainStatus()
        return status

    def close(self) -> None:
        """Close the file; the last status read stays in force."""
        self._progress.close()
