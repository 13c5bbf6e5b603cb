"""Drain one memory's queue as it fills, fold when a flush asks for it or the plan is idle, and drain dead recorders.

Appending runs beside the plan. Folding takes interpreter time from it, so it waits for an idle plan, a flush or the
end.
"""

import asyncio
import logging
import math
import threading
from collections.abc import Awaitable, Callable, Generator, Iterable, Iterator, Mapping
from concurrent.futures import Future
from contextlib import AbstractAsyncContextManager, AsyncExitStack
from typing import NamedTuple, Protocol, TypeVar

from pycrorm_async import errors
from pycrorm_async.settings import Settings
from pycrorm_async.writer import drain as drains

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

    queue: drains.DrainState
    adopted: tuple[drains.DrainState, ...]
    failure: str | None
    fold_error: str | None
    adoption_errors: tuple[str, ...]


class BackgroundWriter:
    """The writer of one memory. Runs in one loop, not in the plan's, because a plan may never suspend."""

    def __init__(
        self,
        source: drains.Source,
        destination: drains.Destination,
        *,
        adopt: Callable[[], Iterable[drains.Source]],
        settings: Settings,
    ) -> None:
        self._destination = destination
        self._adopt = adopt
        self._settings = settings
        self._appended_events = asyncio.Event()
        self._drain = drains.Drain(source, destination.append, settings=settings, on_append=self._note_append)
        self._adopted: list[drains.Drain] = []
        self._adoption_errors: list[str] = []
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
        patience = drains.Patience(self._settings.flush_timeout_s, progress=lambda: self.progress)
        try:
            await patience.run(self._flush(position), name="pycrorm flush")
        except drains.PatienceEnded:
            reason = self._drain.state.unavailable or self._fold_error or drains.TOO_MANY_EVENTS
            raise errors.FlushTimeout(patience.limit_s, reason) from None

    async def _flush(self, position: int) -> None:
        reached = await self._drain.reached(position)
        self._raise_failure()
        if not reached:
            raise errors.InternalError(f"the queue ended before position {position}")
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
        _log.error("the writer stopped; what the spool still holds is kept: %s", error)

    def _raise_failure(self) -> None:
        if self._failure is not None:
            raise self._failure

    async def _raise_stopped(self) -> None:
        stopped = {**self._drain.state.refused, **await self._retry(self._destination.stopped)}
        new_reasons = {episode: reason for episode, reason in stopped.items() if episode not in self._stopped_before}
        if new_reasons:
            raise errors.EpisodeParked(new_reasons)

    async def _fold(self) -> None:
        async with self._folding:
            await self._retry(self._destination.confirm)
            await self._retry(self._destination.fold)

    async def _retry(self, operation: Callable[[], Awaitable[_T]]) -> _T:
        """Retry while the database is unavailable; the caller bounds the time."""
        result = await drains.retry(operation, backoff=drains.PATIENT, on_unavailable=self._mark_unavailable)
        self._fold_error = None
        return result

    def _note_append(self, _: object) -> None:
        self._appended_events.set()

    def _mark_unavailable(self, error: errors.DatabaseUnavailable) -> None:
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
        sources: Iterator[drains.Source] = iter(())
        reports: list[str] = []
        try:
            sources = await drains.run_to_completion(asyncio.to_thread(lambda: iter(self._adopt())))
            while (source := await drains.run_to_completion(asyncio.to_thread(next, sources, None))) is not None:
                await self._drain_adopted(source, reports)
        except Exception as error:  # noqa: BLE001 - in the state; must not stop our own queue
            self._adoption_errors.append(str(error))
        finally:
            if isinstance(sources, Generator):
                sources.close()  # releases the folder that the generator holds
            if reports:  # one line for all, because the same records are refused at every start
                more = f" (and {len(reports) - 1} more: see `pycrorm status`)" if len(reports) > 1 else ""
                _log.error("%s%s", reports[0], more)

    async def _drain_adopted(self, source: drains.Source, reports: list[str]) -> None:
        drain = drains.Drain(
            source,
            self._destination.append,
            settings=self._settings,
            on_append=self._note_append,
            report=reports.append,
        )
        self._adopted.append(drain)
        try:
            await drain.run()
        except Exception as error:  # noqa: BLE001 - in the state; must not stop the next folder
            self._adoption_errors.append(f"{source.name}: {error}")
            reports.append(f"recorder {source.name}: {error}")


# === delegated writer =========================================================================================
#
# Wait for the daemon, or the memory's own writer process, that drains a memory's queue: flush and close without
# writing.

_POLL_S = 0.01
"""Interval at which the drain status is read."""
_UNDRAINED_S = 2.0
"""Bounds the wait of `close` while no process drains or the database is unavailable: the events are safe in the folder.
Longer than a daemon takes to find a new queue."""


class PrivateProcess(Protocol):
    """A process that drains one queue and that its owner starts and ends."""

    @property
    def is_running(self) -> bool:
        """True from the start of the process to its end, also while it does not drain yet."""
        ...

    @property
    def reason(self) -> str | None:
        """The reason why the process ended the last time; None if it never did."""
        ...

    def leave(self) -> None:
        """Let the process drain what is left and end by itself."""
        ...

    async def end(self, *, at_once: bool) -> None:
        """End the process and wait until it has ended; kill it if `at_once`."""
        ...


class DelegatedWriter:
    """The counterpart of `WriterThread` for a queue that a daemon drains, or a process of its own if there is one.

    Belongs to the plan's loop.
    """

    def __init__(self, queue: drains.OfferedQueue, settings: Settings, process: PrivateProcess | None = None) -> None:
        self.process = process
        self._queue = queue
        self._settings = settings
        self._drained_s = asyncio.get_running_loop().time()
        self._is_pending_logged = False

    async def flush(self, position: int) -> None:
        """Wait until the records up to this position are stored and visible in the tables.

        Raises `EpisodeParked` for episodes of this queue that stopped, `TablesPending` if all is stored and the daemon
        cannot bring the tables up to date, `DatabaseError` if the drainer had to stop, and
        `FlushTimeout` after `flush_timeout_s` without progress; its message states whether a process drains the queue.
        """
        hindrance = await self._wait(position, undrained_s_max=math.inf, on_poll=self._raise_failure)
        if hindrance is not None:
            raise errors.FlushTimeout(self._settings.flush_timeout_s, hindrance)
        self._raise_stopped()

    async def close(self) -> None:
        """Wait until the queue, which the caller closed, is stored and visible in the tables; then end its process.

        If this is cancelled, the process drains the rest alone.

        Stops waiting, with a warning, when no process drains the queue, when the database is unavailable, and after
        `flush_timeout_s` without progress: the next drainer of the spool stores the rest. Raises `EpisodeParked`,
        `TablesPending`.
        """
        try:
            await self._queue.synced_to()
            position = self._queue.written
            hindrance = await self._wait(position, undrained_s_max=_UNDRAINED_S)
        except BaseException:
            if self.process is not None:
                self.process.leave()
            raise
        if hindrance is not None:
            _log.warning("%s (%s)", self._describe_rest(position), hindrance)
        if self.process is not None:
            await self.process.end(at_once=hindrance is not None)
        self._raise_stopped()

    async def _wait(
        self, position: int, *, undrained_s_max: float, on_poll: Callable[[], None] = lambda: None
    ) -> str | None:
        """Wait until the records up to this position are visible; return the hindrance if the wait reached a limit."""
        before = self._status.stored
        patience = drains.Patience(self._settings.flush_timeout_s, progress=lambda: self._progress)
        try:
            visible = await patience.run(self._poll(position, undrained_s_max, on_poll), name="pycrorm wait for daemon")
        except drains.PatienceEnded:
            visible = False
        return None if visible else self._hindrance(before)

    async def _poll(self, position: int, undrained_s_max: float, on_poll: Callable[[], None]) -> bool:
        """Return True when the records up to this position are visible, False when none drains them for too long."""
        loop = asyncio.get_running_loop()
        while self._status.folded < position and not self._is_pending(position):
            on_poll()
            now_s = loop.time()
            if self._status.note.unavailable is None and self.is_drained:
                self._drained_s = now_s
            if now_s - self._drained_s > undrained_s_max:
                return False
            await asyncio.sleep(_POLL_S)
        return True

    @property
    def is_drained(self) -> bool:
        """True if a process drains the queue, or this memory's own process is running."""
        return self._queue.is_drained or (self.process is not None and self.process.is_running)

    @property
    def _status(self) -> drains.ExternalDrain:
        status = self._queue.external_drain_status
        assert status is not None, "the queue is offered to a daemon"
        return status

    @property
    def _progress(self) -> tuple[int, int]:
        return self._status.stored, self._status.folded

    def _is_pending(self, position: int) -> bool:
        """Return whether the records up to this position are stored, and the daemon cannot fold them."""
        status = self._status
        return status.stored >= position and status.note.pending is not None

    def _raise_failure(self) -> None:
        """Raise the drainer's reason if it had to stop; a drainer that still runs only reports a refused episode."""
        reason = self._status.note.failure
        if reason is not None and not self._queue.is_drained:
            raise errors.DatabaseError(f"{reason}; everything recorded is safe in the spool")

    def _describe_rest(self, position: int) -> str:
        status = self._status
        if status.stored >= position:
            return f"all events are stored, but the last {position - status.folded} are not visible in the tables yet"
        return f"{position - status.stored} events are safe in {self._queue.folder.parent} and not in the database yet"

    def _hindrance(self, before: int) -> str:
        status = self._status
        if status.note.failure is not None:
            return f"no more events are stored: {status.note.failure}"
        if not self.is_drained:
            if self.process is not None:
                return f"the writer process {self.process.reason or 'has not started yet'}"
            return "no process drains this spool: start `pycrorm writer`"
        drainer = "daemon" if self.process is None else "writer process"
        if status.note.unavailable is not None:
            return f"the {drainer} reports that the database is unavailable: {status.note.unavailable}"
        return f"the {drainer} makes no progress" if status.stored == before else drains.TOO_MANY_EVENTS

    def _raise_stopped(self) -> None:
        stopped = dict(self._status.note.stopped)
        if stopped:
            raise errors.EpisodeParked(stopped)
        if (pending := self._status.note.pending) is not None:
            if not self._is_pending_logged:
                self._is_pending_logged = True
                _log.warning("the tables do not show what is stored: %s", pending)
            raise errors.TablesPending(pending)


# === writer thread ============================================================================================
#
# Run the writer inside a plan's process, in a thread with its own loop, and call it from the plan's loop.
#
# **Theory of operation.** A task in the plan's loop would not run: a plan that waits for no real time awaits all the
# way down without ever suspending. So the thread runs its own loop with one `BackgroundWriter` and opens the database
# there, because a connection belongs to a loop.
#
# The plan's loop and the thread share two futures. `_opened` gets the writer, or the error of opening; `_ended` gets
# the outcome of the thread. Cancelling `start`, `flush` or `close` cancels the wait, not the work.
#
# A flush runs in the thread's loop, which may be ending at that moment. `_accepting` guards `_flushes`: a flush is
# added before the loop stops accepting, and then the loop waits for it, or it finds None there and waits for `_ended`
# instead. A writer that failed keeps its loop until it is asked to stop, so that each later flush raises its error.
#
# `close` asks the thread to stop and waits as long as the writer makes progress. Then it cancels the work and waits
# `_STOP_S` for the thread to close its database. The thread is a daemon thread: unstored events are safe in the spool,
# so they must not keep the process from ending.

_STOP_S = 10.0
"""Bounds the wait of `close`, after it has timed out, for the thread to close its database."""


class WriterThread:
    """Drains one queue from its own thread.

        writer = WriterThread(source=queue, open_destination=open_log, adopt=dead_folders, settings=settings)
        await writer.start()                # raises if the database cannot be opened
        await writer.flush(position)        # stored and folded
        queue.close(); await writer.close() # drains the rest, folds, closes the database, ends the thread

    `open_destination` is entered and left in the thread's loop; opening a `local` one has no limit of time.
    Call `start`, `flush` and `close` from the plan's loop.
    """

    def __init__(
        self,
        *,
        source: drains.Source,
        open_destination: Callable[[], AbstractAsyncContextManager[drains.Destination]],
        adopt: Callable[[], Iterable[drains.Source]],
        settings: Settings,
        local: bool = False,
    ) -> None:
        self._source = source
        self._local = local
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
                self._thread.join()
                ended.exception()  # retrieved, so that it is not logged; the timeout is raised instead
            raise timeout
        self._thread.join()
        ended.result()

    @property
    def state(self) -> WriterState:
        """The writer's state; from any thread, after `start`."""
        return self._opened.result(timeout=0).state

    @property
    def _patience(self) -> drains.Patience:
        writer = self._opened.result(timeout=0)
        return drains.Patience(self._settings.flush_timeout_s, progress=lambda: writer.progress)

    def _timeout_error(self) -> errors.FlushTimeout:
        reason = self.state.queue.unavailable or drains.TOO_MANY_EVENTS
        return errors.FlushTimeout(self._settings.flush_timeout_s, f"closed with work left: {reason}")

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

    async def _open(self, stack: AsyncExitStack) -> drains.Destination:
        opening = stack.enter_async_context(self._open_destination())
        if self._local:  # a file needs no limit: waits for the locks of other processes are bounded where they wait
            return await opening
        answers = drains.OpeningSteps()
        timeout_s = self._settings.connect_timeout_s
        try:
            patience = drains.Patience(timeout_s, progress=lambda: answers.count)
            return await patience.run(answers.counted(opening), name="pycrorm open destination")
        except drains.PatienceEnded:
            raise errors.DatabaseUnavailable(f"the database did not answer within {timeout_s:g} s") from None
