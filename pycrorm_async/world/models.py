"""Built-in models as URDF text: a PR2, a courier and a kitchen from files, and small objects as primitive shapes.

The files are in the folder `built_in`. They consist of boxes and refer to no other file. The centre of mass of every
link is its origin, so that Bullet, which places links by their centres of mass, uses the frames of the models.

**PR2.** It has the links, joints, hard limits and dimensions of the real one as far as plans use them; the rolls of
forearm and wrist are continuous. Its root link `base_footprint` is on the floor. The shapes are about as large as the
robot's: precise enough for bounding boxes, rays and pictures. The optional package example-robot-data has a PR2 of
meshes (`pr2_mesh_urdf_path`) with narrower limits of two joints (wrist flex -2.094 rad, torso 0.31 m), and the model
of the TIAGo Pro.

**Courier.** A small robot of our own design: a differential base carries a column; an arm of six joints is mounted at
its front, a camera on its top. With all joints 0 the arm points ahead, along x.

**Kitchen.** A counter with a sink area, an island, sliding drawers and a fridge with a door. Layout as seen from the
origin, where the robot starts (x ahead, y to the left, metres):

    ahead, front at x 1.05, 0.6 deep    fridge y -1.25..-0.60 | counter -0.55..0.85, top 0.848 | sink area 0.85..1.75,
                                        top 0.812; a wall behind all three
    behind, front at x -1.10, 0.7 deep  island y 0.20..1.80, top 0.900

The thesis' cereal (1.3, 0.7, 0.95) and milk (1.3, 1, 0.9) are on the counter and in the sink area. A surface's frame is
in the middle of its top face; a handle's frame is in its middle with x pointing into the furniture, so that a gripper
approaching from the front has the handle's orientation. A drawer or door at joint position 0 is closed.
"""

import re
from collections.abc import Callable, Iterable, Mapping, Sequence
from functools import cache, partial
from importlib.metadata import PackageNotFoundError, distribution
from pathlib import Path
from xml.sax.saxutils import quoteattr

from pycrorm_async.errors import MissingExtra
from pycrorm_async.world.pose import DescriptionNotLoadable, JointType, ObjectType
from pycrorm_async.world.urdf_model import read_model

# === primitives ===============================================================================================
#
# Generate boxes, cylinders and points as URDF text (metres, around the object's origin).

_INERTIAL = '<inertial><mass value="{:g}"/><inertia ixx="1" ixy="0" ixz="0" iyy="1" iyz="0" izz="1"/></inertial>'
"""The inertia of a small object. Its values do not matter because the simulation is never stepped."""

Range = tuple[float, float]
WHITE = (1.0, 1.0, 1.0, 1.0)


def box_urdf(
    name: str, *, x: Range, y: Range, z: Range, color: Sequence[float] = WHITE, mass_kg: float | None = None
) -> str:
    """Return an object of one link: the box between these bounds, m. A mass of None is left out of the URDF."""
    size, middle = zip(*((high - low, (low + high) / 2) for low, high in (x, y, z)), strict=True)
    return _one_link(name, f'<box size="{numbers(size)}"/>', middle, color, mass_kg)


def cylinder_urdf(
    name: str, *, radius: float, z: Range, color: Sequence[float] = WHITE, mass_kg: float | None = None
) -> str:
    """Return an object of one link: the upright cylinder around its z axis between these heights, m.

    A mass of None is left out of the URDF.
    """
    geometry = f'<cylinder radius="{radius:g}" length="{numbers([z[1] - z[0]])}"/>'
    return _one_link(name, geometry, (0.0, 0.0, (z[0] + z[1]) / 2), color, mass_kg)


def point_urdf(name: str, *, joints: Iterable[str], links: Iterable[str]) -> str:
    """Return a substitute for an object whose shape is unknown: a magenta point of 2 cm that touches nothing.

    Its joints are continuous, so that they take every position, and move links without a shape. `links` are fixed.
    """
    visual = '<visual><geometry><sphere radius="0.01"/></geometry><material name="1 0 1"><color rgba="1 0 1 1"/>'
    parts = [f"<link name={quoteattr(name)}>{visual}</material></visual></link>"]
    for kind, joint, link in (
        *(("continuous", each, f"{each} of {name}") for each in joints),
        *(("fixed", f"{each} fixed in {name}", each) for each in links if each != name),
    ):
        parts.append(
            f"<link name={quoteattr(link)}/><joint name={quoteattr(joint)} type={quoteattr(kind)}>"
            f'<parent link={quoteattr(name)}/><child link={quoteattr(link)}/><axis xyz="0 0 1"/></joint>'
        )
    lines = "\n".join(parts)  # Bullet cannot read a long file that has a single line
    return f"<robot name={quoteattr(name)}>\n{lines}\n</robot>\n"


def numbers(values: Sequence[float]) -> str:
    """Format numbers for URDF, rounded to 1e-6, without negative zero."""
    return " ".join(f"{round(value, 6) + 0.0:g}" for value in values)


def _one_link(name: str, geometry: str, middle: Sequence[float], color: Sequence[float], mass_kg: float | None) -> str:
    link, inertial = quoteattr(name), "" if mass_kg is None else _INERTIAL.format(mass_kg)
    origin, rgba = f'<origin xyz="{numbers(middle)}"/>', numbers(color)
    return (
        f"<robot name={link}><link name={link}>{inertial}<visual>{origin}<geometry>{geometry}</geometry>"
        f'<material name="{rgba}"><color rgba="{rgba}"/></material></visual>'
        f"<collision>{origin}<geometry>{geometry}</geometry></collision></link></robot>\n"
    )


# === catalog ==================================================================================================
#
# Return built-in descriptions as URDF text, so that none has to be downloaded or licensed.
#
# A small object is one link, a box or an upright cylinder, with the extent of the objects in the thesis' plans (metres,
# around the object's origin). The masses are assumptions that were not checked against a source: they are meant to
# match similar objects of the YCB set (chips can, cracker box, bowl, mug, spoon), and a litre of milk in its carton;
# `Object(..., mass_kg=)` replaces one. The robots and the environment are built in by name.


_SHAPES: Mapping[ObjectType, Callable[[str], str]] = {
    ObjectType.MILK: partial(
        box_urdf, x=(-0.033, 0.033), y=(-0.033, 0.033), z=(-0.088, 0.106), color=(0.3, 0.5, 0.9, 1.0), mass_kg=1.06
    ),
    ObjectType.BREAKFAST_CEREAL: partial(
        box_urdf, x=(-0.075, 0.073), y=(-0.03, 0.028), z=(-0.102, 0.122), color=(0.2, 0.7, 0.3, 1.0), mass_kg=0.411
    ),
    ObjectType.SPOON: partial(
        box_urdf, x=(-0.108, 0.108), y=(-0.023, 0.023), z=(-0.0095, 0.0095), color=(0.7, 0.7, 0.75, 1.0), mass_kg=0.03
    ),
    ObjectType.BOWL: partial(cylinder_urdf, radius=0.07, z=(-0.032, 0.035), color=(0.9, 0.8, 0.2, 1.0), mass_kg=0.147),
    ObjectType.JEROEN_CUP: partial(
        cylinder_urdf, radius=0.04, z=(-0.05, 0.05), color=(0.9, 0.9, 0.9, 1.0), mass_kg=0.118
    ),
    ObjectType.METALMUG: partial(
        cylinder_urdf, radius=0.04, z=(-0.05, 0.05), color=(0.6, 0.6, 0.65, 1.0), mass_kg=0.118
    ),
    ObjectType.PRINGLES: partial(
        cylinder_urdf, radius=0.0375, z=(-0.12, 0.12), color=(0.8, 0.2, 0.2, 1.0), mass_kg=0.205
    ),
    ObjectType.GENERIC_OBJECT: partial(
        box_urdf, x=(-0.05, 0.05), y=(-0.05, 0.05), z=(-0.05, 0.05), color=(0.6, 0.6, 0.6, 1.0)
    ),
    ObjectType.HUMAN: partial(cylinder_urdf, radius=0.25, z=(0.0, 1.75), color=(0.8, 0.6, 0.5, 1.0)),
}


_NOT_IN_XML = re.compile("[^\t\n\r -\ud7ff\ue000-\ufffd\U00010000-\U0010ffff]")
"""Finds characters that XML cannot hold, not even as references: a recorded name may have any."""


def built_in_urdf(name: str, object_type: ObjectType) -> str:
    """Return the built-in description of an object: by type, for robots and environments by name.

    Raises:
        DescriptionNotLoadable: no built-in robot or environment has that name.
    """
    if object_type is ObjectType.ROBOT or object_type is ObjectType.ENVIRONMENT:
        if _BUILT_IN.get(name) is object_type:
            return built_in_model(name)
        raise DescriptionNotLoadable(
            name,
            f"no {object_type.name} of that name is built in ('pr2', 'courier' and, with the extra [pr2], 'tiago_pro' "
            "are robots, 'kitchen' the environment); pass a description: URDF text or the path of a .urdf file",
        )
    return _SHAPES[object_type](_NOT_IN_XML.sub("_", name))


def built_in_that_fits(name: str, object_type: ObjectType, *, joints: set[str], links: set[str]) -> str | None:
    """Return the built-in URDF for a name and a type if it has these joints and links, otherwise None."""
    try:
        urdf = built_in_urdf(name, object_type)
    except DescriptionNotLoadable:  # no robot or environment of that name is built in
        return None
    model = read_model(urdf)
    movable = {name for name, each in model.joints.items() if each.kind is not JointType.FIXED}
    return urdf if joints <= movable and links <= model.links.keys() else None


_BUILT_IN = {"pr2": ObjectType.ROBOT, "courier": ObjectType.ROBOT, "kitchen": ObjectType.ENVIRONMENT}


@cache
def built_in_model(name: str) -> str:
    """Return the URDF of a built-in robot or environment."""
    return Path(__file__).with_name("built_in").joinpath(f"{name}.urdf").read_text(encoding="utf-8")


_MESH_MODELS = "cmeel.prefix/share/example-robot-data/robots/"


def pr2_mesh_urdf_path() -> Path:
    """Return the path of the PR2's mesh model in the optional package example-robot-data.

    Its meshes are located relative to that path. Bullet warns about frames without a mass when it loads the model.

    Raises:
        MissingExtra: the package, or the model in it, is not installed.
    """
    return _mesh_model("PR2", "pr2_description/urdf/pr2.urdf", ", or use the built-in model")


def tiago_pro_urdf_path() -> Path:
    """Return the path of the TIAGo Pro's model in the same package. Raises `MissingExtra` if it is not installed."""
    return _mesh_model("TIAGo Pro", "tiago_pro_description/robots/tiago_pro.urdf")


def _mesh_model(robot: str, file: str, otherwise: str = "") -> Path:
    try:
        path = Path(str(distribution("example-robot-data").locate_file(_MESH_MODELS + file)))
    except PackageNotFoundError:
        raise MissingExtra(
            f"the {robot}'s mesh model is not installed: pip install 'pycrorm-async[pr2]'{otherwise}"
        ) from None
    if not path.is_file():
        raise MissingExtra(f"example-robot-data contains no {robot} at {path}: pip install 'pycrorm-async[pr2]'")
    return path
