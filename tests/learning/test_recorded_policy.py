"""A learned policy is in the memory with its content, its training episodes and its settings."""

from __future__ import annotations

from contextlib import suppress
from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest
from sqlalchemy import func, select

from pycrorm_async import Memory, Reading
from pycrorm_async.errors import CallerError
from pycrorm_async.learning import (
    MoveAndPickUp,
    Scene,
    batch_rollout,
    default_policy,
    load_policy,
    name_of,
    read_policy,
    record_policy,
    save_policy,
)
from pycrorm_async.learning.experiment import Experiment, run
from pycrorm_async.learning.pool import MemoryLocation
from pycrorm_async.learning.tree import learn
from pycrorm_async.orm import (
    BatchRolloutAction,
    LearnPolicyAction,
    MoveAndPickUpAction,
    Observation,
    PickUpWithContextView,
    ProcessMetaData,
    TaskTreeNode,
)
from pycrorm_async.plan import Retry
from pycrorm_async.plan.failures import PlanFailure
from pycrorm_async.world import Arms
from tests.learning.geometric_rollouts import frame_of

SMALL = Experiment(rollouts=600, evaluate=30, held_out=30, rounds=2)


@pytest.mark.slow
@pytest.mark.soak_on("postgresql")
async def test_a_recorded_policy_is_read_back_by_its_name(database_url: str, tmp_path: Path) -> None:
    policy = default_policy()
    async with Memory.open(database_url, spool=tmp_path / "spool") as memory:
        async with memory.episode(description="training") as training:
            pass
        name = await record_policy(memory, policy, episodes=[str(training)], successes=7, min_samples_leaf=3)
        await memory.flush()
        read = await read_policy(memory.reading, name)
        async with memory.session() as session:
            (learned,) = (await session.scalars(select(LearnPolicyAction))).all()
    assert name == name_of(policy) == name_of(read) == learned.policy
    assert read.sample(np.random.default_rng(1), 5) == policy.sample(np.random.default_rng(1), 5)
    assert (learned.successes, learned.min_samples_leaf, learned.rollouts, learned.scene) == (7, 3, None, None)
    assert (learned.training_episodes, learned.episode_count, learned.seeds) == ([str(training)], 1, [])


OTHER = replace(default_policy(), constant_height=0.25)
"""A policy whose name is not that of the default one."""


async def test_the_policy_of_rollouts_is_read_back_after_its_file_was_overwritten(
    database_url: str, tmp_path: Path
) -> None:
    file = tmp_path / "policy.json"
    save_policy(OTHER, file)
    async with Memory.open(database_url, spool=tmp_path / "spool") as memory:
        with Scene().entered() as stage:
            for seed in (1, 2):
                action = MoveAndPickUp(stage.target, policy=load_policy(file))
                await batch_rollout(action, 2, seed=seed, reset=stage.reset)
        save_policy(default_policy(), file)
        await memory.flush()
        async with memory.session() as session:
            batches = (await session.scalars(select(BatchRolloutAction))).all()
            chosen = set(await session.scalars(select(MoveAndPickUpAction.policy)))
            contents = await session.scalar(select(func.count(Observation.id)))
            picked = (await session.scalars(select(PickUpWithContextView.policy))).all()
        read = await read_policy(memory.reading, batches[0].policy)
    assert [each.policy for each in batches] == [name_of(OTHER)] * 2
    assert (chosen, read, contents) == ({name_of(OTHER)}, OTHER, 1)
    assert picked == [name_of(OTHER)] * 4


async def test_rollouts_with_one_arm_keep_the_name_of_the_policy_as_it_was_passed(tmp_path: Path) -> None:
    async with Memory.open(f"sqlite:///{tmp_path / 'm.db'}") as memory:
        with Scene().entered() as stage:
            action = MoveAndPickUp(stage.target, [Arms.LEFT], policy=OTHER)
            await batch_rollout(action, 2, seed=1, reset=stage.reset)
        await memory.flush()
        async with memory.session() as session:
            batch = (await session.scalars(select(BatchRolloutAction))).one()
            tries = (await session.scalars(select(MoveAndPickUpAction))).all()
            assert (batch.policy, batch.arms, batch.grasps) == (name_of(OTHER), ["LEFT"], [])
            assert {(each.policy, each.arm) for each in tries} == {(name_of(OTHER), Arms.LEFT)}
        assert await read_policy(memory.reading, batch.policy) == OTHER


async def test_each_try_of_a_retried_pick_up_names_its_policy_and_the_memory_holds_it(tmp_path: Path) -> None:
    async with Memory.open(f"sqlite:///{tmp_path / 'm.db'}") as memory:
        with Scene().entered() as stage:
            action = MoveAndPickUp(stage.target, policy=OTHER, rng=np.random.default_rng(1))
            with suppress(PlanFailure):
                await Retry(action, max_tries=2).perform()
        await memory.flush()
        async with memory.session() as session:
            tries = (await session.scalars(select(MoveAndPickUpAction))).all()
            assert {each.policy for each in tries} == {name_of(OTHER)}
            kept = (await session.scalars(select(Observation))).one()
            node = await session.get_one(TaskTreeNode, kept.node_id)
            assert node.dtype == "Retry"
        assert await read_policy(memory.reading, tries[0].policy or "") == OTHER


@pytest.mark.soak_on("postgresql")
async def test_a_policy_that_is_not_recorded_is_named(database_url: str, tmp_path: Path) -> None:
    async with Memory.open(database_url, spool=tmp_path / "spool") as memory:
        with pytest.raises(CallerError, match="the memory holds no policy '0123456789ab'"):
            await read_policy(memory.reading, "0123456789ab")


@pytest.mark.slow
@pytest.mark.soak_on("postgresql")
async def test_the_rollouts_of_an_experiment_lead_to_their_policy_and_its_training_episodes(
    database_url: str, tmp_path: Path
) -> None:
    place = MemoryLocation(database_url, tmp_path / "spool")
    learned = await run(SMALL, place)
    save_policy(default_policy(), tmp_path / "policy.json")  # what the file holds does not matter
    async with Reading.open(place.url) as reading:
        evaluation = learned.evaluation
        assert name_of(await read_policy(reading, evaluation.policy)) == name_of(learned.policy) == evaluation.policy
        async with reading.session() as session:
            first, last = (await session.scalars(select(LearnPolicyAction).order_by(LearnPolicyAction.id))).all()
            batches = (await session.scalars(select(BatchRolloutAction))).all()
            uuids = {each.id: each.uuid for each in await session.scalars(select(ProcessMetaData))}
    assert (first.policy, last.policy) == (learned.phases[1].policy, evaluation.policy)
    assert (first.rollouts, last.rollouts, first.seeds, last.seeds) == (600, 1_200, [69], [69, 70])
    assert last.successes == len(learned.successes)
    assert learn(frame_of(learned.successes), min_samples_leaf=25).leaves == learned.policy.leaves  # of both rounds
    assert (last.min_samples_leaf, last.scene) == (25, str(SMALL.scene))
    for each, seeds in ((first, {69}), (last, {69, 70})):
        training = {uuids[batch.process_metadata_id] for batch in batches if batch.seed in seeds}
        assert training == set(each.training_episodes)
        assert each.episode_count == len(training) > 1
    again = await run(Experiment(**{**vars(SMALL), "resume": True}), place)
    assert again.policy.leaves == learned.policy.leaves
    async with Reading.open(place.url) as reading, reading.session() as session:
        assert len((await session.scalars(select(LearnPolicyAction))).all()) == 2
