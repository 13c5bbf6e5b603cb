"""The closed vocabularies of the world and of plans; members are recorded by name (values as in reference systems)."""

from __future__ import annotations

from enum import Enum, IntEnum

__all__ = ["Arms", "Grasp", "GripperState", "ObjectType", "JointType", "WorldMode"]


class Arms(IntEnum):
    """Which arm; BOTH for actions that move both."""

    LEFT = 1
    RIGHT = 2
    BOTH = 3


class Grasp(IntEnum):
    """From which side of the object the gripper comes."""

    FRONT = 0
    LEFT = 1
    RIGHT = 2
    TOP = 3


class GripperState(IntEnum):
    """What a gripper is told to do."""

    OPEN = 1
    CLOSE = 2


class ObjectType(IntEnum):
    """What kind of thing an object is."""

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
    """How a joint moves."""

    REVOLUTE = 0
    PRISMATIC = 1
    SPHERICAL = 2
    PLANAR = 3
    FIXED = 4
    UNKNOWN = 5
    CONTINUOUS = 6
    FLOATING = 7


class WorldMode(Enum):
    """With a window, or without."""

    GUI = "GUI"
    DIRECT = "DIRECT"
