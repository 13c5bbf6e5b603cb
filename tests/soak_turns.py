"""Choose the turn of the soak that a commit runs: a thirtieth of the tests marked `soak`, another at another commit.

    python -m pytest -m soak --soak-turn              the turn of the commit that is checked out, as .ci/run does
    python -m pytest -m soak --soak-turn=4f1c2ab      the turn of that commit, again
    python -m pytest -m soak                          every test, in full length

The hash of its node id decides a test's turn, so that other tests may come and go. Outside a git checkout the turn is
that of `FIXED`.
"""

from __future__ import annotations

import hashlib
import re
import subprocess
from pathlib import Path
from typing import Final

TURNS: Final = 30
"""Thirty turns limit each to a few minutes of two cores."""
FIXED: Final = "0"
SLOW_AT_EACH_COMMIT: Final = frozenset({"crash", "promises", "pycram"})
"""The folders whose slow tests run at each commit, as do the tests that tests/README.md names for promises and defects.

All other slow tests are soak, so that the test command stays short.
"""
NAMED: Final = frozenset(re.findall(r"`(test_\w+)`", (Path(__file__).parent / "README.md").read_text()))
"""The tests that tests/README.md names."""


def turn_of(commit: str) -> int:
    """Return the turn of a commit. The first seven digits of its id count, so that the short id leads to the same."""
    return int(commit[:7], 16) % TURNS


def place_of(node_id: str) -> int:
    """Return the turn in which the test with this node id runs."""
    return int.from_bytes(hashlib.sha256(node_id.encode()).digest()[:8], "big") % TURNS


def runs_in_turns(file: Path, test: str) -> bool:
    """Return whether a slow test of this file is soak."""
    return file.parent.name not in SLOW_AT_EACH_COMMIT and test not in NAMED


def current_commit(folder: Path) -> str:
    """Return the id of the commit checked out in `folder`, or `FIXED` where there is no git or no repository."""
    try:
        done = subprocess.run(
            ["git", "rev-parse", "HEAD"], cwd=folder, capture_output=True, text=True, check=True, timeout=10
        )
    except (OSError, subprocess.SubprocessError):
        return FIXED
    return done.stdout.strip()
