"""Meshes are recorded by the hash of their content, and a mesh or description that cannot be kept is counted."""

from __future__ import annotations

import hashlib
import os
import shutil
from pathlib import Path

import pytest
from sqlalchemy import select

from pycrorm_async import Memory, Reading, world_of
from pycrorm_async.orm import Object as ObjectRow
from pycrorm_async.orm import ObjectDescription
from pycrorm_async.settings import Settings
from pycrorm_async.world import BulletWorld, Object, ObjectType
from tests.memory.recorded_arm import AT, made_arm, recorded, wedge

pytestmark = pytest.mark.usefixtures("in_a_folder_of_its_own")


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


@pytest.mark.soak_on("postgresql")
async def test_a_mesh_that_changed_between_two_runs_has_two_hashes_and_both_are_kept(
    database_url: str, tmp_path: Path
) -> None:
    heights = []
    for height in (3.0, 5.0):
        robot = made_arm(tmp_path, height)
        os.utime(tmp_path / "meshes" / "wedge.obj", (height, height))
        await recorded(database_url, robot, Settings())
    async with Reading.open(database_url) as reading:
        for episode in ("1", "2"):
            with world_of(await reading.as_of(episode, sequence=3)) as world:
                box = world.object("arm").box_in_link("tip")
                assert box is not None
                heights.append(box.size.z)
        async with reading.session() as session:
            descriptions = (await session.scalars(select(ObjectDescription))).all()
            arms = [each for each in descriptions if each.meshes]
            assert len(descriptions) == 3  # two arms and one milk
            assert len({mesh.sha256 for each in arms for mesh in each.meshes}) == 2
            rows = (
                await session.scalars(select(ObjectRow).where(ObjectRow.name == "arm").order_by(ObjectRow.id))
            ).all()
            assert {row.description_fingerprint for row in rows} == {each.fingerprint for each in arms}
    assert heights == pytest.approx([0.3, 0.5], abs=1e-6)


@pytest.mark.soak_on("postgresql")
async def test_a_mesh_that_changes_in_one_process_is_hashed_again(database_url: str, tmp_path: Path) -> None:
    robot = made_arm(tmp_path)
    async with Memory.open(database_url) as memory:
        async with memory.episode(description="changed"):
            with BulletWorld():
                Object("arm", ObjectType.ROBOT, robot)
                (tmp_path / "meshes" / "wedge.obj").write_text(wedge(5.0) + "# longer\n")
                Object("again", ObjectType.ROBOT, robot)
                Object("once more", ObjectType.ROBOT, robot)
        await memory.flush()
        then = await memory.as_of("last", sequence=5)
    first, second, third = (each.description_fingerprint for each in then.world.objects)
    assert first != second == third


@pytest.mark.soak_on("postgresql")
async def test_a_mesh_that_is_too_large_is_kept_as_its_box_and_counted(database_url: str, tmp_path: Path) -> None:
    robot = made_arm(tmp_path / "files")
    size = (tmp_path / "files" / "meshes" / "wedge.obj").stat().st_size
    settings = Settings(record_meshes="files", blob_bytes_max=size - 1)
    _, missing = await recorded(database_url, robot, settings)
    reason = f"it takes {size} bytes, {size - 1} are allowed (blob_bytes_max)"
    assert missing.total == 1
    assert missing.last == f"DescriptionDeclared.meshes: wedge.obj: {reason}"
    async with Reading.open(database_url) as reading:
        then = await reading.as_of("last", sequence=3, meshes=True)
    (mesh,) = next(each for each in then.world.descriptions.values() if each.meshes).meshes
    assert (mesh.name, mesh.size, mesh.content, mesh.missing) == ("wedge.obj", size, None, reason)
    assert mesh.sha256 is not None
    with world_of(then) as world:
        box = world.object("arm").box_in_link("tip")
        assert box is not None
        assert tuple(box.size) == pytest.approx((0.1, 0.2, 0.3), abs=1e-6)


@pytest.mark.soak_on("postgresql")
async def test_a_mesh_that_cannot_be_read_any_more_is_missing_with_the_reason(
    database_url: str, tmp_path: Path
) -> None:
    robot = made_arm(tmp_path / "files")
    async with Memory.open(database_url) as memory:
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


@pytest.mark.soak_on("postgresql")
async def test_a_description_that_fits_no_record_is_missing_with_the_reason_and_shown_as_a_point(
    database_url: str,
) -> None:
    names = [os.urandom(64).hex() for _ in range(40)]
    links = "\n".join(f'<link name="{name}"/>' for name in names)
    joints = "\n".join(
        f'<joint name="to {name}" type="continuous"><parent link="base"/><child link="{name}"/></joint>'
        for name in names
    )
    text = f'<robot name="hedge">\n<link name="base"/>\n{links}\n{joints}\n</robot>'
    async with Memory.open(database_url, settings=Settings(record_bytes_max=4_096)) as memory:
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


@pytest.mark.soak_on("postgresql")
async def test_a_color_that_is_not_finite_is_missing_and_the_object_is_recorded(database_url: str) -> None:
    async with Memory.open(database_url) as memory:
        async with memory.episode(description="odd"):
            with BulletWorld():
                Object("milk", ObjectType.MILK, color=(float("nan"), 0.0, 0.0, 1.0))
        await memory.flush()
        assert memory.status.faults.total == 0
        assert memory.status.missing.last == "ObjectAdded.color: (nan, 0.0, 0.0, 1.0) is not finite"
        then = await memory.as_of("last", sequence=3)
    assert [(each.name, each.color) for each in then.world.objects] == [("milk", None)]
