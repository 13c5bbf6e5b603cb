"""Define an action that does nothing, with the parameters of picking up."""

from __future__ import annotations

from pycrorm_async.plan import PickUpActionPerformable
from pycrorm_async.plan.objects import designator_of
from pycrorm_async.world import Arms, Grasp, Object, ObjectType, Pose


class NothingActionPerformable(PickUpActionPerformable):
    """An action with the parameters of picking up that does nothing."""

    async def perform(self) -> None:
        return


def nothing_action() -> NothingActionPerformable:
    """Create the action in the current world, with a robot and a milk."""
    Object("pr2", ObjectType.ROBOT)
    milk = Object("milk", ObjectType.MILK, pose=Pose([1.3, 1.0, 0.9]))
    return NothingActionPerformable(designator_of(milk), Arms.LEFT, Grasp.FRONT)
