"""Keep events in a write-ahead queue: files that survive the process at once and a power cut soon after.

    spool/                     one folder, bound to one database
      log                      id of that database's log, one line; fixed while the spool holds a recorder's folder
      writer                   locked by the daemon that drains the spool
      stored/<log id>/         segments whose records are all stored, and numbers of episodes (`stored_segments.py`)
      <recorder>/              one recorder, one life of a process; the name is its UUID, so names sort by time
        alive                  locked (flock) by the recorder as long as it lives
        drain                  locked by the process that drains the folder
        progress               how far another process has drained the folder (`spool.py`)
        00000001.segment       append-only, numbered without gaps, oldest deleted first, never reused
        00000002.segment       the last one may be allocated ahead: all zero
        00000001.segment.tail  the torn bytes cut off the end of a segment
        blobs/<sha256>         a content too large for an event (`blobs.py`)
      <recorder>.<episode>.refused/   dead letters of this episode (`sources.py`), in the same format
      <recorder>.damaged/      a copy of a damaged folder, which `repair` made before it replaced segments

All numbers in segments are little endian, and every structure begins at a multiple of 8 bytes.

**Segment**: a header, contiguous frames, then zeros to the end of the file.

    offset  type  header of a segment
    0       8 s   magic, "PYCRQSEG"
    8       u32   format, 1; a program refuses a newer format than its own
    12      u32   salt: crc32 of the recorder's id and the number as u64
    16      16 s  the recorder's id
    32      u64   number of the segment, 1 …
    40      u64   base: position of its first record
    48      u32   n, number of open episodes
    52      u32   crc32 of bytes 56 to the header's end, continued over bytes 0 to 52
    56      n of  the open episodes: id 16 s, then of its last record: sequence u64, wall_ns i64, monotonic_ns i64

**Frame**: 64 bytes, then the name of the event's type, the payload, and zeros up to the next multiple of 8.

    offset  type  header of a frame    event (1)          declaration (2)    commit (3)
    0       u8    kind                 1                  2                  3
    1       u8    length of the type's name                                  0
    2       u16   version of the type                                        0
    4       u32   length of the payload                                      4
    8       u64   position             its own            its own            last one covered
    16      u64   sequence             in the episode     0                  records since the commit before
    24      i64   wall_ns              UTC, since 1970
    32      i64   monotonic_ns
    40      16 s  episode              UUID               zeros              zeros
    56      u32   salt                 that of the segment
    60      u32   crc32 of the bytes after the header, with padding, continued over bytes 0 to 60

The payload of a commit frame is the crc32 over the crc32 fields (u32 each) of the records it covers. No frame has kind
0, so preallocated space never decodes as a record. The salt keeps frames that another file left on the same disk blocks
from decoding here.

**Order on the disk.** A sync writes the records to the disk (fdatasync), appends a commit frame, writes that to the
disk too, and only then reports the records as synced. So every record that a commit frame covers was on the disk before
the frame existed: a missing one is *damage*. Records that no commit frame covers may be missing in any combination,
because pages reach a disk in any order: their first hole is a *torn* tail, and recovery truncates it. If one fdatasync
covered records and commit frame together, an ordinary power cut could look like damage. Records may lie between the
last record that a commit frame covers and the commit frame.

The blobs that the records refer to are written to the disk before the commit frame too.

**Reading.** Positions run 1, 2, 3 … through all segments. A segment ends where no frame decodes; the next continues it
if its base is the next position. The oldest segment's header lists the open episodes, so that recovery can end them
when the segments that began them are deleted: a segment is deleted only after the next one's header is on the disk.
"""

from typing import TYPE_CHECKING

from pycrorm_async.lazy_names import lazy_names

if TYPE_CHECKING:
    from pycrorm_async.queue.recorder_queue import RecorderQueue
    from pycrorm_async.queue.sources import DeadSource, LiveSource, open_dead
    from pycrorm_async.queue.spool import RecorderFolder, Spool

__all__ = ["RecorderQueue", "LiveSource", "DeadSource", "open_dead", "Spool", "RecorderFolder"]
__getattr__ = lazy_names(
    __name__,
    {"recorder_queue": "RecorderQueue", "sources": "DeadSource LiveSource open_dead", "spool": "RecorderFolder Spool"},
)
