"""Define the port through which a world uses a physics engine, and choose the engine of a world.

An engine holds the shapes of one world and answers questions about them: frames of links, distances, rays, pictures. It
simulates nothing. Poses, joint positions, limits, attachments and observers are the world's own; what is loaded is a
`Model`, which `world.urdf_model` has read.

Bullet (`engines.bullet`) is the default where it is installed, otherwise MuJoCo (`engines.mujoco`). The variable
PYCRORM_ENGINE, and `BulletWorld(engine=)` before it, name another one. No other module imports either.

>>> with BulletWorld(engine="mujoco") as world:
...     Object("bowl", ObjectType.BOWL)
"""

import math
import os
import re
from collections.abc import Collection, Mapping, Sequence
from contextlib import suppress
from dataclasses import dataclass
from functools import cache
from importlib import import_module
from importlib.metadata import PackageNotFoundError, version
from importlib.util import find_spec
from typing import NamedTuple, Protocol, TypeAlias

import numpy as np
from numpy.typing import NDArray

from pycrorm_async.errors import CallerError
from pycrorm_async.world.bounding_boxes import Frame
from pycrorm_async.world.pose import EngineMissing, Pose, Quaternion, Vector, WorldMode
from pycrorm_async.world.urdf_model import Model

Color: TypeAlias = tuple[float, float, float, float]
"""Red, green, blue, opacity, each 0 to 1."""
Floats: TypeAlias = NDArray[np.float64]

SKY, FLOOR = -1, 0
"""The numbers of a picture's sky, and of the floor, an endless plane through the origin of "map"."""
NEAR_M, FAR_M = 0.05, 60.0
"""The distances in m between which a camera sees."""


class Part(NamedTuple):
    """A link of a body, or with None all of its links."""

    body: int
    link: str | None = None


class Near(NamedTuple):
    """The least distance between the shapes of a part, by its index, and those of another body.

    Attributes:
        distance_m: negative where they overlap: how far one must move to leave the other.
    """

    part: int
    other: int
    distance_m: float


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

    @property
    def near_m(self) -> float:
        """The distance from which on the camera sees."""
        return min(NEAR_M, self.distance_m / 10)

    @property
    def light(self) -> tuple[float, float, float]:
        """The direction to the light, which comes from beside the camera."""
        return _direction(self.yaw_deg + 40, 60)


def _direction(yaw_deg: float, pitch_deg: float) -> tuple[float, float, float]:
    yaw, pitch = math.radians(yaw_deg), math.radians(pitch_deg)
    return math.cos(yaw) * math.cos(pitch), math.sin(yaw) * math.cos(pitch), math.sin(pitch)


class Image(NamedTuple):
    """What a camera sees, each of shape (height, width, ...).

    Attributes:
        colors: red, green, blue, 0 to 255.
        bodies: the body's number, `FLOOR` or `SKY`.
        depths: distance from the camera along its axis, m.
    """

    colors: Floats
    bodies: NDArray[np.int32]
    depths: Floats


def frame_of(position: Sequence[float], turn: Sequence[float]) -> Frame:
    """Return the frame at a position with a rotation (x, y, z, w); of the two quaternions of it, that with w >= 0."""
    x, y, z, w = turn
    return Vector(*position), Quaternion(x, y, z, w) if w >= 0 else Quaternion(-x, -y, -z, -w)


class Engine(Protocol):
    """The shapes of one world in one engine, which belong to one thread at a time. A body has a number above 0.

    An engine opens when it is made, with a floor. Raises `WorldUnavailable` if it cannot, `EngineMissing` if it is not
    installed.
    """

    def __init__(self, mode: WorldMode) -> None: ...

    @classmethod
    def title(cls) -> str:
        """Return name and version, which are recorded with each episode."""
        ...

    def close(self) -> None:
        """Free everything; nothing is called afterwards."""
        ...

    def load(self, name: str, model: Model) -> tuple[int, tuple[str, ...]]:
        """Add a body at the origin with its joints at 0; return its number, and remarks for the user's log.

        Shapes of a body do not collide with each other, and nothing falls. Raises `DescriptionNotLoadable` with the
        object's name if a collision shape cannot be loaded; a visual shape that cannot be drawn is a remark.
        """
        ...

    def unload(self, number: int) -> None:
        """Remove a body."""
        ...

    def place(self, number: int, root: Pose) -> None:
        """Move the root link's frame to this pose in "map"."""
        ...

    def turn(self, number: int, positions: Mapping[str, float]) -> None:
        """Set these joints, rad or m; limits and followers are the caller's."""
        ...

    def frames(self, number: int, links: Sequence[str]) -> list[Frame]:
        """Return the frames of links in "map", with w >= 0 in their quaternions."""
        ...

    def nearest(self, parts: Sequence[Part], others: Collection[int], within_m: float) -> list[Near]:
        """Return the pairs of a part and another body whose collision shapes are at most this far apart, in any order.

        A mesh is the convex hull of its points.
        """
        ...

    def first_met(
        self, starts: Sequence[Sequence[float]], ends: Sequence[Sequence[float]], transparent: Collection[int]
    ) -> list[int]:
        """Return the first body on every ray, `FLOOR` or `SKY`; a ray does not hit the shape it starts in."""
        ...

    def render(self, camera: Camera, width: int, height: int, *, shadows: bool) -> Image:
        """Return what the camera sees of the visual shapes; from below it sees through the floor."""
        ...

    def paint(self, number: int, color: Color) -> None:
        """Give the body's visual shapes this color."""
        ...

    def label(self, number: int, text: str) -> None:
        """Show a text at the origin of the root link, in a window only."""
        ...


# === choice ===================================================================================================

VARIABLE = "PYCRORM_ENGINE"
"""The environment variable that names the engine of worlds for which none is passed."""
_MODULES = {"bullet": ("pybullet", "pycram_bullet"), "mujoco": ("mujoco",)}
"""The modules of each engine, one of which must be installed; the default engine comes first."""
ENGINES = tuple(_MODULES)


def engine_class(engine: str | type[Engine] | None = None) -> type[Engine]:
    """Return the class of an engine by its name; None means that of PYCRORM_ENGINE, else the first that is installed.

    The engine itself is imported now. Raises `CallerError` for an unknown name, `EngineMissing`.
    """
    if isinstance(engine, type):
        return engine
    name = engine or os.environ.get(VARIABLE) or None
    if name is None:
        name = next((each for each in ENGINES if _is_installed(each)), None)
        if name is None:
            raise EngineMissing
    if name not in ENGINES:
        of_variable = "" if engine else f" in {VARIABLE}"
        raise CallerError(f"unknown engine {name!r}{of_variable}; engines: {', '.join(ENGINES)}")
    if not _is_installed(name):
        raise EngineMissing(name)
    module = import_module(f"{__name__}.{name}")
    found: type[Engine] = module.Bullet if name == "bullet" else module.MuJoCo
    return found


def engine_in(description: str) -> str | None:
    """Return the name and version of the engine in the description of a world; None if it has none."""
    match = re.match(r"BulletWorld \(\w+, ([^)]+)\):", description)
    return None if match is None else match[1]


@cache
def title_of(engine: str, *packages: str) -> str:
    """Return the engine's name with the version of the first of these packages that is installed."""
    for package in packages:
        with suppress(PackageNotFoundError):
            return f"{engine} {version(package)}"
    return engine


def _is_installed(name: str) -> bool:
    return any(find_spec(module) is not None for module in _MODULES[name])
