"""A memory as its user meets it: opened, recorded into, asked, closed; with others beside it."""

import asyncio
import contextvars
import os
import sqlite3
import subprocess
import sys
import threading
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import pytest
from sqlalchemy import ForeignKey, func, select
from sqlalchemy.orm import Mapped, mapped_column, undefer

from pycrorm_async import Memory, Reading, Settings, UserView
from pycrorm_async.errors import (
    CallerError,
    DatabaseError,
    DatabaseForeign,
    DatabaseUnavailable,
    EpisodeParked,
    FlushTimeout,
    SpoolForeign,
    UnknownEpisode,
    UnknownUrl,
)
from pycrorm_async.events.codec import encode, fingerprint
from pycrorm_async.events.envelope import Heading
from pycrorm_async.events.happenings import NodeStarted
from pycrorm_async.orm import Action, Designator, PickUpAction, ProcessMetaData, TaskTreeNode
from pycrorm_async.plan import ActionAbstract, PickUpActionPerformable, PlanFailure
from pycrorm_async.plan.objects import BelieveObject
from pycrorm_async.plan.ports import recorder
from pycrorm_async.plan.task_tree import TaskStatus
from pycrorm_async.world import Arms, Grasp, ObjectType, Pose
from pycrorm_async.world.watch import watcher
from tests.commands import environment


@dataclass
class NoteActionPerformable(ActionAbstract):
    text: str

    async def perform(self) -> None:
        """Noted."""


@dataclass
class GentlePickUpActionPerformable(PickUpActionPerformable):
    force: float = 1.0

    async def perform(self) -> None:
        """Lifts nothing: this is about what is remembered."""


async def texts(memory: Memory | Reading) -> list[str]:
    async with memory.session() as session:
        notes: Any = memory.mapped(NoteActionPerformable)
        return list(await session.scalars(select(notes.text).order_by(notes.id)))


def url_of(folder: Path) -> str:
    return f"sqlite:///{folder}/memory.db"


async def test_a_private_memory_answers_and_leaves_nothing_behind() -> None:
    place = Path("/dev/shm")
    before = {path.name for path in place.glob("pycrorm-*/")}
    async with Memory.open("sqlite://") as memory:
        await NoteActionPerformable("gone soon").perform()
        await memory.flush()
        assert await texts(memory) == ["gone soon"]
        assert {path.name for path in place.glob("pycrorm-*/")} - before
    assert {path.name for path in place.glob("pycrorm-*/")} <= before


async def test_what_is_flushed_is_in_the_tables_and_in_the_database_file(tmp_path: Path) -> None:
    async with Memory.open(url_of(tmp_path)) as memory:
        async with memory.episode(description="e"):
            await NoteActionPerformable("a").perform()
            await memory.flush()
            assert await texts(memory) == ["a"]
            with sqlite3.connect(tmp_path / "memory.db") as plain:
                rows = plain.execute("SELECT text, status FROM note_action JOIN task_tree_node USING (id)").fetchall()
                assert rows == [("a", "SUCCEEDED")]
            plain.close()
            await NoteActionPerformable("b").perform()
        status = memory.status
        assert status.written >= status.synced >= status.stored
        assert status.faults.total == 0
    async with Reading.open(url_of(tmp_path)) as reading:
        assert await texts(reading) == ["a", "b"]


async def test_a_memory_goes_on_where_an_earlier_one_ended(tmp_path: Path) -> None:
    for text in ("one", "two", "three"):
        async with Memory.open(url_of(tmp_path)):
            await NoteActionPerformable(text).perform()
    async with Reading.open(url_of(tmp_path)) as reading:
        assert await texts(reading) == ["one", "two", "three"]
        assert [each.number for each in await reading.episodes()] == [1, 2, 3]


async def test_recording_ends_with_the_memory(tmp_path: Path) -> None:
    async with Memory.open(url_of(tmp_path)):
        await NoteActionPerformable("inside").perform()
    assert recorder.get() is None
    assert watcher.get() is None
    await NoteActionPerformable("outside").perform()
    async with Reading.open(url_of(tmp_path)) as reading:
        assert await texts(reading) == ["inside"]


async def test_what_is_performed_goes_to_the_memory_whose_episode_is_open(tmp_path: Path) -> None:
    first, second = f"sqlite:///{tmp_path}/1.db", f"sqlite:///{tmp_path}/2.db"
    async with Memory.open(first) as one, Memory.open(second) as two:
        await NoteActionPerformable("to the last opened").perform()
        async with one.episode(description="e"):
            await NoteActionPerformable("to the one with the episode").perform()
        await NoteActionPerformable("to the last opened again").perform()
        await one.flush()
        await two.flush()
        assert await texts(one) == ["to the one with the episode"]
        assert await texts(two) == ["to the last opened", "to the last opened again"]


async def test_an_exception_of_the_plan_leaves_the_memory_unchanged_and_is_recorded(tmp_path: Path) -> None:
    with pytest.raises(PlanFailure, match="spilled"):
        async with Memory.open(url_of(tmp_path)) as memory, memory.episode(description="e"):
            await NoteActionPerformable("a").perform()
            raise PlanFailure("spilled")
    async with Reading.open(url_of(tmp_path)) as reading:
        (episode,) = await reading.episodes()
        assert (episode.status, episode.nodes) == ("FAILED", 2)
        async with reading.session() as session:
            metadata = (await session.scalars(select(ProcessMetaData))).one()
            assert metadata.failure_type == "pycrorm_async.plan.failures.PlanFailure"
            assert metadata.failure_message == "spilled"


async def test_a_memory_closed_inside_an_episode_ends_it_as_interrupted(tmp_path: Path) -> None:
    memory = Memory.open(url_of(tmp_path))
    await memory.__aenter__()
    opened = memory.episode(description="e")
    await opened.__aenter__()
    await NoteActionPerformable("a").perform()
    await memory.__aexit__(None, None, None)
    await opened.__aexit__(None, None, None)
    async with Reading.open(url_of(tmp_path)) as reading:
        assert [each.status for each in await reading.episodes()] == ["INTERRUPTED"]


async def test_a_memory_that_is_not_open_says_how_to_open_it(tmp_path: Path) -> None:
    memory = Memory.open(url_of(tmp_path))
    with pytest.raises(CallerError, match=r"async with Memory\.open"):
        await memory.flush()
    async with memory:
        pass
    with pytest.raises(CallerError, match=r"async with Memory\.open"):
        async with memory.episode(description="e"):
            pass


async def test_bad_addresses_are_refused_with_their_class(tmp_path: Path) -> None:
    with pytest.raises(UnknownUrl):
        Memory.open("mysql://lab/memory")
    for url, error in (
        (f"sqlite:///{tmp_path}/none/memory.db", DatabaseUnavailable),
        ("postgresql://ada:secret@lab/memory", DatabaseUnavailable),
    ):
        with pytest.raises(error) as refused:
            async with Memory.open(url):
                pass
        assert "secret" not in str(refused.value)
    (tmp_path / "text.db").write_text("no database at all, and rather more than a hundred bytes of it" * 10)
    with pytest.raises(DatabaseForeign):
        async with Memory.open(f"sqlite:///{tmp_path}/text.db"):
            pass
    assert not (tmp_path / "text.db.spool").exists()
    assert recorder.get() is None


async def test_a_spool_belongs_to_one_database(tmp_path: Path) -> None:
    async with Memory.open(f"sqlite:///{tmp_path}/1.db", spool=tmp_path / "spool"):
        await NoteActionPerformable("a").perform()
    with pytest.raises(SpoolForeign):
        async with Memory.open(f"sqlite:///{tmp_path}/2.db", spool=tmp_path / "spool"):
            pass


async def test_the_next_memory_adopts_what_a_killed_process_left(tmp_path: Path) -> None:
    script = (
        "import asyncio, os, signal, sys\n"
        "from tests.memory.test_memory import Memory, NoteActionPerformable\n"
        "async def main():\n"
        "    async with Memory.open(sys.argv[1]) as memory, memory.episode(description='killed'):\n"
        "        for index in range(50):\n"
        "            await NoteActionPerformable(str(index)).perform()\n"
        "        os.kill(os.getpid(), signal.SIGKILL)\n"
        "asyncio.run(main())\n"
    )
    done = await asyncio.to_thread(
        subprocess.run, [sys.executable, "-c", script, url_of(tmp_path)], env=environment(), check=False
    )
    assert done.returncode == -9
    async with Memory.open(url_of(tmp_path)) as memory:
        await NoteActionPerformable("after").perform()
        for _ in range(200):
            await memory.flush()
            found = await texts(memory)
            if len(found) == 51:
                break
            await asyncio.sleep(0.05)
        assert sorted(found) == sorted([*map(str, range(50)), "after"])
        lost = [each for each in await memory.reading.episodes() if each.description == "killed"]
        assert [each.status for each in lost] == ["LOST"]
    assert [path for path in (tmp_path / "memory.db.spool").iterdir() if path.is_dir()] == []


async def test_a_flush_that_cannot_reach_the_database_gives_up_and_loses_nothing(tmp_path: Path) -> None:
    settings = Settings(flush_timeout_s=0.3)
    async with Memory.open(url_of(tmp_path), settings=settings) as memory:
        await NoteActionPerformable("before").perform()
        await memory.flush()
        other = sqlite3.connect(tmp_path / "memory.db", isolation_level=None)
        other.execute("BEGIN IMMEDIATE")
        await NoteActionPerformable("meanwhile").perform()
        with pytest.raises(FlushTimeout, match="safe in the spool"):
            await memory.flush()
        other.execute("ROLLBACK")
        other.close()
        for _ in range(100):
            try:
                await memory.flush()
                break
            except FlushTimeout:
                continue
        assert await texts(memory) == ["before", "meanwhile"]


async def test_a_type_that_contradicts_the_tables_parks_its_episode_with_both_types_named(tmp_path: Path) -> None:
    async with Memory.open(url_of(tmp_path)):
        await NoteActionPerformable("text").perform()

    def other() -> type[ActionAbstract]:
        @dataclass
        class NoteActionPerformable(ActionAbstract):
            text: int

            async def perform(self) -> None:
                """Noted."""

        return NoteActionPerformable

    with pytest.raises(EpisodeParked, match=r"text.*integer|integer.*text"):
        async with Memory.open(url_of(tmp_path)) as memory:
            await other()(7).perform()  # type: ignore[call-arg]
            await memory.flush()
    async with Memory.open(url_of(tmp_path)) as memory:  # an episode that stopped earlier stops nobody
        await NoteActionPerformable("later").perform()
        await memory.flush()
        assert await texts(memory) == ["text", "later"]


async def test_a_view_of_ones_own_lives_beside_the_tables(tmp_path: Path) -> None:
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


async def test_a_subclass_of_an_action_is_found_as_that_action(tmp_path: Path) -> None:
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


async def test_a_process_that_lacks_the_class_sees_its_rows_all_the_same(tmp_path: Path) -> None:
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
    done = await asyncio.to_thread(
        subprocess.run,
        [sys.executable, "-c", script, url_of(tmp_path)],
        env=environment(),
        capture_output=True,
        text=True,
        check=False,
    )
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


async def test_a_cancelled_node_says_so(tmp_path: Path) -> None:
    @dataclass
    class WaitActionPerformable(ActionAbstract):
        async def perform(self) -> None:
            begun.set()
            await asyncio.sleep(60)

    begun = asyncio.Event()
    async with Memory.open(url_of(tmp_path)) as memory:
        async with memory.episode(description="e"):
            task = asyncio.create_task(WaitActionPerformable().perform())
            await begun.wait()
            task.cancel()
            with pytest.raises(asyncio.CancelledError):
                await task
        await memory.flush()
        async with memory.session() as session:
            node = (await session.scalars(select(TaskTreeNode).where(TaskTreeNode.dtype == "WaitAction"))).one()
            assert node.status == TaskStatus.CANCELLED
            assert node.reason == "CancelledError"


async def test_concurrent_episodes_in_tasks_of_their_own_are_all_whole(tmp_path: Path) -> None:
    async def run(name: str) -> None:
        async with memory.episode(description=name):
            for index in range(20):
                await NoteActionPerformable(f"{name}{index}").perform()
                await asyncio.sleep(0)

    async with Memory.open(url_of(tmp_path)) as memory:
        await asyncio.gather(*(run(name) for name in "abcde"))
        await memory.flush()
        found = await memory.reading.episodes()
        assert sorted(each.description for each in found) == list("abcde")
        for each in found:
            nodes = await memory.reading.tree(each.number)
            assert [node.parameters.get("text") for node in nodes] == [None] + [
                f"{each.description}{index}" for index in range(20)
            ]
        with pytest.raises(UnknownEpisode):
            await memory.reading.episode("nothing")


async def test_importing_the_package_loads_nothing_else() -> None:
    script = (
        "import sys, pycrorm_async; print([name for name in sys.modules if 'sqlalchemy' in name or 'bullet' in name])"
    )
    done = await asyncio.to_thread(
        subprocess.run, [sys.executable, "-c", script], env=environment(), capture_output=True, text=True, check=False
    )
    assert done.stdout == "[]\n", done.stderr
    assert os.environ.get("PYCRORM_URL") is None


async def test_a_memory_opened_inside_an_episode_of_another_leaves_that_episode_whole(tmp_path: Path) -> None:
    outer, inner = f"sqlite:///{tmp_path}/1.db", f"sqlite:///{tmp_path}/2.db"
    async with Memory.open(outer) as one:
        async with one.episode(description="outer"):
            await NoteActionPerformable("1").perform()
            async with Memory.open(inner) as two:
                await NoteActionPerformable("2").perform()
                await two.flush()
                assert await texts(two) == ["2"]
            await NoteActionPerformable("3").perform()
        await one.flush()
        assert [each.description for each in await one.reading.episodes()] == ["outer"]
        assert await texts(one) == ["1", "3"]


async def test_a_forked_child_leaves_the_memory_of_its_parent_alone(tmp_path: Path) -> None:
    script = (
        "import asyncio, os, sys\n"
        "from tests.memory.test_memory import Memory, NoteActionPerformable\n"
        "async def main():\n"
        "    async with Memory.open(sys.argv[1]) as memory, memory.episode(description='parent'):\n"
        "        await NoteActionPerformable('before').perform()\n"
        "        child = os.fork()\n"
        "        if child == 0:\n"
        "            await NoteActionPerformable('in the child').perform()\n"
        "            os._exit(7)\n"  # the way every worker of multiprocessing leaves
        "        _, status = os.waitpid(child, 0)\n"
        "        assert os.waitstatus_to_exitcode(status) == 7\n"
        "        await NoteActionPerformable('after').perform()\n"
        "asyncio.run(main())\n"
    )
    done = await asyncio.to_thread(
        subprocess.run,
        [sys.executable, "-c", script, url_of(tmp_path)],
        env=environment(),
        capture_output=True,
        text=True,
        timeout=60,
        check=False,
    )
    assert (done.returncode, done.stderr) == (0, "")
    async with Reading.open(url_of(tmp_path)) as reading:
        assert await texts(reading) == ["before", "after"]
        assert [each.status for each in await reading.episodes()] == ["SUCCEEDED"]


async def test_what_outlives_the_memory_runs_on_and_is_not_recorded(tmp_path: Path) -> None:
    leave = asyncio.Event()

    async def late() -> str:
        await NoteActionPerformable("early").perform()
        await leave.wait()
        await NoteActionPerformable("late").perform()
        return "ran"

    async with Memory.open(url_of(tmp_path)) as memory:
        task = asyncio.create_task(late())
        await asyncio.sleep(0.1)
        assert memory.status.faults.total == 0
    leave.set()
    assert await task == "ran"
    async with Reading.open(url_of(tmp_path)) as reading:
        assert await texts(reading) == ["early"]


@pytest.mark.parametrize(
    ("arguments", "named"),
    [
        ({"seed": 2**63}, "seed"),
        ({"seed": "x"}, "seed"),
        ({"seed": 1.5}, "seed"),
        ({"description": 5}, "description"),
        ({"description": "x" * 3_000_000}, "description"),
        ({"plan": "x" * 3_000_000}, "plan"),
    ],
)
async def test_what_an_episode_cannot_be_opened_with_is_refused_by_name(
    tmp_path: Path, arguments: dict[str, Any], named: str
) -> None:
    async with Memory.open(url_of(tmp_path)) as memory:
        with pytest.raises(CallerError, match=f"the {named} of an episode must be"):
            async with memory.episode(**arguments):
                pass
        async with memory.episode(description="fine", seed=-1):
            await NoteActionPerformable("a").perform()
        await memory.flush()
        assert [each.description for each in await memory.reading.episodes()] == ["fine"]


@pytest.mark.parametrize(
    "arguments", [{"on_full": "waait"}, {"on_unrecordable": ""}, {"batch_events_max": 0}, {"flush_timeout_s": -1.0}]
)
def test_a_setting_that_cannot_work_is_refused_by_name(arguments: dict[str, Any]) -> None:
    with pytest.raises(CallerError, match=rf"Settings\.{next(iter(arguments))} is "):
        Settings(**arguments)


async def test_nothing_of_a_memory_that_is_not_open_is_an_attribute_error(tmp_path: Path) -> None:
    memory = Memory.open(url_of(tmp_path))
    for use in (
        lambda: memory.status,
        lambda: memory.reading,
        memory.session,
        lambda: memory.mapped("NoteAction"),
        lambda: memory.recent_episodes,
    ):
        with pytest.raises(CallerError, match=r"async with Memory\.open"):
            use()


async def test_a_parked_episode_is_told_once(tmp_path: Path) -> None:
    def other() -> Any:
        @dataclass
        class NoteActionPerformable(ActionAbstract):
            text: int

            async def perform(self) -> None:
                """Noted."""

        return NoteActionPerformable

    async with Memory.open(url_of(tmp_path)):
        await NoteActionPerformable("text").perform()
    async with Memory.open(url_of(tmp_path)) as memory:
        await other()(7).perform()
        with pytest.raises(EpisodeParked):
            await memory.flush()
        await memory.flush()
        assert memory.status.faults.total == 0


async def test_memories_closed_in_another_order_than_opened_record_what_is_theirs(tmp_path: Path) -> None:
    one, two = Memory.open(f"sqlite:///{tmp_path}/1.db"), Memory.open(f"sqlite:///{tmp_path}/2.db")
    await one.__aenter__()
    await two.__aenter__()
    await one.__aexit__(None, None, None)
    await NoteActionPerformable("to the second").perform()
    await two.flush()
    assert await texts(two) == ["to the second"]
    await two.__aexit__(None, None, None)
    assert recorder.get() is None
    assert watcher.get() is None


async def test_an_opening_that_fails_or_is_cancelled_leaves_no_thread(tmp_path: Path) -> None:
    def ours() -> set[str]:
        return {each.name for each in threading.enumerate() if each.name.startswith("pycrorm ")}

    before = ours()
    for turns in range(12):
        task = asyncio.create_task(Memory.open(url_of(tmp_path)).__aenter__())
        for _ in range(turns):
            await asyncio.sleep(0.01)
        if task.done():
            await (await task).__aexit__(None, None, None)
            continue
        task.cancel()
        with pytest.raises(asyncio.CancelledError):
            await task
    for _ in range(500):
        if ours() <= before:
            break
        await asyncio.sleep(0.02)
    assert ours() <= before


async def test_a_dropped_plan_that_is_closed_elsewhere_leaves_the_episode_there_alone(tmp_path: Path) -> None:
    @dataclass
    class HangActionPerformable(ActionAbstract):
        async def perform(self) -> None:
            await asyncio.sleep(60)

    async with Memory.open(url_of(tmp_path)) as memory:
        dropped = HangActionPerformable().perform()
        context = contextvars.copy_context()
        context.run(dropped.send, None)
        while recorder.get() is not None and not memory.recent_episodes:
            context.run(dropped.send, None)
        async with memory.episode(description="mine"):
            dropped.close()
            await NoteActionPerformable("here").perform()
        await memory.flush()
        found = {each.description: each.nodes for each in await memory.reading.episodes()}
        assert found == {"HangAction": 2, "mine": 2}


class ORMShout(Action):
    """A mapped class of one's own whose table has the natural name of the type."""

    __tablename__ = "shout_action"

    id: Mapped[int] = mapped_column(ForeignKey(f"{Action.__tablename__}.id"), primary_key=True)
    text: Mapped[str]


@dataclass
class ShoutActionPerformable(ActionAbstract):
    text: str
    orm_class = ORMShout

    async def perform(self) -> None:
        """Shouted."""


async def test_a_mapped_class_of_ones_own_may_have_the_natural_table(tmp_path: Path) -> None:
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
        """Counted."""


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


async def test_a_table_of_the_users_own_in_the_way_is_named_and_nothing_is_lost(tmp_path: Path) -> None:
    async with Memory.open(url_of(tmp_path)) as memory:
        with sqlite3.connect(tmp_path / "memory.db") as plain:
            plain.execute("CREATE TABLE note_action (mine TEXT)")
        await NoteActionPerformable("a").perform()
        with pytest.raises(DatabaseError, match=r"note_action already exists, .* rename yours, then flush again"):
            await memory.flush()
        with plain:
            plain.execute("ALTER TABLE note_action RENAME TO my_notes")
        plain.close()
        await memory.flush()
        assert await texts(memory) == ["a"]


async def test_a_declaration_this_version_cannot_read_parks_its_episode_alone(tmp_path: Path) -> None:
    async with Memory.open(url_of(tmp_path)) as memory:
        queue = memory._now.queue
        payload = b'{"kind":"action","dtype":"DreamAction","table":"dream_action","fields":[{"type":"dream"}]}'
        queue.put_nowait(Heading(None, "DesignatorTypeDeclared", 1), payload)
        with pytest.raises(EpisodeParked, match="cannot read the declaration of its type"):
            async with memory.episode(description="newer") as episode:
                started = NodeStarted("action", 2, fingerprint(payload))
                queue.put_nowait(Heading(episode.id, "NodeStarted", 1), encode(started))
                await memory.flush()
        await NoteActionPerformable("fine").perform()
        await memory.flush()
        assert await texts(memory) == ["fine"]
