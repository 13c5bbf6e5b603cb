"""Hold the parts of an open memory and connect plans to them, in one context or in the whole process."""

from __future__ import annotations

from collections.abc import Iterator
from contextlib import ExitStack, contextmanager
from typing import Any, NamedTuple

from pycrorm_async.clock import Clock
from pycrorm_async.connected_var import ConnectedVar, set_inside
from pycrorm_async.errors import CallerError
from pycrorm_async.hooks.observations import Observations
from pycrorm_async.hooks.plan_recorder import Recorder
from pycrorm_async.plan.execution.observer import recorder
from pycrorm_async.plan.execution.unawaited_performs import called_performs
from pycrorm_async.plan.experience import experience
from pycrorm_async.query.reading import Reading
from pycrorm_async.queue.live.delegated_writer import DelegatedWriter
from pycrorm_async.queue.live.recorder_queue import RecorderQueue
from pycrorm_async.recall.experience import PickUpExperience
from pycrorm_async.recording.recording import Recording
from pycrorm_async.recording.writing.emitter import Emitter
from pycrorm_async.store.address import DatabaseAddress
from pycrorm_async.world.observers import watcher
from pycrorm_async.writer.writer_thread import WriterThread

__all__ = ["Parts", "PartsHolder"]


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
