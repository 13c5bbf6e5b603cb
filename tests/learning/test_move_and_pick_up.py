"""MoveAndPickUp with a policy: its alternatives, and the base poses that they have."""

from __future__ import annotations

import math
from collections.abc import Iterator

import numpy as np
import pytest
from msgspec.structs import replace

from pycrorm_async.errors import CallerError, ImpossibleCondition
from pycrorm_async.learning import MoveAndPickUp, Policy, Rectangle, Region, Scene, default_policy
from pycrorm_async.learning.policy import GRASPS, Leaf, Linear, PickUpChoice
from pycrorm_async.learning.rollouts import Stage, free_and_visible, rectangles
from pycrorm_async.plan import MoveTCPMotion, Retry
from pycrorm_async.plan.failures import ManipulationGoalInCollision, NoRobotHere, ObjectUnreachable
from pycrorm_async.plan.objects import require_robot
from pycrorm_async.world import Arms, BulletWorld, Grasp, Object, ObjectType, Pose
from pycrorm_async.world.bullet_body import engine
from pycrorm_async.world.urdf import PR2

IN_KITCHEN = Scene(kitchen=True, torso_height=0.3)


@pytest.fixture
def stage() -> Iterator[Stage]:
    with Scene().entered() as there:
        yield there


@pytest.fixture
def kitchen() -> Iterator[Stage]:
    with IN_KITCHEN.entered() as there:
        yield there


def at(x: float, y: float, *, height: tuple[float, float] | None = None) -> Policy:
    """A policy whose samples are all within one square millimetre."""
    here, there = (Linear((each - 5e-4, each + 5e-4), (0.0, 1.0)) for each in (x, y))
    torso_range = None if height is None else Linear(height, (0.0, 1.0))
    return Policy((Leaf(1.0, (0.5, 0.5), (0.25,) * len(GRASPS), here, there, torso_range),))


def seen_from_object(target: Pose, base: Pose) -> tuple[float, float]:
    """Return, by trigonometry, the base position in the axes of an upright object."""
    dx, dy = base.position.x - target.position.x, base.position.y - target.position.y
    turned = -2 * math.atan2(target.orientation.z, target.orientation.w)
    return dx * math.cos(turned) - dy * math.sin(turned), dx * math.sin(turned) + dy * math.cos(turned)


@pytest.mark.parametrize("degrees", [0, 90, -135])
def test_the_base_has_the_chosen_position_in_the_objects_own_axes(degrees: float) -> None:
    with Scene(position=(-0.4, 2.0, 0.8), yaw=math.radians(degrees)).entered() as there:
        action = MoveAndPickUp(there.target)
        done = action.chosen(PickUpChoice(Arms.RIGHT, Grasp.LEFT, -0.6, 0.25))
        assert (done.arm, done.grasp) == (Arms.RIGHT, Grasp.LEFT)
        assert done.standing_position.position.z == pytest.approx(0, abs=1e-12)
        assert seen_from_object(there.target.pose, done.standing_position) == pytest.approx((-0.6, 0.25))


def test_for_a_tilted_object_the_base_is_on_the_floor_below_the_chosen_position(stage: Stage) -> None:
    leaning = Pose([1.3, 1.0, 0.9], [0.2, -0.1, 0.3, 0.9])
    stage.target.set_pose(leaning)
    stand = MoveAndPickUp(stage.target).chosen(PickUpChoice(Arms.LEFT, Grasp.FRONT, 0.5, -0.4)).standing_position
    assert stand.position.z == pytest.approx(0, abs=1e-12)
    assert stand.relative_to(leaning).position[:2] == pytest.approx((0.5, -0.4))
    stage.target.set_pose(Pose([1.3, 1.0, 0.9], [1, 0, 0, 1]))
    with pytest.raises(ObjectUnreachable, match="milk lies on its side"):
        MoveAndPickUp(stage.target).chosen(PickUpChoice(Arms.LEFT, Grasp.FRONT, 0.5, -0.4))


def test_plain_samples_are_those_of_the_policy_and_the_generator_is_the_callers(stage: Stage) -> None:
    np.random.seed(1)
    before = np.random.get_state()[1].copy()  # type: ignore[index]
    drawn = default_policy().sample(np.random.default_rng(3), 7)
    action = MoveAndPickUp(stage.target, samples=7, rng=np.random.default_rng(3))
    got = list(action.plain())
    assert [(each.arm, each.grasp) for each in got] == [each[:2] for each in drawn]
    for each, choice in zip(got, drawn, strict=True):
        assert seen_from_object(stage.target.pose, each.standing_position) == pytest.approx(choice[2:])
    assert (np.random.get_state()[1] == before).all()  # type: ignore[index]


def test_only_the_requested_arms_and_grasps_are_sampled(stage: Stage) -> None:
    action = MoveAndPickUp(stage.target, [Arms.RIGHT], [Grasp.TOP, Grasp.LEFT], samples=40)
    assert {each.arm for each in action.plain()} == {Arms.RIGHT}
    assert {each.grasp for each in action.plain()} == {Grasp.TOP, Grasp.LEFT}
    with pytest.raises(ImpossibleCondition):
        MoveAndPickUp(stage.target, [])
    with pytest.raises(CallerError, match="samples must be >= 1, got 0"):
        MoveAndPickUp(stage.target, samples=0)


def test_samples_for_the_scene_are_free_of_obstacles_and_see_the_object(kitchen: Stage) -> None:
    action = MoveAndPickUp(kitchen.target, samples=60, rng=np.random.default_rng(1))
    stands = [each.standing_position for each in action]
    assert len(stands) == 60
    anywhere = MoveAndPickUp(kitchen.target, samples=60, rng=np.random.default_rng(1)).plain()
    clear = [each for each in anywhere if nearest_furniture(kitchen, each.standing_position) >= 0.25]
    assert len(clear) < 50  # otherwise the kitchen would block no sample
    for stand in stands:
        assert nearest_furniture(kitchen, stand) >= 0.25  # 0.3 m, but for half the diagonal of a cell
        eye = (stand.position.x, stand.position.y, 1.45)
        assert kitchen.world.visible(kitchen.target, eye, ignore={kitchen.robot}) > 0


def nearest_furniture(stage: Stage, stand: Pose) -> float:
    """Return Bullet's distance between the kitchen and a thin post at that place, as high as the robot."""
    bullet, client = engine(), stage.world.client
    shape = bullet.createCollisionShape(bullet.GEOM_CYLINDER, radius=0.001, height=1.6, physicsClientId=client)
    post = bullet.createMultiBody(
        baseCollisionShapeIndex=shape, basePosition=(*stand.position[:2], 0.9), physicsClientId=client
    )
    points = bullet.getClosestPoints(post, stage.world.object("kitchen").body.number, 5.0, physicsClientId=client)
    bullet.removeBody(post, physicsClientId=client)
    return float(min(point[8] for point in points))


def test_the_most_likely_samples_come_first(kitchen: Stage) -> None:
    action = MoveAndPickUp(kitchen.target, samples=30, rng=np.random.default_rng(2))
    densities = []
    for each in action:
        x, y = seen_from_object(kitchen.target.pose, each.standing_position)
        densities.append(math.exp(-(x**2) - y**2))  # the default policy's, up to a constant
    assert densities == sorted(densities, reverse=True)
    assert len(set(densities)) == 30
    assert action.resolve() is not None


def test_a_sequence_that_begins_with_the_mode_starts_where_the_density_is_highest(stage: Stage) -> None:
    crowded, thin = at(-0.6, 0.0).leaves[0], at(0.6, 0.0).leaves[0]
    policy = Policy((replace(thin, weight=0.3), replace(crowded, weight=0.7)))
    action = MoveAndPickUp(stage.target, policy=policy, samples=20)
    places = [seen_from_object(stage.target.pose, each.standing_position) for each in action.from_mode()]
    assert places == [pytest.approx((-0.6, 0.0), abs=1e-3)] * 20


def test_an_object_without_a_free_base_position_is_unreachable(kitchen: Stage) -> None:
    inside = MoveAndPickUp(kitchen.target, policy=at(0.1, -0.3))  # in the worktop
    with pytest.raises(ObjectUnreachable, match="no way to pick up milk in this scene"):
        inside.resolve()
    with pytest.raises(ObjectUnreachable):
        list(inside.from_mode())
    assert len(list(inside.plain())) == 20  # whatever is around


def test_experience_with_other_heights_does_not_apply_to_this_one(stage: Stage) -> None:
    policy = at(-0.6, 0.0, height=(0.55, 0.65))
    with pytest.raises(ObjectUnreachable, match="no way to pick up milk at this height"):
        list(MoveAndPickUp(stage.target, policy=policy).plain())
    stage.robot.set_joint_position(PR2.torso_joint, 0.3)  # the milk is 0.6 m over it now
    assert len(list(MoveAndPickUp(stage.target, policy=policy).plain())) == 20


async def test_one_of_the_samples_succeeds_when_tried_in_turn(stage: Stage) -> None:
    action = MoveAndPickUp(stage.target, samples=60, rng=np.random.default_rng(69))
    await Retry(action, max_tries=60).perform()
    assert stage.target.attached_to is stage.robot


async def test_an_arm_that_would_be_in_the_furniture_is_a_failure_where_collisions_count() -> None:
    stand = Pose([0.63, 1.0, 0])
    for scene, raised in ((Scene(kitchen=True), None), (Scene(kitchen=True, collisions=True), "would be in kitchen")):
        with scene.entered() as there:
            x, y = seen_from_object(there.target.pose, stand)
            action = MoveAndPickUp(there.target).chosen(PickUpChoice(Arms.LEFT, Grasp.FRONT, x, y))
            if raised is None:
                await action.perform()
            else:
                with pytest.raises(ManipulationGoalInCollision, match=raised):
                    await action.perform()
                assert there.target.attached_to is None


async def test_a_held_object_counts_as_the_arm_does() -> None:
    with Scene(collisions=True).entered() as there:
        await MoveAndPickUp(there.target).chosen(PickUpChoice(Arms.LEFT, Grasp.FRONT, -0.67, 0.0)).perform()
        goal = there.robot.link_pose("l_gripper_tool_frame")
        await MoveTCPMotion(goal, Arms.LEFT, allow_gripper_collision=True).perform()
        Object("another", ObjectType.MILK, pose=there.target.pose)
        with pytest.raises(ManipulationGoalInCollision, match="would be in another with milk"):
            await MoveTCPMotion(goal, Arms.LEFT, allow_gripper_collision=True).perform()


def test_cells_become_rectangles_that_cover_them_once() -> None:
    cells = np.random.default_rng(1).random((80, 80)) < 0.7
    result = list(rectangles(cells))
    Region(tuple(result))  # refuses rectangles that overlap
    middles = (np.arange(80) + 0.5) * 0.05 - 2.0
    x, y = np.meshgrid(middles, middles, indexing="ij")
    covered = np.zeros((80, 80), dtype=int)
    for each in result:
        covered += (x > each.x_min) & (x < each.x_max) & (y > each.y_min) & (y < each.y_max)
    assert (covered == cells).all()
    whole = np.zeros((80, 80), dtype=bool)
    whole[10:20, 30:70] = True
    assert list(rectangles(whole)) == [pytest.approx(Rectangle(-1.5, -1.0, -0.5, 1.5))]
    assert not list(rectangles(np.zeros((80, 80), dtype=bool)))


@pytest.mark.parametrize("yaw", [math.pi / 2, 0.7])
def test_a_rotated_object_has_the_same_grounded_places_in_the_map(yaw: float) -> None:
    east, north = np.random.default_rng(1).uniform(-1.4, 1.4, (2, 4_000))
    inside = []
    for turn in (0.0, yaw):
        with Scene(kitchen=True, torso_height=0.3, yaw=turn).entered() as there:
            region = free_and_visible(require_robot(), there.target)
            x = math.cos(turn) * east + math.sin(turn) * north
            y = math.cos(turn) * north - math.sin(turn) * east
            inside.append(region.contains(x, y))
    assert 0.1 < inside[0].mean() < 0.9
    assert (inside[0] == inside[1]).mean() > 0.95  # but for cells on the edges


def test_without_a_world_or_a_robot_an_error_is_raised() -> None:
    with BulletWorld():
        milk = Object("milk", ObjectType.MILK)
        with pytest.raises(NoRobotHere, match="no robot in the world"):
            MoveAndPickUp(milk).resolve()
