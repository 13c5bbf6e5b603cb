"""Read the triangles of mesh files: STL, OBJ and Collada (DAE), each as far as robots' descriptions use it.

Materials and normals are left out: a drawing has the colour of the description and flat faces. A file that cannot be
read raises `ValueError`; a drawing then has the box around its link instead.
"""

from __future__ import annotations

import re
from collections.abc import Callable, Iterator, Mapping, Sequence
from itertools import pairwise
from pathlib import Path
from typing import Any, NamedTuple
from xml.etree.ElementTree import Element, ParseError, fromstring

import numpy as np
import numpy.typing as npt

TRIANGLES_MAX = 50_000
"""Bounds the triangles of a file: a drawing of a few hundred pixels shows no more."""
_FILE_BYTES_MAX = 2**26
"""Bounds the bytes of a file that is read for the box around it, ten times a detailed part of a robot."""
_STL_HEADER, _STL_TRIANGLE = 84, 50
_VERTEX = re.compile(rb"vertex\s+(\S+)\s+(\S+)\s+(\S+)")
_DECIMALS = 5
"""Rounds vertices to 0.01 mm, so that those of neighbouring triangles are one."""

Points = npt.NDArray[np.float64]


class Triangles(NamedTuple):
    """The vertices of a mesh, m, and for each triangle the indices of its three vertices."""

    vertices: npt.NDArray[np.float32]
    faces: npt.NDArray[np.uint32]


def triangles_of(name: str, content: bytes) -> Triangles:
    """Return the triangles of a mesh file; the suffix of its name decides its format. Raises `ValueError`."""
    corners = _corners_of(name, content)
    if len(corners) > 3 * TRIANGLES_MAX:
        raise ValueError(f"it has {len(corners) // 3:,} triangles, more than {TRIANGLES_MAX:,}")
    vertices, faces = np.unique(corners.round(_DECIMALS), axis=0, return_inverse=True)
    return Triangles(vertices.astype(np.float32), faces.reshape(-1, 3).astype(np.uint32))


def mesh_points(file: Path) -> Points:
    """Return the corners of the triangles of a mesh file, m. Raises `ValueError` and `OSError`."""
    if (size := file.stat().st_size) > _FILE_BYTES_MAX:
        raise ValueError(f"it takes {size:,} bytes, {_FILE_BYTES_MAX:,} are read")
    return _corners_of(file.name, file.read_bytes())


def _corners_of(name: str, content: bytes) -> Points:
    suffix = name.rpartition(".")[2].lower()
    read = _FORMATS.get(suffix)
    if read is None:
        raise ValueError(f"the format {suffix!r} is not read")
    try:
        corners = np.asarray(read(content), dtype=np.float64).reshape(-1, 3, 3).reshape(-1, 3)
    except (ValueError, IndexError, KeyError, ParseError, UnicodeDecodeError) as error:
        raise ValueError(f"it is not a readable {suffix} file: {error}") from error
    if len(corners) == 0:
        raise ValueError("it has no triangles")
    if not np.isfinite(corners).all():
        raise ValueError("it has a number that is not finite")
    return corners


def _stl(content: bytes) -> Points:
    """Return three corners for each triangle of a binary or a text STL."""
    count = int.from_bytes(content[80:_STL_HEADER], "little")
    if len(content) >= _STL_HEADER and len(content) == _STL_HEADER + count * _STL_TRIANGLE:
        rows = np.frombuffer(content, np.uint8, offset=_STL_HEADER).reshape(count, _STL_TRIANGLE)
        return rows[:, 12:48].copy().view("<f4").astype(np.float64)
    if not content.lstrip().startswith(b"solid"):
        raise ValueError("its length does not fit its number of triangles")
    return np.array(_VERTEX.findall(content), dtype=np.float64)


def _obj(content: bytes) -> Points:
    vertices: list[list[float]] = []
    corners: list[int] = []
    for line in content.decode().splitlines():
        words = line.split()
        if words[:1] == ["v"]:
            vertices.append([float(each) for each in words[1:4]])
        elif words[:1] == ["f"]:
            indices = [int(each.partition("/")[0]) for each in words[1:]]
            corners += _fan([each - 1 if each > 0 else len(vertices) + each for each in indices])
    return np.array(vertices, dtype=np.float64).reshape(-1, 3)[corners]


def _fan(polygon: Sequence[int]) -> Iterator[int]:
    """Divide a polygon into triangles that share its first corner."""
    for second, third in pairwise(polygon[1:]):
        yield from (polygon[0], second, third)


# --- Collada ---------------------------------------------------------------------------------------------------


def _collada(content: bytes) -> Points:
    """Return the geometries of a Collada file where its scene places them, in m and with the z axis up."""
    root = fromstring(content)  # noqa: S314  a memory has recorded it
    for each in root.iter():
        each.tag = each.tag.rpartition("}")[2]
    geometries = {f"#{each.get('id')}": each for each in root.iter("geometry")}
    placed = [
        _placed(corners, matrix)
        for scene in root.iter("visual_scene")
        for node in scene.findall("node")
        for corners, matrix in _instances(node, np.eye(4), geometries)
    ]
    if not placed:
        return np.empty((0, 3))
    corners = np.concatenate(placed)
    unit = root.find("asset/unit")
    corners *= 1.0 if unit is None else float(unit.get("meter", "1"))
    if root.findtext("asset/up_axis", "Y_UP").strip() == "Y_UP":
        corners = np.stack([corners[:, 0], -corners[:, 2], corners[:, 1]], axis=1)
    return corners


def _placed(corners: Points, matrix: Points) -> Points:
    return corners @ matrix[:3, :3].T + matrix[:3, 3]


def _instances(node: Element, above: Points, geometries: Mapping[str, Element]) -> Iterator[tuple[Points, Points]]:
    matrix = above
    for each in node:
        if each.tag in _TRANSFORMS:
            matrix = matrix @ _TRANSFORMS[each.tag](_floats(each))
    for each in node.findall("instance_geometry"):
        mesh = geometries[each.get("url", "")].find("mesh")
        if mesh is not None:
            yield _corners(mesh), matrix
    for each in node.findall("node"):
        yield from _instances(each, matrix, geometries)


def _corners(mesh: Element) -> Points:
    arrays = {f"#{each.get('id')}": _positions(each) for each in mesh.findall("source")}
    vertices = {
        f"#{each.get('id')}": arrays[position.get("source", "")]
        for each in mesh.findall("vertices")
        for position in each.findall("input")
        if position.get("semantic") == "POSITION"
    }
    parts = [_primitive(each, vertices) for kind in ("triangles", "polylist") for each in mesh.findall(kind)]
    return np.concatenate(parts) if parts else np.empty((0, 3))


def _positions(source: Element) -> Points:
    accessor, array = source.find("technique_common/accessor"), source.find("float_array")
    stride = int(accessor.get("stride", "3")) if accessor is not None else 3
    return _floats(array).reshape(-1, stride)[:, :3] if array is not None else np.empty((0, 3))


def _primitive(primitive: Element, vertices: Mapping[str, Points]) -> Points:
    inputs = primitive.findall("input")
    stride = 1 + max(int(each.get("offset", "0")) for each in inputs)
    [vertex] = [each for each in inputs if each.get("semantic") == "VERTEX"]
    indices = np.array(primitive.findtext("p", "").split(), dtype=np.int64).reshape(-1, stride)
    corners = indices[:, int(vertex.get("offset", "0"))]
    if primitive.tag == "polylist":
        ends = np.cumsum(np.array(primitive.findtext("vcount", "").split(), dtype=np.int64))
        polygons = np.split(corners, ends[:-1])
        corners = np.array([index for each in polygons for index in _fan(each.tolist())], dtype=np.int64)
    return vertices[vertex.get("source", "")][corners]


def _floats(element: Element) -> Points:
    return np.array((element.text or "").split(), dtype=np.float64)


def _translation(values: Points) -> Points:
    matrix = np.eye(4)
    matrix[:3, 3] = values
    return matrix


def _rotation(values: Points) -> Points:
    """Return the matrix of an axis and an angle in degrees (Rodrigues' formula)."""
    x, y, z = values[:3] / np.linalg.norm(values[:3])
    angle = np.radians(values[3])
    cross = np.array([[0, -z, y], [z, 0, -x], [-y, x, 0]])
    matrix = np.eye(4)
    matrix[:3, :3] += np.sin(angle) * cross + (1 - np.cos(angle)) * (cross @ cross)
    return matrix


_TRANSFORMS: Mapping[str, Callable[[Points], Points]] = {
    "matrix": lambda values: values.reshape(4, 4),
    "translate": _translation,
    "rotate": _rotation,
    "scale": lambda values: np.diag([*values, 1.0]),
}
_FORMATS: Mapping[str, Callable[[bytes], Any]] = {"stl": _stl, "obj": _obj, "dae": _collada}
