"""From task trees to every row in every table: as the system of the thesis did it, and as ours does.

    python -m bench.thesis                    about 1,000, 10,000 and 50,000 nodes, SQLite; --postgresql on a server
    python -m bench.thesis --nodes 488043 --repeat 1
    python -m bench.thesis --quick            300 nodes, on both databases

The trees are the same values on both sides. The baseline (`bench/baseline`) has the whole tree in memory, adds an
object for each row to a session and commits once; ours has it as events in the folder of a recorder that is gone, which
a daemon finds, appends and folds. The clock runs from there until every row is in every table, without starting
processes and without making the tables of the baseline; those of ours for the types of nodes are made in that time,
and finding the folder takes a fifth of a second at most. The sides take turns, each in its own process. Prints one JSON
line: by size nodes a second, how many times faster ours is (median, least and most over the turns) and how much less of
the processor it takes (on PostgreSQL without the server's), rows and insert statements a node, and MB of the processes,
of ours those of both, in which what they share counts twice.
"""

from __future__ import annotations

import argparse
import json
import shutil
import subprocess
import sys
import tempfile
import time
from contextlib import ExitStack
from functools import partial
from importlib.util import find_spec
from pathlib import Path
from typing import Any

from rich.table import Table

from bench.baseline.storing import Statements, engine_of, store
from bench.baseline.tables import BaselineBase
from bench.daemon import start_daemon, stop
from bench.material.rollouts import Tree, tree
from bench.material.spooled import spool_tree
from bench.material.watched import until_folded
from bench.reporting.figures import MISSING, console, cpu_s_of, held_mb, memory_free_gb, peak_mb, spread, with_children
from tests.databases import Server, ask, server_in

_BYTES_A_NODE = 36_000
"""Of the baseline, which has all rows as objects until it commits."""
_COMPARED = ("baseline_nodes_per_s", "ours_nodes_per_s", "times_faster", "times_less_cpu")


# --- one side, in a process of its own ------------------------------------------------------------------------------


def stored_by_baseline(url: str, nodes: int, seed: int) -> dict[str, Any]:
    """What it takes the baseline, with the whole tree in memory."""
    made = tree(nodes, seed)
    engine = engine_of(url)
    statements = Statements(engine)
    before_mb = peak_mb()
    began, began_cpu = time.perf_counter(), time.process_time()
    store(made, engine)
    seconds, cpu_s = time.perf_counter() - began, time.process_time() - began_cpu
    rows = sum(ask(url, f"SELECT count(*) FROM {_quoted(each, url)}")[0][0] for each in BaselineBase.metadata.tables)
    return {
        "seconds": seconds,
        "cpu_s": cpu_s,
        "mb": peak_mb(),
        "tree_mb": before_mb,
        "rows": rows,
        "statements": statements.sent,
    }


def _quoted(table: str, url: str) -> str:
    return f'public."{table}"' if url.startswith("postgresql:") else f'"{table}"'


def stored_by_us(url: str, recorded: Path, spool: Path, events: int) -> dict[str, Any]:
    """What it takes a daemon that runs already, from the moment the folder with all events is in its spool."""
    daemon = start_daemon(url, spool)
    try:
        processes = with_children(daemon.pid)
        cpu_s = sum(map(cpu_s_of, processes))
        began = time.perf_counter()
        for folder in recorded.iterdir():
            folder.rename(spool / folder.name)
        appended_s, _ = until_folded(url, events)
        seconds = time.perf_counter() - began
        used_s, mb = sum(map(cpu_s_of, processes)) - cpu_s, sum(held_mb("VmHWM", each) for each in processes)
    finally:
        stop(daemon)
    return {"seconds": seconds, "cpu_s": used_s, "appended_s": appended_s, "mb": mb, "rows": rows_shown(url)}


def rows_shown(url: str) -> int:
    """Rows in all our tables but the log and the bookkeeping."""
    if url.startswith("postgresql:"):
        named = "SELECT 'memory_tables.\"' || tablename || '\"' FROM pg_tables WHERE schemaname = 'memory_tables'"
        named += " AND tablename NOT LIKE 'pycrorm_%'"
    else:
        named = (
            "SELECT '\"' || name || '\"' FROM sqlite_master WHERE type = 'table' AND name LIKE '%\\_\\_%' ESCAPE '\\'"
        )
        named += " AND name NOT LIKE 'pycrorm_%'"
    return sum(int(ask(url, f"SELECT count(*) FROM {name}")[0][0]) for (name,) in ask(url, named))


# --- the two, in turns ----------------------------------------------------------------------------------------------


def by_baseline(url: str, nodes: int, seed: int) -> dict[str, Any]:
    """What its process says."""
    command = [sys.executable, "-m", "bench.thesis", "--baseline", url, "--nodes", str(nodes), "--seed", str(seed)]
    done = subprocess.run(command, check=True, stdout=subprocess.PIPE, text=True)
    return dict(json.loads(done.stdout))


def compared(made: Tree, folder: Path, *, seed: int, repeat: int, server: Server | None) -> dict[str, Any]:
    """One size."""
    spooled = folder / "spooled"
    events = spool_tree(made, spooled)
    new = partial(_new_url, folder, server)
    theirs, ours = [], []
    nodes = made.nodes
    for turn in range(repeat):
        theirs.append(by_baseline(new(f"baseline{turn}"), nodes, seed))
        spool = folder / f"spool{turn}"
        shutil.copytree(spooled, spool)
        ours.append(stored_by_us(new(f"ours{turn}"), spool, folder / f"drained{turn}", events))
    shutil.rmtree(spooled)
    faster = [one["seconds"] / other["seconds"] for one, other in zip(theirs, ours, strict=True)]
    return {
        "nodes": nodes,
        "events": events,
        "baseline_nodes_per_s": spread([nodes / each["seconds"] for each in theirs]),
        "ours_nodes_per_s": spread([nodes / each["seconds"] for each in ours]),
        "times_faster": spread(faster),
        "times_less_cpu": spread([one["cpu_s"] / other["cpu_s"] for one, other in zip(theirs, ours, strict=True)]),
        "baseline_rows_per_node": round(theirs[0]["rows"] / nodes, 2),
        "baseline_statements_per_node": round(theirs[0]["statements"] / nodes, 2),
        "ours_rows_per_node": round(ours[0]["rows"] / nodes, 2),
        "baseline_mb": round(max(each["mb"] for each in theirs)),
        "baseline_tree_mb": round(max(each["tree_mb"] for each in theirs)),
        "ours_mb": round(max(each["mb"] for each in ours)),
        "ours_appended_share": spread([each["appended_s"] / each["seconds"] for each in ours]),
    }


def _new_url(folder: Path, server: Server | None, name: str) -> str:
    return server.new_database() if server else f"sqlite:///{folder}/{name}.db"


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--quick", action="store_true", help="300 nodes, on both databases")
    parser.add_argument("--postgresql", action="store_true", help="on a server of its own")
    parser.add_argument("--nodes", type=int, nargs="+", default=[1_000, 10_000, 50_000])
    parser.add_argument("--repeat", type=int, default=3, help="how often each side has its turn")
    parser.add_argument("--seed", type=int, default=69)
    parser.add_argument("--baseline", metavar="URL", help=argparse.SUPPRESS)
    asked = parser.parse_args()
    if asked.baseline:
        print(json.dumps(stored_by_baseline(asked.baseline, asked.nodes[0], asked.seed)))
        return
    sizes, repeat = ([300], 1) if asked.quick else (asked.nodes, asked.repeat)
    if (needed_gb := max(sizes) * _BYTES_A_NODE / 1e9) > (free_gb := memory_free_gb()):
        parser.error(f"the baseline needs about {needed_gb:.0f} GB and {free_gb:.0f} are free: ask for fewer nodes")
    databases = ["sqlite", "postgresql"] if asked.quick else ["postgresql" if asked.postgresql else "sqlite"]
    answer: dict[str, Any] = {"bench": "thesis", "seed": asked.seed, "repeat": repeat}
    with ExitStack() as stack:
        place = Path(stack.enter_context(tempfile.TemporaryDirectory(prefix="b")))
        for database in databases:
            if database == "postgresql" and find_spec("psycopg") is None:
                answer[database] = MISSING
                continue
            server = stack.enter_context(server_in(place / "pg")) if database == "postgresql" else None
            answer[database] = [_one_size(size, place, asked.seed, repeat, server) for size in sizes]
    print(json.dumps(answer))
    console().print(_table(answer))


def _one_size(size: int, place: Path, seed: int, repeat: int, server: Server | None) -> dict[str, Any]:
    console().print(f"{size:,} nodes …")
    with tempfile.TemporaryDirectory(dir=place) as folder:
        return compared(tree(size, seed), Path(folder), seed=seed, repeat=repeat, server=server)


def _table(answer: dict[str, Any]) -> Table:
    table = Table(title="From trees to every row in every table", title_justify="left")
    for name in (
        "database",
        "nodes",
        "thesis, nodes/s",
        "ours, nodes/s",
        "times faster",
        "times less CPU",
        "MB",
        "MB, ours",
    ):
        table.add_column(name, justify="left" if name == "database" else "right")
    for database in ("sqlite", "postgresql"):
        if answer.get(database) == MISSING:
            table.add_row(database, MISSING)
            continue
        for each in answer.get(database, ()):
            rates = [each[name]["median"] for name in _COMPARED]
            figures = [each["nodes"], *rates, each["baseline_mb"], each["ours_mb"]]
            table.add_row(database, *(f"{figure:,}" for figure in figures))
    return table


if __name__ == "__main__":
    main()
