"""The spool: the folder all recorders of one database write below, and the note which database that is."""

from __future__ import annotations

from contextlib import suppress
from pathlib import Path
from typing import Final, NamedTuple

from pycrorm_async.errors import SpoolForeign, SpoolTaken, SpoolUnavailable
from pycrorm_async.events.ids import episode_text
from pycrorm_async.queue.files.file_access import create_spool
from pycrorm_async.queue.files.locks import FileLock, is_locked, note_in, one_at_a_time
from pycrorm_async.queue.files.names import ALIVE, DRAIN, STORED
from pycrorm_async.queue.files.recorder_folder import available, held_by, write_safely
from pycrorm_async.queue.retention.acknowledged_heads import forget_numbers
from pycrorm_async.settings import FileAccess

__all__ = ["Spool", "RecorderFolder"]

BINDING: Final = "log"
WRITER: Final = "writer"


class RecorderFolder(NamedTuple):
    """One recorder's folder, or what was refused of it. `alive`: its process lived when this was looked up.

    A dead recorder never lives again; a folder of refused records is alive while somebody may put more into it.
    """

    path: Path
    alive: bool

    @property
    def name(self) -> str:
        return self.path.name

    @property
    def refused(self) -> str | None:
        """Id of the episode whose refused records are kept here; None for a recorder's own folder."""
        episode = held_by(self.name).episode
        return None if episode is None else episode_text(episode)


class Spool:
    """A folder of recorders. Making one touches nothing; a folder that is not there has no recorders.

    >>> Spool(Path("no.such.spool")).recorders()
    []
    """

    def __init__(self, path: Path, access: FileAccess = "owner") -> None:
        self.path = path
        self.access = access

    def recorders(self) -> list[RecorderFolder]:
        """All recorders, oldest first, each before what was refused of it. Raises `SpoolUnavailable`."""
        with available(self.path):
            return [RecorderFolder(path, alive=_lives(path)) for path in self._entries() if _is_recorder(path)]

    def strangers(self) -> list[Path]:
        """What lies in the spool and is not ours; it is left alone. Raises `SpoolUnavailable`."""
        with available(self.path):
            return [
                path
                for path in self._entries()
                if path.name not in {BINDING, STORED, WRITER} and not _is_recorder(path)
            ]

    def take_writer(self) -> FileLock | None:
        """The lock of the one daemon that drains this spool, which is made if need be; None if there is one.

        Raises `SpoolUnavailable`.
        """
        with available(self.path):
            create_spool(self.path, self.access)
            return FileLock.take(self.path / WRITER)

    @property
    def has_writer(self) -> bool:
        """Whether a daemon drains this spool now. Raises `SpoolUnavailable`."""
        with available(self.path):
            return is_locked(self.path / WRITER)

    def writer_note(self) -> bytes | None:
        """The note of the daemon that drains this spool now; None if there is none. Raises `SpoolUnavailable`."""
        with available(self.path):
            return note_in(self.path / WRITER) if is_locked(self.path / WRITER) else None

    def bind(self, log_id: str) -> None:
        """Notes that this spool is drained into this log; the spool is made if need be.

        It stays so as long as a recorder's folder is in it: an empty one may be bound to another log. Whoever records
        here binds it once more when his folder is there, so that nobody can have bound it to another in between.

        Raises `SpoolForeign` naming both if it belongs to another, `SpoolUnavailable` if it cannot be noted.
        """
        if not log_id or log_id != log_id.strip() or "\n" in log_id:
            raise ValueError(f"not an id: {log_id!r}")
        with available(self.path):
            create_spool(self.path, self.access)
            with one_at_a_time(self.path):
                bound = self.log_id()
                if bound == log_id:
                    return
                if bound is not None and any(_is_recorder(path) for path in self._entries()):
                    raise SpoolForeign(
                        f"spool {self.path} belongs to log {bound}, not to log {log_id}:"
                        " open the database it belongs to, choose another spool, or store in this database what"
                        " it holds with `pycrorm spool rebind`"
                    )
                write_safely(self.path / BINDING, f"{log_id}\n".encode())

    def rebind(self, log_id: str) -> None:
        """Binds the spool to this log whatever is in it, and takes along what is kept of what the log before stored.

        Raises `SpoolTaken` while a process records into it or drains it, and `SpoolUnavailable`; then nothing changed.
        """
        writer = self.take_writer()
        if writer is None:
            raise SpoolTaken(self.path, "a `pycrorm writer` drains it: end that first")
        try:
            with available(self.path), one_at_a_time(self.path):
                for each in self.recorders():
                    if each.alive:
                        raise SpoolTaken(each.path, "its process still records: end that first")
                    if is_locked(each.path / DRAIN):
                        raise SpoolTaken(each.path, "another process stores what is in it: wait for that first")
                bound = self.log_id()
                if bound and bound != log_id and (self.path / STORED / bound).is_dir():
                    forget_numbers(self.path / STORED / bound)
                    with suppress(FileExistsError, NotADirectoryError):
                        (self.path / STORED / bound).rename(self.path / STORED / log_id)
                write_safely(self.path / BINDING, f"{log_id}\n".encode())
        finally:
            writer.release()

    def log_id(self) -> str | None:
        """The log this spool is bound to. Raises `SpoolUnavailable`."""
        with available(self.path):
            try:
                return (self.path / BINDING).read_text(encoding="utf-8").strip()
            except FileNotFoundError:
                return None
            except UnicodeDecodeError:
                raise SpoolUnavailable(self.path / BINDING, "does not hold the id of a log") from None

    def _entries(self) -> list[Path]:
        try:
            return sorted(self.path.iterdir())
        except FileNotFoundError:
            return []
        except NotADirectoryError:
            raise SpoolUnavailable(self.path, "is a file, not a folder") from None


def _is_recorder(path: Path) -> bool:
    try:
        held_by(path.name)
    except ValueError:
        return False
    try:
        (path / ALIVE).lstat()
    except (FileNotFoundError, NotADirectoryError):
        return False
    except OSError:  # what opens the folder says why it cannot; the others are not concerned
        return True
    return True


def _lives(path: Path) -> bool:
    """Whether the recorder lives; not where its lock cannot be opened, which is then said by what opens the folder."""
    try:
        return is_locked(path / ALIVE)
    except OSError:
        return False
