"""Append to a log, and append again the events that it lost in a failover or a restored backup.

    healed = HealedLog(log, spool, stored_in(spool, log.log_id), settings, clock=clock)
    refusals = await healed.append(records)
    await healed.confirm()

Theory of operation. The spool remembers the acknowledged head of each episode, the last sequence that the log has
confirmed (`queue/retention/acknowledged_heads.py`), and keeps stored segments for a while
(`queue/retention/stored_segments.py`). Every append names the episode of this spool that was stored last, by any
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
from collections.abc import Iterable, Iterator, Mapping, Sequence
from pathlib import Path
from typing import Final, TypeVar

from pycrorm_async.clock import Clock
from pycrorm_async.errors import DatabaseError, LogDamaged, LogWentBack
from pycrorm_async.events.envelope import Record
from pycrorm_async.events.ids import EpisodeId, episode_text
from pycrorm_async.queue.retention.acknowledged_heads import AcknowledgedHeads
from pycrorm_async.queue.retention.stored_records import stored_recorders, stored_records
from pycrorm_async.settings import Settings
from pycrorm_async.store.log import EventLog
from pycrorm_async.store.stored import Basis, EpisodeRow

_EPISODES_MAX: Final = 1_000
"""Bounds the episodes whose heads one statement reads."""
_ROUNDS: Final = 3
"""Bounds the healings in one append, because a log may go back again while it is healed; then the caller retries."""

_log = logging.getLogger("pycrorm_async")
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
