"""Hold the parts of an open memory, connect plans to them in one context or the whole process, report their state."""

from __future__ import annotations

from collections.abc import Iterator, Mapping
from contextlib import ExitStack, contextmanager
from typing import Any, NamedTuple, Self

from pycrorm_async.clock import Clock
from pycrorm_async.connected_var import ConnectedVar, set_inside
from pycrorm_async.errors import CallerError, PycrormError
from pycrorm_async.hooks.observations import Observations, observations
from pycrorm_async.hooks.plan_recorder import Recorder
from pycrorm_async.plan.execution.observer import recorder
from pycrorm_async.plan.execution.unawaited_performs import called_performs
from pycrorm_async.plan.experience import experience
from pycrorm_async.query.reading import Reading
from pycrorm_async.queue.live.recorder_queue import RecorderQueue
from pycrorm_async.recall.experience import PickUpExperience
from pycrorm_async.recording.recording import Recording
from pycrorm_async.recording.values.missing_values import Missing
from pycrorm_async.recording.writing.emitter import Emitter, Faults
from pycrorm_async.store.address import DatabaseAddress
from pycrorm_async.world.observers import watcher
from pycrorm_async.writer.background_writer import WriterState
from pycrorm_async.writer.delegated_writer import DelegatedWriter
from pycrorm_async.writer.writer_thread import WriterThread


class Parts(NamedTuple):
    """The parts of an open memory."""

    queue: RecorderQueue
    writer: WriterThread | DelegatedWriter
    reading: Reading
    emitter: Emitter
    recorder: Recorder
    recording: Recording
    observations: Observations
    experience: PickUpExperience

    async def flush(self) -> None:
        """Wait until all events recorded so far are stored and visible. Raises as `Memory.flush` does."""
        position = self.queue.written
        await self.queue.synced_to(position)
        await self.writer.flush(position)

    @contextmanager
    def in_context(self) -> Iterator[None]:
        """Record plans and worlds of this context, and give its plans the experience of this memory."""
        with ExitStack() as stack:
            for variable, value in self._variables():
                stack.enter_context(set_inside(variable, value))
            yield

    @contextmanager
    def in_process(self) -> Iterator[None]:
        """Do so for all contexts of this process that have no memory of their own."""
        for variable, value in self._variables():
            variable.connect(value)
        try:
            yield
        finally:
            for variable, value in self._variables():
                variable.disconnect(value)

    def _variables(self) -> tuple[tuple[ConnectedVar[Any], object], ...]:
        return (
            (recorder, self.recorder),
            (watcher, self.recorder),
            (called_performs, self.recorder.calls),
            (experience, self.experience),
            (observations, self.observations),
        )


class PartsHolder:
    """A memory as its methods see it: with parts while it is open."""

    _parts: Parts | None
    _clock: Clock
    _address: DatabaseAddress
    _located: DatabaseAddress

    @property
    def _open_parts(self) -> Parts:
        if self._parts is None:
            raise CallerError("this memory is not open: use `async with Memory.open(url) as memory`")
        return self._parts


class MemoryStatus(NamedTuple):
    """The state of a memory.

    Attributes:
        written, synced, stored: positions up to which records survive a killed process, survive a power loss, and are
            in the database.
        bytes_spooled: the size of the queue on disk.
        faults: events that the hooks failed to record, and performs that were never awaited.
        unawaited: one sentence for each designator type whose perform was called but never awaited.
        missing: the number of values that could not be recorded, and the reason of the last.
        samples_left_out, episodes_continued: the number of samples dropped for lack of space, and of episodes that were
            continued in a follow-up episode.
        folded: position up to which records are visible, as reported by the daemon; None with a writer thread.
        drained: whether a process drains the queue now.
        writer: the state of the writer thread; None with a daemon.
        unadopted: by folder of a dead recorder that could not be recovered, the error.
        spool_fault: the last fault of the queue's files (a failed sync; deleted or replaced files, and the folder in
            which recording continues); None without one.
        spool_lost: the records lost with deleted files, one line for each run of positions.
        declarations_unrepeated: the number of declarations that one segment contains and the later ones had no space
            to repeat: if the log goes back, their episodes can be healed only while that segment is kept.
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
        """Collect the present state of the memory with these parts."""
        queue, emitter, recorder = parts.queue, parts.emitter, parts.recorder
        drain_status = queue.external_drain_status
        return cls(
            written=queue.written,
            synced=queue.synced,
            stored=queue.stored,
            bytes_spooled=queue.bytes_spooled,
            folded=None if drain_status is None else drain_status.folded,
            drained=queue.is_drained,
            faults=emitter.faults,
            unawaited=emitter.unawaited,
            missing=emitter.missing.count,
            samples_left_out=recorder.samples_left_out,
            episodes_continued=recorder.episodes.continued_count,
            writer=parts.writer.state if isinstance(parts.writer, WriterThread) else None,
            unadopted=dict(unadopted),
            spool_fault=queue.setback,
            spool_lost=queue.lost,
            declarations_unrepeated=queue.declarations_unrepeated,
        )
