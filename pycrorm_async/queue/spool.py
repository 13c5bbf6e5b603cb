"""Manage a spool: the folder that holds the recorders of one database, and the note of that database's log id.

**Drain status.** Exchange the drain status of a living recorder's folder between two processes, in one small file,
`progress`.

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
import shutil
from collections.abc import Iterator, Mapping
from contextlib import contextmanager, suppress
from pathlib import Path
from struct import Struct
from typing import Final, NamedTuple
from zlib import crc32

import msgspec

from pycrorm_async.errors import PycrormError, SpoolForeign, SpoolTaken, SpoolUnavailable
from pycrorm_async.events.ids import EpisodeId, episode_text, parse_episode_id
from pycrorm_async.queue import locks
from pycrorm_async.queue.format import segments_in, sync_path
from pycrorm_async.settings import FileAccess

BINDING: Final = "log"
"""Name of the file with the id of the log that the spool is bound to."""
WRITER: Final = "writer"
"""The daemon that drains the spool holds the lock of this file."""


class RecorderFolder(NamedTuple):
    """A recorder's folder, or a folder of dead letters. `alive` is the state at the time of the listing.

    A dead recorder stays dead; a folder of dead letters is alive while a drainer may add to it.
    """

    path: Path
    alive: bool

    @property
    def name(self) -> str:
        return self.path.name

    @property
    def refused(self) -> str | None:
        """Id of the episode whose dead letters are kept here; None for a recorder's own folder."""
        episode = parse_folder_name(self.name).episode
        return None if episode is None else episode_text(episode)


class Spool:
    """A folder of recorders. Constructing one creates no file; a missing folder has no recorders.

    >>> Spool(Path("no.such.spool")).recorders()
    []
    """

    def __init__(self, path: Path, access: FileAccess = "owner") -> None:
        self.path = path
        self.access = access

    def recorders(self) -> list[RecorderFolder]:
        """List all recorders, oldest first, each before its dead letters. Raises `SpoolUnavailable`."""
        with wrap_os_errors(self.path):
            return [RecorderFolder(path, alive=_is_alive(path)) for path in self._entries() if _is_recorder(path)]

    def strangers(self) -> list[Path]:
        """List the entries of the spool that are not ours; no function touches them. Raises `SpoolUnavailable`."""
        with wrap_os_errors(self.path):
            return [
                path
                for path in self._entries()
                if path.name not in {BINDING, locks.STORED, WRITER} and not _is_recorder(path)
            ]

    def take_writer(self) -> locks.FileLock | None:
        """Take the lock of the daemon that drains this spool; None if a daemon holds it. Creates a missing spool.

        Raises `SpoolUnavailable`.
        """
        with wrap_os_errors(self.path):
            locks.create_spool(self.path, self.access)
            return locks.FileLock.take(self.path / WRITER)

    @property
    def has_writer(self) -> bool:
        """Return whether a daemon drains this spool now. Raises `SpoolUnavailable`."""
        with wrap_os_errors(self.path):
            return locks.is_locked(self.path / WRITER)

    def writer_note(self) -> bytes | None:
        """Read the note of the daemon that drains this spool now; None if there is none. Raises `SpoolUnavailable`."""
        with wrap_os_errors(self.path):
            return locks.read_note(self.path / WRITER) if locks.is_locked(self.path / WRITER) else None

    def bind(self, log_id: str) -> None:
        """Bind this spool to a log, the only one it may be drained into. Creates a missing spool.

        The binding is fixed while the spool contains a recorder's folder; an empty spool may be bound to another log.
        Therefore a recorder binds the spool again after it created its folder: from then on no process can rebind it.

        Raises `SpoolForeign`, which names both logs, if the spool belongs to another one, and `SpoolUnavailable`.
        """
        if not log_id or log_id != log_id.strip() or "\n" in log_id:
            raise ValueError(f"not an id: {log_id!r}")
        with wrap_os_errors(self.path):
            locks.create_spool(self.path, self.access)
            with locks.folder_lock(self.path):
                bound = self.log_id()
                if bound == log_id:
                    return
                if bound is not None and any(_is_recorder(path) for path in self._entries()):
                    raise SpoolForeign(
                        f"spool {self.path} belongs to log {bound}, not to log {log_id}:"
                        " open the database it belongs to, choose another spool, or move its records to this database"
                        " with `pycrorm spool rebind`"
                    )
                write_durably(self.path / BINDING, f"{log_id}\n".encode())

    def rebind(self, log_id: str) -> None:
        """Bind the spool to this log although it holds records; its kept segments move along.

        Raises `SpoolTaken` while a process records into the spool or drains it, and `SpoolUnavailable`; then the
        binding is unchanged.
        """
        writer = self.take_writer()
        if writer is None:
            raise SpoolTaken(self.path, "a `pycrorm writer` drains it: stop that first")
        try:
            with wrap_os_errors(self.path), locks.folder_lock(self.path):
                for recorder in self.recorders():
                    if recorder.alive:
                        raise SpoolTaken(recorder.path, "its process still records: end that first")
                    if locks.is_locked(recorder.path / locks.DRAIN):
                        raise SpoolTaken(recorder.path, "another process drains it: wait until that has finished")
                bound = self.log_id()
                if bound and bound != log_id and (self.path / locks.STORED / bound).is_dir():
                    for numbers in (self.path / locks.STORED / bound).glob(
                        f"{locks.NUMBERS}*"
                    ):  # they belong to that log
                        numbers.unlink()
                    with suppress(FileExistsError, NotADirectoryError):
                        (self.path / locks.STORED / bound).rename(self.path / locks.STORED / log_id)
                write_durably(self.path / BINDING, f"{log_id}\n".encode())
        finally:
            writer.release()

    def log_id(self) -> str | None:
        """Return the id of the log that this spool is bound to, or None. Raises `SpoolUnavailable`."""
        with wrap_os_errors(self.path):
            try:
                return (self.path / BINDING).read_text(encoding="utf-8").strip()
            except FileNotFoundError:
                return None
            except UnicodeDecodeError:
                raise SpoolUnavailable(self.path / BINDING, "does not contain the id of a log") from None

    def _entries(self) -> list[Path]:
        try:
            return sorted(self.path.iterdir())
        except FileNotFoundError:
            return []
        except NotADirectoryError:
            raise SpoolUnavailable(self.path, "is a file, not a folder; name a folder with --spool") from None


def _is_recorder(path: Path) -> bool:
    if not is_folder_name(path.name):
        return False
    try:
        (path / locks.ALIVE).lstat()
    except (FileNotFoundError, NotADirectoryError):
        return False
    except OSError:  # opening the folder reports the reason; the listing must not fail for all recorders
        return True
    return True


def _is_alive(path: Path) -> bool:
    """Return whether the recorder lives; False if its lock cannot be opened, which opening the folder reports."""
    try:
        return locks.is_locked(path / locks.ALIVE)
    except OSError:
        return False


# === recorder folder ==========================================================================================
#
# Create, name and delete one recorder's folder.
#
# The folder gets its name only after its `alive` is locked, so that no process mistakes it for a dead one while it is
# being created. It loses `alive` last, so that an interrupted deletion is recovered like any other dead folder.


class FolderName(NamedTuple):
    """A folder's name: of a recorder's folder, or of the dead letters of one `episode` of that recorder."""

    recorder: EpisodeId
    episode: EpisodeId | None


def parse_folder_name(name: str) -> FolderName:
    """Parse the name of a recorder's folder or of a folder of dead letters. Raises `ValueError` for any other name."""
    recorder, dot, rest = name.partition(".")
    if not dot:
        return FolderName(parse_episode_id(recorder), None)
    if not rest.endswith(locks.REFUSED):
        raise ValueError(name)
    return FolderName(parse_episode_id(recorder), parse_episode_id(rest.removesuffix(locks.REFUSED)))


def is_folder_name(name: str) -> bool:
    """Return whether `parse_folder_name` accepts this name."""
    try:
        parse_folder_name(name)
    except ValueError:
        return False
    return True


@contextmanager
def wrap_os_errors(path: Path) -> Iterator[None]:
    """Convert an `OSError` raised inside to a `SpoolUnavailable` that names the path in the error, else `path`."""
    try:
        yield
    except OSError as error:
        where = Path(os.fsdecode(error.filename)) if isinstance(error.filename, str | bytes) else path
        hint = "; make it writable, or name another folder with --spool" if isinstance(error, PermissionError) else ""
        raise SpoolUnavailable(where, f"{error.strerror or error}{hint}") from error


def folder_error(folder: Path, error: Exception) -> PycrormError:
    """Convert an error met in one folder to an error of this package that names the folder."""
    if isinstance(error, PycrormError):
        return error
    return SpoolUnavailable(folder, f"cannot be read: {type(error).__name__}: {error}")


def make_folder(spool: Path, name: str, access: FileAccess = "owner") -> tuple[Path, locks.FileLock]:
    """Create a recorder's folder, and the spool if missing; return it with its `alive`. Raises `SpoolUnavailable`."""
    folder = spool / name
    unfinished = spool / f"{name}{locks.MAKING}"  # draining processes ignore it
    with wrap_os_errors(spool):
        locks.check_file_system(spool)
        locks.create_spool(spool, access)
        locks.create_folder(unfinished)
        alive = locks.FileLock.take(unfinished / locks.ALIVE)
        if alive is None:
            raise SpoolUnavailable(unfinished, "was deleted while it was being created")
    with wrap_os_errors(folder):
        unfinished.rename(folder)
        sync_path(spool)
        sync_path(spool.parent)
    return folder, alive


def remove_folder(folder: Path) -> None:
    """Delete our files in the folder, and the folder unless it contains files of others. Raises `OSError`."""
    remove_made_ahead(folder)
    for path in segments_in(folder).values():  # the oldest first
        path.unlink()
    with suppress(FileNotFoundError):
        shutil.rmtree(folder / locks.BLOBS)
    for path in list(folder.iterdir()):
        if path.suffix in {locks.MAKING, locks.TAIL}:
            path.unlink()
    for name in (locks.PROGRESS, locks.DRAIN, locks.ALIVE):
        (folder / name).unlink(missing_ok=True)
    if not any(folder.iterdir()):
        folder.rmdir()


def remove_made_ahead(folder: Path) -> None:
    """Delete the preallocated segments without a header. Raises `OSError`.

    Call this before deleting segments in use: if a kill left only a preallocated one, its header would seem lost.
    """
    for path in segments_in(folder).values():
        with path.open("rb") as file:
            is_begun = file.read(1) != b"\0"
        if not is_begun:
            path.unlink()


def write_durably(path: Path, content: bytes) -> None:
    """Replace a file's content atomically, also across a power cut. Raises `OSError`."""
    unfinished = path.with_name(f"{path.name}{locks.MAKING}")
    with os.fdopen(locks.open_file(unfinished, os.O_WRONLY | os.O_TRUNC), "wb") as file:
        file.write(content)
        file.flush()
        os.fsync(file.fileno())
    unfinished.replace(path)
    sync_path(path.parent)


# === drain status =============================================================================================

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
        pending: why the tables do not show stored records; None while they are brought up to date.
    """

    failure: str | None = msgspec.field(default=None, name="given_up")
    unavailable: str | None = msgspec.field(default=None, name="away")
    stopped: Mapping[str, str] = {}
    pending: str | None = None


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
        locks.call_in_forked_child(self.close)

    @classmethod
    def make(cls, folder: Path) -> Progress:
        """Create the file, which offers the folder to a drainer in another process. Raises `OSError`.

        It gets its name only when it is complete. Creates `drain` too: a drainer that created it could recreate a
        folder that is being deleted.
        """
        os.close(locks.open_file(folder / locks.DRAIN, os.O_WRONLY))
        path = folder / locks.PROGRESS
        unfinished = path.with_suffix(".making")
        descriptor = locks.open_file(unfinished, os.O_RDWR | os.O_TRUNC)
        try:
            os.posix_fallocate(descriptor, 0, _FILE_BYTES)
            os.pwrite(descriptor, _MAGIC, 0)
            progress = cls(descriptor)
            progress.write_drain_status(_NOTHING_DRAINED)
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
            descriptor = os.open(folder / locks.PROGRESS, flags)
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
        """Write the recorder's status if it changed; only the recorder may. Raises `OSError`."""
        if status == self._recorded:
            return
        content = _RECORDER.pack(status.synced, status.closed, 0)[:-4]
        self._write(content + crc32(content).to_bytes(4, _ORDER), _RECORDER_AT)
        self._recorded = status

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
        short = DrainNote(_shorten(note.failure), _shorten(note.unavailable), stopped, _shorten(note.pending))
        encoded = msgspec.json.encode(short)
        if len(encoded) <= _NOTE_BYTES_MAX:
            return encoded
        if not stopped:  # 300 characters may still take too many bytes
            return msgspec.json.encode(DrainNote("the reason is too long for this file" if note.failure else None))
        stopped = dict(list(stopped.items())[: len(stopped) // 2])


def _shorten(text: str | None) -> str | None:
    return text if text is None else text[:_REASON_CHARACTERS_MAX]
