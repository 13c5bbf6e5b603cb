"""One recorder's folder: how it comes to be, what is in it, how it goes.

It gets its name when its `alive` is locked already, so nobody can take it for dead while it is being made. It loses
`alive` last, so a deletion that was cut short is recovered like any other dead folder.
"""

from __future__ import annotations

import os
from collections.abc import Iterator
from contextlib import contextmanager
from pathlib import Path
from typing import NamedTuple

from pycrorm_async.errors import PycrormError, SpoolUnavailable
from pycrorm_async.events.ids import EpisodeId, parse_episode_id
from pycrorm_async.queue.files.file_access import create_folder, create_spool, rewrite
from pycrorm_async.queue.files.file_system import check_file_system
from pycrorm_async.queue.files.locks import FileLock
from pycrorm_async.queue.files.names import ALIVE, DRAIN, MAKING, PROGRESS, REFUSED, TAIL
from pycrorm_async.queue.files.segment import segment_numbers, segment_path, sync_folder
from pycrorm_async.settings import FileAccess

__all__ = [
    "Holding",
    "available",
    "begin_folder",
    "fault_in",
    "finish_folder",
    "held_by",
    "make_folder",
    "remove_folder",
    "remove_made_ahead",
    "write_safely",
]


class Holding(NamedTuple):
    """Whose records a folder holds: all of a recorder's, or those of one `episode` that the database refused."""

    recorder: EpisodeId
    episode: EpisodeId | None


def held_by(name: str) -> Holding:
    """What a folder of this name holds. Raises `ValueError` for what is no name of ours."""
    recorder, dot, rest = name.partition(".")
    if not dot:
        return Holding(parse_episode_id(recorder), None)
    if not rest.endswith(REFUSED):
        raise ValueError(name)
    return Holding(parse_episode_id(recorder), parse_episode_id(rest.removesuffix(REFUSED)))


@contextmanager
def available(path: Path) -> Iterator[None]:
    """What the operating system refuses inside becomes a `SpoolUnavailable` that names its own path."""
    try:
        yield
    except OSError as error:
        where = Path(os.fsdecode(error.filename)) if isinstance(error.filename, str | bytes) else path
        raise SpoolUnavailable(where, error.strerror or str(error)) from error


def fault_in(folder: Path, error: Exception) -> PycrormError:
    """The error of one folder as an error of this package that names it: the other folders are not concerned."""
    if isinstance(error, PycrormError):
        return error
    return SpoolUnavailable(folder, f"cannot be read: {type(error).__name__}: {error}")


def make_folder(spool: Path, name: str, access: FileAccess = "owner") -> tuple[Path, FileLock]:
    """A new folder below the spool, which is made if need be, and its `alive`. Raises `SpoolUnavailable`."""
    unfinished, alive = begin_folder(spool, name, access)
    return finish_folder(unfinished), alive


def begin_folder(spool: Path, name: str, access: FileAccess = "owner") -> tuple[Path, FileLock]:
    """The same under an unfinished name, which no process that drains looks at. Raises `SpoolUnavailable`."""
    unfinished = spool / f"{name}{MAKING}"
    with available(spool):
        check_file_system(spool)
        create_spool(spool, access)
        create_folder(unfinished)
        alive = FileLock.take(unfinished / ALIVE)
        if alive is None:
            raise SpoolUnavailable(unfinished, "was taken away while it was being made")
    return unfinished, alive


def finish_folder(unfinished: Path, *, instead_of: Path | None = None) -> Path:
    """Give the folder its name; `instead_of` is no recorder's folder any more then. Raises `SpoolUnavailable`."""
    folder = unfinished.with_name(unfinished.name.removesuffix(MAKING))
    with available(folder):
        unfinished.rename(folder)
        if instead_of is not None:  # at once: recovery ends the open episodes of both, and of one they go on
            (instead_of / ALIVE).unlink(missing_ok=True)
        sync_folder(folder.parent)
        sync_folder(folder.parent.parent)
    return folder


def remove_folder(folder: Path) -> None:
    """Deletes what is ours in it, and the folder unless somebody else left something there. Raises `OSError`."""
    remove_made_ahead(folder)
    for number in segment_numbers(folder):  # the oldest first
        segment_path(folder, number).unlink()
    for path in list(folder.iterdir()):
        if path.suffix in {MAKING, TAIL}:
            path.unlink()
    for name in (PROGRESS, DRAIN, ALIVE):
        (folder / name).unlink(missing_ok=True)
    if not any(folder.iterdir()):
        folder.rmdir()


def remove_made_ahead(folder: Path) -> None:
    """Delete the segments that hold nothing yet, before those in use go: one that a kill left alone would look as if
    its header were lost. Raises `OSError`."""
    for path in [segment_path(folder, number) for number in segment_numbers(folder)]:
        if not _is_begun(path):
            path.unlink()


def _is_begun(segment: Path) -> bool:
    with segment.open("rb") as file:
        return file.read(1) != b"\0"


def write_safely(path: Path, content: bytes) -> None:
    """The file holds this, all of it or what it held before, also after a power cut. Raises `OSError`."""
    unfinished = path.with_name(f"{path.name}{MAKING}")
    with rewrite(unfinished) as file:
        file.write(content)
        file.flush()
        os.fsync(file.fileno())
    unfinished.replace(path)
    sync_folder(path.parent)
