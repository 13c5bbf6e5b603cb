"""Run fold workers: processes that fold batches, and the requests to them.

**Processes.** Start child processes, each with a connection to its parent, and report how they ended.

    child = ChildProcess.start(serve_requests, "pycrorm fold worker")
    answer = await child.exchange(request)

Theory of operation. There are three ways to start a process. The `pycrorm writer` command forks its first fold workers
before it opens anything, while it has a single thread: they have imported all modules and are ready at once, so a full
spool is folded by several processes from the first batch on. All other processes need an interpreter of their own,
because a fork of a running program would inherit locks whose owning threads do not exist in the child. A process that
dies with its parent is spawned. Others are forked from the fork server of multiprocessing, which has imported the
module of the entry and has a single thread: of several, only the first waits for the imports. Both import the main
module, so a script must start them below `if __name__ == "__main__":`.

A terminal or a service manager sends SIGINT and SIGTERM to every process, but only the parent reacts, and ends its
children. These signals could end a child before it ignores them, so they are blocked around the start and unblocked by
the child. A child ends with its connection: the end of file arrives when the parent closes it or dies. With
`dies_with_parent` the kernel also kills it when the parent dies, even while it is stopped or busy.

The parent reaps a child only in `ended` and `end`; until then the kernel cannot reuse the pid, so `kill` always hits
this process. The fork server reaps its children itself, so `kill` first looks whether the process has ended.

**Fold workers.** Start the fold workers of a daemon, which fold while it appends, or those of a rebuild.

    async with FoldWorkers(2, assignment, settings=settings, report=report, note=note) as workers:
        folds = WorkerFolds(destination, workers)

Theory of operation. A worker is a process with one connection to its parent, a daemon or a rebuild. The
parent sends a request and waits for the answer; between requests a worker has no lock and no transaction. Checkpoints
are in the tables, so the events that a dead worker had not committed are folded again by another worker or by the
parent. Therefore the parent may kill a worker at any moment, and does so when it exits. There are two strategies: the
workers of a daemon fold the batches of one pipeline in turn, those of a rebuild fold one share of the episodes each.
While no worker of a daemon is ready the daemon folds itself, so a worker that cannot be started costs speed only.
"""

from __future__ import annotations

import asyncio
import ctypes
import logging
import multiprocessing
import os
import signal
from collections.abc import Callable, Iterable, Iterator, Sequence
from contextlib import ExitStack, contextmanager, suppress
from importlib import import_module
from multiprocessing import resource_tracker
from multiprocessing.connection import Connection
from multiprocessing.process import BaseProcess
from typing import Any, Final, Literal, NamedTuple, Self, TypeAlias

import msgspec

from pycrorm_async.bulk_records import collect_seldom
from pycrorm_async.clock import SYSTEM_CLOCK, Clock
from pycrorm_async.errors import DatabaseError, DatabaseForeign, DatabaseUnavailable
from pycrorm_async.operations.destination import LogAndTables
from pycrorm_async.projections.custom import Projection, installed_projections
from pycrorm_async.projections.pipeline import LOOKAHEAD_EVENTS_MIN, BatchPreview, FoldRunner, LiveTarget, Share
from pycrorm_async.projections.projector import Projector
from pycrorm_async.projections.rebuild import Rebuild
from pycrorm_async.settings import Settings
from pycrorm_async.store.address import BUSY_TIMEOUT_S, DatabaseAddress, shared_address
from pycrorm_async.store.dialects import dialect_of
from pycrorm_async.store.log import EventLog
from pycrorm_async.store.stored import Span
from pycrorm_async.writer.drain import Backoff

#
# Run one fold worker: start its process, restart it when it dies, and exchange requests with it.
#
# Theory of operation. A worker has one asyncio task, which starts the process, waits for its end and starts it again.
# The pause before a restart grows with each death, and is short again after a process has lived for `_HEALTHY_S`. A
# worker's state is `idle` (not needed yet), `starting`, `running` or `restarting`; only its task and the calls that
# wait for its answers change it, all in the parent's event loop.
#
# A worker that loops or is stopped (SIGSTOP) is not replaced: `pycrorm status` shows its pid and the events that wait,
# and another one takes its place when it is killed. The parent kills only processes that it started and has not reaped,
# so a reused pid is never hit.

_RESTART_S: Final = 1.0
"""The first pause before a restart; it doubles after each further death."""
_RESTART_S_MAX: Final = 60.0
"""The longest pause before a restart."""
_HEALTHY_S: Final = 60.0
"""A worker that lived this long is restarted after the first, shortest pause."""


class FoldWorkerLost(Exception):
    """The worker ended before it answered; its batch must be folded again."""


class FoldWorkerState(msgspec.Struct, frozen=True):
    """One worker, for `pycrorm status`.

    Attributes:
        number: from 1.
        state: `idle`: not needed yet.
        since_wall_ns: the start of the state.
        pid: of the process; None if there is none.
        restarts: the number of restarts.
        restart_wall_ns: the time of the next restart; None unless the state is `restarting`.
        reason: of the last death.
        batches: the number of batches folded, by earlier processes of this worker too.
    """

    number: int
    state: Literal["idle", "starting", "running", "restarting"] = "idle"
    since_wall_ns: int = 0
    pid: int | None = None
    restarts: int = 0
    restart_wall_ns: int | None = None
    reason: str | None = None
    batches: int = 0


class FoldWorker:
    """One worker and its current process. Implements `BatchWorker`."""

    def __init__(
        self,
        number: int,
        assignment: Assignment,
        *,
        settings: Settings,
        report: Callable[[str], None],
        note: Callable[[], None],
        clock: Clock,
        forked: ChildProcess | None,
    ) -> None:
        self.state = FoldWorkerState(number, since_wall_ns=clock.wall_ns())
        self.is_ready = False
        self.wanted = asyncio.Event()
        if forked is not None:
            self.wanted.set()
        self._assignment = assignment
        self._settings = settings
        self._report = report
        self._note = note
        self._clock = clock
        self._forked = forked
        self._process: ChildProcess | None = None
        self._changed = asyncio.Event()

    async def started(self, *, restarts_max: int) -> bool:
        """Wait until the worker can take a request; return False if its process was restarted more often than that."""
        self.wanted.set()
        while not self.is_ready and self.state.restarts <= restarts_max:
            await self._changed.wait()
        return self.is_ready

    # --- requests ---------------------------------------------------------------------------------------------

    async def prepare(self, spans: Sequence[Span]) -> BatchPreview:
        answer = await self._request(Prepare(spans))
        assert isinstance(answer, BatchPreview)
        return answer

    async def write(self) -> int:
        count = await self._request(Write())
        assert isinstance(count, int)
        self._change(batches=self.state.batches + (count > 0))
        return count

    async def fold_rest(self, share: Share) -> bool:
        """Refresh materialised views and fold custom projections by one step; return False if none was behind."""
        return bool(await self._request(FoldRest(share)))

    async def fold_share(self, share: Share) -> int | None:
        """Fold a batch of this share of a rebuild; return the number of its events, None when none is left."""
        count = await self._request(FoldShare(share))
        assert count is None or isinstance(count, int)
        return count

    async def _request(self, request: Request) -> object:
        if self._process is None or not self.is_ready:
            raise FoldWorkerLost
        answer = await self._exchange(self._process, request)
        if isinstance(answer, Failure):
            raise (DatabaseUnavailable if answer.unavailable else DatabaseError)(answer.reason)
        return answer

    # --- the process ------------------------------------------------------------------------------------------

    async def run(self) -> None:
        """Keep a process running from the moment `wanted` is set; cancelling this kills the process."""
        backoff = Backoff(first_s=_RESTART_S, longest_s=_RESTART_S_MAX)
        now_s = asyncio.get_running_loop().time
        await self.wanted.wait()
        deaths = 0
        while True:
            began_s = now_s()
            name, reason = await self._run_process()
            deaths = 1 if now_s() - began_s >= _HEALTHY_S else deaths + 1
            pause_s = backoff.pause_s(deaths, 1.0)
            assert pause_s is not None, "there is no last attempt"
            self._report(f"{name} {reason}; restarting it in {pause_s:g} s")
            restart_ns = self._clock.wall_ns() + int(pause_s * 1e9)
            self._change("restarting", pid=None, reason=reason, restart_wall_ns=restart_ns)
            await asyncio.sleep(pause_s)
            self._change("starting", restarts=self.state.restarts + 1, restart_wall_ns=None)

    async def _run_process(self) -> tuple[str, str]:
        """Run one process from its start to its end; return its name and the cause of its end."""
        name = f"fold worker {self.state.number}"
        try:
            process, self._forked = self._forked or ChildProcess.start(main, name), None
        except OSError as error:
            return name, f"cannot be started: {error}"
        self._change("starting", pid=process.pid)
        try:
            with suppress(FoldWorkerLost):
                await self._exchange(process, self._assignment)
                self._process, self.is_ready = process, True
                self._change("running")
            code = await process.ended()
            reason = f"exited with signal {-code}" if code < 0 else f"exited with exit code {code}"
        except Exception as error:  # noqa: BLE001 - such as a projection that cannot be pickled; reported at restart
            reason = f"cannot receive its assignment: {error}"
        finally:
            self.is_ready, self._process = False, None
            process.kill()
            process.process.join()
            await asyncio.sleep(0)  # a request must meet the end of the connection before the connection is closed
            process.end()
        return f"{name} (pid {process.pid})", reason

    async def _exchange(self, process: ChildProcess, message: object) -> Any:
        """Send a message and return the answer. Raises `FoldWorkerLost`.

        A process that gives none is killed, also when this is cancelled: its late answer would be taken for that of
        the next request.
        """
        try:
            return await process.exchange(message)
        except BaseException as fault:
            self.is_ready = False
            process.kill()
            if isinstance(fault, EOFError | OSError):
                raise FoldWorkerLost from None
            raise

    def _change(self, state: str | None = None, **values: object) -> None:
        if state is not None:
            values |= {"state": state, "since_wall_ns": self._clock.wall_ns()}
        self.state = msgspec.structs.replace(self.state, **values)
        self._changed.set()
        self._changed = asyncio.Event()
        self._note()


# === fold requests ============================================================================================
#
# Answer the requests of a daemon or of a rebuild in the process of a fold worker, until the connection ends.
#
# `FoldWorker` starts this process with a connection. The process receives an `Assignment`, answers `READY`, and then
# answers each request once. For a daemon, `Prepare` and `Write` fold a batch of events in two steps, and `FoldRest`
# refreshes materialised views and folds custom projections. For a rebuild, `FoldShare` folds a batch of the worker's
# share of the episodes. The process opens the database at the first request, has at most one open transaction, and none
# between requests. An exception in a request becomes a `Failure`, and the process continues.
#
# Its parent alone ends it (section "processes"), and the kernel kills it when the parent dies, so that no worker
# outlives the daemon, not even a stopped one.

READY: Final = "ready"


class Assignment(NamedTuple):
    """The database to fold, the id of its log, the custom projections to fold, the wait for SQLite's lock, and whether
    to make cases."""

    url: str | DatabaseAddress
    log_id: str
    projections: Sequence[Projection] = ()
    busy_timeout_s: float = BUSY_TIMEOUT_S
    recall: bool = True


class Prepare(NamedTuple):
    """Read and fold these events; answered with a `BatchPreview`."""

    spans: Sequence[Span]


class Write(NamedTuple):
    """Write the prepared batch; answered with the number of its events that are in the tables now."""


class FoldRest(NamedTuple):
    """Bring views, and projections of this share, up to date; answered with whether there was anything to do."""

    share: Share


class FoldShare(NamedTuple):
    """Fold a batch of this share of a rebuild; answered with the number of its events, None when none is left."""

    share: Share


class Failure(NamedTuple):
    """The reason of a failed request. `unavailable`: the database does not answer, so the parent may try again."""

    reason: str
    unavailable: bool


Request: TypeAlias = Prepare | Write | FoldRest | FoldShare
Answer: TypeAlias = BatchPreview | int | bool | Failure | None


def main(connection: Connection) -> None:
    """Answer the requests of a daemon or of a rebuild until the connection ends."""
    collect_seldom()
    # The parent opens the same memory and logs its warnings; repeating them in each worker would double them.
    logging.getLogger("pycrorm_async").setLevel(logging.CRITICAL)
    logging.getLogger("pycrorm_async.projections").setLevel(logging.WARNING)
    with asyncio.Runner() as runner:
        try:
            handler = _RequestHandler(connection.recv())
            connection.send(READY)
            while True:
                connection.send(runner.run(handler.answer(connection.recv())))
        except (EOFError, ConnectionError):
            os._exit(0)


class _RequestHandler:
    """Executes requests."""

    def __init__(self, assignment: Assignment) -> None:
        self._assignment = assignment
        self._log: EventLog | None = None
        self._projector: Projector | None = None
        self._rebuild: Rebuild | None = None

    async def answer(self, request: Request) -> Answer:
        try:
            return await self._execute(request)
        except Exception as error:  # noqa: BLE001 - sent to the parent, which raises it
            self._projector = self._rebuild = None  # after a failover or a restore the tables may have another layout
            return Failure(str(error) or repr(error), unavailable=isinstance(error, DatabaseUnavailable))

    async def _execute(self, request: Request) -> Answer:
        if self._log is None:
            self._log = await self._open_same_log()
        match request:
            case Prepare(spans):
                return await (await self._opened(self._log)).runner.prepare(spans)
            case Write():
                return await (await self._opened(self._log)).runner.write()
            case FoldRest(share):
                return await (await self._opened(self._log)).fold_rest(share)
            case FoldShare(share):
                if self._rebuild is None:
                    self._rebuild = await Rebuild.join(self._log, share)
                return await self._rebuild.fold_next_batch()

    async def _opened(self, log: EventLog) -> Projector:
        """Open the tables at the first request, and again after a failure."""
        if self._projector is None:
            projections = self._assignment.projections
            installed = installed_projections(projections, own=self._assignment.recall)
            projector = Projector(log, projections=projections, installed=installed)
            await projector.open()
            self._projector = projector
        return self._projector

    async def _open_same_log(self) -> EventLog:
        """Open the parent's log. A SQLite file that replaced it is refused and not written."""
        assignment = self._assignment
        address = shared_address(assignment.url)
        await (await EventLog.open(address, create=False)).close()
        log = await EventLog.open(address, create=True, busy_timeout_s=assignment.busy_timeout_s)
        if log.log_id != assignment.log_id:
            await log.close()
            raise DatabaseForeign(f"{address} was replaced while the daemon had it open: start `pycrorm writer` again")
        return log


# === processes ================================================================================================

_IGNORED: Final = (signal.SIGINT, signal.SIGTERM)
_PR_SET_PDEATHSIG: Final = 1


class ChildProcess(NamedTuple):
    """A child process and the connection to it."""

    process: BaseProcess
    connection: Connection

    @classmethod
    def start(
        cls,
        entry: Callable[..., None],
        name: str,
        *args: object,
        dies_with_parent: bool = True,
        fork_beside: Iterable[ChildProcess] | None = None,
    ) -> ChildProcess:
        """Start a process that calls `entry` with its connection and `args`, which it receives pickled unless forked.

        Args:
            dies_with_parent: the kernel kills the process when the calling one dies.
            fork_beside: fork the calling process, which must have one thread, and close the child's copies of the
                connections to these children.

        Raises `OSError` if the system starts no process, and in a daemonic process of multiprocessing (such as a worker
        of its `Pool`), which must not start any.
        """
        if multiprocessing.current_process().daemon:
            raise OSError("a daemonic process of multiprocessing cannot start processes")
        method = "fork" if fork_beside is not None else "spawn" if dies_with_parent else "forkserver"
        context: Any = multiprocessing.get_context(method)
        if method == "forkserver":
            context.set_forkserver_preload([entry.__module__])  # ignored if the server is running
        ours, theirs = context.Pipe()
        inherited = [] if fork_beside is None else [ours, *(each.connection for each in fork_beside)]
        if fork_beside is None:
            resource_tracker.ensure_running()  # its start unblocks the signals, so it must come first
        before = signal.pthread_sigmask(signal.SIG_BLOCK, _IGNORED)
        try:
            process = context.Process(
                target=_run,
                args=(entry, theirs, *args),
                kwargs={"inherited": inherited, "dies_with_parent": dies_with_parent},
                name=name,
                daemon=True,
            )
            process.start()
        finally:
            signal.pthread_sigmask(signal.SIG_SETMASK, before)
            theirs.close()  # while this process holds that end too, the child's death would not be an end of file
        return cls(process, ours)

    @property
    def pid(self) -> int:
        assert self.process.pid is not None, "started"
        return self.process.pid

    async def exchange(self, message: object) -> Any:
        """Send a message and return the answer. Raises `EOFError` or `OSError` when the process ends."""
        self.connection.send(message)
        return await self.receive()

    async def receive(self) -> Any:
        """Return the next message. Raises `EOFError` or `OSError` when the process ends."""
        await readable(self.connection.fileno())
        return self.connection.recv()

    async def ended(self) -> int:
        """Wait for the end of the process; return its exit code, which is negative for a signal."""
        await readable(self.process.sentinel)
        self.process.join()
        assert self.process.exitcode is not None
        return self.process.exitcode

    def kill(self) -> None:
        """Kill the process unless it has ended."""
        if self.process.is_alive():
            self.process.kill()

    def end(self) -> None:
        """Kill the process if it is running, and reap it."""
        self.kill()
        self.process.join()
        self.connection.close()


async def readable(descriptor: int) -> None:
    """Wait until a file descriptor can be read, or has come to its end."""
    readable = asyncio.Event()
    loop = asyncio.get_running_loop()
    loop.add_reader(descriptor, readable.set)
    try:
        await readable.wait()
    finally:
        loop.remove_reader(descriptor)


def _run(
    entry: Callable[..., None],
    connection: Connection,
    *args: object,
    inherited: Iterable[Connection],
    dies_with_parent: bool,
) -> None:
    """Prepare the child and call `entry` in it."""
    for each in inherited:
        each.close()
    for number in _IGNORED:
        signal.signal(number, signal.SIG_IGN)
    signal.pthread_sigmask(signal.SIG_UNBLOCK, _IGNORED)
    parent = multiprocessing.parent_process()
    if dies_with_parent and parent is not None:
        ctypes.CDLL(None).prctl(_PR_SET_PDEATHSIG, signal.SIGKILL)
        if os.getppid() != parent.pid:  # the parent died before the call above
            os._exit(0)
    with connection, suppress(EOFError, ConnectionError):
        entry(connection, *args)


# === fold workers =============================================================================================

WORKERS: Final = 2
"""The fold workers of one daemon: one writes while the other prepares. More would compete for the database's writes."""


_REST_S_MAX: Final = 0.5
"""Bounds the rest of a daemon that shares a memory with others after a batch of a few events. It rests as long as the
batch took: what arrives meanwhile is folded as one batch, which costs the processors little more than a small one."""


class DaemonNote(msgspec.Struct, frozen=True):
    """The note in the spool's lock file, which `pycrorm status` reads."""

    pid: int
    fold_workers: Sequence[FoldWorkerState] = ()


class FoldWorkers:
    """The workers of one daemon. All of them are killed when the context ends.

    Args:
        forked: the first processes, if the command forked them; a worker without one is started when it is needed.
        report: called with one line for each death.
        note: called with the states of all workers when one has changed.
    """

    def __init__(
        self,
        count: int,
        assignment: Assignment,
        *,
        settings: Settings,
        report: Callable[[str], None],
        note: Callable[[Sequence[FoldWorkerState]], None],
        forked: Sequence[ChildProcess] = (),
        clock: Clock = SYSTEM_CLOCK,
    ) -> None:
        self._note_all = note
        self._tasks: list[asyncio.Task[None]] = []
        self._workers: list[FoldWorker] = []
        for number, first in zip(range(1, count + 1), [*forked, *[None] * count], strict=False):
            self._workers.append(
                FoldWorker(
                    number, assignment, settings=settings, report=report, note=self._note, clock=clock, forked=first
                )
            )

    async def __aenter__(self) -> Self:
        self._note()
        for worker in self._workers:
            name = f"pycrorm fold worker {worker.state.number}"
            self._tasks.append(asyncio.create_task(worker.run(), name=name))
        return self

    async def __aexit__(self, *_: object) -> None:
        for task in self._tasks:
            task.cancel()
        await asyncio.gather(*self._tasks, return_exceptions=True)

    def __iter__(self) -> Iterator[FoldWorker]:
        return iter(self._workers)

    @property
    def ready(self) -> list[FoldWorker]:
        """The workers that can take a request now."""
        return [each for each in self._workers if each.is_ready]

    @property
    def are_wanted(self) -> bool:
        """True if every worker is started or will be."""
        return all(each.wanted.is_set() for each in self._workers)

    def want(self, events: int) -> None:
        """Start one worker if there are events to fold, and the others if there are many."""
        for worker in self._workers[: 0 if events == 0 else 1 if events < LOOKAHEAD_EVENTS_MIN else None]:
            worker.wanted.set()

    def _note(self) -> None:
        self._note_all([each.state for each in self._workers])


@contextmanager
def forked(count: int, url: str) -> Iterator[list[ChildProcess]]:
    """Fork the first workers of a daemon for this database, and end them with the context.

    The calling process must have one thread. Raises `UnknownUrl`, `CallerError`, and `DatabaseUnavailable` for settings
    of the URL that cannot be used.
    """
    _import_drivers(url)
    with ExitStack() as stack:
        processes: list[ChildProcess] = []
        for number in range(1, count + 1):
            processes.append(ChildProcess.start(main, f"fold worker {number}", fork_beside=processes))
            stack.callback(processes[-1].end)
        yield processes


def _import_drivers(url: str) -> None:
    """Import the modules that opening the database imports: once here, and not again in each process.

    The imports take 60 ms, longer than folding the first thousand events.
    """
    dialect_of(shared_address(url).engine(read_only=True))  # the engine connects to nothing
    import_module("sqlalchemy.dialects.postgresql")  # an index of the tables has an option of it, also on SQLite


class WorkerFolds:
    """Folds a destination's tables with workers, or in this process while no worker is ready."""

    def __init__(self, destination: LogAndTables, workers: FoldWorkers) -> None:
        self._destination = destination
        self._workers = workers
        self._target = LiveTarget(destination.log)
        self._runner = FoldRunner(self._target)
        self._rest_until_s = 0.0

    async def fold_next_batch(self) -> bool:
        """Implement `StepwiseDestination.fold_next_batch`."""
        async with self._destination.group.folding() as share:
            self._target.share = share
            if not self._workers.are_wanted:  # start processes only when there are events, to keep an idle daemon small
                self._workers.want(await self._runner.size())
            workers = self._workers.ready
            if workers:
                return await self._fold_with(workers, share)
        folded = await self._destination.fold_next_batch()
        if folded:
            self._workers.want(events=1)
        return folded

    async def _fold_with(self, workers: Sequence[FoldWorker], share: Share) -> bool:
        now_s = asyncio.get_running_loop().time
        await asyncio.sleep(self._rest_until_s - now_s())
        began_s = now_s()
        try:
            count = await self._runner.fold_next(workers)
            if share.many > 1 and 0 < (count or 0) < LOOKAHEAD_EVENTS_MIN:
                self._rest_until_s = now_s() + min(now_s() - began_s, _REST_S_MAX)
            return count is not None or await workers[0].fold_rest(share)
        except FoldWorkerLost:  # reported by the worker's task; the next call uses the other workers
            return True
