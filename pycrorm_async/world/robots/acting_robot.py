"""Set the robot that acts in a context: `with robot_acting(robot):`. Without it the world's first robot acts.

Choices nest, end with their block, and are inherited by tasks that start inside, so that each of several tasks can
move a robot of its own.

>>> async def tidy(robot: Object, place: Pose) -> None:
...     with robot_acting(robot):
...         await NavigateAction([place]).resolve().perform()
>>> with BulletWorld(), simulated_robot:
...     ada, bob = (Object(name, ObjectType.ROBOT, robot=PR2) for name in ("ada", "bob"))
...     await asyncio.gather(tidy(ada, Pose([1, 0, 0])), tidy(bob, Pose([-1, 0, 0])))
"""

from __future__ import annotations

from contextlib import AbstractContextManager
from contextvars import ContextVar
from typing import TYPE_CHECKING

from pycrorm_async.connected_var import set_inside
from pycrorm_async.errors import CallerError
from pycrorm_async.world.enums import ObjectType
from pycrorm_async.world.world_copy import counterpart

if TYPE_CHECKING:
    from pycrorm_async.world.bullet import BulletWorld
    from pycrorm_async.world.objects import Object

_chosen: ContextVar[Object | None] = ContextVar("_chosen", default=None)


def robot_acting(robot: Object) -> AbstractContextManager[None]:
    """Let this robot act inside the `with` block; in a copy of its world, its copy acts.

    Raises `CallerError` if the object is not of type ROBOT.
    """
    if getattr(robot, "object_type", None) is not ObjectType.ROBOT:
        raise CallerError(f"only an Object of type ROBOT can act, got {robot!r:.200}")
    return set_inside(_chosen, robot)


def acting_robot(world: BulletWorld) -> Object | None:
    """Return the robot that acts in this context: the chosen one, else the world's first robot.

    None if the world has no robot, or does not have the chosen one.
    """
    chosen = _chosen.get()
    return world.robot if chosen is None else counterpart(chosen, world)
