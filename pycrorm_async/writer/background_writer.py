"""Drain one memory's queue as it fills, fold when a flush asks for it or the plan is idle, and drain dead recorders.

Appending runs beside the plan. Folding takes interpreter time from it, so it waits for an idle plan, a flush or the
end.
"""

from __future__ import annotations

import asyncio
import logging
import random
from collections.abc import Awaitable, Callable, Generator, Iterable, Iterator, Mapping
from typing import NamedTuple, TypeVar

from pycrorm_async.errors import DatabaseUnavailable, EpisodeParked, FlushTimeout, InternalError
from pycrorm_async.settings import Settings
from pycrorm_async.writer.drain import Drain, DrainState, run_to_completion
from pycrorm_async.writer.patience import TOO_MANY_EVENTS, Patience, PatienceEnded
from pycrorm_async.writer.ports import Destination, Source
from pycrorm_async.writer.retry import PATIENT, retry

_log = logging.getLogger("pycrorm_async")
_T = TypeVar("_T")


class WriterState(NamedTuple):
    """The writer's state, for status.

    Attributes:
        queue: the drain of this memory's own queue.
        adopted: the drains of dead recorders.
        failure: the reason why appending has stopped for good; None while it continues. The queue keeps its events on
            disk.
        fold_error: the reason why the last attempt to update the tables failed; None if it succeeded.
        adoption_errors: the dead recorders' folders that could not be drained, with the reasons.
    """

    queue: DrainState
    adopted: tuple[DrainState, ...]
    failure: str | None
    fold_error: str | None
    adoption_errors: tuple[str, ...]


class BackgroundWriter:
    """The writer of one memory. Runs in one loop, not in the plan's, because a plan may never suspend."""

    def __init__(
        self,
        source: Source,
        destination: Destination,
        *,
        adopt: Callable[[], Iterable[Source]],
        settings: Settings,
        randomness: Callable[[], float] = random.random,
    ) -> None:
        self._destination = destination
        self._adopt = adopt
        self._settings = settings
        self._randomness = randomness
        self._appended_events = asyncio.Event()
        self._drain = Drain(source, destination.append, settings=settings, on_append=self._note_append)
        self._adopted: list[Drain] = []
        self._adoption_errors: list[str] = []
        self._not_adopted: list[str] = []
        self._folding = asyncio.Lock()
        self._fold_error: str | None = None
        self._failure: Exception | None = None
        self._stopped_before: Mapping[str, str] = {}

    async def run(self) -> None:
        """Run until the queue is closed and drained and all events are folded.

        Raises the error that stopped appending, or `EpisodeParked` for episodes that stopped during the run.
        """
        try:
            self._stopped_before = await self._retry(self._destination.stopped)
        except Exception as error:
            self._note_failure(error)
            await self._drain.abandon(error)
            raise
        async with asyncio.TaskGroup() as tasks:
            background_tasks = [tasks.create_task(self._adopt_all(), name="pycrorm adopt")]
            if self._settings.fold == "idle":
                background_tasks.append(tasks.create_task(self._fold_when_idle(), name="pycrorm fold when idle"))
            try:
                await self._drain.run()
            except Exception as error:  # noqa: BLE001 - noted, and raised below and by every flush
                self._note_failure(error)
            finally:
                for each in background_tasks:
                    each.cancel()
        self._raise_failure()
        await self._fold()
        await self._raise_stopped()

    async def flush(self, position: int) -> None:
        """Wait until the records up to this position are stored and all stored events are visible in the tables.

        Raises the error that stopped appending, `EpisodeParked` for episodes that stopped since `run` began, and
        `FlushTimeout` after `flush_timeout_s` without progress.
        """
        patience = Patience(self._settings.flush_timeout_s, progress=lambda: self.progress)
        try:
            await patience.run(self._flush(position), name="pycrorm flush")
        except PatienceEnded:
            reason = self._drain.state.unavailable or self._fold_error or TOO_MANY_EVENTS
            raise FlushTimeout(patience.limit_s, reason) from None

    async def _flush(self, position: int) -> None:
        reached = await self._drain.reached(position)
        self._raise_failure()
        if not reached:
            raise InternalError(f"the queue ended before position {position}")
        await self._fold()
        await self._raise_stopped()

    @property
    def progress(self) -> tuple[int, int]:
        """A value that changes while the database accepts records; readable from any thread."""
        return self._drain.state.appended, self._destination.writes

    @property
    def state(self) -> WriterState:
        return WriterState(
            queue=self._drain.state,
            adopted=tuple(each.state for each in self._adopted),
            failure=None if self._failure is None else str(self._failure),
            fold_error=self._fold_error,
            adoption_errors=tuple(self._adoption_errors),
        )

    def _note_failure(self, error: Exception) -> None:
        """Note that appending has stopped for good; log it now, because the next flush may be far away."""
        self._failure = error
        _log.error("the writer stopped; recorded events are kept in the spool: %s", error)

    def _raise_failure(self) -> None:
        if self._failure is not None:
            raise self._failure

    async def _raise_stopped(self) -> None:
        stopped = {**self._drain.state.refused, **await self._retry(self._destination.stopped)}
        new_reasons = {episode: reason for episode, reason in stopped.items() if episode not in self._stopped_before}
        if new_reasons:
            raise EpisodeParked(new_reasons)

    async def _fold(self) -> None:
        async with self._folding:
            await self._retry(self._destination.confirm)
            await self._retry(self._destination.fold)

    async def _retry(self, operation: Callable[[], Awaitable[_T]]) -> _T:
        """Retry while the database is unavailable; the caller bounds the time."""
        result = await retry(
            operation, backoff=PATIENT, on_unavailable=self._mark_unavailable, randomness=self._randomness
        )
        self._fold_error = None
        return result

    def _note_append(self, _: object) -> None:
        self._appended_events.set()

    def _mark_unavailable(self, error: DatabaseUnavailable) -> None:
        self._fold_error = str(error)

    async def _fold_when_idle(self) -> None:
        self._appended_events.set()  # an earlier process may have left events unfolded
        while True:
            await self._appended_events.wait()
            self._appended_events.clear()
            try:
                async with asyncio.timeout(self._settings.idle_ms / 1000):
                    await self._appended_events.wait()
            except TimeoutError:
                try:
                    await self._fold()
                except Exception as error:  # noqa: BLE001 - in the state; the next flush raises it
                    self._fold_error = str(error)

    async def _adopt_all(self) -> None:
        # Recovering folders reads files; in a thread, so that it does not delay our own queue.
        sources: Iterator[Source] = iter(())
        try:
            sources = await run_to_completion(asyncio.to_thread(lambda: iter(self._adopt())))
            while (source := await run_to_completion(asyncio.to_thread(next, sources, None))) is not None:
                await self._drain_adopted(source)
        except Exception as error:  # noqa: BLE001 - in the state; must not stop our own queue
            self._adoption_errors.append(str(error))
        finally:
            if isinstance(sources, Generator):
                sources.close()  # releases the folder that the generator holds
            self._report_not_adopted()

    async def _drain_adopted(self, source: Source) -> None:
        drain = Drain(
            source,
            self._destination.append,
            settings=self._settings,
            on_append=self._note_append,
            report=self._not_adopted.append,
        )
        self._adopted.append(drain)
        try:
            await drain.run()
        except Exception as error:  # noqa: BLE001 - in the state; must not stop the next folder
            self._adoption_errors.append(f"{source.name}: {error}")
            self._not_adopted.append(f"recorder {source.name}: {error}")

    def _report_not_adopted(self) -> None:
        """Log one line for all failures, because the same records are refused at every start."""
        if self._not_adopted:
            more = len(self._not_adopted) - 1
            _log.error("%s%s", self._not_adopted[0], f" (and {more} more: see `pycrorm status`)" if more else "")
