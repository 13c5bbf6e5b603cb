"""`pycrorm run` records the hash of the plan's file and the state of its git repository; git may be absent or slow."""

from __future__ import annotations

import hashlib
import json
import os
import subprocess
import time
from pathlib import Path
from typing import Any

import pytest

from pycrorm_async.cli import run as reader
from pycrorm_async.cli.run import plan_source
from pycrorm_async.record.episode_writer import PlanSource
from tests.bullet import INSTALLED_BULLETS
from tests.commands import pycrorm

PLAN = "async def plan():\n    pass\n"


def git(folder: Path, *arguments: str) -> str:
    identity = ("-c", "user.name=me", "-c", "user.email=me@example.org")
    command = ["git", *identity, *arguments]
    return subprocess.run(command, cwd=folder, check=True, capture_output=True, text=True).stdout.strip()


@pytest.fixture
def repository(tmp_path: Path) -> Path:
    (tmp_path / "myplan.py").write_text(PLAN)
    git(tmp_path, "init", "-q")
    git(tmp_path, "add", "myplan.py")
    git(tmp_path, "commit", "-q", "-m", "a plan")
    return tmp_path


def test_the_commit_is_clean_dirty_or_lacks_the_plan(repository: Path) -> None:
    commit = git(repository, "rev-parse", "HEAD")
    plan, other = repository / "myplan.py", repository / "another.py"
    (repository / "memory.db").write_text("an untracked file beside the plan changes nothing")
    assert plan_source(plan, "0") == PlanSource("0", commit, git_dirty=False)
    other.write_text(PLAN)
    assert plan_source(other, "0") == PlanSource("0", commit, git_dirty=True)
    plan.write_text(PLAN + "# changed\n")
    assert plan_source(plan, "0") == PlanSource("0", commit, git_dirty=True)


def test_without_a_repository_or_a_commit_only_the_hash_is_known(tmp_path: Path) -> None:
    plan = tmp_path / "myplan.py"
    plan.write_text(PLAN)
    assert plan_source(plan, "0") == PlanSource("0")
    git(tmp_path, "init", "-q")
    assert plan_source(plan, "0") == PlanSource("0")


@pytest.mark.parametrize("script", [None, "#!/bin/sh\nexit 128\n", "#!/bin/sh\nexec sleep 60\n"])
def test_git_may_be_absent_fail_or_hang(
    repository: Path, tmp_path_factory: pytest.TempPathFactory, monkeypatch: pytest.MonkeyPatch, script: str | None
) -> None:
    programs = tmp_path_factory.mktemp("programs")
    if script is not None:
        (programs / "git").write_text(script)
        (programs / "git").chmod(0o700)
    (programs / "sleep").symlink_to("/bin/sleep")
    monkeypatch.setenv("PATH", str(programs))
    monkeypatch.setattr(reader, "_GIT_TIMEOUT_S", 0.3)
    began = time.monotonic()
    assert plan_source(repository / "myplan.py", "0") == PlanSource("0")
    assert time.monotonic() - began < 30


@pytest.mark.slow
def test_run_records_the_source_and_show_and_episodes_print_it(repository: Path) -> None:
    assert pycrorm("run", "myplan.py", cwd=repository).returncode == 0
    shown: list[dict[str, Any]] = json.loads(pycrorm("episodes", "--json", cwd=repository).stdout)
    commit = git(repository, "rev-parse", "HEAD")
    digest = hashlib.sha256(PLAN.encode()).hexdigest()
    assert [(each["plan_sha256"], each["git_commit"], each["git_dirty"]) for each in shown] == [(digest, commit, False)]
    assert set(INSTALLED_BULLETS) <= set(shown[0]["libraries"])
    assert shown[0]["settings"] is None
    (repository / "myplan.py").write_text(PLAN + "\n")
    assert pycrorm("run", "myplan.py", "--on-full", "fail", cwd=repository).returncode == 0
    text = pycrorm("show", "last", "--full", cwd=repository).stdout
    assert f"commit    {commit} and uncommitted changes" in text
    assert f"(sha256 {digest[:12]}…)" in pycrorm("show", "1", cwd=repository).stdout
    assert "on_full fail" in text
    assert all(f"{name} 3" in text for name in INSTALLED_BULLETS)
    assert os.sep not in json.dumps(shown[0]["libraries"])
