"""Measure the rate from the spool to the tables as episodes, nodes in an episode, recorders and daemons grow.

    python -m bench.growth             half an hour: 100,000 nodes at a time, SQLite and PostgreSQL
    python -m bench.growth --quick     a few hundred nodes

*Nodes in an episode*: the same number of nodes in one episode, in ten, …, in one for each ten nodes. *Recorders*: the
same nodes in the folders of 1 to 32 recorders, drained by one daemon. *Daemons*: 1 to 4 daemons, each with its own
spool and the same number of nodes, on one PostgreSQL. *Episodes*: the rate of a hundred further episodes of a hundred
nodes when the database already contains a hundred, a thousand, … episodes. *Recording*: the memory of the recording
process after a number of nodes. The script prints one JSON line: nodes a second for each value, and the knee, which is
the largest value with at least nine tenths of the best rate. Every point is measured `--turns` times, alternating with
the others, and given as median, minimum and maximum.
"""

from __future__ import annotations

import argparse
import asyncio
import json
import statistics
import subprocess
import sys
import time
from collections.abc import Callable
from pathlib import Path
from typing import Any, NamedTuple

from rich.table import Table

from bench.daemon import start_daemon, stop
from bench.material.rollouts import progress, spool_rollouts, until_folded
from bench.material.runs import Place, options, place, record_notes
from bench.reporting.figures import console, held_mb, spread, table_of
from pycrorm_async import Memory

_NODES_A_ROLLOUT = 9.76
_SEED = 69
_KNEE_SHARE = 0.9


class Sizes(NamedTuple):
    """The values of each parameter that grows."""

    nodes: int
    an_episode: tuple[int, ...]
    recorders: tuple[int, ...]
    daemons: tuple[int, ...]
    episodes: tuple[int, ...]
    recorded: tuple[int, ...]


LONG = Sizes(
    nodes=100_000,
    an_episode=(10, 100, 1_000, 10_000, 100_000),
    recorders=(1, 2, 4, 8, 16, 32),
    daemons=(1, 2, 4),
    episodes=(100, 1_000, 10_000),
    recorded=(10_000, 100_000, 500_000),
)
QUICK = Sizes(nodes=500, an_episode=(10,), recorders=(2,), daemons=(2,), episodes=(10, 20), recorded=(200, 400))


class Databases:
    """Create databases of one kind, and folders for their spools."""

    def __init__(self, here: Place) -> None:
        self._place = here
        self._count = 0

    def new(self) -> tuple[str, Path]:
        """Return the URL of an empty database, and the path of its spool."""
        self._count += 1
        return self._place.new_url(f"{self._count}"), self._place.folder / f"{self._count}.spool"


# --- measurements ---------------------------------------------------------------------------------------------------


def nodes_per_s(
    databases: Databases, nodes: int, *, an_episode: int = 1_000, recorders: int = 1, daemons: int = 1
) -> float:
    """Start the daemons, move complete recorders' folders into their spools, and wait until all events are folded."""
    url, folder = databases.new()
    spools, complete_folders, events = [], [], 0
    for number in range(daemons):
        spools.append(folder.with_suffix(f".{number}"))
        for recorder in range(recorders):
            complete_folders.append((folder.with_suffix(f".{number}.{recorder}.made"), spools[-1]))
            events += _spool(complete_folders[-1][0], nodes // recorders, an_episode)
    running = [start_daemon(url, spool) for spool in spools]
    try:
        began = time.perf_counter()
        for complete, spool in complete_folders:
            for recorder_folder in complete.iterdir():
                recorder_folder.rename(spool / recorder_folder.name)
        until_folded(url, events)
        return nodes * daemons / (time.perf_counter() - began)
    finally:
        for each in running:
            stop(each)


def _spool(folder: Path, nodes: int, an_episode: int) -> int:
    """Spool about `nodes` nodes in episodes of about `an_episode` nodes; return the number of events."""
    rollouts = max(1, round(nodes / _NODES_A_ROLLOUT))
    return spool_rollouts(rollouts, folder, seed=_SEED, an_episode=max(1, round(an_episode / _NODES_A_ROLLOUT)))


def add_episodes(databases: Databases, sizes: Sizes) -> dict[str, dict[str, float]]:
    """Add episodes to one growing memory, and return nodes a second by the number of earlier episodes."""
    url, spool = databases.new()
    rates_by_episodes: dict[str, dict[str, float]] = {}
    stored_episodes = 0
    running = start_daemon(url, spool)
    try:
        for number, episodes in enumerate(sizes.episodes):
            rates: list[float] = []
            for more in (max(1, episodes - stored_episodes), *[sizes.episodes[0]] * 3):
                complete = spool.with_suffix(f".{number}.{len(rates)}.{more}")
                events = _spool(complete, more * 100, 100)
                folded = progress(url).folded
                began = time.perf_counter()
                for recorder_folder in complete.iterdir():
                    recorder_folder.rename(spool / recorder_folder.name)
                until_folded(url, folded + events)
                rates.append(more * 100 / (time.perf_counter() - began))
                stored_episodes += more
            rates_by_episodes[str(episodes)] = spread(rates[1:])
    finally:
        stop(running)
    return rates_by_episodes


async def record_and_measure(url: str, spool: Path, counts: tuple[int, ...]) -> dict[str, dict[str, float]]:
    """Record nodes, and return the resident MB of this process by count: all pages, and those without a file."""
    memory_mb: dict[str, dict[str, float]] = {}
    recorded = 0
    async with Memory.open(url, spool=spool) as memory:
        for count in counts:
            while recorded < count:
                await record_notes(memory, more := min(1_000, count - recorded))
                recorded += more
                await memory.flush()
            memory_mb[str(count)] = {"mb": held_mb("VmRSS"), "mb_without_files": held_mb("RssAnon")}
    return memory_mb


def recording(databases: Databases, sizes: Sizes) -> dict[str, Any]:
    """Measure the memory of recording in a new process."""
    url, spool = databases.new()
    command = [sys.executable, "-m", "bench.growth", "--record", url, str(spool)]
    command += ["--counts", *map(str, sizes.recorded)]
    memory_mb = dict(json.loads(subprocess.run(command, check=True, stdout=subprocess.PIPE, text=True).stdout))
    first, last = (memory_mb[str(count)] for count in (sizes.recorded[0], sizes.recorded[-1]))
    nodes = sizes.recorded[-1] - sizes.recorded[0]
    memory_mb["bytes_a_node"] = round((last["mb_without_files"] - first["mb_without_files"]) * 2**20 / nodes, 1)
    return memory_mb


# --- curves ---------------------------------------------------------------------------------------------------------


def curve(values: tuple[int, ...], turns: int, rate: Callable[[int], float]) -> dict[str, Any]:
    """Measure each value once in every turn; return the spreads and the knee."""
    rates: dict[int, list[float]] = {each: [] for each in values}
    for _ in range(turns):
        for value, measured_rates in rates.items():
            measured_rates.append(rate(value))
            console().print(f"    {value:,}: {measured_rates[-1]:,.0f} nodes/s")
    medians = {value: statistics.median(measured_rates) for value, measured_rates in rates.items()}
    near_best = [value for value, median in medians.items() if median >= _KNEE_SHARE * max(medians.values())]
    return {**{str(value): spread(measured_rates) for value, measured_rates in rates.items()}, "knee": max(near_best)}


def measure(databases: Databases, sizes: Sizes, turns: int, *, postgresql: bool) -> dict[str, Any]:
    def print_progress(parameter: str) -> None:
        console().print(f"  {parameter}")

    result: dict[str, Any] = {}
    print_progress("nodes in an episode")
    result["nodes_in_an_episode"] = curve(
        sizes.an_episode, turns, lambda each: nodes_per_s(databases, sizes.nodes, an_episode=each)
    )
    print_progress("recorders")
    result["recorders"] = curve(
        sizes.recorders, turns, lambda each: nodes_per_s(databases, sizes.nodes, recorders=each)
    )
    if postgresql:
        print_progress("daemons")
        result["daemons"] = curve(
            sizes.daemons, turns, lambda each: nodes_per_s(databases, sizes.nodes // 4, daemons=each)
        )
    print_progress("episodes")
    result["episodes"] = add_episodes(databases, sizes)
    print_progress("recording")
    result["recording"] = recording(databases, sizes)
    return result


def main() -> None:
    parser = options(__doc__, quick="a few hundred nodes, one turn")
    parser.add_argument("--turns", type=int, default=3)
    parser.add_argument("--databases", nargs="+", default=["sqlite", "postgresql"])
    parser.add_argument("--record", nargs=2, help=argparse.SUPPRESS)
    parser.add_argument("--counts", type=int, nargs="+", help=argparse.SUPPRESS)
    arguments = parser.parse_args()
    if arguments.record:
        url, spool = arguments.record
        print(json.dumps(asyncio.run(record_and_measure(url, Path(spool), tuple(arguments.counts)))))
        return
    sizes, turns = (QUICK, 1) if arguments.quick else (LONG, arguments.turns)
    result: dict[str, Any] = {"bench": "growth", "sizes": sizes._asdict(), "turns": turns, "seed": _SEED}
    for database in arguments.databases:
        console().print(database)
        with place(database) as here:
            result[database] = measure(Databases(here), sizes, turns, postgresql=here.server is not None)
    print(json.dumps(result))
    console().print(_table(result, arguments.databases))


def _table(result: dict[str, Any], databases: list[str]) -> Table:
    header = "database: | parameter: | value | nodes/s | least | most | :"
    table = table_of("Nodes a second from the spool to every row", header)
    for database in databases:
        for parameter, points in result[database].items():
            for value, rate in points.items():
                if parameter != "recording" and isinstance(rate, dict):
                    note = "knee" if str(points.get("knee")) == value else ""
                    table.add_row(
                        database, parameter.replace("_", " "), value, *(f"{each:,}" for each in rate.values()), note
                    )
    return table


if __name__ == "__main__":
    main()
