"""A kinematic world in Bullet or MuJoCo, its objects, and descriptions of robots. It does not depend on the memory.

Importing it imports neither an engine nor numpy: the classes are loaded on first access, the engine when the first
world is entered.

>>> with BulletWorld() as world:
...     robot = Object("pr2", ObjectType.ROBOT)
...     kitchen = Object("kitchen", ObjectType.ENVIRONMENT)
...     cereal = Object("cereal", ObjectType.BREAKFAST_CEREAL, pose=Pose([1.3, 0.7, 0.95]))
"""

from __future__ import annotations

from importlib import import_module
from typing import TYPE_CHECKING, Any

if TYPE_CHECKING:
    from pycrorm_async.world.body import ObjectState, WorldState
    from pycrorm_async.world.bounding_boxes import BoundingBox
    from pycrorm_async.world.bullet import BulletWorld, Object, WorldObserver, WorldWatcher, current_world, watcher
    from pycrorm_async.world.pose import (
        Arms,
        Grasp,
        GripperState,
        JointType,
        ObjectType,
        Pose,
        Quaternion,
        Vector,
        WorldMode,
    )
    from pycrorm_async.world.queries import (
        Costmap,
        GaussianCostmap,
        OccupancyCostmap,
        SemanticCostmap,
        VisibilityCostmap,
    )
    from pycrorm_async.world.urdf import (
        COURIER,
        PR2,
        ArmDescription,
        Bounds,
        Drive,
        FieldOfView,
        Limits,
        RobotDescription,
        describe_arm,
        describe_robot,
        register_robot,
        robot_description,
    )
    from pycrorm_async.world.world_copy import acting_robot, copied, robot_acting

__all__ = [
    "BulletWorld",
    "copied",
    "Object",
    "Pose",
    "Vector",
    "Quaternion",
    "ObjectType",
    "Arms",
    "Grasp",
    "GripperState",
    "JointType",
    "WorldMode",
    "WorldState",
    "ObjectState",
    "BoundingBox",
    "Limits",
    "RobotDescription",
    "ArmDescription",
    "Bounds",
    "Drive",
    "FieldOfView",
    "PR2",
    "COURIER",
    "register_robot",
    "robot_description",
    "describe_arm",
    "describe_robot",
    "robot_acting",
    "acting_robot",
    "Costmap",
    "OccupancyCostmap",
    "GaussianCostmap",
    "VisibilityCostmap",
    "SemanticCostmap",
    "WorldObserver",
    "WorldWatcher",
    "current_world",
    "watcher",
]

_MODULES = ("pose", "urdf", "bounding_boxes", "engines", "body", "bullet", "world_copy", "queries")
"""The modules that define these names; each imports some of those before it, and none after it."""


def __getattr__(name: str) -> Any:
    if name not in __all__:
        raise AttributeError(f"module {__name__!r} has no attribute {name!r}")
    modules = (vars(import_module(f"{__name__}.{each}")) for each in _MODULES)
    return next(names[name] for names in modules if name in names)


def __dir__() -> list[str]:
    return sorted(__all__)
