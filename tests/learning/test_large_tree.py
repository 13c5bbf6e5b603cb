"""A tree with far more leaves than Python's recursion limit: learned, queried, saved and read again."""

from __future__ import annotations

import sys
from pathlib import Path

import numpy as np
import pytest

from pycrorm_async.learning.policy import (
    Evidence,
    PickUpChoice,
    Policy,
    Rectangle,
    Region,
    default_policy,
    load_policy,
    name_of,
    save_policy,
)
from pycrorm_async.learning.tree import learn
from pycrorm_async.world.pose import Arms
from tests.learning.geometric_rollouts import frame_of

pytestmark = pytest.mark.slow

LEFT = Evidence(arms=frozenset({Arms.LEFT}))
SQUARE = Rectangle(0.0, 1.0, 0.0, 1.0)
BESIDE = Evidence(region=Region((SQUARE,)), height=(-0.1, 0.1))


@pytest.fixture(scope="module")
def choices() -> list[PickUpChoice]:
    return default_policy().sample(np.random.default_rng(5), 3_000)


@pytest.fixture(scope="module")
def learned(choices: list[PickUpChoice]) -> Policy:
    heights = np.random.default_rng(6).uniform(-0.5, 0.5, len(choices))
    return learn(frame_of(choices).assign(height=heights), min_samples_leaf=2)


def test_a_tree_has_more_leaves_than_python_nests_calls(learned: Policy, choices: list[PickUpChoice]) -> None:
    assert len(learned.leaves) > sys.getrecursionlimit()
    assert learned.coverage(choices) == 1.0
    assert learned.probability(LEFT) == pytest.approx(np.mean([each.arm is Arms.LEFT for each in choices]))


def test_a_large_tree_answers_under_evidence(learned: Policy) -> None:
    conditioned = learned.condition(LEFT).condition(BESIDE)
    drawn = conditioned.sample(np.random.default_rng(7), 500)
    assert {each.arm for each in drawn} == {Arms.LEFT}
    assert all(0 <= each.relative_x <= 1 and 0 <= each.relative_y <= 1 for each in drawn)
    assert (conditioned.likelihood(drawn) > 0).all()
    assert conditioned.probability(LEFT) == pytest.approx(1.0)
    assert conditioned.mode().probability(BESIDE) == pytest.approx(1.0)


def test_a_large_tree_is_the_same_from_its_file(learned: Policy, tmp_path: Path) -> None:
    save_policy(learned, tmp_path / "policy.json")
    loaded = load_policy(tmp_path / "policy.json")
    assert loaded == learned
    assert name_of(loaded) == name_of(learned)
