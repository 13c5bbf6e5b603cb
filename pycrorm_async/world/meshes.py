"""Read mesh files: OBJ here, and STL, Collada (DAE), glTF (GLB), PLY and OFF with trimesh.

Vertices are in m and with the z axis up, as far as a file says otherwise; materials are left out. A file that cannot be
read raises `ValueError` with the reason.
"""

import io
import itertools
import math
import os
import re
import warnings
from functools import lru_cache
from pathlib import Path
from typing import Any, NamedTuple

import numpy as np
from numpy.typing import NDArray

_SUFFIXES = ("stl", "obj", "dae", "glb", "ply", "off")
_COMMENT = re.compile(rb"<!--.*?-->", re.DOTALL)
_UNIT = re.compile(rb"<unit\b[^>]*\bmeter\s*=\s*[\"']([^\"']*)")
_UP = re.compile(rb"<up_axis>\s*([XZ]_UP)")
_STL_HEADER, _STL_TRIANGLE = 84, 50


class Mesh(NamedTuple):
    """The vertices of a mesh, m, and for each triangle the indices of its three vertices."""

    vertices: NDArray[np.float64]
    faces: NDArray[np.int64]


def read_mesh(name: str, content: bytes) -> Mesh:
    """Return the triangles of a mesh file; the suffix of its name decides its format.

    Raises:
        ValueError: the file cannot be read, or has no triangle or a number that is not finite; or trimesh is not
            installed.
    """
    suffix = name.rpartition(".")[2].lower()
    if suffix not in _SUFFIXES:
        raise ValueError(f"the format {suffix!r} is not read")
    try:
        mesh = _read_obj(content) if suffix == "obj" else _read_scene(suffix, content)
        if not 0 <= mesh.faces.min() <= mesh.faces.max() < len(mesh.vertices):
            raise ValueError("a triangle has a vertex that does not exist")  # noqa: TRY301  a fault of the file
        if suffix == "dae":
            mesh = mesh._replace(vertices=_in_metres(mesh.vertices, _COMMENT.sub(b"", content)))
    except Exception as error:
        raise ValueError(f"it is not a readable {suffix} file: {error}") from error
    if not np.isfinite(mesh.vertices).all():
        raise ValueError("it has a number that is not finite")
    return mesh


def _read_obj(content: bytes) -> Mesh:
    """Return the polygons of an OBJ file as triangles; a negative index counts back from the vertices so far."""
    vertices: list[tuple[float, float, float]] = []
    faces: list[tuple[int, int, int]] = []
    for line in content.replace(b"\\\r\n", b" ").replace(b"\\\n", b" ").splitlines():
        kind, *words = line.partition(b"#")[0].split() or (b"",)
        if kind == b"v":
            x, y, z = map(float, words[:3])
            vertices.append((x, y, z))
        elif kind == b"f":
            numbers = [int(word.partition(b"/")[0]) for word in words]
            first, *others = (each + len(vertices) if each < 0 else each - 1 for each in numbers)
            faces += [(first, *pair) for pair in itertools.pairwise(others)]
    if not faces:
        raise ValueError("it has no triangles")
    return Mesh(np.array(vertices, dtype=np.float64).reshape(-1, 3), np.array(faces, dtype=np.int64))


def _read_scene(suffix: str, content: bytes) -> Mesh:
    """Return the triangles of all meshes of a file, each where the file places it."""
    load = _trimesh().load_scene
    with warnings.catch_warnings():  # the reader of DAE calls what the newest NumPy deprecates
        warnings.simplefilter("ignore", DeprecationWarning)
        scene = load(io.BytesIO(content), file_type=suffix, process=False)
    parts: list[NDArray[np.float64]] = []
    faces: list[NDArray[np.int64]] = []
    count = 0
    for node in scene.graph.nodes_geometry:
        matrix, geometry = scene.graph[node]
        part = scene.geometry[geometry]
        if getattr(part, "faces", None) is not None and len(part.faces):
            parts.append(np.asarray(part.vertices, dtype=np.float64) @ matrix[:3, :3].T + matrix[:3, 3])
            faces.append(np.asarray(part.faces, dtype=np.int64) + count)
            count += len(parts[-1])
    if not parts:
        raise ValueError("it has no triangles")
    return Mesh(np.concatenate(parts), np.concatenate(faces))


def _in_metres(vertices: NDArray[np.float64], content: bytes) -> NDArray[np.float64]:
    """Return the vertices of a Collada file, m, with the z axis up; the library leaves both out."""
    unit, up = _UNIT.search(content), _UP.search(content)
    metres = float(unit[1]) if unit else 1.0
    if not 0 < metres < math.inf:
        raise ValueError(f"its unit is {metres:g} m")
    x, y, z = vertices.T * metres
    axes = {b"Z_UP": (x, y, z), b"X_UP": (-y, -z, x)}.get(up[1] if up else b"", (x, -z, y))  # Y_UP is the default
    return np.stack(axes, axis=1)


def mesh_points(path: str) -> NDArray[np.float64]:
    """Return the vertices of a mesh file, each once; read again only when the file has changed.

    Raises `ValueError` with the path for a file that `read_mesh` refuses.
    """
    try:
        return _points(path, file_status(path))
    except (OSError, ValueError) as error:
        raise ValueError(f"mesh {path}: {error}") from error


FileStatus = tuple[int, int, int, int]


def file_status(path: str) -> FileStatus:
    """Return values that differ after a file has changed. Raises `OSError`."""
    status = os.stat(path)  # noqa: PTH116  a fifth of the time of Path.stat
    return status.st_ino, status.st_size, status.st_mtime_ns, status.st_ctime_ns


@lru_cache(maxsize=512)
def _points(path: str, _status: FileStatus) -> NDArray[np.float64]:
    mesh = read_mesh(path, Path(path).read_bytes())
    return np.unique(mesh.vertices[np.unique(mesh.faces)], axis=0)


def for_bullet(path: str, *, collision: bool) -> bytes | None:
    """Return a binary STL of a mesh file that Bullet cannot read right; None for a file that it can.

    It reads a binary STL, and an OBJ without continued lines and comments behind numbers. Bullet collides with the hull
    of the points. Its reader of Collada is not used, because it ends the process where a file differs from what it
    expects, as a damaged OBJ does.

    Raises `ValueError` with the path for a file that `read_mesh` refuses.
    """
    suffix = Path(path).suffix.lower()
    if suffix == ".stl" and _is_binary(path):
        return None
    points = mesh_points(path)
    if suffix == ".obj" and _MISREAD_OBJ.search(Path(path).read_bytes()) is None:
        return None
    if collision:
        padded = points[np.minimum(np.arange(-(-len(points) // 3) * 3), len(points) - 1)]
        return _stl(padded.reshape(-1, 3, 3))
    return _drawn(path, file_status(path))


_MISREAD_OBJ = re.compile(rb"\\\r?\n|^[ \t]*[vf][^\n]*#", re.MULTILINE)
"""Finds continued lines, and comments behind numbers."""


@lru_cache(maxsize=128)
def _drawn(path: str, _status: FileStatus) -> bytes:
    mesh = read_mesh(path, Path(path).read_bytes())
    return _stl(mesh.vertices[mesh.faces])


def _stl(corners: NDArray[np.float64]) -> bytes:
    """Return a binary STL of triangles, (n, 3, 3), whose normals have length one or, without an area, zero."""
    normals = np.cross(corners[:, 1] - corners[:, 0], corners[:, 2] - corners[:, 0])
    rows = np.zeros(len(corners), dtype=[("normal", "<f4", 3), ("corners", "<f4", (3, 3)), ("unused", "<u2")])
    rows["normal"] = normals / np.maximum(np.linalg.norm(normals, axis=1), 1e-300)[:, None]
    rows["corners"] = corners
    return bytes(80) + len(rows).to_bytes(4, "little") + rows.tobytes()


def _is_binary(path: str) -> bool:
    with Path(path).open("rb") as file:
        header = file.read(_STL_HEADER)
        count = int.from_bytes(header[80:], "little")
        return file.seek(0, os.SEEK_END) == _STL_HEADER + count * _STL_TRIANGLE


def _trimesh() -> Any:
    """Import the library when the first mesh is read. Raises `ValueError` with the command that installs it."""
    try:
        import trimesh
    except ImportError:
        raise ValueError("reading a mesh file needs trimesh: pip install 'pycrorm-async[world]'") from None
    return trimesh
