"""Read the mass of an object from its description (URDF)."""

from __future__ import annotations

import math
from functools import lru_cache
from xml.etree.ElementTree import fromstring


@lru_cache(maxsize=256)
def described_mass_kg(urdf: str) -> float | None:
    """Return the sum of the masses of all links, kg; None if no link has one, or if one is not a number.

    Returns None also for a sum of 0, which means that the model leaves the masses out.
    """
    robot = fromstring(urdf)  # noqa: S314  loaded by the caller's own process, and checked before
    try:
        mass = sum(float(each.get("value", "")) for each in robot.iterfind("link/inertial/mass"))
    except ValueError:
        return None
    return mass if 0 < mass < math.inf else None
