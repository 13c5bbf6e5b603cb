"""Errors of calls on the world. All are `CallerError`: each message names what to change."""

from __future__ import annotations

import sys

from pycrorm_async.errors import CallerError, MissingExtra
from pycrorm_async.world.pose import COORDINATE_MAX, Pose


class WorldError(CallerError):
    """Root of the errors of this package."""


class WorldUnavailable(WorldError):
    """Bullet cannot open a world: a window without a display, or too many worlds at once."""


class BulletMissing(WorldUnavailable, MissingExtra):
    """No Bullet is installed; the message names the command that installs it on this Python."""

    def __init__(self) -> None:
        message = "no world can be opened, because no Bullet is installed: pip install 'pycrorm-async[world]'"
        if sys.version_info >= (3, 13):
            message += " pybullet (no wheel for this Python: compiles for about 8 minutes with a C++ compiler)"
        super().__init__(message)


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
    """Bullet cannot load a description; `reason` names the fault."""

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
    """A joint position is outside the joint's hard limits (rad or m), or not finite; no joint was moved."""

    def __init__(self, object_name: str, joint: str, value: float, limits: tuple[float, float]) -> None:
        lower, upper = max(limits[0], -COORDINATE_MAX), min(limits[1], COORDINATE_MAX)
        super().__init__(f"{object_name!r}: {joint} cannot be set to {value:g}; its limits are {lower:g} to {upper:g}")
        self.object_name = object_name
        self.joint = joint
        self.value = value
        self.limits = limits


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
