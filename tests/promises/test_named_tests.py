"""Every test that tests/README.md names for a promise or for a defect of an earlier system exists."""

from __future__ import annotations

import re
from pathlib import Path

TESTS = Path(__file__).parent.parent


def test_every_test_that_the_readme_names_exists() -> None:
    named = re.findall(r"`(test_\w+)`", (TESTS / "README.md").read_text())
    assert len(named) > 50
    sources = "".join(path.read_text() for path in TESTS.rglob("test_*.py"))
    assert [each for each in named if f"def {each}(" not in sources] == []
