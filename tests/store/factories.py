"""Factories of records for the tests of the store and the writer, and faults of an append."""

from __future__ import annotations

import asyncio
from typing import Any

from pycrorm_async.events.codec import Record
from pycrorm_async.events.ids import EpisodeId

# === factories ================================================================================================
#
# Factories of records for the tests of the store and the writer.

HEADS = "SELECT number, id, head, folded, started_wall_ns, ended_wall_ns, refused, parked FROM episode ORDER BY number"


def episode(number: int) -> EpisodeId:
    """Return an episode id that differs from others in its last digits only."""
    return EpisodeId(bytes(14) + number.to_bytes(2))


def record(
    of: EpisodeId,
    sequence: int,
    *,
    position: int | None = None,
    kind: str = "NodeStarted",
    version: int = 1,
    wall_ns: int | None = None,
    monotonic_ns: int | None = None,
    payload: bytes | None = None,
) -> Record:
    return Record(
        position=sequence if position is None else position,
        episode=of,
        sequence=sequence,
        type=kind,
        version=version,
        wall_ns=1_700_000_000_000_000_000 + sequence if wall_ns is None else wall_ns,
        monotonic_ns=5_000_000 + sequence if monotonic_ns is None else monotonic_ns,
        payload=b'{"kind":"action","parent":%d}' % sequence if payload is None else payload,
    )


def run_of(of: EpisodeId, first: int, last: int, *, position: int | None = None) -> list[Record]:
    """Return events `first` to `last`, at positions from `position` on."""
    start = first if position is None else position
    return [record(of, sequence, position=start + index) for index, sequence in enumerate(range(first, last + 1))]


def declaration(payload: bytes, *, position: int = 1) -> Record:
    return Record(position, None, 0, "DesignatorTypeDeclared", 1, 7, 8, payload)


def started(number: int) -> Record:
    payload = b'{"description":"Tutorial","created_by":"ada","host":"lab","software":"0.1.0","python":"3.11.7"}'
    return record(episode(number), 1, kind="EpisodeStarted", payload=payload)


def name(number: int) -> str:
    return f"00000000-0000-0000-0000-{number:012x}"


# === faults ===================================================================================================
#
# Inject faults into an append.


async def cancel_at_await(task: asyncio.Task[Any], count: int) -> None:
    """Cancel the task at its await number `count`, or when it has ended, and wait for its end."""
    awaited: list[object] = []
    while len(awaited) < count and not task.done():
        waiter = getattr(task, "_fut_waiter", None)
        if waiter is not None and waiter not in awaited[-1:]:
            awaited.append(waiter)
        await asyncio.sleep(0)
    task.cancel()
    await asyncio.wait([task])
