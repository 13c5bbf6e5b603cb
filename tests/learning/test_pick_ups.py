"""Pick-ups with a policy: the alternatives of MoveAndPickUp and RecalledPickUp, and the default policy."""

from __future__ import annotations

import inspect
import math
from collections.abc import Iterator, Sequence
from dataclasses import replace as replaced
from pathlib import Path

import msgspec
import numpy as np
import pytest
from msgspec.structs import replace
from sqlalchemy import select

from pycrorm_async import Memory
from pycrorm_async.errors import CallerError, ImpossibleCondition
from pycrorm_async.learning import (
    MoveAndPickUp,
    Policy,
    RecalledPickUp,
    RecalledPickUpPerformable,
    Rectangle,
    Region,
    Scene,
    SuccessModel,
    default_policy,
    name_of,
)
from pycrorm_async.learning.move_and_pick_up import free_and_visible, rectangles
from pycrorm_async.learning.policy import AROUND_OBJECT, GRASPS, Evidence, Leaf, Linear, PickUpChoice
from pycrorm_async.learning.scenes import Stage
from pycrorm_async.orm import Action
from pycrorm_async.plan import MoveTCPMotion, Retry, Sequential, simulated_robot
from pycrorm_async.plan.failures import (
    ManipulationGoalInCollision,
    NoRobotHere,
    NotResolved,
    ObjectUnreachable,
    PlanFailure,
)
from pycrorm_async.plan.objects import require_robot
from pycrorm_async.plan.task import PastSuccess
from pycrorm_async.world import Arms, BulletWorld, Grasp, Object, ObjectType, Pose
from pycrorm_async.world.engines.bullet import library
from pycrorm_async.world.models import box_urdf
from pycrorm_async.world.urdf import PR2
from tests.bullet import client_of

# === move and pick up =========================================================================================
#
# MoveAndPickUp with a policy: its alternatives, and the base poses that they have.

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
        assert seen_from_object(stage.target.pose, each.standing_position) == pytest.approx(choice[2:4])
    assert (np.random.get_state()[1] == before).all()  # type: ignore[index]


def test_only_the_requested_arms_and_grasps_are_sampled(stage: Stage) -> None:
    action = MoveAndPickUp(stage.target, [Arms.RIGHT], [Grasp.TOP, Grasp.LEFT], samples=40)
    assert {each.arm for each in action.plain()} == {Arms.RIGHT}
    assert {each.grasp for each in action.plain()} == {Grasp.TOP, Grasp.LEFT}
    with pytest.raises(ImpossibleCondition):
        MoveAndPickUp(stage.target, [])
    with pytest.raises(CallerError, match="samples must be >= 1, got 0"):
        MoveAndPickUp(stage.target, samples=0)


async def test_a_robot_with_one_arm_gets_no_samples_of_the_other() -> None:
    with BulletWorld(), simulated_robot:
        Object("courier", ObjectType.ROBOT)
        milk = Object("milk", ObjectType.MILK, pose=Pose([1.3, 1.0, 0.6]))
        for ways in (MoveAndPickUp(milk), MoveAndPickUp(milk, policy=SuccessModel.untrained())):
            assert {each.arm for each in ways} == {Arms.RIGHT}
        assert {each.arm for each in MoveAndPickUp(milk, [Arms.LEFT]).plain()} == {Arms.LEFT}  # fails with the reason
        async with Memory.open("sqlite://"):
            assert {each.arm async for each in RecalledPickUp(milk)} == {Arms.RIGHT}


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
    bullet, client = library(), client_of(stage.world)
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


# === default policy ===========================================================================================

RETAINED = 0.94107
"""The share of the normal distribution in the square and outside the hole: 0.9953² - 0.2227²."""


def density(x: np.ndarray, y: np.ndarray) -> np.ndarray:
    """Compute it by hand: a variance of 0.5 in both directions, cut to the possible base positions."""
    allowed = (np.maximum(abs(x), abs(y)) < 2.0) & (np.maximum(abs(x), abs(y)) > 0.2)
    return np.where(allowed, np.exp(-(x**2) - y**2) / math.pi, 0.0) / RETAINED


def integral(x_min: float, x_max: float, y_min: float, y_max: float) -> float:
    """Return the integral of that density, by the midpoints of 1000 x 1000 cells."""
    x, dx = np.linspace(x_min, x_max, 1000, endpoint=False, retstep=True)
    y, dy = np.linspace(y_min, y_max, 1000, endpoint=False, retstep=True)
    values = density(x[:, None] + dx / 2, y[None, :] + dy / 2)
    return float(values.sum() * dx * dy)


def test_the_hole_and_the_edges_leave_094107_of_the_normal_distribution() -> None:
    whole_plane = Policy(default_policy().leaves)
    assert whole_plane.probability(Evidence(region=AROUND_OBJECT)) == pytest.approx(RETAINED, abs=5e-6)


@pytest.mark.parametrize("corner", [(0.5, 1.0, -0.3, 0.4), (-2.0, -0.5, -2.0, 2.0), (0.0, 0.3, 0.0, 0.3)])
def test_probabilities_of_rectangles_are_the_integrals_of_the_density(corner: tuple[float, ...]) -> None:
    in_corner = Evidence(arms=frozenset({Arms.LEFT}), region=Region((Rectangle(*corner),)))
    assert default_policy().probability(in_corner) == pytest.approx(integral(*corner) / 2, rel=1e-3)


def test_its_mode_is_the_four_places_next_to_the_hole() -> None:
    mode = default_policy().mode()
    assert mode.evidence.arms == frozenset({Arms.LEFT, Arms.RIGHT})
    assert mode.evidence.grasps == frozenset(Grasp)
    assert mode.evidence.region is not None
    assert {tuple(round(edge, 9) for edge in each) for each in mode.evidence.region.rectangles} == {
        (-0.25, -0.2, -0.025, 0.025),
        (0.2, 0.25, -0.025, 0.025),
        (-0.025, 0.025, -0.25, -0.2),
        (-0.025, 0.025, 0.2, 0.25),
    }


def test_the_policy_is_the_same_at_every_height() -> None:
    conditioned = default_policy().condition(Evidence(height=(0.5, 0.6)))
    choices = default_policy().sample(np.random.default_rng(4), 10)
    assert conditioned.likelihood(choices).tolist() == default_policy().likelihood(choices).tolist()


# === recalled pick up =========================================================================================
#
# RecalledPickUp: ways of earlier tries by expected success, then the samples of a policy.


def way(
    x: float, y: float = 0.0, *, arm: Arms = Arms.LEFT, grasp: Grasp = Grasp.FRONT, score: float = 0.9,
    evidence: float = 1.0, prior: float = 0.2,
) -> PastSuccess:  # fmt: skip
    return PastSuccess(arm, grasp, 0.0, Pose([x, y, -0.9]), score, 1, evidence, prior)


class Known:
    """An experience with one answer for each time it is asked; the last answer stays."""

    def __init__(self, *answers: Sequence[PastSuccess]) -> None:
        self.answers = list(answers)
        self.asked: list[tuple[ObjectType, Arms | None, float | None, float | None]] = []

    async def successes(
        self, object_type: ObjectType, *, arm: Arms | None, height: float | None = None, torso: float | None = None
    ) -> Sequence[PastSuccess]:
        self.asked.append((object_type, arm, height, torso))
        return self.answers.pop(0) if len(self.answers) > 1 else self.answers[0]


def recalled(stage: Stage, experience: Known, **options: object) -> RecalledPickUp:
    return RecalledPickUp(stage.target, experience=experience, rng=np.random.default_rng(1), **options)  # type: ignore[arg-type]


async def alternatives(description: RecalledPickUp) -> list[RecalledPickUpPerformable]:
    return [each async for each in description if isinstance(each, RecalledPickUpPerformable)]


def offset(stage: Stage, action: RecalledPickUpPerformable) -> tuple[float, float]:
    x, y, _ = action.standing_position.relative_to(stage.target.pose).position
    return round(x, 3), round(y, 3)


async def test_ways_come_with_the_best_first_and_the_samples_of_the_policy_follow(stage: Stage) -> None:
    known = Known([way(-0.7), way(-0.6, 0.1, arm=Arms.RIGHT, grasp=Grasp.TOP, score=0.5)])
    first, second, *others = await alternatives(recalled(stage, known, samples=5))
    assert (offset(stage, first), first.arm, first.grasp) == ((-0.7, 0.0), Arms.LEFT, Grasp.FRONT)
    assert (first.chosen_by, first.expected_success) == ("recall", 0.9)
    assert (offset(stage, second), second.arm, second.grasp) == ((-0.6, 0.1), Arms.RIGHT, Grasp.TOP)
    assert [(each.chosen_by, each.expected_success) for each in others] == [("default policy", None)] * 5
    # It is asked again before each alternative, for this object at its height over the base.
    assert [each[:2] for each in known.asked] == [(ObjectType.MILK, None)] * 3
    assert [each[2:] for each in known.asked] == [pytest.approx((0.9, 0.0))] * 3


async def test_a_failure_changes_what_comes_next(stage: Stage) -> None:
    near, far = way(-0.7), way(0.6, score=0.4)
    known = Known([near, way(-0.71, score=0.85), far], [far, way(-0.71, score=0.3), way(-0.7, score=0.1)])
    first, second, third, *others = await alternatives(recalled(stage, known, samples=1))
    assert [offset(stage, each)[0] for each in (first, second, third)] == [-0.7, 0.6, -0.71]
    assert [each.chosen_by for each in others] == ["default policy"]  # the first way, tried already, is not repeated


async def test_what_is_expected_to_be_worse_than_an_average_try_is_left_to_the_policy(stage: Stage) -> None:
    poor, unknown = way(-0.7, score=0.19), way(-0.6, score=0.2, evidence=0.4)
    found = await alternatives(recalled(stage, Known([poor, unknown]), samples=2))
    assert [each.chosen_by for each in found] == ["default policy"] * 2


async def test_a_learned_policy_comes_before_the_default_policy_and_may_lack_the_height(stage: Stage) -> None:
    learned = default_policy().condition(Evidence(arms=frozenset({Arms.LEFT})))
    found = await alternatives(recalled(stage, Known([]), policy=learned, samples=2))
    assert [each.chosen_by for each in found] == [name_of(learned)] * 2 + ["default policy"] * 2
    at = Linear((0.1, 0.2), (0.0, 1.0))
    elsewhere = replaced(learned, leaves=tuple(msgspec.structs.replace(each, height=at) for each in learned.leaves))
    found = await alternatives(recalled(stage, Known([]), policy=elsewhere, samples=2))
    assert [each.chosen_by for each in found] == ["default policy"] * 2


async def test_only_allowed_arms_and_grasps_and_free_places_are_used(stage: Stage) -> None:
    ways = [way(-0.7), way(-0.7, arm=Arms.RIGHT), way(-0.7, arm=Arms.RIGHT, grasp=Grasp.TOP)]
    known = Known(ways)
    description = recalled(stage, known, arms=[Arms.RIGHT], grasps=[Grasp.TOP], samples=1)
    first, other = await alternatives(description)
    assert (first.arm, first.grasp, first.chosen_by) == (Arms.RIGHT, Grasp.TOP, "recall")
    assert (other.arm, other.grasp, other.chosen_by) == (Arms.RIGHT, Grasp.TOP, "default policy")
    assert {arm for _, arm, _, _ in known.asked} == {Arms.RIGHT}
    Object("crate", ObjectType.GENERIC_OBJECT, box_urdf("crate", x=(-0.2, 0.2), y=(-0.2, 0.2), z=(0, 0.5)),
           Pose([0.6, 1.0, 0]))  # fmt: skip
    blocked = await alternatives(recalled(stage, Known(ways), samples=1))
    assert [each.chosen_by for each in blocked] == ["default policy"]


async def test_it_is_performed_in_expressions_and_resolved(stage: Stage) -> None:
    done = await Retry(recalled(stage, Known([way(0.0, 0.9), way(-0.6)])), max_tries=2).perform()
    assert done is None
    assert stage.robot.pose.position.x == pytest.approx(0.7)
    stage.reset()
    await Sequential(recalled(stage, Known([way(-0.6)]))).perform()
    stage.reset()
    resolved = await recalled(stage, Known([way(-0.6)])).resolve()
    await resolved.perform()
    stage.reset()
    with pytest.raises(PlanFailure) as raised:
        await Retry(recalled(stage, Known([way(0.0, 1.9), way(1.9)])), max_tries=2).perform()
    assert [note[:6] for note in raised.value.__notes__] == ["try 1:"]


async def test_an_object_that_lies_and_a_wrong_use_are_refused(stage: Stage) -> None:
    description = recalled(stage, Known([way(-0.6)]))
    with pytest.raises(CallerError, match="iterate with `async for`"):
        list(description)
    with pytest.raises(NotResolved):
        _ = description.perform  # type: ignore[attr-defined]
    stage.target.set_pose(Pose([1.3, 1, 0.9], [0.7071, 0, 0, 0.7071]))
    with pytest.raises(ObjectUnreachable, match="lies on its side"):
        await recalled(stage, Known([way(-0.6)])).resolve()
    assert not inspect.iscoroutinefunction(description.__aiter__)


@pytest.mark.slow
async def test_a_node_records_what_chose_it_and_is_found_as_the_action_that_it_is(stage: Stage, tmp_path: Path) -> None:
    async with Memory.open(f"sqlite:///{tmp_path}/memory.db") as memory:
        async with memory.episode(description="recalling"):
            await Retry(recalled(stage, Known([way(0.0, 1.9), way(-0.6)])), max_tries=2).perform()
        await memory.flush()
        async with memory.session() as session:
            mapped = memory.mapped("MoveAndPickUpAction")
            nodes = (await session.scalars(select(mapped).order_by(mapped.sequence))).all()
            assert [(each.dtype, each.chosen_by, each.expected_success) for each in nodes] == [
                ("RecalledPickUpAction", "recall", 0.9)
            ] * 2
            assert len((await session.scalars(select(Action).where(Action.dtype == "RecalledPickUpAction"))).all()) == 2
