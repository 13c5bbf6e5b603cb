"""Wire the log and the tables of a database to the writer, and bind a spool to them.

**Healing.** Append again the events that the log lost in a failover or a restored backup. A log loses its commits from
the end: if the last commit is present, all are. Each append names the episode that this process stored last. The
transaction that appends reads that episode's head in the log. If the log has less than it had confirmed, it went back:
nothing is stored and `LogWentBack` is raised. An append that finds less of one of its own episodes proves the same.
`confirm` compares without an append: at a flush, and at intervals in the daemon. The first comparison of a process
reads the last event of each recorder from its kept segments (`queue/stored_segments.py`), and the stored events of
living recorders from their folders.

Healing appends every event of the segments beyond the log's heads, declarations first, each episode under its old
number. Several processes may heal at once, because the log stores the same event only once. Events that no segment
contains any more stay missing: the episode is refused with its gap.

A spool that appends new episodes before another spool has healed may get numbers of the other's lost episodes; these
then get new numbers, and their row ids change. No number is given to two episodes.
"""

import asyncio
import logging
import socket
import time
from collections.abc import AsyncIterator, Callable, Iterator, Mapping, Sequence
from contextlib import asynccontextmanager, suppress
from functools import partial
from pathlib import Path
from shlex import quote
from typing import Final, NamedTuple

from pycrorm_async import errors
from pycrorm_async.clock import SYSTEM_CLOCK, Clock
from pycrorm_async.events.codec import Record
from pycrorm_async.events.ids import EPISODE_NUMBER_MAX, EpisodeId, episode_text
from pycrorm_async.projections.custom import Projection, installed_projections
from pycrorm_async.projections.fold_group import FoldGroup
from pycrorm_async.projections.mapped_tables import UserView
from pycrorm_async.projections.pipeline import LOOKAHEAD_EVENTS_MIN, WHOLE
from pycrorm_async.projections.projector import Projector
from pycrorm_async.queue.blobs import read_blob
from pycrorm_async.queue.format import map_segment, salt_of, segments_in
from pycrorm_async.queue.locks import STORED
from pycrorm_async.queue.scan import SegmentScanner, last_event
from pycrorm_async.queue.sources import computed_ends
from pycrorm_async.queue.spool import Progress, Spool, is_folder_name, parse_folder_name, wrap_os_errors
from pycrorm_async.queue.stored_segments import EpisodeNumbers, kept_segments, stored_in
from pycrorm_async.settings import Settings
from pycrorm_async.store.address import DatabaseAddress
from pycrorm_async.store.log import EventLog
from pycrorm_async.store.schema import SELECT_BEHIND, SELECT_STOPPED
from pycrorm_async.store.stored import EpisodeRow

_APPENDS_AT_ONCE = 4
"""Bounds the concurrent appends to a server, for any number of recorders: the pool's connections less one for folding.
"""

_WATCH_S = 1.0
"""The interval between two checks that a SQLite file still exists; a check takes two microseconds."""

_OTHERS_S: Final = 1.0
"""The time for which a process that wants all events folded waits for others to fold some of their shares."""

_log = logging.getLogger("pycrorm_async")
_HEADS_MAX: Final = 64
"""Bounds the episodes whose confirmed heads a process compares: more than it appends to at once."""
_RECORDERS_MAX: Final = 256
"""Bounds the recorders whose kept segments the first comparison reads, those kept last: 256 take some 50 ms."""
_HEALINGS_MAX: Final = 3
"""Bounds the healings in one append, because a log may go back again while it is healed."""


class LogAndTables:
    """The log and the tables folded from it. Implements the writer's `StepwiseDestination`.

    While this process cannot use the tables, it appends events and folding raises `TablesForeign`. With a spool, the
    events in its segments are appended again to a log that lost them.
    """

    def __init__(self, log: EventLog, projector: Projector, spool: Path | None = None) -> None:
        self.log = log
        self.log_id = log.log_id
        self.group = FoldGroup(log)
        self._projector = projector
        self._spool = spool
        self._refused = False
        # SQLite allows one writer, and a waiting connection polls for the lock. A semaphore serves waiters in order.
        self._appending = asyncio.Semaphore(1 if log.address.is_sqlite else _APPENDS_AT_ONCE)
        self._numbers = EpisodeNumbers((spool or Path()) / STORED / log.log_id)
        self._heads: dict[EpisodeId, int] | None = None  # confirmed, the last one last; None before a comparison
        self._comparing = asyncio.Lock()
        self._folding = asyncio.Lock()

    async def open_tables(self) -> None:
        """Open the tables. Raises the errors of `Projector.open` but `TablesForeign`: each fold opens them again."""
        try:
            await self._projector.open()
        except errors.TablesForeign as error:
            self._refused = True
            _log.warning("%s; events are stored in the log but not folded until then", error)

    # --- the log ----------------------------------------------------------------------------------------------

    async def append(
        self, records: Sequence[Record], on_wait: Callable[[], None] = lambda: None
    ) -> Mapping[EpisodeId, str]:
        if self._spool is None:
            return await self.log.append(records, on_wait)
        # Before this process' turn, so that others need not wait for large blobs.
        await self.log.blobs.store_for(records)
        async with self._appending:
            for _ in range(_HEALINGS_MAX):
                if self._heads is None:
                    await self.confirm()
                heads = self._heads or {}
                try:
                    stored = await self.log.store(records, on_wait=on_wait, witness=next(reversed(heads.items()), None))
                except errors.LogWentBack:
                    await self.confirm()
                    continue
                if all(row.head >= heads.get(each, 0) for each, row in stored.rows.items()):
                    break
                await self.confirm()
            else:
                stored = await self.log.store(records, on_wait=on_wait)
        self._numbers.note({each: row.number for each, row in stored.rows.items()})
        others = {each: head for each, head in (self._heads or {}).items() if each not in stored.rows}
        self._heads = _latest(others | {each: row.head for each, row in stored.rows.items()})
        return stored.refusals

    async def confirm(self) -> None:
        if self._spool is None:
            return
        async with self._comparing:
            heads = self._heads
            if heads is None:
                try:
                    heads = await asyncio.to_thread(stored_heads, self._spool, self.log_id)
                except (OSError, errors.FilesError) as error:  # must not stop the drain
                    _log.warning("%s: cannot compare with the kept segments: %s", self.log.address, error)
                    heads = {}
            rows = await self.log.heads(list(heads))
            removed = await self.log.removed(heads.keys() - rows.keys())
            now = dict.fromkeys(heads, 0) | {each: row.head for each, row in rows.items()}
            now |= {each: row.head for each, row in removed.items()}
            lost = next((each for each, head in heads.items() if now[each] < head), None)
            if lost is not None:
                await self._heal(errors.LogWentBack(episode_text(lost), heads[lost], now[lost]), self._spool, heads)
                # What no segment contains is not searched again.
                self._heads = {each: row.head for each, row in (await self.log.heads(list(_latest(heads)))).items()}
            elif self._heads is None:
                self._heads = _latest(heads)

    async def _heal(self, cause: errors.LogWentBack, spool: Path, confirmed: Mapping[EpisodeId, int]) -> None:
        """Append again what the segments contain, and fold it, because a flush waits for new events only.

        Events of a recorder's own folder that were not stored before are appended with the others, and not counted. In
        the first comparison of a process a healing that changed nothing is not reported again.
        """
        changed: dict[EpisodeId, EpisodeRow] = {}
        declared: set[bytes] = set()  # each segment repeats declarations
        appended = 0
        numbers = await asyncio.to_thread(self._numbers.read)
        await self.log.skip_numbers(max(numbers.values(), default=0))
        for recorder in await asyncio.to_thread(stored_recorders, spool, self.log_id):
            parts = stored_records(recorder)
            try:
                while (part := await asyncio.to_thread(next, parts, None)) is not None:
                    rows = await self.log.heads(list({each.episode for each in part if each.episode is not None}))
                    heads = {each: row.head for each, row in rows.items()}
                    lost = [
                        each
                        for each in part
                        if (
                            each.sequence > heads.get(each.episode, 0) if each.episode else each.payload not in declared
                        )
                    ]
                    declared.update(each.payload for each in lost if each.episode is None)
                    for start in range(0, len(lost), Settings.batch_events_max):
                        batch = lost[start : start + Settings.batch_events_max]
                        for each, row in (await self.log.store(batch, numbers=numbers)).rows.items():
                            is_lost = recorder.over or each in confirmed
                            appended += is_lost * (row.head - heads.get(each, 0))
                            heads[each] = row.head
                            if is_lost and (each not in rows or rows[each]._replace(folded=0, parked=None) != row):
                                changed[each] = row
            except errors.LogDamaged as error:  # skip this recorder; the segments of the others may still heal the log
                _log.error("recorder %s: %s", recorder.name, error)
        if self._heads is None and not changed:
            return
        incomplete = sum(row.refused is not None for row in changed.values())
        done = f"{appended:,} events were appended again; {incomplete} of {len(changed)} episodes stay incomplete"
        _log.warning("%s: %s; %s", self.log.address, cause, done)
        self._refused = True  # the layout of the tables may have gone back too
        noticed = SYSTEM_CLOCK.wall_ns(), f"{socket.gethostname()}:{spool}", f"{cause}; {done}"
        for work in (partial(self.log.note_incarnation, *noticed), self.fold):
            try:
                await work()
            except errors.DatabaseError as error:
                _log.warning("%s: the healing is not noted or not visible yet: %s", self.log.address, error)

    @property
    def writes(self) -> int:
        return self.log.writes

    # --- the tables -------------------------------------------------------------------------------------------

    @property
    def has_other_writers(self) -> bool:
        return not self.log.address.is_sqlite

    async def fold(self) -> int:
        """Fold everything in the log, of a large backlog by share first; return the number of events folded here."""
        async with self._tables():
            count = 0
            if self.has_other_writers and await self._projector.size() >= LOOKAHEAD_EVENTS_MIN:
                count = await self._fold_by_share()
            return count + await self._projector.catch_up()

    async def _fold_by_share(self) -> int:
        """Fold this process' share of what is behind now, and wait for the others to fold theirs, while these do."""
        count, moved_s = 0, time.monotonic()
        heads = {each.id: each.head for each in await self._episodes_behind()}  # others may append more all the time
        behind: Mapping[str, int] = {}
        try:
            while True:
                async with self.group.folding() as share:
                    folded = await self._projector.fold_tables(share)
                if folded is not None:
                    count, moved_s = count + folded, time.monotonic()
                    continue
                now = await self.behind()
                before, behind = behind, {each: at for each, at in now.items() if at < heads.get(each, 0)}
                moved_s = time.monotonic() if before != behind else moved_s
                if not behind or time.monotonic() > moved_s + _OTHERS_S:
                    return count
                await asyncio.sleep(_OTHERS_S / 10)
        finally:
            await self.group.leave()

    async def fold_next_batch(self) -> bool:
        async with self._tables(), self.group.folding() as share:
            return await self._projector.fold_next_batch(share)

    async def has_unfolded(self) -> bool:
        share = await self.group.share()
        return bool(await self.group.read(EpisodeRow, SELECT_BEHIND, after=0, limit=1, **share._asdict()))

    @asynccontextmanager
    async def _tables(self) -> AsyncIterator[None]:
        """Let one task fold at a time: one whose task heals the log does so beside the one that always folds.

        Opens the tables again after a failed fold or a healed log, because their layout may have changed.
        """
        async with self._folding:
            if self._refused:
                await self._projector.open()
                self._refused = False
            try:
                yield
            except Exception:
                self._refused = True
                raise

    async def behind(self) -> Mapping[str, int]:
        return {each.id: each.folded for each in await self._episodes_behind()}

    async def _episodes_behind(self) -> list[EpisodeRow]:
        return await self.group.read(EpisodeRow, SELECT_BEHIND, after=0, limit=EPISODE_NUMBER_MAX, **WHOLE._asdict())

    async def stopped(self) -> Mapping[str, str]:
        stopped = await self.group.read(EpisodeRow, SELECT_STOPPED)
        return {each.id: each.refused or each.parked or "" for each in stopped}


def _latest(heads: Mapping[EpisodeId, int]) -> dict[EpisodeId, int]:
    return dict(list(heads.items())[-_HEADS_MAX:])


@asynccontextmanager
async def open_destination(
    address: DatabaseAddress,
    spool: Spool,
    *,
    clock: Clock,
    views: Sequence[UserView] = (),
    projections: Sequence[Projection] = (),
    settings: Settings = Settings(),  # noqa: B008  frozen
) -> AsyncIterator[LogAndTables]:
    """Open the log and the tables for writing in the running loop, and bind the spool to the log.

    Folds these projections and the installed ones. Raises `SpoolForeign`.
    """
    expected = expected_log(address, spool)
    log = await EventLog.open(address, create=True, clock=clock, file_access=spool.access, belongs_to=expected)
    if address.is_sqlite:
        log.advice = (
            "put it back, or end this process and store its events in a new database with:"
            f" pycrorm spool rebind --url {quote(address.to_type)} --spool {quote(str(spool.path))}"
        )
    watching = asyncio.create_task(_watch_file(log), name="pycrorm watch file")
    try:
        spool.bind(log.log_id)
        log.blobs.source = _SpoolBlobs(spool.path)
        installed = installed_projections(projections, own=settings.recall)
        projector = Projector(log, views=views, projections=projections, installed=installed)
        keeps = settings.keep_stored_s and settings.keep_stored_bytes
        kept = spool.path if keeps and stored_in(spool.path, log.log_id) else None
        destination = LogAndTables(log, projector, kept)
        try:
            await destination.open_tables()
            yield destination
        finally:
            await destination.group.leave()
    finally:
        watching.cancel()
        await log.close()


class _SpoolBlobs:
    """The blobs in the folders of a spool. Implements `BlobSource`."""

    def __init__(self, spool: Path) -> None:
        self._spool = spool

    async def read_blob(self, name: str) -> bytes | None:
        with wrap_os_errors(self._spool):
            return await asyncio.to_thread(read_blob, self._spool, name)


def expected_log(address: DatabaseAddress, spool: Spool) -> str | None:
    """The id of the log that the database must contain; None where a new log may be created.

    A SQLite file that was deleted while the spool was empty is created again. An empty database on a server is refused,
    because an operator may be restoring it at this moment.
    """
    return None if address.is_sqlite and not spool.recorders() else spool.log_id()


async def _watch_file(log: EventLog) -> None:
    """Log an error when the database file is removed, also while there is nothing to store."""
    lost = False
    while True:
        await asyncio.sleep(_WATCH_S)
        loss = log.loss
        if loss is not None and not lost:
            _log.error("%s", loss)
        elif loss is None and lost:
            _log.warning("%s: the file exists again", log.address)
        lost = loss is not None


# === stored records ===========================================================================================
#
# Read stored records again: each recorder's kept segments and those still in its folder.
#
# Yields only records that a commit frame covers, because others may be lost with the machine. Files may be deleted
# during the reading; their records are left out.


class StoredRecorder(NamedTuple):
    """A recorder's segments by number. `over` if its own folder is deleted, because all its records are stored."""

    name: str
    segments: dict[int, Path]
    over: bool


def stored_recorders(spool: Path, log_id: str) -> list[StoredRecorder]:
    """List every recorder with records that may be stored in this log, oldest first. Raises `FilesError`."""
    kept = stored_in(spool, log_id)
    present = {each.name for each in Spool(spool).recorders()}
    names = set(present)
    if kept is not None and kept.is_dir():
        names |= {each.name for each in kept.iterdir() if is_folder_name(each.name) and each.is_dir()}
    recorders = []
    for name in sorted(names):
        # List the source folder first, so that a segment moved meanwhile is listed twice rather than missed.
        segments = _segments(spool / name)
        if kept is not None:
            segments |= _segments(kept / name)
        recorders.append(StoredRecorder(name, dict(sorted(segments.items())), over=name not in present))
    return recorders


def stored_records(recorder: StoredRecorder) -> Iterator[list[Record]]:
    """Yield a recorder's records, one segment at a time, then the computed ends if the recorder is over.

    Stops at a file that is missing or damaged.
    """
    ready: list[Record] = []
    scanner = SegmentScanner(
        Path(), parse_folder_name(recorder.name).recorder, records=ready, segments=recorder.segments
    )
    yielded = 0
    more = True
    try:
        while more:
            more = scanner.step()
            if more or not recorder.over:
                count = scanner.prefix.cut.position - len(scanner.uncommitted) - scanner.prefix.start.position - yielded
            else:
                ready += computed_ends(scanner.prefix)
                count = len(ready)
            yield ready[:count]
            del ready[:count]
            yielded += count
    except (FileNotFoundError, errors.SpoolDamaged, errors.FilesError):
        return


def stored_heads(spool: Path, log_id: str) -> dict[EpisodeId, int]:
    """Return the sequences that the log must have reached, by episode; the latest come last.

    A recorder with kept segments contributes their last event. A living recorder that another process drains
    contributes each episode in its folder. Raises `FilesError` and `OSError`.
    """
    heads: dict[EpisodeId, int] = {}
    newest: dict[Path, Path] = {}  # by folder, the one kept last at the end
    for each in kept_segments(spool):
        newest.pop(each.path.parent, None)
        newest[each.path.parent] = each.path
    for folder, path in list(newest.items())[-_RECORDERS_MAX:]:
        if folder.parent == stored_in(spool, log_id) and is_folder_name(folder.name):
            with suppress(FileNotFoundError, errors.SpoolDamaged), map_segment(path) as buffer:
                last = last_event(buffer, salt_of(parse_folder_name(folder.name).recorder, int(path.stem)))
                if last is not None:
                    heads[EpisodeId(last.episode)] = last.sequence
    for recorder in Spool(spool).recorders():
        progress = Progress.open(recorder.path, writing=False) if recorder.alive else None
        if progress is not None:
            stored = min(progress.drained().stored, progress.recorded().synced)
            progress.close()
            segments = _segments(recorder.path) if stored else {}
            for part in stored_records(StoredRecorder(recorder.name, segments, over=False)):
                heads |= {each.episode: each.sequence for each in part if each.episode and each.position <= stored}
                if part and part[-1].position >= stored:
                    break
    return heads


def _segments(folder: Path) -> dict[int, Path]:
    try:
        return segments_in(folder)
    except (FileNotFoundError, NotADirectoryError):
        return {}
