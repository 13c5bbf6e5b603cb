"""An answer states how its cases ended, why each was found, and what they have in common."""

from __future__ import annotations

import math

import pytest

from pycrorm_async.events.ids import row_id
from pycrorm_async.recall.answer import Answer, answer, success_of
from pycrorm_async.recall.blocks import Block, CaseLibrary
from pycrorm_async.recall.columns import Case
from pycrorm_async.recall.search import Cue, Wanted


def pick_up(sequence: int, *, height: float, arm: str = "LEFT", reason: str | None = None, yaw: float = 0.0) -> Case:
    texts: dict[str, str | tuple[str, ...]] = {"arm": arm, "near": ("BOWL", "CUP")}
    status = "FAILED" if reason else "SUCCEEDED"
    numbers = {"height": height, "stand_yaw": yaw}
    return Case(row_id(1, sequence, 0), 1_000_000 * sequence, "PickUpAction", texts, numbers, status, reason, 2.0)


CASES = [
    pick_up(1, height=0.625, yaw=3.0),
    pick_up(2, height=1.0, yaw=-3.0),
    pick_up(3, height=1.25, reason="IKError"),
    pick_up(4, height=2.0, arm="RIGHT", reason="<IKError>"),
]


def asked(cue: Cue) -> Answer:
    return answer(cue, CaseLibrary([Block.of(CASES)]))


CUE = Cue(
    type="PickUpAction",
    has=(("arm", "LEFT"), ("near", "CACTUS"), ("near", "CUP")),
    near=(Wanted("height", 1.0, 0.5), Wanted("stand_yaw", 3.0, 0.5)),
    k=3,
)


def test_each_case_names_what_matched_and_what_missed_by_how_much() -> None:
    best = asked(CUE)[0]
    assert best.case == CASES[1]
    assert [(each.feature, each.wanted) for each in best.matched] == [
        ("arm", "LEFT"), ("near", "CUP"), ("height", 1.0), ("stand_yaw", 3.0),
    ]  # fmt: skip
    yaw = best.matched[-1]
    assert yaw.difference == pytest.approx(math.tau - 6.0, abs=1e-6), "angles are compared around the circle"
    assert [(each.feature, each.wanted, each.found) for each in best.missed] == [("near", "CACTUS", ("BOWL", "CUP"))]
    assert sum(each.similarity * each.weight for each in best.compared) == pytest.approx(best.score, abs=1e-9)
    assert best.why().splitlines() == [
        "PickUpAction in episode 1, event 2: SUCCEEDED",
        f"  score {best.score:.3f}",
        "  alike   arm: wanted LEFT, was LEFT",
        "  alike   near: wanted CUP, was BOWL, CUP",
        "  alike   height: wanted 1, was 1 (0 off, tolerance 0.5)",
        "  alike   stand_yaw: wanted 3, was -3 (0.283 off, tolerance 0.5)",
        "  differs near: wanted CACTUS, was BOWL, CUP",
    ]


def test_an_answer_states_how_its_cases_ended_and_what_was_never_seen() -> None:
    found = asked(CUE)
    assert len(found) == 3
    assert found.considered == 4
    assert found.never_seen == (("near", "CACTUS"),)
    assert found.reasons == [("IKError", 1)]
    assert found.success is not None
    assert found.success[3:] == (2, 3)
    assert found.why().splitlines() == [
        "3 of 4 cases for PickUpAction arm=LEFT near=CACTUS near=CUP height~1±0.5 stand_yaw~3±0.5",
        "  2 of 3 succeeded (21-94 %)",
        "  reasons: IKError 1",
        "  never seen: near=CACTUS",
    ]


@pytest.mark.parametrize(
    ("successes", "tries", "low", "high"), [(10, 20, 0.299, 0.701), (0, 20, 0.0, 0.161), (1, 1, 0.207, 1.0)]
)
def test_the_interval_of_the_success_is_that_of_wilson(successes: int, tries: int, low: float, high: float) -> None:
    cases = [pick_up(n + 1, height=1.0, reason=None if n < successes else "IKError") for n in range(tries)]
    rate = success_of(cases)
    assert rate is not None
    assert (rate.share, rate.low, rate.high) == pytest.approx((successes / tries, low, high), abs=1e-3)


def test_an_action_that_was_cancelled_or_lost_does_not_count_for_success() -> None:
    cases = [CASES[0]._replace(status=status) for status in ("CANCELLED", "LOST", "INTERRUPTED")]
    assert success_of(cases) is None
    rate = success_of([*cases, CASES[0]])
    assert rate is not None
    assert rate.tries == 1


def test_what_is_typical_is_counted_by_score() -> None:
    found = asked(CUE)
    height = found.typical("height")
    scores = {each.case.node: each.score for each in found}
    mean = sum(scores[case.node] * case.numbers["height"] for case in CASES[:3]) / sum(scores.values())
    assert height is not None
    assert height.value == pytest.approx(mean)
    assert height.share == 1.0
    arm = found.typical("near")
    assert arm is not None
    assert arm.value == "BOWL"
    assert arm.share == pytest.approx(1.0)
    assert found.typical("weight") is None
    only = found.typical("height", status="FAILED")
    assert only is not None
    assert only[:2] == (1.25, 0.0)


def test_the_typical_angle_is_that_around_the_circle() -> None:
    yaw = answer(Cue(type="PickUpAction"), CaseLibrary([Block.of(CASES[:2])])).typical("stand_yaw")
    assert yaw is not None
    assert isinstance(yaw.value, float)
    assert abs(yaw.value) == pytest.approx(math.pi, abs=1e-6)


def test_a_page_shows_an_answer_without_obeying_its_texts() -> None:
    page = asked(Cue(type="PickUpAction"))._repr_html_()
    assert page.count("<tr>") == 5
    assert "<bdi>&lt;IKError&gt;</bdi>" in page
    assert "<IKError>" not in page
    assert (page.count("✓</span> SUCCEEDED"), page.count("✗</span> FAILED")) == (2, 2)


def test_a_page_of_a_long_answer_has_a_hundred_cases_and_counts_the_others() -> None:
    cases = [pick_up(number, height=1.0) for number in range(1, 151)]
    page = answer(Cue(type="PickUpAction", k=150), CaseLibrary([Block.of(cases)]))._repr_html_()
    assert page.count("<tr>") == 101
    assert "… 50 more" in page


def test_an_answer_without_cases_states_that() -> None:
    empty = answer(Cue(type="FlyAction"), CaseLibrary([Block.of(CASES)]))
    assert list(empty) == []
    assert empty.success is None
    assert empty.reasons == []
    assert empty.why() == "0 of 0 cases for FlyAction"
    assert "<bdi>0 of 0 cases for FlyAction</bdi>" in empty._repr_html_()
