"""Run sixteen robots on two machines with one database, behind a network that keeps failing in every way.

Robots and daemons are killed meanwhile. The test compares the output of the robots with the database, which it reads
through a connection that does not use the memory.
"""

from __future__ import annotations

import asyncio
import enum
import itertools
import json
import os
import random
import select
import signal
from collections import Counter, defaultdict
from collections.abc import Iterator
from contextlib import AsyncExitStack, suppress
from dataclasses import dataclass
from pathlib import Path
from typing import Any, NoReturn
from urllib.parse import urlsplit

import pytest

from pycrorm_async import Memory, Settings
from pycrorm_async.plan import ActionAbstract, PlanFailure
from pycrorm_async.testing.postgresql_proxy import Proxy, proxy_before
from pycrorm_async.world import Pose
from tests.commands import pycrorm
from tests.crash.forked_processes import ForkedProcess
from tests.crash.robot_processes import HANGS_S, Lab
from tests.databases import Server, ask

pytestmark = pytest.mark.slow


ROBOTS_A_MACHINE = 8


class RobotProcess:
    """A robot's process, and its name in the memory; `killed` if it did not run to its end."""

    def __init__(self, url: str, spool: Path, name: str, seed: int) -> None:
        self.forked = ForkedProcess(do_chores, url, str(spool), name, seed, 0.2)
        self.name = name
        self.killed = False

    def kill(self) -> None:
        self.forked.kill()
        self.killed = True

    @property
    def lines(self) -> list[dict[str, Any]]:
        return [json.loads(line) for line in self.forked.lines]


class Machine:
    """A spool, its daemon, a proxy between them and the server, and the robots."""

    def __init__(self, folder: Path, proxy: Proxy, database: str, rng: random.Random) -> None:
        folder.mkdir()
        self.proxy = proxy
        self.lab = Lab(folder, proxy.url(database), rng.randrange(2**31))  # only its daemon is used
        self.rng = rng
        self.robots: list[RobotProcess] = []

    def start_robot(self) -> RobotProcess:
        name = f"{self.lab.folder.name}.{len(self.robots)}"
        robot = RobotProcess(self.lab.url, self.lab.spool, name, self.rng.randrange(2**31))
        self.robots.append(robot)
        return robot

    def living(self) -> list[RobotProcess]:
        return [robot for robot in self.robots if not robot.killed]

    async def keep_daemon_running(self) -> NoReturn:
        """Start the daemon again whenever it has ended, as a service manager does."""
        while True:
            self.lab.start_daemon()
            assert self.lab.daemon is not None
            code = await asyncio.to_thread(self.lab.daemon.wait)
            assert code in (3, -signal.SIGKILL), (
                self.lab.log.read_text()
            )  # 3: the database was unavailable when the daemon started
            await asyncio.sleep(0.1)

    async def kill_and_replace(self) -> None:
        await asyncio.to_thread(self.rng.choice(self.living()).kill)
        await asyncio.to_thread(self.start_robot().forked.wait_for_first_output)

    def folders(self) -> list[str]:
        """List the recorders' folders, which are deleted when all their records are stored."""
        return [path.name for path in self.lab.spool.iterdir() if path.is_dir() and path.name != "stored"]

    def clear(self) -> None:
        for robot in self.living():
            with suppress(ValueError):  # the process has already ended
                robot.forked.process.kill()
        self.lab.clear()


async def work(machines: list[Machine], rng: random.Random, seconds: float) -> None:
    """Run everything concurrently for `seconds`, then restore the network and let the daemons store the rest."""
    async with asyncio.TaskGroup() as tasks:
        keepers = [tasks.create_task(machine.keep_daemon_running()) for machine in machines]
        for machine in machines:
            await asyncio.to_thread(machine.lab.wait_for_log, "draining")
        for machine in machines:
            for robot in [machine.start_robot() for _ in range(ROBOTS_A_MACHINE)]:
                await asyncio.to_thread(robot.forked.wait_for_first_output)
            await asyncio.to_thread(machine.lab.wait_for_log, "appeared")
        troubles = [tasks.create_task(machine.proxy.trouble(rng, pause_s=0.25)) for machine in machines]
        await kill_repeatedly(machines, seconds)
        living = [robot for machine in machines for robot in machine.living()]
        for robot in living:
            robot.forked.request_stop()
        for robot in living:
            assert await asyncio.to_thread(robot.forked.wait) == 0, robot.name
        for trouble in troubles:
            trouble.cancel()
        await until_all_is_stored(machines)
        for keeper in keepers:
            keeper.cancel()
    for machine in machines:
        assert await asyncio.to_thread(machine.lab.stop_daemon) == 0, machine.lab.log.read_text()


async def until_all_is_stored(machines: list[Machine]) -> None:
    loop = asyncio.get_running_loop()
    deadline = loop.time() + HANGS_S
    while left := [name for machine in machines for name in machine.folders()]:
        if loop.time() > deadline:
            raise AssertionError(f"not stored: {left}\n" + "\n".join(each.lab.log.read_text() for each in machines))
        await asyncio.sleep(0.05)


async def kill_repeatedly(machines: list[Machine], seconds: float) -> None:
    """Kill one robot of each machine and one daemon in turn until the time is over, each daemon at least once."""
    deadline = asyncio.get_running_loop().time() + seconds
    for count, machine in enumerate(itertools.cycle(machines), 1):
        await asyncio.sleep(min(seconds / 4, 10.0))
        for each in machines:
            await each.kill_and_replace()
        machine.lab.kill_daemon()
        if count >= len(machines) and asyncio.get_running_loop().time() > deadline:  # one takes long on a busy machine
            return


@pytest.mark.parametrize("seconds", [4.0, pytest.param(600.0, marks=pytest.mark.soak)])
async def test_sixteen_robots_and_two_daemons_behind_a_failing_network_lose_and_double_nothing(
    server: Server, tmp_path: Path, seconds: float, in_turn: bool
) -> None:
    seed = int(os.environ.get("PYCRORM_TEST_SEED") or random.SystemRandom().randrange(2**31))
    print(f"seed {seed}: PYCRORM_TEST_SEED={seed} takes it again")
    rng = random.Random(seed)
    url = server.new_database()
    async with AsyncExitStack() as stack:
        machines: list[Machine] = []
        for name in ("east", "west"):
            proxy = await stack.enter_async_context(proxy_before(server.folder))
            machines.append(Machine(tmp_path / name, proxy, urlsplit(url).path.removeprefix("/"), rng))
            stack.callback(machines[-1].clear)
        await work(machines, rng, min(seconds, 60.0) if in_turn else seconds)
        for machine in machines:
            print(dict(machine.proxy.made), machine.proxy.connections, "connections")
            assert len(machine.proxy.made) >= 6
            assert machine.proxy.connections > 10
            log = machine.lab.log.read_text()
            assert "Traceback" not in log
            assert "tables cannot" not in log
            done = await asyncio.to_thread(
                pycrorm, "writer", "--once", "--json", "--url", url, "--spool", machine.lab.spool, cwd=tmp_path
            )
            assert done.returncode == 0, done.stderr
            assert json.loads(done.stdout)["events_stored"] == 0
        robots = [robot for machine in machines for robot in machine.robots]
        assert sum(not robot.killed for robot in robots) == 2 * ROBOTS_A_MACHINE
        assert sum(robot.killed for robot in robots) >= 4
        stored = await asyncio.to_thread(StoredMemory, url)
        for robot in robots:
            compare(robot, stored)
        compare_all(robots, stored)


# --- the content of the database --------------------------------------------------------------------------------------


class StoredMemory:
    """The log and the tables of the database, by the names that the robots chose."""

    def __init__(self, url: str) -> None:
        self.heads = ask(url, "SELECT number, head, folded, refused, parked FROM episode ORDER BY number")
        self.episodes: dict[str, tuple[str, str | None]] = {}
        self.descriptions = Counter[str]()
        for description, status, failure in ask(url, "SELECT description, status, failure_type FROM process_metadata"):
            self.episodes[description] = status, failure
            self.descriptions[description] += 1
        self.log: defaultdict[str, list[tuple[str, int | None, str | None]]] = defaultdict(list)
        self.sequences: defaultdict[int, list[int]] = defaultdict(list)
        self._read_log(url)
        self.nodes = ask(
            url,
            "SELECT coalesce(step.episode, carry.episode), coalesce(step.number, carry.number),"
            " node.dtype, node.status, parent.number, parent.kind, node.failure_message, node.end_ns IS NOT NULL,"
            " carry.weight, carry.hand, carry.slips, x, y, z, node.id"
            " FROM task_tree_node node LEFT JOIN step_action step ON step.id = node.id"
            " LEFT JOIN carry_action carry ON carry.id = node.id LEFT JOIN pose ON pose.id = carry.there_id"
            " LEFT JOIN (SELECT above.id, number, above.kind FROM task_tree_node above"
            " LEFT JOIN carry_action ON carry_action.id = above.id) parent ON parent.id = node.parent_id"
            " WHERE node.kind = 'action' ORDER BY node.id",
        )
        self.words: defaultdict[int, list[str]] = defaultdict(list)
        for node, text in ask(url, "SELECT node_id, text FROM parameter_item ORDER BY node_id, field, position"):
            self.words[node].append(text)
        self.counts = {
            table: ask(url, f"SELECT count(*) FROM {table}")[0][0]
            for table in (
                "process_metadata task_tree_node step_action carry_action pose parameter_item"
                " object object_removal attachment joint_change location_resolution location_candidate location_refusal"
                " detection state_sample"
            ).split()
        }

    def _read_log(self, url: str) -> None:
        """Read each event in the order of its number as (kind, chore, outcome)."""
        names: dict[int, str] = {}
        numbers: dict[tuple[int, int], int | None] = {}
        rows = ask(url, "SELECT episode, sequence, type, payload FROM event ORDER BY episode, sequence")
        for episode, sequence, kind, text in rows:
            payload = json.loads(text)
            self.sequences[episode].append(sequence)
            if kind == "EpisodeStarted":
                names[episode] = payload["description"]
                numbers[episode, 2] = None  # the root node has no chore
            elif kind == "NodeStarted" and payload["kind"] != "root":
                number = numbers[episode, sequence] = payload["parameters"]["number"]
                self.log[names[episode]].append(("began", number, None))
            elif kind == "NodeEnded" and payload["node"] != 2:
                self.log[names[episode]].append(("ended", numbers[episode, payload["node"]], payload["status"]))
            elif kind in ("NodeStarted", "NodeEnded", "EpisodeEnded"):
                self.log[names[episode]].append((kind, None, payload.get("status")))
            else:
                raise AssertionError((kind, payload))

    def nodes_of(self, robot: RobotProcess) -> Iterator[tuple[Any, ...]]:
        return (row for row in self.nodes if row[0].startswith(f"{robot.name}."))


# --- the comparison ---------------------------------------------------------------------------------------------------


def compare(robot: RobotProcess, stored: StoredMemory) -> None:
    """Every chore of this robot is stored once, in order and with its values; each killed lane may have one more."""
    lines = robot.lines
    opened = [line["opened"] for line in lines if "opened" in line]
    closed = {line["closed"] for line in lines if "closed" in line}
    names = [name for name in stored.episodes if name.startswith(f"{robot.name}.")]
    assert set(opened) <= set(names)
    assert len(names) <= len(opened) + robot.killed * LANES  # opened, but not reported before the kill
    if not robot.killed:
        assert closed == set(names)
        assert lines[-1] == {"faults": 0}
    assert all(stored.episodes[name] == ("SUCCEEDED", None) for name in closed)
    unsaid = 0
    for name in names:
        did = [
            ("began", line["began"], None) if "began" in line else ("ended", line["ended"], line["how"])
            for line in lines
            if line.get("episode") == name
        ]
        events = stored.log[name]
        assert events[0] == ("NodeStarted", None, None) or (not did and robot.killed)
        inside = [each for each in events if each[0] in ("began", "ended")]
        assert inside[: len(did)] == did
        unsaid += len(inside) - len(did)
        if name in closed:
            ends = [("NodeEnded", None, "SUCCEEDED"), ("EpisodeEnded", None, "SUCCEEDED")]
            assert events == [("NodeStarted", None, None), *did, *ends]
        else:
            assert events[-1][0] == "EpisodeEnded"
            assert events[-1][2] in ("LOST", "SUCCEEDED")  # it may have ended without a report before the kill
            assert stored.episodes[name][0] == events[-1][2]
    assert unsaid <= robot.killed
    compare_rows(robot, stored)


def compare_rows(robot: RobotProcess, stored: StoredMemory) -> None:
    lines = robot.lines
    began = {(line["episode"], line["began"]): line for line in lines if "began" in line}
    ended = {(line["episode"], line["ended"]): line["how"] for line in lines if "ended" in line}
    rows = {}
    for episode, number, *rest in stored.nodes_of(robot):
        assert (episode, number) not in rows
        rows[episode, number] = rest
    assert set(began) <= set(rows)
    assert len(rows) <= len(began) + robot.killed
    carried = 0  # steps belong to the carrying before them
    for (episode, number), row in rows.items():
        dtype, status, parent, above, message, has_end, weight, hand, slips, x, y, z, node = row
        how = ended.get((episode, number))
        if how is None:
            assert robot.killed
            assert status == "LOST" or has_end  # its end was recorded but not reported
        else:
            assert (status, has_end) == (how, True)
        assert message == (f"slipped at {number}" if status == "FAILED" else None)
        if dtype == "CarryAction":
            carried = number
            assert (parent, above) == (None, "root")
            assert status == "LOST" or slips is (status == "FAILED")
        else:
            assert (dtype, parent, above) == ("StepAction", carried, "action")
        line = began.get((episode, number))
        if line is not None:
            assert dtype == {"step": "StepAction", "carry": "CarryAction"}[line["what"]]
            values = {"weight": weight, "hand": hand, "there": [x, y, z], "words": stored.words.get(node, [])}
            assert values == line.get("values", {"weight": None, "hand": None, "there": [None] * 3, "words": []})


def compare_all(robots: list[RobotProcess], stored: StoredMemory) -> None:
    """The database holds only what the robots did, and the tables show all of the log."""
    assert all(
        head == folded and refused is None and parked is None for _, head, folded, refused, parked in stored.heads
    )
    assert {number: list(range(1, head + 1)) for number, head, *_ in stored.heads} == stored.sequences
    assert set(stored.descriptions.values()) == {1}
    assert {name.rsplit(".", 2)[0] for name in stored.descriptions} <= {robot.name for robot in robots}
    roots = sum(event[0] == "NodeStarted" for events in stored.log.values() for event in events)
    began = Counter(row[2] for row in stored.nodes)
    words = sum(len(each) for each in stored.words.values())
    rows = {
        "process_metadata": len(stored.episodes),
        "task_tree_node": roots + len(stored.nodes),
        "step_action": began["StepAction"],
        "carry_action": began["CarryAction"],
        "pose": began["CarryAction"],
        "parameter_item": words,
    }
    assert stored.counts == {table: rows.get(table, 0) for table in stored.counts}
    done = sum("ended" in line for robot in robots for line in robot.lines)
    print(f"{len(stored.episodes)} episodes, {done} chores and steps said done, {sum(rows.values())} rows")
    assert done > 1000, "too little was done to prove anything"


# === chore robot ==============================================================================================
#
# Run a robot in a process of its own that performs chores concurrently and reports each on its output.
#
# Each line is a JSON object that the robot writes when it is true: `began` inside `perform`, after the hook before it
# has returned; `ended` when `perform` has returned, with the outcome; `opened` and `closed` around an episode. A chore
# may fail. The robot works until its input is closed.

LANES = 2
"""Plans that run concurrently in one process, each in episodes of its own; two are enough to interleave."""

SETTINGS = Settings(
    sync_interval_ms=10,
    segment_bytes=2**15,
    record_bytes_max=2**12,
    spool_bytes_max=2**26,
    spool_reserve_bytes=2**18,
    flush_timeout_s=90,
)


class Hand(enum.Enum):
    LEFT = 1
    RIGHT = 2


@dataclass
class StepActionPerformable(ActionAbstract):
    episode: str
    number: int

    async def perform(self) -> None:
        report(began=self.number, episode=self.episode, what="step")


@dataclass
class CarryActionPerformable(ActionAbstract):
    episode: str
    number: int
    weight: float
    hand: Hand
    there: Pose
    words: list[str]
    slips: bool

    async def perform(self) -> None:
        values = {"weight": self.weight, "hand": self.hand.name, "there": self.there.position, "words": self.words}
        report(began=self.number, episode=self.episode, what="carry", values=values)
        for number in range(self.number + 1, self.number + 1 + len(self.words)):
            await StepActionPerformable(self.episode, number).perform()
            report(ended=number, episode=self.episode, how="SUCCEEDED")
            await asyncio.sleep(0)
        if self.slips:
            raise PlanFailure(f"slipped at {self.number}")


def report(**words: object) -> None:
    os.write(1, json.dumps(words).encode() + b"\n")


def stop_requested() -> bool:
    return bool(select.select([0], [], [], 0)[0])


async def chores(memory: Memory, lane: str, rng: random.Random, pause_s: float) -> None:
    for round_ in itertools.count():
        episode = f"{lane}.{round_}"
        async with memory.episode(description=episode):
            report(opened=episode)
            numbers = itertools.count(1)
            for _ in range(rng.randrange(1, 12)):
                words = ["".join(rng.choices("aé\n'\\\"\t☃ ", k=3)) for _ in range(rng.randrange(4))]
                there = Pose([rng.gauss(0, 9), rng.gauss(0, 1e-9), rng.gauss(0, 1)])
                slips = rng.random() < 0.2
                carry = CarryActionPerformable(
                    episode, next(numbers), rng.random() / 3, rng.choice(list(Hand)), there, words, slips
                )
                for _ in words:
                    next(numbers)
                try:
                    await carry.perform()
                except PlanFailure:
                    report(ended=carry.number, episode=episode, how="FAILED")
                else:
                    report(ended=carry.number, episode=episode, how="SUCCEEDED")
                await asyncio.sleep(rng.random() * 2 * pause_s)
        report(closed=episode)
        if rng.random() < 0.1:
            await memory.synced()
        if stop_requested():
            return


async def _run_lanes(url: str, spool: Path, name: str, seed: int, pause_s: float) -> None:
    async with Memory.open(url, spool=spool, writer="daemon", settings=SETTINGS) as memory:
        async with asyncio.TaskGroup() as lanes:
            for lane in range(LANES):
                lanes.create_task(chores(memory, f"{name}.{lane}", random.Random(f"{seed} {lane}"), pause_s))
        report(faults=memory.status.faults.total)


def do_chores(url: str, spool: str, name: str, seed: int, pause_s: float) -> None:
    """Perform chores until the input is closed, with a mean pause of `pause_s` seconds between two chores."""
    asyncio.run(_run_lanes(url, Path(spool), name, seed, pause_s))
