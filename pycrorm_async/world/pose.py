"""A pose is a frozen value: position in metres, unit quaternion xyzw, the frame of both, and the time of creation.

>>> Pose([1.3, 0.7, 0.95]).position.z
0.95
>>> Pose([1, 0, 0]) @ Pose([0, 1, 0])
Pose(position=[1.0, 1.0, 0.0], orientation=[0.0, 0.0, 0.0, 1.0], frame='map')
"""

from __future__ import annotations

import math
import operator
from collections.abc import Sequence
from dataclasses import dataclass, field
from typing import NamedTuple

from pycrorm_async.clock import SYSTEM_CLOCK
from pycrorm_async.errors import CallerError

__all__ = [
    "Vector",
    "Quaternion",
    "IDENTITY",
    "COORDINATE_MAX",
    "MalformedPose",
    "Pose",
    "rotated",
    "product",
    "yaw_quaternion",
]


class Vector(NamedTuple):
    """A position or direction, metres."""

    x: float
    y: float
    z: float


class Quaternion(NamedTuple):
    """A rotation as quaternion; unit length inside a `Pose`."""

    x: float
    y: float
    z: float
    w: float


IDENTITY = Quaternion(0.0, 0.0, 0.0, 1.0)

COORDINATE_MAX = 1e9
"""Bounds the absolute value of coordinates (m) and joint positions (rad or m), so that no sum of them is infinite."""


def product(a: Sequence[float], b: Sequence[float]) -> Quaternion:
    """Return the Hamilton product a ⊗ b of two xyzw quaternions: the rotation b followed by a."""
    ax, ay, az, aw = a
    bx, by, bz, bw = b
    return Quaternion(
        aw * bx + ax * bw + ay * bz - az * by,
        aw * by - ax * bz + ay * bw + az * bx,
        aw * bz + ax * by - ay * bx + az * bw,
        aw * bw - ax * bx - ay * by - az * bz,
    )


def rotated(q: Sequence[float], v: Sequence[float]) -> Vector:
    """Rotate the vector v by the unit quaternion q."""
    qx, qy, qz, qw = q
    x, y, z = v
    tx, ty, tz = 2 * (qy * z - qz * y), 2 * (qz * x - qx * z), 2 * (qx * y - qy * x)
    return Vector(
        x + qw * tx + qy * tz - qz * ty,
        y + qw * ty + qz * tx - qx * tz,
        z + qw * tz + qx * ty - qy * tx,
    )


def yaw_quaternion(angle: float) -> Quaternion:
    """Return the rotation by `angle` rad about z."""
    return Quaternion(0.0, 0.0, math.sin(angle / 2), math.cos(angle / 2))


class MalformedPose(CallerError, ValueError):
    """The arguments of a pose are not numbers, a frame's name and whole nanoseconds."""


@dataclass(frozen=True, slots=True, init=False, repr=False)
class Pose:
    """A position and an orientation in a frame. Equality ignores the time.

    Args:
        position: x, y, z in metres.
        orientation: quaternion x, y, z, w of any length but zero; stored with length one.
        frame: name of the frame of both.
        time_ns: UTC in ns since 1970; None means now.

    Raises:
        MalformedPose: a wrong number of components, components that are not numbers, a quaternion of length zero, a
            frame that is not a str, or a time that is not an integer of 64 bits. It is a ValueError too.
    """

    position: Vector
    orientation: Quaternion
    frame: str
    time_ns: int = field(compare=False)

    def __init__(
        self,
        position: Sequence[float] = (0.0, 0.0, 0.0),
        orientation: Sequence[float] = (0.0, 0.0, 0.0, 1.0),
        frame: str = "map",
        time_ns: int | None = None,
    ) -> None:
        put = object.__setattr__
        try:
            x, y, z = position
            put(self, "position", Vector(float(x), float(y), float(z)))
        except (TypeError, ValueError, OverflowError):
            raise MalformedPose(f"a position needs three numbers x, y, z in metres, got {position!r}") from None
        try:
            qx, qy, qz, qw = orientation
            length = math.hypot(qx, qy, qz, qw)
        except (TypeError, ValueError, OverflowError):
            raise MalformedPose(f"an orientation needs four numbers x, y, z, w, got {orientation!r}") from None
        if length == 0:
            raise MalformedPose("an orientation needs a quaternion of length other than zero")
        unit = abs(length - 1.0) < 1e-15
        scale = 1.0 if unit else 1.0 / length
        put(
            self,
            "orientation",
            Quaternion(float(qx * scale), float(qy * scale), float(qz * scale), float(qw * scale)),
        )
        if not isinstance(frame, str):
            raise MalformedPose(f"a pose's frame must be a str, got {frame!r}")
        put(self, "frame", frame)
        put(self, "time_ns", SYSTEM_CLOCK.wall_ns() if time_ns is None else _nanoseconds(time_ns))

    def __repr__(self) -> str:
        return f"Pose(position={list(self.position)}, orientation={list(self.orientation)}, frame={self.frame!r})"

    def __matmul__(self, inner: Pose) -> Pose:
        """Convert `inner`, a pose relative to this one, to this pose's frame."""
        moved = rotated(self.orientation, inner.position)
        x, y, z = self.position
        return Pose((x + moved.x, y + moved.y, z + moved.z), product(self.orientation, inner.orientation), self.frame)

    def inverse(self) -> Pose:
        """Return the pose P for which `self @ P` is the identity."""
        x, y, z, w = self.orientation
        back = Quaternion(-x, -y, -z, w)
        moved = rotated(back, self.position)
        return Pose((-moved.x, -moved.y, -moved.z), back, self.frame)

    def relative_to(self, other: Pose) -> Pose:
        """Return this pose relative to `other`; both must be in the same frame."""
        return other.inverse() @ self

    def distance(self, other: Pose) -> float:
        """Return the distance between the two positions, m."""
        return math.dist(self.position, other.position)

    @property
    def yaw(self) -> float:
        """Heading in the plane, rad in (-π, π]."""
        x, y, z, w = self.orientation
        return math.atan2(2 * (w * z + x * y), 1 - 2 * (y * y + z * z))


def _nanoseconds(time: object) -> int:
    """Check that the time fits the log's 64 bits; the log would refuse the whole episode for a larger one."""
    try:
        whole = operator.index(time)  # type: ignore[arg-type]  # the call is the check
    except TypeError:
        whole = _NS_END
    if not -_NS_END <= whole < _NS_END:
        raise MalformedPose(f"a pose's time must be a whole number of ns since 1970 below 2**63, got {time!r}")
    return whole


_NS_END = 2**63
