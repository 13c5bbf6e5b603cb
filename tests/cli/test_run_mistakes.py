"""`pycrorm run` names the usual mistakes of a plan in one line: no await, no resolve, an exit of its own."""

from __future__ import annotations

import json
from pathlib import Path

import pytest

from tests.commands import pycrorm

pytestmark = pytest.mark.slow

PLAN = """
import asyncio
import sys

from pycrorm_async.plan import MoveTorsoAction, MoveTorsoActionPerformable
from pycrorm_async.world import BulletWorld

async def forgotten():
    with BulletWorld():
        MoveTorsoActionPerformable(0.1).perform()

async def unresolved():
    await MoveTorsoAction([0.1]).perform()

async def leaving():
    sys.exit(0)

async def leaving_in_a_task():
    async def leave():
        sys.exit(0)
    await asyncio.create_task(leave())

async def leaving_badly():
    async def leave():
        sys.exit(3)
    await asyncio.create_task(leave())
"""


def test_a_forgotten_await_is_named_and_exits_1(tmp_path: Path) -> None:
    (tmp_path / "plan.py").write_text(PLAN)
    ran = pycrorm("run", "plan.py:forgotten", cwd=tmp_path)
    sentence = "MoveTorsoAction.perform() was called and never awaited, so it did not run: write `await`"
    assert ran.returncode == 1
    assert sentence in ran.stderr
    shown = pycrorm("run", "plan.py:forgotten", "--json", cwd=tmp_path)
    assert shown.returncode == 1
    assert json.loads(shown.stdout)["unawaited"] == [sentence]


def test_a_missing_resolve_is_named(tmp_path: Path) -> None:
    (tmp_path / "plan.py").write_text(PLAN)
    ran = pycrorm("run", "plan.py:unresolved", cwd=tmp_path)
    assert ran.returncode == 1
    assert "NotResolved: MoveTorsoAction is a description and has no 'perform': resolve it first" in ran.stderr
    assert "MoveTorsoAction(…).resolve().perform() (plan.py:13)" in ran.stderr
    assert "Traceback" not in ran.stderr


def test_a_plan_that_exits_the_program_is_reported_as_such(tmp_path: Path) -> None:
    (tmp_path / "plan.py").write_text(PLAN)
    for name, line in (("leaving", 16), ("leaving_in_a_task", 20)):
        ran = pycrorm("run", f"plan.py:{name}", cwd=tmp_path)
        assert (ran.returncode, "Traceback" in ran.stderr) == (0, False), ran.stderr
        assert f"the plan plan.py:{name} called sys.exit(0) (plan.py:{line})" in ran.stderr
    ran = pycrorm("run", "plan.py:leaving_badly", cwd=tmp_path)
    assert ran.returncode == 1
    assert "failed: SystemExit: 3 (plan.py:25)" in ran.stderr
    assert json.loads(pycrorm("episodes", "--json", cwd=tmp_path).stdout)
