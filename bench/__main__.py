"""All figures, side by side: every script of `bench` in a process of its own, one after the other.

    python -m bench                            two hours and more; the figures in bench/figures
    python -m bench --quick                    that every script still runs
    python -m bench --only thesis --only questions,  one by its name, or all whose name begins so
    python -m bench --report FOLDER            figures.jsonl, figures.md and the plots there

`figures.jsonl` has a line for each run: what the script printed, with its command, how long it took, versions,
hardware, and how busy the machine was before and after. What is measured again replaces the line that was there, so
figures can be measured one by one. `figures.md` shows all of them, with the budgets of the design beside. Lines are
printed too; exit code 1 if a script failed. It needs the extras `[test,learning,bench]`; without a library there is no
comparison with it, and the page says so.
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

from bench.reporting.budgets import BUDGETS, judged
from bench.reporting.figures import console
from bench.reporting.machine import hardware, versions
from bench.reporting.page import page
from bench.reporting.plots import draw


class Run(NamedTuple):
    """A script, with what it is told; `quick` is None where the quick version of another one covers it."""

    name: str
    options: tuple[str, ...] = ()
    quick: bool = True

    @property
    def script(self) -> str:
        return self.name.replace(",", " ").split()[0]


RUNS = (
    Run("hook"),
    Run("stages"),
    Run("busy"),
    Run("busy postgresql", ("--postgresql",)),
    Run("plan"),
    Run("visible"),
    Run("others"),
    Run("daemon"),
    Run("daemon postgresql", ("--postgresql",)),
    Run("thesis"),
    Run("thesis postgresql", ("--postgresql",), quick=False),
    Run("questions"),
    Run("questions, large", ("--pick-ups", "500000"), quick=False),
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
    parser.add_argument("--quick", action="store_true", help="that every script still runs")
    parser.add_argument("--only", action="append", help="those whose name begins with this; can be repeated")
    parser.add_argument("--report", type=Path, default=Path("bench/figures"), help="the folder of the figures")
    asked = parser.parse_args()
    chosen = [
        run
        for run in RUNS
        if (run.quick or not asked.quick) and any(_means(word, run.name) for word in asked.only or [""])
    ]
    if not chosen:
        parser.error(f"no such figure: {', '.join(asked.only)} (there are {', '.join(run.name for run in RUNS)})")
    asked.report.mkdir(parents=True, exist_ok=True)
    failed = []
    try:
        for run in chosen:
            line = measured(run, quick=asked.quick)
            if line is None:
                failed.append(run.name)
                continue
            print(json.dumps(line), flush=True)
            _note(asked.report, run.name, line)
    except KeyboardInterrupt:
        console().print("interrupted; what was measured is kept")
        return 130
    _say_budgets(_lines(asked.report))
    for name in failed:
        console().print(f"[bold red]{name} failed[/]")
    return 1 if failed else 0


def _means(word: str, name: str) -> bool:
    """A whole name means that run, the beginning of several means all of them."""
    return name == word if any(run.name == word for run in RUNS) else name.startswith(word)


def measured(run: Run, *, quick: bool) -> dict[str, Any] | None:
    """The line of one run; None if it failed, which its own words on stderr explain."""
    options = [*run.options, *(["--quick"] if quick else [])]
    shown = shlex.join(["python", "-m", f"bench.{run.script}", *options])
    console().rule(shown)
    began, before = time.perf_counter(), _load()
    done = subprocess.run(
        [sys.executable, "-m", f"bench.{run.script}", *options], stdout=subprocess.PIPE, text=True, check=False
    )
    took = round(time.perf_counter() - began, 1)
    lines = done.stdout.splitlines()
    if done.returncode or len(lines) != 1:
        return None
    about = {"command": shown, "took_s": took, "load_before": before, "load_after": _load()}
    return {**json.loads(lines[0]), **about, "versions": versions(), "hardware": hardware()}


def _load() -> float:
    """How many processes wanted to run, on average in the last minute."""
    return round(os.getloadavg()[0], 1)


def _lines(report: Path) -> dict[str, dict[str, Any]]:
    """What was measured so far, by run."""
    file = report / "figures.jsonl"
    kept = [json.loads(each) for each in file.read_text().splitlines()] if file.exists() else []
    return {each.pop("run"): each for each in kept}


def _note(report: Path, name: str, line: dict[str, Any]) -> None:
    """Beside what was measured before, in the place of an older line of this run."""
    found = _lines(report) | {name: line}
    lines = {run.name: found[run.name] for run in RUNS if run.name in found}
    made = report / "figures.jsonl.new"
    made.write_text("".join(json.dumps({"run": run, **each}) + "\n" for run, each in lines.items()))
    made.replace(report / "figures.jsonl")
    (report / "figures.md").write_text(page(lines, draw(lines, report)))


def _say_budgets(lines: dict[str, dict[str, Any]]) -> None:
    for budget in BUDGETS:
        verdict = judged(budget, lines)
        mark = {True: "[green]held[/]", False: "[bold red]missed[/]", None: "[dim]?[/]"}[verdict.held]
        console().print(f"{mark}  {budget.what} ({budget.budget}): {verdict.measured}", highlight=False)


if __name__ == "__main__":
    sys.exit(main())
