"""Expressions and located objects in the tables of a memory."""

from __future__ import annotations

import dataclasses
import math
from datetime import UTC, datetime
from pathlib import Path
from typing import Any

import pytest
from sqlalchemy import func, select

from pycrorm_async import Memory, Reading
from pycrorm_async.orm import (
    Action,
    Code,
    Designator,
    Language,
    Monitor,
    Motion,
    Repeat,
    Sequential,
    TaskTreeNode,
)
from pycrorm_async.orm import LocatedObject as LocatedObjectRow
from pycrorm_async.orm import Object as ObjectRow
from pycrorm_async.orm import ObjectPart as ObjectPartRow
from pycrorm_async.plan import (
    ActionAbstract,
    LocatedObject,
    MoveTorsoAction,
    NavigateAction,
    ObjectPart,
    simulated_robot,
)
from pycrorm_async.plan import Code as Calling
from pycrorm_async.plan import Monitor as Watching
from pycrorm_async.plan.objects import ObjectDesignator
from pycrorm_async.task_status import TaskStatus
from pycrorm_async.world import BulletWorld, Object, ObjectType, Pose
from pycrorm_async.world.pose import yaw_quaternion
from tests.memory.note_actions import NoteActionPerformable, url_of

pytestmark = pytest.mark.slow


# === language =================================================================================================
#
# Plans of the language in a memory: expressions with their fields, outcomes, failures and interruptions.


def note(text: str) -> NoteActionPerformable:
    return NoteActionPerformable(text)


async def every(memory: Memory | Reading, question: Any) -> list[Any]:
    async with memory.session() as session:
        return list((await session.scalars(question)).all())


def named(nodes: list[TaskTreeNode]) -> list[tuple[str | None, str | None, str]]:
    """Return for each node its type, its parent's type, and its status."""
    types = {node.id: node.dtype for node in nodes}
    return [(node.dtype, types.get(node.parent_id or 0), node.status.name) for node in nodes if node.dtype is not None]


async def test_expressions_are_nodes_with_their_fields_and_are_parents_of_what_they_performed(tmp_path: Path) -> None:
    def never() -> bool:
        return False

    plan = (note("a") + Calling(len, obj=[]) - note("b")) + (note("c") * 2 >> Watching(never, interval_s=0.5))
    async with Memory.open(url_of(tmp_path)) as memory:
        async with memory.episode(description="plan"):
            with pytest.raises(TypeError):  # len takes no keywords: a bug in the plan, and no outcome
                await plan.perform()
            await (note("d") + Calling(dict, a=1, b="two") + note("c") * 2).perform()
            await (note("e") >> Watching(never, interval_s=0.5)).perform()
        await memory.flush()
        nodes = await every(memory, select(TaskTreeNode).order_by(TaskTreeNode.id))
        assert named(nodes) == [
            ("Sequential", None, "ERROR"),
            ("TryInOrder", "Sequential", "ERROR"),
            ("Sequential", "TryInOrder", "ERROR"),
            ("NoteAction", "Sequential", "SUCCEEDED"),
            ("Code", "Sequential", "ERROR"),
            ("Sequential", None, "SUCCEEDED"),
            ("NoteAction", "Sequential", "SUCCEEDED"),
            ("Code", "Sequential", "SUCCEEDED"),
            ("Repeat", "Sequential", "SUCCEEDED"),
            ("NoteAction", "Repeat", "SUCCEEDED"),
            ("NoteAction", "Repeat", "SUCCEEDED"),
            ("Monitor", None, "SUCCEEDED"),
            ("NoteAction", "Monitor", "SUCCEEDED"),
        ]
        (repeat,) = await every(memory, select(Repeat))
        assert (repeat.times, repeat.dtype, repeat.kind) == (2, "Repeat", "language")
        (monitor,) = await every(memory, select(Monitor))
        assert monitor.condition.endswith("<locals>.never")
        assert monitor.interval_s == 0.5
        codes = await every(memory, select(Code).order_by(Code.id))
        assert [(each.function, each.arguments) for each in codes] == [
            ("len", {"obj": "[]"}),
            ("dict", {"a": "1", "b": "'two'"}),
        ]
        results = {node.dtype: node.result for node in nodes if node.status is TaskStatus.SUCCEEDED}
        assert results["Sequential"] == {"succeeded": [0, 1, 2]}
        assert results["Repeat"] == {"rounds": 2}
        assert results["Monitor"] == {"interrupted": False}
        assert results["Code"] == {"a": 1, "b": "two"}


async def test_the_classes_of_actions_and_motions_return_no_expressions(tmp_path: Path) -> None:
    async with Memory.open(url_of(tmp_path)) as memory:
        async with memory.episode(description="plan"):
            with BulletWorld(), simulated_robot:
                Object("pr2", ObjectType.ROBOT)
                await (NavigateAction([Pose([1, 0, 0])]) + MoveTorsoAction([0.2])).perform()
        await memory.flush()
        actions = await every(memory, select(Action).order_by(Action.id))
        assert [type(each).__name__ for each in actions] == ["NavigateAction", "MoveTorsoAction"]
        assert [each.dtype for each in await every(memory, select(Motion).order_by(Motion.id))] == [
            "MoveMotion",
            "MoveJointsMotion",
        ]
        (language,) = await every(memory, select(Language))
        assert type(language) is Sequential
        assert language.robot_state is not None
        assert language.robot_state.pose.position.x == 0
        everything = await every(memory, select(Designator).order_by(Designator.id))
        assert [each.kind for each in everything] == ["language", "action", "motion", "action", "motion"]
        async with memory.session() as session:
            assert await session.scalar(select(func.count()).select_from(Action)) == 2


# === object designators =======================================================================================
#
# Objects that a plan believes in, that are parts of others, or that are located relative to others, are recorded so.


@dataclasses.dataclass
class RememberActionPerformable(ActionAbstract):
    thing: ObjectDesignator

    async def perform(self) -> None:
        """Succeed without doing anything."""


def place(row: ObjectRow | None) -> tuple[str, float, float, float]:
    """Name and position of an object at that time."""
    assert row is not None
    assert row.pose is not None
    return row.name, row.pose.x, row.pose.y, row.pose.z


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
