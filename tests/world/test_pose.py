"""A pose accepts any quaternion that represents a rotation."""

from __future__ import annotations

import math
from decimal import Decimal
from typing import Any

import numpy as np
import pytest

from pycrorm_async.errors import CallerError
from pycrorm_async.world import Pose
from pycrorm_async.world.pose import MalformedPose


@pytest.mark.parametrize("length", [1e-300, 0.5, 1.0, 3.0, 1e300])
def test_an_orientation_of_any_length_is_the_same_rotation(length: float) -> None:
    turned = Pose([0, 0, 0], [0, 0, 0.6 * length, 0.8 * length])
    assert turned.orientation == pytest.approx((0, 0, 0.6, 0.8), abs=1e-15)
    assert turned.yaw == pytest.approx(2 * math.asin(0.6))


@pytest.mark.parametrize("number", [0.0, 1e308])
def test_a_quaternion_without_a_direction_is_refused(number: float) -> None:
    with pytest.raises(ValueError, match="an orientation needs a finite length other than zero, got "):
        Pose([0, 0, 0], [number] * 4)


@pytest.mark.parametrize(
    ("arguments", "message"),
    [
        ({"position": [0, 0]}, r"three numbers x, y, z in metres, got \[0, 0\]"),
        ({"position": None}, "three numbers x, y, z in metres, got None"),
        ({"position": ["a", "b", "c"]}, "three numbers x, y, z in metres"),
        ({"position": [0, 0, 10**400]}, "three numbers x, y, z in metres"),
        ({"position": Pose()}, "three numbers x, y, z in metres, got Pose"),
        ({"orientation": [0, 0, 1]}, r"four numbers x, y, z, w, got \[0, 0, 1\]"),
        ({"orientation": "none"}, "four numbers x, y, z, w, got 'none'"),
        ({"frame": None}, "a pose's frame must be a str, got None"),
        ({"frame": 3}, "a pose's frame must be a str, got 3"),
        ({"time_ns": 1.5e18}, "whole number of ns since 1970"),
        ({"time_ns": "now"}, "whole number of ns since 1970 of at most 64 bits, got 'now'"),
        ({"time_ns": 2**63}, "whole number of ns since 1970 of at most 64 bits, got 9223372036854775808"),
    ],
)
def test_an_invalid_pose_is_refused_in_a_line_with_the_reason(arguments: dict[str, Any], message: str) -> None:
    with pytest.raises(MalformedPose, match=message) as caught:
        Pose(**arguments)
    assert isinstance(caught.value, CallerError)


def test_numbers_of_numpy_become_plain_ones() -> None:
    pose = Pose(np.array([1, 2, 3]), np.array([0.0, 0.0, 1.0, 0.0], np.float32), time_ns=np.int64(5))  # type: ignore[arg-type]
    assert (pose.position, pose.orientation, pose.time_ns) == ((1.0, 2.0, 3.0), (0.0, 0.0, 1.0, 0.0), 5)
    assert {type(each) for each in (*pose.position, *pose.orientation)} == {float}
    assert Pose(orientation=[Decimal(0), Decimal(0), Decimal(2), Decimal(0)]).orientation == (0.0, 0.0, 1.0, 0.0)  # type: ignore[list-item]
    assert type(pose.time_ns) is int
