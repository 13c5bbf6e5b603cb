"""Release parked episodes whose next event can be folded now: by a later version, or since a name became free.

A process looks once, when it opens the tables. It folds the one event that each episode is parked at, and writes
nothing of it; folding continues there with the next batch.
"""

from __future__ import annotations

import re
from collections.abc import Sequence

from sqlalchemy.ext.asyncio import AsyncConnection

from pycrorm_async.events.codec import fingerprint
from pycrorm_async.projections.fold.fold import CannotFold, fold
from pycrorm_async.projections.fold.parameters import Designators
from pycrorm_async.projections.fold.row_batch import Rows
from pycrorm_async.projections.schema.generations import Generation
from pycrorm_async.projections.schema.growth import Growing, grow
from pycrorm_async.projections.schema.layout import unite
from pycrorm_async.store.dialects import dialect_of
from pycrorm_async.store.log import park

__all__ = ["release_parked"]

_EPISODES_MAX = 1_000
"""Parked episodes that one process looks at, at 0.1 ms each: opening a memory must not take minutes."""
_AT_AN_EVENT = re.compile(r"event (\d+): (?!the database refuses it)")
"""How a reason begins that the fold gave; whether a database takes a row is known only when it is written."""


async def release_parked(connection: AsyncConnection, goal: Growing, generation: Generation) -> Generation:
    """The generation, with tables that the database makes now and refused before; the episodes that need them go on.

    Everything happens in the caller's transaction, alone in the memory.
    """
    dialect = dialect_of(connection)
    parked = [each for each in await dialect.stopped(connection) if each.parked is not None]
    places = [(each, _AT_AN_EVENT.match(each.parked or "")) for each in parked[:_EPISODES_MAX]]
    payloads = await dialect.declarations(connection) if parked or generation.layout.unmade else []
    generation = await _tried_again(connection, goal, generation, payloads)
    if not parked:
        return generation
    united = unite(generation.layout, payloads)
    designators = Designators(united.accepted, united.refused)
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


async def _tried_again(
    connection: AsyncConnection, goal: Growing, generation: Generation, payloads: Sequence[bytes]
) -> Generation:
    """The generation with what can be made now of the tables that the database refused to make."""
    unmade = generation.layout.unmade
    if not unmade:
        return generation
    attempt = await connection.begin_nested()
    forgotten = generation.without_unmade()
    grown = await grow(connection, goal, forgotten, [each for each in payloads if fingerprint(each) in unmade])
    if grown.layout == generation.layout:
        await attempt.rollback()  # as it was, and no process has to read it again
        return generation
    await attempt.commit()
    return grown
