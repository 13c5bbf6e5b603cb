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


def test_two_hundred_motions_leave_the_attachment_exact(crane: Object, cup: Object) -> None:
    crane.attach(cup, "hook")
    for step in range(200):
        crane.set_joint_position("turning", 0.05 * step)
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


@pytest.mark.parametrize("moved", [None, Pose([0.9, 0.9, 0.9], yaw_quaternion(1.0))])
def test_joints_and_base_carry_a_chain_rigidly_also_after_it_was_moved(
    crane: Object, cup: Object, spoon: Object, moved: Pose | None
) -> None:
    crane.attach(cup, "hook")
    cup.attach(spoon)
    if moved is not None:
        cup.set_pose(moved)
    held = {each: each.pose for each in (cup, spoon)}
    before = crane_links(Pose(), turning=0, lifting=0, reaching=0)["hook"]
    crane.set_joint_positions(JOINTS)
    crane.set_pose(BASE)
    after = crane_links(BASE, **JOINTS)["hook"]
    for each, pose in held.items():
        np.testing.assert_allclose(matrix(each.pose), carried(before, after, pose), atol=1e-9)


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


def around(corners: list[tuple[float, float, float]], where: np.ndarray) -> np.ndarray:
    """Return the box around these points of a link that is at `where`."""
    points = np.array([(where @ [*corner, 1])[:3] for corner in corners])
    return np.array([points.min(axis=0), points.max(axis=0)])


def corners(x: float, y: float, z: float) -> list[tuple[float, float, float]]:
    return [(i * x / 2, j * y / 2, k * z / 2) for i, j, k in itertools.product((-1, 1), repeat=3)]


RIMS = [
    (0.1 * math.cos(angle), 0.1 * math.sin(angle), end)
    for angle in np.linspace(0, 2 * math.pi, 20_001)
    for end in (-0.2, 0.2)
]
TETRAHEDRON = "v 0 0 0\nv 1 0 0\nv 0 2 0\nv 0 0 3\nf 1 3 2\nf 1 2 4\nf 2 3 4\nf 1 4 3\n"
SHAPES = {
    "box": ('<box size="0.2 0.4 0.6"/>', corners(0.2, 0.4, 0.6)),
    "cylinder": ('<cylinder radius="0.1" length="0.4"/>', RIMS),
    "mesh": ('<mesh filename="{mesh}" scale="0.1 0.1 0.1"/>', [(0, 0, 0), (0.1, 0, 0), (0, 0.2, 0), (0, 0, 0.3)]),
}


@pytest.mark.parametrize("kind", SHAPES)
def test_a_tilted_shape_takes_the_space_of_its_corners_or_rims(world: BulletWorld, kind: str, tmp_path: Path) -> None:
    mesh = tmp_path / "tetrahedron.obj"
    mesh.write_text(TETRAHEDRON)
    shape, points = SHAPES[kind]
    geometry = f'<origin xyz="0.2 0 0" rpy="0.1 0 0.5"/><geometry>{shape.format(mesh=mesh)}</geometry>'
    text = f'<robot name="a"><link name="l"><collision>{geometry}</collision></link></robot>'
    body = Object("thing", ObjectType.GENERIC_OBJECT, text)
    pose = Pose([1, -1, 0.5], [0.1, 0.5, -0.2, 0.7])
    body.set_pose(pose)
    where = matrix(pose) @ shifted(0.2, 0, 0) @ turned(Z, 0.5) @ turned(X, 0.1)
    np.testing.assert_allclose(body.bounding_box(), around(points, where), atol=1e-6)


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
