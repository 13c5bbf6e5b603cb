"""Read synced records back from the folder of a live queue, in order, for the queue's one consumer.

The source belongs to one task of one loop. The sync thread may move the queue to another folder at any time
(`relocation.py`) and publishes the new `Place`. The source switches to it at its next step and continues behind its
position. When a read fails, the source first asks the sync thread to check its files; if the queue then has moved,
the source repeats the read in the new folder.
"""

from __future__ import annotations

import asyncio
import contextlib
from collections.abc import Sequence
from functools import partial

from pycrorm_async.errors import SpoolDamaged, SpoolUnavailable
from pycrorm_async.events.envelope import Record
from pycrorm_async.queue.files.locks import FileLock
from pycrorm_async.queue.files.names import DRAIN
from pycrorm_async.queue.files.reader import Batch, Reader
from pycrorm_async.queue.files.recorder_folder import wrap_os_errors
from pycrorm_async.queue.live.notifier import Notifier
from pycrorm_async.queue.live.queue_files import QueueFiles
from pycrorm_async.queue.sources.dead_letters import DeadLetters


class OwnSource:
    """The consumer's side of a queue; it holds the lock `drain` from its first batch on."""

    def __init__(self, queue: QueueFiles, notifier: Notifier) -> None:
        self._queue = queue
        self._notifier = notifier
        self._place = queue.place
        self._drain: FileLock | None = None
        self._released = False
        self._dead_letters = DeadLetters(self._place.folder)
        self.reader = Reader(self._place)

    @property
    def drains(self) -> bool:
        return self._drain is not None

    async def get_batch(self, *, events_max: int, bytes_max: int, age_s_max: float) -> list[Record]:
        """Implement `RecorderQueue.get_batch`."""
        while True:
            try:
                self._switch_folder()
                return await self._batch(events_max=events_max, bytes_max=bytes_max, age_s_max=age_s_max)
            except (SpoolDamaged, SpoolUnavailable) as error:
                if error is self._queue.failure:
                    raise
                if self._queue.place is self._place:
                    await self._queue.check_files()
                if self._queue.place is self._place:
                    raise self._queue.failure or error from None

    def dead_letter(self, records: Sequence[Record]) -> None:
        """Implement `RecorderQueue.dead_letter`."""
        self._dead_letters.put(records)

    def release(self) -> None:
        """Close the files and release the locks. Idempotent."""
        self._released = True
        self.reader.close()
        self._dead_letters.release()
        if self._drain is not None:
            self._drain.release()

    def _switch_folder(self) -> None:
        """Continue in the queue's current folder, behind the last position; records lost in between are skipped."""
        place = self._queue.place
        if place is self._place:
            return
        reader = Reader(place)
        with wrap_os_errors(place.folder):
            reader.skip_to(self.reader.cursor.position)
        self.reader.close()
        self._dead_letters.release()
        if self._drain is not None:
            self._drain.release()
        self._drain, self._dead_letters = None, DeadLetters(place.folder)
        self.reader, self._place = reader, place

    async def _batch(self, *, events_max: int, bytes_max: int, age_s_max: float) -> list[Record]:
        self._take_drain()
        await self._notifier.until(partial(self._has_news, self.reader.cursor.position))
        batch = self._read(None, events_max, bytes_max)
        with contextlib.suppress(TimeoutError):
            async with asyncio.timeout(age_s_max):
                while not batch.complete and not self._queue.ends_at(batch.after.position):
                    await self._notifier.until(partial(self._has_news, batch.after.position))
                    batch = self._read(batch, events_max, bytes_max)
        if not batch.records and self._queue.failure is not None:
            raise self._queue.failure
        self.reader.cursor = batch.after
        return batch.records

    def _has_news(self, position: int) -> bool:
        return self._queue.synced > position or self._queue.ends_at(position) or self._queue.place is not self._place

    def _read(self, partial_batch: Batch | None, events_max: int, bytes_max: int) -> Batch:
        if self._queue.place is not self._place:
            raise SpoolUnavailable(self._place.folder, "is no longer used: the queue has moved to another folder")
        with wrap_os_errors(self._place.folder):
            last = self._queue.synced
            return self.reader.read(last=last, events_max=events_max, bytes_max=bytes_max, partial=partial_batch)

    def _take_drain(self) -> None:
        if self._drain is None and not self._released:
            with wrap_os_errors(self._place.folder):
                self._drain = FileLock.take(self._place.folder / DRAIN)
            if self._drain is None:
                raise SpoolUnavailable(self._place.folder, "is being drained by another process")
