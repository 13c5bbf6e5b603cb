"""Wire the log and the tables of a database to the writer, and bind a spool to them.

**Healed log.** Append to a log, and append again the events that it lost in a failover or a restored backup.

    healed = HealedLog(log, spool, stored_in(spool, log.log_id), settings, clock=clock)
    refusals = await healed.append(records)
    await healed.confirm()

Theory of operation. The spool remembers the acknowledged head of each episode, the last sequence that the log has
confirmed (`queue/spool.py`), and keeps stored segments for a while
(`queue/stored_segments.py`). Every append names the episode of this spool that was stored last, by any
process. The transaction that appends reads that episode's head in the log. If the log has less than was acknowledged,
it went back: nothing is stored and `LogWentBack` is raised. A log loses its commits from the end, so if the last one is
present, all are. An append that finds a gap in an episode with a higher acknowledged head proves the same. `confirm`
makes this check without an append: at a start, at a flush, and at intervals in the daemon.

Healing compares the acknowledged heads of all episodes with those of the log. It reads the records beyond the log's
heads from the segments and appends them, declarations first, each episode under its old number. Several processes may
heal at once, because the log stores the same event only once. Records that no segment contains any more stay missing:
the acknowledged head is lowered to the log's, so that healing does not search for them again, and the episode is
refused with its gap when later events of it arrive.

An append assigns only episode numbers above the highest number remembered, and leaves a reserve free behind it for
other spools that were stored in the same log and return later. A spool that remembers none of the lost episodes and
appends before all others may receive their numbers; then a lost episode gets a new number, and its row ids change. No
number is ever given to two episodes.
"""

from __future__ import annotations

import asyncio
import logging
import socket
from collections.abc import AsyncIterator, Iterable, Iterator, Mapping, Sequence
from contextlib import asynccontextmanager
from pathlib import Path
from shlex import quote
from typing import Final, NamedTuple, TypeVar

from pycrorm_async.clock import Clock
from pycrorm_async.errors import (
    CallerError,
    DatabaseError,
    FilesError,
    LogDamaged,
    LogWentBack,
    SpoolDamaged,
    TablesForeign,
)
from pycrorm_async.events.codec import Record
from pycrorm_async.events.ids import EpisodeId, episode_text
from pycrorm_async.projections.custom import Projection, installed_projections
from pycrorm_async.projections.mapped_tables import UserView
from pycrorm_async.projections.projector import Projector
from pycrorm_async.queue.blobs import read_blob
from pycrorm_async.queue.format import segment_numbers, segment_path
from pycrorm_async.queue.scan import SegmentScanner
from pycrorm_async.queue.sources import computed_ends
from pycrorm_async.queue.spool import AcknowledgedHeads, Spool, is_folder_name, parse_folder_name, wrap_os_errors
from pycrorm_async.queue.stored_segments import stored_in
from pycrorm_async.settings import Settings
from pycrorm_async.store.address import DatabaseAddress
from pycrorm_async.store.log import EventLog
from pycrorm_async.store.stored import Basis, EpisodeRow

_APPENDS_AT_ONCE = 4
"""Bounds the concurrent appends to a server, for any number of recorders: the pool's connections less one for folding.
"""

_WATCH_S = 1.0
"""The interval between two checks that a SQLite file still exists; a check takes two microseconds."""

_log = logging.getLogger("pycrorm_async")


class LogAndTables:
    """The log and the tables folded from it. Implements the writer's `Log`, `Destination` and `Tables`.

    While this process cannot use the tables, it appends events and folding raises `TablesForeign`.
    """

    def __init__(self, log: EventLog, projector: Projector, healed: HealedLog | None = None) -> None:
        self.log = log
        self.log_id = log.log_id
        self._healed = healed
        self._projector = projector
        self._refused = False
        self._rounds = 0
        # SQLite allows one writer, and a waiting connection polls for the lock. A semaphore serves waiters in order.
        self._appending = asyncio.Semaphore(1 if log.address.is_sqlite else _APPENDS_AT_ONCE)

    async def open_tables(self) -> None:
        """Open the tables. Raises as `Projector.open` does, except `TablesForeign`: each fold then opens them again."""
        try:
            await self._projector.open()
        except TablesForeign as error:
            self._refused = True
            _log.warning("%s; events are stored in the log but not folded until then", error)

    async def append(self, records: Sequence[Record]) -> Mapping[EpisodeId, str]:
        await self.log.store_blobs(records)  # before this process' turn, so that others need not wait for large blobs
        async with self._appending:
            if self._healed is None:
                return await self.log.append(records)
            async with self._folding_healed(self._healed):
                return await self._healed.append(records)

    async def confirm(self) -> None:
        if self._healed is not None:
            async with self._folding_healed(self._healed):
                await self._healed.confirm()

    @asynccontextmanager
    async def _folding_healed(self, healed: HealedLog) -> AsyncIterator[None]:
        """Fold the events that `healed` appended again inside, because a flush waits for new events only."""
        rounds = healed.rounds
        yield
        if healed.rounds != rounds:
            try:
                await self.fold()
            except DatabaseError as error:
                _log.warning("the events that were appended again are not visible in the tables yet: %s", error)

    @property
    def writes(self) -> int:
        return self.log.writes

    async def fold(self) -> int:
        async with self._tables():
            return await self._projector.catch_up()

    async def fold_next_batch(self) -> bool:
        async with self._tables():
            return await self._projector.fold_next_batch()

    @asynccontextmanager
    async def _tables(self) -> AsyncIterator[None]:
        """Open the tables again after a failed fold or a healed log, because their layout may have changed."""
        if self._refused or self._rounds != self._rounds_healed:
            self._rounds = self._rounds_healed
            self._refused = True
            await self._projector.open()
            self._refused = False
        try:
            yield
        except Exception:
            self._refused = True
            raise

    @property
    def _rounds_healed(self) -> int:
        return 0 if self._healed is None else self._healed.rounds

    async def behind(self) -> Mapping[str, int]:
        return {each.id: each.folded for each in await self.log.behind()}

    async def stopped(self) -> Mapping[str, str]:
        return {each.id: each.refused or each.parked or "" for each in await self.log.stopped()}


@asynccontextmanager
async def open_destination(
    address: DatabaseAddress,
    spool: Spool,
    *,
    clock: Clock,
    views: Sequence[UserView] = (),
    projections: Sequence[Projection] = (),
    settings: Settings | None = None,
) -> AsyncIterator[LogAndTables]:
    """Open the log and the tables for writing in the running loop, and bind the spool to the log.

    Folds these projections and the installed ones. With `settings`, the events that the spool keeps are appended again
    to a log that lost them. Raises `SpoolForeign`.
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
        installed = installed_projections(projections, own=settings is None or settings.recall)
        projector = Projector(log, views=views, projections=projections, installed=installed)
        healed: HealedLog | None = None
        if settings is not None and settings.keep_stored_s and settings.keep_stored_bytes:
            folder = stored_in(spool.path, log.log_id)
            healed = None if folder is None else HealedLog(log, spool.path, folder, settings, clock=clock)
        destination = LogAndTables(log, projector, healed)
        await destination.open_tables()
        yield destination
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


def shared_address(url: str | DatabaseAddress) -> DatabaseAddress:
    """The address of a database that another process can open too. Raises `UnknownUrl`, `CallerError`."""
    address = DatabaseAddress.parse(url) if isinstance(url, str) else url
    if address.is_private:
        raise CallerError("sqlite:// exists only in its own process, no other can open it: name a file")
    return address


# === healed log ===============================================================================================

_EPISODES_MAX: Final = 1_000
"""Bounds the episodes whose heads one statement reads."""
_ROUNDS: Final = 3
"""Bounds the healings in one append, because a log may go back again while it is healed; then the caller retries."""

_T = TypeVar("_T")


class HealedLog:
    """One log, with the heads that a spool remembers of it in a folder. Belongs to the loop of the log.

    Attributes:
        rounds: the number of healings.
        offered: the number of events that were appended again.
        missing: the number of episodes that could not be completed.
    """

    def __init__(self, log: EventLog, spool: Path, folder: Path, settings: Settings, *, clock: Clock) -> None:
        self._store = log
        self._spool = spool
        self._settings = settings
        self._clock = clock
        self._heads = AcknowledgedHeads(folder, keep_s=settings.keep_stored_s, wall_ns=clock.wall_ns)
        self._healing = asyncio.Lock()
        self.rounds = 0
        self.offered = 0
        self.missing = 0

    async def append(self, records: Sequence[Record]) -> Mapping[EpisodeId, str]:
        """Append as `EventLog.append` does, healing a log that went back. Raises `LogWentBack` if that failed."""
        heads = self._heads
        for _ in range(_ROUNDS):
            heads.refresh()
            try:
                stored = await self._store.store(records, self._basis())
            except LogWentBack as error:
                await self._heal(error)
                continue
            acknowledged = heads.all  # without this batch, whose heads are noted below
            short = [
                LogWentBack(row.id, acknowledged[each].head, row.head)
                for each, row in stored.rows.items()
                if each in acknowledged and row.head < acknowledged[each].head
            ]
            if not short:
                break
            await self._heal(short[0])
        else:
            stored = await self._store.store(records, self._basis())
        heads.note({each: (row.number, row.head) for each, row in stored.rows.items()})
        return stored.refusals

    async def confirm(self) -> None:
        """Append again the events that the log lost. Raises `DatabaseUnavailable`; may then be called again."""
        heads = self._heads
        heads.refresh()
        if heads.last is None:
            return
        episode, head = heads.last
        row = (await self._store.heads([episode])).get(episode)
        if row is None or row.head < head:
            await self._heal(LogWentBack(episode_text(episode), head, 0 if row is None else row.head))

    def _basis(self) -> Basis:
        heads = self._heads

        def number_of(episode: EpisodeId) -> int | None:
            acknowledged = heads.all.get(episode)
            return (acknowledged.number or None) if acknowledged is not None else None

        return Basis(heads.last, number_of, heads.number_max)

    async def _heal(self, cause: LogWentBack) -> None:
        heads = self._heads
        async with self._healing:
            heads.refresh()
            lost = await self._lost()
            if not lost:  # another task or process has healed it
                return
            self.rounds += 1
            _log.warning("%s: searching %s for the lost events of %d episodes", cause, self._spool, len(lost))
            await self._store.skip_numbers(heads.number_max)
            offered = await self._offer(lost)
            self.offered += offered
            left = await self._lost()
            self.missing += len(left)
            if left:
                heads.note({each: (heads.all[each].number, head) for each, head in left.items()}, lowered=True)
            done = f"{offered:,} events were appended again; {len(left)} of {len(lost)} episodes stay incomplete"
            _log.warning("%s: %s", self._store.address, done)
            noticed_by = f"{socket.gethostname()}:{self._spool}"
            try:
                await self._store.note_incarnation(self._clock.wall_ns(), noticed_by, f"{cause}; {done}")
            except DatabaseError as error:
                _log.warning("%s: the healing cannot be recorded in the log: %s", self._store.address, error)

    async def _lost(self) -> dict[EpisodeId, int]:
        """Return the episodes whose head in the log is below the acknowledged one, with their heads in the log."""
        acknowledged = dict(self._heads.all)
        rows: dict[EpisodeId, EpisodeRow] = {}
        for part in _parts(list(acknowledged), _EPISODES_MAX):
            rows |= await self._store.heads(part)
        present = {each: rows[each].head if each in rows else 0 for each in acknowledged}
        return {each: head for each, head in present.items() if head < acknowledged[each].head}

    async def _offer(self, lost: Mapping[EpisodeId, int]) -> int:
        """Append the lost events that the segments contain; return their number."""
        basis = self._basis()._replace(witness=None)
        offered = 0
        recorders = await asyncio.to_thread(stored_recorders, self._spool, self._store.log_id)
        for recorder in recorders:
            parts = _lost_records(stored_records(recorder), lost)
            try:
                while batch := await asyncio.to_thread(next, parts, None):
                    for part in _parts(batch, self._settings.batch_events_max):
                        await self._store.store(part, basis)
                    offered += sum(each.episode is not None for each in batch)
            except LogDamaged as error:  # skip this recorder; the segments of the others may still heal the log
                _log.error("recorder %s: %s", recorder.name, error)
        return offered


def _lost_records(parts: Iterable[Sequence[Record]], lost: Mapping[EpisodeId, int]) -> Iterator[list[Record]]:
    """Yield the declarations and the events beyond these heads, and skip segments that have neither."""
    for part in parts:
        wanted = [
            each for each in part if each.episode is None or each.sequence > lost.get(each.episode, each.sequence)
        ]
        if wanted:
            yield wanted


def _parts(items: Sequence[_T], size: int) -> Iterator[Sequence[_T]]:
    return (items[start : start + size] for start in range(0, len(items), size))


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
        Path(), parse_folder_name(recorder.name).recorder, on_record=ready.append, segments=recorder.segments
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
    except (FileNotFoundError, SpoolDamaged, FilesError):
        return


def _segments(folder: Path) -> dict[int, Path]:
    try:
        return {number: segment_path(folder, number) for number in segment_numbers(folder)}
    except (FileNotFoundError, NotADirectoryError):
        return {}
