"""Return built-in descriptions as URDF text, so that no file has to be read, downloaded or licensed.

A small object is one link, a box or an upright cylinder, with the extent of the objects in the thesis' plans (metres,
around the object's origin). The masses are assumptions that were not checked against a source: they are meant to match
similar objects of the YCB set (chips can, cracker box, bowl, mug, spoon), and a litre of milk in its carton;
`Object(..., mass_kg=)` replaces one. The robots and the environment are built in by name.
"""

from __future__ import annotations

from typing import NamedTuple
from xml.etree.ElementTree import fromstring

from pycrorm_async.world.enums import ObjectType
from pycrorm_async.world.errors import DescriptionNotLoadable
from pycrorm_async.world.models.courier import courier_urdf
from pycrorm_async.world.models.kitchen import kitchen_urdf
from pycrorm_async.world.models.pr2 import pr2_urdf
from pycrorm_async.world.models.primitives import Range, box_urdf, cylinder_urdf


class _Box(NamedTuple):
    x: Range
    y: Range
    z: Range
    color: tuple[float, float, float, float]
    mass_kg: float | None = None


class _Cylinder(NamedTuple):
    radius: float
    z: Range
    color: tuple[float, float, float, float]
    mass_kg: float | None = None


_SHAPES: dict[ObjectType, _Box | _Cylinder] = {
    ObjectType.MILK: _Box((-0.033, 0.033), (-0.033, 0.033), (-0.088, 0.106), (0.3, 0.5, 0.9, 1.0), 1.06),
    ObjectType.BREAKFAST_CEREAL: _Box((-0.075, 0.073), (-0.03, 0.028), (-0.102, 0.122), (0.2, 0.7, 0.3, 1.0), 0.411),
    ObjectType.SPOON: _Box((-0.108, 0.108), (-0.023, 0.023), (-0.0095, 0.0095), (0.7, 0.7, 0.75, 1.0), 0.03),
    ObjectType.BOWL: _Cylinder(0.07, (-0.032, 0.035), (0.9, 0.8, 0.2, 1.0), 0.147),
    ObjectType.JEROEN_CUP: _Cylinder(0.04, (-0.05, 0.05), (0.9, 0.9, 0.9, 1.0), 0.118),
    ObjectType.METALMUG: _Cylinder(0.04, (-0.05, 0.05), (0.6, 0.6, 0.65, 1.0), 0.118),
    ObjectType.PRINGLES: _Cylinder(0.0375, (-0.12, 0.12), (0.8, 0.2, 0.2, 1.0), 0.205),
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
        return box_urdf(name, x=shape.x, y=shape.y, z=shape.z, color=shape.color, mass_kg=shape.mass_kg)
    return cylinder_urdf(name, radius=shape.radius, z=shape.z, color=shape.color, mass_kg=shape.mass_kg)


def built_in_that_fits(name: str, object_type: ObjectType, *, joints: set[str], links: set[str]) -> str | None:
    """Return the built-in URDF for a name and a type if it has these joints and links, otherwise None."""
    try:
        urdf = built_in_urdf(name, object_type)
    except DescriptionNotLoadable:  # no robot or environment of that name is built in
        return None
    robot = fromstring(urdf)  # noqa: S314  our own text
    movable = {each.get("name") for each in robot.iter("joint") if each.get("type") != "fixed"}
    fits = joints <= movable and links <= {each.get("name") for each in robot.iter("link")}
    return urdf if fits else None


def _by_name(name: str, object_type: ObjectType) -> str:
    if (name, object_type) == ("pr2", ObjectType.ROBOT):
        return pr2_urdf()
    if (name, object_type) == ("courier", ObjectType.ROBOT):
        return courier_urdf()
    if (name, object_type) == ("kitchen", ObjectType.ENVIRONMENT):
        return kitchen_urdf()
    raise DescriptionNotLoadable(
        name,
        f"no {object_type.name} of that name is built in ('pr2', 'courier' are robots, 'kitchen' the environment); "
        "pass a description: URDF text or the path of a .urdf file",
    )
