"""A memory knows where each of its policies comes from, how often it was used, and how that ended."""

from __future__ import annotations

from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest

from pycrorm_async import Memory
from pycrorm_async.errors import CallerError
from pycrorm_async.events.types import Blob
from pycrorm_async.learning import MoveAndPickUp, Scene, batch_rollout, default_policy, name_of, record_policy
from pycrorm_async.learning.policy_cards import SuccessRate, read_card, read_policies
from pycrorm_async.learning.recorded_policy import CalibrationBin, Evaluation, HeldOut, read_policy
from pycrorm_async.plan import PlanFailure
from pycrorm_async.query.success import interval_95

LEARNED = replace(default_policy(), constant_height=0.25)
NAME = name_of(LEARNED)
EVALUATION = Evaluation(
    "pr2, real", 12, (HeldOut("seed", 2, 40, 20, 10, 9, 0.125, (CalibrationBin(0.8, 1.0, 0.9, 10, 9),)),), 0.45, 0.9
)


@pytest.mark.slow
async def test_a_card_has_the_origin_of_a_policy_and_the_success_of_what_it_chose(
    database_url: str, tmp_path: Path
) -> None:
    low = Scene(position=(1.3, 1.0, 0.3))
    async with Memory.open(database_url, spool=tmp_path / "spool") as memory:
        assert await read_policies(memory.reading) == []
        with Scene().entered() as stage:
            action = MoveAndPickUp(stage.target, policy=LEARNED)
            tally = await batch_rollout(action, 20, seed=1, scene=str(Scene()), reset=stage.reset)
            stage.reset()
            with pytest.raises(PlanFailure):  # one of a plan, in no batch
                while True:
                    await action.chosen(LEARNED.sample(np.random.default_rng(1))[0]).perform()
                    stage.reset()
        with low.entered() as stage:
            lower = await batch_rollout(
                MoveAndPickUp(stage.target, policy=LEARNED), 5, seed=1, scene=str(low), reset=stage.reset
            )
        await record_policy(
            memory, LEARNED, episodes=["a", "b"], successes=30, min_samples_leaf=25, rollouts=42, scene="here",
            seeds=[1, 2], evaluation=EVALUATION,
        )  # fmt: skip
        await memory.flush()

        [summary] = await read_policies(memory.reading)
        successes, tries = tally.successes + lower.successes, 26
        assert (summary.name, summary.kind, summary.robots, summary.objects) == (NAME, "tree", ("pr2",), ("MILK",))
        assert (summary.learned_from, summary.used) == (42, tries)
        assert summary.succeeded == SuccessRate(successes, tries, successes / tries, interval_95(successes, tries))

        card = await read_card(memory.reading, NAME[:4])
        assert card.summary == summary
        assert card.features == "arm, grasp, place; learned at 0.250 m over the torso"
        assert (card.size, card.evaluation) == (1, EVALUATION)
        [training] = card.trainings
        assert (training.successes, training.seeds, training.rounds, training.episode_ids) == (
            30,
            (1, 2),
            2,
            ("a", "b"),
        )
        assert {low: share.tries for low, share in card.heights.items()} == {0.3: 5, 0.9: 21}
        assert {scene: share.successes for scene, share in card.scenes.items()} == {
            str(Scene()): tally.successes,
            str(low): lower.successes,
        }


async def test_a_policy_that_cannot_be_read_is_named_and_refused_in_one_line(tmp_path: Path) -> None:
    newer = b'{"kind":"success model","features":"grasp-polar","features_version":99}'
    async with Memory.open(f"sqlite:///{tmp_path}/memory.db") as memory:
        async with memory.episode(description="of a newer version"):
            memory.observe("policy", {"abc1": Blob(newer, "application/json"), "abc2": Blob(b"nothing", "text/plain")})
        await memory.flush()
        assert [(each.name, each.kind) for each in await read_policies(memory.reading)] == [
            ("abc1", "not held"),
            ("abc2", "not held"),
        ]
        with pytest.raises(CallerError, match=r"abc1 cannot be read: .* grasp-polar, version 99"):
            await read_policy(memory.reading, "abc1")
        with pytest.raises(CallerError, match="the policy abc2 cannot be read: "):
            await read_policy(memory.reading, "abc2")
        with pytest.raises(CallerError, match=r"^2 policies begin with 'abc': abc1, abc2; give more digits$"):
            await read_card(memory.reading, "abc")
        with pytest.raises(CallerError, match=r"^the memory names no policy 'abd1'; did you mean abc1"):
            await read_card(memory.reading, "abd1")
