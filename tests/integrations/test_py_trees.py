"""Behaviour trees of py_trees are remembered, whatever happens to them, and random ones exactly."""

from __future__ import annotations

import asyncio
import json
import random
import signal
import subprocess
import sys
from collections.abc import Callable, Iterable, Iterator, Sequence
from itertools import count
from pathlib import Path
from typing import Any

import py_trees
import pytest
from py_trees.blackboard import Blackboard
from py_trees.common import Status

from pycrorm_async import Memory, Settings, recover
from pycrorm_async.integrations.py_trees import RememberedTree
from pycrorm_async.record import executives
from tests.commands import environment
from tests.databases import ask
from tests.record.recordings import assert_verified, url_of

pytestmark = pytest.mark.slow


# === behaviours ===============================================================================================
#
# Behaviours and trees for the tests, and a visitor that counts what py_trees visits.

SUCCESS, FAILURE, RUNNING, INVALID = Status.SUCCESS, Status.FAILURE, Status.RUNNING, Status.INVALID


class Scripted(py_trees.behaviour.Behaviour):
    """Returns the given outcomes and messages, one a tick, and the last one from then on."""

    def __init__(self, name: str, outcomes: Iterable[Status], *feedback: str) -> None:
        super().__init__(name)
        self._outcomes = list(outcomes)
        self._feedback = [*feedback] or [""]

    def update(self) -> Status:
        self.feedback_message = self._feedback.pop(0) if len(self._feedback) > 1 else self._feedback[0]
        return self._outcomes.pop(0) if len(self._outcomes) > 1 else self._outcomes[0]


class Condition(Scripted):
    """A behaviour that only looks."""


class Broken(py_trees.behaviour.Behaviour):
    """Raises in its tick."""

    def __init__(self, name: str, error: BaseException) -> None:
        super().__init__(name)
        self._error = error

    def update(self) -> Status:
        raise self._error


class Visits(py_trees.visitors.VisitorBase):
    """Notes the statuses with which each behaviour was visited."""

    def __init__(self) -> None:
        super().__init__(full=False)
        self.statuses: dict[str, list[Status]] = {}

    def run(self, behaviour: Any) -> None:
        self.statuses.setdefault(behaviour.name, []).append(behaviour.status)


def tree(root: Any) -> Any:
    return py_trees.trees.BehaviourTree(root)


def sequence(name: str, *children: Any, memory: bool = False) -> Any:
    return py_trees.composites.Sequence(name, memory, list(children))


def selector(name: str, *children: Any, memory: bool = False) -> Any:
    return py_trees.composites.Selector(name, memory, list(children))


def parallel(name: str, *children: Any) -> Any:
    policy = py_trees.common.ParallelPolicy.SuccessOnAll(synchronise=False)
    return py_trees.composites.Parallel(name, policy, list(children))


def tick(ticked: Any, count: int) -> None:
    for _ in range(count):
        ticked.tick()


def named(statuses: Sequence[str]) -> list[Status]:
    """Return statuses by their initials."""
    return [{"S": SUCCESS, "F": FAILURE, "R": RUNNING}[each] for each in statuses]


# === remembered tree ==========================================================================================
#
# Behaviour trees of py_trees are remembered: activations, pre-emption, feedback, repeats, and the blackboard.


def test_feedback_is_the_message_of_a_failure_and_in_the_result_of_a_success(tmp_path: Path) -> None:
    root = selector("job", Scripted("grasp", named("F"), "it is slippery"), Scripted("ask", named("S"), "a human came"))
    remembered(tmp_path, root, lambda ticked: tick(ticked, 1))
    assert nodes(tmp_path)[1] == ("grasp", "job", "FAILED", 1, "it is slippery")
    (result,) = ask(tmp_path / "memory.db", "SELECT result FROM designator WHERE parameters ->> 'name' = 'ask'")
    assert json.loads(result[0]) == {"ticks": 1, "feedback": "a human came"}


def test_composites_and_decorators_are_language_and_other_behaviours_are_actions(tmp_path: Path) -> None:
    root = sequence("job", py_trees.decorators.Inverter("not", Condition("is hot", named("F"))))
    remembered(tmp_path, root, lambda ticked: tick(ticked, 1))
    assert ask(tmp_path / "memory.db", "SELECT dtype, kind FROM designator ORDER BY id") == [
        ("Sequence", "language"),
        ("Inverter", "language"),
        ("Condition", "action"),
    ]


class Reach(Scripted):
    """A behaviour with parameters, one of which cannot be read."""

    def __init__(self) -> None:
        super().__init__("reach", named("S"))
        self.height_m = 0.7

    @property
    def arm(self) -> str:
        raise OSError("the arm is switched off")


def test_attributes_of_behaviours_are_recorded_as_parameters(tmp_path: Path) -> None:
    fields = {Reach: {"height_m": "real", "arm": "text"}}
    status = remembered(tmp_path, Reach(), lambda ticked: tick(ticked, 2), fields=fields)
    assert ask(tmp_path / "memory.db", "SELECT name, height_m, arm FROM reach") == [("reach", 0.7, None)]
    assert status.faults.total == 0
    assert "the arm is switched off" in str(status.missing.last)


def test_changes_of_the_blackboard_are_observations_of_the_behaviour_that_writes_the_key(tmp_path: Path) -> None:
    class Measure(py_trees.behaviour.Behaviour):
        def __init__(self) -> None:
            super().__init__("measure")
            self.board = self.attach_blackboard_client(namespace="battery")
            self.board.register_key("volts", py_trees.common.Access.WRITE)
            self.count = 0

        def update(self) -> Any:
            self.count += 1
            self.board.volts = 24.0 if self.count < 50 else 23.5
            return SUCCESS

    def run(ticked: Any) -> None:
        Blackboard.set("goal", "kitchen")
        tick(ticked, 100)
        Blackboard.unset("goal")
        Blackboard.set("secret", "1234")
        tick(ticked, 1)

    remembered(tmp_path, Measure(), run, blackboard=lambda key: key != "/secret")
    assert observations(tmp_path) == [
        ("blackboard/goal", None, "value", "kitchen"),
        ("blackboard/battery/volts", "measure", "value", 24.0),
        ("blackboard/battery/volts", "measure", "value", 23.5),
        ("repeated", "measure", "ticks", 49),
        ("repeated", "measure", "ticks", 99),
        ("blackboard/goal", None, "value", None),
        ("repeated", "measure", "ticks", 100),
    ]


# === remembered trees =========================================================================================
#
# Remember a tree of py_trees, and read its nodes and observations from the tables.

PATIENT_S = 60.0
"""The time of an instant tick: a busy machine must not turn a check into work."""


def remembered(folder: Path, root: Any, run: Callable[[Any], None], **arguments: Any) -> Any:
    """Remember what `run` does with a tree of this root; return the status of the memory."""
    ticked = tree(root)
    with Memory.sync(url_of(folder), settings=Settings(fold="at_end")) as memory:
        with RememberedTree(ticked, memory.recording, **{"instant_s": PATIENT_S, **arguments}):
            run(ticked)
        status = memory.status
    assert ticked.visitors == []
    assert_verified(folder)
    return status


def nodes(folder: Path) -> list[tuple[str, str | None, str, int, str | None]]:
    """Return (name, name of the parent, status, ticks, failure message) of each node of a behaviour, in order."""
    rows = ask(
        folder / "memory.db",
        "SELECT node.parameters, parent.parameters, node.status, node.result, node.failure_message"
        " FROM designator AS node LEFT JOIN designator AS parent ON parent.id = node.parent_id ORDER BY node.id",
    )
    return [
        (
            json.loads(parameters)["name"],
            json.loads(above)["name"] if above is not None else None,
            status,
            json.loads(result)["ticks"] if result is not None else 0,
            message,
        )
        for parameters, above, status, result, message in rows
    ]


def observations(folder: Path) -> list[tuple[str, str | None, str | None, float | str | None]]:
    """Return (name, name of the behaviour, key, value) of each observed value, in order."""
    rows = ask(
        folder / "memory.db",
        "SELECT observation.name, designator.parameters, key, coalesce(number, text) FROM observation"
        " LEFT JOIN observation_value USING (id) LEFT JOIN designator ON designator.id = observation.node_id"
        " ORDER BY observation.id, position",
    )
    return [
        (name, json.loads(parameters)["name"] if parameters is not None else None, key, value)
        for name, parameters, key, value in rows
    ]


def repeated(folder: Path) -> dict[str | None, float | str | None]:
    return {behaviour: value for name, behaviour, _key, value in observations(folder) if name == "repeated"}


# === fixtures =================================================================================================
#
# Clear the blackboard of py_trees, which all trees of a process share, before and after each test.


@pytest.fixture(autouse=True)
def _clear_blackboard() -> Iterator[None]:
    Blackboard.clear()
    yield
    Blackboard.clear()


# === disturbed trees ==========================================================================================
#
# Exceptions, replaced subtrees, other visitors, limits and kills: the tree ticks on, and what it did is remembered.


def test_a_fault_of_the_visitor_is_counted_and_reaches_no_tick(tmp_path: Path) -> None:
    class Vain(Scripted):
        @property
        def feedback_message(self) -> str:
            raise OSError("no feedback")

        @feedback_message.setter
        def feedback_message(self, text: str) -> None: ...

    def refuse(key: str) -> bool:
        raise OSError(key)

    def run(ticked: Any) -> None:
        Blackboard.set("key", 1)
        tick(ticked, 3)

    status = remembered(tmp_path, sequence("job", Vain("look", named("S"))), run, blackboard=refuse)
    assert status.faults.total > 0
    assert [each[0] for each in nodes(tmp_path)][:2] == ["job", "look"]


def test_an_exception_in_a_behaviour_reaches_the_program_and_ends_its_branch_as_an_error(tmp_path: Path) -> None:
    root = parallel("both", Scripted("drive", named("R")), sequence("arm", Broken("grasp", OSError("no power"))))
    with pytest.raises(OSError, match="no power"):
        remembered(tmp_path, root, lambda ticked: tick(ticked, 1))
    assert [each[:3] + each[4:] for each in nodes(tmp_path)] == [
        ("both", None, "ERROR", "no power"),
        ("drive", "both", "INTERRUPTED", None),
        ("arm", "both", "ERROR", "no power"),
        ("grasp", "arm", "ERROR", "no power"),
    ]
    assert_verified(tmp_path)


def test_a_tree_that_is_part_of_a_larger_one_is_recorded_from_its_own_root(tmp_path: Path) -> None:
    inner = sequence("inner", Scripted("look", named("S")))
    sequence("outer", inner)
    status = remembered(tmp_path, inner, lambda ticked: tick(ticked, 1))
    assert [each[:2] for each in nodes(tmp_path)] == [("inner", None), ("look", "inner")]
    assert status.faults.total == 0


def test_a_visitor_left_in_the_tree_after_the_memory_was_closed_disturbs_nothing(tmp_path: Path) -> None:
    ticked = tree(sequence("job", Scripted("look", named("SF" * 20))))
    with Memory.sync(url_of(tmp_path)) as memory:
        visitor = RememberedTree(ticked, memory.recording)
        visitor.__enter__()
        ticked.tick()
    tick(ticked, 5)
    assert ticked.visitors == [visitor]
    visitor.__exit__(None, None, None)
    assert ticked.visitors == []
    tick(ticked, 5)


def test_other_visitors_and_handlers_of_the_tree_stay(tmp_path: Path) -> None:
    other = py_trees.visitors.SnapshotVisitor()
    ticked = tree(Scripted("look", named("S")))
    ticked.add_visitor(other)
    with Memory.sync(url_of(tmp_path)) as memory, RememberedTree(ticked, memory.recording):
        ticked.tick()
    assert ticked.visitors == [other]


_KILLED = """
import os, signal, sys
from pycrorm_async import Memory
from pycrorm_async.integrations.py_trees import RememberedTree
from tests.integrations.test_py_trees import Condition, Scripted, named, sequence, tree
ticked = tree(sequence("job", Condition("is near", named("S")), Scripted("drive", named("R"))))
with Memory.sync(sys.argv[1], writer="daemon") as memory, RememberedTree(ticked, memory.recording, instant_s=60):
    for _ in range(100):
        ticked.tick()
    os.kill(os.getpid(), signal.SIGKILL)
"""


def test_a_killed_tree_keeps_what_its_ticks_announced(tmp_path: Path) -> None:
    arguments = [sys.executable, "-c", _KILLED, url_of(tmp_path)]
    assert subprocess.run(arguments, check=False, env=environment(), timeout=60).returncode == -signal.SIGKILL
    asyncio.run(recover(url_of(tmp_path)))
    assert [each[:3] for each in nodes(tmp_path)] == [
        ("job", None, "LOST"),
        ("is near", "job", "SUCCEEDED"),
        ("drive", "job", "LOST"),
    ]
    assert repeated(tmp_path) == {"is near": 99}


# === random trees =============================================================================================
#
# Random trees, ticked at random: what is remembered of each behaviour is exactly what a visitor saw.

_TICKS = 40


class Moody(py_trees.behaviour.Behaviour):
    """Keeps its outcome most of the time."""

    def __init__(self, name: str, chance: random.Random) -> None:
        super().__init__(name)
        self._chance = chance
        self._outcome = SUCCESS
        self.feedback_message = "quiet"

    def update(self) -> Any:
        if self._chance.random() < 0.15:
            self._outcome = self._chance.choice([SUCCESS, FAILURE, RUNNING])
            self.feedback_message = self._chance.choice(["quiet", "loud"])
        return self._outcome


def random_root(chance: random.Random, numbers: Any, depth: int = 0) -> Any:
    name = str(next(numbers))
    if depth == 3 or chance.random() < 0.2 * depth:
        return Moody(name, chance)
    children = [random_root(chance, numbers, depth + 1) for _ in range(chance.randint(1, 4))]
    match chance.randrange(7):
        case 0 | 1:
            return sequence(name, *children, memory=chance.random() < 0.5)
        case 2 | 3:
            return selector(name, *children, memory=chance.random() < 0.5)
        case 4:
            return parallel(name, *children)
        case 5:
            return py_trees.decorators.Inverter(name, children[0])
        case _:
            return py_trees.decorators.Retry(name, children[0], 3)


def expected(visited: list[Any]) -> list[str]:
    """Return the outcomes that end a tick of a behaviour, in order; a tick that leaves it RUNNING has none."""
    return [{SUCCESS: "SUCCEEDED", FAILURE: "FAILED"}[each] for each in visited if each is not RUNNING]


def recorded(folder: Path) -> tuple[dict[str, list[str]], dict[str, int]]:
    """Return, by the name of a behaviour, its outcomes with repeats, and the number of its recorded ticks."""
    outcomes: dict[str, list[str]] = {}
    ticks: dict[str, int] = {}
    rows = ask(
        folder / "memory.db",
        "SELECT parameters, status, result, (SELECT max(number) FROM observation JOIN observation_value USING (id)"
        " WHERE observation.node_id = designator.id) FROM designator ORDER BY id",
    )
    for parameters, status, result, repeats in rows:
        name, repeated = json.loads(parameters)["name"], int(repeats or 0)
        ticks[name] = ticks.get(name, 0) + json.loads(result)["ticks"] + repeated
        if status != "INTERRUPTED":
            outcomes.setdefault(name, []).extend([status] * (1 + repeated))
    return outcomes, ticks


def misplaced(folder: Path) -> list[Any]:
    """Return the nodes that did not run inside their parent, or not below the parent that their tree has."""
    return ask(
        folder / "memory.db",
        "SELECT child.parameters, parent.parameters FROM designator AS child"
        " JOIN designator AS parent ON parent.id = child.parent_id"
        " WHERE child.sequence < parent.sequence OR child.end_sequence > parent.end_sequence",
    )


@pytest.mark.parametrize("instant_s", [0.0, 60.0])
@pytest.mark.parametrize("seed", range(3))
def test_a_random_tree_is_remembered_as_it_was_visited(
    seed: int, instant_s: float, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setattr(executives, "_UNWRITTEN_TICKS", 5 + seed)
    _compare(random.Random(seed), instant_s, tmp_path)


def _compare(chance: random.Random, instant_s: float, folder: Path) -> None:
    ticked, visits = tree(random_root(chance, count())), Visits()
    ticked.add_visitor(visits)
    with Memory.sync(url_of(folder), settings=Settings(fold="at_end")) as memory:
        with RememberedTree(ticked, memory.recording, instant_s=instant_s):
            for _ in range(_TICKS):
                ticked.tick()
                if chance.random() < 0.05:
                    ticked.root.stop(py_trees.common.Status.INVALID)
        assert memory.status.faults.total == 0
    outcomes, ticks = recorded(folder)
    assert {name: each for name, each in outcomes.items() if each} == {
        name: outcome for name, visited in visits.statuses.items() if (outcome := expected(visited))
    }
    assert ticks == {name: len(visited) for name, visited in visits.statuses.items()}
    assert misplaced(folder) == []
    assert_verified(folder)
