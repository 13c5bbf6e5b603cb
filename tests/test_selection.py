"""The tests of a run: long modules early, every test of the soak in one of twenty turns, and none lost or doubled."""

from __future__ import annotations

from collections import Counter
from pathlib import Path
from types import SimpleNamespace
from typing import Any

import pytest

from tests.long_modules import LONGEST, long_modules_first
from tests.soak_turns import FIXED, TURNS, current_commit, place_of, turn_of

# === long modules =============================================================================================
#
# Each test process runs its long modules early, and no test is lost or doubled by their order.

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


# === soak turns ===============================================================================================
#
# Every test of the soak runs in exactly one of twenty turns, whatever the commit.


def test_successive_ids_are_all_turns_and_a_short_id_has_the_turn_of_the_long_one() -> None:
    assert {turn_of(f"{number:07x}") for number in range(1_000, 1_000 + TURNS)} == set(range(TURNS))
    assert turn_of("4f1c2ab") == turn_of("4f1c2ab09d7a5c3e") == 0x4F1C2AB % 20


def test_tests_are_spread_evenly_and_keep_their_turn() -> None:
    places = Counter(place_of(f"tests/test_a.py::test_b[{number}]") for number in range(1_000))
    assert set(places) == set(range(TURNS))
    assert max(places.values()) < 80
    assert place_of("tests/a.py::test_b[1]") == place_of("tests/a.py::test_b[1]")


def test_a_folder_that_is_no_repository_has_a_fixed_turn(tmp_path: Path) -> None:
    assert current_commit(tmp_path) == FIXED
    assert current_commit(tmp_path / "missing") == FIXED
    assert turn_of(FIXED) == 0
