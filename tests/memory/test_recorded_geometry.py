"""An episode holds all that is needed to see it again: a fresh process makes its world without the robot's files."""

from __future__ import annotations

import json
import shutil
import signal
from collections.abc import Callable
from importlib.metadata import distribution
from pathlib import Path

import pytest

from pycrorm_async import Memory, Reading, world_of
from pycrorm_async.operations.rebuild import rebuild_memory
from pycrorm_async.operations.recovery import recover
from pycrorm_async.query.again import RecordedWorld
from pycrorm_async.settings import Settings
from pycrorm_async.world import BulletWorld, Object, ObjectType, copied
from pycrorm_async.world.urdf import PR2
from tests.commands import run_script
from tests.golden.unpacking import unpack_memory_v1
from tests.memory.recorded_arm import AT, RED, made_arm, recorded, wedge

pytestmark = pytest.mark.usefixtures("in_a_folder_of_its_own")

ROBOTS = "cmeel.prefix/share/example-robot-data/robots"


def panda(folder: Path) -> Path:
    """A copy of a real robot with 30 mesh files."""
    source = Path(str(distribution("example-robot-data").locate_file(ROBOTS))) / "panda_description"
    target = folder / "example-robot-data" / "robots" / "panda_description"
    shutil.copytree(source, target)
    return target / "urdf" / "panda.urdf"


SEE = """
import asyncio, json, sys
from pycrorm_async import Reading, world_of

async def see(url, meshes):
    async with Reading.open(url) as reading:
        then = await reading.as_of("last", sequence=int(sys.argv[3]), meshes=meshes)
    with world_of(then) as world:
        print(json.dumps({
            "assumed": dict(world.assumed),
            "colors": {each.name: each.color for each in world.objects},
            "attached": {each.name: each.attached_to and each.attached_to.name for each in world.objects},
            "links": {
                f"{each.name}/{link}": [*each.link_pose(link).position, *each.link_pose(link).orientation]
                for each in world.objects for link in each.links
            },
        }))

asyncio.run(see(sys.argv[1], sys.argv[2] == "files"))
"""


def seen_again(url: str, folder: Path, sequence: int, meshes: str = "boxes") -> dict[str, object]:
    """Return the report of a new process in another folder."""
    folder.mkdir()
    done = run_script(SEE, url, meshes, str(sequence), cwd=folder)
    assert done.returncode == 0, done.stderr
    answer: dict[str, object] = json.loads(done.stdout)
    return answer


@pytest.mark.soak_on("postgresql")
@pytest.mark.slow
@pytest.mark.parametrize(("make", "meshes"), [(made_arm, "boxes"), (made_arm, "files"), (panda, "boxes")])
async def test_a_robot_is_seen_again_by_a_fresh_process_when_its_files_are_gone(
    database_url: str, tmp_path: Path, make: Callable[[Path], Path], meshes: str
) -> None:
    files = tmp_path / "files"
    robot = make(files)
    poses, missing = await recorded(database_url, robot, Settings(record_meshes=meshes))  # type: ignore[arg-type]
    assert missing.total == 0, missing.last
    shutil.rmtree(files)
    again = seen_again(database_url, tmp_path / "elsewhere", 7, meshes)
    assert again["assumed"] == {}
    assert again["colors"] == {"arm": None, "milk": list(RED)}
    assert again["attached"] == {"arm": None, "milk": "arm"}
    links = again["links"]
    assert isinstance(links, dict)
    assert links.keys() == poses.keys()
    for link, pose in poses.items():
        assert links[link] == pytest.approx(pose, abs=1e-6), link


@pytest.mark.soak_on("postgresql")
async def test_the_boxes_of_an_arm_cover_its_meshes_and_the_files_hold_the_meshes_themselves(
    database_url: str, tmp_path: Path
) -> None:
    robot = made_arm(tmp_path / "files")
    with BulletWorld():
        arm = Object("arm", ObjectType.ROBOT, robot, AT)
        whole = {link: arm.bounding_box(link) for link in arm.links}
        local = {link: arm.box_in_link(link) for link in arm.links}
    await recorded(database_url, robot, Settings(record_meshes="files"))
    shutil.rmtree(tmp_path / "files")
    async with Reading.open(database_url) as reading:
        for meshes in (False, True):
            then = await reading.as_of("last", sequence=3, meshes=meshes)
            with world_of(then) as world, copied(world) as copy:
                for each in (world.object("arm"), copy.object("arm")):
                    for link in each.links:
                        box = each.box_in_link(link)
                        assert box is not None
                        for corner, expected in zip(box, local[link] or (), strict=True):
                            assert corner == pytest.approx(expected, abs=2e-6)
                        if meshes:
                            for corner, expected in zip(each.bounding_box(link), whole[link], strict=True):
                                assert corner == pytest.approx(expected, abs=1e-5)


HULL = """<robot name="v"><material name="coat"><texture filename="{folder}/coat.png"/></material>
<link name="base"><collision><geometry><box size="0.1 0.1 0.1"/></geometry></collision></link>
<link name="hull"><visual><origin xyz="1 0 0"/>
<geometry><mesh filename="{folder}/{mesh}" scale="0.1 0.1 0.1"/></geometry><material name="skin">
<texture filename="{folder}/skin.png"/></material></visual></link>
<joint name="j" type="fixed"><parent link="base"/><child link="hull"/></joint></robot>"""
"""A robot with a link that has a visual mesh and no collision shape, and with textures."""


async def test_a_link_with_only_a_visual_mesh_is_seen_again_as_its_box_and_textures_are_counted(tmp_path: Path) -> None:
    url = f"sqlite:///{tmp_path / 'm.db'}"
    (tmp_path / "wedge.obj").write_text(wedge(3))
    for name in ("coat", "skin"):
        (tmp_path / f"{name}.png").write_bytes(b"no picture")
    _, missing = await recorded(url, HULL.format(folder=tmp_path, mesh="wedge.obj"), Settings())
    assert (missing.total, missing.last) == (2, "DescriptionDeclared.textures: skin.png: textures are not recorded")
    (tmp_path / "wedge.obj").unlink()
    async with Reading.open(url) as reading:
        then = await reading.as_of("last", sequence=3)
    (description,) = [each for each in then.world.descriptions.values() if each.meshes]
    assert str(tmp_path) not in description.text
    low, high = description.boxes["hull"].min, description.boxes["hull"].max
    assert (*low, *high) == pytest.approx((1, 0, 0, 1.1, 0.2, 0.3), abs=2e-6)
    with world_of(then) as world:
        assert dict(world.assumed) == {}
        hull = world.object("arm").description_text.partition('name="hull"')[2].partition("</link>")[0]
    assert '<box size="0.1 0.2 0.3"' in hull


async def test_a_visual_mesh_without_a_box_is_counted(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(Object, "visual_boxes", lambda *_: {})
    (tmp_path / "wedge.obj").write_text(wedge(3))
    robot = HULL.format(folder=tmp_path, mesh="wedge.obj").replace("<texture", "<!-- texture").replace('png"/>', "-->")
    _, missing = await recorded(f"sqlite:///{tmp_path / 'm.db'}", robot, Settings())
    assert (missing.total, missing.last) == (1, "DescriptionDeclared.boxes: the meshes of these links have none: hull")


DIES = """
import asyncio, os, signal, sys
from pycrorm_async import Memory
from pycrorm_async.settings import Settings
from pycrorm_async.world import BulletWorld, Object, ObjectType, Pose

async def die(url, spool, robot):
    settings = Settings(writer="daemon", record_meshes="files")
    async with Memory.open(url, spool=spool, settings=settings) as memory:
        async with memory.episode(description="cut short"):
            with BulletWorld():
                arm = Object("arm", ObjectType.ROBOT, robot, Pose([1, 2, 3]), color=(0, 0, 1, 1))
                arm.set_joint_positions({"shoulder": 0.5, "slide": -0.25})
                print(*arm.link_pose("tip").position, flush=True)
                os.kill(os.getpid(), signal.SIGKILL)

asyncio.run(die(*sys.argv[1:]))
"""


def killed_plan(url: str, spool: Path, robot: Path) -> list[float]:
    """Return the position of the arm's tip when the plan was killed."""
    died = run_script(DIES, url, spool, robot)
    assert died.returncode == -signal.SIGKILL, died.stderr
    return [*map(float, died.stdout.split())]


@pytest.mark.slow
@pytest.mark.soak_on("postgresql")
async def test_a_robot_of_a_plan_that_was_killed_before_anything_was_stored_is_seen_again(
    database_url: str, tmp_path: Path
) -> None:
    spool = tmp_path / "spool"
    async with Memory.open(database_url, spool=spool):  # the database exists; nothing of the plan is in it
        pass
    tip = killed_plan(database_url, spool, made_arm(tmp_path / "files"))
    shutil.rmtree(tmp_path / "files")
    done = await recover(database_url, spool=spool)
    assert (done.failed, len(done.lost)) == ({}, 1)
    async with Reading.open(database_url) as reading:
        then = await reading.as_of("last", sequence=4, meshes=True)
        assert len(then.world.meshes) == 1
        with world_of(then) as world:
            arm = world.object("arm")
            assert dict(world.assumed) == {}
            assert arm.color == (0.0, 0.0, 1.0, 1.0)
            assert arm.link_pose("tip").position == pytest.approx(tip, abs=1e-6)


@pytest.mark.soak_on("postgresql")
async def test_a_robot_under_another_name_keeps_its_description(database_url: str) -> None:
    async with Memory.open(database_url) as memory:
        async with memory.episode(description="two robots"):
            with BulletWorld():
                for name in ("ada", "bob"):
                    Object(name, ObjectType.ROBOT, robot=PR2)
        await memory.flush()
        then = await memory.as_of("last", sequence=4)
    assert len(then.world.descriptions) == 1
    with world_of(then) as world:
        assert [(each.name, each.robot_description) for each in world.objects] == [("ada", PR2), ("bob", PR2)]


async def test_objects_of_an_older_version_have_assumed_shapes_and_are_marked_so(tmp_path: Path) -> None:
    url = unpack_memory_v1(tmp_path)
    await rebuild_memory(url)
    async with Reading.open(url) as reading:
        then = await reading.as_of("1", sequence=4)
    reason = "the built-in shape, because its description was not recorded"
    world = world_of(then)
    assert isinstance(world, RecordedWorld)
    assert dict(world.assumed) == {"milk": reason, "pr2": reason}
    with world:
        assert [(each.name, each.color) for each in world.objects] == [("milk", None), ("pr2", None)]
        assert world.object("pr2").joint_position("torso_lift_joint") == 0.3
