"""Descriptions of actions hold alternatives for each property; `resolve()` uses the first alternative of each.

A property with one value needs no list: `ParkArmsAction(Arms.LEFT)`. Iterating a description yields every combination,
the last property varying fastest; those in which the arm is too weak for the object come last:

>>> [each.motion.name for each in SetGripperAction([Arms.LEFT], [GripperState.OPEN, GripperState.CLOSE])]
['OPEN', 'CLOSE']
"""

from __future__ import annotations

import itertools
from collections.abc import Callable, Iterable, Iterator, Mapping
from typing import TYPE_CHECKING, Any, ClassVar, Generic, NoReturn, TypeAlias, TypeVar

from pycrorm_async.plan.actions.basic import (
    LookAtActionPerformable,
    MoveTorsoActionPerformable,
    NavigateActionPerformable,
    ParkArmsActionPerformable,
    PickUpActionPerformable,
    PlaceActionPerformable,
    SetGripperActionPerformable,
)
from pycrorm_async.plan.actions.manipulation import (
    CloseActionPerformable,
    GraspingActionPerformable,
    GripActionPerformable,
    OpenActionPerformable,
    ReleaseActionPerformable,
)
from pycrorm_async.plan.actions.transport import DetectActionPerformable, TransportActionPerformable
from pycrorm_async.plan.current_robot import require_robot
from pycrorm_async.plan.errors import NoRobotHere, NotResolved
from pycrorm_async.plan.failures import IllPosedGoalFailure
from pycrorm_async.plan.geometry.gripper_checks import lifting_arms
from pycrorm_async.plan.language.operators import Composable
from pycrorm_async.plan.object_designators import ObjectDesignatorDescription, ObjectLike, ObjectPart
from pycrorm_async.world.enums import Arms, Grasp, GripperState
from pycrorm_async.world.errors import NoWorld
from pycrorm_async.world.pose import Pose

P = TypeVar("P")
T = TypeVar("T")

OneOrMore: TypeAlias = T | Iterable[T]
Objects: TypeAlias = ObjectDesignatorDescription | OneOrMore[ObjectLike]


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


class MoveTorsoAction(ActionDescription[MoveTorsoActionPerformable]):
    """Lift or lower the torso to one of these positions (m)."""

    def __init__(self, positions: OneOrMore[float]) -> None:
        super().__init__(MoveTorsoActionPerformable, position=positions)


class SetGripperAction(ActionDescription[SetGripperActionPerformable]):
    """Open or close a gripper."""

    def __init__(self, grippers: OneOrMore[Arms], motions: OneOrMore[GripperState]) -> None:
        super().__init__(SetGripperActionPerformable, gripper=grippers, motion=motions)


class ParkArmsAction(ActionDescription[ParkArmsActionPerformable]):
    """Move one of these arms, or both, to the folded park posture."""

    def __init__(self, arms: OneOrMore[Arms]) -> None:
        super().__init__(ParkArmsActionPerformable, arm=arms)


class NavigateAction(ActionDescription[NavigateActionPerformable]):
    """Drive to one of these places."""

    def __init__(self, target_locations: OneOrMore[Pose]) -> None:
        super().__init__(NavigateActionPerformable, target_location=target_locations)


class LookAtAction(ActionDescription[LookAtActionPerformable]):
    """Turn the head to one of these points."""

    def __init__(self, targets: OneOrMore[Pose]) -> None:
        super().__init__(LookAtActionPerformable, target=targets)


class PickUpAction(ActionDescription[PickUpActionPerformable]):
    """Pick up an object: a given one, one of several, or one that matches a description."""

    _lifting = "arm", "object_designator"

    def __init__(self, object_designator_description: Objects, arms: OneOrMore[Arms], grasps: OneOrMore[Grasp]) -> None:
        super().__init__(
            PickUpActionPerformable,
            object_designator=object_designator_description,
            arm=arms,
            grasp=grasps,
        )


class PlaceAction(ActionDescription[PlaceActionPerformable]):
    """Place the held object at one of these poses."""

    def __init__(
        self, object_designator_description: Objects, target_locations: OneOrMore[Pose], arms: OneOrMore[Arms]
    ) -> None:
        super().__init__(
            PlaceActionPerformable,
            object_designator=object_designator_description,
            arm=arms,
            target_location=target_locations,
        )


class GripAction(ActionDescription[GripActionPerformable]):
    """Close a gripper on an object between its fingers, with one of these efforts (N)."""

    _lifting = "gripper", "object_designator"

    def __init__(
        self, grippers: OneOrMore[Arms], object_designator_description: Objects, efforts: OneOrMore[float]
    ) -> None:
        super().__init__(
            GripActionPerformable,
            gripper=grippers,
            object_designator=object_designator_description,
            effort=efforts,
        )


class ReleaseAction(ActionDescription[ReleaseActionPerformable]):
    """Release a held object."""

    def __init__(self, grippers: OneOrMore[Arms], object_designator_description: Objects) -> None:
        super().__init__(ReleaseActionPerformable, gripper=grippers, object_designator=object_designator_description)


class GraspingAction(ActionDescription[GraspingActionPerformable]):
    """Close a gripper around an object or a handle."""

    def __init__(self, arms: OneOrMore[Arms], object_description: Objects) -> None:
        super().__init__(GraspingActionPerformable, arm=arms, object_desig=object_description)


class OpenAction(ActionDescription[OpenActionPerformable]):
    """Open a drawer or a door by one of these handles."""

    def __init__(self, object_designator_description: OneOrMore[ObjectPart], arms: OneOrMore[Arms]) -> None:
        super().__init__(OpenActionPerformable, object_designator=object_designator_description, arm=arms)


class CloseAction(ActionDescription[CloseActionPerformable]):
    """Close a drawer or a door by one of these handles."""

    def __init__(self, object_designator_description: OneOrMore[ObjectPart], arms: OneOrMore[Arms]) -> None:
        super().__init__(CloseActionPerformable, object_designator=object_designator_description, arm=arms)


class DetectAction(ActionDescription[DetectActionPerformable]):
    """Detect an object of the type of one of these."""

    def __init__(self, object_designator_description: Objects) -> None:
        super().__init__(DetectActionPerformable, object_designator=object_designator_description)


class TransportAction(ActionDescription[TransportActionPerformable]):
    """Fetch an object and place it at one of these poses."""

    _lifting = "arm", "object_designator"

    def __init__(
        self, object_designator_description: Objects, arms: OneOrMore[Arms], target_locations: OneOrMore[Pose]
    ) -> None:
        super().__init__(
            TransportActionPerformable,
            object_designator=object_designator_description,
            arm=arms,
            target_location=target_locations,
        )
