"""Generate the built-in shapes as URDF text, so that no file has to be read, downloaded or licensed.

A small object is one link, a box or an upright cylinder, with the extent of the objects in the thesis' plans (metres,
around the object's origin).
"""

from __future__ import annotations

from collections.abc import Iterable, Sequence
from typing import NamedTuple
from xml.sax.saxutils import quoteattr

from pycrorm_async.world.enums import ObjectType
from pycrorm_async.world.errors import DescriptionNotLoadable

__all__ = ["built_in_urdf", "box_urdf", "cylinder_urdf", "stand_in_urdf", "shape", "numbers", "INERTIA"]

INERTIA = '<inertial><mass value="1"/><inertia ixx="1" ixy="0" ixz="0" iyy="1" iyz="0" izz="1"/></inertial>'
"""The inertia of every link: Bullet warns about links without one. Its values do not matter because the simulation is
never stepped."""

Range = tuple[float, float]
WHITE = (1.0, 1.0, 1.0, 1.0)


class _Box(NamedTuple):
    x: Range
    y: Range
    z: Range
    color: tuple[float, float, float, float]


class _Cylinder(NamedTuple):
    radius: float
    z: Range
    color: tuple[float, float, float, float]


_SHAPES: dict[ObjectType, _Box | _Cylinder] = {
    ObjectType.MILK: _Box((-0.033, 0.033), (-0.033, 0.033), (-0.088, 0.106), (0.3, 0.5, 0.9, 1.0)),
    ObjectType.BREAKFAST_CEREAL: _Box((-0.075, 0.073), (-0.03, 0.028), (-0.102, 0.122), (0.2, 0.7, 0.3, 1.0)),
    ObjectType.SPOON: _Box((-0.108, 0.108), (-0.023, 0.023), (-0.0095, 0.0095), (0.7, 0.7, 0.75, 1.0)),
    ObjectType.BOWL: _Cylinder(0.07, (-0.032, 0.035), (0.9, 0.8, 0.2, 1.0)),
    ObjectType.JEROEN_CUP: _Cylinder(0.04, (-0.05, 0.05), (0.9, 0.9, 0.9, 1.0)),
    ObjectType.METALMUG: _Cylinder(0.04, (-0.05, 0.05), (0.6, 0.6, 0.65, 1.0)),
    ObjectType.PRINGLES: _Cylinder(0.0375, (-0.12, 0.12), (0.8, 0.2, 0.2, 1.0)),
    ObjectType.GENERIC_OBJECT: _Box((-0.05, 0.05), (-0.05, 0.05), (-0.05, 0.05), (0.6, 0.6, 0.6, 1.0)),
    ObjectType.HUMAN: _Cylinder(0.25, (0.0, 1.75), (0.8, 0.6, 0.5, 1.0)),
}


def built_in_urdf(name: str, object_type: ObjectType) -> str:
    """Return the built-in description of an object: by type, for robots and environments by name.

    Raises:
        DescriptionNotLoadable: no built-in robot or environment has that name.
    """
    if object_type is ObjectType.ROBOT or object_type is ObjectType.ENVIRONMENT:
        return _by_name(name, object_type)
    shape = _SHAPES[object_type]
    if isinstance(shape, _Box):
        return box_urdf(name, x=shape.x, y=shape.y, z=shape.z, color=shape.color)
    return cylinder_urdf(name, radius=shape.radius, z=shape.z, color=shape.color)


def _by_name(name: str, object_type: ObjectType) -> str:
    if (name, object_type) == ("pr2", ObjectType.ROBOT):
        from pycrorm_async.world.models.pr2 import pr2_urdf

        return pr2_urdf()
    if (name, object_type) == ("kitchen", ObjectType.ENVIRONMENT):
        from pycrorm_async.world.models.kitchen import kitchen_urdf

        return kitchen_urdf()
    raise DescriptionNotLoadable(
        name,
        f"no {object_type.name} of that name is built in ('pr2' is the robot, 'kitchen' the environment); "
        "pass a description: URDF text or the path of a .urdf file",
    )


def box_urdf(name: str, *, x: Range, y: Range, z: Range, color: Sequence[float] = WHITE) -> str:
    """Return an object of one link: the box between these bounds, m."""
    size, middle = zip(*((high - low, (low + high) / 2) for low, high in (x, y, z)), strict=True)
    return _one_link(name, f'<box size="{numbers(size)}"/>', middle, color)


def cylinder_urdf(name: str, *, radius: float, z: Range, color: Sequence[float] = WHITE) -> str:
    """Return an object of one link: the upright cylinder around its z axis between these heights, m."""
    geometry = f'<cylinder radius="{radius:g}" length="{numbers([z[1] - z[0]])}"/>'
    return _one_link(name, geometry, (0.0, 0.0, (z[0] + z[1]) / 2), color)


def stand_in_urdf(name: str, *, joints: Iterable[str], links: Iterable[str]) -> str:
    """Return a substitute for an object whose shape is unknown: a magenta box of 10 cm around its origin.

    Its joints are continuous, so that they take every position, and move links without a shape. `links` are fixed.
    """
    box = shape('<box size="0.1 0.1 0.1"/>', (0.0, 0.0, 0.0), (1.0, 0.0, 1.0, 1.0))
    parts = [f"<link name={quoteattr(name)}>{INERTIA}{box}</link>"]
    for kind, joint, link in (
        *(("continuous", each, f"{each} of stand-in") for each in joints),
        *(("fixed", f"{each} fixed in stand-in", each) for each in links if each != name),
    ):
        parts.append(
            f"<link name={quoteattr(link)}>{INERTIA}</link><joint name={quoteattr(joint)} type={quoteattr(kind)}>"
            f'<parent link={quoteattr(name)}/><child link={quoteattr(link)}/><axis xyz="0 0 1"/></joint>'
        )
    lines = "\n".join(parts)  # Bullet cannot read a long file that has a single line
    return f"<robot name={quoteattr(name)}>\n{lines}\n</robot>\n"


def shape(geometry: str, middle: Sequence[float], color: Sequence[float]) -> str:
    """Return the <visual> and <collision> elements of a link: the same geometry around `middle`."""
    origin = f'<origin xyz="{numbers(middle)}"/>'
    return (
        f"<visual>{origin}<geometry>{geometry}</geometry>"
        f'<material name="{numbers(color)}"><color rgba="{numbers(color)}"/></material></visual>'
        f"<collision>{origin}<geometry>{geometry}</geometry></collision>"
    )


def numbers(values: Sequence[float]) -> str:
    """Format numbers for URDF, rounded to 1e-6, without negative zero."""
    return " ".join(f"{round(value, 6) + 0.0:g}" for value in values)


def _one_link(name: str, geometry: str, middle: Sequence[float], color: Sequence[float]) -> str:
    link = quoteattr(name)
    return f"<robot name={link}><link name={link}>{INERTIA}{shape(geometry, middle, color)}</link></robot>\n"
