"""Random trees, ticked at random: what is remembered of each behaviour is exactly what a visitor saw."""

from __future__ import annotations

import json
import random
import tempfile
from itertools import count
from pathlib import Path
from typing import Any

import py_trees
import pytest

from pycrorm_async import Memory, Settings
from pycrorm_async.integrations.py_trees import RememberedTree
from pycrorm_async.record import executives
from tests.databases import ask
from tests.integrations.py_trees.behaviours import FAILURE, RUNNING, SUCCESS, Visits, parallel, selector, sequence, tree
from tests.recording.recorded_memory import assert_verified, url_of

pytestmark = pytest.mark.slow

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
@pytest.mark.soak_on(3, 4, 5)
@pytest.mark.parametrize("seed", range(6))
def test_a_random_tree_is_remembered_as_it_was_visited(
    seed: int, instant_s: float, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setattr(executives, "_UNWRITTEN_TICKS", 5 + seed)
    _compare(random.Random(seed), instant_s, tmp_path)


@pytest.mark.soak
@pytest.mark.parametrize("seed", range(100, 110))
def test_many_random_trees_are_remembered_as_they_were_visited(seed: int, in_turn: bool) -> None:
    chance = random.Random(seed)
    for _ in range(3 if in_turn else 30):
        with tempfile.TemporaryDirectory() as folder:
            _compare(chance, chance.choice([0.0, 60.0]), Path(folder))


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
