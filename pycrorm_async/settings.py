"""Hold the settings of one memory: frozen, with a unit in every name. The defaults serve one robot on one machine.

>>> Settings(spool_bytes_max=2**30, on_full="fail").sync_interval_ms
50
"""

import logging
import math
from collections.abc import Mapping
from dataclasses import InitVar, dataclass, fields
from typing import Any, Final, Literal, get_args

from pycrorm_async.errors import CallerError

OnFull = Literal["wait", "fail"]
RecordMeshes = Literal["boxes", "files"]
OnUnrecordable = Literal["record_missing", "refuse"]
Writer = Literal["thread", "process", "daemon"]
FileAccess = Literal["owner", "group"]
Fold = Literal["idle", "at_end"]
FILE_MODES: Final[Mapping[FileAccess, int]] = {"owner": 0o600, "group": 0o660}
"""Mode of a file in the spool and of a SQLite database, by file access."""
_MAY_BE_NONE = frozenset({"sample_interval_ms"})
_MAY_BE_ZERO = frozenset({"keep_stored_bytes", "keep_stored_s", "sample_change_min"})
_EPISODE_EVENTS = range(100, 2**26)
"""Bounds `episode_events_max`: a sequence has 26 bits (`events.ids.SEQUENCE_MAX`); a plan needs about 100 events."""
_REMOVED = ("batch_bytes_max", "batch_age_ms", "fold_worker_restart_s", "fold_worker_answer_s")
_log = logging.getLogger("pycrorm_async")
_CHOICES = {
    "writer": get_args(Writer),
    "on_full": get_args(OnFull),
    "on_unrecordable": get_args(OnUnrecordable),
    "record_meshes": get_args(RecordMeshes),
    "file_access": get_args(FileAccess),
    "fold": get_args(Fold),
    "recall": (True, False),
}


@dataclass(frozen=True, kw_only=True)
class Settings:
    """Limits and intervals of one memory.

    Attributes:
        writer: a thread of this process ("thread"), a process that the memory starts and ends ("process"), or the
            daemon `pycrorm writer` ("daemon") drains the recorder's folder.
        sync_interval_ms: written records wait at most this long for a sync to begin.
        segment_bytes: size of one file of the write-ahead queue, allocated before use.
        spool_bytes_max: one recorder holds at most this much on disk; beyond it `on_full` applies.
        spool_reserve_bytes: part of `spool_bytes_max` reserved for node ends and world observations, which never wait.
        keep_stored_s: a segment whose records are all stored is kept this long, to refill a database that went back
            (a failover, a restored backup); 0 keeps none.
        keep_stored_bytes: these kept segments of a spool take at most this much, in addition to `spool_bytes_max`. The
            default is about a million events, a day of one busy robot, and a sixteenth of `spool_bytes_max`. They are
            deleted first when the disk is full.
        blob_bytes_max: size of the largest blob (an image, a large array); a larger one is recorded as missing. Blobs
            that are not stored yet count as part of `spool_bytes_max`, kept ones as part of `keep_stored_bytes`.
        record_bytes_max: size of the largest event; a larger one is refused.
        episode_events_max: an episode with this many events records no more (`EpisodeFull` is counted in `faults`), but
            for ends, for which an eighth of them is kept, at most 2**20.
        batch_events_max: a batch closes at this many events, or earlier at 4 MiB of payloads or at an age of 50 ms.
        idle_ms: a plan that has emitted no event for this long counts as idle, and its events are folded.
        fold: the writer thread folds when the plan idles ("idle"), or only at a flush and at the end of the memory
            ("at_end"): for an executive that sleeps often, because the fold competes with it for the interpreter.
        recall: make a case of each action that ends, for `memory.recall`, when the tables are folded. Without it, cases
            are made by the next process that has it, or by `pycrorm rebuild`.
        flush_timeout_s: `flush` and closing fail when the database has stored no event for this long; none is lost.
        connect_timeout_s: opening a database on a server fails when it has not answered for this long.
        sample_interval_ms: the robot's state is sampled at this interval while a motion runs, and also at the motion's
            start and end; None samples nothing.
        sample_change_min: samples between start and end hold only the joints (rad or m) and the numbers of the base
            pose that changed by more than this since they were last recorded.
        on_full: a node that starts while the spool is full waits for space ("wait") or fails with `SpoolFull` ("fail").
        on_unrecordable: "record_missing" records a parameter that cannot be recorded as missing, with the reason,
            counts it and warns once; "refuse", for developing a plan, raises before `perform` runs.
        record_meshes: a mesh of an object's description is recorded as its hash and the box around its link ("boxes"),
            or also as a blob with the file's content ("files").
        file_access: a new spool (mode 0700) and a new SQLite database (0600) belong to their "owner" alone, or to the
            "group" of the folder that holds them (2770, 0660), whose processes share them.
    """

    writer: Writer = "thread"
    sync_interval_ms: int = 50
    segment_bytes: int = 8 * 2**20
    spool_bytes_max: int = 4 * 2**30
    spool_reserve_bytes: int = 16 * 2**20
    keep_stored_s: float = 86_400.0
    keep_stored_bytes: int = 256 * 2**20
    blob_bytes_max: int = 64 * 2**20
    record_bytes_max: int = 2**20
    episode_events_max: int = 2**26 - 1
    batch_events_max: int = 10_000
    idle_ms: int = 200
    fold: Fold = "idle"
    recall: bool = True
    flush_timeout_s: float = 15.0
    connect_timeout_s: float = 10.0
    sample_interval_ms: int | None = None
    sample_change_min: float = 0.0
    on_full: OnFull = "wait"
    on_unrecordable: OnUnrecordable = "record_missing"
    record_meshes: RecordMeshes = "boxes"
    file_access: FileAccess = "owner"
    # Removed: accepted without effect for one release, see `_REMOVED`.
    batch_bytes_max: InitVar[object] = None
    batch_age_ms: InitVar[object] = None
    fold_worker_restart_s: InitVar[object] = None
    fold_worker_answer_s: InitVar[object] = None

    def changed(self) -> dict[str, Any]:
        """Return the settings that differ from their defaults, by name."""
        values = {field.name: getattr(self, field.name) for field in fields(self)}
        return {name: value for name, value in values.items() if value != getattr(Settings, name)}

    def __post_init__(self, *removed: object) -> None:
        for name, value in zip(_REMOVED, removed, strict=True):
            if value is not None:
                _log.warning("Settings.%s has no effect any more, and the next release refuses it", name)
        for field in fields(self):
            value = getattr(self, field.name)
            violation = _violation(field.name, value)
            if violation is not None:
                raise CallerError(f"Settings.{field.name} is {value!r}: {violation}")


def _violation(name: str, value: object) -> str | None:
    """Return the rule that a setting's value breaks, or None if the value is valid."""
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
