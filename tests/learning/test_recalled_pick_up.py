"""RecalledPickUp: ways of earlier tries by expected success, then the samples of a policy."""

from __future__ import annotations

import inspect
from collections.abc import Iterator, Sequence
from dataclasses import replace
from pathlib import Path

import msgspec
import numpy as np
import pytest
from sqlalchemy import select

from pycrorm_async import Memory
from pycrorm_async.errors import CallerError
from pycrorm_async.learning import Evidence, RecalledPickUp, RecalledPickUpPerformable, Scene, default_policy, name_of
from pycrorm_async.learning.policy import Linear
from pycrorm_async.learning.rollouts import Stage
from pycrorm_async.orm import Action
from pycrorm_async.plan import Retry, Sequential
from pycrorm_async.plan.failures import NotResolved, ObjectUnreachable, PlanFailure
from pycrorm_async.plan.task import PastSuccess
from pycrorm_async.world import Arms, Grasp, Object, ObjectType, Pose
from pycrorm_async.world.models import box_urdf


def way(
    x: float, y: float = 0.0, *, arm: Arms = Arms.LEFT, grasp: Grasp = Grasp.FRONT, score: float = 0.9,
    evidence: float = 1.0, prior: float = 0.2,
) -> PastSuccess:  # fmt: skip
    return PastSuccess(arm, grasp, 0.0, Pose([x, y, -0.9]), score, 1, evidence, prior)


class Known:
    """An experience with one answer for each time it is asked; the last answer stays."""

    def __init__(self, *answers: Sequence[PastSuccess]) -> None:
        self.answers = list(answers)
        self.asked: list[tuple[ObjectType, Arms | None, float | None, float | None]] = []

    async def successes(
        self, object_type: ObjectType, *, arm: Arms | None, height: float | None = None, torso: float | None = None
    ) -> Sequence[PastSuccess]:
        self.asked.append((object_type, arm, height, torso))
        return self.answers.pop(0) if len(self.answers) > 1 else self.answers[0]


@pytest.fixture
def stage() -> Iterator[Stage]:
    with Scene().entered() as there:
        yield there


def recalled(stage: Stage, experience: Known, **options: object) -> RecalledPickUp:
    return RecalledPickUp(stage.target, experience=experience, rng=np.random.default_rng(1), **options)  # type: ignore[arg-type]


async def alternatives(description: RecalledPickUp) -> list[RecalledPickUpPerformable]:
    return [each async for each in description]


def offset(stage: Stage, action: RecalledPickUpPerformable) -> tuple[float, float]:
    x, y, _ = action.standing_position.relative_to(stage.target.pose).position
    return round(x, 3), round(y, 3)


async def test_ways_come_with_the_best_first_and_the_samples_of_the_policy_follow(stage: Stage) -> None:
    known = Known([way(-0.7), way(-0.6, 0.1, arm=Arms.RIGHT, grasp=Grasp.TOP, score=0.5)])
    first, second, *others = await alternatives(recalled(stage, known, samples=5))
    assert (offset(stage, first), first.arm, first.grasp) == ((-0.7, 0.0), Arms.LEFT, Grasp.FRONT)
    assert (first.chosen_by, first.expected_success) == ("recall", 0.9)
    assert (offset(stage, second), second.arm, second.grasp) == ((-0.6, 0.1), Arms.RIGHT, Grasp.TOP)
    assert [(each.chosen_by, each.expected_success) for each in others] == [("default policy", None)] * 5
    # It is asked again before each alternative, for this object at its height over the base.
    assert [each[:2] for each in known.asked] == [(ObjectType.MILK, None)] * 3
    assert [each[2:] for each in known.asked] == [pytest.approx((0.9, 0.0))] * 3


async def test_a_failure_changes_what_comes_next(stage: Stage) -> None:
    near, far = way(-0.7), way(0.6, score=0.4)
    known = Known([near, way(-0.71, score=0.85), far], [far, way(-0.71, score=0.3), way(-0.7, score=0.1)])
    first, second, third, *others = await alternatives(recalled(stage, known, samples=1))
    assert [offset(stage, each)[0] for each in (first, second, third)] == [-0.7, 0.6, -0.71]
    assert [each.chosen_by for each in others] == ["default policy"]  # the first way, tried already, is not repeated


async def test_what_is_expected_to_be_worse_than_an_average_try_is_left_to_the_policy(stage: Stage) -> None:
    poor, unknown = way(-0.7, score=0.19), way(-0.6, score=0.2, evidence=0.4)
    found = await alternatives(recalled(stage, Known([poor, unknown]), samples=2))
    assert [each.chosen_by for each in found] == ["default policy"] * 2


async def test_a_learned_policy_comes_before_the_default_policy_and_may_lack_the_height(stage: Stage) -> None:
    learned = default_policy().condition(Evidence(arms=frozenset({Arms.LEFT})))
    found = await alternatives(recalled(stage, Known([]), policy=learned, samples=2))
    assert [each.chosen_by for each in found] == [name_of(learned)] * 2 + ["default policy"] * 2
    at = Linear((0.1, 0.2), (0.0, 1.0))
    elsewhere = replace(learned, leaves=tuple(msgspec.structs.replace(each, height=at) for each in learned.leaves))
    found = await alternatives(recalled(stage, Known([]), policy=elsewhere, samples=2))
    assert [each.chosen_by for each in found] == ["default policy"] * 2


async def test_only_allowed_arms_and_grasps_and_free_places_are_used(stage: Stage) -> None:
    ways = [way(-0.7), way(-0.7, arm=Arms.RIGHT), way(-0.7, arm=Arms.RIGHT, grasp=Grasp.TOP)]
    known = Known(ways)
    description = recalled(stage, known, arms=[Arms.RIGHT], grasps=[Grasp.TOP], samples=1)
    first, other = await alternatives(description)
    assert (first.arm, first.grasp, first.chosen_by) == (Arms.RIGHT, Grasp.TOP, "recall")
    assert (other.arm, other.grasp, other.chosen_by) == (Arms.RIGHT, Grasp.TOP, "default policy")
    assert {arm for _, arm, _, _ in known.asked} == {Arms.RIGHT}
    Object("crate", ObjectType.GENERIC_OBJECT, box_urdf("crate", x=(-0.2, 0.2), y=(-0.2, 0.2), z=(0, 0.5)),
           Pose([0.6, 1.0, 0]))  # fmt: skip
    blocked = await alternatives(recalled(stage, Known(ways), samples=1))
    assert [each.chosen_by for each in blocked] == ["default policy"]


async def test_it_is_performed_in_expressions_and_resolved(stage: Stage) -> None:
    done = await Retry(recalled(stage, Known([way(0.0, 0.9), way(-0.6)])), max_tries=2).perform()
    assert done is None
    assert stage.robot.pose.position.x == pytest.approx(0.7)
    stage.reset()
    await Sequential(recalled(stage, Known([way(-0.6)]))).perform()
    stage.reset()
    resolved = await recalled(stage, Known([way(-0.6)])).resolve()
    await resolved.perform()
    stage.reset()
    with pytest.raises(PlanFailure) as raised:
        await Retry(recalled(stage, Known([way(0.0, 1.9), way(1.9)])), max_tries=2).perform()
    assert [note[:6] for note in raised.value.__notes__] == ["try 1:"]


async def test_an_object_that_lies_and_a_wrong_use_are_refused(stage: Stage) -> None:
    description = recalled(stage, Known([way(-0.6)]))
    with pytest.raises(CallerError, match="iterate with `async for`"):
        list(description)
    with pytest.raises(NotResolved):
        _ = description.perform  # type: ignore[attr-defined]
    stage.target.set_pose(Pose([1.3, 1, 0.9], [0.7071, 0, 0, 0.7071]))
    with pytest.raises(ObjectUnreachable, match="lies on its side"):
        await recalled(stage, Known([way(-0.6)])).resolve()
    assert not inspect.iscoroutinefunction(description.__aiter__)


@pytest.mark.slow
async def test_a_node_records_what_chose_it_and_is_found_as_the_action_that_it_is(stage: Stage, tmp_path: Path) -> None:
    async with Memory.open(f"sqlite:///{tmp_path}/memory.db") as memory:
        async with memory.episode(description="recalling"):
            await Retry(recalled(stage, Known([way(0.0, 1.9), way(-0.6)])), max_tries=2).perform()
        await memory.flush()
        async with memory.session() as session:
            mapped = memory.mapped("MoveAndPickUpAction")
            nodes = (await session.scalars(select(mapped).order_by(mapped.sequence))).all()
            assert [(each.dtype, each.chosen_by, each.expected_success) for each in nodes] == [
                ("RecalledPickUpAction", "recall", 0.9)
            ] * 2
            assert len((await session.scalars(select(Action).where(Action.dtype == "RecalledPickUpAction"))).all()) == 2
