"""Measure the bytes on disk that a node takes, in the memory of the thesis and in this one.

    python -m bench.size             30,000 nodes and 2,000 learned rollouts, SQLite and PostgreSQL
    python -m bench.size --quick     300 nodes and 100 rollouts

Both sides store one tree of pick-up rollouts (`bench/material`) with the same values: the thesis' memory as rows of its
tables, this one as events in the log and as the rows that are folded from them. In a SQLite file the pages of each
table and index are counted (`dbstat`), on PostgreSQL the blocks (`pg_relation_size`), with those of long values
(TOAST). The tables of an empty memory are subtracted. A second memory of ours is that of `pycrorm learn`, in which the
world, the joints and the failures of a robot are recorded, too. The script prints one JSON line: for each database and
side bytes a node, for ours also by log and tables, rows and indexes apart, for each table and index that takes at least
one byte a node, and the bytes of the payloads by type of event.
"""

from __future__ import annotations

import json
import re
import subprocess
import sys
from importlib.util import find_spec
from pathlib import Path
from typing import Any

from bench.material.rollouts import Tree, spool_tree, tree
from bench.material.runs import DATABASES, Place, options, place
from bench.reporting.figures import MISSING
from bench.thesis import run_baseline, store_by_us
from tests.databases import ask

_SEED = 69
_PAGES = "SELECT name, sum(pgsize) FROM dbstat GROUP BY name"
_BLOCKS = """
SELECT relname, pg_relation_size(pg_class.oid) + coalesce(pg_relation_size(nullif(reltoastrelid, 0)), 0)
FROM pg_class JOIN pg_namespace ON pg_namespace.oid = relnamespace
WHERE relkind IN ('r', 'i') AND nspname NOT IN ('pg_catalog', 'information_schema', 'pg_toast')"""
_LOG = re.compile(r"(sqlite_autoindex_)?(event|episode)(_|$)")
_INDEX = re.compile(r"_by_|_pkey$|_key$|^sqlite_autoindex_")


def sizes(url: str) -> dict[str, int]:
    """Return the bytes of each table and index of a database."""
    return {name: int(size) for name, size in ask(url, _BLOCKS if url.startswith("postgresql:") else _PAGES)}


def by_part(sizes_by_name: dict[str, int], nodes: int) -> dict[str, Any]:
    """Return bytes a node: of everything, of log and tables with their indexes, and of each table and index."""
    parts = {"log": 0, "log, indexes": 0, "tables": 0, "tables, indexes": 0}
    for name, size in sizes_by_name.items():
        of_log = "log" if _LOG.match(name) else "tables"
        parts[f"{of_log}, indexes" if _INDEX.search(name) else of_log] += size
    each = {name: round(size / nodes, 1) for name, size in sizes_by_name.items() if size >= nodes}
    return {
        "bytes_a_node": round(sum(sizes_by_name.values()) / nodes),
        **{name: round(size / nodes) for name, size in parts.items()},
        "each": dict(sorted(each.items(), key=lambda item: -item[1])),
    }


def payloads(url: str, nodes: int) -> dict[str, float]:
    """Return the bytes a node of the payloads of each type of event."""
    by_type = ask(url, "SELECT type, sum(length(payload)) FROM event GROUP BY type ORDER BY 2 DESC")
    return {name: round(int(size) / nodes, 1) for name, size in by_type if size >= nodes}


def learned(url: str, folder: Path, rollouts: int, empty: dict[str, int]) -> dict[str, Any]:
    """Learn from rollouts in Bullet and return the bytes a node of their memory."""
    numbers = {"rollouts": rollouts, "evaluate": rollouts // 5, "held-out": rollouts // 5}
    numbers["min-samples-leaf"] = min(25, rollouts // 25)  # of 100 rollouts about ten succeed
    files = {"policy": folder / "policy.json", "figure": folder / "policies.png", "url": url}
    options = [part for name, value in (numbers | files).items() for part in (f"--{name}", str(value))]
    subprocess.run([sys.executable, "-m", "pycrorm_async", "learn", *options], check=True, stdout=subprocess.DEVNULL)
    [(nodes,)] = ask(url, "SELECT count(*) FROM event WHERE type = 'NodeStarted'")
    return {"nodes": nodes, **by_part(_without(empty, sizes(url)), nodes), "payloads": payloads(url, nodes)}


def _without(empty: dict[str, int], stored: dict[str, int]) -> dict[str, int]:
    return {name: size - empty.get(name, 0) for name, size in stored.items()}


def measure(here: Place, task_tree: Tree, rollouts: int) -> dict[str, Any]:
    """Store the tree with both sides, and learn from rollouts if there are any; return the bytes a node."""
    sizes_by_name: list[dict[str, int]] = []
    for name, each in (("empty", Tree([], 1)), ("ours", task_tree)):
        spool, recorded = here.folder / name, here.folder / f"{name}.recorded"
        events = spool_tree(each, recorded)
        url = here.new_url(name)
        store_by_us(url, recorded, spool, events)
        sizes_by_name.append(sizes(url))
    empty, stored = sizes_by_name
    result: dict[str, Any] = {
        "ours": by_part(_without(empty, stored), task_tree.nodes) | {"payloads": payloads(url, task_tree.nodes)},
        "thesis_bytes_a_node": MISSING,
        "learned": MISSING,
    }
    if rollouts:
        result["learned"] = learned(here.new_url("learned"), here.folder, rollouts, empty)
    if here.server is None or find_spec("psycopg") is not None:
        url = here.new_url("thesis")
        run_baseline(url, task_tree.nodes, _SEED)
        result["thesis_bytes_a_node"] = round(sum(sizes(url).values()) / task_tree.nodes)
    return result


def main() -> None:
    parser = options(__doc__, quick="300 nodes, 100 rollouts")
    parser.add_argument("--nodes", type=int, default=30_000)
    parser.add_argument("--rollouts", type=int, default=2_000, help="that `pycrorm learn` learns from; 0: leave it out")
    arguments = parser.parse_args()
    rollouts = (100 if arguments.quick else arguments.rollouts) if find_spec("jpt") is not None else 0
    task_tree = tree(300 if arguments.quick else arguments.nodes, _SEED)
    result: dict[str, Any] = {"bench": "size", "nodes": task_tree.nodes}
    for database in DATABASES:
        with place(database) as here:
            result[database] = measure(here, task_tree, rollouts)
    print(json.dumps(result))


if __name__ == "__main__":
    main()
