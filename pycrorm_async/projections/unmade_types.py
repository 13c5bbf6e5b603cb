"""List the designator types of a memory that have no tables, and those kept under other names, with the reasons.

Episodes that use a type without tables are parked. Users' views that are left out are listed here too.
"""

from __future__ import annotations

from pycrorm_async.events.codec import declared_dtype, fingerprint
from pycrorm_async.projections.schema.generations import SHOWN, read_generation
from pycrorm_async.projections.schema.layout import Layout
from pycrorm_async.projections.schema.union import Union, unite
from pycrorm_async.store.dialects import dialect_of
from pycrorm_async.store.log import EventLog


async def _united(log: EventLog) -> tuple[Union, list[bytes]]:
    async with log.snapshot() as connection:
        generation = await read_generation(connection, SHOWN)
        payloads = await dialect_of(connection).declarations(connection)
    return unite(Layout() if generation is None else generation.layout, payloads), payloads


async def contradictions(log: EventLog) -> list[str]:
    """Return a line for each declared field and type that contradicts an earlier one, with its name in the tables."""
    united, _ = await _united(log)
    return [line for each in united.adjustments.values() for line in each.lines]


async def unmade_types(log: EventLog) -> dict[str, str]:
    """Return the reasons by dtype, or by fingerprint where the declaration's dtype cannot be read."""
    united, payloads = await _united(log)
    refused = united.refused
    dtypes = {fingerprint(each): declared_dtype(each) for each in payloads if fingerprint(each) in refused}
    return {dtypes[each] or each: reason for each, reason in refused.items()}


async def failed_views(log: EventLog) -> dict[str, str]:
    """Return the database's reasons for refusing users' views, by view."""
    async with log.snapshot() as connection:
        generation = await read_generation(connection, SHOWN)
    return {} if generation is None else generation.layout.failed_views
