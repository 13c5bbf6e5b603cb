"""The triangles of mesh files: the same pyramid from every format, and a reason for every file that has none."""

import struct

import numpy as np
import pytest

from pycrorm_async.query import scene
from pycrorm_async.query.scene import triangles_of
from tests import mesh_files


@pytest.mark.parametrize(
    ("name", "content"),
    [
        ("a.stl", mesh_files.binary_stl()),
        ("a.STL", mesh_files.text_stl()),
        ("a.obj", mesh_files.obj()),
        ("a.dae", mesh_files.collada()),
        ("a.b.dae", mesh_files.collada(primitive="polylist")),
    ],
)
def test_every_format_has_the_same_triangles(name: str, content: bytes) -> None:
    triangles = triangles_of(name, content)
    corners = {tuple(each) for each in triangles.vertices.tolist()}
    assert corners == {tuple(map(float, each)) for each in mesh_files.CORNERS}
    numbers = {tuple(each): number for number, each in enumerate(map(tuple, np.array(mesh_files.CORNERS, float)))}
    drawn = {frozenset(numbers[tuple(triangles.vertices[each].tolist())] for each in face) for face in triangles.faces}
    assert drawn == {frozenset(each) for each in mesh_files.SIDES}


def test_a_collada_file_whose_y_axis_is_up_is_turned() -> None:
    upright = triangles_of("a.dae", mesh_files.collada(up="Y_UP")).vertices
    assert (upright.min(axis=0).tolist(), upright.max(axis=0).tolist()) == ([0, -1, 0], [1, 0, 1])


@pytest.mark.parametrize(
    ("name", "content", "reason"),
    [
        ("a.ply", b"", "the format 'ply' is not read"),
        ("mesh", b"", "the format 'mesh' is not read"),
        ("a.stl", b"", "its length does not fit"),
        ("a.stl", mesh_files.binary_stl()[:-1], "vertex|no triangles"),
        ("a.stl", b"solid x\nvertex a b c", "not a readable stl file"),
        ("a.stl", b"solid x\nvertex 1 1 1\nvertex 1 1 1", "not a readable stl|reshape"),
        ("a.stl", b" " * 80 + struct.pack("<I12fH", 1, *[float("nan")] * 12, 0), "not finite"),
        ("a.obj", b"v 1 2\nf 1 1 1", "not a readable obj file"),
        ("a.obj", b"v 1 2 3\nf 1 2 3", "not a readable obj file"),
        ("a.obj", b"v 1 2 3\n", "it has no triangles"),
        ("a.obj", b"\xff\xfe", "not a readable obj file"),
        ("a.dae", b"<COLLADA", "not a readable dae file"),
        ("a.dae", b"<COLLADA/>", "it has no triangles"),
        ("a.dae", mesh_files.collada().replace(b'url="#g"', b'url="#other"'), "not a readable dae file"),
        ("a.dae", mesh_files.collada().replace(b"VERTEX", b"OTHER"), "not a readable dae file"),
    ],
)
def test_a_file_without_triangles_has_a_reason(name: str, content: bytes, reason: str) -> None:
    with pytest.raises(ValueError, match=reason):
        triangles_of(name, content)


def test_a_file_with_too_many_triangles_is_refused(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(scene, "TRIANGLES_MAX", 5)
    with pytest.raises(ValueError, match="it has 6 triangles, more than 5"):
        triangles_of("a.obj", mesh_files.obj())
