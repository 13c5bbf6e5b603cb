"""Define poses, the enumerations of the world, and its errors.

**Pose.** A pose is a frozen value: a position in metres and a unit quaternion xyzw, the frame of both, and a time.

>>> Pose([1.3, 0.7, 0.95]).position.z
0.95
>>> Pose([1, 0, 0]) @ Pose([0, 1, 0])
Pose(position=[1.0, 1.0, 0.0], orientation=[0.0, 0.0, 0.0, 1.0], frame='map')
"""

from __future__ import annotations

import math
import operator
import sys
from collections.abc import Sequence
from dataclasses import dataclass, field
from enum import Enum, IntEnum
from typing import Any, ClassVar, NamedTuple, cast

from pycrorm_async.clock import SYSTEM_CLOCK
from pycrorm_async.errors import CallerError, MissingExtra


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
    __recorded_as__: ClassVar[str] = "pose"

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


# === enums ====================================================================================================
#
# Enumerations of the world and of plans. Members are recorded by name; their values are those of PyCRAM.


class Arms(IntEnum):
    """An arm of the robot; BOTH for actions that move the left and the right one.

    A robot's description lists which of these it has; the only arm of a robot may be LEFT or RIGHT. Further arms have a
    name of their own (`named`), with which they are recorded.
    """

    LEFT = 1
    RIGHT = 2
    BOTH = 3

    @classmethod
    def named(cls, name: str) -> Arms:
        """Return the arm of that name, the same object at each call. The class need not have a member of that name.

        >>> Arms.named("CENTRE").name, Arms.named("LEFT") is Arms.LEFT
        ('CENTRE', True)

        Raises `ValueError` for a text that is not an identifier.
        """
        if name in cls.__members__:
            return cls.__members__[name]
        if not name.isidentifier():
            raise ValueError(f"the name of an arm must be an identifier, got {name!r:.100}")
        number = int.from_bytes(name.encode(), "big")  # the same in every process, and of no other name
        arm = int.__new__(cls, number)
        arm._name_, arm._value_ = name, number
        # `setdefault` on the enum's own table keeps one object for each name, whichever thread makes it first.
        members: Any = cls._value2member_map_
        return cast("Arms", members.setdefault(number, arm))

    def __reduce_ex__(self, protocol: Any) -> tuple[Any, ...]:
        return Arms.named, (self._name_,)


class Grasp(IntEnum):
    """The side of the object from which the gripper approaches."""

    FRONT = 0
    LEFT = 1
    RIGHT = 2
    TOP = 3


class GripperState(IntEnum):
    """The goal of a gripper motion."""

    OPEN = 1
    CLOSE = 2


class ObjectType(IntEnum):
    """The kind of an object."""

    METALMUG = 1
    PRINGLES = 2
    MILK = 3
    SPOON = 4
    BOWL = 5
    BREAKFAST_CEREAL = 6
    JEROEN_CUP = 7
    ROBOT = 8
    ENVIRONMENT = 9
    GENERIC_OBJECT = 10
    HUMAN = 11


class JointType(IntEnum):
    """The kind of a joint's motion."""

    REVOLUTE = 0
    PRISMATIC = 1
    SPHERICAL = 2
    PLANAR = 3
    FIXED = 4
    UNKNOWN = 5
    CONTINUOUS = 6
    FLOATING = 7


class WorldMode(Enum):
    """The mode of the engine: GUI opens a window, DIRECT does not."""

    GUI = "GUI"
    DIRECT = "DIRECT"


# === errors ===================================================================================================
#
# Errors of calls on the world. All are `CallerError`: each message names what to change.


class WorldError(CallerError):
    """Root of the errors of this package."""


class WorldUnavailable(WorldError):
    """The engine cannot open a world: a window without a display, or too many worlds at once."""


class EngineMissing(WorldUnavailable, MissingExtra):
    """The engine of that name is not installed, or without a name none is; the message has the command to install."""

    def __init__(self, name: str = "") -> None:
        missing = _ENGINE_TITLES.get(name, "engine")
        extra = "mujoco" if name == "mujoco" else "world"
        message = f"no world can be opened, because no {missing} is installed: pip install 'pycrorm-async[{extra}]'"
        if name == "bullet" and sys.version_info >= (3, 14):
            message += " pybullet (no wheel for this Python: compiles for about 8 minutes with a C++ compiler)"
        super().__init__(message)


_ENGINE_TITLES = {"bullet": "Bullet", "mujoco": "MuJoCo"}


class BulletMissing(EngineMissing):
    """Bullet is not installed, and a world in Bullet was asked for."""

    def __init__(self) -> None:
        super().__init__("bullet")


class WorldClosed(WorldError):
    """The world is not entered yet or is closed; names, types, last poses and joints can still be read."""


class NoWorld(WorldError):
    """No world is entered in this context, and the call has no world argument."""

    def __init__(self, wanted_for: str) -> None:
        super().__init__(f"no world is entered for {wanted_for}: call it inside `with BulletWorld() as world:`")


class ObjectRefused(WorldError):
    """An object cannot have this name, type, mass or base link."""


class ObjectNotInWorld(WorldError):
    """No object of that name is in the world, or it was removed."""

    def __init__(self, name: str, present: tuple[str, ...]) -> None:
        super().__init__(f"{name!r} is not in the world; its objects are: {', '.join(present) or 'none'}")
        self.name = name
        self.present = present


class DuplicateName(WorldError):
    """The world already contains an object of that name."""

    def __init__(self, name: str) -> None:
        super().__init__(f"the world already contains an object named {name!r}; choose another name or remove it")
        self.name = name


class DescriptionNotLoadable(WorldError):
    """The engine cannot load a description; `reason` names the fault."""

    def __init__(self, name: str, reason: str) -> None:
        super().__init__(f"the description of {name!r} cannot be loaded: {reason}")
        self.name = name
        self.reason = reason


class UnknownJoint(WorldError):
    """The object has no movable joint of that name."""

    def __init__(self, object_name: str, joint: str, present: tuple[str, ...]) -> None:
        joints = ", ".join(present) or "none"
        super().__init__(f"{object_name!r} has no movable joint {joint!r}; its joints are: {joints}")
        self.object_name = object_name
        self.joint = joint


class UnknownLink(WorldError):
    """The object has no link of that name."""

    def __init__(self, object_name: str, link: str, present: tuple[str, ...]) -> None:
        super().__init__(f"{object_name!r} has no link {link!r}; its links are: {', '.join(present)}")
        self.object_name = object_name
        self.link = link


class JointLimitExceeded(WorldError):
    """A joint position is outside the joint's hard limits (rad or m), or no finite number; no joint was moved."""

    def __init__(self, object_name: str, joint: str, value: object, limits: tuple[float, float]) -> None:
        lower, upper = max(limits[0], -COORDINATE_MAX), min(limits[1], COORDINATE_MAX)
        shown = f"{value:g}" if isinstance(value, float) else f"{value!r:.100}"
        super().__init__(f"{object_name!r}: {joint} cannot be set to {shown}; its limits are {lower:g} to {upper:g}")
        self.object_name = object_name
        self.joint = joint
        self.value = value
        self.limits = limits


class JointFollows(WorldError):
    """A joint follows another (<mimic>) and cannot be set to another position; no joint was moved."""

    def __init__(self, object_name: str, joint: str, leader: str) -> None:
        super().__init__(f"{object_name!r}: {joint} follows {leader}: set that joint instead")
        self.object_name = object_name
        self.joint = joint
        self.leader = leader


class PoseRefused(WorldError):
    """An object's new pose is not a `Pose`, is not in the frame "map", or has a number that is NaN or too large."""

    def __init__(self, object_name: str, pose: Pose, reason: str) -> None:
        super().__init__(f"{object_name!r} cannot be moved to {pose!r}: {reason}")
        self.object_name = object_name
        self.pose = pose
        self.reason = reason


class AttachmentRefused(WorldError):
    """Two objects cannot be attached to or detached from each other."""


class CostmapMismatch(WorldError):
    """Two costmaps of different origin, size or resolution cannot be multiplied."""
