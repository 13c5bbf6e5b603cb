"""An engine of boxes in numpy: the independent computation with which the others are compared.

It computes frames by the chain of joints, distances by projecting to and fro between two boxes, and rays by slabs. It
loads models of boxes only, such as the built-in robots and the kitchen.
"""

from __future__ import annotations

import itertools
import math
from collections.abc import Collection, Mapping, Sequence
from typing import NamedTuple

import numpy as np
from numpy.typing import NDArray

from pycrorm_async.world.bounding_boxes import Frame, rotation_matrix
from pycrorm_async.world.engines import FAR_M, FLOOR, SKY, Camera, Color, Floats, Image, Near, Part
from pycrorm_async.world.pose import DescriptionNotLoadable, Pose, Quaternion, WorldMode
from pycrorm_async.world.urdf_model import Model, Shape, along, origin


class PlacedBox(NamedTuple):
    """A box in "map": its middle, its axes in the columns of `turn`, half of its edges, all in m."""

    middle: Floats
    turn: Floats
    half: Floats

    def nearest_to(self, point: Floats) -> Floats:
        """Return the point of the box that is nearest to another point."""
        inside = np.clip((point - self.middle) @ self.turn, -self.half, self.half)
        return np.asarray(self.middle + inside @ self.turn.T)

    def distance(self, other: PlacedBox) -> float:
        """Return the distance to another box, m; negative by the depth of the overlap."""
        edges = [np.cross(one, two) for one in self.turn.T for two in other.turn.T]
        axes = [each / length for each in edges if (length := np.linalg.norm(each)) > 1e-9]
        away = other.middle - self.middle
        gaps = [
            abs(axis @ away) - np.abs(axis @ self.turn) @ self.half - np.abs(axis @ other.turn) @ other.half
            for axis in (*self.turn.T, *other.turn.T, *axes)
        ]
        if max(gaps) <= 0:
            return float(max(gaps))
        mine = self.middle
        for _ in range(2_000):
            theirs = other.nearest_to(mine)
            nearer = self.nearest_to(theirs)
            if np.abs(nearer - mine).max() < 1e-12:
                break
            mine = nearer
        return float(np.linalg.norm(mine - theirs))

    def entries(self, starts: Floats, ways: Floats) -> Floats:
        """Return the share of each way, (n, 3), after which it enters the box from outside; infinite if it does not."""
        begin, way = (starts - self.middle) @ self.turn, ways @ self.turn
        with np.errstate(divide="ignore", invalid="ignore"):
            to_low, to_high = (-self.half - begin) / way, (self.half - begin) / way
        between = np.abs(begin) <= self.half
        enter = np.where(way == 0, np.where(between, -np.inf, np.inf), np.minimum(to_low, to_high)).max(axis=1)
        leave = np.where(way == 0, np.where(between, np.inf, -np.inf), np.maximum(to_low, to_high)).min(axis=1)
        return np.where((enter > 0) & (enter <= leave), enter, np.inf)


class _Body:
    def __init__(self, model: Model) -> None:
        self.model = model
        self.root = Pose()
        self.positions: dict[str, float] = {}
        self.color: Color | None = None


class BoxEngine:
    """An engine without a library."""

    def __init__(self, mode: WorldMode) -> None:
        assert mode is WorldMode.DIRECT
        self._bodies: dict[int, _Body] = {}
        self._last = FLOOR
        self._placed: dict[tuple[Part, bool], list[PlacedBox]] = {}

    @classmethod
    def title(cls) -> str:
        return "Boxes 1.0"

    def close(self) -> None:
        self._bodies.clear()

    def load(self, name: str, model: Model) -> tuple[int, tuple[str, ...]]:
        for link, each in model.links.items():
            if (other := next((shape for shape in each.collisions if shape.kind != "box"), None)) is not None:
                raise DescriptionNotLoadable(name, f"collision of link {link!r}: a {other.kind} is no box")
        self._last += 1
        self._bodies[self._last] = _Body(model)
        return self._last, ()

    def unload(self, number: int) -> None:
        del self._bodies[number]
        self._placed.clear()

    def place(self, number: int, root: Pose) -> None:
        self._bodies[number].root = root
        self._placed.clear()

    def turn(self, number: int, positions: Mapping[str, float]) -> None:
        self._bodies[number].positions.update(positions)
        self._placed.clear()

    def frames(self, number: int, links: Sequence[str]) -> list[Frame]:
        body = self._bodies[number]
        frames = [body.root @ along(body.model.paths[link], body.positions) for link in links]
        return [(each.position, Quaternion(*_upward(each.orientation))) for each in frames]

    def nearest(self, parts: Sequence[Part], others: Collection[int], within_m: float) -> list[Near]:
        near = []
        for (index, part), other in itertools.product(enumerate(parts), others):
            pairs = itertools.product(self._boxes(part), self._boxes(Part(other)))
            close = [
                each
                for each in pairs
                if np.linalg.norm(each[0].middle - each[1].middle)
                <= within_m + np.linalg.norm(each[0].half) + np.linalg.norm(each[1].half)
            ]
            distance = min((one.distance(two) for one, two in close), default=math.inf)
            if distance <= within_m:
                near.append(Near(index, other, distance))
        return near

    def first_met(
        self, starts: Sequence[Sequence[float]], ends: Sequence[Sequence[float]], transparent: Collection[int]
    ) -> list[int]:
        begins = np.array(starts, np.float64)
        numbers, _ = self._cast(begins, np.array(ends, np.float64) - begins, transparent, visual=False)
        return [int(each) for each in numbers]

    def render(self, camera: Camera, width: int, height: int, *, shadows: bool) -> Image:
        ahead = np.subtract(camera.target, camera.eye)
        ahead /= np.linalg.norm(ahead)
        right = np.cross(ahead, (0.0, 0.0, 1.0))
        right /= np.linalg.norm(right)
        up = math.tan(math.radians(camera.view_deg) / 2)
        across, down = np.meshgrid(
            (np.arange(width) * 2 / width - 1) * up * width / height,
            (1 - np.arange(1, height + 1) * 2 / height) * up,
        )
        ways = (ahead + across[..., None] * right + down[..., None] * np.cross(right, ahead)).reshape(-1, 3)
        eyes = np.broadcast_to(np.array(camera.eye), ways.shape)
        numbers, shares = self._cast(eyes, ways * FAR_M, (), visual=True)
        grey = np.zeros((height, width, 3))
        return Image(grey, numbers.reshape(height, width), np.minimum(shares, 1.0).reshape(height, width) * FAR_M)

    def paint(self, number: int, color: Color) -> None:
        self._bodies[number].color = color

    def label(self, number: int, text: str) -> None:
        pass

    def _cast(
        self, begins: Floats, ways: Floats, transparent: Collection[int], *, visual: bool
    ) -> tuple[NDArray[np.int32], Floats]:
        with np.errstate(divide="ignore", invalid="ignore"):
            shares = -begins[:, 2] / ways[:, 2]
        shares = np.where((shares > 0) & (ways[:, 2] != 0), shares, np.inf)
        numbers = np.where(shares <= 1, FLOOR, SKY).astype(np.int32)
        for number in self._bodies.keys() - set(transparent):
            for box in self._boxes(Part(number), visual=visual):
                entries = box.entries(begins, ways)
                is_first = (entries < shares) & (entries <= 1)
                numbers[is_first], shares[is_first] = number, entries[is_first]
        return numbers, shares

    def _boxes(self, part: Part, *, visual: bool = False) -> list[PlacedBox]:
        key = part, visual
        if key not in self._placed:
            model = self._bodies[part.body].model
            links = list(model.links) if part.link is None else [part.link]
            boxes = []
            for link, (position, turn) in zip(links, self.frames(part.body, links), strict=True):
                shapes = model.links[link].visuals if visual else model.links[link].collisions
                boxes += [_placed(Pose(position, turn), each) for each in shapes if each.kind == "box"]
            self._placed[key] = boxes
        return self._placed[key]


def _upward(turn: Sequence[float]) -> list[float]:
    """Return the same rotation with w >= 0."""
    return [math.copysign(1, turn[3]) * each for each in turn]


def _placed(frame: Pose, shape: Shape) -> PlacedBox:
    at = frame @ origin(shape.xyz, shape.rpy)
    return PlacedBox(np.array(at.position), rotation_matrix(at.orientation), np.array(shape.sizes) / 2)
