"""The spool: the folder all recorders of one database write below, and the note which database that is."""

from __future__ import annotations

from pathlib import Path
from typing import Final, NamedTuple

from pycrorm_async.errors import SpoolForeign, SpoolUnavailable
from pycrorm_async.events.ids import episode_text
from pycrorm_async.queue.folder import ALIVE, available, held_by, write_safely
from pycrorm_async.queue.locks import FileLock, is_locked, one_at_a_time

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

    def __init__(self, path: Path) -> None:
        self.path = path

    def recorders(self) -> list[RecorderFolder]:
        """All recorders, oldest first, each before what was refused of it. Raises `SpoolUnavailable`."""
        with available(self.path):
            return [
                RecorderFolder(path, alive=is_locked(path / ALIVE)) for path in self._entries() if _is_recorder(path)
            ]

    def strangers(self) -> list[Path]:
        """What lies in the spool and is not ours; it is left alone. Raises `SpoolUnavailable`."""
        with available(self.path):
            return [path for path in self._entries() if path.name not in {BINDING, WRITER} and not _is_recorder(path)]

    def take_writer(self) -> FileLock | None:
        """The lock of the one daemon that drains this spool, which is made if need be; None if there is one.

        Raises `SpoolUnavailable`.
        """
        with available(self.path):
            self.path.mkdir(parents=True, exist_ok=True)
            return FileLock.take(self.path / WRITER)

    @property
    def has_writer(self) -> bool:
        """Whether a daemon drains this spool now. Raises `SpoolUnavailable`."""
        with available(self.path):
            return is_locked(self.path / WRITER)

    def bind(self, log_id: str) -> None:
        """Notes that this spool is drained into this log; the spool is made if need be.

        It stays so as long as a recorder's folder is in it: an empty one may be bound to another log. Whoever records
        here binds it once more when his folder is there, so that nobody can have bound it to another in between.

        Raises `SpoolForeign` naming both if it belongs to another, `SpoolUnavailable` if it cannot be noted.
        """
        if not log_id or log_id != log_id.strip() or "\n" in log_id:
            raise ValueError(f"not an id: {log_id!r}")
        with available(self.path):
            self.path.mkdir(parents=True, exist_ok=True)
            with one_at_a_time(self.path):
                bound = self.log_id()
                if bound == log_id:
                    return
                if bound is not None and any(_is_recorder(path) for path in self._entries()):
                    raise SpoolForeign(
                        f"spool {self.path} belongs to log {bound}, not to log {log_id}:"
                        " open the database it belongs to, or choose another spool"
                    )
                write_safely(self.path / BINDING, f"{log_id}\n".encode())

    def log_id(self) -> str | None:
        """The log this spool is bound to. Raises `SpoolUnavailable`."""
        with available(self.path):
            try:
                return (self.path / BINDING).read_text(encoding="utf-8").strip()
            except FileNotFoundError:
                return None

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
    return (path / ALIVE).exists()
