"""What a call on the world can be refused for. All are `CallerError`: the message says what to change."""

from __future__ import annotations

from pycrorm_async.errors import CallerError
from pycrorm_async.world.pose import COORDINATE_MAX, Pose

__all__ = [
    "WorldError",
    "WorldUnavailable",
    "WorldClosed",
    "NoWorld",
    "ObjectRefused",
    "ObjectNotInWorld",
    "DuplicateName",
    "DescriptionNotLoadable",
    "UnknownJoint",
    "UnknownLink",
    "JointLimitExceeded",
    "PoseRefused",
    "AttachmentRefused",
    "CostmapMismatch",
]


class WorldError(CallerError):
    """The root of what the world refuses."""


class WorldUnavailable(WorldError):
    """Bullet gives no world: no display for a window, or too many worlds at once."""


class WorldClosed(WorldError):
    """The world was not entered yet, or was left; names, types, last poses and joints can still be read."""


class NoWorld(WorldError):
    """No world is entered in this context, and none was given."""

    def __init__(self, wanted_for: str) -> None:
        super().__init__(f"no world for {wanted_for}: act inside `with BulletWorld() as world:`")


class ObjectRefused(WorldError):
    """An object was to be made with a name that is no str, or a type that is no `ObjectType`."""


class ObjectNotInWorld(WorldError):
    """No object of that name is in the world, or it was removed."""

    def __init__(self, name: str, present: tuple[str, ...]) -> None:
        super().__init__(f"{name!r} is not in the world; there are: {', '.join(present) or 'no objects'}")
        self.name = name
        self.present = present


class DuplicateName(WorldError):
    """An object of that name is in the world already."""

    def __init__(self, name: str) -> None:
        super().__init__(f"an object named {name!r} is in the world already; choose another name or remove it")
        self.name = name


class DescriptionNotLoadable(WorldError):
    """No body can be made from a description; `reason` is what is wrong with it."""

    def __init__(self, name: str, reason: str) -> None:
        super().__init__(f"the description of {name!r} cannot be loaded: {reason}")
        self.name = name
        self.reason = reason


class UnknownJoint(WorldError):
    """The object has no movable joint of that name."""

    def __init__(self, object_name: str, joint: str, present: tuple[str, ...]) -> None:
        super().__init__(f"{object_name!r} has no movable joint {joint!r}; it has: {', '.join(present) or 'none'}")
        self.object_name = object_name
        self.joint = joint


class UnknownLink(WorldError):
    """The object has no link of that name."""

    def __init__(self, object_name: str, link: str, present: tuple[str, ...]) -> None:
        super().__init__(f"{object_name!r} has no link {link!r}; it has: {', '.join(present)}")
        self.object_name = object_name
        self.link = link


class JointLimitExceeded(WorldError):
    """A joint position is outside the joint's hard limits (rad or m), or not finite; nothing was moved."""

    def __init__(self, object_name: str, joint: str, value: float, limits: tuple[float, float]) -> None:
        lower, upper = max(limits[0], -COORDINATE_MAX), min(limits[1], COORDINATE_MAX)
        super().__init__(f"{object_name!r}: {joint} cannot be {value:g}; its limits are {lower:g} to {upper:g}")
        self.object_name = object_name
        self.joint = joint
        self.value = value
        self.limits = limits


class PoseRefused(WorldError):
    """An object cannot be put at a pose in another frame than "map", or with a number that is not finite."""

    def __init__(self, object_name: str, pose: Pose, reason: str) -> None:
        super().__init__(f"{object_name!r} cannot be put at {pose!r}: {reason}")
        self.object_name = object_name
        self.pose = pose
        self.reason = reason


class AttachmentRefused(WorldError):
    """Two objects cannot be attached or detached in this way."""


class CostmapMismatch(WorldError):
    """Two costmaps of different place, size or resolution cannot be combined."""
