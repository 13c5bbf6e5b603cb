"""A program that records loads what records: no mapped classes, queries, plans or worlds until it uses them."""

from __future__ import annotations

import json
import subprocess
import sys
from pathlib import Path
from typing import Any

import pytest

from pycrorm_async import Memory, Reading

LOADED = """
import json, sys

def loaded(*packages):
    # The paths of modules that have moved are entries of `sys.modules`, too; they are no modules of files.
    files = [name for name, each in sys.modules.items() if getattr(each, "__spec__", None)]
    files = [each for each in files if each != "pycrorm_async.world.pose"]  # poses and enums, without numpy
    return sorted(each for each in files if each.startswith(tuple(f"{package}." for package in packages)) or
                  each in packages and not each.startswith("pycrorm_async"))

READS = tuple(f"pycrorm_async.{each}" for each in "orm plan world recall report export learning cli".split())
OTHERS = ("numpy", "pandas", "rich", "typer", "IPython", "sqlalchemy.dialects.postgresql")
"""


def run(code: str, *arguments: object) -> Any:
    command = [sys.executable, "-c", LOADED + code, *map(str, arguments)]
    done = subprocess.run(command, check=False, capture_output=True, text=True, timeout=60)
    assert done.returncode == 0, done.stderr
    return json.loads(done.stdout)


RECORDED = """
from pycrorm_async import Memory

imported = loaded(*READS, *OTHERS, *(f"pycrorm_async.{each}" for each in ("query", "projections", "operations")))
with Memory.sync(sys.argv[1], writer=sys.argv[2]) as memory:
    drive = memory.recording.type("action", "Drive", {"speed": float})
    with memory.recording.episode(description="another executive") as episode:
        episode.start("drive", drive, {"speed": 0.5})
        episode.object_added("milk", "milk", "MILK", ((1.0, 0.0, 0.0), (0.0, 0.0, 0.0, 1.0)))
        episode.end("drive")
    if sys.argv[2] == "thread":
        memory.flush()
"""


def test_importing_a_memory_and_recording_load_nothing_that_reads_plans_or_draws(tmp_path: Path) -> None:
    unused = "print(json.dumps([imported, loaded('pycrorm_async.plan', 'pycrorm_async.orm', 'pycrorm_async.report')]))"
    assert run(RECORDED + unused, f"sqlite:///{tmp_path}/thread.db", "thread") == [[], []]
    nothing = "print(json.dumps([imported, loaded(*READS, *OTHERS, 'pycrorm_async.query')]))"
    assert run(RECORDED + nothing, f"sqlite:///{tmp_path}/daemon.db", "daemon") == [[], []]


PLANNED_LATER = """
import asyncio
from dataclasses import dataclass
from pycrorm_async import Memory

async def main():
    memory = Memory.open(sys.argv[1])
    async with memory:
        print(json.dumps(loaded("pycrorm_async.plan")), file=sys.stderr)
        from pycrorm_async.plan import ActionAbstract

        @dataclass
        class LaterAction(ActionAbstract):
            number: int

            async def perform(self):
                pass

        await asyncio.create_task(LaterAction(1).perform())
        async with memory.episode(description="with a name"):
            await LaterAction(2).perform()
    await LaterAction(3).perform()  # the memory is closed
    connected = await Memory.connect(sys.argv[1])
    await LaterAction(4).perform()
    await connected.close()

asyncio.run(main())
print("[]")
"""


@pytest.mark.slow
async def test_a_plan_that_is_imported_while_a_memory_is_open_is_recorded(tmp_path: Path) -> None:
    url = f"sqlite:///{tmp_path}/memory.db"
    run(PLANNED_LATER, url)
    async with Reading.open(url) as reading:
        result = await reading.query("SELECT number FROM later_action ORDER BY number")
        assert [row[0] for row in result.rows] == [1, 2, 4]
        assert [each.description for each in await reading.episodes()] == ["LaterAction", "with a name", "LaterAction"]


@pytest.mark.parametrize("asks", [False, True])
async def test_the_class_of_a_type_is_found_before_the_first_query(tmp_path: Path, *, asks: bool) -> None:
    async with Memory.open(f"sqlite:///{tmp_path}/memory.db") as memory:
        with memory.recording.episode(description="another executive") as episode:
            episode.start("drive", memory.recording.type("action", "Drive", {"speed": float}), {"speed": 0.5})
        await memory.flush()
        assert not memory.reading.is_open
        if asks:  # for a number, which reads no types
            assert await memory.number_of(memory.recent_episodes[0]) == 1
        drive = memory.mapped("Drive")
        assert {"speed"} <= {*drive.__table__.c.keys()}


COMMANDS = """
import importlib

verbs = "ask copy diff episodes events query rebuild schema show tag verify writer".split()
for verb in verbs:
    importlib.import_module(f"pycrorm_async.cli.{verb}")
leaves = [each for each in ("pycrorm_async.orm.actions",) if each in sys.modules]
unused = ("pycrorm_async.plan", "pycrorm_async.recall", "numpy", "pandas", "sqlalchemy.dialects.postgresql")
print(json.dumps([*leaves, *loaded(*unused)]))
"""


@pytest.mark.slow
def test_commands_that_read_or_move_events_load_no_numbers_plans_or_classes_of_types() -> None:
    assert run(COMMANDS) == []
