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
from tests.commands import answer, one_line_of, pycrorm
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

EXAMPLES = sorted(HERE.parents[1].glob("pycrorm_async/examples/*.ipynb"))
OTHERS = [each for each in EXAMPLES if each.stem in ("a_fleet", "why_did_it_fail", "your_ros_bag")]
QUICK = [HERE / "connected.ipynb", *(each for each in EXAMPLES if each not in OTHERS)]


async def executed(folder: Path, notebooks: list[Path]) -> dict[str, list[dict[str, Any]]]:
    """Return what the cells of the notebooks end with in a kernel, by the notebook's name."""
    command = [sys.executable, str(HERE / "execute_notebook.py"), str(folder), *map(str, notebooks)]
    environment = os.environ | {"PYTHONPATH": str(HERE.parent.parent)}
    ran = await asyncio.to_thread(
        lambda: subprocess.run(
            command, cwd=folder, env=environment, capture_output=True, text=True, timeout=400, check=False
        )
    )
    assert ran.returncode == 0, ran.stderr
    return {each.stem: outputs(folder / each.name) for each in notebooks}


async def test_notebooks_record_draw_and_learn(tmp_path: Path) -> None:
    cells = await executed(tmp_path, QUICK)

    (positions,) = cells["connected"]
    assert positions["text/plain"] == "[1.0, 2.0, 3.0]"
    async with Reading.open(url_of(tmp_path)) as reading, reading.session() as session:
        actions = (await session.scalars(select(NavigateAction).order_by(NavigateAction.id))).all()
        assert [each.robot_state and each.robot_state.pose.x for each in actions] == [0.0, 1.0, 2.0]
        episodes = (await session.scalars(select(ProcessMetaData).order_by(ProcessMetaData.id))).all()
        assert [(each.description, each.status) for each in episodes] == [
            ("NavigateAction", "SUCCEEDED"),
            ("two ways in one cell", "SUCCEEDED"),
        ]

    memory, tree, chart, failures, actions_, moment, picture, page, closed = cells["first_episode"][1:]
    assert "Bring the milk" in memory["text/html"]
    assert "FAILED" in tree["text/html"]
    assert "IKError: " in tree["text/html"]
    assert chart["text/html"].startswith("<svg")
    assert "MoveTCPMotion" in failures["text/html"]
    assert actions_["text/plain"].startswith("[('RIGHT', 'FAILED', 1.3, -0.5)")
    assert "l_gripper_tool_frame" in moment["text/html"]
    assert page["text/plain"].startswith("Report(path=PosixPath('milk.html'), first=1,")
    assert page["text/html"].startswith('<iframe sandbox="allow-scripts"')
    assert "not open" in closed["text/html"]

    tally, _frame, places, causes, learned, recalled = cells["learn_from_a_thousand"]
    assert "170 of 1000 succeeded" in tally["text/plain"]
    assert "IKError" in causes["text/html"]
    before, after = (int(each) for each in learned["text/plain"].replace("%", "").replace("'", "").split()[::2])
    assert before < 25 < 60 < after
    assert "RecalledPickUpAction" in recalled["text/html"]
    for each in (picture, places):
        assert each["image/png"].startswith("iVBORw0KGgo")  # PNG in base64


@pytest.mark.soak
async def test_the_other_examples_have_the_answers_that_they_announce(tmp_path: Path) -> None:
    pytest.importorskip("rosbags")
    cells = await executed(tmp_path, OTHERS)

    ended, copied, _episodes, causes, transports, _steps, *_ = cells["a_fleet"]
    assert (ended["text/plain"], copied["text/plain"]) == ("[0, 0, 0]", "0")
    assert "ObjectUnfetchable" in causes["text/html"]
    rows = [line.split()[1:] for line in transports["text/plain"].splitlines()[1:]]
    assert rows == [
        ["anna", "SUCCEEDED", "2"],
        ["ben", "SUCCEEDED", "2"],
        ["cleo", "FAILED", "1"],
        ["cleo", "SUCCEEDED", "1"],
        ["dora", "FAILED", "1"],
        ["dora", "SUCCEEDED", "1"],
    ]

    _world, _memory, failures, tree, refused, *_, recalled, differences = cells["why_did_it_fail"]
    assert "no object is named tea" in failures["text/html"]
    assert "ObjectUnfetchable" in tree["text/html"]
    assert "too far: from shoulder to wrist" in refused["text/plain"]
    assert recalled["text/plain"].startswith("<Answer: 2 of 2 cases for TransportAction; 1 of 2 succeeded")
    assert "cereal" in differences["text/html"]

    tree, chart, moment, failures, streams, samples = cells["your_ros_bag"]
    assert tree["text/plain"].splitlines()[1:] == [
        "  NavigateToPose SUCCEEDED 7.00 s",
        "  NavigateToPose FAILED 6.00 s the action server aborted the goal: the action server aborted the goal",
        "  NavigateToPose SUCCEEDED 3.00 s",
    ]
    assert "turtle Pose(position=[-3.67" in moment["text/plain"]
    assert "joint_states         2      200" in streams["text/plain"]
    assert samples["text/plain"].count("\n") > 5
    assert all(each["text/html"].strip() for each in (chart, failures))


def outputs(notebook: Path) -> list[dict[str, Any]]:
    """Return what the cells of an executed notebook end with, by media type."""
    cells = json.loads(notebook.read_text())["cells"]
    every = [each for cell in cells for each in cell.get("outputs", ())]
    assert not [each for each in every if each["output_type"] == "error"]
    results = [each["data"] for each in every if each["output_type"] == "execute_result"]
    return [{kind: "".join(text) for kind, text in each.items()} for each in results]


def test_the_notebooks_are_stored_without_outputs() -> None:
    for path in (*QUICK, *OTHERS):
        cells = [cell for cell in json.loads(path.read_text())["cells"] if cell["cell_type"] == "code"]
        assert [(cell["outputs"], cell["execution_count"]) for cell in cells] == [([], None)] * len(cells)


def test_the_command_copies_the_examples_and_overwrites_none(tmp_path: Path) -> None:
    for _ in range(2):
        assert answer("examples", "mine", cwd=tmp_path).keys() == {f"mine/{each.name}" for each in EXAMPLES}
    copies = {each: (tmp_path / "mine" / each.name) for each in EXAMPLES}
    assert all(copy.read_text() == each.read_text() for each, copy in copies.items())
    changed = copies[EXAMPLES[0]]
    changed.write_text("mine")
    refused = pycrorm("examples", "mine", cwd=tmp_path)
    assert (refused.returncode, changed.read_text()) == (2, "mine")
    assert f"mine/{changed.name} would be overwritten: name another folder" in one_line_of(refused)
