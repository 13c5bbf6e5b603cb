"""Make the log of a memory at a URL, with its tables, from records."""

from __future__ import annotations

from collections.abc import Iterable

from pycrorm_async.events.codec import Record
from pycrorm_async.projections.projector import Projector
from pycrorm_async.store.address import DatabaseAddress
from pycrorm_async.store.log import EventLog

__all__ = ["append_and_fold"]


async def append_and_fold(url: str, records: Iterable[Record], *, folded: bool = True) -> None:
    """Append to a log that is opened for this call alone, and fold it unless `folded` is false; none is refused."""
    log = await EventLog.open(DatabaseAddress.parse(url), create=True)
    try:
        assert await log.append(list(records)) == {}
        if folded:
            projector = Projector(log)
            await projector.open()
            await projector.catch_up()
    finally:
        await log.close()
