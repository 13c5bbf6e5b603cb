"""Make the environment in which PyCRAM runs: `.venv-pycram`, with pins that no other test needs.

It is made once, in about two minutes, and again when the dependencies in `pyproject.toml` have changed. The command
`python -m tests.integrations.pycram.environment` makes it before the tests do.
"""

from __future__ import annotations

import fcntl
import hashlib
import os
import shutil
import subprocess
import sys
import tomllib
from pathlib import Path

ROOT = Path(__file__).parents[3]
ENVIRONMENT = ROOT / ".venv-pycram"
PYTHON = ENVIRONMENT / "bin" / "python"
PYCRAMS_ORM = "ormatic==1.0.10"
"""PyCRAM's own database, which the tests compare with this memory, needs this; PyCRAM does not declare it."""


def make_environment() -> Path:
    """Return the environment's interpreter; make the environment first, unless its pins are those of this tree."""
    project = tomllib.loads((ROOT / "pyproject.toml").read_text())["project"]
    pins = [*project["dependencies"], *project["optional-dependencies"]["pycram"], PYCRAMS_ORM]
    digest = hashlib.sha256("\n".join([*pins, str(ROOT)]).encode()).hexdigest()
    stamp = ENVIRONMENT / "pins.sha256"
    with (ROOT / ".venv-pycram.lock").open("w") as lock:
        fcntl.flock(lock, fcntl.LOCK_EX)  # several test processes may find it missing at once
        if not stamp.is_file() or stamp.read_text() != digest:
            shutil.rmtree(ENVIRONMENT, ignore_errors=True)
            interpreter = shutil.which("python3.11") or sys.executable  # PyCRAM's dependencies have wheels for it
            subprocess.run([interpreter, "-m", "venv", str(ENVIRONMENT)], check=True)
            pip = [str(PYTHON), "-m", "pip", "install", "-qq", "--disable-pip-version-check"]
            wanted = ["-e", f"{ROOT}[pycram]", PYCRAMS_ORM]
            subprocess.run([*pip, *wanted], check=True, env={**os.environ, "PYTHONPATH": ""})
            stamp.write_text(digest)
    return PYTHON


if __name__ == "__main__":
    sys.stdout.write(f"{make_environment()}\n")
