"""What an open memory reports about itself at one moment."""

from __future__ import annotations

from collections.abc import Mapping
from typing import NamedTuple, Self

from pycrorm_async.errors import PycrormError
from pycrorm_async.hooks.emitter import Faults
from pycrorm_async.hooks.values.missing_values import Missing
from pycrorm_async.memory_parts import Parts
from pycrorm_async.writer.background_writer import WriterState
from pycrorm_async.writer.writer_thread import WriterThread

__all__ = ["MemoryStatus"]


class MemoryStatus(NamedTuple):
    """How a memory is.

    Attributes:
        written, synced, stored: positions of what survives the process, the machine, and is in the database.
        bytes_spooled: what the queue holds on disk.
        faults: what the hooks failed to record, and performs that were never awaited.
        unawaited: for each type of designator whose perform was called and never awaited, a sentence that says so.
        missing: values that could not be recorded, and the reason of the last.
        samples_left_out, episodes_continued: samples that found no room; episodes that went on in a follow-up episode.
        folded: position up to which all shows in the tables, as the daemon says; None where a thread writes.
        drained: whether somebody moves events out of the queue now.
        writer: what the writer of this process does; None where a daemon writes.
        unadopted: folders of dead recorders that could not be recovered, and why.
        spool_fault: what befell the queue's files last (a failed sync; deleted or replaced files, and where recording
            goes on); None if nothing did.
        spool_lost: the records that were lost with deleted files, one line for each run of positions.
        declarations_unrepeated: declarations that are in one segment only, for want of room in the others: of a log
            that went back their episodes can be healed as long as that segment is kept.
    """

    written: int
    synced: int
    stored: int
    bytes_spooled: int
    folded: int | None
    drained: bool
    faults: Faults
    unawaited: tuple[str, ...]
    missing: Missing
    samples_left_out: int
    episodes_continued: int
    writer: WriterState | None
    unadopted: Mapping[str, PycrormError]
    spool_fault: str | None
    spool_lost: tuple[str, ...]
    declarations_unrepeated: int

    @classmethod
    def of(cls, parts: Parts, unadopted: Mapping[str, PycrormError]) -> Self:
        """How the memory with these parts is, at this moment."""
        queue, emitter, told = parts.queue, parts.emitter, parts.recorder
        outside = queue.external_drain_status
        return cls(
            written=queue.written,
            synced=queue.synced,
            stored=queue.stored,
            bytes_spooled=queue.bytes_spooled,
            folded=None if outside is None else outside.folded,
            drained=queue.is_drained,
            faults=emitter.faults,
            unawaited=emitter.unawaited,
            missing=emitter.missing.count,
            samples_left_out=told.samples_left_out,
            episodes_continued=told.continued_count,
            writer=parts.writer.state if isinstance(parts.writer, WriterThread) else None,
            unadopted=dict(unadopted),
            spool_fault=queue.setback,
            spool_lost=queue.lost,
            declarations_unrepeated=queue.declarations_unrepeated,
        )
