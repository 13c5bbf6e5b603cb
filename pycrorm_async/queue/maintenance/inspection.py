"""What is in a spool, told from its files alone: changes nothing, waits for nobody, needs no database.

A live recorder is looked at while it writes: its segments may go and grow meanwhile. So what looks like damage there
counts only if a second look finds it at the same place.
"""

from __future__ import annotations

import os
from collections import Counter
from dataclasses import dataclass, field
from pathlib import Path
from typing import Final

from pycrorm_async.errors import SpoolDamaged, SpoolForeign, SpoolUnavailable
from pycrorm_async.events.ids import EpisodeId, episode_text
from pycrorm_async.queue.files.frame import COMMIT, EVENT, Frame
from pycrorm_async.queue.files.locks import is_locked
from pycrorm_async.queue.files.names import ALIVE, DRAIN, MAKING, MENDED, PROGRESS, TAIL
from pycrorm_async.queue.files.recorder_folder import available, fault_in, held_by
from pycrorm_async.queue.files.scan import Survey, ValidPrefix, survey
from pycrorm_async.queue.files.segment import read_segment, segment_numbers, segment_path
from pycrorm_async.queue.files.spool import RecorderFolder, Spool

__all__ = [
    "SET_ASIDE",
    "SpoolReport",
    "RecorderReport",
    "SegmentReport",
    "OpenEpisode",
    "Damage",
    "inspect_spool",
]

SET_ASIDE: Final = ".damaged"
"""What `repair` adds to the name of a folder it has put aside."""

"""How far another process has drained a living recorder's folder."""
_LOOKS = 20


@dataclass(frozen=True)
class SegmentReport:
    """One file. `base` is the position of its first record; None where its header cannot be read or is not begun."""

    file: str
    bytes: int
    base: int | None
    records: int


@dataclass(frozen=True)
class OpenEpisode:
    """An episode without an end, and its last record. `wall_ns` is UTC."""

    id: str
    sequence: int
    wall_ns: int


@dataclass(frozen=True)
class Damage:
    """Where what was safe once is not what was written."""

    file: str
    offset: int
    reason: str


@dataclass(frozen=True)
class RecorderReport:
    """One recorder's folder, or what was refused of it.

    Attributes:
        name: of the folder: the recorder's id, and for what was refused of it the episode's.
        path: its folder.
        alive: its process lives; of what was refused: more may be put into it.
        being_drained: somebody holds the right to drain it.
        first, last: positions of the first and the last whole record; last is first - 1 if there is none.
        safe: position up to which a sync said that all is on the disk.
        segments: the files, in order.
        types: how many records there are of each event type.
        episodes: how many episodes have records here.
        open: those without an end.
        tail_bytes: what lies behind the last whole record: written, never synced, and torn.
        cut_off: files with what a recovery cut off before.
        foreign: files that are not ours.
        damage: where the damage begins; the records before it are counted, those behind it are not.
        refused: why it could not be looked at: another recorder's file, a newer format, the operating system.
    """

    name: str
    path: str
    alive: bool
    being_drained: bool
    first: int = 1
    last: int = 0
    safe: int = 0
    segments: tuple[SegmentReport, ...] = ()
    types: dict[str, int] = field(default_factory=dict)
    episodes: int = 0
    open: tuple[OpenEpisode, ...] = ()
    tail_bytes: int = 0
    cut_off: tuple[str, ...] = ()
    foreign: tuple[str, ...] = ()
    damage: Damage | None = None
    refused: str | None = None

    @property
    def records(self) -> int:
        return self.last - self.first + 1


@dataclass(frozen=True)
class SpoolReport:
    """A spool.

    Attributes:
        path: the spool's folder.
        log_id: id of the log of the database it belongs to; None if nobody drained it yet.
        recorders: oldest first.
        set_aside: folders that `repair` put aside.
        unfinished: folders that were being made or removed when a process was killed; nothing is in them.
        strangers: what lies here and is not ours.
    """

    path: str
    log_id: str | None
    recorders: tuple[RecorderReport, ...]
    set_aside: tuple[str, ...]
    unfinished: tuple[str, ...]
    strangers: tuple[str, ...]


def inspect_spool(path: Path) -> SpoolReport:
    """Raises `SpoolUnavailable` for what is not there, cannot be read or is no spool."""
    spool = Spool(path)
    with available(path):
        if not path.exists():
            raise SpoolUnavailable(path, "does not exist")
    recorders, log_id = spool.recorders(), spool.log_id()
    others = spool.strangers()
    aside = [each for each in others if is_set_aside(each)]
    unfinished = [each for each in others if _is_unfinished(each)]
    if log_id is None and not recorders and not aside:
        raise SpoolUnavailable(path, "is not a spool: no recorder's folder is in it, and no note of a database")
    return SpoolReport(
        str(path),
        log_id,
        tuple(inspect_recorder(each) for each in recorders),
        tuple(each.name for each in aside),
        tuple(each.name for each in unfinished),
        tuple(_text(each.name) for each in others if each not in [*aside, *unfinished]),
    )


def _text(name: str) -> str:
    """A file's name that can be printed: bytes in it that are not UTF-8 are escaped."""
    return os.fsencode(name).decode(errors="backslashreplace")


def is_set_aside(path: Path) -> bool:
    """Whether `repair` put this folder aside."""
    name, suffix, number = path.name.partition(SET_ASIDE)
    return _is_name(name) and bool(suffix) and (not number or number[1:].isdigit()) and path.is_dir()


def _is_unfinished(path: Path) -> bool:
    """A recorder's folder without its `alive`, the last file to go, or under the name it has before it is whole."""
    name = path.name.removesuffix(MENDED).removesuffix(MAKING)
    if not _is_name(name) or not path.is_dir():
        return False
    return name != path.name or not any(path.iterdir())


def _is_name(name: str) -> bool:
    try:
        held_by(name)
    except ValueError:
        return False
    return True


def inspect_recorder(recorder: RecorderFolder) -> RecorderReport:
    """What is in one recorder's folder; what keeps it from being looked at is in `refused`."""
    name, path = recorder.name, str(recorder.path)
    try:
        with available(recorder.path):
            draining = is_locked(recorder.path / DRAIN)
            try:
                return _looked_at(recorder, being_drained=draining)
            except SpoolForeign as foreign:
                return RecorderReport(name, path, recorder.alive, draining, refused=str(foreign))
    except Exception as error:  # noqa: BLE001 - reported; the other folders are looked at
        return RecorderReport(
            name, path, recorder.alive, being_drained=False, refused=str(fault_in(recorder.path, error))
        )


@dataclass
class _Count:
    """What the walk over the whole frames counts."""

    types: Counter[str] = field(default_factory=Counter)
    episodes: set[bytes] = field(default_factory=set)
    segments: Counter[int] = field(default_factory=Counter)
    safe: int = 0

    def seen(self, number: int, frame: Frame) -> None:
        if frame.kind == COMMIT:
            self.safe = frame.position
            return
        self.segments[number] += 1
        self.types[frame.type.decode(errors="replace")] += 1
        if frame.kind == EVENT:
            self.episodes.add(frame.episode)


def _looked_at(recorder: RecorderFolder, *, being_drained: bool) -> RecorderReport:
    folder = recorder.path
    count, (kept, damage, _) = _surveyed(folder, changing=recorder.alive or being_drained)
    ours = {ALIVE, DRAIN, PROGRESS, *(segment_path(folder, number).name for number in kept.numbers)}
    others = sorted(_text(each.name) for each in folder.iterdir() if each.name not in ours)
    return RecorderReport(
        recorder.name,
        str(folder),
        recorder.alive,
        being_drained,
        first=kept.start.position + 1,
        last=kept.cut.position,
        safe=max(count.safe, kept.start.position),
        segments=tuple(_segment(folder, number, kept, count) for number in kept.numbers),
        types=dict(sorted(count.types.items())),
        episodes=len(count.episodes | set(kept.open)),
        open=tuple(_open(kept)),
        tail_bytes=0 if recorder.alive or damage else _tail_bytes(folder, kept),
        cut_off=tuple(each for each in others if each.endswith(TAIL)),
        foreign=tuple(each for each in others if not each.endswith((TAIL, MAKING)) and each not in _late(folder)),
        damage=None if damage is None else Damage(str(damage.path), damage.offset, damage.reason),
    )


def _surveyed(folder: Path, *, changing: bool) -> tuple[_Count, Survey]:
    """A look that is good for something: of a folder that changes meanwhile, the first that contradicts nobody."""
    recorder = held_by(folder.name).recorder
    before: SpoolDamaged | None = None
    looks = _LOOKS if changing else 1
    for look in range(1, looks + 1):
        count = _Count()
        try:
            found = survey(folder, recorder, seen=count.seen)
        except FileNotFoundError:  # stored and deleted between the listing and the reading
            if look == looks:
                raise
            continue
        damage = found.damage
        if damage is None or not changing:
            break
        if before is not None and (before.path, before.offset) == (damage.path, damage.offset):
            break
        before = damage
    return count, found


def _segment(folder: Path, number: int, kept: ValidPrefix, count: _Count) -> SegmentReport:
    path = segment_path(folder, number)
    size = path.stat().st_size if path.exists() else 0
    return SegmentReport(path.name, size, kept.bases.get(number), count.segments[number])


def _open(kept: ValidPrefix) -> list[OpenEpisode]:
    return [
        OpenEpisode(episode_text(EpisodeId(episode)), last.sequence, last.wall_ns)
        for episode, last in sorted(kept.open.items())
    ]


def _late(folder: Path) -> set[str]:
    """Segments that were made after the survey listed them."""
    return {segment_path(folder, number).name for number in segment_numbers(folder)}


def _tail_bytes(folder: Path, kept: ValidPrefix) -> int:
    """What is not zero behind the last whole record."""
    size = 0
    for number in kept.numbers:
        if number >= kept.cut.number:
            content = read_segment(segment_path(folder, number))
            size += len(content[kept.cut.offset if number == kept.cut.number else 0 :].rstrip(b"\0"))
    return size
