"""Measure the backlog of the writer inside a plan's process while the plan computes without ever suspending.

    python -m bench.busy                 20 s at 2,000 events/s, on SQLite; --postgresql on a new server
    python -m bench.busy --quick         1 s

The plan computes in Python all the time, so that it holds the interpreter lock whenever it can; its actions start and
end at a fixed rate. The script prints one JSON line: the backlog (events that are not in the database yet) every half
second, its maximum over all actions, and the time that the writer needs after the end of the plan. If the backlog does
not grow, the writer keeps up.
"""

from __future__ import annotations

import asyncio
import json
import time
from dataclasses import dataclass
from pathlib import Path

from bench.material.runs import options, place
from pycrorm_async import Memory
from pycrorm_async.plan import ActionAbstract

_EVENTS_PER_S = 2_000
_SAMPLES_PER_S = 2


@dataclass
class ComputingActionPerformable(ActionAbstract):
    until_s: float
    text: str

    async def perform(self) -> None:
        number = 1
        while time.perf_counter() < self.until_s:
            number = number * 3 % 1_000_003


async def measure(url: str, spool: Path, seconds: float) -> dict[str, object]:
    backlog: list[int] = []
    backlog_max = actions = 0
    async with Memory.open(url, spool=spool) as memory:
        async with memory.episode(description="bench"):
            began = time.perf_counter()
            while (now := time.perf_counter() - began) < seconds:
                actions += 1
                await ComputingActionPerformable(began + actions * 2 / _EVENTS_PER_S, f"action {actions}").perform()
                status = memory.status
                backlog_max = max(backlog_max, status.written - status.stored)
                if now * _SAMPLES_PER_S >= len(backlog):
                    backlog.append(status.written - status.stored)
            plan_s = time.perf_counter() - began
        backlog_at_end = memory.status.written - memory.status.stored
        plan_end_s = time.perf_counter()
        await memory.flush()
        flush_s = time.perf_counter() - plan_end_s
    return {
        "events_per_s": round(2 * actions / plan_s),
        "events": 2 * actions,
        "backlog": backlog,
        "backlog_max": max(backlog_max, backlog_at_end),
        "backlog_at_the_end": backlog_at_end,
        "stored_and_folded_after_s": round(flush_s, 2),
    }


def main() -> None:
    parser = options(__doc__, quick="1 s instead of 20")
    parser.add_argument("--postgresql", action="store_true", help="use a new PostgreSQL server")
    arguments = parser.parse_args()
    seconds = 1.0 if arguments.quick else 20.0
    database = "postgresql" if arguments.postgresql else "sqlite"
    result = {"bench": "busy", "database": database, "asked_events_per_s": _EVENTS_PER_S}
    with place(database) as here:
        result |= asyncio.run(measure(here.new_url("busy"), here.folder / "spool", seconds))
    print(json.dumps(result))


if __name__ == "__main__":
    main()
