"""The writer inside a plan's process: a thread with a loop of its own, spoken to from the plan's loop.

A task in the plan's loop would never run: a plan that moves no real time awaits all the way down without suspending.
"""

from __future__ import annotations

import asyncio
import threading
from collections.abc import Callable, Iterable
from concurrent.futures import Future
from contextlib import AbstractAsyncContextManager, AsyncExitStack

from pycrorm_async.errors import DatabaseUnavailable, FlushTimeout
from pycrorm_async.settings import Settings
from pycrorm_async.writer.background_writer import LiveWriter, WriterState
from pycrorm_async.writer.patience import Patience
from pycrorm_async.writer.ports import Destination, Source

__all__ = ["WriterThread"]

_LEAVE_S = 10.0
"""How long `close` waits, when it is too late already, for the thread to let go of its database."""


class WriterThread:
    """Drains one queue from a thread of its own.

        writer = WriterThread(source=queue, open_destination=open_log, adopt=dead_folders, settings=settings)
        await writer.start()                # raises if the database cannot be opened
        await writer.flush(position)        # stored and folded
        queue.close(); await writer.close() # drains what is left, folds, closes the database, ends the thread

    `open_destination` is entered and left inside the thread's loop, where its connections belong. `start`, `flush` and
    `close` are called from the plan's loop; cancelling one of them stops the waiting, not the work.
    """

    def __init__(
        self,
        *,
        source: Source,
        open_destination: Callable[[], AbstractAsyncContextManager[Destination]],
        adopt: Callable[[], Iterable[Source]],
        settings: Settings,
    ) -> None:
        self._source = source
        self._open_destination = open_destination
        self._adopt = adopt
        self._settings = settings
        self._opened: Future[LiveWriter] = Future()
        self._ended: Future[None] = Future()
        self._loop: asyncio.AbstractEventLoop | None = None
        self._work: asyncio.Task[None] | None = None
        self._leave: asyncio.Event | None = None
        self._accepting = threading.Lock()
        self._flushes: set[Future[None]] | None = set()  # None: the loop takes no more
        # A daemon: what it has not stored is safe in the spool, so it is no reason to keep a process from ending.
        self._thread = threading.Thread(target=self._run, name=f"pycrorm writer {source.name}", daemon=True)

    async def start(self) -> None:
        """Starts the thread; returns when the database is open. Raises what opening raised; the thread is gone then."""
        self._thread.start()
        try:
            await asyncio.shield(asyncio.wrap_future(self._opened))
        except asyncio.CancelledError:
            self._opened.add_done_callback(lambda _: self._ask_to_leave(cancel=True))
            raise
        except Exception:
            self._thread.join()
            raise

    async def flush(self, position: int) -> None:
        """Returns when everything up to this position is stored and visible in the tables; see `LiveWriter.flush`.

        One that meets `close` ends as that does: raises what it raises, `FlushTimeout` too.
        """
        flush = self._begin_flush(self._opened.result(timeout=0), position)
        waited_for = asyncio.wrap_future(self._ended if flush is None else flush)
        try:
            if flush is None and not await self._patience.wait(waited_for):
                raise self._too_late()
            await asyncio.shield(waited_for)
        except asyncio.CancelledError:
            if not waited_for.cancelled():
                raise
            raise self._too_late() from None

    def _begin_flush(self, writer: LiveWriter, position: int) -> Future[None] | None:
        """In the thread's loop, which does not end before it; None if the loop is ending."""
        with self._accepting:
            if self._flushes is None:
                return None
            assert self._loop is not None
            flush = asyncio.run_coroutine_threadsafe(writer.flush(position), self._loop)
            self._flushes.add(flush)
            flush.add_done_callback(self._flushes.discard)
        return flush

    def _end_flushes(self) -> list[Future[None]]:
        """No more are begun; gives those that were."""
        with self._accepting:
            begun, self._flushes = list(self._flushes or ()), None
        return begun

    async def close(self) -> None:
        """Waits until the queue, which the caller closed, is drained and folded. The thread is gone afterwards.

        Raises what stopped the appending, `EpisodeParked`, or `FlushTimeout` after `flush_timeout_s` without progress.
        """
        self._ask_to_leave(cancel=False)
        ended = asyncio.wrap_future(self._ended)
        if not await self._patience.wait(ended):
            late = self._too_late()
            self._ask_to_leave(cancel=True)
            await asyncio.wait([ended], timeout=_LEAVE_S)
            if ended.done():
                ended.exception()  # the same, or what came of it
            raise late
        self._thread.join()
        ended.result()

    @property
    def state(self) -> WriterState:
        """What the writer does; from any thread, once started."""
        return self._opened.result(timeout=0).state

    @property
    def _patience(self) -> Patience:
        writer = self._opened.result(timeout=0)
        return Patience(self._settings.flush_timeout_s, progress=lambda: writer.progress)

    def _too_late(self) -> FlushTimeout:
        reason = self.state.queue.away or "there was too much to store and fold"
        return FlushTimeout(
            f"closed after {self._settings.flush_timeout_s:g} s with work left ({reason});"
            " everything recorded is safe in the spool"
        )

    def _ask_to_leave(self, *, cancel: bool) -> None:
        if self._ended.done() or self._loop is None or self._leave is None or self._work is None:
            return
        try:
            self._loop.call_soon_threadsafe(self._work.cancel if cancel else self._leave.set)
        except RuntimeError:  # the loop was closed at this moment: the thread is leaving
            return

    # --- in the thread ----------------------------------------------------------------------------------------

    def _run(self) -> None:
        try:
            asyncio.run(self._main())
        except asyncio.CancelledError:
            if self._opened.cancel():
                self._ended.set_result(None)
            else:
                self._ended.set_exception(self._too_late())
        except BaseException as error:  # noqa: BLE001 - raised by `start`, or by `flush` and `close`
            if not self._opened.done():
                self._opened.set_exception(error)
            self._ended.set_exception(error)
        else:
            self._ended.set_result(None)

    async def _main(self) -> None:
        self._loop = asyncio.get_running_loop()
        self._work = asyncio.current_task()
        self._leave = asyncio.Event()
        async with AsyncExitStack() as stack:
            destination = await self._open(stack)
            writer = LiveWriter(self._source, destination, adopt=self._adopt, settings=self._settings)
            self._opened.set_result(writer)
            try:
                # A writer that failed stays until it is told to leave, so that every flush is told why.
                [outcome] = await asyncio.gather(writer.run(), return_exceptions=True)
                await self._leave.wait()
                await asyncio.gather(*map(asyncio.wrap_future, self._end_flushes()), return_exceptions=True)
            finally:
                if self._end_flushes():
                    await asyncio.sleep(0)  # what was begun just now is a task afterwards, and ends with the loop
            if outcome is not None:
                raise outcome

    async def _open(self, stack: AsyncExitStack) -> Destination:
        timeout_s = self._settings.connect_timeout_s
        try:
            async with asyncio.timeout(timeout_s):
                return await stack.enter_async_context(self._open_destination())
        except TimeoutError:
            raise DatabaseUnavailable(f"the database did not answer within {timeout_s:g} s") from None
