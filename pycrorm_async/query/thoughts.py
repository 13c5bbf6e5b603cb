"""What a connection sees that also sees what was only thought through, while everybody else sees what happened."""

from __future__ import annotations

from sqlalchemy.ext.asyncio import AsyncConnection

from pycrorm_async.projections.schema.generations import Generation, all_noted, projections_in, view_texts_of

__all__ = ["all_views"]


async def all_views(connection: AsyncConnection, generation: Generation) -> dict[str, str]:
    """Name and SQL of every view there is, as it is without anything left out; a view stands on those before it."""
    projections = projections_in(await all_noted(connection))
    return view_texts_of(connection, generation, projections, simulated=True)
