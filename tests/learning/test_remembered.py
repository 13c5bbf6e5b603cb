"""A policy is learned from all pick-ups of one kind that a memory holds, of real robots too."""

from __future__ import annotations

import math
from collections.abc import Iterable
from contextlib import suppress
from dataclasses import replace
from pathlib import Path
from typing import Any

import numpy as np
import pandas as pd
import pytest
from sqlalchemy import func, select

from pycrorm_async import Memory
from pycrorm_async.errors import CallerError, NotEnoughExperience
from pycrorm_async.learning import MoveAndPickUp, Policy, Scene, SuccessModel, batch_rollout, name_of
from pycrorm_async.learning.experiment import Learned
from pycrorm_async.learning.move_and_pick_up import PredictedPickUpPerformable, context_of
from pycrorm_async.learning.policy import PickUpChoice
from pycrorm_async.learning.policy_cards import read_card
from pycrorm_async.learning.recorded_policy import HeldOut, read_policy
from pycrorm_async.learning.remembered import (
    conditions_of,
    learn_remembered,
    read_tries,
    record_remembered,
    select_tries,
)
from pycrorm_async.learning.rollouts import randomness
from pycrorm_async.learning.scenes import Disturbance
from pycrorm_async.orm import LearnPolicyAction
from pycrorm_async.plan.actions import FaceAtPerformable, NavigateActionPerformable, PickUpActionPerformable
from pycrorm_async.plan.failures import PlanFailure
from pycrorm_async.world import Arms, Grasp, Pose
from pycrorm_async.world.urdf import Limits

OBJECTS = {"milk": ("MILK", 0.85), "cereal": ("BREAKFAST_CEREAL", 1.05)}
TRIES = 160


def pick_up_on_a_real_robot(url: str, spool: Path) -> None:
    """Record pick-ups by the seam, as the executive of a robot does: they succeed from less than 0.75 m."""
    rng = np.random.default_rng(3)
    with Memory.sync(url, spool=spool) as memory:
        pick_up = memory.recording.type(
            "action", "PickUpAction", {"object_designator": "object", "arm": "text", "grasp": "text"}
        )
        for name, (kind, height) in OBJECTS.items():
            with memory.recording.episode(description=f"shelves of {name}") as episode:
                episode.object_added("base", "robin", "ROBOT", Pose([0, 0, 0]))
                episode.object_added("thing", name, kind, Pose([2.0, 1.0, height]))
                for number in range(TRIES // 2):
                    distance = float(rng.uniform(0.4, 1.1))
                    episode.object_moved("base", Pose([2.0 - distance, 1.0, 0]))
                    choice = {"object_designator": "thing", "arm": "LEFT", "grasp": "FRONT"}
                    episode.start(number, pick_up, choice, robot="base")
                    failure = None if distance < 0.75 else ("IKError", "out of reach")
                    episode.end(number, "FAILED" if failure else "SUCCEEDED", failure)
        memory.flush()
        assert memory.status.missing.total == 0, memory.status.missing.last


def by(held_out: Iterable[HeldOut]) -> dict[str, HeldOut]:
    return {each.by: each for each in held_out}


@pytest.mark.slow
async def test_a_model_is_learned_from_a_real_robot_and_evaluated_on_other_objects_and_heights(
    database_url: str, tmp_path: Path
) -> None:
    pick_up_on_a_real_robot(database_url, tmp_path / "spool")
    async with Memory.open(database_url, spool=tmp_path / "spool") as memory:
        with Scene().entered() as stage:
            await batch_rollout(MoveAndPickUp(stage.target), 3, seed=1, scene=str(Scene()), reset=stage.reset)
        await memory.flush()
        tries = await read_tries(memory.reading)
        with pytest.raises(CallerError, match=r"^2 kinds .*: 'robin, real' \(\d+ of 160 succeeded\); 'pr2, sim"):
            select_tries(tries, {})
        learned = learn_remembered(select_tries(tries, {"robot": "robin"}))
        assert isinstance(learned.policy, SuccessModel)
        assert (learned.policy.robot, learned.policy.rollouts) == ("robin", TRIES)
        evaluation = learned.evaluation
        assert evaluation.experience == "robin, real"
        assert evaluation.failures == TRIES - learned.successes
        assert evaluation.unknown == (
            "the place to which the robot was sent: learned from where it stood (160 of 160)",
            "the size of the object (160 of 160)",
            "the surface below the object (160 of 160)",
            "joint limits, collisions and disturbance (160 of 160)",
        )
        held_out = by(evaluation.held_out)
        assert {name: each.groups for name, each in held_out.items()} == {
            "random": TRIES, "height": 2, "object": 2, "scene": 2,
        }  # fmt: skip
        for each in held_out.values():
            assert (each.tries, each.successes) == (TRIES, learned.successes)
            assert sum(bin_.tries for bin_ in each.calibration) == TRIES
            assert each.confident_successes / each.confident > 0.9
            assert each.coverage is not None
            assert each.coverage > 0.8
            assert each.brier is not None
            assert each.brier < 0.05
        assert evaluation.coverage == held_out["random"].coverage

        name = await record_remembered(memory, learned)
        assert await record_remembered(memory, learned) == name == name_of(learned.policy)
        async with memory.session() as session:
            assert await session.scalar(select(func.count(LearnPolicyAction.id))) == 1
        assert await read_policy(memory.reading, name) == learned.policy
        card = await read_card(memory.reading, name[:6])
        assert (card.evaluation, card.summary.learned_from, card.summary.robots) == (evaluation, TRIES, ("robin",))
        assert card.trainings[0].episode_ids == learned.episodes
        assert len(learned.episodes) == 2


@pytest.mark.slow
async def test_a_tree_is_learned_from_successes_alone(tmp_path: Path) -> None:
    url = f"sqlite:///{tmp_path}/memory.db"
    pick_up_on_a_real_robot(url, tmp_path / "spool")
    async with Memory.open(url, spool=tmp_path / "spool") as memory:
        tries = select_tries(await read_tries(memory.reading), {"object": "MILK"})
    learned = learn_remembered(tries, Learned.PLACES)
    assert isinstance(learned.policy, Policy)
    assert learned.evaluation.failures is None
    [held_out] = learned.evaluation.held_out  # one object, one height, one scene
    assert (held_out.by, held_out.brier, held_out.calibration) == ("random", None, ())
    assert held_out.confident_successes / held_out.confident > 0.9


@pytest.mark.slow
async def test_tries_have_the_place_to_which_the_robot_was_sent_also_if_it_never_arrived(database_url: str) -> None:
    scene = Scene(collisions=True, kitchen=True, torso_height=0.3, disturbance=Disturbance(base_m=0.05))
    count = 25
    async with Memory.open(database_url) as memory:
        await memory.flush()
        assert (await read_tries(memory.reading)).empty
        with scene.entered() as stage:
            tries = MoveAndPickUp(stage.target)
            tally = await batch_rollout(
                tries, count, seed=1, scene=str(scene), reset=stage.reset, prepare=stage.prepare
            )
            sent = [tries.drawn(randomness(1, index)) for index in range(count)]
            box = stage.target.bounding_box().size
        async with memory.episode(description="alone"):
            with Scene().entered() as stage:
                await NavigateActionPerformable(Pose([0.6, 0.7, 0])).perform()
                await FaceAtPerformable(stage.target.pose).perform()
                with suppress(PlanFailure):
                    await PickUpActionPerformable(stage.target, Arms.LEFT, Grasp.FRONT).perform()
                ways = MoveAndPickUp(stage.target, policy=SuccessModel.untrained(), rng=np.random.default_rng(2))
                with suppress(PlanFailure):
                    await (chosen := next(iter(ways))).perform()
        await memory.flush()
        frame = await read_tries(memory.reading)
    rollouts, stood, choice = (part for _, part in frame.groupby(frame.index.map(lambda row: max(row - count + 1, 0))))
    assert tally.failures["NavigationGoalInCollision"] > 0
    assert (len(rollouts), int((rollouts.status == "SUCCEEDED").sum())) == (count, tally.successes)
    there = [(each.standing_position.position.x - 1.3, each.standing_position.position.y - 1.0) for each in sent]
    assert rollouts[["object_x", "object_y"]].to_numpy() == pytest.approx(np.array(there), abs=1e-9)
    assert set(rollouts.place_from) == {"goal"}
    closing = ["x" if each.grasp in (Grasp.LEFT, Grasp.RIGHT) else "y" for each in sent]
    assert rollouts.width.tolist() == pytest.approx([getattr(box, axis) for axis in closing], abs=1e-5)
    assert rollouts.height.tolist() == pytest.approx([0.6] * count)
    assert (stood.place_from.item(), choice.place_from.item()) == ("stood", "choice")
    assert (stood.object_x.item(), stood.object_y.item()) == pytest.approx((-0.7, -0.3))
    assert isinstance(chosen, PredictedPickUpPerformable)
    assert (choice.object_x.item(), choice.torso_height.item()) == (chosen.relative_x, chosen.torso)


@pytest.mark.slow
async def test_the_edge_of_the_table_is_known_of_tries_that_no_model_chose() -> None:
    scene, count = Scene(heights=(0.7, 1.0), turned=True, table=True, parked=True, collisions=True), 12
    async with Memory.open("sqlite://") as memory:
        with scene.entered() as stage:
            tries = MoveAndPickUp(stage.target)
            await batch_rollout(tries, count, seed=1, scene=str(scene), reset=stage.reset, prepare=stage.prepare)
            known = []
            for index in range(count):
                stage.reset()
                context = context_of(stage.prepare(1, index))
                drawn = tries.drawn(randomness(1, index))
                at = drawn.standing_position.relative_to(stage.target.pose).position
                known.append(context.circumstances([PickUpChoice(drawn.arm, drawn.grasp, *at[:2])]))
        async with memory.episode(description="in the air"):
            with Scene().entered() as stage, suppress(PlanFailure):
                await MoveAndPickUp(stage.target).drawn(randomness(1, 0)).perform()
        await memory.flush()
        frame = await read_tries(memory.reading)
    assert frame.furniture.tolist() == [True] * count + [False]
    assert frame.edge_distance.isna().tolist() == [False] * count + [True]
    for name in ("edge_distance", "edge_angle"):
        expected = [each[name].item() for each in known]
        off = np.remainder(frame[name][:count] - expected + math.pi, math.tau) - math.pi
        assert np.abs(off).max() < 1e-6, name
    assert len(set(frame.edge_distance[:count].round(6))) == count


def test_experience_of_one_kind_agrees_in_limits_collisions_furniture_and_disturbance() -> None:
    scene = Scene()
    same = (scene, replace(scene, position=(1.0, 0.0, 1.2)), replace(scene, heights=(0.6, 1.2), turned=True))
    assert {conditions_of(str(each)) for each in same} == {"soft limits"}
    others = (
        replace(scene, limits=Limits.HARD),
        replace(scene, collisions=True),
        replace(scene, table=True),
        replace(scene, kitchen=True),
        replace(scene, disturbance=Disturbance(base_m=0.02)),
    )
    assert len({conditions_of(str(each)) for each in (scene, *others)}) == 1 + len(others)
    assert conditions_of(None) == "outside of rollouts"
    assert conditions_of("") == "rollouts in no named scene"


def table(statuses: Iterable[str]) -> pd.DataFrame:
    rows: list[dict[str, Any]] = [
        {"arm": "LEFT", "grasp": "FRONT", "object_x": -0.7 - number / 100, "object_y": 0.0, "height": 0.9, "seed": None,
         "torso_height": 0.0, "status": status, "robot": "pr2", "uuid": "a", "object": "MILK", "scene": "", "kind": "k"}
        for number, status in enumerate(statuses)
    ]  # fmt: skip
    return pd.DataFrame(rows)


def test_what_cannot_be_learned_from_is_refused_in_one_line() -> None:
    tries = table(["SUCCEEDED"] * 40)
    with pytest.raises(NotEnoughExperience, match=r"^0 failures are too few to learn from"):
        learn_remembered(tries)
    with pytest.raises(NotEnoughExperience, match=r"^0 successes are too few to learn from"):
        learn_remembered(table(["FAILED"] * 40))
    for model in Learned:
        with pytest.raises(NotEnoughExperience, match=r"^all 40 pick-ups have no height over the robot: its pose"):
            learn_remembered(tries.assign(height=np.nan), model)
    with pytest.raises(NotEnoughExperience, match=r"^10 successes are too few .*; 30 of 40 pick-ups have no height"):
        SuccessModel.fit(tries.assign(height=[0.9] * 10 + [np.nan] * 30))
    with pytest.raises(NotEnoughExperience, match=r"^no pick-up is remembered .*, with object BOWL: record some"):
        select_tries(tries, {"object": "BOWL"})
    with pytest.raises(CallerError, match=r"^pick-ups have no column 'objects' to choose by; did you mean object"):
        select_tries(tries, {"objects": "MILK"})
    assert len(select_tries(tries, {"object": "MILK", "kind": "k"})) == 40
