"""The bench of faults runs, makes every fault, and nothing is lost, doubled, misordered or changed by any of them."""

import json
import subprocess
import sys
from pathlib import Path

ROOT = Path(__file__).parents[2]
FAULTS = [
    "kill -9 of a recorder",
    "kill -9 of an appender, SQLite",
    "kill -9 of an appender, PostgreSQL",
    "torn write at every byte",
    "flipped bit",
    "power cut",
    "failed sync",
    "disk full",
    "clock jumps",
    "fork",
    "exit with a full queue",
    "second opener",
    "lost COMMIT reply",
    "cut connection",
    "cancelled append",
    "killed server",
    "all of it at random, simulated",
]


def test_the_quick_version_makes_every_fault_and_costs_nothing() -> None:
    done = subprocess.run(
        [sys.executable, "-m", "bench.faults", "--quick"], cwd=ROOT, capture_output=True, text=True, check=False
    )
    outcomes = [json.loads(line) for line in done.stdout.splitlines()]
    print(f"seed {outcomes[0]['seed']}" if outcomes else done.stderr)
    cost = ("lost", "duplicated", "misordered", "changed", "broke")
    bad = [each for each in outcomes if any(each[name] for name in cost)]
    assert (done.returncode, bad) == (0, []), done.stderr
    assert [each["fault"] for each in outcomes] == FAULTS
    assert all(each["rounds"] >= 2 and each["events"] >= 20 for each in outcomes)
    assert next(each for each in outcomes if each["fault"] == "flipped bit")["told"] > 0
