"""Every defect that tests/README.md names has a test, and every test of a defect is named there."""

from __future__ import annotations

import ast
import re
from pathlib import Path

import pytest

pytestmark = pytest.mark.slow

HERE = Path(__file__).parent
ROWS = re.findall(
    r"^\| (\w+) \| ([^|]+) \| ([^|]+) \| `(test_\w+)` \|$", (HERE.parent / "README.md").read_text(), re.MULTILINE
)


def declared_and_tested(path: Path) -> tuple[dict[str, str], set[str]]:
    """Return the table `DEFECTS` of a test file, and the names of its tests."""
    tree = ast.parse(path.read_text())
    tests = {each.name for each in tree.body if isinstance(each, ast.FunctionDef | ast.AsyncFunctionDef)}
    (table,) = [
        each.value for each in tree.body if isinstance(each, ast.Assign) and ast.unparse(each.targets[0]) == "DEFECTS"
    ]
    return ast.literal_eval(table), tests


def test_every_defect_has_a_test_and_a_line_in_the_readme() -> None:
    files = sorted(HERE.glob("test_defects_of_*.py"))
    assert len(files) == 5
    tested: dict[str, str] = {}
    for path in files:
        declared, existing = declared_and_tested(path)
        assert set(declared.values()) <= existing, path.name
        assert not tested.keys() & declared.keys(), path.name
        tested |= declared
    numbers = [*map(str, range(1, 21)), *"abcde", *(f"s{number}" for number in range(1, 9))]
    assert [row[0] for row in ROWS] == numbers
    assert {row[0]: row[3] for row in ROWS} == tested
