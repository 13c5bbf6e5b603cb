"""Blocks of cases: nothing is lost in their rows or in a merge, and rows that contradict each other are refused."""

from __future__ import annotations

import random
from typing import Any

import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from pycrorm_async.events.ids import row_id
from pycrorm_async.recall.blocks import WORDS_MAX, Block, BlockRow, decode, encode, merge
from pycrorm_async.recall.columns import FEATURES_MAX, Case, bounded_case
from tests.recall.random_cases import CASES, random_cases


def kept(cases: list[Case]) -> list[Case]:
    """The cases as a block has them: bounded, by type, the newest first."""
    ordered = sorted(map(bounded_case, cases), key=lambda case: (case.started_us, case.node), reverse=True)
    return sorted(ordered, key=lambda case: case.type)


@settings(max_examples=50)
@given(CASES)
def test_a_block_returns_its_cases_from_its_rows(cases: list[Case]) -> None:
    block = decode(encode(Block.of(cases)))
    assert list(block.cases()) == kept(cases)
    assert len(block) == len(cases)


@settings(max_examples=50)
@given(CASES, st.randoms())
def test_the_same_cases_make_the_same_rows_in_any_order_and_in_any_parts(
    cases: list[Case], chance: random.Random
) -> None:
    rows = encode(Block.of(cases))
    mixed = chance.sample(cases, len(cases))
    borders = sorted(chance.choices(range(len(cases) + 1), k=3))
    parts = [mixed[: borders[0]], mixed[borders[0] : borders[1]], mixed[borders[1] : borders[2]], mixed[borders[2] :]]
    blocks = [decode(encode(Block.of(part))) for part in parts if part]
    assert encode(merge(blocks)) == rows


def test_a_case_keeps_its_parent_and_that_it_was_simulated() -> None:
    case = Case(row_id(3, 9, 0), 5, "PlaceAction", {}, {}, "LOST", parent=row_id(3, 4, 0), simulated=True)
    assert list(decode(encode(Block.of([case]))).cases()) == [case]


def test_what_a_memory_cannot_compare_is_left_out_of_a_case() -> None:
    texts: dict[str, str | tuple[str, ...]] = {"prose": "a" * 121, "arm": "LEFT", "near": ("b" * 1_000_000, "CUP")}
    case = bounded_case(Case(1, 0, "A", texts, {"x": float("nan"), "y": float("inf"), "z": 0.1}, "FAILED"))
    assert case.symbols == {"arm": "LEFT", "near": ("CUP",)}
    assert case.numbers == {"z": pytest.approx(0.1)}
    assert case.numbers["z"] != 0.1, "numbers are float32"
    many = bounded_case(Case(1, 0, "A", {f"f{number:05}": "x" for number in range(10_000)}, {}, "FAILED"))
    assert list(many.symbols) == [f"f{number:05}" for number in range(FEATURES_MAX)]


def test_a_feature_cannot_have_the_name_of_an_outcome() -> None:
    with pytest.raises(AssertionError, match="status"):
        bounded_case(Case(1, 0, "A", {"status": "x"}, {}, "FAILED"))


def test_a_feature_with_too_many_words_is_left_out_and_stays_so() -> None:
    cases = [Case(row_id(1, n, 0), n, "A", {"arm": "LEFT", "id": f"{n}"}, {}, "FAILED") for n in range(1, 20_000)]
    halves = [Block.of(cases[:10_000]), Block.of(cases[10_000:])]
    assert [each.left_out for each in halves] == [frozenset(), frozenset()]
    merged = merge(halves)
    assert len(merged) > WORDS_MAX
    assert merged.left_out == {"id"}
    assert {name for case in merged.cases() for name in case.symbols} == {"arm"}
    again = merge([decode(encode(merged)), Block.of(random_cases(3, seed=1))])
    assert again.left_out == {"id"}


def _rows() -> dict[str, BlockRow]:
    return {row.feature: row for row in encode(Block.of(random_cases(9, seed=1)))}


DAMAGE: list[tuple[str, str, dict[str, Any]]] = [
    ("bytes are not", "height", {"data": b"123"}),
    ("bytes are not", "node", {"data": b"12345678"}),
    ("bytes are not", "near", {"data": b"\1"}),
    ("types and", "type", {"data": b"\1\0\0\0"}),
    ("cannot be read", "arm", {"words": "{"}),
    ("cannot be read", "arm", {"words": None}),
    ("has the types", "arm", {"words": '{"types":["X"],"words":[]}'}),
    ("unknown kind", "arm", {"kind": "symbol64"}),
    ("in the order", "started", {"data": b"".join(each.to_bytes(8, "little") for each in range(9))}),
]


@pytest.mark.parametrize(("reason", "feature", "change"), DAMAGE)
def test_rows_that_contradict_each_other_are_refused(reason: str, feature: str, change: dict[str, Any]) -> None:
    rows = _rows()
    rows[feature] = rows[feature]._replace(**change)
    with pytest.raises(ValueError, match=reason):
        decode(rows.values())


def test_a_block_without_its_nodes_is_refused() -> None:
    rows = _rows()
    del rows["node"]
    with pytest.raises(ValueError, match=r"no row .*node"):
        decode(rows.values())


def test_a_code_without_a_word_is_refused() -> None:
    rows = encode(Block.of([Case(32, 0, "A", {"arm": "LEFT"}, {}, "FAILED")]))
    with pytest.raises(ValueError, match="has the code 2 and 1 words"):
        decode(row._replace(data=b"\2") if row.feature == "arm" else row for row in rows)


def test_a_block_without_a_case_has_no_rows() -> None:
    with pytest.raises(ValueError, match="no rows"):
        encode(Block.of([]))
