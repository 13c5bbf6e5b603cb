"""What the questions that are asked all the time cost, on memories of 1,000, 50,000 and 500,000 pick-ups.

    python -m bench.questions                     1,000 and 50,000 pick-ups, SQLite and PostgreSQL
    python -m bench.questions --pick-ups 500000   4.9 million nodes: some minutes to fill, 4 GB
    python -m bench.questions --quick             100, once

The memories hold the rollouts of the thesis, 9 to 13 nodes each, a hundred in an episode. Each question is asked seven
times after a first time that is not counted, all in turns, and the collector has been by before each. A server is asked
when it has counted what it holds, as it does by itself within a minute or two, for before that it guesses how to go
about a question. The same rows are asked for as a frame and as mapped objects, and from the plain view and from one
whose rows are kept. Prints one JSON line: ms (median, least, most) and how many rows there were, by database, size and
question.
"""

from __future__ import annotations

import argparse
import asyncio
import gc
import json
import tempfile
import time
from collections.abc import Awaitable, Callable
from contextlib import ExitStack
from pathlib import Path
from typing import Any

from rich.table import Table
from sqlalchemy import func, select

from bench.material.spooled import spool_rollouts
from bench.reporting.figures import console, spread
from pycrorm_async import Memory, Reading, UserView
from pycrorm_async.operations.recovery import recover
from pycrorm_async.orm import Object, PickUpAction, PickUpWithContextView, Pose, ProcessMetaData, TaskTreeNode
from pycrorm_async.plan.task_tree import TaskStatus
from pycrorm_async.query.experience import PickUpExperience
from pycrorm_async.world import ObjectType
from tests.databases import ask, server_in

_ROUNDS = 7
_COUNTED_S_MAX = 600
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

Question = Callable[[], Awaitable[int]]
"""Asks, and says how many rows the answer had."""


def questions_of(reading: Reading, pick_ups: int) -> dict[str, Question]:
    """By name; `n` of them are objects at most `_OBJECTS_MAX`."""
    last = (pick_ups + 99) // 100
    some = min(_OBJECTS_MAX, pick_ups)

    def frame(statement: Any) -> Question:
        async def asked() -> int:
            return len(await reading.dataframe(statement))

        return asked

    def objects(statement: Any) -> Question:
        async def asked() -> int:
            async with reading.session() as session:
                return len((await session.scalars(statement)).all())

        return asked

    async def tree() -> int:
        return len(await reading.tree(last))

    async def experience() -> int:
        return len(await PickUpExperience(reading).successes(ObjectType.MILK, arm=None))

    async def as_of() -> int:
        return len((await reading.as_of(last, sequence=1_000)).running)

    return {
        "learning, frame": frame(LEARNING),
        "learning, kept rows, frame": frame(KEPT_LEARNING),
        "all pick-ups with context, frame": frame(select(_View)),
        f"{some:,} pick-ups, frame": frame(select(PickUpAction).limit(some)),
        f"{some:,} pick-ups, objects": objects(select(PickUpAction).limit(some)),
        f"where {some:,} were picked, objects": objects(PICKED.limit(some)),
        "why things failed, frame": frame(FAILURES),
        "nodes of an episode, frame": frame(select(TaskTreeNode).where(TaskTreeNode.process_metadata_id == last)),
        "nodes of an episode, objects": objects(select(TaskTreeNode).where(TaskTreeNode.process_metadata_id == last)),
        "episodes, objects": objects(select(ProcessMetaData)),
        "task tree of an episode": tree,
        "what went well before": experience,
        "as of a moment": as_of,
    }


async def fill(url: str, spool: Path, pick_ups: int) -> dict[str, float]:
    """The memory, and the kept view; how long that took."""
    began = time.perf_counter()
    events = await asyncio.to_thread(spool_rollouts, pick_ups, spool, seed=_SEED)
    spooled = time.perf_counter()
    report = await recover(url, spool=spool)
    assert not report.failed, report.failed
    assert not report.drained.stopped, report.drained.stopped
    there = time.perf_counter()
    async with Memory.open(url, spool=spool, views=[KEPT]) as memory:
        await memory.flush()
    took = {"spooled": spooled - began, "stored_and_folded": there - spooled, "kept": time.perf_counter() - there}
    return {"events": events, **{name: round(each, 1) for name, each in took.items()}}


def await_counted(url: str) -> None:
    """Until PostgreSQL's autovacuum has been by all tables that have changed by more than it lets pass."""
    uncounted = "SELECT count(*) FROM pg_stat_user_tables WHERE n_mod_since_analyze > 50 + 0.1 * n_live_tup"
    until = time.monotonic() + _COUNTED_S_MAX
    while ask(url, uncounted) != [(0,)]:
        if time.monotonic() > until:
            raise TimeoutError(f"the server did not count its rows within {_COUNTED_S_MAX} s")
        time.sleep(1)


async def asked(url: str, pick_ups: int, rounds: int) -> dict[str, Any]:
    """All questions in turns, so many times after a first one that is not counted."""
    took: dict[str, list[float]] = {}
    rows: dict[str, int] = {}
    async with Reading.open(url) as reading:
        questions = questions_of(reading, pick_ups)
        for number in range(1 + rounds):
            for name, question in questions.items():
                gc.collect()
                began = time.perf_counter()
                rows[name] = await question()
                if number:
                    took.setdefault(name, []).append((time.perf_counter() - began) * 1000)
    return {name: {"ms": spread(took[name]), "rows": rows[name]} for name in questions}


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--quick", action="store_true", help="100 pick-ups, asked once")
    parser.add_argument("--pick-ups", type=int, nargs="+", default=[1_000, 50_000])
    parser.add_argument("--databases", nargs="+", default=["sqlite", "postgresql"])
    given = parser.parse_args()
    sizes, rounds = ([100], 1) if given.quick else (given.pick_ups, _ROUNDS)
    answer: dict[str, Any] = {"bench": "questions", "rounds": rounds, "seed": _SEED}
    with ExitStack() as stack:
        place = Path(stack.enter_context(tempfile.TemporaryDirectory(prefix="b")))
        for database in given.databases:
            server = stack.enter_context(server_in(place / "pg")) if database == "postgresql" else None
            answer[database] = {}
            for size in sizes:
                console().print(f"{database}, {size:,} pick-ups …")
                url = server.new_database() if server else f"sqlite:///{place}/{size}.db"
                filled = asyncio.run(fill(url, place / f"{database}{size}", size))
                console().print(f"  filled: {filled}")
                if server and not given.quick:
                    await_counted(url)
                answer[database][str(size)] = {"filled_s": filled, **asyncio.run(asked(url, size, rounds))}
    print(json.dumps(answer))
    console().print(_table(answer, given.databases))


def _table(answer: dict[str, Any], databases: list[str]) -> Table:
    table = Table(title="Questions, ms", title_justify="left")
    for name in ("database", "pick-ups", "question", "rows", "median", "least", "most"):
        table.add_column(name, justify="left" if name in ("database", "question") else "right")
    for database in databases:
        for size, found in answer[database].items():
            for name, each in found.items():
                if name != "filled_s":
                    figures = (f"{figure:,}" for figure in each["ms"].values())
                    table.add_row(database, f"{int(size):,}", name, f"{each['rows']:,}", *figures)
    return table


if __name__ == "__main__":
    main()
