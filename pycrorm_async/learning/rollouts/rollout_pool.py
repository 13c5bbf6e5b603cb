"""Rollouts in several processes, each with its own world and recorder; this process is the daemon behind them.

Each worker is spawned, gets jobs and runs of indexes through a pipe, and answers with tallies. Which worker does which
rollout makes no difference to it. Without a place to remember, nothing is: the same rollouts, for comparison.
"""

from __future__ import annotations

import asyncio
import contextvars
import logging
import multiprocessing
import signal
import time
from collections.abc import AsyncIterator, Callable, Iterable, Iterator
from contextlib import AsyncExitStack, asynccontextmanager, contextmanager, suppress
from dataclasses import dataclass
from multiprocessing.connection import Connection
from multiprocessing.context import SpawnProcess
from pathlib import Path
from typing import Any, Self

from pycrorm_async.errors import CallerError, DatabaseUnavailable, PycrormError, SpoolTaken
from pycrorm_async.learning.policies.policy import Policy
from pycrorm_async.learning.policies.policy_file import name_of
from pycrorm_async.learning.rollouts.move_and_pick_up import MoveAndPickUp
from pycrorm_async.learning.rollouts.rollouts import Tally, batch_rollout
from pycrorm_async.learning.rollouts.scene import Scene
from pycrorm_async.memory import Memory
from pycrorm_async.operations.daemon import serve
from pycrorm_async.settings import Settings

__all__ = ["Workers", "WorkerLost", "Place", "Job", "AT_ONCE"]

AT_ONCE = 500
"""A worker is given so many rollouts at once: they are one episode."""
_TELL_S = 0.2
_LOOK_S = 0.02
_TAKE_OVER_S = 1.0
"""So often it is looked whether another daemon has left."""
_SETTINGS = Settings(flush_timeout_s=120)
_log = logging.getLogger(__name__)


class WorkerLost(PycrormError):
    """A worker died, or raised; what it had done is remembered."""


@dataclass(frozen=True)
class Place:
    """Where rollouts are remembered."""

    url: str
    spool: Path | None = None


@dataclass(frozen=True)
class Job:
    """Rollouts of one kind.

    Attributes:
        remembered: whether they are; False leaves no trace of them.
        episode_each: each is an episode, and not what a worker does at once.
    """

    scene: Scene
    policy: Policy
    seed: int
    remembered: bool = True
    episode_each: bool = False


class Workers:
    """Processes that do rollouts. They are spawned: a script that uses them does so below `if __name__ == "__main__":`.

    >>> async with Workers(2, Place("sqlite:///learn.db")) as workers:
    ...     tally = await workers.roll_out(Job(Scene(), default_policy(), seed=69), [(0, 500), (500, 500)])
    """

    def __init__(self, count: int, place: Place | None) -> None:
        """Raises `CallerError` for fewer than one."""
        if count < 1:
            raise CallerError(f"there is at least one worker, not {count}")
        self._count = count
        self._place = place
        self._links: list[_Link] = []
        self._is_free = False
        self._stack = AsyncExitStack()
        self._check_daemon: Callable[[], None] = lambda: None

    async def __aenter__(self) -> Self:
        try:
            if self._place is not None:
                self._check_daemon = await self._stack.enter_async_context(_daemon(self._place))
            with _uninterrupted():
                for _ in range(self._count):
                    self._links.append(_Link.started(self._place))
            self._is_free = True
        except BaseException:
            await self._end()
            raise
        return self

    async def __aexit__(self, *_: object) -> None:
        await self._end()

    async def _end(self) -> None:
        """Every worker ends what it is at, hands over what it recorded, and leaves; then the daemon drains the rest."""
        self._is_free = False
        for link in self._links:
            link.leave()
        for link in self._links:
            await asyncio.to_thread(link.process.join)
        await self._stack.aclose()

    async def roll_out(
        self, job: Job, runs: Iterable[tuple[int, int]], tell: Callable[[Tally], None] = lambda _: None
    ) -> Tally:
        """Does these runs of indexes (first, length); returns when all is done and, if remembered, in the tables.

        Cancelled, the workers stop after the rollout they are at; what was done is remembered.

        Raises:
            WorkerLost: one died or raised; what was done is remembered.
            CallerError: these workers are not started, at another job, or were interrupted in one.
        """
        if not self._is_free:
            raise CallerError("workers do one job at a time, and none after one that was interrupted: start others")
        self._is_free = False
        waiting = iter(runs)
        tallies = {link: Tally() for link in self._links}
        ended = Tally()
        for link in self._links:
            link.send(("job", job))
        busy = {link for link in self._links if link.given(next(waiting, None))}
        try:
            while busy:
                for link in [each for each in busy if each.has_news]:
                    word, tally = link.receive()
                    tallies[link] = tally
                    if word == "done":
                        ended, tallies[link] = ended + tally, Tally()
                        if not link.given(next(waiting, None)):
                            busy.discard(link)
                    tell(sum(tallies.values(), ended))
                self._check_daemon()
                await asyncio.sleep(_LOOK_S)
        except BaseException:
            for link in busy:
                link.send(("stop", None))
            raise
        if job.remembered:
            await self._flushed()
        self._is_free = True
        return ended

    async def _flushed(self) -> None:
        for link in self._links:
            link.send(("flush", None))
        for link in self._links:
            while not link.has_news:
                self._check_daemon()
                await asyncio.sleep(_LOOK_S)
            link.receive()


class _Link:
    """One worker, as this process sees it."""

    def __init__(self, process: SpawnProcess, pipe: Connection) -> None:
        self.process = process
        self._pipe = pipe

    @classmethod
    def started(cls, place: Place | None) -> _Link:
        context = multiprocessing.get_context("spawn")
        ours, theirs = context.Pipe()
        process = context.Process(target=_work, args=(theirs, place), name="pycrorm rollouts")
        process.start()
        theirs.close()
        return cls(process, ours)

    @property
    def has_news(self) -> bool:
        return self._pipe.poll()

    def send(self, message: tuple[str, Any]) -> None:
        with suppress(OSError):  # it is told where it is missed
            self._pipe.send(message)

    def given(self, run: tuple[int, int] | None) -> bool:
        """Whether there was a run to be given."""
        if run is not None:
            self.send(("run", run))
        return run is not None

    def receive(self) -> tuple[str, Tally]:
        try:
            word, answer = self._pipe.recv()
        except (EOFError, OSError):
            self.process.join()
            raise WorkerLost(f"a worker {_how(self.process.exitcode)}; what it had done is remembered") from None
        if word == "failed":
            raise WorkerLost(f"a worker failed: {answer}; what it had done is remembered")
        return word, answer

    def leave(self) -> None:
        self._pipe.close()


def _how(code: int | None) -> str:
    if code is None or code >= 0:
        return f"ended with exit code {code}"
    return f"was killed by {signal.Signals(-code).name}"


@contextmanager
def _uninterrupted() -> Iterator[None]:
    """What is started inside does not hear Ctrl-C, which a terminal gives to all: we tell it."""
    try:
        before = signal.signal(signal.SIGINT, signal.SIG_IGN)
    except ValueError:  # not in the main thread, which alone hears it
        yield
        return
    try:
        yield
    finally:
        signal.signal(signal.SIGINT, before)


@asynccontextmanager
async def _daemon(place: Place) -> AsyncIterator[Callable[[], None]]:
    """Drains the workers' recorders while the context lasts; while another daemon does so, that one does.

    Gives a function that raises what stopped it. Raises as `serve` does.
    """
    leave, ready = asyncio.Event(), asyncio.Event()

    def check() -> None:
        if task.done():
            task.result()

    task = asyncio.create_task(_drained(place, leave, ready), name="pycrorm daemon")
    task.add_done_callback(lambda _: ready.set())
    try:
        await ready.wait()
        check()
        yield check
    finally:
        leave.set()
        await asyncio.wait([task])
        check()


async def _drained(place: Place, leave: asyncio.Event, ready: asyncio.Event) -> None:
    """Until told to leave; `ready` once somebody drains. Raises as `serve` does, but for `SpoolTaken`."""

    def say(line: str) -> None:
        _log.info(line)
        ready.set()

    while not leave.is_set():
        try:
            await serve(place.url, spool=place.spool, leave=leave, say=say)
        except SpoolTaken:
            ready.set()
        except DatabaseUnavailable:
            if not ready.is_set():
                raise
        with suppress(TimeoutError):
            await asyncio.wait_for(leave.wait(), _TAKE_OVER_S)


# --- in the worker --------------------------------------------------------------------------------------------


def _work(pipe: Connection, place: Place | None) -> None:
    """What a worker process does until its pipe is closed, by whoever started it or by his death."""
    logging.disable(logging.WARNING)
    try:
        asyncio.run(_working(pipe, place))
    except Exception as error:  # noqa: BLE001  told to who started it, in one line, if he is still there
        with suppress(OSError):
            pipe.send(("failed", f"{type(error).__name__}: {error}"))


async def _working(pipe: Connection, place: Place | None) -> None:
    forgetful = contextvars.copy_context()  # as it is before a memory is open
    async with AsyncExitStack() as stack:
        memory = None
        if place is not None:
            opened = Memory.open(place.url, spool=place.spool, writer="daemon", settings=_SETTINGS)
            memory = await stack.enter_async_context(opened)
        job: Job | None = None
        with suppress(EOFError):
            while True:
                word, content = await asyncio.to_thread(pipe.recv)
                if word == "job":
                    job = content
                elif word == "flush" and memory is not None:
                    await memory.flush()
                    pipe.send(("flushed", Tally()))
                elif word == "run" and job is not None:
                    first, count = content
                    run = _run(pipe, job, first, count, memory if job.remembered else None)
                    context = contextvars.copy_context() if job.remembered else forgetful
                    pipe.send(("done", await asyncio.create_task(run, context=context)))


async def _run(pipe: Connection, job: Job, first: int, count: int, memory: Memory | None) -> Tally:
    told = time.monotonic()

    def tell(tally: Tally) -> None:
        nonlocal told
        if time.monotonic() > told + _TELL_S:
            told = time.monotonic()
            with suppress(OSError):  # nobody there: the pipe says so to `stop` too
                pipe.send(("so far", tally))

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
            each_in=memory if job.episode_each else None,
            stop=pipe.poll,  # whatever comes while a run is on means that it shall end
            tell=tell,
        )
