"""Pictures of a scene are made from recorded shapes and the triangles of mesh files, and frame what moves."""

from __future__ import annotations

import asyncio
import io
import json
import struct
from pathlib import Path
from typing import Any, Literal

import numpy as np
import pytest
from matplotlib import image
from numpy.typing import NDArray
from typer.testing import CliRunner

from pycrorm_async import Memory
from pycrorm_async.cli.main import app
from pycrorm_async.errors import CallerError, UnknownEpisode
from pycrorm_async.plan import NavigateAction, simulated_robot
from pycrorm_async.query import scene
from pycrorm_async.query.scene import triangles_of
from pycrorm_async.settings import Settings
from pycrorm_async.world import BulletWorld, Object, ObjectType, Pose
from pycrorm_async.world.models import box_urdf
from tests import mesh_files
from tests.databases import put_memory

# === picture ==================================================================================================
#
# Pictures of a scene are made from recorded shapes, frame what moves, and are not recorded themselves.

RED = (0.9, 0.1, 0.1, 1.0)
CUBE = box_urdf("cube", x=(-0.2, 0.2), y=(-0.2, 0.2), z=(0, 0.4))


async def record(url: str) -> None:
    async with Memory.open(url) as memory:
        async with memory.episode(description="Push the cube"):
            with BulletWorld() as world, simulated_robot:
                Object("courier", ObjectType.ROBOT)
                cube = Object("cube", ObjectType.GENERIC_OBJECT, CUBE, Pose([3, 0, 0]), color=RED)
                Object("far away", ObjectType.GENERIC_OBJECT, CUBE, Pose([30, 30, 0]))  # it never moves
                memory.observe("before", 1)
                await NavigateAction([Pose([1, 0.5, 0])]).resolve().perform()
                cube.set_pose(Pose([3, 1, 0]))
                assert world.entered
        async with memory.episode(description="Nothing there"):
            memory.observe("alone", 1)
        with memory.recording.episode(description="Another executive") as episode:
            episode.object_added("base", "turtle", "ROBOT", Pose([0, 0, 0]))
        await memory.flush()


@pytest.fixture(scope="module")
def url(tmp_path_factory: pytest.TempPathFactory) -> str:
    address = f"sqlite:///{tmp_path_factory.mktemp('pictures')}/memory.db"
    asyncio.run(record(address))
    return address


def pixels(png: bytes) -> NDArray[np.float64]:
    assert struct.unpack(">II", png[16:24]) == image.imread(io.BytesIO(png)).shape[1::-1]
    return image.imread(io.BytesIO(png))[:, :, :3]


def redness(png: bytes) -> float:
    """Return the share of red pixels."""
    colors = pixels(png)
    return float(((colors[..., 0] > 0.3) & (colors[..., 0] > 3 * colors[..., 1])).mean())


@pytest.mark.slow
async def test_a_picture_frames_what_moves_and_a_focus_one_object(url: str) -> None:
    memory = await Memory.connect(url)
    try:
        default = await memory.picture("1")
        assert pixels(default).shape == (480, 640, 3)
        assert redness(default) > 0.005
        assert redness(await memory.picture(1, focus="cube", width=160, height=120)) > 0.1
        assert redness(await memory.picture(1, focus="courier", yaw_deg=180, pitch_deg=5, width=90, height=120)) < 0.05
        small: dict[str, Any] = {"width": 64, "height": 48, "yaw_deg": 0.0}
        same = [await memory.picture(1, at=when, **small) for when in ("e7", "e7")]
        assert same[0] == same[1]
        async with memory.episode(description="Looking"):
            await memory.picture(1, **small)
        await memory.flush()
        assert (await memory.as_of("last", sequence=99)).sequence == 4  # starts and ends of the episode and its root
    finally:
        await memory.close()


@pytest.mark.slow
def test_a_scene_of_another_executive_is_drawn_whatever_its_names_types_and_joints_are(tmp_path: Path) -> None:
    hostile = "a\x01\x1b[31m\u202e<b>\n" + "n" * 300
    with Memory.sync(put_memory(tmp_path / "memory.db")) as memory:
        with memory.recording.episode(description="foreign") as episode:
            episode.object_added("robot", hostile, "ROBOT", Pose([0, 3, 0]), {hostile: 0.5}, base_link=hostile)
            episode.object_added("cube", hostile, "LEMONADE", Pose([0, 0, 0]), {"wheel": 0.5}, urdf=CUBE, color=RED)
            episode.object_moved("cube", Pose([0, 1, 0]))
            episode.object_attached("robot", "cube", hostile)
        memory.flush()
        assert redness(memory.picture("last", focus=hostile, width=160, height=120)) > 0.1


PYRAMID = """<robot name="pyramid"><link name="base">
<visual><geometry><mesh filename="pyramid.obj"/></geometry></visual>
<collision><geometry><mesh filename="pyramid.obj"/></geometry></collision></link></robot>"""
CORNERS = "v -1 -1 0\nv 1 -1 0\nv 1 1 0\nv -1 1 0\nv 0 0 2\n"
FACES = "f 1 3 2\nf 1 4 3\nf 1 2 5\nf 2 3 5\nf 3 4 5\nf 4 1 5\n"


@pytest.mark.slow
@pytest.mark.parametrize("meshes", ["boxes", "files"])
async def test_a_mesh_is_drawn_where_its_file_is_recorded_and_as_its_box_elsewhere(
    tmp_path: Path, meshes: Literal["boxes", "files"]
) -> None:
    (tmp_path / "pyramid.urdf").write_text(PYRAMID)
    (tmp_path / "pyramid.obj").write_text(CORNERS + FACES)
    async with Memory.open("sqlite://", settings=Settings(record_meshes=meshes)) as memory:
        async with memory.episode(description="A pyramid"):
            with BulletWorld():
                Object("pyramid", ObjectType.GENERIC_OBJECT, tmp_path / "pyramid.urdf", color=RED)
        await memory.flush()
        share = redness(await memory.picture("last", width=160, height=120, yaw_deg=0.0))
    assert (0.1 < share < 0.2) if meshes == "files" else (0.25 < share < 0.4), share


@pytest.mark.slow
@pytest.mark.parametrize(
    ("episode", "options", "message"),
    [
        ("2", {}, "episode 2 has no objects to draw: no world was recorded"),
        ("1", {"at": "e1"}, "episode 1 was empty at event 1, so nothing is drawn; its first object was added at event"),
        ("3", {"at": "e3"}, "episode 3 has no shapes to draw: of turtle, its description was not recorded"),
        ("1", {"focus": "milk"}, "had no object 'milk' at this moment; its objects: courier, cube, far away"),
        ("1", {"at": "noon"}, "at takes seconds since the episode's start, or an event such as e300, got 'noon'"),
        ("1", {"width": 3}, "at least 16 x 16 and at most 4,000,000 pixels, not 3 x 480"),
        ("1", {"pitch_deg": 90.0}, "pitch_deg must be -89 to 89, got 90"),
        ("1", {"yaw_deg": float("nan")}, "yaw_deg must be a finite number, got nan"),
    ],
)
async def test_what_cannot_be_drawn_is_one_line(
    url: str, episode: str, options: dict[str, object], message: str
) -> None:
    async with Memory.open(url) as memory:
        with pytest.raises(CallerError, match=message):
            await memory.picture(episode, **options)  # type: ignore[arg-type]
        with pytest.raises(UnknownEpisode):
            await memory.picture("9")


@pytest.mark.slow
def test_the_command_writes_a_file_and_replaces_none(url: str, tmp_path: Path) -> None:
    out = tmp_path / "scene.png"
    command = ["picture", "1", "--url", url, "--size", "64x48", "--out", str(out)]
    done = CliRunner().invoke(app(), [*command, "--json"])
    assert done.exit_code == 0, done.output
    assert json.loads(done.stdout) == {"file": str(out), "bytes": out.stat().st_size, "width": 64, "height": 48}
    assert pixels(out.read_bytes()).shape == (48, 64, 3)
    refused = CliRunner().invoke(app(), command)
    assert refused.exit_code == 2
    assert "exists: add --force" in refused.stderr
    before_drawing = CliRunner().invoke(app(), [*command, "--at", "e1"])
    assert "exists: add --force" in before_drawing.stderr, "the moment, which has nothing to draw, is refused later"
    assert CliRunner().invoke(app(), [*command, "--force"]).exit_code == 0
    wrong = CliRunner().invoke(app(), [*command[:-1], str(tmp_path / "other.png"), "--at", "noon"])
    assert (wrong.exit_code, "--at takes seconds" in wrong.stderr) == (2, True)
    assert [each.name for each in tmp_path.iterdir()] == ["scene.png"]


# === mesh triangles ===========================================================================================
#
# The triangles of mesh files: the same pyramid from every format, and a reason for every file that has none.


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
        ("a.ply", b"", "not a readable ply file"),
        ("a.3ds", b"", "the format '3ds' is not read"),
        ("a.stl", b"", "it has no triangles"),
        ("a.stl", mesh_files.binary_stl()[:-1], "vertex|no triangles"),
        ("a.stl", b"solid x\nvertex a b c", "not a readable stl file"),
        ("a.stl", b" " * 80 + struct.pack("<I12fH", 1, *[float("nan")] * 12, 0), "not finite"),
        ("a.obj", b"v 1 2 3\nf 1 2 3", "not a readable obj file"),
        ("a.obj", b"v 1 2 3\n", "it has no triangles"),
        ("a.dae", b"<COLLADA", "not a readable dae file"),
        ("a.dae", mesh_files.collada().replace(b'url="#g"', b'url="#other"'), "not a readable dae file"),
    ],
)
def test_a_file_without_triangles_has_a_reason(name: str, content: bytes, reason: str) -> None:
    with pytest.raises(ValueError, match=reason):
        triangles_of(name, content)


def test_a_file_with_too_many_triangles_is_refused(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(scene, "TRIANGLES_MAX", 5)
    with pytest.raises(ValueError, match="it has 6 triangles, more than 5"):
        triangles_of("a.obj", mesh_files.obj())
