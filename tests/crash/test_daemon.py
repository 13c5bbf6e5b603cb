"""Kill daemons, plans and servers, and stop a daemon whose server is silent: every performed step is stored once."""

from __future__ import annotations

import asyncio
import itertools
import random
import time
from contextlib import nullcontext
from pathlib import Path
from urllib.parse import urlsplit

import pytest

from pycrorm_async import recover
from pycrorm_async.testing.postgresql_proxy import proxy_before
from tests.crash.forked_processes import DaemonProcess, ForkedProcess
from tests.crash.step_robot import RecordedSteps, walk
from tests.databases import Server, ask, server_in_memory

pytestmark = pytest.mark.slow


@pytest.mark.parametrize(
    ("kills", "on_server"),
    [
        (3, False),
        pytest.param(100, False, marks=pytest.mark.soak),
        pytest.param(100, True, marks=pytest.mark.soak),
    ],
)
def test_killed_daemons_plans_and_servers_leave_every_step_stored_once(
    tmp_path: Path, kills: int, on_server: bool, in_turn: bool, rng: random.Random
) -> None:
    spool, steps, names = tmp_path / "spool", RecordedSteps(), itertools.count()
    with server_in_memory() if on_server else nullcontext() as server:  # its own, because it is killed
        url = f"sqlite:///{tmp_path}/memory.db" if server is None else server.new_database()

        def started() -> ForkedProcess:
            return ForkedProcess(walk, url, str(spool), "daemon", f"plan{next(names)}", rng.randrange(2**31))

        plans = [started() for _ in range(3)]
        for _ in range(min(kills, 25) if in_turn else kills):
            daemon = DaemonProcess(url, spool)
            daemon.wait_for("draining")
            time.sleep(rng.random() ** 2 * 0.5)
            if rng.random() < 0.3:
                steps.add(plans.pop(rng.randrange(len(plans))).kill_and_read())
                plans.append(started())
            if server is not None and rng.random() < 0.1:
                server.kill()
                time.sleep(rng.random() * 0.1)
                start_again(server)
            daemon.kill_and_wait()
        for each in plans:
            each.wait_for("did")
            steps.add(each.kill_and_read())
        asyncio.run(recover(url, spool=spool))
        steps.verify(url)
    assert len(steps.certain) > 100, "too little was done to prove anything"


def start_again(server: Server) -> None:
    """Start the server; again if it takes longer on a busy machine than `Server.start` waits."""
    for attempt in itertools.count():
        try:
            server.start()
            ask(server.url(), "SELECT 1")
        except Exception:
            if attempt == 9:
                raise
        else:
            return


@pytest.mark.soak
async def test_a_daemon_that_stops_while_its_server_is_silent_loses_no_event(server: Server, tmp_path: Path) -> None:
    url, spool, steps = server.new_database(), tmp_path / "spool", RecordedSteps()
    async with proxy_before(server.folder) as proxy:
        through = proxy.url(urlsplit(url).path.removeprefix("/"))
        plan = ForkedProcess(walk, through, str(spool), "daemon", "plan", 1)
        daemon = DaemonProcess(through, spool)
        await asyncio.to_thread(plan.wait_for, "did")
        await asyncio.to_thread(daemon.wait_for, "appeared")
        proxy.stall()  # the server stays silent from here on
        lines = len(plan.lines)
        while len(plan.lines) < lines + 100:  # noqa: ASYNC110  the plan is not disturbed
            await asyncio.sleep(0.01)
        assert await asyncio.to_thread(daemon.stop) == 0
        proxy.flow()
        plan.request_stop()
        assert await asyncio.to_thread(plan.wait) == 0
    steps.add(plan.words)
    await recover(url, spool=spool)
    await asyncio.to_thread(steps.verify, url)
