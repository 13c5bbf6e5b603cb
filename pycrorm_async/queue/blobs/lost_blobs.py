"""Truncate a dead recorder's folder before the first unsynced record whose blob a power cut took.

A sync makes blobs durable before it appends the commit frame of the records that refer to them. So only a record that
no commit frame covers can be on the disk without its blob. Such a record counts as a hole, like one whose bytes are
missing: it and all later records belong to the torn tail.
"""

from __future__ import annotations

from pathlib import Path
from typing import NamedTuple

from pycrorm_async.events.blobs import references_in
from pycrorm_async.queue.blobs.blob_files import is_whole
from pycrorm_async.queue.files.frame import COMMIT, Frame
from pycrorm_async.queue.files.names import BLOBS
from pycrorm_async.queue.files.reader import Cursor
from pycrorm_async.queue.files.scan import read_header, seal, survey
from pycrorm_async.queue.files.segment import header_bytes, read_segment, segment_path


class _Referring(NamedTuple):
    """A record with the blobs it refers to; `offset` is the sum of the frames before it in its segment."""

    segment: int
    offset: int
    position: int
    names: tuple[str, ...]


def truncate_at_lost_blob(folder: Path, recorder: bytes) -> None:
    """Truncate the segments of a locked folder; copies the tail aside first. Raises `OSError` and `SpoolForeign`.

    Leaves a damaged folder as it is, because a repair decides about its records.
    """
    if not (folder / BLOBS).is_dir():
        return
    unsynced: list[_Referring] = []
    sizes: dict[int, int] = {}

    def note(segment: int, frame: Frame) -> None:
        if frame.kind == COMMIT:
            unsynced[:] = [each for each in unsynced if each.position > frame.position]
        elif references := references_in(frame.type.decode(), frame.payload):
            names = tuple(each.hash for each in references)
            unsynced.append(_Referring(segment, sizes.get(segment, 0), frame.position, names))
        sizes[segment] = sizes.get(segment, 0) + frame.size

    prefix, damage, _ = survey(folder, recorder, on_frame=note)
    if damage is not None:
        return
    for each in unsynced:
        if not all(is_whole(folder, name) for name in each.names):
            path = segment_path(folder, each.segment)
            header = read_header(path, read_segment(path), recorder=recorder, number=each.segment)
            assert header is not None, "the segment was scanned"
            offset = header_bytes(len(header.open)) + each.offset
            seal(folder, prefix._replace(cut=Cursor(each.segment, offset, each.position - 1)))
            return
