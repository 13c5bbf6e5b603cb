"""The notebooks run in a kernel: cells record into what an earlier cell connected, and draw what they end with."""

from __future__ import annotations

import asyncio
import json
import os
import subprocess
import sys
from pathlib import Path
from typing import Any

import pytest
from sqlalchemy import select

from pycrorm_async import Reading
from pycrorm_async.orm import NavigateAction, ProcessMetaData
from tests.memory.note_actions import url_of

pytestmark = pytest.mark.slow

HERE = Path(__file__).parent
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
    assert "<b>IKError</b>" in tree["text/html"].replace("<bdi>", "").replace("</bdi>", "")
    assert chart["text/html"].startswith("<svg")
    assert "MoveTCPMotion" in failures["text/html"]
    assert actions_["text/plain"].startswith("[('RIGHT', 'FAILED', 1.3, -0.5)")
    assert "polygon" in moment["text/html"]
    for each in (picture, places, arms):
        assert each["image/png"].startswith("iVBORw0KGgo")  # PNG in base64
    assert page["text/plain"].startswith("Report(path=PosixPath('milk.html'), first=1,")
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
