"""Report durability: the machines that hold stored events, and the period whose events could be stored again.

Events are *stored* when the database has committed them. A failover, or the restore of a backup, can lose stored
events: the log then *went back*, and each time it did is an `Incarnation` of the log. Two sources can store the lost
events again. A recorder that still runs has its last events in its queue. The segments, which are the queue's files,
are kept below `spool/stored` for a while after all their events were stored.
"""

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


@dataclass(frozen=True)
class KeptSegments:
    """Segments kept below `spool/stored` after all their records were stored.

    Attributes:
        segments: number of segments.
        bytes: their size.
        since: events stored after this moment can be stored again from the segments; None without segments.
    """

    segments: int
    bytes: int
    since: datetime | None


@dataclass(frozen=True)
class Durability:
    """The database's report on stored events.

    Attributes:
        stored_on: number of machines that hold each stored event, and the names of the synchronous standbys.
        went_back: each time at which the log was noticed to have lost stored events.
    """

    stored_on: StoredOn
    went_back: list[Incarnation]


def summarise_kept_segments(spool: Path) -> KeptSegments:
    """Summarise the segments kept in a spool after their events were stored. Raises `SpoolUnavailable`."""
    with wrap_os_errors(spool):
        segments = kept_segments(spool)
    return KeptSegments(
        len(segments), sum(each.bytes for each in segments), _moment(segments[0].stored_ns) if segments else None
    )


async def durability(log: EventLog) -> Durability:
    """Query the durability of a log. Raises `DatabaseUnavailable`."""
    return Durability(await log.stored_on(), await log.incarnations())


def print_durability(kept: KeptSegments, durability: Durability | None) -> None:
    """Print the durability in sentences; `durability` is None if the database did not answer."""
    if durability is not None:
        machines, standbys = durability.stored_on
        replicas = f" (synchronous standby {', '.join(standbys)})" if standbys else ""
        stdout.print(f"A stored event is on {machines} machine{'s' * (machines > 1)}{replicas}.", markup=False)
    if kept.since is None:
        stdout.print(
            "No stored segments are kept; after a data loss, only events of running recorders can be stored again.",
            markup=False,
        )
    else:
        size = f"{kept.segments:,} segment{'s' * (kept.segments != 1)}, {kept.bytes / 2**20:,.1f} MiB"
        stdout.print(
            f"After a data loss, events stored since {_text(kept.since)} can be stored again ({size} kept).",
            markup=False,
        )
    for each in durability.went_back if durability is not None else ():
        when = _text(_moment(each.noticed_wall_ns))
        stdout.print(
            f"The database lost stored events, noticed {when} by {each.noticed_by}: {each.reason}", markup=False
        )


def _moment(wall_ns: int) -> datetime:
    return datetime.fromtimestamp(wall_ns / 1e9, UTC)


def _text(moment: datetime) -> str:
    return f"{moment:%Y-%m-%d %H:%M:%S} UTC"
