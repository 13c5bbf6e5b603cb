"""Run one fold worker: start its process, restart it when it dies, and exchange requests with it.

Theory of operation. A worker has one asyncio task, which starts the process, waits for its end and starts it again. The
pause before a restart grows with each death, and is short again after a process has lived for `fold_worker_healthy_s`.
A worker's state is `idle` (not needed yet), `starting`, `running`, `stopped` or `restarting`; only its task and the
calls that wait for its answers change it, all in the parent's event loop.

A process that is stopped (SIGSTOP, a debugger) inside a transaction keeps SQLite's only write lock, or row locks in
PostgreSQL, and so blocks other writers. Neither its CPU time nor its open connection shows that, so the parent reads
the state of the process while it waits for an answer. It reports a stopped worker after `fold_worker_report_s` and
kills it after `fold_worker_stopped_s`; the database then rolls the transaction back. A worker that is not stopped has
`fold_worker_answer_s` for an answer. The parent kills only processes that it started and has not reaped, so a reused
pid is never hit.
"""

from __future__ import annotations

import asyncio
from collections.abc import Callable, Sequence
from typing import Any, Final, Literal

import msgspec

from pycrorm_async.clock import Clock
from pycrorm_async.errors import DatabaseError, DatabaseUnavailable
from pycrorm_async.operations.fold_requests import (
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
from pycrorm_async.projections.run.targets import Share
from pycrorm_async.settings import Settings
from pycrorm_async.store.stored import Span
from pycrorm_async.writer.retry import Backoff

_RESTART_S_MAX: Final = 60.0
"""The longest pause before a restart."""
_CHECK_S: Final = 0.25
"""The interval at which the parent reads the state of a process while it waits for its answer."""


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
                self._report(
                    f"fold worker {self.state.number} (pid {process.pid}) is stopped while it {activity};"
                    f" replacing it in {left_s:.1f} s unless it continues"
                )
                self._change("stopped")
            case "wait" if is_reported:
                self._continue()

    def _continue(self) -> None:
        self._report(f"fold worker {self.state.number} (pid {self.state.pid}) continues")
        self._change("running" if self.is_ready else "starting")

    def _change(self, state: str | None = None, **values: object) -> None:
        if state is not None:
            values |= {"state": state, "since_wall_ns": self._clock.wall_ns()}
        self.state = msgspec.structs.replace(self.state, **values)
        self._changed.set()
        self._changed = asyncio.Event()
        self._note()
