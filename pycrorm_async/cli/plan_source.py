"""Read the source of a plan that `pycrorm run` starts: the hash of its file, and the state of its git repository."""

from __future__ import annotations

import os
import subprocess
from pathlib import Path

from pycrorm_async.recording.writing.provenance import PlanSource

_GIT_TIMEOUT_S = 2.0
"""Bounds each call of git, so that a repository on a slow disk delays a plan by at most three times as much."""


def plan_source(path: Path, sha256: str) -> PlanSource:
    """Return the plan's source; without its commit outside a repository, without git, or if git takes too long."""
    commit = _git(path, "rev-parse", "--verify", "HEAD")
    if commit is None:
        return PlanSource(sha256)
    if _git(path, "ls-files", "--error-unmatch", "--", path.name) is None:
        return PlanSource(sha256, commit, git_dirty=True)
    changes = _git(path, "status", "--porcelain", "--untracked-files=no")
    return PlanSource(sha256, commit, None if changes is None else bool(changes))


def _git(path: Path, *arguments: str) -> str | None:
    """Return the output of git in the folder of the file; None if it fails."""
    environment = os.environ | {"GIT_OPTIONAL_LOCKS": "0"}  # `git status` must not write into the repository
    try:
        result = subprocess.run(  # noqa: S603  fixed arguments; the path is that of the plan, which runs anyway
            ["git", "-c", "core.fsmonitor=false", *arguments],  # noqa: S607  the git of the user's own path
            cwd=path.resolve().parent,
            env=environment,
            capture_output=True,
            text=True,
            errors="replace",
            timeout=_GIT_TIMEOUT_S,
            check=False,
        )
    except (OSError, subprocess.TimeoutExpired):
        return None
    return result.stdout.strip() if result.returncode == 0 else None
