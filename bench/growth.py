"""Where it stops: how fast spools become rows as episodes, nodes in an episode, recorders and daemons grow.

    python -m bench.growth             half an hour: 100,000 nodes at a time, SQLite and PostgreSQL
    python -m bench.growth --quick     a few hundred

*Nodes in an episode*: the same number of nodes in one episode, in ten … in one for each ten nodes. *Recorders*: the
same nodes in the folders of 1 to 32 recorders that one daemon drains. *Daemons*: 1 to 4 of them, each with a spool of
its own and the same number of nodes, into one PostgreSQL. *Episodes*: how fast a hundred episodes of a hundred nodes
come on top when a hundred, a thousand … are there already. *Recording*: how large the recording process is after so
many nodes. Prints one JSON line: nodes a second for each, and the knee, the largest of each kind that still has nine
tenths of the best rate. Every point is measured `--turns` times, in turns; of these it tells median, least and most.
"""

from __future__ import annotations

import argparse
import asyncio
import json
import statistics
import subprocess
import sys
import tempfile
import time
from collections.abc import Callable
from contextlib import ExitStack
from dataclasses import dataclass
from pathlib import Path
from typing import Any, NamedTuple

from rich.table import Table

from bench.daemon import start_daemon, stop
from bench.material.spooled import spool_rollouts
from bench.material.watched import progress, until_folded
from bench.reporting.figures import console, held_mb, spread
from pycrorm_async import Memory
from pycrorm_async.plan import ActionAbstract
from tests.databases import Server, server_in

_NODES_A_ROLLOUT = 9.76
_SEED = 69
_STILL_GOOD = 0.9


class Sizes(NamedTuple):
    """How much of each."""

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


class Place:
    """New databases and folders of one kind."""

    def __init__(self, folder: Path, server: Server | None) -> None:
        self._folder = folder
        self._server = server
        self._count = 0

    def new(self) -> tuple[str, Path]:
        """The URL of an empty database, and where its spool will be."""
        self._count += 1
        spool = self._folder / f"{self._count}.spool"
        url = self._server.new_database() if self._server else f"sqlite:///{self._folder}/{self._count}.db"
        return url, spool


# --- what is measured -----------------------------------------------------------------------------------------------


def nodes_per_s(place: Place, nodes: int, *, an_episode: int = 1_000, recorders: int = 1, daemons: int = 1) -> float:
    """By daemons that run already when the recorders' folders come, so many for each, with all events in them."""
    url, folder = place.new()
    spools, waiting, events = [], [], 0
    for number in range(daemons):
        spools.append(folder.with_suffix(f".{number}"))
        for recorder in range(recorders):
            waiting.append((folder.with_suffix(f".{number}.{recorder}.made"), spools[-1]))
            events += _spooled(waiting[-1][0], nodes // recorders, an_episode)
    running = [start_daemon(url, spool) for spool in spools]
    try:
        began = time.perf_counter()
        for made, spool in waiting:
            for recorder_folder in made.iterdir():
                recorder_folder.rename(spool / recorder_folder.name)
        until_folded(url, events)
        return nodes * daemons / (time.perf_counter() - began)
    finally:
        for each in running:
            stop(each)


def _spooled(folder: Path, nodes: int, an_episode: int) -> int:
    """About so many nodes, in episodes of about so many; the number of events."""
    rollouts = max(1, round(nodes / _NODES_A_ROLLOUT))
    return spool_rollouts(rollouts, folder, seed=_SEED, an_episode=max(1, round(an_episode / _NODES_A_ROLLOUT)))


def as_episodes_grow(place: Place, sizes: Sizes) -> dict[str, dict[str, float]]:
    """Nodes a second of what comes on top, in one memory that grows."""
    url, spool = place.new()
    found: dict[str, dict[str, float]] = {}
    there = 0
    running = start_daemon(url, spool)
    try:
        for number, episodes in enumerate(sizes.episodes):
            rates = []
            for more in (max(1, episodes - there), *[sizes.episodes[0]] * 3):
                made = spool.with_suffix(f".{number}.{len(rates)}.{more}")
                events = _spooled(made, more * 100, 100)
                shown = progress(url).folded
                began = time.perf_counter()
                for recorder_folder in made.iterdir():
                    recorder_folder.rename(spool / recorder_folder.name)
                until_folded(url, shown + events)
                rates.append(more * 100 / (time.perf_counter() - began))
                there += more
            found[str(episodes)] = spread(rates[1:])
    finally:
        stop(running)
    return found


@dataclass
class NoteActionPerformable(ActionAbstract):
    text: str
    weight: float

    async def perform(self) -> None: ...


async def record_and_weigh(url: str, spool: Path, counts: tuple[int, ...]) -> dict[str, dict[str, float]]:
    """MB of this process when so many nodes are recorded and in the tables: all, and what is no file's."""
    found: dict[str, dict[str, float]] = {}
    recorded = 0
    async with Memory.open(url, spool=spool) as memory:
        for count in counts:
            while recorded < count:
                async with memory.episode(description="bench"):
                    for index in range(min(1_000, count - recorded)):
                        await NoteActionPerformable(f"note {index}", index / 7).perform()
                        recorded += 1
                await memory.flush()
            found[str(count)] = {"mb": held_mb("VmRSS"), "mb_without_files": held_mb("RssAnon")}
    return found


def recording(place: Place, sizes: Sizes) -> dict[str, Any]:
    """In a process of its own."""
    url, spool = place.new()
    command = [sys.executable, "-m", "bench.growth", "--record", url, str(spool)]
    command += ["--counts", *map(str, sizes.recorded)]
    found = dict(json.loads(subprocess.run(command, check=True, stdout=subprocess.PIPE, text=True).stdout))
    first, last = (found[str(count)] for count in (sizes.recorded[0], sizes.recorded[-1]))
    nodes = sizes.recorded[-1] - sizes.recorded[0]
    found["bytes_a_node"] = round((last["mb_without_files"] - first["mb_without_files"]) * 2**20 / nodes, 1)
    return found


# --- all of it ------------------------------------------------------------------------------------------------------


def curve(values: tuple[int, ...], turns: int, rate: Callable[[int], float]) -> dict[str, Any]:
    """Each value as often as there are turns, in turns; and the knee."""
    rates: dict[int, list[float]] = {each: [] for each in values}
    for _ in range(turns):
        for value, found in rates.items():
            found.append(rate(value))
            console().print(f"    {value:,}: {found[-1]:,.0f} nodes/s")
    medians = {value: statistics.median(found) for value, found in rates.items()}
    good = [value for value, median in medians.items() if median >= _STILL_GOOD * max(medians.values())]
    return {**{str(value): spread(found) for value, found in rates.items()}, "knee": max(good)}


def measured(place: Place, sizes: Sizes, turns: int, *, postgresql: bool) -> dict[str, Any]:
    def say(what: str) -> None:
        console().print(f"  {what}")

    answer: dict[str, Any] = {}
    say("nodes in an episode")
    answer["nodes_in_an_episode"] = curve(
        sizes.an_episode, turns, lambda each: nodes_per_s(place, sizes.nodes, an_episode=each)
    )
    say("recorders")
    answer["recorders"] = curve(sizes.recorders, turns, lambda each: nodes_per_s(place, sizes.nodes, recorders=each))
    if postgresql:
        say("daemons")
        answer["daemons"] = curve(sizes.daemons, turns, lambda each: nodes_per_s(place, sizes.nodes // 4, daemons=each))
    say("episodes")
    answer["episodes"] = as_episodes_grow(place, sizes)
    say("recording")
    answer["recording"] = recording(place, sizes)
    return answer


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--quick", action="store_true", help="a few hundred nodes, one turn")
    parser.add_argument("--turns", type=int, default=3)
    parser.add_argument("--databases", nargs="+", default=["sqlite", "postgresql"])
    parser.add_argument("--record", nargs=2, help=argparse.SUPPRESS)
    parser.add_argument("--counts", type=int, nargs="+", help=argparse.SUPPRESS)
    asked = parser.parse_args()
    if asked.record:
        url, spool = asked.record
        print(json.dumps(asyncio.run(record_and_weigh(url, Path(spool), tuple(asked.counts)))))
        return
    sizes, turns = (QUICK, 1) if asked.quick else (LONG, asked.turns)
    answer: dict[str, Any] = {"bench": "growth", "sizes": sizes._asdict(), "turns": turns, "seed": _SEED}
    with ExitStack() as stack:
        for database in asked.databases:
            console().print(database)
            folder = Path(stack.enter_context(tempfile.TemporaryDirectory(prefix="b")))
            server = stack.enter_context(server_in(folder / "pg")) if database == "postgresql" else None
            answer[database] = measured(Place(folder, server), sizes, turns, postgresql=server is not None)
    print(json.dumps(answer))
    console().print(_table(answer, asked.databases))


def _table(answer: dict[str, Any], databases: list[str]) -> Table:
    table = Table(title="Nodes a second from the spool to every row", title_justify="left")
    for name in ("database", "what grows", "to", "nodes/s", "least", "most", ""):
        table.add_column(name, justify="left" if name in ("database", "what grows", "") else "right")
    for database in databases:
        for what, points in answer[database].items():
            for value, rate in points.items():
                if what != "recording" and isinstance(rate, dict):
                    note = "the knee" if str(points.get("knee")) == value else ""
                    table.add_row(
                        database, what.replace("_", " "), value, *(f"{each:,}" for each in rate.values()), note
                    )
    return table


if __name__ == "__main__":
    main()
