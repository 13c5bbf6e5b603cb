"""Use Bullet as the engine of a world: one client of its server for each world.

Bullet keeps poses and joint positions in double precision, and gets a model without inertia as a URDF with all centres
of mass in the origins of their links, because it computes the frames of these centres in double precision.

Bullet makes the hulls of meshes 1 mm thicker, and rounds the corners of boxes by as much.
"""

import ctypes
import itertools
import math
import os
import re
import tempfile
from collections.abc import Collection, Iterator, Mapping, Sequence
from contextlib import contextmanager
from functools import cache, cached_property
from importlib import import_module
from importlib.util import find_spec
from pathlib import Path
from threading import Lock
from typing import Any, NamedTuple
from xml.sax.saxutils import quoteattr

import numpy as np

from pycrorm_async.world import pose as poses
from pycrorm_async.world.bounding_boxes import BoundingBox, Frame, box_of, boxes_around, rotation_matrix
from pycrorm_async.world.engines import FAR_M, FLOOR, SKY, Camera, Color, Floats, Image, Near, Part, frame_of, title_of
from pycrorm_async.world.meshes import for_bullet
from pycrorm_async.world.urdf_model import Model, along, digits, joint_lines

_ROOT = -1  # Bullet's number of a body's first link
_STATES_MAX = 127
"""Bullet returns no frames of links for a body with more joints than this, but it moves the links."""
_RAYS_AT_ONCE = 16_000  # Bullet accepts at most 16,384 rays per call
_GRAVITY_M_PER_S2 = -9.8
_SLACK_M = 5e-3
"""Added to balls and boxes, because Bullet's shapes are up to 1 mm thicker than those of the model."""
_LINKS_APART_MAX = 5
"""Bullet compares a link with a whole body of 22 links in the time of six calls for single links."""


class _BulletBody:
    """A loaded body: Bullet's numbers of its links and joints by name, and its state."""

    def __init__(self, model: Model, number: int, client: int) -> None:
        self.model = model
        self.links = {model.root: _ROOT}
        self.joints: dict[str, int] = {}
        bullet = library()
        for joint in range(bullet.getNumJoints(number, physicsClientId=client)):
            info = bullet.getJointInfo(number, joint, physicsClientId=client)
            self.joints[info[1].decode()] = self.links[info[12].decode()] = joint
        self.by_chain = len(self.joints) > _STATES_MAX
        self.root = poses.Pose()
        self.positions: dict[str, float] = {}
        """Kept only if frames are computed by the chain of joints."""
        self.placed_boxes: tuple[Floats, Floats] | None = None
        """Lowest and highest corners, (n, 3) each, in "map" for the shaped links; None after the body has moved."""

    @cached_property
    def boxes(self) -> dict[str, BoundingBox]:
        """The box around the collision shapes of each shaped link, in its own frame."""
        boxes = {link: box_of(each, visual=False) for link, each in self.model.links.items()}
        return {link: box for link, box in boxes.items() if box is not None}

    @cached_property
    def radii(self) -> dict[str, float]:
        """The radius of the ball around each shaped link's origin that holds its shapes."""
        return {
            link: float(np.linalg.norm(np.maximum(np.abs(box.min), np.abs(box.max))))
            for link, box in self.boxes.items()
        }


class _Ball(NamedTuple):
    """A ball around a link of a part: the part's index, Bullet's numbers of body and link."""

    part: int
    body: int
    link: int
    middle: poses.Vector
    radius: float


class Bullet:
    """A Bullet client with a floor.

    Attributes:
        client: Bullet's number of it.
    """

    def __init__(self, mode: poses.WorldMode) -> None:
        self.client = _connect(mode)
        self._bullet = library()
        self._bodies: dict[int, _BulletBody] = {}

    @classmethod
    def title(cls) -> str:
        """Return "Bullet" and the version of the installed package."""
        installed = [packages for module, packages in _PACKAGES.items() if find_spec(module) is not None]
        return title_of("Bullet", *itertools.chain.from_iterable(installed))

    def close(self) -> None:
        """Close the client."""
        self._bullet.disconnect(physicsClientId=self.client)

    # --- bodies -----------------------------------------------------------------------------------------------

    def load(self, name: str, model: Model) -> tuple[int, tuple[str, ...]]:
        """Load a model; the remarks are what Bullet printed, and the visual meshes that it does not draw."""
        number, remarks = _load(name, model, self.client)
        self._bodies[number] = body = _BulletBody(model, number, self.client)
        if any(shape.kind == "mesh" for link in model.links.values() for shape in link.collisions):
            _ = body.boxes  # while the files are those that Bullet has read
        return number, remarks

    def unload(self, number: int) -> None:
        """Remove a body."""
        self._bullet.removeBody(number, physicsClientId=self.client)
        del self._bodies[number]

    def link_number(self, number: int, link: str) -> int:
        """Return Bullet's number of a link."""
        return self._bodies[number].links[link]

    def place(self, number: int, root: poses.Pose) -> None:
        """Move the root link's frame to this pose."""
        self._bullet.resetBasePositionAndOrientation(
            number, root.position, root.orientation, physicsClientId=self.client
        )
        body = self._bodies[number]
        body.root, body.placed_boxes = root, None

    def turn(self, number: int, positions: Mapping[str, float]) -> None:
        """Set these joints."""
        body = self._bodies[number]
        numbers = [body.joints[joint] for joint in positions]
        values = [[position] for position in positions.values()]
        self._bullet.resetJointStatesMultiDof(number, numbers, values, physicsClientId=self.client)
        body.placed_boxes = None
        if body.by_chain:
            body.positions.update(positions)

    def frames(self, number: int, links: Sequence[str]) -> list[Frame]:
        """Return the frames of links: of their centres of mass, which are in their origins."""
        body = self._bodies[number]
        if body.by_chain:
            placed = [body.root @ along(body.model.paths[link], body.positions) for link in links]
            return [frame_of(each.position, each.orientation) for each in placed]
        if len(links) == 1 and (only := body.links[links[0]]) != _ROOT:
            state = self._bullet.getLinkState(number, only, computeForwardKinematics=True, physicsClientId=self.client)
            return [frame_of(*state[:2])]
        numbers = [body.links[link] for link in links]
        below = [each for each in numbers if each != _ROOT]
        states: Sequence[Any] = ()
        if below:
            states = self._bullet.getLinkStates(
                number, below, computeForwardKinematics=True, physicsClientId=self.client
            )
        frames = {each: frame_of(*state[:2]) for each, state in zip(below, states, strict=True)}
        frames[_ROOT] = frame_of(body.root.position, body.root.orientation)
        return [frames[each] for each in numbers]

    # --- queries ----------------------------------------------------------------------------------------------

    def nearest(self, parts: Sequence[Part], others: Collection[int], within_m: float) -> list[Near]:
        """Return the pairs of a part and another body that are at most this far apart.

        Bullet compares all pairs of links that it is asked for, so it is asked for those alone whose ball and box are
        near enough: a hundredth of the time where an arm has many bodies around it.
        """
        balls = self._balls(parts)
        boxes = [self._placed_boxes(other) for other in others]
        shapes = [(other, link) for other in others for link in self._bodies[other].boxes]
        if not balls or not shapes:
            return []
        low, high = (np.concatenate(ends) for ends in zip(*boxes, strict=True))
        middles, reaches = np.array([ball.middle for ball in balls]), np.array([ball.radius for ball in balls])
        apart = np.maximum(np.maximum(low - middles[:, None], middles[:, None] - high), 0.0)
        is_close = np.einsum("nmi,nmi->nm", apart, apart) <= ((reaches + within_m + _SLACK_M) ** 2)[:, None]
        close: dict[tuple[int, int], list[str]] = {}
        for row, column in np.argwhere(is_close).tolist():
            other, link = shapes[column]
            close.setdefault((row, other), []).append(link)
        least: dict[tuple[int, int], float] = {}
        for (row, other), links in close.items():
            part, number, of_link, *_ = balls[row]
            numbers = self._bodies[other].links
            whole = len(links) > _LINKS_APART_MAX
            for to in [{}] if whole else [{"linkIndexB": numbers[link]} for link in links]:
                for point in self._bullet.getClosestPoints(
                    number, other, distance=within_m, linkIndexA=of_link, physicsClientId=self.client, **to
                ):
                    least[part, other] = min(point[8], least.get((part, other), math.inf))
        return [Near(*pair, distance) for pair, distance in least.items()]

    def _balls(self, parts: Sequence[Part]) -> list[_Ball]:
        """Return a ball around each shaped link of the parts."""
        links: dict[int, list[tuple[int, str]]] = {}
        for index, (number, link) in enumerate(parts):
            radii = self._bodies[number].radii
            named = radii if link is None else (link,)
            links.setdefault(number, []).extend((index, each) for each in named if each in radii)
        balls = []
        for number, named_links in links.items():
            body = self._bodies[number]
            frames = self.frames(number, [link for _, link in named_links])
            for (index, link), (position, _) in zip(named_links, frames, strict=True):
                balls.append(_Ball(index, number, body.links[link], position, body.radii[link]))
        return balls

    def _placed_boxes(self, number: int) -> tuple[Floats, Floats]:
        """Return boxes along the axes of "map" around the shaped links of a body."""
        body = self._bodies[number]
        if body.placed_boxes is None:
            frames = self.frames(number, [*body.boxes])
            corners = np.array([(box.min, box.max) for box in body.boxes.values()]).reshape(-1, 2, 3)
            turns = np.array([rotation_matrix(turn) for _, turn in frames]).reshape(-1, 3, 3)
            positions = np.array([position for position, _ in frames]).reshape(-1, 3)
            halves = np.ptp(corners, axis=1) / 2
            body.placed_boxes = boxes_around(turns, positions, corners.mean(axis=1), halves)
        return body.placed_boxes

    def first_met(
        self, starts: Sequence[Sequence[float]], ends: Sequence[Sequence[float]], transparent: Collection[int]
    ) -> list[int]:
        """Return the first body on every ray."""
        numbers: list[int] = []
        try:
            for number in transparent:
                self._group(number, 0)
            for begin in range(0, len(starts), _RAYS_AT_ONCE):
                rays = starts[begin : begin + _RAYS_AT_ONCE], ends[begin : begin + _RAYS_AT_ONCE]
                numbers += [hit[0] for hit in self._bullet.rayTestBatch(*rays, physicsClientId=self.client)]
        finally:
            for number in transparent:
                self._group(number, 1)
        return numbers

    def _group(self, number: int, group: int) -> None:
        """Put a body into a group of Bullet; rays pass through those in none.

        Casting a new ray from behind each hit would not work: Bullet may let a ray that starts just inside a shape hit
        the same shape again and again.
        """
        for link in self._bodies[number].links.values():
            self._bullet.setCollisionFilterGroupMask(number, link, group, -1, physicsClientId=self.client)

    # --- pictures ---------------------------------------------------------------------------------------------

    def render(self, camera: Camera, width: int, height: int, *, shadows: bool) -> Image:
        """Return a picture by Bullet's software renderer, which needs no display."""
        bullet, near = self._bullet, camera.near_m
        columns, rows, colors, buffer, numbers = bullet.getCameraImage(
            width,
            height,
            bullet.computeViewMatrix(camera.eye, camera.target, (0, 0, 1)),
            bullet.computeProjectionMatrixFOV(camera.view_deg, width / height, near, FAR_M),
            shadow=int(shadows),
            lightDirection=camera.light,
            lightColor=(1, 1, 1),
            lightAmbientCoeff=0.55,
            lightDiffuseCoeff=0.5,
            lightSpecularCoeff=0,
            renderer=bullet.ER_TINY_RENDERER,
            physicsClientId=self.client,
        )
        return Image(
            np.reshape(colors, (rows, columns, 4))[:, :, :3].astype(np.float64),
            np.maximum(np.reshape(numbers, (rows, columns)), SKY).astype(np.int32),
            FAR_M * near / (FAR_M - (FAR_M - near) * np.reshape(buffer, (rows, columns))),
        )

    def paint(self, number: int, color: Color) -> None:
        """Give the visual shapes of all links this color."""
        for link in self._bodies[number].links.values():
            self._bullet.changeVisualShape(number, link, rgbaColor=color, physicsClientId=self.client)

    def label(self, number: int, text: str) -> None:
        """Show a text at the origin of the root link, in a window only."""
        self._bullet.addUserDebugText(text, (0.0, 0.0, 0.03), parentObjectUniqueId=number, physicsClientId=self.client)


def _connect(mode: poses.WorldMode) -> int:
    """Open a Bullet client with a floor, its first body."""
    bullet = library()
    if mode is poses.WorldMode.GUI and not os.environ.get("DISPLAY"):  # without a display Bullet ends the process
        raise poses.WorldUnavailable("a window needs a display, but DISPLAY is not set; use WorldMode.DIRECT")
    try:
        client: int = bullet.connect(bullet.GUI if mode is poses.WorldMode.GUI else bullet.DIRECT)
    except bullet.error as reason:
        raise poses.WorldUnavailable(f"Bullet cannot open another world: {reason}") from reason
    if client < 0:
        raise poses.WorldUnavailable("Bullet cannot open another world; close worlds that are not needed")
    # Bullet's file cache is keyed by name: it would return the old text of a changed description, and never shrink.
    bullet.setPhysicsEngineParameter(enableFileCaching=0, physicsClientId=client)
    bullet.setGravity(0, 0, _GRAVITY_M_PER_S2, physicsClientId=client)
    floor = bullet.createCollisionShape(bullet.GEOM_PLANE, physicsClientId=client)
    number = bullet.createMultiBody(0, floor, physicsClientId=client)
    assert number == FLOOR, number
    return client


# === loading ==================================================================================================


def _load(name: str, model: Model, client: int) -> tuple[int, tuple[str, ...]]:
    """Load a model with all its links and a fixed base; return Bullet's number of the body, and its remarks."""
    bullet = library()
    with tempfile.TemporaryDirectory(prefix="pycrorm-urdf-") as folder:
        urdf, remarks = _written(model, Path(folder))
        path = Path(folder, "model.urdf")
        path.write_text(urdf, encoding="utf-8")
        with captured() as output:
            try:
                number: int | None = bullet.loadURDF(
                    str(path),
                    useFixedBase=True,
                    flags=bullet.URDF_USE_IMPLICIT_CYLINDER,
                    physicsClientId=client,
                )
            except bullet.error:
                number = None
    printed = "".join(output)
    if number is None:
        raise poses.DescriptionNotLoadable(name, " ".join(_messages(printed, "Error")) or "Bullet printed no reason")
    return number, (*remarks, *_messages(printed, "Warning"), *_messages(printed, "Error"))


def _written(model: Model, folder: Path) -> tuple[str, tuple[str, ...]]:
    """Return a URDF of what the reader understood, with one element a line, and what Bullet does not draw.

    Bullet reads no line of more than 1,023 characters. The links have their centres of mass in their origins, because
    nothing falls, and Bullet computes the frames of these centres in double precision. Meshes that Bullet does not read
    are written to the folder.
    """
    lines, remarks = ["<robot name='model'>"], []
    files: dict[tuple[str, str], str] = {}
    for name, link in model.links.items():
        lines.append(f"<link name={quoteattr(name)}>\n{_INERTIAL}")
        for kind, shapes in (("collision", link.collisions), ("visual", link.visuals)):
            for shape in shapes:
                file = shape.file
                if shape.kind == "mesh" and (kind, file) not in files:
                    try:
                        content = for_bullet(file, collision=kind == "collision")
                    except (OSError, ValueError):  # of a collision mesh it was raised when its box was computed
                        fault = "Bullet does not draw" if Path(file).is_file() else "there is no file"
                        remarks.append(f"visual of link {name!r}: {fault} {file}")
                        continue
                    files[kind, file] = file if content is None else str(folder / f"{len(files)}.stl")
                    if content is not None:
                        Path(files[kind, file]).write_bytes(content)
                sizes = _SIZES[shape.kind].format(*map(repr, shape.sizes))
                name_of_file = f"filename={quoteattr(files[kind, file])} " if shape.kind == "mesh" else ""
                lines += [
                    f"<{kind}>",
                    f"<origin xyz='{digits(shape.xyz)}' rpy='{digits(shape.rpy)}'/>",
                    "<geometry>",
                    f"<{shape.kind} {name_of_file}{sizes}/>",
                    "</geometry>",
                ]
                if shape.color is not None and kind == "visual":
                    rgba = digits(shape.color)
                    lines.append(f"<material name='{rgba}'>\n<color rgba='{rgba}'/>\n</material>")
                lines.append(f"</{kind}>")
        lines.append("</link>")
    for joint in model.joints.values():
        lines += joint_lines(joint)
    return "\n".join([*lines, "</robot>"]), tuple(remarks)


_INERTIAL = "<inertial>\n<mass value='1'/>\n<inertia ixx='1' ixy='0' ixz='0' iyy='1' iyz='0' izz='1'/>\n</inertial>"


_SIZES = {
    "mesh": "scale='{} {} {}'",
    "box": "size='{} {} {}'",
    "sphere": "radius='{}'",
    "cylinder": "radius='{}' length='{}'",
    "capsule": "radius='{}' length='{}'",
}
"""The attributes of each kind of shape."""


def _messages(output: str, kind: str) -> list[str]:
    """Extract the errors or the warnings from Bullet's output, without its file names and line numbers."""
    parts = re.split(r"b3(Error|Warning|Printf)\[[^\]]*\]:\n?", output)
    return list(
        dict.fromkeys(
            text.strip() for of, text in zip(parts[1::2], parts[2::2], strict=True) if of == kind and text.strip()
        )
    )


# === library ==================================================================================================
#
# Load Bullet when the first world is entered, and keep its output away from stdout and stderr.
#
# Three packages ship the same Bullet: pybullet has wheels up to Python 3.11; pycram-bullet, the fork of the institute
# behind PyCRAM, has wheels for 3.11 and 3.12 and calls its module `pycram_bullet`; pybullet-arm64, a fork that is kept
# up to date, has wheels for 3.12 and 3.13 on x86-64 too. Each one works; no other module of this package imports one.
#
# Bullet prints with C's `printf`, which cannot be switched off: a greeting at import, warnings when it loads a body.
# Meanwhile this module points C's own `stdout` and `stderr` to a buffer in memory. Python and child processes write to
# the file descriptors and not through those pointers, so their output is not affected. The buffer holds Bullet's error
# message if a description does not load.

_PACKAGES = {"pybullet": ("pybullet", "pybullet-arm64"), "pycram_bullet": ("pycram-bullet",)}
"""For each module the packages that have it."""
_STREAMS_LOCK = Lock()  # a process has one C stdout


@cache
def library() -> Any:
    """Return the module of Bullet, imported at the first call: `pybullet` or else `pycram_bullet`.

    Raises `BulletMissing` if neither is installed.
    """
    for name in _PACKAGES:
        spec = find_spec(name)
        if spec is None or spec.origin is None:
            continue
        # Load the library before the streams are redirected: its C++ runtime keeps the streams it finds when it
        # starts, and would flush the freed memory buffer at exit.
        ctypes.CDLL(spec.origin)
        with captured():
            return import_module(name)
    raise poses.BulletMissing


@contextmanager
def captured() -> Iterator[list[str]]:
    """Capture the output of C code inside the context; afterwards the list holds it as one string.

    One thread at a time can capture, others block; not reentrant. Without glibc nothing is captured.
    """
    output: list[str] = []
    libc = ctypes.CDLL(None)
    if not hasattr(libc, "gnu_get_libc_version"):  # only glibc lets its streams be assigned
        yield output
        return
    libc.open_memstream.restype = ctypes.c_void_p
    text, size = ctypes.c_char_p(), ctypes.c_size_t()
    streams = [ctypes.c_void_p.in_dll(libc, name) for name in ("stdout", "stderr")]
    with _STREAMS_LOCK:
        memory: int | None = libc.open_memstream(ctypes.byref(text), ctypes.byref(size))
        if memory is None:
            raise MemoryError
        before = [stream.value for stream in streams]
        for stream in streams:
            stream.value = memory
        try:
            yield output
        finally:
            for stream, value in zip(streams, before, strict=True):
                stream.value = value
            libc.fclose(ctypes.c_void_p(memory))
            output.append((text.value or b"").decode(errors="replace"))
            libc.free(text)
