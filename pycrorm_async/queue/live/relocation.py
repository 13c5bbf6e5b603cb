"""Move a living queue to a new folder after its files were deleted or replaced by another program.

**Theory of operation.** Syncing a file that has no name any more succeeds, so the sync thread compares, after each sync
and before it acknowledges, the files it holds (`alive`, the segments) with those that have their names. Where they
differ the queue is *displaced*: nothing is acknowledged, and `synced()` raises. A file without a name can still be read
by the process that has it mapped. So the sync thread makes a folder of a new recorder, carries there what it can read,
and goes on there:

1. The new folder has an unfinished name, which no process that drains looks at.
2. Records are carried segment by segment, with their positions, sequences and times. Meanwhile threads go on putting
   into the old mapping. What they put last is carried under the lock of the old appender, which then refuses with
   `Relocated`; a thread that meets that puts into the new one.
3. What was carried is made safe, and the folder gets its name. If the old one is still there, its `alive` goes with the
   next system call: of two folders of one queue only one may be recovered, because recovery ends the open episodes.
4. The rest of the old folder is deleted. The next sync appends the commit frame, and acknowledges.

A process killed before step 3 leaves what the other program left of the old folder. The lock on the old `alive` is held
until the process ends: wherever that file was moved to, its recorder is alive.

Records in segments that are neither mapped nor readable are lost. `Remains.lost` names them, the log gets a gap, and
the database refuses the rest of their episodes, which is kept beside the recorder's folder (`refused.py`).
"""

from __future__ import annotations

from collections.abc import Callable, Mapping
from contextlib import suppress
from itertools import zip_longest
from pathlib import Path
from typing import NamedTuple

from pycrorm_async.errors import PycrormError, SpoolUnavailable
from pycrorm_async.events.ids import EpisodeId, episode_text
from pycrorm_async.queue.files.drain_status import DrainStatusReader
from pycrorm_async.queue.files.frame import COMMIT, Buffer, decode_each
from pycrorm_async.queue.files.locks import FileIdentity, FileLock
from pycrorm_async.queue.files.reader import Cursor
from pycrorm_async.queue.files.recorder_folder import begin_folder, finish_folder, remove_folder
from pycrorm_async.queue.files.segment import LastRecord, Segment, decode_header, header_bytes, read_segment, salt_of
from pycrorm_async.queue.live.appender import SegmentStart
from pycrorm_async.queue.live.consumer import Place
from pycrorm_async.queue.live.relocatable_appender import RelocatableAppender
from pycrorm_async.settings import FileAccess

__all__ = ["Home", "Remains", "move"]

_EPISODES_MAX = 8
"""How many episodes one line names."""
_STALLS_MAX = 100
"""How often a mapping may hold nothing new before it counts as overwritten: a thread may be writing just then."""


class Home(NamedTuple):
    """Where a queue writes, and with what."""

    place: Place
    alive: FileLock
    identity: FileIdentity
    appender: RelocatableAppender
    outside: DrainStatusReader | None

    @property
    def is_in_place(self) -> bool:
        """Whether the folder still has its name."""
        return self.identity.is_at(self.place.folder)


class Remains(NamedTuple):
    """What can be carried.

    Attributes:
        contents: of the segments that can be read, without a hole between them; the last one still grows.
        after: position of the record before the first of them.
        opened: the episodes that are open there.
        lost: what no file holds any more, one line for each run of positions.
        left: whether records that are not stored stay in the old folder, because a hole follows them.
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
    settle: Callable[[Home, tuple[str, ...]], None],
) -> None:
    """Make a folder for this recorder below the spool, and go on in it.

    `settle` is called when the queue is there, under the lock of the appender before and with what is lost, and again
    when the folder has its name. Raises `FilesError` and `OSError`: before the first of these calls nothing is changed,
    and after it the queue is in a folder with an unfinished name, from which it can move once more.
    """
    unfinished, alive = begin_folder(spool, episode_text(recorder), access)
    appender: RelocatableAppender | None = None
    settled = False
    try:
        remains = _remains_of(home.appender, home.place.recorder, stored=stored)
        appender = appender_in(unfinished, recorder, remains.after, remains.opened)
        outside = None if home.outside is None else DrainStatusReader(unfinished, before=remains.after)
        place = Place(unfinished, recorder, Cursor(1, header_bytes(len(remains.opened)), remains.after))
        moved = Home(place, alive, FileIdentity.of(unfinished.stat()), appender, outside)

        def switch() -> None:
            nonlocal settled
            settle(moved, remains.lost)
            settled = True

        _carry(remains, home.appender, appender, recorder=home.place.recorder, switch=switch)
    finally:
        if not settled:
            if appender is not None:
                appender.close()
            with suppress(OSError):
                remove_folder(unfinished)
            alive.release()
    goes = home.place.folder if home.is_in_place and not remains.left else None
    try:
        for segment in appender.segments:  # before anything of the old folder goes
            segment.sync()
        folder = finish_folder(unfinished, replaced=goes)
        appender.settle(folder)
        settle(moved._replace(place=place._replace(folder=folder)), ())
    except BaseException:
        _leave(home, None)
        raise
    _leave(home, goes)


def _leave(home: Home, folder: Path | None) -> None:
    """Close what the queue had open, and delete the old folder if it is there and all of it was carried."""
    if folder is not None:
        with suppress(OSError):
            remove_folder(folder)
    home.appender.close()
    if home.outside is not None:
        home.outside.close()


def _remains_of(appender: RelocatableAppender, recorder: bytes, *, stored: int) -> Remains:
    """Look for what is not stored, in the mappings and in the old folder."""
    mapped = {segment.number: segment for segment in appender.segments}
    contents: list[tuple[int, Buffer]] = []
    lost: list[str] = []
    left = False
    begun = appender.begun
    for each, following in zip_longest(begun, begun[1:]):
        content: Buffer | None
        if each.number in mapped:
            content = mapped[each.number].buffer
        else:
            content = _readable(each, recorder, last=following.base - 1)
        if content is not None:
            contents.append((each.number, content))
            continue
        first, last = max(each.base, stored + 1), following.base - 1
        if first <= last:
            lost.append(_named(first, last, each.opened, following.opened))
        left = left or (bool(contents) and each.base - 1 > stored)
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
    """Carry all that can be read and what is put meanwhile; `switch` is called when the new one has all of it.

    Raises `FilesError`; then the old one is as it was.
    """
    for number, content in remains.contents[:-1]:
        _carry_from(content, _first_frame(content), salt_of(recorder, number), new)
    number, content = remains.contents[-1]
    segment = next(each for each in old.segments if each.number == number)
    while True:
        offset = _carry_from(segment.buffer, _first_frame(segment.buffer), salt_of(recorder, segment.number), new)
        stalls = 0
        while not old.hand_over(new, segment, offset, switch=switch):
            following, before = _after(old, segment), offset
            offset = _carry_from(segment.buffer, offset, salt_of(recorder, segment.number), new)
            stalls = stalls + 1 if offset == before else 0
            if stalls > _STALLS_MAX:
                raise SpoolUnavailable(segment.path, f"does not hold at byte {offset} what was put there")
            if following is not None:
                segment = following
                break
        else:
            return


def _first_frame(content: Buffer) -> int:
    """Where the first frame of a segment begins."""
    header = decode_header(content)
    assert header is not None, "what is carried was read before"
    return header_bytes(len(header.open))


def _after(appender: RelocatableAppender, segment: Segment) -> Segment | None:
    """The segment that was begun behind this one, which is full then."""
    return next((each for each in appender.segments if each.number == segment.number + 1), None)


def _carry_from(content: Buffer, offset: int, salt: int, new: RelocatableAppender) -> int:
    for record in decode_each(content, offset, salt):
        if record[0] != COMMIT:
            new.carry(record)
        offset += record[-1]
    return offset


def _readable(begun: SegmentStart, recorder: bytes, *, last: int) -> bytes | None:
    """The content of a segment that is not mapped any more; None if it is not all there."""
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


def _named(first: int, last: int, before: Mapping[EpisodeId, LastRecord], after: Mapping[EpisodeId, LastRecord]) -> str:
    """The records of one segment that is gone: by position, and by event as far as an episode was open around it."""
    events = []
    for episode in dict.fromkeys((*before, *after)):
        begin = before[episode].sequence + 1 if episode in before else 1
        end = f"to {after[episode].sequence}" if episode in after else "to its end"
        if episode not in after or after[episode].sequence >= begin:
            events.append(f"events {begin} {end} of episode {episode_text(episode)}")
    more = f" and of {len(events) - _EPISODES_MAX} more episodes" if len(events) > _EPISODES_MAX else ""
    named = f": {', '.join(events[:_EPISODES_MAX])}{more}" if events else ""
    return f"positions {first} to {last}{named}"
