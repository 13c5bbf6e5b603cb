"""Reads again what was stored: of each recorder the segments that are kept, and those that are still in its folder.

Nothing is given that no commit frame covers, for it may be lost with the machine. Files may go meanwhile: what cannot
be read any more cannot be offered.
"""

from __future__ import annotations

from collections.abc import Iterator
from pathlib import Path
from typing import NamedTuple

from pycrorm_async.errors import FilesError, SpoolDamaged
from pycrorm_async.events.envelope import Record
from pycrorm_async.queue.files.recorder_folder import held_by
from pycrorm_async.queue.files.scan import SegmentScanner
from pycrorm_async.queue.files.segment import segment_numbers, segment_path
from pycrorm_async.queue.files.spool import Spool
from pycrorm_async.queue.retention.stored_segments import stored_in
from pycrorm_async.queue.sources.dead_source import computed_ends

__all__ = ["StoredRecorder", "stored_recorders", "stored_records"]


class StoredRecorder(NamedTuple):
    """A recorder's segments by number. `over` when its own folder is gone: all that it ever wrote was stored."""

    name: str
    segments: dict[int, Path]
    over: bool


def stored_recorders(spool: Path, log_id: str) -> list[StoredRecorder]:
    """Every recorder of which something may have been stored in this log, the oldest first. Raises `FilesError`."""
    kept = stored_in(spool, log_id)
    present = {each.name for each in Spool(spool).recorders()}
    names = set(present)
    if kept is not None and kept.is_dir():
        names |= {each.name for each in kept.iterdir() if _is_recorder(each)}
    found = []
    for name in sorted(names):
        # First where they come from: one that is moved meanwhile is found twice and not missed.
        segments = _segments(spool / name)
        if kept is not None:
            segments |= _segments(kept / name)
        found.append(StoredRecorder(name, dict(sorted(segments.items())), over=name not in present))
    return found


def stored_records(recorder: StoredRecorder) -> Iterator[list[Record]]:
    """Its records, a segment at a time, then the computed ends of a recorder that is over.

    Ends early where a file is gone or damaged.
    """
    ready: list[Record] = []
    walk = SegmentScanner(Path(), held_by(recorder.name).recorder, found=ready.append, segments=recorder.segments)
    given = 0
    more = True
    try:
        while more:
            more = walk.step()
            if more or not recorder.over:
                whole = walk.kept.cut.position - len(walk.unsaid) - walk.kept.start.position - given
            else:
                ready += computed_ends(walk.kept)
                whole = len(ready)
            yield ready[:whole]
            del ready[:whole]
            given += whole
    except (FileNotFoundError, SpoolDamaged, FilesError):
        return


def _segments(folder: Path) -> dict[int, Path]:
    try:
        return {number: segment_path(folder, number) for number in segment_numbers(folder)}
    except (FileNotFoundError, NotADirectoryError):
        return {}


def _is_recorder(path: Path) -> bool:
    try:
        held_by(path.name)
    except ValueError:
        return False
    return path.is_dir()
