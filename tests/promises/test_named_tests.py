"""Every test that tests/README.md names for a promise or for a defect of an earlier system exists."""

from __future__ import annotations

from pathlib import Path

from tests.soak_turns import NAMED


def test_every_test_that_the_readme_names_exists() -> None:
    assert len(NAMED) > 50
    sources = "".join(path.read_text() for path in Path(__file__).parent.parent.rglob("test_*.py"))
    assert [each for each in NAMED if f"def {each}(" not in sources] == []
