"""The search finds exactly the cases, in exactly the order, that comparing every case in plain Python finds."""

from __future__ import annotations

import math
import random
from itertools import pairwise

import pytest

from pycrorm_async.events.ids import row_id
from pycrorm_async.recall import search as searching
from pycrorm_async.recall.blocks import Block, CaseLibrary, Group, decode, encode
from pycrorm_async.recall.columns import Case, bounded_case
from pycrorm_async.recall.search import Cue, Match, Wanted, Weights, search, weights_of
from tests.recall.random_cases import STATUSES, TYPES, WORDS, random_cases

CASES = [bounded_case(case) for case in random_cases(400, seed=1)]
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
        possible = [("arm", "LEFT"), ("arm", "RIGHT"), ("status", chance.choice(STATUSES)), ("reason", "IKError")]
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
        type=chance.choice((None, *TYPES)),
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
    return CaseLibrary([decode(encode(Block.of(part))) for part in parts])


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


def test_a_type_alone_returns_its_newest_cases() -> None:
    cue = Cue(type="PickUpAction", k=5)
    newest = sorted(
        ((case.started_us, case.node) for case in CASES if case.type == "PickUpAction" and not case.simulated),
        reverse=True,
    )
    assert found(cue, library_of(CASES, random.Random(1))) == [(1.0, node) for _, node in newest[:5]]


def test_a_library_without_cases_has_no_answer() -> None:
    assert found(Cue(type="PickUpAction", has=(("arm", "LEFT"),), near=(Wanted("height", 1.0),)), CaseLibrary()) == []


def test_a_word_that_no_case_has_cannot_hide_a_case_that_matches_all_else() -> None:
    cases = [
        Case(row_id(1, n, 0), n, "A", {"arm": "LEFT", "object_type": "MILK" if n % 2 else "BOWL"}, {}, "FAILED")
        for n in range(1, 10_001)
    ]
    library = CaseLibrary([Block.of(cases)])
    cue = Cue(type="A", has=(("arm", "LEFT"), ("object_type", "CACTUS")))
    weights = weights_of(cue, library)
    assert weights.never_seen == (("object_type", "CACTUS"),)
    assert weights.words == pytest.approx((0.1, 3.0))


def test_a_common_cue_ends_in_the_newest_rows(monkeypatch: pytest.MonkeyPatch) -> None:
    compared = []
    compare = searching._matches

    def counted(group: Group, rows: slice, cue: Cue, weights: Weights, lowest: int, bound: int) -> list[Match]:
        compared.append(rows)
        return compare(group, rows, cue, weights, lowest, bound)

    monkeypatch.setattr(searching, "_matches", counted)
    cases = [Case(row_id(1, n, 0), n, "A", {"arm": "LEFT"}, {}, "FAILED") for n in range(1, 10_001)]
    library = CaseLibrary([Block.of(cases[:5_000]), Block.of(cases[5_000:])])
    assert len(found(Cue(type="A", has=(("arm", "LEFT"),), k=10), library)) == 10
    assert compared == [slice(0, 4_096)]


def test_the_tolerance_of_a_number_does_not_depend_on_the_blocks() -> None:
    chance = random.Random(5)
    libraries = [library_of(CASES, chance) for _ in range(20)]
    for feature in ("height", "ticket"):
        assert len({library.tolerance("PickUpAction", feature) for library in libraries}) == 1
    assert libraries[0].tolerance("PickUpAction", "height") == pytest.approx(0.29, abs=0.03)
    assert libraries[0].tolerance("PickUpAction", "stand_yaw") == 0.5
