"""Whether the writer inside a plan's process keeps up beside a plan that is always busy and never suspends.

    python -m bench.busy                 20 s at 2,000 events/s, on SQLite; --postgresql on a server of its own
    python -m bench.busy --quick         1 s

The plan computes all the time, in Python, so that it holds the interpreter whenever it is let; its actions start and
end at an even rhythm. Prints one JSON line: the backlog, events that are not in the database yet, every half second,
the largest seen at any action, and how long the rest took when the plan was over. A backlog that does not grow is kept
up with.
"""

from __future__ import annotations

import argparse
import asyncio
import json
import tempfile
import time
from contextlib import ExitStack
from dataclasses import dataclass
from pathlib import Path

from pycrorm_async import Memory
from pycrorm_async.plan import ActionAbstract
from tests.databases import server_in

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


async def measured(url: str, spool: Path, seconds: float) -> dict[str, object]:
    backlog: list[int] = []
    largest = actions = 0
    async with Memory.open(url, spool=spool) as memory:
        async with memory.episode(description="bench"):
            began = time.perf_counter()
            while (now := time.perf_counter() - began) < seconds:
                actions += 1
                await ComputingActionPerformable(began + actions * 2 / _EVENTS_PER_S, f"action {actions}").perform()
                status = memory.status
                largest = max(largest, status.written - status.stored)
                if now * _SAMPLES_PER_S >= len(backlog):
                    backlog.append(status.written - status.stored)
            took = time.perf_counter() - began
        left = memory.status.written - memory.status.stored
        over = time.perf_counter()
        await memory.flush()
        flushed = time.perf_counter() - over
    return {
        "events_per_s": round(2 * actions / took),
        "events": 2 * actions,
        "backlog": backlog,
        "backlog_max": max(largest, left),
        "backlog_at_the_end": left,
        "stored_and_folded_after_s": round(flushed, 2),
    }


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__.splitlines()[0] if __doc__ else None)
    parser.add_argument("--quick", action="store_true", help="1 s instead of 20")
    parser.add_argument("--postgresql", action="store_true", help="on a server of its own")
    arguments = parser.parse_args()
    seconds = 1.0 if arguments.quick else 20.0
    with ExitStack() as stack:
        folder = Path(stack.enter_context(tempfile.TemporaryDirectory(prefix="b")))
        url = f"sqlite:///{folder}/busy.db"
        if arguments.postgresql:
            url = stack.enter_context(server_in(folder / "pg")).new_database()
        result = {"bench": "busy", "database": url.partition(":")[0], "asked_events_per_s": _EVENTS_PER_S}
        print(json.dumps(result | asyncio.run(measured(url, folder / "spool", seconds))))


if __name__ == "__main__":
    main()
