"""Inspect a spool, and repair a damaged recorder's folder."""

import os
import shutil
from collections import Counter
from collections.abc import Iterable, Iterator
from contextlib import ExitStack, suppress
from dataclasses import dataclass, field, replace
from itertools import chain, count
from pathlib import Path
from typing import Final, TypeAlias

from pycrorm_async.errors import InternalError, SpoolDamaged, SpoolUnavailable
from pycrorm_async.events.ids import EpisodeId, episode_text
from pycrorm_async.queue import format as spool_format
from pycrorm_async.queue import scan
from pycrorm_async.queue import spool as spools
from pycrorm_async.queue.blobs import blob_files, file_bytes
from pycrorm_async.queue.locks import ALIVE, BLOBS, DRAIN, MAKING, MENDED, PROGRESS, TAIL, FileLock, is_locked

# === inspection ===============================================================================================
#
# Report the content of a spool from its files alone: without changing them, taking locks or opening a database.
#
# A live recorder deletes and extends its segments while this reads them. Therefore apparent damage there counts only if
# a second scan meets it at the same place.

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
class FileDamage:
    """Synced bytes that differ from the bytes that were written: the file and the offset where they begin."""

    file: str
    offset: int
    reason: str


@dataclass(frozen=True)
class RecorderReport:
    """One recorder's folder, or a folder of dead letters.

    Attributes:
        name: the folder's name: the recorder's id, followed by the episode's id for dead letters.
        path: the folder.
        alive: the recorder's process lives; for dead letters, a drainer may add more.
        being_drained: a process holds `drain`.
        bytes_spooled: size of the segments and blobs; a living recorder allocates segments in advance.
        blobs: number of blobs that are not deleted yet.
        recorded, drained: the two parts of `progress`; None for a dead recorder and for one that drains itself.
        refused: why the folder could not be examined: another recorder's file, a newer format, an OS error.
        first, last: positions of the first and the last whole record; last is first - 1 if there is none. This and the
            following are known only if the segments were scanned.
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

    name: str
    path: str
    alive: bool
    being_drained: bool = False
    bytes_spooled: int = 0
    recorded: spools.RecorderStatus | None = None
    drained: spools.DrainStatus | None = None
    refused: str | None = None
    blobs: int = 0
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
    damage: FileDamage | None = None

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
    spool = spools.Spool(path)
    with spools.wrap_os_errors(path):
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
    return spools.is_folder_name(name) and bool(suffix) and (not number or number[1:].isdigit()) and path.is_dir()


def _is_unfinished(path: Path) -> bool:
    """Return whether this is an empty recorder's folder without `alive`, or one that has its unfinished name."""
    name = path.name.removesuffix(MENDED).removesuffix(MAKING)
    if not spools.is_folder_name(name) or not path.is_dir():
        return False
    return name != path.name or not any(path.iterdir())


def inspect_recorder(recorder: spools.RecorderFolder, *, scanning: bool = True) -> RecorderReport:
    """Report one recorder's folder, with the content of its segments if `scanning`.

    An error that prevents it is in `refused`.
    """
    report = RecorderReport(recorder.name, str(recorder.path), recorder.alive)
    try:
        with spools.wrap_os_errors(recorder.path):
            report = _look(recorder, report)
            return _examine(recorder, report) if scanning else report
    except Exception as error:  # noqa: BLE001 - reported; must not prevent the report on the others
        return replace(report, refused=str(spools.folder_error(recorder.path, error)))


def _look(recorder: spools.RecorderFolder, report: RecorderReport) -> RecorderReport:
    blobs, segments = blob_files(recorder.path), list[Path]()
    with suppress(FileNotFoundError):  # all records were stored and the folder deleted meanwhile
        segments += spool_format.segments_in(recorder.path).values()
    report = replace(
        report,
        being_drained=is_locked(recorder.path / DRAIN),
        bytes_spooled=file_bytes([*segments, *blobs]),
        blobs=len(blobs),
    )
    progress = spools.Progress.open(recorder.path, writing=False) if recorder.alive else None
    if progress is None:
        return report
    try:
        return replace(report, recorded=progress.recorded(), drained=progress.drained())
    finally:
        progress.close()


@dataclass
class _Count:
    """Counts of the whole frames that a scan meets."""

    types: Counter[str] = field(default_factory=Counter)
    episodes: set[bytes] = field(default_factory=set)
    segments: Counter[int] = field(default_factory=Counter)
    safe: int = 0

    def count_frame(self, after: spool_format.ReadCursor, frame: spool_format.Frame) -> None:
        if frame.kind == spool_format.COMMIT:
            self.safe = frame.position
            return
        self.segments[after.number] += 1
        self.types[frame.type.decode(errors="replace")] += 1
        if frame.kind == spool_format.EVENT:
            self.episodes.add(frame.episode)


def _examine(recorder: spools.RecorderFolder, report: RecorderReport) -> RecorderReport:
    folder = recorder.path
    counted, (prefix, damage, _) = _survey_stable(folder, changing=recorder.alive or report.being_drained)
    entries = [each.name for each in folder.iterdir()]
    numbers = {*prefix.numbers, *spool_format.segments_in(folder)}  # also those begun or deleted since the scan
    ours = {ALIVE, BLOBS, DRAIN, PROGRESS, *(spool_format.segment_path(folder, number).name for number in numbers)}
    others = sorted(_text(each) for each in entries if each not in ours)
    return replace(
        report,
        first=prefix.start.position + 1,
        last=prefix.cut.position,
        safe=max(counted.safe, prefix.start.position),
        segments=tuple(
            SegmentReport(path.name, file_bytes([path]), prefix.bases.get(number), counted.segments[number])
            for number in prefix.numbers
            for path in [spool_format.segment_path(folder, number)]
        ),
        types=dict(sorted(counted.types.items())),
        episodes=len(counted.episodes | set(prefix.open)),
        open=tuple(
            OpenEpisode(episode_text(episode), last.sequence, last.wall_ns)
            for episode, last in sorted(prefix.open.items())
        ),
        tail_bytes=0 if recorder.alive or damage else sum(len(tail) for _, tail in scan.tails(folder, prefix)),
        cut_off=tuple(each for each in others if each.endswith(TAIL)),
        foreign=tuple(each for each in others if not each.endswith((TAIL, MAKING))),
        damage=None if damage is None else FileDamage(str(damage.path), damage.offset, damage.reason),
    )


def _survey_stable(folder: Path, *, changing: bool) -> tuple[_Count, scan.Survey]:
    """Scan a folder; repeat the scan of a changing one until it meets no damage, or the same damage again."""
    met: set[tuple[Path, int]] = set()
    for attempt in range(_SURVEYS):
        count = _Count()
        try:
            result = scan.survey(folder, spools.parse_folder_name(folder.name).recorder, on_frame=count.count_frame)
        except FileNotFoundError:  # stored and deleted between the listing and the reading
            if not changing or attempt == _SURVEYS - 1:
                raise
            continue
        damage = result.damage
        if damage is None or not changing or (damage.path, damage.offset) in met:
            break
        met.add((damage.path, damage.offset))
    return count, result


# === repair ===================================================================================================
#
# Repair a dead recorder's damaged folder, so that its whole records can be drained, and report the records dropped.
#
# A copy of the folder is kept as `<recorder>.damaged`. Then each segment from the damage on is replaced by one with the
# whole records of the old one that can be kept. An episode's records are kept up to its first missing record, because
# the log accepts no episode with a gap. Kept records get new positions, because positions have no gaps either.
#
# After a kill at any point the folder is whole or damaged, and the next repair begins again, with a copy of its own.

Range: TypeAlias = tuple[int, int]
"""The first and the last of consecutive numbers."""


class _Salvage:
    """One pass over the segments of a damaged folder that keeps their whole records.

    `position` is that of the last record written, `unreadable` the positions in the damaged folder for which no frame
    decodes, `dropped` the whole records behind a gap in their episode.
    """

    def __init__(self, folder: Path, prefix: scan.ValidPrefix) -> None:
        self._folder = folder
        self._recorder = spools.parse_folder_name(folder.name).recorder
        self._first = prefix.cut.number or min(prefix.numbers)
        self._numbers = [each for each in prefix.numbers if each >= self._first]
        self.headless = not prefix.bases and self._first > 1
        self.unreadable: list[Range] = []
        self.dropped: dict[EpisodeId, list[spool_format.Frame]] = {}
        earlier = {each: spool_format.segment_path(folder, each) for each in prefix.bases if each < self._first}
        before = scan.SegmentScanner(folder, self._recorder, segments=earlier)
        while before.step():
            pass
        self._open, self.position = dict(before.prefix.open), before.prefix.cut.position
        self._uncommitted = before.uncommitted  # by the segments that stay: the first new commit frame covers them
        header = (
            spool_format.decode_header(spool_format.read_segment(spool_format.segment_path(folder, self._first)))
            if self._first in prefix.bases
            else None
        )
        if header is not None:
            self._open, self.position = dict(header.open), header.base - 1
        if self.headless:
            self._reconstruct_header()
        self.start = self._last_position = self.position

    def run(self) -> None:
        """Replace the segments. Raises `OSError`."""
        safe, number = 0, self._first
        for damaged in self._numbers:
            before, after = dict(self._open), self.position
            frames = list(self._frames(damaged))
            safe = max([safe, *(frame.position for frame in frames if frame.kind == spool_format.COMMIT)])
            kept = [frame for frame in frames if frame.kind != spool_format.COMMIT and self._keep(frame)]
            if kept or damaged == self._first:
                header = spool_format.encode_segment_header(
                    spool_format.SegmentHeader(self._recorder, number, after + 1, before)
                )
                salt = spool_format.salt_of(self._recorder, number)
                span = spool_format.encode_span(kept, after=after, salt=salt, uncommitted=self._uncommitted)
                spools.write_durably(spool_format.segment_path(self._folder, number), b"".join((header, *span)))
                self._uncommitted = ()
                number += 1
            self.position += len(kept)
        for damaged in self._numbers:
            if damaged >= number:
                spool_format.segment_path(self._folder, damaged).unlink()
        if safe > self._last_position:
            self.unreadable.append((self._last_position + 1, safe))

    def kept_to(self, episode: EpisodeId) -> int:
        """Return the sequence of an open episode's last kept record; 0 if none is kept."""
        last = self._open.get(episode)
        return last.sequence if last is not None else 0

    def _frames(self, number: int) -> Iterator[spool_format.Frame]:
        """Decode the whole frames of a segment that a recorder can have written."""
        path = spool_format.segment_path(self._folder, number)
        for offset, frame in scan.whole_frames(
            spool_format.read_segment(path), spool_format.header_bytes(0), spool_format.salt_of(self._recorder, number)
        ):
            if frame.kind != spool_format.COMMIT:
                try:
                    scan.check_record(path, offset, frame)
                except SpoolDamaged:  # the gap it leaves is reported
                    continue
            yield frame

    def _reconstruct_header(self) -> None:
        """Find the episodes that were open before the first record: their first sequences here are above 1."""
        met: set[bytes] = set()
        for frame in (
            each for number in self._numbers for each in self._frames(number) if each.kind != spool_format.COMMIT
        ):
            self.position = self.position or frame.position - 1
            if frame.kind == spool_format.EVENT and frame.episode not in met:
                met.add(frame.episode)
                if frame.sequence > 1:
                    before = spool_format.LastRecord(frame.sequence - 1, frame.wall_ns, frame.monotonic_ns)
                    self._open[EpisodeId(frame.episode)] = before

    def _keep(self, frame: spool_format.Frame) -> bool:
        """Return whether this record can be kept; note a dropped record, and the positions missing before it."""
        if frame.position <= self._last_position:
            return False
        if frame.position > self._last_position + 1:
            self.unreadable.append((self._last_position + 1, frame.position - 1))
        self._last_position = frame.position
        if frame.kind != spool_format.EVENT:
            return True
        episode = EpisodeId(frame.episode)
        if frame.sequence != self.kept_to(episode) + 1:
            self.dropped.setdefault(episode, []).append(frame)
            return False
        self._open[episode] = spool_format.LastRecord(frame.sequence, frame.wall_ns, frame.monotonic_ns)
        if frame.type == spool_format.EPISODE_ENDED.encode():
            del self._open[episode]
        return True


def ranges(numbers: Iterable[int]) -> tuple[Range, ...]:
    """Group consecutive numbers: 1, 2, 3, 7 becomes (1, 3), (7, 7)."""
    grouped: list[Range] = []
    for number in numbers:
        if grouped and grouped[-1][1] == number - 1:
            grouped[-1] = (grouped[-1][0], number)
        else:
            grouped.append((number, number))
    return tuple(grouped)


@dataclass(frozen=True)
class DroppedRecords:
    """Whole records behind a gap in their episode, dropped because the log accepts no gap.

    Attributes:
        episode: the episode's id.
        kept_to: sequence of the episode's last kept record; 0 if none is kept.
        sequences: sequences of the dropped records.
        positions: their positions in the damaged folder.
    """

    episode: str
    kept_to: int
    sequences: tuple[Range, ...]
    positions: tuple[Range, ...]


@dataclass(frozen=True)
class RepairReport:
    """The result of one repair.

    Attributes:
        name: the recorder.
        set_aside: the damaged folder under its new name; it contains the files named in `damage`.
        damage: where the damage began.
        kept: number of records before the damage.
        saved: number of records salvaged behind it.
        unreadable: positions of records that cannot be read any more.
        given_up: by episode, whole records that were dropped.
        headless: the oldest file's header was unreadable: an episode that it listed as open and that has no record
            behind the damage does not get its end.
    """

    name: str
    set_aside: str
    damage: FileDamage
    kept: int
    saved: int
    unreadable: tuple[Range, ...]
    given_up: tuple[DroppedRecords, ...]
    headless: bool

    @property
    def complete(self) -> bool:
        """Return whether no record was lost or dropped."""
        return not (self.unreadable or self.given_up or self.headless)


def repair_folder(folder: Path) -> RepairReport | None:
    """Repair the folder if it is damaged; return None if it is whole.

    Raises `SpoolUnavailable` if the recorder lives, a process drains the folder, or it cannot be written, and
    `SpoolForeign` for a newer format or another recorder's file. Then the folder is unchanged.
    """
    with spools.wrap_os_errors(folder), ExitStack() as locks:
        for name, holder in (
            (ALIVE, "its recorder is alive, or another process drains it"),
            (DRAIN, "another process drains it"),
        ):
            lock = FileLock.take(folder / name, create=name == DRAIN)
            if lock is None:
                raise SpoolUnavailable(folder, f"{holder}: stop that process first")
            locks.callback(lock.release)
        recorder = spools.parse_folder_name(folder.name).recorder
        prefix, damage, _ = scan.survey(folder, recorder)
        if damage is None:
            return None
        aside = _copy_aside(folder)
        salvage = _Salvage(folder, prefix)
        salvage.run()
        written = scan.scan(folder, recorder).cut.position
        if written != salvage.position:
            raise InternalError(f"{folder} holds records up to {written} instead of {salvage.position}; see {aside}")
    return RepairReport(
        name=folder.name,
        set_aside=str(aside),
        damage=FileDamage(str(aside / damage.path.name), damage.offset, damage.reason),
        kept=prefix.cut.position - prefix.start.position,
        saved=salvage.position - max(prefix.cut.position, salvage.start),
        unreadable=tuple(salvage.unreadable),
        given_up=tuple(
            DroppedRecords(
                episode_text(episode),
                salvage.kept_to(episode),
                ranges(frame.sequence for frame in frames),
                ranges(frame.position for frame in frames),
            )
            for episode, frames in sorted(salvage.dropped.items())
        ),
        headless=salvage.headless,
    )


def _copy_aside(folder: Path) -> Path:
    """Copy a damaged folder under a free name; return the copy. Links its files, because a repair replaces them."""
    names = chain([""], map(".{}".format, count(2)))
    copies = (folder.with_name(f"{folder.name}{DAMAGED_SUFFIX}{each}") for each in names)
    aside = next(each for each in copies if not each.exists())
    shutil.copytree(folder, aside, copy_function=_link, ignore=shutil.ignore_patterns(ALIVE, DRAIN, PROGRESS))
    spool_format.sync_path(aside)
    spool_format.sync_path(folder.parent)
    return aside


def _link(source: str, target: str) -> None:
    try:
        os.link(source, target)
    except OSError:  # the file system has no hard links
        shutil.copyfile(source, target)


def finish_repairs(spool: Path) -> list[Path]:
    """Name the finished folders of repairs by an earlier version that were killed in their last step; return them."""
    folders = []
    with spools.wrap_os_errors(spool):
        for repaired in sorted(spool.glob(f"*{MENDED}")):
            folder = repaired.with_name(repaired.name.removesuffix(MENDED))
            if not folder.exists():  # the damaged folder was renamed only after the new one was whole and synced
                repaired.rename(folder)
                spool_format.sync_path(spool)
                folders.append(folder)
    return folders
