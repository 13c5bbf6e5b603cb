"""What the writer needs of its two ends: a source of synced records, and a log that takes and folds them.

`Source` and `Destination` are what a writer beside a plan needs; `ClaimedSource` and `Tables` what a daemon needs more.
"""

from __future__ import annotations

from collections.abc import Collection, Mapping, Sequence
from pathlib import Path
from typing import NamedTuple, Protocol

from pycrorm_async.events.envelope import Record
from pycrorm_async.events.ids import EpisodeId

__all__ = [
    "Source",
    "Destination",
    "ClaimedSource",
    "ReleaseOutcome",
    "SourceScanner",
    "ScanResult",
    "Tables",
    "OfferedQueue",
    "DrainProgress",
    "DrainRemarks",
]


class Source(Protocol):
    """The consumer's side of a queue, live or recovered."""

    @property
    def name(self) -> str:
        """The recorder's name, for status and messages."""
        ...

    async def get_batch(self, *, events_max: int, bytes_max: int, age_s_max: float) -> Sequence[Record]:
        """The next synced records in order, at least one, at most the limits (a single larger record comes alone).

        Waits until one is there, then at most `age_s_max` for more. Empty once the queue is closed and drained.
        What was given is not given again by this source; what was not acknowledged is given again by the next.
        """
        ...

    async def acknowledge(self, position: int) -> None:
        """Everything up to this position is stored for good: its segments may be deleted."""
        ...

    def dead_letter(self, records: Sequence[Record]) -> bool:
        """Keeps records that the log refused elsewhere, so that the source may forget them like stored ones: durable
        when it returns. What was set aside before is so once. Blocks.

        False if they are to stay where they are, because the source is made of such records. Raises `FilesError` or
        `DamageError` if it cannot be done.
        """
        ...

    def fail(self, reason: str) -> None:
        """From now on nothing more will be acknowledged: whoever waits for room is told why. The first reason stays."""
        ...


class Destination(Protocol):
    """The log in a database, and the tables behind it."""

    async def append(self, records: Sequence[Record]) -> Mapping[EpisodeId, str]:
        """Durable when it returns. What is stored already with the same bytes is stored once.

        Gives the episodes of which it refused records (a gap, or what no database can hold) and why: these records are
        not stored and must be kept; the other episodes go on. Raises `DatabaseUnavailable` when the database is away:
        the same call may be made again. Raises `LogDamaged` when another event is stored under a record's key.
        """
        ...

    async def confirm(self) -> None:
        """Looks whether the log still holds what it confirmed, and offers it again what it lost. Raises as `append`."""
        ...

    @property
    def writes(self) -> int:
        """How many transactions that write were committed: while it grows the database gets on."""
        return 0

    async def fold(self) -> int:
        """Brings the tables up to date with the log; gives the number of events folded.

        An episode it cannot fold is parked. May be cancelled: what was committed stays, the rest is folded next time.
        """
        ...

    async def stopped(self) -> Mapping[str, str]:
        """Every episode, by id, that is refused or parked, and why. Stays short however many episodes there are."""
        ...


class ClaimedSource(Source, Protocol):
    """One recorder's folder, held by a daemon: nobody else drains it meanwhile."""

    @property
    def is_alive(self) -> bool:
        """Whether the recorder lives in another process and puts more into it."""
        ...

    def finish(self) -> None:
        """Nothing beyond what is synced now is given any more."""
        ...

    def mark_visible(self, position: int, stopped: Mapping[str, str]) -> None:
        """Everything up to this position shows in the tables, or never will: of the `stopped` episodes, by id."""
        ...

    def mark_unavailable(self, reason: str | None) -> None:
        """Why the database takes nothing now; None when it does again."""
        ...

    def release_folder(self) -> ReleaseOutcome:
        """Leaves it to whoever comes next; what a dead recorder left is deleted if all of it is stored. Blocks."""
        ...


class ReleaseOutcome(NamedTuple):
    """What became of a folder, in words; `whole` unless something is left in it that could not be stored.

    `again`: whether that is to be tried again in this process.
    """

    what: str
    whole: bool
    again: bool = True


class ScanResult(NamedTuple):
    """What looking round brought: folders to drain, and by name those that cannot be, and why."""

    held: Sequence[ClaimedSource]
    failed: Mapping[str, Exception]


class SourceScanner(Protocol):
    """Takes hold of every recorder's folder that can be drained, but for those of these names. Reads files: blocks."""

    def __call__(self, but: Collection[str]) -> ScanResult: ...


class Tables(Destination, Protocol):
    """A destination that says what shows in the tables, and folds in steps, so that appending goes on beside it."""

    async def fold_next_batch(self) -> bool:
        """Shows some of what the tables do not show yet; False if there was nothing. Raises as `fold` does."""
        ...

    async def behind(self) -> Mapping[str, int]:
        """By id, how far the tables show each episode of which they do not show all that they ever will."""
        ...


class DrainRemarks(Protocol):
    """Reasons that the drainer of a queue gives in words."""

    @property
    def given_up(self) -> str | None:
        """Why the drainer acknowledges nothing more."""
        ...

    @property
    def away(self) -> str | None:
        """Why the database takes nothing at this moment."""
        ...

    @property
    def stopped(self) -> Mapping[str, str]:
        """By episode id, why it is refused or parked."""
        ...


class DrainProgress(Protocol):
    """Positions that the drainer of a queue has reached."""

    @property
    def stored(self) -> int:
        """Everything up to this position is in the log."""
        ...

    @property
    def folded(self) -> int:
        """Everything up to this position is visible in the tables."""
        ...

    @property
    def note(self) -> DrainRemarks:
        """What hinders the drainer."""
        ...


class OfferedQueue(Protocol):
    """A recorder's queue that another process drains."""

    @property
    def folder(self) -> Path:
        """The recorder's folder, below the spool."""
        ...

    @property
    def written(self) -> int:
        """The position of the last record."""
        ...

    @property
    def is_drained(self) -> bool:
        """Whether a process drains the queue at this moment."""
        ...

    @property
    def external_drain_status(self) -> DrainProgress | None:
        """How far the other process has got; None for a queue that is drained in this process."""
        ...

    async def synced_to(self) -> None:
        """Returns when every record is safe on the disk. Raises `SpoolUnavailable`."""
        ...
