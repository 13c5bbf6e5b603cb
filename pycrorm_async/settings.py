"""What can be set, frozen, with a unit in every name. The defaults serve one robot on one machine.

>>> Settings(spool_bytes_max=2**30, on_full="fail").sync_interval_ms
50
"""

from __future__ import annotations

import math
from collections.abc import Mapping
from dataclasses import dataclass, fields
from typing import Final, Literal, get_args

from pycrorm_async.errors import CallerError

__all__ = ["FILE_MODES", "FileAccess", "Settings", "OnFull", "OnUnrecordable", "Writer"]

OnFull = Literal["wait", "fail"]
OnUnrecordable = Literal["record_missing", "refuse"]
Writer = Literal["thread", "daemon"]
FileAccess = Literal["owner", "group"]
FILE_MODES: Final[Mapping[FileAccess, int]] = {"owner": 0o600, "group": 0o660}
"""Mode of a file in the spool, and of a SQLite database."""
_MAY_BE_NONE = frozenset({"sample_interval_ms"})
_MAY_BE_ZERO = frozenset({"keep_stored_bytes", "keep_stored_s", "sample_change_min"})
_EPISODE_EVENTS = range(100, 2**26)
"""What a sequence of 26 bits can count (`events.ids.SEQUENCE_MAX`); fewer than a hundred leave no room for a plan."""
_CHOICES = {
    "writer": get_args(Writer),
    "on_full": get_args(OnFull),
    "on_unrecordable": get_args(OnUnrecordable),
    "file_access": get_args(FileAccess),
}


@dataclass(frozen=True, kw_only=True)
class Settings:
    """Limits and rhythms of one memory.

    Attributes:
        writer: who moves events to the database: a thread of this process, or the daemon `pycrorm writer`.
        sync_interval_ms: a sync of what was written begins after at most this long.
        segment_bytes: size of one file of the write-ahead queue, allocated ahead.
        spool_bytes_max: what one recorder may hold on disk before `on_full` applies.
        spool_reserve_bytes: kept free below that for ends and world observations, which never wait for room.
        keep_stored_s: a segment is kept for so long after all in it is stored, to heal a database that went back (a
            failover, a restored backup); 0: not at all.
        keep_stored_bytes: all kept segments of a spool take at most so much, beside `spool_bytes_max`. The default is
            about a million events: a day of one busy robot, and a sixteenth of `spool_bytes_max`. A full disk takes
            them first.
        record_bytes_max: the largest single event; a larger one is refused.
        episode_events_max: before it has more events than this, an episode is ended and goes on in a follow-up episode.
        batch_events_max, batch_bytes_max, batch_age_ms: a batch closes at whichever comes first.
        fold_worker_restart_s: how long the daemon waits before it starts a fold worker again that has died; twice as
            long after each further death, at most a minute.
        fold_worker_healthy_s: a fold worker that has lived for so long is restarted as after a first death.
        fold_worker_report_s: a fold worker that is stopped (SIGSTOP, a debugger) while it folds is reported after so
            long, because it may hold a lock of the database,
        fold_worker_stopped_s: and killed and replaced after so long.
        fold_worker_answer_s: a fold worker that gives no answer for so long is replaced even if it is at work. A batch
            takes about a second; this is not for slow disks, it is for what never ends.
        idle_ms: a plan that has emitted nothing for so long is idle: its tables are brought up to date.
        flush_timeout_s: `flush` and closing fail when the database has taken nothing for this long; nothing is lost.
        connect_timeout_s: how long a database may take to answer at the first connection.
        sample_interval_ms: how often the robot's state is sampled while a motion runs; None: never. Each motion is then
            sampled at its start and end as well.
        sample_change_min: between those, only joints (rad or m) and numbers of the base's pose that changed by more
            than this since they were last written.
        on_full: what a node does that starts while the spool is full: wait for room, or fail with `SpoolFull`.
        on_unrecordable: record a parameter that cannot be recorded as missing, with the reason, count it and warn once;
            or, while a plan is developed, refuse the perform.
        file_access: a new spool (mode 0700) and a new SQLite database (0600) belong to their `owner` alone, or to the
            `group` of the folder that holds them (2770, 0660), whose processes share them.
    """

    writer: Writer = "thread"
    sync_interval_ms: int = 50
    segment_bytes: int = 8 * 2**20
    spool_bytes_max: int = 4 * 2**30
    spool_reserve_bytes: int = 16 * 2**20
    keep_stored_s: float = 86_400.0
    keep_stored_bytes: int = 256 * 2**20
    record_bytes_max: int = 2**20
    episode_events_max: int = 2**26 - 1
    batch_events_max: int = 10_000
    batch_bytes_max: int = 4 * 2**20
    batch_age_ms: int = 50
    fold_worker_restart_s: float = 1.0
    fold_worker_healthy_s: float = 60.0
    fold_worker_report_s: float = 2.0
    fold_worker_stopped_s: float = 10.0
    fold_worker_answer_s: float = 300.0
    idle_ms: int = 200
    flush_timeout_s: float = 15.0
    connect_timeout_s: float = 10.0
    sample_interval_ms: int | None = None
    sample_change_min: float = 0.0
    on_full: OnFull = "wait"
    on_unrecordable: OnUnrecordable = "record_missing"
    file_access: FileAccess = "owner"

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
    if name == "episode_events_max" and value not in _EPISODE_EVENTS:
        return f"it must be a whole number from {_EPISODE_EVENTS[0]:,} to {_EPISODE_EVENTS[-1]:,}"
    number = value if isinstance(value, int | float) else math.nan
    if name in _MAY_BE_ZERO:
        return None if 0 <= number < math.inf else "it must be a number, zero or above"
    return None if number > 0 else "it must be a number above zero"
