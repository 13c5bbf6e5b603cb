"""Generate the built-in kitchen: a counter with a sink area, an island, sliding drawers and a fridge with a door.

Layout as seen from the origin, where the robot starts (x ahead, y to the left, metres):

    ahead, front at x 1.05, 0.6 deep    fridge y -1.25..-0.60 | counter -0.55..0.85, top 0.848 | sink area 0.85..1.75,
                                        top 0.812; a wall behind all three
    behind, front at x -1.10, 0.7 deep  island y 0.20..1.80, top 0.900

The thesis' cereal (1.3, 0.7, 0.95) and milk (1.3, 1, 0.9) are on the counter and in the sink area. A surface's frame is
in the middle of its top face; a handle's frame is in its middle with x pointing into the furniture, so that a gripper
approaching from the front has the handle's orientation. A drawer or door at joint position 0 is closed.
"""

from __future__ import annotations

import math
from collections.abc import Iterable
from typing import NamedTuple

from pycrorm_async.world.models.primitives import INERTIA, numbers, shape

_FRONT, _ISLAND_FRONT = 1.05, -1.10
_WOOD, _STEEL, _PALE = (0.62, 0.45, 0.28, 1.0), (0.7, 0.72, 0.75, 1.0), (0.93, 0.92, 0.88, 1.0)
_DRAWER_TRAVEL_M, _DOOR_SWING_RAD = 0.35, 1.9
_PANEL_M = 0.02


class _Block(NamedTuple):
    """An axis-aligned box in its link's frame: (low, high) along x, y and z."""

    x: tuple[float, float]
    y: tuple[float, float]
    z: tuple[float, float]
    color: tuple[float, ...] = _WOOD


def kitchen_urdf() -> str:
    """Return the kitchen as URDF text; deterministic."""
    parts = [
        f'<link name="kitchen">{INERTIA}</link>',
        *_part("kitchen_wall", "kitchen", (1.65, 0.0, 0.0), [_Block((0.0, 0.1), (-1.25, 1.75), (0.0, 2.2), _PALE)]),
        *_cupboard("kitchen_counter", x=(_FRONT, 1.65), y=(-0.55, 0.85), top=0.848),
        *_cupboard("sink_area", x=(_FRONT, 1.65), y=(0.85, 1.75), top=0.812),
        *_tap(),
        *_cupboard("kitchen_island", x=(-1.80, _ISLAND_FRONT), y=(0.20, 1.80), top=0.900),
        *_drawer("kitchen_counter_upper_drawer", front=(_FRONT, 0.35), turn=0.0, z=(0.60, 0.79)),
        *_drawer("kitchen_counter_lower_drawer", front=(_FRONT, 0.35), turn=0.0, z=(0.30, 0.58)),
        *_drawer("sink_area_drawer", front=(_FRONT, 1.30), turn=0.0, z=(0.57, 0.76)),
        *_drawer("kitchen_island_upper_drawer", front=(_ISLAND_FRONT, 1.0), turn=math.pi, z=(0.64, 0.84)),
        *_drawer("kitchen_island_lower_drawer", front=(_ISLAND_FRONT, 1.0), turn=math.pi, z=(0.34, 0.62)),
        *_fridge(),
    ]
    return '<robot name="kitchen">\n' + "\n".join(parts) + "\n</robot>\n"


def _cupboard(name: str, *, x: tuple[float, float], y: tuple[float, float], top: float) -> Iterable[str]:
    """Yield a closed body up to the worktop, and the worktop as `<name>_surface`."""
    half = ((x[1] - x[0]) / 2, (y[1] - y[0]) / 2)
    middle = ((x[0] + x[1]) / 2, (y[0] + y[1]) / 2)
    sides = (-half[0], half[0]), (-half[1], half[1])
    yield from _part(name, "kitchen", (*middle, 0.0), [_Block(*sides, (0.0, top - 0.04))])
    yield from _part(f"{name}_surface", name, (0.0, 0.0, top), [_Block(*sides, (-0.04, 0.0), _PALE)])


def _tap() -> Iterable[str]:
    spout = _Block((-0.18, 0.0), (-0.012, 0.012), (0.22, 0.245), _STEEL)
    pipe = _Block((-0.0125, 0.0125), (-0.0125, 0.0125), (0.0, 0.25), _STEEL)
    yield from _part("sink_area_tap", "sink_area_surface", (0.22, 0.15, 0.0), [pipe, spout])


def _drawer(name: str, *, front: tuple[float, float], turn: float, z: tuple[float, float]) -> Iterable[str]:
    """Yield an open box 0.6 m wide and 0.45 m deep that `<name>_joint` slides out of the front, and `<name>_handle`."""
    height, side = z[1] - z[0], 0.30
    inner = (_PANEL_M, 0.45)
    blocks = [
        _Block((-_PANEL_M, _PANEL_M), (-side, side), (0.0, height), _PALE),
        _Block(inner, (-side + _PANEL_M, side - _PANEL_M), (0.0, _PANEL_M)),
        _Block(inner, (-side + _PANEL_M, -side + 2 * _PANEL_M), (_PANEL_M, height - 0.03)),
        _Block(inner, (side - 2 * _PANEL_M, side - _PANEL_M), (_PANEL_M, height - 0.03)),
        _Block((0.43, 0.45), (-side + 2 * _PANEL_M, side - 2 * _PANEL_M), (_PANEL_M, height - 0.03)),
    ]
    yield _link(name, blocks)
    yield _joint(name, "kitchen", "prismatic", (*front, z[0]), turn, axis=(-1, 0, 0), travel=_DRAWER_TRAVEL_M)
    handle = _Block((-0.008, 0.008), (-0.07, 0.07), (-0.008, 0.008), _STEEL)
    yield from _part(f"{name}_handle", name, (-0.05, 0.0, height / 2), [handle])


def _fridge() -> Iterable[str]:
    """Yield a hollow body open to the front, a shelf, and a door hinged on the right."""
    wall, width, depth, height = 0.03, 0.65, 0.60, 1.60
    across, deep = (0.0, width), (0.0, depth)
    blocks = [
        _Block(deep, (0.0, wall), (0.0, height), _PALE),
        _Block(deep, (width - wall, width), (0.0, height), _PALE),
        _Block((depth - wall, depth), across, (0.0, height), _PALE),
        _Block(deep, across, (0.0, 0.1), _PALE),
        _Block(deep, across, (height - wall, height), _PALE),
    ]
    yield from _part("fridge", "kitchen", (_FRONT, -1.25, 0.0), blocks)
    board = _Block((-0.27, 0.27), (-width / 2 + wall, width / 2 - wall), (-0.015, 0.0), _STEEL)
    yield from _part("fridge_shelf_surface", "fridge", (0.30, width / 2, 0.80), [board])
    yield _link("fridge_door", [_Block((-0.05, 0.0), across, (0.1, height), _PALE)])
    yield _joint("fridge_door", "fridge", "revolute", (0.0, 0.0, 0.0), 0.0, axis=(0, 0, 1), travel=_DOOR_SWING_RAD)
    handle = _Block((-0.01, 0.01), (-0.01, 0.01), (-0.2, 0.2), _STEEL)
    yield from _part("fridge_door_handle", "fridge_door", (-0.10, width - 0.06, 0.95), [handle])


def _part(name: str, parent: str, at: tuple[float, float, float], blocks: Iterable[_Block]) -> Iterable[str]:
    """Yield a link and the joint that fixes it to its parent."""
    yield _link(name, blocks)
    yield _joint(name, parent, "fixed", at, 0.0)


def _link(name: str, blocks: Iterable[_Block]) -> str:
    shapes = []
    for block in blocks:
        bounds = block[:3]
        size = numbers([high - low for low, high in bounds])
        shapes.append(shape(f'<box size="{size}"/>', [(low + high) / 2 for low, high in bounds], block.color))
    return f'<link name="{name}">{INERTIA}{"".join(shapes)}</link>'


def _joint(
    link: str,
    parent: str,
    kind: str,
    at: tuple[float, float, float],
    turn: float,
    *,
    axis: tuple[int, int, int] | None = None,
    travel: float = 0.0,
) -> str:
    """Return `<link>_joint` at that position of the parent, rotated about z; it moves from 0 to `travel` if it can."""
    motion = ""
    if axis is not None:
        motion = f'<axis xyz="{numbers(axis)}"/><limit lower="0" upper="{travel}" effort="100" velocity="1"/>'
    return (
        f'<joint name="{link}_joint" type="{kind}"><parent link="{parent}"/><child link="{link}"/>'
        f'<origin xyz="{numbers(at)}" rpy="0 0 {turn}"/>{motion}</joint>'
    )
