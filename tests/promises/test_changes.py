"""Newer programs continue the memory of an older one: the recipes of the README, on the golden memory.

Version 0.1.0 wrote the golden memory; the expected content is written here by hand.
"""

from __future__ import annotations

import asyncio
import shutil
from dataclasses import dataclass
from pathlib import Path
from typing import Any, ClassVar

import msgspec
import pytest
from sqlalchemy import select

from pycrorm_async import Memory, Reading
from pycrorm_async.errors import DatabaseForeign
from pycrorm_async.events.codec import UPCASTERS, Decoder, Upcaster
from pycrorm_async.events.types import EVENT_TYPES, ObjectAdded
from pycrorm_async.operations.copy import copy_episodes
from pycrorm_async.operations.rebuild import rebuild_memory
from pycrorm_async.operations.recovery import recover
from pycrorm_async.orm import Action
from pycrorm_async.plan import ActionAbstract
from pycrorm_async.projections import fold
from pycrorm_async.projections.verify import verify
from pycrorm_async.store.address import DatabaseAddress
from pycrorm_async.store.dialects import dialect_of
from pycrorm_async.store.log import EventLog
from pycrorm_async.world import Arms
from tests.databases import ask
from tests.golden.unpacking import unpack_memory_v1
from tests.store.factories import declaration, episode, run_of
from tests.table_comparison import differences, tables_of

pytestmark = pytest.mark.slow


@pytest.fixture(scope="module")
def rebuilt(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """A folder with the golden memory and the tables of this version of the fold, which tests copy."""
    folder = tmp_path_factory.mktemp("rebuilt")
    asyncio.run(rebuild_memory(unpack_memory_v1(folder)))
    return folder


@pytest.fixture
def golden(rebuilt: Path, tmp_path: Path) -> str:
    """The golden memory with the tables of this version of the fold."""
    shutil.copytree(rebuilt, tmp_path, dirs_exist_ok=True)
    return f"sqlite:///{tmp_path}/memory.db"


def id_of(number: int, sequence: int) -> int:
    return number * 2**31 + sequence * 2**5


# --- the classes of a later program: all of them were once `GreetAction(whom: str, loudness: float, hand: Arms)` ------


def greeting(**fields: Any) -> type[Any]:
    """Return a `GreetAction` with these fields."""

    async def perform(self: Any) -> None:
        """Succeed without doing anything."""

    body = {"__annotations__": fields, "perform": perform, "__module__": __name__}
    return dataclass(type("GreetActionPerformable", (ActionAbstract,), body))


@dataclass
class WelcomeActionPerformable(ActionAbstract):
    """GreetAction under a new name, with one field removed and one added."""

    aliases: ClassVar[tuple[str, ...]] = ("GreetAction",)

    whom: str
    hand: Arms
    language: str

    async def perform(self) -> None:
        """Succeed without doing anything."""


@dataclass
class HelloActionPerformable(ActionAbstract):
    """The same class again, whose author kept the dtype of the memories."""

    dtype = "GreetAction"

    whom: str

    async def perform(self) -> None:
        """Succeed without doing anything."""


async def performed(url: str, *designators: ActionAbstract) -> None:
    """Perform each in an episode of its own, behind those of the dead recorder, until all of them are in the tables."""
    await recover(url)
    async with Memory.open(url) as memory:
        for each in designators:
            await each.perform()
        await memory.flush()
        assert memory.status.faults.total == 0, memory.status.faults.last
        assert memory.status.unadopted == {}


async def designators_of(url: str, name: str | type, *fields: str) -> list[tuple[Any, ...]]:
    """Return these fields of all designators of a type, in order, each with its recorded dtype."""
    async with Reading.open(url) as reading, reading.session() as session:
        mapped: Any = reading.mapped(name)
        rows = (await session.scalars(select(mapped).order_by(mapped.id))).all()
        return [(row.dtype, *(getattr(row, field) for field in fields)) for row in rows]


ADA, CLEO, DORA = ("GreetAction", "Ada"), ("GreetAction", "Cleo"), ("GreetAction", "Dora")


# --- the content of the golden memory ---------------------------------------------------------------------------------


@pytest.fixture(params=["sqlite", "postgresql"])
async def every_event(request: pytest.FixtureRequest, golden: str) -> str:
    """Return the golden database with its spool adopted, in place or copied to a server."""
    done = await recover(golden)
    assert (done.failed, len(done.lost)) == ({}, 1)
    if request.param == "sqlite":
        return golden
    url: str = request.getfixturevalue("server").new_database()
    copied = await copy_episodes(golden, url)
    assert [(each.copied, each.damage, each.stopped) for each in copied.episodes] == [
        (18, None, None), (4, None, None), (6, None, None),
    ]  # fmt: skip
    return url


@pytest.mark.soak_on("postgresql")
@pytest.mark.soak_on("sqlite")
async def test_a_memory_of_the_first_version_has_all_its_rows_and_its_spool_is_adopted(every_event: str) -> None:
    t0 = 1_700_000_000_000_000
    assert ask(every_event, "SELECT number, head, folded, parked, refused FROM episode ORDER BY 1") == [
        (1, 18, 18, None, None), (2, 4, 4, None, None), (3, 6, 6, None, None),
    ]  # fmt: skip
    assert ask(
        every_event, "SELECT id, description, created_by, status, created_at FROM process_metadata ORDER BY 1"
    ) == [(1, "Everything once", "ada", "SUCCEEDED", t0 + 1_000_000), (3, "Cut short", "ada", "LOST", t0 + 1_000_000)]
    assert ask(every_event, "SELECT id, parent_id, dtype, status, failure_message FROM task_tree_node ORDER BY id") == [
        (id_of(1, 4), None, None, "SUCCEEDED", None),
        (id_of(1, 5), id_of(1, 4), "PickUpAction", "SUCCEEDED", None),
        (id_of(1, 6), id_of(1, 5), "GreetAction", "FAILED", "no answer"),
        (id_of(3, 2), None, None, "LOST", None),
        (id_of(3, 3), id_of(3, 2), "GreetAction", "SUCCEEDED", None),
        (id_of(3, 5), id_of(3, 2), "GreetAction", "LOST", None),
    ]
    assert ask(every_event, "SELECT id, whom, loudness, hand FROM greet_action ORDER BY id") == [
        (id_of(1, 6), "Ada", 0.25, "RIGHT"), (id_of(3, 3), "Cleo", 0.5, "LEFT"), (id_of(3, 5), "Dora", 0.75, "RIGHT"),
    ]  # fmt: skip
    assert ask(every_event, "SELECT id, arm, grasp, object_designator_id FROM pick_up_action") == [
        (id_of(1, 5), "LEFT", "FRONT", id_of(1, 2))
    ]
    assert ask(every_event, "SELECT id, name, obj_type, identity_id, node_id FROM object ORDER BY id") == [
        (id_of(1, 2), "milk", "MILK", id_of(1, 2), None),
        (id_of(1, 3), "pr2", "ROBOT", id_of(1, 3), None),
        (id_of(1, 12), "milk", "MILK", id_of(1, 2), id_of(1, 5)),
    ]
    assert ask(every_event, "SELECT kind, parent_id, child_id, link FROM attachment ORDER BY id") == [
        ("attached", id_of(1, 3), id_of(1, 2), "l_gripper_tool_frame"), ("detached", id_of(1, 3), id_of(1, 12), None),
    ]  # fmt: skip
    assert ask(every_event, "SELECT joint, position FROM joint_change") == [("torso_lift_joint", 1e-9)]
    assert ask(every_event, "SELECT object_id FROM object_removal") == [(id_of(1, 12),)]
    assert ask(every_event, "SELECT channel, value FROM state_sample") == [("base.x", 0.6)]
    assert ask(every_event, "SELECT name, source, visible, confidence FROM detection") == [
        ("milk", "camera", 0.75, None)
    ]
    assert ask(every_event, "SELECT considered, offered, taken FROM location_resolution") == [(17, 2, 0)]
    assert ask(every_event, "SELECT x, arms, grasp FROM location_candidate ORDER BY position") == [
        (0.5, "LEFT,RIGHT", "FRONT"), (0.6, "", None),
    ]  # fmt: skip
    before = tables_of(every_event)
    await rebuild_memory(every_event)
    assert differences(before, tables_of(every_event)) == []
    log = await EventLog.open(DatabaseAddress.parse(every_event), create=False)
    verified = await verify(log)
    await log.close()
    assert (verified.episodes, verified.events, verified.damages, verified.differences) == (3, 28, [], [])


async def test_a_newer_program_migrates_an_open_log_and_older_programs_cannot_open_it_again(
    database_url: str, monkeypatch: pytest.MonkeyPatch
) -> None:
    address = DatabaseAddress.parse(database_url)
    older = await EventLog.open(address, create=True)
    await older.append([declaration(b'{"dtype":"A"}'), *run_of(episode(1), 1, 3)])
    schema = "" if address.is_sqlite else "pycrorm."
    second = (f"ALTER TABLE {schema}episode ADD COLUMN robot text", f"CREATE INDEX by_robot ON {schema}episode (robot)")
    dialect = dialect_of(older.engine)
    with monkeypatch.context() as patch:
        patch.setattr(dialect, "migrations", (*dialect.migrations, second))
        newer = await EventLog.open(address, create=True)
    await newer.close()
    assert newer.log_id == older.log_id
    assert (
        await older.append([declaration(b'{"dtype":"B"}'), *run_of(episode(1), 4, 6), *run_of(episode(2), 1, 2)]) == {}
    )
    assert [(each.number, each.head) for each in await older.episodes()] == [(1, 6), (2, 2)]
    await older.close()
    assert ask(database_url, "SELECT count(*) FROM event") == [(8,)]
    for create in (True, False):
        with pytest.raises(DatabaseForeign, match=r"its format is 2, this version reads 1$"):
            await EventLog.open(address, create=create)


# --- a designator with changed fields ---------------------------------------------------------------------------------


async def test_an_added_field_is_null_in_old_rows_and_a_removed_one_in_new_ones(golden: str) -> None:
    greet = greeting(whom=str | None, language=str, loudness=float)  # `hand` is removed, `whom` is optional
    await performed(golden, greet(None, "en", 1.0))
    expected = [(*ADA, "RIGHT", None), (*CLEO, "LEFT", None), (*DORA, "RIGHT", None), ("GreetAction", None, None, "en")]
    assert await designators_of(golden, "GreetAction", "whom", "hand", "language") == expected
    before = tables_of(golden)
    await rebuild_memory(golden)
    assert differences(before, tables_of(golden)) == []
    assert await designators_of(golden, greet, "whom", "hand", "language") == expected


# --- a renamed designator ---------------------------------------------------------------------------------------------


async def test_a_class_that_keeps_its_dtype_keeps_its_rows(golden: str) -> None:
    await performed(golden, HelloActionPerformable("Eve"))
    expected = [ADA, CLEO, DORA, ("GreetAction", "Eve")]
    assert await designators_of(golden, HelloActionPerformable, "whom") == expected


async def test_a_class_with_an_alias_has_the_rows_recorded_under_either_name(golden: str) -> None:
    await performed(golden, WelcomeActionPerformable("Eve", Arms.BOTH, "en"))
    expected = [
        (*ADA, "RIGHT", None, 0.25),
        (*CLEO, "LEFT", None, 0.5),
        (*DORA, "RIGHT", None, 0.75),
        ("WelcomeAction", "Eve", "BOTH", "en", None),
    ]
    for _ in range(2):
        for name in ("WelcomeAction", "GreetAction", WelcomeActionPerformable, "welcome_action", "greet_action"):
            assert await designators_of(golden, name, "whom", "hand", "language", "loudness") == expected, name
        await rebuild_memory(golden)
    async with Reading.open(golden) as reading, reading.session() as session:
        actions = (await session.scalars(select(Action).order_by(Action.id))).all()
        names = ["PickUpAction", *["WelcomeAction"] * 4]
        assert [type(each).__name__ for each in actions] == names
        assert reading.mapped("GreetAction") is reading.mapped("WelcomeAction")
    assert ask(golden, "SELECT count(*) FROM greet_action") == ask(golden, "SELECT count(*) FROM welcome_action")


async def test_rows_of_an_old_program_that_still_records_have_the_new_name(golden: str) -> None:
    await performed(golden, WelcomeActionPerformable("Eve", Arms.BOTH, "en"))
    await performed(golden, greeting(whom=str, loudness=float)("Flo", 1.0))
    welcomed = [(dtype, whom) for dtype, whom in await designators_of(golden, "WelcomeAction", "whom")]
    assert welcomed == [ADA, CLEO, DORA, ("WelcomeAction", "Eve"), ("GreetAction", "Flo")]


async def test_an_open_memory_learns_the_new_name_and_keeps_the_class_that_it_returned(golden: str) -> None:
    await recover(golden)
    async with Reading.open(golden) as reading:
        greet: Any = reading.mapped("GreetAction")
        await performed(golden, WelcomeActionPerformable("Eve", Arms.BOTH, "en"))
        async with reading.session() as session:
            assert reading.mapped("WelcomeAction") is greet
            rows: list[Any] = list(await session.scalars(select(greet).order_by(greet.id)))
            assert [(row.whom, row.language) for row in rows] == [
                ("Ada", None), ("Cleo", None), ("Dora", None), ("Eve", "en"),
            ]  # fmt: skip


# --- an event with a changed shape ------------------------------------------------------------------------------------


class Weighed(ObjectAdded, frozen=True, kw_only=True):
    """A second shape of ObjectAdded: names are upper case, and every object has a mass."""

    version = 2

    mass_kg: float


def weighed(old: dict[str, Any]) -> dict[str, Any]:
    return old | {"name": old["name"].upper(), "mass_kg": 1.0}


STEPS: dict[tuple[str, int], Upcaster] = {**UPCASTERS, ("ObjectAdded", 1): weighed}


async def test_an_upcaster_serves_fold_rebuild_and_snapshots_of_older_events(
    golden: str, monkeypatch: pytest.MonkeyPatch
) -> None:
    names = "SELECT name FROM object ORDER BY id"
    assert ask(golden, names) == [("milk",), ("pr2",), ("milk",)]
    later = Decoder(EVENT_TYPES | {"ObjectAdded": Weighed}, STEPS)
    monkeypatch.setattr(fold, "_decode", later.decode)
    await rebuild_memory(golden)
    assert ask(golden, names) == [("MILK",), ("PR2",), ("milk",)]
    async with Reading.open(golden) as reading:
        moment = await reading.as_of(1, sequence=4)
    assert sorted(each.name for each in moment.world.objects) == ["MILK", "PR2"]
    log = await EventLog.open(DatabaseAddress.parse(golden), create=False)
    assert msgspec.json.decode((await log.events(1))[1].payload)["name"] == "milk"  # the log is unchanged
    await log.close()
