"""A world owns one physics engine and its objects, and notifies its observers of every change.

Motions are kinematic: setters place objects and joints, the simulation is never stepped, and objects do not fall. Any
number of worlds can be open at once, in tasks and threads; one world belongs to one thread at a time.

**Objects.** Objects of a world: poses, joints and attachments. Each motion notifies the observers once per changed
object.

>>> with BulletWorld() as world:
...     milk = Object("milk", ObjectType.MILK, pose=Pose([1.3, 1, 0.9]))
...     milk.set_pose(Pose([1.3, 1.2, 0.9]))
...     round(milk.bounding_box().size.z, 3)
0.194
"""

from __future__ import annotations

import logging
import math
from collections.abc import Callable, Collection, Iterable, Iterator, Mapping, Sequence
from dataclasses import dataclass
from pathlib import Path
from types import MappingProxyType, TracebackType
from typing import TYPE_CHECKING, ClassVar, Protocol, Self, TypeVar

from pycrorm_async import connected_var
from pycrorm_async.connected_var import ConnectedVar
from pycrorm_async.world import pose as poses
from pycrorm_async.world.body import (
    Body,
    ObjectState,
    WorldState,
    check_arguments,
    check_state,
    inner_points,
    number_or_nan,
    set_state,
)
from pycrorm_async.world.bounding_boxes import BoundingBox, box_around
from pycrorm_async.world.engines import Color, Engine, engine_class
from pycrorm_async.world.model_boxes import shape_boxes
from pycrorm_async.world.models import built_in_urdf
from pycrorm_async.world.urdf import RobotDescription, robot_description
from pycrorm_async.world.urdf_model import Model, read_model, urdf_text

if TYPE_CHECKING:
    from pycrorm_async.world.arms import Chain

T = TypeVar("T")

_log = logging.getLogger("pycrorm_async")


class BulletWorld:
    """A world, entered once with `with`; inside that block it is `current_world` of the context.

    >>> with BulletWorld() as world:
    ...     Object("bowl", ObjectType.BOWL)
    ...     world.objects
    (Object('bowl', BOWL, Pose(position=[0.0, 0.0, 0.0], orientation=[0.0, 0.0, 0.0, 1.0], frame='map')),)

    Entering takes about 50 ms. It raises `WorldUnavailable`, and any exception of the context's watcher. After the
    block every change raises `WorldClosed`; the last poses and joint positions can still be read.

    Args:
        mode: whether the engine opens a window.
        engine: its name, "bullet" or "mujoco", or a class with its methods; None means that of PYCRORM_ENGINE, else the
            first of these two that is installed.
        copy_of: the world this one is a copy of; only for `world_copy.copied`. A copy has no watcher.
        set_up: adds the first objects when the world has been entered; if it raises, the world is left again.
    """

    def __init__(
        self,
        mode: poses.WorldMode = poses.WorldMode.DIRECT,
        *,
        engine: str | type[Engine] | None = None,
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
        self._engine_asked = engine
        self._engine: Engine | None = None
        self.engine_title: str | None = None
        """Name and version of the engine; None before the world is entered."""
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
        if self._engine is not None or self._left:
            raise poses.WorldClosed("a world can be entered only once; create a new BulletWorld()")
        chosen = engine_class(self._engine_asked)
        self._engine, self.engine_title = chosen(self.mode), chosen.title()

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
        engine, self._engine, self._left = self.engine, None, True
        engine.close()

    @property
    def entered(self) -> bool:
        """True while the world is entered and not left."""
        return self._engine is not None

    @property
    def engine(self) -> Engine:
        """The engine, for this package only: moving its bodies notifies no observer. Raises `WorldClosed`."""
        if self._engine is None:
            raise poses.WorldClosed(
                "the world is closed; only its last poses and joint positions can be read"
                if self._left
                else "the world is not entered; act inside `with BulletWorld() as world:`"
            )
        return self._engine

    @property
    def client(self) -> int:
        """Bullet's number of this world. Raises `WorldClosed`, and `AttributeError` in a world of another engine."""
        client: int = getattr(self.engine, "client")  # noqa: B009  only Bullet's engine has one
        return client

    @property
    def description(self) -> str:
        """The world's mode, engine and objects in one line."""
        objects = ", ".join(f"{obj.name} ({obj.object_type.name})" for obj in self.objects)
        mode = ", ".join(filter(None, (self.mode.value, self.engine_title)))
        return f"BulletWorld ({mode}): {objects or 'empty'}"

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
        raise poses.ObjectNotInWorld(name, tuple(obj.name for obj in self.objects))

    def has(self, obj: Object) -> bool:
        """Return whether the world contains this object; objects are compared by identity."""
        return self._objects.get(obj.body.number) is obj

    def add(self, obj: Object) -> None:
        """Add an object whose body is loaded, and notify the observers; only `Object` calls this."""
        self._objects[obj.body.number] = obj
        if self._robot is None and obj.object_type is poses.ObjectType.ROBOT:
            self._robot = obj
        for observer in self._observers:
            observer.object_added(obj)

    def remove(self, obj: Object) -> None:
        """Detach an object and remove it; its last pose and joints can still be read."""
        obj.check_present()
        obj.detach_all()
        self.engine.unload(obj.body.number)
        del self._objects[obj.body.number]
        if obj is self._robot:
            robots = (other for other in self._objects.values() if other.object_type is poses.ObjectType.ROBOT)
            self._robot = next(robots, None)
        for observer in self._observers:
            observer.object_removed(obj)

    # --- resetting and restoring ------------------------------------------------------------------------------

    def reset(self) -> None:
        """Detach every object, set its joints to their start, and move it to its original pose.

        Objects that are in that state already are not moved, and observers get no call for them.
        """
        _ = self.engine
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
        _ = self.engine
        states = {self.object(name): state for name, state in saved.objects.items()}
        for obj, state in states.items():
            check_state(obj.name, obj.body, state)
        for each in self.attachments:
            if each.child in states or each.parent in states:
                attached_to = states[each.child].attached_to if each.child in states else None
                if attached_to != (each.parent.name, each.link):
                    each.parent.detach(each.child)
        changes = {  # followers follow, whatever was saved
            obj: set_state(obj.body, state.pose, obj.body.followed(state.joints)) for obj, state in states.items()
        }
        for obj, (joints, _) in changes.items():
            if joints:
                self.notify_joints(obj, joints)
        self.notify_moved([obj for obj, (_, has_moved) in changes.items() if has_moved])
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
        if len(starts) != len(ends):
            raise ValueError(f"every ray needs a start and an end, got {len(starts)} starts and {len(ends)} ends")
        transparent = [obj.body.number for obj in ignore if self.has(obj)]
        numbers = self.engine.first_met(starts, ends, transparent) if len(starts) else []
        return [self._objects.get(number) for number in numbers]

    def met_towards(self, obj: Object, eye: Sequence[float], *, ignore: Iterable[Object] = ()) -> list[Object | None]:
        """Return the first object on each ray from the point `eye` into an object's shapes: itself or an occluder.

        None means the floor. The list is empty for an object without shapes.
        """
        obj.check_present()
        points = inner_points(obj.body)
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


# === attachments ==============================================================================================
#
# Keep the attachments of one world, and carry attached objects along with a motion.
#
# A child is attached to one link of one parent and keeps its pose relative to that link. Chains are allowed, cycles are
# not.


@dataclass(frozen=True, slots=True)
class AttachedChild:
    """A child that moves with `link` of `parent` (None: its base link) at the pose `relative` to that link."""

    parent: Object
    child: Object
    link: str | None
    relative: poses.Pose


class Attachments:
    """All attachments of one world. Changing them moves no object and notifies no observer."""

    def __init__(self) -> None:
        self._of_child: dict[Object, AttachedChild] = {}

    def __iter__(self) -> Iterator[AttachedChild]:
        """Iterate over the attachments in the order of their creation."""
        return iter(tuple(self._of_child.values()))

    def of(self, child: Object) -> AttachedChild | None:
        """Return the attachment of `child` to its parent."""
        return self._of_child.get(child)

    def on(self, parent: Object) -> tuple[AttachedChild, ...]:
        """Return the attachments of direct children of `parent`."""
        return tuple(each for each in self._of_child.values() if each.parent is parent)

    def below(self, parent: Object) -> tuple[Object, ...]:
        """Return all descendants of `parent`, parents before their children."""
        return tuple(obj for each in self.on(parent) for obj in (each.child, *self.below(each.child)))

    def add(self, parent: Object, child: Object, link: str | None) -> None:
        """Attach `child` at its current pose. Raises `AttachmentRefused`."""
        if parent.world is not child.world:
            raise poses.AttachmentRefused(f"{child.name!r} and {parent.name!r} are in different worlds")
        present = self._of_child.get(child)
        if present is not None:
            raise poses.AttachmentRefused(
                f"{child.name!r} is attached to {present.parent.name!r} already; detach it there first"
            )
        above: Object | None = parent
        while above is not None:
            if above is child:
                raise poses.AttachmentRefused(f"{child.name!r} cannot be attached to itself (through {parent.name!r})")
            above = attachment.parent if (attachment := self._of_child.get(above)) else None
        self.put(parent, child, link)

    def put(self, parent: Object, child: Object, link: str | None) -> None:
        """Store the attachment of `child` to that link at its current pose, without checks."""
        relative = child.pose.relative_to(parent.link_pose(link))
        self.keep(AttachedChild(parent, child, link, relative))

    def keep(self, attachment: AttachedChild) -> None:
        """Store an attachment; the caller ensures that the child is at its relative pose."""
        self._of_child[attachment.child] = attachment

    def remove(self, parent: Object, child: Object) -> AttachedChild:
        """Remove an attachment and return it. Raises `AttachmentRefused` if `child` is not attached to `parent`."""
        present = self._of_child.get(child)
        if present is None or present.parent is not parent:
            raise poses.AttachmentRefused(f"{child.name!r} is not attached to {parent.name!r}")
        return self._of_child.pop(child)

    def carry(self, parent: Object, joints: Iterable[str] | None = None) -> list[Object]:
        """Move all descendants of `parent` to their poses relative to its links; return them, parents first.

        With `joints`, only the children on links that these joints move, and their descendants.
        """
        carried: list[Object] = []
        moved = None if joints is None else set(joints)
        for each in self.on(parent) if self._of_child else ():
            link_moved = moved is None or not moved.isdisjoint(parent.joints_above(each.link))
            if link_moved:
                each.child.body.place(parent.link_pose(each.link) @ each.relative)
                carried.append(each.child)
                carried += self.carry(each.child)
        return carried


# === objects ==================================================================================================

_PAST_LIMIT_MAX = 1e-6  # rad or m; tolerates positions that rounding puts past a limit


class Object:
    """One object of one world, compared by identity.

    Args:
        name: unique in its world.
        object_type: the kind of object; the first one of type ROBOT becomes `world.robot`.
        description: URDF text, or the path of a .urdf file or of a mesh file; None means the built-in shape for that
            name and type.
        pose: pose of the base link's frame, in "map"; None means the root link's at the origin. `reset` restores it.
        world: the world to add it to; None means the current world of this context.
        color: red, green, blue, opacity, 0 to 1.
        mass_kg: None means the sum of the masses in the description, if it has any; unknown for a robot or environment.
        robot: the description of a robot; None means the built-in or registered one with the object's name. Without
            `description` the model is that of the robot's description, or the built-in one of its name.
        base_link: the link whose pose is the robot's pose, empty for the root link; None means that of the robot's
            description. The base link of any other object is its root link.
        packages: folders of ROS packages by their names, for `package://` in the URDF; those of the robot's description
            count too. See `urdf_model.urdf_text`.

    Elements of the URDF without effect, and remarks of the engine, are logged once, not for copies of an object.

    Raises:
        ObjectRefused, NoWorld, WorldClosed, DuplicateName, DescriptionNotLoadable, PoseRefused, UnknownLink.
    """

    name: str
    object_type: poses.ObjectType
    world: BulletWorld
    original_pose: poses.Pose
    description_text: str
    model: Model
    """What was understood of the description."""
    color: Color | None
    robot_description: RobotDescription | None
    chains: dict[poses.Arms, Chain]
    """The chains of a robot's arms that were needed so far, for `kinematics`."""
    body: Body
    """The body in the engine, for this package only: moving it notifies no observer."""
    copy_of: Object | None
    """The object of the original world of which this one is a copy; None outside copied worlds."""
    __recorded_as__: ClassVar[str] = "Object"

    def __init__(
        self,
        name: str,
        object_type: poses.ObjectType,
        description: str | Path | None = None,
        pose: poses.Pose | None = None,
        *,
        world: BulletWorld | None = None,
        color: Color | None = None,
        mass_kg: float | None = None,
        robot: RobotDescription | None = None,
        base_link: str | None = None,
        packages: Mapping[str, str | Path] = MappingProxyType({}),
    ) -> None:
        check_arguments(name, object_type, mass_kg, color)
        world = world if world is not None else current_world.get()
        if world is None:
            raise poses.NoWorld(f"object {name!r}")
        engine = world.engine
        if any(present.name == name for present in world.objects):
            raise poses.DuplicateName(name)
        self.name = name
        self.object_type = object_type
        self.world = world
        self.copy_of = None
        if pose is not None:
            _check_pose(name, pose)
        is_robot = object_type is poses.ObjectType.ROBOT
        if base_link and not is_robot:
            raise poses.ObjectRefused(
                f"only a robot has a base link other than its root, but {name!r} is {object_type.name}"
            )
        if robot is None and is_robot:
            robot = robot_description(name)
        if base_link is None and is_robot and robot is not None:
            base_link = robot.base_link
        if description is None and robot is not None:
            description = robot.urdf
        if description is None:
            description = built_in_urdf(name if robot is None else robot.name, object_type)
        if robot is not None:
            packages = {**robot.packages, **packages}
        self.description_text = urdf_text(name, description, packages)
        self.model = read_model(self.description_text)
        self.robot_description = robot
        self.color = color
        self._mass_kg = None if mass_kg is None else float(mass_kg)  # of any type of number, and recorded
        self.chains = {}
        self.body = Body(name, self.model, engine, pose, color, base_link or "")
        if world.copy_of is None:
            self._log_left_out()
        self.original_pose = self.body.pose
        world.add(self)

    def __repr__(self) -> str:
        return f"Object({self.name!r}, {self.object_type.name}, {self.pose!r})"

    @property
    def row_of(self) -> Self:
        """The object of which a memory has a row: itself."""
        return self

    def _log_left_out(self) -> None:
        remarks = [*self.model.left_out, *self.body.remarks]
        if remarks:
            _log.warning("the description of %r: %s", self.name, "; ".join(remarks))
        if self.model.unapplied:
            unapplied = ", ".join(f"<{tag}> {count}" for tag, count in self.model.unapplied.items())
            _log.info("the description of %r: a kinematic world does not use: %s", self.name, unapplied)

    # --- pose and extent --------------------------------------------------------------------------------------

    @property
    def pose(self) -> poses.Pose:
        """The pose that was set last, or to which the object was carried, unrounded. Readable after removal."""
        return self.body.pose

    def set_pose(self, pose: poses.Pose) -> None:
        """Move the base link's frame to this pose, together with the objects attached to this one.

        An object that is attached to a parent stays attached, at its new pose relative to the parent.

        Raises:
            PoseRefused, WorldClosed, ObjectNotInWorld: before anything is moved.
        """
        self.check_present()
        self.body.place(_check_pose(self.name, pose))
        self._keep_attached()
        self.world.notify_moved([self, *self.world.attachments.carry(self)])

    @property
    def base_link(self) -> str:
        """The link whose frame is a robot's pose; empty for the root link."""
        return "" if self.body.base == self.body.root else self.body.base

    def root_pose(self, pose: poses.Pose | None = None) -> poses.Pose:
        """Return the pose of the root link's frame, now or with the object at `pose` and its joints as they are."""
        return self.body.root_pose if pose is None else self.body.root_at(pose)

    def link_pose(self, link: str | None = None) -> poses.Pose:
        """Return the pose of a link's frame in "map"; None means the base link. Raises `UnknownLink`."""
        if link is None or link == self.body.base:
            return self.body.pose
        if link == self.body.root:
            return self.body.root_pose
        self._check_link(link)
        self.check_present()
        position, orientation = self.body.link_frame(link)
        return poses.Pose(position, orientation)

    def link_pose_at(self, link: str, positions: Mapping[str, float]) -> poses.Pose:
        """Return the pose that a link's frame would have in "map" at these joint positions (rad or m).

        Nothing is moved and limits are not checked. Raises `UnknownLink`, `UnknownJoint`.
        """
        self._check_link(link)
        for joint in positions:
            self.joint_position(joint)
        self.check_present()
        position, orientation = self.body.link_frame_at(link, positions)
        return poses.Pose(position, orientation)

    def bounding_box(self, link: str | None = None) -> BoundingBox:
        """Return the box along the axes of "map" around the whole object or one link, without margin.

        Without a collision shape it is a box of size zero at the frame's origin. Raises `UnknownLink`.
        """
        links = self.body.links if link is None else (self._check_link(link),)
        self.check_present()
        box = self.body.box(links)
        if box is None:
            position = self.link_pose(link).position
            return BoundingBox(position, position)
        return box

    def box_in_link(self, link: str) -> BoundingBox | None:
        """Return the box around a link's collision shapes, in its own frame; None without any. Raises `UnknownLink`."""
        return box_around([((poses.Vector(0.0, 0.0, 0.0), poses.IDENTITY), self.body.solids[self._check_link(link)])])

    def visual_boxes(self, links: Collection[str]) -> dict[str, BoundingBox]:
        """Return the boxes around the visual shapes of links, in their frames, where the shapes can be read."""
        return shape_boxes(self.description_text, visual=True, links=links)

    @property
    def mass_kg(self) -> float | None:
        """The given mass, else that of the description; None if it is not known.

        The description counts for objects that grippers lift, not for robots and environments, whose models often have
        guessed masses.
        """
        if self._mass_kg is not None or self.object_type in (poses.ObjectType.ROBOT, poses.ObjectType.ENVIRONMENT):
            return self._mass_kg
        return self.model.mass_kg

    def label(self, text: str) -> None:
        """Show a text at the object, if the world has a window."""
        self.check_present()
        self.world.engine.label(self.body.number, text)

    # --- joints -----------------------------------------------------------------------------------------------

    @property
    def joints(self) -> tuple[str, ...]:
        """The names of the movable joints."""
        return tuple(self.body.positions)

    @property
    def links(self) -> tuple[str, ...]:
        """The names of all links, the root first."""
        return self.body.links

    def joint_position(self, joint: str) -> float:
        """Return the position that was set last, rad or m. Raises `UnknownJoint`."""
        return self._of_joint(joint, self.body.positions)

    def joint_positions(self) -> dict[str, float]:
        """Return the positions of all movable joints by name, rad or m; a copy."""
        return dict(self.body.positions)

    def joint_limits(self, joint: str) -> tuple[float, float]:
        """Return the lower and upper hard limit, rad or m; infinite for a continuous joint. Raises `UnknownJoint`."""
        return self._of_joint(joint, self.body.limits)

    def joint_type(self, joint: str) -> poses.JointType:
        """Return the type of a joint, also of a fixed one. Raises `UnknownJoint`."""
        return self._of_joint(joint, self.body.joint_types)

    def joints_above(self, link: str | None) -> tuple[str, ...]:
        """Return the movable joints between a link (None: the base link) and the root, nearest first.

        Raises `UnknownLink`.
        """
        return self.body.movable_above[self.body.base if link is None else self._check_link(link)]

    def set_joint_position(self, joint: str, position: float) -> None:
        """Set one joint; see `set_joint_positions`."""
        self.set_joint_positions({joint: position})

    def set_joint_positions(self, positions: Mapping[str, float]) -> None:
        """Set joints, rad or m, in one motion, and carry along the objects attached to the links they move.

        A joint above the base link moves the base too. A joint with <mimic> follows its leader, also where its own
        position is passed with that of its leader. All errors are raised before anything is moved.

        Raises:
            JointLimitExceeded: a position is outside its hard limits (by more than 1e-6) or not finite, or is no
                number, and is not the joint's present one.
            JointFollows: a joint that follows another would have to leave it.
            UnknownJoint, WorldClosed, ObjectNotInWorld.
        """
        self.check_present()
        targets = {joint: number_or_nan(position) for joint, position in positions.items()}
        for joint, position in targets.items():
            lower, upper = self.joint_limits(joint)
            leader = self.body.leader(joint)
            if position == self.body.positions[joint] or (leader in targets and math.isfinite(position)):
                continue
            if leader is not None:
                raise poses.JointFollows(self.name, joint, leader)
            within = lower - _PAST_LIMIT_MAX <= position <= upper + _PAST_LIMIT_MAX
            if not (within and abs(position) <= poses.COORDINATE_MAX):
                raise poses.JointLimitExceeded(self.name, joint, positions[joint], (lower, upper))
        targets = self.body.followed(targets)
        if targets:
            before = self.body.pose
            self.body.turn(targets)
            moved = [self] if self.body.pose != before else []
            if moved:
                self._keep_attached()
            moved += self.world.attachments.carry(self, targets)
            self.world.notify_joints(self, targets)
            self.world.notify_moved(moved)

    # --- attachments ------------------------------------------------------------------------------------------

    @property
    def attachments(self) -> dict[Object, str | None]:
        """The attached objects, each with the link it moves with (None: the base link)."""
        return {each.child: each.link for each in self.world.attachments.on(self)}

    @property
    def attached_to(self) -> Object | None:
        """The object that this one is attached to."""
        attachment = self.world.attachments.of(self)
        return None if attachment is None else attachment.parent

    def attach(self, child: Object, link: str | None = None) -> None:
        """Attach `child` at its current pose to `link` (None: the base link), so that it moves with it.

        Raises:
            AttachmentRefused: the child is attached already, to this or another object, or it carries this one.
            UnknownLink, WorldClosed, ObjectNotInWorld.
        """
        self.check_present()
        if not isinstance(child, Object):
            raise poses.AttachmentRefused(f"only an Object can be attached to {self.name!r}, got {child!r}")
        child.check_present()
        if link is not None:
            self._check_link(link)
        self.world.attachments.add(self, child, link)
        for observer in self.world.observers:
            observer.object_attached(self, child, link)

    def detach(self, child: Object) -> None:
        """Detach `child`, which keeps its pose. Raises `AttachmentRefused` if it is not attached to this object."""
        self.check_present()
        attachment = self.world.attachments.remove(self, child)
        for observer in self.world.observers:
            observer.object_detached(self, child, attachment.link)

    def detach_all(self) -> None:
        """Detach all children, and the object itself from its parent."""
        for child in self.attachments:
            self.detach(child)
        if (parent := self.attached_to) is not None:
            parent.detach(self)

    # --- reset and removal ------------------------------------------------------------------------------------

    def reset(self) -> None:
        """Detach the object, set its joints to their start, and move it to its original pose.

        A joint starts at 0 or, where its limits exclude that, at the nearest of them. Only differences are notified.
        """
        self.check_present()
        self.detach_all()
        joints, has_moved = set_state(self.body, self.original_pose, self.body.start)
        if joints:
            self.world.notify_joints(self, joints)
        if has_moved:
            self.world.notify_moved([self])

    def remove(self) -> None:
        """Detach the object and remove it from the world; its last pose and joints can still be read."""
        self.world.remove(self)

    def check_present(self) -> None:
        """Raise `WorldClosed` if the world is closed, `ObjectNotInWorld` if the object was removed."""
        _ = self.world.engine
        if not self.world.has(self):
            raise poses.ObjectNotInWorld(self.name, tuple(present.name for present in self.world.objects))

    def _keep_attached(self) -> None:
        """Keep the attachment to the parent at the object's new pose."""
        attachments = self.world.attachments
        if (attachment := attachments.of(self)) is not None:
            attachments.put(attachment.parent, self, attachment.link)

    def _of_joint(self, joint: str, values: Mapping[str, T]) -> T:
        try:
            return values[joint]
        except KeyError:
            raise poses.UnknownJoint(self.name, joint, self.joints) from None

    def _check_link(self, link: str) -> str:
        if link not in self.body.movable_above:
            raise poses.UnknownLink(self.name, link, self.links)
        return link


def _check_pose(name: str, pose: poses.Pose) -> poses.Pose:
    """Return the pose. Raises `PoseRefused` if the object cannot be moved to it."""
    if not isinstance(pose, poses.Pose):
        raise poses.PoseRefused(name, pose, "it is not a Pose")
    if pose.frame != "map":
        raise poses.PoseRefused(name, pose, f"its frame is {pose.frame!r}: transform it to 'map' first")
    if not all(abs(value) <= poses.COORDINATE_MAX for value in (*pose.position, *pose.orientation)):
        raise poses.PoseRefused(name, pose, f"its numbers must be finite and at most {poses.COORDINATE_MAX:g}")
    return pose


# === observers ================================================================================================
#
# Protocols for observing worlds: observers of one world's changes, and watchers of worlds that are entered.
#
# Theory of operation -------------------
#
# Two context variables connect the world to its users, so that the world package imports none of them. `current_world`
# is the world of the innermost `with BulletWorld()` of the current task; a world entered with `BulletWorld.connect` is
# visible in every context of the process that has none of its own. `watcher` is the `WorldWatcher` of the current
# context; an open memory sets its recorder as one.
#
# A world reads `watcher` once, when it is entered, calls its `world_entered`, and keeps it, so that the same watcher
# gets `world_left` even if the context has another one by then. If `world_entered` raises, the world closes and the
# exception reaches the caller: a watcher can refuse a world, and gets no `world_left` for it. Copies of a world are
# entered without a watcher.
#
# A world calls its observers in the order in which they were added, synchronously in the thread that changed the world,
# and only after the motion is complete, when all poses and joints, also those of carried objects, are set. A world
# belongs to one thread at a time, so its calls do not overlap, and observers need no lock of their own for it. The
# tuple of observers is replaced and never mutated, so an observer may add or remove observers while it is called.
# Collision queries move the objects' `Body` for a trial and restore it, without a call of the object's setters, so they
# notify no observer.


class WorldObserver(Protocol):
    """Receives every change of one world: objects added and removed, their motions, and their attachments.

    A motion notifies once for each object with a new pose and once for each object with new joint positions. The world
    calls in the thread that made the change. An observer must not raise: the exception would reach that thread.
    """

    def object_added(self, added: Object) -> None:
        """Called after an object was added, with its pose and joints set."""
        ...

    def object_removed(self, removed: Object) -> None:
        """Called after an object was removed; its last pose can still be read."""
        ...

    def object_moved(self, moved: Object) -> None:
        """Called after an object's pose was set, or changed because its parent carried it."""
        ...

    def joints_moved(self, moved: Object, positions: Mapping[str, float]) -> None:
        """Called after one motion set these joints (by name, rad or m)."""
        ...

    def object_attached(self, parent: Object, child: Object, link: str | None) -> None:
        """Called after `child` was attached to `link` of `parent` (None: its base link)."""
        ...

    def object_detached(self, parent: Object, child: Object, link: str | None) -> None:
        """Called after `child` was detached from `link` of `parent`."""
        ...


class WorldWatcher(Protocol):
    """Receives the worlds that are entered and left in its context."""

    def world_entered(self, world: BulletWorld) -> None:
        """Called when a world is entered, by `with` or `connect`; an exception closes it and reaches the caller."""
        ...

    def world_left(self, world: BulletWorld) -> None:
        """Called when the world is left, before it closes; its objects can still be read."""
        ...


current_world: ConnectedVar[BulletWorld] = ConnectedVar("current_world")
watcher: ConnectedVar[WorldWatcher] = connected_var.world_watcher
