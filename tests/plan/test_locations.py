"""Resolving locations: every candidate works and collides with nothing, and a recorder is notified once."""

from __future__ import annotations

import itertools
import math
import random
import re
from collections.abc import Callable, Iterator, Sequence
from contextlib import contextmanager
from typing import Any

import numpy as np
import pytest

from pycrorm_async.errors import CallerError
from pycrorm_async.learning.move_and_pick_up import MoveAndPickUp
from pycrorm_async.plan import (
    AccessingLocation,
    ActionAbstract,
    CostmapLocation,
    DatabaseCostmapLocation,
    FaceAtPerformable,
    Location,
    MoveTorsoActionPerformable,
    NavigateActionPerformable,
    NoRobotHere,
    ObjectPart,
    ObjectRelativeLocation,
    ParkArmsActionPerformable,
    PickUpActionPerformable,
    PlaceActionPerformable,
    ResolutionError,
    SemanticCostmapLocation,
    simulated_robot,
)
from pycrorm_async.plan.execution import Candidate, Cells, Refusal
from pycrorm_async.plan.failures import (
    LookingHighLevelFailure,
    NavigationGoalInCollision,
    ObjectUnavailable,
    ObjectUnreachable,
    PerceptionObjectNotInWorld,
    ReachabilityFailure,
)
from pycrorm_async.plan.locations import CANDIDATES_MAX, opening_poses
from pycrorm_async.plan.motions import simulated_robot_within
from pycrorm_async.plan.objects import CurrentRobot, designator_of, require_robot
from pycrorm_async.plan.task import PastSuccess
from pycrorm_async.world import Arms, BulletWorld, Grasp, Object, ObjectType, Pose
from pycrorm_async.world.models import box_urdf
from pycrorm_async.world.pose import UnknownLink, yaw_quaternion
from pycrorm_async.world.queries import OccupancyCostmap, VisibilityCostmap
from pycrorm_async.world.urdf import PR2, Limits
from tests import bullet
from tests.plan.conftest import Scene
from tests.plan.fakes import Recording

# === locations ================================================================================================
#
# Resolving locations: every candidate works, and a recorder is notified once.

LEFT_TOOL = "l_gripper_tool_frame"
OUT_OF_REACH = Pose([1.3, 1, 3])


@pytest.mark.slow
@pytest.mark.parametrize(
    ("yaw", "step"), [(0.0, 4), *(pytest.param(yaw, 1, marks=pytest.mark.soak) for yaw in (0.0, 1.0, math.pi))]
)
async def test_from_every_candidate_the_object_can_be_picked_up(scene: Scene, yaw: float, step: int) -> None:
    """At each commit only every fourth candidate is tried."""
    await MoveTorsoActionPerformable(0.2).perform()
    await ParkArmsActionPerformable(Arms.RIGHT).perform()
    scene.milk.set_pose(Pose([1.3, 1, 0.9], yaw_quaternion(yaw)))
    before = scene.world.save_state()
    stands = list(CostmapLocation(target=scene.milk, reachable_for=scene.robot))
    assert len(stands) > 50
    for stand in stands[::step]:
        for arm in stand.reachable_arms:
            await NavigateActionPerformable(stand.pose).perform()
            await PickUpActionPerformable(scene.milk, arm, Grasp.FRONT).perform()
            scene.world.restore_state(before)


@pytest.mark.slow
async def test_from_every_candidate_the_held_object_can_be_placed(scene: Scene) -> None:
    await MoveTorsoActionPerformable(0.2).perform()
    await NavigateActionPerformable(Pose([0.6, 0.9, 0])).perform()
    await PickUpActionPerformable(scene.milk, Arms.LEFT, Grasp.RIGHT).perform()
    await ParkArmsActionPerformable(Arms.BOTH).perform()
    goal = Pose([-1.4, 0.8, 0.99], yaw_quaternion(0.5))
    before = scene.world.save_state()
    stands = list(CostmapLocation(goal, reachable_for=scene.robot, reachable_arm=Arms.LEFT))
    assert len(stands) > 50
    for stand in stands:
        assert stand.reachable_arms == (Arms.LEFT,)
        await NavigateActionPerformable(stand.pose).perform()
        await PlaceActionPerformable(scene.milk, Arms.LEFT, goal).perform()
        scene.world.restore_state(before)


@pytest.mark.slow
def test_candidates_are_on_the_floor_face_the_target_and_are_clear_of_furniture(scene: Scene) -> None:
    boxes = [box for link in scene.kitchen.links if (box := scene.kitchen.bounding_box(link)).size != (0, 0, 0)]
    stands = list(CostmapLocation(scene.cereal, reachable_for=scene.robot))
    for pose in (each.pose for each in stands):
        assert pose.position.z == 0
        away = (1.3 - pose.position.x, 0.7 - pose.position.y)
        assert pose.yaw == pytest.approx(math.atan2(away[1], away[0]))
        for box in boxes:
            gap_x = max(box.min.x - pose.position.x, pose.position.x - box.max.x)
            gap_y = max(box.min.y - pose.position.y, pose.position.y - box.max.y)
            assert max(gap_x, gap_y) >= 0.32 - 1e-9
    distances = [stand.pose.distance(Pose([1.3, 0.7, 0])) for stand in stands]
    assert distances == pytest.approx(sorted(distances))


@pytest.mark.slow
async def test_from_a_candidate_for_visibility_the_object_is_seen(scene: Scene) -> None:
    Object("wall", ObjectType.GENERIC_OBJECT, box_urdf("wall", x=(-0.02, 0.02), y=(-0.3, 0.3), z=(0, 2)),
           Pose([1.0, 0.9, 0]))  # fmt: skip
    stands = list(CostmapLocation(scene.milk, visible_for=scene.robot))
    assert stands
    assert all(each.reachable_arms == () for each in stands)
    for stand in stands:
        await NavigateActionPerformable(stand.pose).perform()
        eye = scene.robot.link_pose("wide_stereo_optical_frame").position
        assert scene.world.visible(scene.milk, eye, ignore=[scene.robot]) >= 0.5
    for stand in CostmapLocation(scene.milk.pose, visible_for=scene.robot):
        await NavigateActionPerformable(stand.pose).perform()
        eye = scene.robot.link_pose("wide_stereo_optical_frame").position
        assert scene.world.ray_test([eye], [scene.milk.pose.position], ignore=[scene.robot]) in ([None], [scene.milk])


def test_resolving_a_location_moves_nothing(scene: Scene) -> None:
    before = scene.world.save_state()
    list(itertools.islice(CostmapLocation(scene.milk, reachable_for=scene.robot, visible_for=scene.robot), 5))
    list(SemanticCostmapLocation("kitchen_island_surface", scene.kitchen, scene.milk))
    assert scene.world.save_state() == before


def test_a_location_without_a_reachable_candidate_is_a_failure_and_is_recorded(scene: Scene) -> None:
    scene.milk.set_pose(OUT_OF_REACH)
    with Recording().listening() as recording:
        with pytest.raises(ObjectUnreachable, match="pick up milk"):
            CostmapLocation(scene.milk, reachable_for=scene.robot).resolve()
        with pytest.raises(ReachabilityFailure) as caught:
            CostmapLocation(OUT_OF_REACH, reachable_for=scene.robot).resolve()
        assert caught.value.data == (OUT_OF_REACH,)
        assert list(CostmapLocation(OUT_OF_REACH, reachable_for=scene.robot)) == []
    assert recording.places == [("CostmapLocation", (), None, 600, None)] * 3
    for refused in recording.refused:
        assert len({each.pose.position for each in refused}) == 600
        assert all(re.fullmatch("LEFT: .+; RIGHT: .+", each.reason) for each in refused)


def test_a_location_without_a_candidate_that_sees_the_object_is_a_failure_and_is_recorded(scene: Scene) -> None:
    crate = box_urdf("crate", x=(-0.2, 0.2), y=(-0.2, 0.2), z=(-0.2, 0.2))
    Object("crate", ObjectType.GENERIC_OBJECT, crate, scene.milk.pose)
    with Recording().listening() as recording, pytest.raises(LookingHighLevelFailure):
        CostmapLocation(scene.milk, visible_for=scene.robot).resolve()
    assert recording.places == [("CostmapLocation", (), None, 0, None)]


def test_a_removed_target_or_a_missing_robot_is_reported(scene: Scene) -> None:
    scene.world.remove(scene.milk)
    for asked in (
        SemanticCostmapLocation("kitchen_island_surface", scene.kitchen, scene.milk),
        CostmapLocation(scene.milk, reachable_for=scene.robot),
        CostmapLocation(designator_of(scene.milk), visible_for=scene.robot),
        ObjectRelativeLocation(Pose([0, 0.5, 0]), scene.milk),
    ):
        with pytest.raises(PerceptionObjectNotInWorld, match="milk is not an object of the world"):
            asked.resolve()
    with pytest.raises(NoRobotHere, match="'cereal' is not a robot"):
        CostmapLocation(scene.kitchen, reachable_for=scene.cereal).resolve()
    with pytest.raises(UnknownLink):
        SemanticCostmapLocation("attic", scene.kitchen).resolve()


@pytest.mark.parametrize(
    ("kind", "arguments", "message"),
    [
        (CostmapLocation, lambda _: ("milk",), "target: expected Pose | Object | ObjectDesignator, got str 'milk'"),
        (CostmapLocation, lambda s: (s.milk, "pr2"), "reachable_for: expected Object | ObjectDesignator | None, got"),
        (CostmapLocation, lambda s: (s.milk, s.robot, None, [Arms.LEFT]), "reachable_arm: expected Arms | None, got"),
        (AccessingLocation, lambda s: ("fridge_door_handle", s.robot), "handle: expected ObjectPart, got str"),
        (AccessingLocation, lambda s: (s.milk, s.robot), "handle: expected ObjectPart, got Object"),
        (SemanticCostmapLocation, lambda s: (s.kitchen, "sink_area"), "urdf_link_name: expected str, got Object"),
        (ObjectRelativeLocation, lambda _: (Pose(), "milk"), "reference_object: expected Object | ObjectDesignator"),
        (Location, lambda _: ([0, 0, 0],), "pose: expected Pose, got list [0, 0, 0]"),
        (DatabaseCostmapLocation, lambda s: (s.milk, "pr2"), "reachable_for: expected Object | ObjectDesignator"),
        (DatabaseCostmapLocation, lambda s: (s.milk, None, [Arms.LEFT]), "reachable_arm: expected Arms | None"),
    ],
)
def test_a_target_without_possible_locations_is_refused_by_name(
    scene: Scene, kind: Any, arguments: Callable[[Scene], tuple[object, ...]], message: str
) -> None:
    with pytest.raises(ResolutionError, match=re.escape(message)):
        kind(*arguments(scene))


@pytest.mark.parametrize("role", ["reachable_for", "visible_for"])
def test_a_pose_in_another_frame_is_refused(scene: Scene, role: str) -> None:
    robot: Any = {role: scene.robot}
    with pytest.raises(CallerError, match="the target is in frame 'base_link', the robot in 'map'"):
        CostmapLocation(Pose([0.7, 0, 0.9], frame="base_link"), **robot).resolve()
    with pytest.raises(CallerError, match="the target is not finite"):
        CostmapLocation(Pose([math.nan, 0, 0.9]), **robot).resolve()


# --- notifications of a recorder --------------------------------------------------------------------------------------


def test_a_resolution_is_recorded_with_the_chosen_candidate(scene: Scene) -> None:
    with Recording().listening() as recording:
        stand = CostmapLocation(scene.milk, reachable_for=scene.robot, reachable_arm=Arms.RIGHT).resolve()
    candidates = (Candidate(stand.pose, (Arms.RIGHT,)),)
    ((name, notes, taken, considered, node),) = recording.places
    assert (name, notes, taken, node) == ("CostmapLocation", candidates, 0, None)
    first = next(iter(CostmapLocation(scene.milk, reachable_for=scene.robot, reachable_arm=Arms.RIGHT)))
    assert first == stand
    assert 1 <= considered <= 600


def test_a_search_counts_the_places_that_its_costmaps_exclude_each_once(scene: Scene) -> None:
    handle = ObjectPart("sink_area_drawer_handle", scene.kitchen)
    with Recording().listening() as recording:
        CostmapLocation(scene.milk, visible_for=scene.robot).resolve()
        CostmapLocation(scene.milk, reachable_for=scene.robot).resolve()
        AccessingLocation(handle, scene.robot).resolve()
        SemanticCostmapLocation("kitchen_island_surface", scene.kitchen, scene.milk).resolve()
    ground = Pose([*scene.milk.pose.position[:2], 0])
    low, high = CurrentRobot(scene.robot, PR2).camera_heights_m()
    free = OccupancyCostmap(scene.world, ground).map > 0
    seen = VisibilityCostmap(scene.world, scene.milk, min_height_m=low, max_height_m=high, origin=ground).map > 0
    visible, reachable, opening, surface = recording.cells
    assert visible == Cells(occupied=(~free).sum(), hidden=(free & ~seen).sum(), free=(free & seen).sum())
    assert min(visible.occupied, visible.hidden, visible.free) > 1_000
    assert reachable == Cells(occupied=visible.occupied, hidden=0, free=free.sum())
    assert opening is not None
    assert (opening.occupied + opening.free, opening.hidden) == (80 * 80, 0)
    assert surface is None


def test_a_loop_over_candidates_is_recorded_at_its_end_with_the_last_one_as_chosen(scene: Scene) -> None:
    location = SemanticCostmapLocation("kitchen_island_surface", scene.kitchen, scene.milk)
    with Recording().listening() as recording:
        for place in location:
            if place.pose.position.x < -1.5:
                break
        ((_, candidates, taken, considered, _),) = recording.places
        assert candidates[-1] == Candidate(place.pose)
        assert taken == len(candidates) - 1 == considered - 1
        assert all(each.pose.position.x >= -1.5 for each in candidates[:-1])


def test_a_loop_that_runs_to_its_end_chose_none(scene: Scene) -> None:
    with Recording().listening() as recording:
        places = list(SemanticCostmapLocation("kitchen_island_surface", scene.kitchen, scene.milk))
    reported = (*places[: CANDIDATES_MAX - 1], places[-1])
    assert recording.places == [
        ("SemanticCostmapLocation", tuple(Candidate(each.pose) for each in reported), None, len(places), None)
    ]
    assert recording.offered_beyond == [len(places) - CANDIDATES_MAX]


def test_an_unused_location_is_not_recorded(scene: Scene) -> None:
    with Recording().listening() as recording:
        iter(CostmapLocation(scene.milk, reachable_for=scene.robot)).close()
    assert recording.places == []


def test_an_abandoned_search_is_recorded_by_the_recorder_with_which_it_began(scene: Scene) -> None:
    with Recording().listening() as recording:
        places = iter(CostmapLocation(scene.milk, reachable_for=scene.robot))
        next(places)
        next(places)
    assert recording.places == []
    del places
    ((_, candidates, taken, _, _),) = recording.places
    assert (len(candidates), taken) == (2, 1)


async def test_the_node_that_resolves_is_recorded(scene: Scene) -> None:
    class Asking(ActionAbstract):
        async def perform(self) -> Pose:
            return Location(Pose([1, 2, 0])).resolve().pose

    with Recording().listening() as recording:
        assert await Asking().perform() == Pose([1, 2, 0])
    ((name, candidates, taken, considered, node),) = recording.places
    assert (name, candidates, taken, considered) == ("Location", (Candidate(Pose([1, 2, 0])),), 0, 1)
    assert node is recording.ended[0]


# --- the other designators -----------------------------------------------------------------------------------------


def test_a_location_resolves_to_itself_and_one_beside_an_object_moves_with_it(scene: Scene) -> None:
    here = Location(Pose([1, 2, 0]), (Arms.LEFT,))
    assert (here.resolve(), list(here)) == (here, [here])
    beside = ObjectRelativeLocation(Pose([0, 0.5, 0]), designator_of(scene.milk))
    assert beside.resolve() == Location(Pose([1.3, 1.5, 0.9]))
    scene.milk.set_pose(Pose([0, 0, 1], yaw_quaternion(math.pi / 2)))
    assert beside.resolve().pose.position == pytest.approx((-0.5, 0, 1))


def test_placed_objects_are_wholly_on_the_surface_and_the_middle_comes_first(scene: Scene) -> None:
    places = list(SemanticCostmapLocation("kitchen_island_surface", scene.kitchen, scene.milk))
    surface = scene.kitchen.bounding_box("kitchen_island_surface")
    assert places[0].pose.position == pytest.approx((surface.centre.x, surface.centre.y, surface.max.z + 0.088))
    for place in places:
        scene.milk.set_pose(place.pose)
        box = scene.milk.bounding_box()
        assert box.min.z == pytest.approx(surface.max.z)
        assert surface.min.x - 1e-9 <= box.min.x
        assert box.max.x <= surface.max.x + 1e-9
        assert surface.min.y - 1e-9 <= box.min.y
        assert box.max.y <= surface.max.y + 1e-9
    assert len({place.pose.position for place in places}) == len(places) > 1000
    assert list(SemanticCostmapLocation("kitchen_island_surface", scene.kitchen, scene.milk)) == places


def test_the_current_grasp_does_not_affect_the_pose_on_the_surface(scene: Scene) -> None:
    upright = SemanticCostmapLocation("kitchen_island_surface", scene.kitchen, scene.cereal).resolve()
    scene.cereal.set_pose(Pose([0.5, 0, 1.2], [0.5, 0.1, 0.2, 0.6]))
    scene.robot.attach(scene.cereal, LEFT_TOOL)
    assert SemanticCostmapLocation("kitchen_island_surface", scene.kitchen, scene.cereal).resolve() == upright


def test_an_occupied_place_is_not_a_candidate(scene: Scene) -> None:
    location = SemanticCostmapLocation("kitchen_island_surface", scene.kitchen, scene.milk)
    free = len(list(location))
    middle = SemanticCostmapLocation("kitchen_island_surface", scene.kitchen, scene.cereal).resolve()
    scene.cereal.set_pose(middle.pose)
    with Recording().listening() as recording:
        left = list(location)
    assert 0 < len(left) < free
    assert recording.places[0][3] == free
    assert len(recording.refused[0]) == free - len(left)
    assert {each.reason for each in recording.refused[0]} == {"cereal is in the way"}
    assert not {each.pose.position for each in recording.refused[0]} & {each.pose.position for each in left}
    for place in left:
        scene.milk.set_pose(place.pose)
        milk, cereal = scene.milk.bounding_box(), scene.cereal.bounding_box()
        assert (
            milk.max.x <= cereal.min.x + 1e-6
            or cereal.max.x <= milk.min.x + 1e-6
            or milk.max.y <= cereal.min.y + 1e-6
            or cereal.max.y <= milk.min.y + 1e-6
        )


def test_a_full_surface_is_a_failure(scene: Scene) -> None:
    Object("crate", ObjectType.GENERIC_OBJECT, box_urdf("crate", x=(-1, 1), y=(-1, 1), z=(0, 0.5)),
           Pose([-1.45, 1.0, 0.9]))  # fmt: skip
    with pytest.raises(ObjectUnavailable, match="no room for milk on kitchen_island_surface"):
        SemanticCostmapLocation("kitchen_island_surface", scene.kitchen, scene.milk).resolve()


def test_without_an_object_the_candidates_are_on_the_surface_itself(scene: Scene) -> None:
    place = SemanticCostmapLocation("kitchen_island_surface", scene.kitchen).resolve()
    assert place.pose.position == pytest.approx((-1.45, 1.0, 0.9))


# === base clearance ===========================================================================================
#
# Collision checks of the base: no candidate collides, and driving into an obstacle fails, where collisions count.

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
    numbers = [bullet.link_number(obj, each) for each in (obj.links if links is None else links)]
    return {
        other.name
        for other in obj.world.objects
        if other is not obj
        for number in numbers
        for point in bullet.getClosestPoints(
            obj.body.number, other.body.number, 0.0, number, physicsClientId=bullet.client_of(obj.world)
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
@pytest.mark.soak_on(*range(1, 16))
@pytest.mark.parametrize("part", range(16))
async def test_at_no_offered_place_is_the_base_in_collision_in_two_hundred_table_scenes(part: int) -> None:
    offering = dict.fromkeys(("costmap", "seeing", "experience", "policy", "surface"), 0)
    for seed in range(SEED + part * SCENES // 16, SEED + (part + 1) * SCENES // 16):
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
    least = dict.fromkeys(offering, 0.6) | {"costmap": 0.3}  # where the arm reaches past the tables as well
    assert all(count > SCENES / 16 * least[kind] for kind, count in offering.items()), offering


@pytest.mark.soak
@pytest.mark.slow
def test_places_to_open_a_drawer_are_clear_of_the_kitchen(scene: Scene) -> None:
    """The second heading of each place, turned by 45 degrees, needs the room of the base's corners."""
    scene.robot.set_pose(AWAY)
    handle = ObjectPart("sink_area_drawer_handle", scene.kitchen)
    with colliding():
        assert AccessingLocation(handle, scene.robot).resolve().reachable_arms
        found = itertools.islice(opening_poses(handle, scene.robot, None), 1_201)
        searched = [each for each in found if not isinstance(each, Cells)]
    reason = "base in collision with kitchen"
    refused = [each.pose for each in searched if isinstance(each, Refusal) and each.reason.startswith(reason)]
    assert 0 < len(refused) < len(searched) / 4
    for pose in (each.pose for each in searched):
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
