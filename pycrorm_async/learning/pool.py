"""Perform rollouts in several worker processes, each with its own world and recorder, and drain their recorders.

Theory of operation
-------------------

The caller's process holds a `Workers` object, one `ChildProcess` per worker, and one task that runs the daemon. Each
worker process is forked from a fork server (`operations.workers`) and connected by one pipe. With a `MemoryLocation`
each worker opens a memory with ``writer="daemon"``: it writes to its own folder in the spool, and the daemon task
drains all of them into the database. Without one nothing is recorded, and no daemon runs; the rollouts are the same.
Seed and index alone determine a rollout, so it does not matter which worker performs it.

The parent sends ``job`` (scene, policy, seed), ``run`` (first index, length), ``flush`` and ``stop``. A worker answers
a run with ``so far`` messages, at most one per 0.2 s, and one ``done``; it answers a flush with ``flushed``; an
exception ends the worker with ``failed``. A worker has at most one run at a time, and while it has one the parent
sends it nothing but ``stop``. Therefore the worker does not read the pipe during a run: any pending message, and also
the end of file after the parent has closed the pipe or died, makes ``poll`` true and ends the run after the current
rollout.

A `Workers` object performs one job at a time (`_is_free`). After an interrupted or failed job it accepts no other,
because answers to the old job may still be in the pipes.

A worker that dies closes its end of the pipe; the parent reads the end of file and raises `WorkerLost`. Its finished
rollouts survive in its spool folder, which the daemon adopts and drains. If the parent dies, every worker reads the end
of file, ends its run and closes its memory; the next `recover` or daemon drains the folders. Workers ignore the signals
of a terminal (`operations.workers`): the parent alone handles them and stops the workers.

At exit the parent closes the pipes, waits for the processes in a thread so that the daemon keeps draining meanwhile,
and stops the daemon last. Only one daemon drains a spool: while another holds it (`SpoolTaken`), the task retries every
second and takes over when that one ends, so that a flush always has a daemon to wait for.
"""

import asyncio
import contextvars
import logging
import signal
import time
from collections.abc import AsyncIterator, Callable, Coroutine, Iterable
from contextlib import AsyncExitStack, asynccontextmanager, suppress
from dataclasses import dataclass
from functools import partial
from multiprocessing.connection import Connection
from pathlib import Path
from typing import Any, Self

from pycrorm_async.errors import CallerError, DatabaseUnavailable, PycrormError, SpoolTaken
from pycrorm_async.learning.move_and_pick_up import MoveAndPickUp
from pycrorm_async.learning.policy_file import AnyPolicy, name_of
from pycrorm_async.learning.rollouts import Tally, batch_rollout
from pycrorm_async.learning.scenes import Scene
from pycrorm_async.memory import Memory
from pycrorm_async.operations.daemon import serve
from pycrorm_async.operations.workers import ChildProcess
from pycrorm_async.settings import Settings

ROLLOUTS_PER_RUN = 500
"""Rollouts in one run of a worker, which is one episode: enough to make the cost of building the world negligible."""
_PROGRESS_INTERVAL_S = 0.2
"""The shortest time in s between two reports of progress."""
_TAKEOVER_INTERVAL_S = 1.0
"""Time between attempts to drain the spool while another daemon drains it."""
SETTINGS = Settings(flush_timeout_s=120)
"""Workers wait longer than usual in `flush`, because one daemon drains and folds the records of all of them."""
_log = logging.getLogger(__name__)


class WorkerLost(PycrormError):
    """A worker process died or raised; its finished rollouts are recorded."""


@dataclass(frozen=True)
class MemoryLocation:
    """The database URL and the spool that rollouts are recorded to; without a spool, the URL's default one."""

    url: str
    spool: Path | None = None


@dataclass(frozen=True)
class RolloutTask:
    """The parameters that the rollouts of one `roll_out` share.

    Attributes:
        recorded: whether rollouts are recorded.
        episode_each: whether each rollout is an episode; otherwise each run is one.
    """

    scene: Scene
    policy: AnyPolicy
    seed: int
    recorded: bool = True
    episode_each: bool = False


class Workers:
    """A pool of worker processes that perform rollouts.

    The processes import the main module, so a script must use the pool below `if __name__ == "__main__":`.

    >>> async with Workers(2, MemoryLocation("sqlite:///learn.db")) as workers:
    ...     tally = await workers.roll_out(RolloutTask(Scene(), default_policy(), seed=69), [(0, 500), (500, 500)])
    """

    def __init__(self, count: int, place: MemoryLocation | None) -> None:
        """Raise `CallerError` if count < 1."""
        if count < 1:
            raise CallerError(f"worker count must be >= 1, got {count}")
        self._count = count
        self._place = place
        self._processes: list[ChildProcess] = []
        self._daemon: list[asyncio.Task[None]] = []
        self._is_free = False
        self._stack = AsyncExitStack()

    async def __aenter__(self) -> Self:
        async with AsyncExitStack() as stack:
            if self._place is not None:
                self._daemon.append(await stack.enter_async_context(run_daemon(self._place)))
            stack.push_async_callback(self._end_workers)
            for _ in range(self._count):
                process = ChildProcess.start(_run_worker, "pycrorm rollouts", self._place, dies_with_parent=False)
                self._processes.append(process)
            self._is_free = True
            self._stack = stack.pop_all()
        return self

    async def __aexit__(self, *_: object) -> None:
        await self._stack.aclose()

    async def _end_workers(self) -> None:
        """Close the pipes, and wait until the workers have closed their memories and exited; the daemon ends later."""
        self._is_free = False
        for process in self._processes:
            process.connection.close()
        for process in self._processes:
            await asyncio.to_thread(process.process.join)

    async def roll_out(
        self, job: RolloutTask, runs: Iterable[tuple[int, int]], report: Callable[[Tally], None] = lambda _: None
    ) -> Tally:
        """Perform the runs of indexes (first, length); return when all are performed and, if recorded, visible.

        On cancellation the workers stop after their current rollout; finished rollouts are recorded.

        Raises:
            WorkerLost: a worker died or raised; finished rollouts are recorded.
            CallerError: the workers are not started, perform another job, or were interrupted in one.
        """
        if not self._is_free:
            raise CallerError("workers do one job at a time, and none after an interrupted job: start new workers")
        self._is_free = False
        pending_runs = iter(runs)
        tallies: dict[tuple[int, int], Tally] = {}

        def note(run: tuple[int, int], tally: Tally) -> None:
            tallies[run] = tally
            report(sum(tallies.values(), Tally()))

        async def work(process: ChildProcess) -> None:
            with suppress(OSError):  # of a dead worker: `_answer` raises `WorkerLost`
                process.connection.send(("job", job))
            for run in pending_runs:
                note(run, await _answer(process, ("run", run), partial(note, run)))

        try:
            await self._each(work)
        except BaseException:
            for process in self._processes:
                with suppress(OSError):  # of a dead worker
                    process.connection.send(("stop", None))
            raise
        if job.recorded:
            await self._each(lambda process: _answer(process, ("flush", None)))
        self._is_free = True
        return sum(tallies.values(), Tally())

    async def _each(self, work: Callable[[ChildProcess], Coroutine[Any, Any, object]]) -> None:
        """Do this with each worker; raise the first error of one, or of the daemon."""
        working = {asyncio.create_task(work(each), name=f"pycrorm rollouts {each.pid}") for each in self._processes}
        try:
            while working:
                done, _ = await asyncio.wait([*working, *self._daemon], return_when=asyncio.FIRST_COMPLETED)
                for task in done:
                    task.result()
                working -= done
        finally:
            for task in working:
                task.cancel()


async def _answer(
    process: ChildProcess, message: tuple[str, Any], report: Callable[[Tally], None] = lambda _: None
) -> Tally:
    """Send a message and return the answer; `report` receives the results so far. Raises `WorkerLost`."""
    try:
        kind, answer = await process.exchange(message)
        while kind == "so far":
            report(answer)
            kind, answer = await process.receive()
    except (EOFError, OSError):
        process.process.join()
        ending = _describe_exit(process.process.exitcode)
        raise WorkerLost(f"a rollout worker {ending}; its finished rollouts are recorded") from None
    if kind == "failed":
        raise WorkerLost(f"a rollout worker failed: {answer}; its finished rollouts are recorded")
    assert isinstance(answer, Tally)
    return answer


def _describe_exit(code: int | None) -> str:
    if code is None or code >= 0:
        return f"ended with exit code {code}"
    return f"was killed by {signal.Signals(-code).name}"


@asynccontextmanager
async def run_daemon(place: MemoryLocation) -> AsyncIterator[asyncio.Task[None]]:
    """Drain the workers' recorders until the context ends, except while another daemon drains the spool.

    Yields the task of the daemon, which ends early only with an error. Raises the errors of `serve`.
    """
    stop, ready = asyncio.Event(), asyncio.Event()
    task = asyncio.create_task(_drain(place, stop, ready), name="pycrorm daemon")
    task.add_done_callback(lambda _: ready.set())
    try:
        await ready.wait()
        if task.done():
            task.result()
        yield task
    finally:
        stop.set()
        await asyncio.wait([task])
        task.result()


async def _drain(place: MemoryLocation, stop: asyncio.Event, ready: asyncio.Event) -> None:
    """Drain until `stop` is set; set `ready` when this or another daemon drains.

    Raises the errors of `serve`, but retries after `SpoolTaken` and, once ready, after `DatabaseUnavailable`.
    """

    def log(line: str) -> None:
        _log.info(line)
        ready.set()

    while not stop.is_set():
        try:
            await serve(place.url, spool=place.spool, stop=stop, report=log)
        except SpoolTaken:
            ready.set()
        except DatabaseUnavailable:
            if not ready.is_set():
                raise
        with suppress(TimeoutError):
            await asyncio.wait_for(stop.wait(), _TAKEOVER_INTERVAL_S)


# --- in the worker --------------------------------------------------------------------------------------------


def _run_worker(pipe: Connection, place: MemoryLocation | None) -> None:
    """Serve jobs until the pipe is closed, by the parent or because the parent died."""
    logging.disable(logging.WARNING)
    try:
        asyncio.run(_serve_jobs(pipe, place))
    except Exception as error:  # noqa: BLE001  reported to the parent in one line, if the parent is alive
        with suppress(OSError):
            pipe.send(("failed", f"{type(error).__name__}: {error}"))


async def _serve_jobs(pipe: Connection, place: MemoryLocation | None) -> None:
    context_without_memory = contextvars.copy_context()  # copied before a memory is open: hooks record nothing in it
    async with AsyncExitStack() as stack:
        memory = None
        if place is not None:
            opened = Memory.open(place.url, spool=place.spool, writer="daemon", settings=SETTINGS)
            memory = await stack.enter_async_context(opened)
        job: RolloutTask | None = None
        with suppress(EOFError):
            while True:
                kind, content = await asyncio.to_thread(pipe.recv)
                if kind == "job":
                    job = content
                elif kind == "flush" and memory is not None:
                    await memory.flush()
                    pipe.send(("flushed", Tally()))
                elif kind == "run" and job is not None:
                    first, count = content
                    run = _run(pipe, job, first, count, memory if job.recorded else None)
                    context = contextvars.copy_context() if job.recorded else context_without_memory
                    pipe.send(("done", await asyncio.create_task(run, context=context)))


async def _run(pipe: Connection, job: RolloutTask, first: int, count: int, memory: Memory | None) -> Tally:
    reported_s = time.monotonic()

    def report(tally: Tally) -> None:
        nonlocal reported_s
        if time.monotonic() > reported_s + _PROGRESS_INTERVAL_S:
            reported_s = time.monotonic()
            with suppress(OSError):  # the parent is dead: `stop` sees the end of file too
                pipe.send(("so far", tally))

    # During a run the parent sends nothing but `stop`.
    return await perform_run(job, first, count, memory, stop=pipe.poll, report_progress=report)


async def perform_run(
    job: RolloutTask,
    first: int,
    count: int,
    memory: Memory | None,
    *,
    stop: Callable[[], bool] = lambda: False,
    report_progress: Callable[[Tally], None] = lambda _: None,
) -> Tally:
    """Perform the rollouts with these indexes in a world of their own, recorded in this memory."""
    async with AsyncExitStack() as stack:
        if memory is not None and not job.episode_each:
            description = f"rollouts {first} to {first + count - 1} under policy {name_of(job.policy)}"
            await stack.enter_async_context(memory.episode(description=description, plan="learn", seed=job.seed))
        stage = stack.enter_context(job.scene.entered())
        return await batch_rollout(
            MoveAndPickUp(stage.target, policy=job.policy),
            count,
            seed=job.seed,
            first=first,
            scene=str(job.scene),
            reset=stage.reset,
            prepare=stage.prepare if job.scene.varies else None,
            each_in=memory if job.episode_each else None,
            stop=stop,
            report_progress=report_progress,
        )
