"""Objects and their links have the poses of their description, and impossible changes are refused."""

from __future__ import annotations

import math
import re
from typing import Any

import numpy as np
import pytest

from pycrorm_async.world import BulletWorld, JointType, Object, ObjectType, Pose
from pycrorm_async.world.errors import (
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
    thing = crane(base)
    thing.set_joint_positions({"turning": turning, "lifting": lifting, "reaching": reaching})
    expected = crane_links(base, turning=turning, lifting=lifting, reaching=reaching)
    assert set(thing.links) == set(expected)
    for link, where in expected.items():
        np.testing.assert_allclose(matrix(thing.link_pose(link)), where, atol=1e-9)


@pytest.mark.parametrize("base", [Pose(), LEANING])
def test_a_link_pose_at_other_joint_positions_moves_nothing_and_notifies_no_observer(
    world: BulletWorld, base: Pose
) -> None:
    thing = crane(base)
    thing.set_joint_positions({"turning": 0.4, "lifting": -0.5, "reaching": 0.1})
    change_log = ChangeLog()
    world.observe(change_log)
    before = {link: thing.link_pose(link) for link in thing.links}
    expected = crane_links(base, turning=2.5, lifting=-0.5, reaching=0.25)
    for link, where in expected.items():
        there = thing.link_pose_at(link, {"turning": 2.5, "reaching": 0.25})
        np.testing.assert_allclose(matrix(there), where, atol=1e-9)
    assert {link: thing.link_pose(link) for link in thing.links} == before
    assert thing.joint_positions() == {"turning": 0.4, "lifting": -0.5, "reaching": 0.1}
    assert change_log.notes == []
    with pytest.raises(UnknownJoint):
        thing.link_pose_at("hook", {"rowing": 1.0})


def test_links_follow_a_base_that_is_set_after_the_joints(world: BulletWorld) -> None:
    thing = crane()
    thing.set_joint_positions({"turning": 0.4, "reaching": 0.6})
    thing.set_pose(LEANING)
    expected = crane_links(LEANING, turning=0.4, lifting=0, reaching=0.6)
    np.testing.assert_allclose(matrix(thing.link_pose("hook")), expected["hook"], atol=1e-9)


def test_joints_and_links_have_the_names_kinds_and_limits_of_the_description(world: BulletWorld) -> None:
    thing = crane()
    assert thing.links[0] == "foot"
    assert set(thing.joints) == {"turning", "lifting", "reaching"}
    assert thing.joint_positions() == {"turning": 0.0, "lifting": 0.0, "reaching": 0.0}
    assert thing.joint_limits("lifting") == (-0.5, 1.2)
    assert thing.joint_limits("reaching") == (0.0, 0.6)
    assert thing.joint_limits("turning") == (-math.inf, math.inf)
    assert [thing.joint_type(joint) for joint in ("turning", "lifting", "reaching", "pole")] == [
        JointType.CONTINUOUS,
        JointType.REVOLUTE,
        JointType.PRISMATIC,
        JointType.FIXED,
    ]
    assert thing.joints_above("hook") == ("reaching", "lifting", "turning")
    assert thing.joints_above("flag") == ("turning",)
    assert thing.joints_above("foot") == ()


def test_one_motion_of_joints_is_reported_once_with_all_of_them(world: BulletWorld, change_log: ChangeLog) -> None:
    thing = crane()
    change_log.notes.clear()
    thing.set_joint_positions({"turning": 1.5, "reaching": 0.1})
    thing.set_joint_position("reaching", 0.1)
    assert change_log.notes == [
        ("joints", "crane", {"turning": 1.5, "reaching": 0.1}),
        ("joints", "crane", {"reaching": 0.1}),
    ]
    assert thing.joint_positions() == {"turning": 1.5, "lifting": 0.0, "reaching": 0.1}


def test_a_motion_of_no_joints_is_ignored(world: BulletWorld, change_log: ChangeLog) -> None:
    thing = crane()
    change_log.notes.clear()
    thing.set_joint_positions({})
    assert change_log.notes == []


def test_a_base_motion_is_reported_once_even_without_a_change(world: BulletWorld, change_log: ChangeLog) -> None:
    thing = crane()
    change_log.notes.clear()
    thing.set_pose(LEANING)
    thing.set_pose(LEANING)
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
    thing = crane()
    change_log.notes.clear()
    with pytest.raises(JointLimitExceeded) as refused:
        thing.set_joint_positions({"turning": 0.5, "lifting": 0.5, joint: value})
    assert (refused.value.object_name, refused.value.joint, refused.value.limits) == ("crane", joint, limits)
    assert refused.value.value == value or math.isnan(value)
    assert thing.joint_positions() == {"turning": 0.0, "lifting": 0.0, "reaching": 0.0}
    assert change_log.notes == []


def test_a_joint_without_limits_is_refused_with_a_clear_message(world: BulletWorld) -> None:
    with pytest.raises(JointLimitExceeded) as refused:
        crane().set_joint_position("turning", math.inf)
    assert str(refused.value) == "'crane': turning cannot be set to inf; its limits are -1e+09 to 1e+09"


def test_rounding_past_a_limit_is_accepted_and_never_clamped(world: BulletWorld) -> None:
    thing = crane()
    thing.set_joint_position("lifting", 1.2 + 9e-7)
    assert thing.joint_position("lifting") == 1.2 + 9e-7


def test_unknown_names_are_refused_with_those_that_exist(world: BulletWorld) -> None:
    thing = crane()
    for call in (
        lambda: thing.set_joint_position("elbow", 0.0),
        lambda: thing.joint_position("elbow"),
        lambda: thing.joint_limits("elbow"),
        lambda: thing.joint_type("elbow"),
    ):
        with pytest.raises(UnknownJoint, match=r"'crane' has no movable joint 'elbow'.*turning"):
            call()
    for look in (thing.link_pose, thing.bounding_box, thing.joints_above):
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
    thing, milk = crane(LEANING), Object("milk", ObjectType.MILK)
    thing.attach(milk, "hook")
    change_log.notes.clear()
    with pytest.raises(PoseRefused, match=re.escape(reason)) as refused:
        thing.set_pose(pose)
    assert refused.value.object_name == "crane"
    assert refused.value.pose is pose
    assert str(refused.value).startswith(f"'crane' cannot be moved to {pose!r}: ")
    assert (thing.pose, milk.pose) == (LEANING, Pose())
    with pytest.raises(PoseRefused, match=r"'crane' cannot be moved to \[1, 2, 3\]: it is not a Pose"):
        thing.set_pose([1, 2, 3])  # type: ignore[arg-type]  # the fault this test is about
    with pytest.raises(PoseRefused, match="'cup'"):
        Object("cup", ObjectType.JEROEN_CUP, pose=pose)
    assert [present.name for present in world.objects] == ["crane", "milk"]
    assert change_log.notes == []


def test_the_pose_of_an_object_carried_to_the_farthest_place_is_finite(world: BulletWorld) -> None:
    thing, milk = crane(), Object("milk", ObjectType.MILK, pose=Pose([-1e9, -1e9, -1e9]))
    thing.attach(milk, "hook")
    for place in (Pose([1e9, 1e9, 1e9], [0.2, -0.4, 0.1, 0.8]), Pose([-1e9, 0, 1e9], [0.2, 0.4, 0.1, -0.8])):
        thing.set_pose(place)
        thing.set_joint_position("turning", 1e9)
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
    thing, cup = crane(LEANING), Object("cup", ObjectType.JEROEN_CUP, pose=Pose([1, 0, 0]))
    thing.attach(cup, "hook")
    thing.set_joint_positions({"turning": 0.4, "lifting": 0.0})
    kept = cup.pose
    change_log.notes.clear()
    thing.reset()
    assert change_log.notes == [("detached", "crane", "cup", "hook"), ("joints", "crane", {"turning": 0.0})]
    assert thing.pose is LEANING
    assert cup.pose is kept
    change_log.notes.clear()
    thing.reset()
    assert change_log.notes == []


def test_a_removed_object_can_be_read_but_not_moved(world: BulletWorld, change_log: ChangeLog) -> None:
    thing = crane(LEANING)
    thing.set_joint_position("turning", 0.4)
    thing.remove()
    assert change_log.notes[-1] == ("removed", "crane", LEANING)
    assert (thing.name, thing.pose, thing.joint_position("turning")) == ("crane", LEANING, 0.4)
    assert world.objects == ()
    for call in (
        lambda: thing.set_pose(Pose()),
        lambda: thing.set_joint_position("turning", 0.0),
        lambda: thing.link_pose("hook"),
        thing.bounding_box,
        thing.reset,
        thing.remove,
    ):
        with pytest.raises(ObjectNotInWorld, match="'crane'"):
            call()


def test_a_colour_is_applied_to_every_link(world: BulletWorld) -> None:
    from pycrorm_async.world.bullet_loader import engine

    milk = Object("milk", ObjectType.MILK, color=(1.0, 0.0, 0.5, 1.0))
    shapes = engine().getVisualShapeData(milk.body.number, physicsClientId=world.client)
    assert [shape[7] for shape in shapes] == [(1.0, 0.0, 0.5, 1.0)]
