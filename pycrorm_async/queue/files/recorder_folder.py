"""Create, name and delete one recorder's folder.

The folder gets its name only after its `alive` is locked, so that no process mistakes it for a dead one while it is
being created. It loses `alive` last, so that an interrupted deletion is recovered like any other dead folder.
"""

from __future__ import annotations

import os
import shutil
from collections.abc import Iterator
from contextlib import contextmanager, suppress
from pathlib import Path
from typing import NamedTuple

from pycrorm_async.errors import PycrormError, SpoolUnavailable
from pycrorm_async.events.ids import EpisodeId, parse_episode_id
from pycrorm_async.queue.files.file_access import create_folder, create_spool, rewrite
from pycrorm_async.queue.files.file_system import check_file_system
from pycrorm_async.queue.files.locks import FileLock
from pycrorm_async.queue.files.names import ALIVE, BLOBS, DRAIN, MAKING, PROGRESS, REFUSED, TAIL
from pycrorm_async.queue.files.segment import segment_numbers, segment_path, sync_folder
from pycrorm_async.settings import FileAccess


class FolderName(NamedTuple):
    """A folder's name: of a recorder's folder, or of the dead letters of one `episode` of that recorder."""

    recorder: EpisodeId
    episode: EpisodeId | None


def parse_folder_name(name: str) -> FolderName:
    """Parse the name of a recorder's folder or of a folder of dead letters. Raises `ValueError` for any other name."""
    recorder, dot, rest = name.partition(".")
    if not dot:
        return FolderName(parse_episode_id(recorder), None)
    if not rest.endswith(REFUSED):
        raise ValueError(name)
    return FolderName(parse_episode_id(recorder), parse_episode_id(rest.removesuffix(REFUSED)))


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


def make_folder(spool: Path, name: str, access: FileAccess = "owner") -> tuple[Path, FileLock]:
    """Create a recorder's folder, and the spool if missing; return it with its `alive`. Raises `SpoolUnavailable`."""
    unfinished, alive = begin_folder(spool, name, access)
    return finish_folder(unfinished), alive


def begin_folder(spool: Path, name: str, access: FileAccess = "owner") -> tuple[Path, FileLock]:
    """Create the folder under an unfinished name, which draining processes ignore. Raises `SpoolUnavailable`."""
    unfinished = spool / f"{name}{MAKING}"
    with wrap_os_errors(spool):
        check_file_system(spool)
        create_spool(spool, access)
        create_folder(unfinished)
        alive = FileLock.take(unfinished / ALIVE)
        if alive is None:
            raise SpoolUnavailable(unfinished, "was deleted while it was being created")
    return unfinished, alive


def finish_folder(unfinished: Path, *, replaced: Path | None = None) -> Path:
    """Give the folder its final name, and delete `alive` in the folder it replaces. Raises `SpoolUnavailable`."""
    folder = unfinished.with_name(unfinished.name.removesuffix(MAKING))
    with wrap_os_errors(folder):
        unfinished.rename(folder)
        if replaced is not None:  # immediately: recovering it would end episodes that continue in the new folder
            (replaced / ALIVE).unlink(missing_ok=True)
        sync_folder(folder.parent)
        sync_folder(folder.parent.parent)
    return folder


def remove_folder(folder: Path) -> None:
    """Delete our files in the folder, and the folder unless it contains files of others. Raises `OSError`."""
    remove_made_ahead(folder)
    for number in segment_numbers(folder):  # the oldest first
        segment_path(folder, number).unlink()
    with suppress(FileNotFoundError):
        shutil.rmtree(folder / BLOBS)
    for path in list(folder.iterdir()):
        if path.suffix in {MAKING, TAIL}:
            path.unlink()
    for name in (PROGRESS, DRAIN, ALIVE):
        (folder / name).unlink(missing_ok=True)
    if not any(folder.iterdir()):
        folder.rmdir()


def remove_made_ahead(folder: Path) -> None:
    """Delete the preallocated segments without a header. Raises `OSError`.

    Call this before deleting segments in use: if a kill left only a preallocated one, its header would seem lost.
    """
    for path in [segment_path(folder, number) for number in segment_numbers(folder)]:
        if not _is_begun(path):
            path.unlink()


def _is_begun(segment: Path) -> bool:
    with segment.open("rb") as file:
        return file.read(1) != b"\0"


def write_durably(path: Path, content: bytes) -> None:
    """Replace a file's content atomically, also across a power cut. Raises `OSError`."""
    unfinished = path.with_name(f"{path.name}{MAKING}")
    with rewrite(unfinished) as file:
        file.write(content)
        file.flush()
        os.fsync(file.fileno())
    unfinished.replace(path)
    sync_folder(path.parent)
