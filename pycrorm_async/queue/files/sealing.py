"""What is done to what another process wrote: on the disk before it is given away, and cut before it is written on."""

from __future__ import annotations

import os
from collections.abc import Iterable
from pathlib import Path

from pycrorm_async.queue.files.recorder_folder import TAIL, write_safely
from pycrorm_async.queue.files.scan import ValidPrefix
from pycrorm_async.queue.files.segment import read_segment, segment_path, sync_folder

__all__ = ["seal", "make_safe", "tails"]


def seal(folder: Path, kept: ValidPrefix) -> None:
    """Cuts the files where the records end; what is cut off is copied aside first, to `<segment>.tail`.

    Twice is once, and killed at any point it can be done again. Raises `OSError`.
    """
    for path, tail in tails(folder, kept):
        if tail:
            write_safely(path.with_name(f"{path.name}{TAIL}"), tail)
    for number in kept.numbers:
        path = segment_path(folder, number)
        if number > kept.cut.number:
            path.unlink(missing_ok=True)
        elif number == kept.cut.number:
            with path.open("rb+") as file:
                file.truncate(kept.cut.offset)
                os.fsync(file.fileno())
    sync_folder(folder)


def make_safe(folder: Path, numbers: Iterable[int]) -> None:
    """These segments are on the disk, the first of them first. Raises `OSError`.

    A killed process' last records are there for all who read, and yet may be nowhere but in the page cache. If they
    were given away like this and lost in a power cut, the log would hold events that the next computed ends replace.
    """
    for number in numbers:
        descriptor = os.open(segment_path(folder, number), os.O_RDONLY | os.O_CLOEXEC)
        try:
            os.fdatasync(descriptor)
        finally:
            os.close(descriptor)
    sync_folder(folder)


def tails(folder: Path, kept: ValidPrefix) -> list[tuple[Path, bytes]]:
    """For each file that reaches behind the cut what is there, without the zeros at its end. Raises `OSError`."""
    cut = kept.cut
    return [
        (path, read_segment(path)[cut.offset if number == cut.number else 0 :].rstrip(b"\0"))
        for number in kept.numbers
        if number >= cut.number and (path := segment_path(folder, number)).exists()
    ]
