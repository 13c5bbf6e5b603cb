"""How safe it is what the database confirmed: on how many machines it is, and since when a loss could be healed."""

from __future__ import annotations

from dataclasses import dataclass
from datetime import UTC, datetime
from pathlib import Path

from pycrorm_async.cli.output import stdout
from pycrorm_async.queue.files.recorder_folder import wrap_os_errors
from pycrorm_async.queue.retention.stored_segments import kept_segments
from pycrorm_async.store.dialect import StoredOn
from pycrorm_async.store.log import EventLog
from pycrorm_async.store.stored import Incarnation

__all__ = ["Durability", "KeptSegments", "durability", "kept_in", "print_durability"]


@dataclass(frozen=True)
class KeptSegments:
    """Segments kept below `spool/stored` after all their records were stored.

    Attributes:
        segments, bytes: how many, and what they take.
        since: all that was stored after this moment can be offered to the database again; None if nothing is kept.
    """

    segments: int
    bytes: int
    since: datetime | None


@dataclass(frozen=True)
class Durability:
    """What the database says: on how many machines an event is once it is stored, and each time that it went back."""

    stored_on: StoredOn
    went_back: list[Incarnation]


def kept_in(spool: Path) -> KeptSegments:
    """Raises `SpoolUnavailable`."""
    with wrap_os_errors(spool):
        segments = kept_segments(spool)
    return KeptSegments(
        len(segments), sum(each.bytes for each in segments), _moment(segments[0].stored_ns) if segments else None
    )


async def durability(log: EventLog) -> Durability:
    """Raises `DatabaseUnavailable`."""
    return Durability(await log.stored_on(), await log.incarnations())


def print_durability(kept: KeptSegments, known: Durability | None) -> None:
    """In sentences; `known` is None where the database did not answer."""
    if known is not None:
        machines, standbys = known.stored_on
        also = f" (synchronous standby {', '.join(standbys)})" if standbys else ""
        stdout.print(f"stored = on {machines} machine{'s' * (machines > 1)}{also}", markup=False)
    if kept.since is None:
        stdout.print("A loss could be healed from what living recorders hold; no stored segment is kept.", markup=False)
    else:
        held = f"{kept.segments:,} segment{'s' * (kept.segments != 1)}, {kept.bytes / 2**20:,.1f} MiB"
        stdout.print(f"A loss could be healed since {_text(kept.since)} ({held} kept).", markup=False)
    for each in known.went_back if known is not None else ():
        when = _text(_moment(each.noticed_wall_ns))
        stdout.print(f"The database went back, noticed {when} by {each.noticed_by}: {each.reason}", markup=False)


def _moment(wall_ns: int) -> datetime:
    return datetime.fromtimestamp(wall_ns / 1e9, UTC)


def _text(moment: datetime) -> str:
    return f"{moment:%Y-%m-%d %H:%M:%S} UTC"
