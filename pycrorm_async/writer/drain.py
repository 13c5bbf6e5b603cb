"""Move records from one source into the log: read, append, acknowledge, in this order only.

After a kill or a cancellation at any point, the worst case is that a batch is appended a second time; the log stores it
once. While the database is unavailable the drain retries and the source keeps its records.

The source keeps refused records as dead letters before the drain acknowledges them; the next process offers them again.
If the source cannot keep them, the drain acknowledges no position from the first such record on, because a source
deletes by position. From then on the source can only fill up, so the drain calls `fail`, which makes waiting producers
raise; it does the same when it ends with an error.

**Retry.** Retry a database operation while the database is unavailable, with the pauses of a `Backoff`.

>>> folded = await retry(destination.fold, backoff=BRIEF)

**Patience.** Wait for work as long as it makes progress: bound the time without progress, not the work.

>>> patience = Patience(15.0, progress=lambda: writer.progress)
>>> if not await patience.wait(closing):
...     raise FlushTimeout(15.0, TOO_MANY_EVENTS)
"""

from __future__ import annotations

import asyncio
import logging
import random
import types
from collections.abc import Awaitable, Callable, Collection, Coroutine, Generator, Iterable, Mapping, Sequence
from contextlib import suppress
from dataclasses import dataclass
from functools import partial
from pathlib import Path
from typing import Any, Final, NamedTuple, Protocol, TypeAlias, TypeVar

from pycrorm_async import errors
from pycrorm_async.events.codec import Record
from pycrorm_async.events.ids import EpisodeId, episode_text
from pycrorm_async.settings import Settings

# === retry ====================================================================================================


async def retry(
    operation: Callable[[], Awaitable[_T]],
    *,
    backoff: Backoff,
    on_unavailable: Callable[[errors.DatabaseUnavailable], None] = lambda _: None,
    randomness: Callable[[], float] = random.random,
    sleep: Callable[[float], Awaitable[None]] = asyncio.sleep,
) -> _T:
    """Return the operation's result. Calls `on_unavailable` after each failed attempt; raises the last one's error."""
    attempt = 0
    while True:
        try:
            return await operation()
        except errors.DatabaseUnavailable as error:
            attempt += 1
            on_unavailable(error)
            pause_s = backoff.pause_s(attempt, randomness())
            if pause_s is None:
                raise
        await sleep(pause_s)


@dataclass(frozen=True, kw_only=True, slots=True)
class Backoff:
    """A policy for retries; with `attempts_max` None they never end."""

    first_s: float
    longest_s: float
    attempts_max: int | None = None

    def pause_s(self, attempt: int, randomness: float) -> float | None:
        """Return the pause after failed attempt 1, 2, 3 …; None to stop. `randomness`, 0 to 1, gives half to full."""
        if self.attempts_max is not None and attempt >= self.attempts_max:
            return None
        doublings = min(attempt - 1, 30)  # bounded, because the power would overflow after some days
        pause_s: float = min(self.longest_s, self.first_s * 2**doublings)
        return pause_s * (1 + randomness) / 2


PATIENT = Backoff(first_s=0.1, longest_s=10.0)
"""The backoff of writers: retries never end, because the queue keeps recording events on disk."""

BRIEF = Backoff(first_s=0.1, longest_s=1.0, attempts_max=5)
"""The backoff of commands that a user waits for: five attempts."""


# === drain ====================================================================================================

_log = logging.getLogger("pycrorm_async")
BATCH_BYTES_MAX: Final = 4 * 2**20
"""Bounds the payloads of a batch, and with them the memory and the time of one append."""
_BATCH_AGE_S: Final = 0.05
"""Bounds the time for which a batch gathers events: a transaction for each event would cost more than the wait."""
_T = TypeVar("_T")
Append: TypeAlias = Callable[[Sequence[Record], Callable[[], None]], Coroutine[Any, Any, Mapping[EpisodeId, str]]]
"""`Destination.append`, or a function that calls it."""


class DrainState(NamedTuple):
    """The state of a drain, for status.

    Attributes:
        source: the recorder's name.
        records: number of appended records. Records that the log already had count too, refused ones do not.
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

    Calls `append` with each batch, and `on_append` when the batch is acknowledged. Reads the next batch while a server
    stores this one.
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
        self.stuck: errors.FilesError | errors.DamageError | None = None
        """Why the source could not keep refused records; no position from them on is acknowledged."""
        self._changed = asyncio.Condition()
        self._finished = False
        self._reading: asyncio.Task[Sequence[Record]] | None = None

    async def run(self) -> None:
        """Drain until the source is closed and empty.

        Raises `LogDamaged`, the error of a damaged source, and `DatabaseUnavailable` after the last attempt. Calls the
        source's `fail` first; reporting the error to the user is up to the caller.
        """
        try:
            while batch := await self._next_batch():
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
            if self._reading is not None:
                self._reading.cancel()
                await asyncio.gather(self._reading, return_exceptions=True)
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

    async def _next_batch(self) -> Sequence[Record]:
        self._read_ahead()
        reading, self._reading = self._reading, None
        assert reading is not None
        return await reading

    def _read_ahead(self) -> None:
        """Begin to read the next batch, also while the database stores this one."""
        if self._reading is None:
            batch = self._source.get_batch(
                events_max=self._settings.batch_events_max,
                bytes_max=BATCH_BYTES_MAX,
                age_s_max=_BATCH_AGE_S,
            )
            self._reading = asyncio.create_task(batch, name="pycrorm read batch")

    async def _append(self, batch: Sequence[Record]) -> Mapping[EpisodeId, str]:
        refusals = await retry(
            lambda: run_to_completion(self._append_records(batch, self._read_ahead)),
            backoff=self._backoff,
            on_unavailable=self._mark_unavailable,
            randomness=self._randomness,
            sleep=self._sleep,
        )
        self.state = self.state._replace(unavailable=None)
        return refusals

    def _mark_unavailable(self, error: errors.DatabaseUnavailable) -> None:
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
        except (errors.FilesError, errors.DamageError) as error:
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


# === ports ====================================================================================================
#
# Define the writer's two ends: a source of synced records, and a log that stores them with the tables behind it.
#
# A writer beside a plan needs `Source` and `Destination`; a daemon needs `ClaimedSource` and `StepwiseDestination`; a
# plan that waits for a daemon needs `OfferedQueue`.


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
        One call waits at a time, also while the records of the call before are not acknowledged yet.
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


class Destination(Protocol):
    """The log in a database and the tables behind it."""

    async def append(
        self, records: Sequence[Record], on_wait: Callable[[], None] = lambda: None
    ) -> Mapping[EpisodeId, str]:
        """Append records, durable on return. Records stored before with the same bytes are stored once.

        Calls `on_wait` when a server stores them and this process waits for it; it may read the next records then.
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

    async def fold(self) -> int:
        """Fold all events of the log that are not folded yet; return their number.

        Parks an episode that it cannot fold. May be cancelled: committed folds stay, the next call folds the rest.
        """
        ...

    async def stopped(self) -> Mapping[str, str]:
        """Return the refused and parked episodes by id, with reasons, at a cost independent of the others."""
        ...


class StepwiseDestination(Destination, Protocol):
    """A destination that a daemon folds in steps while it appends."""

    @property
    def has_other_writers(self) -> bool:
        """Whether other processes may append and fold events at the same time, so that it has to look for them."""
        ...

    async def has_unfolded(self) -> bool:
        """Return whether events that this process should fold are not visible yet. Raises `DatabaseUnavailable`."""
        ...

    async def fold_next_batch(self) -> bool:
        """Fold one batch of events that are not visible yet; False if there was none.

        Parks an episode that it cannot fold. Raises `DatabaseUnavailable`; then the same call may be repeated.
        """
        ...

    async def behind(self) -> Mapping[str, int]:
        """Return the folded sequence, by id, of each episode with events that are not visible yet."""
        ...


class ClaimedSource(Source, Protocol):
    """One recorder's folder, claimed by a daemon: no other process drains it meanwhile."""

    @property
    def is_alive(self) -> bool:
        """True if the recorder lives in another process and may record more."""
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

    def mark_pending(self, reason: str | None) -> None:
        """Publish the reason why the tables do not show stored records; None when they do again."""
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
    def pending(self) -> str | None: ...
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


class SourceScanner(Protocol):
    """Claims the recorders' folders of a spool."""

    def is_due(self, but: Collection[str]) -> bool:
        """Return whether a scan may have another result than the last one. Takes microseconds."""
        ...

    def __call__(self, but: Collection[str]) -> ScanResult:
        """Claim every recorder's folder that can be drained, except those of these names. Reads files: blocks."""
        ...


# === drain once ===============================================================================================
#
# Drain every source to its end, then fold once, for `pycrorm writer --once`.


@dataclass(frozen=True, kw_only=True)
class DrainSummary:
    """The result of `drain_once`.

    Attributes:
        drained: one state per source, in the order of draining.
        failed: by source name, the reason why it could not be drained to its end, or its refused records not be kept.
        folded: number of folded events.
        stopped: by episode id, the reason why it is refused or parked; includes episodes refused whole, without a row.
        pending: the reason why the tables do not show what is stored.
    """

    drained: tuple[DrainState, ...]
    failed: Mapping[str, errors.PycrormError]
    folded: int
    stopped: Mapping[str, str]
    pending: str | None = None


async def drain_once(
    sources: Iterable[Source],
    destination: Destination,
    *,
    settings: Settings,
    on_append: Callable[[Source, Sequence[Record]], None] = lambda _source, _batch: None,
) -> DrainSummary:
    """Drain each source to its end, then fold. A damaged source does not prevent draining the others.

    Calls `on_append` with each acknowledged batch. Raises `DatabaseUnavailable` if the database stays unavailable for
    five attempts; stored events stay stored.
    """
    drained: list[DrainState] = []
    failed: dict[str, errors.PycrormError] = {}
    for source in sources:
        drain = Drain(
            source, destination.append, settings=settings, backoff=BRIEF, on_append=partial(on_append, source)
        )
        try:
            await drain.run()
        except errors.DatabaseError:
            raise
        except errors.PycrormError as error:
            failed[source.name] = error
        except Exception as error:  # noqa: BLE001 - reported for this source; must not stop the next
            failed[source.name] = errors.InternalError(f"recorder {source.name} cannot be drained: {error!r}")
        if drain.stuck is not None:
            failed[source.name] = drain.stuck
        drained.append(drain.state)
    await retry(destination.confirm, backoff=BRIEF)
    folded, pending = 0, None
    try:
        folded = await retry(destination.fold, backoff=BRIEF)
    except errors.TablesPending as error:
        pending = str(error)
    stopped = await retry(destination.stopped, backoff=BRIEF)
    refused = {episode: reason for each in drained for episode, reason in each.refused.items()}
    return DrainSummary(
        drained=tuple(drained), failed=failed, folded=folded, stopped={**refused, **stopped}, pending=pending
    )


# === patience =================================================================================================

_CHECK_S: Final = 0.25
"""Interval at which the progress is read, and the precision of the bound."""
TOO_MANY_EVENTS: Final = "more events than could be stored and folded in that time"
"""The reason of a `FlushTimeout` when nothing else is known to hold the writer up."""


class PatienceEnded(Exception):
    """The work made no progress for too long, and was cancelled."""


class Patience:
    """Ends a wait when `progress` has returned the same value for `limit_s`."""

    def __init__(self, limit_s: float, *, progress: Callable[[], object]) -> None:
        self.limit_s = limit_s
        self._progress = progress

    async def wait(self, work: asyncio.Future[Any]) -> bool:
        """Wait for the work; True when it is done, False after `limit_s` without progress. Cancels nothing."""
        loop = asyncio.get_running_loop()
        last, since_s = self._progress(), loop.time()
        while not work.done():
            left_s = since_s + self.limit_s - loop.time()
            if left_s <= 0:
                return False
            await asyncio.wait([work], timeout=min(left_s, _CHECK_S))
            if (current := self._progress()) != last:
                last, since_s = current, loop.time()
        return True

    async def run(self, work: Coroutine[Any, Any, _T], *, name: str) -> _T:
        """Run the work in a task of this name, which ends with this call; raises `PatienceEnded`."""
        task = asyncio.create_task(work, name=name)
        try:
            if not await self.wait(task):
                raise PatienceEnded
            return task.result()
        finally:
            if not task.done():
                task.cancel()
                await asyncio.wait([task])


class OpeningSteps:
    """Counts how often a coroutine resumed, because something that it had awaited was done: the progress of opening."""

    count = 0

    async def counted(self, work: Coroutine[Any, Any, _T]) -> _T:
        """Await the work and count its steps."""
        return await self._steps(work)

    @types.coroutine
    def _steps(self, work: Coroutine[Any, Any, _T]) -> Generator[Any, Any, _T]:
        resume: Callable[[], Any] = partial(work.send, None)
        while True:
            try:
                awaited = resume()
            except StopIteration as done:
                result: _T = done.value
                return result
            self.count += 1
            try:
                yield awaited
            except BaseException as error:  # noqa: BLE001  a cancellation, which the work meets where it waits
                resume = partial(work.throw, error)
            else:
                resume = partial(work.send, None)
