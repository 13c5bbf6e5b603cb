"""Store task trees with the system of the thesis and with this package, until every row is in every table.

    python -m bench.thesis                    about 1,000, 10,000 and 50,000 nodes, SQLite; --postgresql on a new server
    python -m bench.thesis --nodes 488043 --repeat 1
    python -m bench.thesis --quick            300 nodes, on both databases

Both sides store the same values. The baseline (`bench/material/baseline.py`) has the whole tree in memory, adds an
object for each row to a session and commits once. This package has the tree as events in the folder of a dead recorder,
which a daemon discovers, appends and folds. The measured time ends when every row is in every table. It excludes the
start of processes and the creation of the baseline's tables; it includes the creation of our tables for the types of
nodes, and the discovery of the folder, which takes up to a fifth of a second. The sides take turns, each in its own
process. The script prints one JSON line: for each size nodes a second, the ratios of wall and of CPU time (median,
minimum and maximum over the turns; without the CPU time of a PostgreSQL server), rows and insert statements for a node,
and MB of the processes. Ours has two processes, whose shared memory is counted twice.
"""

from __future__ import annotations

import argparse
import json
import shutil
import subprocess
import sys
import tempfile
import time
from importlib.util import find_spec
from pathlib import Path
from typing import Any

from rich.table import Table

from bench.daemon import start_daemon, stop
from bench.material.baseline import BaselineBase, Statements, engine_of, store
from bench.material.rollouts import Tree, spool_tree, tree, until_folded
from bench.material.runs import Place, options, place
from bench.reporting.figures import (
    MISSING,
    console,
    cpu_s_of,
    held_mb,
    memory_free_gb,
    peak_mb,
    spread,
    table_of,
    with_children,
)
from tests.databases import ask

_BYTES_A_NODE = 36_000
"""Memory of the baseline for a node, because it keeps all rows as objects until it commits."""
_COMPARED = ("baseline_nodes_per_s", "ours_nodes_per_s", "times_faster", "times_less_cpu")


# --- one side, in its own process -----------------------------------------------------------------------------------


def store_by_baseline(url: str, nodes: int, seed: int) -> dict[str, Any]:
    """Store a tree with the baseline; return time, memory, rows and statements."""
    task_tree = tree(nodes, seed)
    engine = engine_of(url)
    statements = Statements(engine)
    before_mb = peak_mb()
    began, began_cpu = time.perf_counter(), time.process_time()
    store(task_tree, engine)
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


def store_by_us(url: str, recorded: Path, spool: Path, events: int) -> dict[str, Any]:
    """Store the events with a running daemon, measured from the move of their folder into its spool."""
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
    return {"seconds": seconds, "cpu_s": used_s, "appended_s": appended_s, "mb": mb, "rows": count_rows(url)}


def count_rows(url: str) -> int:
    """Count the rows of all our tables except the log and the bookkeeping."""
    if url.startswith("postgresql:"):
        tables_query = (
            "SELECT 'memory_tables.\"' || tablename || '\"' FROM pg_tables WHERE schemaname = 'memory_tables'"
        )
        tables_query += " AND tablename NOT LIKE 'pycrorm_%'"
    else:
        tables_query = (
            "SELECT '\"' || name || '\"' FROM sqlite_master WHERE type = 'table' AND name LIKE '%\\_\\_%' ESCAPE '\\'"
        )
        tables_query += " AND name NOT LIKE 'pycrorm_%'"
    return sum(int(ask(url, f"SELECT count(*) FROM {name}")[0][0]) for (name,) in ask(url, tables_query))


# --- both sides, in turns -------------------------------------------------------------------------------------------


def run_baseline(url: str, nodes: int, seed: int) -> dict[str, Any]:
    """Run the baseline in a new process and return its figures."""
    command = [sys.executable, "-m", "bench.thesis", "--baseline", url, "--nodes", str(nodes), "--seed", str(seed)]
    completed = subprocess.run(command, check=True, stdout=subprocess.PIPE, text=True)
    return dict(json.loads(completed.stdout))


def compare(task_tree: Tree, folder: Path, here: Place, *, seed: int, repeat: int) -> dict[str, Any]:
    """Measure both sides with one tree."""
    spooled = folder / "spooled"
    events = spool_tree(task_tree, spooled)
    baseline, ours = [], []
    nodes = task_tree.nodes
    for turn in range(repeat):
        baseline.append(run_baseline(here.new_url(f"{folder.name}/baseline{turn}"), nodes, seed))
        spool = folder / f"spool{turn}"
        shutil.copytree(spooled, spool)
        ours.append(store_by_us(here.new_url(f"{folder.name}/ours{turn}"), spool, folder / f"drained{turn}", events))
    shutil.rmtree(spooled)
    times_faster = [one["seconds"] / other["seconds"] for one, other in zip(baseline, ours, strict=True)]
    return {
        "nodes": nodes,
        "events": events,
        "baseline_nodes_per_s": spread([nodes / each["seconds"] for each in baseline]),
        "ours_nodes_per_s": spread([nodes / each["seconds"] for each in ours]),
        "times_faster": spread(times_faster),
        "times_less_cpu": spread([one["cpu_s"] / other["cpu_s"] for one, other in zip(baseline, ours, strict=True)]),
        "baseline_rows_per_node": round(baseline[0]["rows"] / nodes, 2),
        "baseline_statements_per_node": round(baseline[0]["statements"] / nodes, 2),
        "ours_rows_per_node": round(ours[0]["rows"] / nodes, 2),
        "baseline_mb": round(max(each["mb"] for each in baseline)),
        "baseline_tree_mb": round(max(each["tree_mb"] for each in baseline)),
        "ours_mb": round(max(each["mb"] for each in ours)),
        "ours_appended_share": spread([each["appended_s"] / each["seconds"] for each in ours]),
    }


def main() -> None:
    parser = options(__doc__, quick="300 nodes, on both databases")
    parser.add_argument("--postgresql", action="store_true", help="use a new PostgreSQL server")
    parser.add_argument("--nodes", type=int, nargs="+", default=[1_000, 10_000, 50_000])
    parser.add_argument("--repeat", type=int, default=3, help="turns of each side")
    parser.add_argument("--seed", type=int, default=69)
    parser.add_argument("--baseline", metavar="URL", help=argparse.SUPPRESS)
    arguments = parser.parse_args()
    if arguments.baseline:
        print(json.dumps(store_by_baseline(arguments.baseline, arguments.nodes[0], arguments.seed)))
        return
    sizes, repeat = ([300], 1) if arguments.quick else (arguments.nodes, arguments.repeat)
    if (needed_gb := max(sizes) * _BYTES_A_NODE / 1e9) > (free_gb := memory_free_gb()):
        parser.error(
            f"the baseline needs about {needed_gb:.0f} GB of memory, and {free_gb:.0f} GB are free; use fewer --nodes"
        )
    databases = ["sqlite", "postgresql"] if arguments.quick else ["postgresql" if arguments.postgresql else "sqlite"]
    result: dict[str, Any] = {"bench": "thesis", "seed": arguments.seed, "repeat": repeat}
    for database in databases:
        if database == "postgresql" and find_spec("psycopg") is None:
            result[database] = MISSING
            continue
        with place(database) as here:
            result[database] = [measure_size(size, here, arguments.seed, repeat) for size in sizes]
    print(json.dumps(result))
    console().print(_table(result))


def measure_size(size: int, here: Place, seed: int, repeat: int) -> dict[str, Any]:
    console().print(f"{size:,} nodes …")
    with tempfile.TemporaryDirectory(dir=here.folder) as folder:
        return compare(tree(size, seed), Path(folder), here, seed=seed, repeat=repeat)


def _table(result: dict[str, Any]) -> Table:
    header = "database: | nodes | thesis, nodes/s | ours, nodes/s | times faster | times less CPU | MB | MB, ours"
    table = table_of("Task trees to rows in all tables", header)
    for database in ("sqlite", "postgresql"):
        if result.get(database) == MISSING:
            table.add_row(database, MISSING)
            continue
        for each in result.get(database, ()):
            rates = [each[name]["median"] for name in _COMPARED]
            cells = [each["nodes"], *rates, each["baseline_mb"], each["ours_mb"]]
            table.add_row(database, *(f"{figure:,}" for figure in cells))
    return table


if __name__ == "__main__":
    main()
