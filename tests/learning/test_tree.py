"""A tree of places: learned as pyjpt learns it, queried, saved and read again, however many leaves it has."""

from __future__ import annotations

import math
import subprocess
import sys
import warnings
from collections.abc import Iterator
from concurrent.futures import ThreadPoolExecutor
from typing import Any

import numpy as np
import pandas as pd
import pytest

from pycrorm_async.errors import CallerError, ImpossibleCondition, MissingExtra, NotEnoughExperience
from pycrorm_async.learning.policy import Evidence, PickUpChoice, Policy, default_policy
from pycrorm_async.learning.tree import learn
from pycrorm_async.world.pose import Arms, Grasp
from tests.learning.geometric_rollouts import frame_of, succeeds

pytestmark = pytest.mark.slow


LEFT = Evidence(arms=frozenset({Arms.LEFT}))
ALIKE = {"arm": ["LEFT"] * 30, "grasp": ["FRONT"] * 30, "object_x": [0.5] * 30, "object_y": [0.1] * 30}


def successes_of(rollouts: int, seed: int) -> list[PickUpChoice]:
    return [each for each in default_policy().sample(np.random.default_rng(seed), rollouts) if succeeds(each)]


@pytest.fixture(scope="module")
def successes() -> list[PickUpChoice]:
    """Return the successes of 2,000 pick-ups of the default policy: about 320."""
    return successes_of(2000, 69)


@pytest.fixture(scope="module")
def learned(successes: list[PickUpChoice]) -> Policy:
    return learn(frame_of(successes))


@pytest.fixture(scope="module")
def oracle(successes: list[PickUpChoice]) -> Iterator[Any]:
    """Return the tree that pyjpt learns without any code of the package."""
    with warnings.catch_warnings():
        warnings.simplefilter("ignore")
        from jpt.distributions import Numeric, SymbolicType
        from jpt.trees import JPT
        from jpt.variables import NumericVariable, SymbolicVariable

        tree = JPT(
            [
                SymbolicVariable("arm", SymbolicType("Arm", ["LEFT", "RIGHT"])),
                SymbolicVariable("grasp", SymbolicType("Grasp", ["FRONT", "LEFT", "RIGHT", "TOP"])),
                NumericVariable("object_x", Numeric),
                NumericVariable("object_y", Numeric),
            ],
            min_samples_leaf=25,
        )
        with ThreadPoolExecutor(1) as beside:
            beside.submit(tree.learn, frame_of(successes), multicore=0).result()
        yield tree


def test_a_learned_policy_succeeds_far_more_often_than_the_default_one(
    learned: Policy, successes: list[PickUpChoice]
) -> None:
    assert 0.14 < len(successes) / 2000 < 0.18
    tries = learned.sample(np.random.default_rng(1), 1000)
    assert np.mean([succeeds(each) for each in tries]) > 0.5


def test_its_mode_succeeds_more_often_still(learned: Policy) -> None:
    mode = learned.mode()
    tries = mode.sample(np.random.default_rng(1), 200)
    assert len({each[:2] for each in tries}) == 1
    assert np.mean([succeeds(each) for each in tries]) > 0.9


def test_all_successes_it_learned_from_are_possible_and_regions_without_one_are_not(
    learned: Policy, successes: list[PickUpChoice]
) -> None:
    assert learned.coverage(successes) == 1.0
    assert learned.probability(LEFT) == pytest.approx(np.mean([each.arm is Arms.LEFT for each in successes]))
    assert learned.probability(Evidence(grasps=frozenset({Grasp.TOP}))) == 0.0
    with pytest.raises(ImpossibleCondition, match="grasps TOP"):
        learned.condition(Evidence(grasps=frozenset({Grasp.TOP})))


def test_the_leaves_equal_those_of_pyjpt_in_order_and_to_the_digit(learned: Policy, oracle: Any) -> None:
    rows = sum(leaf.samples for leaf in oracle.leaves.values())
    theirs = []
    for _, leaf in sorted(oracle.leaves.items()):
        arm, grasp, x, y = (leaf.distributions[each] for each in oracle.variables)
        knots = [tuple(piece.upper for piece in each.cdf.intervals[:-1]) for each in (x, y)]
        theirs.append((leaf.samples / rows, tuple(arm.probabilities), tuple(grasp.probabilities), *knots))
    ours = [(each.weight, each.arms, each.grasps, each.x.knots, each.y.knots) for each in learned.leaves]  # type: ignore[union-attr]
    assert len(ours) > 5
    assert ours == theirs


def test_learning_again_yields_the_same_policy(learned: Policy, successes: list[PickUpChoice]) -> None:
    assert learn(frame_of(successes)) == learned


FIRST_OF_ALL = """
import random, signal, sys, threading, warnings
import numpy, pandas
warnings.simplefilter("error")
signal.signal(signal.SIGINT, signal.default_int_handler)
def state():
    generators = random.getstate(), repr(numpy.random.get_state(legacy=False))
    return generators, list(warnings.filters), signal.getsignal(signal.SIGINT), threading.enumerate(), sys.excepthook
from pycrorm_async.learning.tree import learn
assert "jpt" not in sys.modules
before = state()
numbers = [number / 30 for number in range(30)]
learn(pandas.DataFrame({"arm": ["LEFT"] * 30, "grasp": ["TOP"] * 30, "object_x": numbers, "object_y": numbers}))
assert "jpt.trees" in sys.modules
changed = [(then, now) for then, now in zip(before, state()) if then != now]
assert not changed, changed
"""


@pytest.mark.soak
def test_the_first_learning_of_a_process_changes_no_other_state_of_it() -> None:
    done = subprocess.run([sys.executable, "-c", FIRST_OF_ALL], check=False, capture_output=True, text=True)
    assert (done.returncode, done.stderr) == (0, "")


def test_a_height_that_never_changed_is_noted_and_does_not_apply_to_others(successes: list[PickUpChoice]) -> None:
    frame = frame_of(successes).assign(height=0.9)
    policy = learn(frame)
    assert policy.constant_height == 0.9
    assert all(leaf.height is None for leaf in policy.leaves)
    assert policy.condition(Evidence(height=(1.2, 1.3))).likelihood(successes).tolist() == (
        policy.likelihood(successes).tolist()
    )


def test_base_positions_are_learned_for_each_height() -> None:
    chance = np.random.default_rng(4)
    heights = chance.uniform(0.6, 1.0, 400)
    frame = pd.DataFrame(
        {
            "arm": np.where(chance.random(400) < 0.5, "LEFT", "RIGHT"),
            "grasp": "FRONT",
            "object_x": np.where(heights < 0.8, -0.6, 0.6) + chance.normal(0, 0.05, 400),
            "object_y": chance.normal(0, 0.1, 400),
            "height": heights,
        }
    )
    policy = learn(frame)
    low, high = (policy.condition(Evidence(height=around)) for around in ((0.69, 0.71), (0.89, 0.91)))
    assert all(each.relative_x < 0 for each in low.sample(np.random.default_rng(5), 500))
    assert all(each.relative_x > 0 for each in high.sample(np.random.default_rng(5), 500))
    assert low.coverage([PickUpChoice(Arms.LEFT, Grasp.FRONT, 0.6, 0.0)]) == 0.0
    assert policy.probability(Evidence(height=(0.6, 0.8))) == pytest.approx((heights < 0.8).mean(), abs=0.02)
    with pytest.raises(ImpossibleCondition, match=r"height 1\.500 to 1\.600 m"):
        policy.condition(Evidence(height=(1.5, 1.6)))


def test_from_a_single_base_position_only_that_one_is_learned() -> None:
    policy = learn(pd.DataFrame(ALIKE))
    choices = policy.sample(rng(), 100)
    assert {each[:2] for each in choices} == {(Arms.LEFT, Grasp.FRONT)}
    assert all(math.dist((each.relative_x, each.relative_y), (0.5, 0.1)) < 0.0015 for each in choices)
    assert policy.coverage([PickUpChoice(Arms.LEFT, Grasp.FRONT, 0.5, 0.1)]) == 1.0


@pytest.mark.parametrize("seed", range(20))
def test_every_frame_of_repeated_and_isolated_values_is_learned_whole(seed: int) -> None:
    chance = np.random.default_rng(seed)
    rows = int(chance.choice([2, 5, 40, 150]))

    def numbers() -> np.ndarray:
        kinds = (
            chance.normal(0, 1, rows),
            chance.integers(0, 3, rows) / 2,
            np.full(rows, 0.7),
            chance.choice([0.6, 0.75], rows) + chance.normal(0, 1e-9, rows),
            np.where(chance.random(rows) < 0.5, 0.25, chance.random(rows)),
        )
        return kinds[chance.integers(len(kinds))]

    frame = pd.DataFrame(
        {
            "arm": chance.choice(["LEFT", "RIGHT"][: chance.integers(1, 3)], rows),
            "grasp": chance.choice([each.name for each in Grasp][: chance.integers(1, 5)], rows),
            "object_x": numbers(),
            "object_y": numbers(),
            "height": numbers(),
        }
    )
    policy = learn(frame, min_samples_leaf=int(chance.integers(2, min(rows, 30) + 1)))
    seen = [
        PickUpChoice(Arms[arm], Grasp[grasp], x, y)
        for arm, grasp, x, y in zip(*(frame[name].tolist() for name in frame.columns[:4]), strict=True)
    ]
    assert policy.coverage(seen) == 1.0
    assert policy.coverage(policy.sample(rng(), 500)) == 1.0
    assert policy.probability(LEFT) == pytest.approx((frame.arm == "LEFT").mean())


@pytest.mark.parametrize(
    ("change", "said"),
    [
        ({"arm": ["BOTH"] * 30}, "column arm holds 'BOTH', which is none of LEFT, RIGHT"),
        ({"grasp": [Grasp.TOP] * 30}, "column grasp holds 3, which is none of FRONT, LEFT, RIGHT, TOP"),
        ({"grasp": ["TOP"] * 29 + [None]}, "column grasp holds nan"),
        ({"object_x": [0.1] * 28 + [math.nan, math.inf]}, "object_x has no finite number in 2 of 30 rows"),
        ({"object_y": ["near"] * 30}, "column object_y holds values that are not numbers"),
        ({"height": [None] * 30}, "height has no finite number in 30 of 30 rows"),
    ],
)
def test_invalid_successes_are_refused_by_name(change: dict[str, Any], said: str) -> None:
    with pytest.raises(CallerError) as raised:
        learn(pd.DataFrame(ALIKE | change))
    assert said in str(raised.value)


def test_a_missing_column_is_named() -> None:
    frame = pd.DataFrame(ALIKE).rename(columns={"object_x": "relative_x"})
    with pytest.raises(CallerError, match="the frame has no column object_x: select arm, grasp, object_x, object_y"):
        learn(frame)


def test_too_few_successes_are_no_experience() -> None:
    for rows in (0, 1, 24):
        few = f"^{rows} successes are too few to learn from: a leaf takes 25; record more rollouts or choose a smaller"
        with pytest.raises(NotEnoughExperience, match=rf"{few} --min-samples-leaf \(min_samples_leaf=\)$"):
            learn(pd.DataFrame(ALIKE)[:rows])
    with pytest.raises(CallerError, match="two samples or more"):
        learn(pd.DataFrame(ALIKE), min_samples_leaf=1)


def test_without_pyjpt_the_extra_to_install_is_named(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setitem(sys.modules, "jpt.trees", None)
    with pytest.raises(MissingExtra, match=r"pip install 'pycrorm-async\[learning\]'"):
        learn(pd.DataFrame(ALIKE))


@pytest.mark.soak
@pytest.mark.parametrize("seed", [69, 70])
def test_ten_thousand_attempts_teach_more_than_their_own_repetition(seed: int) -> None:
    policy = learn(frame_of(successes_of(10_000, seed)))
    tries = policy.sample(np.random.default_rng(1), 10_000)
    assert np.mean([succeeds(each) for each in tries]) >= 0.78
    assert policy.coverage(successes_of(10_000, seed + 1000)) >= 0.85


@pytest.mark.soak
def test_the_mode_for_every_arm_and_grasp_succeeds_nearly_always() -> None:
    policy = learn(frame_of(successes_of(10_000, 69)))
    for arm in (Arms.LEFT, Arms.RIGHT):
        for grasp in (Grasp.FRONT, Grasp.LEFT, Grasp.RIGHT):
            conditions = Evidence(arms=frozenset({arm}), grasps=frozenset({grasp}))
            tries = policy.condition(conditions).mode().sample(np.random.default_rng(1), 100)
            assert {each[:2] for each in tries} == {(arm, grasp)}
            assert np.mean([succeeds(each) for each in tries]) >= 0.95, conditions


def rng() -> np.random.Generator:
    return np.random.default_rng(9)


# === large tree ===============================================================================================
#
# A tree with far more leaves than Python's recursion limit.


@pytest.fixture(scope="module")
def choices() -> list[PickUpChoice]:
    return default_policy().sample(np.random.default_rng(5), 3_000)


@pytest.fixture(scope="module")
def learned_large(choices: list[PickUpChoice]) -> Policy:
    heights = np.random.default_rng(6).uniform(-0.5, 0.5, len(choices))
    return learn(frame_of(choices).assign(height=heights), min_samples_leaf=2)


def test_a_tree_has_more_leaves_than_python_nests_calls(learned_large: Policy, choices: list[PickUpChoice]) -> None:
    assert len(learned_large.leaves) > sys.getrecursionlimit()
    assert learned_large.coverage(choices) == 1.0
    assert learned_large.probability(LEFT) == pytest.approx(np.mean([each.arm is Arms.LEFT for each in choices]))
