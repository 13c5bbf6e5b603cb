"""Kill, suspend and stop daemons while plans record: every step a plan performed is stored once and in its order."""

from __future__ import annotations

import asyncio
import json
import random
import signal
import sqlite3
import time
from collections.abc import Iterator
from pathlib import Path
from urllib.parse import urlsplit

import pytest

from bench.breaking import processes
from pycrorm_async.testing.postgresql_proxy import proxy_before
from tests.commands import one_line_of, pycrorm
from tests.crash.robot_processes import Lab
from tests.databases import Server, ask, server_in_memory

pytestmark = pytest.mark.slow


# === daemon kill ==============================================================================================
#
# Kill daemons and plans with SIGKILL repeatedly: every step a plan performed is stored once and in its order.


def kill_daemons(server: Server | None, folder: Path, kills: int) -> None:
    seed = random.SystemRandom().randrange(2**20)
    print(f"seed {seed}")
    outcome = processes.killed_daemons(server)(kills, random.Random(seed), folder, lambda: None)
    assert outcome.clean, outcome
    assert outcome.events > 100, "too little was done to prove anything"


@pytest.mark.parametrize("kills", [3, pytest.param(100, marks=pytest.mark.soak)])
def test_killed_daemons_and_plans_leave_every_step_stored_once(tmp_path: Path, kills: int, in_turn: bool) -> None:
    kill_daemons(None, tmp_path, min(kills, 25) if in_turn else kills)


@pytest.mark.soak
def test_killed_daemons_plans_and_servers_leave_every_step_stored_once(tmp_path: Path, in_turn: bool) -> None:
    with server_in_memory() as server:  # its own, because it is killed
        kill_daemons(server, tmp_path, 25 if in_turn else 100)


@pytest.fixture
def own_server() -> Iterator[Server]:
    with server_in_memory() as running:
        yield running


@pytest.mark.soak  # store/test_postgresql_faults kills a server, memory/test_delegated_writer locks a daemon out
def test_a_server_that_restarts_under_load_costs_no_event(own_server: Server, tmp_path: Path) -> None:
    lab = Lab(tmp_path, own_server.new_database(), random.randrange(2**31))
    try:
        robots = [lab.start_robot() for _ in range(2)]
        lab.start_daemon()
        for robot in robots:
            robot.wait_until_it_performs()
        lab.wait_for_log("appeared")
        own_server.stop()
        lab.wait_for_log("the database is unavailable")
        own_server.start()
        lab.wait_for_log("the database is available again")
        lab.stop_robots()
        assert lab.stop_daemon() == 0
        lab.verify_every_step_stored_once_in_order()
    finally:
        lab.clear()


@pytest.mark.soak  # memory/test_delegated_writer locks it
def test_a_database_file_that_another_program_locks_costs_no_event(tmp_path: Path) -> None:
    lab = Lab(tmp_path, f"sqlite:///{tmp_path / 'memory.db'}", random.randrange(2**31))
    try:
        robot = lab.start_robot()
        lab.start_daemon()
        robot.wait_until_it_performs()
        lab.wait_for_log("appeared")
        other = sqlite3.connect(tmp_path / "memory.db", isolation_level=None, timeout=30)
        other.execute("BEGIN EXCLUSIVE")
        lab.wait_for_log("the database is unavailable: sqlite:////")
        other.execute("COMMIT")
        other.close()
        lab.wait_for_log("the database is available again")
        lab.stop_robots()
        assert lab.stop_daemon() == 0
        lab.verify_every_step_stored_once_in_order()
    finally:
        lab.clear()


@pytest.mark.soak
def test_two_daemons_of_two_spools_fold_into_one_server_without_hindering_each_other(
    own_server: Server, tmp_path: Path
) -> None:
    url, seed = own_server.new_database(), random.randrange(2**31)
    labs = [Lab(tmp_path / name, url, seed + number) for number, name in enumerate(("one", "two"))]
    try:
        for lab in labs:
            lab.folder.mkdir()
            lab.start_daemon()
            for prefix in ("a", "b"):
                lab.start_robot(f"{lab.folder.name}.{prefix}").wait_until_it_performs()
        time.sleep(20)
        for lab in labs:
            lab.stop_robots()
            assert lab.stop_daemon() == 0
            assert "tables cannot" not in lab.log.read_text()
            assert "away" not in lab.log.read_text()
        labs[0].gone += labs[1].gone
        labs[0].verify_every_step_stored_once_in_order()
        assert [path.name for path in labs[1].spool.iterdir() if path.is_dir() and path.name != "stored"] == []
    finally:
        for lab in labs:
            lab.clear()


# === stopped daemon ===========================================================================================
#
# A daemon that is suspended, and one that is asked to stop while its server does not answer.
#
# No other process takes over from a daemon that may resume: its process holds the lock, which is no lease that expires.


def suspend(lab: Lab) -> None:
    assert lab.daemon is not None
    lab.daemon.send_signal(signal.SIGSTOP)


def resume(lab: Lab) -> None:
    assert lab.daemon is not None
    lab.daemon.send_signal(signal.SIGCONT)


@pytest.mark.soak_on("postgresql")
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


@pytest.mark.soak_on("postgresql")
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


@pytest.mark.soak_on("postgresql")
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
