"""The memory holds of robots and objects what a plan depended on: the masses, the base link, who took part."""

from __future__ import annotations

from dataclasses import replace
from pathlib import Path

import pytest
from sqlalchemy import select
from sqlalchemy.orm import selectinload

from pycrorm_async import Memory, world_of
from pycrorm_async.orm import EpisodeRobot, PickUpAction, ProcessMetaData
from pycrorm_async.orm import Object as RecordedObject
from pycrorm_async.plan import PickUpActionPerformable, simulated_robot
from pycrorm_async.plan.failures import CapabilityAbsenceFailure
from pycrorm_async.world import COURIER, Arms, BulletWorld, Grasp, Object, ObjectType, Pose

pytestmark = pytest.mark.slow


async def test_a_robot_that_is_added_again_has_one_row(database_url: str, tmp_path: Path) -> None:
    def add(name: str, serial: str | None = None) -> Object:
        return Object(name, ObjectType.ROBOT, robot=replace(COURIER, serial=serial))

    async with Memory.open(database_url, spool=tmp_path / "spool") as memory:
        async with memory.episode(description="again"):
            with BulletWorld() as world:
                add("ada", "A-1").remove()
                add("bob")
                ada = add("ada", "A-1")
                ada.set_pose(Pose([1, 0, 0]))
                ada.remove()
                add("ada", "A-2").remove()
                world.object("bob").remove()
                add("bob").set_joint_position("arm_yaw_joint", 0.5)
            with BulletWorld():
                add("bob")
        async with memory.episode(description="other"):
            with BulletWorld():
                add("bob")
        await memory.flush()
        async with memory.session() as session:
            asked = select(ProcessMetaData).options(selectinload(ProcessMetaData.robots)).order_by(ProcessMetaData.id)
            episodes = (await session.scalars(asked)).all()
            first = select(RecordedObject.id).order_by(RecordedObject.id).limit(1)
            assert episodes[0].robots[0].id == (await session.scalars(first)).one()
            joined = select(RecordedObject.sequence).join(EpisodeRobot, RecordedObject.id == EpisodeRobot.id)
            sequences = (await session.scalars(joined.order_by(EpisodeRobot.id))).all()
            assert sequences == (await session.scalars(select(EpisodeRobot.sequence).order_by(EpisodeRobot.id))).all()
        robots = [[(each.name, each.serial) for each in one.robots] for one in episodes]
        assert robots == [[("ada", "A-1"), ("bob", None), ("ada", "A-2")], [("bob", None)]]
        assert len(sequences) == 4
        summaries = await memory.reading.episodes()
        assert [[(each.name, each.serial) for each in one.robots] for one in summaries] == robots


@pytest.mark.soak_on("postgresql")
async def test_an_object_that_was_too_heavy_is_recorded_with_its_mass_and_the_reason(
    database_url: str, tmp_path: Path
) -> None:
    async with Memory.open(database_url, spool=tmp_path / "spool") as memory:
        async with memory.episode(description="heavy"):
            with BulletWorld(), simulated_robot:
                Object("courier", ObjectType.ROBOT)
                milk = Object("milk", ObjectType.MILK, pose=Pose([0.65, 0, 0.9]), mass_kg=12.5)
                Object("cup", ObjectType.JEROEN_CUP, pose=Pose([2, 0, 0.9]))
                Object("block", ObjectType.GENERIC_OBJECT, pose=Pose([3, 0, 0.9]))
                with pytest.raises(CapabilityAbsenceFailure):
                    await PickUpActionPerformable(milk, Arms.RIGHT, Grasp.FRONT).perform()
                milk.set_pose(Pose([0.65, 0.1, 0.9]))
        await memory.flush()
        async with memory.session() as session:
            masses = select(RecordedObject.name, RecordedObject.mass_kg).order_by(RecordedObject.id)
            rows = [tuple(each) for each in await session.execute(masses)]
            failed = (await session.scalars(select(PickUpAction))).one()
            node = await failed.awaitable_attrs.node
            sequence = node.sequence
        assert rows == [("courier", None), ("milk", 12.5), ("cup", 0.118), ("block", None), ("milk", None)]
        assert (failed.status.name, failed.reason) == ("FAILED", "CapabilityAbsenceFailure")
        assert node.failure_message == "milk weighs 12.5 kg, the RIGHT arm lifts 3 kg"
        assert node.failure_arguments == [node.failure_message, "milk", 12.5, 3.0]
        then = await memory.as_of("last", sequence=sequence)
    assert {each.name: each.mass_kg for each in then.world.objects} == {
        "courier": None,
        "milk": 12.5,
        "cup": 0.118,
        "block": None,
    }
    with world_of(then) as recorded, simulated_robot:
        milk = recorded.object("milk")
        assert milk.mass_kg == 12.5
        assert recorded.object("block").mass_kg is None
        with pytest.raises(CapabilityAbsenceFailure, match=r"^milk weighs 12\.5 kg"):
            await PickUpActionPerformable(milk, Arms.RIGHT, Grasp.FRONT).perform()
