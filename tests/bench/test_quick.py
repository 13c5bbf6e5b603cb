"""Every script in `bench/` runs with --quick and prints one JSON line; the figures themselves are not tested."""

import json
import subprocess
import sys
from pathlib import Path
from typing import Any

import pytest

pytestmark = pytest.mark.slow

ROOT = Path(__file__).parents[2]
BUT = {"busy", "faults", "hook", "__main__", "concurrent_processes", "pycram"}  # the last needs PyCRAM's environment
OTHERS = sorted({path.stem for path in (ROOT / "bench").glob("*.py")} - BUT)
"""Scripts without a test of their own."""
SHORT = {"digests", "recall"}
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
