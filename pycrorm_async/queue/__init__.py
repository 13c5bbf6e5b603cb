"""The write-ahead queue: events in files that survive the process at once and the machine soon after.

    spool/                     one folder, bound to one database
      log                      id of that database's log, one line; stays while a recorder's folder is here
      writer                   locked by the daemon that drains the spool
      <recorder>/              one recorder, one life of a process; the name is its UUID, so names sort by time
        alive                  locked (flock) by the recorder as long as it lives
        drain                  locked by whoever drains the folder
        progress               how far it is drained, if that is another process (`progress.py`)
        00000001.segment       append-only, numbered without gaps, oldest deleted first, never reused
        00000002.segment       the last one may be made ahead: all zero
        00000001.segment.tail  what was torn at the end of a refused folder that is written on
      <recorder>.<episode>.refused/   what the database refused of this episode (`refused.py`), in the same format
      <recorder>.damaged/      a damaged folder as it was, when `repair` put another in its place

Everything below is little endian, and every structure begins at a multiple of 8 bytes.

**Segment**: a header, frames without space between them, zeros to the end of the file.

    offset  type  header of a segment
    0       8 s   magic, "PYCRQSEG"
    8       u32   format, 1; a program refuses a format it does not know
    12      u32   salt: crc32 of the recorder's id and the number as u64
    16      16 s  the recorder's id
    32      u64   number of the segment, 1 …
    40      u64   base: position of its first record
    48      u32   n, how many episodes are open
    52      u32   crc32 of bytes 56 to the header's end, continued over bytes 0 to 52
    56      n of  the open episodes: id 16 s, then of its last record: sequence u64, wall_ns i64, monotonic_ns i64

**Frame**: 64 bytes, then the name of the event's type, the payload, and zeros up to the next multiple of 8.

    offset  type  header of a frame    event (1)          declaration (2)    commit (3)
    0       u8    kind                 1                  2                  3
    1       u8    length of the type's name                                  0
    2       u16   version of the type                                        0
    4       u32   length of the payload                                      4
    8       u64   position             its own            its own            last one that is safe
    16      u64   sequence             in the episode     0                  records since the commit before
    24      i64   wall_ns              UTC, since 1970
    32      i64   monotonic_ns
    40      16 s  episode              UUIDv7             zeros              zeros
    56      u32   salt                 that of the segment
    60      u32   crc32 of what follows the header, padding too, continued over bytes 0 to 60

A commit's payload is the crc32 over the crc32 fields (u32 each) of those records. Kind 0 is no frame, so space made
ahead is never a record. The salt keeps what another file once left on the same blocks from coming back to life.

**Order on the disk.** A sync makes the records safe, then appends a commit frame that says so, then makes that safe,
and only then tells anybody. So all that a commit frame covers was on the disk before the frame existed: if any of it is
missing that is *damage*. What no commit frame covers may be there or not, in any order, because pages reach a disk in
any order: the first hole in it is where it is *torn*, and it is cut there. A commit frame written before the one sync
that covers both would look like damage after an ordinary power cut. Records may stand between the last record a
commit covers and the commit.

**Reading.** Positions run 1, 2, 3 … through all segments. A segment ends where no frame decodes; the next continues it
if its base is the next position. The oldest segment's header knows the open episodes, so that their end can be told
when the segments that began them are gone: a segment goes only after the next one's header is safe.
"""

from pycrorm_async.queue.files.spool import RecorderFolder, Spool
from pycrorm_async.queue.live.recorder_queue import RecorderQueue
from pycrorm_async.queue.sources.dead_source import RecoveredQueue, open_dead
from pycrorm_async.queue.sources.live_source import LiveQueue

__all__ = ["RecorderQueue", "LiveQueue", "RecoveredQueue", "open_dead", "Spool", "RecorderFolder"]
