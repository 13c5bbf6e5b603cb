"""Designate objects in plans: a description selects objects of the world, a designator refers to one of them.

Every function that takes a designator also takes the world's own `Object`. There are five classes: `Object` and
`ObjectDesignator` refer to an object of the world, `ObjectPart` to a link of one, `LocatedObject` to an object whose
pose is specified relative to another, `BelieveObject` to an object that has not been perceived.

A designator refers to the object in the plan's current world: in a simulation (`retry`) to the copy of
its object, and outside it to the original again, also if the designator was created inside.

>>> ObjectDesignatorDescription(names=["milk"]).resolve().pose
Pose(position=[1.3, 1.0, 0.9], orientation=[0.0, 0.0, 0.0, 1.0], frame='map')
"""

from __future__ import annotations

import math
from collections.abc import Iterable, Iterator, Mapping
from dataclasses import dataclass, field
from datetime import datetime
from typing import TYPE_CHECKING, Any, ClassVar, NamedTuple, NoReturn, TypeAlias, TypeVar

from pycrorm_async.clock import SYSTEM_CLOCK, microseconds_of, utc_of
from pycrorm_async.errors import CallerError
from pycrorm_async.plan import failures
from pycrorm_async.world.bullet import BulletWorld, Object, current_world
from pycrorm_async.world.pose import Arms, GripperState, NoWorld, ObjectType, Pose
from pycrorm_async.world.urdf import ArmDescription, RobotDescription
from pycrorm_async.world.world_copy import acting_robot, counterpart, original, related

_T = TypeVar("_T")


@dataclass(frozen=True)
class ObjectDesignator:
    """A reference to an object of the world.

    Attributes:
        world_object: the object itself; None in a frozen copy.
        frozen_pose: the pose at the moment of the frozen copy.
    """

    name: str
    object_type: ObjectType
    world_object: Object | None = field(default=None, repr=False)
    frozen_pose: Pose | None = None
    __recorded_as__: ClassVar[str] = "Object"

    @property
    def row_of(self) -> Object | None:
        """The object of the world of which a memory has a row."""
        return self.world_object

    def __post_init__(self) -> None:
        _check(self, name=str, object_type=ObjectType)
        if self.world_object is None and self.frozen_pose is None:
            raise failures.ResolutionError(type(self).__name__, missing=["world_object or frozen_pose"])
        if self.frozen_pose is not None:
            _check(self, frozen_pose=Pose)

    @property
    def pose(self) -> Pose:
        """The current pose; in a frozen copy, the pose at that moment."""
        if self.frozen_pose is not None:
            return self.frozen_pose
        assert self.world_object is not None
        return _in_current_world(self.world_object).pose

    def frozen_copy(self) -> ObjectDesignator:
        """Return a copy that keeps the object's current pose."""
        return ObjectDesignator(self.name, self.object_type, None, self.pose)


class BelieveObject(ObjectDesignator):
    """An object with an assumed pose that is not in the world."""

    __recorded_as__: ClassVar[str] = "BelieveObject"

    def __init__(self, name: str, object_type: ObjectType, pose: Pose) -> None:
        super().__init__(name, object_type, None, pose)

    def frozen_copy(self) -> BelieveObject:
        return self


@dataclass(frozen=True, init=False)
class ObjectPart(ObjectDesignator):
    """A link of an object, for example a handle; its pose is the link's.

    Attributes:
        name: the link's name.
        part_of: the object that has the link.
    """

    part_of: ObjectDesignator = field(kw_only=True)
    __recorded_as__: ClassVar[str] = "ObjectPart"

    @property
    def row_of(self) -> Object | None:
        """The whole."""
        return self.part_of.row_of if isinstance(self.part_of, ObjectPart) else self.part_of.world_object

    def __init__(
        self,
        name: str,
        part_of: ObjectLike,
        object_type: ObjectType = ObjectType.GENERIC_OBJECT,
        frozen_pose: Pose | None = None,
    ) -> None:
        whole = designator_of(part_of)
        vars(self).update(
            name=name, object_type=object_type, world_object=None, frozen_pose=frozen_pose, part_of=whole
        )  # the attributes themselves are frozen
        _check(self, name=str, object_type=ObjectType)

    @property
    def pose(self) -> Pose:
        """The link's current pose; in a frozen copy, the pose at that moment. Raises `UnknownLink`."""
        if self.frozen_pose is not None:
            return self.frozen_pose
        return in_world(self.part_of).link_pose(self.name)

    def frozen_copy(self) -> ObjectPart:
        return ObjectPart(self.name, self.part_of.frozen_copy(), self.object_type, self.pose)


@dataclass(frozen=True, init=False)
class LocatedObject(ObjectDesignator):
    """An object whose pose was specified, at a moment, relative to another: "the milk is 20 cm left of the cereal".

    Its pose is in the map and follows the reference; the pose's time is the moment of the specification.

    >>> cereal = ObjectDesignatorDescription(names=["cereal"]).resolve()
    >>> LocatedObject("milk", ObjectType.MILK, Pose([0, 0.2, 0]), cereal).pose.position
    Vector(x=1.3, y=0.9, z=0.95)

    Attributes:
        relative_pose: the pose relative to the reference (m); its frame's name is ignored.
        reference: another object, or a part of one.
        timestamp: the moment of the specification, with a time zone; None means now.
        world_object: the object itself, if it is in the world; its real pose may differ.
    """

    relative_pose: Pose = field(kw_only=True)
    reference: ObjectDesignator = field(kw_only=True)
    timestamp: datetime = field(kw_only=True)
    __recorded_as__: ClassVar[str] = "LocatedObject"

    @property
    def row_of(self) -> Object | None:
        """The reference, or the whole that it is a part of."""
        return self.reference.row_of if isinstance(self.reference, ObjectPart) else self.reference.world_object

    def __init__(
        self,
        name: str,
        object_type: ObjectType,
        relative_pose: Pose,
        reference: ObjectLike,
        timestamp: datetime | None = None,
        world_object: Object | None = None,
        frozen_pose: Pose | None = None,
    ) -> None:
        moment = timestamp if timestamp is not None else utc_of(SYSTEM_CLOCK.wall_ns() // 1000)
        vars(self).update(name=name, object_type=object_type, world_object=world_object, frozen_pose=frozen_pose)
        vars(self).update(relative_pose=relative_pose, reference=designator_of(reference), timestamp=moment)
        _check(self, name=str, object_type=ObjectType, relative_pose=Pose, timestamp=datetime)
        if moment.tzinfo is None:
            raise failures.ResolutionError(
                type(self).__name__, wrong=["timestamp: expected a datetime with a time zone"]
            )

    @property
    def pose(self) -> Pose:
        """The specified pose in the map; in a frozen copy, the pose at that moment."""
        if self.frozen_pose is not None:
            return self.frozen_pose
        pose = self.reference.pose @ self.relative_pose
        return Pose(pose.position, pose.orientation, pose.frame, microseconds_of(self.timestamp) * 1000)

    def frozen_copy(self) -> LocatedObject:
        return LocatedObject(
            self.name,
            self.object_type,
            self.relative_pose,
            self.reference.frozen_copy(),
            self.timestamp,
            frozen_pose=self.pose,
        )


class ObjectDesignatorDescription:
    """Describes objects by name or type; iterating yields a designator for each match that is in the world now.

    Args:
        names: one name, or several in the order of preference.
        types: one type, or several.

    The order is that of the names, without names that of the world. Raises `ResolutionError` for names that are not
    str and types that are not `ObjectType`.
    """

    def __init__(
        self, names: str | Iterable[str] | None = None, types: ObjectType | Iterable[ObjectType] | None = None
    ) -> None:
        self.names = _as_tuple("names", str, names)
        self.types = _as_tuple("types", ObjectType, types)

    def __iter__(self) -> Iterator[ObjectDesignator]:
        matches = [each for each in require_world().objects if self.types is None or each.object_type in self.types]
        if self.names is not None:
            by_name = {each.name: each for each in matches}
            matches = [by_name[name] for name in dict.fromkeys(self.names) if name in by_name]
        for each in matches:
            yield designator_of(each)

    if not TYPE_CHECKING:  # hidden from type checkers, which report the fault themselves

        def __getattr__(self, name: str) -> NoReturn:
            if name in ("name", "object_type", "pose", "world_object"):
                raise failures.NotResolved(type(self).__name__, name)
            raise AttributeError(f"{type(self).__name__!r} object has no attribute {name!r}")

    def resolve(self) -> ObjectDesignator:
        """Return the first match. Raises `ObjectNotFound`."""
        for designator in self:
            return designator
        present = ", ".join(each.name for each in require_world().objects) or "nothing"
        raise failures.ObjectNotFound(f"no object is {self}; in the world: {present}", self.names, self._type_names())

    def __str__(self) -> str:
        parts = []
        if self.names is not None:
            parts.append(f"named {' or '.join(self.names)}")
        if self.types is not None:
            parts.append(f"of type {' or '.join(self._type_names() or ())}")
        return " and ".join(parts) or "in the world"

    def _type_names(self) -> tuple[str, ...] | None:
        return tuple(each.name for each in self.types) if self.types is not None else None


def _as_tuple(name: str, kind: type[_T], values: _T | Iterable[_T] | None) -> tuple[_T, ...] | None:
    if values is None:
        return None
    items: tuple[Any, ...]
    items = tuple(values) if isinstance(values, Iterable) and not isinstance(values, kind) else (values,)
    if wrong := [each for each in items if not isinstance(each, kind)]:
        fault = f"{name}: expected each {kind.__name__}, got {wrong[0]!r}"
        raise failures.ResolutionError(ObjectDesignatorDescription.__name__, wrong=[fault])
    return items


class LocatedObjectDescription(ObjectDesignatorDescription):
    """Describes objects by names and types, and locates each relative to reference objects.

    Args:
        references: alternatives for the reference.
        names, types: one, or several.

    Iterating yields each object with each reference other than itself, at their current poses.
    """

    def __init__(
        self,
        references: Iterable[ObjectLike],
        names: str | Iterable[str] | None = None,
        types: ObjectType | Iterable[ObjectType] | None = None,
    ) -> None:
        super().__init__(names, types)
        self.references = tuple(designator_of(each) for each in references)

    def __iter__(self) -> Iterator[LocatedObject]:
        for match in super().__iter__():
            for reference in self.references:
                other = reference.world_object
                if other is None or _in_current_world(other) is not match.world_object:
                    relative = match.pose.relative_to(reference.pose)
                    yield LocatedObject(
                        match.name, match.object_type, relative, reference, world_object=match.world_object
                    )

    def resolve(self) -> LocatedObject:
        """Return the first match. Raises `ObjectNotFound`."""
        first = super().resolve()
        assert isinstance(first, LocatedObject)
        return first

    def __str__(self) -> str:
        others = " or ".join(each.name for each in self.references) or "nothing"
        return f"{super().__str__()}, beside {others}"


ObjectLike: TypeAlias = Object | ObjectDesignator
"""An object of the world, or a designator of one."""


def designator_of(target: ObjectLike) -> ObjectDesignator:
    """Return the designator of a world object, or the designator itself. Raises `ResolutionError` for other values."""
    if isinstance(target, ObjectDesignator):
        return target
    if not isinstance(target, Object):
        raise failures.ResolutionError(
            "ObjectDesignator", wrong=[f"expected an object or its designator, got {target!r}"]
        )
    return ObjectDesignator(target.name, target.object_type, target)


def pose_of(target: ObjectLike) -> Pose:
    """Return the object's current, assumed or specified pose.

    Raises:
        PerceptionObjectNotInWorld: the object was removed from the world.
    """
    designator = designator_of(target)
    if designator.world_object is not None:
        in_world(designator)
    return designator.pose


def in_world(target: ObjectLike) -> Object:
    """Return the world object that `target` refers to, in the current world if the object's world is related to it.

    Two worlds are related if one is a copy of the other, or both are copies of one.

    Raises:
        PerceptionObjectNotInWorld: the designator has no world object, the object was removed, or it exists in a copy
            only.
    """
    obj = target.world_object if isinstance(target, ObjectDesignator) else target
    match = counterpart(obj, _current_world_of(obj)) if obj is not None else None
    if match is None:
        raise failures.PerceptionObjectNotInWorld(f"{target.name} is not an object of the world", target.name)
    return match


def _in_current_world(obj: Object) -> Object:
    """Return the object's counterpart in the current world, or the object itself, whose last pose can be read."""
    world = _current_world_of(obj)
    return obj if obj.world is world else counterpart(obj, world) or obj


def _current_world_of(obj: Object) -> BulletWorld:
    """Return the world of this context if it is related to the object's, otherwise the object's world."""
    world = current_world.get()
    if world is None:
        return original(obj.world)
    return world if related(world, obj.world) else obj.world


def _check(designator: ObjectDesignator, **expected: type) -> None:
    """Raise `ResolutionError` that names the fields of another type."""
    wrong = [
        f"{name}: expected {kind.__name__}, got {value!r}"
        for name, kind in expected.items()
        if not isinstance(value := getattr(designator, name), kind)
    ]
    if wrong:
        raise failures.ResolutionError(type(designator).__name__, wrong=wrong)


# === current robot ============================================================================================
#
# Look up the world and the robot of the current context, with an error that names the missing statement.


class CurrentRobot(NamedTuple):
    """A robot: its object in the world and the description of its kind."""

    body: Object
    description: RobotDescription

    def one_arm(self, arm: Arms) -> ArmDescription:
        """Return the description of a single arm.

        Raises:
            IllPosedGoalFailure: `arm` is `Arms.BOTH`.
            CapabilityAbsenceFailure: the robot has no such arm.
        """
        if arm is Arms.BOTH:
            raise failures.IllPosedGoalFailure(
                "this designator needs one arm, LEFT or RIGHT, and does not work with BOTH", arm
            )
        arm_description = self.description.arms.get(arm)
        if arm_description is None:
            raise failures.CapabilityAbsenceFailure(f"{self.body.name} has no {arm.name} arm", self.body.name, arm)
        return arm_description

    def each_arm(self, arm: Arms) -> dict[Arms, ArmDescription]:
        """Return the arm, or both for `Arms.BOTH`. Raises `CapabilityAbsenceFailure` for an arm the robot lacks."""
        return {each: self.one_arm(each) for each in ((Arms.LEFT, Arms.RIGHT) if arm is Arms.BOTH else (arm,))}

    def base_links(self) -> tuple[str, ...]:
        """Return the links with a shape that no arm moves: the base, and the torso and head on it."""
        first_joints = {arm.joints[0] for arm in self.description.arms.values()}
        body = self.body
        return tuple(
            link for link in body.links if body.body.solids[link] and first_joints.isdisjoint(body.joints_above(link))
        )

    def absence(self, capability: str) -> failures.CapabilityAbsenceFailure:
        """Return the failure of an action for which the robot lacks a part."""
        return failures.CapabilityAbsenceFailure(f"{self.body.name} has no {capability}", self.body.name, capability)

    def torso_joint(self) -> str:
        """Return the joint that lifts the torso. Raises `CapabilityAbsenceFailure`."""
        if self.description.torso_joint is None:
            raise self.absence("torso to lift")
        return self.description.torso_joint

    def gripper_joints(self, arm: Arms, state: GripperState) -> Mapping[str, float]:
        """Return the positions of a gripper's joints. Raises `CapabilityAbsenceFailure` without a gripper."""
        joints = self.one_arm(arm).gripper_joints.get(state)
        if not joints:
            raise self.absence(f"gripper at its {arm.name} arm")
        return joints

    def parked(self, arm: Arms) -> dict[str, float]:
        """Return the posture of a parked arm. Raises `CapabilityAbsenceFailure` if the arm has none."""
        park = self.one_arm(arm).park
        if not park:
            raise self.absence(f"park posture of its {arm.name} arm")
        return dict(park)

    def tool_pose(self, arm: Arms) -> Pose:
        """Return the current pose of an arm's tool frame."""
        described = self.one_arm(arm)
        return in_link(self.body.link_pose(described.tool_frame), described.tool_in_link)

    def camera_pose(self) -> Pose:
        """Return the current pose of the camera's optical frame. Raises `CapabilityAbsenceFailure` without a camera."""
        if self.description.camera_link is None:
            raise self.absence("camera")
        return in_link(self.body.link_pose(self.description.camera_link), self.description.camera_in_link)

    def camera_heights_m(self) -> tuple[float, float]:
        """Return the lowest and the highest height of the camera above the floor."""
        if self.description.camera_height_m is not None:
            return self.description.camera_height_m
        height = self.camera_pose().position.z
        return height, height

    def with_load(self) -> frozenset[Object]:
        """Return the robot and all objects attached to it, directly or indirectly."""
        return frozenset({self.body, *self.body.world.attachments.below(self.body)})


def in_link(link: Pose, frame: Pose | None) -> Pose:
    """Return the pose of a frame that is fixed to a link; None is the link's own frame."""
    return link if frame is None else link @ frame


def require_world() -> BulletWorld:
    """Return the world of the innermost `with BulletWorld()` of this context. Raises `NoWorld`."""
    world = current_world.get()
    if world is None:
        raise NoWorld("the plan")
    return world


def require_robot() -> CurrentRobot:
    """Return the robot that acts in the current world (`robot_acting`). Raises `NoWorld`, `NoRobotHere`."""
    world = require_world()
    body = acting_robot(world)
    if body is None:
        if world.robot is not None:
            raise failures.NoRobotHere("the robot that acts here (robot_acting) is not in the current world")
        raise failures.NoRobotHere('no robot in the world: add one, e.g. Object("pr2", ObjectType.ROBOT)')
    description = body.robot_description
    if description is None:
        raise failures.NoRobotHere(
            f"no robot description is registered for the robot {body.name!r}: pass one, as in Object(..., robot=PR2)"
        )
    return CurrentRobot(body, description)


def check_in_map(target: Pose) -> None:
    """Raise `CallerError` if the pose is not in the frame "map", or not finite."""
    if target.frame != "map":
        raise CallerError(f"the target is in frame {target.frame!r}, the robot in 'map': transform it first")
    if not math.isfinite(sum(target.position) + sum(target.orientation)):
        raise CallerError(f"the target is not finite: {target!r}")
