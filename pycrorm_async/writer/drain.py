"""Move records from one source into the log: read, append, acknowledge, in this order only.

After a kill or a cancellation at any point, the worst case is that a batch is appended a second time; the log stores it
once. While the database is unavailable the drain retries and the source keeps its records.

The source keeps refused records as dead letters before the drain acknowledges them; the next process offers them again.
If the source cannot keep them, the drain acknowledges no position from the first such record on, because a source
deletes by position. From then on the source can only fill up, so the drain calls `fail`, which makes waiting producers
raise; it does the same when it ends with an error.
"""

from __future__ import annotations

import asyncio
import logging
import random
from collections.abc import Awaitable, Callable, Coroutine, Mapping, Sequence
from contextlib import suppress
from typing import Any, NamedTuple, TypeAlias, TypeVar

from pycrorm_async.errors import DamageError, DatabaseUnavailable, FilesError
from pycrorm_async.events.envelope import Record
from pycrorm_async.events.ids import EpisodeId, episode_text
from pycrorm_async.settings import Settings
from pycrorm_async.writer.ports import Source
from pycrorm_async.writer.retry import PATIENT, Backoff, retry

_log = logging.getLogger("pycrorm_async")
_T = TypeVar("_T")
Append: TypeAlias = Callable[[Sequence[Record]], Coroutine[Any, Any, Mapping[EpisodeId, str]]]
"""`Log.append`, or a function that calls it."""


class DrainState(NamedTuple):
    """The state of a drain, for status.

    Attributes:
        source: the recorder's name.
        records: number of appended records, with those stored before, without refused ones.
        batches: number of appended batches.
        retries: number of attempts at which the database was unavailable.
        unavailable: the reason why the database is unavailable at the moment; None if it is available.
        last_error: the latest of these reasons.
        appended: position of the last appended record.
        acknowledged: position up to which the source may delete records.
        refused: by episode id, the reason why the log refused records of it.
    """

    source: str
    records: int = 0
    batches: int = 0
    retries: int = 0
    unavailable: str | None = None
    last_error: str | None = None
    appended: int = 0
    acknowledged: int = 0
    refused: Mapping[str, str] = {}


class Drain:
    """A drain of one source into one log. Belongs to the loop that runs it; `state` is readable from any thread.

    Calls `append` with each batch, and `on_append` when the batch is acknowledged.
    """

    def __init__(
        self,
        source: Source,
        append: Append,
        *,
        settings: Settings,
        backoff: Backoff = PATIENT,
        on_append: Callable[[Sequence[Record]], None] = lambda _: None,
        report: Callable[[str], None] = _log.error,
        randomness: Callable[[], float] = random.random,
        sleep: Callable[[float], Awaitable[None]] = asyncio.sleep,
    ) -> None:
        self._source = source
        self._append_records = append
        self._settings = settings
        self._backoff = backoff
        self._on_append = on_append
        self._report = report
        self._randomness = randomness
        self._sleep = sleep
        self.state = DrainState(source.name)  # replaced in one step, because any thread may read it
        self._acknowledge_max: int | None = None  # no position above it is acknowledged
        self.stuck: FilesError | DamageError | None = None
        """Why the source could not keep refused records; no position from them on is acknowledged."""
        self._changed = asyncio.Condition()
        self._finished = False

    async def run(self) -> None:
        """Drain until the source is closed and empty.

        Raises `LogDamaged`, the error of a damaged source, and `DatabaseUnavailable` after the last attempt. Calls the
        source's `fail` first; reporting the error to the user is up to the caller.
        """
        settings = self._settings
        try:
            while batch := await self._source.get_batch(
                events_max=settings.batch_events_max,
                bytes_max=settings.batch_bytes_max,
                age_s_max=settings.batch_age_ms / 1000,
            ):
                refusals = await self._append(batch)
                await self._acknowledge(await self._safe_position(batch, refusals))
                name, batches = self._source.name, self.state.batches + 1  # a queue that moves gets another name
                self.state = self.state._replace(source=name, batches=batches, appended=batch[-1].position)
                self._on_append(batch)
                await self._notify()
        except Exception as error:
            self._source.fail(_failure_reason(error))
            raise
        finally:
            self._finished = True
            await self._notify()

    async def abandon(self, error: Exception) -> None:
        """End the drain without running it: fail the source and wake the waiters."""
        self._source.fail(_failure_reason(error))
        self._finished = True
        await self._notify()

    async def reached(self, position: int) -> bool:
        """Wait until the records up to this position are appended; False if the drain ended before."""
        async with self._changed:
            await self._changed.wait_for(lambda: self._finished or self.state.appended >= position)
        return self.state.appended >= position

    async def _append(self, batch: Sequence[Record]) -> Mapping[EpisodeId, str]:
        refusals = await retry(
            lambda: run_to_completion(self._append_records(batch)),
            backoff=self._backoff,
            on_unavailable=self._mark_unavailable,
            randomness=self._randomness,
            sleep=self._sleep,
        )
        self.state = self.state._replace(unavailable=None)
        return refusals

    def _mark_unavailable(self, error: DatabaseUnavailable) -> None:
        self.state = self.state._replace(retries=self.state.retries + 1, unavailable=str(error), last_error=str(error))

    async def _safe_position(self, batch: Sequence[Record], refusals: Mapping[EpisodeId, str]) -> int:
        """Keep the refused records of a batch; return the position that may be acknowledged."""
        appended = sum(1 for record in batch if record.episode not in refusals) if refusals else len(batch)
        refused = {episode_text(episode): reason for episode, reason in refusals.items()}
        if refused and self._acknowledge_max is None:
            await self._keep_refused([each for each in batch if each.episode in refusals], refused)
        refused |= self.state.refused
        self.state = self.state._replace(records=self.state.records + appended, refused=refused)
        return batch[-1].position if self._acknowledge_max is None else self._acknowledge_max

    async def _keep_refused(self, records: Sequence[Record], refused: Mapping[str, str]) -> None:
        try:
            kept_elsewhere = await run_to_completion(asyncio.to_thread(self._source.dead_letter, records))
        except (FilesError, DamageError) as error:
            self._acknowledge_max, self.stuck = records[0].position - 1, error
            episode, reason = next(iter(refused.items()))
            refusal = f"episode {episode} was refused: {reason}; its events cannot be kept as dead letters: {error}"
            self._report(f"recorder {self._source.name} gets no further acknowledgements: {refusal}")
            self._source.fail(refusal)
            return
        if not kept_elsewhere:
            self._acknowledge_max = records[0].position - 1
        for episode, reason in refused.items():
            if episode not in self.state.refused:
                detail = f"episode {episode} was refused: {reason}; its events are kept in the spool"
                self._report(f"recorder {self._source.name}: {detail}")

    async def _acknowledge(self, position: int) -> None:
        if position > self.state.acknowledged:
            await self._source.acknowledge(position)
            self.state = self.state._replace(acknowledged=position)

    async def _notify(self) -> None:
        async with self._changed:
            self._changed.notify_all()


def _failure_reason(error: Exception) -> str:
    return f"the writer stopped: {error}"


async def run_to_completion(work: Coroutine[Any, Any, _T]) -> _T:
    """Await work that must not be interrupted; raise a cancellation only after the work has finished."""
    task = asyncio.create_task(work)
    try:
        return await asyncio.shield(task)
    except asyncio.CancelledError:
        while not task.done():
            with suppress(asyncio.CancelledError):
                await asyncio.wait([task])
        if not task.cancelled():
            task.exception()  # retrieved, so that asyncio does not log it; the cancellation wins
        raise
