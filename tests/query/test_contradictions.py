"""Contradicting declarations of several processes: every query still has an answer."""

from __future__ import annotations

from typing import Any

import pytest
from sqlalchemy import ForeignKey, select
from sqlalchemy.orm import Mapped, mapped_column

from pycrorm_async.errors import CallerError
from pycrorm_async.events.types import DesignatorTypeDeclared, NodeStarted
from pycrorm_async.orm import Action, Designator, Motion, TaskTreeNode
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
OTHER_KIND = "Wave is declared as {} and as {}"
OF_US = "Wave: its table would be 'pose', which the memory itself uses (set another dtype)"
OF_ANOTHER = "Saying_Action needs the table saying_action, which belongs to SayingAction (set another dtype)"
OTHER_TYPE = (
    "Wave.times is declared as {} and as {} (types that share a name must agree: rename one field or set another dtype)"
)


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
    ("first", "second", "parked", "reason"),
    [
        (WAVE, WAVE_MOTION, 3, OTHER_KIND.format("action", "motion")),
        (WAVE_MOTION, WAVE, 3, OTHER_KIND.format("motion", "action")),
        (WAVE, WAVE_IN_WORDS, 3, OTHER_TYPE.format("integer", "text")),
        (WAVE_IN_WORDS, WAVE, 3, OTHER_TYPE.format("text", "integer")),
        (WAVE, WAVE_AS_POSE, 3, OF_US),
        (WAVE_AS_POSE, WAVE, 2, OF_US),
        (WAVE, SAYING_TWIN, 3, OF_ANOTHER),
        (SAYING_TWIN, WAVE, 2, OF_ANOTHER),
    ],
    ids=[
        "a motion after the action",
        "a motion before the action",
        "text after integer",
        "text before integer",
        "a taken table last",
        "a taken table first",
        "another's table last",
        "another's table first",
    ],
)
async def test_the_refused_declaration_parks_its_episode_and_every_query_has_an_answer(
    log: EventLog, first: DesignatorTypeDeclared, second: DesignatorTypeDeclared, parked: int, reason: str
) -> None:
    await perform_each(log, first, second)
    assert [(each.number, each.parked) for each in await log.stopped()] == [(parked, f"event 1: {reason}")]
    kept = second if parked == 2 else first
    expected = [("SayingAction", "SayingAction"), ("Wave", "Wave")]
    async with Reading.open_address(log.address) as reading:
        assert await answer_to(reading, select(Designator)) == expected
        assert await answer_to(reading, select(Action)) == (expected if kept.kind == "action" else expected[:1])
        assert await answer_to(reading, select(Motion)) == (expected[1:] if kept.kind == "motion" else [])
        wave: Any = reading.mapped("Wave")
        async with reading.session() as session:
            assert [each.times for each in await session.scalars(select(wave))] == [
                3 if kept.fields[0].type == "integer" else "three"
            ]


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
        (declared("Hop", "hop", kind="motion"), declared("Jump", "jump", bases=("Hop",))),
        (declared("Jump", "jump", bases=("Hop",)), declared("Hop", "hop", bases=("Jump",))),
        (declared("Bow", "ORMBow", kind="motion"),),
        (declared("Bow", "ORMBow", kind="language"),),
    ],
    ids=[
        "a built-in base of another kind",
        "a base of another kind later",
        "a base of another kind before",
        "each the other's base",
        "a class of another kind",
        "a class where none belongs",
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
