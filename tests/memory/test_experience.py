"""The memory that a plan queries for experience, and the experience that is visible in it."""

from __future__ import annotations

import asyncio
from pathlib import Path

import numpy as np
import pytest

from pycrorm_async import Memory, Reading
from pycrorm_async.errors import CallerError
from pycrorm_async.learning import MoveAndPickUp, PickUpChoice, RecalledPickUp, Scene
from pycrorm_async.plan import (
    DatabaseCostmapLocation,
    Location,
    MoveTCPMotion,
    MoveTorsoActionPerformable,
    NavigateActionPerformable,
    PickUpActionPerformable,
)
from pycrorm_async.plan.failures import IKError
from pycrorm_async.plan.task import experience
from pycrorm_async.recall.experience import PickUpExperience
from pycrorm_async.world import Arms, BulletWorld, Grasp, Object, ObjectType, Pose
from tests.memory.test_database_resolver import STAND, TORSO, scene

pytestmark = pytest.mark.slow


async def pick_up(stand: Pose = STAND, *, torso: float = TORSO) -> None:
    with scene(kitchen=True) as here:
        await NavigateActionPerformable(stand).perform()
        await MoveTorsoActionPerformable(torso).perform()
        await PickUpActionPerformable(here.milk, Arms.LEFT, Grasp.FRONT).perform()


async def resolved_location(experience: PickUpExperience | None = None) -> Location | None:
    with BulletWorld():
        milk = Object("milk", ObjectType.MILK, pose=Pose([1.3, 1, 0.9]))
        return await DatabaseCostmapLocation(milk, experience=experience).resolve()


def place_of(location: Location | None) -> tuple[float, float]:
    assert location is not None
    return location.pose.position.x, location.pose.position.y


async def test_a_pick_up_counts_as_soon_as_it_has_ended_also_before_it_is_stored(tmp_path: Path) -> None:
    async with Memory.open(f"sqlite:///{tmp_path}/memory.db") as memory, memory.episode(description="trying"):
        assert await resolved_location() is None
        await pick_up()
        before = await resolved_location()
        assert place_of(before) == pytest.approx((0.6, 0.9))
        await memory.flush()
        assert await resolved_location() == before


async def test_a_failure_is_recalled_at_once_and_the_next_try_is_elsewhere(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    async def fail(_motion: MoveTCPMotion) -> None:
        raise IKError(Pose(), Arms.LEFT, "tool")

    with Scene(torso_height=0.3).entered() as stage:
        async with Memory.open(f"sqlite:///{tmp_path}/memory.db") as memory, memory.episode(description="trying"):
            for x, y, grasp in ((-0.70, 0.0, Grasp.FRONT), (-0.72, 0.0, Grasp.FRONT), (0.0, -0.7, Grasp.RIGHT)):
                await MoveAndPickUp(stage.target).chosen(PickUpChoice(Arms.LEFT, grasp, x, y)).perform()
                stage.reset()
            alternatives = aiter(RecalledPickUp(stage.target, rng=np.random.default_rng(1)))
            first = await anext(alternatives)
            assert (first.chosen_by, first.grasp) == ("recall", Grasp.FRONT)  # two successes beside each other
            with monkeypatch.context() as patched, pytest.raises(IKError):
                patched.setattr(MoveTCPMotion, "perform", fail)
                await first.perform()
            stage.reset()
            second = await anext(alternatives)
            assert (second.chosen_by, second.grasp) == ("recall", Grasp.RIGHT)  # and not the other one beside it
            assert first.expected_success is not None
            assert second.expected_success is not None
            assert second.expected_success < first.expected_success


async def test_experience_outlives_the_process_that_recorded_it(tmp_path: Path) -> None:
    async with Memory.open(f"sqlite:///{tmp_path}/memory.db"):
        await pick_up()
    async with Memory.open(f"sqlite:///{tmp_path}/memory.db"):
        assert place_of(await resolved_location()) == pytest.approx((0.6, 0.9))
    async with Reading.open(f"sqlite:///{tmp_path}/memory.db") as reading:
        assert place_of(await resolved_location(PickUpExperience.of(reading))) == pytest.approx((0.6, 0.9))


async def test_of_two_memories_the_one_with_an_open_episode_is_queried_or_else_the_one_opened_last(
    tmp_path: Path,
) -> None:
    async with Memory.open(f"sqlite:///{tmp_path}/old.db") as old:
        await pick_up()
        await old.flush()
        async with Memory.open(f"sqlite:///{tmp_path}/new.db"):
            assert await resolved_location() is None
            async with old.episode(description="remembering"):
                assert place_of(await resolved_location()) == pytest.approx((0.6, 0.9))
            assert await resolved_location() is None
        assert place_of(await resolved_location()) == pytest.approx((0.6, 0.9))
    assert experience.get() is None


async def test_a_closed_memory_is_no_longer_queried(tmp_path: Path) -> None:
    closed = asyncio.Event()

    async def later() -> Location | None:
        await closed.wait()
        return await resolved_location()

    async with Memory.open(f"sqlite:///{tmp_path}/memory.db"):
        task = asyncio.create_task(later())
        await asyncio.sleep(0)
    closed.set()
    with pytest.raises(CallerError, match="the memory is closed, so its experience cannot be read"):
        await task
    with pytest.raises(CallerError, match="queried from a memory"):
        await resolved_location()


async def test_the_location_with_the_better_success_rate_comes_first(tmp_path: Path) -> None:
    async with Memory.open(f"sqlite:///{tmp_path}/memory.db") as memory:
        async with memory.episode(description="trying"):
            await pick_up(Pose([0.65, 1.0, 0]))
            for _ in range(2):
                await pick_up(Pose([0.5, 0.8, 0]))
        await memory.flush()
        assert place_of(await resolved_location()) == pytest.approx((0.5, 0.8))
