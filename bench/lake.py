"""Measure `pycrorm archive` and `pycrorm restore`: events a second, and the memory that they take.

    python -m bench.lake                  100,000 and 320,000 events, SQLite and PostgreSQL
    python -m bench.lake --quick          2,000 events, SQLite
    python -m bench.lake --python OTHER   the commands of another Python, to compare two versions

Pick-up rollouts (`bench.material.rollouts`), ten in an episode, some 20 events each, are recorded and folded. Then the
command archives all episodes and the next restores and folds them, in turns with those of `--python`, if it is named.
Each size is repeated `--turns` times, and the turn with the least CPU time counts. A command's CPU time is that of its
process with all threads and fold workers, without a PostgreSQL server, and includes its start. The script prints one
JSON line: by database, Python, size and command, events a second of CPU time and of wall time, and MB of the process.
"""

from __future__ import annotations

import json
import os
import sys
import time
from collections.abc import Sequence
from pathlib import Path
from subprocess import DEVNULL, Popen
from typing import Any

from bench.material.rollouts import spool_rollouts
from bench.material.runs import options, place
from bench.reporting.figures import console
from tests.databases import ask_to_change

_EVENTS_A_ROLLOUT = 20.04
_SEED = 69
Figures = dict[str, float]


def run(python: str, words: Sequence[str], events: int, folder: Path) -> Figures:
    """Run a command of `pycrorm` to its end, in a folder without another version of it; return its figures."""
    began = time.perf_counter()
    process = Popen([python, "-m", "pycrorm_async", *words, "--json"], stdout=DEVNULL, cwd=folder)
    _, status, used = os.wait4(process.pid, 0)
    wall_s = time.perf_counter() - began
    assert status == 0, words
    cpu_s = used.ru_utime + used.ru_stime
    return {
        "events_per_cpu_s": round(events / cpu_s),
        "events_per_s": round(events / wall_s),
        "mb": round(used.ru_maxrss / 1024),
    }


def measure(url: str, folder: Path, pythons: Sequence[str], events: int, turns: int) -> dict[str, Any]:
    """Record these many events in a new memory; archive and restore them with each Python, in turns."""
    spool = folder / f"{events}.spool"
    recorded = spool_rollouts(round(events / _EVENTS_A_ROLLOUT), spool, seed=_SEED, an_episode=10)
    run(sys.executable, ["writer", "--once", "--url", url, "--spool", str(spool)], recorded, folder)
    best: dict[str, dict[str, Figures]] = {python: {} for python in pythons}
    for turn in range(turns):
        for number, python in enumerate(pythons):
            lake = f"ducklake:{folder}/{events}.{turn}.{number}.lake"
            archive = ["archive", "--before", "2100-01-01", "--to", lake, "--url", url, "--spool", str(spool)]
            restore = ["copy", "--from", lake, "--to", url]
            for words in archive, restore:
                figures = run(python, words, recorded, folder)
                console().print(f"    {python} {words[0]} {figures}")
                least = best[python].setdefault(words[0], figures)
                best[python][words[0]] = max(least, figures, key=lambda each: each["events_per_cpu_s"])
            ask_to_change(url, "DELETE FROM pycrorm_removed_episode")  # else only this lake takes them again
    return best


def main() -> None:
    parser = options(__doc__, quick="2,000 events, one turn, SQLite")
    parser.add_argument("--events", type=int, nargs="+", default=[100_000, 320_000])
    parser.add_argument("--turns", type=int, default=3)
    parser.add_argument("--databases", nargs="+", default=["sqlite", "postgresql"])
    parser.add_argument("--python", action="append", default=[], metavar="OTHER", help="another Python, in turns")
    arguments = parser.parse_args()
    sizes, turns, databases = arguments.events, arguments.turns, arguments.databases
    if arguments.quick:
        sizes, turns, databases = [2_000], 1, ["sqlite"]
    result: dict[str, Any] = {"bench": "lake", "turns": turns, "seed": _SEED}
    for database in databases:
        with place(database) as here:
            for events in sizes:
                console().print(f"{database}, {events:,} events")
                pythons = [sys.executable, *arguments.python]
                figures = measure(here.new_url(f"{events}"), here.folder, pythons, events, turns)
                result.setdefault(database, {})[f"{events:,}"] = figures
    print(json.dumps(result))


if __name__ == "__main__":
    main()
