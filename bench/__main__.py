"""Run every script of `bench`, each in its own process, one after the other, and collect the figures.

    python -m bench                            a few hours; writes bench/figures
    python -m bench --quick                    a short run of every script, to check that it works
    python -m bench --only thesis --only questions,  a run by its name, or all whose names begin with this
    python -m bench --report FOLDER            write figures.jsonl, figures.md and the plots there

`figures.jsonl` has one line for each run: the JSON that the script printed, its command, its duration, versions,
hardware, and the load of the machine before and after. A repeated run replaces its line, so single figures can be
measured again. `figures.md` shows all figures and the budgets of the design. The lines are also printed. The exit code
is 1 if a script failed. The extras `[test,learning,bench]` are required; if a library is not installed, the page marks
its comparison as missing.
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

from bench.reporting.budgets import BUDGETS, verdict_on
from bench.reporting.figures import console, hardware, versions
from bench.reporting.page import draw, page


class Run(NamedTuple):
    """A script with its options; `quick` is False if the quick version of another run covers it."""

    name: str
    options: tuple[str, ...] = ()
    quick: bool = True

    @property
    def script(self) -> str:
        return self.name.replace(",", " ").split()[0]


RUNS = (
    Run("hook"),
    Run("recording"),
    Run("stages"),
    Run("observations"),
    Run("busy"),
    Run("busy postgresql", ("--postgresql",)),
    Run("plan"),
    Run("visible"),
    Run("live"),
    Run("others"),
    Run("daemon"),
    Run("daemon postgresql", ("--postgresql",)),
    Run("behaviour_trees"),
    Run("digests"),
    Run("recall"),
    Run("recall, large", ("--no-soar", "--actions", "10000000"), quick=False),
    Run("cases"),
    Run("thesis"),
    Run("thesis postgresql", ("--postgresql",), quick=False),
    Run("size"),
    Run("questions"),
    Run("questions, large", ("--pick-ups", "500000"), quick=False),
    Run("objects"),
    Run("rebuild", ("--workers", "1", "2")),
    Run("rebuild postgresql", ("--postgresql", "--workers", "1", "2")),
    Run("rebuild, large", ("--no-company", "--events", "100000", "10000000"), quick=False),
    Run("rebuild postgresql, large", ("--postgresql", "--no-company", "--events", "100000", "10000000"), quick=False),
    Run("growth", ("--turns", "2")),
    Run("thesis, 488,043 nodes", ("--nodes", "488043", "--repeat", "1"), quick=False),
    Run("thesis postgresql, 488,043 nodes", ("--postgresql", "--nodes", "488043", "--repeat", "1"), quick=False),
)


def main() -> int:
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--quick", action="store_true", help="short runs, to check that every script works")
    parser.add_argument("--only", action="append", help="runs whose names begin with this; can be repeated")
    parser.add_argument("--report", type=Path, default=Path("bench/figures"), help="folder for the figures")
    arguments = parser.parse_args()
    selected = [
        run
        for run in RUNS
        if (run.quick or not arguments.quick) and any(_selects(word, run.name) for word in arguments.only or [""])
    ]
    if not selected:
        runs = ", ".join(run.name for run in RUNS)
        parser.error(f"no run has a name that begins with {', '.join(arguments.only)}; the runs are {runs}")
    arguments.report.mkdir(parents=True, exist_ok=True)
    failed = []
    try:
        for run in selected:
            line = measure(run, quick=arguments.quick)
            if line is None:
                failed.append(run.name)
                continue
            print(json.dumps(line), flush=True)
            _note(arguments.report, run.name, line)
    except KeyboardInterrupt:
        console().print("interrupted; the finished runs are kept")
        return 130
    _print_budgets(_lines(arguments.report))
    for name in failed:
        console().print(f"[bold red]{name} failed[/]")
    return 1 if failed else 0


def _selects(word: str, name: str) -> bool:
    """Return True if the word is the run's whole name, or a prefix of it and no run's whole name."""
    return name == word if any(run.name == word for run in RUNS) else name.startswith(word)


def measure(run: Run, *, quick: bool) -> dict[str, Any] | None:
    """Run one script and return its line; return None if it failed, with the reason on stderr."""
    options = [*run.options, *(["--quick"] if quick else [])]
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
    """Write a line into the report, replacing an older line of the same run, and render the page."""
    by_run = _lines(report) | {name: line}
    lines = {run.name: by_run[run.name] for run in RUNS if run.name in by_run}
    temporary = report / "figures.jsonl.new"
    temporary.write_text("".join(json.dumps({"run": run, **each}) + "\n" for run, each in lines.items()))
    temporary.replace(report / "figures.jsonl")
    (report / "figures.md").write_text(page(lines, draw(lines, report)))


def _print_budgets(lines: dict[str, dict[str, Any]]) -> None:
    for budget in BUDGETS:
        verdict = verdict_on(budget, lines)
        mark = {True: "[green]met[/]", False: "[bold red]missed[/]", None: "[dim]?[/]"}[verdict.met]
        console().print(f"{mark}  {budget.measurement} ({budget.budget}): {verdict.measured}", highlight=False)


if __name__ == "__main__":
    sys.exit(main())
