"""Perform all plans of PyCRAM once for the tests that read what was recorded."""

from __future__ import annotations

import fcntl
import subprocess

import pytest

from tests.integrations.pycram.environment import ROOT, make_environment
from tests.integrations.pycram.performed_plans import PLANS, RUN_S_MAX, Run, environment
from tests.shared_folders import shared_place


@pytest.fixture(scope="session")
def run(tmp_path_factory: pytest.TempPathFactory) -> Run:
    """Perform all plans once, for all processes of the tests."""
    shared = shared_place(tmp_path_factory)
    folder = shared / "pycram"
    with (shared / "pycram.lock").open("w") as lock:
        fcntl.flock(lock, fcntl.LOCK_EX)
        if not folder.exists():
            folder.mkdir()
            command = [str(make_environment()), *PLANS, str(folder)]
            done = subprocess.run(
                command,
                check=False,
                cwd=ROOT,
                env=environment(folder),
                capture_output=True,
                text=True,
                timeout=RUN_S_MAX,
            )
            (folder / "output.txt").write_text(done.stdout + done.stderr)
    output = (folder / "output.txt").read_text()
    assert (folder / "facts.json").exists(), output
    return Run(folder, output)
