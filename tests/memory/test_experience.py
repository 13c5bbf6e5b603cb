"""The memory that a plan queries for experience, and the reference system's resolver, under its tests' names."""

from __future__ import annotations

import asyncio
import math
from collections.abc import AsyncIterator, Iterator
from contextlib import contextmanager
from pathlib import Path
from typing import NamedTuple

import numpy as np
import pytest
from sqlalchemy import select

from pycrorm_async import Memory, Reading
from pycrorm_async.errors import CallerError
from pycrorm_async.learning import MoveAndPickUp, PickUpChoice, RecalledPickUp, RecalledPickUpPerformable, Scene
from pycrorm_async.orm import LocationCandidate, LocationResolution
from pycrorm_async.plan import (
    DatabaseCostmapLocation,
    Location,
    MoveTCPMotion,
    MoveTorsoActionPerformable,
    NavigateActionPerformable,
    ParkArmsActionPerformable,
    PickUpActionPerformable,
    PlaceActionPerformable,
    simulated_robot,
)
from pycrorm_async.plan.failures import IKError
from pycrorm_async.plan.task import experience
from pycrorm_async.recall.experience import PickUpExperience
from pycrorm_async.world import Arms, BulletWorld, Grasp, Object, ObjectType, Pose
from pycrorm_async.world.pose import yaw_quaternion
from tests.memory.note_actions import url_of

pytestmark = pytest.mark.slow


# === database resolver ========================================================================================
#
# The four tests of the reference system's resolver, under their names: what succeeded is stored, and repeated.
#
# A first plan picks the milk up and records it. A second one, in a new world, uses only that memory.

STAND = Pose([0.6, 0.9, 0.0])
TORSO = 0.3


class ResolverScene(NamedTuple):
    robot: Object
    milk: Object


@contextmanager
def scene(*, kitchen: bool = False, milk: Pose | None = None) -> Iterator[ResolverScene]:
    """A new world with robot and milk."""
    with BulletWorld(), simulated_robot:
        robot = Object("pr2", ObjectType.ROBOT)
        if kitchen:
            Object("kitchen", ObjectType.ENVIRONMENT)
        yield ResolverScene(robot, Object("milk", ObjectType.MILK, pose=milk or Pose([1.3, 1, 0.9])))


@pytest.fixture
async def memory(tmp_path: Path) -> AsyncIterator[Memory]:
    """A memory of one success: the milk, from 0.7 m before it and 0.1 m aside, torso up, left arm, from the front."""
    async with Memory.open(url_of(tmp_path)) as memory:
        async with memory.episode(description="learning to pick up"):
            with scene(kitchen=True) as here:
                await NavigateActionPerformable(STAND).perform()
                await MoveTorsoActionPerformable(TORSO).perform()
                await PickUpActionPerformable(here.milk, Arms.LEFT, Grasp.FRONT).perform()
        await memory.flush()
        yield memory


async def picked_up(place: Location | None, milk: Object) -> Location:
    """Pick it up from the resolved location."""
    assert place is not None
    assert place.grasp is not None
    assert place.torso_height is not None
    await NavigateActionPerformable(place.pose).perform()
    await MoveTorsoActionPerformable(place.torso_height).perform()
    await PickUpActionPerformable(milk, place.reachable_arms[0], place.grasp).perform()
    return place


async def test_costmap_no_obstacles(memory: Memory) -> None:
    with scene() as here:
        place = await picked_up(await DatabaseCostmapLocation(here.milk, here.robot).resolve(), here.milk)
        assert place.pose.distance(STAND) < 1e-9
        assert (place.reachable_arms, place.grasp, place.torso_height) == ((Arms.LEFT,), Grasp.FRONT, TORSO)
        assert here.robot.pose.distance(STAND) < 1e-9
        assert here.robot.attachments == {here.milk: "l_gripper_tool_frame"}


async def test_costmap_with_obstacles(memory: Memory) -> None:
    with scene(kitchen=True) as here:
        await picked_up(await DatabaseCostmapLocation(here.milk, here.robot).resolve(), here.milk)
        assert here.milk.attached_to is here.robot
        here.robot.detach(here.milk)
        # Rotated with the object, the base would be at (2.0, 1.1): less than 0.3 m behind the kitchen's wall.
        here.milk.set_pose(Pose([1.3, 1, 0.9], yaw_quaternion(math.pi)))
        assert await DatabaseCostmapLocation(here.milk, here.robot).resolve() is None


async def test_object_at_different_location(memory: Memory) -> None:
    turned = yaw_quaternion(math.pi)
    with scene(kitchen=True, milk=Pose([-1.35, 1.1, 0.95], turned)) as here:
        place = await picked_up(await DatabaseCostmapLocation(here.milk, here.robot).resolve(), here.milk)
        # Rotated on the island: 0.7 m from it on the other side, 0.1 m to the other hand.
        assert place.pose.position == pytest.approx((-1.35 + 0.7, 1.1 + 0.1, 0.0))
        assert abs(place.pose.yaw) == pytest.approx(math.pi)
        await PlaceActionPerformable(here.milk, Arms.LEFT, Pose([-1.3, 1.2, 0.95], turned)).perform()
        assert here.milk.pose.distance(Pose([-1.3, 1.2, 0.95])) < 1e-6
        assert here.milk.attached_to is None


async def test_multiple_objects(memory: Memory) -> None:
    with scene(kitchen=True) as here:
        other = Object("other milk", ObjectType.MILK, pose=Pose([1.3, 0.2, 0.93]))
        bowl = Object("bowl", ObjectType.BOWL, pose=Pose([1.3, 0.6, 0.9]))
        before = here.robot.world.save_state()
        for milk in (here.milk, other):
            place = await picked_up(await DatabaseCostmapLocation(milk, here.robot).resolve(), milk)
            assert place.pose.position == pytest.approx((0.6, milk.original_pose.position.y - 0.1, 0.0))
            assert here.robot.attachments == {milk: "l_gripper_tool_frame"}
            here.robot.world.restore_state(before)
        assert await DatabaseCostmapLocation(bowl, here.robot).resolve() is None


async def test_the_choice_is_recorded_with_grasp_and_torso_height(memory: Memory) -> None:
    async with memory.episode(description="doing it again"):
        with scene(kitchen=True) as here:
            await ParkArmsActionPerformable(Arms.BOTH).perform()
            place = await DatabaseCostmapLocation(here.milk, here.robot, Arms.LEFT).resolve()
            assert place is not None
            assert await DatabaseCostmapLocation(here.milk, here.robot, Arms.RIGHT).resolve() is None
    await memory.flush()
    async with memory.session() as session:
        chosen, none = (await session.scalars(select(LocationResolution).order_by(LocationResolution.id))).all()
        (candidate,) = (await session.scalars(select(LocationCandidate))).all()
    assert (chosen.location, chosen.considered, chosen.offered, chosen.taken) == ("DatabaseCostmapLocation", 1, 1, 0)
    assert (none.location, none.considered, none.offered, none.taken) == ("DatabaseCostmapLocation", 0, 0, None)
    assert (candidate.x, candidate.y, candidate.z) == pytest.approx((0.6, 0.9, 0.0))
    assert (candidate.grasp, candidate.torso_height, candidate.taken) == (Grasp.FRONT, TORSO, True)
    assert candidate.reachable_arms == [Arms.LEFT]


# === experience ===============================================================================================
#
# The memory that a plan queries for experience, and the experience that is visible in it.


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
            assert isinstance(first, RecalledPickUpPerformable)
            assert (first.chosen_by, first.grasp) == ("recall", Grasp.FRONT)  # two successes beside each other
            with monkeypatch.context() as patched, pytest.raises(IKError):
                patched.setattr(MoveTCPMotion, "perform", fail)
                await first.perform()
            stage.reset()
            second = await anext(alternatives)
            assert isinstance(second, RecalledPickUpPerformable)
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
