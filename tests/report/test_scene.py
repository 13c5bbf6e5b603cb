"""The scene of the page: framed closely, recorded meshes, objects chosen by a click, a camera that follows."""

from pathlib import Path

import pytest

from pycrorm_async.memory import Memory
from pycrorm_async.query.reading import Reading
from pycrorm_async.report import document as mesh_data
from pycrorm_async.report.document import episode_document
from pycrorm_async.settings import RecordMeshes, Settings
from pycrorm_async.world import BulletWorld, Object, ObjectType, Pose
from tests import mesh_files
from tests.report.browser import Browser, Tab
from tests.report.conftest import page_of
from tests.report.test_page import NO_WEBGL, assert_quiet, position, record_pick_ups

pytestmark = pytest.mark.slow


# === scene ====================================================================================================
#
# The scene of the page: framed closely, objects chosen by a click, a camera that follows the robot, named paths.


def test_an_object_is_chosen_by_a_click_in_the_scene_or_in_the_list(chrome: Browser, pages: dict[str, Path]) -> None:
    with chrome.open(pages["plan"], fragment="#e60") as tab:
        place = """(() => {
          const { camera } = pycrormPage.view.camera;
          const { width, height, left, top } = document.querySelector("canvas").getBoundingClientRect();
          const cereal = pycrormPage.bodies.of(pycrormPage.episode.objects[3]).group;
          const at = new THREE.Box3().setFromObject(cereal).getCenter(new THREE.Vector3()).project(camera);
          return [left + (at.x + 1) / 2 * width, top + (1 - at.y) / 2 * height];
        })()"""
        tab.settle()
        x, y = tab.ask(place)
        tab.call("Input.dispatchMouseEvent", type="mouseMoved", x=x, y=y)
        tab.wait_for("document.querySelector('.hint').textContent === 'cereal BREAKFAST_CEREAL'")
        for kind in ("mousePressed", "mouseReleased"):
            tab.call("Input.dispatchMouseEvent", type=kind, x=x, y=y, button="left", clickCount=1)
        assert tab.ask("pycrormPage.object.name") == "cereal"
        chosen = "[...document.querySelectorAll('.panel tr.lit td')].map((each) => each.textContent)"
        assert tab.ask(chosen) == ["cereal", "BREAKFAST_CEREAL", "1.300", "0.700", "0.950", "0", ""]
        tab.ask("[...document.querySelectorAll('.panel button')].find((each) => each.textContent === 'milk').click()")
        assert tab.ask(chosen) == ["milk", "MILK", "1.300", "1.000", "0.900", "0", "pr2, left arm"]
        tab.press("Escape")
        assert tab.ask(chosen) == []
        assert_quiet(tab, pages["plan"])


def test_the_camera_follows_the_robot_and_shows_the_whole_scene_again(chrome: Browser, pages: dict[str, Path]) -> None:
    aim = "pycrormPage.view.camera.controls.target.toArray().map((each) => Number(each.toFixed(3)))"
    with chrome.open(pages["plan"], fragment="#e10") as tab:
        tab.settle()
        whole = tab.ask(aim)
        tab.press("r")
        pressed = "[...document.querySelectorAll('#views [aria-pressed=true]')].map((each) => each.textContent)"
        assert "follow pr2" in tab.ask(pressed)
        x, y, _ = tab.ask(aim)
        tab.ask("pycrormPage.seek(60)")
        (u, v, _), robot = tab.ask(aim), position(tab, "pr2")
        assert abs(u - robot[0]) < abs(x - robot[0]) + 0.5
        assert [round(u - x, 2), round(v - y, 2)] == [robot[0], robot[1]]  # it stood at the origin
        tab.press("w")
        assert "follow pr2" not in tab.ask(pressed)
        moment = tab.ask(aim)
        assert moment not in (whole, [u, v, 0])  # less than all places of the episode
        tab.ask("pycrormPage.seek(pycrormPage.episode.opens)")
        tab.press("w")
        assert tab.ask(aim) != moment


EXTENT = """(() => {
  const ends = [];
  for (const { group, object } of pycrormPage.view.present) group.traverse((each) => {
    if (!each.isMesh || object.type === SKIPPED) return;
    const { position } = each.geometry.attributes;
    for (let at = 0; at < position.count; at++)
      ends.push(new THREE.Vector3().fromBufferAttribute(position, at).applyMatrix4(each.matrixWorld));
  });
  for (const each of ends) each.project(pycrormPage.view.camera.camera);
  return ends.reduce((most, { x, y }) => Math.max(most, Math.abs(x), Math.abs(y)), 0);
})()"""
"""The largest distance of anything drawn from the middle of the picture; 1 is at an edge."""


def farthest_over(tab: Tab, moments: int) -> list[float]:
    """Return how far from the middle anything but an environment is drawn, at moments all over the episode."""
    script = f"""(() => {{
      const {{ first, opens }} = pycrormPage.episode;
      return Array.from({{ length: {moments} }}, (_, index) => {{
        pycrormPage.seek(first + ((opens - first) * index) / {moments - 1});
        return {EXTENT.replace("SKIPPED", "'ENVIRONMENT'")};
      }});
    }})()"""
    return list(tab.ask(script))


def test_everything_is_in_sight_and_as_large_as_that_allows(chrome: Browser, pages: dict[str, Path]) -> None:
    with chrome.open(pages["plan"]) as tab:
        tab.settle()
        assert 0.7 < tab.ask(EXTENT.replace("SKIPPED", "''")) < 1
        assert 0.6 < max(farthest_over(tab, 20)) < 1
        tab.ask("pycrormPage.seek(60)")
        tab.press("w")
        assert 0.7 < tab.ask(EXTENT.replace("SKIPPED", "''")) < 1


async def test_bodies_are_in_sight_at_every_moment_also_of_a_long_way(
    chrome: Browser, pages: dict[str, Path], tmp_path: Path
) -> None:
    url = f"sqlite:///{tmp_path / 'memory.db'}"
    record_pick_ups(url, 60)
    await page_of(url, tmp_path / "page.html")
    for page in (pages["drives"], tmp_path / "page.html"):
        with chrome.open(page) as tab:
            tab.settle()
            assert max(farthest_over(tab, 30)) < 1


async def test_an_object_far_from_all_else_makes_the_scene_no_smaller(chrome: Browser, tmp_path: Path) -> None:
    url = f"sqlite:///{tmp_path / 'memory.db'}"
    with Memory.sync(url) as memory:
        with memory.recording.episode(description="far") as episode:
            episode.object_added("base", "pr2", "ROBOT", Pose([0, 0, 0]))
            for name, place in (("milk", 1.0), ("lost", 1e4)):
                episode.object_added(name, name, "MILK", Pose([place, 0, 0.5]))
            for place in (1.0, 2.0, 300.0, 2.5):
                episode.object_moved("base", Pose([place, 0, 0]))
        memory.flush()
    await page_of(url, tmp_path / "page.html")
    robot = EXTENT.replace("SKIPPED", "'MILK'")
    reach = "pycrormPage.view.reach"
    with chrome.open(tmp_path / "page.html") as tab:
        tab.settle()
        assert tab.ask(reach) < 3
        tab.ask("pycrormPage.seek(pycrormPage.episode.objects[0].poses.at[3])")
        assert tab.ask(robot) < 1  # it left, so that the camera went there
        tab.ask("pycrormPage.seek(pycrormPage.episode.objects[0].poses.at[4])")
        assert tab.ask(robot) < 1
        assert tab.ask(reach) < 3
        tab.ask("pycrormPage.view.camera.touched = true")
        tab.ask("pycrormPage.seek(pycrormPage.episode.objects[0].poses.at[3])")
        assert tab.ask(robot) > 1  # the camera is the user's


def test_the_paths_in_the_scene_are_named(chrome: Browser, pages: dict[str, Path]) -> None:
    with chrome.open(pages["plan"]) as tab:
        named = "[...document.querySelectorAll('#legend > span')].map((each) => each.textContent)"
        assert tab.ask(named) == [" path of pr2", " path of milk", "during TransportAction", "grid 1 m"]
        dashes = "[...document.querySelectorAll('#legend line')].map((each) => each.getAttribute('stroke-dasharray'))"
        assert tab.ask(dashes) == ["none", "7.5 5"]
        points = "pycrormPage.view.pathList.map((each) => each.points.length)"
        rods = "pycrormPage.view.paths.children.map((each) => each.geometry.index.count / 24)"
        (solid, dashed), (drawn, dashes) = tab.ask(points), tab.ask(rods)
        assert drawn == solid - 1
        assert dashes > dashed


@pytest.mark.parametrize("script", ["", NO_WEBGL])
async def test_of_many_objects_as_many_are_named_as_can_be_read(chrome: Browser, tmp_path: Path, script: str) -> None:
    with Memory.sync(f"sqlite:///{tmp_path / 'memory.db'}") as memory:
        with memory.recording.episode(description="many") as episode:
            for number in range(300):
                episode.object_added(f"{number}", f"bowl {number}", "BOWL", Pose([number % 5, number % 7, 0.5]))
            episode.object_added("base", "turtle", "ROBOT", Pose([0, 0, 0]))
        memory.flush()
    await page_of(f"sqlite:///{tmp_path / 'memory.db'}", tmp_path / "page.html")
    with chrome.open(tmp_path / "page.html", script=script) as tab:
        tab.settle()
        shown = "[...document.querySelectorAll('.names span, #map text')].map((each) => each.textContent)"
        names = tab.ask(shown)
        assert len(names) == 60
        assert "turtle" in names
        assert tab.ask("[...document.querySelectorAll('#notes p')].map((each) => each.textContent)") == [
            "bowl 0, bowl 1 and 298 others: drawn as the built-in shape, because its description was not recorded",
            "turtle: drawn as a body with its heading, because its description was not recorded",
        ]
        assert tab.problems() == []


# === meshes ===================================================================================================
#
# Recorded mesh files in the page: drawn with their triangles, and where that fails as boxes, with the reason.

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
    page = (await page_of(await record(tmp_path), tmp_path / "page.html")).path
    part = "pycrormPage.bodies.of(pycrormPage.episode.objects[0]).links.get(link).children.at(-1)"
    box = f"""(link) => {{
      const drawn = new THREE.Box3().setFromObject({part}, true);
      return [...drawn.min.toArray(), ...drawn.max.toArray()].map((each) => Number(each.toFixed(3)));
    }}"""
    with chrome.open(page) as tab:
        boxes = {link: tab.ask(f"({box})('{link}')") for link in FILES}
        assert boxes == {"stl": [0, 0, 1, 0.5, 0.5, 3], "obj": [1, 0, 1, 1.5, 0.5, 3], "dae": [2, 0, 1, 2.5, 0.5, 3]}
        assert tab.ask(f"((link) => {part}.children[0].geometry.index.count)('stl')") == 18
        assert tab.ask("document.getElementById('notes').textContent") == ""
        assert tab.problems() == []


async def test_the_map_has_the_outlines_of_meshes(chrome: Browser, tmp_path: Path) -> None:
    lying = Pose([0, 0, 1], [0.5**0.5, 0, 0, 0.5**0.5])
    page = (await page_of(await record(tmp_path, pose=lying), tmp_path / "page.html")).path
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
    reason = "there are too many triangles already"
    assert model["boxes"] == f"2 mesh files: part.obj ({reason}), part.dae ({reason})"
    assert [model["shapes"][link][0][0] for link in ("stl", "obj")] == ["mesh", "box"]
    assert len(model["meshes"]) == 1
    (tmp_path / "memory.db").unlink()
    async with Reading.open(await record(tmp_path, "boxes")) as reading:
        [model] = [each for each in (await episode_document(reading, 1))["models"].values() if each.get("boxes")]
    assert (model["meshes"], model["boxes"][:41]) == ({}, "3 mesh files: part.stl (its content was n")
