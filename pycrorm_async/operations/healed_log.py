"""Appends to a log, and offers it again what it lost of what was stored before: after a failover, a restored backup.

    healed = HealedLog(log, spool, settings, clock=clock)
    refusals = await healed.append(records)
    await healed.confirm()

Theory of operation. The spool remembers how far each episode was stored (`queue/heads.py`), and keeps the segments for
a while (`queue/stored.py`). Every append carries the episode that was stored last in this spool, by whatever process.
The transaction that appends reads how far that episode is; a log that holds less went back, and takes nothing
(`LogWentBack`). Commits of a log are lost from the end, so if the last one is there all are. An append that finds a gap
in an episode of which more was stored shows the same. `confirm` asks the question without an append: at a start, at a
flush, now and then in the daemon.

Then the heads of all episodes that are remembered are compared with the log's, and all records beyond the log's heads
are read from the segments and appended, declarations first, each episode under the number it had. Several processes may
do so at once: the same event is stored once. What no segment holds any more stays missing; the episode is refused with
its gap when more of it comes. Its remembered head is lowered to the log's, so that it is not looked for again.

Numbers. An append assigns none that is not above the highest one remembered, and leaves a reserve free behind that, for
other spools that were stored in the same log and come back later. A spool that remembers nothing of the lost episodes
and comes before all others may be given their numbers; then a lost episode gets a new number, and its row ids change.
No two episodes ever have one number.
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
from pycrorm_async.queue.retention.stored_segments import stored_in
from pycrorm_async.settings import Settings
from pycrorm_async.store.log import EventLog
from pycrorm_async.store.stored import Basis, EpisodeRow

__all__ = ["HealedLog"]

_ASKED_AT_ONCE: Final = 1_000
"""Episodes whose heads are read by one statement."""
_ROUNDS: Final = 3
"""A log may go back again while it is healed; after so many rounds the caller sees the error and tries later."""

_log = logging.getLogger("pycrorm_async")
_T = TypeVar("_T")


class HealedLog:
    """One log, and what a spool knows of it. Belongs to the loop of the log.

    `offered` counts the records that were offered again, `missing` the episodes that could not be completed.
    """

    def __init__(self, log: EventLog, spool: Path, settings: Settings, *, clock: Clock) -> None:
        self._store = log
        self._spool = spool
        self._settings = settings
        self._clock = clock
        folder = stored_in(spool, log.log_id) if settings.keep_stored_s and settings.keep_stored_bytes else None
        self._heads: AcknowledgedHeads | None = None
        if folder is not None:
            self._heads = AcknowledgedHeads(folder, keep_s=settings.keep_stored_s, wall_ns=clock.wall_ns)
        self._healing = asyncio.Lock()
        self.rounds = 0
        self.offered = 0
        self.missing = 0

    async def append(self, records: Sequence[Record]) -> Mapping[EpisodeId, str]:
        """As `EventLog.append`, of a log that went back after it was healed. Raises `LogWentBack` if that failed."""
        heads = self._heads
        if heads is None:
            return await self._store.append(records)
        for _ in range(_ROUNDS):
            heads.refresh()
            try:
                stored = await self._store.store(records, self._basis(heads))
            except LogWentBack as error:
                await self._heal(heads, error)
                continue
            known = heads.all  # as before this batch, which nobody noted yet
            short = [
                LogWentBack(row.id, known[each].head, row.head)
                for each, row in stored.rows.items()
                if each in known and row.head < known[each].head
            ]
            if not short:
                break
            await self._heal(heads, short[0])
        else:
            stored = await self._store.store(records, self._basis(heads))
        heads.note({each: (row.number, row.head) for each, row in stored.rows.items()})
        return stored.refusals

    async def confirm(self) -> None:
        """Offer again what the log lost. Raises `DatabaseUnavailable`; may then be called again."""
        heads = self._heads
        if heads is None:
            return
        heads.refresh()
        if heads.last is None:
            return
        episode, head = heads.last
        row = (await self._store.heads([episode])).get(episode)
        if row is None or row.head < head:
            await self._heal(heads, LogWentBack(episode_text(episode), head, 0 if row is None else row.head))

    def _basis(self, heads: AcknowledgedHeads) -> Basis:
        def number_of(episode: EpisodeId) -> int | None:
            noted = heads.all.get(episode)
            return (noted.number or None) if noted is not None else None

        return Basis(heads.last, number_of, heads.number_max)

    async def _heal(self, heads: AcknowledgedHeads, cause: LogWentBack) -> None:
        async with self._healing:
            heads.refresh()
            lost = await self._lost(heads)
            if not lost:  # another task, or another process, healed it meanwhile
                return
            self.rounds += 1
            _log.warning("%s: looking for what it lost of %d episodes in %s", cause, len(lost), self._spool)
            await self._store.skip_numbers(heads.number_max)
            offered = await self._offer(heads, lost)
            self.offered += offered
            left = await self._lost(heads)
            self.missing += len(left)
            if left:
                heads.note({each: (heads.all[each].number, head) for each, head in left.items()}, lowered=True)
            done = f"{offered:,} events were offered again; {len(left)} of {len(lost)} episodes stay incomplete"
            _log.warning("%s: %s", self._store.address, done)
            noticed_by = f"{socket.gethostname()}:{self._spool}"
            try:
                await self._store.note_incarnation(self._clock.wall_ns(), noticed_by, f"{cause}; {done}")
            except DatabaseError as error:
                _log.warning("that the log went back cannot be noted in it: %s", error)

    async def _lost(self, heads: AcknowledgedHeads) -> dict[EpisodeId, int]:
        """The episodes of which the log holds less than was stored, and how far it has them."""
        remembered = dict(heads.all)
        rows: dict[EpisodeId, EpisodeRow] = {}
        for some in _parts(list(remembered), _ASKED_AT_ONCE):
            rows |= await self._store.heads(some)
        found = {each: rows[each].head if each in rows else 0 for each in remembered}
        return {each: head for each, head in found.items() if head < remembered[each].head}

    async def _offer(self, heads: AcknowledgedHeads, lost: Mapping[EpisodeId, int]) -> int:
        """Appends what the segments hold of it; how many events that were."""
        basis = self._basis(heads)._replace(witness=None)
        offered = 0
        recorders = await asyncio.to_thread(stored_recorders, self._spool, self._store.log_id)
        for recorder in recorders:
            parts = _lost_records(stored_records(recorder), lost)
            try:
                while batch := await asyncio.to_thread(next, parts, None):
                    for some in _parts(batch, self._settings.batch_events_max):
                        await self._store.store(some, basis)
                    offered += sum(each.episode is not None for each in batch)
            except LogDamaged as error:  # of this recorder; what the others can heal is healed
                _log.error("recorder %s: %s", recorder.name, error)
        return offered


def _lost_records(parts: Iterable[Sequence[Record]], lost: Mapping[EpisodeId, int]) -> Iterator[list[Record]]:
    """Declarations, and events beyond these heads; without segments that hold none of either."""
    for part in parts:
        wanted = [
            each for each in part if each.episode is None or each.sequence > lost.get(each.episode, each.sequence)
        ]
        if wanted:
            yield wanted


def _parts(items: Sequence[_T], size: int) -> Iterator[Sequence[_T]]:
    return (items[start : start + size] for start in range(0, len(items), size))
