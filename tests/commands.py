"""Runs the command `pycrorm` as a user does: in a process of its own."""

import json
import os
import subprocess
import sys
from pathlib import Path
from typing import Any

COMMAND = [sys.executable, "-W", "error", "-m", "pycrorm_async"]


def environment() -> dict[str, str]:
    """The user's, without settings of ours, wide enough that no line is wrapped."""
    kept = {name: value for name, value in os.environ.items() if not name.startswith("PYCRORM_")}
    return kept | {"COLUMNS": "200", "PYTHONPATH": str(Path(__file__).parent.parent), "NO_COLOR": "1"}


def pycrorm(*arguments: str | Path, cwd: Path, timeout_s: float = 300) -> subprocess.CompletedProcess[str]:
    """The command's exit code, stdout and stderr."""
    return subprocess.run(
        [*COMMAND, *map(str, arguments)],
        cwd=cwd,
        env=environment(),
        capture_output=True,
        text=True,
        timeout=timeout_s,
        check=False,
    )


def answer(*arguments: str | Path, cwd: Path, code: int = 0) -> Any:
    """The JSON document of a `--json` call that ends with this code."""
    done = pycrorm(*arguments, "--json", cwd=cwd)
    assert done.returncode == code, done.stderr
    return json.loads(done.stdout)


def one_line_of(done: subprocess.CompletedProcess[str]) -> str:
    """The one line on stderr; fails if there is a traceback or more than that line."""
    assert "Traceback" not in done.stderr, done.stderr
    lines = [line for line in done.stderr.splitlines() if line.strip()]
    assert len(lines) == 1, done.stderr
    return lines[0]
