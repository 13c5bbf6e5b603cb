"""Read the recorded geometry of a moment without Bullet: shapes of objects, poses of links, outlines from above."""

import math
from collections.abc import Iterable, Mapping, Sequence
from typing import Any, Final, NamedTuple
from xml.etree.ElementTree import ParseError

import numpy as np
import numpy.typing as npt

from pycrorm_async.events.types import DescriptionDeclared
from pycrorm_async.world.bounding_boxes import BoundingBox
from pycrorm_async.world.meshes import read_mesh
from pycrorm_async.world.model_boxes import with_boxes
from pycrorm_async.world.models import built_in_that_fits
from pycrorm_async.world.pose import JointType, ObjectType, Pose, Vector
from pycrorm_async.world.urdf_model import ENDLESS, Joint, Mimic, Model, Shape, along, origin, read_model

# === link frames ==============================================================================================
#
# Compute the frame of every link of a model from an object's pose and joint positions: forward kinematics.


def link_poses(
    model: Mapping[str, Any], pose: Pose, joints: Mapping[str, float], base_link: str | None = None
) -> dict[str, Pose]:
    """Return the pose of each link of a model from `object_model`; `pose` is that of `base_link`, or of the root."""
    poses = {model["root"]: Pose()}
    for row in model["joints"]:
        _, _, parent, child, *_ = row
        poses[child] = poses[parent] @ joint_pose(row, joints)
    root = pose @ poses[base_link].inverse() if base_link in poses else pose
    return {link: root @ each for link, each in poses.items()}


def joint_pose(joint: Sequence[Any], joints: Mapping[str, float]) -> Pose:
    """Return the pose of a joint's child link in its parent link, at these positions."""
    return along([_joint_of(joint)], joints)


def _joint_of(row: Sequence[Any]) -> Joint:
    name, kind, parent, child, xyz, rpy, axis, mimic = row
    length = math.hypot(*axis) or 1.0
    unit = Vector(*(each / length for each in axis))
    follows = None if mimic is None or kind == "fixed" else Mimic(*mimic)
    return Joint(name, JointType[kind.upper()], parent, child, origin(xyz, rpy), tuple(rpy), unit, ENDLESS, follows)


# === mesh triangles ===========================================================================================

TRIANGLES_MAX = 50_000
"""Bounds the triangles of a file: a drawing of a few hundred pixels shows no more."""
_DECIMALS = 5
"""Rounds vertices to 0.01 mm, so that those of neighbouring triangles are one."""


class Triangles(NamedTuple):
    """The vertices of a mesh, m, and for each triangle the indices of its three vertices."""

    vertices: npt.NDArray[np.float32]
    faces: npt.NDArray[np.uint32]


def triangles_of(name: str, content: bytes) -> Triangles:
    """Return the triangles of a mesh file; the suffix of its name decides its format. Raises `ValueError`.

    Materials and normals are left out: a drawing has the colour of the description and flat faces. A drawing has the
    box around its link in the place of a file that cannot be read.
    """
    mesh = read_mesh(name, content)
    if len(mesh.faces) > TRIANGLES_MAX:
        raise ValueError(f"it has {len(mesh.faces):,} triangles, more than {TRIANGLES_MAX:,}")
    vertices, places = np.unique(mesh.vertices.round(_DECIMALS), axis=0, return_inverse=True)
    return Triangles(vertices.astype(np.float32), places.reshape(-1)[mesh.faces].astype(np.uint32))


# === object model =============================================================================================
#
# Read the links, joints and shapes of a URDF as plain values, for forward kinematics where they are drawn.
#
# A mesh is drawn with its triangles where its file is recorded and they are asked for, otherwise as the box around its
# link's collision shapes. A link without a visual shape has its collision shapes.

_POINT: dict[str, Any] = {"root": "", "shapes": {"": [["sphere", [0.03], [0, 0, 0], [0, 0, 0], [1, 0, 1, 1]]]}}


def point_model(reason: str) -> dict[str, Any]:
    """Return the model of an object whose shape is unknown: a magenta point."""
    return {**_POINT, "joints": [], "assumed": f"a point, because {reason}"}


def object_model(description: DescriptionDeclared, *, drawn: frozenset[str] = frozenset()) -> dict[str, Any]:
    """Return root link, shapes by link, and joints in the order of the tree.

    A shape is `[kind, sizes, xyz, rpy, rgba or None]`; a joint is `[name, type, parent, child, xyz, rpy, axis, mimic]`,
    with `mimic` as `[joint, multiplier, offset]` or None. `drawn` are the references of the meshes that keep their
    place (`MeshValue.reference`); their sizes are the reference and three factors. The others are boxes.
    """
    if description.missing is not None:
        return point_model(f"its description is missing: {description.missing}")
    try:
        return _document(read_model(boxed_urdf(description, kept=drawn)))
    except (ValueError, ParseError) as error:
        return point_model(f"its description cannot be read: {error}")


_ROBOT_SHAPES: Final = [
    ["cylinder", [0.28, 0.3], [0, 0, 0.15], [0, 0, 0], [0.35, 0.38, 0.43, 1]],
    ["cylinder", [0.16, 0.9], [0, 0, 0.75], [0, 0, 0], [0.55, 0.59, 0.66, 1]],
    ["sphere", [0.14], [0, 0, 1.34], [0, 0, 0], [0.35, 0.38, 0.43, 1]],
    ["box", [0.5, 0.09, 0.09], [0.3, 0, 1.0], [0, 0, 0], [0.95, 0.6, 0.1, 1]],
    ["box", [0.8, 0.03, 0.03], [0.4, 0, 0.02], [0, 0, 0], [0.85, 0.15, 0.15, 1]],
    ["box", [0.03, 0.8, 0.03], [0, 0.4, 0.02], [0, 0, 0], [0.15, 0.65, 0.2, 1]],
    ["box", [0.03, 0.03, 0.3], [0, 0, 1.6], [0, 0, 0], [0.15, 0.35, 0.9, 1]],
]
"""A body 1.5 m high that stands at the robot's pose; a pointer shows its heading, and bars its x, y and z axes."""


def assumed_model(name: str, object_type: str, joints: set[str]) -> dict[str, Any]:
    """Return the model of an object without a recorded description.

    It is the built-in shape if that fits, otherwise a body with a heading and axes for a robot, or a point.
    """
    reason = "its description was not recorded"
    if object_type in ObjectType.__members__:
        urdf = built_in_that_fits(name, ObjectType[object_type], joints=joints, links=set())
        if urdf is not None:
            return {**_document(read_model(urdf)), "assumed": f"the built-in shape, because {reason}"}
    if object_type == ObjectType.ROBOT.name:
        assumed = f"a body with its heading, because {reason}"
        return {"root": "", "shapes": {"": _ROBOT_SHAPES}, "joints": [], "assumed": assumed}
    return point_model(reason)


def boxed_urdf(description: DescriptionDeclared, *, kept: frozenset[str]) -> str:
    """Return the URDF of a description with the box around its link in the place of each mesh that is not kept."""
    if "<mesh" not in description.text:
        return description.text
    boxes = {link: BoundingBox(Vector(*box.min), Vector(*box.max)) for link, box in description.boxes.items()}
    return with_boxes(description.text, boxes, kept=kept)


def _document(model: Model) -> dict[str, Any]:
    shapes = {name: [_shape(each) for each in link.visuals or link.collisions] for name, link in model.links.items()}
    return {
        "root": model.root,
        "shapes": {name: each for name, each in shapes.items() if each},
        "joints": [_row(path[-1]) for path in model.paths.values() if path],
    }


def _row(joint: Joint) -> list[Any]:
    return [
        joint.name,
        joint.kind.name.lower(),
        joint.parent,
        joint.child,
        _rounded(joint.origin.position),
        _rounded(joint.rpy),
        _rounded(joint.axis),
        None if joint.mimic is None else list(joint.mimic),
    ]


def _shape(shape: Shape) -> list[Any]:
    sizes = [shape.file, *shape.sizes] if shape.kind == "mesh" else _rounded(shape.sizes)
    return [shape.kind, sizes, _rounded(shape.xyz), _rounded(shape.rpy), shape.color and list(shape.color)]


def _rounded(numbers: Iterable[float]) -> list[float]:
    return [round(each, 9) for each in numbers]
