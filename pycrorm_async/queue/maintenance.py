"""Inspect a spool, and repair a damaged recorder's folder."""

from __future__ import annotations

import os
import shutil
from collections import Counter
from collections.abc import Iterable, Iterator
from contextlib import ExitStack
from dataclasses import dataclass, field, replace
from pathlib import Path
from typing import Final, TypeAlias

from pycrorm_async.errors import InternalError, SpoolDamaged, SpoolUnavailable
from pycrorm_async.events.ids import EpisodeId, episode_text
from pycrorm_async.queue.blobs import blob_bytes, blob_files, carry_blobs
from pycrorm_async.queue.format import (
    COMMIT,
    EPISODE_ENDED,
    EVENT,
    Frame,
    LastRecord,
    SegmentHeader,
    decode_header,
    encode_segment_header,
    encode_span,
    header_bytes,
    read_segment,
    salt_of,
    segment_numbers,
    segment_path,
    sync_folder,
)
from pycrorm_async.queue.locks import (
    ALIVE,
    BLOBS,
    DRAIN,
    MAKING,
    MENDED,
    PROGRESS,
    TAIL,
    FileLock,
    create_folder,
    is_locked,
    open_file,
)
from pycrorm_async.queue.scan import Survey, check_record, scan, survey, tails, whole_frames
from pycrorm_async.queue.spool import (
    DrainStatus,
    Progress,
    RecorderFolder,
    RecorderStatus,
    Spool,
    folder_error,
    is_folder_name,
    parse_folder_name,
    wrap_os_errors,
    write_durably,
)

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
        damage=None if damage is None else FileDamage(str(damage.path), damage.offset, damage.reason),
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


# === salvage ==================================================================================================
#
# Copy a damaged folder's whole records to a new one: those before the damage, and those that can be kept behind it.
#
# An episode's records are kept up to its first missing record, because the log accepts no episode with a gap. The
# records behind the damage get new positions, because positions have no gaps either.

Range: TypeAlias = tuple[int, int]
"""The first and the last of consecutive numbers."""


class Salvage:
    """One copy of the whole records of a damaged folder to a new folder.

    `position` is that of the last record written, `saved` the number of records from behind the damage, `unreadable`
    the positions in the damaged folder for which no frame decodes.
    """

    def __init__(self, damaged: Path, repaired: Path, result: Survey) -> None:
        self._damaged = damaged
        self._repaired = repaired
        self._recorder = parse_folder_name(damaged.name).recorder
        self._survey = result
        prefix = result.prefix
        self.headless = not prefix.bases and bool(prefix.numbers) and prefix.numbers[0] > 1
        self._open = dict(prefix.open)
        self._number = prefix.cut.number
        self.position = self._last_position = prefix.cut.position
        self.saved = 0
        self.unreadable: list[Range] = []
        self._dropped: dict[EpisodeId, list[Frame]] = {}

    def run(self) -> None:
        """Write the new folder's blobs and segments. Raises `OSError`."""
        prefix = self._survey.prefix
        carry_blobs(self._damaged, self._repaired)
        if self.headless:
            self._begin_without_header()
        for number in sorted(prefix.bases):
            self._copy(number)
        if not prefix.bases:
            self._number -= 1  # the first one written replaces the one with the unreadable header
        safe = 0
        for number in (each for each in self._survey.prefix.numbers if each >= self._survey.prefix.cut.number):
            frames = list(self._frames(number))
            safe = max([safe, *(frame.position for frame in frames if frame.kind == COMMIT)])
            before = dict(self._open)
            self._write(before, [frame for frame in frames if frame.kind != COMMIT and self._keep(frame)])
        if safe > self._last_position:
            self.unreadable.append((self._last_position + 1, safe))

    @property
    def dropped(self) -> dict[EpisodeId, list[Frame]]:
        """Whole records behind a gap in their episode."""
        return self._dropped

    def kept_to(self, episode: EpisodeId) -> int:
        """Return the sequence of an open episode's last kept record; 0 if none is kept."""
        last = self._open.get(episode)
        return last.sequence if last is not None else 0

    def _frames(self, number: int) -> Iterator[Frame]:
        """Decode the whole frames of a segment behind the damage."""
        prefix = self._survey.prefix
        content = read_segment(segment_path(self._damaged, number))
        start = prefix.cut.offset if number == prefix.cut.number and prefix.bases else header_bytes(0)
        path = segment_path(self._damaged, number)
        for offset, frame in whole_frames(content, start, salt_of(self._recorder, number)):
            if frame.kind != COMMIT:
                try:
                    check_record(path, offset, frame)
                except SpoolDamaged:  # the gap it leaves is reported
                    continue
            yield frame

    def _begin_without_header(self) -> None:
        """Reconstruct the open episodes of a lost header from later headers and each episode's first record."""
        numbers = self._survey.prefix.numbers
        first: dict[EpisodeId, Frame] = {}
        for number in numbers:
            header = decode_header(read_segment(segment_path(self._damaged, number)))
            for episode, last in header.open.items() if header is not None else ():
                if episode not in first:
                    self._open.setdefault(episode, last)
            for frame in self._frames(number):
                if frame.kind == EVENT:
                    first.setdefault(EpisodeId(frame.episode), frame)
                if not self.position and frame.kind != COMMIT:
                    self.position = self._last_position = frame.position - 1
        for episode, frame in first.items():
            if frame.sequence > 1:
                self._open[episode] = LastRecord(frame.sequence - 1, frame.wall_ns, frame.monotonic_ns)
        self._number = numbers[0]

    def _keep(self, frame: Frame) -> bool:
        """Return whether this record can be kept; note a dropped record, and the positions missing before it."""
        if frame.position <= self._last_position:
            return False
        if frame.position > self._last_position + 1:
            self.unreadable.append((self._last_position + 1, frame.position - 1))
        self._last_position = frame.position
        if frame.kind != EVENT:
            return True
        episode = EpisodeId(frame.episode)
        before = self._open.get(episode)
        if frame.sequence != (before.sequence if before else 0) + 1:
            self._dropped.setdefault(episode, []).append(frame)
            return False
        self._open[episode] = LastRecord(frame.sequence, frame.wall_ns, frame.monotonic_ns)
        if frame.type == EPISODE_ENDED.encode():
            del self._open[episode]
        return True

    def _copy(self, number: int) -> None:
        """Copy a segment from before the damage; end the last one at the cut and commit its records."""
        source, target = segment_path(self._damaged, number), segment_path(self._repaired, number)
        cut = self._survey.prefix.cut
        if number < cut.number:
            try:
                os.link(source, target)
            except OSError:  # the file system has no hard links
                write_durably(target, read_segment(source))
            return
        content, uncommitted = read_segment(source)[: cut.offset], self._survey.uncommitted
        if uncommitted:
            content += encode_span(
                [], after=self.position, salt=salt_of(self._recorder, number), uncommitted=uncommitted
            )[1]
        write_durably(target, content)

    def _write(self, before: dict[EpisodeId, LastRecord], records: list[Frame]) -> None:
        """Write the next segment, unless there are no records."""
        if not records:
            return
        self._number += 1
        header = encode_segment_header(SegmentHeader(self._recorder, self._number, self.position + 1, before))
        span = encode_span(records, after=self.position, salt=salt_of(self._recorder, self._number))
        self.position += len(records)
        self.saved += len(records)
        write_durably(segment_path(self._repaired, self._number), b"".join((header, *span)))


def ranges(numbers: Iterable[int]) -> tuple[Range, ...]:
    """Group consecutive numbers: 1, 2, 3, 7 becomes (1, 3), (7, 7)."""
    grouped: list[Range] = []
    for number in numbers:
        if grouped and grouped[-1][1] == number - 1:
            grouped[-1] = (grouped[-1][0], number)
        else:
            grouped.append((number, number))
    return tuple(grouped)


# === repair ===================================================================================================
#
# Repair a dead recorder's damaged folder, so that its whole records can be drained, and report the records dropped.
#
# The damaged folder is renamed unchanged to `<recorder>.damaged`, and a new folder takes its name. The new folder holds
# the segments before the damage and new segments with the whole records behind it, as far as `maintenance.py` can keep
# them.
#
# The new folder is built beside the old one, scanned and synced before either is renamed. After a kill at any point the
# next repair continues: it builds an unfinished folder again, and renames a finished one.


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
    with wrap_os_errors(folder), ExitStack() as locks:
        alive = FileLock.take(folder / ALIVE, create=False)
        if alive is None:
            reason = "its recorder is alive, or another process drains it: stop that process first"
            raise SpoolUnavailable(folder, reason)
        locks.callback(alive.release)
        drain = FileLock.take(folder / DRAIN)
        if drain is None:
            raise SpoolUnavailable(folder, "another process drains it: stop that process first")
        locks.callback(drain.release)
        result = survey(folder, parse_folder_name(folder.name).recorder)
        return None if result.damage is None else _replace(folder, result, result.damage)


def finish_repairs(spool: Path) -> list[Path]:
    """Name the finished folders of repairs killed between their last two steps; return these folders."""
    folders = []
    with wrap_os_errors(spool):
        for repaired in sorted(spool.glob(f"*{MENDED}")):
            folder = repaired.with_name(repaired.name.removesuffix(MENDED))
            if not folder.exists():  # the damaged folder is renamed only after the new one is whole and synced
                repaired.rename(folder)
                sync_folder(spool)
                folders.append(folder)
    return folders


def _replace(folder: Path, result: Survey, damage: SpoolDamaged) -> RepairReport:
    """Build a repaired folder, rename the damaged one, and give its name to the repaired one."""
    repaired = folder.with_name(f"{folder.name}{MENDED}")
    if repaired.exists():  # left by a killed repair
        shutil.rmtree(repaired)
    create_folder(repaired)
    try:
        salvage = _fill(repaired, folder, result)
        damaged = _free_name(folder)
        folder.rename(damaged)
    except BaseException:
        shutil.rmtree(repaired, ignore_errors=True)
        raise
    repaired.rename(folder)
    sync_folder(folder.parent)
    return RepairReport(
        name=folder.name,
        set_aside=str(damaged),
        damage=FileDamage(str(damaged / damage.path.name), damage.offset, damage.reason),
        kept=result.prefix.cut.position - result.prefix.start.position,
        saved=salvage.saved,
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


def _fill(repaired: Path, folder: Path, result: Survey) -> Salvage:
    """Write the new folder, scan it again and sync it."""
    os.close(open_file(repaired / ALIVE, os.O_WRONLY))
    salvage = Salvage(folder, repaired, result)
    salvage.run()
    written = scan(repaired, parse_folder_name(folder.name).recorder).cut.position
    if written != salvage.position:
        raise InternalError(
            f"{repaired} holds records up to position {written} instead of {salvage.position};"
            " the damaged folder is unchanged"
        )
    sync_folder(repaired)
    return salvage


def _free_name(folder: Path) -> Path:
    name = folder.with_name(f"{folder.name}{DAMAGED_SUFFIX}")
    number = 1
    while name.exists():
        number += 1
        name = folder.with_name(f"{folder.name}{DAMAGED_SUFFIX}.{number}")
    return name
