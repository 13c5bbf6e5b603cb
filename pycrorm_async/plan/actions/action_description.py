"""Descriptions of actions hold alternatives for each property; `resolve()` uses the first alternative of each.

A property with one value needs no list: `ParkArmsAction(Arms.LEFT)`. Iterating a description yields every combination,
the last property varying fastest; those in which the arm is too weak for the object come last:

>>> [each.motion.name for each in SetGripperAction([Arms.LEFT], [GripperState.OPEN, GripperState.CLOSE])]
['OPEN', 'CLOSE']
"""

from __future__ import annotations

import itertools
from collections.abc import Callable, Iterator, Mapping
from typing import TYPE_CHECKING, Any, ClassVar, Generic, NoReturn, TypeVar

from pycrorm_async.plan.current_robot import require_robot
from pycrorm_async.plan.errors import NoRobotHere, NotResolved
from pycrorm_async.plan.failures import IllPosedGoalFailure
from pycrorm_async.plan.geometry.gripper_checks import lifting_arms
from pycrorm_async.plan.language.operators import Composable
from pycrorm_async.plan.object_designators import ObjectDesignatorDescription, ObjectLike
from pycrorm_async.world.enums import Arms
from pycrorm_async.world.errors import NoWorld

P = TypeVar("P")


class ActionDescription(Composable, Generic[P]):
    """Base of descriptions; takes the alternatives by name, in the order of the performable's fields.

    Object descriptions among the alternatives are matched against the world at each resolution or iteration.
    """

    _lifting: ClassVar[tuple[str, str] | None] = None
    """The properties that name the arm and the object that it lifts."""

    def __init__(self, performable: Callable[..., P], **alternatives: Any) -> None:
        self._performable = performable
        self._alternatives = {name: _as_alternatives(each) for name, each in alternatives.items()}

    if not TYPE_CHECKING:  # hidden from type checkers, which report the fault themselves

        def __getattr__(self, name: str) -> NoReturn:
            if name == "perform" or name in self.__dict__.get("_alternatives", ()):
                raise NotResolved(type(self).__name__, name)
            raise AttributeError(f"{type(self).__name__!r} object has no attribute {name!r}")

    def resolve(self) -> P:
        """Return the performable with the first alternative of each property.

        Of several arms it is the first one that lifts the object (`ArmDescription.payload_kg`), if one does.

        Raises:
            IllPosedGoalFailure: a property has no alternative.
            ObjectNotFound: no object in the world matches the description.
        """
        return next(iter(self))

    def __iter__(self) -> Iterator[P]:
        """Yield every combination, the last property varying fastest. Raises as `resolve` does."""
        choices = [self._choices(name, among) for name, among in self._alternatives.items()]
        too_weak: list[dict[str, Any]] = []
        for combination in itertools.product(*choices):
            properties = dict(zip(self._alternatives, combination, strict=True))
            if self._is_too_weak(properties):
                too_weak.append(properties)
            else:
                yield self._performable(**properties)
        for properties in too_weak:
            yield self._performable(**properties)

    def _is_too_weak(self, properties: Mapping[str, Any]) -> bool:
        """Return whether another arm of the alternatives lifts the object and this one does not."""
        if self._lifting is None:
            return False
        arm, load = self._lifting
        arms = self._alternatives[arm]
        return isinstance(arms, tuple) and len(arms) > 1 and properties[arm] not in _arms_for(properties[load], arms)

    def _choices(self, name: str, among: ObjectDesignatorDescription | tuple[Any, ...]) -> tuple[Any, ...]:
        if isinstance(among, ObjectDesignatorDescription):
            return tuple(among) or (among.resolve(),)
        if not among:
            raise IllPosedGoalFailure(f"{type(self).__name__} has no alternative for {name}", name)
        return among


def _arms_for(load: ObjectLike, arms: tuple[Arms, ...]) -> tuple[Arms, ...]:
    """Return the arms that lift the object; all of them outside a world with a robot."""
    try:
        return lifting_arms(require_robot(), arms, load)
    except (NoWorld, NoRobotHere):
        return arms


def _as_alternatives(value: Any) -> ObjectDesignatorDescription | tuple[Any, ...]:
    """Return the alternatives; a value that is not iterable is the only one, and so is a str."""
    if isinstance(value, ObjectDesignatorDescription):
        return value
    if isinstance(value, str):
        return (value,)
    try:
        alternatives = iter(value)
    except TypeError:
        return (value,)
    return tuple(alternatives)
