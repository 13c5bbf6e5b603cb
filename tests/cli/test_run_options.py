"""`pycrorm run` accepts the settings of a recording as options, and refuses a wrong one in one line."""

from __future__ import annotations

import sqlite3
from contextlib import closing
from pathlib import Path

import pytest

from tests.commands import one_line_of, pycrorm

pytestmark = pytest.mark.slow

PLAN = """
from dataclasses import dataclass
from typing import Any

from pycrorm_async.plan import ActionAbstract, MoveTorsoActionPerformable, simulated_robot
from pycrorm_async.world import BulletWorld, Object, ObjectType

@dataclass
class KeepActionPerformable(ActionAbstract):
    what: float
    async def perform(self):
        print("performed")

async def torso():
    with BulletWorld(), simulated_robot:
        Object("pr2", ObjectType.ROBOT)
        await MoveTorsoActionPerformable(0.2).perform()

async def unrecordable():
    await KeepActionPerformable(object()).perform()

async def full(memory):
    print("on_full is", memory._settings.on_full)
"""


@pytest.fixture
def folder(tmp_path: Path) -> Path:
    (tmp_path / "plan.py").write_text(PLAN)
    return tmp_path


def samples(folder: Path) -> list[str]:
    with closing(sqlite3.connect(folder / "pycrorm.db")) as database, database:
        return [channel for (channel,) in database.execute("SELECT channel FROM state_sample")]


def test_the_robot_is_sampled_at_the_interval_of_the_option(folder: Path) -> None:
    assert pycrorm("run", "plan.py:torso", cwd=folder).returncode == 0
    assert samples(folder) == []
    assert pycrorm("run", "plan.py:torso", "--sample-interval-ms", "1", cwd=folder).returncode == 0
    assert {"base.x", "torso_lift_joint"} <= set(samples(folder))


def test_an_unrecordable_parameter_is_recorded_as_missing_or_refused(folder: Path) -> None:
    for options in ((), ("--on-unrecordable", "record_missing")):
        ran = pycrorm("run", "plan.py:unrecordable", *options, cwd=folder)
        assert (ran.returncode, "performed" in ran.stdout) == (0, True), ran.stderr
    ran = pycrorm("run", "plan.py:unrecordable", "--on-unrecordable", "refuse", cwd=folder)
    assert (ran.returncode, "performed" in ran.stdout) == (1, False)
    assert "the plan plan.py:unrecordable failed: Unrecordable: " in ran.stderr


@pytest.mark.parametrize(("options", "on_full"), [((), "wait"), (("--on-full", "fail"), "fail")])
def test_the_reaction_to_a_full_spool_is_an_option(folder: Path, options: tuple[str, ...], on_full: str) -> None:
    ran = pycrorm("run", "plan.py:full", *options, cwd=folder)
    assert (ran.returncode, ran.stdout.splitlines()[0]) == (0, f"on_full is {on_full}"), ran.stderr


MILLISECONDS = "it must be a whole number of milliseconds from 1 to 86,400,000"


@pytest.mark.parametrize(
    ("option", "value", "reason"),
    [
        ("--sample-interval-ms", "0", MILLISECONDS),
        ("--sample-interval-ms", "-5", MILLISECONDS),
        ("--sample-interval-ms", "2.5", MILLISECONDS),
        ("--sample-interval-ms", "often", MILLISECONDS),
        ("--sample-interval-ms", "9" * 400, MILLISECONDS),
        ("--on-unrecordable", "record", "use 'record_missing' or 'refuse'"),
        ("--on-full", "", "use 'wait' or 'fail'"),
    ],
)
def test_a_wrong_option_is_one_line_and_nothing_runs(folder: Path, option: str, value: str, reason: str) -> None:
    ran = pycrorm("run", "plan.py:torso", f"{option}={value}", cwd=folder)
    assert (ran.returncode, ran.stdout) == (2, "")
    assert one_line_of(ran) == f"pycrorm: {option} is {value!r}: {reason}"
    assert not (folder / "pycrorm.db").exists()
