"""Enumerations of the world and of plans. Members are recorded by name; their values are those of PyCRAM."""

from __future__ import annotations

from enum import Enum, IntEnum
from typing import Any, cast


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
    """The mode of Bullet: GUI opens a window, DIRECT does not."""

    GUI = "GUI"
    DIRECT = "DIRECT"
