"""One recorder's folder: how it comes to be, what is in it, how it goes.

It gets its name when its `alive` is locked already, so nobody can take it for dead while it is being made. It loses
`alive` last, so a deletion that was cut short is recovered like any other dead folder.
"""

from __future__ import annotations

import os
from collections.abc import Iterator
from contextlib import contextmanager
from pathlib import Path
from typing import Final, NamedTuple

from pycrorm_async.errors import SpoolUnavailable
from pycrorm_async.events.ids import EpisodeId, parse_episode_id
from pycrorm_async.queue.locks import FileLock
from pycrorm_async.queue.progress import PROGRESS
from pycrorm_async.queue.segment import segment_numbers, segment_path, sync_folder

__all__ = [
    "ALIVE",
    "DRAIN",
    "MAKING",
    "MENDED",
    "REFUSED",
    "TAIL",
    "Holding",
    "available",
    "held_by",
    "make_folder",
    "remove_folder",
    "write_safely",
]

ALIVE: Final = "alive"
DRAIN: Final = "drain"
MAKING: Final = ".making"
MENDED: Final = f".mended{MAKING}"
"""What `repair` adds to the name of a new folder until it is whole."""
REFUSED: Final = ".refused"
TAIL: Final = ".tail"


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


def make_folder(spool: Path, name: str) -> tuple[Path, FileLock]:
    """A new folder below the spool, which is made if need be, and its `alive`. Raises `SpoolUnavailable`."""
    unfinished, folder = spool / f"{name}{MAKING}", spool / name
    with available(spool):
        spool.mkdir(parents=True, exist_ok=True)
        unfinished.mkdir()
        alive = FileLock.take(unfinished / ALIVE)
        if alive is None:
            raise SpoolUnavailable(unfinished, "was taken away while it was being made")
        unfinished.rename(folder)
        sync_folder(spool)
        sync_folder(spool.parent)
    return folder, alive


def remove_folder(folder: Path) -> None:
    """Deletes what is ours in it, and the folder unless somebody else left something there. Raises `OSError`."""
    # One made ahead goes first: left alone by a kill it would look like one whose header was lost. Then the oldest.
    for path in sorted((segment_path(folder, number) for number in segment_numbers(folder)), key=_is_begun):
        path.unlink()
    for path in list(folder.iterdir()):
        if path.suffix in {MAKING, TAIL}:
            path.unlink()
    for name in (PROGRESS, DRAIN, ALIVE):
        (folder / name).unlink(missing_ok=True)
    if not any(folder.iterdir()):
        folder.rmdir()


def _is_begun(segment: Path) -> bool:
    with segment.open("rb") as file:
        return file.read(1) != b"\0"


def write_safely(path: Path, content: bytes) -> None:
    """The file holds this, all of it or what it held before, also after a power cut. Raises `OSError`."""
    unfinished = path.with_name(f"{path.name}{MAKING}")
    with unfinished.open("wb") as file:
        file.write(content)
        file.flush()
        os.fsync(file.fileno())
    unfinished.replace(path)
    sync_folder(path.parent)
