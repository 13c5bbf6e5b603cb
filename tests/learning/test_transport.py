"""Transports in the ways that experience prefers: an end in mind, nothing impossible tried, every try another way."""

from __future__ import annotations

import asyncio
import math
from collections.abc import AsyncIterator, Iterator, Sequence
from contextlib import suppress
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from sqlalchemy import select

from bench import tasks
from pycrorm_async import Memory
from pycrorm_async.errors import CallerError
from pycrorm_async.learning import Disturbance, SuccessModel, TransportPolicy, name_of
from pycrorm_async.learning.move_and_pick_up import PredictedPickUpPerformable
from pycrorm_async.learning.policy import PickUpChoice
from pycrorm_async.learning.transport import held_grasp
from pycrorm_async.orm import TransportAction as TransportRow
from pycrorm_async.plan import (
    PickUpActionPerformable,
    PlanFailure,
    Retry,
    TransportAction,
    locations,
)
from pycrorm_async.plan.actions import MoveAndPickUpPerformable
from pycrorm_async.plan.failures import ReachabilityFailure
from pycrorm_async.plan.locations import Location, PlaceReach, face
from pycrorm_async.plan.objects import require_robot
from pycrorm_async.plan.task import collected_tree
from pycrorm_async.task_status import TaskStatus
from pycrorm_async.world import Arms, Grasp, Pose

pytestmark = pytest.mark.slow

ARMS = [Arms.LEFT, Arms.RIGHT]
SOLVABLE = (0, 4, 8)
"""Tasks of seed 69 that have many solutions."""


def policy(number: int = 0, **options: Any) -> TransportPolicy:
    return TransportPolicy(rng=np.random.default_rng((69, number, 3)), **options)


async def test_what_is_picked_up_is_placed_and_nothing_fails_on_the_way(tmp_path: Path) -> None:
    with tasks.kitchen(Disturbance()) as here:
        async with Memory.open(f"sqlite:///{tmp_path}/tasks.db") as memory:
            for number in SOLVABLE:
                thing, goal = here.prepare(69, number)
                async with memory.episode(description="task"):
                    with collected_tree() as tree:
                        transport = await TransportAction(thing, ARMS, [goal], policy=policy(number)).resolve()  # type: ignore[misc]
                        await transport.perform()
                np.testing.assert_allclose(thing.pose.position, goal.position, atol=1e-6)
                assert abs(np.dot(thing.pose.orientation, goal.orientation)) == pytest.approx(1, abs=1e-6)
                assert {each.status for each in tree} == {TaskStatus.SUCCEEDED}
            await memory.flush()
            async with memory.session() as session:
                assert len((await session.scalars(select(TransportRow))).all()) == len(SOLVABLE)


async def test_a_task_ends_the_same_in_any_order_and_world() -> None:
    def ends(numbers: list[int]) -> dict[int, Any]:
        return dict(zip(numbers, tasks.job("random, checked", None, tasks.ERRORS, 69, numbers), strict=True))

    forth, back = [await asyncio.to_thread(ends, each) for each in ([0, 4], [4, 0])]
    assert forth == back
    assert any(each.placed for each in forth.values())


async def test_the_next_try_delivers_what_is_held_from_another_place() -> None:
    with tasks.kitchen(Disturbance()) as here:
        thing, goal = here.prepare(69, 4)
        way = await anext(policy(4).fetching(thing, ARMS, goal))
        await way.perform()
        places, reached = [], False
        async for each in TransportAction(thing, ARMS, [goal], policy=policy(4, checked=False)):
            assert each.arm is way.arm
            with collected_tree() as tree, suppress(PlanFailure):
                await each.perform()
                reached = True
            assert not [node for node in tree if isinstance(node.designator, PickUpActionPerformable)]
            places.append(here.robot.pose)
            if reached or len(places) == 4:
                break
        assert len(places) > 1
        assert len(set(places)) == len(places)


async def test_ways_start_from_where_the_object_is_after_it_has_moved() -> None:
    with tasks.kitchen(Disturbance()) as here:
        for number in SOLVABLE:
            thing, goal = here.prepare(69, number)
            tries = aiter(TransportAction(thing, ARMS, [goal], policy=policy(number)))
            await anext(tries)  # it fails, say, and pushes the object across the table
            table = here.tables[0].pose
            x, y, z = thing.pose.relative_to(table).position
            thing.set_pose(table @ Pose((-x, y, z)))
            await (await anext(tries)).perform()
            np.testing.assert_allclose(thing.pose.position, goal.position, atol=1e-6)


async def test_tries_before_an_object_moved_count_after_it() -> None:
    class OnePlace(TransportPolicy):
        """Fetches from one place with one height of the torso, with every arm and grasp alike; places from anywhere."""

        def chances(self, choices: Sequence[PickUpChoice], _: Any) -> Iterator[Any]:
            if len({each.grasp for each in choices}) == 1:
                yield np.ones(len(choices))
                return
            preferred.extend(choices[:1])
            one = preferred[0]
            off = [math.dist(each[2:4], one[2:4]) if each.torso == one.torso else math.inf for each in choices]
            yield np.where(np.array(off) < 0.07, 1.0, 0.01)

    preferred: list[PickUpChoice] = []
    holds = []
    with tasks.kitchen(Disturbance()) as here:
        thing, goal = here.prepare(69, 4)
        async for way in OnePlace(checked=False, rng=np.random.default_rng(4)).fetching(thing, ARMS, goal):
            holds.append((way.arm, way.grasp))
            if len(holds) == 8:
                break
            thing.set_pose(thing.pose @ Pose((0.001, 0.0, 0.0)))
    assert len(set(holds)) == 8


async def test_there_is_no_further_try_once_the_object_is_at_its_goal() -> None:
    tries = 0
    with tasks.kitchen(Disturbance()) as here:
        thing, goal = here.prepare(69, 4)
        async for each in TransportAction(thing, ARMS, [goal, goal @ Pose((0.1, 0.0, 0.0))], policy=policy(4)):
            tries += 1
            await each.perform()
    assert tries == 1


async def test_an_object_that_was_dropped_is_placed_as_it_is_held_after_the_next_try() -> None:
    class TwoGrasps(TransportPolicy):
        """Fetches with one grasp and then with another; the only place for the first grasp is out of reach."""

        async def fetching(self, target: Any, arms: Any, goal: Pose) -> AsyncIterator[MoveAndPickUpPerformable]:
            grasps = set()
            async for way in super().fetching(target, arms, goal):
                if way.grasp not in grasps:
                    grasps.add(way.grasp)
                    yield way

        def placing(self, held: Any, arm: Arms, goal: Pose) -> Any:
            asked.append(held_grasp(require_robot(), arm, held))
            return super().placing(held, arm, goal if len(asked) > 1 else Pose((0.0, 0.0, 3.0)))

    asked: list[Grasp] = []
    with tasks.kitchen(Disturbance()) as here:
        thing, goal = here.prepare(69, 4)
        start = thing.pose
        tries = aiter(TransportAction(thing, [Arms.LEFT], [goal], policy=TwoGrasps(rng=np.random.default_rng(4))))
        with pytest.raises(ReachabilityFailure, match="no other place to stand"):
            await (await anext(tries)).perform()
        here.robot.detach(thing)
        thing.set_pose(start)
        await (await anext(tries)).perform()
        np.testing.assert_allclose(thing.pose.position, goal.position, atol=1e-6)
    assert len(set(asked)) == 2


async def test_the_only_place_is_found_with_the_torso_at_its_limit() -> None:
    with tasks.kitchen(Disturbance()) as here:
        thing, goal = here.prepare(69, 1)  # cereal at 1.14 m, which the gripper takes from the front and from above
        way = await anext(policy(1).fetching(thing, ARMS, goal))
        assert isinstance(way, PredictedPickUpPerformable)
        assert (way.grasp, way.torso) == (Grasp.FRONT, 0.33)
        await way.perform()
        assert thing in here.robot.attachments


async def test_the_base_is_turned_where_no_place_facing_the_goal_serves() -> None:
    with tasks.kitchen(Disturbance()) as here:
        thing, goal = here.prepare(69, 20)
        ways = TransportPolicy(rng=np.random.default_rng((69, 20, 5)))
        places = ways.places(thing, goal).of(Arms.LEFT, Grasp.RIGHT)
        place = next(each for each, _ in places if isinstance(each, Location))
        facing = face(place.pose, goal, height_m=0.0)
        assert abs(math.remainder(place.pose.yaw - facing.yaw, math.tau)) > 0.1


async def test_a_policy_is_asked_with_async_for_and_says_so() -> None:
    with tasks.kitchen(Disturbance()) as here:
        thing, goal = here.prepare(69, 4)
        with pytest.raises(CallerError, match="iterate with `async for`"):
            next(iter(TransportAction(thing, ARMS, [goal], policy=policy())))
        with pytest.raises(PlanFailure, match=r"no way to fetch .* placed at its goal"):
            await Retry(TransportAction(thing, ARMS, [Pose((0, 0, 3))], policy=policy()), max_tries=2).perform()
        with pytest.raises(ReachabilityFailure, match="no place to stand and place"):
            policy().placing(thing, Arms.LEFT, Pose((0, 0, 3))).resolve()


async def test_other_tasks_run_while_a_way_or_a_place_is_searched(monkeypatch: pytest.MonkeyPatch) -> None:
    turns = 0

    async def count_turns() -> None:
        nonlocal turns
        while True:
            await asyncio.sleep(0)
            turns += 1

    def refuse(*_: Any, **__: Any) -> PlaceReach:
        return PlaceReach(refusal="no")

    with tasks.kitchen(Disturbance()) as here:
        thing, goal = here.prepare(69, 4)
        way = await anext(policy(4).fetching(thing, ARMS, goal))
        counting = asyncio.create_task(count_turns())
        monkeypatch.setattr(locations, "reaching_arms", refuse)
        assert [each async for each in policy().fetching(thing, ARMS, goal)] == []
        assert turns > 100
        await way.perform()
        turns = 0
        transport = await TransportAction(thing, ARMS, [goal], policy=policy()).resolve()  # type: ignore[misc]
        with pytest.raises(ReachabilityFailure, match="no other place to stand"):
            await transport.perform()
        counting.cancel()
    assert turns > 100


async def test_a_model_of_another_robot_is_refused_where_no_way_is_possible() -> None:
    model = SuccessModel("grasp-polar", 1, 1.0, (), "courier", 100, 40)
    with tasks.kitchen(Disturbance()) as here:
        thing, _ = here.prepare(69, 4)
        with pytest.raises(CallerError, match="was learned from pick-ups of courier"):
            await anext(TransportPolicy(model).fetching(thing, ARMS, Pose((0, 0, 3))))


async def test_where_nothing_is_remembered_recall_is_followed_by_the_model() -> None:
    model = SuccessModel("grasp-polar", 1, 1.0, (), None, 100, 40)
    async with Memory.open("sqlite://"):
        with tasks.kitchen(Disturbance()) as here:
            thing, goal = here.prepare(69, 4)
            way = await anext(TransportPolicy(model, recall=True).fetching(thing, ARMS, goal))
    assert way.policy == name_of(model)


async def test_the_grasp_of_a_held_object_is_known_from_the_hand() -> None:
    grasps = set()
    with tasks.kitchen(Disturbance()) as here:
        for number in (0, 20):
            thing, goal = here.prepare(69, number)
            way = await anext(policy(number).fetching(thing, ARMS, goal))
            await way.perform()
            assert held_grasp(require_robot(), way.arm, thing) is way.grasp
            grasps.add(way.grasp)
    assert len(grasps) > 1
