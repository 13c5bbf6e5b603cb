"""Provide the PR2 as a model for Bullet: generated from boxes (`pr2_urdf`), or from meshes (`pr2_mesh_urdf_path`).

Both have the same root, links, joints and dimensions as far as plans use them. The generated one needs no file and
loads in milliseconds; the mesh model is in the optional package example-robot-data and has narrower limits of two
joints (wrist flex -2.094 rad, torso 0.31 m).

The root link `base_footprint` is on the floor. The centre of mass of every link is its origin, so that Bullet, which
places links by their centres of mass, uses the frames of the model. The shapes are about as large as the robot's:
precise enough for bounding boxes, rays and pictures.
"""

from __future__ import annotations

from functools import cache
from importlib.metadata import PackageNotFoundError, distribution
from pathlib import Path
from xml.etree.ElementTree import Element, indent, tostring

from pycrorm_async.errors import MissingExtra
from pycrorm_async.world.models.urdf_elements import DARK, GREY, OPTICAL, WHITE, fixed, link, moving
from pycrorm_async.world.robots.robot_description import FINGER_OPEN_RAD, PR2, Bounds, PR2Arm

_X, _Y, _Z = (1, 0, 0), (0, 1, 0), (0, 0, 1)
_MESH_MODEL = "cmeel.prefix/share/example-robot-data/robots/pr2_description/urdf/pr2.urdf"


@cache
def pr2_urdf() -> str:
    """Return a PR2 of boxes as URDF text, with the names and dimensions of the real one; it refers to no other file.

    It declares the hard limits; the rolls of forearm and wrist are continuous.
    """
    robot = Element("robot", name=PR2.name)
    link(robot, "base_footprint")
    fixed(robot, "base_footprint_joint", "base_footprint", "base_link", (0, 0, 0.051))
    link(robot, "base_link", (0.65, 0.65, 0.28), (0, 0, 0.14), WHITE)
    torso = PR2.torso_origin
    moving(
        robot,
        PR2.torso_joint,
        "base_link",
        "torso_lift_link",
        (torso.x, torso.y, torso.z - 0.051),
        _Z,
        PR2.torso_limits,
        prismatic=True,
    )
    link(robot, "torso_lift_link", (0.24, 0.44, 0.95), (-0.1, 0, -0.235), WHITE)
    _head(robot)
    for arm in PR2.arms.values():
        _arm(robot, arm)
    indent(robot)  # Bullet cannot read a long file that has a single line
    return tostring(robot, encoding="unicode")


def pr2_mesh_urdf_path() -> Path:
    """Return the path of the PR2's mesh model in the optional package example-robot-data.

    Its meshes are located relative to that path. Bullet warns about frames without a mass when it loads the model.

    Raises:
        MissingExtra: the package, or the model in it, is not installed.
    """
    try:
        path = Path(str(distribution("example-robot-data").locate_file(_MESH_MODEL)))
    except PackageNotFoundError:
        raise MissingExtra(
            "the PR2's mesh model is not installed: pip install 'pycrorm-async[pr2]', or use the built-in model"
        ) from None
    if not path.is_file():
        raise MissingExtra(f"example-robot-data contains no PR2 at {path}: pip install 'pycrorm-async[pr2]'")
    return path


def _head(robot: Element) -> None:
    """Add pan, tilt and the stereo camera on top, which is 1.27 m above the floor at torso height 0."""
    moving(
        robot,
        PR2.head_pan_joint,
        "torso_lift_link",
        PR2.head_pan_link,
        (-0.01707, 0, 0.38145),
        _Z,
        Bounds(-3.007, 3.007),
    )
    link(robot, PR2.head_pan_link, (0.16, 0.2, 0.2), (0.02, 0, -0.06), DARK)
    moving(
        robot,
        PR2.head_tilt_joint,
        PR2.head_pan_link,
        PR2.head_tilt_link,
        (0.068, 0, 0),
        _Y,
        Bounds(-0.471238, 1.39626),
    )
    link(robot, PR2.head_tilt_link, (0.22, 0.3, 0.11), (-0.05, 0, 0.1), WHITE)
    for joint, parent, child, origin in (
        ("head_plate_frame_joint", PR2.head_tilt_link, "head_plate_frame", (0.0232, 0, 0.0645)),
        ("sensor_mount_frame_joint", "head_plate_frame", "sensor_mount_link", (0, 0, 0)),
        ("double_stereo_frame_joint", "sensor_mount_link", "double_stereo_link", (0, 0, 0.003)),
        ("wide_stereo_frame_joint", "double_stereo_link", "wide_stereo_link", (0, 0.03, 0.0305)),
    ):
        fixed(robot, joint, parent, child, origin)
        link(robot, child)
    fixed(
        robot,
        "wide_stereo_optical_frame_joint",
        "wide_stereo_link",
        PR2.camera_link,
        (0, 0, 0),
        rotation=OPTICAL,
    )
    link(robot, PR2.camera_link)


def _arm(robot: Element, arm: PR2Arm) -> None:
    """Add the seven joints from the torso to the wrist, and the gripper."""
    prefix = arm.tool_frame[0]
    pan, lift, roll, elbow, forearm_roll, wrist, wrist_roll = (
        joint.removesuffix("_joint") + "_link" for joint in arm.joints
    )
    upper_arm, forearm = f"{prefix}_upper_arm_link", f"{prefix}_forearm_link"
    to_lift, to_elbow, to_wrist = (
        (length, 0.0, 0.0) for length in (arm.shoulder_offset_m, arm.upper_arm_m, arm.forearm_m)
    )
    origin_of_parent = (0.0, 0.0, 0.0)
    chain = (  # parent, child, origin of the joint in the parent, axis
        ("torso_lift_link", pan, arm.shoulder, _Z),
        (pan, lift, to_lift, _Y),
        (lift, roll, origin_of_parent, _X),
        (upper_arm, elbow, to_elbow, _Y),
        (elbow, forearm_roll, origin_of_parent, _X),
        (forearm, wrist, to_wrist, _Y),
        (wrist, wrist_roll, origin_of_parent, _X),
    )
    for joint, (parent, child, origin, axis) in zip(arm.joints, chain, strict=True):
        moving(robot, joint, parent, child, origin, axis, arm.hard_limits[joint])
    fixed(robot, f"{prefix}_upper_arm_joint", roll, upper_arm, origin_of_parent)
    fixed(robot, f"{prefix}_forearm_joint", forearm_roll, forearm, origin_of_parent)

    link(robot, pan, (0.2, 0.2, 0.5), (0.02, 0, -0.2), WHITE)
    link(robot, lift, (0.22, 0.16, 0.22), origin_of_parent, GREY)
    link(robot, roll)
    link(robot, upper_arm, (0.3, 0.14, 0.14), (0.22, 0, 0), WHITE)
    link(robot, elbow, (0.14, 0.1, 0.14), origin_of_parent, GREY)
    link(robot, forearm_roll)
    link(robot, forearm, (0.22, 0.11, 0.11), (0.18, 0, 0), WHITE)
    link(robot, wrist, (0.07, 0.05, 0.08), origin_of_parent, GREY)
    link(robot, wrist_roll)
    _gripper(robot, arm, prefix, wrist_roll)


def _gripper(robot: Element, arm: PR2Arm, prefix: str, wrist_roll: str) -> None:
    """Add the palm, two fingers that swing outwards, and the tool frame between their tips."""
    palm = f"{prefix}_gripper_palm_link"
    fixed(robot, f"{prefix}_gripper_palm_joint", wrist_roll, palm, (0, 0, 0))
    link(robot, palm, (0.1, 0.1, 0.05), (0.07, 0, 0), DARK)
    fixed(robot, f"{prefix}_gripper_tool_joint", palm, arm.tool_frame, (arm.tool_m, 0, 0))
    link(robot, arm.tool_frame)
    for finger, side in (("l", 1), ("r", -1)):
        finger_link = f"{prefix}_gripper_{finger}_finger_link"
        origin, axis = (0.07691, side * 0.01, 0), (0, 0, side)
        moving(
            robot,
            f"{prefix}_gripper_{finger}_finger_joint",
            palm,
            finger_link,
            origin,
            axis,
            Bounds(0.0, FINGER_OPEN_RAD),
        )
        link(robot, finger_link, (0.12, 0.02, 0.03), (0.06, side * 0.005, 0), GREY)
