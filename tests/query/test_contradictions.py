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


OTHERS = (
    declared("Jump", "jump", bases=("MoveMotion",)),  # a built-in base of another kind
    declared("Skip", "skip", bases=("Hop",)),  # a base of another kind, which is declared later
    declared("Hop", "hop", kind="motion"),
    declared("Turn", "turn", bases=("Spin",)),  # each is the other's base
    declared("Spin", "spin", bases=("Turn",)),
    declared("Bow", "ORMBow", kind="motion"),  # a class of another kind
)


async def test_every_query_has_an_answer_whatever_declarations_contradict_each_other(log: EventLog) -> None:
    """A later declaration gets other names, a refused one parks its episode, bases of another kind are ignored."""
    await perform_each(log, WAVE, WAVE_MOTION, WAVE_IN_WORDS, SAYING_TWIN, *OTHERS, WAVE_AS_POSE)
    assert [(each.number, each.parked) for each in await log.stopped()] == [(12, f"event 1: {OF_US}")]
    actions, motions = ["SayingAction", "Wave", "Wave", "Saying_ActionAction"], ["WaveMotion"]
    actions += [each.dtype for each in OTHERS if each.kind == "action"]
    motions += [each.dtype for each in OTHERS if each.kind == "motion"]
    async with Reading.open_address(log.address) as reading:
        for question, dtypes in ((Action, actions), (Motion, motions), (ORMBow, [])):
            assert [dtype for _, dtype in await answer_to(reading, select(question))] == dtypes
        everything = await answer_to(reading, select(Designator))
        assert everything[:5] == [
            (each, each) for each in ("SayingAction", "Wave", "WaveMotion", "Wave", "Saying_ActionAction")
        ]
        async with reading.session() as session:
            nodes = (await session.scalars(select(TaskTreeNode).order_by(TaskTreeNode.id))).all()
            assert [each.dtype for each in nodes] == [dtype for _, dtype in everything]
            assert [each.action and each.action.dtype for each in nodes] == [dtype for _, dtype in everything]
            for dtype, attribute, values in (
                ("Wave", "times", [3, None]),
                ("Wave", "times_text", [None, "three"]),
                ("WaveMotion", "times", [3]),
                ("Saying_ActionAction", "times", [3]),
            ):
                rows = await session.scalars(select(reading.mapped(dtype)).order_by("id"))
                assert [getattr(each, attribute) for each in rows] == values, (dtype, attribute)
    kept = {line.rpartition(" is kept as ")[2] for line in await contradictions(log)}
    assert kept >= {"WaveMotion", "times_text", "Saying_ActionAction"}


async def test_a_type_without_an_accepted_declaration_has_no_class_until_a_later_one_is_accepted(log: EventLog) -> None:
    await perform_each(log, WAVE_AS_POSE)
    async with Reading.open_address(log.address) as reading:
        assert await answer_to(reading, select(Designator)) == [("SayingAction", "SayingAction")]
        with pytest.raises(CallerError, match=r"this memory has no type 'Wave' \(its types: SayingAction\)"):
            reading.mapped("Wave")
        wave = Script(3)
        wave.put(NodeStarted("action", None, name_of(WAVE), {"times": 3}))
        await stored_and_folded(log, [*declarations(WAVE), *wave.records])
        assert await answer_to(reading, select(Designator)) == [("SayingAction", "SayingAction"), ("Wave", "Wave")]
