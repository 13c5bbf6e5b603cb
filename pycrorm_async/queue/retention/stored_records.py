"""Read stored records again: each recorder's kept segments and those still in its folder.

Yields only records that a commit frame covers, because others may be lost with the machine. Files may be deleted during
the reading; their records are left out.
"""

from __future__ import annotations

from collections.abc import Iterator
from pathlib import Path
from typing import NamedTuple

from pycrorm_async.errors import FilesError, SpoolDamaged
from pycrorm_async.events.envelope import Record
from pycrorm_async.queue.files.recorder_folder import is_folder_name, parse_folder_name
from pycrorm_async.queue.files.scan import SegmentScanner
from pycrorm_async.queue.files.segment import segment_numbers, segment_path
from pycrorm_async.queue.files.spool import Spool
from pycrorm_async.queue.retention.stored_segments import stored_in
from pycrorm_async.queue.sources.dead_source import computed_ends


class StoredRecorder(NamedTuple):
    """A recorder's segments by number. `over` if its own folder is deleted, because all its records are stored."""

    name: str
    segments: dict[int, Path]
    over: bool


def stored_recorders(spool: Path, log_id: str) -> list[StoredRecorder]:
    """List every recorder with records that may be stored in this log, oldest first. Raises `FilesError`."""
    kept = stored_in(spool, log_id)
    present = {each.name for each in Spool(spool).recorders()}
    names = set(present)
    if kept is not None and kept.is_dir():
        names |= {each.name for each in kept.iterdir() if is_folder_name(each.name) and each.is_dir()}
    recorders = []
    for name in sorted(names):
        # List the source folder first, so that a segment moved meanwhile is listed twice rather than missed.
        segments = _segments(spool / name)
        if kept is not None:
            segments |= _segments(kept / name)
        recorders.append(StoredRecorder(name, dict(sorted(segments.items())), over=name not in present))
    return recorders


def stored_records(recorder: StoredRecorder) -> Iterator[list[Record]]:
    """Yield a recorder's records, one segment at a time, then the computed ends if the recorder is over.

    Stops at a file that is missing or damaged.
    """
    ready: list[Record] = []
    scanner = SegmentScanner(
        Path(), parse_folder_name(recorder.name).recorder, on_record=ready.append, segments=recorder.segments
    )
    yielded = 0
    more = True
    try:
        while more:
            more = scanner.step()
            if more or not recorder.over:
                count = scanner.prefix.cut.position - len(scanner.uncommitted) - scanner.prefix.start.position - yielded
            else:
                ready += computed_ends(scanner.prefix)
                count = len(ready)
            yield ready[:count]
            del ready[:count]
            yielded += count
    except (FileNotFoundError, SpoolDamaged, FilesError):
        return


def _segments(folder: Path) -> dict[int, Path]:
    try:
        return {number: segment_path(folder, number) for number in segment_numbers(folder)}
    except (FileNotFoundError, NotADirectoryError):
        return {}
