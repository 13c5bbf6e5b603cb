"""Report the content of a spool from its files alone: without changing them, taking locks or opening a database.

A live recorder deletes and extends its segments while this reads them. Therefore apparent damage there counts only if a
second scan meets it at the same place.
"""

from __future__ import annotations

import os
from collections import Counter
from dataclasses import dataclass, field, replace
from pathlib import Path
from typing import Final

from pycrorm_async.errors import SpoolDamaged, SpoolUnavailable
from pycrorm_async.events.ids import episode_text
from pycrorm_async.queue.blobs.blob_files import blob_bytes, blob_files
from pycrorm_async.queue.files.drain_status import DrainStatus, Progress, RecorderStatus
from pycrorm_async.queue.files.frame import COMMIT, EVENT, Frame
from pycrorm_async.queue.files.locks import is_locked
from pycrorm_async.queue.files.names import ALIVE, BLOBS, DRAIN, MAKING, MENDED, PROGRESS, TAIL
from pycrorm_async.queue.files.recorder_folder import folder_error, is_folder_name, parse_folder_name, wrap_os_errors
from pycrorm_async.queue.files.scan import Survey, survey, tails
from pycrorm_async.queue.files.segment import segment_numbers, segment_path
from pycrorm_async.queue.files.spool import RecorderFolder, Spool

DAMAGED_SUFFIX: Final = ".damaged"
"""Suffix that `repair` appends to the name of the damaged folder it replaces."""
_SURVEYS = 20
"""Bounds the scans of a folder that changes meanwhile, before apparent damage is reported."""


@dataclass(frozen=True)
class SegmentReport:
    """One segment. `base` is the position of its first record; None if its header is unreadable or not written yet."""

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
    """Synced bytes that differ from the bytes that were written: the file and the offset where they begin."""

    file: str
    offset: int
    reason: str


@dataclass(frozen=True)
class FolderReport:
    """One recorder's folder, or a folder of dead letters, without the content of its segments.

    Attributes:
        name: the folder's name: the recorder's id, followed by the episode's id for dead letters.
        path: the folder.
        alive: the recorder's process lives; for dead letters, a drainer may add more.
        being_drained: a process holds `drain`.
        bytes_spooled: size of the segments and blobs; a living recorder allocates segments in advance.
        blobs: number of blobs that are not deleted yet.
        recorded, drained: the two parts of `progress`; None for a dead recorder and for one that drains itself.
        refused: why the folder could not be examined: another recorder's file, a newer format, an OS error.
    """

    name: str
    path: str
    alive: bool
    being_drained: bool = False
    bytes_spooled: int = 0
    recorded: RecorderStatus | None = None
    drained: DrainStatus | None = None
    refused: str | None = None
    blobs: int = 0


@dataclass(frozen=True)
class RecorderReport(FolderReport):
    """One recorder's folder, or a folder of dead letters, with the content of its segments.

    Attributes:
        first, last: positions of the first and the last whole record; last is first - 1 if there is none.
        safe: the last position that a commit frame covers.
        segments: the files, in order.
        types: number of records of each event type.
        episodes: number of episodes with records here.
        open: the episodes without an end.
        tail_bytes: size of the torn tail behind the last whole record, which no sync covered.
        cut_off: files with the tails that earlier recoveries cut off.
        foreign: files that are not ours.
        damage: where the damage begins; only records before it are counted.
    """

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

    @property
    def records(self) -> int:
        return self.last - self.first + 1


@dataclass(frozen=True)
class SpoolReport:
    """The content of a spool.

    Attributes:
        path: the spool's folder.
        log_id: id of the log that the spool is bound to; None before the first drain.
        recorders: the recorders' folders, oldest first.
        set_aside: damaged folders that `repair` replaced.
        unfinished: folders left by a process that was killed while it created, repaired or removed them.
        strangers: entries that are not ours.
    """

    path: str
    log_id: str | None
    recorders: tuple[RecorderReport, ...]
    set_aside: tuple[str, ...]
    unfinished: tuple[str, ...]
    strangers: tuple[str, ...]


def inspect_spool(path: Path) -> SpoolReport:
    """Report the content of a spool. Raises `SpoolUnavailable` if it is missing, unreadable or not a spool."""
    spool = Spool(path)
    with wrap_os_errors(path):
        if not path.exists():
            raise SpoolUnavailable(path, "does not exist; `pycrorm status --url URL` prints the spool of a database")
    recorders, log_id = spool.recorders(), spool.log_id()
    others = spool.strangers()
    replaced = [each for each in others if is_damaged_copy(each)]
    unfinished = [each for each in others if _is_unfinished(each)]
    if log_id is None and not recorders and not replaced:
        raise SpoolUnavailable(
            path, "is not a spool: it contains neither a recorder's folder nor the note of a database"
        )
    return SpoolReport(
        str(path),
        log_id,
        tuple(inspect_recorder(each) for each in recorders),
        tuple(each.name for each in replaced),
        tuple(each.name for each in unfinished),
        tuple(_text(each.name) for each in others if each not in [*replaced, *unfinished]),
    )


def _text(name: str) -> str:
    """Return a printable file name: bytes that are not UTF-8 are escaped."""
    return os.fsencode(name).decode(errors="backslashreplace")


def is_damaged_copy(path: Path) -> bool:
    """Return whether this is a damaged folder that `repair` replaced."""
    name, suffix, number = path.name.partition(DAMAGED_SUFFIX)
    return is_folder_name(name) and bool(suffix) and (not number or number[1:].isdigit()) and path.is_dir()


def _is_unfinished(path: Path) -> bool:
    """Return whether this is an empty recorder's folder without `alive`, or one that has its unfinished name."""
    name = path.name.removesuffix(MENDED).removesuffix(MAKING)
    if not is_folder_name(name) or not path.is_dir():
        return False
    return name != path.name or not any(path.iterdir())


def inspect_folder(recorder: RecorderFolder) -> FolderReport:
    """Report the state of a recorder's folder, scanning no segment; an error that prevents it is in `refused`."""
    try:
        with wrap_os_errors(recorder.path):
            return _look(recorder)
    except Exception as error:  # noqa: BLE001 - reported; must not prevent the report on the others
        fault = str(folder_error(recorder.path, error))
        return FolderReport(recorder.name, str(recorder.path), recorder.alive, refused=fault)


def inspect_recorder(recorder: RecorderFolder) -> RecorderReport:
    """Report the content of one recorder's folder; an error that prevents it is in `refused`."""
    folder = inspect_folder(recorder)
    try:
        if folder.refused is None:
            with wrap_os_errors(recorder.path):
                return _examine(recorder, folder)
        fault = folder.refused
    except Exception as error:  # noqa: BLE001 - reported; must not prevent the report on the others
        fault = str(folder_error(recorder.path, error))
    return RecorderReport(folder.name, folder.path, folder.alive, folder.being_drained, refused=fault)


def _look(recorder: RecorderFolder) -> FolderReport:
    blobs = blob_files(recorder.path)
    state = FolderReport(
        recorder.name,
        str(recorder.path),
        recorder.alive,
        being_drained=is_locked(recorder.path / DRAIN),
        bytes_spooled=_bytes(recorder.path) + blob_bytes(blobs),
        blobs=len(blobs),
    )
    progress = Progress.open(recorder.path, writing=False) if recorder.alive else None
    if progress is None:
        return state
    try:
        return replace(state, recorded=progress.recorded(), drained=progress.drained())
    finally:
        progress.close()


def _bytes(folder: Path) -> int:
    try:
        segments = [segment_path(folder, number) for number in segment_numbers(folder)]
    except FileNotFoundError:  # all records were stored and the folder deleted meanwhile
        return 0
    return sum(_size(each) for each in segments)


def _size(path: Path) -> int:
    try:
        return path.stat().st_size
    except FileNotFoundError:
        return 0


@dataclass
class _Count:
    """Counts of the whole frames that a scan meets."""

    types: Counter[str] = field(default_factory=Counter)
    episodes: set[bytes] = field(default_factory=set)
    segments: Counter[int] = field(default_factory=Counter)
    safe: int = 0

    def count_frame(self, number: int, frame: Frame) -> None:
        if frame.kind == COMMIT:
            self.safe = frame.position
            return
        self.segments[number] += 1
        self.types[frame.type.decode(errors="replace")] += 1
        if frame.kind == EVENT:
            self.episodes.add(frame.episode)


def _examine(recorder: RecorderFolder, state: FolderReport) -> RecorderReport:
    folder = recorder.path
    count, (prefix, damage, _) = _survey_stable(folder, changing=recorder.alive or state.being_drained)
    entries = [each.name for each in folder.iterdir()]
    numbers = {*prefix.numbers, *segment_numbers(folder)}  # also those begun or deleted since the scan
    ours = {ALIVE, BLOBS, DRAIN, PROGRESS, *(segment_path(folder, number).name for number in numbers)}
    others = sorted(_text(each) for each in entries if each not in ours)
    return RecorderReport(
        **vars(state),
        first=prefix.start.position + 1,
        last=prefix.cut.position,
        safe=max(count.safe, prefix.start.position),
        segments=tuple(
            SegmentReport(path.name, _size(path), prefix.bases.get(number), count.segments[number])
            for number in prefix.numbers
            for path in [segment_path(folder, number)]
        ),
        types=dict(sorted(count.types.items())),
        episodes=len(count.episodes | set(prefix.open)),
        open=tuple(
            OpenEpisode(episode_text(episode), last.sequence, last.wall_ns)
            for episode, last in sorted(prefix.open.items())
        ),
        tail_bytes=0 if recorder.alive or damage else sum(len(tail) for _, tail in tails(folder, prefix)),
        cut_off=tuple(each for each in others if each.endswith(TAIL)),
        foreign=tuple(each for each in others if not each.endswith((TAIL, MAKING))),
        damage=None if damage is None else Damage(str(damage.path), damage.offset, damage.reason),
    )


def _survey_stable(folder: Path, *, changing: bool) -> tuple[_Count, Survey]:
    """Scan a folder; repeat the scan of a changing one until it meets no damage, or the same damage twice in a row."""
    recorder = parse_folder_name(folder.name).recorder
    before: SpoolDamaged | None = None
    attempts = _SURVEYS if changing else 1
    for attempt in range(1, attempts + 1):
        count = _Count()
        try:
            result = survey(folder, recorder, on_frame=count.count_frame)
        except FileNotFoundError:  # stored and deleted between the listing and the reading
            if attempt == attempts:
                raise
            continue
        damage = result.damage
        if damage is None or not changing:
            break
        if before is not None and (before.path, before.offset) == (damage.path, damage.offset):
            break
        before = damage
    return count, result
