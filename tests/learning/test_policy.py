from __future__ import annotations

import math

import numpy as np
import pytest

from pycrorm_async.errors import CallerError, ImpossibleCondition
from pycrorm_async.learning.policy import (
    Evidence,
    Leaf,
    Linear,
    Normal,
    PickUpChoice,
    Policy,
    Rectangle,
    Region,
    default_policy,
)
from pycrorm_async.world.pose import Arms, Grasp

LEFT, RIGHT = frozenset({Arms.LEFT}), frozenset({Arms.RIGHT})
WEST = Leaf(
    0.25,
    (1.0, 0.0),
    (0.5, 0.5, 0.0, 0.0),
    Linear((-1.0, -0.8, -0.5), (0.0, 0.8, 1.0)),
    Linear((0.0, 0.5), (0.0, 1.0)),
    Linear((0.5, 0.7), (0.0, 1.0)),
)
EAST = Leaf(
    0.75,
    (0.2, 0.8),
    (0.0, 0.0, 0.0, 1.0),
    Linear((0.5, 1.0), (0.0, 1.0)),
    Linear((-0.5, 0.0, 0.5), (0.0, 0.5, 1.0)),
    Linear((0.6, 1.0), (0.0, 1.0)),
)
TWO = Policy((WEST, EAST))
NEAR = Evidence(region=Region((Rectangle(0.21, 1 / 3, -1 / 7, 1 / 7),)))


def test_probabilities_are_sums_of_products() -> None:
    assert TWO.probability(Evidence()) == 1.0
    assert TWO.probability(Evidence(arms=LEFT)) == pytest.approx(0.25 + 0.75 * 0.2)
    assert TWO.probability(Evidence(arms=LEFT, grasps=frozenset({Grasp.TOP}))) == pytest.approx(0.75 * 0.2)
    assert TWO.probability(Evidence(height=(0.6, 0.7))) == pytest.approx(0.25 * 0.5 + 0.75 * 0.25)
    both = Region((Rectangle(-0.9, -0.65, 0.0, 0.1), Rectangle(0.6, 3.0, -9.0, 9.0)))
    assert TWO.probability(Evidence(region=both)) == pytest.approx(0.25 * 0.5 * 0.2 + 0.75 * 0.8)


def test_likelihoods_are_probability_times_density() -> None:
    choices = [
        PickUpChoice(Arms.LEFT, Grasp.FRONT, -0.9, 0.1),
        PickUpChoice(Arms.LEFT, Grasp.FRONT, -0.6, 0.1),
        PickUpChoice(Arms.RIGHT, Grasp.TOP, 0.7, 0.1),
        PickUpChoice(Arms.RIGHT, Grasp.FRONT, 0.7, 0.1),
        PickUpChoice(Arms.BOTH, Grasp.TOP, 0.7, 0.1),
        PickUpChoice(Arms.RIGHT, Grasp.TOP, 0.4, 0.1),
        PickUpChoice(Arms.RIGHT, Grasp.TOP, math.nan, 0.1),
    ]
    expected = [0.25 * 0.5 * 4.0 * 2.0, 0.25 * 0.5 * (0.2 / 0.3) * 2.0, 0.75 * 0.8 * 2.0 * 1.0, 0.0, 0.0, 0.0, 0.0]
    assert TWO.likelihood(choices) == pytest.approx(expected)
    assert TWO.coverage(choices) == pytest.approx(3 / 7)
    assert TWO.likelihood([]).tolist() == []


def test_the_first_and_the_last_knot_belong_to_a_leaf() -> None:
    ends = [PickUpChoice(Arms.LEFT, Grasp.FRONT, x, y) for x in (-1.0, -0.5) for y in (0.0, 0.5)]
    assert (TWO.likelihood(ends) > 0).all()


def test_evidence_on_the_height_changes_the_weights_of_the_leaves() -> None:
    low, high = TWO.condition(Evidence(height=(0.5, 0.6))), TWO.condition(Evidence(height=(0.75, 0.9)))
    assert low.probability(Evidence(arms=LEFT)) == pytest.approx(1.0)
    assert high.probability(Evidence(arms=LEFT)) == pytest.approx(0.2)
    assert low.likelihood([PickUpChoice(Arms.LEFT, Grasp.FRONT, -0.9, 0.1)]) == pytest.approx([0.5 * 4.0 * 2.0])


def test_a_conditioned_density_integrates_to_one() -> None:
    region = Region((Rectangle(-0.9, -0.6, -1.0, 0.4), Rectangle(-0.6, 0.7, 0.1, 0.4)))
    policy = TWO.condition(Evidence(arms=LEFT, region=region, height=(0.55, 0.8)))
    places = [(-1.01 + 0.02 * column, -0.51 + 0.02 * row) for column in range(100) for row in range(52)]
    total = sum(
        policy.likelihood([PickUpChoice(arm, grasp, x, y) for x, y in places]).sum() * 0.02**2
        for arm in Arms
        for grasp in Grasp
    )
    assert total == pytest.approx(1.0, rel=1e-6)


def test_conditioning_twice_is_conditioning_on_both() -> None:
    first = Evidence(arms=LEFT, region=Region((Rectangle(-0.9, 0.8, -1.0, 0.3),)), height=(0.5, 0.68))
    second = Evidence(
        grasps=frozenset({Grasp.FRONT, Grasp.TOP}),
        region=Region((Rectangle(-0.7, 0.6, 0.0, 1.0), Rectangle(0.6, 0.9, 0.0, 1.0))),
        height=(0.62, 2.0),
    )
    both = Evidence(
        arms=LEFT,
        grasps=frozenset({Grasp.FRONT, Grasp.TOP}),
        region=Region((Rectangle(-0.7, 0.6, 0.0, 0.3), Rectangle(0.6, 0.8, 0.0, 0.3))),
        height=(0.62, 0.68),
    )
    assert TWO.condition(first).condition(second) == TWO.condition(both)
    assert TWO.condition(first).probability(second) == pytest.approx(TWO.probability(both) / TWO.probability(first))


def test_contradicting_evidence_is_impossible() -> None:
    apart = [
        (Evidence(arms=LEFT), Evidence(arms=RIGHT)),
        (Evidence(height=(0.5, 0.6)), Evidence(height=(0.6, 0.7))),
        (Evidence(region=Region((Rectangle(-1, 0, 0, 1),))), Evidence(region=Region((Rectangle(0, 1, 0, 1),)))),
        (Evidence(), Evidence(arms=frozenset({Arms.BOTH}))),
        (Evidence(), Evidence(region=Region(()))),
    ]
    for first, second in apart:
        policy = TWO.condition(first)
        assert policy.probability(second) == 0.0
        with pytest.raises(ImpossibleCondition, match="gives no probability to: arms "):
            policy.condition(second)


def test_conditioned_samples_match_the_evidence_and_are_possible() -> None:
    region = Region((Rectangle(-0.9, -0.7, 0.1, 0.2), Rectangle(0.6, 0.7, -0.1, 0.0)))
    policy = TWO.condition(Evidence(region=region, grasps=frozenset({Grasp.FRONT, Grasp.TOP})))
    choices = policy.sample(np.random.default_rng(5), 20_000)
    assert (policy.likelihood(choices) > 0).all()
    west = [choice for choice in choices if choice.relative_x < 0]
    assert {choice[:2] for choice in west} == {(Arms.LEFT, Grasp.FRONT)}
    assert {choice[:2] for choice in choices if choice.relative_x > 0} == {(arm, Grasp.TOP) for arm in list(Arms)[:2]}
    masses = 0.25 * 0.5 * (0.4 + 0.2 / 3) * 0.2, 0.75 * 0.2 * 0.1
    assert len(west) / 20_000 == pytest.approx(masses[0] / sum(masses), abs=0.015)
    dense = np.mean([choice.relative_x < -0.8 for choice in west])
    assert dense == pytest.approx(0.4 / (0.4 + 0.2 / 3), abs=0.01)
    x, y = (np.array([choice[part] for choice in choices]) for part in (2, 3))
    assert region.contains(x, y).all()


def test_the_same_generator_draws_the_same_samples_in_any_batches() -> None:
    at_once = TWO.sample(np.random.default_rng(6), 50)
    one_by_one = np.random.default_rng(6)
    assert [TWO.sample(one_by_one)[0] for _ in range(50)] == at_once
    assert TWO.sample(np.random.default_rng(7), 50) != at_once
    assert TWO.sample(np.random.default_rng(6), 0) == []


@pytest.mark.parametrize("drawn", [0.0, 1 - 2**-53], ids=["least", "most"])
def test_the_least_and_the_most_likely_draws_are_possible_too(drawn: float) -> None:
    class Fixed:
        def random(self, shape: tuple[int, int]) -> np.ndarray:
            return np.full(shape, drawn)

    region = Region((Rectangle(-0.9, -0.3 + 1e-12, 0.1, 1 / 3), Rectangle(-0.3 + 1e-12, 0.7, -1.9, -0.1)))
    for policy in (TWO.condition(Evidence(region=region)), default_policy(), default_policy().condition(NEAR)):
        (choice,) = policy.sample(Fixed())  # type: ignore[arg-type]
        assert policy.coverage([choice]) == 1.0


def test_sampling_does_not_change_the_global_generator() -> None:
    before = np.random.get_state(legacy=False)["state"]
    TWO.sample(np.random.default_rng(6), 50)
    assert repr(np.random.get_state(legacy=False)["state"]) == repr(before)


def test_the_mode_is_the_square_with_the_highest_probability() -> None:
    mode = TWO.mode(width_m=0.1)
    # 0.25 * 0.5 * 0.4 * 0.2 in the west is less than 0.75 * 0.8 * 0.2 * 0.1 in the east
    assert mode.evidence.arms == RIGHT
    assert mode.evidence.grasps == frozenset({Grasp.TOP})
    assert mode.evidence.region is not None
    assert mode.evidence.region.rectangles[0] == pytest.approx((0.5, 0.6, -0.5, -0.4))
    west = TWO.condition(Evidence(region=Region((Rectangle(-0.85, 0.0, 0.42, 0.5),)))).mode(width_m=0.1)
    assert west.evidence.arms == LEFT
    assert west.evidence.grasps == frozenset({Grasp.FRONT, Grasp.LEFT})
    assert west.evidence.region is not None
    assert west.evidence.region.rectangles[0] == pytest.approx((-0.85, -0.75, 0.42, 0.5))


def test_a_window_holds_as_much_as_any_of_its_width_can() -> None:
    linear = WEST.x
    assert linear.peak(-5.0, 5.0, 4.0).probability == pytest.approx(1.0)
    assert linear.peak(-5.0, 5.0, 0.3) == pytest.approx((-1.0, -0.7, 0.8 + 0.2 / 3))
    assert Linear((0.0, 1.0, 1.1), (0.0, 0.1, 1.0)).peak(-5.0, 5.0, 0.3) == pytest.approx((0.8, 1.1, 0.92))
    assert linear.peak(-0.9, -0.7, 4.0) == pytest.approx((-0.9, -0.7, 0.4 + 0.2 / 3))
    assert Normal(0.3, 1.0).peak(-1.0, 1.0, 0.2)[:2] == pytest.approx((0.2, 0.4))
    assert Normal(3.0, 1.0).peak(-1.0, 1.0, 0.2)[:2] == pytest.approx((0.8, 1.0))


@pytest.mark.parametrize(
    ("rectangles", "message"),
    [
        ([Rectangle(0, 1, 0, 1), Rectangle(2, 3, 0, 1), Rectangle(0.9, 2, 0.9, 2)], "must not overlap"),
        ([Rectangle(0, 0, 0, 1)], "finite limits, the smaller first"),
        ([Rectangle(1, 0, 0, 1)], "finite limits, the smaller first"),
        ([Rectangle(0, math.inf, 0, 1)], "finite limits, the smaller first"),
        ([Rectangle(0, math.nan, 0, 1)], "finite limits, the smaller first"),
    ],
)
def test_a_region_consists_of_rectangles_that_do_not_overlap(rectangles: list[Rectangle], message: str) -> None:
    with pytest.raises(CallerError, match=message):
        Region(tuple(rectangles))


def test_the_default_policy_places_the_base_as_in_the_thesis() -> None:
    rng = np.random.default_rng(5)
    drawn = rng.normal(0, math.sqrt(0.5), (30_000, 2))
    farthest = np.abs(drawn).max(axis=1)
    expected = np.abs(drawn[(farthest >= 0.2) & (farthest <= 2)])
    choices = default_policy().sample(rng, 20_000)
    places = np.abs([(each.relative_x, each.relative_y) for each in choices])
    assert places.mean(axis=0) == pytest.approx(expected.mean(axis=0), abs=0.015)
    farthest = places.max(axis=1)
    assert (farthest.min() >= 0.2, farthest.min() < 0.21, farthest.max() <= 2, farthest.max() > 1.95) == (True,) * 4
    for kind, members in (("arm", (Arms.LEFT, Arms.RIGHT)), ("grasp", Grasp)):
        shares = [sum(getattr(each, kind) is member for each in choices) / len(choices) for member in members]
        assert shares == pytest.approx([1 / len(shares)] * len(shares), abs=0.015)


def test_invalid_evidence_is_refused() -> None:
    with pytest.raises(CallerError, match="evidence on arms must be members of Arms"):
        Evidence(arms=frozenset({Grasp.LEFT}))  # type: ignore[arg-type]
    with pytest.raises(CallerError, match="evidence on grasps must be members of Grasp"):
        Evidence(grasps=frozenset({"LEFT"}))  # type: ignore[arg-type]
    for height in ((0.9, 0.9), (1.0, 0.9), (0.9, math.nan)):
        with pytest.raises(CallerError, match="evidence on height takes an interval"):
            Evidence(height=height)
    with pytest.raises(CallerError, match="-1 choices"):
        default_policy().sample(np.random.default_rng(1), -1)
    with pytest.raises(CallerError, match="no choices"):
        default_policy().coverage([])
    with pytest.raises(CallerError, match="width_m must be > 0, got 0"):
        default_policy().mode(width_m=0)
