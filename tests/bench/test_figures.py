"""Every script of `bench/` runs and prints its figures, and the README shows them with the verdicts of the budgets."""

import json
import subprocess
import sys
from pathlib import Path
from typing import Any

import pytest

from bench import gate
from bench.__main__ import RUNS, _lines, _note
from bench.reporting.budgets import BUDGETS, Verdict, verdict_on
from bench.reporting.figures import MISSING
from bench.reporting.tables import TABLES, answers, into_the_log, rivals, written

pytestmark = pytest.mark.slow


# === page =====================================================================================================
#
# The tables of the README: each answer and each way is shown, and each budget of the design has its verdict.

ABOUT: dict[str, Any] = {
    "command": "python -m bench.x",
    "took_s": 1.5,
    "load_before": 0.1,
    "load_after": 2.0,
    "versions": {"python": "3.11.7"},
    "hardware": {"processor": "P", "cores": 2, "memory_gb": 8.0, "kernel": "6"},
}
ROOT = Path(__file__).parents[2]


def plan(thread: float, process: float, **about: Any) -> dict[str, Any]:
    writers = {"thread": thread, "process": process, "daemon": process}
    shares = {f"with_{name}": {"slower_by_median": share, "us_a_rollout": 97} for name, share in writers.items()}
    return {"plan": {"bench": "plan", **shares, **ABOUT, **about}}


def verdict(what: str, lines: dict[str, Any]) -> Verdict:
    [budget] = [each for each in BUDGETS if each.measurement.startswith(what)]
    return verdict_on(budget, lines)


def test_a_budget_is_met_up_to_its_limit_and_missed_beyond_it() -> None:
    shown = "thread +75.0%, process -1.0%, daemon -1.0%"
    assert verdict("the fastest", plan(0.75, -0.01)) == Verdict(shown, met=True)
    assert verdict("the fastest", plan(0.75, 0.551)).met is False
    assert verdict("the fastest", plan(0.751, 0.0)).met is False


def test_a_quick_run_is_not_compared_with_a_budget() -> None:
    result = verdict("the fastest", plan(0.0, 0.0, command="python -m bench.plan --quick"))
    assert result == Verdict("not measured", None)


def test_a_missing_library_leaves_its_budget_unmeasured_and_is_on_the_page() -> None:
    rates = {"eventsource-py": MISSING, "ours": {"events_per_s": {"median": 1234}}}
    lines = {
        "others": {"bench": "others", **ABOUT, "sqlite": rates, "postgresql": {"eventsource-py": MISSING}},
        "rivals": {"bench": "rivals", **ABOUT, "ways": {"persist-queue, SQLite": MISSING}},
    }
    assert verdict("full spool → log against eventsource-py", lines) == Verdict("not measured", None)
    assert "| full spool, read, checked, stored | 1,234 |  |" in into_the_log(lines)
    assert f"| persist-queue, SQLite | {MISSING} |" in rivals(lines)


def test_the_first_table_answers_from_the_lines_and_names_what_is_not_measured() -> None:
    shown = answers(plan(0.75, 0.5)).splitlines()
    assert shown[3].endswith(
        "| thread +75%, process +50%, daemon +50%; of a rollout of 97 ms, as those of the thesis, 0.1% (process) |"
    )
    assert [each.endswith("| not measured |") for each in shown[2:]].count(False) == 1


def test_a_block_is_replaced_by_its_table_and_the_rest_of_the_page_stays() -> None:
    page = "# Costs\n\n<!-- bench: rivals -->\nold\n<!-- end -->\n\nrest"
    assert written(page, {}) == "# Costs\n\n<!-- bench: rivals -->\n\nNot measured.\n\n<!-- end -->\n\nrest"


@pytest.mark.parametrize(
    ("ratio", "known", "outcome"),
    [
        (1.1, 1.0, "holds"),
        (1.11, 1.0, "warns"),
        (1.4, 1.0, "warns"),
        (1.41, 1.0, "fails"),
        (9.0, None, "no ratio on record"),
    ],
)
def test_the_gate_warns_at_a_tenth_and_fails_at_four_tenths_above_the_ratio_on_record(
    ratio: float, known: float | None, outcome: str
) -> None:
    assert gate._outcome(ratio, known) == outcome


def test_every_part_of_the_gate_has_a_ratio_on_record() -> None:
    assert all(set(each) == set(gate.RAW) for each in json.loads(gate.ON_RECORD.read_text()).values())


def test_a_repeated_measurement_replaces_its_line_and_nothing_else(tmp_path: Path) -> None:
    _note(tmp_path, "plan", plan(0.04, 0.0)["plan"])
    _note(tmp_path, "gate", {"bench": "gate", **ABOUT})
    _note(tmp_path, "plan", plan(0.02, 0.0)["plan"])
    lines = _lines(tmp_path)
    assert list(lines) == ["gate", "plan"]
    assert lines["plan"]["with_thread"]["slower_by_median"] == 0.02


def test_every_run_names_an_existing_script() -> None:
    for run in RUNS:
        assert (ROOT / "bench" / f"{run.script}.py").is_file()


def test_the_readme_shows_each_table_as_it_was_measured() -> None:
    page = (ROOT / "bench" / "README.md").read_text()
    assert all(f"<!-- bench: {name} -->" in page for name in TABLES)
    assert written(page, _lines(ROOT / "bench" / "figures")) == page, "run: python -m bench --write"


# === quick ====================================================================================================
#
# Every script in `bench/` runs with --quick and prints one JSON line; the figures themselves are not tested.

BUT = {"busy", "faults", "gate", "__main__", "pycram"}  # the last needs PyCRAM's environment
OTHERS = sorted({path.stem for path in (ROOT / "bench").glob("*.py")} - BUT)
"""Scripts without a test of their own."""
SHORT = {"start"}
"""Scripts of a few seconds. The others run in turns, because most take ten seconds and more."""


def measure(script: str, *options: str) -> dict[str, Any]:
    """Run a script and return the last line that it prints."""
    command = [sys.executable, "-m", f"bench.{script}", "--quick", *options]
    completed = subprocess.run(command, cwd=ROOT, capture_output=True, text=True, check=False)
    assert completed.returncode == 0, completed.stderr
    *_, line = completed.stdout.splitlines()
    result = json.loads(line)
    assert result["bench"] == script
    return dict(result)


@pytest.mark.soak
@pytest.mark.parametrize("options", [(), ("--postgresql",)])
def test_the_backlog_beside_a_busy_plan_is_measured(options: tuple[str, ...]) -> None:
    result = measure("busy", *options)
    assert result["events"] > 0
    assert max(result["backlog_at_the_end"], *result["backlog"]) <= result["backlog_max"] <= result["events"] + 10


@pytest.mark.parametrize(
    "script", [each if each in SHORT else pytest.param(each, marks=pytest.mark.soak) for each in OTHERS]
)
def test_every_other_script_measures_something(script: str) -> None:
    assert len(measure(script)) >= 2
