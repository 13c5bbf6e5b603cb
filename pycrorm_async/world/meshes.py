"""Read mesh files with trimesh: STL, OBJ, Collada (DAE), glTF (GLB), PLY and OFF.

Vertices are in m and with the z axis up, as far as a file says otherwise; materials are left out. A file that cannot be
read raises `ValueError` with the reason.
"""

import io
import os
import re
import warnings
from contextlib import suppress
from functools import lru_cache
from pathlib import Path
from typing import Any, NamedTuple

import numpy as np
from numpy.typing import NDArray

_SUFFIXES = ("stl", "obj", "dae", "glb", "ply", "off")
_UNIT = re.compile(rb"<unit\b[^>]*\bmeter\s*=\s*[\"']\s*([0-9.eE+-]+)")
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
    load = _trimesh().load_scene
    try:
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
            raise ValueError("it has no triangles")  # noqa: TRY301  a fault of the file like those of the library
        mesh = Mesh(np.concatenate(parts), np.concatenate(faces))
        if not 0 <= mesh.faces.min() <= mesh.faces.max() < count:
            raise ValueError("a triangle has a vertex that does not exist")  # noqa: TRY301  as above
    except Exception as error:
        raise ValueError(f"it is not a readable {suffix} file: {error}") from error
    if not np.isfinite(mesh.vertices).all():
        raise ValueError("it has a number that is not finite")
    return mesh._replace(vertices=_in_metres(mesh.vertices, content)) if suffix == "dae" else mesh


def _in_metres(vertices: NDArray[np.float64], content: bytes) -> NDArray[np.float64]:
    """Return the vertices of a Collada file, m, with the z axis up; the library leaves both out."""
    unit = _UNIT.search(content)
    vertices = vertices * (float(unit[1]) if unit else 1.0)
    if b"Z_UP" not in content and b"X_UP" not in content:  # Y_UP is the default
        vertices = np.stack([vertices[:, 0], -vertices[:, 2], vertices[:, 1]], axis=1)
    return vertices


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


def is_read_by_bullet(path: str, *, collision: bool) -> bool:
    """Return whether Bullet reads the triangles of a mesh file right: of OBJ, of binary STL and, to draw them, DAE.

    A damaged OBJ or DAE would end the process inside Bullet.
    """
    suffix = Path(path).suffix.lower()
    if not Path(path).is_file():
        return False
    if suffix == ".obj" or (suffix == ".dae" and not collision):
        with suppress(ValueError):
            return bool(len(mesh_points(path)))
    return suffix == ".stl" and _is_binary(path)


def points_as_stl(points: NDArray[np.float64]) -> bytes:
    """Return a binary STL whose triangles have these points as corners; Bullet collides with their convex hull."""
    padded = points[np.minimum(np.arange(-(-len(points) // 3) * 3), len(points) - 1)]
    rows = np.zeros(len(padded) // 3, dtype=[("normal", "<f4", 3), ("corners", "<f4", (3, 3)), ("unused", "<u2")])
    rows["corners"] = padded.reshape(-1, 3, 3)
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
