"""Run the writer inside a plan's process, in a thread with its own loop, and call it from the plan's loop.

**Theory of operation.** A task in the plan's loop would not run: a plan that waits for no real time awaits all the way
down without ever suspending. So the thread runs its own loop with one `BackgroundWriter` and opens the database there,
because a connection belongs to a loop.

The plan's loop and the thread share two futures. `_opened` gets the writer, or the error of opening; `_ended` gets the
outcome of the thread. Cancelling `start`, `flush` or `close` cancels the wait, not the work.

A flush runs in the thread's loop, which may be ending at that moment. `_accepting` guards `_flushes`: a flush is added
before the loop stops accepting, and then the loop waits for it, or it finds None there and waits for `_ended` instead.
A writer that failed keeps its loop until it is asked to stop, so that each later flush raises its error.

`close` asks the thread to stop and waits as long as the writer makes progress. Then it cancels the work and waits
`_STOP_S` for the thread to close its database. The thread is a daemon thread: unstored events are safe in the spool,
so they must not keep the process from ending.
"""

from __future__ import annotations

import asyncio
import threading
from collections.abc import Callable, Iterable
from concurrent.futures import Future
from contextlib import AbstractAsyncContextManager, AsyncExitStack

from pycrorm_async.errors import DatabaseUnavailable, FlushTimeout
from pycrorm_async.settings import Settings
from pycrorm_async.writer.background_writer import BackgroundWriter, WriterState
from pycrorm_async.writer.patience import TOO_MANY_EVENTS, Patience
from pycrorm_async.writer.ports import Destination, Source

_STOP_S = 10.0
"""Bounds the wait of `close`, after it has timed out, for the thread to close its database."""


class WriterThread:
    """Drains one queue from its own thread.

        writer = WriterThread(source=queue, open_destination=open_log, adopt=dead_folders, settings=settings)
        await writer.start()                # raises if the database cannot be opened
        await writer.flush(position)        # stored and folded
        queue.close(); await writer.close() # drains the rest, folds, closes the database, ends the thread

    `open_destination` is entered and left in the thread's loop. Call `start`, `flush` and `close` from the plan's loop.
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
        self._opened: Future[BackgroundWriter] = Future()
        self._ended: Future[None] = Future()
        self._loop: asyncio.AbstractEventLoop | None = None
        self._work: asyncio.Task[None] | None = None
        self._stop: asyncio.Event | None = None
        self._accepting = threading.Lock()
        self._flushes: set[Future[None]] | None = set()  # None: the loop accepts no more flushes
        self._thread = threading.Thread(target=self._run, name=f"pycrorm writer {source.name}", daemon=True)

    async def start(self) -> None:
        """Start the thread and wait until the database is open. Raises the error of opening; the thread ends then."""
        self._thread.start()
        try:
            await asyncio.shield(asyncio.wrap_future(self._opened))
        except asyncio.CancelledError:
            self._opened.add_done_callback(lambda _: self._request_stop(cancel=True))
            raise
        except Exception:
            self._thread.join()
            raise

    async def flush(self, position: int) -> None:
        """Wait until the records up to this position are stored and visible; see `BackgroundWriter.flush`.

        During `close` a flush ends with the outcome of `close`.
        """
        flush = self._begin_flush(self._opened.result(timeout=0), position)
        waited_for = asyncio.wrap_future(self._ended if flush is None else flush)
        try:
            if flush is None and not await self._patience.wait(waited_for):
                raise self._timeout_error()
            await asyncio.shield(waited_for)
        except asyncio.CancelledError:
            if not waited_for.cancelled():
                raise
            raise self._timeout_error() from None

    def _begin_flush(self, writer: BackgroundWriter, position: int) -> Future[None] | None:
        """Start a flush in the thread's loop, which waits for it before it ends; None if the loop is ending."""
        with self._accepting:
            if self._flushes is None:
                return None
            assert self._loop is not None
            flush = asyncio.run_coroutine_threadsafe(writer.flush(position), self._loop)
            self._flushes.add(flush)
            flush.add_done_callback(self._flushes.discard)
        return flush

    def _end_flushes(self) -> list[Future[None]]:
        """Accept no more flushes; return the running ones."""
        with self._accepting:
            flushes, self._flushes = list(self._flushes or ()), None
        return flushes

    async def close(self) -> None:
        """Wait until the queue, which the caller closed, is drained and folded and the thread has ended.

        Raises the error that stopped appending, `EpisodeParked`, or `FlushTimeout` after `flush_timeout_s` without
        progress.
        """
        self._request_stop(cancel=False)
        ended = asyncio.wrap_future(self._ended)
        if not await self._patience.wait(ended):
            timeout = self._timeout_error()
            self._request_stop(cancel=True)
            await asyncio.wait([ended], timeout=_STOP_S)
            if ended.done():
                ended.exception()  # retrieved, so that it is not logged; the timeout is raised instead
            raise timeout
        self._thread.join()
        ended.result()

    @property
    def state(self) -> WriterState:
        """The writer's state; from any thread, after `start`."""
        return self._opened.result(timeout=0).state

    @property
    def _patience(self) -> Patience:
        writer = self._opened.result(timeout=0)
        return Patience(self._settings.flush_timeout_s, progress=lambda: writer.progress)

    def _timeout_error(self) -> FlushTimeout:
        reason = self.state.queue.unavailable or TOO_MANY_EVENTS
        return FlushTimeout(self._settings.flush_timeout_s, f"closed with work left: {reason}")

    def _request_stop(self, *, cancel: bool) -> None:
        if self._ended.done() or self._loop is None or self._stop is None or self._work is None:
            return
        try:
            self._loop.call_soon_threadsafe(self._work.cancel if cancel else self._stop.set)
        except RuntimeError:  # the loop has just closed: the thread is ending
            return

    # --- in the thread ----------------------------------------------------------------------------------------

    def _run(self) -> None:
        try:
            asyncio.run(self._main())
        except asyncio.CancelledError:
            if self._opened.cancel():
                self._ended.set_result(None)
            else:
                self._ended.set_exception(self._timeout_error())
        except BaseException as error:  # noqa: BLE001 - raised by `start`, or by `flush` and `close`
            if not self._opened.done():
                self._opened.set_exception(error)
            self._ended.set_exception(error)
        else:
            self._ended.set_result(None)

    async def _main(self) -> None:
        self._loop = asyncio.get_running_loop()
        self._work = asyncio.current_task()
        self._stop = asyncio.Event()
        async with AsyncExitStack() as stack:
            destination = await self._open(stack)
            writer = BackgroundWriter(self._source, destination, adopt=self._adopt, settings=self._settings)
            self._opened.set_result(writer)
            try:
                # A failed writer waits for the request to stop, so that every flush raises its error.
                [outcome] = await asyncio.gather(writer.run(), return_exceptions=True)
                await self._stop.wait()
                await asyncio.gather(*map(asyncio.wrap_future, self._end_flushes()), return_exceptions=True)
            finally:
                if self._end_flushes():
                    await asyncio.sleep(0)  # lets a flush started just now become a task, which ends with the loop
            if outcome is not None:
                raise outcome

    async def _open(self, stack: AsyncExitStack) -> Destination:
        timeout_s = self._settings.connect_timeout_s
        try:
            async with asyncio.timeout(timeout_s):
                return await stack.enter_async_context(self._open_destination())
        except TimeoutError:
            raise DatabaseUnavailable(f"the database did not answer within {timeout_s:g} s") from None
