"""Perform rollouts in the workers of a Dask cluster, on any number of machines.

Theory of operation. The coordinator, which is `pycrorm learn`, submits each run of rollouts as a task to the scheduler
of the cluster, and the scheduler gives it to a worker. The worker opens a memory with ``writer="daemon"``: it records
into the spool of its own machine, which the `pycrorm writer` of that machine stores in the one database of all. A
worker needs no connection to the database, and its password is not sent. The coordinator itself drains the spool of its
machine, as it does for `Workers`.

A task ends when its rollouts are stored and folded, so the result of a finished task is in the memory even if its
machine is lost a moment later. If a worker dies, the scheduler performs its unfinished tasks again elsewhere. Seed and
index alone determine a rollout, so the second one is equal to the first; results are counted once for each task, and
`read_rollouts` returns each index once, also where the dead worker had stored a part of the run. The episode that it
left open ends as LOST when the daemon of its machine adopts its folder, or at the next start of one.

If the coordinator dies or is interrupted, the scheduler forgets the tasks that have not begun. Those that have begun
end, and their rollouts are recorded.
"""

from __future__ import annotations

import asyncio
import concurrent.futures
import logging
import pkgutil
import socket
import threading
from collections.abc import AsyncIterator, Callable, Iterable, Iterator
from contextlib import AsyncExitStack, asynccontextmanager
from dataclasses import dataclass
from pathlib import Path
from typing import TYPE_CHECKING, Final, Self, TypeAlias

from pycrorm_async import __version__
from pycrorm_async.errors import CallerError, MissingExtra
from pycrorm_async.learning import pool
from pycrorm_async.learning.pool import MemoryLocation, RolloutTask, WorkerLost, Workers
from pycrorm_async.learning.rollouts import Tally
from pycrorm_async.memory import Memory
from pycrorm_async.queue.spool import Spool
from pycrorm_async.store.address import shared_address
from pycrorm_async.world.engines import engine_class

if TYPE_CHECKING:
    from distributed import Client, Future

_CONNECT_S: Final = 10.0
"""Bounds the wait for the scheduler, and for its first worker."""
_ALONE_S: Final = 60.0
"""Bounds the time without any worker, after all of them have died."""
_ROLLOUTS_PER_TASK_MIN: Final = 50
"""Bounds a task from below: a world and a recorder for each cost as much as some ten rollouts."""
_TASKS_PER_THREAD: Final = 4
"""The tasks that each thread of the cluster gets at least, so that all end at about the same time."""


@dataclass(frozen=True)
class _Destination:
    """The spool of the workers, which has one path on all machines, and the log in which its daemons store.

    Attributes:
        url: of the database, without a password.
        host: name of the coordinator's machine, if the database is one of its files.
    """

    spool: Path
    url: str
    log_id: str | None
    host: str | None

    def check(self) -> None:
        """Raise `CallerError` unless a daemon of this machine stores what is recorded here in that log."""
        here = socket.gethostname()
        if self.host not in (None, here):
            raise CallerError(
                f"{self.url} is a file of {self.host}, and a worker is on {here}: name a memory on PostgreSQL"
            )
        spool = Spool(self.spool)
        if not spool.has_writer:
            raise CallerError(
                f"no `pycrorm writer` drains the spool {self.spool} of {here}: start `pycrorm writer --url {self.url}"
                f" --spool {self.spool}` there"
            )
        if spool.log_id() not in (None, self.log_id):
            raise CallerError(
                f"the `pycrorm writer` of {here} drains {self.spool} into another database than {self.url}: start it"
                " with this --url, or name another --spool"
            )


class ClusterWorkers:
    """A pool of the workers of a Dask cluster, with the methods of `Workers`.

    >>> async with ClusterWorkers("tcp://lab:8786", MemoryLocation("postgresql://robot@lab/memory")) as workers:
    ...     tally = await workers.roll_out(RolloutTask(Scene(), default_policy(), seed=69), [(0, 500), (500, 500)])

    Args:
        cluster: the address of the scheduler, as `dask scheduler` prints it.
        place: the memory, and a spool with this path on each machine; None records nothing.
    """

    def __init__(self, cluster: str, place: MemoryLocation | None) -> None:
        self._cluster = cluster
        self._place = place
        self._destination: _Destination | None = None
        self._daemon: list[asyncio.Task[None]] = []
        self._stack = AsyncExitStack()

    async def __aenter__(self) -> Self:
        """Connect to the cluster, and drain the spool of this machine.

        Raises `MissingExtra`, and `CallerError` if no scheduler or worker answers, or a worker has another version.
        """
        async with AsyncExitStack() as stack:
            self._client = await stack.enter_async_context(_connected(self._cluster))
            if self._place is not None:
                address = shared_address(self._place.url)
                spool = (self._place.spool or address.default_spool).absolute()
                place = MemoryLocation(self._place.url, spool)
                self._daemon.append(await stack.enter_async_context(pool.run_daemon(place)))
                host = socket.gethostname() if address.is_sqlite else None
                self._destination = _Destination(spool, address.to_type, Spool(spool).log_id(), host)
            self._stack = stack.pop_all()
        return self

    async def __aexit__(self, *_: object) -> None:
        await self._stack.aclose()

    async def roll_out(
        self, job: RolloutTask, runs: Iterable[tuple[int, int]], report: Callable[[Tally], None] = lambda _: None
    ) -> Tally:
        """Perform the runs of indexes (first, length); return when all are performed and, if recorded, visible.

        On cancellation, runs that have begun go on in the workers, which record them.

        Raises:
            WorkerLost: a run failed or killed its workers, the scheduler or all workers ended.
            CallerError: the memory cannot be reached from a worker, or a worker has another engine.
        """
        tally, alone_s, whole = Tally(), 0.0, list(runs)
        job_at = job, engine_class().__name__, self._destination if job.recorded else None
        futures: list[Future] = []
        working: set[asyncio.Task[Tally]] = set()
        try:
            threads = sum((await self._client.nthreads()).values())
            length = -(-sum(count for _, count in whole) // max(1, _TASKS_PER_THREAD * threads))
            for first, count in _divided(whole, max(length, _ROLLOUTS_PER_TASK_MIN)):
                futures.append(self._client.submit(_perform, *job_at, first, count, pure=False))
            working |= {asyncio.create_task(self._result(each), name="pycrorm rollouts") for each in futures}
            while working:
                done, _ = await asyncio.wait(
                    [*working, *self._daemon], timeout=_CONNECT_S, return_when=asyncio.FIRST_COMPLETED
                )
                alone_s = 0.0 if done or await self._client.nthreads() else alone_s + _CONNECT_S
                if alone_s >= _ALONE_S:
                    raise WorkerLost(f"the cluster has had no workers for {alone_s:.0f} s; {_KEPT}")
                for task in done:
                    tally += task.result() or Tally()  # the daemon's task ends with an error only
                    report(tally)
                working -= done
        except OSError as error:  # of the client alone: `_result` translates those of the workers
            raise WorkerLost(f"the scheduler at {self._cluster} does not answer ({error}); {_KEPT}") from None
        finally:
            for task in working:
                task.cancel()
            for each in futures:
                each.release()  # the scheduler forgets those that have not begun
        return tally

    async def _result(self, future: Future) -> Tally:
        try:
            tally: Tally = await future
        except CallerError:
            raise
        except concurrent.futures.CancelledError:
            raise WorkerLost(f"the scheduler at {self._cluster} has ended; {_KEPT}") from None
        except Exception as error:  # noqa: BLE001 - whatever a worker raised
            raise WorkerLost(f"a rollout worker failed: {type(error).__name__}: {error}; {_KEPT}") from None
        return tally


RolloutPool: TypeAlias = Workers | ClusterWorkers


def rollout_pool(workers: int, cluster: str | None, place: MemoryLocation | None) -> RolloutPool:
    """Return a pool of so many processes of this machine, or of the cluster with this address. Raises `CallerError`."""
    return Workers(workers, place) if cluster is None else ClusterWorkers(cluster, place)


_KEPT: Final = "finished rollouts are recorded"


def _divided(runs: Iterable[tuple[int, int]], length_max: int) -> Iterator[tuple[int, int]]:
    for first, count in runs:
        for begin in range(first, first + count, length_max):
            yield begin, min(length_max, first + count - begin)


@asynccontextmanager
async def _connected(cluster: str) -> AsyncIterator[Client]:
    """Yield a client of this scheduler.

    Raises `MissingExtra`, and `CallerError` if no scheduler or worker answers, or a worker has another version.
    """
    try:
        from distributed import Client
    except ImportError:
        raise MissingExtra("distributed is not installed: pip install 'pycrorm-async[cluster]'") from None
    logging.getLogger("distributed.client").setLevel(logging.CRITICAL)  # what it logs of a fault, our errors say
    client = Client(cluster, asynchronous=True, timeout=_CONNECT_S)
    try:
        await client
    except (OSError, ValueError) as error:
        await client.close()
        raise CallerError(f"no Dask scheduler answers at {cluster}: {error}") from None
    async with client:
        await _check_workers(client, cluster)
        yield client


async def _check_workers(client: Client, cluster: str) -> None:
    try:
        await client.wait_for_workers(1, timeout=_CONNECT_S)
    except TimeoutError:
        raise CallerError(
            f"the scheduler at {cluster} has no workers: start `dask worker {cluster} --nworkers -1 --nthreads 2` on"
            " each machine"
        ) from None
    # A function of the standard library, because the workers may not have this package.
    versions = await client.run(pkgutil.resolve_name, "pycrorm_async:__version__", on_error="return")
    for worker, version in versions.items():
        if version != __version__:
            fault = f"has version {version}"
            if isinstance(version, Exception):
                fault = f"cannot import the package ({version})"
            raise CallerError(f"the worker {worker} {fault}: install version {__version__} there, as here")


async def check_cluster(cluster: str) -> None:
    """Check that rollouts can be performed there. Raises what `ClusterWorkers.__aenter__` raises."""
    async with _connected(cluster):
        pass


# --- in the worker --------------------------------------------------------------------------------------------


def _perform(job: RolloutTask, engine: str, destination: _Destination | None, first: int, count: int) -> Tally:
    """Perform one run, in a thread of a worker; return when it is visible. Raises `CallerError`."""
    with _IN_TURN:
        own = engine_class().__name__
    if own != engine:
        raise CallerError(
            f"a worker on {socket.gethostname()} has the engine {own}, and the coordinator {engine}, in which the same"
            " rollouts may end differently: install the same"
        )
    return asyncio.run(_perform_in(destination, job, first, count))


async def _perform_in(destination: _Destination | None, job: RolloutTask, first: int, count: int) -> Tally:
    if destination is None:
        with _IN_TURN:
            return await pool.perform_run(job, first, count, None)
    destination.check()
    opened = Memory.open(destination.url, spool=destination.spool, writer="daemon", settings=pool.SETTINGS)
    async with opened as memory:
        with _IN_TURN:
            tally = await pool.perform_run(job, first, count, memory)
        await memory.flush()
    return tally


_IN_TURN: Final = threading.Lock()
"""Held by the thread of a worker that performs rollouts, because the engines are not made for several. A second thread
keeps the worker busy while the first one waits until its rollouts are stored."""
