"""A kinematic world in Bullet or MuJoCo, its objects, and descriptions of robots. It does not depend on the memory.

Importing it imports neither an engine nor numpy: the classes are loaded on first access, the engine when the first
world is entered.

>>> with BulletWorld() as world:
...     robot = Object("pr2", ObjectType.ROBOT)
...     kitchen = Object("kitchen", ObjectType.ENVIRONMENT)
...     cereal = Object("cereal", ObjectType.BREAKFAST_CEREAL, pose=Pose([1.3, 0.7, 0.95]))
"""

from typing import TYPE_CHECKING

from pycrorm_async.lazy_names import lazy_names

if TYPE_CHECKING:
    from pycrorm_async.world.body import *  # noqa: F403
    from pycrorm_async.world.bounding_boxes import *  # noqa: F403
    from pycrorm_async.world.bullet import *  # noqa: F403
    from pycrorm_async.world.pose import *  # noqa: F403
    from pycrorm_async.world.queries import *  # noqa: F403
    from pycrorm_async.world.urdf import *  # noqa: F403
    from pycrorm_async.world.world_copy import *  # noqa: F403

_NAMES = {
    "pose": "Arms Grasp GripperState JointType ObjectType Pose Quaternion Vector WorldMode",
    "urdf": (
        "COURIER PR2 ArmDescription Bounds Drive FieldOfView Limits RobotDescription describe_arm describe_robot"
        " register_robot robot_description"
    ),
    "bounding_boxes": "BoundingBox",
    "body": "ObjectState WorldState",
    "bullet": "BulletWorld Object WorldObserver WorldWatcher current_world watcher",
    "world_copy": "acting_robot copied robot_acting",
    "queries": "Costmap GaussianCostmap OccupancyCostmap SemanticCostmap VisibilityCostmap",
}

__all__ = [each for names in _NAMES.values() for each in names.split()]
if not TYPE_CHECKING:  # which would take any other name for one of this package
    __getattr__ = lazy_names(__name__, _NAMES)


def __dir__() -> list[str]:
    return sorted(__all__)
