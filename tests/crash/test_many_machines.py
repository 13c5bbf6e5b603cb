"""Run sixteen robots on two machines with one database, behind a network that keeps failing in every way.

Robots and daemons are killed meanwhile. The test compares the output of the robots with the database, which it reads
through a connection that does not use the memory.
"""

from __future__ import annotations

import asyncio
import itertools
import json
import random
import signal
from contextlib import AsyncExitStack, suppress
from pathlib import Path
from typing import NoReturn
from urllib.parse import urlsplit

import pytest

from pycrorm_async.testing.postgresql_proxy import Proxy, proxy_before
from tests.commands import pycrorm
from tests.crash.forked_processes import DaemonProcess, ForkedProcess
from tests.crash.step_robot import RecordedSteps, walk
from tests.databases import Server

pytestmark = pytest.mark.slow

ROBOTS_A_MACHINE = 8
LANES = 2
"""Plans that run concurrently in one process, each in episodes of its own; two are enough to interleave."""
HANGS_S = 600.0


class Machine:
    """A spool, its daemon, a proxy between them and the server, and the robots that live."""

    def __init__(self, folder: Path, proxy: Proxy, database: str, rng: random.Random) -> None:
        folder.mkdir()
        self.proxy = proxy
        self.url = proxy.url(database)
        self.spool = folder / "spool"
        self.rng = rng
        self.daemon: DaemonProcess | None = None
        self.robots: list[ForkedProcess] = []
        self.names = itertools.count()

    async def start_robot(self) -> None:
        name = f"{self.spool.parent.name}{next(self.names)}"
        arguments = self.url, str(self.spool), "daemon", name, self.rng.randrange(2**31), LANES
        self.robots.append(ForkedProcess(walk, *arguments))
        await asyncio.to_thread(self.robots[-1].wait_for, "did")

    async def keep_daemon_running(self) -> NoReturn:
        """Start the daemon again whenever it has ended, as a service manager does."""
        while True:
            self.daemon = DaemonProcess(self.url, self.spool)
            code = await asyncio.to_thread(self.daemon.wait, HANGS_S)
            # 3: the database was unavailable when the daemon started
            assert code in (3, -signal.SIGKILL), self.daemon.lines
            await asyncio.sleep(0.1)

    def folders(self) -> list[str]:
        """List the recorders' folders, which are deleted when all their records are stored."""
        return [path.name for path in self.spool.iterdir() if path.is_dir() and path.name != "stored"]

    def clear(self) -> None:
        for robot in self.robots:
            with suppress(ValueError):  # the process has already ended
                robot.process.kill()
        if self.daemon is not None:
            self.daemon.kill()


async def work(machines: list[Machine], steps: RecordedSteps, rng: random.Random, seconds: float) -> None:
    """Run everything concurrently for `seconds`, then restore the network and let the daemons store the rest."""
    async with asyncio.TaskGroup() as tasks:
        keepers = [tasks.create_task(machine.keep_daemon_running()) for machine in machines]
        for machine in machines:
            for _ in range(ROBOTS_A_MACHINE):
                await machine.start_robot()
        troubles = [tasks.create_task(machine.proxy.trouble(rng, pause_s=0.25)) for machine in machines]
        await kill_repeatedly(machines, steps, seconds)
        living = [robot for machine in machines for robot in machine.robots]
        for robot in living:
            robot.request_stop()
        for robot in living:
            assert await asyncio.to_thread(robot.wait) == 0
            assert robot.lines[-1] == "faults 0"
            steps.add(robot.words)
        for trouble in troubles:
            trouble.cancel()
        async with asyncio.timeout(HANGS_S):
            while any(machine.folders() for machine in machines):  # noqa: ASYNC110  other processes delete them
                await asyncio.sleep(0.05)
        for keeper in keepers:
            keeper.cancel()
    for machine in machines:
        assert machine.daemon is not None
        assert await asyncio.to_thread(machine.daemon.stop) == 0, machine.daemon.lines


async def kill_repeatedly(machines: list[Machine], steps: RecordedSteps, seconds: float) -> None:
    """Kill one robot of each machine and one daemon in turn until the time is over, each daemon at least once."""
    deadline = asyncio.get_running_loop().time() + seconds
    for count, machine in enumerate(itertools.cycle(machines), 1):
        await asyncio.sleep(min(seconds / 4, 10.0))
        for each in machines:
            robot = each.robots.pop(each.rng.randrange(len(each.robots)))
            steps.add(await asyncio.to_thread(robot.kill_and_read))
            await each.start_robot()
        assert machine.daemon is not None
        machine.daemon.kill()
        if count >= len(machines) and asyncio.get_running_loop().time() > deadline:  # one takes long on a busy machine
            return


@pytest.mark.parametrize("seconds", [4.0, pytest.param(600.0, marks=pytest.mark.soak)])
async def test_sixteen_robots_and_two_daemons_behind_a_failing_network_lose_and_double_nothing(
    server: Server, tmp_path: Path, seconds: float, in_turn: bool, rng: random.Random
) -> None:
    url, steps = server.new_database(), RecordedSteps()
    async with AsyncExitStack() as stack:
        machines: list[Machine] = []
        for name in ("east", "west"):
            proxy = await stack.enter_async_context(proxy_before(server.folder))
            machines.append(Machine(tmp_path / name, proxy, urlsplit(url).path.removeprefix("/"), rng))
            stack.callback(machines[-1].clear)
        await work(machines, steps, rng, min(seconds, 60.0) if in_turn else seconds)
        for machine in machines:
            print(dict(machine.proxy.made), machine.proxy.connections, "connections")
            assert len(machine.proxy.made) >= 6
            assert machine.proxy.connections > 10
            assert machine.daemon is not None
            log = machine.daemon.log.read_text()
            assert "Traceback" not in log
            assert "tables cannot" not in log
            done = await asyncio.to_thread(
                pycrorm, "writer", "--once", "--json", "--url", url, "--spool", machine.spool, cwd=tmp_path
            )
            assert done.returncode == 0, done.stderr
            assert json.loads(done.stdout)["events_stored"] == 0
        await asyncio.to_thread(steps.verify, url)
    assert len(steps.certain) > 1000, "too little was done to prove anything"
