"""Every script of `bench/` runs and prints its figures, and the page shows each with the verdict of its budget."""

import ast
import json
import subprocess
import sys
from importlib import import_module
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


def test_the_largest_measured_number_of_nodes_is_judged() -> None:
    def of(*sizes: tuple[int, float]) -> dict[str, Any]:
        return {**ABOUT, "sqlite": [{"nodes": nodes, "times_faster": {"median": times}} for nodes, times in sizes]}

    lines = {"thesis": of((1_000, 70.0), (50_000, 60.0)), "thesis, 488,043 nodes": of((488_043, 49.9))}
    result = verdict("spool", lines)
    assert result == Verdict("49.9 times at 488,043 nodes", met=False)


def test_mapped_objects_are_judged_on_both_databases() -> None:
    def of(sqlite: float, postgresql: float) -> dict[str, Any]:
        ratios = {"sqlite": sqlite, "postgresql": postgresql}
        return {
            "objects": {**ABOUT, **{name: {"actions": {"ours_is": {"median": is_}}} for name, is_ in ratios.items()}}
        }

    assert verdict("CPU time of `select(Action)`", of(0.7, 1.0)) == Verdict(
        "sqlite 0.70 times, postgresql 1.00 times", met=True
    )
    assert verdict("CPU time of `select(Action)`", of(0.7, 1.1)).met is False


def test_a_common_cue_is_judged_beside_soar_where_it_is_installed() -> None:
    def of(common: float, soar: dict[str, Any] | str, p99: float = 9.0) -> dict[str, Any]:
        kinds = {"common": {"median": common, "p99": 1.0}, "rare": {"median": 1.0, "p99": p99}}
        return {"recall": {**ABOUT, "1,000,000": {"recall_ms": kinds, "soar": soar, "bytes_an_action": 62.2}}}

    slower = {"recall_ms": {"common": {"median": 0.1}}}
    common, kinds = "recall of a common cue", "recall by every kind"
    assert verdict(common, of(0.05, slower)) == Verdict("0.05 ms, Soar 0.1 ms", met=True)
    assert verdict(common, of(0.15, slower)).met is False
    assert verdict(common, of(0.15, "missing")) == Verdict("0.15 ms", met=True)
    assert verdict(kinds, of(0.1, slower)) == Verdict("9 ms (rare), 62.2 bytes an action", met=True)
    assert verdict(kinds, of(0.1, slower, p99=10.5)).met is False


def test_cases_are_judged_on_both_databases_and_by_their_growth() -> None:
    def of(fold_us: float, load_ms: float, large_ms: float) -> dict[str, Any]:
        figures = {"fold_cpu_us_an_action": {"median": fold_us}, "load_ms": {"median": load_ms}}
        sizes = {"1,000,000": 1.0}, {"10,000,000": large_ms}
        recalls = [
            {size: {"recall_ms": {"rare": {"median": ms}}, "bytes_an_action": 60} for size, ms in each.items()}
            for each in sizes
        ]
        cases: dict[str, Any] = {"sqlite": figures, "postgresql": figures}
        lines: dict[str, dict[str, Any]] = {"cases": cases, "recall": recalls[0], "recall, large": recalls[1]}
        return {name: {**ABOUT, **each} for name, each in lines.items()}

    fold, load, growth = "making the case", "loading the cases", "recall among"
    assert verdict(fold, of(25, 100, 11)) == Verdict("sqlite 25 µs, postgresql 25 µs", met=True)
    assert verdict(fold, of(25.1, 100, 11)).met is False
    assert verdict(load, of(25, 100, 11)) == Verdict("sqlite 100 ms, postgresql 100 ms", met=True)
    assert verdict(load, of(25, 101, 11)).met is False
    assert verdict(growth, of(25, 100, 11)) == Verdict("1.10 times an action (rare), 60 bytes an action", met=True)
    assert verdict(growth, of(25, 100, 11.5)).met is False


def test_the_wall_time_of_mapped_objects_is_shown_beside_that_of_the_thesis() -> None:
    def of(sqlite_ms: int, postgresql_ms: int) -> dict[str, Any]:
        sides = {
            name: {"actions": {"ours_ms": {"median": ms}, "thesis_ms": {"median": 1_500}}}
            for name, ms in (("sqlite", sqlite_ms), ("postgresql", postgresql_ms))
        }
        return {"objects": {**ABOUT, **sides}}

    assert verdict("the same, wall time", of(1_000, 250)) == Verdict(
        "sqlite 1.00 s (system of the thesis: 1.50 s), postgresql 0.25 s (system of the thesis: 1.50 s),"
        " at a load of 0.1 to 2.0",
        met=True,
    )
    assert verdict("the same, wall time", of(1_001, 250)).met is False
    assert verdict("the same, wall time", of(1_000, 251)).met is False


def test_of_all_rebuilt_logs_the_largest_is_judged() -> None:
    def of(database: str, events: int, times: float, mb: float) -> dict[str, Any]:
        sizes = [{"events": 100}, {"events": events}]
        return {**ABOUT, "database": database, "by_workers": {"1": sizes}, "growth": {"1": _grown(times, mb)}}

    lines = {
        "rebuild": of("sqlite", 1_000, 1.2, 0),
        "rebuild, large": of("sqlite", 10_000, 1.1, 16.0),
        "rebuild postgresql": of("postgresql", 1_000, 0.9, -1.0),
    }
    result = verdict("rebuild, the largest log", lines)
    assert result == Verdict(
        "sqlite 1.10 times, +16 MB (100 to 10,000 events), postgresql 0.90 times, -1 MB (100 to 1,000 events)",
        met=True,
    )
    for worse in (_grown(1.11, 0), _grown(1.0, 16.1)):
        lines["rebuild, large"]["growth"] = {"1": worse}
        assert verdict("rebuild, the largest log", lines).met is False


def _grown(times: float, mb: float) -> dict[str, float]:
    return {"us_per_event": times, "mb": mb}


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


@pytest.mark.parametrize("path", sorted((ROOT / "bench").rglob("*.py")), ids=lambda each: each.stem)
def test_every_name_that_the_bench_imports_still_exists(path: Path) -> None:
    """Most scripts run on demand only, so that a renamed import would otherwise stay unnoticed until the next run."""
    tree = ast.parse(path.read_text())
    for node in ast.walk(tree):
        if isinstance(node, ast.ImportFrom) and node.module is not None and node.module.startswith("pycrorm_async"):
            module = import_module(node.module)
            for each in node.names:
                if not hasattr(module, each.name):
                    import_module(f"{node.module}.{each.name}")  # a module, which must exist


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
