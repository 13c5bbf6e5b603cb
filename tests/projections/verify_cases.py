"""Memories to verify, changes of their tables by plain SQL, and a verification in a thread of its own."""

from __future__ import annotations

import asyncio
import threading
from collections.abc import Awaitable, Callable, Sequence
from dataclasses import replace
from typing import Any, NamedTuple

import pytest

from pycrorm_async.events.codec import LOST
from pycrorm_async.events.types import (
    CandidateValue,
    EpisodeEnded,
    EpisodeStarted,
    FailureValue,
    JointsMoved,
    LocationResolved,
    NodeEnded,
    NodeReference,
    NodeStarted,
    ObjectAdded,
    ObjectAttached,
    ObjectDetached,
    ObjectDetected,
    ObjectMoved,
    ObjectReference,
    ObjectRemoved,
    ObjectValue,
    RefusalValue,
    RobotValue,
    SeenValue,
    StateSampled,
)
from pycrorm_async.projections import verify as parts
from pycrorm_async.projections.custom import Projection
from pycrorm_async.projections.findings import VerifyResult
from pycrorm_async.projections.rebuild import Rebuild, claimed, clear
from pycrorm_async.projections.verify import verify
from pycrorm_async.store.address import DatabaseAddress
from pycrorm_async.store.log import EventLog
from tests.databases import ask, ask_to_change, change_each
from tests.projections.event_script import NAVIGATE, PICK_UP, Script, declarations, declared, field, name_of, pose
from tests.projections.sql_queries import stored_and_folded

EVERY = declared(
    "EveryAction",
    "every_action",
    field("count", "integer", 2),
    field("share", "real", 3),
    field("sure", "boolean", 4),
    field("when", "datetime", 5),
    field("words", "list", 6, item="text"),
    field("places", "dict", 7, item="pose"),
    field("things", "list", 8, item="object"),
    field("part", "object", 9),
    field("counts", "list", 10, item="integer"),
)
TYPES = declarations(NAVIGATE, PICK_UP, EVERY)


def full(number: int, *, simulated: bool = False, rounds: int = 1) -> Script:
    """Return an episode with every kind of event, so that every core table has rows; it succeeds."""
    script = Script(number)
    put = script.put
    thought_by = NodeReference("00000000-0000-7000-8000-000000000001", 2) if simulated else None
    put(EpisodeStarted(f"e{number}", "me", "h", "1.0", "3.11", "plan", "a world", 7, simulated, thought_by))
    root = put(NodeStarted("root", simulated=simulated))
    robot = put(ObjectAdded("pr2", "ROBOT", pose(), {"torso": 0.1}))
    for _ in range(rounds):
        _round(script, root, robot, simulated=simulated)
    put(NodeEnded(root, "FAILED", FailureValue("a.PlanFailure", "no more", ["x"])))
    put(EpisodeEnded("FAILED", FailureValue("a.PlanFailure", "no more")))
    return script


def _round(script: Script, root: int, robot: int, *, simulated: bool) -> None:
    put = script.put
    milk = put(ObjectAdded("milk", "MILK", pose(script.episode[-1], 2, 3), {}, root))
    pr2, it = ObjectReference(robot, robot), ObjectReference(milk, milk)
    state = RobotValue(pose(0.1, 0.2, 0), "ROBOT", 0.1, pr2)
    place = {"target_location": pose(1, 1)}
    drive = put(NodeStarted("action", root, name_of(NAVIGATE), place, state, simulated=simulated))
    candidates = (CandidateValue(pose(1, 1), ("LEFT",), "TOP", 0.3), CandidateValue(pose(2, 1), ("RIGHT", "LEFT")))
    put(LocationResolved("CostmapLocation", candidates, 0, 10, drive, (RefusalValue(pose(3, 1), "hidden"),)))
    moved = put(ObjectMoved(robot, "pr2", "ROBOT", pose(1, 1), drive))
    put(NodeEnded(drive, "SUCCEEDED", result={"metres": 2}))
    seen = (
        SeenValue("milk", "MILK", pose(1), it, 0.5),
        SeenValue("jug", "JUG", pose(2)),
        SeenValue("jug?", "JUG", pose(3), confidence=0.25, source="stereo"),
    )
    put(ObjectDetected("camera", "MILK", seen, root))
    parameters = {"object_designator": it, "arm": "LEFT", "grasp": "TOP"}
    pick = put(NodeStarted("action", root, name_of(PICK_UP), parameters, state, simulated=simulated))
    put(JointsMoved(ObjectReference(robot, moved), {"torso": 0.2, "head": -0.5}, pick))
    put(StateSampled(ObjectReference(robot, moved), {"base.x": 0.1, "torso": 0.2}, pick))
    put(ObjectAttached(ObjectReference(robot, moved), it, "tool", pick))
    everything = {
        "count": 3,
        "share": 0.25,
        "sure": True,
        "when": "2026-01-02T03:04:05.000006Z",
        "words": ["a", "b"],
        "places": {"here": pose(1), "there": pose(2)},
        "things": [it, ObjectValue("BelieveObject", "jug", "JUG", pose(3))],
        "part": ObjectValue("ObjectPart", "cap", "CAP", pose(4), it),
        "counts": [1, 2],
    }
    every = put(NodeStarted("action", pick, name_of(EVERY), everything, state, simulated=simulated))
    put(ObjectDetached(ObjectReference(robot, moved), it, "tool", every))
    put(NodeEnded(every, "FAILED", FailureValue("a.IKError", "far", [1])))
    put(NodeEnded(pick, "SUCCEEDED"))
    put(ObjectRemoved(it, root))


def lost(number: int) -> Script:
    """Return the same episode up to a power cut in the middle; recovery has ended it."""
    script = Script(number)
    script.records = full(number).records[:15]
    script.put_payload(EpisodeEnded.__name__, LOST)
    return script


def running(number: int) -> Script:
    """Return the same episode, still running."""
    script = Script(number)
    script.records = full(number).records[:16]
    return script


def parked(number: int) -> Script:
    """Return an episode recorded by a newer version of the program."""
    script = full(number)
    script.records[10] = script.records[10]._replace(type="RobotDanced", payload=b"{}")
    return script


# --- verification -----------------------------------------------------------------------------------------------------


async def look(log: EventLog, *, episode: int | None = None) -> VerifyResult:
    """Verify everything, or one episode."""
    rows = {each.number: each for each in await log.episodes()}
    return await verify(log, episode=None if episode is None else rows[episode])


async def verified(url: str) -> VerifyResult:
    """Verify the memory at this URL, which is not written to."""
    async with await EventLog.open(DatabaseAddress.parse(url), create=False) as log:
        return await verify(log)


def unlock(url: str) -> None:
    """Let the log of a memory be changed."""
    if url.startswith("postgresql:"):
        blobs = [name for (name,) in ask(url, "SELECT relname FROM pg_class WHERE relname = 'pycrorm_blob'")]
        tables = ("event", "episode", "pycrorm_declaration", "pycrorm_digest", *blobs)
        change_each(url, [f"ALTER TABLE pycrorm.{table} DISABLE TRIGGER ALL" for table in tables])
    else:
        triggers = ask(url, "SELECT name FROM sqlite_master WHERE type = 'trigger'")
        change_each(url, [f"DROP TRIGGER {name}" for (name,) in triggers])


def findings(result: VerifyResult) -> tuple[Any, ...]:
    """Sort the findings, so that they do not depend on the parts in which the log was read."""
    whole = replace(result, damages=[], differences=[])
    return (whole, sorted(result.damages, key=repr), sorted(result.differences, key=repr))


async def in_parts(log: EventLog, events: int, monkeypatch: pytest.MonkeyPatch) -> VerifyResult:
    """Verify in parts of about as many events, read in pages of so many."""
    with monkeypatch.context() as patched:
        patched.setattr(parts, "_PART_EVENTS", events)
        patched.setattr(parts, "_PAGE_EVENTS", events)
        return await look(log)


def assert_clean(result: VerifyResult) -> None:
    assert (result.damages, result.differences) == ([], [])
    assert (result.damage, result.drift) == (0, 0)


def in_own_loop(call: Callable[[], Awaitable[None]]) -> None:
    """Run it in a thread with a loop of its own, because Hypothesis cannot await."""
    faults: list[BaseException] = []

    async def awaited() -> None:
        await call()

    def run() -> None:
        try:
            asyncio.run(awaited())
        except BaseException as fault:  # noqa: BLE001 - raised again below
            faults.append(fault)

    thread = threading.Thread(target=run)
    thread.start()
    thread.join()
    if faults:
        raise faults[0]


async def rebuilt(log: EventLog, projection: Projection | None = None) -> None:
    async with claimed(log):
        rebuild = await Rebuild.begin(log, projection=projection)
        await rebuild.show()
        assert await clear(log) == []


async def opened(url: str) -> EventLog:
    return await EventLog.open(DatabaseAddress.parse(url), create=True)


async def fold_in_batches(log: EventLog, scripts: Sequence[Script], events: int) -> None:
    """Store them at once, and fold this many events at a time."""
    records = [*TYPES, *(each for script in scripts for each in script.records)]
    await stored_and_folded(log, records, batch_events=events)


# --- changes of a SQLite file -------------------------------------------------------------------------------------


class VisibleTable(NamedTuple):
    """A table as it is in the database: the types of its columns, and those of its key."""

    name: str
    physical: str
    kinds: dict[str, str]
    key: list[str]


def visible_tables(url: str) -> list[VisibleTable]:
    """Return every table that readers see, queried from the database itself."""
    [(number,)] = ask(url, "SELECT generation FROM pycrorm_generation WHERE projection = 'tables'")
    listed = ask(
        url,
        "SELECT each.name, part.name, part.type, part.pk > 0 FROM sqlite_master AS each"
        " JOIN pragma_table_info(each.name) AS part WHERE each.type = 'table' ORDER BY each.name, part.cid",
    )
    tables: dict[str, VisibleTable] = {}
    for physical, column, kind, is_key in listed:
        name, mark, generation = physical.removeprefix("zz_").rpartition("__")
        if not mark or generation != str(number) or name.startswith("pycrorm_"):
            continue
        table = tables.setdefault(name, VisibleTable(name, physical, {}, []))
        table.kinds[column] = kind.lower()
        if is_key:
            table.key.append(column)
    for table in tables.values():
        if not table.key:  # the rows of one event differ in a name
            table.key.extend(each for each in table.kinds if each in ("id", "joint", "channel"))
    return list(tables.values())


def another(value: Any, kind: str) -> Any:
    """Return another value that the column could have."""
    if kind == "boolean":
        return not value
    if kind == "text":
        return f"{value} changed"
    return (value or 0) + (0.5 if "double" in kind else 1)


def rows_of(url: str, table: VisibleTable) -> list[dict[str, Any]]:
    """Return the rows of a table, in the order of their keys."""
    rows = ask(url, f'SELECT * FROM "{table.physical}" ORDER BY {", ".join(table.key)}')
    return [dict(zip(table.kinds, row, strict=True)) for row in rows]


def event_of(table: VisibleTable, row: dict[str, Any]) -> tuple[int, int]:
    """Return the episode and event in the key of a row: 22 bits, 26 bits, 5 bits of slot."""
    key = row[table.key[0]] if "id" not in table.key else row["id"]
    if table.name in ("process_metadata", "simulated_episode"):
        return key, 1
    return key // 2**31, key // 2**5 % 2**26


def insert(url: str, table: VisibleTable, row: dict[str, Any]) -> None:
    ask_to_change(url, f'INSERT INTO "{table.physical}" VALUES ({", ".join("?" * len(row))})', row.values())


def set_columns(url: str, table: VisibleTable, row: dict[str, Any], values: dict[str, Any]) -> None:
    changes = ", ".join(f'"{each}" = ?' for each in values)
    parameters = (*values.values(), *map(row.get, table.key))
    ask_to_change(url, f'UPDATE "{table.physical}" SET {changes} WHERE {_is_row(table)}', parameters)


def delete(url: str, table: VisibleTable, row: dict[str, Any]) -> None:
    ask_to_change(url, f'DELETE FROM "{table.physical}" WHERE {_is_row(table)}', map(row.get, table.key))


def _is_row(table: VisibleTable) -> str:
    return " AND ".join(f'"{each}" = ?' for each in table.key)
