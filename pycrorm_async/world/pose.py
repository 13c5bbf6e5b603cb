"""A pose is a frozen value: a position in metres and a unit quaternion xyzw, the frame of both, and a time.

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


class Vector(NamedTuple):
    """A position or a displacement, m."""

    x: float
    y: float
    z: float


class Quaternion(NamedTuple):
    """A rotation as a quaternion; a `Pose` keeps it at length one."""

    x: float
    y: float
    z: float
    w: float


IDENTITY = Quaternion(0.0, 0.0, 0.0, 1.0)

COORDINATE_MAX = 1e9
"""Bounds coordinates (m) and joint positions (rad or m) that a world accepts, so that no sum of them is infinite."""


def product(a: Sequence[float], b: Sequence[float]) -> Quaternion:
    """Return the Hamilton product a ⊗ b of two xyzw quaternions, which rotates by b first, then by a."""
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


def dot(a: Sequence[float], b: Sequence[float]) -> float:
    """Return the scalar product of two vectors."""
    return sum(x * y for x, y in zip(a, b, strict=True))


def yaw_quaternion(angle: float) -> Quaternion:
    """Return the rotation by `angle` rad about the z axis."""
    return Quaternion(0.0, 0.0, math.sin(angle / 2), math.cos(angle / 2))


class MalformedPose(CallerError, ValueError):
    """A pose cannot have this position, orientation, frame or time."""


@dataclass(frozen=True, slots=True, init=False, repr=False)
class Pose:
    """A position and an orientation in a frame. Equality ignores `time_ns`. A world refuses non-finite components.

    Args:
        position: x, y, z in metres.
        orientation: quaternion x, y, z, w of any length but zero; stored normalised.
        frame: name of the frame in which both are given.
        time_ns: ns since 1970 UTC; None means now.

    Raises:
        MalformedPose: a wrong number of components, components that are not numbers, a quaternion of length zero or
            without a finite length, a frame that is not a str, or a time that is not a signed 64-bit integer.
            `MalformedPose` is a `ValueError` too.
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
            qx, qy, qz, qw = map(float, orientation)
            length = math.hypot(qx, qy, qz, qw)
        except (TypeError, ValueError, OverflowError):
            raise MalformedPose(f"an orientation needs four numbers x, y, z, w, got {orientation!r}") from None
        if length == 0 or (length == math.inf and all(map(math.isfinite, (qx, qy, qz, qw)))):
            raise MalformedPose(f"an orientation needs a finite length other than zero, got {orientation!r}")
        if abs(length - 1.0) >= 1e-15:  # a unit quaternion keeps its exact bits
            qx, qy, qz, qw = qx / length, qy / length, qz / length, qw / length
        put(self, "orientation", Quaternion(qx, qy, qz, qw))
        if not isinstance(frame, str):
            raise MalformedPose(f"a pose's frame must be a str, got {frame!r}")
        put(self, "frame", frame)
        put(self, "time_ns", SYSTEM_CLOCK.wall_ns() if time_ns is None else _nanoseconds(time_ns))

    def __repr__(self) -> str:
        return f"Pose(position={list(self.position)}, orientation={list(self.orientation)}, frame={self.frame!r})"

    def __matmul__(self, inner: Pose) -> Pose:
        """Convert `inner`, a pose relative to this one, to the frame named by `self.frame`; its time is now."""
        moved = rotated(self.orientation, inner.position)
        x, y, z = self.position
        return Pose((x + moved.x, y + moved.y, z + moved.z), product(self.orientation, inner.orientation), self.frame)

    def inverse(self) -> Pose:
        """Return the pose P for which `self @ P` is, up to rounding, the origin with the identity rotation."""
        x, y, z, w = self.orientation
        back = Quaternion(-x, -y, -z, w)
        moved = rotated(back, self.position)
        return Pose((-moved.x, -moved.y, -moved.z), back, self.frame)

    def relative_to(self, other: Pose) -> Pose:
        """Return this pose relative to `other`. Does not check that both are in the same frame."""
        return other.inverse() @ self

    def distance(self, other: Pose) -> float:
        """Return the distance between the two positions, m."""
        return math.dist(self.position, other.position)

    @property
    def yaw(self) -> float:
        """Heading in the xy plane, rad from +x, in [-π, π]."""
        x, y, z, w = self.orientation
        return math.atan2(2 * (w * z + x * y), 1 - 2 * (y * y + z * z))


def _nanoseconds(time: object) -> int:
    """Return the time as an int, checked to fit the 64 bits in which a memory stores it."""
    try:
        whole = operator.index(time)  # type: ignore[arg-type]  # raises TypeError unless it is an integer
    except TypeError:
        whole = None
    if whole is None or not -_NS_END <= whole < _NS_END:
        raise MalformedPose(f"a pose's time must be a whole number of ns since 1970 of at most 64 bits, got {time!r}")
    return whole


_NS_END = 2**63
