"""Start the fold workers of a daemon, which fold while it appends, or those of a rebuild.

    async with FoldWorkers(2, assignment, settings=settings, report=report, note=note) as workers:
        tables = FoldWorkerTables(destination, workers)

Theory of operation. A worker is a process (`fold_worker`) with one connection to its parent, a daemon or a rebuild. The
parent sends a request and waits for the answer; between requests a worker has no lock and no transaction. Checkpoints
are in the tables, so the events that a dead worker had not committed are folded again by another worker or by the
parent. Therefore the parent may kill a worker at any moment, and does so when it exits. There are two strategies: the
workers of a daemon fold the batches of one pipeline in turn, those of a rebuild fold one share of the episodes each.
While no worker of a daemon is ready the daemon folds itself, so a worker that cannot be started costs speed only.
"""

from __future__ import annotations

import asyncio
from collections.abc import Callable, Iterator, Mapping, Sequence
from contextlib import ExitStack, contextmanager
from importlib import import_module
from typing import Final, Self

import msgspec

from pycrorm_async.clock import SYSTEM_CLOCK, Clock
from pycrorm_async.operations.destination import LogAndTables, shared_address
from pycrorm_async.operations.fold_requests import Assignment, main
from pycrorm_async.operations.fold_worker import FoldWorker, FoldWorkerLost, FoldWorkerState
from pycrorm_async.operations.processes import ChildProcess
from pycrorm_async.projections.run.pipeline import LOOKAHEAD_EVENTS_MIN, FoldPipeline
from pycrorm_async.projections.run.targets import LiveTarget
from pycrorm_async.settings import Settings
from pycrorm_async.store.dialects import dialect_of
from pycrorm_async.writer.ports import Tables

WORKERS: Final = 2
"""The fold workers of one daemon: one writes while the other prepares. More would compete for the database's writes."""
_NOTE_S: Final = 1.0
"""The longest delay of a note of the number of batches; a change of state is noted at once."""


class DaemonNote(msgspec.Struct, frozen=True):
    """The note in the spool's lock file, which `pycrorm status` reads."""

    pid: int
    fold_workers: Sequence[FoldWorkerState] = ()


class FoldWorkers:
    """The workers of one daemon. All of them are killed when the context ends.

    Args:
        forked: the first processes, if the command forked them; a worker without one is started when it is needed.
        report: called with one line for each death, stop and continuation.
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
        self._noted: list[object] = []
        self._later: asyncio.TimerHandle | None = None
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
        if self._later is not None:
            self._later.cancel()

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
        """Note the states now if one has changed, otherwise the number of batches a little later."""
        states = [each.state for each in self._workers]
        key: list[object] = [(each.state, each.since_wall_ns, each.pid) for each in states]
        if key != self._noted:
            self._noted = key
            self._note_all(states)
        elif self._later is None:
            self._later = asyncio.get_running_loop().call_later(_NOTE_S, self._note_batches)

    def _note_batches(self) -> None:
        self._later = None
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
            if folded:
                self._workers.want(events=1)
            return folded
        try:
            with self._destination.log.translated():
                count = await self._pipeline.fold_next(workers)
            self._has_news = count is not None or await workers[0].fold_rest(now=self._has_news)
        except FoldWorkerLost:  # reported by the worker's task; the next call uses the other workers
            return True
        return self._has_news

    async def behind(self) -> Mapping[str, int]:
        return await self._destination.behind()

    async def stopped(self) -> Mapping[str, str]:
        return await self._destination.stopped()
