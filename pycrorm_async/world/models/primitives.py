"""Generate boxes, cylinders and points as URDF text (metres, around the object's origin)."""

from __future__ import annotations

from collections.abc import Iterable, Sequence
from xml.sax.saxutils import quoteattr

_INERTIAL = '<inertial><mass value="{:g}"/><inertia ixx="1" ixy="0" ixz="0" iyy="1" iyz="0" izz="1"/></inertial>'
INERTIA = _INERTIAL.format(1.0)
"""The inertia of a link of a robot or an environment: Bullet warns about links without one. Its values do not matter
because the simulation is never stepped, and because no gripper lifts such an object."""

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


def _one_link(name: str, geometry: str, middle: Sequence[float], color: Sequence[float], mass_kg: float | None) -> str:
    link, inertial = quoteattr(name), "" if mass_kg is None else _INERTIAL.format(mass_kg)
    return f"<robot name={link}><link name={link}>{inertial}{shape(geometry, middle, color)}</link></robot>\n"
