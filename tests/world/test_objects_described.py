"""A description is URDF text, a .urdf file, or built in; one that cannot be loaded is refused with the reason."""

from __future__ import annotations

import re
from pathlib import Path

import numpy as np
import pytest

from pycrorm_async.world import BulletWorld, Object, ObjectType, Pose
from pycrorm_async.world.models import pr2_mesh_urdf_path, pr2_urdf
from pycrorm_async.world.pose import DescriptionNotLoadable
from pycrorm_async.world.urdf import PR2
from tests.world.fakes import CRANE

WEDGE = """v 0 0 0
v 1 0 0
v 0 2 0
v 0 0 3
f 1 3 2
f 1 2 4
f 2 3 4
f 1 4 3
"""


def with_mesh(reference: str) -> str:
    return (
        '<robot name="wedge"><link name="wedge"><collision><origin xyz="1 0 0"/><geometry>'
        f'<mesh filename="{reference}" scale="0.1 0.1 0.1"/></geometry></collision></link></robot>'
    )


def test_text_and_file_make_the_same_object(world: BulletWorld, tmp_path: Path) -> None:
    file = tmp_path / "crane.urdf"
    file.write_text(CRANE)
    by_text = Object("a", ObjectType.GENERIC_OBJECT, CRANE)
    by_path = Object("b", ObjectType.GENERIC_OBJECT, file)
    by_name = Object("c", ObjectType.GENERIC_OBJECT, str(file))
    assert by_text.description_text == by_path.description_text == by_name.description_text == CRANE
    assert by_text.links == by_path.links == by_name.links


def test_a_changed_file_is_read_again(world: BulletWorld, tmp_path: Path) -> None:
    file = tmp_path / "crane.urdf"
    file.write_text(CRANE)
    Object("before", ObjectType.GENERIC_OBJECT, file)
    file.write_text(CRANE.replace('"mast"', '"tower"'))
    assert "tower" in Object("after", ObjectType.GENERIC_OBJECT, file).links


@pytest.mark.parametrize(
    "reference", ["package://parts/meshes/wedge.obj", "package:///parts/meshes/wedge.obj", "../meshes/wedge.obj"]
)
def test_meshes_are_searched_beside_the_file_and_in_packages_above_it(
    world: BulletWorld, tmp_path: Path, reference: str
) -> None:
    (tmp_path / "parts" / "meshes").mkdir(parents=True)
    (tmp_path / "parts" / "meshes" / "wedge.obj").write_text(WEDGE)
    (tmp_path / "parts" / "urdf").mkdir()
    file = tmp_path / "parts" / "urdf" / "wedge.urdf"
    file.write_text(with_mesh(reference))
    box = Object("wedge", ObjectType.GENERIC_OBJECT, file, Pose([0, 0, 1])).bounding_box()
    np.testing.assert_allclose(box, [(1, 0, 1), (1.1, 0.2, 1.3)], atol=1e-3)


def test_a_robot_of_more_joints_than_bullet_reports_has_the_poses_and_boxes_of_all_links(
    world: BulletWorld, tmp_path: Path
) -> None:
    (tmp_path / "wedge.obj").write_text(WEDGE)
    mesh = f'<geometry><mesh filename="{tmp_path}/wedge.obj" scale="0.1 0.1 0.1"/></geometry>'
    body = '<inertial><origin xyz="0.5 0 0"/><mass value="1"/><inertia ixx="1" iyy="1" izz="1"/></inertial>'
    two_meshes = f'<collision>{mesh}</collision><collision><origin xyz="1 0 0"/>{mesh}</collision>'
    for count in (127, 128, 140):  # Bullet reports the links of a body with 127 joints, and no more
        links = "".join(f'<link name="{each}">{body}</link>' for each in range(count))
        joints = "".join(
            f'<joint name="j{each}" type="{"fixed" if each else "revolute"}"><parent link="{each}"/>'
            f'<child link="{each + 1}"/><origin xyz="0.1 0 0"/><axis xyz="0 0 1"/>'
            '<limit lower="-2" upper="2" effort="1" velocity="1"/></joint>'
            for each in range(count)
        )
        text = f'<robot name="snake">{links}<link name="{count}">{body}{two_meshes}</link>{joints}</robot>'
        snake = Object(f"snake {count}", ObjectType.ROBOT, text, Pose([1, 2, 3]))  # its text is one line
        ahead = snake.bounding_box(f"{count}")
        end = 1 + 0.1 * count
        np.testing.assert_allclose(ahead, [(end, 2, 3), (end + 1.1, 2.2, 3.3)], atol=5e-3)
        assert snake.link_pose_at(f"{count}", {"j0": np.pi / 2}).distance(Pose([1.1, 1.9 + 0.1 * count, 3])) < 1e-9
        snake.set_joint_position("j0", np.pi / 2)
        assert snake.link_pose(f"{count}").distance(Pose([1.1, 1.9 + 0.1 * count, 3])) < 1e-9
        side = snake.bounding_box(f"{count}")
        np.testing.assert_allclose(side, [(0.9, 1.9 + 0.1 * count, 3), (1.1, 3 + 0.1 * count, 3.3)], atol=5e-3)


def two_joints(first: str, second: str) -> str:
    """Return links r, l and m, and two fixed joints, given as name and parent and child."""
    joints = "".join(
        f'<joint name="{name}" type="fixed"><parent link="{parent}"/><child link="{child}"/></joint>'
        for name, parent, child in (first.split(), second.split())
    )
    return f'<robot name="a"><link name="r"/><link name="l"/><link name="m"/>{joints}</robot>'


HINGE = '<joint name="j" type="revolute"><parent link="r"/><child link="m"/></joint>'
BOX = "<link name='r'><collision><geometry><box/></geometry></collision></link>"
FAULTS = {
    "no such file": ("/proc/none/crane.urdf", "cannot be read"),
    "not XML": ('<robot name="a"><link', "unclosed token"),
    "another element": ("<foo/>", "its root element is <foo>"),
    "no link": ('<robot name="a"/>', "it has no link"),
    "two roots": ('<robot name="a"><link name="l"/><link name="m"/></robot>', "one root link, and has 2: l, m"),
    "a circle": (two_joints("j l m", "k m l"), "joined in a cycle"),
    "two joints of one name": (two_joints("j r m", "j r l"), "2 joints are named 'j'"),
    "two parents": (two_joints("j r m", "k l m"), "'m' has two parents"),
    "a joint to nowhere": (two_joints("j r m", "k r z"), "names a link 'z' that does not exist"),
    "a link without a name": ('<robot name="a"><link/></robot>', "a link has no name"),
    "a mesh that is missing": (with_mesh("package://parts/none.stl"), "mesh package://parts/none.stl is not at"),
    "a joint without limits": (
        f'<robot name="a"><link name="r"/><link name="m"/>{HINGE}</robot>',
        "does not specify limits",
    ),
    "an origin that is nowhere": (with_mesh("none.stl").replace('"1 0 0"', '"1 nan 0"'), "<origin> holds nan"),
    "a turn without end": (with_mesh("none.stl").replace('xyz="1 0 0"', 'rpy="0 0 1e999"'), "<origin> holds inf"),
    "a place too far": (with_mesh("none.stl").replace('"1 0 0"', '"1.1e9 0 0"'), "<origin> holds 1.1e+09"),
    "a box without a size": (f'<robot name="a">{BOX}</robot>', "box requires a size"),
}


@pytest.mark.parametrize("fault", FAULTS)
def test_a_description_that_cannot_be_loaded_is_refused_with_the_reason(world: BulletWorld, fault: str) -> None:
    description, reason = FAULTS[fault]
    with pytest.raises(DescriptionNotLoadable, match=re.escape(reason)) as refused:
        Object("thing", ObjectType.GENERIC_OBJECT, description)
    assert refused.value.name == "thing"
    assert world.objects == ()


@pytest.mark.parametrize("object_type", [ObjectType.ROBOT, ObjectType.ENVIRONMENT])
def test_a_robot_or_environment_that_is_not_built_in_needs_a_description(
    world: BulletWorld, object_type: ObjectType
) -> None:
    with pytest.raises(DescriptionNotLoadable, match="'pr2', 'courier' are robots, 'kitchen' the environment"):
        Object("somewhere", object_type)
    assert Object("somewhere", object_type, CRANE).robot_description is None


def test_the_built_in_robot_is_the_pr2(world: BulletWorld) -> None:
    robot = Object("pr2", ObjectType.ROBOT)
    assert robot.robot_description is PR2
    assert robot.description_text == pr2_urdf()
    assert robot.joint_limits("torso_lift_joint") == (0.0, 0.33)


def test_the_mesh_model_of_the_extra_loads_and_has_the_same_extents(world: BulletWorld) -> None:
    by_mesh = Object("pr2", ObjectType.ROBOT, pr2_mesh_urdf_path())
    by_shape = Object("built in", ObjectType.ROBOT, pr2_urdf())
    assert by_mesh.robot_description is PR2
    np.testing.assert_allclose(by_mesh.bounding_box(), by_shape.bounding_box(), atol=0.03)


EXTENTS = {
    ObjectType.MILK: ((-0.033, -0.033, -0.088), (0.033, 0.033, 0.106)),
    ObjectType.BREAKFAST_CEREAL: ((-0.075, -0.03, -0.102), (0.073, 0.028, 0.122)),
    ObjectType.BOWL: ((-0.07, -0.07, -0.032), (0.07, 0.07, 0.035)),
}


@pytest.mark.parametrize("object_type", EXTENTS)
def test_small_objects_have_the_extents_of_the_thesis_scene(world: BulletWorld, object_type: ObjectType) -> None:
    np.testing.assert_allclose(Object("thing", object_type).bounding_box(), EXTENTS[object_type], rtol=0, atol=1e-6)


def test_every_type_but_robots_and_environments_has_a_shape(world: BulletWorld) -> None:
    for object_type in ObjectType:
        if object_type not in (ObjectType.ROBOT, ObjectType.ENVIRONMENT):
            shaped = Object(f'a "{object_type.name}" <&>', object_type)
            assert shaped.links == (f'a "{object_type.name}" <&>',)
            assert min(shaped.bounding_box().size) > 0.01
