"""A URDF is read as the standard says, in the world as in everything that is computed from it, or refused by name."""

from __future__ import annotations

import logging
import math
import struct
from decimal import Decimal
from pathlib import Path
from typing import Any

import numpy as np
import pytest

from pycrorm_async.errors import CallerError
from pycrorm_async.memory import Memory
from pycrorm_async.query.again import world_of
from pycrorm_async.query.scene import link_poses, object_model
from pycrorm_async.world import (
    ArmDescription,
    Arms,
    BulletWorld,
    GripperState,
    JointType,
    Object,
    ObjectType,
    Pose,
    describe_arm,
    describe_robot,
)
from pycrorm_async.world.pose import DescriptionNotLoadable, JointFollows, Vector
from pycrorm_async.world.queries import Camera, photograph
from tests import mesh_files
from tests.bullet import ENGINE
from tests.report.test_document import described

GRIPPER = """<robot name="gripper"><link name="palm"/><link name="left"/><link name="right"/><link name="tip"/>
<joint name="drive" type="prismatic"><parent link="palm"/><child link="left"/><axis xyz="0 1 0"/>
  <limit lower="0" upper="0.04" effort="1" velocity="1"/></joint>
<joint name="follower" type="prismatic"><parent link="palm"/><child link="right"/><axis xyz="0 -1 0"/>
  <mimic joint="drive" multiplier="0.5" offset="0.01"/></joint>
<joint name="second" type="prismatic"><parent link="right"/><child link="tip"/><axis xyz="0 -1 0"/>
  <mimic joint="follower" multiplier="2"/></joint></robot>"""


def hinge(
    *, axis: str = "0 0 1", limit: str = '<limit lower="-1" upper="1"/>', kind: str = "revolute", origin: str = ""
) -> str:
    return (
        f'<robot name="r"><link name="base"/><link name="arm"/><joint name="hinge" type="{kind}">{origin}'
        f'<parent link="base"/><child link="arm"/><axis xyz="{axis}"/>{limit}</joint></robot>'
    )


# --- mimic -----------------------------------------------------------------------------------------------------


async def test_followers_follow_in_the_world_as_of_on_the_page_and_in_exports(tmp_path: Path) -> None:
    async with Memory.open(f"sqlite:///{tmp_path}/memory.db") as memory:
        with BulletWorld():
            async with memory.episode(description="close"):
                gripper = Object("gripper", ObjectType.ROBOT, GRIPPER)
                milk = Object("milk", ObjectType.MILK)
                gripper.attach(milk, "tip")
                gripper.set_joint_position("drive", 0.04)
                assert gripper.joint_positions() == pytest.approx({"drive": 0.04, "follower": 0.03, "second": 0.06})
                assert gripper.link_pose("tip").distance(Pose([0, -0.09, 0])) < 1e-9
                assert gripper.link_pose_at("tip", {"drive": 0.0}).distance(Pose([0, -0.03, 0])) < 1e-9
                assert milk.pose.distance(Pose([0, -0.06, 0])) < 1e-9
        await memory.flush()
        [episode] = await memory.episodes()
        then = await memory.as_of(episode.id, time=1e9)
        assert then.world.objects[0].joints == pytest.approx({"drive": 0.04, "follower": 0.03, "second": 0.06})
        with world_of(then) as again:
            assert again.object("gripper").link_pose("tip").distance(Pose([0, -0.09, 0])) < 1e-9
    for joints in ({"drive": 0.04}, {"drive": 0.04, "follower": 0.0, "second": 0.0}):
        poses = link_poses(object_model(described(GRIPPER)), Pose(), joints)
        np.testing.assert_allclose(poses["tip"].position, [0, -0.09, 0], atol=1e-9)


def test_a_follower_needs_no_limits_and_cannot_leave_its_leader(world: BulletWorld) -> None:
    gripper = Object("gripper", ObjectType.ROBOT, GRIPPER)
    assert gripper.joint_limits("second") == pytest.approx((0.02, 0.06))
    gripper.set_joint_positions(gripper.joint_positions())
    with pytest.raises(JointFollows, match="'gripper': second follows drive: set that joint instead"):
        gripper.set_joint_position("second", 0.05)
    gripper.set_joint_positions({"second": 0.0, "drive": 0.02})
    assert gripper.joint_position("second") == pytest.approx(0.04)


FOLLOWER = """<robot name="r"><link name="a"/><link name="b"/><link name="c"/>
<joint name="lead" type="{kind}"><parent link="a"/><child link="b"/>{limit}</joint>
<joint name="follow" type="revolute"><parent link="a"/><child link="c"/>{own}
  <mimic joint="lead" multiplier="-2" offset="0.4"/></joint></robot>"""
LIMIT = '<limit lower="0" upper="1" effort="1" velocity="1"/>'


def test_a_follower_of_a_fixed_joint_is_at_its_offset(world: BulletWorld) -> None:
    robot = Object("robot", ObjectType.ROBOT, FOLLOWER.format(kind="fixed", limit="", own=LIMIT))
    assert robot.joint_positions() == {"follow": 0.4}
    assert robot.link_pose("c").orientation == pytest.approx((math.sin(0.2), 0, 0, math.cos(0.2)))


def test_the_limits_of_a_follower_are_those_of_its_leader_or_the_log_names_them(
    world: BulletWorld, caplog: pytest.LogCaptureFixture
) -> None:
    free = FOLLOWER.format(kind="revolute", limit=LIMIT, own='<limit effort="1" velocity="1"/>')
    assert Object("free", ObjectType.ROBOT, free).joint_limits("follow") == (-1.6, 0.4)
    assert not caplog.records
    Object("bound", ObjectType.ROBOT, FOLLOWER.format(kind="revolute", limit=LIMIT, own=LIMIT))
    assert "joint 'follow': its limits 0 to 1 do not hold, because it follows 'lead' from -1.6 to 0.4" in caplog.text


# --- limits and axes -------------------------------------------------------------------------------------------


def test_a_continuous_joint_is_endless_whatever_its_limits(world: BulletWorld) -> None:
    cart = Object("cart", ObjectType.ROBOT, hinge(kind="continuous", limit='<limit lower="0" upper="0"/>'))
    assert (cart.joint_type("hinge"), cart.joint_limits("hinge")) == (JointType.CONTINUOUS, (-math.inf, math.inf))
    cart.set_joint_position("hinge", 7.0)


def test_limits_without_lower_and_upper_are_zero(world: BulletWorld, caplog: pytest.LogCaptureFixture) -> None:
    assert Object("a", ObjectType.ROBOT, hinge(limit='<limit effort="1"/>')).joint_limits("hinge") == (0, 0)
    assert "joint 'hinge': its <limit> has neither lower nor upper, so that it cannot move" in caplog.text


@pytest.mark.parametrize(("lower", "upper", "start"), [(-3, -0.1, -0.1), (0.5, 2, 0.5), (-1, 1, 0)])
def test_a_joint_starts_at_the_legal_position_next_to_0_and_returns_there(
    world: BulletWorld, lower: float, upper: float, start: float
) -> None:
    arm = Object("arm", ObjectType.ROBOT, hinge(limit=f'<limit lower="{lower}" upper="{upper}"/>'))
    assert arm.joint_position("hinge") == start
    assert arm.link_pose("arm").yaw == pytest.approx(start)
    arm.set_joint_position("hinge", (lower + upper) / 2)
    world.reset()
    assert arm.joint_positions() == {"hinge": start}


@pytest.mark.parametrize("kind", ["revolute", "prismatic"])
def test_an_axis_has_length_one_in_the_world_and_in_chains(world: BulletWorld, kind: str) -> None:
    arm = Object("arm", ObjectType.ROBOT, hinge(axis="0 3 4", kind=kind))
    unit = Object("unit", ObjectType.ROBOT, hinge(axis="0 0.6 0.8", kind=kind))
    for each in (arm, unit):
        each.set_joint_position("hinge", 0.5)
    assert arm.link_pose("arm").distance(unit.link_pose("arm")) < 1e-12
    np.testing.assert_allclose(arm.link_pose("arm").orientation, unit.link_pose("arm").orientation, atol=1e-12)
    page = link_poses(object_model(described(arm.description_text)), Pose(), {"hinge": 0.5})["arm"]
    np.testing.assert_allclose(page.position, arm.link_pose("arm").position, atol=1e-9)


# --- words and files -------------------------------------------------------------------------------------------

SHAPE = '<robot name="r"><link name="base"><{kind}>{shape}</{kind}></link></robot>'
WORDS = {
    "an angle of xacro": (hinge(origin='<origin rpy="0 0 ${pi/2}"/>'), "joint 'hinge': <origin rpy=\"0 0 ${pi/2}\">"),
    "an environment": (hinge(origin='<origin xyz="$(optenv X 1 2 3)"/>'), "'$(optenv' is not a number: expand"),
    "two numbers": (hinge(origin='<origin xyz="1 2"/>'), '<origin xyz="1 2"> has 2 numbers instead of 3'),
    "no number": (hinge(origin='<origin xyz=""/>'), '<origin xyz=""> has 0 numbers instead of 3'),
    "an axis": (hinge(axis="0 0 up"), "joint 'hinge': <axis xyz=\"0 0 up\">: 'up' is not a number"),
    "no axis": (hinge(axis="0 0 0"), "has no direction"),
    "a limit": (hinge(limit='<limit lower="-1" upper="1.57."/>'), "<limit upper=\"1.57.\">: '1.57.' is not a number"),
    "a limit without end": (hinge(limit='<limit lower="inf" upper="inf"/>'), "<limit> leaves it no position"),
    "an effort": (hinge(limit='<limit lower="0" upper="1" effort="much"/>'), "'much' is not a number"),
    "Python's own": (hinge(limit='<limit lower="0" upper="1_0"/>'), "'1_0' is not a number"),
    "a multiplier": (GRIPPER.replace('"0.5"', '"half"'), "<mimic multiplier=\"half\">: 'half' is not a number"),
    "a multiplier without end": (GRIPPER.replace('"0.5"', '"inf"'), "<mimic> holds inf and"),
    "a soft limit": (
        hinge(limit='<limit lower="0" upper="1"/><safety_controller soft_lower_limit="a"/>'),
        "'a' is not",
    ),
    "a type": (hinge(kind="ball"), "joint 'hinge' has the type 'ball'"),
    "a size": (SHAPE.format(kind="collision", shape='<geometry><box size="1 1 l"/></geometry>'), "<box size="),
    "a scale": (
        SHAPE.format(kind="visual", shape='<geometry><mesh filename="a.stl" scale="1 1"/></geometry>'),
        "scale",
    ),
    "a scale without end": (
        SHAPE.format(kind="visual", shape='<geometry><mesh filename="a.stl" scale="inf 1 1"/></geometry>'),
        "link 'base' visual: <mesh> holds [inf, 1.0, 1.0]; numbers must be finite",
    ),
    "a colour": (SHAPE.format(kind="visual", shape='<material name="m"><color rgba="1 0 red 1"/></material>'), "'red'"),
    "a mass": ('<robot name="r"><link name="l"><inertial><mass value="1kg"/></inertial></link></robot>', "'1kg'"),
    "a leader that does not exist": (
        GRIPPER.replace('mimic joint="drive"', 'mimic joint="none"'),
        "joint 'follower': <mimic> joints name a joint 'none' that does not exist",
    ),
    "a leader that follows": (
        GRIPPER.replace('mimic joint="drive"', 'mimic joint="second"'),
        "joints follow each other",
    ),
    "xacro": (
        '<robot xmlns:xacro="http://ros.org/wiki/xacro" name="r"><xacro:include filename="x"/></robot>',
        "expand",
    ),
}


@pytest.mark.parametrize("what", WORDS)
def test_a_word_where_a_number_belongs_is_refused_by_element_and_word(
    world: BulletWorld, what: str, tmp_path: Path
) -> None:
    text, fault = WORDS[what]
    file = tmp_path / "robot.urdf"
    file.write_text(text)
    with pytest.raises(DescriptionNotLoadable) as refused:
        Object("robot", ObjectType.ROBOT, file)
    assert fault in str(refused.value)
    assert str(file) in str(refused.value)


GOOD = hinge(origin='<origin xyz="1 0 0"/>')
ODD = {
    "a mark": GOOD.encode("utf-8-sig"),
    "blank lines": b'\n\n<?xml version="1.0"?>\n' + GOOD.encode(),
    "Latin 1": '<?xml version="1.0" encoding="ISO-8859-1"?><!-- Größe -->'.encode("latin-1") + GOOD.encode(),
    "UTF-16": f'<?xml version="1.0" encoding="UTF-16"?>{GOOD}'.encode("utf-16"),
    "UTF-16 that is UTF-8": f'<?xml version="1.0" encoding="UTF-16"?>{GOOD}'.encode(),
    "a stray prefix": GOOD.replace("<link", '<xacro:property name="a"/><gazebo:x y:z="1"/><link', 1).encode(),
    "a namespace": GOOD.replace("<robot", '<robot xmlns="http://www.ros.org"').encode(),
    "a rule in a comment": b"<!-- ---- by <me@home> -->" + GOOD.encode(),
    "a zero at the end": GOOD.encode() + b"\n\0",
    "commas": GOOD.replace("1 0 0", "1, 0, 0").encode(),
    "no inertia": GOOD.replace('<link name="arm"/>', '<link name="arm"><inertial/></link>').encode(),
    "a mass only": GOOD.replace(
        '<link name="arm"/>', '<link name="arm"><inertial><mass value="1"/></inertial></link>'
    ).encode(),
}


@pytest.mark.parametrize("what", ODD)
def test_what_other_programs_read_is_read(world: BulletWorld, what: str, tmp_path: Path) -> None:
    file = tmp_path / "robot.urdf"
    file.write_bytes(ODD[what])
    robot = Object("robot", ObjectType.ROBOT, file)
    assert robot.link_pose("arm").position == (1, 0, 0)
    assert Object("copy", ObjectType.ROBOT, robot.description_text).links == robot.links
    assert object_model(described(robot.description_text))["root"] == "base"


async def test_elements_without_effect_are_named_in_the_log_and_in_the_status(
    tmp_path: Path, caplog: pytest.LogCaptureFixture
) -> None:
    text = hinge(kind="floating").replace("</joint>", '<dynamics damping="1"/></joint>')
    text = text.replace('<link name="arm"/>', '<link name="arm"><visual><geometry><cone/></geometry></visual></link>')
    caplog.set_level(logging.INFO, logger="pycrorm_async")
    async with Memory.open(f"sqlite:///{tmp_path}/memory.db") as memory:
        async with memory.episode(description="look"):
            with BulletWorld():
                Object("odd", ObjectType.ROBOT, text)
        missing = memory.status.missing
    assert missing.total == 1
    for each in (
        "joint 'hinge': its type floating does not move here",
        "link 'arm' visual: <cone> is no shape of URDF",
    ):
        assert each in caplog.text
        assert each in str(missing.last)
    assert "does not use: <dynamics> 1" in caplog.text


# --- meshes ----------------------------------------------------------------------------------------------------


def meshed(file: str, kind: str = "collision") -> str:
    return SHAPE.format(kind=kind, shape=f'<geometry><mesh filename="{file}"/></geometry>')


def test_a_visual_mesh_that_is_missing_or_not_drawn_keeps_the_robot(
    world: BulletWorld, caplog: pytest.LogCaptureFixture
) -> None:
    robot = Object("robot", ObjectType.ROBOT, meshed("package://nowhere/body.glb", "visual"))
    assert robot.links == ("base",)
    assert "visual of link 'base': there is no file package://nowhere/body.glb" in caplog.text
    with pytest.raises(DescriptionNotLoadable, match=r"collision of link 'base': mesh .* packages=\{'nowhere': …\}"):
        Object("other", ObjectType.ROBOT, meshed("package://nowhere/body.glb"))


@pytest.mark.parametrize(
    ("name", "content"),
    [("a.dae", b"<COLLADA/>"), ("a.obj", b"v 0 0 0\nv 1 0 0\nv 0 1 1\nf 1 2 99999999999\n"), ("a.DAE", b"")],
)
def test_a_damaged_visual_mesh_is_left_out_and_does_not_end_the_process(
    world: BulletWorld, name: str, content: bytes, tmp_path: Path, caplog: pytest.LogCaptureFixture
) -> None:
    (tmp_path / name).write_bytes(content)
    assert Object("robot", ObjectType.ROBOT, meshed(str(tmp_path / name), "visual")).links == ("base",)
    photograph(world, Camera(Vector(0, 0, 0), 1.0, 0), 8, 6, smooth=False)  # MuJoCo reads it for a picture only
    assert f"visual of link 'base': {ENGINE.split()[0]} does not draw {tmp_path / name}" in caplog.text


PYRAMID = b"v 0 0 0\nv 1 0 0\nv 0 1 0\nv 0 0 1\n"
OBJ = {
    "indices that count back, in two parts": b"o a\nv 0 0 0\nv 1 0 0\nv 0 1 0\nf -3 -2 -1\no b\nv 0 0 1\nf -4 -3 -1\n",
    "tabs": PYRAMID.replace(b" ", b"\t") + b"f\t1\t2\t3\t# base\nf\t1\t2\t4\n",
    "continued lines": PYRAMID + b"f 1 2 \\\n3\nf 1 2 \\\r\n 4\n",
    "materials": b"mtllib a.mtl\nusemtl red\n" + PYRAMID + b"vt 0 0\nusemtl blue\nf 1/1 2/1 3/1\nf 1//1 2//1 4//1\n",
}


@pytest.mark.parametrize("what", OBJ)
def test_an_obj_has_the_vertices_that_its_faces_name(world: BulletWorld, what: str, tmp_path: Path) -> None:
    (tmp_path / "a.obj").write_bytes(OBJ[what])
    part = Object("part", ObjectType.GENERIC_OBJECT, meshed(str(tmp_path / "a.obj")))
    assert part.bounding_box() == ((0, 0, 0), (1, 1, 1))
    assert world.ray_test([(0.2, 0.01, 5)], [(0.2, 0.01, -5)]) == [part]


@pytest.mark.parametrize(
    ("name", "content", "reason"),
    [
        ("a.obj", PYRAMID + b"f 0 1 2\n", "a triangle has a vertex that does not exist"),
        ("a.stl", mesh_files.binary_stl()[:-7], r"it is not a readable stl"),
        *(
            (
                "a.dae",
                mesh_files.collada().replace(b'meter="0.01"', b'meter="' + unit + b'"'),
                "not a readable dae file",
            )
            for unit in (b"0", b"cm", b"-1", b"inf")
        ),
    ],
)
def test_a_damaged_collision_mesh_is_refused_with_its_link_and_file(
    world: BulletWorld, name: str, content: bytes, reason: str, tmp_path: Path
) -> None:
    (tmp_path / name).write_bytes(content)
    with pytest.raises(DescriptionNotLoadable, match=rf"collision of link 'base': mesh .*{name}: .*{reason}"):
        Object("part", ObjectType.GENERIC_OBJECT, meshed(str(tmp_path / name)))


@pytest.mark.parametrize(
    ("axis", "corners"),
    [
        ("<up_axis>Z_UP</up_axis>", ((0, 0, 0), (1, 1, 1))),
        ("<!-- Z_UP --><up_axis>Y_UP</up_axis>", ((0, -1, 0), (1, 0, 1))),
        ("<up_axis> X_UP </up_axis>", ((-1, -1, 0), (0, 0, 1))),
    ],
)
def test_the_up_axis_of_a_collada_file_turns_it(
    world: BulletWorld, axis: str, corners: tuple[tuple[float, ...], ...], tmp_path: Path
) -> None:
    content = mesh_files.collada().replace(b"<up_axis>Z_UP</up_axis>", axis.encode())
    (tmp_path / "a.dae").write_bytes(content)
    part = Object("part", ObjectType.GENERIC_OBJECT, meshed(str(tmp_path / "a.dae")))
    np.testing.assert_allclose(part.bounding_box(), corners, atol=1e-9)


DRAWN = {
    "no unit.dae": mesh_files.collada().replace(b' meter="0.01"', b""),  # ended the process inside Bullet
    "text.stl": mesh_files.text_stl(),
    "a.off": b"OFF\n4 1 0\n0 0 0\n1 0 0\n0 1 0\n0 0 1\n3 1 2 3\n",
    "a.dae": mesh_files.collada(),
}


@pytest.mark.parametrize("name", DRAWN)
def test_a_visual_mesh_of_each_format_is_drawn(
    world: BulletWorld, name: str, tmp_path: Path, caplog: pytest.LogCaptureFixture
) -> None:
    (tmp_path / name).write_bytes(DRAWN[name])
    part = Object("part", ObjectType.GENERIC_OBJECT, meshed(str(tmp_path / name), "visual"), Pose([0, 0, 0.01]))
    picture = photograph(world, Camera(Vector(0.3, 0.3, 0.3), 3.0, 0, 10), 32, 24, smooth=False)
    assert part.body.number in picture.bodies
    assert not caplog.records


def test_packages_are_found_by_name_and_by_the_variables_of_ros(
    world: BulletWorld, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    file = tmp_path / "install/share/parts/meshes/a.stl"
    file.parent.mkdir(parents=True)
    file.write_bytes(mesh_files.binary_stl())
    (file.parents[1] / "package.xml").write_text("<package/>")
    text = meshed("package://parts/meshes/a.stl")
    by_name = Object("by name", ObjectType.ROBOT, text, packages={"parts": file.parents[1]})
    described_robot = describe_robot("described", text, packages={"parts": file.parents[1]}, base_link="base")
    Object("described", ObjectType.ROBOT, robot=described_robot)
    for variable, value in (
        ("AMENT_PREFIX_PATH", tmp_path / "install"),
        ("ROS_PACKAGE_PATH", file.parents[2]),
        ("ROS_PACKAGE_PATH", file.parents[1]),
        ("ROS_PACKAGE_PATH", tmp_path / "install"),
    ):
        with monkeypatch.context() as patched:
            patched.setenv(variable, str(value))
            found = Object(f"{variable} {value}", ObjectType.ROBOT, text)
        assert found.description_text == by_name.description_text


def test_a_package_has_the_name_that_its_package_xml_gives_it(
    world: BulletWorld, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    package = tmp_path / "src/repository/parts-2.1"
    (package / "meshes").mkdir(parents=True)
    (package / "meshes/a part.stl").write_bytes(mesh_files.binary_stl())
    (package / "package.xml").write_text('<?xml version="1.0"?><package format="3">\n<name> parts </name></package>')
    text = meshed("package://parts/meshes/a%20part.stl")
    (package / "urdf").mkdir()
    (package / "urdf/robot.urdf").write_text(text)
    inside = Object("inside", ObjectType.ROBOT, package / "urdf/robot.urdf")
    with pytest.raises(DescriptionNotLoadable, match="name its folder with packages="):
        Object("elsewhere", ObjectType.ROBOT, text)
    monkeypatch.setenv("ROS_PACKAGE_PATH", str(tmp_path / "src"))
    assert Object("elsewhere", ObjectType.ROBOT, text).description_text == inside.description_text


def test_a_mesh_file_is_an_object_and_is_read_again_when_it_changes(world: BulletWorld, tmp_path: Path) -> None:
    file = tmp_path / "milk.stl"
    file.write_bytes(mesh_files.binary_stl())
    milk = Object("milk", ObjectType.MILK, str(file), Pose([1, 0, 0]))
    assert milk.bounding_box().max == (2, 1, 1)
    assert milk.links == ("milk",)
    corners = [(0, 0, 0), (3, 0, 0), (0, 3, 3)]
    file.write_bytes(bytes(80) + struct.pack("<I12fH", 1, 0, 0, 0, *(x for each in corners for x in each), 0))
    assert Object("more milk", ObjectType.MILK, file).bounding_box().max == (3, 3, 3)


# --- descriptions ----------------------------------------------------------------------------------------------


@pytest.mark.parametrize(
    ("facts", "reason"),
    [
        ({"torso_joint": "lift"}, "names a joint 'lift' that its URDF lacks"),
        ({"head_joints": ("hinge", "tilt")}, "names a joint 'tilt'"),
        ({"camera_link": "eye"}, "names a link 'eye'"),
        ({"postures": {"carry": {"hinge": 0, "knee": 1}}}, "names a joint 'knee'"),
        ({"arms": {Arms.LEFT: ArmDescription(joints=("hinge",), tool_frame="hand")}}, "names a link 'hand'"),
        ({"name": 3}, "the name of a robot must be a str, got 3"),
        ({"serial": 17}, "the serial of a robot must be a str, got 17"),
        ({"drive": "FIXED"}, "the drive of 'r' must be a Drive, got 'FIXED'"),
        ({"srdf": "<robot/>", "park": "rest"}, "the SRDF of 'r' has no state 'rest'; its states are: none"),
    ],
)
def test_a_description_that_does_not_fit_its_model_is_refused_when_it_is_made(
    facts: dict[str, Any], reason: str
) -> None:
    with pytest.raises(CallerError, match=reason):
        describe_robot(**{"name": "r", "urdf": hinge(), **facts})


async def test_a_mass_of_any_type_of_number_is_recorded(tmp_path: Path) -> None:
    masses: list[Any] = [True, 2, np.float64(1.5), np.float32(0.5), Decimal("0.25")]
    async with Memory.open(f"sqlite:///{tmp_path}/memory.db") as memory:
        with BulletWorld():
            async with memory.episode(description="weigh"):
                for number, mass in enumerate(masses):
                    Object(f"milk {number}", ObjectType.MILK, mass_kg=mass)
        await memory.flush()
        then = await memory.as_of(1, time=1e9)
        assert memory.status.missing.total == 0
    assert [each.mass_kg for each in then.world.objects] == [float(each) for each in masses]


def test_a_model_that_cannot_be_read_is_refused_with_its_file_when_the_robot_is_described(tmp_path: Path) -> None:
    with pytest.raises(DescriptionNotLoadable, match=r"'r' cannot be loaded: .*/none\.urdf cannot be read"):
        describe_robot("r", tmp_path / "none.urdf")
    (tmp_path / "r.urdf").write_text(hinge(axis="0 0 up"))
    with pytest.raises(DescriptionNotLoadable, match=r"/r\.urdf: joint 'hinge': <axis xyz="):
        describe_robot("r", tmp_path / "r.urdf")


def test_a_state_of_followers_alone_moves_their_leader(world: BulletWorld) -> None:
    state = '<group_state name="{name}" group="hand"><joint name="{joint}" value="{value}"/>{more}</group_state>'
    both = state.format(name="both", joint="follower", value="9", more='<joint name="drive" value="0.04"/>')
    srdf = f"<robot>{state.format(name='half', joint='second', value='0.04', more='')}{both}</robot>"
    robot = describe_robot("gripper", GRIPPER, srdf=srdf)
    gripper = Object("gripper", ObjectType.ROBOT, robot=robot)
    assert robot.postures == {"half": {"drive": pytest.approx(0.02)}, "both": {"drive": 0.04}}
    gripper.set_joint_positions(robot.postures["half"])
    assert gripper.joint_position("second") == pytest.approx(0.04)


def test_a_state_outside_the_limits_is_logged(caplog: pytest.LogCaptureFixture) -> None:
    srdf = '<robot><group_state name="up" group="arm"><joint name="hinge" value="3"/></group_state></robot>'
    describe_robot("r", hinge(), srdf=srdf)
    assert "the SRDF of 'r': the state 'up' puts hinge at 3, outside its limits -1 to 1" in caplog.text


DOG = """<robot name="dog"><link name="base"/><link name="thigh"/><link name="foot"/><link name="upper"/>
<link name="hand"/><link name="one"/><link name="two"/>
<joint name="hip" type="revolute"><parent link="base"/><child link="thigh"/><limit lower="-1" upper="1"/></joint>
<joint name="ankle" type="fixed"><parent link="thigh"/><child link="foot"/></joint>
<joint name="shoulder" type="revolute"><parent link="base"/><child link="upper"/><limit lower="-2" upper="2"/>
  <safety_controller k_velocity="1" soft_lower_limit="-1.5" soft_upper_limit="1.5"/></joint>
<joint name="wrist" type="revolute"><parent link="upper"/><child link="hand"/><limit lower="-1" upper="1"/>
  <safety_controller k_velocity="1"/></joint>
<joint name="thumb" type="revolute"><parent link="hand"/><child link="one"/><origin xyz="0 0.02 0"/>
<axis xyz="0 0 1"/>
  <limit lower="0" upper="0.8"/></joint>
<joint name="finger" type="revolute"><parent link="hand"/><child link="two"/><origin xyz="0 -0.02 0"/>
<axis xyz="0 0 -1"/>
  <mimic joint="thumb"/></joint></robot>"""
for tip in ("one", "two"):
    shape = '<collision><origin xyz="0.1 0 0"/><geometry><sphere radius="0.01"/></geometry></collision>'
    DOG = DOG.replace(f'<link name="{tip}"/>', f'<link name="{tip}">{shape}</link>')
SRDF = """<robot name="dog"><virtual_joint name="root_joint" type="floating" parent_frame="odom" child_link="base"/>
<group name="arm links"><link name="upper"/><link name="hand"/></group>
<group name="arm"><group name="arm links"/></group>
<group name="LEG"><joint name="hip"/></group><group name="paw"><link name="one"/></group>
<group_state name="park" group="arm"><joint name="root_joint" value="0. 0. 0.3 0. 0. 0. 1."/>
<joint name="shoulder" value="0.4"/><joint name="hip" value="0.2"/></group_state>
<end_effector name="foot" parent_link="foot" group="LEG"/>{hand}</robot>"""
HANDS = {
    "a group of subgroups": '<end_effector name="e" parent_link="hand" group="arm"/>',
    "a group of links": '<end_effector name="e" parent_link="hand" group="paw" parent_group="arm links"/>',
    "the group of the hand": '<end_effector name="e" parent_link="hand" group="paw"/>',
}


@pytest.mark.parametrize("hand", HANDS)
def test_an_srdf_gives_its_arms_without_legs_with_soft_limits_and_hands_that_turn(hand: str) -> None:
    dog = describe_robot("dog", DOG, srdf=SRDF.format(hand=HANDS[hand]))
    [(name, arm)] = dog.arms.items()
    assert (name, arm.base_link, arm.joints) == (Arms.RIGHT, "base", ("shoulder", "wrist"))
    assert arm.soft_limits == {"shoulder": (-1.5, 1.5)}
    assert arm.park == {"shoulder": 0.4}
    assert dog.postures == {"park": {"shoulder": 0.4, "hip": 0.2}}
    opened = {"thumb": 0.8, "finger": 0.8}
    assert arm.gripper_joints == {GripperState.OPEN: opened, GripperState.CLOSE: {"thumb": 0.0, "finger": 0.0}}
    assert arm.opening_m is None


def test_a_hand_is_open_where_its_tips_are_farthest_apart() -> None:
    turned = DOG.replace('lower="0" upper="0.8"', 'lower="-0.8" upper="0"')
    turned = turned.replace('"0 0 1"', "there").replace('"0 0 -1"', '"0 0 1"').replace("there", '"0 0 -1"')
    arm = describe_arm(turned, "base", "hand")
    assert arm.gripper_joints[GripperState.OPEN]["thumb"] == -0.8
    assert arm.gripper_joints[GripperState.CLOSE]["thumb"] == 0.0


@pytest.mark.parametrize(
    ("was", "word", "fault"),
    [
        ('"0.4"', '"nan"', "joint 'shoulder': 'nan' is not finite"),
        (' value="0.4"', "", "joint 'shoulder': '' is not a number"),
        ('robot name="dog"', "sdf", "its root element is <sdf>, not <robot>"),
    ],
)
def test_an_srdf_without_numbers_for_its_states_or_of_another_kind_is_refused(was: str, word: str, fault: str) -> None:
    text = SRDF.format(hand="").replace(was, word)
    with pytest.raises(CallerError, match=fault):
        describe_robot("dog", DOG, srdf=text.replace("</robot>", "</sdf>") if word == "sdf" else text)
