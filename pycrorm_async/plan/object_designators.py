"""How a plan names objects: a description finds them in the world, a designator stands for one of them.

Wherever a designator is wanted, the world's own `Object` will do as well. Five classes tell apart what is
meant: `Object` and `ObjectDesignator` one of the world, `ObjectPart` a link of one, `LocatedObject` one whose
place was told relative to another, `BelieveObject` one that nobody has seen.

What is meant is the object of the world that the plan acts in: in a copy of the world (`plan.thinking`) a
designator stands for the copy of its object, and one that was made there for the real one again outside.

>>> ObjectDesignatorDescription(names=["milk"]).resolve().pose
Pose(position=[1.3, 1.0, 0.9], orientation=[0.0, 0.0, 0.0, 1.0], frame='map')
"""

from __future__ import annotations

from collections.abc import Iterable, Iterator
from dataclasses import dataclass, field
from datetime import UTC, datetime, timedelta
from typing import TYPE_CHECKING, Any, NoReturn, TypeAlias, TypeVar

from pycrorm_async.clock import SYSTEM_CLOCK
from pycrorm_async.plan.current_robot import world_here
from pycrorm_async.plan.errors import NotResolved, ResolutionError
from pycrorm_async.plan.failures import ObjectNotFound, PerceptionObjectNotInWorld
from pycrorm_async.world.enums import ObjectType
from pycrorm_async.world.objects import Object
from pycrorm_async.world.observers import current_world
from pycrorm_async.world.pose import Pose
from pycrorm_async.world.world_copy import counterpart, original, related

if TYPE_CHECKING:
    from pycrorm_async.world.bullet import BulletWorld

__all__ = [
    "ObjectDesignator",
    "ObjectPart",
    "LocatedObject",
    "BelieveObject",
    "ObjectDesignatorDescription",
    "LocatedObjectDescription",
    "ObjectLike",
    "designator_of",
    "in_world",
    "place_of",
]


T = TypeVar("T")


@dataclass(frozen=True)
class ObjectDesignator:
    """An object of the world, as a plan means it.

    Attributes:
        world_object: the object itself; None in a copy of how it was.
        frozen_pose: where it was, in such a copy.
    """

    name: str
    object_type: ObjectType
    world_object: Object | None = field(default=None, repr=False)
    frozen_pose: Pose | None = None

    def __post_init__(self) -> None:
        _check(self, name=str, object_type=ObjectType)
        if self.world_object is None and self.frozen_pose is None:
            raise ResolutionError(type(self).__name__, missing=["world_object or frozen_pose"])
        if self.frozen_pose is not None:
            _check(self, frozen_pose=Pose)

    @property
    def pose(self) -> Pose:
        """Where it is now; in a frozen copy, where it was."""
        if self.frozen_pose is not None:
            return self.frozen_pose
        assert self.world_object is not None
        return _meant_here(self.world_object).pose

    def frozen_copy(self) -> ObjectDesignator:
        """The object as it is now, whatever becomes of it."""
        return ObjectDesignator(self.name, self.object_type, None, self.pose)


class BelieveObject(ObjectDesignator):
    """An object that is believed to be somewhere and is not in the world."""

    def __init__(self, name: str, object_type: ObjectType, pose: Pose) -> None:
        super().__init__(name, object_type, None, pose)

    def frozen_copy(self) -> BelieveObject:
        return self


@dataclass(frozen=True, init=False)
class ObjectPart(ObjectDesignator):
    """A link of an object, for example a handle; its pose is the link's.

    Attributes:
        name: the link's name.
        part_of: the whole.
    """

    part_of: ObjectDesignator = field(kw_only=True)

    def __init__(
        self,
        name: str,
        part_of: ObjectLike,
        object_type: ObjectType = ObjectType.GENERIC_OBJECT,
        frozen_pose: Pose | None = None,
    ) -> None:
        put = object.__setattr__
        put(self, "name", name)
        put(self, "object_type", object_type)
        put(self, "world_object", None)
        put(self, "frozen_pose", frozen_pose)
        put(self, "part_of", designator_of(part_of))
        _check(self, name=str, object_type=ObjectType)

    @property
    def pose(self) -> Pose:
        """Where the link is now; in a frozen copy, where it was. Raises `UnknownLink`."""
        if self.frozen_pose is not None:
            return self.frozen_pose
        return in_world(self.part_of).link_pose(self.name)

    def frozen_copy(self) -> ObjectPart:
        return ObjectPart(self.name, self.part_of.frozen_copy(), self.object_type, self.pose)


@dataclass(frozen=True, init=False)
class LocatedObject(ObjectDesignator):
    """An object whose place was told, at a moment, relative to another: "the milk is 20 cm left of the cereal".

    Its pose is in the map and goes along with the reference; the pose's time is the moment it was told.

    >>> cereal = ObjectDesignatorDescription(names=["cereal"]).resolve()
    >>> LocatedObject("milk", ObjectType.MILK, Pose([0, 0.2, 0]), cereal).pose.position
    Vector(x=1.3, y=0.9, z=0.95)

    Attributes:
        relative_pose: where it is as seen from the reference (m), whatever frame the pose names.
        reference: another object, or a part of one.
        timestamp: when it was told, with a time zone; now, if left out.
        world_object: the object itself, if it is in the world; it may be elsewhere than it was told to be.
    """

    relative_pose: Pose = field(kw_only=True)
    reference: ObjectDesignator = field(kw_only=True)
    timestamp: datetime = field(kw_only=True)

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
        told = timestamp if timestamp is not None else _moment(SYSTEM_CLOCK.wall_ns())
        put = object.__setattr__
        put(self, "name", name)
        put(self, "object_type", object_type)
        put(self, "world_object", world_object)
        put(self, "frozen_pose", frozen_pose)
        put(self, "relative_pose", relative_pose)
        put(self, "reference", designator_of(reference))
        put(self, "timestamp", told)
        _check(self, name=str, object_type=ObjectType, relative_pose=Pose, timestamp=datetime)
        if told.tzinfo is None:
            raise ResolutionError(type(self).__name__, wrong=["timestamp: expected a datetime with a time zone"])

    @property
    def pose(self) -> Pose:
        """Where it is if it is where it was told to be; in a frozen copy, where that was."""
        if self.frozen_pose is not None:
            return self.frozen_pose
        there = self.reference.pose @ self.relative_pose
        return Pose(there.position, there.orientation, there.frame, _nanoseconds(self.timestamp))

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
    """Describes objects by name or type; iterating it gives a designator for each that is in the world now.

    Args:
        names: any of these names, or one; the order is one of preference.
        types: any of these types, or one.

    With names the order is theirs, without that of the world. Raises `ResolutionError` for names and types that
    are none.
    """

    def __init__(
        self, names: str | Iterable[str] | None = None, types: ObjectType | Iterable[ObjectType] | None = None
    ) -> None:
        self.names = _all_of("names", str, names)
        self.types = _all_of("types", ObjectType, types)

    def __iter__(self) -> Iterator[ObjectDesignator]:
        there = [each for each in world_here().objects if self.types is None or each.object_type in self.types]
        if self.names is not None:
            by_name = {each.name: each for each in there}
            there = [by_name[name] for name in dict.fromkeys(self.names) if name in by_name]
        for each in there:
            yield designator_of(each)

    if not TYPE_CHECKING:  # a type checker finds the fault by itself

        def __getattr__(self, name: str) -> NoReturn:
            if name in ("name", "object_type", "pose", "world_object"):
                raise NotResolved(type(self).__name__, name)
            raise AttributeError(f"{type(self).__name__!r} object has no attribute {name!r}")

    def resolve(self) -> ObjectDesignator:
        """The first that fits. Raises `ObjectNotFound`."""
        for designator in self:
            return designator
        there = ", ".join(each.name for each in world_here().objects) or "nothing"
        raise ObjectNotFound(f"no object is {self}; in the world: {there}", self.names, self._type_names())

    def __str__(self) -> str:
        parts = []
        if self.names is not None:
            parts.append(f"named {' or '.join(self.names)}")
        if self.types is not None:
            parts.append(f"of type {' or '.join(self._type_names() or ())}")
        return " and ".join(parts) or "there"

    def _type_names(self) -> tuple[str, ...] | None:
        return tuple(each.name for each in self.types) if self.types is not None else None


def _all_of(name: str, kind: type[T], given: T | Iterable[T] | None) -> tuple[T, ...] | None:
    if given is None:
        return None
    every: tuple[Any, ...] = tuple(given) if isinstance(given, Iterable) and not isinstance(given, kind) else (given,)
    if wrong := [each for each in every if not isinstance(each, kind)]:
        listed = f"{name}: expected each {kind.__name__}, got {wrong[0]!r}"
        raise ResolutionError(ObjectDesignatorDescription.__name__, wrong=[listed])
    return every


class LocatedObjectDescription(ObjectDesignatorDescription):
    """Describes objects as an `ObjectDesignatorDescription` does, and tells where each is relative to others.

    Args:
        references: alternatives for what the place is told relative to.
        names, types: any of these, or one.

    Iterating it gives each object with each reference (never with itself), as they stand at that moment.
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
        for found in super().__iter__():
            for reference in self.references:
                other = reference.world_object
                if other is None or _meant_here(other) is not found.world_object:
                    relative = found.pose.relative_to(reference.pose)
                    yield LocatedObject(
                        found.name, found.object_type, relative, reference, world_object=found.world_object
                    )

    def resolve(self) -> LocatedObject:
        """The first that fits. Raises `ObjectNotFound`."""
        first = super().resolve()
        assert isinstance(first, LocatedObject)
        return first

    def __str__(self) -> str:
        others = " or ".join(each.name for each in self.references) or "nothing"
        return f"{super().__str__()}, beside {others}"


ObjectLike: TypeAlias = Object | ObjectDesignator
"""What stands for an object."""


def designator_of(meant: ObjectLike) -> ObjectDesignator:
    """The designator of a world object; a designator is its own. Raises `ResolutionError` for anything else."""
    if isinstance(meant, ObjectDesignator):
        return meant
    if not isinstance(meant, Object):
        raise ResolutionError("ObjectDesignator", wrong=[f"expected an object or its designator, got {meant!r}"])
    return ObjectDesignator(meant.name, meant.object_type, meant)


def place_of(meant: ObjectLike) -> Pose:
    """Where it is, is believed or was told to be.

    Raises:
        PerceptionObjectNotInWorld: it was in the world and is there no more.
    """
    designator = designator_of(meant)
    if designator.world_object is not None:
        in_world(designator)
    return designator.pose


def in_world(meant: ObjectLike) -> Object:
    """The world object that is meant, in the world of this context if that is its own, a copy of it or its original.

    Raises:
        PerceptionObjectNotInWorld: there is none, it was removed, or it is only in a copy.
    """
    thing = meant.world_object if isinstance(meant, ObjectDesignator) else meant
    found = counterpart(thing, _world_of(thing)) if thing is not None else None
    if found is None:
        raise PerceptionObjectNotInWorld(f"{meant.name} is not an object of the world", meant.name)
    return found


def _meant_here(thing: Object) -> Object:
    """As `in_world`; one that is not there itself, whose last pose can still be read."""
    world = _world_of(thing)
    return thing if thing.world is world else counterpart(thing, world) or thing


def _world_of(thing: Object) -> BulletWorld:
    """The one of this context, unless the object's has nothing to do with it."""
    here = current_world.get()
    if here is None:
        return original(thing.world)
    return here if related(here, thing.world) else thing.world


def _check(designator: ObjectDesignator, **expected: type) -> None:
    """Raise `ResolutionError` naming the fields that are something else."""
    wrong = [
        f"{name}: expected {kind.__name__}, got {value!r}"
        for name, kind in expected.items()
        if not isinstance(value := getattr(designator, name), kind)
    ]
    if wrong:
        raise ResolutionError(type(designator).__name__, wrong=wrong)


_EPOCH = datetime(1970, 1, 1, tzinfo=UTC)


def _moment(wall_ns: int) -> datetime:
    return _EPOCH + timedelta(microseconds=wall_ns // 1000)


def _nanoseconds(moment: datetime) -> int:
    return (moment - _EPOCH) // timedelta(microseconds=1) * 1000
