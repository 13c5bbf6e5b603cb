"""A pose is made of any quaternion that means a rotation."""

from __future__ import annotations

import math

import pytest

from pycrorm_async.world import Pose


@pytest.mark.parametrize("length", [1e-300, 0.5, 1.0, 3.0, 1e300])
def test_an_orientation_of_any_length_is_the_same_rotation(length: float) -> None:
    turned = Pose([0, 0, 0], [0, 0, 0.6 * length, 0.8 * length])
    assert turned.orientation == pytest.approx((0, 0, 0.6, 0.8), abs=1e-15)
    assert turned.yaw == pytest.approx(2 * math.asin(0.6))


def test_no_quaternion_at_all_is_refused() -> None:
    with pytest.raises(ValueError, match="length other than zero"):
        Pose([0, 0, 0], [0, 0, 0, 0])
