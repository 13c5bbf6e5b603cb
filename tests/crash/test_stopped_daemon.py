"""A daemon that is suspended, and one that is asked to stop while its server does not answer.

No other process takes over from a daemon that may resume: its process holds the lock, which is no lease that expires.
"""

from __future__ import annotations

import asyncio
import json
import random
import signal
import time
from pathlib import Path
from urllib.parse import urlsplit

import pytest

from pycrorm_async.testing.postgresql_proxy import proxy_before
from tests.commands import one_line_of, pycrorm
from tests.crash.robot_processes import Lab
from tests.databases import Server, ask

pytestmark = [pytest.mark.slow, pytest.mark.soak_on("postgresql")]
"""Files and processes keep this promise, without SQL of their own, so that servers test it in turns."""


def suspend(lab: Lab) -> None:
    assert lab.daemon is not None
    lab.daemon.send_signal(signal.SIGSTOP)


def resume(lab: Lab) -> None:
    assert lab.daemon is not None
    lab.daemon.send_signal(signal.SIGCONT)


@pytest.mark.soak
def test_a_suspended_daemon_that_resumes_has_doubled_nothing_and_no_other_took_its_place(
    database_url: str, tmp_path: Path
) -> None:
    lab = Lab(tmp_path, database_url, random.randrange(2**31))
    try:
        robot = lab.start_robot()
        lab.start_daemon()
        robot.wait_until_it_performs()
        lab.wait_for_log("appeared")
        suspend(lab)
        second = pycrorm("writer", "--url", database_url, "--spool", lab.spool, cwd=tmp_path)
        assert one_line_of(second).endswith("another `pycrorm writer` drains it already")
        assert second.returncode == 3
        done = pycrorm("writer", "--once", "--json", "--url", database_url, "--spool", lab.spool, cwd=tmp_path)
        if done.returncode == 3:  # it may be suspended while it writes, and SQLite has one lock for writers
            assert one_line_of(done).endswith("database is locked")
        else:
            assert json.loads(done.stdout)["recorders"] == []  # the daemon holds the only folder
        resume(lab)
        lab.stop_robots()
        assert lab.stop_daemon() == 0
        lab.verify_every_step_stored_once_in_order()
    finally:
        lab.clear()


def test_a_suspended_daemon_that_is_killed_is_succeeded_by_another(database_url: str, tmp_path: Path) -> None:
    lab = Lab(tmp_path, database_url, random.randrange(2**31))
    try:
        robot = lab.start_robot()
        lab.start_daemon()
        robot.wait_until_it_performs()
        lab.wait_for_log("appeared")
        suspend(lab)
        lab.kill_daemon()
        begun = lab.log.read_text().count("appeared")
        lab.start_daemon()
        while lab.log.read_text().count("appeared") == begun:
            time.sleep(0.05)
        lab.stop_robots()
        assert lab.stop_daemon() == 0
        lab.verify_every_step_stored_once_in_order()
    finally:
        lab.clear()


@pytest.mark.soak
async def test_a_daemon_that_stops_while_its_server_is_silent_loses_no_event(server: Server, tmp_path: Path) -> None:
    url = server.new_database()
    async with proxy_before(server.folder) as proxy:
        through = proxy.url(urlsplit(url).path.removeprefix("/"))
        lab = Lab(tmp_path, through, random.randrange(2**31))
        try:
            robot = lab.start_robot()
            lab.start_daemon()
            await asyncio.to_thread(robot.wait_until_it_performs)
            await asyncio.to_thread(lab.wait_for_log, "appeared")
            proxy.stall()  # the server stays silent from here on
            lines = len(robot.lines)
            while len(robot.lines) < lines + 100:  # noqa: ASYNC110  the plan is not disturbed
                await asyncio.sleep(0.01)
            assert await asyncio.to_thread(lab.stop_daemon) == 0
            proxy.flow()
            await asyncio.to_thread(lab.stop_robots)
            await asyncio.to_thread(lab.verify_every_step_stored_once_in_order)
        finally:
            lab.clear()
    assert ask(url, "SELECT count(*) FROM episode WHERE refused IS NOT NULL") == [(0,)]
