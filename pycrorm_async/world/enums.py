"""Enumerations of the world and of plans. Members are recorded by name; their values are those of PyCRAM."""

from __future__ import annotations

from enum import Enum, IntEnum

__all__ = ["Arms", "Grasp", "GripperState", "ObjectType", "JointType", "WorldMode"]


class Arms(IntEnum):
    """An arm of the robot; BOTH for actions that move both."""

    LEFT = 1
    RIGHT = 2
    BOTH = 3


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
    """Whether Bullet opens a window: GUI does, DIRECT does not."""

    GUI = "GUI"
    DIRECT = "DIRECT"
