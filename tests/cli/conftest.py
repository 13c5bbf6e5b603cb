"""Provide a folder with plans that go wrong, and with modules that cannot be imported as plans."""

from pathlib import Path

import pytest

from tests.cli.bad_plans import PLANS


@pytest.fixture
def folder(tmp_path: Path) -> Path:
    (tmp_path / "plans.py").write_text(PLANS)
    (tmp_path / "broken.py").write_text("import math\nmath.no_such_thing\n")
    (tmp_path / "wrong.py").write_text("def plan(:\n")
    (tmp_path / "turtle.py").write_text("async def plan(): pass\n")
    (tmp_path / "leaving.py").write_text("raise SystemExit(4)\n")
    return tmp_path
