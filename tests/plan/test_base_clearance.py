"""Collision checks of the base: no candidate collides, and driving into an obstacle fails, where collisions count."""

from __future__ import annotations

import itertools
import math
import random
from collections.abc import Iterator, Sequence
from contextlib import contextmanager

import numpy as np
import pytest

from pycrorm_async.learning.rollouts import MoveAndPickUp
from pycrorm_async.plan import (
    AccessingLocation,
    CostmapLocation,
    DatabaseCostmapLocation,
    FaceAtPerformable,
    NavigateActionPerformable,
    ObjectPart,
    SemanticCostmapLocation,
    simulated_robot,
)
from pycrorm_async.plan.execution import Cells
from pycrorm_async.plan.failures import NavigationGoalInCollision, ObjectUnreachable
from pycrorm_async.plan.locations import opening_poses
from pycrorm_async.plan.motions import simulated_robot_within
from pycrorm_async.plan.objects import require_robot
from pycrorm_async.plan.task import PastSuccess
from pycrorm_async.world import Arms, BulletWorld, Grasp, Object, ObjectType, Pose
from pycrorm_async.world.models import box_urdf
from pycrorm_async.world.pose import yaw_quaternion
from pycrorm_async.world.urdf import Limits
from tests import bullet
from tests.plan.conftest import Scene
from tests.plan.fake_observer import Recording

SEED = 20261123
SCENES = 200
TOUCH_M = 1e-3
AWAY = Pose([-4.0, -4.0, 0.0])


@contextmanager
def colliding() -> Iterator[None]:
    with simulated_robot_within(Limits.SOFT, collisions=True):
        yield


def table(rng: random.Random, name: str, x: float, y: float) -> tuple[Object, float, float, float]:
    """A table of any size, height and heading: a closed box, or a top that floats as if on thin legs."""
    half_x, half_y, height = rng.uniform(0.3, 0.8), rng.uniform(0.3, 0.5), rng.uniform(0.6, 0.9)
    bottom = 0.0 if rng.random() < 0.5 else height - 0.05
    urdf = box_urdf(name, x=(-half_x, half_x), y=(-half_y, half_y), z=(bottom, height))
    pose = Pose([x, y, 0.0], yaw_quaternion(rng.uniform(-math.pi, math.pi)))
    return Object(name, ObjectType.GENERIC_OBJECT, urdf, pose), half_x, half_y, height


@contextmanager
def table_scene(seed: int) -> Iterator[tuple[Object, Object, Object]]:
    """The robot away from one to three tables, and a milk on the first."""
    rng = random.Random(seed)
    with BulletWorld(), colliding():
        robot = Object("pr2", ObjectType.ROBOT, pose=AWAY)
        robot.set_joint_position("torso_lift_joint", rng.uniform(0.0, 0.3))
        first, half_x, half_y, height = table(rng, "table", 0.0, 0.0)
        for number in range(rng.randint(0, 2)):
            table(rng, f"table {number}", rng.uniform(-2, 2), rng.uniform(-2, 2))
        on_table = Pose(
            [rng.uniform(0.05 - half_x, half_x - 0.05), rng.uniform(0.05 - half_y, half_y - 0.05), height + 0.1],
            yaw_quaternion(rng.uniform(-math.pi, math.pi)),
        )
        yield robot, first, Object("milk", ObjectType.MILK, pose=first.pose @ on_table)


def collisions(obj: Object, links: Sequence[str] | None = None) -> set[str]:
    """Bullet's own answer: the objects that these links, or all, are in where the object is now."""
    numbers = [obj.body.link_number(each) for each in (obj.links if links is None else links)]
    return {
        other.name
        for other in obj.world.objects
        if other is not obj
        for number in numbers
        for point in bullet.getClosestPoints(
            obj.body.number, other.body.number, 0.0, number, physicsClientId=obj.world.client
        )
        if point[8] < -TOUCH_M
    }


def base_collisions(robot: Object, pose: Pose) -> set[str]:
    robot.set_pose(pose)
    try:
        return collisions(robot, ["base_link", "torso_lift_link", "head_pan_link", "head_tilt_link"])
    finally:
        robot.set_pose(AWAY)


class Successes:
    """Experience with many past successes all around the object."""

    async def successes(self, object_type: ObjectType, *, arm: Arms | None, **_: object) -> list[PastSuccess]:
        angles = [number * math.tau / 12 for number in range(12)]
        return [
            PastSuccess(Arms.LEFT, Grasp.FRONT, None, Pose([r * math.cos(a), r * math.sin(a), 0], yaw_quaternion(b)), 1)
            for r in (0.5, 0.7)
            for a in angles
            for b in (0.0, 1.0, a)
        ]


@pytest.mark.slow
@pytest.mark.soak_on(*range(1, 8))
@pytest.mark.parametrize("part", range(8))
async def test_at_no_offered_place_is_the_base_in_collision_in_two_hundred_table_scenes(part: int) -> None:
    offering = dict.fromkeys(("costmap", "seeing", "experience", "policy", "surface"), 0)
    for seed in range(SEED + part * SCENES // 8, SEED + (part + 1) * SCENES // 8):
        with table_scene(seed) as (robot, support, milk):
            places = {
                "costmap": [each.pose for each in itertools.islice(CostmapLocation(milk, reachable_for=robot), 3)],
                "seeing": [each.pose for each in itertools.islice(CostmapLocation(milk, visible_for=robot), 3)],
            }
            remembered = await DatabaseCostmapLocation(milk, experience=Successes()).remembered()
            places["experience"] = [each.pose for each in remembered]
            try:
                samples = list(MoveAndPickUp(milk, samples=5, rng=np.random.default_rng(seed)))
            except ObjectUnreachable:
                samples = []
            places["policy"] = [each.standing_position for each in samples]
            for kind, poses in places.items():
                offering[kind] += bool(poses)
                for pose in poses:
                    assert not base_collisions(robot, pose), (seed, kind, pose)
            for sample in samples[:2]:
                await NavigateActionPerformable(sample.standing_position).perform()
                await FaceAtPerformable(milk.pose).perform()
            robot.set_pose(AWAY)
            bowl = Object("bowl", ObjectType.BOWL, pose=Pose([9, 9, 0]))
            surfaces = list(itertools.islice(SemanticCostmapLocation("table", support, bowl), 5))
            offering["surface"] += bool(surfaces)
            for pose in (each.pose for each in surfaces):
                bowl.set_pose(pose)
                assert not collisions(bowl), (seed, pose)
    assert all(count > SCENES / 8 * 0.6 for count in offering.values()), offering


@pytest.mark.slow
def test_places_to_open_a_drawer_are_clear_of_the_kitchen(scene: Scene) -> None:
    """The second heading of each place, turned by 45 degrees, needs the room of the base's corners."""
    scene.robot.set_pose(AWAY)
    handle = ObjectPart("sink_area_drawer_handle", scene.kitchen)
    with colliding():
        assert AccessingLocation(handle, scene.robot).resolve().reachable_arms
        found = itertools.islice(opening_poses(handle, scene.robot, None), 1_201)
        searched = [each for each in found if not isinstance(each, Cells)]
    refused = [pose for pose, reach in searched if (reach.refusal or "").startswith("base in collision with kitchen")]
    assert 0 < len(refused) < len(searched) / 4
    for pose, _ in searched:
        assert pose in refused or not base_collisions(scene.robot, pose)
    assert any(base_collisions(scene.robot, pose) for pose in refused)


async def test_driving_into_furniture_fails_where_collisions_count_and_nothing_moves(scene: Scene) -> None:
    before = scene.world.save_state()
    goal = Pose([0.9, 0.0, 0.0])
    with (
        colliding(),
        pytest.raises(NavigationGoalInCollision, match="the base would be in kitchen with base_link") as failed,
    ):
        await NavigateActionPerformable(goal).perform()
    assert failed.value.data == ("base_link", "kitchen")
    assert scene.world.save_state() == before
    with simulated_robot:
        await NavigateActionPerformable(goal).perform()
    assert scene.robot.pose.position == goal.position


async def test_another_robot_has_the_footprint_of_its_own_model() -> None:
    """The courier's base is 0.5 m long and 0.44 m wide, so that it comes nearer to the counter than a PR2."""
    with BulletWorld(), colliding():
        courier = Object("courier", ObjectType.ROBOT)
        Object("kitchen", ObjectType.ENVIRONMENT)
        milk = Object("milk", ObjectType.MILK, pose=Pose([1.3, 1, 0.9]))
        places = list(itertools.islice(CostmapLocation(milk, reachable_for=courier), 5))
        assert len(places) == 5
        for pose in (*(place.pose for place in places), Pose([0.78, -0.2, 0])):
            await NavigateActionPerformable(pose).perform()
        with pytest.raises(NavigationGoalInCollision):
            await NavigateActionPerformable(Pose([1.2, 0, 0])).perform()


async def test_a_base_that_fits_straight_may_not_fit_turned(scene: Scene) -> None:
    """The front of the counter is at x 1.03, the base reaches 0.325 m ahead and 0.46 m to its corners."""
    with colliding():
        await NavigateActionPerformable(Pose([0.69, 0.0, 0.0])).perform()
        with pytest.raises(NavigationGoalInCollision):
            await NavigateActionPerformable(Pose([0.69, 0.0, 0.0], yaw_quaternion(math.pi / 4))).perform()
    assert scene.robot.pose.yaw == 0.0


async def test_what_lies_on_the_base_counts_as_the_base_does(scene: Scene) -> None:
    crate = Object("crate", ObjectType.GENERIC_OBJECT, box_urdf("crate", x=(0, 0.5), y=(-0.1, 0.1), z=(0.4, 0.5)))
    scene.robot.attach(crate, "base_link")
    before = scene.world.save_state()
    with colliding(), pytest.raises(NavigationGoalInCollision, match="would be in kitchen with crate"):
        await NavigateActionPerformable(Pose([0.65, 0.0, 0.0])).perform()
    assert scene.world.save_state() == before


@pytest.mark.slow
def test_places_in_collision_are_refused_with_the_obstacle_and_only_where_collisions_count(scene: Scene) -> None:
    def reasons() -> set[str]:
        with Recording().listening() as recording:
            list(CostmapLocation(scene.milk, visible_for=scene.robot))
        return {each.reason for each in recording.refused[0] if each.reason.startswith("base in collision with ")}

    assert not reasons()
    with colliding():
        refusals = reasons()
    assert "base in collision with kitchen (sink_area_drawer_handle)" in refusals


async def test_a_past_success_inside_furniture_is_refused_with_the_obstacle(scene: Scene) -> None:
    with colliding(), Recording().listening() as recording:
        list(await DatabaseCostmapLocation(scene.milk, experience=Successes()).remembered())
    assert any(each.reason.startswith("base in collision with kitchen") for each in recording.refused[0])


def test_without_a_place_for_the_base_the_policy_raises() -> None:
    with BulletWorld(), colliding():
        Object("pr2", ObjectType.ROBOT, pose=AWAY)
        milk = Object("milk", ObjectType.MILK, pose=Pose([0, 0, 0.9]))
        for number, (x, y) in enumerate(itertools.product(np.arange(-2.5, 2.6, 0.5), repeat=2)):
            urdf = box_urdf("post", x=(-0.01, 0.01), y=(-0.01, 0.01), z=(0, 0.3))
            Object(f"post {number}", ObjectType.GENERIC_OBJECT, urdf, Pose([x, y, 0]))
        assert require_robot().body.pose == AWAY
        with pytest.raises(ObjectUnreachable):
            list(MoveAndPickUp(milk, rng=np.random.default_rng(1)))
