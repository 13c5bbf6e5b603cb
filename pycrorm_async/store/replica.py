"""Read a memory from a streaming replica of its PostgreSQL server, and report how far the replica is behind.

    log = await open_to_read(primary, replica)

**Theory of operation.** A replica replays the write-ahead log of its primary, in order, and so shows the memory as it
was a moment ago: whole transactions, never a part of one. Two facts say how far it is behind. The position in the
write-ahead log that the primary has written and the replica has replayed differ by a number of bytes, and the last
commit that was replayed has a time. The time alone does not do, because nothing is committed while no robot records;
nor do the bytes alone, because PostgreSQL writes some now and then that no reader can see. So a replica counts as
behind when it has not replayed, after `SETTLE_S`, what the primary had written before.

A reader that names a replica is refused one of another memory: a replica has the id of the log. While the replica
does not answer, or follows no server any more, the primary does, and while the primary does not answer, the replica
does.
"""

import asyncio
import logging
from datetime import datetime
from typing import Final, NamedTuple

from pycrorm_async.errors import CallerError, DatabaseUnavailable
from pycrorm_async.store.address import DatabaseAddress, check_replica
from pycrorm_async.store.log import EventLog

LAG_S_MAX: Final = 5.0
"""A replica that lacks changes, and whose last change is older than this, is reported. A flush waits for it as long."""
SETTLE_S: Final = 0.2
"""The time in which a replica that is not behind replays what its primary had written."""
_POLL_S: Final = 0.02

_WRITTEN = """
SELECT pg_catalog.pg_postmaster_start_time(),
(CASE WHEN pg_catalog.pg_is_in_recovery() THEN pg_catalog.pg_last_wal_replay_lsn()
ELSE pg_catalog.pg_current_wal_flush_lsn() END - '0/0')::bigint"""
_REPLAYED = """
SELECT pg_catalog.pg_postmaster_start_time(),
CASE WHEN pg_catalog.pg_is_in_recovery() THEN (pg_catalog.pg_last_wal_replay_lsn() - '0/0')::bigint END,
pg_catalog.date_part('epoch', pg_catalog.clock_timestamp() - pg_catalog.pg_last_xact_replay_timestamp())"""
"""Selects the start of the server, which identifies it, the position, null for one that is no replica (any more), and
the age of the last replayed commit."""

_log = logging.getLogger("pycrorm_async")


class ReplicaLag(NamedTuple):
    """The changes that a replica lacks.

    Attributes:
        behind_bytes: of the primary's write-ahead log; 0 if it lacks none, None while the primary does not answer.
        last_change_s: the age in seconds of the last change that it shows, by its own clock; None before the first.
    """

    behind_bytes: int | None
    last_change_s: float | None

    def __str__(self) -> str:
        age = "" if self.last_change_s is None else f"; its last change is {self.last_change_s:,.0f} s old"
        match self.behind_bytes:
            case None:
                return f"may be behind, because its primary does not answer{age}"
            case 0:
                return "shows all that its primary has committed"
        return f"lacks {self.behind_bytes / 1024:,.1f} KiB of its primary's changes{age}"


async def open_to_read(primary: DatabaseAddress, replica: DatabaseAddress | None) -> EventLog:
    """Open the memory for reading, on its replica if one is given; warn where that is behind, or does not answer.

    Raises `CallerError` for a server that is no replica of the primary, and the errors of `EventLog.open`.
    """
    if replica is None:
        return await EventLog.open(primary, create=False)
    check_replica(replica, primary)
    log = None
    try:
        log = await EventLog.open(replica, create=False)
        lag = await lag_line(log, primary)
    except BaseException as fault:
        if log is not None:
            await log.close()
        if not isinstance(fault, DatabaseUnavailable):
            raise
        _log.warning("the replica does not answer: %s; reading from %s", fault, primary)
        return await EventLog.open(primary, create=False)
    if lag is not None:
        _log.warning("%s", lag)
    return log


async def lag_line(log: EventLog, primary: DatabaseAddress) -> str | None:
    """Return a line if this is the log of a replica that is behind, or whose primary does not answer; else None.

    Raises as `lag_between` does.
    """
    if log.address == primary:
        return None
    lag = await _lag_of(log, primary)
    is_behind = lag.behind_bytes is None or (lag.behind_bytes > 0 and (lag.last_change_s or 0.0) > LAG_S_MAX)
    return f"the replica {log.address} {lag}" if is_behind else None


async def _lag_of(replica: EventLog, primary: DatabaseAddress) -> ReplicaLag:
    try:
        log = await EventLog.open(primary, create=False)
    except DatabaseUnavailable:
        return ReplicaLag(None, (await _replayed(replica))[-1])
    try:
        return await lag_between(replica, log, SETTLE_S)
    finally:
        await log.close()


async def lag_between(replica: EventLog, primary: EventLog, patience_s: float) -> ReplicaLag:
    """Wait until the replica has what the primary has now, at most for this long; return how far it is behind then.

    Raises `CallerError` if these are two memories, and `DatabaseUnavailable` for one that follows no server any more.
    """
    if replica.log_id != primary.log_id:
        raise CallerError(f"{replica.address} holds another memory than {primary.address}: correct --read-url")
    async with primary.reading() as connection:
        server, written = tuple((await connection.exec_driver_sql(_WRITTEN)).one())
    end_s = asyncio.get_running_loop().time() + patience_s
    while True:
        own_server, position, last_change_s = await _replayed(replica)
        if position is None and own_server != server:
            raise DatabaseUnavailable(f"{replica.address} is promoted or a copy, and follows no other server")
        lacks = 0 if position is None else max(0, written - position)
        if not lacks or asyncio.get_running_loop().time() >= end_s:
            return ReplicaLag(lacks, last_change_s)
        await asyncio.sleep(_POLL_S)


async def _replayed(replica: EventLog) -> tuple[datetime, int | None, float | None]:
    async with replica.reading() as connection:
        started, position, last_change_s = tuple((await connection.exec_driver_sql(_REPLAYED)).one())
    return started, position, last_change_s
