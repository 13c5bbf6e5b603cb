"""Check a range of episodes part by part, each part in one snapshot, with a `PartCheck` for the tables to compare."""

from __future__ import annotations

from typing import NamedTuple, Protocol

from sqlalchemy.ext.asyncio import AsyncConnection

from pycrorm_async.errors import DatabaseForeign
from pycrorm_async.events.ids import EPISODE_NUMBER_MAX, row_id_min
from pycrorm_async.projections.verify.findings import VerifyResult
from pycrorm_async.projections.verify.row_comparison import Comparison
from pycrorm_async.store.dialects import dialect_of
from pycrorm_async.store.log import EventLog
from pycrorm_async.store.stored import Span

_PART_EVENTS = 4_000
"""Bounds the events of one part, and so the memory used."""
_ATTEMPTS = 10
"""Bounds the snapshots for one part while rebuilds replace the tables."""


class Unreadable(Exception):
    """The database cannot read the first event of this span, or a later one."""

    def __init__(self, span: Span, reason: str) -> None:
        super().__init__(reason)
        self.span = span


class Place(NamedTuple):
    """The place in the log behind event `after` of episode `number`."""

    number: int
    after: int = 0

    @property
    def row(self) -> int:
        """The smallest id of a row made by an event behind this place."""
        return row_id_min(self.number, self.after + 1 if self.after else 0)


class PartCheck(Protocol):
    """Compares one kind of tables with the log.

    Attributes:
        result: to which the findings are added.
        missing_table: the error for a table that is missing.
    """

    result: VerifyResult
    missing_table: str

    async def comparison(self, connection: AsyncConnection) -> Comparison | None:
        """Return the comparison with the tables of this snapshot; None ends the check."""
        ...

    async def check(
        self, connection: AsyncConnection, comparison: Comparison, at: Place, within: EpisodeRange, limit: int
    ) -> Place | None:
        """Check some `limit` events behind this place; return the next place, None at the end of the range.

        Raises `Unreadable`, and then has reported nothing.
        """
        ...


class EpisodeRange(NamedTuple):
    """The episodes with numbers from `first` up to but not including `end`; None is the end of the memory."""

    first: int = 0
    end: int | None = None

    @property
    def limits(self) -> dict[str, int]:
        """The parameters `first` and `end` of a query."""
        return {"first": self.first, "end": EPISODE_NUMBER_MAX + 1 if self.end is None else self.end}

    async def check(self, log: EventLog, check: PartCheck) -> None:
        """Check all parts of this range. Raises `DatabaseForeign` if a table is missing."""
        at: Place | None = Place(self.first)
        limit = _PART_EVENTS
        while at is not None:
            try:
                at = await self._check_part(log, check, at, limit)
                limit = min(limit * 8, _PART_EVENTS)
            except Unreadable as fault:
                if limit > 1:  # shorten the part until the unreadable event is alone
                    limit = max(limit // 8, 1)
                else:
                    check.result.add_damage(fault.span.number, fault.span.last, f"cannot be read: {fault}")
                    at = Place(fault.span.number + 1)

    async def _check_part(self, log: EventLog, check: PartCheck, at: Place, limit: int) -> Place | None:
        for _ in range(_ATTEMPTS):
            async with log.snapshot() as connection:
                comparison = await check.comparison(connection)
                if comparison is None:
                    return None
                if await dialect_of(connection).keep(connection, comparison.tables):
                    return await check.check(connection, comparison, at, self, limit)
            # A rebuild replaced and dropped the tables between two statements: read the generation again.
        raise DatabaseForeign(f"{log.address}: {check.missing_table}")
