"""Run every script of `bench`, each in its own process, one after the other, and collect the figures.

    python -m bench                            a few hours, on a quiet machine; writes bench/figures
    python -m bench --middle                   every comparison with fewer nodes and turns, in minutes
    python -m bench --quick                    a short run of every script, to check that it works
    python -m bench --only thesis --only questions,  a run by its name, or all whose names begin with this
    python -m bench --tables                   print the tables of bench/README.md from the figures; runs nothing
    python -m bench --write                    write them into bench/README.md; runs nothing

`figures.jsonl` has one line for each run: the JSON that the script printed, its command, its duration, versions,
hardware, and the load of the machine before and after. A repeated run replaces its line, so single figures can be
measured again. `--middle` and `--quick` print their tables, and write no figures unless `--report FOLDER` is given. The
exit code is 1 if a script failed. The extras `[test,learning,bench]` are required; if a library is not installed, its
comparison is named as missing.
"""

from __future__ import annotations

import argparse
import json
import os
import shlex
import subprocess
import sys
import time
from pathlib import Path
from typing import Any, NamedTuple

from bench.reporting.figures import console, hardware, versions
from bench.reporting.tables import README, TABLES, draw, written


class Run(NamedTuple):
    """A script with its options; `quick` is False if the quick version of another run covers it.

    `middle` are the options of a run of some minutes; without them it is left out there.
    """

    name: str
    options: tuple[str, ...] = ()
    quick: bool = True
    middle: tuple[str, ...] | None = None

    @property
    def script(self) -> str:
        return self.name.replace(",", " ").split()[0]


_POSTGRESQL = ("--postgresql",)
_LARGE = ("--no-company", "--events", "100000", "10000000")
_WHOLE = ("--nodes", "488043", "--repeat", "1")
_TEN_THOUSAND = ("--nodes", "10000", "--repeat", "1")
RUNS = (
    Run("gate", middle=()),
    Run("rivals", middle=("--turns", "8", "--kills", "1")),
    Run("start", middle=()),
    Run("busy", middle=()),
    Run("busy postgresql", _POSTGRESQL),
    Run("plan", middle=("--turns", "3")),
    Run("world", middle=("--quick",)),
    Run("visible", middle=("--seconds", "3")),
    Run("live"),
    Run("others", middle=("--events", "20000", "--turns", "2")),
    Run("daemon", middle=()),
    Run("daemon postgresql", _POSTGRESQL, middle=_POSTGRESQL),
    Run("recall", middle=("--no-soar", "--actions", "100000")),
    Run("recall, large", ("--no-soar", "--actions", "10000000"), quick=False),
    Run("cases"),
    Run("thesis", middle=_TEN_THOUSAND),
    Run("thesis postgresql", _POSTGRESQL, quick=False, middle=(*_POSTGRESQL, *_TEN_THOUSAND)),
    Run("size", middle=("--nodes", "10000")),
    Run("questions", middle=("--pick-ups", "1000")),
    Run("questions, large", ("--pick-ups", "500000"), quick=False),
    Run("objects", middle=("--rows", "3000")),
    Run("rebuild", ("--workers", "1", "2"), middle=("--no-company", "--events", "20000", "100000")),
    Run("rebuild postgresql", (*_POSTGRESQL, "--workers", "1", "2")),
    Run("rebuild, large", _LARGE, quick=False),
    Run("rebuild postgresql, large", (*_POSTGRESQL, *_LARGE), quick=False),
    Run("growth", ("--turns", "2")),
    Run("placement"),
    Run("lake"),
    Run("thesis, 488,043 nodes", _WHOLE, quick=False),
    Run("thesis postgresql, 488,043 nodes", (*_POSTGRESQL, *_WHOLE), quick=False),
)
_FIGURES = Path("bench/figures")


def main() -> int:
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    size = parser.add_mutually_exclusive_group()
    size.add_argument("--quick", action="store_true", help="short runs, to check that every script works")
    size.add_argument("--middle", action="store_true", help="runs of some minutes in all")
    size.add_argument("--tables", action="store_true", help="print the tables of the figures, and run nothing")
    size.add_argument("--write", action="store_true", help="write the tables into bench/README.md, and run nothing")
    parser.add_argument("--only", action="append", help="runs whose names begin with this; can be repeated")
    parser.add_argument("--report", type=Path, help=f"folder for the figures; default: {_FIGURES}")
    arguments = parser.parse_args()
    report = arguments.report or _FIGURES
    if arguments.tables or arguments.write:
        _show(_lines(report), write=arguments.write)
        return 0
    selected = [
        run
        for run in RUNS
        if (run.quick or not arguments.quick)
        and (run.middle is not None or not arguments.middle)
        and any(_selects(word, run.name) for word in arguments.only or [""])
    ]
    if not selected:
        runs = ", ".join(run.name for run in RUNS)
        parser.error(f"no run has a name that begins with {', '.join(arguments.only)}; the runs are {runs}")
    keeps = arguments.report is not None or not (arguments.quick or arguments.middle)
    lines: dict[str, dict[str, Any]] = {}
    failed = []
    try:
        for run in selected:
            options = run.middle if arguments.middle and run.middle is not None else run.options
            line = measure(run, [*options, *(["--quick"] if arguments.quick else [])])
            if line is None:
                failed.append(run.name)
                continue
            print(json.dumps(line), flush=True)
            lines[run.name] = line
            if keeps:
                _note(report, run.name, line)
    except KeyboardInterrupt:
        console().print("interrupted; the finished runs are kept" if keeps else "interrupted")
        return 130
    _show(_lines(report) if keeps else lines, write=False)
    for name in failed:
        console().print(f"[bold red]{name} failed[/]")
    return 1 if failed else 0


def _selects(word: str, name: str) -> bool:
    """Return True if the word is the run's whole name, or a prefix of it and no run's whole name."""
    return name == word if any(run.name == word for run in RUNS) else name.startswith(word)


def measure(run: Run, options: list[str]) -> dict[str, Any] | None:
    """Run one script and return its line; return None if it failed, with the reason on stderr."""
    command = shlex.join(["python", "-m", f"bench.{run.script}", *options])
    console().rule(command)
    began, before = time.perf_counter(), _load()
    completed = subprocess.run(
        [sys.executable, "-m", f"bench.{run.script}", *options], stdout=subprocess.PIPE, text=True, check=False
    )
    took_s = round(time.perf_counter() - began, 1)
    lines = completed.stdout.splitlines()
    if completed.returncode or len(lines) != 1:
        return None
    about = {"command": command, "took_s": took_s, "load_before": before, "load_after": _load()}
    return {**json.loads(lines[0]), **about, "versions": versions(), "hardware": hardware()}


def _load() -> float:
    """Return the load average of the last minute."""
    return round(os.getloadavg()[0], 1)


def _lines(report: Path) -> dict[str, dict[str, Any]]:
    """Read the lines in the report, by run."""
    file = report / "figures.jsonl"
    lines = [json.loads(each) for each in file.read_text().splitlines()] if file.exists() else []
    return {each.pop("run"): each for each in lines}


def _note(report: Path, name: str, line: dict[str, Any]) -> None:
    """Write a line into the report, replacing an older line of the same run."""
    report.mkdir(parents=True, exist_ok=True)
    by_run = _lines(report) | {name: line}
    lines = {run.name: by_run[run.name] for run in RUNS if run.name in by_run}
    temporary = report / "figures.jsonl.new"
    temporary.write_text("".join(json.dumps({"run": run, **each}) + "\n" for run, each in lines.items()))
    temporary.replace(report / "figures.jsonl")


def _show(lines: dict[str, dict[str, Any]], *, write: bool) -> None:
    """Print the tables, or write them and the plot into the README."""
    if not write:
        for name, table in TABLES.items():
            console().print(f"\n{name}\n\n{table(lines)}", highlight=False, markup=False, soft_wrap=True)
        return
    README.write_text(written(README.read_text(), lines))
    try:
        draw(lines, _FIGURES)
    except ModuleNotFoundError:
        console().print("the plot is not drawn: matplotlib is not installed")


if __name__ == "__main__":
    sys.exit(main())
