"""Descriptions with alternatives: the first of each, every combination, and none."""

from __future__ import annotations

import pytest

from pycrorm_async.plan import (
    CloseAction,
    CloseActionPerformable,
    DetectAction,
    DetectActionPerformable,
    GraspingAction,
    GraspingActionPerformable,
    GripAction,
    GripActionPerformable,
    LookAtAction,
    LookAtActionPerformable,
    MoveTorsoAction,
    MoveTorsoActionPerformable,
    NavigateAction,
    NavigateActionPerformable,
    ObjectDesignatorDescription,
    ObjectPart,
    OpenAction,
    OpenActionPerformable,
    ParkArmsAction,
    ParkArmsActionPerformable,
    PickUpAction,
    PickUpActionPerformable,
    PlaceAction,
    PlaceActionPerformable,
    ReleaseAction,
    ReleaseActionPerformable,
    ResolutionError,
    SetGripperAction,
    SetGripperActionPerformable,
    TransportAction,
    TransportActionPerformable,
)
from pycrorm_async.plan.failures import IllPosedGoalFailure, ObjectNotFound
from pycrorm_async.plan.objects import designator_of
from pycrorm_async.world import Arms, Grasp, GripperState, ObjectType, Pose
from tests.plan.conftest import Scene

HERE, THERE = Pose([0, 0, 0]), Pose([1, 0, 0])


def test_resolving_takes_the_first_of_each() -> None:
    assert NavigateAction([HERE, THERE]).resolve() == NavigateActionPerformable(HERE)
    assert NavigateAction(target_locations=iter([THERE])).resolve() == NavigateActionPerformable(THERE)
    assert MoveTorsoAction(positions=[0.3, 0.2]).resolve() == MoveTorsoActionPerformable(0.3)
    assert ParkArmsAction(arms=[Arms.BOTH]).resolve() == ParkArmsActionPerformable(Arms.BOTH)
    assert LookAtAction(targets=[THERE]).resolve() == LookAtActionPerformable(THERE)
    assert SetGripperAction(grippers=[Arms.LEFT], motions=[GripperState.OPEN]).resolve() == SetGripperActionPerformable(
        Arms.LEFT, GripperState.OPEN
    )


def test_one_value_needs_no_list(scene: Scene) -> None:
    assert ParkArmsAction(Arms.LEFT).resolve() == ParkArmsActionPerformable(Arms.LEFT)
    assert MoveTorsoAction(0.2).resolve() == MoveTorsoActionPerformable(0.2)
    assert NavigateAction(THERE).resolve() == NavigateActionPerformable(THERE)
    opening = SetGripperAction([Arms.LEFT, Arms.RIGHT], GripperState.OPEN)
    assert [each.gripper for each in opening] == [Arms.LEFT, Arms.RIGHT]
    assert TransportAction(scene.milk, Arms.LEFT, THERE).resolve() == TransportActionPerformable(
        scene.milk, Arms.LEFT, THERE
    )
    two = PickUpAction((each for each in (scene.milk, scene.cereal)), Arms.LEFT, Grasp.TOP)
    assert [each.object_designator for each in two] == [scene.milk, scene.cereal]


def test_a_value_that_is_no_alternative_is_refused_whole_and_by_name(scene: Scene) -> None:
    with pytest.raises(ResolutionError, match="wrong: arm: expected Arms, got str 'LEFT'"):
        ParkArmsAction("LEFT").resolve()  # type: ignore[arg-type]
    with pytest.raises(ResolutionError, match=r"missing: arm$"):
        ParkArmsAction(None).resolve()  # type: ignore[arg-type]
    with pytest.raises(ResolutionError, match=r"object_designator: .*, got str 'milk'"):
        PickUpAction("milk", [Arms.LEFT], [Grasp.FRONT]).resolve()  # type: ignore[arg-type]


def test_grasping_and_perceiving_actions_accept_objects_and_handles(scene: Scene) -> None:
    milk = ObjectDesignatorDescription(names=["milk"])
    meant = designator_of(scene.milk)
    handles = [ObjectPart(f"{name}_handle", scene.kitchen) for name in ("fridge_door", "sink_area_drawer")]
    both = [Arms.RIGHT, Arms.LEFT]
    assert GripAction(both, milk, [20.0, 5]).resolve() == GripActionPerformable(Arms.RIGHT, meant, 20.0)
    assert ReleaseAction(both, object_designator_description=scene.milk).resolve() == ReleaseActionPerformable(
        Arms.RIGHT, scene.milk
    )
    assert GraspingAction(arms=both, object_description=handles).resolve() == GraspingActionPerformable(
        Arms.RIGHT, handles[0]
    )
    assert OpenAction(handles, arms=both).resolve() == OpenActionPerformable(handles[0], Arms.RIGHT)
    assert CloseAction(handles[1], both).resolve() == CloseActionPerformable(handles[1], Arms.RIGHT)
    assert DetectAction(object_designator_description=milk).resolve() == DetectActionPerformable(meant)
    assert TransportAction(milk, both, target_locations=[THERE, HERE]).resolve() == TransportActionPerformable(
        meant, Arms.RIGHT, THERE
    )
    assert list(OpenAction(handles, both)) == [OpenActionPerformable(handle, arm) for handle in handles for arm in both]


def test_iterating_yields_every_combination_the_last_property_fastest() -> None:
    both = SetGripperAction([Arms.LEFT, Arms.RIGHT], [GripperState.OPEN, GripperState.CLOSE])
    expected = [
        SetGripperActionPerformable(Arms.LEFT, GripperState.OPEN),
        SetGripperActionPerformable(Arms.LEFT, GripperState.CLOSE),
        SetGripperActionPerformable(Arms.RIGHT, GripperState.OPEN),
        SetGripperActionPerformable(Arms.RIGHT, GripperState.CLOSE),
    ]
    assert list(both) == expected
    assert list(both) == expected


def test_objects_may_be_described_given_or_several(scene: Scene) -> None:
    milk, cereal = designator_of(scene.milk), designator_of(scene.cereal)
    described = ObjectDesignatorDescription(types=[ObjectType.MILK, ObjectType.BREAKFAST_CEREAL])
    front = PickUpActionPerformable(milk, Arms.LEFT, Grasp.FRONT)
    assert PickUpAction(described, [Arms.LEFT], [Grasp.FRONT]).resolve() == front
    assert PickUpAction(milk, [Arms.LEFT], [Grasp.FRONT]).resolve() == front
    assert PickUpAction(scene.milk, [Arms.LEFT], [Grasp.FRONT]).resolve().object_designator is scene.milk
    assert [each.object_designator for each in PickUpAction([cereal, milk], [Arms.LEFT], [Grasp.TOP])] == [cereal, milk]
    assert [
        (each.object_designator, each.target_location, each.arm)
        for each in PlaceAction(described, [HERE, THERE], [Arms.LEFT])
    ] == [(milk, HERE, Arms.LEFT), (milk, THERE, Arms.LEFT), (cereal, HERE, Arms.LEFT), (cereal, THERE, Arms.LEFT)]
    assert PlaceAction(described, target_locations=[HERE], arms=[Arms.LEFT]).resolve() == PlaceActionPerformable(
        milk, Arms.LEFT, HERE
    )


def test_objects_are_searched_when_the_description_is_resolved(scene: Scene) -> None:
    wanted = PickUpAction(ObjectDesignatorDescription(names=["milk"]), [Arms.LEFT], [Grasp.FRONT])
    assert len(list(wanted)) == 1
    scene.world.remove(scene.milk)
    with pytest.raises(ObjectNotFound, match="no object is named milk"):
        wanted.resolve()
    with pytest.raises(ObjectNotFound):
        next(iter(wanted))


def test_no_alternative_is_a_failure_that_names_the_property() -> None:
    with pytest.raises(IllPosedGoalFailure, match="SetGripperAction has no alternative for motion") as caught:
        SetGripperAction([Arms.LEFT], []).resolve()
    assert caught.value.data == ("motion",)
    with pytest.raises(IllPosedGoalFailure, match="NavigateAction has no alternative for target_location"):
        list(NavigateAction([]))
    with pytest.raises(IllPosedGoalFailure, match="PickUpAction has no alternative for object_designator"):
        PickUpAction([], [Arms.LEFT], [Grasp.FRONT]).resolve()
