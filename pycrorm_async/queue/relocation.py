"""Move a living queue to a new folder after another program deleted or replaced its files.

**Theory of operation.** Syncing a file without a name succeeds. So after each sync and before it acknowledges, the sync
thread compares the files it holds (`alive`, the segments) with the files of those names. If they differ, the queue is
*displaced*: it acknowledges nothing, and `synced_to` raises. A process can still read a file without a name that it has
mapped. So the sync thread creates the folder of a new recorder, carries all readable records there and continues there:

1. The new folder has an unfinished name, which draining processes ignore.
2. The records are carried segment by segment, with their positions, sequences and times. Meanwhile producers keep
   putting into the old mapping. The last records are carried under the lock of the old appender, which then refuses
   puts with `AppenderRelocated`; a producer that meets it puts into the new appender.
3. The carried records are synced, and the folder gets its name. If the old folder still exists, the next system call
   deletes its `alive`: only one of the two folders may be recovered, because recovery ends the open episodes.
4. The rest of the old folder is deleted. The next sync appends the commit frame and acknowledges.

A process killed before step 3 leaves the old folder as the other program left it. The process holds the lock on the old
`alive` until it ends, so that a folder moved elsewhere still counts as alive.

Records in segments that are neither mapped nor readable are lost. `Remains.lost` names them. The log gets a gap there,
so the database refuses the rest of their episodes, which become dead letters (`sources.py`).
"""

from __future__ import annotations

from collections.abc import Callable, Mapping
from contextlib import suppress
from itertools import zip_longest
from pathlib import Path
from typing import NamedTuple

from pycrorm_async.errors import PycrormError, SpoolUnavailable
from pycrorm_async.events.ids import EpisodeId, episode_text
from pycrorm_async.queue.appender import RelocatableAppender, SegmentStart
from pycrorm_async.queue.format import (
    COMMIT,
    Buffer,
    Cursor,
    LastRecord,
    Place,
    Segment,
    decode_each,
    decode_header,
    header_bytes,
    read_segment,
    salt_of,
)
from pycrorm_async.queue.locks import FileIdentity, FileLock
from pycrorm_async.queue.spool import DrainStatusReader, begin_folder, finish_folder, remove_folder
from pycrorm_async.settings import FileAccess

_EPISODES_MAX = 8
"""Bounds the episodes that one line of a loss names."""
_STALLS_MAX = 100
"""Bounds the passes without a new record, while a producer is writing, before the mapping counts as overwritten."""


class Home(NamedTuple):
    """The folder a queue writes in, with its locks, appender and drain status."""

    place: Place
    alive: FileLock
    identity: FileIdentity
    appender: RelocatableAppender
    drain_status: DrainStatusReader | None

    @property
    def is_in_place(self) -> bool:
        """True if the folder still has its name."""
        return self.identity.is_at(self.place.folder)


class Remains(NamedTuple):
    """The records that can be carried.

    Attributes:
        contents: numbers and contents of the readable segments, contiguous; producers still write into the last one.
        after: position of the record before the first of them.
        opened: the episodes open at that position.
        lost: one line for each run of positions that no file contains any more.
        left: whether the old folder keeps records that are not stored, because a hole follows them.
    """

    contents: list[tuple[int, Buffer]]
    after: int
    opened: Mapping[EpisodeId, LastRecord]
    lost: tuple[str, ...]
    left: bool


def move(
    home: Home,
    *,
    spool: Path,
    access: FileAccess,
    recorder: EpisodeId,
    stored: int,
    appender_in: Callable[[Path, bytes, int, Mapping[EpisodeId, LastRecord]], RelocatableAppender],
    switch_home: Callable[[Home, tuple[str, ...]], None],
) -> None:
    """Create a folder for this recorder below the spool, and continue the queue there.

    Calls `switch_home` with the lost records under the old appender's lock when the new one has all others, and again
    when the folder has its name. Raises `FilesError` and `OSError`: before the first call without any effect, after it
    with the queue in a folder with an unfinished name, from which it can move again.
    """
    unfinished, alive = begin_folder(spool, episode_text(recorder), access)
    appender: RelocatableAppender | None = None
    switched = False
    try:
        remains = _find_remains(home.appender, home.place.recorder, stored=stored)
        appender = appender_in(unfinished, recorder, remains.after, remains.opened)
        drain_status = None if home.drain_status is None else DrainStatusReader(unfinished, before=remains.after)
        place = Place(unfinished, recorder, Cursor(1, header_bytes(len(remains.opened)), remains.after))
        moved = Home(place, alive, FileIdentity.of(unfinished.stat()), appender, drain_status)

        def switch() -> None:
            nonlocal switched
            switch_home(moved, remains.lost)
            switched = True

        _carry(remains, home.appender, appender, recorder=home.place.recorder, switch=switch)
    finally:
        if not switched:
            if appender is not None:
                appender.close()
            with suppress(OSError):
                remove_folder(unfinished)
            alive.release()
    old_folder = home.place.folder if home.is_in_place and not remains.left else None
    try:
        for segment in appender.segments:  # before any file of the old folder is deleted
            segment.sync()
        folder = finish_folder(unfinished, replaced=old_folder)
        appender.settle(folder)
        switch_home(moved._replace(place=place._replace(folder=folder)), ())
    except BaseException:
        _close_old(home, None)
        raise
    _close_old(home, old_folder)


def _close_old(home: Home, folder: Path | None) -> None:
    """Close the old appender and drain status; delete the old folder, if given."""
    if folder is not None:
        with suppress(OSError):
            remove_folder(folder)
    home.appender.close()
    if home.drain_status is not None:
        home.drain_status.close()


def _find_remains(appender: RelocatableAppender, recorder: bytes, *, stored: int) -> Remains:
    """Collect the records that are not stored, from the mappings and the old folder."""
    mapped = {segment.number: segment for segment in appender.segments}
    contents: list[tuple[int, Buffer]] = []
    lost: list[str] = []
    left = False
    begun = appender.begun
    for start, following in zip_longest(begun, begun[1:]):
        content: Buffer | None
        if start.number in mapped:
            content = mapped[start.number].buffer
        else:
            content = _read_whole(start, recorder, last=following.base - 1)
        if content is not None:
            contents.append((start.number, content))
            continue
        first, last = max(start.base, stored + 1), following.base - 1
        if first <= last:
            lost.append(_describe_loss(first, last, start.opened, following.opened))
        left = left or (bool(contents) and start.base - 1 > stored)
        contents = []
    header = decode_header(contents[0][1])
    assert header is not None, "the current segment is mapped, and its header is whole"
    return Remains(contents, header.base - 1, header.open, tuple(lost), left)


def _carry(
    remains: Remains,
    old: RelocatableAppender,
    new: RelocatableAppender,
    *,
    recorder: bytes,
    switch: Callable[[], None],
) -> None:
    """Carry all readable records and those put meanwhile; call `switch` when the new appender has them all.

    Raises `FilesError`; then the old appender is unchanged.
    """
    for number, content in remains.contents[:-1]:
        _carry_from(content, _first_frame(content), salt_of(recorder, number), new)
    number, content = remains.contents[-1]
    segment = next(each for each in old.segments if each.number == number)
    while True:
        offset = _carry_from(segment.buffer, _first_frame(segment.buffer), salt_of(recorder, segment.number), new)
        stalls = 0
        while not old.hand_over(new, segment, offset, switch=switch):
            following, before = _next_segment(old, segment), offset
            offset = _carry_from(segment.buffer, offset, salt_of(recorder, segment.number), new)
            stalls = stalls + 1 if offset == before else 0
            if stalls > _STALLS_MAX:
                raise SpoolUnavailable(segment.path, f"does not contain at byte {offset} the record that was put there")
            if following is not None:
                segment = following
                break
        else:
            return


def _first_frame(content: Buffer) -> int:
    """Return the offset of a segment's first frame."""
    header = decode_header(content)
    assert header is not None, "only segments with a valid header are carried"
    return header_bytes(len(header.open))


def _next_segment(appender: RelocatableAppender, segment: Segment) -> Segment | None:
    """Return the segment after this one, if the appender has begun it."""
    return next((each for each in appender.segments if each.number == segment.number + 1), None)


def _carry_from(content: Buffer, offset: int, salt: int, new: RelocatableAppender) -> int:
    for record in decode_each(content, offset, salt):
        if record[0] != COMMIT:
            new.carry(record)
        offset += record[-1]
    return offset


def _read_whole(begun: SegmentStart, recorder: bytes, *, last: int) -> bytes | None:
    """Read a segment that is not mapped any more; None if a record of it is missing."""
    try:
        content = read_segment(begun.path)
    except (OSError, PycrormError):
        return None
    header = decode_header(content)
    if header is None or (header.recorder, header.number, header.base) != (recorder, begun.number, begun.base):
        return None
    position = begun.base - 1
    for record in decode_each(content, header_bytes(len(header.open)), salt_of(recorder, begun.number)):
        if record[0] != COMMIT:
            position = record[2]
    return content if position == last else None


def _describe_loss(
    first: int, last: int, before: Mapping[EpisodeId, LastRecord], after: Mapping[EpisodeId, LastRecord]
) -> str:
    """Describe a lost segment's records: their positions, and their events as far as open episodes show them."""
    events = []
    for episode in dict.fromkeys((*before, *after)):
        begin = before[episode].sequence + 1 if episode in before else 1
        end = f"to {after[episode].sequence}" if episode in after else "to its end"
        if episode not in after or after[episode].sequence >= begin:
            events.append(f"events {begin} {end} of episode {episode_text(episode)}")
    more = f" and of {len(events) - _EPISODES_MAX} more episodes" if len(events) > _EPISODES_MAX else ""
    named = f": {', '.join(events[:_EPISODES_MAX])}{more}" if events else ""
    return f"positions {first} to {last}{named}"
