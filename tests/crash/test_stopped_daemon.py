"""A daemon that is stopped and not dead, and one that is told to leave while its server is silent.

Nobody takes over from a daemon that may wake up again: its lock is its process's, and no lease that runs out.
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
"""The promise is kept in files or by a process, with no SQL of its own; on a server it is tested in turns."""


def stop_in_its_tracks(lab: Lab) -> None:
    assert lab.daemon is not None
    lab.daemon.send_signal(signal.SIGSTOP)


def let_go_on(lab: Lab) -> None:
    assert lab.daemon is not None
    lab.daemon.send_signal(signal.SIGCONT)


def test_a_daemon_that_was_stopped_and_goes_on_has_doubled_nothing_and_nobody_took_its_place(
    database_url: str, tmp_path: Path
) -> None:
    lab = Lab(tmp_path, database_url, random.randrange(2**31))
    try:
        robot = lab.start_robot()
        lab.start_daemon()
        robot.wait_until_it_walks()
        lab.wait_for_log("appeared")
        stop_in_its_tracks(lab)
        second = pycrorm("writer", "--url", database_url, "--spool", lab.spool, cwd=tmp_path)
        assert one_line_of(second).endswith("another `pycrorm writer` drains it already")
        assert second.returncode == 3
        done = pycrorm("writer", "--once", "--json", "--url", database_url, "--spool", lab.spool, cwd=tmp_path)
        if done.returncode == 3:  # it may stand still in the middle of writing, and SQLite has one lock for that
            assert one_line_of(done).endswith("database is locked")
        else:
            assert json.loads(done.stdout)["recorders"] == []  # the one that is there is held by it
        let_go_on(lab)
        lab.stop_robots()
        assert lab.stop_daemon() == 0
        lab.prove_that_everything_is_there_once_and_in_order()
    finally:
        lab.clear()


def test_a_stopped_daemon_that_is_killed_is_followed_by_another(database_url: str, tmp_path: Path) -> None:
    lab = Lab(tmp_path, database_url, random.randrange(2**31))
    try:
        robot = lab.start_robot()
        lab.start_daemon()
        robot.wait_until_it_walks()
        lab.wait_for_log("appeared")
        stop_in_its_tracks(lab)
        lab.kill_daemon()
        begun = lab.log.read_text().count("appeared")
        lab.start_daemon()
        while lab.log.read_text().count("appeared") == begun:
            time.sleep(0.05)
        lab.stop_robots()
        assert lab.stop_daemon() == 0
        lab.prove_that_everything_is_there_once_and_in_order()
    finally:
        lab.clear()


async def test_a_daemon_that_is_told_to_leave_while_its_server_is_silent_leaves_and_nothing_is_lost(
    server: Server, tmp_path: Path
) -> None:
    url = server.new_database()
    async with proxy_before(server.folder) as proxy:
        through = proxy.url(urlsplit(url).path.removeprefix("/"))
        lab = Lab(tmp_path, through, random.randrange(2**31))
        try:
            robot = lab.start_robot()
            lab.start_daemon()
            await asyncio.to_thread(robot.wait_until_it_walks)
            await asyncio.to_thread(lab.wait_for_log, "appeared")
            proxy.stall()  # for good: not a byte comes back any more
            said = len(robot.said)
            while len(robot.said) < said + 100:  # noqa: ASYNC110  the plan is not disturbed
                await asyncio.sleep(0.01)
            assert await asyncio.to_thread(lab.stop_daemon) == 0
            proxy.flow()
            await asyncio.to_thread(lab.stop_robots)
            await asyncio.to_thread(lab.prove_that_everything_is_there_once_and_in_order)
        finally:
            lab.clear()
    assert ask(url, "SELECT count(*) FROM episode WHERE refused IS NOT NULL") == [(0,)]
