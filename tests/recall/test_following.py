"""The actions beside, around and after an action, and the relations of Allen, equal those that plain Python finds."""

from __future__ import annotations

import random

import pytest

from pycrorm_async.events.ids import row_id
from pycrorm_async.recall.answer import Relation, Sequences, relation
from pycrorm_async.recall.blocks import Block, CaseLibrary
from pycrorm_async.recall.columns import Case


def action(sequence: int, name: str, *, parent: int = 0, status: str = "SUCCEEDED", episode: int = 1) -> Case:
    around = row_id(episode, parent, 0) if parent else None
    reason = "IKError" if status == "FAILED" else None
    return Case(row_id(episode, sequence, 0), 10 * sequence, name, {}, {}, status, reason, 1.0, around)


PLAN = [
    action(2, "Transport"),
    action(3, "Navigate", parent=2),
    action(5, "PickUp", parent=2, status="FAILED"),
    action(7, "Navigate", parent=2),
    action(9, "PickUp", parent=2),
    action(11, "Park"),
    action(2, "Navigate", episode=2),
]


def library(cases: list[Case]) -> CaseLibrary:
    return CaseLibrary([Block.of(cases[::2]), Block.of(cases[1::2])])


def test_next_and_previous_have_the_same_parent() -> None:
    sequences = Sequences(library(PLAN))
    transport, first, failed, second, pick_up, park, other = PLAN
    assert [sequences.next(case) for case in PLAN] == [park, failed, second, pick_up, None, None, None]
    assert [sequences.previous(case) for case in PLAN] == [None, None, first, failed, second, transport, None]
    assert [sequences.parent(case) for case in PLAN] == [None, transport, transport, transport, transport, None, None]
    assert sequences.case(row_id(2, 2, 0)) == other
    assert sequences.case(row_id(2, 3, 0)) is None
    assert sequences.next(other._replace(node=row_id(9, 9, 0))) is None


def test_what_follows_is_counted_with_how_it_ended() -> None:
    sequences = Sequences(library(PLAN))
    after = sequences.follows("Navigate")
    assert after.cases == 3
    assert [(each.type, each.cases) for each in after.followers] == [("PickUp", 2), (None, 1)]
    pick_up = after.followers[0]
    assert pick_up.share == pytest.approx(2 / 3)
    assert pick_up.success is not None
    assert pick_up.success[3:] == (1, 2)
    failed = sequences.follows("PickUp", reason="IKError")
    assert [(each.type, each.cases) for each in failed.followers] == [("Navigate", 1)]
    assert sequences.follows("PickUp", status="SUCCEEDED").followers == ((None, 1, 1.0, None),)
    assert sequences.follows("Fly") == (0, ())
    assert Sequences(CaseLibrary()).follows("Fly") == (0, ())


def test_simulations_are_not_counted() -> None:
    cases = [action(1, "Navigate")._replace(simulated=True), action(2, "PickUp")._replace(simulated=True)]
    assert Sequences(library(cases)).follows("Navigate") == (0, ())


def interval(start: int, end: int, sequence: int = 1) -> Case:
    """From start to end, in steps of 10 ms, which exceed the millisecond in which moments count as one."""
    return Case(row_id(1, sequence, 0), start * 10_000, "A", {}, {}, "SUCCEEDED", None, (end - start) / 100)


RELATIONS = {
    Relation.BEFORE: (0, 2), Relation.MEETS: (0, 3), Relation.OVERLAPS: (0, 5), Relation.STARTS: (3, 5),
    Relation.DURING: (4, 5), Relation.FINISHES: (4, 6), Relation.EQUALS: (3, 6), Relation.FINISHED_BY: (0, 6),
    Relation.CONTAINS: (0, 9), Relation.STARTED_BY: (3, 9), Relation.OVERLAPPED_BY: (4, 9), Relation.MET_BY: (6, 9),
    Relation.AFTER: (7, 9),
}  # fmt: skip


@pytest.mark.parametrize("name", Relation)
def test_each_relation_of_allen_is_known_from_the_intervals(name: Relation) -> None:
    assert relation(interval(*RELATIONS[name]), interval(3, 6)) is name


def test_an_action_without_an_end_has_no_relation() -> None:
    assert relation(interval(0, 2)._replace(duration_s=None), interval(3, 6)) is None
    assert relation(interval(0, 2), interval(3, 6)._replace(duration_s=None)) is None


def test_the_actions_during_another_are_found_among_those_of_its_episode() -> None:
    chance = random.Random(1)
    cases = [interval(start := chance.randrange(50), start + chance.randrange(1, 20), n) for n in range(1, 60)]
    others = [case._replace(node=row_id(2, case.sequence, 0)) for case in cases]
    sequences = Sequences(library(cases + others))
    for wanted in (Relation.DURING, Relation.OVERLAPS):
        expected = [case for case in cases[1:] if relation(case, cases[0]) is wanted]
        found = sequences.related(cases[0], wanted)
        assert [case.node for case in found] == [
            case.node for case in sorted(expected, key=lambda case: (case.started_us, case.node))
        ]
