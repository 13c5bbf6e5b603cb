"""Rollouts in the worker processes of a real Dask cluster: those of one process, also when a worker is killed."""

from __future__ import annotations

import asyncio
import os
import signal
import socket
import time
from collections.abc import AsyncIterator, Callable
from contextlib import asynccontextmanager
from pathlib import Path
from typing import Any

import pytest

from pycrorm_async import Reading, recover
from pycrorm_async.errors import CallerError
from pycrorm_async.learning import Scene, cluster, default_policy, name_of
from pycrorm_async.learning.cluster import ClusterWorkers
from pycrorm_async.learning.experiment import read_rollouts
from pycrorm_async.learning.pool import MemoryLocation, RolloutTask, WorkerLost, Workers
from pycrorm_async.learning.rollouts import Tally, tally_of
from pycrorm_async.queue.spool import Spool
from tests.databases import ask

pytest.importorskip("distributed", reason="needs the extra 'cluster'")
pytestmark = pytest.mark.slow

JOB = RolloutTask(Scene(), default_policy(), seed=69)


@asynccontextmanager
async def started(workers: int, **options: Any) -> AsyncIterator[Any]:
    """A scheduler of this process, with so many worker processes."""
    from distributed import LocalCluster

    own = {"threads_per_worker": 2, "processes": True, "dashboard_address": ":0", "asynchronous": True}
    async with LocalCluster(n_workers=workers, **own, **options) as one:
        yield one


def until_events(url: str) -> None:
    """Wait until each worker is in the middle of a run."""
    recording = "SELECT 1 FROM event GROUP BY episode HAVING count(*) > 200"
    while ask(url, f"SELECT count(*) FROM ({recording}) AS recording") < [(2,)]:
        time.sleep(0.01)


def once(act: Callable[[], None]) -> Callable[[Tally], None]:
    """Return a progress callback that acts at the first report."""
    acts = [act]
    return lambda _tally: acts.pop()() if acts else None


@pytest.mark.soak_on("postgresql")
async def test_a_cluster_with_a_killed_worker_remembers_the_rollouts_of_one_process(
    database_url: str, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setattr(cluster, "_ROLLOUTS_PER_TASK_MIN", 200)  # so that each thread begins its only task at once
    place, alone = MemoryLocation(database_url, tmp_path / "spool"), MemoryLocation(f"sqlite:///{tmp_path}/alone.db")
    await recover(place.url, spool=place.spool)
    async with started(2) as one, ClusterWorkers(one.scheduler_address, place) as workers:
        rolling = asyncio.create_task(workers.roll_out(JOB, [(0, 500), (500, 300)]))
        await asyncio.to_thread(until_events, place.url)
        os.kill(next(iter(one.workers.values())).process.pid, signal.SIGKILL)
        tally = await rolling
        unrecorded = RolloutTask(JOB.scene, JOB.policy, JOB.seed, recorded=False)
        first = await workers.roll_out(unrecorded, [(0, 100)])
    async with Workers(1, alone) as processes:
        assert await processes.roll_out(JOB, [(0, 800)]) == tally
    frames = []
    for each in (place, alone):
        await recover(each.url, spool=each.spool)  # ends the episodes of the killed worker
        async with Reading.open(each.url) as reading:
            frames.append(await read_rollouts(reading, Scene(), name_of(default_policy()), 69, 800))
    assert (len(frames[0]), tally_of(frames[0])) == (800, tally)
    assert frames[0].reset_index(drop=True).equals(frames[1].reset_index(drop=True))
    assert tally_of(frames[1][:100]) == first
    lost = ask(place.url, "SELECT count(*) FROM process_metadata WHERE status = 'LOST'")
    assert lost > [(0,)], "the worker was killed in the middle of a run"


def test_a_worker_refuses_to_record_where_its_rollouts_would_not_reach_the_memory(tmp_path: Path) -> None:
    """Called as a worker calls it, because the workers of these tests are all on this machine."""
    spool, here = Spool(tmp_path / "spool"), socket.gethostname()

    def refused(log_id: str = "one", host: str = here) -> str:
        place = cluster._Destination(spool.path, "sqlite:///x.db", log_id, host)
        with pytest.raises(CallerError) as refusal:
            cluster._perform(JOB, "Bullet", place, 0, 1)
        return str(refusal.value)

    assert f"is a file of lab, and a worker is on {here}: name a memory on PostgreSQL" in refused(host="lab")
    assert f"no `pycrorm writer` drains the spool {spool.path} of {here}: start `pycrorm writer --url" in refused()
    writer = spool.take_writer()
    assert writer is not None
    spool.bind("one")
    assert "into another database than sqlite:///x.db" in refused("two")
    writer.release()
    with pytest.raises(CallerError, match=r"has the engine .*, and the coordinator Other"):
        cluster._perform(JOB, "Other", None, 0, 1)


async def test_a_cluster_without_scheduler_workers_or_this_version_is_refused(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(cluster, "_CONNECT_S", 0.5)

    async def refused(address: str) -> str:
        with pytest.raises(CallerError) as refusal:
            async with ClusterWorkers(address, None):
                pass
        return str(refusal.value)

    assert "no Dask scheduler answers at tcp://127.0.0.1:9: " in await refused("tcp://127.0.0.1:9")
    async with started(0) as one:
        assert f"has no workers: start `dask worker {one.scheduler_address}" in await refused(one.scheduler_address)
        monkeypatch.setattr(cluster, "_CONNECT_S", 30)
        one.scale(1)
        await one
        monkeypatch.setattr(cluster, "__version__", "9.9")
        assert "has version 0.2.0.dev0: install version 9.9 there" in await refused(one.scheduler_address)


@pytest.mark.soak
async def test_a_scheduler_or_workers_that_end_are_one_line_and_finished_rollouts_are_kept(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    place = MemoryLocation(f"sqlite:///{tmp_path}/memory.db")
    await recover(place.url)
    async with started(1) as one, ClusterWorkers(one.scheduler_address, place) as workers:
        with pytest.raises(WorkerLost, match=r"the scheduler at tcp.* has ended; finished rollouts are recorded"):
            await workers.roll_out(
                JOB, [(0, 500), (500, 500)], once(lambda: one.loop.add_callback(one.scheduler.close))
            )
        with pytest.raises(WorkerLost, match=r"the scheduler at tcp.* finished rollouts are recorded"):
            await workers.roll_out(JOB, [(0, 500)])
    async with Reading.open(place.url) as reading:
        assert len(await read_rollouts(reading, Scene(), name_of(default_policy()), 69, 1000)) >= 125
    monkeypatch.setattr(cluster, "_ALONE_S", 1.0)
    async with started(1) as one, ClusterWorkers(one.scheduler_address, None) as workers:
        monkeypatch.setattr(cluster, "_CONNECT_S", 0.5)
        unrecorded = RolloutTask(JOB.scene, JOB.policy, JOB.seed, recorded=False)
        with pytest.raises(WorkerLost, match=r"the cluster has had no workers for 1 s; finished rollouts"):
            await workers.roll_out(unrecorded, [(0, 1000)], once(lambda: one.scale(0)))
