"""Open a memory for a verb that reads one answer from it, and warn about events that the answer cannot contain yet."""

from __future__ import annotations

import asyncio
from collections.abc import Awaitable, Callable
from pathlib import Path
from typing import TYPE_CHECKING, TypeVar

from pycrorm_async.cli.output import note
from pycrorm_async.operations.destination import shared_address
from pycrorm_async.queue.spool import Spool
from pycrorm_async.store.address import DatabaseAddress

if TYPE_CHECKING:
    from pycrorm_async.query.reading import Reading

T = TypeVar("T")


def read_memory(url: str, spool: Path | None, read: Callable[[Reading], Awaitable[T]]) -> T:
    """Open the memory at the URL, call `read` with it, and return the result; then note pending events.

    Raises `CallerError` for `sqlite://`, as every verb that opens the memory of another process.
    """
    from pycrorm_async.query.reading import Reading  # loads the mapped classes, which not every verb needs

    shared_address(url)

    async def run() -> T:
        async with Reading.open(url) as reading:
            return await read(reading)

    answer = asyncio.run(run())
    note_pending_events(url, spool)
    return answer


# === pending events ===========================================================================================
#
# Warn when a spool holds events that its database does not; reading verbs never store them themselves.


def note_pending_events(url: str, spool: Path | None) -> None:
    """Print one line on stderr for dead recorders with events left to store, and one for living recorders."""
    address = DatabaseAddress.parse(url)
    folders = Spool(spool or address.default_spool).recorders()
    recorders = [each for each in folders if each.refused is None]  # `pycrorm status` reports dead letters
    alive = sum(each.alive for each in recorders)
    dead = len(recorders) - alive
    if dead:
        option = f" --spool {spool}" if spool else ""
        note(
            f"{dead} dead recorder{'s' * (dead > 1)} left events that are not in the database:"
            f" run `pycrorm writer --once --url {address.to_type}{option}` to store them."
        )
    if alive:
        note(f"{alive} recorder{'s are' if alive > 1 else ' is'} running: the latest events may not be stored yet.")
