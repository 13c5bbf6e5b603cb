"""The world a plan acts in: one Bullet client of its own, the objects in it, and who is told of what happens there.

Motions are kinematic: things are put where they are to be, nothing is stepped and nothing falls. Any number of worlds
can be open at once, in tasks and threads; one world belongs to one thread at a time.
"""

from __future__ import annotations

import os
from collections.abc import Iterable, Mapping, Sequence
from types import TracebackType
from typing import Self

from pycrorm_async.world import state
from pycrorm_async.world.attachments import Attachments
from pycrorm_async.world.bullet_loader import engine
from pycrorm_async.world.enums import ObjectType, WorldMode
from pycrorm_async.world.errors import ObjectNotInWorld, WorldClosed, WorldUnavailable
from pycrorm_async.world.objects import Object
from pycrorm_async.world.observers import WorldObserver, WorldWatcher, current_world, watcher
from pycrorm_async.world.queries import visibility
from pycrorm_async.world.state import WorldState

__all__ = ["BulletWorld"]

_GRAVITY_M_PER_S2 = -9.8


class BulletWorld:
    """A world, to be entered once with `with`; inside, it is `current_world` of this context.

    >>> with BulletWorld() as world:
    ...     Object("bowl", ObjectType.BOWL)
    ...     world.objects
    (Object('bowl', BOWL, Pose(position=[0.0, 0.0, 0.0], orientation=[0.0, 0.0, 0.0, 1.0], frame='map')),)

    Entering takes some 50 ms, raises `WorldUnavailable`, and whatever this context's watcher refuses it with.
    Afterwards everything that would change the world raises `WorldClosed`; what was last known can still be read.

    Args:
        mode: with a window, or without.
        copy_of: for `copying.copied` only: the world that this one is filled from. No watcher is told of a copy.
    """

    def __init__(self, mode: WorldMode = WorldMode.DIRECT, *, copy_of: BulletWorld | None = None) -> None:
        self.mode = mode
        self.copy_of = copy_of
        self.attachments = Attachments()
        self._objects: dict[int, Object] = {}
        self._robot: Object | None = None
        self._observers: tuple[WorldObserver, ...] = ()
        self._client: int | None = None
        self._left = False
        self._outer: BulletWorld | None = None
        self._watcher: WorldWatcher | None = None

    def __repr__(self) -> str:
        return f"<{self.description}>"

    # --- entering and leaving ---------------------------------------------------------------------------------

    def __enter__(self) -> Self:
        self._begin()
        self._outer = current_world.here()
        current_world.set(self)
        self._tell_entered()
        return self

    def connect(self) -> Self:
        """Enter it for all contexts of this process that are in no world of their own, until `close`.

        For notebooks, whose cells have a context each. If several are connected, plans act in the last one.
        """
        self._begin()
        current_world.connect(self)
        self._tell_entered()
        return self

    def close(self) -> None:
        """Leave it; twice is once."""
        if self.entered:
            self.__exit__(None, None, None)

    def _begin(self) -> None:
        if self._client is not None or self._left:
            raise WorldClosed("a world is entered once; make a new BulletWorld()")
        self._client = _connected(self.mode)

    def _tell_entered(self) -> None:
        self._watcher = watcher.get() if self.copy_of is None else None
        if self._watcher is not None:
            try:
                self._watcher.world_entered(self)
            except BaseException:
                self._close()
                raise

    def __exit__(
        self,
        kind: type[BaseException] | None,
        error: BaseException | None,
        traceback: TracebackType | None,
    ) -> None:
        try:
            if self._watcher is not None:
                self._watcher.world_left(self)
        finally:
            self._close()

    def _close(self) -> None:
        current_world.disconnect(self)
        if current_world.here() is self:  # it is not when the context manager is closed in another context
            current_world.set(self._outer)
        client, self._client, self._left = self.client, None, True
        engine().disconnect(physicsClientId=client)

    @property
    def entered(self) -> bool:
        """Whether it can be acted on now."""
        return self._client is not None

    @property
    def client(self) -> int:
        """Bullet's number of this world; raises `WorldClosed`."""
        if self._client is None:
            raise WorldClosed(
                "the world was left; only what was last known of it can be read"
                if self._left
                else "the world is not entered; act inside `with BulletWorld() as world:`"
            )
        return self._client

    @property
    def description(self) -> str:
        """The world in a line."""
        things = ", ".join(f"{thing.name} ({thing.object_type.name})" for thing in self.objects)
        return f"BulletWorld ({self.mode.value}): {things or 'empty'}"

    # --- what is in it ----------------------------------------------------------------------------------------

    @property
    def objects(self) -> tuple[Object, ...]:
        """In the order they were added."""
        return tuple(self._objects.values())

    @property
    def robot(self) -> Object | None:
        """The first object of type ROBOT."""
        return self._robot

    def object(self, name: str) -> Object:
        """The object of that name; raises `ObjectNotInWorld`."""
        for thing in self._objects.values():
            if thing.name == name:
                return thing
        raise ObjectNotInWorld(name, tuple(thing.name for thing in self.objects))

    def has(self, thing: Object) -> bool:
        """Whether this very object is in it."""
        return self._objects.get(thing.body.number) is thing

    def add(self, thing: Object) -> None:
        """Called by `Object` when its body is there; tells the observers."""
        self._objects[thing.body.number] = thing
        if self._robot is None and thing.object_type is ObjectType.ROBOT:
            self._robot = thing
        for observer in self._observers:
            observer.object_added(thing)

    def remove(self, thing: Object) -> None:
        """Take an object out, detached first; its last pose and joints can still be read."""
        thing.check_present()
        thing.detach_all()
        thing.body.unload()
        del self._objects[thing.body.number]
        if thing is self._robot:
            robots = (other for other in self._objects.values() if other.object_type is ObjectType.ROBOT)
            self._robot = next(robots, None)
        for observer in self._observers:
            observer.object_removed(thing)

    # --- going back -------------------------------------------------------------------------------------------

    def reset(self) -> None:
        """Every object detached, joints 0, at its original pose; only what is not so is touched and told."""
        _ = self.client
        for each in self.attachments:
            each.parent.detach(each.child)
        for thing in self.objects:
            thing.reset()

    def save_state(self) -> WorldState:
        """Poses, joint positions and attachments of all objects, as a frozen value."""
        return state.saved(self)

    def restore_state(self, saved: WorldState) -> None:
        """Make the objects of `saved` as they were then; tells what differed, and nothing else.

        An object that was added since stays where it is, detached from the others. Raises `ObjectNotInWorld` if one
        of the state's objects is gone, `UnknownJoint` if another one has its name now, `PoseRefused` or
        `JointLimitExceeded` if it was made by hand with a number that is not finite; then nothing was touched.
        """
        _ = self.client
        state.restore(self, saved)

    # --- looking ----------------------------------------------------------------------------------------------

    def ray_test(
        self,
        starts: Sequence[Sequence[float]],
        ends: Sequence[Sequence[float]],
        *,
        ignore: Iterable[Object] = (),
    ) -> list[Object | None]:
        """For every ray the first object it meets; None where it meets none, or the floor.

        Objects in `ignore` are looked through. A ray does not meet the shape it starts in. Points in "map", metres.
        """
        return visibility.first_met(self, starts, ends, ignore=frozenset(ignore))

    def visible(self, thing: Object, eye: Sequence[float], *, ignore: Iterable[Object] = ()) -> float:
        """The share of `thing` that is seen from the point `eye`, 0 to 1; nothing of it is beyond a field of view.

        Rays go to points spread through its shapes; those that meet another object or the floor first are hidden.
        """
        return visibility.visible_share(self, thing, eye, ignore=frozenset(ignore))

    # --- who is told ------------------------------------------------------------------------------------------

    @property
    def observers(self) -> tuple[WorldObserver, ...]:
        """In the order they came."""
        return self._observers

    def observe(self, observer: WorldObserver) -> None:
        """From now on it is told of every change. One that observes already is not told twice."""
        if observer not in self._observers:
            self._observers = (*self._observers, observer)

    def unobserve(self, observer: WorldObserver) -> None:
        """It is no longer told."""
        self._observers = tuple(other for other in self._observers if other is not observer)

    def tell_moved(self, things: Iterable[Object]) -> None:
        """Called when a motion is complete: these objects have new poses."""
        if self._observers:
            for thing in things:
                for observer in self._observers:
                    observer.object_moved(thing)

    def tell_turned(self, thing: Object, positions: Mapping[str, float]) -> None:
        """Called when a motion is complete: these joints have new positions."""
        for observer in self._observers:
            observer.joints_moved(thing, positions)


def _connected(mode: WorldMode) -> int:
    """A new Bullet client with a floor."""
    bullet = engine()
    if mode is WorldMode.GUI and not os.environ.get("DISPLAY"):  # Bullet would end the process
        raise WorldUnavailable("a window needs a display (DISPLAY is not set); use WorldMode.DIRECT")
    try:
        client: int = bullet.connect(bullet.GUI if mode is WorldMode.GUI else bullet.DIRECT)
    except bullet.error as reason:
        raise WorldUnavailable(f"Bullet opens no further world: {reason}") from reason
    if client < 0:
        raise WorldUnavailable("Bullet opens no further world; leave those that are not needed")
    # remembering files by name would give a changed description's old text, and keep every one in memory
    bullet.setPhysicsEngineParameter(enableFileCaching=0, physicsClientId=client)
    bullet.setGravity(0, 0, _GRAVITY_M_PER_S2, physicsClientId=client)
    floor = bullet.createCollisionShape(bullet.GEOM_PLANE, physicsClientId=client)
    bullet.createMultiBody(0, floor, physicsClientId=client)
    return client
