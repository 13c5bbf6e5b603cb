"""Release parked episodes whose next event can be folded now: by a newer version, or because a name became free.

A process tries this once, when it opens the tables. It folds the one event at which each episode is parked and discards
the rows; the next batch folds it again and continues there.
"""

from __future__ import annotations

import re
from collections.abc import Sequence

from sqlalchemy.ext.asyncio import AsyncConnection

from pycrorm_async.events.codec import fingerprint
from pycrorm_async.projections.fold.column_values import CannotFold
from pycrorm_async.projections.fold.fold import fold
from pycrorm_async.projections.fold.parameters import Designators
from pycrorm_async.projections.fold.row_batch import Rows
from pycrorm_async.projections.schema.generations import Generation
from pycrorm_async.projections.schema.growth import GrowthTarget, grow
from pycrorm_async.projections.schema.union import unite
from pycrorm_async.store.dialects import dialect_of
from pycrorm_async.store.log import park

_EPISODES_MAX = 1_000
"""Bounds the parked episodes that one process tries, at 0.1 ms each, so that opening a memory never takes minutes."""
_AT_AN_EVENT = re.compile(r"event (\d+): (?!the database refuses it)")
"""Matches a reason from the fold. A row that the database refused is excluded, because only writing it again shows
whether the database accepts it now."""


async def release_parked(connection: AsyncConnection, target: GrowthTarget, generation: Generation) -> Generation:
    """Release episodes and create tables that the database refused before; return the generation with those.

    Runs in the caller's transaction, which must exclude all other writers of the memory.
    """
    dialect = dialect_of(connection)
    parked = [each for each in await dialect.stopped(connection) if each.parked is not None]
    places = [(each, _AT_AN_EVENT.match(each.parked or "")) for each in parked[:_EPISODES_MAX]]
    payloads = await dialect.declarations(connection) if parked or generation.layout.unmade else []
    generation = await _retry_unmade(connection, target, generation, payloads)
    if not parked:
        return generation
    designators = Designators.of_union(unite(generation.layout, payloads))
    for episode, place in places:
        if place is None or int(place[1]) != episode.folded + 1:
            continue
        for event in await dialect.events(connection, episode.number, after=episode.folded, limit=1):
            try:
                fold(event, designators, Rows())
            except CannotFold:
                continue
            await park(connection, episode.number, None)
    return generation


async def _retry_unmade(
    connection: AsyncConnection, target: GrowthTarget, generation: Generation, payloads: Sequence[bytes]
) -> Generation:
    """Try again to create the tables that the database refused; return the generation with those it creates now."""
    unmade = generation.layout.unmade
    if not unmade:
        return generation
    attempt = await connection.begin_nested()
    cleared = generation.without_unmade()
    grown = await grow(connection, target, cleared, [each for each in payloads if fingerprint(each) in unmade])
    if grown.layout == generation.layout:
        await attempt.rollback()  # keeps the revision, so that no other process has to read the layout again
        return generation
    await attempt.commit()
    return grown
