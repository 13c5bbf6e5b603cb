"""Draw the world of a moment from above, as SVG on a light ground."""

from __future__ import annotations

import html
import math
from collections.abc import Iterable, Iterator, Sequence

from pycrorm_async.query.notebook.markup import Drawing
from pycrorm_async.query.parameter_text import one_line
from pycrorm_async.query.scene.outlines import Outline, Point, outlines
from pycrorm_async.query.snapshot import ObjectThen, WorldThen

_SIZE_PX = 460.0
"""The longer side of a map in pixels."""
_SIZE_MIN_M = 2.0
"""The least longer side of a map in m, so that a single small object does not fill it."""
_MARGIN_M = 0.3
"""The least margin around the objects, in m."""
_LINES_MAX = 40
"""Bounds the lines of the grid along an axis."""
_OUTLINES_MAX = 3_000
"""Bounds the shapes of a map; of more, the highest are drawn."""
_NAMES_MAX = 60
"""Bounds the objects whose names are drawn."""


def world_map(world: WorldThen) -> Drawing:
    """Return the outlines of all objects from above, with the names of those that are not the environment."""
    shapes = outlines(world)[-_OUTLINES_MAX:]
    left, right, low, high = _extent([point for each in shapes for point in each.corners])
    scale = _SIZE_PX / max(right - left, high - low)
    width, height = (right - left) * scale, (high - low) * scale

    def at(point: Point) -> Point:
        return (point[0] - left) * scale, (high - point[1]) * scale

    parts = [f'<rect width="{width:.0f}" height="{height:.0f}" fill="#f4f6f9"/>']
    parts += [f'<path d="{_line(at((x, low)), at((x, high)))}" stroke="#d3d9e2"/>' for x in _grid(left, right)]
    parts += [f'<path d="{_line(at((left, y)), at((right, y)))}" stroke="#d3d9e2"/>' for y in _grid(low, high)]
    parts += [_polygon(each, [at(corner) for corner in each.corners]) for each in shapes]
    named = [each for each in world.objects if each.object_type != "ENVIRONMENT"][:_NAMES_MAX]
    parts += _names(named, [at((each.pose.position.x, each.pose.position.y)) for each in named])
    step = _step(right - left)
    parts.append(f'<text x="6" y="{height - 6:.0f}" fill="#5a6675" stroke="none">grid of {step:g} m</text>')
    return Drawing(
        f'<svg xmlns="http://www.w3.org/2000/svg" viewBox="0 0 {width:.0f} {height:.0f}" role="img"'
        f' aria-label="map of {len(world.objects)} objects from above" font-family="system-ui,sans-serif"'
        f' font-size="12" style="width:100%;max-width:{width:.0f}px">{"".join(parts)}</svg>'
    )


def _extent(points: Sequence[Point]) -> tuple[float, float, float, float]:
    if not points:
        return -1.0, 1.0, -1.0, 1.0
    (left, right), (low, high) = ((min(each), max(each)) for each in zip(*points, strict=True))
    margin = max(_MARGIN_M, (_SIZE_MIN_M - max(right - left, high - low)) / 2)
    return left - margin, right + margin, low - margin, high + margin


def _step(width: float) -> float:
    return float(10 ** max(0, math.ceil(math.log10(width / _LINES_MAX))))


def _grid(low: float, high: float) -> Iterator[float]:
    step = _step(high - low)
    yield from (index * step for index in range(math.ceil(low / step), math.floor(high / step) + 1))


def _line(start: Point, end: Point) -> str:
    return f"M{start[0]:.1f} {start[1]:.1f}L{end[0]:.1f} {end[1]:.1f}"


def _polygon(shape: Outline, corners: Iterable[Point]) -> str:
    red, green, blue, opacity = (min(max(each, 0.0), 1.0) for each in shape.color)
    points = " ".join(f"{x:.1f},{y:.1f}" for x, y in corners)
    color = f"#{round(red * 255):02x}{round(green * 255):02x}{round(blue * 255):02x}"
    paint = f'fill="{color}" fill-opacity="{opacity:.2g}" stroke="#1a2330" stroke-opacity=".55" stroke-width=".7"'
    return f'<polygon points="{points}" {paint}/>'


def _names(objects: Sequence[ObjectThen], positions: Sequence[Point]) -> Iterator[str]:
    """Yield the names above the objects, each moved up until it covers no other name."""
    taken: list[tuple[float, float, float]] = []
    for each, (x, y) in zip(objects, positions, strict=True):
        name = one_line(each.name, 30)
        half, y = len(name) * 3.4, y - 8
        while any(abs(x - other) < half + width and abs(y - top) < 13 for other, top, width in taken):
            y -= 13
        taken.append((x, y, half))
        paint = 'fill="#1a2330" stroke="#f4f6f9" stroke-width="3" paint-order="stroke" text-anchor="middle"'
        yield f'<text x="{x:.1f}" y="{y:.1f}" {paint}>{html.escape(name)}</text>'
