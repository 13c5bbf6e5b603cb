"""The memory holds of robots and objects what a plan depended on: the masses, the base link, who took part."""

from __future__ import annotations

from pathlib import Path

import pytest
from sqlalchemy import select

from pycrorm_async import Memory, world_of
from pycrorm_async.orm import Object as RecordedObject
from pycrorm_async.orm import PickUpAction
from pycrorm_async.plan import PickUpActionPerformable, simulated_robot
from pycrorm_async.plan.failures import CapabilityAbsenceFailure
from pycrorm_async.world import Arms, BulletWorld, Grasp, Object, ObjectType, Pose

pytestmark = pytest.mark.slow


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
