"""The package needs neither an engine nor the extras for what needs no world, and loads none of them there."""

from __future__ import annotations

import json
import subprocess
import sys
from pathlib import Path
from typing import Any

import pytest

from tests.commands import environment

pytestmark = pytest.mark.slow


WITHOUT_EXTRAS = """
import sys
from importlib.abc import MetaPathFinder

EXTRAS = {"pybullet", "pycram_bullet", "mujoco", "optik", "jpt", "pandas", "matplotlib", "cmeel"}

class Absent(MetaPathFinder):
    wanted = []

    def find_spec(self, name, path=None, target=None):
        if name.partition(".")[0] in EXTRAS:
            self.wanted.append(name)
            raise ModuleNotFoundError(name)

sys.meta_path.insert(0, Absent())
"""

RECORDING = """
import asyncio
from dataclasses import dataclass

import pycrorm_async
from pycrorm_async import Memory
from pycrorm_async.plan import ActionAbstract
from pycrorm_async.world import Pose

@dataclass
class WaitActionPerformable(ActionAbstract):
    seconds: float
    at: Pose

    async def perform(self):
        await asyncio.sleep(0)

async def plan():
    await WaitActionPerformable(0.5, Pose([1, 2, 3])).perform()

async def of_our_own():
    async with Memory.open("sqlite:///pycrorm.db") as memory:
        async with memory.episode(description="of our plan layer"):
            await plan()
            memory.observe("battery", {"volts": 24.1})
        await memory.flush()

asyncio.run(of_our_own())
with Memory.sync("sqlite:///pycrorm.db") as memory:
    navigate = memory.recording.type("action", "NavigateAction", {"target_location": "pose"})
    with memory.recording.episode(description="of another executive") as episode:
        episode.start("a", navigate, {"target_location": Pose([1, 0, 0])})
        episode.end("a")
    memory.flush()
    assert memory.status.faults.total == 0, memory.status
"""

VERBS = """
from pathlib import Path

from pycrorm_async.cli.main import main

Path("waiting.py").write_text("async def plan():\\n    pass\\n")
codes = {}
for words in (
    "--help", "run waiting.py", "status", "episodes", "show 1", "show 2 --at 0", "events 1", "tag 1 good",
    "writer --once", "verify", "rebuild", "copy --from sqlite:///pycrorm.db --to sqlite:///other.db", "spool inspect",
):
    sys.argv = ["pycrorm", *words.split()]
    try:
        main()
    except SystemExit as exiting:
        codes[words] = exiting.code
"""

PRINTING = """
import json
print(json.dumps([codes, Absent.wanted, sorted(EXTRAS & set(sys.modules))]))
"""


def run(script: str, folder: Path) -> subprocess.CompletedProcess[str]:
    command = [sys.executable, "-W", "error", "-c", script]
    return subprocess.run(
        command, cwd=folder, env=environment(), capture_output=True, text=True, timeout=300, check=False
    )


@pytest.mark.every_python
def test_recording_and_every_verb_that_needs_no_world_loads_no_extra(tmp_path: Path) -> None:
    done = run(WITHOUT_EXTRAS + RECORDING + VERBS + PRINTING, tmp_path)
    assert done.returncode == 0, done.stderr
    codes, wanted, loaded = json.loads(done.stdout.splitlines()[-1])
    assert set(codes.values()) == {0}, (codes, done.stderr)
    assert (len(codes), wanted, loaded) == (13, [], [])
    assert "WaitAction" in done.stdout
    assert "of another executive" in done.stdout


ABSENT = "import sys; sys.modules |= dict.fromkeys(('pybullet', 'pycram_bullet', 'mujoco', 'optik')); "
LINE = "no world can be opened, because no engine is installed: pip install 'pycrorm-async[world]'"


REFUSED = """
import contextlib, io, json, os

from pycrorm_async.cli.main import main

results = []
for words in (["demo"], ["run", "sweep.py"]):
    sys.argv = ["pycrorm", *words]
    code = None
    with contextlib.redirect_stderr(io.StringIO()) as printed:
        try:
            main()
        except SystemExit as exiting:
            code = exiting.code
    results.append([code, printed.getvalue(), os.listdir()])
print(json.dumps(results))
"""
SWEEP = "from pycrorm_async.world import BulletWorld\nasync def plan():\n    with BulletWorld():\n        pass\n"


@pytest.fixture(scope="module")
def refused(tmp_path_factory: pytest.TempPathFactory) -> Any:
    """Return exit code, stderr and the folder's files after `demo` and then after `run sweep.py`, in one process."""
    folder = tmp_path_factory.mktemp("refused")
    (folder / "sweep.py").write_text(SWEEP)
    done = run(ABSENT + "\n" + REFUSED, folder)
    assert done.returncode == 0, done.stderr
    return json.loads(done.stdout.splitlines()[-1])


@pytest.mark.every_python
def test_a_verb_that_needs_a_world_first_names_what_to_install(refused: Any) -> None:
    code, printed, files = refused[0]
    assert (code, printed.count("\n"), files) == (2, 1, ["sweep.py"])
    assert printed.startswith(f"pycrorm: {LINE}")


@pytest.mark.every_python
@pytest.mark.parametrize(("engine", "title", "extra"), [("bullet", "Bullet", "world"), ("mujoco", "MuJoCo", "mujoco")])
def test_the_error_of_a_world_names_what_to_install_for_its_engine(
    engine: str, title: str, extra: str, tmp_path: Path
) -> None:
    opening = f"from pycrorm_async.world import BulletWorld\ntry:\n    BulletWorld(engine={engine!r}).__enter__()\n"
    done = run(f"{ABSENT}\n{opening}except Exception as error:\n    print(type(error).__mro__, error)", tmp_path)
    assert all(name in done.stdout for name in ("EngineMissing", "WorldUnavailable", "MissingExtra"))
    line = f"no world can be opened, because no {title} is installed: pip install 'pycrorm-async[{extra}]'"
    compiling = " pybullet (no wheel for this Python: compiles for about 8 minutes with a C++ compiler)"
    needs_compiler = engine == "bullet" and sys.version_info >= (3, 14)
    assert done.stdout.endswith(f" {line}{compiling if needs_compiler else ''}\n")


@pytest.mark.every_python
def test_a_failed_plan_names_in_one_line_what_to_install(refused: Any) -> None:
    code, printed, _ = refused[1]
    assert (code, printed.count("\n")) == (1, 1)
    assert printed.startswith(f"pycrorm: the plan sweep.py:plan failed: EngineMissing: {LINE}")


@pytest.mark.every_python
@pytest.mark.parametrize(
    ("module", "absent", "extra"),
    [("py_trees", "py_trees", "py_trees"), ("callbacks", "langchain_core", "langchain")],
)
def test_an_integration_without_its_package_names_the_extra(module: str, absent: str, extra: str) -> None:
    script = f"{WITHOUT_EXTRAS}\nEXTRAS.add({absent!r})\nimport pycrorm_async.integrations.{module}"
    done = subprocess.run(
        [sys.executable, "-c", script], env=environment(), capture_output=True, text=True, timeout=60, check=False
    )
    assert done.stderr.splitlines()[-1].startswith("pycrorm_async.errors.MissingExtra: ")
    assert f"pip install 'pycrorm-async[{extra}]'" in done.stderr


IMPORTS = """
import importlib, json, pkgutil
import pycrorm_async.errors

EXTRAS |= set("collada foxglove langchain_core langgraph mcap mcp polars pyarrow py_trees rerun".split())
EXTRAS |= {"starlette", "trimesh", "uvicorn"}
needing = []
for module in pkgutil.walk_packages(pycrorm_async.__path__, "pycrorm_async."):
    if module.name.endswith("__main__") or module.name == "pycrorm_async.testing.fixtures":
        continue
    try:
        importlib.import_module(module.name)
    except pycrorm_async.errors.MissingExtra:
        needing.append(module.name.removeprefix("pycrorm_async."))
print(json.dumps(needing))
"""


@pytest.mark.every_python
def test_only_what_serves_an_extra_needs_it_to_be_imported(tmp_path: Path) -> None:
    done = run(WITHOUT_EXTRAS + IMPORTS, tmp_path)
    assert done.returncode == 0, done.stderr
    assert json.loads(done.stdout) == [
        "integrations.callbacks",
        "integrations.mcp_server",
        "integrations.py_trees",
        "live.server",
    ]


# === import ===================================================================================================
#
# Importing the plan layer.


def test_importing_plans_loads_neither_an_engine_nor_a_database() -> None:
    code = (
        "import sys, pycrorm_async.plan as plan; assert all(hasattr(plan, name) for name in plan.__all__);"
        "unwanted = {'pybullet', 'pycram_bullet', 'mujoco', 'optik', 'sqlalchemy', 'pycrorm_async.events'};"
        "unwanted.add('pycrorm_async.record');"
        "print(sorted(unwanted & set(sys.modules)))"
    )
    done = subprocess.run([sys.executable, "-c", code], capture_output=True, text=True, timeout=60, check=True)
    assert done.stdout == "[]\n"
