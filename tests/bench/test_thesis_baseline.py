"""The baseline has the shape of the system of the thesis."""

from __future__ import annotations

from collections.abc import Iterator
from pathlib import Path

import pytest
from sqlalchemy import Engine

from bench.material.baseline import BaselineBase, Statements, engine_of, store
from bench.material.rollouts import THESIS_NODES, Tree, tree, tree_of
from tests.databases import ask

pytestmark = pytest.mark.slow

ROOT_ROWS = 2
"""The root's own node, and the episode's metadata."""


@pytest.fixture
def file(tmp_path: Path) -> str:
    return f"sqlite:///{tmp_path}/baseline.db"


@pytest.fixture
def engine(file: str) -> Iterator[Engine]:
    engine = engine_of(file)
    yield engine
    engine.dispose()


def rows_of(url: str) -> dict[str, int]:
    """Return the number of rows of each table that is not empty."""
    counts = {each: ask(url, f'SELECT count(*) FROM "{each}"')[0][0] for each in BaselineBase.metadata.tables}
    return {name: count for name, count in counts.items() if count}


@pytest.mark.parametrize(("motions", "nodes", "rows"), [(1, 9, 84), (3, 11, 95), (5, 13, 106)])
def test_a_rollout_has_as_many_nodes_and_rows_as_in_the_thesis(
    file: str, engine: Engine, motions: int, nodes: int, rows: int
) -> None:
    rollouts = tree_of([motions])
    store(rollouts, engine)
    assert rollouts.nodes == 1 + nodes
    assert sum(rows_of(file).values()) == ROOT_ROWS + rows


def test_one_navigation_is_eleven_inserts_over_eight_tables(file: str, engine: Engine) -> None:
    rollouts = tree_of([1])
    navigation = rollouts.rollouts[0]
    navigation.children.clear()
    statements = Statements(engine)
    store(Tree([navigation], 2), engine)
    rows = rows_of(file)
    assert rows == {
        "ProcessMetaData": 1,
        "TaskTreeNode": 2,
        "Designator": 1,
        "Action": 1,
        "NavigateAction": 1,
        "RobotState": 1,
        "Pose": 2,
        "Position": 2,
        "Quaternion": 2,
    }
    assert statements.sent == ROOT_ROWS + 11


def test_rows_with_a_key_of_their_own_take_a_statement_each_on_sqlite(file: str, engine: Engine) -> None:
    rollouts = tree(1_000, seed=1)
    statements = Statements(engine)
    store(rollouts, engine)
    rows = rows_of(file)
    roots = ("TaskTreeNode", "Designator", "RobotState", "Object", "Pose", "Position", "Quaternion", "ProcessMetaData")
    own = {name: rows.pop(name) for name in roots}
    assert statements.sent == sum(own.values()) + len(rows)
    assert statements.sent / rollouts.nodes == pytest.approx(7.0, abs=0.1)
    assert (sum(own.values()) + sum(rows.values())) / rollouts.nodes == pytest.approx(9.05, abs=0.05)


@pytest.mark.soak
def test_fifty_thousand_rollouts_have_the_number_of_nodes_of_the_thesis() -> None:
    assert tree(THESIS_NODES, seed=69).nodes == 488_043


def test_the_same_seed_makes_the_same_tree_and_another_one_another() -> None:
    assert tree(500, seed=7) == tree(500, seed=7)
    assert tree(500, seed=7) != tree(500, seed=8)
