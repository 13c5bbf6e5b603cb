"""A connected memory and world serve every context without its own: cells of notebooks, tasks and threads."""

from __future__ import annotations

import asyncio
import json
import os
import subprocess
import sys
import threading
from contextvars import Context
from pathlib import Path
from typing import Any

import pytest
from sqlalchemy import select

from pycrorm_async import Memory, Reading
from pycrorm_async.errors import CallerError
from pycrorm_async.orm import NavigateAction, ProcessMetaData
from pycrorm_async.plan.execution import recorder
from pycrorm_async.world import BulletWorld, Object, ObjectType
from pycrorm_async.world.pose import NoWorld, WorldClosed
from tests.memory.note_actions import NoteActionPerformable, texts, url_of

pytestmark = pytest.mark.slow


# === connected ================================================================================================
#
# A connected memory and world serve every context without its own: cells, tasks and threads.

HERE = Path(__file__).parent


async def in_a_cell(text: str) -> None:
    """Run it as a cell of a notebook does: in a task with a new context, which has no memory yet."""
    await asyncio.get_running_loop().create_task(NoteActionPerformable(text).perform(), context=Context())


async def test_a_context_without_a_memory_uses_the_one_that_was_connected_last(tmp_path: Path) -> None:
    folders = [tmp_path / name for name in "abc"]
    for each in folders:
        each.mkdir()
    first = await Memory.connect(url_of(folders[0]))
    await in_a_cell("1")
    second = await Memory.connect(url_of(folders[1]))
    await in_a_cell("2")
    async with Memory.open(url_of(folders[2])):
        await NoteActionPerformable("3").perform()  # this context has its own
        await in_a_cell("4")
    thread = threading.Thread(target=lambda: asyncio.run(NoteActionPerformable("5").perform()))
    thread.start()
    thread.join()
    await second.close()
    await second.close()
    await in_a_cell("6")
    await first.close()
    await in_a_cell("7")
    assert recorder.get() is None
    texts_of_episodes = []
    for each in folders:
        async with Reading.open(url_of(each)) as reading:
            texts_of_episodes.append(await texts(reading))
    assert texts_of_episodes == [["1", "6"], ["2", "4", "5"], ["3"]]


async def test_closing_while_an_episode_is_open_ends_it_as_interrupted(tmp_path: Path) -> None:
    memory = await Memory.connect(url_of(tmp_path))
    async with memory.episode(description="left open"):
        await NoteActionPerformable("kept").perform()
        await memory.close()
        await NoteActionPerformable("not recorded").perform()
    with pytest.raises(CallerError, match="not open"):
        await memory.flush()
    async with Reading.open(url_of(tmp_path)) as reading:
        assert await texts(reading) == ["kept"]
        async with reading.session() as session:
            assert (await session.scalars(select(ProcessMetaData.status))).all() == ["INTERRUPTED"]


def test_a_connected_world_serves_every_context_until_it_is_closed() -> None:
    outer = BulletWorld().connect()
    milk = Context().run(Object, "milk", ObjectType.MILK)
    assert milk.world is outer
    with BulletWorld() as inner:
        assert Object("milk", ObjectType.MILK).world is inner
    later = BulletWorld().connect()
    assert Context().run(Object, "milk", ObjectType.MILK).world is later
    later.close()
    later.close()
    assert Context().run(Object, "cup", ObjectType.JEROEN_CUP).world is outer
    outer.close()
    with pytest.raises(NoWorld):
        Object("milk", ObjectType.MILK)
    with pytest.raises(WorldClosed):
        outer.connect()


# === notebooks ================================================================================================
#
# The notebooks run in a kernel: cells record into what an earlier cell connected, and draw what they end with.

NOTEBOOKS = (HERE / "connected.ipynb", HERE.parent / "tutorial.ipynb")


async def test_the_notebooks_run_and_record_and_the_tutorial_draws_what_it_shows(tmp_path: Path) -> None:
    command = [sys.executable, str(HERE / "execute_notebook.py"), str(tmp_path), *map(str, NOTEBOOKS)]
    environment = os.environ | {"PYTHONPATH": str(HERE.parent.parent)}
    ran = await asyncio.to_thread(
        lambda: subprocess.run(
            command, cwd=tmp_path, env=environment, capture_output=True, text=True, timeout=200, check=False
        )
    )
    assert ran.returncode == 0, ran.stderr

    (positions,) = outputs(tmp_path / "connected.ipynb")
    assert positions["text/plain"] == "[1.0, 2.0, 3.0]"
    async with Reading.open(url_of(tmp_path)) as reading, reading.session() as session:
        actions = (await session.scalars(select(NavigateAction).order_by(NavigateAction.id))).all()
        assert [each.robot_state and each.robot_state.pose.x for each in actions] == [0.0, 1.0, 2.0]
        episodes = (await session.scalars(select(ProcessMetaData).order_by(ProcessMetaData.id))).all()
        assert [(each.description, each.status) for each in episodes] == [
            ("NavigateAction", "SUCCEEDED"),
            ("two ways in one cell", "SUCCEEDED"),
        ]

    drawn = outputs(tmp_path / "tutorial.ipynb")
    memory, tree, chart, failures, actions_, moment, picture, page, tally, places, arms, learned, closed = drawn[1:]
    assert "Bring the milk" in memory["text/html"]
    assert "FAILED" in tree["text/html"]
    assert "IKError: " in tree["text/html"]
    assert chart["text/html"].startswith("<svg")
    assert "MoveTCPMotion" in failures["text/html"]
    assert actions_["text/plain"].startswith("[('RIGHT', 'FAILED', 1.3, -0.5)")
    assert "l_gripper_tool_frame" in moment["text/html"]
    for each in (picture, places, arms):
        assert each["image/png"].startswith("iVBORw0KGgo")  # PNG in base64
    assert page["text/plain"].startswith("Report(path=PosixPath('milk.html'), first=1,")
    assert page["text/html"].startswith('<iframe sandbox="allow-scripts"')
    assert "of 300 succeeded" in tally["text/plain"]
    before, after = (int(each) for each in learned["text/plain"].replace("%", "").replace("'", "").split()[::2])
    assert before < 25 < after
    assert "not open" in closed["text/html"]


def outputs(notebook: Path) -> list[dict[str, Any]]:
    """Return what the cells of an executed notebook end with, by media type."""
    cells = json.loads(notebook.read_text())["cells"]
    every = [each for cell in cells for each in cell.get("outputs", ())]
    assert not [each for each in every if each["output_type"] == "error"]
    results = [each["data"] for each in every if each["output_type"] == "execute_result"]
    return [{kind: "".join(text) for kind, text in each.items()} for each in results]


def test_the_tutorial_is_stored_without_outputs() -> None:
    for path in NOTEBOOKS:
        cells = [cell for cell in json.loads(path.read_text())["cells"] if cell["cell_type"] == "code"]
        assert [(cell["outputs"], cell["execution_count"]) for cell in cells] == [([], None)] * len(cells)
