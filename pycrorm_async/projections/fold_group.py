"""Share the episodes of one memory among all processes that fold it at the same time.

    group = FoldGroup(log)
    async with group.folding() as share: ...
    await group.leave()

**Theory of operation.** Any process may fold any event: a batch that another process folded first is rolled back
(`pipeline`). But it has then been read and folded in vain, and four daemons on one server took three times the
processor time of one. So on PostgreSQL every process that folds for longer joins a group: its session holds an advisory
lock in shared mode, which the server releases when the session ends, also by the death of the process. Each
process lists the holders once a second, and folds the episodes whose number modulo the size of the group is its place
among them. There is no leader and no table, and so nothing to repair: while two processes disagree on the
group, an episode is folded twice at most, and one of the two is rolled back.

A process that stays in the group and does not fold, because it is stopped, or its machine has lost its power, does not
keep the events of its share from the tables. If no episode of a share has moved between two looks `_STALL_S` apart, a
process that has nothing else to do folds all shares for `_HELP_S`. The same holds for each custom projection, whose
code other processes may not have.

SQLite has one writer at a time, and no group.
"""

from __future__ import annotations

import asyncio
import time
from collections.abc import AsyncIterator, Mapping, Sequence
from contextlib import asynccontextmanager
from typing import Any, Final

from sqlalchemy import Executable
from sqlalchemy.ext.asyncio import AsyncConnection

from pycrorm_async.projections.pipeline import WHOLE, Share
from pycrorm_async.store.dialects import dialect_of
from pycrorm_async.store.log import EventLog
from pycrorm_async.store.schema import SELECT_BEHIND
from pycrorm_async.store.stored import EpisodeRow

_LOOK_S: Final = 1.0
"""Interval between two looks at the group, 0.2 ms each, and so the time until the share of a dead process is taken."""
_STALL_S: Final = 20.0
"""The time in which a process that folds has folded something: a batch takes a second, or ten on a busy machine."""
_HELP_S: Final = 30.0
"""The time for which all shares are folded when a process does not fold its own, until that is examined again."""
_COMPARED_MAX: Final = 1_000
"""Bounds the episodes that are compared, those with the lowest numbers."""


class FoldGroup:
    """The processes that fold a memory, as this one sees them."""

    def __init__(self, log: EventLog) -> None:
        self._log = log
        self._session: AsyncConnection | None = None
        self._own = WHOLE
        self._looked_s = float("-inf")
        self._others = OtherShares()
        self._turn = asyncio.Lock()  # a session executes one statement at a time

    async def share(self) -> Share:
        """Return the share of this process, which is WHOLE while it is alone. Joins the group at the first call."""
        now_s = time.monotonic()
        if not self._log.address.is_sqlite and now_s >= self._looked_s + _LOOK_S:
            async with self._turn:
                self._own = await self._look()
            self._looked_s = now_s
        return self._others.folded_with(self._own)

    @asynccontextmanager
    async def folding(self) -> AsyncIterator[Share]:
        """Yield the share of this process. A fault makes it leave, so that others fold its share."""
        share = await self.share()
        try:
            yield share
        except BaseException:
            await self.leave()
            raise

    async def is_stalled(self) -> bool:
        """Return whether a share is not folded by its process, from now on by this one. Compares at intervals."""
        if self._own == WHOLE or not self._others.is_due:
            return False
        behind = await self.read(EpisodeRow, SELECT_BEHIND, after=0, limit=_COMPARED_MAX, **WHOLE._asdict())
        return self._others.compare(behind, self._own) == WHOLE

    async def read(self, kind: Any, statement: Executable, **values: Any) -> list[Any]:
        """Read as `EventLog.read` does, in a member in its session, for a quarter of the processor time."""
        async with self._turn:
            if self._session is None:
                return await self._log.read(kind, statement, **values)
            try:
                with self._log.translated():
                    return await dialect_of(self._session).rows(self._session, kind, statement, **values)
            except BaseException:
                await self.leave()
                raise

    async def leave(self) -> None:
        """Leave the group by ending the session."""
        session, self._session = self._session, None
        self._own, self._looked_s = WHOLE, float("-inf")
        if session is not None:
            await session.invalidate()
            await session.close()

    async def _look(self) -> Share:
        try:
            with self._log.translated():
                if self._session is None:
                    session = await self._log.engine.connect()
                    # Autocommit, because an idle transaction would be terminated; the lock belongs to the session.
                    self._session = await session.execution_options(isolation_level="AUTOCOMMIT")
                return Share(*await dialect_of(self._session).join_fold_group(self._session))
        except BaseException:
            await self.leave()
            raise


class OtherShares:
    """The shares of other processes, and whether one of them is not folded by its process."""

    def __init__(self) -> None:
        self._behind: Mapping[int, int] = {}
        self._compared_s = self._help_until_s = float("-inf")

    @property
    def is_due(self) -> bool:
        """Whether the episodes that are behind should be compared now."""
        return time.monotonic() >= self._compared_s + _STALL_S

    def compare(self, behind: Sequence[EpisodeRow], own: Share) -> Share:
        """Compare with the episodes that were behind at the last call; return as `folded_with` does."""
        now = {each.number: each.folded for each in behind}
        self._compared_s = time.monotonic()
        if is_stalled(self._behind, now, own.many):
            self._help_until_s = self._compared_s + _HELP_S
        self._behind = now
        return self.folded_with(own)

    def folded_with(self, own: Share) -> Share:
        """Return the share to fold: the own one, or all of them while one of the others is not folded."""
        return WHOLE if time.monotonic() < self._help_until_s else own


def is_stalled(before: Mapping[int, int], now: Mapping[int, int], many: int) -> bool:
    """Return whether all episodes of one of `many` shares that were behind have not been folded further.

    Args:
        before: by number, the folded sequence of the episodes that were behind.
        now: the same, later.
        many: the number of shares.

    >>> is_stalled({1: 5, 2: 7}, {1: 6, 2: 7}, 2), is_stalled({1: 5, 2: 7, 4: 9}, {1: 6, 2: 7}, 2)
    (True, False)
    """
    moving = {number % many for number, folded in before.items() if now.get(number) != folded}
    return any(number % many not in moving for number in before)
