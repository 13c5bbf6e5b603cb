"""Create the tables of newly declared designator types, leaving out the types that the database refuses.

Theory of operation. Growing runs in its caller's transaction, which excludes all other writers of the memory. The
tables of all declarations that the generation lacks are created at once, inside a savepoint. If the database refuses a
definition, the savepoint is rolled back and each half is tried separately, down to the single declaration that it
refuses. The generation's layout records that one as `unmade` with the reason, so that every process refuses it from
then on, and its nodes park their own episodes.

Only a refusal of the definition counts (`Dialect.refusal`). A lock timeout, a full disk or an unavailable server aborts
the whole transaction, and growing is tried again with the next batch. A user's view that cannot be created any more is
not blamed on a declaration either: `show` leaves it out.

One transaction creates the tables of at most `_SLICE` declarations, because a server keeps a lock for each of them
until COMMIT. A caller whose generation is still smaller than the layout it folded for commits and calls again.
"""

from __future__ import annotations

import logging
from collections.abc import Sequence
from typing import Protocol

from sqlalchemy.exc import ArgumentError, CompileError, IdentifierError
from sqlalchemy.ext.asyncio import AsyncConnection

from pycrorm_async.events.codec import fingerprint
from pycrorm_async.projections.schema.generations import Generation
from pycrorm_async.projections.schema.layout import Layout
from pycrorm_async.projections.schema.union import Union, unite
from pycrorm_async.store.dialects import dialect_of

_SLICE = 1_000
"""Bounds the tables created in one transaction: a default PostgreSQL has room for some 7,000 locks, and a table with
its index, its TOAST table and its view takes up to five."""

_log = logging.getLogger("pycrorm_async.projections")


class GrowthTarget(Protocol):
    """Protocol of the owner of a generation's row in `pycrorm_generation`, which can extend the tables."""

    async def grow(self, connection: AsyncConnection, generation: Generation, layout: Layout) -> Generation:
        """Create the tables and columns that only this layout has, and store the layout."""
        ...


async def grow(
    connection: AsyncConnection, target: GrowthTarget, generation: Generation, payloads: Sequence[bytes]
) -> Generation:
    """Create the tables of these declarations, up to one slice and without those that the database refuses.

    Returns the grown generation. Raises every database error that is not such a refusal; then the caller must roll its
    transaction back.
    """
    return await _grow(connection, target, generation, _slice(generation.layout, payloads))


def _slice(layout: Layout, payloads: Sequence[bytes]) -> Sequence[bytes]:
    """Return the longest prefix of these declarations that needs at most `_SLICE` new tables."""
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
    connection: AsyncConnection, target: GrowthTarget, generation: Generation, payloads: Sequence[bytes]
) -> Generation:
    united = unite(generation.layout, payloads)
    if united.layout == generation.layout:
        return generation
    try:
        async with connection.begin_nested():
            grown = await target.grow(connection, generation, united.layout)
            _log_contradictions(united, generation.layout)
            return grown
    except (ArgumentError, CompileError, IdentifierError) as error:  # SQLAlchemy cannot express the definition
        reason = str(error)
    except dialect_of(connection).faults as error:
        refusal = dialect_of(connection).refusal(error)
        if refusal is None:
            raise
        reason = refusal
    if len(payloads) > 1:
        middle = len(payloads) // 2
        generation = await _grow(connection, target, generation, payloads[:middle])
        return await _grow(connection, target, generation, payloads[middle:])
    name = fingerprint(payloads[0])
    if name not in united.accepted:  # the declaration has no tables, so a view is at fault: raise its error
        return await target.grow(connection, generation, united.layout)
    dtype = united.accepted[name].dtype
    remedy = ": rename your table or view, then open the memory again" if "already exists" in reason else ""
    reason = f"the database refuses the tables of {dtype}: {' '.join(reason.split())}{remedy}"
    grown = await target.grow(connection, generation, generation.layout.with_unmade(name, reason))
    _log.warning("%s; episodes that use this type are parked, all others continue", reason)
    return grown


def _log_contradictions(united: Union, before: Layout) -> None:
    """Log the contradictions of those declarations that need a column or a table of their own now."""
    for name, adjustment in united.adjustments.items():
        declared = united.accepted[name]
        columns = before.leaves.get(declared.table)
        if columns is None or any(own not in columns for own in adjustment.own_names):
            _log.warning("; ".join(adjustment.lines))
