"""A world owns one Bullet client and its objects, and notifies its observers of every change.

Motions are kinematic: setters place objects and joints, the simulation is never stepped, and objects do not fall. Any
number of worlds can be open at once, in tasks and threads; one world belongs to one thread at a time.
"""

from __future__ import annotations

import os
from collections.abc import Callable, Iterable, Mapping, Sequence
from types import MappingProxyType, TracebackType
from typing import Self

from pycrorm_async.world.attachments import Attachments
from pycrorm_async.world.bullet_loader import engine
from pycrorm_async.world.enums import ObjectType, WorldMode
from pycrorm_async.world.errors import ObjectNotInWorld, WorldClosed, WorldUnavailable
from pycrorm_async.world.objects import Object
from pycrorm_async.world.observers import WorldObserver, WorldWatcher, current_world, watcher
from pycrorm_async.world.queries import visibility
from pycrorm_async.world.state import ObjectState, WorldState, check_state, set_state

_GRAVITY_M_PER_S2 = -9.8


class BulletWorld:
    """A world, entered once with `with`; inside that block it is `current_world` of the context.

    >>> with BulletWorld() as world:
    ...     Object("bowl", ObjectType.BOWL)
    ...     world.objects
    (Object('bowl', BOWL, Pose(position=[0.0, 0.0, 0.0], orientation=[0.0, 0.0, 0.0, 1.0], frame='map')),)

    Entering takes about 50 ms. It raises `WorldUnavailable`, and any exception of the context's watcher. After the
    block every change raises `WorldClosed`; the last poses and joint positions can still be read.

    Args:
        mode: whether Bullet opens a window.
        copy_of: the world this one is a copy of; only for `world_copy.copied`. A copy has no watcher.
        set_up: adds the first objects when the world has been entered; if it raises, the world is left again.
    """

    def __init__(
        self,
        mode: WorldMode = WorldMode.DIRECT,
        *,
        copy_of: BulletWorld | None = None,
        set_up: Callable[[BulletWorld], None] | None = None,
    ) -> None:
        self.mode = mode
        self.copy_of = copy_of
        self._set_up = set_up
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
        self._notify_entered()
        return self

    def connect(self) -> Self:
        """Enter the world until `close`, for every context of this process that has not entered a world of its own.

        This is for notebooks, where each cell has its own context. If several are connected, plans act in the last one.
        """
        self._begin()
        current_world.connect(self)
        self._notify_entered()
        return self

    def close(self) -> None:
        """Leave the world; a second call does nothing."""
        if self.entered:
            self.__exit__(None, None, None)

    def _begin(self) -> None:
        if self._client is not None or self._left:
            raise WorldClosed("a world can be entered only once; create a new BulletWorld()")
        self._client = _connect(self.mode)

    def _notify_entered(self) -> None:
        self._watcher = watcher.get() if self.copy_of is None else None
        if self._watcher is not None:
            try:
                self._watcher.world_entered(self)
            except BaseException:
                self._close()
                raise
        if self._set_up is not None:
            try:
                self._set_up(self)
            except BaseException:
                self.close()
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
        if current_world.here() is self:  # False if the context manager is closed in another context
            current_world.set(self._outer)
        client, self._client, self._left = self.client, None, True
        engine().disconnect(physicsClientId=client)

    @property
    def entered(self) -> bool:
        """True while the world is entered and not left."""
        return self._client is not None

    @property
    def client(self) -> int:
        """Bullet's number of this world. Raises `WorldClosed`."""
        if self._client is None:
            raise WorldClosed(
                "the world is closed; only its last poses and joint positions can be read"
                if self._left
                else "the world is not entered; act inside `with BulletWorld() as world:`"
            )
        return self._client

    @property
    def description(self) -> str:
        """The world's mode and objects in one line."""
        objects = ", ".join(f"{obj.name} ({obj.object_type.name})" for obj in self.objects)
        return f"BulletWorld ({self.mode.value}): {objects or 'empty'}"

    # --- objects ----------------------------------------------------------------------------------------------

    @property
    def objects(self) -> tuple[Object, ...]:
        """The objects in the order in which they were added."""
        return tuple(self._objects.values())

    @property
    def robot(self) -> Object | None:
        """The first object of type ROBOT; None without one."""
        return self._robot

    def object(self, name: str) -> Object:
        """Return the object of that name. Raises `ObjectNotInWorld`."""
        for obj in self._objects.values():
            if obj.name == name:
                return obj
        raise ObjectNotInWorld(name, tuple(obj.name for obj in self.objects))

    def has(self, obj: Object) -> bool:
        """Return whether the world contains this object; objects are compared by identity."""
        return self._objects.get(obj.body.number) is obj

    def add(self, obj: Object) -> None:
        """Add an object whose body is loaded, and notify the observers; only `Object` calls this."""
        self._objects[obj.body.number] = obj
        if self._robot is None and obj.object_type is ObjectType.ROBOT:
            self._robot = obj
        for observer in self._observers:
            observer.object_added(obj)

    def remove(self, obj: Object) -> None:
        """Detach an object and remove it; its last pose and joints can still be read."""
        obj.check_present()
        obj.detach_all()
        obj.body.unload()
        del self._objects[obj.body.number]
        if obj is self._robot:
            robots = (other for other in self._objects.values() if other.object_type is ObjectType.ROBOT)
            self._robot = next(robots, None)
        for observer in self._observers:
            observer.object_removed(obj)

    # --- resetting and restoring ------------------------------------------------------------------------------

    def reset(self) -> None:
        """Detach every object, set its joints to 0, and move it to its original pose.

        Objects that are in that state already are not moved, and observers get no call for them.
        """
        _ = self.client
        for each in self.attachments:
            each.parent.detach(each.child)
        for obj in self.objects:
            obj.reset()

    def save_state(self) -> WorldState:
        """Return poses, joint positions and attachments of all objects as a frozen value."""
        parents = {each.child: (each.parent.name, each.link) for each in self.attachments}
        states = {
            obj.name: ObjectState(obj.pose, MappingProxyType(obj.joint_positions()), parents.get(obj))
            for obj in self.objects
        }
        return WorldState(MappingProxyType(states))

    def restore_state(self, saved: WorldState) -> None:
        """Restore the objects of `saved`; observers get the differences only, after all poses and joints are set.

        An object that was added since keeps its pose and is detached from the restored ones. The following are raised
        before anything is changed: `ObjectNotInWorld` if an object of the state was removed, `UnknownJoint` if its
        name now belongs to an object without that joint, `PoseRefused` or `JointLimitExceeded` if a hand-made state
        has numbers that are not finite.
        """
        _ = self.client
        states = {self.object(name): state for name, state in saved.objects.items()}
        for obj, state in states.items():
            check_state(obj.name, obj.body, state)
        for each in self.attachments:
            if each.child in states or each.parent in states:
                attached_to = states[each.child].attached_to if each.child in states else None
                if attached_to != (each.parent.name, each.link):
                    each.parent.detach(each.child)
        changes = {obj: set_state(obj.body, state) for obj, state in states.items()}
        for obj, change in changes.items():
            if change.joints:
                self.notify_joints(obj, change.joints)
        self.notify_moved([obj for obj, change in changes.items() if change.moved])
        for child, state in states.items():
            if state.attached_to is not None:
                parent, link = self.object(state.attached_to[0]), state.attached_to[1]
                if child.attached_to is parent:
                    self.attachments.put(parent, child, link)
                else:
                    parent.attach(child, link)

    # --- visibility -------------------------------------------------------------------------------------------

    def ray_test(
        self,
        starts: Sequence[Sequence[float]],
        ends: Sequence[Sequence[float]],
        *,
        ignore: Iterable[Object] = (),
    ) -> list[Object | None]:
        """Return the first object on every ray; None for no object, or the floor.

        Objects in `ignore` are transparent. A ray does not hit the shape it starts in. Points are in "map", m.
        """
        transparent = [obj.body for obj in ignore if self.has(obj)]
        numbers = visibility.first_met(self.client, starts, ends, transparent=transparent)
        return [self._objects.get(number) for number in numbers]

    def met_towards(self, obj: Object, eye: Sequence[float], *, ignore: Iterable[Object] = ()) -> list[Object | None]:
        """Return the first object on each ray from the point `eye` into an object's shapes: itself or an occluder.

        None means the floor. The list is empty for an object without shapes.
        """
        obj.check_present()
        points = visibility.inner_points(obj.body)
        others = [each for each in ignore if each is not obj]
        return self.ray_test([eye] * len(points), points, ignore=others) if points else []

    def visible(self, obj: Object, eye: Sequence[float], *, ignore: Iterable[Object] = ()) -> float:
        """Return the share of an object that is visible from the point `eye`, 0 to 1; no field of view limits it.

        Rays go to points spread through its shapes; a point is hidden if its ray hits another object or the floor.
        """
        hits = self.met_towards(obj, eye, ignore=ignore)
        return sum(hit is obj for hit in hits) / len(hits) if hits else 0.0

    # --- observers --------------------------------------------------------------------------------------------

    @property
    def observers(self) -> tuple[WorldObserver, ...]:
        """The observers in the order in which they were added."""
        return self._observers

    def observe(self, observer: WorldObserver) -> None:
        """Add an observer; adding it a second time does nothing."""
        if observer not in self._observers:
            self._observers = (*self._observers, observer)

    def unobserve(self, observer: WorldObserver) -> None:
        """Remove an observer."""
        self._observers = tuple(other for other in self._observers if other is not observer)

    def notify_moved(self, objects: Iterable[Object]) -> None:
        """Notify the observers, after a motion is complete, that these objects have new poses."""
        if self._observers:
            for obj in objects:
                for observer in self._observers:
                    observer.object_moved(obj)

    def notify_joints(self, obj: Object, positions: Mapping[str, float]) -> None:
        """Notify the observers, after a motion is complete, that these joints have new positions."""
        for observer in self._observers:
            observer.joints_moved(obj, positions)


def _connect(mode: WorldMode) -> int:
    """Open a Bullet client with a floor."""
    bullet = engine()
    if mode is WorldMode.GUI and not os.environ.get("DISPLAY"):  # without a display Bullet ends the process
        raise WorldUnavailable("a window needs a display, but DISPLAY is not set; use WorldMode.DIRECT")
    try:
        client: int = bullet.connect(bullet.GUI if mode is WorldMode.GUI else bullet.DIRECT)
    except bullet.error as reason:
        raise WorldUnavailable(f"Bullet cannot open another world: {reason}") from reason
    if client < 0:
        raise WorldUnavailable("Bullet cannot open another world; close worlds that are not needed")
    # Bullet's file cache is keyed by name: it would return the old text of a changed description, and never shrink.
    bullet.setPhysicsEngineParameter(enableFileCaching=0, physicsClientId=client)
    bullet.setGravity(0, 0, _GRAVITY_M_PER_S2, physicsClientId=client)
    floor = bullet.createCollisionShape(bullet.GEOM_PLANE, physicsClientId=client)
    bullet.createMultiBody(0, floor, physicsClientId=client)
    return client
