"""Measure what a start and an end cost that another executive records, beside the hook of our own plan layer.

    python -m bench.recording            40 rounds of 1,000 nodes
    python -m bench.recording --quick    4 rounds

Both write the same nodes, an action with object, arm and grasp and the state of a robot, into the queue of one memory
whose writer is a daemon that does not run, so no other thread takes part. Rounds alternate; each figure is the median
over the rounds, in µs of the plan's thread. The hook is half of what a perform with a memory takes longer than one
without. The script prints one JSON line; the table is on stderr.
"""

from __future__ import annotations

import argparse
import asyncio
import contextvars
import json
import statistics
import tempfile
import time
from pathlib import Path
from typing import Any

from rich.console import Console
from rich.table import Table

from bench.material.turns import NothingActionPerformable, nothing_action
from pycrorm_async import Memory, Settings
from pycrorm_async.record.recorded_episode import RecordedEpisode
from pycrorm_async.record.recording import Recording
from pycrorm_async.world import BulletWorld, Pose

NODES = 1_000


async def performs(action: NothingActionPerformable) -> float:
    started = time.thread_time_ns()
    for _ in range(NODES):
        await action.perform()
    return (time.thread_time_ns() - started) / NODES / 1_000


def nodes(recording: Recording, episode: RecordedEpisode) -> tuple[float, float]:
    """Write the same nodes through the seam; return the cost of a start and of an end, µs."""
    fields: Any = {"object_designator": "object", "arm": "text", "grasp": "text"}
    kind = recording.type("action", "NothingAction", fields)
    parameters = {"object_designator": "milk", "arm": "LEFT", "grasp": "FRONT"}
    starts = ends = 0
    for key in range(NODES):
        first = time.thread_time_ns()
        episode.start(key, kind, parameters, robot="pr2")
        second = time.thread_time_ns()
        episode.end(key)
        starts, ends = starts + second - first, ends + time.thread_time_ns() - second
    return starts / NODES / 1_000, ends / NODES / 1_000


async def measured(rounds: int, folder: Path) -> dict[str, float]:
    settings = Settings(spool_bytes_max=2**33, segment_bytes=2**26)
    figures: dict[str, list[float]] = {"hook": [], "start": [], "end": []}
    with BulletWorld():
        action = nothing_action()
        without = contextvars.copy_context()  # before the memory is open
        async with Memory.open(f"sqlite:///{folder / 'memory.db'}", writer="daemon", settings=settings) as memory:
            with memory.recording.episode(description="seam") as episode:
                episode.object_added("pr2", "pr2", "ROBOT", Pose(), {"torso": 0.1}, torso_joint="torso")
                episode.object_added("milk", "milk", "MILK", Pose())
                async with memory.episode(description="hook"):
                    for _ in range(rounds):
                        alone = await asyncio.create_task(performs(action), context=without)
                        figures["hook"].append((await performs(action) - alone) / 2)
                        start, end = nodes(memory.recording, episode)
                        figures["start"].append(start)
                        figures["end"].append(end)
    return {name: round(statistics.median(each), 1) for name, each in figures.items()}


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--quick", action="store_true", help="4 rounds, to check that it works")
    rounds = 4 if parser.parse_args().quick else 40
    with tempfile.TemporaryDirectory() as folder:
        figures = asyncio.run(measured(rounds, Path(folder)))
    table = Table("", "µs", title=f"one event, median of {rounds} rounds of {NODES} nodes")
    table.add_row("hook of our own plan layer, a start or an end", f"{figures['hook']:.1f}")
    table.add_row("seam, a start with three parameters and a robot", f"{figures['start']:.1f}")
    table.add_row("seam, an end", f"{figures['end']:.1f}")
    Console(stderr=True).print(table)
    costs = {f"{name}_us": value for name, value in figures.items()}
    print(json.dumps({"bench": "recording", "rounds": rounds, "nodes": NODES, **costs}))


if __name__ == "__main__":
    main()
