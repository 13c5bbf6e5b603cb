"""Load rows as mapped objects with the system of the thesis and with this package, on the same task tree.

    python -m bench.objects            25,000 rows of 61,000 nodes, SQLite and PostgreSQL, five rounds
    python -m bench.objects --quick    100 rows, one round

Both sides store the same rollouts. A round loads the actions, the nodes and the pick-ups of a new session, each with
both sides in turn, after a first round that is not counted; garbage is collected before each load. The system of the
thesis uses synchronous sessions, and this package asynchronous ones. `read` also reads the robot's place of each
loaded action, which the system of the thesis loads with four queries for each action, and this package with some for
500 actions; it has fewer rows for that reason. The script prints one JSON line: ms of wall time and µs of CPU time a
row (median, minimum, maximum; without the CPU time of a server), and their ratio, by database and query.
"""

from __future__ import annotations

import asyncio
import gc
import json
import time
from collections.abc import Awaitable, Callable
from importlib.util import find_spec
from typing import Any

from rich.table import Table
from sqlalchemy import Engine, select
from sqlalchemy.orm import Session

from bench.material.baseline import LEAVES, ActionRow, TaskTreeNodeRow, engine_of, store
from bench.material.rollouts import spool_tree, tree
from bench.material.runs import Place, options, place, store_all
from bench.reporting.figures import MISSING, console, spread, table_of
from pycrorm_async import Reading
from pycrorm_async.orm import Action, PickUpAction, TaskTreeNode

_ROWS = 25_000
_READ_ROWS = 500
_NODES_A_ROW = 2.44
"""Nodes for each action, so that there are as many actions as rows."""
_ROUNDS = 5
_SEED = 69

Side = Callable[[], Awaitable[int]]
"""Load rows and return their number."""


def sides(engine: Engine, reading: Reading, rows: int) -> dict[str, tuple[Side, Side]]:
    """Return by name the same query of the system of the thesis and of this package."""

    def loaded(rows: Any, *, read: bool) -> int:
        return len([each.robot_state.pose.position.x for each in rows] if read else rows)

    def thesis(class_: Any, limit: int, *, read: bool = False) -> Side:
        async def load() -> int:
            with Session(engine) as session:
                return loaded(session.scalars(select(class_).limit(limit)).all(), read=read)

        return load

    def ours(class_: Any, limit: int, *, read: bool = False) -> Side:
        async def load() -> int:
            async with reading.session() as session:
                return loaded((await session.scalars(select(class_).limit(limit))).all(), read=read)

        return load

    few = min(rows, _READ_ROWS)
    # Columns a row: actions 4 and 13, nodes 8 and 22, pick-ups 7 and 16.
    return {
        "actions": (thesis(ActionRow, rows), ours(Action, rows)),
        "nodes": (thesis(TaskTreeNodeRow, rows), ours(TaskTreeNode, rows)),
        "pick-ups": (thesis(LEAVES["PickUpAction"], rows), ours(PickUpAction, rows)),
        "actions, read": (thesis(ActionRow, few, read=True), ours(Action, few, read=True)),
    }


async def measure(engine: Engine, url: str, rows: int, rounds: int) -> dict[str, Any]:
    """Run all queries `rounds` times, the sides in turn, after a first round that is not counted."""
    result: dict[str, Any] = {}
    async with Reading.open(url) as reading:
        for name, pair in sides(engine, reading, rows).items():
            wall_ms: tuple[list[float], list[float]] = ([], [])
            cpu_us: tuple[list[float], list[float]] = ([], [])
            count = 0
            for number in range(1 + rounds):
                for side, load in enumerate(pair):
                    gc.collect()
                    began, began_cpu = time.perf_counter(), time.process_time()
                    count = await load()
                    if number:
                        wall_ms[side].append((time.perf_counter() - began) * 1e3)
                        cpu_us[side].append((time.process_time() - began_cpu) * 1e6 / count)
            result[name] = {
                "rows": count,
                "thesis_ms": spread(wall_ms[0]),
                "ours_ms": spread(wall_ms[1]),
                "thesis_cpu_us_a_row": spread(cpu_us[0]),
                "ours_cpu_us_a_row": spread(cpu_us[1]),
                "ours_is": spread([ours / thesis for thesis, ours in zip(*cpu_us, strict=True)]),
            }
    return result


def fill(here: Place, rows: int) -> tuple[Engine, str]:
    """Store one tree with both sides; return the baseline's engine and the URL of our memory."""
    task_tree = tree(max(50, round(rows * _NODES_A_ROW)), _SEED)
    engine = engine_of(here.new_url("baseline"))
    store(task_tree, engine)
    url = here.new_url("ours")
    spool_tree(task_tree, here.folder / "spool")
    store_all(url, here.folder / "spool")
    return engine, url


def main() -> None:
    parser = options(__doc__, quick="100 rows, one round")
    parser.add_argument("--rows", type=int, default=_ROWS)
    parser.add_argument("--databases", nargs="+", default=["sqlite", "postgresql"])
    arguments = parser.parse_args()
    rows, rounds = (100, 1) if arguments.quick else (arguments.rows, _ROUNDS)
    result: dict[str, Any] = {"bench": "objects", "rounds": rounds, "seed": _SEED}
    for database in arguments.databases:
        if database == "postgresql" and find_spec("psycopg") is None:
            result[database] = MISSING
            continue
        console().print(f"{database}, {rows:,} rows …")
        with place(database) as here:
            engine, url = fill(here, rows)
            result[database] = asyncio.run(measure(engine, url, rows, rounds))
            engine.dispose()
    print(json.dumps(result))
    console().print(_table(result, arguments.databases))


def _table(result: dict[str, Any], databases: list[str]) -> Table:
    table = table_of("Rows as mapped objects", "database: | query: | rows | thesis, ms | ours, ms | CPU: ours is")
    for database in databases:
        if result[database] == MISSING:
            table.add_row(database, MISSING)
            continue
        for query, each in result[database].items():
            figures = (f"{each[name]['median']:,}" for name in ("thesis_ms", "ours_ms", "ours_is"))
            table.add_row(database, query, f"{each['rows']:,}", *figures)
    return table


if __name__ == "__main__":
    main()
