"""What a projector adds to its own transaction, so that rows and progress are committed together or not at all."""

from __future__ import annotations

from collections.abc import Sequence

from sqlalchemy.ext.asyncio import AsyncConnection

from pycrorm_async.store.dialect import Progress
from pycrorm_async.store.dialects import dialect_of

__all__ = ["advance_folded", "park"]


async def advance_folded(connection: AsyncConnection, steps: Sequence[Progress]) -> bool:
    """Notes (episode number, folded before, folded now) of each episode.

    False if one of them is not where the caller believed: someone else folded it, and the caller must roll back.
    """
    return await dialect_of(connection).advance_folded(connection, steps) == len(steps)


async def park(connection: AsyncConnection, number: int, reason: str | None) -> None:
    """Stops folding an episode, with the reason; None releases it. The log goes on taking its events."""
    await dialect_of(connection).park(connection, number, reason)
