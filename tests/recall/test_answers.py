"""An answer states how its cases ended and why each was found; it is the same on both databases."""

from __future__ import annotations

import math
import random
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import pytest

from pycrorm_async import Memory, Reading
from pycrorm_async.events.ids import row_id
from pycrorm_async.operations.copy import copy_episodes
from pycrorm_async.operations.rebuild import rebuild_projection
from pycrorm_async.plan import ActionAbstract
from pycrorm_async.projections.custom import own_projections
from pycrorm_async.recall.answer import Answer, Relation, Sequences, answer, relation, success_of
from pycrorm_async.recall.blocks import CaseBlock, CaseLibrary
from pycrorm_async.recall.columns import Case
from pycrorm_async.recall.recall import Recall
from pycrorm_async.recall.search import Cue, Wanted
from tests.databases import Server
from tests.recall.sliding_grips import FETCH, GRIP, record

# === answer ===================================================================================================
#
# An answer states how its cases ended, why each was found, and what they have in common.


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
    return answer(cue, CaseLibrary([CaseBlock.of(CASES)]))


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
    yaw = answer(Cue(type="PickUpAction"), CaseLibrary([CaseBlock.of(CASES[:2])])).typical("stand_yaw")
    assert yaw is not None
    assert isinstance(yaw.value, float)
    assert abs(yaw.value) == pytest.approx(math.pi, abs=1e-6)


def test_a_page_shows_a_hundred_cases_of_an_answer_without_obeying_their_texts() -> None:
    page = asked(Cue(type="PickUpAction"))._repr_html_()
    assert page.count("<tr>") == 5
    assert "<bdi>&lt;IKError&gt;</bdi>" in page
    assert "<IKError>" not in page
    assert (page.count("✓</span> SUCCEEDED"), page.count("✗</span> FAILED")) == (2, 2)
    cases = [pick_up(number, height=1.0) for number in range(1, 151)]
    page = answer(Cue(type="PickUpAction", k=150), CaseLibrary([CaseBlock.of(cases)]))._repr_html_()
    assert page.count("<tr>") == 101
    assert "… 50 more" in page


def test_an_answer_without_cases_states_that() -> None:
    empty = answer(Cue(type="FlyAction"), CaseLibrary([CaseBlock.of(CASES)]))
    assert list(empty) == []
    assert empty.success is None
    assert empty.reasons == []
    assert empty.why() == "0 of 0 cases for FlyAction\n  never seen: type FlyAction; there are PickUpAction"
    assert "<bdi>0 of 0 cases for FlyAction</bdi>" in empty._repr_html_()


# === following ================================================================================================
#
# The actions beside, around and after an action, and the relations of Allen, equal those that plain Python finds.


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
    return CaseLibrary([CaseBlock.of(cases[::2]), CaseBlock.of(cases[1::2])])


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


def test_each_relation_of_allen_is_known_from_the_intervals_unless_one_has_no_end() -> None:
    for name in Relation:
        assert relation(interval(*RELATIONS[name]), interval(3, 6)) is name
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


# === renamed types ============================================================================================
#
# A type that was renamed is found by each of its names, with the cases of all, and the answer states that.


@dataclass
class GraspActionPerformable(ActionAbstract):
    """A class whose former name is that of a recorded type; it was never performed."""

    aliases = ("TakeAction",)
    arm: str = ""

    async def perform(self) -> None: ...


def record_renamed(url: str, folder: Path, *, renamed: bool) -> None:
    """Take with the left arm, which fails, then under a new name with the right arm."""
    with Memory.sync(url, spool=folder / "spool") as memory:
        names = [("TakeAction", (), "LEFT"), ("GrabAction", ("TakeAction",), "RIGHT")]
        for name, aliases, arm in names if renamed else names[:1]:
            type_ = memory.recording.type("action", name, {"arm": str}, aliases=aliases)
            with memory.recording.episode(description=name) as episode:
                episode.start("around", memory.recording.type("action", "WorkAction", {}))
                episode.start("it", type_, {"arm": arm}, parent="around")
                episode.end("it", "FAILED" if arm == "LEFT" else "SUCCEEDED")
                episode.end("around", "SUCCEEDED")
        memory.flush()


@pytest.mark.soak_on("postgresql")
async def test_each_name_finds_the_cases_of_both(database_url: str, tmp_path: Path) -> None:
    record_renamed(database_url, tmp_path, renamed=True)
    async with Reading.open(database_url) as reading:
        recall = Recall.of(reading)
        for name in ("GrabAction", "TakeAction"):
            answer = await recall(name, has={"arm": "LEFT"})
            assert [(each.symbols["arm"], each.case.type) for each in answer] == [("LEFT", "GrabAction")]
            assert answer.considered == 2
            assert answer.joined == ("GrabAction", "TakeAction")
            assert "  renamed: counts the cases of GrabAction and TakeAction" in answer.why()
            assert len(await recall(name)) == 2
            assert (await recall.follows(name)).cases == 2
        (follower,) = [each for each in (await recall.follows("GrabAction")).followers if each.type is None]
        assert follower.cases == 2
        answer = await recall.like((await recall("GrabAction"))[0])
        assert [each.symbols["arm"] for each in answer] == ["LEFT"]
        assert (await recall("WorkAction")).joined == ()
        assert await recall.types() == ("GrabAction", "TakeAction", "WorkAction")


async def test_a_class_that_was_never_performed_finds_the_cases_of_its_former_name(tmp_path: Path) -> None:
    url = f"sqlite:///{tmp_path / 'memory.db'}"
    record_renamed(url, tmp_path, renamed=False)
    async with Reading.open(url) as reading:
        recall = Recall.of(reading)
        assert len(await recall("GraspAction")) == 0
        answer = await recall(GraspActionPerformable)
        assert [each.symbols["arm"] for each in answer] == ["LEFT"]
        assert answer.joined == ("TakeAction",)


async def test_a_type_that_is_renamed_while_the_memory_is_open_is_found_at_once(tmp_path: Path) -> None:
    url = f"sqlite:///{tmp_path / 'memory.db'}"
    record_renamed(url, tmp_path, renamed=False)
    async with Reading.open(url) as reading:
        recall = Recall.of(reading)
        assert len(await recall("TakeAction")) == 1
        record_renamed(url, tmp_path, renamed=True)
        assert len(await recall("TakeAction")) == 3
        assert len(await recall("GrabAction")) == 3


# === same answers =============================================================================================
#
# The answers of a memory are the same on both databases and after a rebuild; damage and other versions are named.

Shape = tuple[tuple[float, int, int, str], ...]


async def answers(url: str) -> list[Shape]:
    """The answers of a memory to random cues: score, episode and event of each case, and what was different."""
    chance = random.Random(3)
    shapes = []
    async with Reading.open(url) as reading:
        recall = Recall.of(reading)
        for _ in range(50):
            pairs = [("arm", "LEFT"), ("arm", "RIGHT"), ("item", "cup"), ("item", "plate"), ("inside", FETCH)]
            has: dict[str, Any] = {}
            for feature, word in chance.sample(pairs, chance.randrange(4)):
                has.setdefault(feature, []).append(word)
            near = {"level": chance.choice((chance.random() + 0.5, (1.0, 0.2)))} if chance.random() < 0.5 else {}
            answer = await recall(GRIP, has=has, near=near, k=chance.choice((3, 50)))
            shapes.append(
                tuple((each.score, each.case.episode, each.case.sequence, each.difference()) for each in answer)
            )
    return shapes


@pytest.mark.slow
@pytest.mark.soak
async def test_both_databases_and_a_rebuild_return_the_same_answers(tmp_path: Path, server: Server) -> None:
    here, there = f"sqlite:///{tmp_path / 'memory.db'}", server.new_database()
    async with Memory.open(here) as memory:
        await record(memory)
        await memory.flush()
        await record(memory)
    expected = await answers(here)
    assert sum(map(len, expected)) > 300
    await copy_episodes(here, there)
    assert await answers(there) == expected
    for url in (here, there):
        await rebuild_projection(url, own_projections()[0])
        assert await answers(url) == expected
