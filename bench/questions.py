"""Measure common queries on memories of 1,000, 50,000 and 500,000 pick-ups.

    python -m bench.questions                     1,000 and 50,000 pick-ups, SQLite and PostgreSQL
    python -m bench.questions --pick-ups 500000   4.9 million nodes: some minutes to fill, 4 GB
    python -m bench.questions --quick             100 pick-ups, one round

The memories contain the rollouts of the thesis, 9 to 13 nodes each, a hundred in an episode. Each query runs seven
times after a first run that is not counted; the queries take turns, and garbage is collected before each. PostgreSQL is
queried after autovacuum has analysed the tables, within a minute or two, because before that its planner lacks
statistics. The same rows are queried as a data frame and as mapped objects, and from a plain and a materialised view.
The script prints one JSON line: ms (median, minimum, maximum) and the number of rows, by database, size and query.
"""

from __future__ import annotations

import asyncio
import gc
import json
import time
from collections.abc import Awaitable, Callable
from pathlib import Path
from typing import Any

from rich.table import Table
from sqlalchemy import func, select

from bench.material.rollouts import spool_rollouts
from bench.material.runs import options, place, store_all
from bench.reporting.figures import console, spread, table_of
from pycrorm_async import Memory, Reading, UserView
from pycrorm_async.orm import Object, PickUpAction, PickUpWithContextView, Pose, ProcessMetaData, TaskTreeNode
from pycrorm_async.recall.experience import PickUpExperience
from pycrorm_async.task_status import TaskStatus
from pycrorm_async.world import ObjectType
from tests.databases import ask

_ROUNDS = 7
_ANALYSED_S_MAX = 600
_OBJECTS_MAX = 10_000
_SEED = 69
_View = PickUpWithContextView

KEPT = UserView(
    "kept_pick_up",
    select(
        _View.id, _View.process_metadata_id, _View.arm, _View.grasp, _View.relative_x, _View.relative_y, _View.status
    ),
    materialised=True,
)
LEARNING = select(_View.arm, _View.grasp, _View.relative_x, _View.relative_y).where(
    _View.status == TaskStatus.SUCCEEDED
)
KEPT_LEARNING = select(KEPT.table.c.arm, KEPT.table.c.grasp, KEPT.table.c.relative_x, KEPT.table.c.relative_y).where(
    KEPT.table.c.status == TaskStatus.SUCCEEDED
)
FAILURES = (
    select(TaskTreeNode.reason, func.count().label("times"))
    .where(TaskTreeNode.status == TaskStatus.FAILED)
    .group_by(TaskTreeNode.reason)
)
PICKED = select(Pose).join(PickUpAction.object).join(Object.pose)

Query = Callable[[], Awaitable[int]]
"""Run a query and return the number of its rows."""


def queries_of(reading: Reading, pick_ups: int) -> dict[str, Query]:
    """Return the queries by name; those limited in rows return at most `_OBJECTS_MAX`."""
    last = (pick_ups + 99) // 100
    limit = min(_OBJECTS_MAX, pick_ups)

    def frame(statement: Any) -> Query:
        async def rows() -> int:
            return len(await reading.dataframe(statement))

        return rows

    def objects(statement: Any) -> Query:
        async def rows() -> int:
            async with reading.session() as session:
                return len((await session.scalars(statement)).all())

        return rows

    async def tree() -> int:
        return len(await reading.tree(last))

    async def experience() -> int:
        return len(await PickUpExperience.of(reading).successes(ObjectType.MILK, arm=None))

    async def as_of() -> int:
        return len((await reading.as_of(last, sequence=1_000)).running)

    return {
        "learning, frame": frame(LEARNING),
        "learning, kept rows, frame": frame(KEPT_LEARNING),
        "all pick-ups with context, frame": frame(select(_View)),
        f"{limit:,} pick-ups, frame": frame(select(PickUpAction).limit(limit)),
        f"{limit:,} pick-ups, objects": objects(select(PickUpAction).limit(limit)),
        f"where {limit:,} were picked, objects": objects(PICKED.limit(limit)),
        "why things failed, frame": frame(FAILURES),
        "nodes of an episode, frame": frame(select(TaskTreeNode).where(TaskTreeNode.process_metadata_id == last)),
        "nodes of an episode, objects": objects(select(TaskTreeNode).where(TaskTreeNode.process_metadata_id == last)),
        "episodes, objects": objects(select(ProcessMetaData)),
        "task tree of an episode": tree,
        "what went well before": experience,
        "as of a moment": as_of,
    }


async def fill(url: str, spool: Path, pick_ups: int) -> dict[str, float]:
    """Fill the memory and its materialised view; return the number of events and the durations in seconds."""
    begin_s = time.perf_counter()
    events = await asyncio.to_thread(spool_rollouts, pick_ups, spool, seed=_SEED)
    spooled_s = time.perf_counter()
    await asyncio.to_thread(store_all, url, spool)
    folded_s = time.perf_counter()
    async with Memory.open(url, spool=spool, views=[KEPT]) as memory:
        await memory.flush()
    durations = {
        "spooled": spooled_s - begin_s,
        "stored_and_folded": folded_s - spooled_s,
        "kept": time.perf_counter() - folded_s,
    }
    return {"events": events, **{name: round(each, 1) for name, each in durations.items()}}


def wait_for_autovacuum(url: str) -> None:
    """Wait until PostgreSQL's autovacuum has analysed all tables that changed by more than its threshold."""
    not_analysed = "SELECT count(*) FROM pg_stat_user_tables WHERE n_mod_since_analyze > 50 + 0.1 * n_live_tup"
    deadline = time.monotonic() + _ANALYSED_S_MAX
    while ask(url, not_analysed) != [(0,)]:
        if time.monotonic() > deadline:
            raise TimeoutError(f"autovacuum did not analyse all tables within {_ANALYSED_S_MAX} s")
        time.sleep(1)


async def measure(url: str, pick_ups: int, rounds: int) -> dict[str, Any]:
    """Run all queries `rounds` times, alternating, after a first round that is not counted."""
    durations_ms: dict[str, list[float]] = {}
    rows: dict[str, int] = {}
    async with Reading.open(url) as reading:
        queries = queries_of(reading, pick_ups)
        for number in range(1 + rounds):
            for name, query in queries.items():
                gc.collect()
                began = time.perf_counter()
                rows[name] = await query()
                if number:
                    durations_ms.setdefault(name, []).append((time.perf_counter() - began) * 1000)
    return {name: {"ms": spread(durations_ms[name]), "rows": rows[name]} for name in queries}


def main() -> None:
    parser = options(__doc__, quick="100 pick-ups, one round")
    parser.add_argument("--pick-ups", type=int, nargs="+", default=[1_000, 50_000])
    parser.add_argument("--databases", nargs="+", default=["sqlite", "postgresql"])
    arguments = parser.parse_args()
    sizes, rounds = ([100], 1) if arguments.quick else (arguments.pick_ups, _ROUNDS)
    result: dict[str, Any] = {"bench": "questions", "rounds": rounds, "seed": _SEED}
    for database in arguments.databases:
        result[database] = {}
        with place(database) as here:
            for size in sizes:
                console().print(f"{database}, {size:,} pick-ups …")
                url = here.new_url(f"{size}")
                filled = asyncio.run(fill(url, here.folder / f"spool{size}", size))
                console().print(f"  filled: {filled}")
                if here.server and not arguments.quick:
                    wait_for_autovacuum(url)
                result[database][str(size)] = {"filled_s": filled, **asyncio.run(measure(url, size, rounds))}
    print(json.dumps(result))
    console().print(_table(result, arguments.databases))


def _table(result: dict[str, Any], databases: list[str]) -> Table:
    table = table_of("Queries, ms", "database: | pick-ups | query: | rows | median | least | most")
    for database in databases:
        for size, queries in result[database].items():
            for name, each in queries.items():
                if name != "filled_s":
                    figures = (f"{figure:,}" for figure in each["ms"].values())
                    table.add_row(database, f"{int(size):,}", name, f"{each['rows']:,}", *figures)
    return table


if __name__ == "__main__":
    main()
