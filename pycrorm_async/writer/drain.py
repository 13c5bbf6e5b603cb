"""Moves records from one source into the log: read, append, acknowledge, in that order only.

Killed or cancelled anywhere in between, the worst that follows is that a batch is appended a second time, which
stores it once. While the database is away the drain waits and the source keeps its records. What is refused is set
aside by the source before it is acknowledged, and is offered again by the next process. If that cannot be done, nothing
from the first such record on is ever acknowledged: a source forgets by position only, so this is how they are kept. The
source is told at once, for it can only fill up from then on; so it is when the drain ends with an error.
"""

from __future__ import annotations

import asyncio
import logging
import random
from collections.abc import Awaitable, Callable, Coroutine, Mapping, Sequence
from contextlib import suppress
from typing import Any, NamedTuple, TypeVar

from pycrorm_async.errors import DamageError, DatabaseUnavailable, FilesError
from pycrorm_async.events.envelope import Record
from pycrorm_async.events.ids import EpisodeId, episode_text
from pycrorm_async.settings import Settings
from pycrorm_async.writer.ports import Destination, Source
from pycrorm_async.writer.retry import PATIENT, Backoff, retry

__all__ = ["Drain", "DrainState", "run_to_completion"]

_log = logging.getLogger("pycrorm_async")
_T = TypeVar("_T")


class DrainState(NamedTuple):
    """How far a drain is, for status.

    Attributes:
        source: the recorder's name.
        records: appended so far, those that were there already included, refused ones not.
        batches: appended so far.
        retries: how often the database was away.
        away: why it is away at this moment; None if it is not.
        last_error: the latest of these reasons.
        appended: position of the last record the log was given.
        acknowledged: position up to which the source may forget.
        refused: by episode id, why records of it were refused.
    """

    source: str
    records: int
    batches: int
    retries: int
    away: str | None
    last_error: str | None
    appended: int
    acknowledged: int
    refused: Mapping[str, str]


class Drain:
    """One source on its way into one log. Belongs to the loop that runs it; `state` may be read from any thread."""

    def __init__(
        self,
        source: Source,
        destination: Destination,
        *,
        settings: Settings,
        backoff: Backoff = PATIENT,
        on_append: Callable[[], None] = lambda: None,
        say: Callable[[str], None] = _log.error,
        randomness: Callable[[], float] = random.random,
        sleep: Callable[[float], Awaitable[None]] = asyncio.sleep,
    ) -> None:
        self._source = source
        self._destination = destination
        self._settings = settings
        self._backoff = backoff
        self._on_append = on_append
        self._say = say
        self._randomness = randomness
        self._sleep = sleep
        self._records = self._batches = self._retries = 0
        self._away: str | None = None
        self._last_error: str | None = None
        self._appended = self._acknowledged = 0
        self._ceiling: int | None = None  # no position above it is acknowledged any more
        self._refused: dict[str, str] = {}
        self.stuck: FilesError | DamageError | None = None
        """Why refused records could not be set aside, so that nothing from them on is acknowledged any more."""
        self._moved = asyncio.Condition()
        self._over = False

    async def run(self) -> None:
        """Drains until the source is closed and empty.

        Raises what makes going on useless: `LogDamaged`, a damaged source, a database away after the last attempt.
        The source is told; the user is told by whoever this is raised to.
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
                self._batches += 1
                self._appended = batch[-1].position
                self._on_append()
                await self._tell()
        except Exception as error:
            self._source.fail(_stopped(error))
            raise
        finally:
            self._over = True
            await self._tell()

    async def abandon(self, error: Exception) -> None:
        """Instead of `run`, when it cannot be: who waits is told."""
        self._source.fail(_stopped(error))
        self._over = True
        await self._tell()

    async def reached(self, position: int) -> bool:
        """Waits until the log was given everything up to this position; False if the drain ended before."""
        async with self._moved:
            await self._moved.wait_for(lambda: self._over or self._appended >= position)
        return self._appended >= position

    @property
    def appended(self) -> int:
        """Position of the last record the log was given."""
        return self._appended

    @property
    def state(self) -> DrainState:
        return DrainState(
            source=self._source.name,
            records=self._records,
            batches=self._batches,
            retries=self._retries,
            away=self._away,
            last_error=self._last_error,
            appended=self._appended,
            acknowledged=self._acknowledged,
            refused=dict(self._refused),  # one step of the interpreter, so whole from any thread
        )

    async def _append(self, batch: Sequence[Record]) -> Mapping[EpisodeId, str]:
        refusals = await retry(
            lambda: run_to_completion(self._destination.append(batch)),
            backoff=self._backoff,
            on_away=self._note_away,
            randomness=self._randomness,
            sleep=self._sleep,
        )
        self._away = None
        return refusals

    def _note_away(self, error: DatabaseUnavailable) -> None:
        self._retries += 1
        self._away = self._last_error = str(error)

    async def _safe_position(self, batch: Sequence[Record], refusals: Mapping[EpisodeId, str]) -> int:
        """How far the source may forget now."""
        self._records += sum(1 for record in batch if record.episode not in refusals) if refusals else len(batch)
        refused = {episode_text(episode): reason for episode, reason in refusals.items()}
        if refused and self._ceiling is None:
            await self._set_aside([each for each in batch if each.episode in refusals], refused)
        self._refused = {**refused, **self._refused}
        return batch[-1].position if self._ceiling is None else self._ceiling

    async def _set_aside(self, records: Sequence[Record], refused: Mapping[str, str]) -> None:
        try:
            aside = await run_to_completion(asyncio.to_thread(self._source.dead_letter, records))
        except (FilesError, DamageError) as error:
            self._ceiling, self.stuck = records[0].position - 1, error
            episode, reason = next(iter(refused.items()))
            refusal = f"episode {episode} was refused: {reason}; its events cannot be set aside: {error}"
            self._say(f"nothing more is acknowledged to recorder {self._source.name}: {refusal}")
            self._source.fail(refusal)
            return
        if not aside:
            self._ceiling = records[0].position - 1
        for episode, reason in refused.items():
            if episode not in self._refused:
                kept = f"episode {episode} was refused: {reason}; its events are kept in the spool"
                self._say(f"recorder {self._source.name}: {kept}")

    async def _acknowledge(self, position: int) -> None:
        if position > self._acknowledged:
            await self._source.acknowledge(position)
            self._acknowledged = position

    async def _tell(self) -> None:
        async with self._moved:
            self._moved.notify_all()


def _stopped(error: Exception) -> str:
    return f"the writer stopped: {error}"


async def run_to_completion(work: Coroutine[Any, Any, _T]) -> _T:
    """Awaits work that is not to be left half done: a cancellation, or several, is passed on when it is finished."""
    task = asyncio.create_task(work)
    try:
        return await asyncio.shield(task)
    except asyncio.CancelledError:
        while not task.done():
            with suppress(asyncio.CancelledError):
                await asyncio.wait([task])
        if not task.cancelled():
            task.exception()  # seen; the cancellation counts for more
        raise
