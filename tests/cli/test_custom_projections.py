"""Custom projections with the command: named by an option, or offered by an installed package."""

from __future__ import annotations

import json
import os
import subprocess
from pathlib import Path
from typing import Any

import pytest

from tests.commands import COMMAND, answer, environment, one_line_of, pycrorm
from tests.databases import ask, ask_to_change

pytestmark = pytest.mark.soak
"""Each of these tests starts many processes."""

PLAN = '''
from dataclasses import dataclass
from pycrorm_async.plan import ActionAbstract

@dataclass
class WeighActionPerformable(ActionAbstract):
    what: str
    grams: float
    async def perform(self):
        if self.what == "water":
            raise ValueError("spilled")

async def plan():
    """Weigh things."""
    await WeighActionPerformable("milk", 1.5).perform()
    await WeighActionPerformable("water", 2.5).perform()
'''
LAB = """
from pycrorm_async.events.types import NodeEnded
from pycrorm_async.projections.custom import Projection

class Weighed(Projection):
    name = "weighed"
    tables = {"weighing": {"what": "text", "grams": "real", "status": "text"}}

    def fold(self, event, rows):
        if event.dtype == "WeighAction":
            rows.insert("weighing", event.id, **event.parameters)
        elif isinstance(event.happening, NodeEnded):
            rows.update("weighing", event.row(event.happening.node), status=event.happening.status)

class Picky(Weighed):
    def fold(self, event, rows):
        super().fold(event, rows)
        if event.parameters.get("what") == "water":
            raise ValueError("no water")

class Next(Weighed):
    version = 2

class NoTables(Weighed):
    tables = {}

class Strange:
    pass
"""
WEIGHED = [("milk", 1.5, "SUCCEEDED"), ("water", 2.5, "ERROR")]


@pytest.fixture
def lab(tmp_path: Path) -> Path:
    """A folder with a plan and a module of projections."""
    (tmp_path / "weighing.py").write_text(PLAN)
    (tmp_path / "lab.py").write_text(LAB)
    return tmp_path


def weighed(folder: Path) -> list[Any]:
    return ask(folder / "pycrorm.db", "SELECT what, grams, status FROM weighing ORDER BY id")


def write_entry_points(folder: Path, **entries: str) -> None:
    """Write what an installation leaves: a folder beside the modules that names its entry points."""
    place = folder / "site" / "lab-1.0.dist-info"
    place.mkdir(parents=True)
    (place / "METADATA").write_text("Metadata-Version: 2.1\nName: lab\nVersion: 1.0\n")
    lines = [f"{name} = {value}" for name, value in entries.items()]
    (place / "entry_points.txt").write_text("\n".join(["[pycrorm.projections]", *lines, ""]))
    (folder / "lab.py").rename(folder / "site" / "lab.py")


def with_site(*arguments: str, cwd: Path) -> subprocess.CompletedProcess[str]:
    """Run the command where that package is installed."""
    settings = environment()
    settings["PYTHONPATH"] = os.pathsep.join([settings["PYTHONPATH"], str(cwd / "site")])
    return subprocess.run(
        [*COMMAND, *arguments], cwd=cwd, env=settings, capture_output=True, text=True, timeout=300, check=False
    )


def test_a_named_projection_is_folded_by_the_run_rebuilt_and_verified(lab: Path) -> None:
    assert pycrorm("run", "weighing.py", "--projection", "lab:Weighed", cwd=lab).returncode == 1  # the plan failed
    assert weighed(lab) == WEIGHED
    done = answer("rebuild", "weighed", "--projection", "lab:Weighed", cwd=lab)
    assert done.keys() == {"projections"}
    assert {**done["projections"]["weighed"], "seconds": 0} == {
        "generation": 1002, "events": 8, "episodes": 1, "seconds": 0, "parked": {}, "damaged": {}, "left": []
    }  # fmt: skip
    assert weighed(lab) == WEIGHED
    assert answer("verify", "--projection", "lab:Weighed", cwd=lab)["drift"] == 0
    ask_to_change(lab / "pycrorm.db", "UPDATE zz_pycrorm_own_weighing__1002 SET grams = 3 WHERE what = 'milk'")
    result = answer("verify", "--projection", "lab:Weighed", cwd=lab, code=1)
    assert [(each["table"], each["column"], each["stored"]) for each in result["differences"]] == [
        ("weighing", "grams", 3)
    ]
    rebuild = pycrorm("rebuild", "--projection", "lab:Weighed", cwd=lab)
    assert (rebuild.returncode, rebuild.stderr) == (0, "")
    assert [line.split(":")[0] for line in rebuild.stdout.splitlines()] == [
        "generation 1002",
        "weighed, generation 1003",
    ]
    assert weighed(lab) == WEIGHED


def test_the_projection_of_an_installed_package_is_folded_without_an_option(lab: Path) -> None:
    write_entry_points(lab, weighed="lab:Weighed")
    with_site("run", "weighing.py", cwd=lab)
    assert weighed(lab) == WEIGHED
    rebuild = with_site("rebuild", "--json", cwd=lab)
    assert json.loads(rebuild.stdout)["projections"]["weighed"]["generation"] == 1002
    assert weighed(lab) == WEIGHED
    state = json.loads(with_site("status", "--json", cwd=lab).stdout)
    weighed_now = [each for each in state["projections"] if each["name"] == "weighed"]
    assert weighed_now == [{"name": "weighed", "version": 1, "behind": 0, "parked": {}, "fault": None}]


def test_a_package_with_an_invalid_projection_is_reported_in_a_line_and_the_others_continue(lab: Path) -> None:
    write_entry_points(lab, a="lab:Strange", b="nowhere:At", c="lab:Weighed", d="lab:NoTables")
    done = with_site("writer", "--once", "--url", f"sqlite:///{lab}/pycrorm.db", cwd=lab)
    assert done.returncode == 0
    said = [line.partition("the projection ")[2].strip() for line in done.stderr.splitlines()]
    assert said == [
        "a of an installed package is left out: lab:Strange is not a projection: derive from pycrorm_async.Projection",
        "b of an installed package is left out: ModuleNotFoundError: No module named 'nowhere'",
        "d of an installed package is left out: the projection NoTables: it has no tables: set `tables`",
    ]
    assert weighed(lab) == []


def test_a_projection_whose_code_is_missing_is_left_unchanged_and_reported(lab: Path) -> None:
    pycrorm("run", "weighing.py", "--projection", "lab:Weighed", cwd=lab)
    rebuild = pycrorm("rebuild", cwd=lab)
    assert rebuild.returncode == 0
    assert one_line_of(rebuild) == "the projection weighed is not rebuilt, because its code is not available"
    assert weighed(lab) == WEIGHED
    rebuild = pycrorm("rebuild", "weighed", cwd=lab)
    assert rebuild.returncode == 2
    assert "the code of the projection weighed is not available: add --projection module:Class" in one_line_of(rebuild)
    rebuild = pycrorm("verify", cwd=lab)
    assert rebuild.returncode == 0
    assert one_line_of(rebuild) == "the projection weighed was not verified: its code is not installed here"


def test_status_reports_what_a_projection_cannot_fold_and_which_version_is_not_folded(lab: Path) -> None:
    ran = pycrorm("run", "weighing.py", "--projection", "lab:Picky", cwd=lab)
    assert "episode 1 is parked in the projection weighed: event 5: weighed raised ValueError: no water" in ran.stderr
    state = answer("status", cwd=lab, code=1)
    assert state["episodes"] == []
    parked = {each["name"]: each["parked"] for each in state["projections"]}
    assert parked["weighed"] == {"1": "event 5: weighed raised ValueError: no water"}
    rebuild = pycrorm("status", cwd=lab)
    assert "episode 1 is stopped in the projection weighed: event 5: weighed raised ValueError" in one_line_of(rebuild)
    ran = pycrorm("writer", "--once", "--projection", "lab:Next", cwd=lab)
    assert ran.returncode == 0
    said = "have version 1, its code has version 2: run `pycrorm rebuild weighed`"
    assert said in one_line_of(ran)
    assert pycrorm("rebuild", "weighed", "--projection", "lab:Next", cwd=lab).returncode == 0
    assert weighed(lab) == WEIGHED
    assert pycrorm("status", cwd=lab).returncode == 0


@pytest.mark.parametrize(
    ("arguments", "said"),
    [
        (["rebuild", "--projection", "lab"], "'lab' does not name a projection: write module:Class"),
        (["verify", "--projection", "nowhere:At"], "nowhere cannot be imported: ModuleNotFoundError"),
        (["writer", "--once", "--projection", "lab:Absent"], "lab has no 'Absent'"),
        (["rebuild", "--projection", "lab:Strange"], "lab:Strange is not a projection"),
        (["rebuild", "--projection", "lab:NoTables"], "it has no tables"),
        (["rebuild", "--projection", "lab:Weighed", "--projection", "lab:Picky"], "two projections have the name"),
        (["rebuild", "scales"], "unknown projection 'scales'; known: tables"),
        (
            ["run", "weighing.py", "--writer", "daemon", "--projection", "lab:Weighed"],
            "without the projections of this process",
        ),
    ],
)
def test_an_impossible_projection_is_refused_in_one_line(lab: Path, arguments: list[str], said: str) -> None:
    if arguments[-1] == "scales":
        pycrorm("writer", "--once", cwd=lab)
    done = pycrorm(*arguments, cwd=lab)
    assert done.returncode == 2, done.stderr
    assert said in one_line_of(done)
