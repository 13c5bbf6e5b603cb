"""Define the descriptions of the built-in actions; `actions.action_description` defines what they have in common."""

from __future__ import annotations

from collections.abc import Iterable
from typing import TypeAlias, TypeVar

from pycrorm_async.plan.actions.action_description import ActionDescription
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
from pycrorm_async.plan.object_designators import ObjectDesignatorDescription, ObjectLike, ObjectPart
from pycrorm_async.world.enums import Arms, Grasp, GripperState
from pycrorm_async.world.pose import Pose

T = TypeVar("T")

OneOrMore: TypeAlias = T | Iterable[T]
Objects: TypeAlias = ObjectDesignatorDescription | OneOrMore[ObjectLike]


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
