"""An episode holds all that is needed to see it again: a fresh process makes its world without the robot's files."""

from __future__ import annotations

import hashlib
import json
import os
import shutil
import signal
from collections.abc import Callable
from importlib.metadata import distribution
from pathlib import Path

import pytest
from sqlalchemy import select

from pycrorm_async import Memory, Reading, world_of
from pycrorm_async.operations.rebuild import rebuild_memory
from pycrorm_async.operations.recovery import recover
from pycrorm_async.orm import Object as ObjectRow
from pycrorm_async.orm import ObjectDescription
from pycrorm_async.query.again import RecordedWorld
from pycrorm_async.record.values import Missing
from pycrorm_async.settings import Settings
from pycrorm_async.world import BulletWorld, Object, ObjectType, Pose, copied
from pycrorm_async.world.urdf import PR2
from tests.commands import run_script
from tests.databases import put_memory
from tests.golden.unpacking import unpack_memory_v1


@pytest.fixture
def url(tmp_path: Path) -> str:
    return put_memory(tmp_path / "memory.db")


# === recorded arm =============================================================================================
#
# Write an arm with a mesh on each of its links, and record it with a milk that it carries.

AT = Pose([1, -2, 0.5], [0, 0, 0.6, 0.8])
RED = (1.0, 0.0, 0.0, 0.5)


def wedge(height: float) -> str:
    return f"v 0 0 0\nv 1 0 0\nv 0 2 0\nv 0 0 {height}\nf 1 3 2\nf 1 2 4\nf 2 3 4\nf 1 4 3\n"


def made_arm(folder: Path, height: float = 3.0) -> Path:
    """An arm of two joints with a mesh on each link; its frames are turned, its masses off the frames."""
    (folder / "meshes").mkdir(parents=True, exist_ok=True)
    (folder / "meshes" / "wedge.obj").write_text(wedge(height))

    def link(name: str, at: str) -> str:
        mesh = '<geometry><mesh filename="meshes/wedge.obj" scale="0.1 0.1 0.1"/></geometry>'
        return (
            f'<link name="{name}"><inertial><origin xyz="{at}" rpy="0.3 0.2 0.1"/><mass value="2"/>'
            '<inertia ixx="1" ixy="0" ixz="0" iyy="1" iyz="0" izz="1"/></inertial>\n'
            f'<visual>{mesh}<material name="m"><color rgba="0 1 0 1"/></material></visual>\n'
            f'<collision><origin xyz="{at}"/>{mesh}</collision></link>\n'
        )

    def joint(name: str, kind: str, parent: str, child: str) -> str:
        return (
            f'<joint name="{name}" type="{kind}"><origin xyz="0.1 0.2 0.3" rpy="0.5 -0.4 0.3"/>'
            f'<parent link="{parent}"/><child link="{child}"/><axis xyz="0 0.6 0.8"/>'
            '<limit lower="-2" upper="2" effort="1" velocity="1"/></joint>\n'
        )

    file = folder / "arm.urdf"
    file.write_text(
        '<robot name="arm">\n'
        + link("base", "0 0 0.1")
        + link("upper", "0.2 0 0")
        + link("tip", "0 0.3 0")
        + joint("shoulder", "revolute", "base", "upper")
        + joint("slide", "prismatic", "upper", "tip")
        + "</robot>\n"
    )
    return file


def link_poses(world: BulletWorld) -> dict[str, list[float]]:
    return {
        f"{each.name}/{link}": [*each.link_pose(link).position, *each.link_pose(link).orientation]
        for each in world.objects
        for link in each.links
    }


async def recorded(url: str, robot: Path | str, settings: Settings) -> tuple[dict[str, list[float]], Missing]:
    """Record the robot beside a milk that it carries; return the poses of all links."""
    async with Memory.open(url, settings=settings) as memory:
        async with memory.episode(description="seen"):
            with BulletWorld() as world:
                arm = Object("arm", ObjectType.ROBOT, robot, AT)
                milk = Object("milk", ObjectType.MILK, pose=Pose([0, 0, 1]), color=RED)
                arm.attach(milk, arm.links[-1])
                middles = {joint: sum(arm.joint_limits(joint)) / 2 + 0.01 for joint in arm.joints}
                arm.set_joint_positions(middles)
                poses = link_poses(world)
        await memory.flush()
        assert memory.status.faults.total == 0, memory.status.faults.last
        return poses, memory.status.missing


# === recorded geometry ========================================================================================

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


@pytest.mark.slow
@pytest.mark.parametrize(("make", "meshes"), [(made_arm, "boxes"), (made_arm, "files"), (panda, "boxes")])
async def test_a_robot_is_seen_again_by_a_fresh_process_when_its_files_are_gone(
    url: str, tmp_path: Path, make: Callable[[Path], Path], meshes: str
) -> None:
    files = tmp_path / "files"
    robot = make(files)
    poses, missing = await recorded(url, robot, Settings(record_meshes=meshes))  # type: ignore[arg-type]
    assert missing.total == 0, missing.last
    shutil.rmtree(files)
    again = seen_again(url, tmp_path / "elsewhere", 7, meshes)
    assert again["assumed"] == {}
    assert again["colors"] == {"arm": None, "milk": list(RED)}
    assert again["attached"] == {"arm": None, "milk": "arm"}
    links = again["links"]
    assert isinstance(links, dict)
    assert links.keys() == poses.keys()
    for link, pose in poses.items():
        assert links[link] == pytest.approx(pose, abs=1e-6), link


async def test_the_boxes_of_an_arm_cover_its_meshes_and_the_files_hold_the_meshes_themselves(
    url: str, tmp_path: Path
) -> None:
    robot = made_arm(tmp_path / "files")
    with BulletWorld():
        arm = Object("arm", ObjectType.ROBOT, robot, AT)
        whole = {link: arm.bounding_box(link) for link in arm.links}
        local = {link: arm.box_in_link(link) for link in arm.links}
    await recorded(url, robot, Settings(record_meshes="files"))
    shutil.rmtree(tmp_path / "files")
    async with Reading.open(url) as reading:
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
async def test_a_robot_of_a_plan_that_was_killed_before_anything_was_stored_is_seen_again(
    url: str, tmp_path: Path
) -> None:
    spool = tmp_path / "spool"
    async with Memory.open(url, spool=spool):  # the database exists; nothing of the plan is in it
        pass
    tip = killed_plan(url, spool, made_arm(tmp_path / "files"))
    shutil.rmtree(tmp_path / "files")
    done = await recover(url, spool=spool)
    assert (done.failed, len(done.lost)) == ({}, 1)
    async with Reading.open(url) as reading:
        then = await reading.as_of("last", sequence=4, meshes=True)
        assert len(then.world.meshes) == 1
        with world_of(then) as world:
            arm = world.object("arm")
            assert dict(world.assumed) == {}
            assert arm.color == (0.0, 0.0, 1.0, 1.0)
            assert arm.link_pose("tip").position == pytest.approx(tip, abs=1e-6)


async def test_a_robot_under_another_name_keeps_its_description(url: str) -> None:
    async with Memory.open(url) as memory:
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


# === recorded meshes ==========================================================================================
#
# Meshes are recorded by the hash of their content, and a mesh or description that cannot be kept is counted.


async def test_a_mesh_that_changed_with_its_size_and_its_time_kept_is_hashed_again(tmp_path: Path) -> None:
    url = f"sqlite:///{tmp_path / 'm.db'}"
    hashes = []
    async with Memory.open(url) as memory:
        async with memory.episode(description="changed"):
            with BulletWorld():
                for height in (3, 5):
                    robot = made_arm(tmp_path, height)
                    os.utime(tmp_path / "meshes" / "wedge.obj", (1, 1))
                    hashes.append(hashlib.sha256((tmp_path / "meshes" / "wedge.obj").read_bytes()).hexdigest())
                    Object(f"arm {height}", ObjectType.GENERIC_OBJECT, robot)
        await memory.flush()
        async with memory.session() as session:
            descriptions = {each.fingerprint: each for each in await session.scalars(select(ObjectDescription))}
            rows = (await session.scalars(select(ObjectRow).order_by(ObjectRow.id))).all()
    recorded_meshes = [mesh for row in rows for mesh in descriptions[row.description_fingerprint or ""].meshes]
    assert [mesh.sha256 for mesh in recorded_meshes] == hashes


async def test_one_robot_has_one_hash_wherever_it_is_and_however_its_meshes_are_recorded(tmp_path: Path) -> None:
    descriptions = []
    for meshes in ("boxes", "files"):
        url = f"sqlite:///{tmp_path / meshes}.db"
        await recorded(url, made_arm(tmp_path / meshes), Settings(record_meshes=meshes))
        async with Reading.open(url) as reading, reading.session() as session:
            descriptions += [each for each in await session.scalars(select(ObjectDescription)) if each.meshes]
    assert len({each.fingerprint for each in descriptions}) == 2
    assert len({each.text_sha256 for each in descriptions}) == 1


async def test_a_mesh_that_is_too_large_is_kept_as_its_box_and_counted(url: str, tmp_path: Path) -> None:
    robot = made_arm(tmp_path / "files")
    size = (tmp_path / "files" / "meshes" / "wedge.obj").stat().st_size
    settings = Settings(record_meshes="files", blob_bytes_max=size - 1)
    _, missing = await recorded(url, robot, settings)
    reason = f"it takes {size} bytes, {size - 1} are allowed (blob_bytes_max)"
    assert missing.total == 1
    assert missing.last == f"DescriptionDeclared.meshes: wedge.obj: {reason}"
    async with Reading.open(url) as reading:
        then = await reading.as_of("last", sequence=3, meshes=True)
    (mesh,) = next(each for each in then.world.descriptions.values() if each.meshes).meshes
    assert (mesh.name, mesh.size, mesh.content, mesh.missing) == ("wedge.obj", size, None, reason)
    assert mesh.sha256 is not None
    with world_of(then) as world:
        box = world.object("arm").box_in_link("tip")
        assert box is not None
        assert tuple(box.size) == pytest.approx((0.1, 0.2, 0.3), abs=1e-6)


async def test_a_mesh_that_cannot_be_read_any_more_is_missing_with_the_reason(url: str, tmp_path: Path) -> None:
    robot = made_arm(tmp_path / "files")
    async with Memory.open(url) as memory:
        with BulletWorld():
            arm = Object("arm", ObjectType.ROBOT, robot, AT)
            shutil.rmtree(tmp_path / "files")
            async with memory.episode(description="too late"):
                arm.set_joint_position("shoulder", 0.5)
            tip = arm.link_pose("tip").position
        await memory.flush()
        assert memory.status.faults.total == 0
        assert memory.status.missing.last == "DescriptionDeclared.meshes: wedge.obj: No such file or directory"
        then = await memory.as_of("last", sequence=4)
    (mesh,) = next(iter(then.world.descriptions.values())).meshes
    assert (mesh.sha256, mesh.missing) == (None, "No such file or directory")
    with world_of(then) as world:
        assert dict(world.assumed) == {}
        assert world.object("arm").link_pose("tip").position == pytest.approx(tip, abs=1e-6)


async def test_a_description_that_fits_no_record_is_missing_with_the_reason_and_shown_as_a_point(
    url: str,
) -> None:
    names = [os.urandom(64).hex() for _ in range(40)]
    links = "\n".join(f'<link name="{name}"/>' for name in names)
    joints = "\n".join(
        f'<joint name="to {name}" type="continuous"><parent link="base"/><child link="{name}"/></joint>'
        for name in names
    )
    text = f'<robot name="hedge">\n<link name="base"/>\n{links}\n{joints}\n</robot>'
    async with Memory.open(url, settings=Settings(record_bytes_max=4_096)) as memory:
        async with memory.episode(description="large"):
            with BulletWorld():
                Object("hedge", ObjectType.GENERIC_OBJECT, text.replace("continuous", "fixed"), AT)
                Object("milk", ObjectType.MILK)
        await memory.flush()
        assert memory.status.faults.total == 0
        assert memory.status.missing.total == 1
        then = await memory.as_of("last", sequence=4)
    with world_of(then) as world:
        assert world.object("hedge").pose == AT
        assert list(world.assumed) == ["hedge"]
        assert "4,096 are allowed (record_bytes_max)" in world.assumed["hedge"]


async def test_a_color_that_is_not_finite_is_missing_and_the_object_is_recorded(url: str) -> None:
    async with Memory.open(url) as memory:
        async with memory.episode(description="odd"):
            with BulletWorld():
                Object("milk", ObjectType.MILK, color=(float("nan"), 0.0, 0.0, 1.0))
        await memory.flush()
        assert memory.status.faults.total == 0
        assert memory.status.missing.last == "ObjectAdded.color: nan is not a finite number"
        then = await memory.as_of("last", sequence=3)
    assert [(each.name, each.color) for each in then.world.objects] == [("milk", None)]
