"""Grow the tables of a generation by what was declared, type by type where the database refuses some of it.

## Theory of operation

A growth runs in its caller's transaction, alone in the memory. All declarations that the generation has no tables for
are made at once, inside a savepoint. If the database refuses their definition, the savepoint is rolled back and each
half is tried on its own, and so on down to the one declaration that it refuses. The generation's layout notes that
one as `unmade` with the reason, so that every process refuses it from then on, and its nodes park their own episodes.

Only a refusal of the definition counts (`Dialect.refusal`). A lock that was not given in time, a full disk or a server
that is away ends the whole transaction, and the growth is tried again with the next batch. Nor is a declaration at
fault for a view of a user that cannot be made any more: then noting the declaration as unmade, which makes the same
views, fails too, and that error is raised.

One transaction makes the tables of `_SLICE` declarations at most, because a server keeps a lock for each of them until
COMMIT. A caller that finds the generation smaller than what it folded for commits, and comes again.
"""

from __future__ import annotations

import logging
from collections.abc import Sequence
from typing import Protocol

from sqlalchemy.exc import ArgumentError, CompileError, IdentifierError
from sqlalchemy.ext.asyncio import AsyncConnection

from pycrorm_async.events.codec import fingerprint
from pycrorm_async.projections.schema.generations import Generation
from pycrorm_async.projections.schema.layout import Layout, unite
from pycrorm_async.store.dialects import dialect_of

__all__ = ["Growing", "grow"]

_SLICE = 1_000
"""Tables that one transaction makes at most: a server as it is installed has room for some 7,000 locks, and a table
with its index, the table of its long texts and the view before it takes up to five."""

_log = logging.getLogger("pycrorm_async.projections")


class Growing(Protocol):
    """Where a generation is noted."""

    async def grow(self, connection: AsyncConnection, generation: Generation, layout: Layout) -> Generation:
        """Makes what this layout has more, and notes it."""
        ...


async def grow(
    connection: AsyncConnection, goal: Growing, generation: Generation, payloads: Sequence[bytes]
) -> Generation:
    """The generation with the tables of these declarations, as far as the database makes them and one slice holds them.

    Raises what is no refusal of a declaration; then the caller's transaction must be rolled back.
    """
    return await _grow(connection, goal, generation, _slice(generation.layout, payloads))


def _slice(layout: Layout, payloads: Sequence[bytes]) -> Sequence[bytes]:
    """The first of these declarations that together bring as many new tables as one transaction makes."""
    accepted = unite(layout, payloads).accepted
    new: set[str] = set()
    for place, payload in enumerate(payloads):
        declared = accepted.get(fingerprint(payload))
        if declared is not None and declared.table not in layout.leaves:
            new.add(declared.table)
            if len(new) > _SLICE:
                return payloads[:place]
    return payloads


async def _grow(
    connection: AsyncConnection, goal: Growing, generation: Generation, payloads: Sequence[bytes]
) -> Generation:
    united = unite(generation.layout, payloads)
    if united.layout == generation.layout:
        return generation
    try:
        async with connection.begin_nested():
            return await goal.grow(connection, generation, united.layout)
    except (ArgumentError, CompileError, IdentifierError) as error:  # its statement could not even be written
        reason = str(error)
    except dialect_of(connection).faults as error:
        refusal = dialect_of(connection).refusal(error)
        if refusal is None:
            raise
        reason = refusal
    if len(payloads) > 1:
        middle = len(payloads) // 2
        generation = await _grow(connection, goal, generation, payloads[:middle])
        return await _grow(connection, goal, generation, payloads[middle:])
    name = fingerprint(payloads[0])
    if name not in united.accepted:  # not its tables: a view that stands before all of them
        return await goal.grow(connection, generation, united.layout)
    dtype = united.accepted[name].dtype
    remedy = ": rename yours, then open the memory again" if "already exists" in reason else ""
    reason = f"the database makes no tables for {dtype}: {' '.join(reason.split())}{remedy}"
    grown = await goal.grow(connection, generation, generation.layout.with_unmade(name, reason))
    _log.warning("%s; its episodes are parked, all others go on", reason)
    return grown
