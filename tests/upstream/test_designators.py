"""The actions of PyCRAM have the SOMA concepts that its tests of July 2024 name."""

from __future__ import annotations

import pytest

from pycrorm_async import plan


@pytest.mark.parametrize(
    ("action", "concept"),
    [
        (plan.MoveTorsoActionPerformable, "MoveTorso"),
        (plan.SetGripperActionPerformable, "SettingGripper"),
        (plan.ReleaseActionPerformable, "Releasing"),
        (plan.GripActionPerformable, "Holding"),
        (plan.ParkArmsActionPerformable, "ParkingArms"),
        (plan.NavigateActionPerformable, "Navigating"),
        (plan.PickUpActionPerformable, "PickingUp"),
        (plan.PlaceActionPerformable, "Placing"),
        (plan.LookAtActionPerformable, "LookingAt"),
        (plan.DetectActionPerformable, "LookingFor"),
        (plan.OpenActionPerformable, "Opening"),
        (plan.CloseActionPerformable, "Closing"),
        (plan.TransportActionPerformable, "Transporting"),
        (plan.GraspingActionPerformable, "Grasping"),
    ],
)
def test_each_action_has_its_concept(action: type[plan.ActionAbstract], concept: str) -> None:
    assert action.concept == concept
