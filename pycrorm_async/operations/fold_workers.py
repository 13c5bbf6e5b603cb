"""Start, watch and restart the processes that fold for a daemon while it appends, or for a rebuild.

    async with FoldWorkers(2, assignment, settings=settings, say=say, note=note) as workers:
        tables = FoldWorkerTables(destination, workers)

Theory of operation. A worker is a process (`fold_worker`) with one connection to its parent, a daemon or a rebuild. The
parent sends a request and waits for the answer; between requests a worker has no lock and no transaction. Checkpoints
are in the tables, so the events that a dead worker had not committed are folded again by another worker or by the
parent. Therefore the parent may kill a worker at any moment, and does so when it exits. There are two strategies: the
workers of a daemon fold the batches of one pipeline in turn, those of a rebuild fold one share of the episodes each.

Each worker has one asyncio task, which starts the process, waits for its end and starts it again. The pause before a
restart grows with each death, and is short again after a process has lived for `fold_worker_healthy_s`. While no worker
is ready the daemon folds itself, so a worker that cannot be started costs speed and nothing else. A worker's state is
`idle` (not needed yet), `starting`, `running`, `stopped` or `restarting`; only its task and the calls that wait for its
answers change it, all in the daemon's event loop.

A process that is stopped (SIGSTOP, a debugger) inside a transaction keeps SQLite's only write lock, or row locks in
PostgreSQL, and so blocks other writers. Neither its CPU time nor its open connection shows that, so the daemon reads
the state of the process while it waits for an answer. It reports a stopped worker after `fold_worker_report_s` and
kills it after `fold_worker_stopped_s`; the database then rolls the transaction back. A worker that is not stopped has
`fold_worker_answer_s` for an answer. The daemon kills only processes that it started and has not reaped, so a reused
pid is never hit.
"""

from __future__ import annotations

import asyncio
from collections.abc import Callable, Iterator, Sequence
from contextlib import ExitStack, contextmanager
from typing import Any, Final, Literal, Self

import msgspec

from pycrorm_async.clock import SYSTEM_CLOCK, Clock
from pycrorm_async.errors import DatabaseError, DatabaseUnavailable
from pycrorm_async.operations.destination import LogAndTables
from pycrorm_async.operations.fold_worker import (
    Assignment,
    Failure,
    FoldRest,
    FoldShare,
    Prepare,
    Request,
    Write,
    main,
)
from pycrorm_async.operations.processes import ChildProcess
from pycrorm_async.projections.run.batch_fold import BatchPreview
from pycrorm_async.projections.run.pipeline import LOOKAHEAD_EVENTS_MIN, FoldPipeline
from pycrorm_async.projections.run.targets import LiveTarget, Share
from pycrorm_async.settings import Settings
from pycrorm_async.store.stored import Span
from pycrorm_async.writer.ports import Tables
from pycrorm_async.writer.retry import Backoff

__all__ = [
    "WORKERS",
    "DaemonNote",
    "FoldWorker",
    "FoldWorkers",
    "FoldWorkerTables",
    "FoldWorkerState",
    "FoldWorkerLost",
    "forked",
    "verdict",
]

WORKERS: Final = 2
"""The fold workers of one daemon: one writes while the other prepares. More would compete for the database's writes."""
_RESTART_S_MAX: Final = 60.0
"""The longest pause before a restart."""
_CHECK_S: Final = 0.25
"""The interval at which the daemon reads the state of a process while it waits for its answer."""
_NOTE_S: Final = 1.0
"""The shortest interval between two notes of the number of batches; a change of state is noted at once."""


class FoldWorkerLost(Exception):
    """The worker ended before it answered; its batch must be folded again."""


class FoldWorkerState(msgspec.Struct, frozen=True):
    """One worker, for `pycrorm status`.

    Attributes:
        number: from 1.
        state: `idle`: not needed yet; `stopped`: the process is stopped while the daemon waits for it.
        since_wall_ns: the start of the state.
        pid: of the process; None without one.
        restarts: the number of restarts.
        restart_wall_ns: the time of the next restart; None unless the state is `restarting`.
        reason: of the last death.
        batches: the number of batches folded, by earlier processes of this worker too.
    """

    number: int
    state: Literal["idle", "starting", "running", "stopped", "restarting"] = "idle"
    since_wall_ns: int = 0
    pid: int | None = None
    restarts: int = 0
    restart_wall_ns: int | None = None
    reason: str | None = None
    batches: int = 0


class DaemonNote(msgspec.Struct, frozen=True):
    """The note in the spool's lock file, which `pycrorm status` reads."""

    pid: int
    fold_workers: Sequence[FoldWorkerState] = ()


def verdict(settings: Settings, *, unanswered_s: float, stopped_s: float) -> Literal["wait", "report", "replace"]:
    """Decide about a worker that has not answered yet; `stopped_s` is 0 for a process that is not stopped.

    >>> verdict(Settings(), unanswered_s=299.0, stopped_s=0.0), verdict(Settings(), unanswered_s=11.0, stopped_s=10.5)
    ('wait', 'replace')
    """
    if stopped_s >= settings.fold_worker_stopped_s or unanswered_s >= settings.fold_worker_answer_s:
        return "replace"
    return "report" if stopped_s >= settings.fold_worker_report_s else "wait"


class FoldWorker:
    """One worker and its current process. Implements `BatchWorker`."""

    def __init__(
        self,
        number: int,
        assignment: Assignment,
        *,
        settings: Settings,
        say: Callable[[str], None],
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
        self._say = say
        self._note = note
        self._clock = clock
        self._forked = forked
        self._process: ChildProcess | None = None
        self._killed_because: str | None = None
        self._changed = asyncio.Event()

    async def started(self, *, restarts_max: int) -> bool:
        """Wait until the worker can take a request; return False if its process was restarted more often than that."""
        self.wanted.set()
        while not self.is_ready and self.state.restarts <= restarts_max:
            await self._changed.wait()
        return self.is_ready

    # --- requests ---------------------------------------------------------------------------------------------

    async def prepare(self, spans: Sequence[Span]) -> BatchPreview:
        answer = await self._request(Prepare(spans), "prepares a batch")
        assert isinstance(answer, BatchPreview)
        return answer

    async def write(self) -> int:
        count = await self._request(Write(), "writes a batch and holds locks of the database")
        assert isinstance(count, int)
        self._change(batches=self.state.batches + (count > 0))
        return count

    async def fold_rest(self, *, now: bool) -> bool:
        """Refresh materialised views and fold custom projections by one step; return False if none was behind."""
        return bool(await self._request(FoldRest(now), "folds views or projections and may hold locks of the database"))

    async def fold_share(self, share: Share) -> int | None:
        """Fold a batch of this share of a rebuild; return the number of its events, None when none is left."""
        count = await self._request(FoldShare(share), "writes a batch and holds locks of the database")
        assert count is None or isinstance(count, int)
        return count

    async def _request(self, request: Request, activity: str) -> object:
        if self._process is None or not self.is_ready:
            raise FoldWorkerLost
        answer = await self._exchange(self._process, request, activity)
        if isinstance(answer, Failure):
            raise (DatabaseUnavailable if answer.unavailable else DatabaseError)(answer.reason)
        return answer

    # --- the process ------------------------------------------------------------------------------------------

    async def run(self) -> None:
        """Keep a process running from the moment `wanted` is set; cancelling this kills the process."""
        backoff = Backoff(first_s=self._settings.fold_worker_restart_s, longest_s=_RESTART_S_MAX)
        now_s = asyncio.get_running_loop().time
        await self.wanted.wait()
        deaths = 0
        while True:
            began_s = now_s()
            name, reason = await self._run_process()
            deaths = 1 if now_s() - began_s >= self._settings.fold_worker_healthy_s else deaths + 1
            pause_s = backoff.pause_s(deaths, 1.0)
            assert pause_s is not None, "there is no last attempt"
            self._say(f"{name} {reason}; restarting it in {pause_s:g} s")
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
        opening = asyncio.create_task(self._open(process), name=f"pycrorm {name} opens")
        try:
            code = await process.ended()
        finally:
            self.is_ready, self._process = False, None
            process.kill()
            opening.cancel()
            await asyncio.gather(opening, return_exceptions=True)
            process.end()
        cause = f"exited with signal {-code}" if code < 0 else f"exited with exit code {code}"
        reason, self._killed_because = self._killed_because or cause, None
        return f"{name} (pid {process.pid})", reason

    async def _open(self, process: ChildProcess) -> None:
        try:
            await self._exchange(process, self._assignment, "starts")
        except FoldWorkerLost:
            return
        except Exception as error:  # noqa: BLE001 - such as a projection that cannot be pickled; reported at restart
            self._killed_because = f"cannot receive its assignment: {error}"
            process.kill()
            return
        self._process, self.is_ready = process, True
        self._change("running")

    async def _exchange(self, process: ChildProcess, message: object, activity: str) -> Any:
        """Send a message, watch the process, and return the answer. Raises `FoldWorkerLost`.

        Cancelling it kills the process, because the late answer would be taken for that of the next request.
        """
        now_s = asyncio.get_running_loop().time
        exchange = asyncio.ensure_future(asyncio.to_thread(process.exchange, message))
        sent_s = running_s = now_s()
        try:
            while not (await asyncio.wait([exchange], timeout=_CHECK_S))[0]:
                checked_s = now_s()
                running_s = running_s if process.is_stopped() else checked_s
                self._treat(process, activity, unanswered_s=checked_s - sent_s, stopped_s=checked_s - running_s)
            answer = exchange.result()
        except (EOFError, OSError):
            self.is_ready = False
            process.kill()  # without a connection it could only idle
            raise FoldWorkerLost from None
        except asyncio.CancelledError:
            self.is_ready = False
            exchange.add_done_callback(lambda done: done.cancelled() or done.exception())
            process.kill()
            raise
        if self.state.state == "stopped":
            self._continue()
        return answer

    def _treat(self, process: ChildProcess, activity: str, *, unanswered_s: float, stopped_s: float) -> None:
        """Report or kill the process according to `verdict`."""
        settings, is_reported = self._settings, self.state.state == "stopped"
        match verdict(settings, unanswered_s=unanswered_s, stopped_s=stopped_s):
            case "replace" if self._killed_because is None:
                cause = (
                    f"was stopped for {stopped_s:.1f} s" if stopped_s else f"gave no answer for {unanswered_s:.0f} s"
                )
                self._killed_because = f"{cause} while it {activity}, and was killed"
                self.is_ready = False
                process.kill()
            case "report" if not is_reported:
                left_s = settings.fold_worker_stopped_s - stopped_s
                self._say(
                    f"fold worker {self.state.number} (pid {process.pid}) is stopped while it {activity};"
                    f" replacing it in {left_s:.1f} s unless it continues"
                )
                self._change("stopped")
            case "wait" if is_reported:
                self._continue()

    def _continue(self) -> None:
        self._say(f"fold worker {self.state.number} (pid {self.state.pid}) continues")
        self._change("running" if self.is_ready else "starting")

    def _change(self, state: str | None = None, **values: object) -> None:
        if state is not None:
            values |= {"state": state, "since_wall_ns": self._clock.wall_ns()}
        self.state = msgspec.structs.replace(self.state, **values)
        self._changed.set()
        self._changed = asyncio.Event()
        self._note()


class FoldWorkers:
    """The workers of one daemon. All of them are killed when the context ends.

    Args:
        forked: the first processes, if the command forked them; a worker without one is started when it is needed.
        say: called with one line for each death, stop and continuation.
        note: called with the states of all workers when one has changed.
    """

    def __init__(
        self,
        count: int,
        assignment: Assignment,
        *,
        settings: Settings,
        say: Callable[[str], None],
        note: Callable[[Sequence[FoldWorkerState]], None],
        forked: Sequence[ChildProcess] = (),
        clock: Clock = SYSTEM_CLOCK,
    ) -> None:
        self._note_all = note
        self._clock = clock
        self._noted: tuple[list[object], int] = ([], 0)
        self._tasks: list[asyncio.Task[None]] = []
        self._workers: list[FoldWorker] = []
        for number, first in zip(range(1, count + 1), [*forked, *[None] * count], strict=False):
            self._workers.append(
                FoldWorker(number, assignment, settings=settings, say=say, note=self._note, clock=clock, forked=first)
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
        states, now_ns = [each.state for each in self._workers], self._clock.wall_ns()
        key: list[object] = [(each.state, each.since_wall_ns, each.pid) for each in states]
        before, noted_ns = self._noted
        if key != before or now_ns - noted_ns >= _NOTE_S * 1e9:
            self._noted = key, now_ns
            self._note_all(states)


@contextmanager
def forked(count: int) -> Iterator[list[ChildProcess]]:
    """Fork the first workers of a daemon, and end them with the context. The calling process must have one thread."""
    with ExitStack() as stack:
        processes: list[ChildProcess] = []
        for number in range(1, count + 1):
            processes.append(ChildProcess.start(main, f"fold worker {number}", fork_beside=processes))
            stack.callback(processes[-1].end)
        yield processes


class FoldWorkerTables(Tables):
    """Folds a destination's tables with workers, or in this process while no worker is ready. Implements `Tables`."""

    def __init__(self, destination: LogAndTables, workers: FoldWorkers) -> None:
        self._destination = destination
        self._workers = workers
        self._pipeline = FoldPipeline(LiveTarget(destination.log))
        self._has_news = True

    async def fold_next_batch(self) -> bool:
        if not self._workers.are_wanted:  # start processes only when there are events, to keep an idle daemon small
            with self._destination.log.translated():
                self._workers.want(await self._pipeline.size())
        workers = self._workers.ready
        if not workers:
            folded = await self._destination.fold_next_batch()
            self._workers.want(folded)
            return folded
        try:
            with self._destination.log.translated():
                count = await self._pipeline.fold_next(workers)
            self._has_news = count is not None or await workers[0].fold_rest(now=self._has_news)
        except FoldWorkerLost:  # reported by the worker's task; the next call uses the other workers
            return True
        return self._has_news
