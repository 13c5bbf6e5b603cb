"""Objects have the poses of their description, which is checked; impossible changes are refused."""

from __future__ import annotations

import math
import re
from decimal import Decimal
from fractions import Fraction
from pathlib import Path
from typing import Any

import numpy as np
import pytest

from pycrorm_async.errors import CallerError
from pycrorm_async.world import BulletWorld, JointType, Object, ObjectType, Pose
from pycrorm_async.world.models import built_in_model
from pycrorm_async.world.pose import (
    DescriptionNotLoadable,
    DuplicateName,
    JointLimitExceeded,
    MalformedPose,
    ObjectNotInWorld,
    ObjectRefused,
    PoseRefused,
    UnknownJoint,
    UnknownLink,
)
from pycrorm_async.world.urdf import PR2
from tests import bullet
from tests.world.fakes import CRANE, ChangeLog

# === objects ==================================================================================================
#
# Objects and their links have the poses of their description, and impossible changes are refused.

LEANING = Pose([0.3, -1.2, 0.7], [0.2, -0.4, 0.1, 0.8])


def crane(pose: Pose | None = None) -> Object:
    return Object("crane", ObjectType.GENERIC_OBJECT, CRANE, pose)


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


def test_a_motion_is_reported_once_even_without_a_change(world: BulletWorld, change_log: ChangeLog) -> None:
    placed_crane = crane()
    change_log.notes.clear()
    for _ in range(2):
        placed_crane.set_pose(LEANING)
        placed_crane.set_joint_positions({"turning": 1.5, "reaching": 0.1})
    motion = [("moved", "crane", LEANING), ("joints", "crane", {"turning": 1.5, "reaching": 0.1})]
    assert change_log.notes == motion * 2


@pytest.mark.parametrize(
    ("joint", "value", "limits"),
    [
        ("lifting", 1.2001, "-0.5 to 1.2"),
        ("lifting", -0.50001, "-0.5 to 1.2"),
        ("reaching", math.nan, "0 to 0.6"),
        ("turning", math.inf, "-1e+09 to 1e+09"),
        ("turning", -2e16, "-1e+09 to 1e+09"),
        *(("lifting", each, "-0.5 to 1.2") for each in ("0.3", b"0", None, 1j, [0.1], 10**400)),
    ],
)
def test_a_joint_outside_its_limits_is_refused_and_nothing_moves(
    world: BulletWorld, change_log: ChangeLog, joint: str, value: Any, limits: str
) -> None:
    placed_crane = crane()
    change_log.notes.clear()
    with pytest.raises(JointLimitExceeded) as refused:
        placed_crane.set_joint_positions({"turning": 0.5, "lifting": 0.5, joint: value})
    assert str(refused.value) == f"'crane': {joint} cannot be set to {value!r:.100}; its limits are {limits}"
    assert (refused.value.object_name, refused.value.joint) == ("crane", joint)
    assert placed_crane.joint_positions() == {"turning": 0.0, "lifting": 0.0, "reaching": 0.0}
    assert change_log.notes == []


def test_rounding_past_a_limit_is_accepted_and_never_clamped(world: BulletWorld) -> None:
    placed_crane = crane()
    placed_crane.set_joint_position("lifting", 1.2 + 9e-7)
    assert placed_crane.joint_position("lifting") == 1.2 + 9e-7


@pytest.mark.parametrize("position", [np.float32(0.5), np.int64(0), True, Decimal("0.5"), Fraction(1, 2)])
def test_a_position_of_any_type_of_number_becomes_a_float(world: BulletWorld, position: float) -> None:
    placed_crane = crane()
    placed_crane.set_joint_position("lifting", position)
    assert type(placed_crane.joint_position("lifting")) is float
    assert placed_crane.joint_position("lifting") == float(position)


def test_unknown_names_are_refused_with_those_that_exist(world: BulletWorld) -> None:
    placed_crane = crane()
    for call in (
        lambda: placed_crane.set_joint_position("elbow", 0.0),
        lambda: placed_crane.joint_position("elbow"),
        lambda: placed_crane.joint_limits("elbow"),
        lambda: placed_crane.joint_type("elbow"),
        lambda: placed_crane.link_pose_at("hook", {"elbow": 1.0}),
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
    ("arguments", "words"),
    [
        ({"name": None}, "an object's name must be a str, got None"),
        ({"object_type": "MILK"}, "the type of object 'milk' must be an ObjectType, got 'MILK'"),
        ({"object_type": 3}, "the type of object 'milk' must be an ObjectType, got 3"),
        *(
            ({"mass_kg": each}, "the mass of object 'milk' must be a number of kg > 0, got ")
            for each in ("1", b"1", 10**400, math.nan, 0, 1j)
        ),
        *(
            ({"color": each}, "the color of object 'milk' must be four numbers from 0 to 1, got ")
            for each in ((1, 0, 0), "red", ("r", "e", "d", "!"), (1, 0, 0, None))
        ),
        ({"base_link": "lid"}, "only a robot has a base link other than its root, but 'milk' is MILK"),
    ],
)
def test_an_object_without_a_name_a_type_a_mass_or_a_colour_is_refused(
    world: BulletWorld, arguments: dict[str, Any], words: str
) -> None:
    with pytest.raises(ObjectRefused, match=f"^{re.escape(words)}"):
        Object(**{"name": "milk", "object_type": ObjectType.MILK, **arguments})
    assert world.objects == ()


def test_a_name_is_used_once_in_a_world(world: BulletWorld) -> None:
    crane()
    with pytest.raises(DuplicateName, match="'crane'"):
        Object("crane", ObjectType.MILK)
    world.remove(world.object("crane"))
    assert Object("crane", ObjectType.MILK).object_type is ObjectType.MILK


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

    milk = Object("milk", ObjectType.MILK, color=(1.0, 0.0, 0.5, 1.0))
    shapes = bullet.getVisualShapeData(milk.body.number, physicsClientId=bullet.client_of(world))
    assert [shape[7] for shape in shapes] == [(1.0, 0.0, 0.5, 1.0)]


# === objects described ========================================================================================
#
# A description is URDF text, a .urdf file, or built in; one that cannot be loaded is refused with the reason.

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
    file.write_text(CRANE.replace('"mast"', '"tower"'))
    assert "tower" in Object("changed", ObjectType.GENERIC_OBJECT, file).links


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
    **{
        f"a length of {shape}": (
            f'<robot name="r"><link name="base"><collision><geometry><{shape}/></geometry></collision></link></robot>',
            "a length is 0 to",
        )
        for shape in ('box size="1 1 -1"', 'sphere radius="-1"', 'cylinder radius="1" length="1e10"')
    },
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
    with pytest.raises(
        DescriptionNotLoadable,
        match=r"'pr2', 'courier' and, with the extra .pr2., 'tiago_pro' are robots, 'kitchen' the environment",
    ):
        Object("somewhere", object_type)
    assert Object("somewhere", object_type, CRANE).robot_description is None


def test_the_built_in_robot_is_the_pr2(world: BulletWorld) -> None:
    robot = Object("pr2", ObjectType.ROBOT)
    assert robot.robot_description is PR2
    assert robot.description_text == built_in_model("pr2")
    assert robot.joint_limits("torso_lift_joint") == (0.0, 0.33)


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


# === pose =====================================================================================================
#
# A pose accepts any quaternion that represents a rotation.


@pytest.mark.parametrize("length", [1e-300, 0.5, 1.0, 3.0, 1e300])
def test_an_orientation_of_any_length_is_the_same_rotation(length: float) -> None:
    turned = Pose([0, 0, 0], [0, 0, 0.6 * length, 0.8 * length])
    assert turned.orientation == pytest.approx((0, 0, 0.6, 0.8), abs=1e-15)
    assert turned.yaw == pytest.approx(2 * math.asin(0.6))


@pytest.mark.parametrize("number", [0.0, 1e308])
def test_a_quaternion_without_a_direction_is_refused(number: float) -> None:
    with pytest.raises(ValueError, match="an orientation needs a finite length other than zero, got "):
        Pose([0, 0, 0], [number] * 4)


@pytest.mark.parametrize(
    ("arguments", "message"),
    [
        ({"position": [0, 0]}, r"three numbers x, y, z in metres, got \[0, 0\]"),
        ({"position": None}, "three numbers x, y, z in metres, got None"),
        ({"position": ["a", "b", "c"]}, "three numbers x, y, z in metres"),
        ({"position": [0, 0, 10**400]}, "three numbers x, y, z in metres"),
        ({"position": Pose()}, "three numbers x, y, z in metres, got Pose"),
        ({"orientation": [0, 0, 1]}, r"four numbers x, y, z, w, got \[0, 0, 1\]"),
        ({"orientation": "none"}, "four numbers x, y, z, w, got 'none'"),
        ({"frame": None}, "a pose's frame must be a str, got None"),
        ({"frame": 3}, "a pose's frame must be a str, got 3"),
        ({"time_ns": 1.5e18}, "whole number of ns since 1970"),
        ({"time_ns": "now"}, "whole number of ns since 1970 of at most 64 bits, got 'now'"),
        ({"time_ns": 2**63}, "whole number of ns since 1970 of at most 64 bits, got 9223372036854775808"),
    ],
)
def test_an_invalid_pose_is_refused_in_a_line_with_the_reason(arguments: dict[str, Any], message: str) -> None:
    with pytest.raises(MalformedPose, match=message) as caught:
        Pose(**arguments)
    assert isinstance(caught.value, CallerError)


def test_numbers_of_numpy_become_plain_ones() -> None:
    pose = Pose(np.array([1, 2, 3]), np.array([0.0, 0.0, 1.0, 0.0], np.float32), time_ns=np.int64(5))  # type: ignore[arg-type]
    assert (pose.position, pose.orientation, pose.time_ns) == ((1.0, 2.0, 3.0), (0.0, 0.0, 1.0, 0.0), 5)
    assert {type(each) for each in (*pose.position, *pose.orientation)} == {float}
    assert Pose(orientation=[Decimal(0), Decimal(0), Decimal(2), Decimal(0)]).orientation == (0.0, 0.0, 1.0, 0.0)  # type: ignore[list-item]
    assert type(pose.time_ns) is int
