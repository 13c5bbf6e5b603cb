"""Many rollouts: the same for the same seed and index in any order, and all of them recorded."""

from __future__ import annotations

import random
from collections import Counter
from collections.abc import Sequence
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from sqlalchemy import func, select

from pycrorm_async import Memory, Settings
from pycrorm_async.errors import CallerError
from pycrorm_async.learning import (
    MoveAndPickUp,
    Policy,
    Scene,
    Tally,
    batch_rollout,
    default_policy,
    name_of,
    rollouts,
    rollouts_question,
)
from pycrorm_async.learning.experiment import read_rollouts
from pycrorm_async.learning.rollouts import BatchRolloutActionPerformable, randomness
from pycrorm_async.orm import BatchRolloutAction, PickUpAction, ProcessMetaData, TaskTreeNode
from pycrorm_async.plan.task import collected_tree
from pycrorm_async.world import Grasp, ObjectType
from pycrorm_async.world.urdf import Limits
from tests.learning.geometric_rollouts import succeeds

pytestmark = pytest.mark.slow

PATIENT = Settings(flush_timeout_s=60)


async def rolled_out(count: int, *, seed: int = 69, scene: Scene | None = None, **options: Any) -> Tally:
    scene = scene or Scene()
    with scene.entered() as stage:
        action = MoveAndPickUp(stage.target, policy=options.pop("policy", None))
        return await batch_rollout(action, count, seed=seed, scene=str(scene), reset=stage.reset, **options)


async def frame_of(memory: Memory, *, seed: int = 69, policy: Policy | None = None) -> Any:
    await memory.flush()
    return await memory.dataframe(
        rollouts_question(scene=str(Scene()), seed=seed, policy=None if policy is None else name_of(policy))
    )


@pytest.mark.soak  # plan/test_actions performs other samples, test_policy compares their distributions
async def test_default_rollouts_succeed_as_often_as_in_the_thesis_and_never_from_the_top() -> None:
    """15.77 % there; two standard errors of 5,000 are one percent."""
    tried: Counter[Grasp] = Counter()
    done: Counter[Grasp] = Counter()
    before = 0

    def look(tally: Tally) -> None:
        nonlocal before
        grasp = default_policy().sample(randomness(69, tally.rollouts - 1))[0].grasp
        tried[grasp] += 1
        done[grasp] += tally.successes - before
        before = tally.successes

    tally = await rolled_out(5_000, report_progress=look)
    assert 0.145 < tally.success_rate < 0.17
    assert tally.failures.keys() == {"IKError"}
    assert done[Grasp.TOP] == 0
    for grasp in (Grasp.FRONT, Grasp.LEFT, Grasp.RIGHT):
        assert 0.18 < done[grasp] / tried[grasp] < 0.25


async def test_within_hard_limits_the_same_rollouts_succeed_and_more() -> None:
    succeeded: dict[Limits, list[bool]] = {}
    for limits in Limits:
        ends: list[int] = []
        await rolled_out(
            60, scene=Scene(limits=limits), report_progress=lambda tally, to=ends: to.append(tally.successes)
        )
        succeeded[limits] = np.diff([0, *ends]).astype(bool).tolist()
    pairs = list(zip(succeeded[Limits.SOFT], succeeded[Limits.HARD], strict=True))
    assert (False, True) in pairs
    assert (True, False) not in pairs


async def test_every_rollout_ends_as_geometry_and_inverse_kinematics_alone_predict() -> None:
    ends: list[int] = []
    await rolled_out(400, seed=7, report_progress=lambda tally: ends.append(tally.successes))
    expected = [succeeds(default_policy().sample(np.random.default_rng((7, index)))[0]) for index in range(400)]
    assert np.diff([0, *ends]).astype(bool).tolist() == expected


async def test_seed_and_index_determine_a_rollout_in_any_batch_and_any_world() -> None:
    whole: list[int] = []
    await rolled_out(120, report_progress=lambda tally: whole.append(tally.successes))
    pieces: list[int] = []
    for first, count in ((80, 40), (0, 30), (30, 50)):
        np.random.seed(first)  # without influence
        random.seed(first)
        ends: list[int] = []
        await rolled_out(count, first=first, report_progress=lambda tally, ends=ends: ends.append(tally.successes))
        pieces[first:first] = np.diff([0, *ends]).tolist()
    assert pieces[30:110] != whole  # the order of the pieces is not that of the indexes
    in_order = [*pieces[0:30], *pieces[30:80], *pieces[80:120]]
    assert in_order == np.diff([0, *whole]).tolist()
    assert (await rolled_out(120, seed=70)).successes != 0


@pytest.mark.soak_on("postgresql")
async def test_records_and_counts_agree_on_the_stage_at_which_each_rollout_failed(
    database_url: str, tmp_path: Path
) -> None:
    counted: list[Tally] = []
    async with Memory.open(database_url, spool=tmp_path / "spool", settings=PATIENT) as memory:
        async with memory.episode(description="many"):
            counted.append(await rolled_out(150))
        await rolled_out(50, first=150)  # in an episode of its own
        await rolled_out(30, seed=1)  # other ones
        frame = await frame_of(memory)
        assert rollouts.tally_of(frame) == counted[0] + again(150, 50)
        assert frame["index"].tolist() == list(range(200))
        assert set(frame.policy) == {name_of(default_policy())}
        choices = [default_policy().sample(randomness(69, index))[0] for index in range(200)]
        assert frame.arm.tolist() == [each.arm.name for each in choices]
        assert frame.grasp.tolist() == [each.grasp.name for each in choices]
        np.testing.assert_allclose(frame.object_x, [each.relative_x for each in choices], atol=1e-9)
        np.testing.assert_allclose(frame.object_y, [each.relative_y for each in choices], atol=1e-9)
        np.testing.assert_allclose(frame.height, 0.9, atol=1e-9)
        stages = rollouts.stages_of(frame)
        assert stages == await by_node_arithmetic(memory, frame)
        assert sum(stages.values()) == sum(frame.status == "FAILED")
        async with memory.session() as session:
            query_rows = (await session.execute(MoveAndPickUp.query_for_database())).all()
        assert len(query_rows) == sum(frame.status == "SUCCEEDED") + await won(memory, 1)


def again(first: int, count: int) -> Tally:
    """Return the same rollouts by geometry alone."""
    ends = [
        succeeds(default_policy().sample(np.random.default_rng((69, first + number)))[0]) for number in range(count)
    ]
    return Tally(sum(ends), Counter({"IKError": count - sum(ends)}))


async def won(memory: Memory, seed: int) -> int:
    return int(sum((await frame_of(memory, seed=seed)).status == "SUCCEEDED"))


async def by_node_arithmetic(memory: Memory, frame: Any) -> dict[str, int]:
    """Count the motions of each pick-up, as in section 4.3 of the facts on the original: the stage is where it failed.

    One goal of the hand: the pre-pose failed. Opening the gripper and a second: the grasp. Closing it and a third: the
    lift. The motions come from the nodes, whatever the named query makes of them.
    """
    async with memory.session() as session:
        node = TaskTreeNode
        children = select(node.parent_id, func.count().label("count")).group_by(node.parent_id).subquery()
        query_rows = (
            select(children.c.count, func.count())
            .join(PickUpAction, PickUpAction.id == children.c.parent_id)
            .join(node, node.id == PickUpAction.id)
            .join(ProcessMetaData, ProcessMetaData.id == node.process_metadata_id)
            .where(node.status == "FAILED", ProcessMetaData.id <= 2)
            .group_by(children.c.count)
        )
        found: dict[int, int] = {row[0]: row[1] for row in await session.execute(query_rows)}
    assert len(frame) == 200
    names = {1: "pre-pose", 3: "grasp", 5: "lift"}
    return {names[count]: found[count] for count in sorted(found)}


async def test_each_rollout_can_be_an_episode_of_its_own(tmp_path: Path) -> None:
    async with Memory.open(f"sqlite:///{tmp_path}/memory.db", settings=PATIENT) as memory:
        tally = await rolled_out(12, each_in=memory)
        frame = await frame_of(memory)
        assert rollouts.tally_of(frame) == tally
        assert frame["index"].tolist() == list(range(12))
        episodes = await memory.reading.episodes()
        assert [each.description.split(" under")[0] for each in episodes] == [f"rollout {index}" for index in range(12)]


async def test_a_stop_request_ends_a_batch_before_the_next_rollout(tmp_path: Path) -> None:
    async with Memory.open(f"sqlite:///{tmp_path}/memory.db", settings=PATIENT) as memory:
        seen: list[int] = []
        tally = await rolled_out(
            100, stop=lambda: len(seen) == 7, report_progress=lambda tally: seen.append(tally.rollouts)
        )
        assert tally.rollouts == 7
        frame = await frame_of(memory)
        assert frame["index"].tolist() == list(range(7))
        left = list(rollouts.missing_runs(frame["index"], 12, length_max=3))
        assert left == [(7, 3), (10, 2)]
        assert (await rolled_out(5, stop=lambda: True)).rollouts == 0


async def test_an_interrupted_rollout_does_not_count_and_is_repeated(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    """Interrupt it in the middle of its pick-up: an earlier interruption leaves no row that could be counted."""

    class Enough(BaseException):
        pass

    async with Memory.open(f"sqlite:///{tmp_path}/memory.db", settings=PATIENT) as memory:
        with Scene().entered() as stage:
            action = MoveAndPickUp(stage.target)
            attempts = 0

            def reset() -> None:
                nonlocal attempts
                attempts += 1
                stage.reset()
                if attempts == 4:
                    monkeypatch.setattr("pycrorm_async.plan.motions.postures", raising)

            def raising(*_: object, **__: object) -> None:
                raise Enough

            with pytest.raises(Enough):
                await batch_rollout(action, 10, seed=69, scene=str(Scene()), reset=reset)
        assert (await frame_of(memory))["index"].tolist() == [0, 1, 2, 3]
        monkeypatch.undo()
        await rolled_out(6, first=4)
        frame = await frame_of(memory)
        assert frame["index"].tolist() == list(range(10))
        async with memory.session() as session:
            batches: Sequence[BatchRolloutAction] = (await session.scalars(select(BatchRolloutAction))).all()
        assert [(each.first, each.count, each.seed) for each in batches] == [(0, 10, 69), (4, 6, 69)]


async def test_rollouts_that_were_repeated_count_once(tmp_path: Path) -> None:
    async with Memory.open(f"sqlite:///{tmp_path}/memory.db", settings=PATIENT) as memory:
        for first, count in ((0, 20), (10, 20)):
            await rolled_out(count, first=first)
        await memory.flush()
        frame = await read_rollouts(memory.reading, Scene(), name_of(default_policy()), 69, 30)
        assert frame["index"].tolist() == list(range(30))


async def test_a_fault_in_the_plan_ends_the_batch(tmp_path: Path) -> None:
    with Scene().entered() as stage:

        def broken() -> None:
            raise ZeroDivisionError

        with pytest.raises(ZeroDivisionError):
            await batch_rollout(MoveAndPickUp(stage.target), 10, seed=1, reset=broken)
    assert not list(tmp_path.iterdir())


@pytest.mark.parametrize("wrong", [{"seed": -1}, {"first": -1}, {"count": -1}])
async def test_invalid_counts_are_refused(wrong: dict[str, Any]) -> None:
    with pytest.raises(CallerError, match="must be >= 0, got"):
        await rolled_out(**({"count": 1} | wrong))


def test_scenes_that_differ_have_different_texts() -> None:
    """Rollouts are distinguished by this text."""
    scenes = [
        Scene(),
        Scene(object_type=ObjectType.BOWL),
        Scene(name="bowl", object_type=ObjectType.BOWL),
        Scene(position=(1.3, 1.0, 0.900001)),
        Scene(yaw=1e-5),
        Scene(yaw=1.00001e-5),
        Scene(torso_height=0.3),
        Scene(limits=Limits.HARD),
        Scene(collisions=True),
        Scene(kitchen=True),
    ]
    assert len({str(each) for each in scenes}) == len(scenes)
    assert str(Scene()) == "milk at 1.3, 1, 0.9 m, torso at 0 m, soft limits"


async def test_the_node_of_a_batch_has_its_rollouts_as_children() -> None:
    with collected_tree() as tree:
        await rolled_out(3)
    nodes = list(tree)
    (batch,) = [each for each in nodes if isinstance(each.designator, BatchRolloutActionPerformable)]
    assert [type(each.designator).__name__ for each in nodes if each.parent is batch] == [
        "MoveAndPickUpPerformable"
    ] * 3


def test_rates_come_with_an_interval() -> None:
    """Wilson's, by the formula's textbook values for 7 of 10, and none without rollouts."""
    low, high = Tally(7, Counter({"IKError": 3})).interval
    assert [low, high] == pytest.approx([0.3968, 0.8922], abs=1e-4)
    assert Tally().interval == (0.0, 1.0)
    assert Tally().success_rate != Tally().success_rate  # NaN


def test_missing_rollouts_are_listed_in_runs() -> None:
    assert list(rollouts.missing_runs([], 5, length_max=2)) == [(0, 2), (2, 2), (4, 1)]
    assert list(rollouts.missing_runs([0, 1, 5], 8, length_max=10)) == [(2, 3), (6, 2)]
    assert list(rollouts.missing_runs(range(8), 8, length_max=10)) == []
    assert list(rollouts.missing_runs([9], 3, length_max=10)) == [(0, 3)]
