"""Manage a spool: the folder that holds the recorders of one database, and the note of that database's log id."""

from __future__ import annotations

from contextlib import suppress
from pathlib import Path
from typing import Final, NamedTuple

from pycrorm_async.errors import SpoolForeign, SpoolTaken, SpoolUnavailable
from pycrorm_async.events.ids import episode_text
from pycrorm_async.queue.files.file_access import create_spool
from pycrorm_async.queue.files.locks import FileLock, folder_lock, is_locked, read_note
from pycrorm_async.queue.files.names import ALIVE, DRAIN, STORED
from pycrorm_async.queue.files.recorder_folder import is_folder_name, parse_folder_name, wrap_os_errors, write_durably
from pycrorm_async.queue.retention.acknowledged_heads import forget_numbers
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
                if path.name not in {BINDING, STORED, WRITER} and not _is_recorder(path)
            ]

    def take_writer(self) -> FileLock | None:
        """Take the lock of the daemon that drains this spool; None if a daemon holds it. Creates a missing spool.

        Raises `SpoolUnavailable`.
        """
        with wrap_os_errors(self.path):
            create_spool(self.path, self.access)
            return FileLock.take(self.path / WRITER)

    @property
    def has_writer(self) -> bool:
        """Return whether a daemon drains this spool now. Raises `SpoolUnavailable`."""
        with wrap_os_errors(self.path):
            return is_locked(self.path / WRITER)

    def writer_note(self) -> bytes | None:
        """Read the note of the daemon that drains this spool now; None without one. Raises `SpoolUnavailable`."""
        with wrap_os_errors(self.path):
            return read_note(self.path / WRITER) if is_locked(self.path / WRITER) else None

    def bind(self, log_id: str) -> None:
        """Bind this spool to a log, the only one it may be drained into. Creates a missing spool.

        The binding is fixed while the spool contains a recorder's folder; an empty spool may be bound to another log.
        Therefore a recorder binds the spool again after it created its folder: from then on no process can rebind it.

        Raises `SpoolForeign`, which names both logs, if the spool belongs to another one, and `SpoolUnavailable`.
        """
        if not log_id or log_id != log_id.strip() or "\n" in log_id:
            raise ValueError(f"not an id: {log_id!r}")
        with wrap_os_errors(self.path):
            create_spool(self.path, self.access)
            with folder_lock(self.path):
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
        """Bind the spool to this log although it holds records; its kept segments and heads move along.

        Raises `SpoolTaken` while a process records into the spool or drains it, and `SpoolUnavailable`; then the
        binding is unchanged.
        """
        writer = self.take_writer()
        if writer is None:
            raise SpoolTaken(self.path, "a `pycrorm writer` drains it: stop that first")
        try:
            with wrap_os_errors(self.path), folder_lock(self.path):
                for recorder in self.recorders():
                    if recorder.alive:
                        raise SpoolTaken(recorder.path, "its process still records: end that first")
                    if is_locked(recorder.path / DRAIN):
                        raise SpoolTaken(recorder.path, "another process drains it: wait until that has finished")
                bound = self.log_id()
                if bound and bound != log_id and (self.path / STORED / bound).is_dir():
                    forget_numbers(self.path / STORED / bound)
                    with suppress(FileExistsError, NotADirectoryError):
                        (self.path / STORED / bound).rename(self.path / STORED / log_id)
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
        (path / ALIVE).lstat()
    except (FileNotFoundError, NotADirectoryError):
        return False
    except OSError:  # opening the folder reports the reason; the listing must not fail for all recorders
        return True
    return True


def _is_alive(path: Path) -> bool:
    """Return whether the recorder lives; False if its lock cannot be opened, which opening the folder reports."""
    try:
        return is_locked(path / ALIVE)
    except OSError:
        return False
