"""Each test process runs its long modules early, and no test is lost or doubled by their order."""

from __future__ import annotations

from pathlib import Path
from types import SimpleNamespace
from typing import Any

import pytest

from tests.long_modules import LONGEST, long_modules_first

TESTS = Path(__file__).parent


def items_of(*modules: str) -> list[Any]:
    """Return ten tests of each module, as far as the order looks at them."""
    return [SimpleNamespace(path=TESTS / f"{module}.py", number=number) for module in modules for number in range(10)]


def test_every_named_module_exists() -> None:
    assert [each for each in LONGEST if not (TESTS / f"{each}.py").is_file()] == []
    assert len(set(LONGEST)) == len(LONGEST)


def test_each_share_has_its_long_modules_in_its_first_half_and_modules_stay_whole() -> None:
    short = [f"queue/test_{number}" for number in range(16)]
    items = items_of(*short[:8], *reversed(LONGEST[:8]), *short[8:])
    ordered = long_modules_first(items, 4)
    names = [f"{each.path.parent.relative_to(TESTS)}/{each.path.stem}" for each in ordered[::10]]
    assert names[::6] == LONGEST[:4]
    assert [names[2], *names[8::6]] == LONGEST[4:8]
    assert [vars(each)["number"] for each in ordered] == [*range(10)] * 24
    assert [each for each in ordered if each.path.parent.name == "queue"] == items_of(*short)


@pytest.mark.parametrize("processes", [1, 2, 3, 7, 40])
def test_no_test_is_lost_or_doubled(processes: int) -> None:
    items = items_of("queue/test_a", *LONGEST[:3], "queue/test_b")[3:-4]
    assert sorted(map(id, long_modules_first(items, processes))) == sorted(map(id, items))
    assert long_modules_first([], processes) == []
