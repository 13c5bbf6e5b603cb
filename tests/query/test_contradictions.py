"""Contradicting declarations of several processes: every query still has an answer."""

from __future__ import annotations

from typing import Any

import pytest
from sqlalchemy import ForeignKey, select
from sqlalchemy.orm import Mapped, mapped_column

from pycrorm_async.errors import CallerError
from pycrorm_async.events.types import DesignatorTypeDeclared, NodeStarted
from pycrorm_async.orm import Action, Designator, Motion, TaskTreeNode
from pycrorm_async.projections.generations import contradictions
from pycrorm_async.query.reading import Reading
from pycrorm_async.store.log import EventLog
from tests.projections.event_script import SAYING, Script, declarations, declared, field, name_of
from tests.projections.sql_queries import stored_and_folded

pytestmark = [pytest.mark.soak_on("postgresql"), pytest.mark.slow]
"""These tests take long on a server, where they run in turns; other modules show that the server behaves alike."""

WAVE = declared("Wave", "wave", field("times", "integer", 2))
WAVE_MOTION = declared("Wave", "wave", field("times", "integer", 2), kind="motion")
WAVE_AS_POSE = declared("Wave", "pose", field("times", "integer", 2))
WAVE_IN_WORDS = declared("Wave", "wave", field("times", "text", 2))
SAYING_TWIN = declared("Saying_Action", "saying_action", field("times", "integer", 2))
OF_US = "Wave: its table would be 'pose', which the memory itself uses (set another dtype)"


class ORMBow(Action):
    """An author's class of an action."""

    id: Mapped[int] = mapped_column(ForeignKey(f"{Action.__tablename__}.id"), primary_key=True, init=False)


async def answer_to(reading: Reading, question: Any) -> list[tuple[str, str]]:
    """Return class and dtype of every designator in the answer."""
    async with reading.session() as session:
        return [(type(each).__name__, each.dtype) for each in await session.scalars(question.order_by("id"))]


async def perform_each(log: EventLog, *types: DesignatorTypeDeclared) -> None:
    """Perform every type in an episode of its own, in this order, after one with a SayAction."""
    scripts = [Script(number) for number in range(1, len(types) + 2)]
    scripts[0].put(NodeStarted("action", None, name_of(SAYING), {"text": "hi"}))
    for script, each in zip(scripts[1:], types, strict=True):
        value: Any = 3 if not each.fields or each.fields[0].type == "integer" else "three"
        script.put(NodeStarted(each.kind, None, name_of(each), {"times": value}))
    await stored_and_folded(
        log, [*declarations(SAYING, *types), *(record for script in scripts for record in script.records)]
    )


@pytest.mark.parametrize(
    ("first", "second", "other", "attribute"),
    [
        (WAVE, WAVE_MOTION, "WaveMotion", "times"),
        (WAVE, WAVE_IN_WORDS, "Wave", "times_text"),
        (WAVE, SAYING_TWIN, "Saying_ActionAction", "times"),
    ],
    ids=["a motion after the action", "text after integer", "the table of another"],
)
async def test_the_later_declaration_has_other_names_and_every_query_has_an_answer(
    log: EventLog, first: DesignatorTypeDeclared, second: DesignatorTypeDeclared, other: str, attribute: str
) -> None:
    await perform_each(log, first, second)
    assert await log.stopped() == []
    expected = [("SayingAction", "SayingAction"), ("Wave", "Wave"), (other, other)]
    kinds = ["action", first.kind, second.kind]
    async with Reading.open_address(log.address) as reading:
        assert await answer_to(reading, select(Designator)) == expected
        for question, kind in ((select(Action), "action"), (select(Motion), "motion")):
            answer = [each for each, its in zip(expected, kinds, strict=True) if its == kind]
            assert await answer_to(reading, question) == answer
        async with reading.session() as session:
            values = [
                [getattr(each, name) for each in await session.scalars(select(reading.mapped(dtype)).order_by("id"))]
                for dtype, name in (("Wave", "times"), (other, attribute))
            ]
        recorded = [3 if each.fields[0].type == "integer" else "three" for each in (first, second)]
        beside = [None] if other == "Wave" else []
        assert values == [[recorded[0], *beside], [*beside, recorded[1]]]
    line = (await contradictions(log))[0]
    assert line.endswith(f" is kept as {attribute if other == 'Wave' else other}")


@pytest.mark.parametrize(
    ("first", "second", "parked"),
    [(WAVE, WAVE_AS_POSE, 3), (WAVE_AS_POSE, WAVE, 2)],
    ids=["a table of the memory last", "a table of the memory first"],
)
async def test_the_refused_declaration_parks_its_episode_and_every_query_has_an_answer(
    log: EventLog, first: DesignatorTypeDeclared, second: DesignatorTypeDeclared, parked: int
) -> None:
    await perform_each(log, first, second)
    assert [(each.number, each.parked) for each in await log.stopped()] == [(parked, f"event 1: {OF_US}")]
    async with Reading.open_address(log.address) as reading:
        for question in (select(Designator), select(Action)):
            assert await answer_to(reading, question) == [("SayingAction", "SayingAction"), ("Wave", "Wave")]
        assert await answer_to(reading, select(Motion)) == []


async def test_a_type_without_an_accepted_declaration_has_no_class(log: EventLog) -> None:
    await perform_each(log, WAVE_AS_POSE)
    async with Reading.open_address(log.address) as reading:
        assert await answer_to(reading, select(Designator)) == [("SayingAction", "SayingAction")]
        with pytest.raises(CallerError, match=r"this memory has no type 'Wave' \(its types: SayingAction\)"):
            reading.mapped("Wave")


@pytest.mark.parametrize(
    "types",
    [
        (declared("Jump", "jump", bases=("MoveMotion",)),),
        (declared("Jump", "jump", bases=("Hop",)), declared("Hop", "hop", kind="motion")),
        (declared("Jump", "jump", bases=("Hop",)), declared("Hop", "hop", bases=("Jump",))),
        (declared("Bow", "ORMBow", kind="motion"),),
    ],
    ids=[
        "a built-in base of another kind",
        "a base of another kind later",
        "each the other's base",
        "a class of another kind",
    ],
)
async def test_bases_and_classes_of_another_kind_are_ignored(
    log: EventLog, types: tuple[DesignatorTypeDeclared, ...]
) -> None:
    await perform_each(log, *types)
    assert await log.stopped() == []
    everything = [("SayingAction", "action"), *((each.dtype, each.kind) for each in types)]
    async with Reading.open_address(log.address) as reading:
        for question, kinds in (
            (select(Designator), ("action", "motion", "language")),
            (select(Action), ("action",)),
            (select(Motion), ("motion",)),
        ):
            answer = await answer_to(reading, question)
            assert [dtype for _, dtype in answer] == [dtype for dtype, kind in everything if kind in kinds]
        assert await answer_to(reading, select(ORMBow)) == []
        async with reading.session() as session:
            nodes = (await session.scalars(select(TaskTreeNode).order_by(TaskTreeNode.id))).all()
            assert [each.action and each.action.dtype for each in nodes] == [dtype for dtype, _ in everything]
