"""An attached object moves rigidly with its link, and its box encloses it exactly after every motion."""

from __future__ import annotations

import itertools
import math
from pathlib import Path

import numpy as np
import pytest

from pycrorm_async.world import BoundingBox, BulletWorld, Object, ObjectType, Pose
from pycrorm_async.world.pose import AttachmentRefused, ObjectNotInWorld, UnknownLink, yaw_quaternion
from tests.world.fakes import CRANE, ChangeLog, X, Z, crane_links, matrix, shifted, turned

# === objects attached =========================================================================================
#
# An attached object moves rigidly with its link, and each motion is reported once.

BASE = Pose([0.5, 1.0, 0.2], [0.1, 0.2, -0.3, 0.9])
CUP_AT = Pose([1.1, 0.6, 0.9], [0.5, 0.1, 0.0, 0.8])
SPOON_AT = Pose([1.2, 0.7, 1.1], yaw_quaternion(0.4))
JOINTS = {"turning": 0.8, "lifting": -0.3, "reaching": 0.4}


@pytest.fixture
def crane(world: BulletWorld) -> Object:
    return Object("crane", ObjectType.GENERIC_OBJECT, CRANE)


@pytest.fixture
def cup(world: BulletWorld) -> Object:
    return Object("cup", ObjectType.JEROEN_CUP, pose=CUP_AT)


@pytest.fixture
def spoon(world: BulletWorld) -> Object:
    return Object("spoon", ObjectType.SPOON, pose=SPOON_AT)


def carried(before: np.ndarray, after: np.ndarray, pose: Pose) -> np.ndarray:
    """Return the pose of an object at `pose` after its carrier moved from one matrix to the other."""
    return np.asarray(after @ np.linalg.inv(before) @ matrix(pose))


def test_joints_and_base_carry_a_chain_rigidly(crane: Object, cup: Object, spoon: Object) -> None:
    crane.attach(cup, "hook")
    cup.attach(spoon)
    before = crane_links(Pose(), turning=0, lifting=0, reaching=0)["hook"]
    crane.set_joint_positions(JOINTS)
    crane.set_pose(BASE)
    after = crane_links(BASE, **JOINTS)["hook"]
    np.testing.assert_allclose(matrix(cup.pose), carried(before, after, CUP_AT), atol=1e-9)
    np.testing.assert_allclose(matrix(spoon.pose), carried(before, after, SPOON_AT), atol=1e-9)


def test_a_thousand_motions_leave_the_attachment_exact(crane: Object, cup: Object) -> None:
    crane.attach(cup, "hook")
    for step in range(1000):
        crane.set_joint_position("turning", 0.01 * step)
    crane.set_joint_position("turning", 0.0)
    np.testing.assert_allclose(matrix(cup.pose), matrix(CUP_AT), atol=1e-9)


def test_one_motion_is_reported_once_for_each_object_it_carries(
    crane: Object, cup: Object, spoon: Object, change_log: ChangeLog
) -> None:
    crane.attach(cup, "hook")
    cup.attach(spoon)
    change_log.notes.clear()
    crane.set_joint_positions(JOINTS)
    assert change_log.notes == [
        ("joints", "crane", JOINTS),
        ("moved", "cup", cup.pose),
        ("moved", "spoon", spoon.pose),
    ]
    change_log.notes.clear()
    crane.set_pose(BASE)
    assert change_log.notes == [("moved", "crane", BASE), ("moved", "cup", cup.pose), ("moved", "spoon", spoon.pose)]
    change_log.notes.clear()
    cup.set_pose(CUP_AT)
    assert change_log.notes == [("moved", "cup", CUP_AT), ("moved", "spoon", spoon.pose)]


def test_observers_are_notified_when_the_whole_motion_is_done(world: BulletWorld, crane: Object, cup: Object) -> None:
    crane.attach(cup, "hook")
    seen: list[tuple[Pose, Pose]] = []

    class Looking(ChangeLog):
        def object_moved(self, moved: Object) -> None:
            seen.append((crane.pose, cup.pose))

    world.observe(Looking())
    crane.set_pose(BASE)
    assert seen == [(BASE, cup.pose)] * 2
    assert cup.pose != CUP_AT


def test_joints_that_do_not_move_the_link_carry_no_object(crane: Object, cup: Object, change_log: ChangeLog) -> None:
    crane.attach(cup, "flag")
    change_log.notes.clear()
    crane.set_joint_positions({"lifting": 0.5, "reaching": 0.2})
    assert change_log.names() == [("joints", "crane")]
    assert cup.pose is CUP_AT
    crane.set_joint_position("turning", 0.5)
    assert change_log.names() == [("joints", "crane"), ("joints", "crane"), ("moved", "cup")]


def test_an_attachment_without_a_link_is_to_the_base(crane: Object, cup: Object, change_log: ChangeLog) -> None:
    crane.attach(cup)
    crane.set_joint_positions(JOINTS)
    assert cup.pose is CUP_AT
    crane.set_pose(BASE)
    np.testing.assert_allclose(matrix(cup.pose), matrix(BASE) @ matrix(CUP_AT), atol=1e-9)
    assert ("attached", "crane", "cup", None) in change_log.notes


def test_an_attached_object_that_is_moved_stays_attached_at_its_new_place(crane: Object, cup: Object) -> None:
    crane.attach(cup, "hook")
    moved = Pose([0.9, 0.9, 0.9], yaw_quaternion(1.0))
    cup.set_pose(moved)
    assert cup.attached_to is crane
    crane.set_joint_positions(JOINTS)
    before = crane_links(Pose(), turning=0, lifting=0, reaching=0)["hook"]
    after = crane_links(Pose(), **JOINTS)["hook"]
    np.testing.assert_allclose(matrix(cup.pose), carried(before, after, moved), atol=1e-9)


def test_attaching_moves_nothing_and_can_be_read_from_both_ends(
    crane: Object, cup: Object, spoon: Object, change_log: ChangeLog
) -> None:
    change_log.notes.clear()
    crane.attach(cup, "hook")
    crane.attach(spoon)
    assert (cup.pose, spoon.pose) == (CUP_AT, SPOON_AT)
    assert crane.attachments == {cup: "hook", spoon: None}
    assert cup.attached_to is crane
    assert crane.attached_to is None
    assert change_log.notes == [("attached", "crane", "cup", "hook"), ("attached", "crane", "spoon", None)]


def test_a_detached_object_stays_in_place(crane: Object, cup: Object, change_log: ChangeLog) -> None:
    crane.attach(cup, "hook")
    crane.set_joint_positions(JOINTS)
    held_at = cup.pose
    crane.detach(cup)
    assert change_log.notes[-1] == ("detached", "crane", "cup", "hook")
    crane.set_pose(BASE)
    assert cup.pose is held_at
    assert (crane.attachments, cup.attached_to) == ({}, None)


def test_an_impossible_attachment_or_detachment_is_refused(crane: Object, cup: Object, spoon: Object) -> None:
    crane.attach(cup, "hook")
    cup.attach(spoon)
    with pytest.raises(AttachmentRefused, match="only an Object can be attached to 'crane', got 'cup'"):
        crane.attach("cup")  # type: ignore[arg-type]  # the fault this test is about
    with pytest.raises(AttachmentRefused, match="'cup' is attached to 'crane' already"):
        crane.attach(cup, "hook")
    with pytest.raises(AttachmentRefused, match="'spoon' is attached to 'cup' already"):
        crane.attach(spoon)
    with pytest.raises(AttachmentRefused, match="'crane' cannot be attached to itself"):
        crane.attach(crane, "hook")
    with pytest.raises(AttachmentRefused, match="'crane' cannot be attached to itself \\(through 'spoon'\\)"):
        spoon.attach(crane)
    with pytest.raises(AttachmentRefused, match="'spoon' is not attached to 'crane'"):
        crane.detach(spoon)
    with pytest.raises(UnknownLink, match="'claw'"):
        crane.attach(spoon, "claw")
    assert (crane.attachments, cup.attachments) == ({cup: "hook"}, {spoon: None})


def test_objects_of_two_worlds_are_not_attached(crane: Object) -> None:
    with BulletWorld() as other:
        bowl = Object("bowl", ObjectType.BOWL, world=other)
        with pytest.raises(AttachmentRefused, match="different worlds"):
            crane.attach(bowl)


def test_removing_detaches_both_ways_first(crane: Object, cup: Object, spoon: Object, change_log: ChangeLog) -> None:
    crane.attach(cup, "hook")
    cup.attach(spoon)
    change_log.notes.clear()
    cup.remove()
    assert change_log.notes == [
        ("detached", "cup", "spoon", None),
        ("detached", "crane", "cup", "hook"),
        ("removed", "cup", CUP_AT),
    ]
    with pytest.raises(ObjectNotInWorld, match="'cup'"):
        crane.attach(cup)
    crane.set_pose(BASE)
    assert (cup.pose, spoon.pose) == (CUP_AT, SPOON_AT)


# === objects boxes ============================================================================================
#
# A bounding box encloses its object exactly, immediately after every motion.

ONE_LINK = '<robot name="a"><link name="l"><collision>{origin}<geometry>{shape}</geometry></collision></link></robot>'


def one(shape: str, origin: str = "", pose: Pose | None = None) -> Object:
    return Object("thing", ObjectType.GENERIC_OBJECT, ONE_LINK.format(shape=shape, origin=origin), pose)


def around(corners: list[tuple[float, float, float]], where: np.ndarray) -> np.ndarray:
    """Return the box around these points of a link that is at `where`."""
    points = np.array([(where @ [*corner, 1])[:3] for corner in corners])
    return np.array([points.min(axis=0), points.max(axis=0)])


def corners(x: float, y: float, z: float) -> list[tuple[float, float, float]]:
    return [(i * x / 2, j * y / 2, k * z / 2) for i, j, k in itertools.product((-1, 1), repeat=3)]


def test_a_box_rotated_by_45_degrees_takes_its_diagonal(world: BulletWorld) -> None:
    body = one('<box size="0.2 0.2 0.5"/>', pose=Pose([1, 2, 3], yaw_quaternion(math.pi / 4)))
    half = 0.1 * math.sqrt(2)
    np.testing.assert_allclose(body.bounding_box(), [(1 - half, 2 - half, 2.75), (1 + half, 2 + half, 3.25)], atol=1e-9)


def test_a_tilted_box_takes_the_space_of_its_corners(world: BulletWorld) -> None:
    pose = Pose([0.5, -0.2, 1.0], [0.3, 0.1, -0.5, 0.6])
    body = one('<box size="0.2 0.4 0.6"/>', '<origin xyz="0.1 0 0.3" rpy="0 0 0.3"/>')
    body.set_pose(pose)
    where = matrix(pose) @ shifted(0.1, 0, 0.3) @ turned(Z, 0.3)
    np.testing.assert_allclose(body.bounding_box(), around(corners(0.2, 0.4, 0.6), where), atol=1e-9)


def test_a_sphere_takes_its_radius_whatever_its_orientation(world: BulletWorld) -> None:
    body = one('<sphere radius="0.25"/>', pose=Pose([1, 0, 0], [0.3, 0.1, -0.5, 0.6]))
    np.testing.assert_allclose(body.bounding_box(), [(0.75, -0.25, -0.25), (1.25, 0.25, 0.25)], atol=1e-9)


def test_a_tilted_cylinder_takes_the_space_of_its_rims(world: BulletWorld) -> None:
    body = one('<cylinder radius="0.1" length="0.4"/>')
    body.set_pose(Pose([0, 0, 1], [math.sin(0.3), 0, 0, math.cos(0.3)]))
    rims = [
        (0.1 * math.cos(angle), 0.1 * math.sin(angle), end)
        for angle in np.linspace(0, 2 * math.pi, 20_001)
        for end in (-0.2, 0.2)
    ]
    expected = around(rims, shifted(0, 0, 1) @ turned(X, 0.6))
    np.testing.assert_allclose(body.bounding_box(), expected, atol=1e-6)


def test_the_box_of_a_link_moves_with_joints_and_base(world: BulletWorld) -> None:
    body = Object("crane", ObjectType.GENERIC_OBJECT, CRANE)
    base = Pose([1, 2, 0.1], yaw_quaternion(0.3))
    body.set_pose(base)
    body.set_joint_positions({"turning": 0.8, "lifting": 0.9, "reaching": 0.5})
    links = crane_links(base, turning=0.8, lifting=0.9, reaching=0.5)
    mast = around(corners(0.1, 0.2, 0.4), links["mast"] @ shifted(0.1, 0, 0.2) @ turned(X, 0.5))
    foot = around(corners(0.4, 0.6, 0.2), links["foot"] @ shifted(0, 0, 0.1))
    ball = (links["hook"] @ [0, 0, -0.1, 1])[:3]
    hook = np.array([ball - 0.05, ball + 0.05])
    flag = around([(0, 0, -0.1), (0, 0, 0.1)], links["flag"]) + np.array([(-0.03, -0.03, 0), (0.03, 0.03, 0)])
    for link, expected in {"mast": mast, "foot": foot, "hook": hook, "flag": flag}.items():
        np.testing.assert_allclose(body.bounding_box(link), expected, atol=1e-9, err_msg=link)
    every = np.stack([mast, foot, hook, flag])
    np.testing.assert_allclose(body.bounding_box(), [every[:, 0].min(axis=0), every[:, 1].max(axis=0)], atol=1e-9)


def test_a_link_without_a_shape_has_a_box_of_size_zero_at_its_frame(world: BulletWorld) -> None:
    body = Object("crane", ObjectType.GENERIC_OBJECT, CRANE)
    at = body.link_pose("boom").position
    assert body.bounding_box("boom") == BoundingBox(at, at)


TETRAHEDRON = "v 0 0 0\nv 1 0 0\nv 0 2 0\nv 0 0 3\nf 1 3 2\nf 1 2 4\nf 2 3 4\nf 1 4 3\n"
INERTIAL = (
    '<inertial><origin xyz="0.3 0.1 0" rpy="0 0.4 1"/><mass value="1"/>'
    '<inertia ixx="1" iyy="1" izz="1" ixy="0" ixz="0" iyz="0"/></inertial>'
)


@pytest.mark.parametrize("inertial", ["", INERTIAL])
def test_a_mesh_takes_the_space_of_its_corners(world: BulletWorld, tmp_path: Path, inertial: str) -> None:
    mesh = tmp_path / "tetrahedron.obj"
    mesh.write_text(TETRAHEDRON)
    shape = (
        '<collision><origin xyz="0.2 0 0" rpy="0.1 0 0.5"/><geometry>'
        f'<mesh filename="{mesh}" scale="0.1 0.1 0.1"/></geometry></collision>'
    )
    body = Object("mesh", ObjectType.GENERIC_OBJECT, f'<robot name="a"><link name="l">{inertial}{shape}</link></robot>')
    pose = Pose([1, -1, 0.5], [0.1, 0.5, -0.2, 0.7])
    body.set_pose(pose)
    where = matrix(pose) @ shifted(0.2, 0, 0) @ turned(Z, 0.5) @ turned(X, 0.1)
    expected = around([(0, 0, 0), (0.1, 0, 0), (0, 0.2, 0), (0, 0, 0.3)], where)
    np.testing.assert_allclose(body.bounding_box(), expected, atol=1e-3)


def test_a_mesh_whose_corners_bullet_does_not_return_is_at_least_covered(world: BulletWorld, tmp_path: Path) -> None:
    mesh = tmp_path / "tetrahedron.obj"
    mesh.write_text(TETRAHEDRON)
    shape = (
        '<collision><geometry><box size="0.1 0.1 0.1"/></geometry></collision><collision><geometry>'
        f'<mesh filename="{mesh}" scale="0.1 0.1 0.1"/></geometry></collision>'
    )
    body = Object("mesh", ObjectType.GENERIC_OBJECT, f'<robot name="a"><link name="l">{INERTIAL}{shape}</link></robot>')
    body.set_pose(Pose([1, 0, 0]))
    low, high = np.array(body.bounding_box())
    assert (low <= np.array([0.95, -0.05, -0.05])).all()
    assert (high >= np.array([1.1, 0.2, 0.3])).all()
    assert (high - low < np.array([0.6, 0.6, 0.6])).all()
