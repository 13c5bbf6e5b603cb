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

A process whose session stays and that does not fold, because it or its fold worker is stopped, or its machine has lost
its power, does not keep the events of its share from the tables. With each look a process takes a second lock, whose
key is the number of the look, and releases the one before. A process that the others see with the same number for
`_STALL_S` is not counted until it looks again. Only this process' own clock measures that time, and of a pause of its
own, in which the whole machine may have been stopped, it measures a part.

SQLite has one writer at a time, and no group.
"""

import asyncio
import time
from collections.abc import AsyncIterator, Mapping
from contextlib import asynccontextmanager
from typing import Any, Final

from sqlalchemy import Executable
from sqlalchemy.ext.asyncio import AsyncConnection

from pycrorm_async.projections.pipeline import WHOLE, Share
from pycrorm_async.store.dialects import dialect_of
from pycrorm_async.store.log import EventLog

_LOOK_S: Final = 1.0
"""Interval between two looks at the group, 0.4 ms each, and so the time until the share of a dead process is taken."""
_STALL_S: Final = 10.0
"""The time after which a process that has not looked does not count: longer than a batch takes on a busy machine, and
so short that a flush, which waits for 15 s, does not end before another process has folded what it waits for."""
_PAUSE_S: Final = 5.0
"""The most time between two looks of a process that it counts as silence of the others, which may have been stopped
with it: half of `_STALL_S`, so that they look again before they do not count."""


class FoldGroup:
    """The processes that fold a memory, as this one sees them."""

    def __init__(self, log: EventLog) -> None:
        self._log = log
        self._session: AsyncConnection | None = None
        self._own = WHOLE
        self._looked_s = float("-inf")
        self._look_number = 0
        self._seen: Mapping[
            int, tuple[int | None, float]
        ] = {}  # by process id, its last look, and the time for which it has not changed
        self._turn = asyncio.Lock()  # a session executes one statement at a time

    async def share(self) -> Share:
        """Return the share of this process, which is WHOLE while it is alone. Joins the group at the first call."""
        now_s = time.monotonic()
        if not self._log.address.is_sqlite and now_s >= self._looked_s + _LOOK_S:
            async with self._turn:
                self._own = await self._look()
            self._looked_s = now_s
        return self._own

    @asynccontextmanager
    async def folding(self) -> AsyncIterator[Share]:
        """Yield the share of this process. A fault makes it leave, so that others fold its share."""
        share = await self.share()
        try:
            yield share
        except BaseException:
            await self.leave()
            raise

    async def read(self, kind: Any, statement: Executable, **values: Any) -> list[Any]:
        """Read as `EventLog.read` does, in a member in its session, for a quarter of the processor time."""
        async with self._turn:
            if self._session is None:
                return await self._log.read(kind, statement, **values)
            try:
                with self._log.translated():
                    return await dialect_of(self._session).rows(self._session, kind, statement, **values)
            except BaseException:
                await self._end_session()
                raise

    async def leave(self) -> None:
        """Leave the group by ending the session."""
        async with self._turn:
            await self._end_session()

    async def _end_session(self) -> None:
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
                    self._seen = {}
                self._look_number += 1
                own, looks = await dialect_of(self._session).join_fold_group(self._session, self._look_number)
        except BaseException:
            await self._end_session()
            raise
        passed_s = min(time.monotonic() - self._looked_s, _PAUSE_S)
        before = self._seen
        self._seen = {
            each: (look, before[each][1] + passed_s if each in before and before[each][0] == look else 0.0)
            for each, look in looks.items()
        }
        active = [
            each
            for each, (look, silent_s) in sorted(self._seen.items())
            if each == own or look is None or silent_s <= _STALL_S  # a process of an earlier version has no look
        ]
        return Share(active.index(own), len(active))
