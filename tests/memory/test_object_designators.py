"""Objects that a plan believes in, that are parts of others, or that are located relative to others, are recorded
so.
"""

from __future__ import annotations

import dataclasses
import math
from collections.abc import Iterator
from contextlib import suppress
from datetime import UTC, datetime
from pathlib import Path
from typing import Any, get_type_hints

import pytest
from sqlalchemy import select

from pycrorm_async import Memory
from pycrorm_async.orm import BelieveObject as BelieveObjectRow
from pycrorm_async.orm import Designator as DesignatorRow
from pycrorm_async.orm import LocatedObject as LocatedObjectRow
from pycrorm_async.orm import Object as ObjectRow
from pycrorm_async.orm import ObjectPart as ObjectPartRow
from pycrorm_async.orm import TaskTreeNode
from pycrorm_async.plan import (
    ActionAbstract,
    BelieveObject,
    Designator,
    LocatedObject,
    ObjectPart,
    PlanFailure,
    simulated_robot,
)
from pycrorm_async.plan.objects import ObjectDesignator
from pycrorm_async.task_status import TaskStatus
from pycrorm_async.world import Arms, BulletWorld, Grasp, GripperState, Object, ObjectType, Pose
from pycrorm_async.world.pose import yaw_quaternion
from tests.memory.note_actions import url_of

pytestmark = pytest.mark.slow

BELIEVED = BelieveObject("cup", ObjectType.JEROEN_CUP, Pose([1.2, 0.4, 0.9], yaw_quaternion(0.5)))
VALUES: dict[Any, Any] = {
    Arms: Arms.LEFT,
    Grasp: Grasp.FRONT,
    GripperState: GripperState.OPEN,
    Pose: Pose([0.5, 0, 0]),
    str: "recall",
}


@dataclasses.dataclass
class RememberActionPerformable(ActionAbstract):
    thing: ObjectDesignator

    async def perform(self) -> None:
        """Succeed without doing anything."""


def about_objects() -> Iterator[Designator]:
    """Return one of each built-in action with an object: all about the believed cup."""
    waiting: list[Any] = [ActionAbstract]
    while waiting:
        kind: Any = waiting.pop()
        waiting += kind.__subclasses__()
        if kind.__module__.startswith("pycrorm_async.") and "__dataclass_fields__" in vars(kind):
            hints = get_type_hints(kind)
            fields = [
                each.name for each in dataclasses.fields(kind) if each.init and each.default is dataclasses.MISSING
            ]
            about = [name for name in fields if "ObjectDesignator" in str(hints[name])]
            if about:
                values = {name: VALUES.get(hints[name], 0.5) for name in fields}
                yield kind(**values | dict.fromkeys(about, BELIEVED))


def place(row: ObjectRow | None) -> tuple[str, float, float, float]:
    """Name and position of an object at that time."""
    assert row is not None
    assert row.pose is not None
    return row.name, row.pose.x, row.pose.y, row.pose.z


async def test_a_believed_object_can_be_an_argument_of_every_action_and_is_recorded(tmp_path: Path) -> None:
    with BulletWorld(), simulated_robot:
        Object("pr2", ObjectType.ROBOT)
        async with Memory.open(url_of(tmp_path)) as memory:
            async with memory.episode(description="believing"):
                actions = list(about_objects())
                for action in actions:
                    with suppress(PlanFailure):
                        await action.perform()
            await memory.flush()
            async with memory.session() as session:
                rows: Any = (await session.scalars(select(DesignatorRow))).all()
                named = {each.dtype: each.object for each in rows if hasattr(each, "object_id")}
                nodes = (await session.execute(select(TaskTreeNode.dtype, TaskTreeNode.status))).all()
    status: dict[str, TaskStatus] = {node.dtype: node.status for node in nodes}
    assert {action.dtype for action in actions} >= {"PickUpAction", "PlaceAction", "MoveAndPickUpAction"}
    for action in actions:
        row = named[action.dtype]
        assert isinstance(row, BelieveObjectRow), action
        assert place(row) == ("cup", 1.2, 0.4, 0.9)
        assert (row.obj_type, row.identity_id) == (ObjectType.JEROEN_CUP, None)
        assert status[action.dtype] in (TaskStatus.FAILED, TaskStatus.SUCCEEDED), action


async def test_a_located_object_is_recorded_with_its_reference_at_that_time(tmp_path: Path) -> None:
    noon = datetime(2024, 7, 30, 12, 0, 0, 123456, UTC)
    with BulletWorld():
        milk = Object("milk", ObjectType.MILK, pose=Pose([1.3, 1, 0.9]))
        kitchen = Object("kitchen", ObjectType.ENVIRONMENT)
        milk.set_pose(Pose([1, 0, 0.5], yaw_quaternion(math.pi / 2)))
        cup = LocatedObject("cup", ObjectType.JEROEN_CUP, Pose([0, 0.2, 0.1]), milk, noon)
        shelf = ObjectPart("fridge_shelf_surface", kitchen)
        jam = LocatedObject("jam", ObjectType.GENERIC_OBJECT, Pose([0.1, 0, 0]), shelf, noon)
        async with Memory.open(url_of(tmp_path)) as memory:
            async with memory.episode(description="telling"):
                await RememberActionPerformable(cup).perform()
                milk.set_pose(Pose([5, 5, 0.5]))
                await RememberActionPerformable(jam).perform()
                await RememberActionPerformable(shelf).perform()
            await memory.flush()
            async with memory.session() as session:
                located = (await session.scalars(select(LocatedObjectRow).order_by(LocatedObjectRow.id))).all()
                (part,) = (await session.scalars(select(ObjectPartRow))).all()
                milks = (await session.scalars(select(ObjectRow).where(ObjectRow.name == "milk"))).all()
    assert [(each.dtype, each.obj_type) for each in located] == [
        ("LocatedObject", ObjectType.JEROEN_CUP),
        ("LocatedObject", ObjectType.GENERIC_OBJECT),
    ]
    assert place(located[0])[1:] == pytest.approx((0.8, 0, 0.6))
    assert located[0].pose is not None
    assert located[0].pose.time == noon
    assert place(located[0].reference) == ("milk", 1.0, 0.0, 0.5)
    assert place(located[1].reference) == place(part.part_of) == ("kitchen", 0.0, 0.0, 0.0)
    assert part.name == "fridge_shelf_surface"
    assert [place(each)[1:3] for each in milks] == [(1.0, 0.0), (5.0, 5.0)]
