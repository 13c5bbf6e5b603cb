"""The writer of one memory: drains its queue as it fills, folds when asked or idle, adopts what the dead left.

Appending goes on beside the plan; folding costs interpreter time, so it waits until the plan is idle, flushes or ends.
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
from pycrorm_async.writer.patience import Patience
from pycrorm_async.writer.ports import Destination, Source
from pycrorm_async.writer.retry import PATIENT, retry

__all__ = ["LiveWriter", "WriterState"]

_log = logging.getLogger("pycrorm_async")
_T = TypeVar("_T")


class WriterState(NamedTuple):
    """What the writer does, for status.

    Attributes:
        queue: the drain of this memory's own queue.
        adopted: the drains of what dead recorders left.
        failure: why appending stopped for good; None while it goes on. The queue keeps its events on disk.
        fold_error: why the tables could not be brought up to date the last time; None if they could.
        adoption_errors: folders that could not be adopted, and why.
    """

    queue: DrainState
    adopted: tuple[DrainState, ...]
    failure: str | None
    fold_error: str | None
    adoption_errors: tuple[str, ...]


class LiveWriter:
    """Runs in one loop, which should not be the plan's: a plan may never suspend."""

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
        self._news = asyncio.Event()
        self._drain = Drain(source, destination, settings=settings, on_append=self._news.set)
        self._adopted: list[Drain] = []
        self._adoption_errors: list[str] = []
        self._not_adopted: list[str] = []
        self._folding = asyncio.Lock()
        self._fold_error: str | None = None
        self._failure: Exception | None = None
        self._stopped_before: Mapping[str, str] = {}

    async def run(self) -> None:
        """Until the queue is closed and drained and everything is folded.

        Raises what stopped the appending, or `EpisodeParked` for episodes that stopped since this began.
        """
        try:
            self._stopped_before = await self._patiently(self._destination.stopped)
        except Exception as error:
            self._stop(error)
            await self._drain.abandon(error)
            raise
        async with asyncio.TaskGroup() as tasks:
            others = (
                tasks.create_task(self._fold_when_idle(), name="pycrorm fold when idle"),
                tasks.create_task(self._adopt_all(), name="pycrorm adopt"),
            )
            try:
                await self._drain.run()
            except Exception as error:  # noqa: BLE001 - kept, and raised below and at every flush
                self._stop(error)
            finally:
                for each in others:
                    each.cancel()
        self._raise_failure()
        await self._fold()
        await self._raise_stopped()

    async def flush(self, position: int) -> None:
        """Returns when everything up to this position is stored and the tables show all that is stored.

        Raises what stopped the appending, `EpisodeParked` for episodes that stopped since `run` began, and
        `FlushTimeout` after `flush_timeout_s` without progress.
        """
        timeout_s = self._settings.flush_timeout_s
        flushing = asyncio.create_task(self._flush(position), name="pycrorm flush")
        try:
            if not await Patience(timeout_s, progress=lambda: self.progress).wait(flushing):
                raise FlushTimeout(self._not_in_time(timeout_s))
            flushing.result()
        finally:
            if not flushing.done():
                flushing.cancel()
                await asyncio.wait([flushing])

    async def _flush(self, position: int) -> None:
        reached = await self._drain.reached(position)
        self._raise_failure()
        if not reached:
            raise InternalError(f"the queue ended before position {position}")
        await self._fold()
        await self._raise_stopped()

    @property
    def progress(self) -> tuple[int, int]:
        """Grows while the database takes what it is given; from any thread."""
        return self._drain.appended, self._destination.writes

    @property
    def state(self) -> WriterState:
        return WriterState(
            queue=self._drain.state,
            adopted=tuple(each.state for each in self._adopted),
            failure=None if self._failure is None else str(self._failure),
            fold_error=self._fold_error,
            adoption_errors=tuple(self._adoption_errors),
        )

    def _not_in_time(self, timeout_s: float) -> str:
        reason = self._drain.state.away or self._fold_error or "there was too much to store and fold"
        return f"not finished after {timeout_s:g} s ({reason}); everything recorded is safe in the spool"

    def _stop(self, error: Exception) -> None:
        """For good. Said at once: the next flush may be far away."""
        self._failure = error
        _log.error("the writer stopped, and what is recorded is kept in the spool: %s", error)

    def _raise_failure(self) -> None:
        if self._failure is not None:
            raise self._failure

    async def _raise_stopped(self) -> None:
        stopped = {**self._drain.state.refused, **await self._patiently(self._destination.stopped)}
        news = {episode: reason for episode, reason in stopped.items() if episode not in self._stopped_before}
        if news:
            raise EpisodeParked(news)

    async def _fold(self) -> None:
        async with self._folding:
            await self._patiently(self._destination.confirm)
            await self._patiently(self._destination.fold)

    async def _patiently(self, ask: Callable[[], Awaitable[_T]]) -> _T:
        """Asks again while the database is away; the caller bounds the time."""
        answer = await retry(ask, backoff=PATIENT, on_away=self._note_away, randomness=self._randomness)
        self._fold_error = None
        return answer

    def _note_away(self, error: DatabaseUnavailable) -> None:
        self._fold_error = str(error)

    async def _fold_when_idle(self) -> None:
        self._news.set()  # something may have been left behind before
        while True:
            await self._news.wait()
            self._news.clear()
            try:
                async with asyncio.timeout(self._settings.idle_ms / 1000):
                    await self._news.wait()
            except TimeoutError:
                await self._fold_once()

    async def _fold_once(self) -> None:
        try:
            await self._fold()
        except Exception as error:  # noqa: BLE001 - shown in the state; the next flush meets and raises it
            self._fold_error = str(error)

    async def _adopt_all(self) -> None:
        # Finding and recovering folders reads files: in a thread, so that our own queue does not wait for it.
        sources: Iterator[Source] = iter(())
        try:
            sources = await run_to_completion(asyncio.to_thread(lambda: iter(self._adopt())))
            while (source := await run_to_completion(asyncio.to_thread(next, sources, None))) is not None:
                await self._drain_adopted(source)
        except Exception as error:  # noqa: BLE001 - shown in the state; another's folder does not stop our own queue
            self._adoption_errors.append(str(error))
        finally:
            if isinstance(sources, Generator):
                sources.close()  # so that it lets go of the folder it is at
            self._tell_not_adopted()

    async def _drain_adopted(self, source: Source) -> None:
        drain = Drain(
            source,
            self._destination,
            settings=self._settings,
            on_append=self._news.set,
            say=self._not_adopted.append,
        )
        self._adopted.append(drain)
        try:
            await drain.run()
        except Exception as error:  # noqa: BLE001 - shown in the state; the next folder may be in order
            self._adoption_errors.append(f"{source.name}: {error}")
            self._not_adopted.append(f"recorder {source.name}: {error}")

    def _tell_not_adopted(self) -> None:
        """In one line: what was refused once is offered, and refused, at every start."""
        if self._not_adopted:
            more = len(self._not_adopted) - 1
            _log.error("%s%s", self._not_adopted[0], f" (and {more} more: see `pycrorm status`)" if more else "")
