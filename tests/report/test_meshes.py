"""Recorded mesh files in the page: drawn with their triangles, and where that fails as boxes, with the reason."""

from pathlib import Path

import pytest

from pycrorm_async.memory import Memory
from pycrorm_async.query.reading import Reading
from pycrorm_async.report import document as mesh_data
from pycrorm_async.report.document import episode_document
from pycrorm_async.settings import RecordMeshes, Settings
from pycrorm_async.world import BulletWorld, Object, ObjectType, Pose
from tests import mesh_files
from tests.report.browser import Browser
from tests.report.test_page import NO_WEBGL

pytestmark = pytest.mark.slow

LINK = """<link name="{0}">
<inertial><mass value="1"/><inertia ixx="1" ixy="0" ixz="0" iyy="1" iyz="0" izz="1"/></inertial>
<visual><geometry><mesh filename="{1}" scale="0.5 0.5 2"/></geometry></visual>
<collision><geometry><mesh filename="{1}" scale="0.5 0.5 2"/></geometry></collision></link>
"""
JOINT = '<joint name="{1}" type="fixed"><origin xyz="1 0 0"/><parent link="{0}"/><child link="{1}"/></joint>'
UPRIGHT = Pose([0, 0, 1])
FILES = {"stl": mesh_files.binary_stl(), "obj": mesh_files.obj(), "dae": mesh_files.collada()}


async def record(folder: Path, meshes: RecordMeshes = "files", pose: Pose = UPRIGHT) -> str:
    """Record an episode with one object that has a link for each format of mesh files; return the URL."""
    links = []
    for suffix, content in FILES.items():
        (folder / f"part.{suffix}").write_bytes(content)
        links.append(LINK.format(suffix, f"part.{suffix}"))
    joints = [JOINT.format("stl", "obj"), JOINT.format("obj", "dae")]
    urdf = folder / "parts.urdf"
    urdf.write_text(f'<robot name="parts">{"".join(links + joints)}</robot>')
    url = f"sqlite:///{folder / 'memory.db'}"
    async with Memory.open(url, settings=Settings(record_meshes=meshes)) as memory:
        async with memory.episode(description="meshes"):
            with BulletWorld():
                Object("parts", ObjectType.GENERIC_OBJECT, urdf, pose)
        await memory.flush()
    return url


@pytest.mark.soak
async def test_mesh_files_are_drawn_with_their_triangles(chrome: Browser, tmp_path: Path) -> None:
    async with Memory.open(await record(tmp_path)) as memory:
        page = (await memory.report(1, tmp_path / "page.html")).path
    part = "pycrormPage.bodies.of(pycrormPage.episode.objects[0]).links.get(link).children.at(-1)"
    box = f"""(link) => {{
      const drawn = new THREE.Box3().setFromObject({part}, true);
      return [...drawn.min.toArray(), ...drawn.max.toArray()].map((each) => Number(each.toFixed(3)));
    }}"""
    with chrome.open(page) as tab:
        boxes = {link: tab.ask(f"({box})('{link}')") for link in FILES}
        assert boxes == {
            "stl": [0, 0, 1, 0.5, 0.5, 3],
            "obj": [1, 0, 1, 1.5, 0.5, 3],
            "dae": [2, 0, 1, 2.5, 0.5, 3],
        }
        assert tab.ask(f"((link) => {part}.children[0].geometry.index.count)('stl')") == 18
        assert tab.ask("document.getElementById('notes').textContent") == ""
        assert tab.problems() == []


async def test_the_map_has_the_outlines_of_meshes(chrome: Browser, tmp_path: Path) -> None:
    lying = Pose([0, 0, 1], [0.5**0.5, 0, 0, 0.5**0.5])
    async with Memory.open(await record(tmp_path, pose=lying)) as memory:
        page = (await memory.report(1, tmp_path / "page.html")).path
    corners = """[...document.querySelectorAll('#map polygon')].map((each) =>
      each.getAttribute('points').split(' ').map((corner) => corner.split(',').map((number) => Number(number) + 0)))"""
    with chrome.open(page, script=NO_WEBGL) as tab:
        triangles = sorted(sorted({(x, y) for x, y in each}) for each in tab.ask(corners))
        assert triangles == [[(x, 0), (x + 0.25, 2), (x + 0.5, 0)] for x in (0, 1, 2)]
        # The bodies that a browser with WebGL draws are made without it as well, where the page opens faster.
        part = "pycrormPage.bodies.of(pycrormPage.episode.objects[0]).links.get('stl').children.at(-1)"
        assert tab.ask(f"{part}.children[0].geometry.index.count") == 18


async def test_a_page_lists_which_meshes_are_boxes_and_why(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(mesh_data, "_TRIANGLES_MAX", 7)
    async with Reading.open(await record(tmp_path)) as reading:
        document = await episode_document(reading, 1)
    model = document["models"][document["objects"][0]["model"]]
    reason = "the page has too many triangles already"
    assert model["boxes"] == f"2 mesh files: part.obj ({reason}), part.dae ({reason})"
    assert [model["shapes"][link][0][0] for link in ("stl", "obj")] == ["mesh", "box"]
    assert len(model["meshes"]) == 1


async def test_meshes_that_are_not_recorded_are_boxes(tmp_path: Path) -> None:
    async with Reading.open(await record(tmp_path, "boxes")) as reading:
        document = await episode_document(reading, 1)
    model = document["models"][document["objects"][0]["model"]]
    assert (model["meshes"], model["boxes"][:41]) == ({}, "3 mesh files: part.stl (its content was n")
    assert [model["shapes"][link][0][0] for link in ("stl", "obj")] == ["box", "box"]
