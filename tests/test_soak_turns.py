"""Every test of the soak runs in exactly one of ten turns, whatever the commit."""

from collections import Counter
from pathlib import Path

from tests.soak_turns import FIXED, TURNS, current_commit, place_of, turn_of


def test_ten_successive_ids_are_ten_turns_and_a_short_id_has_the_turn_of_the_long_one() -> None:
    assert {turn_of(f"{number:07x}") for number in range(1_000, 1_000 + TURNS)} == set(range(TURNS))
    assert turn_of("4f1c2ab") == turn_of("4f1c2ab09d7a5c3e") == 0x4F1C2AB % 10


def test_tests_are_spread_evenly_and_keep_their_turn() -> None:
    places = Counter(place_of(f"tests/test_a.py::test_b[{number}]") for number in range(1_000))
    assert set(places) == set(range(TURNS))
    assert max(places.values()) < 150
    assert place_of("tests/a.py::test_b[1]") == place_of("tests/a.py::test_b[1]")


def test_a_folder_that_is_no_repository_has_a_fixed_turn(tmp_path: Path) -> None:
    assert current_commit(tmp_path) == FIXED
    assert current_commit(tmp_path / "missing") == FIXED
    assert turn_of(FIXED) == 0
