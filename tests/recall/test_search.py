"""The search finds exactly the cases of a cue in exact order, refuses a wrong cue, and hides nothing silently."""

from __future__ import annotations

import math
import random
from itertools import pairwise
from typing import Any

import numpy as np
import pytest

from pycrorm_async.errors import CallerError
from pycrorm_async.events.ids import row_id
from pycrorm_async.recall import blocks
from pycrorm_async.recall import search as activations
from pycrorm_async.recall import search as searching
from pycrorm_async.recall.answer import answer
from pycrorm_async.recall.blocks import CaseBlock, CaseLibrary, Group, decode, encode
from pycrorm_async.recall.columns import Case
from pycrorm_async.recall.recall import cue_like
from pycrorm_async.recall.search import (
    FEATURES_MAX,
    K_MAX,
    Cue,
    Match,
    Wanted,
    Weights,
    check_cue,
    forgotten,
    numbers_of,
    search,
    symbols_of,
    weights_of,
)
from pycrorm_async.world.pose import Arms, ObjectType
from tests.recall.cases import CASE_STATUSES, CASE_TYPES, WORDS, kept_case, random_cases

# === search ===================================================================================================
#
# The search finds exactly the cases, in exactly the order, that comparing every case in plain Python finds.

CASES = [kept_case(case) for case in random_cases(400, seed=1)]
Answer = list[tuple[float, int]]


def has(case: Case, feature: str, word: str) -> bool:
    value = {**case.symbols, "status": case.status, "reason": case.reason}.get(feature)
    return word in value if isinstance(value, tuple) else value == word


def ended_by(case: Case, moment_us: int) -> bool:
    return case.duration_s is not None and case.started_us + case.duration_s * 1e6 <= moment_us


def nearness(case: Case, wanted: Wanted, tolerance: float) -> float:
    number = {**case.numbers, "duration": case.duration_s}.get(wanted.feature)
    if number is None:
        return 0.0
    distance = abs(number - wanted.value)
    if wanted.feature.endswith("yaw"):
        distance = math.fmod(distance, math.tau)
        distance = min(distance, math.tau - distance)
    return max(1 - distance / tolerance, 0.0)


def fulfils(case: Case, cue: Cue) -> bool:
    return (
        cue.type in (None, case.type)
        and not any(has(case, *pair) for pair in cue.lacks)
        and all(has(case, *pair) for pair in cue.requires)
        and (cue.before_us is None or case.started_us < cue.before_us)
        and (cue.after_us is None or case.started_us >= cue.after_us)
        and (cue.during_us is None or (case.started_us >= cue.during_us[0] and ended_by(case, cue.during_us[1])))
        and (cue.as_of_us is None or ended_by(case, cue.as_of_us))
        and (cue.episodes is None or case.episode in cue.episodes)
        and case.node not in cue.prohibit
        and (cue.simulated or not case.simulated)
    )


def brute_force(cue: Cue, cases: list[Case]) -> Answer:
    """Compare every case with the cue, by the definition of the score."""
    counted = [
        case
        for case in cases
        if cue.type in (None, case.type) and (cue.as_of_us is None or ended_by(case, cue.as_of_us))
    ]
    weights = [
        min(3.0, math.log((len(counted) + 1) / (sum(has(case, *pair) for case in counted) + 1)) + 0.1)
        for pair in cue.has
    ]
    whole = sum(weights, start=0.0) + len(cue.near) or 1.0
    answer = []
    for case in cases:
        if not fulfils(case, cue):
            continue
        similarity = 0.0 if cue.has or cue.near else 1.0
        for pair, weight in zip(cue.has, weights, strict=True):
            similarity += weight if has(case, *pair) else 0.0
        for wanted in cue.near:
            assert wanted.tolerance is not None
            similarity += nearness(case, wanted, wanted.tolerance)
        steps = round(similarity / whole * 1e9)
        if steps >= max(round(cue.minimum * 1e9), 1 if cue.has or cue.near else 0):
            answer.append((steps, case.started_us, case.node))
    return [(steps / 1e9, node) for steps, _, node in sorted(answer, reverse=True)[: cue.k]]


def random_cue(chance: random.Random, cases: list[Case]) -> Cue:
    """A cue with every kind of feature and condition, each in some cues only."""

    def sometimes(value: object) -> object:
        return value if chance.random() < 0.25 else None

    def pairs(most: int) -> tuple[tuple[str, str], ...]:
        possible = [("arm", "LEFT"), ("arm", "RIGHT"), ("status", chance.choice(CASE_STATUSES)), ("reason", "IKError")]
        possible += [(feature, word) for feature in ("object_type", "near") for word in (*WORDS, "CACTUS")]
        return tuple(chance.sample(possible, chance.randrange(most + 1)))

    numbers = [
        Wanted("height", chance.choice((0.9, chance.random() + 0.5)), chance.choice((0.05, 0.3))),
        Wanted("stand_yaw", chance.uniform(-4, 4), 0.7),
        Wanted("ticket", chance.choice((3.0, 2.0**40)), chance.choice((0.5, 2.0))),
        Wanted("duration", 0.5, 0.5),
    ]
    start = chance.randrange(45)
    return Cue(
        type=chance.choice((None, *CASE_TYPES)),
        has=pairs(5),
        near=tuple(chance.sample(numbers, chance.choice((0, 0, 1, 3)))),
        lacks=pairs(1),
        requires=pairs(1) if chance.random() < 0.2 else (),
        before_us=sometimes(chance.randrange(60)),  # type: ignore[arg-type]
        after_us=sometimes(chance.randrange(60)),  # type: ignore[arg-type]
        during_us=sometimes((start, start + chance.choice((5, 600_000)))),  # type: ignore[arg-type]
        as_of_us=sometimes(chance.choice((30, 500_000))),  # type: ignore[arg-type]
        episodes=sometimes(frozenset(chance.sample((1, 2, 3, 9), 2))),  # type: ignore[arg-type]
        prohibit=frozenset(chance.sample([case.node for case in cases], 5))
        if sometimes("") is not None
        else frozenset(),
        simulated=chance.random() < 0.3,
        k=chance.choice((1, 3, 20, 1_000)),
        minimum=chance.choice((0.0, 0.0, 0.5)),
    )


def library_of(cases: list[Case], chance: random.Random) -> CaseLibrary:
    """The cases in blocks of any size, in any order, as the database returns them."""
    mixed = chance.sample(cases, len(cases))
    borders = sorted({0, len(cases), *(chance.randrange(len(cases)) for _ in range(chance.randrange(6)))})
    parts = [mixed[start:end] for start, end in pairwise(borders)]
    return CaseLibrary([decode(encode(CaseBlock.of(part))) for part in parts])


def found(cue: Cue, library: CaseLibrary) -> Answer:
    return [(each.score, each.node) for each in search(cue, library, weights_of(cue, library))]


@pytest.mark.parametrize("cues", [150, pytest.param(500, marks=pytest.mark.soak)])
@pytest.mark.parametrize("first_rows", [4_096, 7])
@pytest.mark.slow
def test_random_cues_find_the_cases_of_brute_force_in_its_order(
    first_rows: int, cues: int, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setattr(searching, "_FIRST_ROWS", first_rows)
    chance = random.Random(first_rows)
    library = library_of(CASES, chance)
    answers = 0
    for number in range(cues):
        if number % 50 == 0:
            library = library_of(CASES, chance)
        cue = random_cue(chance, CASES)
        expected = brute_force(cue, CASES)
        assert found(cue, library) == expected, cue
        answers += bool(expected)
    assert answers > cues / 2, "most cues have an answer"


def test_a_library_without_cases_has_no_answer() -> None:
    assert found(Cue(type="PickUpAction", has=(("arm", "LEFT"),), near=(Wanted("height", 1.0),)), CaseLibrary()) == []


def test_a_common_cue_ends_in_the_newest_rows(monkeypatch: pytest.MonkeyPatch) -> None:
    compared = []
    compare = searching._matches

    def counted(group: Group, rows: slice, cue: Cue, weights: Weights, lowest: int, bound: int) -> list[Match]:
        compared.append(rows)
        return compare(group, rows, cue, weights, lowest, bound)

    monkeypatch.setattr(searching, "_matches", counted)
    monkeypatch.setattr(searching, "_FIRST_ROWS", 40)
    cases = [Case(row_id(1, n, 0), n, "A", {"arm": "LEFT"}, {}, "FAILED") for n in range(1, 101)]
    library = CaseLibrary([CaseBlock.of(cases[:50]), CaseBlock.of(cases[50:])])
    assert len(found(Cue(type="A", has=(("arm", "LEFT"),), k=10), library)) == 10
    assert compared == [slice(0, 40)]


def test_the_tolerance_of_a_number_does_not_depend_on_the_blocks() -> None:
    chance = random.Random(5)
    libraries = [library_of(CASES, chance) for _ in range(5)]
    for feature in ("height", "ticket"):
        assert len({library.tolerance("PickUpAction", feature) for library in libraries}) == 1
    assert libraries[0].tolerance("PickUpAction", "height") == pytest.approx(0.29, abs=0.03)
    assert libraries[0].tolerance("PickUpAction", "stand_yaw") == 0.5


# === activation ===============================================================================================
#
# The activation is near that of ACT-R, and what falls below a threshold is counted before anything is hidden.

NOW_US = 10_000_000_000


def use(sequence: int, age_s: float, arm: str, name: str = "A") -> Case:
    texts: dict[str, str | tuple[str, ...]] = {"arm": arm, "near": ("CUP",) if sequence % 2 else ("BOWL",)}
    status = "FAILED" if sequence % 3 else "SUCCEEDED"
    return Case(row_id(1, sequence, 0), NOW_US - round(age_s * 1e6), name, texts, {"x": age_s}, status, None, 1.0)


def activation(ages_s: list[float]) -> float:
    """Return the activation of a way with uses of these ages: the threshold from which on it is forgotten."""
    library = CaseLibrary([CaseBlock.of(use(number, age_s, "L") for number, age_s in enumerate(ages_s, 1))])
    low, high = -50.0, 50.0
    for _ in range(60):
        middle = (low + high) / 2
        is_forgotten = forgotten(library, threshold=middle, now_us=NOW_US).cases > 0
        low, high = (low, middle) if is_forgotten else (middle, high)
    return low


def test_up_to_three_uses_are_counted_exactly_and_more_nearly() -> None:
    assert activation([4.0]) == pytest.approx(np.log(0.5))
    assert activation([1.0, 4.0, 100.0]) == pytest.approx(np.log(1.6))
    assert activation([0.0]) < 4, "an action that starts now does not outweigh all others"
    assert activation([4.0] * 10) == pytest.approx(np.log(5))
    chance = np.random.default_rng(1)
    for size in (4, 20, 300):
        ages = np.sort(chance.uniform(1, 10_000, size))
        assert activation(ages.tolist()) == pytest.approx(float(np.log(np.sum(ages**-0.5))), abs=0.15)


@pytest.mark.parametrize("numbers_max", [2**62, 3])
def test_all_cases_of_a_way_have_its_activation(numbers_max: int, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(activations, "_NUMBERS_MAX", numbers_max)
    chance = random.Random(2)
    cases = [use(n, chance.uniform(1, 9_000), chance.choice("LR"), chance.choice("AB")) for n in range(1, 200)]
    library = CaseLibrary([CaseBlock.of(cases[:50]), CaseBlock.of(cases[50:])])

    def hidden(threshold: float) -> set[int]:
        return set(forgotten(library, threshold=threshold, now_us=NOW_US).nodes.tolist())

    for name in "AB":
        for arm in "LR":
            way = [case for case in cases if (case.type, case.symbols["arm"]) == (name, arm)]
            nodes, value = {case.node for case in way}, activation([(NOW_US - case.started_us) / 1e6 for case in way])
            assert nodes <= hidden(value + 1e-9)
            assert not nodes & hidden(value - 1e-9)


def test_what_is_forgotten_is_what_lies_below_the_threshold() -> None:
    cases = [use(1, 1.0, "L"), use(2, 2.0, "L"), use(3, 9_000.0, "R"), use(4, 8_000.0, "R"), use(5, 9_000.0, "L")]
    library = CaseLibrary([CaseBlock.of(cases)])
    hidden = forgotten(library, threshold=-2.0, now_us=NOW_US)
    assert (hidden.cases, hidden.ways) == (2, 1)
    assert hidden.nodes.tolist() == [cases[2].node, cases[3].node]
    assert forgotten(library, threshold=-99.0, now_us=NOW_US).cases == 0
    assert forgotten(library, threshold=99.0, now_us=NOW_US)[:2] == (5, 2)
    assert forgotten(CaseLibrary(), threshold=99.0, now_us=NOW_US)[:2] == (0, 0)


# === cue ======================================================================================================
#
# A cue that cannot be answered is refused in one line that names the nearest known feature.

LIBRARY = CaseLibrary([CaseBlock.of(random_cases(50, seed=1))])
TYPE = "PickUpAction"

BAD_CUES: dict[str, tuple[Cue, str]] = {
    "empty": (Cue(), "the cue is empty"),
    "a feature no case has": (Cue(type=TYPE, has=(("amr", "LEFT"),)), "'amr'; did you mean arm?"),
    "a number no case has": (Cue(type=TYPE, near=(Wanted("heigth", 1.0),)), "'heigth'; did you mean height?"),
    "nothing near": (Cue(has=(("qqqq", "x"),)), "'qqqq'; there are arm, near, object_type, reason, status"),
    "in lacks": (Cue(type=TYPE, lacks=(("amr", "LEFT"),)), "did you mean arm?"),
    "a text for a number": (Cue(type=TYPE, has=(("height", "high"),)), "height is a number: ask for it with `near`"),
    "a number for a text": (Cue(type=TYPE, near=(Wanted("arm", 1.0),)), "arm is a text: ask for it with `has`"),
    "k 0": (Cue(type=TYPE, k=0), "k must be 1 to 10,000, got 0"),
    "k too large": (Cue(type=TYPE, k=K_MAX + 1), "k must be 1 to 10,000"),
    "minimum": (Cue(type=TYPE, minimum=1.5), "minimum must be a score from 0 to 1"),
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


def test_a_cue_that_cannot_be_answered_is_refused_in_one_line() -> None:
    for name, (cue, line) in BAD_CUES.items():
        with pytest.raises(CallerError) as error:
            check_cue(cue, LIBRARY)
        assert line in str(error.value), name
        assert ("\n" in str(error.value), len(str(error.value)) < 200) == (False, True), name


BAD_VALUES: dict[str, tuple[dict[str, Any], dict[str, Any], str]] = {
    "1 MB": ({"arm": "x" * 1_000_000}, {}, "arm is a text of 1,000,000 characters; cases have at most 120"),
    "empty": ({"arm": ""}, {}, "arm is an empty text"),
    "number": ({"height": 0.9}, {}, "height is given as the number 0.9: ask for numbers with `near`"),
    "text": ({}, {"height": "high"}, "height is given as 'high', which is not a number"),
    "long text": ({}, {"height": "x" * 1_000_000}, "(1,000,002 characters), which is not a number"),
    "yes": ({}, {"height": True}, "height is given as True, which is not a number"),
    "tolerance 0": ({}, {"height": (0.9, 0)}, "the tolerance of height must be greater than 0, got 0"),
    "tolerance NaN": ({}, {"height": (0.9, float("nan"))}, "height must be a finite number, got nan"),
    "infinite": ({}, {"height": float("inf")}, "height must be a finite number, got inf"),
    "three": ({}, {"height": (1, 2, 3)}, "height is given as 3 values"),
}


def test_a_value_that_no_case_can_have_is_refused() -> None:
    for name, (has, near, line) in BAD_VALUES.items():
        with pytest.raises(CallerError) as error:
            symbols_of(has), numbers_of(near)
        assert line in str(error.value), name
        assert len(str(error.value)) < 200, name


def test_enums_classes_and_lists_are_words() -> None:
    pairs = symbols_of({"arm": Arms.LEFT, "near": [ObjectType.BOWL, "CUP"], "reason": ValueError, "fragile": True})
    assert pairs == (
        ("arm", "LEFT"), ("near", "BOWL"), ("near", "CUP"), ("reason", "ValueError"), ("fragile", "True"),
    )  # fmt: skip


def test_a_type_or_a_word_that_never_occurred_is_no_error() -> None:
    check_cue(Cue(type="FlyAction", has=(("amr", "LEFT"),)), LIBRARY)
    check_cue(Cue(type=TYPE, has=(("arm", "THIRD"),)), LIBRARY)
    check_cue(Cue(type=TYPE, has=(("amr", "LEFT"),)), CaseLibrary())


def test_a_feature_with_too_many_words_is_refused_by_its_name(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(blocks, "WORDS_MAX", 16)
    cases = [Case(row_id(1, n, 0), n, "A", {"id": f"{n}"}, {}, "FAILED") for n in range(18)]
    library = CaseLibrary([CaseBlock.of(cases[:9]), CaseBlock.of(cases[9:])])
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
    library = CaseLibrary([CaseBlock.of([*others, crowded])])
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
