"""What can be set, frozen, with a unit in every name. The defaults serve one robot on one machine.

>>> Settings(spool_bytes_max=2**30, on_full="fail").sync_interval_ms
50
"""

from __future__ import annotations

import math
from dataclasses import dataclass, fields
from typing import Literal, get_args

from pycrorm_async.errors import CallerError

__all__ = ["Settings", "OnFull", "OnUnrecordable", "Writer"]

OnFull = Literal["wait", "fail"]
OnUnrecordable = Literal["refuse", "record_missing"]
Writer = Literal["thread", "daemon"]
_MAY_BE_NONE = frozenset({"sample_interval_ms"})
_MAY_BE_ZERO = frozenset({"sample_change_min"})
_CHOICES = {"writer": get_args(Writer), "on_full": get_args(OnFull), "on_unrecordable": get_args(OnUnrecordable)}


@dataclass(frozen=True, kw_only=True)
class Settings:
    """Limits and rhythms of one memory.

    Attributes:
        writer: who moves events to the database: a thread of this process, or the daemon `pycrorm writer`.
        sync_interval_ms: a sync of what was written begins after at most this long.
        segment_bytes: size of one file of the write-ahead queue, allocated ahead.
        spool_bytes_max: what one recorder may hold on disk before `on_full` applies.
        spool_reserve_bytes: kept free below that for ends and world observations, which never wait for room.
        record_bytes_max: the largest single event; a larger one is refused.
        batch_events_max, batch_bytes_max, batch_age_ms: a batch closes at whichever comes first.
        idle_ms: a plan that has emitted nothing for so long is idle: its tables are brought up to date.
        flush_timeout_s: `flush` and closing give up after this long; nothing is lost by it.
        connect_timeout_s: how long a database may take to answer at the first connection.
        sample_interval_ms: how often the robot's state is sampled while a motion runs; None: never. Each motion is then
            sampled at its start and end as well.
        sample_change_min: between those, only joints (rad or m) and numbers of the base's pose that changed by more
            than this since they were last written.
        on_full: what a node does that starts while the spool is full: wait for room, or fail with `SpoolFull`.
        on_unrecordable: refuse a perform whose parameters cannot be recorded, or record them as missing.
    """

    writer: Writer = "thread"
    sync_interval_ms: int = 50
    segment_bytes: int = 8 * 2**20
    spool_bytes_max: int = 4 * 2**30
    spool_reserve_bytes: int = 16 * 2**20
    record_bytes_max: int = 2**20
    batch_events_max: int = 10_000
    batch_bytes_max: int = 4 * 2**20
    batch_age_ms: int = 50
    idle_ms: int = 200
    flush_timeout_s: float = 300.0
    connect_timeout_s: float = 10.0
    sample_interval_ms: int | None = None
    sample_change_min: float = 0.0
    on_full: OnFull = "wait"
    on_unrecordable: OnUnrecordable = "refuse"

    def __post_init__(self) -> None:
        for each in fields(self):
            value = getattr(self, each.name)
            fault = _fault(each.name, value)
            if fault is not None:
                raise CallerError(f"Settings.{each.name} is {value!r}: {fault}")


def _fault(name: str, value: object) -> str | None:
    """What a setting must be and is not."""
    choices = _CHOICES.get(name)
    if choices is not None:
        return None if value in choices else f"use {' or '.join(map(repr, choices))}"
    if name in _MAY_BE_NONE and value is None:
        return None
    number = value if isinstance(value, int | float) else math.nan
    if name in _MAY_BE_ZERO:
        return None if 0 <= number < math.inf else "it must be a number, zero or above"
    return None if number > 0 else "it must be a number above zero"
