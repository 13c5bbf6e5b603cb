"""Photograph a world with Bullet's software renderer, which needs no display."""

from __future__ import annotations

import math
from collections.abc import Sequence
from dataclasses import dataclass
from typing import TYPE_CHECKING, NamedTuple, TypeAlias

import numpy as np
from numpy.typing import NDArray

from pycrorm_async.world.bullet_loader import engine
from pycrorm_async.world.pose import Vector

if TYPE_CHECKING:
    from pycrorm_async.world.bullet import BulletWorld

_NEAR_M, _FAR_M = 0.05, 60.0
"""The distances in m between which the camera sees."""
_SKY = (238.0, 241.0, 245.0)
_FLOOR_LIGHT, _FLOOR_CONTRAST = 225.0, 0.35
"""Bullet's floor is a blue and white chessboard; it is repainted in pale greys, so that it does not outshine the
objects."""

Floats: TypeAlias = NDArray[np.float64]


@dataclass(frozen=True)
class Camera:
    """A camera that looks at a point.

    Attributes:
        target: in "map", m.
        distance_m: from the target.
        yaw_deg: direction from the target to the camera: 0 along +x, 90 along +y.
        pitch_deg: of the camera above the target's horizon.
        view_deg: angle between the upper and the lower edge of the picture.
    """

    target: Vector
    distance_m: float
    yaw_deg: float
    pitch_deg: float = 32.0
    view_deg: float = 40.0

    @property
    def eye(self) -> Vector:
        """The camera's position."""
        x, y, z = _direction(self.yaw_deg, self.pitch_deg)
        along = self.distance_m
        return Vector(self.target.x + x * along, self.target.y + y * along, self.target.z + z * along)


class Photograph(NamedTuple):
    """A picture of a world.

    Attributes:
        pixels: red, green, blue, shape (height, width, 3).
        bodies: `Object.body.number` of the object at each pixel, shape (height, width); other numbers: floor and sky.
        depths: distance from the camera along its axis at each pixel, m, shape (height, width).
    """

    pixels: NDArray[np.uint8]
    bodies: NDArray[np.int32]
    depths: Floats


def photograph(world: BulletWorld, camera: Camera, width: int, height: int, *, smooth: bool = True) -> Photograph:
    """Return a picture of the world. With `smooth`, each pixel is the mean of 4 points, and objects cast shadows.

    A smooth picture of 640 x 480 takes about 1 s of CPU time, one of 80 x 60 without it 10 ms.
    """
    bullet, scale = engine(), 2 if smooth else 1
    view = bullet.computeViewMatrix(camera.eye, camera.target, (0, 0, 1))
    near = min(_NEAR_M, camera.distance_m / 10)
    projection = bullet.computeProjectionMatrixFOV(camera.view_deg, width / height, near, _FAR_M)
    columns, rows, colors, buffer, numbers = bullet.getCameraImage(
        width * scale,
        height * scale,
        view,
        projection,
        shadow=int(smooth),
        lightDirection=_direction(camera.yaw_deg + 40, 60),
        lightColor=(1, 1, 1),
        lightAmbientCoeff=0.55,
        lightDiffuseCoeff=0.5,
        lightSpecularCoeff=0,
        renderer=bullet.ER_TINY_RENDERER,
        physicsClientId=world.client,
    )
    bodies = np.reshape(numbers, (rows, columns)).astype(np.int32)
    pixels = np.reshape(colors, (rows, columns, 4))[:, :, :3].astype(np.float64)
    _repaint_ground(pixels, bodies, [each.body.number for each in world.objects])
    smoothed = pixels.reshape(height, scale, width, scale, 3).mean(axis=(1, 3))
    depths = _FAR_M * near / (_FAR_M - (_FAR_M - near) * np.reshape(buffer, (rows, columns)))
    return Photograph(smoothed.round().astype(np.uint8), bodies[::scale, ::scale], depths[::scale, ::scale])


def _repaint_ground(pixels: Floats, bodies: NDArray[np.int32], objects: Sequence[int]) -> None:
    pixels[bodies < 0] = _SKY
    floor = (bodies >= 0) & ~np.isin(bodies, objects)
    brightness = pixels[floor].mean(axis=1, keepdims=True)
    pixels[floor] = _FLOOR_LIGHT + (brightness - _FLOOR_LIGHT) * _FLOOR_CONTRAST


def _direction(yaw_deg: float, pitch_deg: float) -> tuple[float, float, float]:
    yaw, pitch = math.radians(yaw_deg), math.radians(pitch_deg)
    return math.cos(yaw) * math.cos(pitch), math.sin(yaw) * math.cos(pitch), math.sin(pitch)
