"""Define the targets of a fold: `LiveTarget` is the visible generation, `SideTarget` any other, with its checkpoints.

Theory of operation. There are two stores of checkpoints. Those of the visible built-in tables are `episode.folded`,
whose index makes a poll for new events take 0.03 ms, however many episodes there are. Every other generation, one that
a rebuild fills or that of a custom projection, has a table with one row for each episode (`checkpoints`), which is
dropped together with it. A rebuild copies its checkpoints into `episode.folded` when it switches.

`SideTarget` reads the generation under its key in every transaction. For a rebuild another number is an error. For a
projection it means that another process has rebuilt it: a batch folded for the old tables is folded again for the new
ones, unless their version differs, which is an error. Several workers may fill one generation, each its `Share` of the
episodes, so that no two of them advance one checkpoint.
"""

from __future__ import annotations

import logging
from collections.abc import Mapping, Sequence
from typing import NamedTuple

from sqlalchemy.ext.asyncio import AsyncConnection

from pycrorm_async.errors import DatabaseForeign, DatabaseUnavailable, InternalError
from pycrorm_async.projections.run import checkpoints
from pycrorm_async.projections.schema.generations import (
    Generation,
    Hold,
    current_generation,
    grow_tables,
    read_generation,
    show,
    write_generation,
)
from pycrorm_async.projections.schema.layout import Layout
from pycrorm_async.store.dialect import Progress
from pycrorm_async.store.log import EventLog, advance_folded, park
from pycrorm_async.store.stored import Span, beyond, share_out

_log = logging.getLogger("pycrorm_async.projections")

_EPISODES_MAX = 400
"""Bounds the episodes in one batch, because reading each of them costs as much as folding some of its events."""


class Share(NamedTuple):
    """The episodes that one of several workers folds: those whose number modulo `many` is `part`."""

    part: int = 0
    many: int = 1


WHOLE = Share()


class LiveTarget:
    """The visible generation, with `episode.folded` as its checkpoints. Implements `FoldTarget`."""

    parks_gaps = True

    def __init__(self, log: EventLog) -> None:
        self._log = log

    async def generation(self, connection: AsyncConnection, hold: Hold) -> Generation:
        generation = await current_generation(connection, hold=hold)
        if generation is None:
            raise DatabaseUnavailable("the tables are missing: restore them from a backup, or run `pycrorm rebuild`")
        return generation

    async def grow(self, connection: AsyncConnection, generation: Generation, layout: Layout) -> Generation:
        return await show(connection, await grow_tables(connection, generation, layout))

    async def unfolded(self, limit: int, *, after: int, reached: Mapping[int, int]) -> list[Span]:
        return await self._log.unfolded(limit, after=after, reached=reached)

    async def advance(self, connection: AsyncConnection, steps: Sequence[Progress]) -> bool:
        return await advance_folded(connection, steps)

    async def park(self, connection: AsyncConnection, number: int, reason: str) -> None:
        await park(connection, number, reason)


class SideTarget:
    """A generation with its own checkpoint table. Implements `FoldTarget`.

    Args:
        log: with the events.
        key: of its row in `pycrorm_generation`.
        projection: the custom projection's name; None for the built-in tables.
        version: of the fold in this process.
        number: of the generation; None accepts any that has the key.
        share: the episodes that this process folds.
    """

    parks_gaps = False

    def __init__(
        self,
        log: EventLog,
        key: str,
        projection: str | None,
        version: int,
        *,
        number: int | None = None,
        share: Share = WHOLE,
    ) -> None:
        self._log = log
        self._key = key
        self._projection = projection
        self._version = version
        self._number = number
        self._share = share
        self._place = ""

    async def generation(self, connection: AsyncConnection, hold: Hold) -> Generation:
        generation = await read_generation(connection, self._key, hold=hold)
        if generation is None or self._number not in (None, generation.number):
            raise InternalError(
                f"another process replaced the tables of {self._projection or 'the memory'} during the fold"
            )
        if generation.version != self._version:
            raise DatabaseForeign(
                f"its tables have version {generation.version} now, but this process folds version {self._version}"
            )
        self._place = checkpoints.place_of(generation.number, self._projection)
        return generation

    async def grow(self, connection: AsyncConnection, generation: Generation, layout: Layout) -> Generation:
        grown = await grow_tables(connection, generation, layout)
        await write_generation(connection, self._key, grown)
        return grown

    async def unfolded(self, limit: int, *, after: int, reached: Mapping[int, int]) -> list[Span]:
        async with self._log.reading() as connection:
            await self.generation(connection, "share")  # locked, so that no rebuild drops its tables
            while True:
                episodes = await checkpoints.behind(
                    connection,
                    self._place,
                    after=after,
                    limit=_EPISODES_MAX,
                    share=self._share,
                    after_tables=self._projection is not None,
                )
                behind = beyond(episodes, reached)
                if behind or after == 0:
                    return share_out(behind, limit)
                after = 0

    async def advance(self, connection: AsyncConnection, steps: Sequence[Progress]) -> bool:
        return await checkpoints.advance(connection, self._place, steps)

    async def park(self, connection: AsyncConnection, number: int, reason: str) -> None:
        await checkpoints.park(connection, self._place, number, reason)
        if self._projection is not None:
            _log.warning("episode %s is parked in the projection %s: %s", number, self._projection, reason)
