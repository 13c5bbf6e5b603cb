"""Processes that fold beside the daemon, which appends: started when they are needed, watched, restarted.

    async with FoldWorkers(2, assignment, settings=settings, say=say, note=note) as workers:
        tables = FoldWorkerTables(destination, workers)

Theory of operation. A worker is a spawned process (`fold_worker`) with one connection. The daemon sends it a request
and waits for the answer; between requests a worker holds nothing, neither a lock nor a transaction. What a worker had
not committed when it dies is folded again by another one, or by the daemon, because progress is in the tables. So the
daemon may kill a worker at any moment, and does so when it leaves.

Each worker has one task, which starts the process, waits for its end and starts it again. The pause before that grows
with each death and is short again after a worker has lived for a minute. While no worker is ready the daemon folds by
itself, so a worker that cannot be started costs speed and nothing else.

A worker that is stopped (SIGSTOP, a debugger) in the middle of a transaction holds SQLite's one write lock, or locks of
rows in PostgreSQL, and so keeps other processes from writing. Neither its processor time nor its open connection would
show that, so the daemon looks at the state of the process while it waits for an answer: it reports a stopped worker
after `fold_worker_report_s`, and kills it after `fold_worker_stopped_s`, upon which the database rolls its transaction
back. A worker that is at work is given `fold_worker_answer_s`. Only processes that the daemon started itself, and has
not reaped, are ever killed.
"""

from __future__ import annotations

import asyncio
from collections.abc import Callable, Mapping, Sequence
from typing import Any, Final, Literal, Self

import msgspec

from pycrorm_async.clock import SYSTEM_CLOCK, Clock
from pycrorm_async.errors import DatabaseError, DatabaseUnavailable
from pycrorm_async.events.envelope import Record
from pycrorm_async.events.ids import EpisodeId
from pycrorm_async.operations.destination import LogAndTables
from pycrorm_async.operations.fold_process import FoldProcess
from pycrorm_async.operations.fold_worker import Assignment, Failure, FoldRest, Prepare, Request, Write
from pycrorm_async.projections.run.pipeline import LOOKAHEAD_EVENTS_MIN, FoldPipeline, Outlook
from pycrorm_async.settings import Settings
from pycrorm_async.store.stored import Span
from pycrorm_async.writer.ports import Tables
from pycrorm_async.writer.retry import Backoff

__all__ = ["WORKERS", "DaemonNote", "FoldWorkers", "FoldWorkerTables", "FoldWorkerState", "FoldWorkerLost", "verdict"]

WORKERS: Final = 2
"""Processes that fold for one daemon: while one writes the other one prepares, and no database lets two write well."""
_RESTART_S_MAX: Final = 60.0
_LOOK_S: Final = 0.25
"""So often the daemon looks at the process that it waits for."""
_NOTE_S: Final = 1.0
"""The number of batches is noted at most so often; every change of a state at once."""


class FoldWorkerLost(Exception):
    """The worker ended before it answered; its batch is to be folded again."""


class FoldWorkerState(msgspec.Struct, frozen=True):
    """One worker, for `pycrorm status`.

    Attributes:
        number: from 1.
        state: `idle`: not needed yet; `stopped`: the process is stopped while the daemon waits for it.
        since_wall_ns: of the state.
        pid: of the process; None while there is none.
        restarts: how often it was started again.
        restart_wall_ns: when it is started again; None unless it is `restarting`.
        reason: of the last death.
        batches: folded, those of the processes before it included.
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
    """The daemon's note in its lock of the spool, for `pycrorm status`."""

    pid: int
    fold_workers: Sequence[FoldWorkerState] = ()


def verdict(settings: Settings, *, unanswered_s: float, stopped_s: float) -> Literal["wait", "report", "replace"]:
    """The treatment of a worker that owes an answer; `stopped_s` is 0 for a process that is not stopped.

    >>> verdict(Settings(), unanswered_s=299.0, stopped_s=0.0), verdict(Settings(), unanswered_s=11.0, stopped_s=10.5)
    ('wait', 'replace')
    """
    if stopped_s >= settings.fold_worker_stopped_s or unanswered_s >= settings.fold_worker_answer_s:
        return "replace"
    return "report" if stopped_s >= settings.fold_worker_report_s else "wait"


class FoldWorker:
    """One worker, whatever process it has at the moment. Implements `Hand`."""

    def __init__(
        self,
        number: int,
        assignment: Assignment,
        *,
        settings: Settings,
        say: Callable[[str], None],
        note: Callable[[], None],
        clock: Clock,
        forked: FoldProcess | None,
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
        self._link: FoldProcess | None = None
        self._killed_because: str | None = None

    # --- as a hand --------------------------------------------------------------------------------------------

    async def prepare(self, spans: Sequence[Span]) -> Outlook:
        answer = await self._answer(Prepare(spans), "prepares a batch")
        assert isinstance(answer, Outlook)
        return answer

    async def write(self) -> int:
        count = await self._answer(Write(), "writes a batch and holds locks of the database")
        assert isinstance(count, int)
        self._change(batches=self.state.batches + (count > 0))
        return count

    async def fold_rest(self, *, now: bool) -> bool:
        """One step of the kept views and of projections of one's own; False if nothing was behind."""
        return bool(await self._answer(FoldRest(now), "folds views or projections and may hold locks of the database"))

    async def _answer(self, request: Request, doing: str) -> object:
        if self._link is None or not self.is_ready:
            raise FoldWorkerLost
        answer = await self._watched(self._link, request, doing)
        if isinstance(answer, Failure):
            raise (DatabaseUnavailable if answer.unavailable else DatabaseError)(answer.reason)
        return answer

    # --- the process ------------------------------------------------------------------------------------------

    async def run(self) -> None:
        """Keeps the process alive from when it is wanted until this is cancelled, which kills it."""
        backoff = Backoff(first_s=self._settings.fold_worker_restart_s, longest_s=_RESTART_S_MAX)
        now_s = asyncio.get_running_loop().time
        await self.wanted.wait()
        deaths = 0
        while True:
            began_s = now_s()
            who, reason = await self._live()
            deaths = 1 if now_s() - began_s >= self._settings.fold_worker_healthy_s else deaths + 1
            pause_s = backoff.pause_s(deaths, 1.0)
            assert pause_s is not None, "there is no last attempt"
            self._say(f"{who} {reason}; restarting it in {pause_s:g} s")
            restart_ns = self._clock.wall_ns() + int(pause_s * 1e9)
            self._change("restarting", pid=None, reason=reason, restart_wall_ns=restart_ns)
            await asyncio.sleep(pause_s)
            self._change("starting", restarts=self.state.restarts + 1, restart_wall_ns=None)

    async def _live(self) -> tuple[str, str]:
        """One process from its start to its end: its name, and how it ended."""
        name = f"fold worker {self.state.number}"
        try:
            link, self._forked = self._forked or FoldProcess.spawn(), None
        except OSError as error:
            return name, f"cannot be started: {error}"
        self._change("starting", pid=link.process.pid)
        opening = asyncio.create_task(self._open(link), name=f"pycrorm {name} opens")
        try:
            how = await link.ended()
        finally:
            self.is_ready, self._link = False, None
            link.process.kill()
            opening.cancel()
            await asyncio.gather(opening, return_exceptions=True)
            link.end()
        reason, self._killed_because = self._killed_because or how, None
        return f"{name} (pid {link.process.pid})", reason

    async def _open(self, link: FoldProcess) -> None:
        try:
            await self._watched(link, self._assignment, "starts")
        except FoldWorkerLost:
            return
        except Exception as error:  # noqa: BLE001 - a projection that cannot be pickled, say: reported with the restart
            self._killed_because = f"cannot be given its work: {error}"
            link.process.kill()
            return
        self._link, self.is_ready = link, True
        self._change("running")

    async def _watched(self, link: FoldProcess, message: object, doing: str) -> Any:
        """The answer to this message. Raises `FoldWorkerLost`. Cancelled, it leaves no answer on its way: it kills."""
        now_s = asyncio.get_running_loop().time
        exchange = asyncio.ensure_future(asyncio.to_thread(link.exchange, message))
        asked_s = running_s = now_s()
        try:
            while not (await asyncio.wait([exchange], timeout=_LOOK_S))[0]:
                looked_s = now_s()
                running_s = running_s if link.is_stopped() else looked_s
                self._treat(link, doing, unanswered_s=looked_s - asked_s, stopped_s=looked_s - running_s)
            answer = exchange.result()
        except (EOFError, OSError):
            self.is_ready = False
            link.process.kill()  # one that closed its connection is of no use
            raise FoldWorkerLost from None
        except asyncio.CancelledError:
            self.is_ready = False
            exchange.add_done_callback(lambda done: done.cancelled() or done.exception())
            link.process.kill()
            raise
        if self.state.state == "stopped":
            self._continue()
        return answer

    def _treat(self, link: FoldProcess, doing: str, *, unanswered_s: float, stopped_s: float) -> None:
        settings, is_reported = self._settings, self.state.state == "stopped"
        match verdict(settings, unanswered_s=unanswered_s, stopped_s=stopped_s):
            case "replace" if self._killed_because is None:
                silent = (
                    f"was stopped for {stopped_s:.1f} s" if stopped_s else f"gave no answer for {unanswered_s:.0f} s"
                )
                self._killed_because = f"{silent} while it {doing}, and was killed"
                self.is_ready = False
                link.process.kill()
            case "report" if not is_reported:
                left_s = settings.fold_worker_stopped_s - stopped_s
                self._say(
                    f"fold worker {self.state.number} (pid {link.process.pid}) is stopped while it {doing};"
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
        self._note()


class FoldWorkers:
    """The workers of one daemon; all are gone when the context is left.

    Args:
        forked: their first processes, if they are there already; otherwise a worker is started when it is needed.
        say: gets one line for each death, stop and return.
        note: gets the states of all workers when one has changed.
    """

    def __init__(
        self,
        count: int,
        assignment: Assignment,
        *,
        settings: Settings,
        say: Callable[[str], None],
        note: Callable[[Sequence[FoldWorkerState]], None],
        forked: Sequence[FoldProcess] = (),
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

    @property
    def ready(self) -> list[FoldWorker]:
        """Those that can be asked now."""
        return [each for each in self._workers if each.is_ready]

    @property
    def are_wanted(self) -> bool:
        """Whether all are started, or are to be."""
        return all(each.wanted.is_set() for each in self._workers)

    def want(self, events: int) -> None:
        """Starts one worker if there are events to fold, and the others if there are many."""
        for worker in self._workers[: 0 if events == 0 else 1 if events < LOOKAHEAD_EVENTS_MIN else None]:
            worker.wanted.set()

    def _note(self) -> None:
        states, now_ns = [each.state for each in self._workers], self._clock.wall_ns()
        key: list[object] = [(each.state, each.since_wall_ns, each.pid) for each in states]
        before, noted_ns = self._noted
        if key != before or now_ns - noted_ns >= _NOTE_S * 1e9:
            self._noted = key, now_ns
            self._note_all(states)


class FoldWorkerTables(Tables):
    """A destination whose tables are folded by workers, and by this process while none of them is ready."""

    def __init__(self, destination: LogAndTables, workers: FoldWorkers) -> None:
        self._destination = destination
        self._workers = workers
        self._pipeline = FoldPipeline(destination.log)
        self._has_news = True

    async def append(self, records: Sequence[Record]) -> Mapping[EpisodeId, str]:
        return await self._destination.append(records)

    async def confirm(self) -> None:
        await self._destination.confirm()

    async def fold(self) -> int:
        return await self._destination.fold()

    async def fold_next_batch(self) -> bool:
        if not self._workers.are_wanted:  # a daemon with little to do has no process that it does not need
            self._workers.want(await self._pipeline.size())
        hands = self._workers.ready
        if not hands:
            folded = await self._destination.fold_next_batch()
            self._workers.want(folded)
            return folded
        try:
            with self._destination.log.translated():
                count = await self._pipeline.fold_next(hands)
            self._has_news = count is not None or await hands[0].fold_rest(now=self._has_news)
        except FoldWorkerLost:  # said by its task; the next call asks the others
            return True
        return self._has_news

    async def behind(self) -> Mapping[str, int]:
        return await self._destination.behind()

    async def stopped(self) -> Mapping[str, str]:
        return await self._destination.stopped()
