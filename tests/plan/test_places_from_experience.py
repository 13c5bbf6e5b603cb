"""Past base poses carried over to an object's current pose: usable ones become candidates, the best first."""

from __future__ import annotations

import math
from collections.abc import Sequence

import pytest

from pycrorm_async.errors import CallerError
from pycrorm_async.plan import (
    DatabaseCostmapLocation,
    Location,
    MoveTorsoActionPerformable,
    NavigateActionPerformable,
    PickUpActionPerformable,
)
from pycrorm_async.plan.execution import Candidate
from pycrorm_async.plan.failures import PerceptionObjectNotInWorld
from pycrorm_async.plan.task import PastSuccess, experience
from pycrorm_async.world import Arms, Grasp, Object, ObjectType, Pose
from pycrorm_async.world.models import box_urdf
from pycrorm_async.world.pose import yaw_quaternion
from tests.plan.conftest import Scene
from tests.plan.fakes import Recording

BEFORE_IT = Pose([-0.7, 0.0, -0.9])
ASIDE = Pose([-0.6, -0.4, -0.9], yaw_quaternion(0.5))


def past(
    stand: Pose = BEFORE_IT, *, arm: Arms = Arms.LEFT, grasp: Grasp = Grasp.FRONT, torso: float = 0.3
) -> PastSuccess:
    return PastSuccess(arm, grasp, torso, stand, 0.5)


class Known:
    """An experience with a few successes."""

    def __init__(self, *known_poses: PastSuccess) -> None:
        self.known = known_poses
        self.asked: list[tuple[ObjectType, Arms | None]] = []
        self.heights: list[float | None] = []

    async def successes(
        self, object_type: ObjectType, *, arm: Arms | None, height: float | None = None, torso: float | None = None
    ) -> Sequence[PastSuccess]:
        assert torso is None  # each place has the torso height of its own success
        self.asked.append((object_type, arm))
        self.heights.append(height)
        return self.known


def location_from(scene: Scene, known_poses: Known, *, arm: Arms | None = None) -> DatabaseCostmapLocation:
    return DatabaseCostmapLocation(scene.milk, scene.robot, arm, experience=known_poses)


async def test_a_past_pose_is_carried_over_to_an_object_that_moved_and_rotated(scene: Scene) -> None:
    scene.world.remove(scene.kitchen)
    scene.milk.set_pose(Pose([2.0, 3.0, 0.9], yaw_quaternion(math.pi / 2)))
    place = await location_from(scene, Known(past(ASIDE))).resolve()
    assert place is not None
    # 0.6 m behind it and 0.4 m to its right, where its x points along map's y
    assert place.pose.position == pytest.approx((2.0 + 0.4, 3.0 - 0.6, 0.0))
    assert place.pose.yaw == pytest.approx(math.pi / 2 + 0.5)
    assert (place.reachable_arms, place.grasp, place.torso_height) == ((Arms.LEFT,), Grasp.FRONT, 0.3)


async def test_from_a_candidate_it_can_be_picked_up_as_suggested(scene: Scene) -> None:
    stands = [Pose([x / 10, y / 10, -0.9], yaw_quaternion(-y / 8)) for x in range(-9, -4) for y in range(-3, 4)]
    known_poses = Known(
        *(
            past(stand, arm=arm, grasp=grasp, torso=torso)
            for stand in stands
            for arm in (Arms.LEFT, Arms.RIGHT)
            for grasp in Grasp
            for torso in (0.0, 0.3)
        )
    )
    before = scene.world.save_state()
    places = [place async for place in location_from(scene, known_poses)]
    assert scene.world.save_state() == before
    assert {place.grasp for place in places} == set(Grasp)
    assert 20 < len(places) < len(known_poses.known)
    for place in places:
        assert place.grasp is not None
        assert place.torso_height is not None
        await NavigateActionPerformable(place.pose).perform()
        await MoveTorsoActionPerformable(place.torso_height).perform()
        await PickUpActionPerformable(scene.milk, place.reachable_arms[0], place.grasp).perform()
        scene.world.restore_state(before)


async def test_an_occupied_past_pose_is_no_candidate(scene: Scene) -> None:
    stand = BEFORE_IT
    assert await location_from(scene, Known(past(stand))).resolve() is not None
    # The base is at (0.6, 1.0): 0.25 m clear of the crate, then 0.35 m.
    crate = Object("crate", ObjectType.GENERIC_OBJECT, box_urdf("crate", x=(-0.1, 0.1), y=(-0.1, 0.1), z=(0, 0.5)),
                   Pose([0.25, 1.0, 0]))  # fmt: skip
    assert await location_from(scene, Known(past(stand))).resolve() is None
    crate.set_pose(Pose([0.15, 1.0, 0]))
    assert await location_from(scene, Known(past(stand))).resolve() is not None


async def test_the_robot_and_its_load_do_not_occupy_a_past_pose(scene: Scene) -> None:
    await NavigateActionPerformable(Pose([0.6, 1.0, 0])).perform()
    scene.cereal.set_pose(Pose([0.7, 1.0, 1.0]))
    scene.robot.attach(scene.cereal, "r_gripper_tool_frame")
    for robot in (scene.robot, None):
        location = DatabaseCostmapLocation(scene.milk, robot, experience=Known(past()))
        assert await location.resolve() is not None


async def test_an_unreachable_past_pose_is_a_candidate_only_if_no_reach_is_requested(scene: Scene) -> None:
    known_poses = Known(past(torso=0.3), past(torso=0.0, grasp=Grasp.TOP), past(torso=0.9))
    places = [place.torso_height async for place in location_from(scene, known_poses)]
    assert places == [0.3]
    everywhere = DatabaseCostmapLocation(scene.milk, experience=known_poses)
    assert [place.torso_height async for place in everywhere] == [0.3, 0.0, 0.9]
    scene.milk.set_pose(Pose([1.3, 1, 1.9]))
    assert await location_from(scene, known_poses).resolve() is None


async def test_experience_with_upright_objects_is_not_carried_over_to_a_lying_one(scene: Scene) -> None:
    scene.milk.set_pose(Pose([1.3, 1, 0.9], [math.sin(math.pi / 4), 0, 0, math.cos(math.pi / 4)]))
    location = DatabaseCostmapLocation(scene.milk, experience=Known(past()))
    assert await location.resolve() is None
    # seen from a milk that lies on its side the floor was 0.9 m along its own -y
    lying = past(Pose([-0.7, -0.9, 0.0], [-math.sin(math.pi / 4), 0, 0, math.cos(math.pi / 4)]))
    place = await DatabaseCostmapLocation(scene.milk, experience=Known(lying)).resolve()
    assert place is not None
    assert place.pose.position == pytest.approx((0.6, 1.0, 0.0))
    assert place.pose.yaw == pytest.approx(0)


async def test_places_are_queried_for_the_arm_and_for_the_height_of_the_target_over_the_base(scene: Scene) -> None:
    known_poses = Known(past())
    scene.robot.set_pose(Pose([0, 0, 0.25]))
    for height, arm in ((0.9, Arms.RIGHT), (0.7, None)):
        scene.milk.set_pose(Pose([1.3, 1, height]))
        await location_from(scene, known_poses, arm=arm).resolve()
    assert known_poses.asked == [(ObjectType.MILK, Arms.RIGHT), (ObjectType.MILK, None)]
    assert known_poses.heights == pytest.approx([0.65, 0.45])


async def test_the_experience_of_the_context_is_queried_and_without_one_an_error_is_raised(scene: Scene) -> None:
    location = DatabaseCostmapLocation(scene.milk, scene.robot)
    with pytest.raises(
        CallerError, match=r"queried from a memory, and none is open: resolve inside `async with Memory.open\(url\)`"
    ):
        await location.resolve()
    with pytest.raises(CallerError, match="queried from a memory"):
        async for _ in location:
            pass
    token = experience.set(Known(past()))
    try:
        assert await location.resolve() is not None
    finally:
        experience.reset(token)


async def test_an_invalid_request_is_refused(scene: Scene) -> None:
    with pytest.raises(CallerError, match="pass an object as target, not a place"):
        DatabaseCostmapLocation(Pose())  # type: ignore[arg-type]  # the fault this test is about
    with pytest.raises(CallerError, match="uses one arm: reachable_arm must be LEFT, RIGHT, or None"):
        location_from(scene, Known(), arm=Arms.BOTH)
    scene.world.remove(scene.robot)
    with pytest.raises(PerceptionObjectNotInWorld, match="pr2"):
        await location_from(scene, Known(past())).resolve()


# --- notifications of a recorder --------------------------------------------------------------------------------------

GOOD, HIDDEN, OTHER = past(), past(Pose([0.3, 0.0, -0.9])), past(Pose([-0.75, 0.0, -0.9]), torso=0.2)


def candidate(place: Location) -> Candidate:
    return Candidate(place.pose, place.reachable_arms, place.grasp, place.torso_height)


async def test_candidates_and_choice_are_recorded_with_grasp_and_torso_height(scene: Scene) -> None:
    with Recording().listening() as recording:
        place = await location_from(scene, Known(HIDDEN, GOOD, OTHER)).resolve()
    assert place is not None
    assert candidate(place) == Candidate(place.pose, (Arms.LEFT,), Grasp.FRONT, 0.3)
    assert recording.places == [("DatabaseCostmapLocation", (candidate(place),), 0, 2, None)]


async def test_a_search_without_usable_experience_is_recorded_too(scene: Scene) -> None:
    with Recording().listening() as recording:
        assert await location_from(scene, Known()).resolve() is None
        assert await location_from(scene, Known(HIDDEN)).resolve() is None
    assert recording.places == [
        ("DatabaseCostmapLocation", (), None, 0, None),
        ("DatabaseCostmapLocation", (), None, 1, None),
    ]
    assert [[each.reason for each in refused] for refused in recording.refused] == [
        [],
        ["an obstacle is nearer than 0.3 m"],
    ]
