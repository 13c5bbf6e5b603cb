"""A cue that cannot be answered is refused in one line that names the nearest known feature."""

from __future__ import annotations

from typing import Any

import pytest

from pycrorm_async.errors import CallerError
from pycrorm_async.events.ids import row_id
from pycrorm_async.recall.answer import answer
from pycrorm_async.recall.blocks import WORDS_MAX, Block, CaseLibrary
from pycrorm_async.recall.columns import FEATURES_MAX, Case
from pycrorm_async.recall.recall import cue_like
from pycrorm_async.recall.search import K_MAX, Cue, Wanted, check_cue, numbers_of, symbols_of
from pycrorm_async.world.pose import Arms, ObjectType
from tests.recall.random_cases import random_cases

LIBRARY = CaseLibrary([Block.of(random_cases(50, seed=1))])
TYPE = "PickUpAction"

BAD_CUES: dict[str, tuple[Cue, str]] = {
    "empty": (Cue(), "the cue is empty"),
    "a feature no case has": (Cue(type=TYPE, has=(("amr", "LEFT"),)), "'amr'; did you mean arm?"),
    "a number no case has": (Cue(type=TYPE, near=(Wanted("heigth", 1.0),)), "'heigth'; did you mean height?"),
    "nothing near": (Cue(has=(("qqqq", "x"),)), "'qqqq'; there are arm, near, object_type, reason, status"),
    "in lacks": (Cue(type=TYPE, lacks=(("amr", "LEFT"),)), "did you mean arm?"),
    "a text for a number": (
        Cue(type=TYPE, has=(("height", "high"),)),
        "height is a number: ask for it with `near`",
    ),
    "a number for a text": (
        Cue(type=TYPE, near=(Wanted("arm", 1.0),)),
        "arm is a text: ask for it with `has`",
    ),
    "k 0": (Cue(type=TYPE, k=0), "k must be 1 to 10,000, got 0"),
    "k too large": (Cue(type=TYPE, k=K_MAX + 1), "k must be 1 to 10,000"),
    "minimum": (Cue(type=TYPE, minimum=1.5), "minimum must be a score from 0 to 1"),
    "minimum NaN": (Cue(type=TYPE, minimum=float("nan")), "minimum must be a score from 0 to 1"),
    "before is not later": (Cue(type=TYPE, before_us=5, after_us=5), "`before` is not later than `after`"),
    "during ends early": (Cue(type=TYPE, during_us=(5, 4)), "`during` ends before it starts"),
    "contradiction": (
        Cue(type=TYPE, has=(("arm", "LEFT"),), lacks=(("arm", "LEFT"),)),
        "arm=LEFT is both in `has` and in `lacks`",
    ),
    "10,000 features": (
        Cue(type=TYPE, has=tuple((f"f{number}", "x") for number in range(10_000))),
        "the cue has 10,000 features, and at most 256 are compared",
    ),
}


@pytest.mark.parametrize(("cue", "line"), BAD_CUES.values(), ids=BAD_CUES.keys())
def test_a_cue_that_cannot_be_answered_is_refused_in_one_line(cue: Cue, line: str) -> None:
    with pytest.raises(CallerError) as error:
        check_cue(cue, LIBRARY)
    assert line in str(error.value)
    assert "\n" not in str(error.value)
    assert len(str(error.value)) < 200


BAD_VALUES: dict[str, tuple[dict[str, Any], dict[str, Any], str]] = {
    "1 MB": ({"arm": "x" * 1_000_000}, {}, "arm is a text of 1,000,000 characters; cases have at most 120"),
    "empty": ({"arm": ""}, {}, "arm is an empty text"),
    "number": ({"height": 0.9}, {}, "height is given as the number 0.9: ask for numbers with `near`"),
    "text": ({}, {"height": "high"}, "height is given as 'high', which is not a number"),
    "long text": ({}, {"height": "x" * 1_000_000}, "(1,000,002 characters), which is not a number"),
    "yes": ({}, {"height": True}, "height is given as True, which is not a number"),
    "tolerance 0": ({}, {"height": (0.9, 0)}, "the tolerance of height must be greater than 0, got 0"),
    "tolerance -1": ({}, {"height": (0.9, -1)}, "the tolerance of height must be greater than 0, got -1"),
    "tolerance NaN": ({}, {"height": (0.9, float("nan"))}, "height must be a finite number, got nan"),
    "infinite": ({}, {"height": float("inf")}, "height must be a finite number, got inf"),
    "three": ({}, {"height": (1, 2, 3)}, "height is given as 3 values"),
}


@pytest.mark.parametrize(("has", "near", "line"), BAD_VALUES.values(), ids=BAD_VALUES.keys())
def test_a_value_that_no_case_can_have_is_refused(has: dict[str, Any], near: dict[str, Any], line: str) -> None:
    with pytest.raises(CallerError) as error:
        symbols_of(has), numbers_of(near)
    assert line in str(error.value)
    assert len(str(error.value)) < 200


def test_enums_classes_and_lists_are_words() -> None:
    pairs = symbols_of({"arm": Arms.LEFT, "near": [ObjectType.BOWL, "CUP"], "reason": ValueError, "fragile": True})
    assert pairs == (
        ("arm", "LEFT"), ("near", "BOWL"), ("near", "CUP"), ("reason", "ValueError"), ("fragile", "True"),
    )  # fmt: skip


def test_a_type_or_a_word_that_never_occurred_is_no_error() -> None:
    check_cue(Cue(type="FlyAction", has=(("amr", "LEFT"),)), LIBRARY)
    check_cue(Cue(type=TYPE, has=(("arm", "THIRD"),)), LIBRARY)
    check_cue(Cue(type=TYPE, has=(("amr", "LEFT"),)), CaseLibrary())


def test_a_feature_with_too_many_words_is_refused_by_its_name() -> None:
    cases = [Case(row_id(1, n, 0), n, "A", {"id": f"{n}"}, {}, "FAILED") for n in range(1, WORDS_MAX + 2)]
    half = len(cases) // 2
    library = CaseLibrary([Block.of(cases[:half]), Block.of(cases[half:])])
    assert library.left_out == {"id"}
    with pytest.raises(CallerError, match="id has more than 16,384 different values"):
        check_cue(Cue(type="A", has=(("id", "5"),)), library)


def test_a_cue_reads_as_the_command_takes_it() -> None:
    cue = Cue(type=TYPE, has=(("arm", "LEFT"),), near=(Wanted("height", 0.93, 0.1),), lacks=(("near", "BOWL"),))
    assert str(cue) == "PickUpAction arm=LEFT height~0.93±0.1 not:near=BOWL"


def test_a_case_with_too_many_features_is_compared_by_those_that_weigh_most_and_the_others_are_counted() -> None:
    numbers = {f"n{number:03}": 1.0 for number in range(60)}
    common, rare = [f"common {number:03}" for number in range(150)], [f"rare {number:03}" for number in range(150)]
    others = [Case(row_id(1, n, 0), n, "A", {"near": tuple(common)}, numbers, "FAILED") for n in range(1, 100)]
    crowded = Case(row_id(1, 100, 0), 100, "A", {"near": (*common, *rare), "arm": "LEFT"}, numbers, "FAILED")
    library = CaseLibrary([Block.of([*others, crowded])])
    cue = cue_like(crowded, library)
    assert (len(cue.has) + len(cue.near), cue.left_out) == (FEATURES_MAX, 361 - FEATURES_MAX)
    words = [word for _, word in cue.has]
    assert set(rare) | {"LEFT"} <= set(words)
    assert len(cue.near) == 60, "a number weighs more than a word that almost every case has"
    check_cue(cue, library)
    assert "  left out: 105 features of the action that weigh least" in answer(cue, library).why().splitlines()
    plain = cue_like(others[0], library)
    assert (len(plain.has), len(plain.near), plain.left_out) == (150, 60, 0)
    assert "left out" not in answer(plain, library).why()
