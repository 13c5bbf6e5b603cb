"""Every URDF and SRDF of the installed packages is read as an independent computation reads it, or refused by name.

The packages are `pybullet_data` (without its 1,000 random objects) and `example-robot-data`.
"""

from __future__ import annotations

import functools
import math
import random
import re
from collections.abc import Mapping
from importlib.metadata import distribution
from importlib.util import find_spec
from pathlib import Path
from xml.etree.ElementTree import Element, fromstring

import numpy as np
import pytest
from numpy.typing import NDArray

from pycrorm_async.query.scene import link_poses
from pycrorm_async.query.scene import object_model as page_model
from pycrorm_async.world import BulletWorld, Object, ObjectType, Pose, describe_robot
from pycrorm_async.world.bounding_boxes import rotation_matrix
from pycrorm_async.world.pose import DescriptionNotLoadable
from tests.report.test_document import described

Matrix = NDArray[np.float64]

EXAMPLES = Path(str(distribution("example-robot-data").locate_file("cmeel.prefix/share/example-robot-data/robots")))
_DATA = find_spec("pybullet_data")
BULLET = Path(_DATA.submodule_search_locations[0]) if _DATA and _DATA.submodule_search_locations else Path("/none")
URDFS = sorted(each for root in (EXAMPLES, BULLET) for each in root.rglob("*.urdf") if "random_urdfs" not in each.parts)
SRDFS = sorted(EXAMPLES.rglob("*.srdf"))
PACKAGES = {"example-robot-data": EXAMPLES.parent}
AT_EACH_COMMIT = {
    "pr2", "tiago_no_hand", "xarm6_with_gripper", "kuka_lwr", "humanoid", "husky", "microtaur", "ur3", "r2d2",
    "biped2d_pybullet", "finger_edu", "racecar", "door", "alex_psyonic_hands",
}  # fmt: skip
REFUSED = {
    "alex_psyonic_hands": "joint 'Left_index_q2': <mimic> joints name a joint 'index_q1' that does not exist",
    "ur3": "it has no link",
    "biped2d_pybullet": "joint 'torso_to_rightleg': <limit lower=\"-1.57.\">: '-1.57.' is not a number",
    "humanoid": "joint 'chest' has the type 'spherical'; types are",
    "husky": "joint 'imu_joint': <origin xyz=\"$(optenv HUSKY_IMU_XYZ 0.19 0 0.149)\">: '$(optenv' is not a number",
    "model_for_sdf": "collision of link 'lbr_iiwa_link_0': mesh meshes/coarse/link_0.stl is not at",
    "microtaur": "joint 'dynamixel7_chassis_left': <origin rpy=\"-3.14159 1.57079 0 0\"> has 4 numbers instead of 3",
    "racecar_differential": "link 'chassis' collision: <mesh scale=\"1 1 1 1\"> has 4 numbers instead of 3",
    "spherical_joint_limit": "joint 'neck' has the type 'spherical'; types are",
    "torus_deform": "it has no link",
}
"""What is wrong with the files that no reader could read in one way."""


def cases(files: list[Path], quick: set[str]) -> list[object]:
    return [
        pytest.param(each, id=f"{each.parent.name}-{each.stem}", marks=() if each.stem in quick else pytest.mark.soak)
        for each in files
    ]


def turned(axis: Matrix, angle: float) -> Matrix:
    """Rodrigues' formula."""
    x, y, z = axis / np.linalg.norm(axis)
    cross = np.array([[0, -z, y], [z, 0, -x], [-y, x, 0]])
    return np.asarray(np.eye(3) + math.sin(angle) * cross + (1 - math.cos(angle)) * cross @ cross)


def triple(element: Element | None, name: str, default: str) -> Matrix:
    text = default if element is None else element.get(name, default)
    return np.array([float(each) for each in text.split()])


def frames_of(robot: Element, positions: Mapping[str, float]) -> dict[str, Matrix]:
    """Compute the frame of each link in the root, straight from the elements and with matrices only."""
    joints = {each.get("name", ""): each for each in robot.findall("joint")}

    def position(name: str) -> float:
        mimic = joints[name].find("mimic")
        if joints[name].get("type") in ("fixed", "floating", "planar"):
            return 0.0
        if mimic is None:
            return positions[name]
        leader = position(mimic.get("joint", ""))
        return leader * float(mimic.get("multiplier", "1")) + float(mimic.get("offset", "0"))

    above = {}
    for name, joint in joints.items():
        frame, motion = np.eye(4), np.eye(4)
        origin, axis = joint.find("origin"), triple(joint.find("axis"), "xyz", "1 0 0")
        roll, pitch, yaw = triple(origin, "rpy", "0 0 0")
        x, y, z = np.eye(3)
        frame[:3, :3] = turned(z, yaw) @ turned(y, pitch) @ turned(x, roll)
        frame[:3, 3] = triple(origin, "xyz", "0 0 0")
        if joint.get("type") in ("revolute", "continuous"):
            motion[:3, :3] = turned(axis, position(name))
        elif joint.get("type") == "prismatic":
            motion[:3, 3] = axis / np.linalg.norm(axis) * position(name)
        parent, child = joint.find("parent"), joint.find("child")
        assert parent is not None
        assert child is not None
        above[child.get("link", "")] = parent.get("link", ""), frame @ motion

    @functools.cache
    def link_frame(link: str) -> Matrix:
        if link not in above:
            return np.eye(4)
        parent, frame = above[link]
        return np.asarray(link_frame(parent) @ frame)

    return {name: link_frame(name) for link in robot.findall("link") if (name := link.get("name", ""))}


def random_positions(robot: Object, rng: random.Random) -> dict[str, float]:
    limits = {each: robot.joint_limits(each) for each in robot.joints if robot.body.leader(each) is None}
    return {
        each: rng.uniform(max(lower, min(-3, upper)), min(upper, max(3, lower)))
        for each, (lower, upper) in limits.items()
    }


@pytest.mark.parametrize("file", cases(URDFS, AT_EACH_COMMIT))
def test_a_real_robot_has_the_frames_of_an_independent_computation_or_is_refused_by_element_and_word(
    world: BulletWorld, file: Path
) -> None:
    if file.stem in REFUSED and (file.stem != "ur3" or EXAMPLES in file.parents):
        with pytest.raises(DescriptionNotLoadable) as refused:
            Object("robot", ObjectType.ROBOT, file, packages=PACKAGES)
        assert str(file) in str(refused.value)
        assert REFUSED[file.stem] in str(refused.value)
        return
    robot = Object("robot", ObjectType.ROBOT, file, Pose(), packages=PACKAGES)
    robot.set_joint_positions(robot.joint_positions())  # it starts within its limits
    rng = random.Random(file.stem)
    model = page_model(described(robot.description_text), drawn=frozenset())
    for _ in range(3):
        positions = random_positions(robot, rng)
        robot.set_joint_positions(positions)
        page = link_poses(model, Pose(), robot.joint_positions())
        for link, frame in frames_of(fromstring(robot.description_text), positions).items():
            for where, pose in (("the world", robot.link_pose(link)), ("page and exports", page[link])):
                placed = np.eye(4)
                placed[:3, :3], placed[:3, 3] = rotation_matrix(pose.orientation), pose.position
                np.testing.assert_allclose(placed, frame, atol=1e-6, err_msg=f"{where}: {link}")


@pytest.mark.skipif(not any(BULLET.rglob("*.urdf")), reason="this wheel of Bullet has no models")
def test_the_corpus_has_a_hundred_robots() -> None:
    assert len(URDFS) - len(REFUSED) > 100
    assert len(SRDFS) > 30


@pytest.mark.parametrize("file", cases(SRDFS, {each.stem for each in SRDFS}))
def test_a_real_srdf_gives_postures_within_its_urdf_and_no_leg_as_an_arm(file: Path) -> None:
    urdfs = sorted(file.parents[1].rglob("*.urdf"), key=lambda each: (each.stem != file.stem, len(each.stem)))
    if not urdfs:
        pytest.skip("the package has no URDF of this robot")
    if urdfs[0].stem in REFUSED:
        with pytest.raises(DescriptionNotLoadable, match=re.escape(REFUSED[urdfs[0].stem])):
            describe_robot(file.stem, urdfs[0], srdf=file, packages=PACKAGES)
        return
    robot = describe_robot(file.stem, urdfs[0], srdf=file, packages=PACKAGES)
    text = urdfs[0].read_text()
    assert all(f'"{joint}"' in text for posture in robot.postures.values() for joint in posture)
    assert not [arm for arm in robot.arms.values() if "foot" in arm.tool_frame.lower() or "sole" in arm.tool_frame]


def test_the_pr2_of_its_own_srdf_has_the_soft_limits_and_grippers_of_the_built_in_one() -> None:
    folder = EXAMPLES / "pr2_description"
    robot = describe_robot("pr2", folder / "urdf/pr2.urdf", srdf=folder / "srdf/pr2.srdf", packages=PACKAGES)
    from pycrorm_async.world import PR2

    for arm, described_arm in robot.arms.items():
        assert described_arm.joints == PR2.arms[arm].joints
        for joint, bounds in described_arm.soft_limits.items():
            np.testing.assert_allclose(bounds, PR2.arms[arm].soft_limits[joint], atol=1e-4)
        for state, positions in PR2.arms[arm].gripper_joints.items():
            assert positions.items() <= described_arm.gripper_joints[state].items()
