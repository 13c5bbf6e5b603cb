"""The score of a way to pick an object up, and the present situation of the object."""

from __future__ import annotations

import math
from dataclasses import dataclass

import numpy as np
import pytest

from pycrorm_async import Memory
from pycrorm_async.errors import CallerError
from pycrorm_async.events.ids import row_id
from pycrorm_async.plan import ActionAbstract, PickUpAction, PlanFailure, simulated_robot
from pycrorm_async.plan.objects import ObjectDesignator, ObjectDesignatorDescription
from pycrorm_async.plan.task import PastSuccess
from pycrorm_async.recall.blocks import CaseBlock, CaseLibrary
from pycrorm_async.recall.columns import Case
from pycrorm_async.recall.experience import TRIES_MAX, Tries, best_first, tries_of
from pycrorm_async.recall.prediction import present_situation
from pycrorm_async.recall.recall import Recall
from pycrorm_async.world import BulletWorld, Object, Pose
from pycrorm_async.world.pose import Arms, Grasp, ObjectType

# === past pick ups ============================================================================================
#
# The score of a way to pick an object up: what counts, how much, and the order of the ways.

OFF = math.exp(-1 / 2)
"""The likeness of a try that is 0.1 m off."""


def tried(
    number: int, x: float = -0.7, *, status: str = "SUCCEEDED", type_: str = "PickUpAction", height: float = 0.9,
    torso: float | None = 0.0, arm: Arms = Arms.LEFT, object_type: str = "MILK", simulated: bool = False,
    **numbers: float,
) -> Case:  # fmt: skip
    """A pick-up that started as the `number`-th, of an object at this height over the base."""
    symbols = {"arm": arm.name, "grasp": "FRONT", "object_type": object_type}
    place = {"stand_x": x, "stand_y": 0.0, "stand_yaw": 0.0, "object_z": height} | numbers
    if torso is not None:
        place |= {"torso": torso, "height": height - torso}
    return Case(row_id(1, number, 0), number, type_, symbols, place, status, simulated=simulated)


def tries(*cases: Case, arm: Arms | None = None) -> Tries:
    library = CaseLibrary([CaseBlock.of(cases)] if cases else [])
    return tries_of(library, ["PickUpAction", "CarefulPickUpAction"], ObjectType.MILK, arm)


def found(*ways: PastSuccess) -> list[tuple[float, float]]:
    return [(round(each.stand.position.x, 6), round(each.score, 6)) for each in ways]


def test_a_score_counts_each_try_by_its_likeness_and_the_share_of_all_successes_as_one_try() -> None:
    known = tries(
        tried(1),
        tried(2, status="FAILED"),
        tried(3, -0.8, status="FAILED"),  # 0.1 m off
        tried(4, height=1.0, status="FAILED"),  # 0.1 m higher
        tried(5, height=1.0, torso=0.1, status="FAILED"),  # higher, with the torso as much higher
        tried(6, arm=Arms.RIGHT, status="FAILED"),  # another arm
    )
    (way,) = best_first(known)
    prior = (1 + 1) / (6 + 2)
    assert way.prior == pytest.approx(prior)
    assert way.evidence == pytest.approx(3 + 2 * OFF)
    assert way.score == pytest.approx((1 + prior) / (3 + 2 * OFF + 1))
    assert (way.arm, way.grasp, way.torso_height, way.times) == (Arms.LEFT, Grasp.FRONT, 0.0, 1)
    assert way.stand.position == pytest.approx((-0.7, 0.0, -0.9))


def test_ways_are_scored_for_the_height_that_is_asked_and_not_for_their_own() -> None:
    low, high = tried(1, -0.7, height=0.6), tried(2, -0.5, height=1.2)
    known = tries(low, high, tried(3, -0.7, height=1.2, status="FAILED"), tried(4, -0.5, height=0.6, status="FAILED"))
    assert [x for x, _ in found(*best_first(known, height=0.65))] == [-0.7, -0.5]
    assert [x for x, _ in found(*best_first(known, height=1.15))] == [-0.5, -0.7]
    far = best_first(known, height=3.0)
    assert [each.score for each in far] == pytest.approx([0.5, 0.5])  # nothing is known: the prior
    assert [each.evidence for each in far] == pytest.approx([0.0, 0.0])


def test_a_given_torso_height_counts_instead_of_that_of_the_way() -> None:
    known = tries(tried(1, height=0.9, torso=0.3), tried(2, -0.5, height=0.9, torso=0.0))
    # With the torso at 0.3 m an object at 0.9 m is where one at 0.6 m is for a torso at 0.
    assert [x for x, _ in found(*best_first(known, height=0.6, torso=0.0))] == [-0.7, -0.5]
    assert [x for x, _ in found(*best_first(known, height=1.2, torso=0.3))] == [-0.5, -0.7]


def test_equal_scores_are_ordered_by_successes_and_then_the_latest_first() -> None:
    known = tries(tried(1, 1.0), tried(2, 2.0), tried(3, 2.0), tried(4, 3.0), tried(5, 3.0, status="FAILED"))
    assert [(each.stand.position.x, each.times) for each in best_first(known)] == [(2.0, 2), (1.0, 1), (3.0, 1)]
    alike = tries(tried(1, 1.0), tried(2, 2.0), tried(3, 3.0))
    assert [each.stand.position.x for each in best_first(alike)] == [3.0, 2.0, 1.0]


def test_other_objects_other_arms_simulations_and_unfinished_tries_do_not_count() -> None:
    cases = [
        tried(1),
        tried(2, type_="CarefulPickUpAction"),
        tried(3, arm=Arms.RIGHT),
        tried(4, object_type="BOWL"),
        tried(5, type_="PlaceAction"),
        tried(6, simulated=True),
        tried(7, stand_x=math.nan),  # beside an object that lay on its side
        tried(8)._replace(symbols={"arm": "UPPER", "grasp": "FRONT", "object_type": "MILK"}),
        tried(9)._replace(symbols={"arm": "LEFT", "grasp": "PINCH", "object_type": "MILK"}),
        *(tried(10 + number, status=status) for number, status in enumerate(("CANCELLED", "ERROR", "LOST"))),
    ]
    assert [round(each.stand.position.x, 3) for each in best_first(tries(*cases))] == [-0.7, -0.7]
    assert tries(*cases).succeeded.size == 3
    assert tries(*cases, arm=Arms.RIGHT).succeeded.tolist() == [True]
    assert best_first(tries()) == []
    assert best_first(tries(tried(1, status="FAILED"))) == []


def test_a_robot_without_a_torso_has_the_height_of_the_object_in_the_map() -> None:
    (way,) = best_first(tries(tried(1, torso=None)), height=0.9)
    assert way.torso_height is None
    assert way.evidence == pytest.approx(1.0)


def test_the_latest_tries_of_all_blocks_are_taken() -> None:
    blocks = [CaseBlock.of([tried(number, -1 - number / 1e4)]) for number in range(1, 4)]
    many = CaseBlock.of(tried(number, status="FAILED") for number in range(4, 4 + TRIES_MAX - 2))
    known = tries_of(CaseLibrary([*blocks, many]), ["PickUpAction"], ObjectType.MILK, None)
    assert known.succeeded.size == TRIES_MAX
    assert np.flatnonzero(known.succeeded).size == 2
    assert [round(each.stand.position.x, 4) for each in best_first(known)] == [-1.0003, -1.0002]


# === present situation ========================================================================================
#
# The present situation of an object has the features that the case of an action has which starts now.


@dataclass
class InspectActionPerformable(ActionAbstract):
    """Fails where the object is far."""

    item: ObjectDesignator
    slowly: bool = True

    async def perform(self) -> None:
        if self.item.pose.position.x > 1.5:
            raise PlanFailure("it is too far")


async def inspect(milk: Object) -> None:
    designator = ObjectDesignatorDescription(names=[milk.name]).resolve()
    try:
        await InspectActionPerformable(designator).perform()
    except PlanFailure:
        return


async def test_an_action_with_an_object_is_recalled_before_it_is_stored_as_it_is_afterwards() -> None:
    async with Memory.open("sqlite://") as memory:
        with BulletWorld(), simulated_robot:
            milk = Object("milk", ObjectType.MILK, pose=Pose([2.0, 0.5, 0.9]))
            Object("bowl", ObjectType.BOWL, pose=Pose([2.1, 0.4, 0.9]))
            async with memory.episode():
                assert list(await memory.recall(InspectActionPerformable)) == []
                await inspect(milk)
                [found] = await memory.recall(InspectActionPerformable)
                assert (found.status, found.symbols["near"]) == ("FAILED", ("BOWL",))
        await memory.flush()
        [stored] = await Recall.of(memory.reading)(InspectActionPerformable)
        assert found.case._replace(started_us=0, duration_s=0) == stored.case._replace(started_us=0, duration_s=0)


@pytest.mark.slow
async def test_the_present_has_the_features_of_the_case_that_starts_now() -> None:
    async with Memory.open("sqlite://") as memory:
        with BulletWorld(), simulated_robot:
            robot = Object("pr2", ObjectType.ROBOT, pose=Pose([0.2, 0.1, 0], [0, 0, 0.6, 0.8]))
            milk = Object("milk", ObjectType.MILK, pose=Pose([1, 0.5, 0.9]))
            Object("bowl", ObjectType.BOWL, pose=Pose([1.1, 0.4, 0.9]))
            spoon = Object("spoon", ObjectType.SPOON, pose=Pose([0.5, 0.1, 0.9]))
            robot.attach(spoon, "l_gripper_tool_frame")
            async with memory.episode():
                symbols, numbers = present_situation(milk, InspectActionPerformable)
                await inspect(milk)
                [found] = await memory.recall(InspectActionPerformable)
                assert {**symbols, "slowly": "True"} == found.symbols
                assert symbols["near"] == ("BOWL",)
                assert symbols["held"] == ("SPOON",)
                assert numbers == pytest.approx(dict(found.numbers), abs=1e-6)
                assert {"stand_x", "stand_yaw", "object_z", "torso"} <= numbers.keys()

                assert (
                    present_situation(milk, PickUpAction)
                    == present_situation(milk, "PickUpAction")
                    == (symbols, numbers)
                )

                milk.set_pose(Pose([2.0, 0.5, 0.9]))
                await inspect(milk)
                await inspect(milk)
                answer = await memory.recall.similar_to_now(milk, InspectActionPerformable)
                assert [each.status for each in answer] == ["FAILED", "FAILED", "SUCCEEDED"]
                assert answer[0].score > answer[2].score
                assert "object_name" not in dict(answer.cue.has)
                slow = await memory.recall.similar_to_now(milk, InspectActionPerformable, has={"slowly": False}, k=1)
                assert slow.never_seen == (("slowly", "False"),)
                assert len(slow) == 1
            milk.remove()
            with pytest.raises(CallerError, match="is not an object in a world"):
                await memory.recall.similar_to_now(milk, InspectActionPerformable)
            with pytest.raises(CallerError, match="is not a designator class"):
                await memory.recall.similar_to_now(robot, int)
