"""Plans and daemons in processes of their own that tests kill, and the proof that no event was lost.

The output of a plan is kept outside the system, and the proof reads the database through connections that do not use
the memory.
"""

from __future__ import annotations

import random
import signal
import time
from collections import defaultdict
from pathlib import Path

from tests.commands import Started, pycrorm
from tests.crash.forked_processes import ForkedProcess
from tests.crash.step_robot import run_step_robot
from tests.databases import ask

__all__ = ["RobotProcess", "Lab"]

HANGS_S = 300.0
"""A process that takes longer than this hangs, however busy the machine is."""


class RobotProcess:
    """The process of one plan, and the lines that it wrote."""

    def __init__(self, url: str, spool: Path, name: str, seed: int, pause_s_max: float) -> None:
        self.name = name
        self.forked = ForkedProcess(run_step_robot, url, str(spool), name, seed, pause_s_max)

    def wait_until_it_performs(self) -> None:
        deadline = time.monotonic() + HANGS_S
        while len(self.lines) < 5:
            assert time.monotonic() < deadline
            time.sleep(0.01)

    def kill(self) -> None:
        self.forked.kill()

    def stop(self) -> None:
        """Ask the process to end its episode and close its memory, and wait for it."""
        self.forked.request_stop()
        assert self.forked.wait() == 0

    @property
    def lines(self) -> list[list[str]]:
        """The words of each complete line that the process has written."""
        return self.forked.words


class Lab:
    """One database, one spool, the robots that record into it, and at most one daemon."""

    def __init__(self, folder: Path, url: str, seed: int, *, pause_s_max: float = 0.02) -> None:
        print(f"seed {seed}")
        self.folder = folder
        self.url = url
        self.spool = folder / "spool"
        self.rng = random.Random(seed)
        self.pause_s_max = pause_s_max
        self.robots: list[RobotProcess] = []
        self.gone: list[RobotProcess] = []
        self.daemon: Started | None = None
        self.log = folder / "daemon.log"

    def start_robot(self, name: str | None = None) -> RobotProcess:
        name = name or f"robot{len(self.robots) + len(self.gone)}"
        robot = RobotProcess(self.url, self.spool, name, self.rng.randrange(2**31), self.pause_s_max)
        self.robots.append(robot)
        return robot

    def kill_robot(self) -> None:
        robot = self.robots.pop(self.rng.randrange(len(self.robots)))
        robot.kill()
        self.gone.append(robot)

    def stop_robots(self) -> None:
        for robot in self.robots:
            robot.stop()
        self.gone += self.robots
        self.robots = []

    def start_daemon(self) -> None:
        self.daemon = Started("writer", "--url", self.url, "--spool", self.spool, cwd=self.folder, output=self.log)

    def kill_daemon(self) -> None:
        assert self.daemon is not None
        self.daemon.kill()
        self.daemon.communicate()

    def stop_daemon(self) -> int:
        assert self.daemon is not None
        self.daemon.send_signal(signal.SIGTERM)
        self.daemon.communicate(timeout=HANGS_S)
        return self.daemon.wait()

    def wait_for_log(self, words: str) -> None:
        deadline = time.monotonic() + HANGS_S
        while not self.log.exists() or words not in self.log.read_text():
            assert time.monotonic() < deadline, self.log.read_text()
            time.sleep(0.05)

    def clear(self) -> None:
        """Kill every process that this lab started."""
        for robot in self.robots:
            robot.kill()
        if self.daemon is not None and self.daemon.poll() is None:
            self.kill_daemon()

    def verify_every_step_stored_once_in_order(self) -> None:
        """Drain with one `pycrorm writer --once`, after all other processes have ended, and compare the database."""
        assert not self.robots
        done = pycrorm("writer", "--once", "--url", self.url, "--spool", self.spool, cwd=self.folder)
        assert done.returncode == 0, done.stderr
        assert "Traceback" not in self.log.read_text()
        assert [path.name for path in self.spool.iterdir() if path.is_dir() and path.name != "stored"] == []
        lines = [line for robot in self.gone for line in robot.lines]
        did = {
            (place, int(step)) for what, place, step, *_ in (line for line in lines if len(line) == 3) if what == "did"
        }
        ended = {line[1] for line in lines if line[0] == "ended"}
        assert len(did) > 100, "too little was done to prove anything"

        rows = ask(
            self.url,
            "SELECT place, step, status FROM step_action JOIN task_tree_node ON step_action.id = task_tree_node.id"
            " ORDER BY step_action.id",
        )
        steps: defaultdict[str, list[int]] = defaultdict(list)
        for place, step, status in rows:
            steps[place].append(step)
            assert status in ("SUCCEEDED", "LOST")
            assert status == "SUCCEEDED" or (place, step) not in did
        assert all(numbers == list(range(len(numbers))) for numbers in steps.values())
        stored = {(place, step) for place, numbers in steps.items() for step in numbers}
        assert did <= stored
        assert len(stored) <= len(did) + len(self.gone)  # for each death one step that was performed and not reported

        episodes = ask(self.url, "SELECT description, status FROM process_metadata")
        statuses = dict(episodes)
        assert len(statuses) == len(episodes)
        assert {place: statuses[place] for place in ended} == dict.fromkeys(ended, "SUCCEEDED")
        assert set(steps) <= set(statuses)
        heads = ask(self.url, "SELECT number, head, folded, refused, parked FROM episode ORDER BY number")
        assert all(head == folded and refused is None and parked is None for _, head, folded, refused, parked in heads)
        counted = ask(self.url, "SELECT episode, count(*), min(sequence), max(sequence) FROM event GROUP BY episode")
        assert sorted(counted) == [(number, head, 1, head) for number, head, *_ in heads]
