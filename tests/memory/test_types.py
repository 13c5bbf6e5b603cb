"""User types in a memory: subclasses, mapped classes, views, data frames, and processes that lack the class."""

import asyncio
from dataclasses import dataclass
from pathlib import Path

import pytest
from sqlalchemy import func, select
from sqlalchemy.orm import Mapped, undefer

from pycrorm_async import Memory, UserView
from pycrorm_async.orm import Action, Designator, PickUpAction, TaskTreeNode
from pycrorm_async.plan import ActionAbstract, PickUpActionPerformable
from pycrorm_async.plan.objects import BelieveObject
from pycrorm_async.world import Arms, Grasp, ObjectType, Pose
from tests.commands import run_script
from tests.memory.note_actions import NoteActionPerformable, url_of

pytestmark = pytest.mark.slow


@dataclass
class GentlePickUpActionPerformable(PickUpActionPerformable):
    force: float = 1.0

    async def perform(self) -> None:
        """Lift nothing: the test is about the recorded row."""


async def test_a_user_view_is_made_beside_the_tables(tmp_path: Path) -> None:
    view = UserView("attempts", select(TaskTreeNode.dtype, func.count().label("times")).group_by(TaskTreeNode.dtype))
    async with Memory.open(url_of(tmp_path), views=[view]) as memory:
        async with memory.episode(description="e"):
            await NoteActionPerformable("a").perform()
            await NoteActionPerformable("b").perform()
        await memory.flush()
        async with memory.session() as session:
            rows = (await session.execute(select(view.table).order_by(view.table.c.times))).all()
        assert [tuple(row) for row in rows] == [(None, 1), ("NoteAction", 2)]
        frame = await memory.dataframe(select(view.table))
        assert sorted(frame.times) == [1, 2]


async def test_a_subclass_of_an_action_is_listed_among_that_action(tmp_path: Path) -> None:
    cup = BelieveObject("cup", ObjectType.JEROEN_CUP, Pose([1.0, 2.0, 3.0]))
    async with Memory.open(url_of(tmp_path)) as memory:
        await GentlePickUpActionPerformable(cup, Arms.RIGHT, Grasp.TOP, 0.5).perform()
        await memory.flush()
        async with memory.session() as session:
            picked = (await session.scalars(select(PickUpAction))).one()
            assert type(picked).__name__ == "GentlePickUpAction"
            assert (picked.arm, picked.grasp, picked.force) == (Arms.RIGHT, Grasp.TOP, 0.5)  # type: ignore[attr-defined]
            assert picked.object.dtype == "BelieveObject"
            assert picked.object.pose is not None
            assert (picked.object.name, picked.object.pose.position.z) == ("cup", 3.0)


async def test_a_memory_that_only_records_generates_no_class(tmp_path: Path) -> None:
    identities = Designator.__mapper__.polymorphic_map
    before = set(identities)
    async with Memory.open(url_of(tmp_path)) as memory:
        await NoteActionPerformable("a").perform()
        await memory.flush()
        assert set(identities) == before
        mapped = memory.mapped(NoteActionPerformable)
        assert set(identities) - before == {mapped.__mapper__.polymorphic_identity}


async def test_a_process_that_lacks_the_class_still_reads_its_rows(tmp_path: Path) -> None:
    async with Memory.open(url_of(tmp_path)):
        await NoteActionPerformable("seen").perform()
    script = (
        "import asyncio, sys\n"
        "from sqlalchemy import select\n"
        "from pycrorm_async import Reading\n"
        "from pycrorm_async.orm import Action, Designator, TaskTreeNode\n"
        "async def main():\n"
        "    async with Reading.open(sys.argv[1]) as reading, reading.session() as session:\n"
        "        for kind in (Action, Designator):\n"
        "            (note,) = (await session.scalars(select(kind))).all()\n"
        "            print(type(note).__name__, note.dtype, note.text)\n"
        "        nodes = (await session.scalars(select(TaskTreeNode).order_by(TaskTreeNode.id))).all()\n"
        "        print([node.action.text if node.action else None for node in nodes])\n"
        "asyncio.run(main())\n"
    )
    done = await asyncio.to_thread(run_script, script, url_of(tmp_path))
    assert done.stdout.splitlines() == [
        "NoteAction NoteAction seen",
        "NoteAction NoteAction seen",
        "[None, 'seen']",
    ], done.stderr


async def test_a_plain_engine_sees_an_unknown_type_as_an_action_with_its_parameters(tmp_path: Path) -> None:
    from sqlalchemy.ext.asyncio import AsyncSession, create_async_engine

    async with Memory.open(url_of(tmp_path)):
        await NoteActionPerformable("seen").perform()
    engine = create_async_engine(f"sqlite+aiosqlite:///{tmp_path}/memory.db")
    async with AsyncSession(engine) as session:
        note = (await session.scalars(select(Action).options(undefer(Action.parameters)))).one()
        assert type(note) is Action
        assert (note.dtype, note.parameters) == ("NoteAction", {"text": "seen"})
        assert (await session.scalars(select(Designator))).one() is note
    await engine.dispose()


class ORMShout(Action):
    """A user's mapped class whose table has the natural name of the type."""

    __tablename__ = "shout_action"

    text: Mapped[str]


@dataclass
class ShoutActionPerformable(ActionAbstract):
    text: str
    orm_class = ORMShout

    async def perform(self) -> None:
        """Succeed without doing anything."""


async def test_a_users_mapped_class_may_have_the_natural_table(tmp_path: Path) -> None:
    async with Memory.open(url_of(tmp_path)) as memory:
        await ShoutActionPerformable("hey").perform()
        await memory.flush()
        async with memory.session() as session:
            assert [each.text for each in await session.scalars(select(ORMShout))] == ["hey"]
            assert [type(each) for each in await session.scalars(select(Action))] == [ORMShout]


@dataclass
class CountActionPerformable(ActionAbstract):
    big: int | None
    small: float | None
    sure: bool | None

    async def perform(self) -> None:
        """Succeed without doing anything."""


async def test_a_frame_keeps_integers_and_truth_values_where_others_are_missing(tmp_path: Path) -> None:
    async with Memory.open(url_of(tmp_path)) as memory:
        async with memory.episode(description="e"):
            await CountActionPerformable(2**53 + 1, 0.1, True).perform()
            await CountActionPerformable(None, None, None).perform()
        await memory.flush()
        counted = memory.mapped(CountActionPerformable)
        question = select(counted.big, counted.small, counted.sure).order_by(counted.id)
        frame = await memory.dataframe(question)
        assert [str(dtype) for dtype in frame.dtypes] == ["Int64", "float64", "boolean"]
        assert frame.big[0] == 2**53 + 1
        assert (frame.small[0], frame.sure[0]) == (0.1, True)
        assert frame.isna().sum().to_list() == [1, 1, 1]
        whole = await memory.dataframe(question.where(counted.big.is_not(None)))
        assert [str(dtype) for dtype in whole.dtypes] == ["int64", "float64", "bool"]
