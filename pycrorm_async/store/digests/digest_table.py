"""Keep the digests of episodes in the table `pycrorm_digest`, in the transactions that append their events.

Theory of operation. `RunningDigests` keeps a running digest for each episode that this process appends to. An append
copies it into an `Extension`, adds the events while their rows are made, inserts the digests of completed blocks in the
same transaction, and replaces the running digest by the copy after the commit. A running digest counts only if it is at
the head that the transaction sees under its lock; otherwise, as after a restart or when another process has appended,
it is computed again from the kept digest before the current block and the block's events in the log. So a process that
restarts takes over the events of an incomplete block as the log holds them.

The table only grows: a digest is inserted once and never changed, like an event. It is not part of the log's format:
older programs still use the log, and the episodes that they append get no digests. If the digest before the current
block is missing, the episode gets no further ones. On PostgreSQL a login that may not insert digests, because the
owner has not run `GRANTS` again, appends without them.
"""

from __future__ import annotations

from collections.abc import Iterable, Mapping, Sequence
from typing import Final

import msgspec
from sqlalchemy import text
from sqlalchemy.ext.asyncio import AsyncConnection

from pycrorm_async.events.envelope import Record
from pycrorm_async.events.ids import parse_episode_id
from pycrorm_async.store.dialect import Dialect
from pycrorm_async.store.digests.episode_digest import BLOCK_EVENTS, DigestRow, RunningDigest
from pycrorm_async.store.stored import EpisodeRow

_EPISODES_MAX: Final = 1_000
"""Bounds the running digests that a process keeps, half a kilobyte each; without one, a block is read again."""

_AT = text("SELECT digest FROM pycrorm_digest WHERE episode = :number AND sequence = :sequence")
_LAST = text("""
SELECT episode, sequence, digest
FROM (SELECT episode, max(sequence) AS sequence FROM pycrorm_digest GROUP BY episode) AS last
JOIN pycrorm_digest USING (episode, sequence)""")


class Extension:
    """The digests after an append: rows to insert, and running digests by number; None: the episode gets no digests."""

    def __init__(self, running: Mapping[int, RunningDigest | None]) -> None:
        self.rows: list[DigestRow] = []
        self.running = running

    def add(self, number: int, events: Sequence[Record], *, last: bool = False) -> None:
        """Add the next events of an episode; with `last`, keep the digest behind them also inside a block."""
        digest = self.running[number]
        if digest is None:
            return
        self.rows += [DigestRow(number, *each) for each in digest.add(events)]
        if last and digest.sequence % BLOCK_EVENTS:
            self.rows.append(DigestRow(number, digest.sequence, digest.digest()))


class RunningDigests:
    """The running digests of the episodes that a process appends to one log."""

    def __init__(self, dialect: Dialect) -> None:
        self._dialect = dialect
        self._insertable: bool | None = None
        self._running: dict[int, RunningDigest | None] = {}

    async def begin(self, connection: AsyncConnection, rows: Iterable[EpisodeRow]) -> Extension | None:
        """Begin an append to the episodes of these rows; None if digests cannot be stored."""
        if self._insertable is None:
            self._insertable = await has_digests(self._dialect, connection, insert=True)
        if not self._insertable:
            return None
        return Extension({each.number: await self._at_head(connection, each) for each in rows})

    async def insert(self, connection: AsyncConnection, extension: Extension) -> None:
        """Insert the digests in the transaction that appends the events."""
        if not extension.rows:
            return
        rows = msgspec.json.encode(extension.rows).decode()
        try:
            await connection.exec_driver_sql(self._dialect.digest_statements.insert, (rows,))
        except BaseException:
            self._insertable = None  # a database that was restored meanwhile may lack the table
            raise

    def keep(self, extension: Extension) -> None:
        """Keep the running digests of an append that was committed."""
        self._running |= extension.running
        while len(self._running) > _EPISODES_MAX:
            del self._running[next(iter(self._running))]

    async def _at_head(self, connection: AsyncConnection, row: EpisodeRow) -> RunningDigest | None:
        """Return a running digest at the episode's head, to be changed by the caller; None if it cannot continue."""
        if row.number in self._running:
            kept = self._running[row.number]
            if kept is None or kept.sequence == row.head:
                return kept and kept.copy()
        start = row.head - row.head % BLOCK_EVENTS
        if start == 0:
            running = RunningDigest.at_start(parse_episode_id(row.id))
        else:
            at_start = (await connection.execute(_AT, {"number": row.number, "sequence": start})).scalar()
            if at_start is None:
                return None
            running = RunningDigest(bytes.fromhex(at_start), start)
        if row.head > start:
            events = await self._dialect.events(connection, row.number, after=start, limit=row.head - start)
            running.add(events)
        return running if running.sequence == row.head else None  # else events are missing, which `verify` reports


async def create_digest_table(dialect: Dialect, connection: AsyncConnection) -> None:
    """Create the table in the transaction that opens the log, unless it exists or this login may not."""
    if (await connection.exec_driver_sql(dialect.digest_statements.creatable)).scalar_one():
        await dialect.execute_all(connection, dialect.digest_statements.table)


async def has_digests(dialect: Dialect, connection: AsyncConnection, *, insert: bool = False) -> bool:
    """Return whether the table exists and this login may read it, and with `insert` also extend it."""
    row = (await connection.exec_driver_sql(dialect.digest_statements.usable)).one()
    return bool(row[1 if insert else 0])


async def last_digests(dialect: Dialect, connection: AsyncConnection) -> dict[int, DigestRow]:
    """Read the last digest of each episode, by number."""
    if not await has_digests(dialect, connection):
        return {}
    return {each.episode: DigestRow(*each) for each in await connection.execute(_LAST)}
