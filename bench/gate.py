"""Compare what recording, appending and folding cost with raw writing, and with the ratios on record.

    python -m bench.gate             half a minute; exit code 1 if a part costs 1.4 times its ratio on record
    python -m bench.gate --record    put the ratios of this machine on record, in bench/gate.json

Every part and its raw counterpart run in turns in one process, and the CPU time of each is the least of all its turns,
so that other programs on the machine hardly change the ratio. *hooks*: the start and the end of an action with object,
arm, grasp and the robot's state, in the plan's thread; raw, two JSON lines with a flush after each. *append* and
*fold*: an episode of pick-up rollouts into the log, and from the log into the tables and cases; raw, the same rows into
a table of plain `sqlite3` by `executemany`. *hook to row*: half an action's hooks, append and fold together; raw, the
log's rows and all rows and indexes that the fold makes of them, by `executemany`. A part above a limit is measured
twice more, because a slowdown stays and a disturbance does not. There is a record for the compiled core and one for
pure Python.
"""

from __future__ import annotations

import argparse
import asyncio
import gc
import json
import logging
import os
import sqlite3
import sys
import tempfile
import time
from collections.abc import Awaitable, Callable
from contextlib import AsyncExitStack, closing
from pathlib import Path
from typing import Any, Final, NamedTuple

from rich.table import Table

from bench.material.rollouts import spool_rollouts
from bench.material.runs import read_all
from bench.material.turns import nothing_action
from bench.reporting.figures import console, table_of
from pycrorm_async import Memory, Settings
from pycrorm_async.bulk_records import collect_seldom
from pycrorm_async.core import IS_COMPILED
from pycrorm_async.events.codec import Record
from pycrorm_async.events.ids import episode_id
from pycrorm_async.plan.execution import recorder
from pycrorm_async.plan.task import TaskTreeNode
from pycrorm_async.projections.custom import own_projections
from pycrorm_async.projections.projector import Projector
from pycrorm_async.store.address import DatabaseAddress
from pycrorm_async.store.log import EventLog
from pycrorm_async.world import BulletWorld

WARNS, FAILS = 1.1, 1.4
ON_RECORD: Final = Path(__file__).with_name("gate.json")
RAW: Final = {"hooks": "JSON lines", "append": "executemany", "fold": "executemany", "hook to row": "all rows"}
TURNS, ACTIONS, ROLLOUTS = 25, 200, 200
_INSERT = "INSERT INTO event VALUES (?, ?, ?, ?, ?, ?, ?)"
STARTED: Final[dict[str, Any]] = {
    "event": "start", "node": 17, "parent": 2, "type": "PickUpAction", "wall_ns": 1_795_416_560_556_237_149,
    "parameters": {"object_designator": "milk", "arm": "LEFT", "grasp": "FRONT"},
    "robot": {"position": [1.25, -0.5, 0.0], "orientation": [0.0, 0.0, 0.7071, 0.7071], "frame": "map", "torso": 0.3},
}  # fmt: skip
ENDED: Final[dict[str, Any]] = {"event": "end", "node": 17, "status": "SUCCEEDED", "wall_ns": 1_795_416_560_556_237_149}


class Part(NamedTuple):
    """A loop over this number of `events`; `prepare` runs before each turn, `clock` reads the CPU time that counts."""

    run: Callable[[], Awaitable[object]]
    clock: Callable[[], int]
    events: int
    prepare: Callable[[], object] = lambda: None


async def measure() -> dict[str, float]:
    """Return the least CPU time of each part and raw counterpart, in µs for an action or an event."""
    with tempfile.TemporaryDirectory(prefix="b") as folder:
        async with AsyncExitStack() as stack:
            parts = {**await _hooks(stack, Path(folder)), **await _storage(stack, Path(folder))}
            least = dict.fromkeys(parts, float("inf"))
            gc.collect()
            gc.freeze()  # the collections before the turns need not walk what the program has loaded
            for turn in range(TURNS):
                for name, part in parts.items():
                    part.prepare()
                    gc.collect()
                    began_ns = part.clock()
                    await part.run()
                    took_us = (part.clock() - began_ns) / part.events / 1e3
                    if turn:
                        least[name] = min(least[name], took_us)
    return least


async def _hooks(stack: AsyncExitStack, folder: Path) -> dict[str, Part]:
    """Return the loops of both hooks, and of the JSON lines."""
    settings = Settings(spool_bytes_max=2**33, segment_bytes=2**26)
    memory = await stack.enter_async_context(
        Memory.open(f"sqlite:///{folder}/hooks.db", writer="daemon", settings=settings)  # nothing drains it
    )
    await stack.enter_async_context(memory.episode(description="gate"))
    stack.enter_context(BulletWorld())
    action, observer = nothing_action(), recorder.get()
    assert observer is not None
    file = stack.enter_context((folder / "lines.jsonl").open("w"))

    async def hooks() -> None:
        for _ in range(ACTIONS):
            node = TaskTreeNode(action, "action", None, time.monotonic_ns())
            observer.node_started(node)
            observer.node_ended(node)

    async def lines() -> None:
        for _ in range(ACTIONS):
            for event in (STARTED, ENDED):
                file.write(json.dumps(event) + "\n")
                file.flush()

    return {"JSON lines": Part(lines, time.thread_time_ns, ACTIONS), "hooks": Part(hooks, time.thread_time_ns, ACTIONS)}


async def _storage(stack: AsyncExitStack, folder: Path) -> dict[str, Part]:
    """Return the loops that append and fold an episode, and that write its rows raw."""
    spool = folder / "spooled"
    await asyncio.to_thread(spool_rollouts, ROLLOUTS, spool, seed=69, an_episode=ROLLOUTS)
    log = await EventLog.open(DatabaseAddress.parse(f"sqlite:///{folder}/memory.db"), create=True)
    stack.push_async_callback(log.close)
    projector = Projector(log, installed=own_projections())
    await projector.open()
    raw = sqlite3.connect(folder / "raw.db", isolation_level=None)
    stack.callback(raw.close)
    raw.execute("PRAGMA journal_mode = WAL")
    raw.execute(
        "CREATE TABLE event (episode TEXT, sequence INTEGER, type TEXT, version INTEGER, wall_ns INTEGER,"
        " monotonic_ns INTEGER, payload TEXT, PRIMARY KEY (episode, sequence)) STRICT"
    )
    records = await read_all(spool)
    assert await log.append([each for each in records if each.episode is None]) == {}
    events = [each for each in records if each.episode is not None]
    batch: list[Record] = []
    rows: list[tuple[Any, ...]] = []

    def next_episode() -> None:
        name = episode_id(time.time_ns(), os.urandom(10))
        batch[:] = [each._replace(episode=name) for each in events]
        rows[:] = [(name.hex(), *each[2:7], each.payload.decode()) for each in events]

    async def append() -> None:
        assert await log.append(batch) == {}

    async def fold() -> None:
        assert await projector.catch_up() == len(events)

    async def executemany() -> None:
        raw.execute("BEGIN IMMEDIATE")
        raw.executemany(_INSERT, rows)
        raw.execute("COMMIT")

    next_episode()
    await append()
    await fold()
    all_rows = stack.enter_context(closing(sqlite3.connect(folder / "rows.db", isolation_level=None)))
    content = _copy_schema(folder / "memory.db", all_rows)

    def delete_rows() -> None:
        for insert in content:
            all_rows.execute(f"DELETE FROM {insert.split()[2]}")

    async def insert_rows() -> None:
        all_rows.execute("BEGIN IMMEDIATE")
        for insert, values in content.items():
            all_rows.executemany(insert, values)
        all_rows.execute("COMMIT")

    count, clock = len(events), time.process_time_ns  # the driver's thread counts too
    return {
        "executemany": Part(executemany, clock, count, next_episode),
        "append": Part(append, clock, count),
        "fold": Part(fold, clock, count),
        "all rows": Part(insert_rows, clock, count, delete_rows),
    }


def _copy_schema(file: Path, copy: sqlite3.Connection) -> dict[str, list[Any]]:
    """Make the tables and indexes of a memory that hold rows; return the statement and the rows of each table."""
    copy.execute("PRAGMA journal_mode = WAL")
    content: dict[str, list[Any]] = {}
    with closing(sqlite3.connect(file)) as memory:
        made = memory.execute(
            "SELECT type, tbl_name, sql FROM sqlite_master WHERE sql IS NOT NULL AND type IN ('table', 'index')"
            " AND name NOT LIKE 'sqlite_%' ORDER BY type DESC"
        ).fetchall()
        for kind, table, sql in made:
            values = memory.execute(f'SELECT * FROM "{table}"').fetchall()
            if values:
                copy.execute(sql)
            if values and kind == "table":
                content[f'INSERT INTO "{table}" VALUES ({", ".join("?" * len(values[0]))})'] = values
    return content


def core() -> str:
    """Return which core of the queue this process uses."""
    return "compiled" if IS_COMPILED else "pure"


def ratios(least_us: dict[str, float]) -> dict[str, float]:
    """Return the parts as multiples of their raw counterparts."""
    least_us["hook to row"] = least_us["hooks"] / 2 + least_us["append"] + least_us["fold"]
    return {name: round(least_us[name] / least_us[raw], 3) for name, raw in RAW.items()}


def main() -> int:
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--record", action="store_true", help="put the ratios of this machine on record")
    recording = parser.parse_args().record
    collect_seldom()
    logging.disable(logging.WARNING)  # the memory of the hooks warns that nothing drains it
    records: dict[str, dict[str, float]] = json.loads(ON_RECORD.read_text()) if ON_RECORD.exists() else {}
    known = records.get(core(), {})
    least_us = asyncio.run(measure())
    for _ in range(2):
        if not recording and all(ratio <= WARNS * known.get(name, ratio) for name, ratio in ratios(least_us).items()):
            break
        again_us = asyncio.run(measure())
        least_us = {name: min(least_us[name], value) for name, value in again_us.items()}
    found = ratios(least_us)
    if recording:
        ON_RECORD.write_text(json.dumps(dict(sorted((records | {core(): found}).items())), indent=1) + "\n")
    outcomes = {name: _outcome(ratio, known.get(name)) for name, ratio in found.items()}
    console().print(_table(least_us, found, known, outcomes))
    console().print("put the ratios of this machine on record with: python -m bench.gate --record", highlight=False)
    print(json.dumps({"bench": "gate", "core": core(), "ratios": found, "on_record": known, "outcomes": outcomes}))
    return 1 if "fails" in outcomes.values() and not recording else 0


def _outcome(ratio: float, known: float | None) -> str:
    if known is None:
        return "no ratio on record"
    return "fails" if ratio > FAILS * known else "warns" if ratio > WARNS * known else "holds"


def _table(
    least_us: dict[str, float], found: dict[str, float], known: dict[str, float], outcomes: dict[str, str]
) -> Table:
    header = "part: | µs | raw way: | µs | ratio | on record | :"
    table = table_of(f"CPU time against raw writing, {core()} core", header)
    for name, raw in RAW.items():
        cells = (
            f"{least_us[name]:.2f}",
            raw,
            f"{least_us[raw]:.2f}",
            f"{found[name]:.2f}",
            f"{known.get(name, 0):.2f}",
        )
        table.add_row(name, *cells, outcomes[name])
    return table


if __name__ == "__main__":
    sys.exit(main())
