"""Measure what it costs to import the package and to start a command, beside the libraries that both need anyway.

    python -m bench.start            10 processes of each kind, in turns
    python -m bench.start --quick    2 of each

The script prints one JSON line: the least CPU time of a process in ms, without that of an empty interpreter, the most
memory of it in MB, and the ratios to the imports that no program on these libraries can do without.
"""

from __future__ import annotations

import json
import os
import sys
import tempfile
from pathlib import Path
from typing import Final

from bench.material.runs import options

PROCESSES: Final = {
    "empty": ["-c", ""],
    "libraries of a memory": ["-c", "import sqlalchemy.ext.asyncio, numpy, msgspec"],
    "import Memory": ["-c", "from pycrorm_async import Memory"],
    "libraries of a command": ["-c", "import typer, sqlalchemy.ext.asyncio"],
    "import typer": ["-c", "import typer"],
    "pycrorm --version": ["-m", "pycrorm_async", "--version"],
    "pycrorm episodes": ["-m", "pycrorm_async", "episodes", "--url", "sqlite:///memory.db"],
}
RATIOS: Final = {
    "import Memory": "libraries of a memory",
    "pycrorm episodes": "libraries of a command",
    "pycrorm --version": "import typer",
}


def run(arguments: list[str], folder: Path) -> tuple[float, float]:
    """Run an interpreter to its end; return its CPU time in ms and its most memory in MB."""
    silent = [(os.POSIX_SPAWN_OPEN, number, os.devnull, os.O_RDWR, 0) for number in (1, 2)]
    environment = {**os.environ, "PYTHONPATH": str(Path(__file__).parents[1]), "PWD": str(folder)}
    pid = os.posix_spawn(sys.executable, [sys.executable, *arguments], environment, file_actions=silent)
    _, status, usage = os.wait4(pid, 0)
    assert os.waitstatus_to_exitcode(status) == 0, arguments
    return (usage.ru_utime + usage.ru_stime) * 1e3, usage.ru_maxrss / 1024


def measure(rounds: int) -> dict[str, object]:
    before = Path.cwd()
    took: dict[str, list[tuple[float, float]]] = {name: [] for name in PROCESSES}
    with tempfile.TemporaryDirectory(prefix="b") as folder:
        os.chdir(folder)
        try:
            run(["-m", "pycrorm_async", "demo", "--url", "sqlite:///memory.db"], Path(folder))
            for _ in range(rounds):
                for name, arguments in PROCESSES.items():
                    took[name].append(run(arguments, Path(folder)))
        finally:
            os.chdir(before)
    empty_ms = min(each[0] for each in took["empty"])
    cpu_ms = {name: round(min(each[0] for each in runs) - empty_ms, 1) for name, runs in took.items()}
    return {
        "cpu_ms": cpu_ms,
        "memory_mb": {name: round(max(each[1] for each in runs)) for name, runs in took.items()},
        "times": {name: round(cpu_ms[name] / cpu_ms[beside], 2) for name, beside in RATIOS.items()},
    }


def main() -> None:
    parser = options(__doc__, quick="2 processes of each kind")
    rounds = 2 if parser.parse_args().quick else 10
    print(json.dumps({"bench": "start", "rounds": rounds, **measure(rounds)}))


if __name__ == "__main__":
    main()
