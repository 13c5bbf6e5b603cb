"""Objects and their links have the poses of their description, and impossible changes are refused."""

from __future__ import annotations

import math
import re
from typing import Any

import numpy as np
import pytest

from pycrorm_async.world import BulletWorld, JointType, Object, ObjectType, Pose
from pycrorm_async.world.pose import (
    DuplicateName,
    JointLimitExceeded,
    NoWorld,
    ObjectNotInWorld,
    ObjectRefused,
    PoseRefused,
    UnknownJoint,
    UnknownLink,
)
from tests.world.fakes import CRANE, ChangeLog, crane_links, matrix

LEANING = Pose([0.3, -1.2, 0.7], [0.2, -0.4, 0.1, 0.8])


def crane(pose: Pose | None = None) -> Object:
    return Object("crane", ObjectType.GENERIC_OBJECT, CRANE, pose)


def test_the_pose_read_is_exactly_the_pose_set(world: BulletWorld) -> None:
    milk = Object("milk", ObjectType.MILK, pose=LEANING)
    assert milk.pose is LEANING
    there = Pose([1.3, 1.0, 0.9], [0, 0, 0.3, 0.7])
    milk.set_pose(there)
    assert milk.pose is there
    assert milk.link_pose() is there


def test_without_a_pose_an_object_is_at_the_origin(world: BulletWorld) -> None:
    assert Object("bowl", ObjectType.BOWL).pose == Pose([0, 0, 0], [0, 0, 0, 1])


@pytest.mark.parametrize("base", [Pose(), LEANING])
@pytest.mark.parametrize(
    ("turning", "lifting", "reaching"), [(0, 0, 0), (0.4, -0.5, 0.6), (-9.0, 1.2, 0.25), (2.5, 0.3, 0)]
)
def test_every_link_is_where_the_description_has_it(
    world: BulletWorld, base: Pose, turning: float, lifting: float, reaching: float
) -> None:
    placed_crane = crane(base)
    placed_crane.set_joint_positions({"turning": turning, "lifting": lifting, "reaching": reaching})
    expected = crane_links(base, turning=turning, lifting=lifting, reaching=reaching)
    assert set(placed_crane.links) == set(expected)
    for link, where in expected.items():
        np.testing.assert_allclose(matrix(placed_crane.link_pose(link)), where, atol=1e-9)


@pytest.mark.parametrize("base", [Pose(), LEANING])
def test_a_link_pose_at_other_joint_positions_moves_nothing_and_notifies_no_observer(
    world: BulletWorld, base: Pose
) -> None:
    placed_crane = crane(base)
    placed_crane.set_joint_positions({"turning": 0.4, "lifting": -0.5, "reaching": 0.1})
    change_log = ChangeLog()
    world.observe(change_log)
    before = {link: placed_crane.link_pose(link) for link in placed_crane.links}
    expected = crane_links(base, turning=2.5, lifting=-0.5, reaching=0.25)
    for link, where in expected.items():
        there = placed_crane.link_pose_at(link, {"turning": 2.5, "reaching": 0.25})
        np.testing.assert_allclose(matrix(there), where, atol=1e-9)
    assert {link: placed_crane.link_pose(link) for link in placed_crane.links} == before
    assert placed_crane.joint_positions() == {"turning": 0.4, "lifting": -0.5, "reaching": 0.1}
    assert change_log.notes == []
    with pytest.raises(UnknownJoint):
        placed_crane.link_pose_at("hook", {"rowing": 1.0})


def test_links_follow_a_base_that_is_set_after_the_joints(world: BulletWorld) -> None:
    placed_crane = crane()
    placed_crane.set_joint_positions({"turning": 0.4, "reaching": 0.6})
    placed_crane.set_pose(LEANING)
    expected = crane_links(LEANING, turning=0.4, lifting=0, reaching=0.6)
    np.testing.assert_allclose(matrix(placed_crane.link_pose("hook")), expected["hook"], atol=1e-9)


def test_joints_and_links_have_the_names_kinds_and_limits_of_the_description(world: BulletWorld) -> None:
    placed_crane = crane()
    assert placed_crane.links[0] == "foot"
    assert set(placed_crane.joints) == {"turning", "lifting", "reaching"}
    assert placed_crane.joint_positions() == {"turning": 0.0, "lifting": 0.0, "reaching": 0.0}
    assert placed_crane.joint_limits("lifting") == (-0.5, 1.2)
    assert placed_crane.joint_limits("reaching") == (0.0, 0.6)
    assert placed_crane.joint_limits("turning") == (-math.inf, math.inf)
    assert [placed_crane.joint_type(joint) for joint in ("turning", "lifting", "reaching", "pole")] == [
        JointType.CONTINUOUS,
        JointType.REVOLUTE,
        JointType.PRISMATIC,
        JointType.FIXED,
    ]
    assert placed_crane.joints_above("hook") == ("reaching", "lifting", "turning")
    assert placed_crane.joints_above("flag") == ("turning",)
    assert placed_crane.joints_above("foot") == ()


def test_one_motion_of_joints_is_reported_once_with_all_of_them(world: BulletWorld, change_log: ChangeLog) -> None:
    placed_crane = crane()
    change_log.notes.clear()
    placed_crane.set_joint_positions({"turning": 1.5, "reaching": 0.1})
    placed_crane.set_joint_position("reaching", 0.1)
    assert change_log.notes == [
        ("joints", "crane", {"turning": 1.5, "reaching": 0.1}),
        ("joints", "crane", {"reaching": 0.1}),
    ]
    assert placed_crane.joint_positions() == {"turning": 1.5, "lifting": 0.0, "reaching": 0.1}


def test_a_motion_of_no_joints_is_ignored(world: BulletWorld, change_log: ChangeLog) -> None:
    placed_crane = crane()
    change_log.notes.clear()
    placed_crane.set_joint_positions({})
    assert change_log.notes == []


def test_a_base_motion_is_reported_once_even_without_a_change(world: BulletWorld, change_log: ChangeLog) -> None:
    placed_crane = crane()
    change_log.notes.clear()
    placed_crane.set_pose(LEANING)
    placed_crane.set_pose(LEANING)
    assert change_log.notes == [("moved", "crane", LEANING)] * 2


@pytest.mark.parametrize(
    ("joint", "value", "limits"),
    [
        ("lifting", 1.2001, (-0.5, 1.2)),
        ("lifting", -0.50001, (-0.5, 1.2)),
        ("reaching", 5.0, (0.0, 0.6)),
        ("reaching", math.nan, (0.0, 0.6)),
        ("turning", math.inf, (-math.inf, math.inf)),
        ("turning", -1.1e9, (-math.inf, math.inf)),
    ],
)
def test_a_joint_outside_its_limits_is_refused_and_nothing_moves(
    world: BulletWorld, change_log: ChangeLog, joint: str, value: float, limits: tuple[float, float]
) -> None:
    placed_crane = crane()
    change_log.notes.clear()
    with pytest.raises(JointLimitExceeded) as refused:
        placed_crane.set_joint_positions({"turning": 0.5, "lifting": 0.5, joint: value})
    assert (refused.value.object_name, refused.value.joint, refused.value.limits) == ("crane", joint, limits)
    assert refused.value.value == value or math.isnan(value)
    assert placed_crane.joint_positions() == {"turning": 0.0, "lifting": 0.0, "reaching": 0.0}
    assert change_log.notes == []


def test_a_joint_without_limits_is_refused_with_a_clear_message(world: BulletWorld) -> None:
    with pytest.raises(JointLimitExceeded) as refused:
        crane().set_joint_position("turning", math.inf)
    assert str(refused.value) == "'crane': turning cannot be set to inf; its limits are -1e+09 to 1e+09"


def test_rounding_past_a_limit_is_accepted_and_never_clamped(world: BulletWorld) -> None:
    placed_crane = crane()
    placed_crane.set_joint_position("lifting", 1.2 + 9e-7)
    assert placed_crane.joint_position("lifting") == 1.2 + 9e-7


def test_unknown_names_are_refused_with_those_that_exist(world: BulletWorld) -> None:
    placed_crane = crane()
    for call in (
        lambda: placed_crane.set_joint_position("elbow", 0.0),
        lambda: placed_crane.joint_position("elbow"),
        lambda: placed_crane.joint_limits("elbow"),
        lambda: placed_crane.joint_type("elbow"),
    ):
        with pytest.raises(UnknownJoint, match=r"'crane' has no movable joint 'elbow'.*turning"):
            call()
    for look in (placed_crane.link_pose, placed_crane.bounding_box, placed_crane.joints_above):
        with pytest.raises(UnknownLink, match=r"'crane' has no link 'claw'.*hook"):
            look("claw")


@pytest.mark.parametrize(
    ("pose", "reason"),
    [
        (Pose([0, 0, math.nan]), "finite"),
        (Pose([math.inf, -math.inf, 0]), "finite"),
        (Pose([0, 0, -1.1e9]), "at most 1e+09"),
        (Pose([0, 0, 0], [0, math.nan, 0, 1]), "finite"),
        (Pose([0, 0, 0], [math.inf, 0, 0, 1]), "finite"),
        (Pose([1, 2, 3], frame="pr2/base_link"), "'pr2/base_link'"),
    ],
)
def test_an_invalid_pose_is_refused_and_nothing_moves(
    world: BulletWorld, change_log: ChangeLog, pose: Pose, reason: str
) -> None:
    placed_crane, milk = crane(LEANING), Object("milk", ObjectType.MILK)
    placed_crane.attach(milk, "hook")
    change_log.notes.clear()
    with pytest.raises(PoseRefused, match=re.escape(reason)) as refused:
        placed_crane.set_pose(pose)
    assert refused.value.object_name == "crane"
    assert refused.value.pose is pose
    assert str(refused.value).startswith(f"'crane' cannot be moved to {pose!r}: ")
    assert (placed_crane.pose, milk.pose) == (LEANING, Pose())
    with pytest.raises(PoseRefused, match=r"'crane' cannot be moved to \[1, 2, 3\]: it is not a Pose"):
        placed_crane.set_pose([1, 2, 3])  # type: ignore[arg-type]  # the fault this test is about
    with pytest.raises(PoseRefused, match="'cup'"):
        Object("cup", ObjectType.JEROEN_CUP, pose=pose)
    assert [present.name for present in world.objects] == ["crane", "milk"]
    assert change_log.notes == []


def test_the_pose_of_an_object_carried_to_the_farthest_place_is_finite(world: BulletWorld) -> None:
    placed_crane, milk = crane(), Object("milk", ObjectType.MILK, pose=Pose([-1e9, -1e9, -1e9]))
    placed_crane.attach(milk, "hook")
    for place in (Pose([1e9, 1e9, 1e9], [0.2, -0.4, 0.1, 0.8]), Pose([-1e9, 0, 1e9], [0.2, 0.4, 0.1, -0.8])):
        placed_crane.set_pose(place)
        placed_crane.set_joint_position("turning", 1e9)
        assert all(map(math.isfinite, (*milk.pose.position, *milk.pose.orientation)))


@pytest.mark.parametrize(
    ("name", "object_type", "words"),
    [
        (None, ObjectType.MILK, "an object's name must be a str, got None"),
        (b"milk", ObjectType.MILK, "an object's name must be a str, got b'milk'"),
        ("milk", "MILK", "the type of object 'milk' must be an ObjectType, got 'MILK'"),
        ("milk", 3, "the type of object 'milk' must be an ObjectType, got 3"),
    ],
)
def test_an_object_has_a_name_and_a_type(
    world: BulletWorld, change_log: ChangeLog, name: Any, object_type: Any, words: str
) -> None:
    with pytest.raises(ObjectRefused) as refused:
        Object(name, object_type)
    assert str(refused.value) == words
    assert (world.objects, change_log.notes) == ((), [])


def test_a_name_is_used_once_in_a_world(world: BulletWorld) -> None:
    crane()
    with pytest.raises(DuplicateName, match="'crane'"):
        Object("crane", ObjectType.MILK)
    world.remove(world.object("crane"))
    assert Object("crane", ObjectType.MILK).object_type is ObjectType.MILK


def test_an_object_needs_a_world() -> None:
    with pytest.raises(NoWorld, match="'milk'"):
        Object("milk", ObjectType.MILK)


def test_reset_of_an_object_reports_only_its_changes(world: BulletWorld, change_log: ChangeLog) -> None:
    placed_crane, cup = crane(LEANING), Object("cup", ObjectType.JEROEN_CUP, pose=Pose([1, 0, 0]))
    placed_crane.attach(cup, "hook")
    placed_crane.set_joint_positions({"turning": 0.4, "lifting": 0.0})
    kept = cup.pose
    change_log.notes.clear()
    placed_crane.reset()
    assert change_log.notes == [("detached", "crane", "cup", "hook"), ("joints", "crane", {"turning": 0.0})]
    assert placed_crane.pose is LEANING
    assert cup.pose is kept
    change_log.notes.clear()
    placed_crane.reset()
    assert change_log.notes == []


def test_a_removed_object_can_be_read_but_not_moved(world: BulletWorld, change_log: ChangeLog) -> None:
    placed_crane = crane(LEANING)
    placed_crane.set_joint_position("turning", 0.4)
    placed_crane.remove()
    assert change_log.notes[-1] == ("removed", "crane", LEANING)
    assert (placed_crane.name, placed_crane.pose, placed_crane.joint_position("turning")) == ("crane", LEANING, 0.4)
    assert world.objects == ()
    for call in (
        lambda: placed_crane.set_pose(Pose()),
        lambda: placed_crane.set_joint_position("turning", 0.0),
        lambda: placed_crane.link_pose("hook"),
        placed_crane.bounding_box,
        placed_crane.reset,
        placed_crane.remove,
    ):
        with pytest.raises(ObjectNotInWorld, match="'crane'"):
            call()


def test_a_colour_is_applied_to_every_link(world: BulletWorld) -> None:
    from pycrorm_async.world.bullet_body import engine

    milk = Object("milk", ObjectType.MILK, color=(1.0, 0.0, 0.5, 1.0))
    shapes = engine().getVisualShapeData(milk.body.number, physicsClientId=world.client)
    assert [shape[7] for shape in shapes] == [(1.0, 0.0, 0.5, 1.0)]
