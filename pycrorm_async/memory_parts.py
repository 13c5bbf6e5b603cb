"""The parts of an open memory, and its state. Those that record plans, read or recall are made when they are used.

A memory reaches plans and worlds by variables (`connected_var`). While the plan layer is not loaded they hold late
values, so that a program which records another executive loads no plan, no world and no query.
"""

from __future__ import annotations

import asyncio
import sys
import threading
from collections.abc import Callable, Iterator, Mapping
from contextlib import ExitStack, contextmanager
from typing import TYPE_CHECKING, Any, Final, Generic, NamedTuple, Self, TypeVar

from pycrorm_async import connected_var, record
from pycrorm_async import projections as folding
from pycrorm_async import query as reading_side
from pycrorm_async import recall as recalling
from pycrorm_async.clock import Clock
from pycrorm_async.connected_var import ConnectedVar, Late, set_inside
from pycrorm_async.errors import PycrormError
from pycrorm_async.queue.recorder_queue import RecorderQueue
from pycrorm_async.record.episode_writer import Emitter, Faults, OpenEpisodes
from pycrorm_async.record.recording import Recording
from pycrorm_async.record.values import Missing
from pycrorm_async.store.address import DatabaseAddress
from pycrorm_async.writer.plan_writer import DelegatedWriter, WriterState, WriterThread

if TYPE_CHECKING:
    from pycrorm_async.events.types import DesignatorTypeDeclared
    from pycrorm_async.operations import WriterProcess, WriterProcessState
    from pycrorm_async.query import Reading
    from pycrorm_async.recall import PickUpExperience, Recall
    from pycrorm_async.record import Recorder

T = TypeVar("T")


def built_in_declaration(dtype: str) -> DesignatorTypeDeclared | None:
    """Return the declaration of the plan layer's own type with this dtype; other names do not load the plan layer."""
    is_built_in = any(each.dtype == dtype for each in folding.SCHEMA.leaves)
    return record.built_in_declaration(dtype) if is_built_in else None


class _part(Generic[T]):  # noqa: N801  used as a decorator
    """A part that is made when it is first read, once, although several threads may read it."""

    def __init__(self, make: Callable[[Any], T]) -> None:
        self._make = make
        self._name = make.__name__
        self.__doc__ = make.__doc__

    def __get__(self, parts: Parts, owner: type) -> T:
        with parts.lock:
            if self._name not in vars(parts):
                vars(parts)[self._name] = self._make(parts)  # which is found before this descriptor from now on
        part: T = vars(parts)[self._name]
        return part


class Parts:
    """The parts of an open memory, to which plans are connected in one context or in the whole process.

    Those that record plans, read or recall are made when they are first used, because a program that records another
    executive needs none of them.
    """

    def __init__(
        self,
        address: DatabaseAddress,
        queue: RecorderQueue,
        writer: WriterThread | DelegatedWriter,
        recording: Recording,
        clock: Clock,
        process: WriterProcess | None = None,
        replica: DatabaseAddress | None = None,
    ) -> None:
        self.queue = queue
        self.writer = writer
        self.recording = recording
        self.process = process
        self.emitter: Final[Emitter] = recording.emitter
        self.episodes: Final[OpenEpisodes] = recording.episodes
        self.lock = threading.RLock()  # a finalizer may read a part while this thread makes one
        self._address = address
        self._replica = replica
        self._clock = clock

    @_part
    def recorder(self) -> Recorder:
        """The recorder of our own plan layer."""
        return record.Recorder(self.recording)

    @_part
    def reading(self) -> Reading:
        """The reading side, which opens the database at its first query."""
        return reading_side.Reading(self._address, replica=self._replica, follows=True)

    @_part
    def recall(self) -> Recall:
        """The past actions of the database and of this process."""
        running = recalling.ProcessCases(
            self.emitter,
            open_episodes=lambda: [*self.episodes.by_id],
            flush=self.flush,
            log=self.reading.log,
            clock=self._clock,
        )
        reader = recalling.CaseReader(recalling.DatabaseSource(self.reading), running)
        return recalling.Recall(reader, self.reading, self._clock)

    @_part
    def experience(self) -> PickUpExperience:
        """The experience that location designators ask."""
        experience = recalling.PickUpExperience(self.reading, lambda: self.recall.reader)
        experience.is_closed = self.emitter.is_closed
        return experience

    def made(self, name: str) -> Any:
        """Return the part of this name if it was used; None otherwise."""
        return vars(self).get(name)

    async def flush(self) -> None:
        """Wait until all events recorded so far are stored and visible. Raises the errors of `Memory.flush`."""
        position = self.queue.written
        await self.queue.synced_to(position)
        await self.writer.flush(position)

    def close(self, error: BaseException | None) -> None:
        """End the open episodes and record nothing more."""
        recorder: Recorder | None = self.made("recorder")
        self.episodes.refuse_new()
        for episode in self.episodes.all:
            (recorder.close_episode if recorder is not None else self.episodes.close)(
                episode, error or asyncio.CancelledError("the memory was closed")
            )
        self.disconnect()
        if recorder is not None:
            recorder.close()

    def disconnect(self, *because: str) -> None:
        """Record nothing more, and answer no plan."""
        self.emitter.close(*because)
        if (experience := self.made("experience")) is not None:
            experience.is_closed = True

    async def close_reading(self) -> None:
        """Close the connections of the reading side, if it was used."""
        if (reading := self.made("reading")) is not None:
            await reading.close()

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
        variables = self._variables()
        for variable, value in variables:
            variable.connect(value)
        try:
            yield
        finally:
            for variable, value in variables:
                variable.disconnect(value)

    def _variables(self) -> tuple[tuple[ConnectedVar[Any], object], ...]:
        def late(make: Callable[[], object]) -> Late[object]:
            return Late(make, lambda: self.emitter.is_closed)

        recorder: object
        calls: object
        if "pycrorm_async.plan.execution" in sys.modules:  # plans read what is made already a little faster
            recorder, calls = self.recorder, self.recorder.calls
        else:
            recorder, calls = late(lambda: self.recorder), late(lambda: self.recorder.calls)
        return (
            (connected_var.plan_observer, recorder),
            (connected_var.world_watcher, recorder),
            (connected_var.called_performs, calls),
            (connected_var.experience, late(lambda: self.experience)),
        )


def _reported(state: Any) -> str:
    """Return a state as text, without fields that are None, 0 or empty; False counts."""
    if not hasattr(state, "_asdict"):
        return repr(state)
    fields = ((name, each) for name, each in state._asdict().items() if each or each is False)
    shown = (f"{name}={_reported(each)}" for name, each in fields if not isinstance(each, tuple) or any(each))
    return f"{type(state).__name__}({', '.join(shown)})"


class MemoryStatus(NamedTuple):
    """The state of a memory.

    Attributes:
        written, synced, stored: positions up to which records survive a killed process, survive a power loss, and are
            in the database.
        bytes_spooled: the size of the queue on disk.
        faults: events that the hooks failed to record, and performs that were never awaited.
        unawaited: one sentence for each designator type whose perform was called but never awaited.
        missing: the number of values that could not be recorded, and the reason of the last.
        samples_left_out: the number of samples dropped for lack of space.
        folded: position up to which records are visible, as reported by the daemon or the writer process; None with a
            writer thread.
        drained: whether a process drains the queue now, or the writer process is running.
        writer: the state of the writer thread; None with a daemon and with a process.
        unadopted: by folder of a dead recorder that could not be recovered, the error.
        spool_fault: the fault of the queue's files that ended the recording (a failed sync, or deleted or replaced
            files); None if there is none.
        spool_lost: the positions of the records that deleted or replaced files took before they were stored, one line.
        declarations_unrepeated: the number of declarations that one segment contains and the later ones had no space
            to repeat: if the log goes back, their episodes can be healed only while that segment is kept.
        unrecorded: the number of nodes, episodes and other reports that came after the memory was closed, or in a
            forked child.
        writer_process: the state of the memory's own writer process; None without one.
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
    writer: WriterState | None
    unadopted: Mapping[str, PycrormError]
    spool_fault: str | None
    spool_lost: tuple[str, ...]
    declarations_unrepeated: int
    unrecorded: int = 0
    writer_process: WriterProcessState | None = None

    def __repr__(self) -> str:
        """Leave out the fields that report nothing, so that a fault is seen."""
        return _reported(self)

    @classmethod
    def of(cls, parts: Parts, unadopted: Mapping[str, PycrormError]) -> Self:
        """Collect the present state of the memory with these parts."""
        queue, emitter, recorder = parts.queue, parts.emitter, parts.made("recorder")
        drain_status = queue.external_drain_status
        return cls(
            written=queue.written,
            synced=queue.synced,
            stored=queue.stored,
            bytes_spooled=queue.bytes_spooled,
            folded=None if drain_status is None else drain_status.folded,
            drained=queue.is_drained if isinstance(parts.writer, WriterThread) else parts.writer.is_drained,
            faults=emitter.faults,
            unawaited=emitter.unawaited,
            missing=emitter.missing.count,
            samples_left_out=recorder.samples_left_out if recorder is not None else 0,
            writer=parts.writer.state if isinstance(parts.writer, WriterThread) else None,
            unadopted=dict(unadopted),
            spool_fault=None if queue.failure is None else str(queue.failure),
            spool_lost=queue.lost,
            declarations_unrepeated=queue.declarations_unrepeated,
            unrecorded=emitter.unrecorded,
            writer_process=None if parts.process is None else parts.process.state,
        )
