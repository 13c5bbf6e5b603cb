from __future__ import annotations

import math

import numpy as np
import pytest

from pycrorm_async.errors import ImpossibleCondition
from pycrorm_async.learning.policy import (
    AROUND_OBJECT,
    Evidence,
    PickUpChoice,
    Policy,
    Rectangle,
    Region,
    default_policy,
)
from pycrorm_async.world.pose import Arms, Grasp

RETAINED = 0.94107
"""The share of the normal distribution in the square and outside the hole: 0.9953² - 0.2227²."""


def density(x: np.ndarray, y: np.ndarray) -> np.ndarray:
    """Compute it by hand: a variance of 0.5 in both directions, cut to the possible base positions."""
    allowed = (np.maximum(abs(x), abs(y)) < 2.0) & (np.maximum(abs(x), abs(y)) > 0.2)
    return np.where(allowed, np.exp(-(x**2) - y**2) / math.pi, 0.0) / RETAINED


def integral(x_min: float, x_max: float, y_min: float, y_max: float) -> float:
    """Return the integral of that density, by the midpoints of 1000 x 1000 cells."""
    x, dx = np.linspace(x_min, x_max, 1000, endpoint=False, retstep=True)
    y, dy = np.linspace(y_min, y_max, 1000, endpoint=False, retstep=True)
    values = density(x[:, None] + dx / 2, y[None, :] + dy / 2)
    return float(values.sum() * dx * dy)


def test_the_hole_and_the_edges_leave_094107_of_the_normal_distribution() -> None:
    whole_plane = Policy(default_policy().leaves)
    assert whole_plane.probability(Evidence(region=AROUND_OBJECT)) == pytest.approx(RETAINED, abs=5e-6)


def test_the_density_is_that_of_two_normal_distributions_and_an_eighth_for_each_arm_and_grasp() -> None:
    x, y = np.random.default_rng(1).uniform(-2.2, 2.2, (2, 1000))
    x[:200], y[:200] = x[:200] / 10, y[:200] / 10
    choices = [PickUpChoice(Arms.RIGHT, Grasp.TOP, *place) for place in zip(x.tolist(), y.tolist(), strict=True)]
    assert np.allclose(default_policy().likelihood(choices), density(x, y) / 8, rtol=1e-5, atol=0)


@pytest.mark.parametrize("corner", [(0.5, 1.0, -0.3, 0.4), (-2.0, -0.5, -2.0, 2.0), (0.0, 0.3, 0.0, 0.3)])
def test_probabilities_of_rectangles_are_the_integrals_of_the_density(corner: tuple[float, ...]) -> None:
    in_corner = Evidence(arms=frozenset({Arms.LEFT}), region=Region((Rectangle(*corner),)))
    assert default_policy().probability(in_corner) == pytest.approx(integral(*corner) / 2, rel=1e-3)


def test_samples_are_distributed_as_the_density() -> None:
    choices = default_policy().sample(np.random.default_rng(69), 40_000)
    places = np.array([choice[2:] for choice in choices])
    farthest = abs(places).max(axis=1)
    assert (farthest.min() >= 0.2, farthest.max() <= 2.0) == (True, True)
    for x_min, x_max, y_min, y_max in [(-0.7, -0.2, -0.5, 0.5), (0.2, 2.0, -2.0, 0.0), (-0.2, 0.2, 0.2, 0.6)]:
        inside = (places > (x_min, y_min)).all(axis=1) & (places < (x_max, y_max)).all(axis=1)
        expected = integral(x_min, x_max, y_min, y_max)
        assert inside.mean() == pytest.approx(expected, abs=4 * math.sqrt(expected / 40_000))
    for arm in (Arms.LEFT, Arms.RIGHT):
        assert np.mean([choice.arm is arm for choice in choices]) == pytest.approx(1 / 2, abs=0.01)
    for grasp in Grasp:
        assert np.mean([choice.grasp is grasp for choice in choices]) == pytest.approx(1 / 4, abs=0.01)


@pytest.mark.slow
def test_a_conditioned_policy_samples_the_matching_part_of_the_distribution() -> None:
    evidence = Evidence(
        arms=frozenset({Arms.RIGHT}),
        region=Region((Rectangle(-1.0, 0.3, -0.5, 0.5), Rectangle(0.3, 0.6, 0.1, 1.2))),
    )
    drawn = default_policy().condition(evidence).sample(np.random.default_rng(2), 20_000)
    kept = [
        choice
        for choice in default_policy().sample(np.random.default_rng(3), 200_000)
        if choice.arm is Arms.RIGHT
        and (
            (-1.0 <= choice.relative_x <= 0.3 and -0.5 <= choice.relative_y <= 0.5)
            or (0.3 <= choice.relative_x <= 0.6 and 0.1 <= choice.relative_y <= 1.2)
        )
    ]
    assert {choice.arm for choice in drawn} == {Arms.RIGHT}
    shares = np.linspace(0, 1, 11)
    for part in (2, 3):
        apart = np.quantile([choice[part] for choice in drawn], shares) - np.quantile([c[part] for c in kept], shares)
        assert abs(apart).max() < 0.03


def test_its_mode_is_the_four_places_next_to_the_hole() -> None:
    mode = default_policy().mode()
    assert mode.evidence.arms == frozenset({Arms.LEFT, Arms.RIGHT})
    assert mode.evidence.grasps == frozenset(Grasp)
    assert mode.evidence.region is not None
    assert {tuple(round(edge, 9) for edge in each) for each in mode.evidence.region.rectangles} == {
        (-0.25, -0.2, -0.025, 0.025),
        (0.2, 0.25, -0.025, 0.025),
        (-0.025, 0.025, -0.25, -0.2),
        (-0.025, 0.025, 0.2, 0.25),
    }


def test_the_policy_is_the_same_at_every_height() -> None:
    conditioned = default_policy().condition(Evidence(height=(0.5, 0.6)))
    choices = default_policy().sample(np.random.default_rng(4), 10)
    assert conditioned.likelihood(choices).tolist() == default_policy().likelihood(choices).tolist()


def test_no_sample_is_in_the_hole_or_beyond_the_edges() -> None:
    for nowhere in (Rectangle(-0.2, 0.2, -0.2, 0.2), Rectangle(2.0, 3.0, 0.0, 1.0)):
        evidence = Evidence(region=Region((nowhere,)))
        assert default_policy().probability(evidence) == 0.0
        with pytest.raises(ImpossibleCondition, match="no probability to: arms any, grasps any, in 0 rectangles"):
            default_policy().condition(evidence)
