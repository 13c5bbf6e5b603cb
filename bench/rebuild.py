"""How fast tables are made anew from the log, whether the cost of an event grows, and who feels it meanwhile.

    python -m bench.rebuild                100,000 and 1,000,000 events, one and two workers, SQLite
    python -m bench.rebuild --postgresql   the same on a server of its own
    python -m bench.rebuild --large        10,000,000 too
    python -m bench.rebuild --quick        2,000 and 10,000

Every rebuild is a process of its own. Prints one JSON line: events a second, µs an event, by the clock and of the
processors (on PostgreSQL without the server's; with what a process needs to begin and to clear up), and MB of the
largest process, by size and workers; how much more an event costs, and how much more memory is taken, in the largest
log than in the smallest; and the longest waits, in s, of a process that records and flushes and of one that asks, with
nothing else going on and while the largest log is rebuilt.
"""

from __future__ import annotations

import argparse
import asyncio
import json
import resource
import subprocess
import sys
import tempfile
import time
from contextlib import ExitStack
from pathlib import Path

from pycrorm_async.events.envelope import Record
from pycrorm_async.projections.projector import Projector
from pycrorm_async.rebuilding import rebuild_memory
from pycrorm_async.store.address import DatabaseAddress
from pycrorm_async.store.log import EventLog
from tests.crash.forked import Forked
from tests.crash.remaking import read_until_told, record_until_told
from tests.databases import server_in
from tests.projections.remade import TYPES, picking

_NODES = 124
"""So that an episode has 253 events; those of a plan that ends well have some hundred."""
_APPEND_EPISODES = 40
_CALM_S = 5.0


async def fill(url: str, events: int) -> int:
    """Appends whole episodes, the first of them folded; the number of events."""
    log = await EventLog.open(DatabaseAddress.parse(url), create=True)
    records: list[Record] = list(TYPES)
    count = number = 0
    while count < events:
        number += 1
        records += picking(number, nodes=_NODES).records
        count += 5 + 2 * _NODES
        if number % _APPEND_EPISODES == 1 or count >= events:
            await log.append(records)
            records.clear()
        if number == 1:
            projector = Projector(log)
            await projector.open()
            await projector.fold_behind()
    await log.close()
    return count


def rebuilt(url: str, workers: int) -> dict[str, float]:
    """What a process of its own says of its rebuild."""
    command = [sys.executable, "-m", "bench.rebuild", "--of", url, "--workers", str(workers)]
    said = subprocess.run(command, check=True, capture_output=True, text=True).stdout
    return dict(json.loads(said))


def rebuild_and_say(url: str, workers: int) -> None:
    done = asyncio.run(rebuild_memory(url, workers=workers))
    used = [resource.getrusage(who) for who in (resource.RUSAGE_SELF, resource.RUSAGE_CHILDREN)]
    said = {
        "events": done.events,
        "seconds": done.seconds,
        "cpu_s": sum(each.ru_utime + each.ru_stime for each in used),
        "mb": max(each.ru_maxrss for each in used) / 1024,
    }
    print(json.dumps(said))


def waits(url: str, spool: Path, *, rebuilding: bool) -> dict[str, float]:
    """The longest waits of one that records and of one that reads."""
    recorder, reader = Forked(record_until_told, url, spool), Forked(read_until_told, url)
    for each in (recorder, reader):
        each.wait_for_its_first_words()
    if rebuilding:
        rebuilt(url, 1)
    else:
        time.sleep(_CALM_S)
    for each in (recorder, reader):
        each.tell_to_stop()
        assert each.wait() == 0, each.said[-3:]
    return {
        "flush_s": round(float(recorder.said[-1].split()[-1]), 3),
        "question_s": round(float(reader.said[-1].split()[-1]), 3),
    }


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    for name in ("--quick", "--large", "--postgresql"):
        parser.add_argument(name, action="store_true")
    parser.add_argument("--of", help=argparse.SUPPRESS)
    parser.add_argument("--workers", type=int, default=1, help=argparse.SUPPRESS)
    asked = parser.parse_args()
    if asked.of:
        rebuild_and_say(asked.of, asked.workers)
        return
    sizes = [2_000, 10_000] if asked.quick else [100_000, 1_000_000, *([10_000_000] if asked.large else [])]
    answer: dict[str, object] = {"bench": "rebuild", "database": "postgresql" if asked.postgresql else "sqlite"}
    by_workers: dict[int, list[dict[str, float]]] = {1: [], 2: []}
    with ExitStack() as stack:
        folder = Path(stack.enter_context(tempfile.TemporaryDirectory(prefix="b")))
        server = stack.enter_context(server_in(folder / "pg")) if asked.postgresql else None
        for size in sizes:
            url = server.new_database() if server else f"sqlite:///{folder}/{size}.db"
            asyncio.run(fill(url, size))
            for workers, found in by_workers.items():
                found.append(rebuilt(url, workers))
                last = found[-1]
                answer[f"{size}_events_{workers}_workers"] = {
                    "events_per_s": round(last["events"] / last["seconds"]),
                    "us_per_event": round(last["seconds"] / last["events"] * 1e6, 2),
                    "cpu_us_per_event": round(last["cpu_s"] / last["events"] * 1e6, 2),
                    "mb": round(last["mb"], 1),
                }
        for workers, found in by_workers.items():
            costs = [each["seconds"] / each["events"] for each in found]
            answer[f"growth_{workers}_workers"] = {
                "cost": round(costs[-1] / costs[0], 2),
                "mb": round(found[-1]["mb"] - found[0]["mb"], 1),
            }
        answer["waits_calm"] = waits(url, folder / "spool", rebuilding=False)
        answer["waits_rebuilding"] = waits(url, folder / "spool", rebuilding=True)
    print(json.dumps(answer))


if __name__ == "__main__":
    main()
