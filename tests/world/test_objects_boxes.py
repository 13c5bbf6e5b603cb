"""A bounding box encloses its object exactly, immediately after every motion."""

from __future__ import annotations

import itertools
import math
from pathlib import Path

import numpy as np
import pytest

from pycrorm_async.world import BoundingBox, BulletWorld, Object, ObjectType, Pose, Vector
from pycrorm_async.world.pose import yaw_quaternion
from tests.world.fakes import CRANE, X, Z, crane_links, matrix, shifted, turned

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


def test_a_box_has_a_centre_and_a_size() -> None:
    box = BoundingBox(Vector(0.0, -1.0, 2.0), Vector(1.0, 1.0, 2.5))
    assert box.centre == Vector(0.5, 0.0, 2.25)
    assert box.size == Vector(1.0, 2.0, 0.5)


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
