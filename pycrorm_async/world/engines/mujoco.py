"""Use MuJoCo as the engine of a world: models made of its elements, compiled before the first question after a change.

Theory of operation
-------------------
MuJoCo answers questions about a compiled model, and compiling takes 1 to 3 ms. So loading and unloading a body only
edits the specification, and the next question compiles it: once for a burst of changes. Compiling numbers all elements
again, so a compiled `_Scene` reads the numbers of each body from its elements. A root link is a mocap body, whose pose
is part of the data and not of the model; a joint is a hinge or a slide without limits, which the world checks.

Elements of MuJoCo get no names, because a URDF may name a link `world`, as MuJoCo names its own root; and every body
has a mass, because MuJoCo refuses moving bodies without one. Shapes come from our reader alone. A mesh is the hull of
its points, computed once for each file by compiling it alone, so that a mesh that MuJoCo refuses is an error of its
object.

A picture is cast ray by ray in a second scene, of the visual shapes, which exists from the first picture on. No display
and no OpenGL are needed, and nothing casts a shadow.

MuJoCo raises exceptions and prints nothing, so its output need not be captured; captured output has ended processes at
their exit. Its warnings would be written to MUJOCO_LOG.TXT in the current folder; they are logged instead.
"""

from __future__ import annotations

import logging
import math
from collections.abc import Collection, Mapping, Sequence
from functools import cache, lru_cache, partial
from importlib import import_module
from importlib.util import find_spec
from pathlib import Path
from typing import Any, NamedTuple, TypeAlias

import numpy as np
from numpy.typing import NDArray

from pycrorm_async.world import pose as poses
from pycrorm_async.world.bounding_boxes import Frame, boxes_around, rotation_matrix
from pycrorm_async.world.engines import FAR_M, FLOOR, SKY, Camera, Color, Floats, Image, Near, Part, frame_of, title_of
from pycrorm_async.world.meshes import FileStatus, Mesh, file_status, mesh_points, read_mesh
from pycrorm_async.world.urdf_model import Model, Shape, origin

Numbers: TypeAlias = NDArray[np.int32]

_log = logging.getLogger("pycrorm_async")
_THIN_M = 1e-3
"""The least extent of a mesh: a flat one has no hull. It is as thick as Bullet makes a mesh by its margin."""
_SIZE_MIN = 1e-6
"""The least edge or radius of a shape, m: MuJoCo refuses zero."""
_STEP_M = 1e-7
"""The distance behind a surface at which a ray goes on through it."""
_PASSES_MAX = 64
"""Bounds the surfaces that one ray leaves behind it, each of a shape in which it began."""
_WITHIN_SLACK_M = 1e-3
"""MuJoCo returns its greatest distance for all shapes that are farther apart, so it is asked for a little more."""
_VISIBLE, _TRANSPARENT = 0, 1
"""Groups of shapes; rays pass through the second."""
_GROUPS = np.array([1, 0, 0, 0, 0, 0], np.uint8)
_GREY: Color = (0.8, 0.8, 0.8, 1.0)
_AMBIENT, _DIFFUSE = 0.55, 0.5
_FLOOR_SQUARES = (np.array([0.5, 0.65, 0.85]), np.array([0.95, 0.95, 0.95]))


class MuJoCo:
    """The bodies of a world, and their collision shapes in a scene of MuJoCo."""

    def __init__(self, mode: poses.WorldMode) -> None:
        library()
        if mode is poses.WorldMode.GUI:
            raise poses.WorldUnavailable("MuJoCo opens no window here: use WorldMode.DIRECT, or engine='bullet'")
        self._bodies: dict[int, _MujocoBody] = {}
        self._last = FLOOR
        self._collisions = _Scene()
        self._visuals: _Scene | None = None

    @classmethod
    def title(cls) -> str:
        """Return "MuJoCo" and the version of the installed package."""
        return title_of("MuJoCo", "mujoco-core", "mujoco")

    def close(self) -> None:
        """Free the scenes."""
        self._bodies.clear()
        del self._collisions, self._visuals

    # --- bodies -----------------------------------------------------------------------------------------------

    def load(self, name: str, model: Model) -> tuple[int, tuple[str, ...]]:
        """Add a body; the remarks name visual meshes without a file."""
        shapes: dict[str, tuple[_Geom, ...]] = {}
        for link, each in model.links.items():
            try:
                shapes[link] = tuple(_geom(shape, _GREY) for shape in each.collisions)
            except ValueError as fault:
                raise poses.DescriptionNotLoadable(name, f"collision of link {link!r}: {fault}") from fault
        self._last += 1
        body = self._bodies[self._last] = _MujocoBody(name, model)
        self._collisions.add(self._last, body, shapes)
        self._visuals = None
        files = ((link, shape.file) for link, each in model.links.items() for shape in each.visuals if shape.file)
        absent = [(link, file) for link, file in files if not Path(file).is_file()]
        return self._last, tuple(f"visual of link {link!r}: there is no file {file}" for link, file in absent)

    def unload(self, number: int) -> None:
        """Remove a body."""
        del self._bodies[number]
        self._collisions.remove(number)
        self._visuals = None

    def place(self, number: int, root: poses.Pose) -> None:
        """Move the root link's frame to this pose."""
        self._bodies[number].root = root
        self._collisions.moved.add(number)

    def turn(self, number: int, positions: Mapping[str, float]) -> None:
        """Set these joints."""
        self._bodies[number].positions.update(positions)
        self._collisions.moved.add(number)

    def frames(self, number: int, links: Sequence[str]) -> list[Frame]:
        """Return the frames of links."""
        scene = self._collisions.current(self._bodies)
        numbers = [scene.links[number][link] for link in links]
        frames = ((scene.positions[each].tolist(), scene.quaternions[each].tolist()) for each in numbers)
        return [frame_of(position, (x, y, z, w)) for position, (w, x, y, z) in frames]

    # --- queries ----------------------------------------------------------------------------------------------

    def nearest(self, parts: Sequence[Part], others: Collection[int], within_m: float) -> list[Near]:
        """Return the pairs that are at most this far apart: those whose boxes are are measured by MuJoCo."""
        scene = self._collisions.current(self._bodies)
        of_parts = [scene.geoms_of(*part) for part in parts]
        of_others = [scene.geoms_of(other) for other in others]
        if not of_parts or not of_others:
            return []
        ones, twos = np.concatenate(of_parts), np.concatenate(of_others)
        part_of = np.repeat(np.arange(len(parts)), [len(each) for each in of_parts])
        low, high = scene.boxes()
        apart = np.maximum(low[ones][:, None] - high[twos], low[twos] - high[ones][:, None]).max(axis=2)
        measured, distance_max = library().mj_geomDistance, within_m + _WITHIN_SLACK_M
        near: dict[tuple[int, int], float] = {}
        for row, column in np.argwhere(apart <= within_m).tolist():
            distance = measured(scene.model, scene.data, int(ones[row]), int(twos[column]), distance_max, None)
            if distance <= within_m:
                pair = int(part_of[row]), int(scene.bodies[twos[column]])
                near[pair] = min(distance, near.get(pair, math.inf))
        return [Near(*pair, distance) for pair, distance in near.items()]

    def first_met(
        self, starts: Sequence[Sequence[float]], ends: Sequence[Sequence[float]], transparent: Collection[int]
    ) -> list[int]:
        """Return the first body on every ray."""
        scene = self._collisions.current(self._bodies)
        begins, ways = np.array(starts, np.float64), np.array(ends, np.float64)
        ways -= begins
        lengths = np.linalg.norm(ways, axis=1)
        hidden = np.isin(scene.bodies, list(transparent)) if transparent else None
        geoms = scene.cast(begins, ways / np.maximum(lengths, 1e-12)[:, None], lengths, transparent=hidden).geoms
        numbers: list[int] = np.where(geoms >= 0, scene.bodies[geoms], SKY).tolist()
        return numbers

    # --- pictures ---------------------------------------------------------------------------------------------

    def render(self, camera: Camera, width: int, height: int, *, shadows: bool) -> Image:  # noqa: ARG002  see above
        """Return a picture, for each pixel the color that the light gives to the surface its ray meets."""
        if self._visuals is None:
            self._visuals = scene = _Scene(floor_sides=1)
            for number, body in self._bodies.items():
                scene.add(number, body, _visual_geoms(body))
        self._visuals.moved.update(self._bodies)
        scene = self._visuals.current(self._bodies)
        ahead = np.subtract(camera.target, camera.eye)
        ahead /= np.linalg.norm(ahead)
        right = np.cross(ahead, (0.0, 0.0, 1.0))
        right /= np.linalg.norm(right)
        up = math.tan(math.radians(camera.view_deg) / 2)
        rows = (1 - np.arange(1, height + 1) * 2 / height) * up  # of the lower left corners of pixels, as in Bullet
        columns = (np.arange(width) * 2 / width - 1) * up * width / height
        ways = ahead + columns[None, :, None] * right + rows[:, None, None] * np.cross(right, ahead)
        ways = ways.reshape(-1, 3)
        stretch = np.linalg.norm(ways, axis=1)  # of a ray against the camera's axis
        eyes = np.broadcast_to(np.array(camera.eye), ways.shape)
        units = ways / stretch[:, None]
        hits = scene.cast(eyes, units, FAR_M * stretch, nearest=camera.near_m * stretch)
        bodies = np.where(hits.geoms >= 0, scene.bodies[hits.geoms], SKY)
        colors = scene.colors[hits.geoms]
        floor = bodies == FLOOR
        met = np.array(camera.eye) + units * hits.distances[:, None]
        is_odd = np.floor(met[floor, :2]).sum(axis=1) % 2 > 0
        colors[floor] = np.where(is_odd[:, None], *_FLOOR_SQUARES)
        light = np.clip(hits.normals @ np.array(camera.light), 0.0, 1.0)
        colors *= np.minimum(_AMBIENT + _DIFFUSE * light, 1.0)[:, None] * 255
        depths = np.where(hits.geoms >= 0, hits.distances / stretch, FAR_M)
        shape = height, width
        return Image(colors.reshape(*shape, 3), bodies.astype(np.int32).reshape(shape), depths.reshape(shape))

    def paint(self, number: int, color: Color) -> None:
        """Give the body's visual shapes this color, from the next picture on."""
        self._bodies[number].color = color
        self._visuals = None

    def label(self, number: int, text: str) -> None:
        """Show nothing: there is no window."""


class _MujocoBody:
    """The state of a body."""

    def __init__(self, name: str, model: Model) -> None:
        self.name = name
        self.model = model
        self.root = poses.Pose()
        self.positions: dict[str, float] = {}
        self.color: Color | None = None


class _Geom(NamedTuple):
    """A shape for MuJoCo: its type, its place in the link, its color, and the triangles of a mesh."""

    kind: str
    size: tuple[float, float, float]
    at: poses.Pose
    color: Color
    mesh: Mesh | None = None


class _Elements(NamedTuple):
    """A body's elements of the specification: by link, by joint, with the link of each shape, and its meshes."""

    links: dict[str, Any]
    joints: dict[str, Any]
    shapes: list[tuple[Any, str]]
    meshes: list[Any]


class _Hits(NamedTuple):
    """What rays meet: the shape or -1, the distance, and the outward normal of its surface, (n,), (n,), (n, 3)."""

    geoms: Numbers
    distances: Floats
    normals: Floats


class _Scene:
    """A specification of bodies with a floor, and what was compiled of it.

    Args:
        floor_sides: 1 for a floor that is met from above only, as a camera sees it; 2 for one that rays meet.

    Attributes:
        moved: numbers of bodies whose state differs from that in the data.
        links: for each body MuJoCo's numbers of its links.
        bodies: for each shape the number of its body, (n,).
        colors: of the shapes, red, green, blue, (n, 3).
        positions, quaternions: of MuJoCo's bodies, by their numbers, (n, 3) and (n, 4), w first.
    """

    model: Any
    data: Any
    links: dict[int, dict[str, int]]
    bodies: Numbers
    colors: Floats
    positions: Floats
    quaternions: Floats

    def __init__(self, *, floor_sides: int = 2) -> None:
        self._library = library()
        self._spec = self._library.MjSpec()
        self._spec.compiler.usethread = False
        self._spec.compiler.fusestatic = False
        self._elements: dict[int, _Elements] = {}
        self._meshes: dict[int, tuple[Any, int]] = {}
        self._is_compiled = False
        self._boxes: tuple[Floats, Floats] | None = None
        self.moved: set[int] = set()
        plane = self._library.mjtGeom.mjGEOM_PLANE
        for turn in ((1, 0, 0, 0), (0, 1, 0, 0))[:floor_sides]:  # a plane is met from one side only
            self._spec.worldbody.add_geom(type=plane, size=[0, 0, 1], quat=turn)

    def add(self, number: int, body: _MujocoBody, shapes: Mapping[str, Sequence[_Geom]]) -> None:
        """Add a body with these shapes by link."""
        self._is_compiled = False
        root = self._spec.worldbody.add_body(mocap=True, explicitinertial=True, mass=1.0, inertia=(1, 1, 1))
        elements = self._elements[number] = _Elements({body.model.root: root}, {}, [], [])
        kinds = self._library.mjtJoint
        for joint in (path[-1] for path in body.model.paths.values() if path):
            elements.links[joint.child] = element = elements.links[joint.parent].add_body(
                **_at(joint.origin), explicitinertial=True, mass=1.0, inertia=(1, 1, 1)
            )
            if joint.kind is not poses.JointType.FIXED:
                kind = kinds.mjJNT_SLIDE if joint.kind is poses.JointType.PRISMATIC else kinds.mjJNT_HINGE
                elements.joints[joint.name] = element.add_joint(type=kind, axis=joint.axis)
        for link, geom in ((link, each) for link, geoms in shapes.items() for each in geoms):
            mesh = {}
            if geom.mesh is not None:  # which all shapes of these triangles share
                own, count = self._meshes.get(id(geom.mesh), (None, 0))
                own = own or _add_mesh(self._spec, f"{id(geom.mesh)}", geom.mesh.vertices, geom.mesh.faces)
                self._meshes[id(geom.mesh)] = own, count + 1
                elements.meshes.append(geom.mesh)
                mesh = {"meshname": f"{id(geom.mesh)}"}
            shape = elements.links[link].add_geom(
                **_at(geom.at),
                type=getattr(self._library.mjtGeom, f"mjGEOM_{geom.kind.upper()}"),
                size=geom.size,
                rgba=geom.color,
                contype=0,
                conaffinity=0,
                **mesh,
            )
            elements.shapes.append((shape, link))

    def remove(self, number: int) -> None:
        """Remove a body, and the meshes that no other body has."""
        self._is_compiled = False
        elements = self._elements.pop(number)
        self._spec.delete(next(iter(elements.links.values())))
        for triangles in elements.meshes:
            mesh, count = self._meshes.pop(id(triangles))
            if count > 1:
                self._meshes[id(triangles)] = mesh, count - 1
            else:
                self._spec.delete(mesh)
        self.moved.discard(number)

    def current(self, states: Mapping[int, _MujocoBody]) -> _Scene:
        """Bring the compiled model and its data up to date; return the scene itself."""
        if not self._is_compiled:
            self._compile()
            self.moved = set(self._elements)
        if self.moved:
            for number in self.moved:
                state, (mocap, addresses) = states[number], self._addresses[number]
                x, y, z, w = state.root.orientation
                self._roots[mocap] = state.root.position
                self._turns[mocap] = w, x, y, z
                for joint, position in state.positions.items():
                    self._joints[addresses[joint]] = position
            self._library.mj_kinematics(self.model, self.data)
            self.moved.clear()
            self._boxes = None
        return self

    def _compile(self) -> None:
        self.model = model = self._spec.compile()
        self.data = data = self._library.MjData(model)
        self._roots, self._turns, self._joints = data.mocap_pos, data.mocap_quat, data.qpos
        self.positions, self.quaternions = data.xpos, data.xquat
        self.bodies = np.full(model.ngeom, FLOOR, np.int32)
        self.colors = model.geom_rgba[:, :3].astype(np.float64)
        self.links, self._addresses = {}, {}
        self._shapes: dict[Part, NDArray[np.int64]] = {}
        mocaps, addresses = model.body_mocapid.tolist(), model.jnt_qposadr.tolist()
        for number, elements in self._elements.items():
            self.links[number] = links = {link: element.id for link, element in elements.links.items()}
            root = next(iter(links.values()))
            self._addresses[number] = (
                mocaps[root],
                {joint: addresses[element.id] for joint, element in elements.joints.items()},
            )
            by_link: dict[str, list[int]] = {}
            for element, link in elements.shapes:
                by_link.setdefault(link, []).append(element.id)
            for link, shapes in by_link.items():
                self._shapes[Part(number, link)] = np.array(shapes, np.int64)
            every = [shape for shapes in by_link.values() for shape in shapes]
            self._shapes[Part(number)] = np.array(every, np.int64)
            self.bodies[every] = number
        self._middles, self._halves = model.geom_aabb[:, :3].copy(), model.geom_aabb[:, 3:].copy()
        self._is_compiled = True

    def geoms_of(self, body: int, link: str | None = None) -> NDArray[np.int64]:
        """Return MuJoCo's numbers of the shapes of a link, or of a whole body."""
        return self._shapes.get(Part(body, link), _NONE)

    def boxes(self) -> tuple[Floats, Floats]:
        """Return the lowest and the highest corners of the boxes around all shapes, (n, 3) each."""
        if self._boxes is None:
            turns = self.data.geom_xmat.reshape(-1, 3, 3)
            self._boxes = boxes_around(turns, self.data.geom_xpos, self._middles, self._halves)
        return self._boxes

    def cast(
        self,
        starts: Floats,
        units: Floats,
        lengths: Floats,
        *,
        nearest: Floats | None = None,
        transparent: NDArray[np.bool_] | None = None,
    ) -> _Hits:
        """Return what rays meet within their lengths, and not nearer than `nearest`.

        A ray passes the surface of a shape that it leaves, because it began inside.
        """
        count = len(starts)
        hits = _Hits(np.full(count, -1, np.int32), np.zeros(count), np.zeros((count, 3)))
        pending, passed, at = np.arange(count), np.zeros(count), starts
        if transparent is not None:
            self.model.geom_group[transparent] = _TRANSPARENT
        try:
            for _ in range(_PASSES_MAX):
                geoms, distances, normals = self._met(at, units[pending], float(lengths.max(initial=0.0)))
                distances += passed[pending]
                is_met = (geoms >= 0) & (distances <= lengths[pending])
                is_left = is_met & (np.einsum("ni,ni->n", normals, units[pending]) > 0)
                if nearest is not None:
                    is_left |= is_met & (distances < nearest[pending])
                for each in np.flatnonzero(is_left & (passed[pending] > 0)).tolist():
                    # A shape that touches the one which the ray has left is entered within the step behind that.
                    ray = pending[each]
                    entry = self._first_surface(int(geoms[each]), starts[ray], units[ray], normals[each])
                    if entry < distances[each] - 2 * _STEP_M and (nearest is None or entry >= nearest[ray]):
                        distances[each], is_left[each] = entry, False
                is_hit = is_met & ~is_left
                hits.geoms[pending[is_hit]] = geoms[is_hit]
                hits.distances[pending[is_hit]] = distances[is_hit]
                hits.normals[pending[is_hit]] = normals[is_hit]
                passed[pending[is_left]] = distances[is_left] + _STEP_M
                pending = pending[is_left]
                if not len(pending):
                    break
                at = starts[pending] + units[pending] * passed[pending][:, None]
        finally:
            if transparent is not None:
                self.model.geom_group[transparent] = _VISIBLE
        return hits

    def _first_surface(self, geom: int, start: Floats, unit: Floats, normal: Floats) -> float:
        """Return the distance at which a ray first meets one shape, and put the normal there into `normal`."""
        model, data = self.model, self.data
        if model.geom_type[geom] == self._library.mjtGeom.mjGEOM_MESH:
            return float(self._library.mj_rayMesh(model, data, geom, start, unit, normal))
        at, turn, size = data.geom_xpos[geom], data.geom_xmat[geom], model.geom_size[geom]
        return float(self._library.mju_rayGeom(at, turn, size, start, unit, model.geom_type[geom], normal))

    def _met(self, starts: Floats, units: Floats, length: float) -> _Hits:
        """Return the nearest surface on every ray, met from outside or from inside."""
        count = len(starts)
        geoms, distances, normals = np.full(count, -1, np.int32), np.full(count, -1.0), np.zeros((count, 3))
        if count and (starts == starts[0]).all():
            cast = self._library.mj_multiRay
            flat, eye = np.ascontiguousarray(units).ravel(), starts[0].copy()
            cast(self.model, self.data, eye, flat, _GROUPS, 1, -1, geoms, distances, normals.reshape(-1), count, length)
        else:
            cast, geom = self._library.mj_ray, np.zeros(1, np.int32)
            for ray in range(count):
                normal = normals[ray]
                distances[ray] = cast(self.model, self.data, starts[ray], units[ray], _GROUPS, 1, -1, geom, normal)
                geoms[ray] = geom[0]
        return _Hits(geoms, distances, normals)


_NONE = np.zeros(0, np.int64)


def _at(pose: poses.Pose) -> dict[str, Any]:
    """Return the place of an element; MuJoCo's quaternions have w first."""
    x, y, z, w = pose.orientation
    return {"pos": pose.position, "quat": (w, x, y, z)}


# === shapes ===================================================================================================


def _geom(shape: Shape, color: Color) -> _Geom:
    """Return a collision shape. Raises `ValueError` for a mesh that cannot be read."""
    at = origin(shape.xyz, shape.rpy)
    if shape.kind == "mesh":
        try:
            return _Geom("mesh", (0, 0, 0), at, color, _hull(shape.file, file_status(shape.file), shape.sizes))
        except OSError as error:
            raise ValueError(f"mesh {shape.file}: {error}") from error
    sizes = [max(each, _SIZE_MIN) for each in shape.sizes]
    match shape.kind:
        case "box":
            size = sizes[0] / 2, sizes[1] / 2, sizes[2] / 2
        case "sphere":
            size = sizes[0], 0.0, 0.0
        case _:
            size = sizes[0], sizes[1] / 2, 0.0
    return _Geom(shape.kind, size, at, color)


def _visual_geoms(body: _MujocoBody) -> dict[str, tuple[_Geom, ...]]:
    """Return what is drawn of a body; a mesh that cannot be drawn is logged and left out."""
    drawn: dict[str, list[_Geom]] = {}
    for link, each in body.model.links.items():
        for shape in each.visuals:
            color = body.color or _color(shape)
            if shape.kind != "mesh":
                drawn.setdefault(link, []).append(_geom(shape, color))
            elif Path(shape.file).is_file():
                try:
                    mesh = _surface(shape.file, file_status(shape.file), shape.sizes)
                except ValueError as fault:
                    what = "the description of %r: visual of link %r: MuJoCo does not draw %s: %s"
                    _log.warning(what, body.name, link, shape.file, fault)
                    continue
                drawn.setdefault(link, []).append(_Geom("mesh", (0, 0, 0), origin(shape.xyz, shape.rpy), color, mesh))
    return {link: tuple(each) for link, each in drawn.items()}


def _color(shape: Shape) -> Color:
    if shape.color is None:
        return _GREY
    red, green, blue, opacity = shape.color
    return red, green, blue, opacity


@lru_cache(maxsize=512)
def _hull(path: str, _status: FileStatus, scale: tuple[float, ...]) -> Mesh:
    """Return the convex hull of a mesh file's points; a flat one is made 1 mm thick. Raises `ValueError`."""
    points = mesh_points(path) * scale
    middle = points.mean(axis=0)
    _, _, axes = np.linalg.svd(points - middle, full_matrices=True)
    for axis in axes:
        along = (points - middle) @ axis
        if (lack := _THIN_M - float(np.ptp(along))) > 0:
            points = np.concatenate([points - axis * lack / 2, points + axis * lack / 2])
    return _compiled(path, points, np.zeros((0, 3), np.int32))


@lru_cache(maxsize=128)
def _surface(path: str, _status: FileStatus, scale: tuple[float, ...]) -> Mesh:
    """Return the triangles of a mesh file as they are. Raises `ValueError`."""
    mesh = read_mesh(path, Path(path).read_bytes())
    return _compiled(path, mesh.vertices * scale, mesh.faces)


def _compiled(path: str, vertices: Floats, faces: NDArray[Any]) -> Mesh:
    """Return the triangles that MuJoCo makes of a mesh; without faces, those of the hull. Raises `ValueError`."""
    mujoco = library()
    spec = mujoco.MjSpec()
    spec.compiler.usethread = False
    _add_mesh(spec, "mesh", vertices, faces)
    spec.worldbody.add_geom(type=mujoco.mjtGeom.mjGEOM_MESH, meshname="mesh", contype=0, conaffinity=0)
    try:
        model = spec.compile()
    except (ValueError, mujoco.FatalError) as error:
        reason = str(error).splitlines()[0].removeprefix("Error: ").replace("mesh 'mesh'", "it")
        raise ValueError(f"mesh {path}: MuJoCo cannot use it: {reason}") from error
    w, x, y, z = model.mesh_quat[0]
    points = model.mesh_vert.astype(np.float64) @ rotation_matrix((x, y, z, w)).T + model.mesh_pos[0]
    used, corners = np.unique(model.mesh_face, return_inverse=True)
    return Mesh(points[used], corners.reshape(-1, 3))


def _add_mesh(spec: Any, name: str, vertices: NDArray[Any], faces: NDArray[Any]) -> Any:
    mesh = spec.add_mesh(name=name, uservert=vertices.ravel().tolist(), userface=faces.ravel().tolist())
    mesh.inertia = library().mjtMeshInertia.mjMESH_INERTIA_SHELL  # the others refuse open surfaces
    return mesh


# === library ==================================================================================================


@cache
def library() -> Any:
    """Return the module of MuJoCo, imported at the first call. Raises `EngineMissing`."""
    if find_spec("mujoco") is None:
        raise poses.EngineMissing("mujoco")
    mujoco: Any = import_module("mujoco")
    if mujoco.get_mju_user_warning() is None:  # otherwise MuJoCo would write to a file in the current folder
        mujoco.set_mju_user_warning(partial(_log.warning, "MuJoCo: %s"))
    return mujoco
