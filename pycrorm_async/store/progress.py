"""What a projector adds to its own transaction, so that rows and progress are committed together or not at all."""

from __future__ import annotations

from collections.abc import Sequence

import msgspec
from sqlalchemy.ext.asyncio import AsyncConnection

from pycrorm_async.store.sqlite import statements as sql

__all__ = ["advance_folded", "park"]


async def advance_folded(connection: AsyncConnection, steps: Sequence[tuple[int, int, int]]) -> bool:
    """Notes (episode number, folded before, folded now) of each episode.

    False if one of them is not where the caller believed: someone else folded it, and the caller must roll back.
    """
    text = msgspec.json.encode(steps).decode()
    return (await connection.exec_driver_sql(sql.ADVANCE_FOLDED, (text,))).rowcount == len(steps)


async def park(connection: AsyncConnection, number: int, reason: str | None) -> None:
    """Stops folding an episode, with the reason; None releases it. The log goes on taking its events."""
    await connection.exec_driver_sql(sql.PARK, (reason, number))
