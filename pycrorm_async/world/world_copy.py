"""Copy a world, so that a plan can act in the copy without changing the original.

>>> with BulletWorld() as world:
...     milk = Object("milk", ObjectType.MILK)
...     with copied(world) as copy:
...         counterpart(milk, copy).set_pose(Pose([1, 2, 3]))
...     milk.pose.position
Vector(x=0.0, y=0.0, z=0.0)

**Acting robot.** Set the robot that acts in a context: `with robot_acting(robot):`. Without it the world's first robot
acts.

Choices nest, end with their block, and are inherited by tasks that start inside, so that each of several tasks can
move a robot of its own.

>>> async def tidy(robot: Object, place: Pose) -> None:
...     with robot_acting(robot):
...         await NavigateAction([place]).resolve().perform()
>>> with BulletWorld(), simulated_robot:
...     ada, bob = (Object(name, ObjectType.ROBOT, robot=PR2) for name in ("ada", "bob"))
...     await asyncio.gather(tidy(ada, Pose([1, 0, 0])), tidy(bob, Pose([-1, 0, 0])))
"""

from collections.abc import Iterator
from contextlib import AbstractContextManager, contextmanager
from contextvars import ContextVar

from pycrorm_async.connected_var import set_inside
from pycrorm_async.errors import CallerError
from pycrorm_async.world.bullet import AttachedChild, BulletWorld, Object
from pycrorm_async.world.pose import ObjectType, WorldMode


@contextmanager
def copied(world: BulletWorld) -> Iterator[BulletWorld]:
    """Copy the world as it is now, without a window, and enter the copy; it closes with the context.

    Inside the context the copy is `current_world`. Each object is copied exactly, with name, type, description, colour,
    poses, joints and attachments. Copying calls neither the watcher nor the observers of either world; the copy starts
    without observers. A copy can be copied. Copying the PR2 in its kitchen takes about 25 ms.

    Raises:
        WorldClosed: the world is closed. WorldUnavailable: the engine cannot open another world.
    """
    engine = type(world.engine)
    with BulletWorld(WorldMode.DIRECT, engine=engine, copy_of=world) as copy:
        copies = {obj: _copy_object(obj, copy) for obj in world.objects}
        for each in world.attachments:
            copy.attachments.keep(AttachedChild(copies[each.parent], copies[each.child], each.link, each.relative))
        yield copy


def counterpart(obj: Object, world: BulletWorld) -> Object | None:
    """Return the object that corresponds to `obj` in `world`: itself, a copy of it, or the object it is a copy of.

    Copies of copies count too. None if that object was removed, if `obj` was added after the copy was made, or if the
    worlds are not related.
    """
    if obj.world is world:
        return obj if world.has(obj) else None
    first = _first(obj)
    return next((each for each in world.objects if _first(each) is first), None)


def related(one: BulletWorld, other: BulletWorld) -> bool:
    """Return whether both are the same world, or copies of the same one."""
    return original(one) is original(other)


def original(world: BulletWorld) -> BulletWorld:
    """Return the world at the root of a chain of copies; a world that is not a copy is its own root."""
    while world.copy_of is not None:
        world = world.copy_of
    return world


def _copy_object(obj: Object, copy: BulletWorld) -> Object:
    object_copy = Object(
        obj.name,
        obj.object_type,
        obj.description_text,
        obj.original_pose,
        world=copy,
        color=obj.color,
        mass_kg=obj.mass_kg,
        base_link=obj.base_link,
    )
    object_copy.copy_of = obj
    object_copy.robot_description = obj.robot_description
    object_copy.chains = obj.chains
    object_copy.body.turn(obj.joint_positions())
    object_copy.body.place(obj.pose)
    return object_copy


def _first(obj: Object) -> Object:
    while obj.copy_of is not None:
        obj = obj.copy_of
    return obj


# === acting robot =============================================================================================

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
