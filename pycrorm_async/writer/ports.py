"""Define the writer's two ends: a source of synced records, and a log that stores them with the tables behind it.

A writer beside a plan needs `Source` and `Destination`; a daemon needs `ClaimedSource`, `Log` and `Tables`; a plan that
waits for a daemon needs `OfferedQueue`.
"""

from __future__ import annotations

from collections.abc import Callable, Collection, Mapping, Sequence
from pathlib import Path
from typing import NamedTuple, Protocol, TypeAlias

from pycrorm_async.events.envelope import Record
from pycrorm_async.events.ids import EpisodeId


class Source(Protocol):
    """The consumer's side of a queue, live or recovered."""

    @property
    def name(self) -> str:
        """The recorder's name, for status and messages."""
        ...

    async def get_batch(self, *, events_max: int, bytes_max: int, age_s_max: float) -> Sequence[Record]:
        """Return the next synced records in order, at least one, within the limits (a larger record comes alone).

        Waits for the first record, then at most `age_s_max` for more. Returns an empty sequence once the queue is
        closed and drained. A source supplies each record once; the next source supplies unacknowledged records again.
        """
        ...

    async def acknowledge(self, position: int) -> None:
        """Note that records up to this position are durable in the database: their segments may be deleted."""
        ...

    def dead_letter(self, records: Sequence[Record]) -> bool:
        """Keep records that the log refused, durable on return, so that they can be acknowledged. Blocks.

        Keeps each record once. Returns False if the source itself consists of dead letters, which must stay where they
        are. Raises `FilesError` or `DamageError` if the records cannot be kept.
        """
        ...

    def fail(self, reason: str) -> None:
        """Note that no more records will be acknowledged, so that waiting producers fail. The first reason stays."""
        ...


class Log(Protocol):
    """The log in a database."""

    async def append(self, records: Sequence[Record]) -> Mapping[EpisodeId, str]:
        """Append records, durable on return. Records stored before with the same bytes are stored once.

        Returns the episodes with refused records (behind a gap, or with content no database can hold) and the reasons:
        the caller must keep these records; other episodes are not affected. Raises `DatabaseUnavailable`; then the same
        call may be repeated. Raises `LogDamaged` if another event is stored under a record's key.
        """
        ...

    async def confirm(self) -> None:
        """Check that the log still holds the events it confirmed; append lost ones again. Raises as `append` does."""
        ...

    @property
    def writes(self) -> int:
        """Number of committed writing transactions; grows while the database makes progress."""
        return 0


class Destination(Log, Protocol):
    """A log and the tables behind it, for a writer that folds to the end."""

    async def fold(self) -> int:
        """Fold all events of the log that are not folded yet; return their number.

        Parks an episode that it cannot fold. May be cancelled: committed folds stay, the next call folds the rest.
        """
        ...

    async def stopped(self) -> Mapping[str, str]:
        """Return the refused and parked episodes by id, with reasons, at a cost independent of the others."""
        ...


class Tables(Protocol):
    """The tables behind a log, for a daemon that folds in steps while it appends."""

    async def fold_next_batch(self) -> bool:
        """Fold one batch of events that are not visible yet; False if there was none.

        Parks an episode that it cannot fold. Raises `DatabaseUnavailable`; then the same call may be repeated.
        """
        ...

    async def behind(self) -> Mapping[str, int]:
        """Return the folded sequence, by id, of each episode with events that are not visible yet."""
        ...

    async def stopped(self) -> Mapping[str, str]:
        """Return the refused and parked episodes, as `Destination.stopped` does."""
        ...


class ClaimedSource(Source, Protocol):
    """One recorder's folder, claimed by a daemon: no other process drains it meanwhile."""

    @property
    def is_alive(self) -> bool:
        """True if the recorder lives in another process and may record more."""
        ...

    @property
    def stored(self) -> int:
        """Position last acknowledged, by this source or an earlier one."""
        ...

    @property
    def invisible(self) -> Mapping[EpisodeId, int]:
        """The last sequence, by episode, that earlier sources stored and that was not visible when this one began."""
        ...

    @property
    def holds_dead_letters(self) -> bool:
        """True for a folder of records that a database refused: only the next writer should offer them again."""
        ...

    def finish(self) -> None:
        """End this source behind the records that are synced now."""
        ...

    def mark_visible(self, position: int, stopped: Mapping[str, str]) -> None:
        """Publish that records up to this position are visible, except those of `stopped` episodes, by id."""
        ...

    def mark_unavailable(self, reason: str | None) -> None:
        """Publish the reason why the database is unavailable; None when it is available again."""
        ...

    def release(self) -> str | None:
        """Release the folder; delete a dead recorder's folder if all its records are stored. Blocks.

        Returns the outcome for a report; None if not all records could be stored. Raises `SpoolUnavailable`.
        """
        ...


class DrainReasons(Protocol):
    """The reasons that a drainer in another process gives: why it stopped, why it waits, which episodes stopped."""

    @property
    def failure(self) -> str | None: ...
    @property
    def unavailable(self) -> str | None: ...
    @property
    def stopped(self) -> Mapping[str, str]: ...


class ExternalDrain(Protocol):
    """The progress of a drainer in another process: its stored and visible positions, and its reasons."""

    @property
    def stored(self) -> int: ...
    @property
    def folded(self) -> int: ...
    @property
    def note(self) -> DrainReasons: ...


class OfferedQueue(Protocol):
    """The recorder's side of a queue that another process drains."""

    @property
    def folder(self) -> Path:
        """The folder of the queue, in its spool."""
        ...

    @property
    def written(self) -> int:
        """Position of the last record put."""
        ...

    @property
    def is_drained(self) -> bool:
        """True while a process drains the queue. Raises `FilesError`."""
        ...

    @property
    def external_drain_status(self) -> ExternalDrain | None:
        """The status that the drainer published last; None if this process drains the queue itself."""
        ...

    async def synced_to(self, position: int | None = None) -> None:
        """Wait until the records up to this position, by default all, are on the disk. Raises `SpoolUnavailable`."""
        ...


class ScanResult(NamedTuple):
    """The result of a scan: claimed folders to drain (`held`), and by name the errors of folders that cannot be."""

    held: Sequence[ClaimedSource]
    failed: Mapping[str, Exception]


SourceScanner: TypeAlias = Callable[[Collection[str]], ScanResult]
"""Claims every recorder's folder that can be drained, except those of these names. Reads files: blocks."""
