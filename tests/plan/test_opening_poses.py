"""Base poses for opening and closing: every candidate works, and an impossible request names its reason."""

from __future__ import annotations

import itertools
import math
import re

import pytest

from pycrorm_async.plan import (
    AccessingLocation,
    CloseActionPerformable,
    Location,
    MoveTorsoActionPerformable,
    NavigateActionPerformable,
    NoRobotHere,
    ObjectPart,
    OpenActionPerformable,
    ParkArmsActionPerformable,
)
from pycrorm_async.plan.execution import Candidate
from pycrorm_async.plan.failures import (
    EnvironmentManipulationImpossible,
    EnvironmentUnreachable,
    PerceptionObjectNotInWorld,
)
from pycrorm_async.plan.locations import REFUSALS_MAX
from pycrorm_async.world import Arms, Object, Pose
from pycrorm_async.world.pose import UnknownLink
from tests.plan.conftest import Scene
from tests.plan.fake_observer import Recording

pytestmark = pytest.mark.slow

DRAWERS = [
    "kitchen_counter_upper_drawer",
    "kitchen_counter_lower_drawer",
    "sink_area_drawer",
    "kitchen_island_upper_drawer",
    "kitchen_island_lower_drawer",
]
TRAVEL = dict.fromkeys(DRAWERS, 0.35) | {"fridge_door": 1.9}
"""The range of each joint by the kitchen's own description, in m or rad."""
ABOUT = pytest.mark.parametrize("about", [4, pytest.param(12, marks=pytest.mark.soak)])
"""This many of the candidates are tried, spread over the whole order."""


def spread_candidates(places: list[Location], about: int) -> list[Location]:
    return places[:: max(1, len(places) // about)]


@pytest.mark.soak_on(
    "kitchen_counter_upper_drawer", "kitchen_counter_lower_drawer", "kitchen_island_upper_drawer", "sink_area_drawer"
)
@ABOUT
@pytest.mark.parametrize(
    ("name", "torso"),
    [
        *((name, 0.3 if "lower" in name else 0.0) for name in TRAVEL),
        pytest.param("fridge_door", 0.3, marks=pytest.mark.soak),
    ],
)
async def test_from_every_candidate_the_furniture_can_be_opened_and_closed(
    scene: Scene, name: str, torso: float, about: int
) -> None:
    await MoveTorsoActionPerformable(torso).perform()
    handle, joint = ObjectPart(f"{name}_handle", scene.kitchen), f"{name}_joint"
    before = scene.world.save_state()
    places = list(AccessingLocation(handle, scene.robot))
    assert len(places) >= 90
    for place in spread_candidates(places, about):
        for arm in place.reachable_arms:
            await NavigateActionPerformable(place.pose).perform()
            await OpenActionPerformable(handle, arm).perform()
            assert scene.kitchen.joint_position(joint) == pytest.approx(TRAVEL[name] - 0.05)
            tool = scene.robot.link_pose(f"{'l' if arm is Arms.LEFT else 'r'}_gripper_tool_frame")
            assert tool.distance(scene.kitchen.link_pose(f"{name}_handle")) < 1e-5
            await ParkArmsActionPerformable(Arms.BOTH).perform()
            await CloseActionPerformable(handle, arm).perform()
            assert scene.kitchen.joint_position(joint) == 0
            scene.world.restore_state(before)


@pytest.mark.soak_on("sink_area_drawer")
@ABOUT
@pytest.mark.parametrize(("name", "now"), [("sink_area_drawer", 0.13), ("fridge_door", 0.77)])
async def test_half_open_furniture_can_be_opened_or_closed_from_every_candidate(
    scene: Scene, name: str, now: float, about: int
) -> None:
    handle, joint = ObjectPart(f"{name}_handle", scene.kitchen), f"{name}_joint"
    scene.kitchen.set_joint_position(joint, now)
    before = scene.world.save_state()
    for place in spread_candidates(list(AccessingLocation(handle, scene.robot)), about):
        arm = place.reachable_arms[0]
        for action, there in ((OpenActionPerformable, TRAVEL[name] - 0.05), (CloseActionPerformable, 0.0)):
            await NavigateActionPerformable(place.pose).perform()
            await action(handle, arm).perform()
            assert scene.kitchen.joint_position(joint) == pytest.approx(there)
            scene.world.restore_state(before)


def gap(pose: Pose, low: tuple[float, float], high: tuple[float, float]) -> float:
    """Return the distance of a base from a rectangle along the axis in which it is larger, m."""
    x, y, _ = pose.position
    return max(low[0] - x, x - high[0], low[1] - y, y - high[1])


def assert_clear(places: list[Location], kitchen: Object) -> None:
    boxes = [box for link in kitchen.links if (box := kitchen.bounding_box(link)).size != (0, 0, 0)]
    for place in places:
        assert place.pose.position.z == 0
        for box in boxes:
            assert gap(place.pose, box.min[:2], box.max[:2]) >= 0.4 - 1e-9


def test_the_first_candidates_are_clear_of_furniture_and_a_place_for_both_arms_is_reached_by_each(scene: Scene) -> None:
    lower, upper = (ObjectPart(f"{each}_handle", scene.kitchen) for each in (DRAWERS[1], DRAWERS[2]))
    assert_clear([*itertools.islice(AccessingLocation(lower, scene.robot), 100)], scene.kitchen)
    assert AccessingLocation(upper, scene.robot, Arms.BOTH).resolve().reachable_arms == (Arms.LEFT, Arms.RIGHT)


@pytest.mark.soak  # the first hundred are checked before
def test_candidates_are_clear_of_furniture_and_those_in_the_path_of_the_drawer_come_last(scene: Scene) -> None:
    places = list(AccessingLocation(ObjectPart("kitchen_counter_lower_drawer_handle", scene.kitchen), scene.robot))
    assert_clear(places, scene.kitchen)
    # Pulled out by 0.3 m: the panel, 0.6 m wide, to 1.05 - 0.02 - 0.3, the handle to 1.05 - 0.05 - 0.008 - 0.3.
    panel, bar = ((0.73, 0.05), (1.05, 0.65)), ((0.692, 0.28), (1.05, 0.42))
    swept = [min(gap(place.pose, *panel), gap(place.pose, *bar)) < 0.4 for place in places]
    assert swept == sorted(swept)
    assert True in swept
    assert False in swept
    facing = [place for place in places if abs(_aside(place.pose, (1.0, 0.35))) < 1e-9]
    assert 0 < len(facing) < len(places)
    assert places[0] in facing


def _aside(pose: Pose, goal: tuple[float, float]) -> float:
    """Return the angle, in rad, between the pose's direction and the point."""
    towards = math.atan2(goal[1] - pose.position.y, goal[0] - pose.position.x)
    return math.remainder(pose.yaw - towards, math.tau)


@pytest.mark.soak  # one place for both is required before
def test_the_requested_arms_reach(scene: Scene) -> None:
    handle = ObjectPart("sink_area_drawer_handle", scene.kitchen)

    def reaching(arm: Arms | None) -> set[tuple[Arms, ...]]:
        return {each.reachable_arms for each in AccessingLocation(handle, scene.robot, arm)}

    assert reaching(Arms.RIGHT) == {(Arms.RIGHT,)}
    assert reaching(Arms.BOTH) == {(Arms.LEFT, Arms.RIGHT)}
    assert reaching(None) == {(Arms.LEFT,), (Arms.RIGHT,), (Arms.LEFT, Arms.RIGHT)}


def test_resolving_moves_nothing_and_is_recorded_once(scene: Scene) -> None:
    handle = ObjectPart("sink_area_drawer_handle", scene.kitchen)
    before = scene.world.save_state()
    with Recording().listening() as recording:
        first, second = itertools.islice(AccessingLocation(handle, scene.robot), 2)
    assert scene.world.save_state() == before
    ((name, candidates, taken, considered, node),) = recording.places
    assert (name, taken, node) == ("AccessingLocation", 1, None)
    assert candidates == tuple(Candidate(each.pose, each.reachable_arms) for each in (first, second))
    assert considered >= 2


def test_an_unreachable_handle_is_a_failure_and_is_recorded(scene: Scene) -> None:
    scene.kitchen.set_pose(Pose([0, 0, 1.5]))
    with Recording().listening() as recording, pytest.raises(EnvironmentUnreachable, match="no place") as caught:
        AccessingLocation(ObjectPart("sink_area_drawer_handle", scene.kitchen), scene.robot).resolve()
    assert caught.value.data == ("sink_area_drawer_handle",)
    ((name, candidates, taken, considered, _),) = recording.places
    assert (name, candidates, taken) == ("AccessingLocation", (), None)
    assert considered > REFUSALS_MAX == len(recording.refused[0])
    assert all(re.fullmatch("LEFT: .+; RIGHT: .+", each.reason) for each in recording.refused[0])


def test_an_object_that_cannot_be_opened_is_refused_with_the_reason(scene: Scene) -> None:
    def request(part: ObjectPart) -> None:
        AccessingLocation(part, scene.robot).resolve()

    with pytest.raises(EnvironmentManipulationImpossible, match="no joint of kitchen moves sink_area_surface"):
        request(ObjectPart("sink_area_surface", scene.kitchen))
    with pytest.raises(UnknownLink, match="attic_handle"):
        request(ObjectPart("attic_handle", scene.kitchen))
    with pytest.raises(NoRobotHere, match="'milk' is not a robot"):
        AccessingLocation(ObjectPart("sink_area_drawer_handle", scene.kitchen), scene.milk).resolve()
    scene.world.remove(scene.kitchen)
    with pytest.raises(PerceptionObjectNotInWorld, match="kitchen"):
        request(ObjectPart("sink_area_drawer_handle", scene.kitchen))
