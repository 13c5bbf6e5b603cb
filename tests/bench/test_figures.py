"""Every script of `bench/` runs and prints its figures, and the page shows each with the verdict of its budget."""

import json
import subprocess
import sys
from pathlib import Path
from typing import Any

import pytest

from bench.__main__ import RUNS, _lines, _note
from bench.reporting.budgets import BUDGETS, Verdict, verdict_on
from bench.reporting.page import page, rows_of

pytestmark = pytest.mark.slow


# === page =====================================================================================================
#
# The page of all figures: every measurement is shown, and each budget of the design has its verdict.

ABOUT: dict[str, Any] = {
    "command": "python -m bench.x",
    "took_s": 1.5,
    "load_before": 0.1,
    "load_after": 2.0,
    "versions": {"python": "3.11.7"},
    "hardware": {"processor": "P", "cores": 2, "memory_gb": 8.0, "kernel": "6"},
}
ROOT = Path(__file__).parents[2]


def plan(thread: float, daemon: float, **about: Any) -> dict[str, Any]:
    shares = {"with_thread": {"slower_by_median": thread}, "with_daemon": {"slower_by_median": daemon}}
    return {"plan": {"bench": "plan", **shares, **ABOUT, **about}}


def verdict(what: str, lines: dict[str, Any]) -> Verdict:
    [budget] = [each for each in BUDGETS if each.measurement.startswith(what)]
    return verdict_on(budget, lines)


def test_a_budget_is_met_up_to_its_limit_and_missed_beyond_it() -> None:
    assert verdict("the fastest", plan(0.05, -0.01)) == Verdict("thread +5.0%, daemon -1.0%", met=True)
    assert verdict("the fastest", plan(0.01, 0.051)).met is False


def test_a_quick_run_is_not_compared_with_a_budget() -> None:
    result = verdict("the fastest", plan(0.0, 0.0, command="python -m bench.plan --quick"))
    assert result == Verdict("not measured", None)


def test_a_missing_library_leaves_its_budget_unmeasured_and_is_on_the_page() -> None:
    message = "missing: install the extra 'bench'"
    lines = {"others": {"bench": "others", **ABOUT, "postgresql": {"eventsource-py": message}}}
    assert verdict("full spool → log against eventsource-py", lines) == Verdict("not measured", None)
    assert f"| postgresql, eventsource-py | {message} |" in page(lines, [])


def test_every_figure_is_on_the_page_with_its_path_and_a_spread_is_one_figure() -> None:
    figures = {
        "sqlite": {"ours": {"median": 1234, "least": 1.5, "most": 2_000_000}},
        "backlog": [1, 22],
        "rates": [{"nodes": 10, "seconds": 2}],
    }
    assert list(rows_of(figures)) == [
        ("sqlite, ours", "1,234 (least 1.5, most 2,000,000)"),
        ("backlog", "1, 22"),
        ("rates, 10, nodes", "10"),
        ("rates, 10, seconds", "2"),
    ]


def test_a_repeated_measurement_replaces_its_line_and_nothing_else(tmp_path: Path) -> None:
    _note(tmp_path, "plan", plan(0.04, 0.0)["plan"])
    _note(tmp_path, "hook", {"bench": "hook", **ABOUT})
    _note(tmp_path, "plan", plan(0.02, 0.0)["plan"])
    lines = _lines(tmp_path)
    assert list(lines) == ["hook", "plan"]
    assert lines["plan"]["with_thread"] == {"slower_by_median": 0.02}
    assert "thread +2.0%" in (tmp_path / "figures.md").read_text()


def test_every_run_names_an_existing_script() -> None:
    for run in RUNS:
        assert (ROOT / "bench" / f"{run.script}.py").is_file()


def test_the_readme_shows_the_budgets_as_they_were_measured() -> None:
    measured = (ROOT / "bench" / "figures" / "figures.md").read_text()
    budgets = measured[measured.index("| measurement | budget |") :].split("\n\n")[0]
    assert len(budgets.splitlines()) == 2 + len(BUDGETS)
    assert budgets in (ROOT / "bench" / "README.md").read_text()


# === quick ====================================================================================================
#
# Every script in `bench/` runs with --quick and prints one JSON line; the figures themselves are not tested.

BUT = {"busy", "faults", "hook", "__main__", "concurrent_processes", "pycram"}  # the last needs PyCRAM's environment
OTHERS = sorted({path.stem for path in (ROOT / "bench").glob("*.py")} - BUT)
"""Scripts without a test of their own."""
SHORT = {"digests"}
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
def test_the_cost_of_a_hook_is_measured_with_the_database_up_slow_and_down() -> None:
    result = measure("hook")
    states = [f"{writer}, {state}" for writer in ("thread", "daemon") for state in ("up", "slow", "down")]
    assert [name for name in result if isinstance(result[name], dict)] == ["none", *states]
    for name in ("none", *states):
        spread = result[name]["perform_us"]
        assert 0 < spread["median"] <= spread["p99"] <= spread["p99.9"] <= spread["max"]


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
