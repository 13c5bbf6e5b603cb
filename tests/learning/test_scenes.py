"""Scenes that vary and disturb: the same for the same seed and index, and apart from the choices of a policy."""

from __future__ import annotations

import math
from collections.abc import Sequence
from contextlib import suppress
from dataclasses import replace
from typing import Any

import numpy as np
import pytest

from pycrorm_async.errors import CallerError
from pycrorm_async.learning import Disturbance, MoveAndPickUp, PickUpChoice, Scene, Stage, Tally, batch_rollout
from pycrorm_async.plan import MoveAndPickUpPerformable, PlanFailure
from pycrorm_async.plan.task import collected_tree
from pycrorm_async.world import Arms, Grasp, ObjectType

TABLES = Scene(
    heights=(0.6, 1.1), turned=True, others=(ObjectType.BREAKFAST_CEREAL,), table=True, collisions=True,
    torso_height=0.2, disturbance=Disturbance(base_m=0.02, base_rad=0.03, object_m=0.005, object_rad=0.05, slip=0.01),
)  # fmt: skip
REACHED = PickUpChoice(Arms.LEFT, Grasp.FRONT, -0.6, 0.0)
"""From here the arm reaches the milk of the thesis' scene."""


async def ends_of(scene: Scene, pieces: Sequence[tuple[int, int]]) -> dict[int, Any]:
    """Return for each index the place, the object with its pose, and how the rollout ended."""
    ends: dict[int, Any] = {}
    for first, count in pieces:
        with scene.entered() as stage, collected_tree() as tree:
            await batch_rollout(
                MoveAndPickUp(stage.target), count, seed=69, first=first, reset=stage.reset, prepare=stage.prepare,
                report_progress=lambda tally: None,
            )  # fmt: skip
            tried = [each for each in tree if isinstance(each.designator, MoveAndPickUpPerformable)]
        for index, node in enumerate(tried, first):
            action = node.designator
            assert isinstance(action, MoveAndPickUpPerformable)
            ends[index] = (action.standing_position, action.object_designator.name, str(node.failure))
    return ends


@pytest.mark.slow
async def test_seed_and_index_determine_table_object_and_errors_in_any_world() -> None:
    whole = await ends_of(TABLES, [(0, 60)])
    assert await ends_of(TABLES, [(40, 20), (0, 15), (15, 25)]) == whole
    assert {name for _, name, _ in whole.values()} == {"milk", "breakfast_cereal"}
    kinds = " ".join(failure for _, _, failure in whole.values())
    assert "base would be in table" in kinds


@pytest.mark.slow
async def test_disturbing_the_robot_changes_no_choice_of_the_policy() -> None:
    calm = await ends_of(replace(TABLES, disturbance=Disturbance()), [(0, 30)])
    disturbed = await ends_of(TABLES, [(0, 30)])
    assert [each[:2] for each in calm.values()] == [each[:2] for each in disturbed.values()]
    assert calm != disturbed


async def test_what_varies_stays_within_its_limits_and_on_the_table() -> None:
    with TABLES.entered() as stage:
        drawn = []
        for index in range(40):
            stage.reset()
            target = stage.prepare(3, index)
            table = stage.world.object("table")
            across, along, top = target.pose.relative_to(table.pose).position
            drawn.append((target.pose.position.z, target.pose.yaw, across, along))
            assert target.bounding_box().min.z == pytest.approx(table.pose.position.z)
            assert top > 0
    heights, headings, across_, along_ = np.array(drawn).T
    assert 0.6 <= heights.min() < 0.7
    assert 1.0 < heights.max() <= 1.1
    assert np.ptp(headings) > 5
    assert -0.2701 <= across_.min() < -0.25  # the edge is 0.35 m from the middle
    assert -0.12 < across_.max() <= -0.0999
    assert np.abs(along_).max() <= 0.4


async def outcomes(stage: Stage, choice: PickUpChoice, count: int) -> Tally:
    tally = Tally()
    for index in range(count):
        stage.reset()
        target = stage.prepare(7, index)
        try:
            await MoveAndPickUp(target).chosen(choice).perform()
        except PlanFailure as failure:
            tally.failures[type(failure).__name__] += 1
        else:
            tally.successes += 1
    return tally


@pytest.mark.slow
async def test_an_object_off_its_place_is_hit_by_a_finger_or_missed_as_often_as_its_clearance_says() -> None:
    """The milk is 6.6 cm wide and the gripper opens 8.6 cm: it fits within 1 cm, with a chance of 68.3 % at 1 cm."""
    for object_m, expected in ((0.01, 0.683), (0.02, 0.383)):
        with Scene(disturbance=Disturbance(object_m=object_m)).entered() as stage:
            tally = await outcomes(stage, REACHED, 200)
        assert tally.success_rate == pytest.approx(expected, abs=0.08)
        assert tally.failures.keys() <= {"ManipulationGoalNotReached", "GripperClosedCompletely"}
    with Scene(disturbance=Disturbance(object_m=0.3)).entered() as stage:
        assert (await outcomes(stage, REACHED, 50)).failures["GripperClosedCompletely"] > 35


async def test_an_object_wider_than_the_gripper_is_never_picked_up() -> None:
    bowl = Scene(name="bowl", object_type=ObjectType.BOWL)
    with bowl.entered() as stage:
        assert (await outcomes(stage, REACHED, 1)).successes == 1  # without the check
    with replace(bowl, disturbance=Disturbance(object_m=0.001)).entered() as stage:
        assert await outcomes(stage, REACHED, 20) == Tally(0, {"ManipulationGoalNotReached": 20})  # type: ignore[arg-type]


@pytest.mark.slow
async def test_an_object_slips_as_often_as_told_and_is_not_held_then() -> None:
    with Scene(disturbance=Disturbance(slip=0.3)).entered() as stage:
        tally = await outcomes(stage, REACHED, 100)
        assert tally.failures["ObjectLost"] == pytest.approx(30, abs=12)
        assert tally.rollouts == tally.successes + tally.failures["ObjectLost"]
    with Scene(disturbance=Disturbance(slip=1)).entered() as stage:
        stage.prepare(7, 0)
        with pytest.raises(PlanFailure, match="milk slipped from the LEFT gripper"):
            await MoveAndPickUp(stage.target).chosen(REACHED).perform()
        assert not stage.robot.attachments
        assert stage.target.pose.position == (1.3, 1.0, 0.9)


@pytest.mark.slow
async def test_a_base_that_misses_its_place_is_where_its_errors_say_and_turns_without_moving() -> None:
    with Scene(disturbance=Disturbance(base_m=0.02, base_rad=0.03)).entered() as stage:
        places = []
        for index in range(120):
            stage.reset()
            action = MoveAndPickUp(stage.prepare(7, index)).chosen(REACHED)
            before = action.standing_position.position
            with suppress(PlanFailure):
                await action.perform()
            here = stage.robot.pose
            places.append((here.position.x - before.x, here.position.y - before.y, here.yaw))
    x, y, heading = np.array(places).T
    assert np.std(x) == pytest.approx(0.02, rel=0.2)
    assert np.std(y) == pytest.approx(0.02, rel=0.2)
    assert np.std(heading) > 0.03  # it faces the object from where it has landed
    assert abs(np.mean(x)) < 0.005


def test_a_scene_without_variation_keeps_its_description_and_any_other_adds_to_it() -> None:
    assert str(Scene()) == "milk at 1.3, 1, 0.9 m, torso at 0 m, soft limits"
    assert not Scene().varies
    variants = [
        Scene(heights=(0.6, 1.2)), Scene(turned=True), Scene(table=True), Scene(parked=True), TABLES,
        Scene(others=(ObjectType.BREAKFAST_CEREAL,)), Scene(disturbance=Disturbance(base_m=0.02)),
        Scene(disturbance=Disturbance(object_m=0.02)), Scene(disturbance=Disturbance(slip=0.02)),
    ]  # fmt: skip
    assert len({str(Scene()), *map(str, variants)}) == len(variants) + 1


@pytest.mark.parametrize("wrong", [{"base_m": -0.1}, {"slip": 1.5}, {"object_rad": float("nan")}])
def test_an_impossible_disturbance_is_refused(wrong: dict[str, float]) -> None:
    with pytest.raises(CallerError, match=f"{next(iter(wrong))} of a disturbance must be"):
        Disturbance(**wrong)


def test_an_impossible_scene_is_refused() -> None:
    with pytest.raises(CallerError, match="heights of a scene are an interval"):
        Scene(heights=(1.2, 0.6))
    with pytest.raises(CallerError, match="a table or the kitchen, not both"):
        Scene(table=True, kitchen=True)


def test_a_robot_arrives_facing_the_object_where_collisions_count() -> None:
    for collisions, ahead in ((True, -1.0), (False, 1.0)):
        with Scene(collisions=collisions).entered() as stage:
            there = MoveAndPickUp(stage.target).chosen(PickUpChoice(Arms.LEFT, Grasp.FRONT, 0.6, 0.0))
            assert math.cos(there.standing_position.yaw) == pytest.approx(ahead)
