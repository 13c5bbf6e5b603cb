"""`memory.predict` is the share of successes among the tries like the action; `memory.advising` acts on it."""

from __future__ import annotations

import asyncio
import logging
import math
from collections.abc import Iterator, Sequence
from contextlib import suppress
from dataclasses import dataclass, replace
from pathlib import Path
from typing import Any

import pytest
from sqlalchemy import select

from bench import advised
from pycrorm_async import Memory
from pycrorm_async.errors import CallerError
from pycrorm_async.events.ids import row_id
from pycrorm_async.learning import Disturbance, MoveAndPickUp, Policy, Scene, batch_rollout
from pycrorm_async.learning.move_and_pick_up import PredictedPickUpPerformable
from pycrorm_async.learning.policy import Leaf, Linear
from pycrorm_async.orm import Observation, ObservationValue, TaskTreeNode
from pycrorm_async.plan import ActionAbstract, ActionDescription, PlanFailure, Retry, collected_tree, simulated_robot
from pycrorm_async.plan.actions import MoveAndPickUpPerformable, NavigateActionPerformable, PickUpAction
from pycrorm_async.plan.failures import RefusedByPrediction
from pycrorm_async.query.success import interval_95
from pycrorm_async.recall import prediction
from pycrorm_async.recall.blocks import CaseBlock, CaseLibrary
from pycrorm_async.recall.cases import FeatureFields
from pycrorm_async.recall.columns import Case
from pycrorm_async.recall.prediction import MemoryAdviser, Prediction, Situation, compared, predict
from pycrorm_async.recall.search import Wanted
from pycrorm_async.world import Arms, BulletWorld, Object, ObjectType, Pose
from pycrorm_async.world.pose import Grasp
from pycrorm_async.world.urdf import Limits
from tests.databases import Server, put_memory
from tests.recall.sliding_grips import GripSlidingActionPerformable, SlipperyFailure, grip

OFF = math.exp(-1 / 2)
"""The likeness of a try that is off by one tolerance."""
LEFT = {"arm": "LEFT", "object_type": "MILK"}


def tried(number: int, x: float, status: str = "SUCCEEDED", reason: str | None = None, **words: str) -> Case:
    numbers = {"stand_x": x, "stand_yaw": 3.1, "height": 0.9, "torso": 0.1}
    return Case(row_id(1, number, 0), number, "PickUpAction", {**LEFT, **words}, numbers, status, reason)


def predicted(situation: Situation, *cases: Case) -> Prediction:
    [result] = predict(CaseLibrary([CaseBlock.of(cases)] if cases else []), [situation])
    return result


# === the figure ===============================================================================================


def test_a_prediction_counts_tries_by_their_likeness_and_the_share_of_all_as_one_try() -> None:
    situation = Situation("PickUpAction", LEFT, [Wanted("stand_x", -0.7, 0.1)])
    result = predicted(
        situation,
        tried(1, -0.7),
        tried(2, -0.8, "FAILED", "IKError"),  # one tolerance off
        tried(3, -0.7, "FAILED", "ObjectLost", arm="RIGHT"),  # another arm: counts for the prior only
        tried(4, -0.7, "FAILED", "IKError", object_type="BOWL"),
        tried(5, -0.7, "INTERRUPTED"),
        tried(6, -0.7, "FAILED", "RefusedByPrediction"),  # was not tried
        tried(7, -0.7)._replace(simulated=True),
    )
    prior = (1 + 1) / (3 + 2)
    assert result.chance == pytest.approx((1 + prior) / (1 + OFF + 1))
    assert (result.low, result.high) == pytest.approx(interval_95(1, 1 + OFF))
    assert result.tries == pytest.approx(1 + OFF)
    assert result.cases == (row_id(1, 1, 0), row_id(1, 2, 0))
    assert (result.reason, result.source, result.is_known) == ("IKError", "recall", True)
    assert str(result).endswith("from 1.6 tries like it; if it fails, most likely by IKError")


def test_what_was_never_tried_is_not_known_and_has_an_interval_from_0_to_1() -> None:
    situation = Situation("PickUpAction", LEFT, [Wanted("stand_x", 0.5, 0.1)])
    far = predicted(situation, tried(1, -0.7), tried(2, -0.7))
    assert (far.chance, far.low, far.high, far.cases, far.reason) == (0.75, 0.0, 1.0, (), None)
    assert not far.is_known
    assert str(far) == "not known: 0.0 tries like it are not enough"
    nothing = predicted(situation)
    assert (nothing.chance, nothing.low, nothing.high, nothing.tries) == (0.5, 0.0, 1.0, 0.0)


def test_the_prediction_of_a_model_is_the_prior_and_counts_as_one_try() -> None:
    situation = Situation("PickUpAction", LEFT, [Wanted("stand_x", -0.7, 0.1)], expected=0.9, model="abc")
    alone = predicted(situation)
    assert (alone.chance, alone.tries, alone.source, alone.is_known) == (0.9, 0.0, "abc", True)
    assert (alone.low, alone.high) == interval_95(0.9, 1)
    failed = predicted(situation, tried(1, -0.7, "FAILED", "IKError"), tried(2, -0.7, "FAILED", "IKError"))
    assert failed.chance == pytest.approx(0.9 / 3)
    assert (failed.low, failed.high) == pytest.approx(interval_95(0.9, 3))
    assert str(failed).endswith("from 2.0 tries like it and the model abc; if it fails, most likely by IKError")


def test_angles_are_compared_round_the_circle_and_a_try_without_a_number_counts_nothing() -> None:
    turned = predicted(Situation("PickUpAction", LEFT, [Wanted("stand_yaw", -3.1)]), tried(1, -0.7))
    assert turned.tries == pytest.approx(math.exp(-(((2 * math.pi - 6.2) / 0.5) ** 2) / 2), abs=1e-6)
    assert predicted(Situation("PickUpAction", LEFT, [Wanted("weight", 1.0, 0.1)]), tried(1, -0.7)).tries == 0.0


def test_the_height_of_a_goal_is_compared_over_the_torso() -> None:
    fields = FeatureFields("PlaceAction", (), (), (("goal", ("goal_x", "goal_y", "goal_z", "goal_yaw")),), (), "action")
    situation = compared("PickUpAction", {**LEFT}, {"goal_z": 1.0, "torso": 0.3}, fields)
    lower = tried(1, -0.7)._replace(numbers={"goal_z": 0.8, "torso": 0.1})
    assert predicted(situation, lower).tries == pytest.approx(1, abs=1e-6)


def test_the_place_of_an_object_in_the_gripper_is_not_compared() -> None:
    fields = FeatureFields("GiveAction", (), (), (), ("object_designator",), "action")
    numbers = {"stand_x": -0.7, "height": 0.9, "object_z": 1.0, "torso": 0.1}
    standing = compared("GiveAction", {"object_type": "MILK", "near": ("BOWL",)}, numbers, fields)
    assert (dict(standing.words), [each.feature for each in standing.numbers]) == (
        {"object_type": "MILK"},
        ["stand_x", "height"],
    )
    assert compared("GiveAction", {"object_type": "MILK", "held": ("MILK",)}, numbers, fields).numbers == []


# === of actions ===============================================================================================


@pytest.mark.slow
async def test_an_action_is_predicted_by_the_tries_in_its_present_situation(database_url: str, tmp_path: Path) -> None:
    async with Memory.open(database_url, spool=tmp_path / "spool") as memory:
        with BulletWorld(), simulated_robot:
            Object("pr2", ObjectType.ROBOT)
            milk = Object("milk", ObjectType.MILK, pose=Pose([1.3, 1.0, 0.9]))
            move = MoveAndPickUpPerformable(Pose([0.6, 0.7, 0]), milk, Arms.LEFT, Grasp.FRONT)
            assert not (await memory.predict(move)).is_known
            await move.perform()  # a try of this process counts at once
            milk.world.reset()
            for _ in range(3):
                with pytest.raises(PlanFailure):
                    await MoveAndPickUpPerformable(Pose([3.0, 0.7, 0]), milk, Arms.LEFT, Grasp.FRONT).perform()
            likely = await memory.predict(move)
            assert likely.tries == pytest.approx(1, abs=1e-3)
            assert likely.reason is None
            assert (likely.low, likely.high) == pytest.approx(interval_95(1, 1), abs=1e-3)
            assert [(await memory.recall.case(each)).type for each in likely.cases] == ["PickUpAction"]
            await NavigateActionPerformable(Pose([3.0, 0.7, 0], [0, 0, 1, 0])).perform()
            description = PickUpAction(milk, [Arms.LEFT, Arms.RIGHT], [Grasp.FRONT])
            unlikely = await memory.predict(description)  # of its first alternative, where the robot stands
            assert unlikely.reason == "IKError"
            assert unlikely.chance < 0.3 < likely.chance
            assert not (await memory.predict(PickUpAction(milk, [Arms.RIGHT], [Grasp.FRONT]))).is_known
            lifted = PredictedPickUpPerformable(
                move.standing_position, milk, Arms.LEFT, Grasp.FRONT, torso=0.3, relative_x=0, relative_y=0, height=0,
                probability=0.75, policy="abc",
            )  # fmt: skip
            rated = await memory.predict(lifted)
            assert rated.tries == pytest.approx(math.exp(-9 / 2), abs=1e-3)  # 3 tolerances
            assert rated.source == "abc"
            assert rated.chance == pytest.approx(0.75, abs=0.01)
        await memory.flush()
        by_features = await memory.recall.predict(PickUpAction, has={"arm": Arms.LEFT}, near={"stand_x": (-0.7, 0.1)})
        assert by_features.tries == pytest.approx(1, abs=1e-3)
        with pytest.raises(CallerError, match="no case of PickUpAction has a feature 'arms'; did you mean arm"):
            await memory.recall.predict(PickUpAction, has={"arms": Arms.LEFT})


@pytest.mark.slow
async def test_rollouts_under_other_conditions_do_not_count(database_url: str, tmp_path: Path) -> None:
    hard, colliding = Scene(limits=Limits.HARD), Scene(limits=Limits.HARD, collisions=True)
    disturbed = replace(hard, disturbance=Disturbance(base_m=0.01, slip=0.1))
    x, y = (Linear((each - 5e-4, each + 5e-4), (0.0, 1.0)) for each in (-0.7, -0.3))
    here = Policy((Leaf(1.0, (0.5, 0.5), (0.25,) * 4, x, y, None),))
    others = (Scene(), colliding, disturbed, Scene(limits=Limits.HARD, table=True))
    async with Memory.open(database_url, spool=tmp_path / "spool") as memory:
        for count, scene in enumerate((hard, *others), 2):
            with scene.entered() as stage:
                tries = MoveAndPickUp(stage.target, [Arms.LEFT], [Grasp.FRONT], here)
                await batch_rollout(tries, count, seed=1, scene=str(scene), reset=stage.reset)
        async with memory.episode(description="outside of rollouts"):
            with Scene().entered() as stage:
                tries = MoveAndPickUp(stage.target, [Arms.LEFT], [Grasp.FRONT], here)
                await batch_rollout(tries, 1, seed=2, scene=str(Scene()), reset=stage.reset)
            with hard.entered() as stage, suppress(PlanFailure):
                await MoveAndPickUpPerformable(Pose([0.6, 0.7, 0]), stage.target, Arms.LEFT, Grasp.FRONT).perform()

        async def compared_in(scene: Scene) -> int:
            with scene.entered() as stage:
                place = Pose([0.6, 0.7, 0])
                move = MoveAndPickUpPerformable(place, stage.target, Arms.LEFT, Grasp.FRONT)
                return round((await memory.predict(move)).tries)

        assert [await compared_in(scene) for scene in (hard, *others)] == [3, 5, 5, 6, 7]
        async with memory.episode(description="a batch that this process has not stored when it predicts"):
            with hard.entered() as stage:
                tries = MoveAndPickUp(stage.target, [Arms.LEFT], [Grasp.FRONT], here)
                await batch_rollout(tries, 1, seed=2, scene=str(hard), reset=stage.reset)
            await compared_in(hard)
        await memory.flush()
        assert [await compared_in(scene) for scene in (hard, *others)] == [4, 5, 5, 6, 7]


def test_a_sync_memory_predicts_too(tmp_path: Path) -> None:
    with Memory.sync(f"sqlite:///{tmp_path}/memory.db") as memory:
        kind = memory.recording.type("action", "GraspAction", {"arm": "text"})
        with memory.recording.episode(description="grips") as episode:
            for number in range(3):
                episode.start(number, kind, {"arm": "LEFT"})
                episode.end(number)
        memory.flush()
        result = memory.predict("GraspAction", has={"arm": "LEFT"})
        assert (result.chance, result.tries) == pytest.approx(((3 + 4 / 5) / 4, 3.0))
        assert str(memory.predict("GripAction")) == "not known: never seen: type GripAction; did you mean GraspAction?"
        assert str(memory.predict("Other")) == "not known: never seen: type Other; there are GraspAction"


# === advice ===================================================================================================


class GripSliding(ActionDescription[GripSlidingActionPerformable]):
    def __init__(self, levels: Sequence[float]) -> None:
        super().__init__(GripSlidingActionPerformable, arm=[Arms.LEFT], level=levels)


@dataclass
class GripOnceActionPerformable(ActionAbstract):
    """Grips by a description, as a part of a plan."""

    level: float

    async def perform(self) -> None:
        await Retry(GripSliding([self.level]), max_tries=1).perform()


async def filled(memory: Memory) -> None:
    async with memory.episode(description="grips"):
        for level in (0.5, 0.5, 0.9, 1.5, 1.5, 1.5, 1.6):
            await grip(Arms.LEFT, level)


def levels_of(tree: Any) -> list[float]:
    return [each.designator.level for each in tree if isinstance(each.designator, GripSlidingActionPerformable)]


@pytest.mark.soak_on("postgresql")
async def test_an_advised_plan_tries_the_likeliest_alternatives_and_refuses_the_others(
    database_url: str, tmp_path: Path
) -> None:
    async with Memory.open(database_url, spool=tmp_path / "spool") as memory:
        await filled(memory)
        async with memory.episode(description="advised"):
            with collected_tree() as unadvised, pytest.raises(SlipperyFailure):
                await Retry(GripSliding([1.5, 1.6, 0.5]), max_tries=1).perform()
            with memory.advising(minimum=0.5):
                with collected_tree() as tree:
                    await Retry(GripSliding([1.5, 1.6, 0.5]), max_tries=1).perform()
                    await (GripSliding([1.5, 0.9, 0.5]) + GripSliding([0.9])).perform()
                with collected_tree() as refused, pytest.raises(RefusedByPrediction) as raised:
                    await Retry(GripSliding([1.5, 1.6]), max_tries=2).perform()
                with pytest.raises(RefusedByPrediction):
                    await GripOnceActionPerformable(1.5).perform()
            assert (levels_of(unadvised), levels_of(tree), levels_of(refused)) == ([1.5], [0.5, 0.5, 0.9], [])
            failure = raised.value
            assert (failure.alternatives, failure.minimum, failure.reason) == (2, 0.5, "SlipperyFailure")
            assert 0 < failure.low <= failure.chance < 0.5
        await memory.flush()
        nodes = await memory.reading.rows(
            select(TaskTreeNode.dtype, TaskTreeNode.reason).where(TaskTreeNode.reason == "RefusedByPrediction")
        )
        assert sorted(map(tuple, nodes)) == [
            ("GripOnceAction", "RefusedByPrediction"),
            ("Retry", "RefusedByPrediction"),
            ("Retry", "RefusedByPrediction"),
        ]
        advice = select(ObservationValue.key, ObservationValue.number).join(
            Observation, Observation.id == ObservationValue.id
        )
        advice = advice.where(Observation.name == "advice", ObservationValue.key == "refused").order_by(Observation.id)
        assert [tuple(each) for each in await memory.reading.rows(advice)] == [
            ("refused", 2),
            ("refused", 1),
            ("refused", 0),
        ]
        # What was refused was not tried, so it is no experience.
        assert not (await memory.recall.predict("GripOnceAction", near={"level": 1.5})).is_known


async def test_a_failure_counts_before_the_next_alternative_and_the_unknown_is_tried() -> None:
    async with Memory.open("sqlite://") as memory, memory.episode(description="new"):
        with memory.advising(minimum=0.3), collected_tree() as tree, pytest.raises(SlipperyFailure) as slipped:
            await Retry(GripSliding([2.0, 2.001, 5.0, 2.002]), max_tries=2).perform()
        assert levels_of(tree) == [2.0, 5.0]  # the first one failed, so those like it come later
        assert slipped.value.__notes__ == ["try 1: SlipperyFailure: it slipped"]
        with memory.advising(minimum=0.6), collected_tree() as tree, pytest.raises(RefusedByPrediction) as refused:
            await Retry(GripSliding([90.0, 90.0, 90.0])).perform()
        assert levels_of(tree) == [90.0]
        assert (refused.value.alternatives, refused.value.__notes__) == (2, ["try 1: SlipperyFailure: it slipped"])
        with memory.advising(explore=False), collected_tree() as tree, pytest.raises(RefusedByPrediction):
            await Retry(GripSliding([7000.0])).perform()
        assert levels_of(tree) == []


async def test_a_plan_goes_on_unadvised_without_its_database(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch, caplog: pytest.LogCaptureFixture
) -> None:
    monkeypatch.setattr(prediction, "ANSWER_WAIT_S", 0.05)
    async with Memory.open(f"sqlite:///{tmp_path}/memory.db", writer="daemon") as memory:  # no daemon: no database
        with memory.advising(minimum=1.0), collected_tree() as tree, caplog.at_level(logging.WARNING):
            for _ in range(2):
                await Retry(GripSliding([0.7, 0.5]), max_tries=1).perform()
    assert levels_of(tree) == [0.7, 0.7]
    [line] = [each.message for each in caplog.records if each.message.startswith("the memory predicts")]
    assert line == "the memory predicts nothing, so the plan goes on unadvised: no answer in 0.05 s"


async def test_a_plan_does_not_wait_for_a_memory_that_does_not_answer(
    monkeypatch: pytest.MonkeyPatch, caplog: pytest.LogCaptureFixture
) -> None:
    monkeypatch.setattr(prediction, "ANSWER_WAIT_S", 0.01)
    answered, questions = asyncio.Event(), 0
    known = Prediction(0.9, 0.8, 1.0, 9.0, (), None)

    async def slow(actions: Sequence[Any]) -> list[Prediction]:
        nonlocal questions
        questions += 1
        await answered.wait()
        return [known for _ in actions]

    adviser = MemoryAdviser(slow, lambda *_: None, 0.3, explore=True)
    one = GripSlidingActionPerformable(Arms.LEFT, 0.5)
    assert [await adviser.chances([one]) for _ in range(3)] == [None, None, None]
    assert questions == 1  # the next ones do not wait for it
    answered.set()
    await asyncio.sleep(0)
    assert await adviser.chances([one]) == [known]
    assert [each.message for each in caplog.records] == [
        "the memory predicts nothing, so the plan goes on unadvised: no answer in 0.01 s"
    ]


async def test_parallel_plans_are_all_advised_and_one_that_outlives_the_advice_ends_as_others() -> None:
    async with Memory.open("sqlite://") as memory:
        await filled(memory)
        async with memory.episode(description="parallel"):
            with collected_tree() as tree, memory.advising(minimum=0.5):
                await (GripSliding([1.5, 0.5]) | GripSliding([1.5, 0.5])).perform()
                outliving = asyncio.create_task(Retry(GripSliding([1.5, 0.5]), max_tries=1).perform())
                await asyncio.sleep(0)  # so that it asks
                await asyncio.sleep(0)
            await outliving
            assert levels_of(tree) == [0.5, 0.5, 0.5]


async def test_what_is_no_action_and_a_minimum_that_is_no_chance_are_refused() -> None:
    async with Memory.open("sqlite://") as memory:
        with pytest.raises(CallerError, match="3 is no action: give one"):
            await memory.predict(3)  # type: ignore[arg-type]
        with pytest.raises(CallerError, match="`has` and `near` belong to a type"):
            await memory.recall.predict(GripSliding([1.5]), near={"level": 1.5})
        with pytest.raises(CallerError, match="minimum must be a chance from 0 to 1, got 30"), memory.advising(30):
            pass


async def test_alternatives_before_the_failure_of_a_description_are_tried() -> None:
    class Failing(GripSliding):
        def __iter__(self) -> Iterator[GripSlidingActionPerformable]:
            yield from super().__iter__()
            raise PlanFailure("there is no further way")

    async with Memory.open("sqlite://") as memory, memory.episode(description="failing"):
        with memory.advising():
            with collected_tree() as tree:
                await Retry(Failing([0.5])).perform()
            with pytest.raises(PlanFailure, match="there is no further way"):
                await Retry(Failing([1.5]), max_tries=2).perform()
        assert levels_of(tree) == [0.5]


@pytest.mark.slow
async def test_in_the_kitchen_advice_saves_failed_attempts_and_loses_no_object_postgresql_as_sqlite(
    server: Server, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.chdir(tmp_path)  # the default spool of a database of PostgreSQL is in the working directory

    async def outcome(way: str, url: str) -> advised.Outcome:
        tasks = advised.Outcome()
        await advised.remember(url, seed=0, tries=60)
        await advised.tasks(url, way, seed=0, count=6, outcome=tasks)
        return tasks

    alone = await outcome("on its own", put_memory(tmp_path / "alone.db"))
    advice = await outcome("advised", put_memory(tmp_path / "advised.db"))
    assert await outcome("advised", server.new_memory()) == advice
    assert sum(advice.failed) < sum(alone.failed)
    assert advice.placed >= alone.placed
